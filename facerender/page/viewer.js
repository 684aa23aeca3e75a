// Viewer of a pair: A over B with a movable border, and a zoom of all images to one place.
const PIXEL = 8;  // least size of an enlarged pixel, in CSS pixels
const swaps = [], wholes = [];  // functions of all viewers, for the keys
for (const viewer of document.querySelectorAll(".viewer")) {
  const figures = [...viewer.querySelectorAll("figure")];
  const places = [...viewer.querySelectorAll(".place")];
  const cut = viewer.querySelector(".cut");
  const number = (figure, name) => +figure.style.getPropertyValue(name);
  let centre = null;  // pixel [x, y] in the centre of the enlarged view; null without a zoom

  function look(at) {
    centre = at;
    viewer.classList.toggle("enlarged", at !== null);
    for (const place of places) place.ariaPressed = place.value === String(at);
    for (const figure of figures) {
      const fit = figure.querySelector(".view").clientWidth / number(figure, "--w");
      const zoom = at && fit ? Math.max(PIXEL, 2 * fit) / fit : 1;
      ["--w", "--h"].forEach((side, axis) => {
        const to = at ? (at[axis] + 0.5) / number(figure, side) : 0.5;
        const inside = Math.min(Math.max(to, 0.5 / zoom), 1 - 0.5 / zoom);
        figure.style.setProperty(axis ? "--y" : "--x", inside);
      });
      figure.style.setProperty("--z", zoom);
    }
  }
  addEventListener("resize", () => centre && look(centre));
  wholes.push(() => look(null));

  for (const place of places) {
    place.addEventListener("click", () => {
      look(place.ariaPressed === "true" ? null : place.value.split(",").map(Number));
    });
  }
  for (const figure of figures) {
    figure.querySelector(".view").addEventListener("click", event => {
      if (centre) return look(null);
      const box = figure.querySelector(".layer").getBoundingClientRect();
      const x = (event.clientX - box.left) / box.width, y = (event.clientY - box.top) / box.height;
      look([Math.floor(x * number(figure, "--w")), Math.floor(y * number(figure, "--h"))]);
    });
  }
  const steps = {ArrowLeft: [-4, 0], ArrowRight: [4, 0], ArrowUp: [0, -4], ArrowDown: [0, 4]};
  viewer.addEventListener("keydown", event => {
    const step = steps[event.key];
    if (!step || !centre || event.target === cut) return;
    event.preventDefault();
    const limits = ["--w", "--h"].map(side => number(figures[0], side) - 1);
    look(centre.map((at, axis) => Math.min(Math.max(at + step[axis], 0), limits[axis])));
  });

  if (cut) {
    const move = () => viewer.style.setProperty("--cut", cut.value);
    const swap = () => { cut.value = cut.value === "100" ? 0 : 100; move(); };
    cut.addEventListener("input", move);
    viewer.querySelector(".swap").addEventListener("click", swap);
    swaps.push(swap);
  }
}
addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === "Escape") wholes.forEach(whole => whole());
  if (event.key === "x" || event.key === "X") swaps.forEach(swap => swap());
});
