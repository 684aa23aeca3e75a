// Controls, made from the registry: each reads the state and writes it.
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
const refreshers = [];  // bring controls up to the state

function refresh() {
  for (const each of [...refreshers]) each();
}

// A choice of few, pairs of value and text: words side by side.
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

// A number; empty for null where that has a meaning, which the placeholder tells.
function number(label, {low, high, step = "any", empty = null}, read, write) {
  const made = element("input", {
    type: "number", "aria-label": label, min: low, max: high, step, inputMode: "decimal",
    placeholder: empty ?? "",
  });
  made.addEventListener("input", () => {
    if (made.value === "" && empty !== null && !made.validity.badInput) write(null);
    else if (made.value !== "" && +made.value >= low && +made.value <= high) write(+made.value);
    made.classList.toggle("wrong", !(made.value === "" && empty !== null) && !(+made.value >= low
      && +made.value <= high && made.value !== ""));
  });
  made.addEventListener("blur", refresh);
  refreshers.push(() => {
    if (made === document.activeElement && made.value !== "") return;
    const value = read();
    made.value = value === null ? "" : short(value);
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

// The file's own value of a uniform, where all parts have the same.
function ownValue(name) {
  const values = new Set(facts.parts.map(part => short(part.uniforms[name])));
  return values.size === 1 ? [...values][0] : "the file's";
}

function slopeWords() {
  const mapped = facts.parts.some(part => part.features.includes("ROUGHNESS_MAP"));
  return mapped ? "map" : ownValue("slope");
}

// The table of A and B; a row for each field, marked where they differ.
function termTable(state, changed) {
  const rows = [];
  function row(label, cell, {shown = () => true, used = () => true} = {}) {
    const cells = ["a", "b"].map(which => element("td", {}, cell(which)));
    const made = element("tr", {}, element("th", {scope: "row"}, label), ...cells);
    refreshers.push(() => {
      made.hidden = !shown();
      ["a", "b"].forEach((which, i) => {
        const off = !used(state()[which]);
        cells[i].classList.toggle("unused", off);
        cells[i].querySelectorAll("input, select").forEach(each => { each.disabled = off; });
      });
    });
    rows.push(made);
    return made;
  }
  const set = (which, name) => value => {
    state()[which][name] = value;
    changed();
  };
  const marked = (made, name) => refreshers.push(() => {
    made.classList.toggle("changed", state().a[name] !== state().b[name]);
  });
  const chosen = (label, name, names, more) => marked(row(label, which => selection(
    `${label} of ${SWATCH[which]}`, names, () => state()[which][name], set(which, name)), more), name);
  const given = (label, name, limits, more) => marked(row(label, which => number(
    `${label} of ${SWATCH[which]}`, limits, () => state()[which][name], set(which, name)), more), name);
  const same = names => Object.keys(names).map(name => [name, name]);
  const power = {
    shown: () => [state().a, state().b].some(term => term.lobe === "g-power"),
    used: term => term.lobe === "g-power",
  };
  const factors = {used: term => modelOf(term).factors};

  chosen("model", "model", Object.entries(registry.models).map(([name, {title}]) => [name, title]));
  chosen("lobe", "lobe", [...same(registry.lobes), ["g-power", "g-power of one’s own"]]);
  given("power g", "g", {low: 1, high: 31, step: 1}, power);
  given("factor", "factor", {low: 1e-6, high: 1e6}, power);
  given("offset", "offset", {low: -1e6, high: 1e6}, power);
  chosen("Fresnel", "fresnel", same(registry.fresnel), factors);
  chosen("masking", "masking", same(registry.masking), factors);
  const [low, high] = registry.slopes;
  marked(row("slope m", which => {
    const read = () => state()[which].m;
    const range = element("input", {
      type: "range", min: 0.05, max: 0.7, step: 0.005, "aria-label": `slope m of ${SWATCH[which]}, slider`,
    });
    range.addEventListener("input", () => set(which, "m")(+range.value));
    refreshers.push(() => { range.value = read() ?? 0.3; });
    const typed = number(`slope m of ${SWATCH[which]}`, {low, high, empty: slopeWords()}, read,
      set(which, "m"));
    return element("div", {className: "ranged"}, typed, range);
  }), "m");
  given("f0", "f0", {low: 0, high: 0.999, empty: ownValue("f0")});
  given("ks", "ks",
    {low: 0, high: registry.largest_weight, empty: ownValue("specular_weight")});

  const head = element("tr", {}, element("td", {},
    button("⇄", "Swap A and B", () => {
      [state().a, state().b] = [state().b, state().a];
      changed();
    })),
    ...["a", "b"].map(which => element("th", {scope: "col", className: which},
      element("b", {}, SWATCH[which]),
      button(which === "a" ? "→ B" : "A ←", `Make ${which === "a" ? "B" : "A"} the same`, () => {
        state()[which === "a" ? "b" : "a"] = {...state()[which]};
        changed();
      }))));
  return element("table", {className: "terms"}, element("thead", {}, head), element("tbody", {}, ...rows));
}

// A colour of another brightness; one of 0 keeps its hue, for it may be on the way to 0.5.
function dimmed(color, value) {
  const highest = Math.max(...color);
  return color.map(x => Math.max(value, 1e-9) * (highest ? x / highest : 1));
}

// A row for each light; made anew where their number changes.
function lightTable(state, changed) {
  const body = element("tbody");
  const add = button("add a light", "Add a light", () => {
    state().lights.push({azimuth: 0, elevation: 30, irradiance: [2, 2, 2], radius: 0, distance: null});
    changed();
  });
  const box = element("div", {}, element("table", {className: "lights"},
    element("thead", {}, element("tr", {}, ...["", "azimuth°", "elevation°", "irradiance", "radius°", ""]
      .map(text => element("th", {scope: "col"}, text)))), body), add);
  let built = -1;
  let own = [];
  function build() {
    refreshers.splice(0, refreshers.length, ...refreshers.filter(each => !own.includes(each)));
    const before = refreshers.length;
    body.replaceChildren(...state().lights.map((_, i) => {
      const light = () => state().lights[i] ?? {irradiance: [0]};
      const field = (name, label, limits) => number(`${label} of light ${i + 1}`, limits,
        () => light()[name] ?? null, value => { light()[name] = value; changed(); });
      const power = number(`irradiance of light ${i + 1}`, {low: 0, high: 1e5},
        () => Math.max(...light().irradiance), value => {
          light().irradiance = dimmed(light().irradiance, value);
          changed();
        });
      const cells = [
        element("i", {className: "swatch"}), field("azimuth", "azimuth", {low: -3600, high: 3600}),
        field("elevation", "elevation", {low: -90, high: 90}), power,
        field("radius", "radius", {low: 0, high: 20}),
        button("×", `Remove light ${i + 1}`, () => { state().lights.splice(i, 1); changed(); }),
      ];
      refreshers.push(() => {
        const highest = Math.max(...light().irradiance, 1e-6);
        cells[0].style.background = `rgb(${light().irradiance.map(x => Math.round(255 * (x / highest) ** 0.45))})`;
      });
      return element("tr", {}, ...cells.map(cell => element("td", {}, cell)));
    }));
    own = refreshers.slice(before);
    own.forEach(each => each());
  }
  refreshers.push(() => {
    add.disabled = state().lights.length >= MOST_LIGHTS;
    if (state().lights.length === built) return;
    built = state().lights.length;
    build();
  });
  const highest = () => Math.max(...state().ambient);
  const ambient = number("irradiance from everywhere", {low: 0, high: 1e5}, highest, value => {
    state().ambient = dimmed(state().ambient, value);
    changed();
  });
  box.append(element("label", {className: "ambient"}, "from everywhere", ambient));
  return box;
}
