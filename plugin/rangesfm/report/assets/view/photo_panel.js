// What is known of one photo: its thumbnail, its place, and its ranges.

const MAX_NUM_ROWS = 200;

class PhotoPanel {
  constructor(panel, scene) {
    this.panel = panel;
    this.scene = scene;
    this.image = panel.querySelector("img");
    this.note = panel.querySelector(".no-thumbnail");
    this.body = panel.querySelector("tbody"); // none where the page has no ranges
  }

  show(path, i, ranges, numbers) {
    const name = path.names[i];
    this.panel.querySelector("h3").textContent = name;
    this.panel.querySelector(".place").textContent = this.#place(path, i);
    const thumbnail = this.scene.thumbnails[name];
    this.image.hidden = thumbnail === undefined;
    this.note.hidden = thumbnail !== undefined;
    if (thumbnail === undefined) this.image.removeAttribute("src");
    else this.image.src = thumbnail;
    this.image.alt = `Photo ${name}`;
    if (this.body !== null) this.#list(ranges, numbers);
  }

  #place(path, i) {
    const at = row3(path.centers, i).map((value) => value.toFixed(3).replace("-", "−"));
    const time = path.times === null ? "" : ` at ${path.times[i].toFixed(2)} s`;
    return `Photo ${i + 1} of ${path.names.length}${time}; x, y, z = ${at.join(", ")} m${this.#moved(path, i)}`;
  }

  /** How far the refinement moved this camera. */
  #moved(path, i) {
    const before = this.scene.paths.filter((other) => other.rotations !== null).at(-2);
    if (before === undefined) return "";
    const j = before.names.indexOf(path.names[i]);
    if (j < 0) return "";
    const shift = Math.hypot(...row3(path.centers, i).map((value, axis) => value - before.centers[3 * j + axis]));
    return `; ${shift.toFixed(3)} m from where "${before.name}" has it`;
  }

  #list(ranges, numbers) {
    this.panel.querySelector("table").hidden = numbers.length === 0;
    const rest = numbers.length - MAX_NUM_ROWS;
    this.panel.querySelector(".num-ranges").textContent =
      `${numbers.length} ranges nearest to this photo${rest > 0 ? `, the first ${MAX_NUM_ROWS} below` : ""}`;
    this.body.replaceChildren(
      ...numbers.slice(0, MAX_NUM_ROWS).map((i) => {
        const row = document.createElement("tr");
        const anchor = ranges.anchor_ids[ranges.anchor[i]];
        row.append(Object.assign(document.createElement("th"), { scope: "row", textContent: anchor }));
        const cells = [
          ranges.measured[i].toFixed(3),
          Number.isNaN(ranges.residual[i]) ? "–" : ranges.residual[i].toFixed(3).replace("-", "−"),
          ranges.statuses[ranges.status[i]],
        ];
        for (const text of cells) row.insertCell().textContent = text;
        return row;
      }),
    );
  }
}
