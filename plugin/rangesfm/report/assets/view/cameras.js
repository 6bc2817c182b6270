// Cameras as frusta along their path.

/** Corners of a frustum in the world, metres: the camera's centre, then the image from its top left, clockwise. */
function frustumCorners(path, i, size, shape) {
  const center = row3(path.centers, i);
  const [w, h] = [size * shape[0], size * shape[1]];
  const inCamera = [[-w, -h, size], [w, -h, size], [w, h, size], [-w, h, size]];
  return [center, ...inCamera.map((corner) => fromCamera(path, i, corner, center))];
}

const FRUSTUM_EDGES = [0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1];
const FRUSTUM_SIDES = [0, 1, 2, 0, 2, 3, 0, 3, 4, 0, 4, 1];

/** All cameras of a path and the line through them, in the colour of the theme's name; later paths over earlier. */
function makePath(path, size, shape, order) {
  const group = new THREE.Group();
  const add = (Kind, positions) => group.add(themed(Kind, positions, new THREE.LineBasicMaterial(), path.color));
  if (path.rotations !== null) {
    const edges = path.names.flatMap((_, i) => {
      const corners = frustumCorners(path, i, size, shape);
      return FRUSTUM_EDGES.map((corner) => corners[corner]);
    });
    add(THREE.LineSegments, edges);
  }
  add(THREE.Line, path.names.map((_, i) => row3(path.centers, i)));
  for (const part of group.children) part.renderOrder = order;
  return group;
}

/** The one camera that the reader looks at: larger, and filled. */
class ChosenCamera {
  constructor(size, shape) {
    this.size = 1.6 * size;
    this.shape = shape;
    this.group = new THREE.Group();
    this.edges = themed(THREE.LineSegments, [], new THREE.LineBasicMaterial(), "chosen");
    const glass = { transparent: true, opacity: 0.35, side: 2, depthWrite: false };
    this.sides = themed(THREE.Mesh, [], new THREE.MeshBasicMaterial(glass), "chosen");
    this.group.add(this.edges, this.sides);
  }

  show(path, i) {
    const corners = frustumCorners(path, i, this.size, this.shape);
    for (const [part, order] of [[this.edges, FRUSTUM_EDGES], [this.sides, FRUSTUM_SIDES]]) {
      part.geometry.dispose();
      part.geometry = lineGeometry(order.map((corner) => corners[corner]));
    }
  }
}
