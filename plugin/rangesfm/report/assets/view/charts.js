// The figures, drawn by Vega-Lite in the colours of the page, as wide as there is room.

const POINTER_PX = 24;
const PAPER_PX = 700; // width of a printed page, and of each of its two columns
const COLUMN_ON_PAPER_PX = 339;

class Chart {
  constructor(node, chart) {
    Object.assign(this, chart, { node, view: null });
    const { top, bottom, left, right } = this.spec.padding;
    this.sides = left + right;
    node.style.height = `${this.#size()[1] + top + bottom}px`;
  }

  /** Draws the chart unless it is drawn already, because thousands of points take time. */
  draw() {
    if (this.view !== null) return;
    const datasets = Object.fromEntries(this.series.map((one, i) => [`series${i}`, rowsOf(one)]));
    const runtime = VEGA.parse(VEGA.compile({ ...this.spec, datasets }).spec, {}, { ast: true });
    this.view = new VEGA.View(runtime, { expr: VEGA.expressionInterpreter, renderer: "svg" }).initialize(this.node);
    this.node.style.height = "";
    this.tip = this.node.appendChild(Object.assign(document.createElement("output"), { className: "tip", hidden: true }));
    this.node.addEventListener("pointermove", (event) => this.#point(event));
    this.node.addEventListener("pointerleave", () => (this.tip.hidden = true));
    this.fit();
    new ResizeObserver(() => this.fit()).observe(this.node);
  }

  /** Yields {name, x, y} of all data, as the CSV file has them. */
  *rows() {
    for (const one of this.series) {
      if (one.is_data) for (const { x, y } of rowsOf(one)) if (isFinite(x + y)) yield { name: one.name, x, y };
    }
    yield* this.marks;
  }

  /** Rounds a value to numDigits digits, and to more where the axis is short and far from 0. */
  number(value, axis, numDigits) {
    const [low, high] = this.spec.encoding[axis].scale.domain;
    const share = Math.max(Math.abs(low), Math.abs(high)) / Math.abs(high - low); // the numbers of rows run downwards
    return Number(value.toPrecision(Math.min(numDigits + Math.max(0, Math.ceil(Math.log10(share))), 17)));
  }

  #size(room = this.node.clientWidth) {
    const width = Math.max(room - this.sides, 80);
    return [width, this.keeps_shape ? Math.round((width * this.spec.height) / this.spec.width) : this.spec.height];
  }

  /** Makes the chart as wide as there is room, by default that in the window. */
  fit(room) {
    const [width, height] = this.#size(room);
    this.view.width(width).height(height).run();
  }

  /** Shows the values of the data nearest to the pointer. */
  #point({ clientX, clientY }) {
    const box = this.node.getBoundingClientRect();
    const { left, top } = this.spec.padding;
    const [toX, toY] = [this.view.scale("x"), this.view.scale("y")];
    let nearest = null;
    let best = POINTER_PX;
    for (const row of this.rows()) {
      const [px, py] = [left + toX(row.x), top + Math.min(Math.max(toY(row.y), 0), this.view.height())];
      const distance = Math.hypot(px - clientX + box.x, py - clientY + box.y);
      if (distance < best) [best, nearest] = [distance, { ...row, px, py }];
    }
    this.tip.hidden = nearest === null;
    if (nearest === null) return;
    const { name, x, y, px, py } = nearest;
    const told = [this.number(x, "x", 5), this.number(y, "y", 5)];
    const values = told.map((value, i) => this.labels[i] && `${this.labels[i]} ${value}`);
    this.tip.textContent = [name, ...values].filter(Boolean).join(" · ");
    this.tip.classList.toggle("left", px > box.width / 2);
    Object.assign(this.tip.style, { left: `${px}px`, top: `${py}px` });
  }
}

/** Returns rows {x, y} from a flat array of x and y in turn, relative to an origin. */
function rowsOf({ points, origin }) {
  return Array.from({ length: points.length / 2 }, (_, i) => ({ x: origin[0] + points[2 * i], y: origin[1] + points[2 * i + 1] }));
}

/**
 * Returns the charts of each figure by its name. They are drawn when they come near the window, and the others, which may
 * be folded, while the browser has nothing to do: on paper a picture would be missing that is drawn only then.
 */
function makeFigures(figures) {
  const chartOf = new Map();
  const drawSeen = (entries) => entries.forEach((entry) => entry.isIntersecting && chartOf.get(entry.target).draw());
  const observer = new IntersectionObserver(drawSeen, { rootMargin: "100%" });
  addEventListener("beforeprint", () => {
    for (const chart of chartOf.values()) {
      chart.draw();
      chart.fit(chart.node.closest(".wide > .single") === null ? COLUMN_ON_PAPER_PX : PAPER_PX);
    }
  });
  addEventListener("afterprint", () => chartOf.forEach((chart) => chart.fit()));
  for (const [name, charts] of Object.entries(figures)) {
    const nodes = document.querySelectorAll(`#${name} .chart`);
    figures[name] = charts.map((chart, i) => new Chart(nodes[i], chart));
    for (const chart of figures[name]) {
      chartOf.set(chart.node, chart);
      observer.observe(chart.node);
      requestIdleCallback(() => chart.draw());
    }
  }
  return figures;
}
