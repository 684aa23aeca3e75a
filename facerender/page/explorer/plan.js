// The plan of a budget: its decisions as switches, which are on where B has what they say, and what
// each loses by itself of the picture on screen.
const decisions = facts.plan?.decisions ?? [];
const switches = decisions.filter(({on}) => on);  // what the page can draw

// What budgets are in, and what the page measures for each.
const UNITS = {
  display: {scale: 255, unit: "1/255", measure: "display"},
  relative: {scale: 100, unit: "%", measure: "relative"},
  flip: {scale: 1, unit: "FLIP", measure: "display"},
};
const inBudget = UNITS[facts.plan?.unit];
const onScreen = UNITS[inBudget?.measure];

const has = (term, fields) => Object.entries(fields).every(([name, value]) => term[name] === value);

// The full shading with what the plan takes.
const planTerm = full => Object.assign(full, ...switches.filter(({taken}) => taken).map(({on}) => on));

// All that the losses of the decisions depend on: everything but B and how it is shown.
function viewed(state, size) {
  return JSON.stringify([size, state.a, state.camera, state.lights, state.ambient, state.only, state.exposure]);
}

// What A loses with each decision alone, in what the budget is in; null where stop() says so.
async function lossesAlone(drawing, state, tell, stop) {
  const losses = [];
  drawing.draw("a", state);
  for (const {alone, name} of switches) {
    tell(`measuring ${name}`);
    drawing.draw("b", {...state, b: {...state.a, ...alone}});
    const measuring = drawing.measure(state);
    drawing.draw("b", state);
    const found = await measuring;
    if (!found || stop()) return null;
    const {largest} = statistics(found, drawing.size[0])[inBudget.measure];
    losses.push(inBudget.measure === "display" ? largest : onScreen.scale * largest);
  }
  return {of: viewed(state, drawing.size), losses};
}

// Fills the section, or removes it where there is no plan. losses: what was measured last, or null.
function buildPlan(state, size, losses, changed) {
  if (!facts.plan) {
    byId("plan").remove();
    return;
  }
  byId("plan-lines").append(...Object.entries(facts.plan.lines).flatMap(([name, text]) =>
    [element("dt", {}, name), element("dd", {}, text)]));
  const row = decision => {
    const {name, words, on, off, saving, loss} = decision;
    const here = element("td", {}, "–");
    const said = element("span", {}, element("b", {}, name), ` ${words}`);
    let title = said;
    if (on) {
      const box = element("input", {type: "checkbox"});
      box.addEventListener("change", () => {
        Object.assign(state().b, box.checked ? on : off);
        changed();
      });
      title = element("label", {}, box, said);
      refreshers.push(() => {
        box.checked = has(state().b, on);
        const found = losses();
        const now = found?.of === viewed(state(), size());
        here.textContent = now ? figure(found.losses[switches.indexOf(decision)]) : "–";
      });
    }
    const share = (100 * saving).toFixed(1).replace("-", "−");
    return element("tr", {}, element("th", {scope: "row"}, title),
      ...[share, loss === null ? "any" : figure(inBudget.scale * loss)].map(text => element("td", {}, text)), here);
  };
  const groups = [
    ["taken: what each loses alone", switches.filter(({taken}) => taken)],
    ["not taken: alone here; by the plan at least, with what is taken", switches.filter(({taken}) => !taken)],
    ["not drawn here", decisions.filter(({on}) => !on)],
  ];
  byId("decisions").append(element("table", {className: "decisions"},
    element("thead", {}, element("tr", {}, ...[["decision"], ["saves", "%"], ["loses by the plan", inBudget.unit],
      ["loses here", onScreen.unit]].map(([text, unit = ""]) =>
      element("th", {scope: "col"}, `${text} `, element("span", {className: "unit"}, unit))))),
    ...groups.filter(([, list]) => list.length).map(([title, list]) => element("tbody", {},
      element("tr", {}, element("th", {scope: "rowgroup", colSpan: 4, className: "group"}, title)),
      ...list.map(row)))));
  byId("plan-reset").addEventListener("click", () => {
    const {a, b} = firstState();
    Object.assign(state(), {a, b});
    changed();
  });
  refreshers.push(() => {
    const first = firstState();
    const [full, whole] = ["a", "b"].map(which => has(state()[which], first[which]));
    const count = switches.filter(({on}) => has(state().b, on)).length;
    byId("plan-told").textContent = `${full ? "A is the full shading" : "A is not the full shading"}, `
      + `B ${whole ? "is the plan" : `has ${count} of ${switches.length} decisions`}.`;
  });
}
