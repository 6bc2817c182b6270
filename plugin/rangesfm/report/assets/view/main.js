// The view, put together from the page's data and its controls.

const OBLIQUE_VIEW = 0.75;

class View {
  constructor(root, scene) {
    this.root = root;
    this.scene = scene;
    this.canvas = root.querySelector("canvas");
    this.stage = Stage.on(this.canvas, scene.up, scene.box);
    root.classList.toggle("no-webgl", this.stage === null);
    if (this.stage === null) return;
    this.labels = new Labels(this.stage, root.querySelector(".labels"));
    this.measuring = new Measuring(this.stage, this.labels, root.querySelector(".measured"), scene.scale_interval);
    this.path = scene.paths.at(-1) ?? null;
    this.#fillStage();
    this.#attachLayers();
    this.#attachViews();
    this.#attachPhoto();
    onClick(this.canvas, (pixel) => this.click(pixel));
    attachScaleBar(this.stage, root.querySelector(".scale-bar"));
    this.#attachPrinting();
    this.look("oblique");
  }

  /** Choose a camera of the final path: its frustum, its photo and its ranges. */
  choose(i) {
    if (this.path === null || this.path.rotations === null) return;
    this.chosen = i;
    this.chosenCamera.show(this.path, i);
    this.slider.value = String(i);
    this.slider.setAttribute("aria-valuetext", this.path.names[i]);
    this.photo.show(this.path, i, this.scene.ranges, this.rangeLines === null ? [] : this.rangeLines.ofCamera(i));
    this.#showRanges();
    this.stage.requestFrame();
  }

  click(pixel) {
    const isMeasuring = this.root.querySelector("[name=measure]").checked;
    const camera = this.path === null ? null : nearestTo(this.stage, pixel, this.path.centers);
    if (!isMeasuring) {
      if (camera !== null) this.choose(camera.index);
      return;
    }
    const found = this.#candidates(pixel, camera).filter((candidate) => candidate.at !== null);
    found.sort((a, b) => a.at.pixels - b.at.pixels);
    if (found.length > 0) this.measuring.add(found[0].name, found[0].at.position);
  }

  look(name) {
    const { up } = this.scene;
    const vertical = up.findIndex((value) => value !== 0);
    const along = [1, 0, 0];
    const across = vertical === 2 ? [0, -1, 0] : [0, 0, -1];
    const directions = {
      oblique: up.map((value, axis) => OBLIQUE_VIEW * value + 0.55 * along[axis] + 0.8 * across[axis]),
      plan: up.map((value, axis) => value + 1e-4 * across[axis]),
      elevation: across,
    };
    this.stage.lookFrom(directions[name]);
  }

  /** Position of the i-th point of the map, metres. */
  pointAt(i) {
    return pointPosition(this.scene.points, i);
  }

  #candidates(pixel, camera) {
    const { points, anchors } = this.scene;
    const anchor = nearestTo(this.stage, pixel, anchors.flatMap(({ position }) => position));
    const point =
      points !== null && this.layers.points.visible
        ? nearestTo(this.stage, pixel, points.steps, points.origin, stepOf(points))
        : null;
    return [
      { at: anchor, name: anchor && `anchor ${anchors[anchor.index].id}` },
      { at: camera, name: camera && `camera ${this.path.names[camera.index]}` },
      { at: point, name: point && `point ${point.index + 1}` },
    ];
  }

  #fillStage() {
    const { scene, stage } = this;
    const { grid, cell } = makeGrid(scene.box, scene.up);
    this.root.querySelector(".grid-cell").textContent = `grid ${lengthText(cell)}`;
    this.layers = { grid, anchors: makeAnchors(scene.anchors, 0.016 * scene.box.radius) };
    if (scene.points !== null) this.layers.points = makePoints(stage, scene.points);
    for (const [order, path] of scene.paths.entries()) {
      this.layers[path.id] = makePath(path, scene.frustum_size, scene.frustum_shape, order);
    }
    this.chosenCamera = new ChosenCamera(scene.frustum_size, scene.frustum_shape);
    this.rangeLines = null;
    if (scene.ranges !== null && this.path !== null && this.path.rotations !== null) {
      this.rangeLines = new RangeLines(scene.ranges, this.path, scene.anchors);
      stage.add(this.rangeLines.lines);
    }
    stage.add(...Object.values(this.layers), this.chosenCamera.group);
    for (const anchor of scene.anchors) {
      this.labels.add(anchor.id, anchor.position, "anchor");
      if (anchor.mirror !== null) this.labels.add(`${anchor.id} (mirror image)`, anchor.mirror, "anchor");
    }
  }

  #attachLayers() {
    for (const box of this.root.querySelectorAll("[name=layer]")) {
      const apply = () => {
        this.layers[box.value].visible = box.checked;
        if (box.value === "anchors") this.labels.toggle("anchor", box.checked);
        this.stage.requestFrame();
      };
      box.addEventListener("change", apply);
      apply();
    }
    this.root.querySelector("[name=measure]").addEventListener("change", (event) => {
      this.canvas.classList.toggle("measuring", event.target.checked);
      this.measuring.clear();
      if (event.target.checked) this.measuring.output.textContent = "Click two points, cameras or anchors.";
    });
  }

  #attachViews() {
    for (const button of this.root.querySelectorAll("[data-look]")) {
      button.addEventListener("click", () => this.look(button.dataset.look));
    }
    for (const box of this.root.querySelectorAll("[name=status], [name=all-photos]")) {
      box.addEventListener("change", () => this.#showRanges());
    }
  }

  #showRanges() {
    if (this.rangeLines === null) return;
    const boxes = [...this.root.querySelectorAll("[name=status]:checked")];
    const isOfAll = this.root.querySelector("[name=all-photos]").checked;
    this.rangeLines.show(new Set(boxes.map((box) => Number(box.value))), isOfAll ? null : this.chosen);
    this.root.querySelector(".num-lines").textContent = `${this.rangeLines.numShown} ranges drawn`;
    this.stage.requestFrame();
  }

  /** On paper, a picture stands for the view. */
  #attachPrinting() {
    addEventListener("beforeprint", () => {
      this.stage.draw(); // what is drawn can be read only at once
      this.root.querySelector(".printed").src = this.canvas.toDataURL("image/png");
    });
  }

  #attachPhoto() {
    this.slider = this.root.querySelector("[name=photo]");
    if (this.slider === null) return;
    this.photo = new PhotoPanel(this.root.querySelector(".photo"), this.scene);
    this.slider.addEventListener("input", () => this.choose(Number(this.slider.value)));
    this.choose(Number(this.slider.value));
  }
}

// The page is there to read before its figures and the view are: setting up WebGL may take longer than all the rest.
const start = () => {
  const scene = readBlock("scene");
  if (scene?.ranges) scene.ranges.residual = scene.ranges[scene.ranges.final];
  window.rangesfmFigures = makeFigures(readBlock("figures"));
  attachDownloads(scene, rangesfmFigures);
  if (scene !== null) window.rangesfmView = new View(document.getElementById("view"), scene);
};
addEventListener("load", () => requestAnimationFrame(() => setTimeout(start)));
