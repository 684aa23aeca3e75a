// Formats numbers for the page, for URLs, and for GLSL.
const radians = degrees => degrees * Math.PI / 180;
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

// Returns a number as text with six significant digits, without trailing zeros.
const short = x => String(+x.toPrecision(6));

// Returns a number as text of at most seven characters for an input, with two or more digits.
function narrow(x) {
  const texts = [6, 5, 4, 3, 2].map(digits => String(+x.toPrecision(digits)));
  return texts.find(text => text.length <= 7) ?? texts.at(-1);
}

// Returns a number as text with three significant digits for display, never with an exponent.
function figure(x) {
  if (!Number.isFinite(x)) return "not finite";
  if (x === 0) return "0";
  if (Math.abs(x) < 0.001) return "< 0.001";
  const digits = clamp(2 - Math.floor(Math.log10(Math.abs(x))), 0, 4);
  return x.toLocaleString("en", {minimumFractionDigits: digits, maximumFractionDigits: digits});
}

// Returns a float literal: GLSL ES does not convert integers to floats.
function literal(x) {
  const text = String(x);
  return /[.e]/.test(text) ? text : `${text}.0`;
}
