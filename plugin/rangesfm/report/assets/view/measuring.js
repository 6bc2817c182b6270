// Distance and height difference of two clicked positions, with their 95 % intervals.

const NORMAL_95 = 1.96;
const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);
const metres = (value, sign = "") => (value < 0 ? "−" : sign) + Math.abs(value).toFixed(3);

/** How cameras and anchors err together: the precision of one relative to another. See MapErrors of the package. */
class RelativeErrors {
  constructor(errors) {
    Object.assign(this, errors);
  }

  /** Returns the interval of a value that changes with the shift of the second point against the first along a direction.
   * more: a further standard deviation of the value. */
  interval(first, second, value, direction, more = 0) {
    const change = (rows) => dot(direction, [0, 1, 2].map((axis) => rows[3 * second + axis] - rows[3 * first + axis]));
    const byScale = change(this.by_scale);
    let variance = this.scale_variance_change * byScale ** 2 + more ** 2;
    for (const row of [first, second]) {
      const rest = this.rests.subarray(9 * row, 9 * row + 9);
      variance += dot(direction, [0, 1, 2].map((axis) => dot(direction, rest.subarray(3 * axis, 3 * axis + 3))));
    }
    const width = this.num_modes;
    for (let mode = 0; mode < width; mode++) {
      const at = (row, axis) => this.modes[(3 * row + axis) * width + mode];
      const shift = dot(direction, [0, 1, 2].map((axis) => at(second, axis) - at(first, axis)));
      variance += (shift * this.steps[mode]) ** 2;
    }
    const half = NORMAL_95 * Math.sqrt(Math.max(variance, 0));
    return [value - half, value + half];
  }
}

class Measuring {
  /** scene: has errors of cameras and anchors, or null, and the 95 % interval of the scale relative to its value. */
  constructor(stage, output, { errors, scale_interval, unit }) {
    Object.assign(this, { stage, output, unit, errors: errors && new RelativeErrors(errors), scaleInterval: scale_interval });
    this.line = themed(THREE.Line, [], new THREE.LineBasicMaterial({ depthTest: false }), "chosen");
    this.line.renderOrder = 1;
    this.label = makeLabel("distance", "");
    this.line.add(this.label);
    this.clear();
    stage.add(this.line);
  }

  clear(text = "") {
    this.ends = [];
    this.line.visible = false;
    this.output.textContent = text;
    this.stage.requestFrame();
  }

  /** Adds an end of the distance; a third end begins a new distance. */
  add(end) {
    if (this.ends.length === 2) this.clear();
    this.ends.push(end);
    if (this.ends.length === 1) this.output.textContent = `From ${end.kind} ${end.name}: now click the other end.`;
    else this.#show(...this.ends);
  }

  #show(a, b) {
    const apart = b.position.map((value, axis) => value - a.position[axis]);
    const distance = Math.hypot(...apart);
    moveTo(this.line, [a.position, b.position]);
    this.line.visible = true;
    this.label.position.set(...a.position.map((value, axis) => (value + b.position[axis]) / 2));
    this.label.element.textContent = `${distance.toFixed(3)} ${this.unit}`;
    const ends = `${a.kind} ${a.name} to ${b.kind} ${b.name}`;
    this.output.textContent = `${ends}: ${distance.toFixed(3)} ${this.unit}${this.#precision(a, b, apart, distance)}`;
    this.stage.requestFrame();
  }

  #precision(a, b, apart, distance) {
    const { errors, scaleInterval } = this;
    if (errors === null || distance === 0) {
      const [low, high] = (scaleInterval ?? []).map((share) => metres(share * distance));
      return low ? ` (95 % interval, from the scale alone: ${low} to ${high} m)` : "";
    }
    if (a.row === null || b.row === null) {
      const names = [a, b].map((end) => (end.kind === "point" ? `point:${end.name}` : end.name));
      return ` (its 95 % interval: rangesfm measure RESULT ${names.join(" ")})`;
    }
    const along = apart.map((value) => value / distance);
    const [low, high] = errors.interval(a.row, b.row, distance, along);
    return ` (95 % interval ${metres(Math.max(low, 0))} to ${metres(high)} m)${this.#height(a, b, apart)}`;
  }

  #height(a, b, apart) {
    const { errors } = this;
    if (errors.up === null) return "";
    const height = dot(errors.up, apart);
    const level = Math.hypot(...apart.map((value, axis) => value - height * errors.up[axis]));
    const ends = errors.interval(a.row, b.row, height, errors.up, errors.tilt_stddev * level);
    const [low, high] = ends.map((end) => metres(end, "+"));
    return `; height difference ${metres(height, "+")} m (${low} to ${high} m)`;
  }
}
