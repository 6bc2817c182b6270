// The map's points. They come in random order, so that the first so many are an even sample of all.

const LEAST_SHARE_WHILE_MOVING = 0.1;
const MANY_POINTS = 30000;

function makePoints(stage, { steps, colors, origin, extent, num }) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(steps, 3, true));
  geometry.setAttribute("color", new THREE.BufferAttribute(colors, 3, true));
  const size = num < MANY_POINTS ? 3 : 2;
  const points = new THREE.Points(geometry, new THREE.PointsMaterial({ size, sizeAttenuation: false, vertexColors: true }));
  points.position.set(...origin);
  points.scale.setScalar(extent);
  points.frustumCulled = false;
  let share = 1;
  stage.addEventListener("slow", () => {
    share = Math.max(LEAST_SHARE_WHILE_MOVING, 0.6 * share);
    geometry.setDrawRange(0, Math.ceil(share * num));
  });
  stage.addEventListener("rest", () => geometry.setDrawRange(0, num));
  return points;
}

/** Position of the i-th point, metres from the scene's origin: whole steps of the largest side of their box. */
function pointPosition({ steps, origin, extent }, i) {
  return row3(steps, i).map((value, axis) => origin[axis] + (extent / 65535) * value);
}
