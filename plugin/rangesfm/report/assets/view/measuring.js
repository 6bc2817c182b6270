// The distance between two clicked positions, with the interval that follows from the scale.

class Measuring {
  /** interval: 95 % interval of the scale relative to its value, [low, high], or null. */
  constructor(stage, output, interval) {
    Object.assign(this, { stage, output, interval });
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
  add(name, position) {
    if (this.ends.length === 2) this.clear();
    this.ends.push({ name, position });
    if (this.ends.length === 1) this.output.textContent = `From ${name}: now click the other end.`;
    else this.#show(...this.ends);
  }

  #show(a, b) {
    const distance = Math.hypot(...a.position.map((value, axis) => value - b.position[axis]));
    moveTo(this.line, [a.position, b.position]);
    this.line.visible = true;
    this.label.position.set(...a.position.map((value, axis) => (value + b.position[axis]) / 2));
    this.label.element.textContent = `${distance.toFixed(3)} m`;
    const [low, high] = (this.interval ?? []).map((share) => (share * distance).toFixed(3));
    const interval = low && ` (95 % interval, from the scale alone: ${low} to ${high} m)`;
    this.output.textContent = `${a.name} to ${b.name}: ${distance.toFixed(3)} m${interval ?? ""}`;
    this.stage.requestFrame();
  }
}
