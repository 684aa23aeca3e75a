// Numbers as texts: in the page, in links, and in GLSL.
const radians = degrees => degrees * Math.PI / 180;
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

// Six digits, without zeros at the end.
const short = x => String(+x.toPrecision(6));

// Three digits as a reader wants them; never an exponent.
function figure(x) {
  if (!Number.isFinite(x)) return "not finite";
  if (x === 0) return "0";
  if (Math.abs(x) < 0.001) return "< 0.001";
  const digits = clamp(2 - Math.floor(Math.log10(Math.abs(x))), 0, 4);
  return x.toLocaleString("en", {minimumFractionDigits: digits, maximumFractionDigits: digits});
}

// A float literal: GLSL ES takes no whole number for one.
function literal(x) {
  const text = String(x);
  return /[.e]/.test(text) ? text : `${text}.0`;
}
