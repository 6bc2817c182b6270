// The stage: renderers, camera and controls. It draws only when something has changed.

const SLOW_FRAME_MS = 45;
const MAX_PIXEL_RATIO = 2;
const FIELD_OF_VIEW_DEG = 45;
const SLOPE = Math.tan((FIELD_OF_VIEW_DEG * Math.PI) / 360);
const MARGIN = 1.08;

/** Dispatches the events "frame" (drawn), "slow" (frames take long while moving) and "rest" (moving has ended). */
class Stage extends EventTarget {
  /** Returns null where the browser has no WebGL. */
  static on(canvas, labels, up, box) {
    const context = canvas.getContext("webgl2", { antialias: true, alpha: false });
    return context === null ? null : new Stage(canvas, labels, context, up, box);
  }

  constructor(canvas, labels, context, up, box) {
    super();
    THREE.ColorManagement.enabled = false; // the screen shows the colours of the photos unchanged
    Object.assign(this, { canvas, box, scene: new THREE.Scene(), lastFrame: null, isRequested: false });
    this.center = new THREE.Vector3(...box.low).add(new THREE.Vector3(...box.high)).divideScalar(2);
    this.renderer = new THREE.WebGLRenderer({ canvas, context, antialias: true });
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    this.labels = new THREE.CSS2DRenderer({ element: labels });
    this.camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW_DEG, 1, box.radius / 500, box.radius * 50);
    this.camera.up.set(...up);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.requestFrame());
    this.controls.addEventListener("start", () => (this.lastFrame = performance.now()));
    this.controls.addEventListener("end", () => this.#rest());
    new ResizeObserver(() => this.requestFrame()).observe(canvas);
    this.scene.background = new THREE.Color();
    onTheme(() => {
      this.scene.background.set(themeColor("stage"));
      this.requestFrame();
    });
  }

  add(...objects) {
    this.scene.add(...objects);
    this.requestFrame();
  }

  requestFrame() {
    if (this.isRequested) return;
    this.isRequested = true;
    requestAnimationFrame(() => {
      this.isRequested = false;
      this.draw();
    });
  }

  draw() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width === 0 || height === 0) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, MAX_PIXEL_RATIO));
    this.renderer.setSize(width, height, false);
    this.labels.setSize(width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.renderer.render(this.scene, this.camera);
    this.labels.render(this.scene, this.camera);
    this.dispatchEvent(new Event("frame"));
    if (this.lastFrame === null) return;
    const duration = performance.now() - this.lastFrame;
    if (duration > SLOW_FRAME_MS && duration < 1000) this.dispatchEvent(new Event("slow"));
    this.lastFrame += duration;
  }

  /** Looks at the middle of the scene from a direction, at the smallest distance that shows all corners of its box. */
  lookFrom(direction) {
    const towards = new THREE.Vector3(...direction).normalize();
    const right = this.camera.up.clone().cross(towards).normalize();
    const above = towards.clone().cross(right);
    const aspect = this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight);
    const ends = [this.box.low, this.box.high];
    const distances = [0, 1, 2, 3, 4, 5, 6, 7].map((i) => {
      const from = new THREE.Vector3(...[0, 1, 2].map((axis) => ends[(i >> axis) & 1][axis])).sub(this.center);
      const sideways = Math.max(Math.abs(from.dot(right)) / aspect, Math.abs(from.dot(above)));
      return from.dot(towards) + (MARGIN * sideways) / SLOPE;
    });
    this.controls.target.copy(this.center);
    this.camera.position.copy(this.center).addScaledVector(towards, Math.max(...distances, 0.1 * this.box.radius));
    this.controls.update();
    this.requestFrame();
  }

  /** Returns the pixel of a position in metres (from left and top) and its depth, above 1 behind the camera. */
  pixelOf(position) {
    const { x, y, z } = new THREE.Vector3(...position).project(this.camera);
    return [((x + 1) / 2) * this.canvas.clientWidth, ((1 - y) / 2) * this.canvas.clientHeight, z];
  }

  /** Returns how many metres one pixel is, at the distance of the point looked at. */
  metresPerPixel() {
    return (2 * SLOPE * this.camera.position.distanceTo(this.controls.target)) / this.canvas.clientHeight;
  }

  #rest() {
    this.lastFrame = null;
    this.dispatchEvent(new Event("rest"));
    this.requestFrame();
  }
}

/** Returns lines or a mesh in a colour of the theme. They are never culled, because their positions may change. */
function themed(Kind, positions, material, color) {
  onTheme(() => material.color.set(themeColor(color)));
  const made = new Kind(lineGeometry(positions), material);
  made.frustumCulled = false;
  return made;
}

function lineGeometry(positions) {
  return new THREE.BufferGeometry().setAttribute("position", new THREE.Float32BufferAttribute(positions.flat(), 3));
}

/** Gives lines or a mesh other positions. */
function moveTo(object, positions) {
  object.geometry.dispose();
  object.geometry = lineGeometry(positions);
}

/** Returns a text over the view, right of a place in it. */
function makeLabel(kind, text) {
  const element = Object.assign(document.createElement("span"), { className: `label ${kind}`, textContent: text });
  return Object.assign(new THREE.CSS2DObject(element), { center: new THREE.Vector2(0, 0.5) });
}
