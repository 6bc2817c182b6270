// Cameras, drawn as frusta along their path.

const FRUSTUM_EDGES = [0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1];
const FRUSTUM_SIDES = [0, 1, 2, 0, 2, 3, 0, 3, 4, 0, 4, 1];

/** Returns a place given in the frame of the i-th camera of a path in the world; center: position of that camera. */
function fromCamera(path, i, place, center = row3(path.centers, i)) {
  const rotation = path.rotations.subarray(9 * i, 9 * i + 9);
  return center.map((value, axis) => row3(rotation, axis).reduce((sum, part, j) => sum + part * place[j], value));
}

/** Returns corners of a frustum in metres, in the order of turn: 0 is the camera's centre, 1 to 4 are the image corners,
 * clockwise from the top left. */
function frustum(path, i, size, [w, h], turn) {
  const inCamera = [[0, 0, 0], [-w, -h, 1], [w, -h, 1], [w, h, 1], [-w, h, 1]];
  const corners = inCamera.map((corner) => fromCamera(path, i, corner.map((value) => size * value)));
  return turn.map((corner) => corners[corner]);
}

/** Returns all cameras of a path and the line through them. Paths with a larger order are drawn over the others. */
function makePath(path, size, shape, order) {
  const group = new THREE.Group();
  const add = (Kind, positions) => group.add(themed(Kind, positions, new THREE.LineBasicMaterial(), path.color));
  if (path.rotations !== null) {
    add(THREE.LineSegments, path.names.flatMap((_, i) => frustum(path, i, size, shape, FRUSTUM_EDGES)));
  }
  add(THREE.Line, path.names.map((_, i) => row3(path.centers, i)));
  for (const part of group.children) part.renderOrder = order;
  return group;
}

/** The camera that the reader has chosen, drawn larger and filled. */
class ChosenCamera {
  constructor(size, shape) {
    Object.assign(this, { size: 1.6 * size, shape, group: new THREE.Group() });
    const glass = { transparent: true, opacity: 0.35, side: 2, depthWrite: false };
    this.edges = themed(THREE.LineSegments, [], new THREE.LineBasicMaterial(), "chosen");
    this.sides = themed(THREE.Mesh, [], new THREE.MeshBasicMaterial(glass), "chosen");
    this.group.add(this.edges, this.sides);
  }

  show(path, i) {
    moveTo(this.edges, frustum(path, i, this.size, this.shape, FRUSTUM_EDGES));
    moveTo(this.sides, frustum(path, i, this.size, this.shape, FRUSTUM_SIDES));
  }
}
