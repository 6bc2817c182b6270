// The figures: Vega-Lite draws them in the page's colours, as wide as there is room.

const POINTER_PX = 24;

class Chart {
  constructor(node, chart) {
    Object.assign(this, chart, { node, view: null });
    const { padding, width, height } = this.spec;
    this.shape = this.keeps_shape ? height / width : null;
    this.sides = padding.left + padding.right;
    node.style.height = `${this.#height() + padding.top + padding.bottom}px`;
  }

  /** Draws it, once: thousands of points take their time. */
  draw() {
    if (this.view !== null) return;
    const datasets = Object.fromEntries(this.series.map((series, i) => [`series${i}`, rowsOf(series)]));
    const runtime = VEGA.parse(VEGA.compile({ ...this.spec, datasets }).spec, {}, { ast: true });
    this.view = new VEGA.View(runtime, { expr: VEGA.expressionInterpreter, renderer: "svg" }).initialize(this.node);
    this.node.style.height = "";
    this.#fit();
    new ResizeObserver(() => this.#fit()).observe(this.node);
    this.tip = this.node.appendChild(document.createElement("output"));
    this.tip.className = "tip";
    this.tip.hidden = true;
    this.node.addEventListener("pointermove", (event) => this.#point(event));
    this.node.addEventListener("pointerleave", () => (this.tip.hidden = true));
  }

  /** [series, x, y] of all data, as the CSV file has them. */
  *rows() {
    for (const { name, points, is_data } of this.series) {
      if (!is_data) continue;
      for (let i = 0; i < points.length; i += 2) if (isFinite(points[i] + points[i + 1])) yield [name, points[i], points[i + 1]];
    }
    for (const { title, x, y } of this.marks) yield [title, x, y];
  }

  #width() {
    return Math.max(this.node.clientWidth - this.sides, 80);
  }

  #height() {
    return this.shape === null ? this.spec.height : Math.round(this.#width() * this.shape);
  }

  #fit() {
    this.view.width(this.#width()).height(this.#height()).run();
  }

  /** What is nearest to the pointer tells its values. */
  #point(event) {
    const box = this.node.getBoundingClientRect();
    const { left, top } = this.spec.padding;
    const [toX, toY] = [this.view.scale("x"), this.view.scale("y")];
    const [low, high] = [this.view.height(), 0];
    let nearest = null;
    let best = POINTER_PX;
    for (const [name, x, y] of this.rows()) {
      const px = left + toX(x);
      const py = top + Math.min(Math.max(toY(y), high), low);
      const distance = Math.hypot(px - event.clientX + box.x, py - event.clientY + box.y);
      if (distance < best) [best, nearest] = [distance, { name, x, y, px, py }];
    }
    this.tip.hidden = nearest === null;
    if (nearest === null) return;
    const values = [nearest.x, nearest.y].map((value) => Number(value.toPrecision(5)));
    const parts = this.labels.map((label, i) => (label ? `${label} ${values[i]}` : "")).filter(Boolean);
    this.tip.textContent = [nearest.name, ...parts].join(" · ");
    this.tip.classList.toggle("left", nearest.px > box.width / 2);
    Object.assign(this.tip.style, { left: `${nearest.px}px`, top: `${nearest.py}px` });
  }
}

/** Rows of x and y; an empty one breaks a line, and dots are a line that is broken after each. */
function rowsOf({ points, kind }) {
  const rows = [];
  for (let i = 0; i < points.length; i += 2) {
    const [x, y] = [points[i], points[i + 1]];
    rows.push(isFinite(x + y) ? { x, y } : {});
    if (kind === "dots") rows.push({});
  }
  return rows;
}

/** All figures of the page, by name: a list of charts each, which are drawn when they come near or go to paper. */
function makeFigures(figures) {
  const made = {};
  const chartOf = new Map();
  const observer = new IntersectionObserver(
    (entries) => {
      for (const { isIntersecting, target } of entries) if (isIntersecting) chartOf.get(target).draw();
    },
    { rootMargin: "100%" },
  );
  for (const [name, charts] of Object.entries(figures)) {
    const nodes = document.querySelectorAll(`#${name} .chart`);
    made[name] = charts.map((chart, i) => new Chart(nodes[i], chart));
    for (const chart of made[name]) {
      chartOf.set(chart.node, chart);
      observer.observe(chart.node);
    }
  }
  addEventListener("beforeprint", () => chartOf.forEach((chart) => chart.draw()));
  return made;
}

function csvOfFigure(charts) {
  const [x, y] = charts[0].labels.map((label) => (label || "row").replace("−", "minus ").split(/\s+/).join("_"));
  const number = (value) => Number(value.toPrecision(7));
  const rows = charts.flatMap((chart) => [...chart.rows()].map(([name, a, b]) => [chart.title, name, number(a), number(b)]));
  return csvText(["panel", "series", x, y], rows.length, (i) => rows[i]);
}
