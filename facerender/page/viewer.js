// Viewer with zoom. It shows two images side by side, in turns, with a slider, or as a difference.
const PIXEL = 8;  // least size of an enlarged pixel, in CSS pixels
const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
for (const viewer of document.querySelectorAll(".viewer")) {
  const find = selector => viewer.querySelector(selector);
  const figures = [...viewer.querySelectorAll("figure")];
  const choices = viewer.querySelectorAll("[name^=zoom]");
  const number = (figure, name) => +figure.style.getPropertyValue(name);
  let centre = null;  // pixel [x, y] in the centre of the enlarged view; null without a zoom

  function draw() {
    viewer.classList.toggle("enlarged", centre !== null);
    for (const figure of figures) {
      const layer = figure.querySelector(".layer");
      const fit = layer.parentElement.clientWidth / number(figure, "--w");
      const zoom = centre && fit ? Math.max(PIXEL, 2 * fit) / fit : 1;
      ["--w", "--h"].forEach((side, axis) => {
        const at = centre ? (centre[axis] + 0.5) / number(figure, side) : 0.5;
        const inside = Math.min(Math.max(at, 0.5 / zoom), 1 - 0.5 / zoom);
        layer.style.setProperty(axis ? "--y" : "--x", inside);
      });
      layer.style.setProperty("--z", zoom);
    }
  }

  function look(at) {
    centre = at;
    for (const choice of choices) choice.checked = !at && !choice.value;
    draw();
  }

  function cut(percent) {
    find(".cut input").value = percent;
    find(".stage").style.setProperty("--cut", percent);
  }

  const swap = () => viewer.classList.toggle("swapped");
  const shows = mode => find(`[value=${mode}]:checked`);
  const across = (event, element) => {
    const box = element.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  };

  viewer.addEventListener("change", ({target}) => {
    const {name, value} = target;
    if (name.startsWith("zoom")) centre = value ? value.split(",").map(Number) : null;
    draw();
  });
  addEventListener("resize", draw);

  let pressed = 0;
  for (const figure of figures) {
    const view = figure.querySelector(".view");
    view.addEventListener("pointerdown", event => { pressed = event.clientX; });
    view.addEventListener("pointermove", event => {
      if (shows("slider")) cut(100 * across(event, view)[0]);
    });
    view.addEventListener("click", event => {
      if (Math.abs(event.clientX - pressed) > 4) return;  // the pointer was dragged, not clicked
      if (centre) return look(null);
      const [x, y] = across(event, figure.querySelector(".layer"));
      look([Math.floor(x * number(figure, "--w")), Math.floor(y * number(figure, "--h"))]);
    });
  }
  const steps = {ArrowLeft: [-4, 0], ArrowRight: [4, 0], ArrowUp: [0, -4], ArrowDown: [0, 4]};
  find(".stage").addEventListener("keydown", event => {
    const step = steps[event.key];
    if (!step || !centre) return;
    event.preventDefault();
    const limits = ["--w", "--h"].map(side => number(figures[0], side) - 1);
    look(centre.map((at, axis) => Math.min(Math.max(at + step[axis], 0), limits[axis])));
  });

  if (find(".cut")) {
    find(".cut input").addEventListener("input", ({target}) => cut(target.value));
    find(".run").checked = !still;
    find(".swap").addEventListener("click", () => { find(".run").checked = false; swap(); });
    setInterval(() => { if (shows("blink") && find(".run").checked) swap(); }, 600);
  }
}
