// The map's points. They come in random order, so that the first so many are an even sample of all.

const LEAST_SHARE_WHILE_MOVING = 0.1;
const MANY_POINTS = 30000;

const POINT_VERTEX = `
  attribute vec3 rgb;
  uniform float size;
  varying vec3 color;
  void main() {
    color = rgb;
    gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
    gl_PointSize = size;
  }`;

const POINT_FRAGMENT = `
  varying vec3 color;
  void main() { gl_FragColor = vec4(color, 1.0); }`;

function makePoints(stage, data) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(data.steps, 3, true));
  geometry.setAttribute("rgb", new THREE.BufferAttribute(data.colors, 3, true));
  const material = new THREE.ShaderMaterial({
    vertexShader: POINT_VERTEX,
    fragmentShader: POINT_FRAGMENT,
    uniforms: { size: { value: 1 } },
  });
  const points = new THREE.Points(geometry, material);
  points.position.set(...data.origin);
  points.scale.setScalar(data.extent);
  points.frustumCulled = false;
  points.onBeforeRender = () => {
    material.uniforms.size.value = (data.num < MANY_POINTS ? 3 : 2) * stage.renderer.getPixelRatio();
  };
  let share = 1;
  stage.on("slow", () => {
    share = Math.max(LEAST_SHARE_WHILE_MOVING, 0.6 * share);
    geometry.setDrawRange(0, Math.ceil(share * data.num));
  });
  stage.on("rest", () => geometry.setDrawRange(0, data.num));
  return points;
}

/** Metres from one whole number that a coordinate may have to the next. */
function stepOf(data) {
  return data.extent / 65535;
}

/** Position of the i-th point, metres. */
function pointPosition(data, i) {
  return row3(data.steps, i).map((value, axis) => data.origin[axis] + stepOf(data) * value);
}
