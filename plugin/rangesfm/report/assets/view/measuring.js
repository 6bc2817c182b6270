// The distance between two clicked positions, with what the scale leaves uncertain of it.

class Measuring {
  /** interval: the scale's interval relative to its value, [low, high], or null. */
  constructor(stage, labels, output, interval) {
    this.stage = stage;
    this.output = output;
    this.interval = interval;
    this.label = labels.add("", null, "distance");
    this.line = themed(THREE.Line, [], new THREE.LineBasicMaterial({ depthTest: false }), "chosen");
    this.line.renderOrder = 1;
    this.clear();
    stage.add(this.line);
  }

  clear() {
    this.ends = [];
    this.line.visible = false;
    this.label.position = null;
    this.output.textContent = "";
    this.stage.requestFrame();
  }

  /** One end; the third begins anew. */
  add(name, position) {
    if (this.ends.length === 2) this.clear();
    this.ends.push({ name, position });
    if (this.ends.length === 1) this.output.textContent = `From ${name}: now click the other end.`;
    else this.#show();
  }

  #show() {
    const [a, b] = this.ends;
    const distance = Math.hypot(...a.position.map((value, axis) => value - b.position[axis]));
    this.line.geometry.dispose();
    this.line.geometry = lineGeometry([a.position, b.position]);
    this.line.visible = true;
    this.label.position = a.position.map((value, axis) => (value + b.position[axis]) / 2);
    this.label.node.textContent = `${distance.toFixed(3)} m`;
    this.output.textContent = `${a.name} to ${b.name}: ${distance.toFixed(3)} m${this.#interval(distance)}`;
    this.stage.requestFrame();
  }

  #interval(distance) {
    if (this.interval === null) return "";
    const [low, high] = this.interval.map((share) => (share * distance).toFixed(3));
    return ` (95 % by the scale alone: ${low} to ${high} m)`;
  }
}
