// The stage: renderer, camera and controls. It draws when something changed, and only then.

const SLOW_FRAME_MS = 45;
const MAX_PIXEL_RATIO = 2;
const FIELD_OF_VIEW_DEG = 45;
const MARGIN = 1.08;

class Stage {
  /** Returns null where the browser has no WebGL. */
  static on(canvas, up, box) {
    const context = canvas.getContext("webgl2", { antialias: true, alpha: false });
    return context === null ? null : new Stage(canvas, context, up, box);
  }

  constructor(canvas, context, up, box) {
    THREE.ColorManagement.enabled = false; // colours go to the screen as the photos have them
    this.canvas = canvas;
    this.box = box;
    this.center = box.low.map((value, axis) => (value + box.high[axis]) / 2);
    this.up = new THREE.Vector3(...up);
    this.renderer = new THREE.WebGLRenderer({ canvas, context, antialias: true });
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color();
    this.camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW_DEG, 1, box.radius / 500, box.radius * 50);
    this.camera.up.copy(this.up);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.listeners = { frame: [], slow: [], rest: [] };
    this.isMoving = false;
    this.isRequested = false;
    this.controls.addEventListener("change", () => this.requestFrame());
    this.controls.addEventListener("start", () => this.#move());
    this.controls.addEventListener("end", () => this.#rest());
    new ResizeObserver(() => this.requestFrame()).observe(canvas);
    onTheme(() => {
      this.scene.background.set(themeColor("stage"));
      this.requestFrame();
    });
  }

  /** name: "frame" (drawn), "slow" (frames take long while moving), "rest" (moving has ended). */
  on(name, callback) {
    this.listeners[name].push(callback);
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
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.renderer.render(this.scene, this.camera);
    for (const callback of this.listeners.frame) callback();
    if (this.isMoving) this.#watchTime();
  }

  /** Look at the middle of the scene from a direction, as near as shows all corners of its box. */
  lookFrom(direction) {
    const target = new THREE.Vector3(...this.center);
    const towards = new THREE.Vector3(...direction).normalize();
    const right = this.up.clone().cross(towards).normalize();
    const above = towards.clone().cross(right);
    const slope = Math.tan((FIELD_OF_VIEW_DEG * Math.PI) / 360) / MARGIN;
    const aspect = this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight);
    const distances = this.#corners().map((corner) => {
      const from = corner.sub(target);
      const sideways = Math.max(Math.abs(from.dot(right)) / aspect, Math.abs(from.dot(above)));
      return from.dot(towards) + sideways / slope;
    });
    this.controls.target.copy(target);
    this.camera.position.copy(target).addScaledVector(towards, Math.max(...distances, 0.1 * this.box.radius));
    this.controls.update();
    this.requestFrame();
  }

  #corners() {
    const { low, high } = this.box;
    return [0, 1, 2, 3, 4, 5, 6, 7].map(
      (i) => new THREE.Vector3(...[0, 1, 2].map((axis) => ((i >> axis) & 1 ? high : low)[axis])),
    );
  }

  /** Pixels [x, y] on the canvas of a position in metres; null behind the camera or outside the view. */
  pixelOf(position) {
    const seen = new THREE.Vector3(...position).project(this.camera);
    if (seen.z > 1 || Math.abs(seen.x) > 1 || Math.abs(seen.y) > 1) return null;
    return [((seen.x + 1) / 2) * this.canvas.clientWidth, ((1 - seen.y) / 2) * this.canvas.clientHeight];
  }

  /** Metres on the screen of one pixel, at the point looked at. */
  metresPerPixel() {
    const distance = this.camera.position.distanceTo(this.controls.target);
    return (2 * distance * Math.tan((FIELD_OF_VIEW_DEG * Math.PI) / 360)) / this.canvas.clientHeight;
  }

  #move() {
    this.isMoving = true;
    this.lastFrame = null;
  }

  #rest() {
    this.isMoving = false;
    for (const callback of this.listeners.rest) callback();
    this.requestFrame();
  }

  #watchTime() {
    const now = performance.now();
    const isSlow = this.lastFrame !== null && now - this.lastFrame > SLOW_FRAME_MS && now - this.lastFrame < 1000;
    this.lastFrame = now;
    if (isSlow) for (const callback of this.listeners.slow) callback();
  }
}
