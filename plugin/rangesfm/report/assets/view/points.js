// The map's points. They come in random order, so that the first n of them are an even sample.

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

/** Returns the position of the i-th point, metres from the origin of the scene. It is stored as whole steps, of which
 * the largest side of the points' box has 65535. */
function pointPosition({ steps, origin, extent }, i) {
  return row3(steps, i).map((value, axis) => origin[axis] + (extent / 65535) * value);
}
