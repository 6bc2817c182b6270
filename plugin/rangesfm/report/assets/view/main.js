// The 3-D view, made from the data of the page and connected to its controls.

class View {
  constructor(root, scene) {
    Object.assign(this, { root, scene, canvas: root.querySelector("canvas"), path: scene.paths.at(-1) });
    this.stage = Stage.on(this.canvas, root.querySelector(".labels"), scene.up, scene.box);
    root.classList.toggle("no-webgl", this.stage === null);
    if (this.stage === null) return;
    this.measuring = new Measuring(this.stage, root.querySelector(".measured"), scene);
    this.#fillStage();
    this.#attachControls();
    onClick(this.canvas, (pixel) => this.click(pixel));
    attachScaleBar(this.stage, root.querySelector(".scale-bar"), scene.unit);
    this.look("oblique");
  }

  /** Shows frustum, photo and ranges of a camera of the final path. */
  choose(i) {
    if (this.slider === null) return;
    this.chosen = i;
    this.chosenCamera.show(this.path, i);
    this.slider.value = String(i);
    this.slider.setAttribute("aria-valuetext", this.path.names[i]);
    this.photo.show(this.path, i, this.rangeLines?.ofCamera(i));
    this.showRanges();
    this.stage.requestFrame();
  }

  click(pixel) {
    const { points, anchors } = this.scene;
    const nearest = (num, positionOf, endOf) => {
      const found = nearestTo(this.stage, pixel, num, positionOf);
      return found === null ? [] : [{ ...found, ...endOf(found.index) }];
    };
    const { names, centers } = this.path;
    const cameras = nearest(names.length, (i) => row3(centers, i), (i) => ({ kind: "camera", name: names[i], row: i }));
    if (!this.root.querySelector("[name=measure]").checked) {
      for (const { index } of cameras) this.choose(index);
      return;
    }
    const numPoints = this.layers.points?.visible ? points.num : 0;
    const [found] = [
      ...nearest(anchors.length, (i) => anchors[i].position, (i) => ({
        kind: "anchor",
        name: anchors[i].id,
        row: names.length + i,
      })),
      ...cameras,
      ...nearest(numPoints, (i) => this.pointAt(i), (i) => ({ kind: "point", name: points.ids?.[i] ?? i + 1, row: null })),
    ].sort((a, b) => a.pixels - b.pixels);
    if (found !== undefined) this.measuring.add(found);
  }

  look(name) {
    const { up } = this.scene;
    const across = up[2] === 0 ? [0, 0, -1] : [0, -1, 0];
    const directions = {
      oblique: [0.55, 0, 0].map((along, axis) => along + 0.75 * up[axis] + 0.8 * across[axis]),
      plan: up.map((value, axis) => value + 1e-4 * across[axis]),
      elevation: across,
    };
    this.stage.lookFrom(directions[name]);
  }

  /** Returns the position of the i-th point of the map, metres from the origin of the scene. */
  pointAt(i) {
    return pointPosition(this.scene.points, i);
  }

  showRanges() {
    if (this.rangeLines === null) return;
    const boxes = [...this.root.querySelectorAll("[name=status]:checked")];
    const isOfAll = this.root.querySelector("[name=all-photos]").checked;
    this.rangeLines.show(new Set(boxes.map((box) => Number(box.value))), isOfAll ? null : this.chosen);
    this.root.querySelector(".num-lines").textContent = `${this.rangeLines.numShown} ranges drawn`;
    this.stage.requestFrame();
  }

  #fillStage() {
    const { scene, stage } = this;
    const { grid, cell } = makeGrid(scene.box, scene.up);
    this.root.querySelector(".grid-cell").textContent = `grid ${lengthText(cell, scene.unit)}`;
    this.layers = { grid, anchors: makeAnchors(scene.anchors, 0.016 * scene.box.radius) };
    if (scene.points !== null) this.layers.points = makePoints(stage, scene.points);
    for (const [order, path] of scene.paths.entries()) {
      this.layers[path.id] = makePath(path, scene.frustum_size, scene.frustum_shape, order);
    }
    this.chosenCamera = new ChosenCamera(scene.frustum_size, scene.frustum_shape);
    const hasLines = scene.ranges !== null && this.path.rotations !== null;
    this.rangeLines = hasLines ? new RangeLines(scene.ranges, this.path, scene.anchors) : null;
    stage.add(...Object.values(this.layers), this.chosenCamera.group, ...(hasLines ? [this.rangeLines.lines] : []));
  }

  #attachControls() {
    const on = (event, selector, act) => {
      for (const node of this.root.querySelectorAll(selector)) node.addEventListener(event, () => act(node));
    };
    const show = (box) => {
      this.layers[box.value].visible = box.checked;
      this.stage.requestFrame();
    };
    this.root.querySelectorAll("[name=layer]").forEach(show);
    on("change", "[name=layer]", show);
    on("change", "[name=measure]", ({ checked }) => {
      this.canvas.classList.toggle("measuring", checked);
      this.measuring.clear(checked ? "Click two points, cameras or anchors." : "");
    });
    on("click", "[data-look]", (button) => this.look(button.dataset.look));
    on("change", "[name=status], [name=all-photos]", () => this.showRanges());
    on("input", "[name=photo]", (slider) => this.choose(Number(slider.value)));
    // A printed page has a picture in place of the view.
    addEventListener("beforeprint", () => {
      this.stage.draw(); // the canvas can be read only directly after it is drawn
      const texts = this.root.querySelectorAll(".stage .label, .scale-bar, .grid-cell");
      this.root.querySelector(".printed").src = pictureWith(texts, this.canvas);
    });
    this.slider = this.root.querySelector("[name=photo]");
    if (this.slider === null) return;
    this.photo = new PhotoPanel(this.root.querySelector(".photo"), this.scene);
    this.choose(Number(this.slider.value));
  }
}

const PRINTED_TEXT = 1.6; // the view is about that much smaller on paper than in a window

/** Returns a canvas as a picture (data URI), with the texts that the page shows over it. */
function pictureWith(texts, canvas) {
  const { width, height } = canvas;
  const picture = Object.assign(document.createElement("canvas"), { width, height });
  const draw = picture.getContext("2d");
  draw.drawImage(canvas, 0, 0);
  const on = canvas.getBoundingClientRect();
  draw.scale(width / on.width, height / on.height);
  draw.translate(-on.x, -on.y);
  draw.textBaseline = "middle";
  for (const text of texts) {
    const box = text.getBoundingClientRect();
    const { fontWeight, fontSize, fontFamily, color, backgroundColor, borderBottomWidth } = getComputedStyle(text);
    const [size, line] = [PRINTED_TEXT * parseFloat(fontSize), parseFloat(borderBottomWidth)];
    draw.font = `${fontWeight} ${size}px ${fontFamily}`;
    const wide = draw.measureText(text.textContent).width;
    // A label begins at its place; scale bar and grid keep their middle, as far as the picture has room, and stand lower.
    const isLabel = text.classList.contains("label");
    const middle = Math.max(on.left + 8, Math.min(box.left + (box.width - wide) / 2, on.right - wide - 8));
    const [left, y] = isLabel ? [box.left + 5, (box.top + box.bottom) / 2] : [middle, box.bottom - line - 0.65 * size];
    draw.fillStyle = backgroundColor;
    draw.fillRect(left - 4, y - 0.65 * size, wide + 8, 1.3 * size);
    draw.fillStyle = color;
    draw.fillRect(box.left, box.bottom - line, box.width, line);
    draw.fillText(text.textContent, left, y);
  }
  return picture.toDataURL("image/png");
}

/** Unfolds all sections but the appendix while the page is printed. */
function unfoldOnPaper() {
  const unfolded = [];
  addEventListener("beforeprint", () => {
    for (const section of document.querySelectorAll("details:not([open], .appendix)")) {
      section.open = true;
      unfolded.push(section);
    }
  });
  addEventListener("afterprint", () => {
    for (const section of unfolded.splice(0)) section.open = false;
  });
}

// The text of the page is shown before figures and view are made, because starting WebGL may take longer than the rest.
const start = () => {
  const scene = readBlock("scene");
  if (scene?.ranges) scene.ranges.residual = scene.ranges[scene.ranges.final];
  unfoldOnPaper(); // before the figures are fitted to the paper
  window.rangesfmFigures = makeFigures(readBlock("figures"));
  attachDownloads(scene, rangesfmFigures);
  if (scene !== null) window.rangesfmView = new View(document.getElementById("view"), scene);
};
addEventListener("load", () => requestAnimationFrame(() => setTimeout(start)));
