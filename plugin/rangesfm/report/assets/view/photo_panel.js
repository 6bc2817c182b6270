// The panel of the chosen photo: thumbnail, position and ranges.

const MAX_NUM_ROWS = 200;

class PhotoPanel {
  constructor(panel, scene) {
    Object.assign(this, { panel, scene, image: panel.querySelector("img") });
  }

  /** numbers: those of the ranges nearest to the photo. */
  show(path, i, numbers) {
    const name = path.names[i];
    const { thumbnails } = this.scene;
    const thumbnail = Object.hasOwn(thumbnails, name) ? thumbnails[name] : undefined; // a photo may be called "constructor"
    this.#say("h3", name);
    this.#say(".place", this.#place(path, i));
    this.image.hidden = thumbnail === undefined;
    this.panel.querySelector(".no-thumbnail").hidden = thumbnail !== undefined;
    if (thumbnail !== undefined) this.image.src = thumbnail;
    this.image.alt = `Photo ${name}`;
    if (this.scene.ranges) this.#list(this.scene.ranges, numbers);
  }

  #say(selector, text) {
    this.panel.querySelector(selector).textContent = text;
  }

  #place(path, i) {
    const at = inFrame(this.scene, row3(path.centers, i)).map((value) => value.toFixed(3).replace("-", "−"));
    const time = path.times === null ? "" : ` at ${path.times[i].toFixed(2)} s`;
    return `Photo ${i + 1} of ${path.names.length}${time}; x, y, z = ${at.join(", ")} ${this.scene.unit}${this.#moved(path, i)}`;
  }

  /** Returns a text that says how far the refinement moved this camera. */
  #moved(path, i) {
    const before = this.scene.paths.filter((other) => other.rotations !== null).at(-2);
    const j = before?.names.indexOf(path.names[i]) ?? -1;
    if (j < 0) return "";
    const shift = Math.hypot(...row3(path.centers, i).map((value, axis) => value - before.centers[3 * j + axis]));
    return `; ${shift.toFixed(3)} ${this.scene.unit} from where "${before.name}" has it`;
  }

  #list(ranges, numbers) {
    const isLong = numbers.length > MAX_NUM_ROWS;
    this.#say(".num-ranges", `${numbers.length} ranges nearest to this photo${isLong ? `, the first ${MAX_NUM_ROWS} below` : ""}`);
    this.panel.querySelector("table").hidden = numbers.length === 0;
    const body = this.panel.querySelector("tbody");
    body.replaceChildren();
    for (const i of numbers.slice(0, MAX_NUM_ROWS)) {
      const row = body.insertRow();
      const anchor = ranges.anchor_ids[ranges.anchor[i]];
      row.append(Object.assign(document.createElement("th"), { scope: "row", textContent: anchor }));
      const residual = isNaN(ranges.residual[i]) ? "–" : ranges.residual[i].toFixed(3).replace("-", "−");
      const cells = [ranges.measured[i].toFixed(3), residual, ranges.statuses[ranges.status[i]]];
      for (const text of cells) row.insertCell().textContent = text;
    }
  }
}
