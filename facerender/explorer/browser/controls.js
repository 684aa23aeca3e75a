// The controls, made from the registry. Each control reads and writes the state.
function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name in made) made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

const byId = id => document.getElementById(id);
const refreshers = [];  // functions that update the controls from the state

function refresh() {
  for (const each of [...refreshers]) each();
}

// Adds radio buttons side by side, from pairs of value and text.
function choice(id, pairs, read, write) {
  const inputs = pairs.map(([value, text]) => {
    const input = element("input", {type: "radio", name: id, value});
    input.addEventListener("change", () => write(value));
    byId(id).append(element("label", {}, input, element("span", {}, text)));
    return input;
  });
  refreshers.push(() => inputs.forEach(input => { input.checked = input.value === read(); }));
}

function selection(label, names, read, write) {
  const options = names.map(([value, text]) => element("option", {value}, text));
  const made = element("select", {"aria-label": label}, ...options);
  made.addEventListener("change", () => write(made.value));
  refreshers.push(() => { made.value = read(); });
  return made;
}

// Shows a text below an input, or hides the text if it is empty.
function showRange(input, text) {
  const box = input.getBoundingClientRect();
  const made = byId("range");
  made.hidden = !text;
  made.textContent = text || "";
  const [left, below] = [innerWidth - made.offsetWidth, innerHeight - made.offsetHeight];
  made.style.left = `${clamp(box.left, 0, Math.max(left - 8, 0))}px`;
  made.style.top = `${box.bottom + 4 > below ? box.top - made.offsetHeight - 4 : box.bottom + 4}px`;
}

// Returns an input for a number in a range. With `empty`, an empty input means null, and the
// placeholder shows `empty`.
function number(label, [min, max], read, write, {step = "any", empty = null} = {}) {
  const made = element("input", {
    type: "number", "aria-label": label, min, max, step, inputMode: "decimal", placeholder: empty ?? "",
  });
  made.addEventListener("input", () => {
    const none = made.value === "" && empty !== null && !made.validity.badInput;
    const good = made.value !== "" && isWithin(+made.value, [min, max])
      && (step === "any" || Number.isInteger(+made.value / step));
    if (none || good) write(none ? null : +made.value);
    const wrong = !none && !good;
    made.classList.toggle("wrong", wrong);
    showRange(made, wrong && `${label}: give ${step === 1 ? "a whole number" : "a number"} from `
      + `${short(min)} to ${short(max)}${empty === null ? "" : `, or nothing for ${empty}`}`);
  });
  made.addEventListener("blur", () => {
    refresh();
    showRange(made, "");
  });
  refreshers.push(() => {
    if (made === document.activeElement && made.value !== "") return;
    const value = read();
    made.value = value === null ? "" : narrow(value);
    made.classList.remove("wrong");
  });
  return made;
}

function slider(label, {low, high, step}, read, write, text) {
  const input = element("input", {type: "range", min: low, max: high, step, "aria-label": label});
  const output = element("output");
  input.addEventListener("input", () => write(+input.value));
  refreshers.push(() => {
    input.value = read();
    output.textContent = text(read());
    input.setAttribute("aria-valuetext", output.textContent);
  });
  return element("label", {className: "slider"}, element("span", {}, label), input, output);
}

const button = (text, label, press) => {
  const made = element("button", {type: "button", title: label, "aria-label": label}, text);
  made.addEventListener("click", press);
  return made;
};

// Returns the mesh file's value of a uniform if all parts have the same value, else "per part".
function ownValue(name) {
  const values = new Set(facts.parts.map(part => short(part.uniforms[name])));
  return values.size === 1 ? [...values][0] : "per part";
}

function slopeWords() {
  const mapped = facts.parts.some(part => part.features.includes("ROUGHNESS_MAP"));
  return mapped ? "map" : ownValue("slope");
}

// Returns the table head: the names of A and B, and buttons that copy and swap them.
function termHead(state, changed) {
  return element("tr", {}, element("td", {},
    button("⇄", "Swap A and B", () => {
      [state().a, state().b] = [state().b, state().a];
      changed();
    })),
    ...[["a", "b", "→ B"], ["b", "a", "A ←"]].map(([which, other, text]) =>
      element("th", {scope: "col", className: which}, element("b", {}, SWATCH[which]),
        button(text, `Copy ${SWATCH[which]} to ${SWATCH[other]}`, () => {
          state()[other] = {...state()[which]};
          changed();
        }))));
}

// Returns the table of A and B, one row per field. Rows are marked if A and B differ.
function termTable(state, changed) {
  const rows = [];
  const set = (which, name) => value => {
    state()[which][name] = value;
    changed();
  };
  const isOwn = term => term.lobe === "g-power";
  const row = (label, name, cell, {shown = () => true, used = () => true} = {}) => {
    const cells = ["a", "b"].map(which => element("td", {}, cell(`${label} of ${SWATCH[which]}`,
      () => state()[which][name], set(which, name))));
    const made = element("tr", {}, element("th", {scope: "row"}, label), ...cells);
    refreshers.push(() => {
      made.hidden = !shown();
      made.classList.toggle("changed", state().a[name] !== state().b[name]);
      ["a", "b"].forEach((which, i) => {
        const off = !used(state()[which]);
        cells[i].classList.toggle("unused", off);
        cells[i].querySelectorAll("input, select").forEach(each => { each.disabled = off; });
      });
    });
    rows.push(made);
  };
  const chosen = (label, name, names, more) =>
    row(label, name, (title, read, write) => selection(title, names, read, write), more);
  const typed = (label, name, options, more) => row(label, name,
    (title, read, write) => number(title, ranges.term[name] ?? ranges.term.m, read, write, options), more);
  const same = names => names.map(name => [name, name]);
  const power = {shown: () => isOwn(state().a) || isOwn(state().b), used: isOwn};
  const factors = {used: term => modelOf(term).factors};

  chosen("model", "model", Object.entries(registry.models).map(([name, {title}]) => [name, title]));
  chosen("lobe", "lobe", same([...Object.keys(registry.lobes), "g-power"]));
  typed("power g", "g", {step: 1}, power);
  typed("factor", "factor", {}, power);
  typed("offset", "offset", {}, power);
  chosen("Fresnel", "fresnel", same(registry.fresnel), factors);
  chosen("masking", "masking", same(registry.masking), factors);
  row("m", "m", (title, read, write) => {
    const range = element("input", {
      type: "range", min: 0.05, max: 0.7, step: 0.005, "aria-label": `${title}, slider`,
    });
    range.addEventListener("input", () => write(+range.value));
    refreshers.push(() => { range.value = read() ?? 0.3; });
    return element("div", {className: "ranged"},
      number(title, ranges.term.m, read, write, {empty: slopeWords()}), range);
  });
  typed("m of plan", "constant", {empty: "none"},
    {shown: () => state().a.constant !== null || state().b.constant !== null});
  typed("f0", "f0", {empty: ownValue("f0")});
  typed("ks", "ks", {empty: ownValue("specular_weight")});

  return element("table", {className: "terms"}, element("thead", {}, termHead(state, changed)),
    element("tbody", {}, ...rows));
}

// Returns a colour with another brightness. 0 keeps the hue: the user may be about to type 0.5.
function dimmed(color, value) {
  const highest = Math.max(...color);
  return color.map(x => Math.max(value, 1e-9) * (highest ? x / highest : 1));
}

// Returns an input for the brightness of a colour.
const brightness = (label, owner, name, changed) => number(label, ranges.light.irradiance,
  () => Math.max(...owner()[name]), value => {
    owner()[name] = dimmed(owner()[name], value);
    changed();
  });

// Returns the table of lights, one row per light. It is rebuilt if the number of lights changes.
function lightTable(state, changed) {
  const body = element("tbody");
  const add = button("add a light", "Add a light", () => {
    state().lights.push({azimuth: 0, elevation: 30, irradiance: [2, 2, 2], radius: 0, distance: null});
    changed();
  });
  const heads = ["", "azimuth°", "elevation°", "irradiance", "radius°", ""]
    .map(text => element("th", {scope: "col"}, text));
  let own = [];
  function rowOf(i) {
    const light = () => state().lights[i] ?? {irradiance: [0]};
    const field = name => number(`${name} of light ${i + 1}`, ranges.light[name],
      () => light()[name] ?? null, value => { light()[name] = value; changed(); });
    const swatch = element("i", {className: "swatch"});
    refreshers.push(() => {
      const highest = Math.max(...light().irradiance, 1e-6);
      swatch.style.background = `rgb(${light().irradiance.map(x => Math.round(255 * (x / highest) ** 0.45))})`;
    });
    const cells = [
      swatch, field("azimuth"), field("elevation"),
      brightness(`irradiance of light ${i + 1}`, light, "irradiance", changed), field("radius"),
      button("×", `Remove light ${i + 1}`, () => { state().lights.splice(i, 1); changed(); }),
    ];
    return element("tr", {}, ...cells.map(cell => element("td", {}, cell)));
  }
  refreshers.push(() => {
    const {lights} = state();
    add.disabled = lights.length >= facts.most_lights;
    if (lights.length === body.rows.length) return;
    refreshers.splice(0, refreshers.length, ...refreshers.filter(each => !own.includes(each)));
    const before = refreshers.length;
    body.replaceChildren(...lights.map((_, i) => rowOf(i)));
    own = refreshers.slice(before);
    own.forEach(each => each());
  });
  return element("div", {},
    element("table", {className: "lights"}, element("thead", {}, element("tr", {}, ...heads)), body), add,
    element("label", {className: "ambient"}, "ambient light",
      brightness("irradiance of the ambient light", state, "ambient", changed)));
}
