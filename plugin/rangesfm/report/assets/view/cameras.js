// Cameras as frusta along their path.

/** Corners of a frustum in the world, metres: the camera's centre, then the image from its top left, clockwise. */
function frustumCorners(path, i, size, shape) {
  const center = row3(path.centers, i);
  const rotation = path.rotations.subarray(9 * i, 9 * i + 9);
  const [w, h] = [size * shape[0], size * shape[1]];
  const inCamera = [[-w, -h, size], [w, -h, size], [w, h, size], [-w, h, size]];
  const inWorld = inCamera.map((corner) =>
    center.map(
      (value, axis) =>
        value +
        rotation[3 * axis] * corner[0] +
        rotation[3 * axis + 1] * corner[1] +
        rotation[3 * axis + 2] * corner[2],
    ),
  );
  return [center, ...inWorld];
}

const FRUSTUM_EDGES = [0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1];
const FRUSTUM_SIDES = [0, 1, 2, 0, 2, 3, 0, 3, 4, 0, 4, 1];

function lineGeometry(positions) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(positions.flat()), 3));
  return geometry;
}

/** All cameras of a path and the line through them, in the colour of the theme's name; later paths over earlier. */
function makePath(path, size, shape, order) {
  const group = new THREE.Group();
  const material = new THREE.LineBasicMaterial();
  onTheme(() => material.color.set(themeColor(path.color)));
  if (path.rotations !== null) {
    const edges = path.names.flatMap((_, i) => {
      const corners = frustumCorners(path, i, size, shape);
      return FRUSTUM_EDGES.map((corner) => corners[corner]);
    });
    group.add(new THREE.LineSegments(lineGeometry(edges), material));
  }
  group.add(new THREE.Line(lineGeometry(path.names.map((_, i) => row3(path.centers, i))), material));
  for (const part of group.children) {
    part.frustumCulled = false;
    part.renderOrder = order;
  }
  return group;
}

/** The one camera that the reader looks at: larger, and filled. */
class ChosenCamera {
  constructor(size, shape) {
    this.size = 1.6 * size;
    this.shape = shape;
    this.group = new THREE.Group();
    this.edges = new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial());
    const glass = { transparent: true, opacity: 0.35, side: 2, depthWrite: false };
    this.sides = new THREE.Mesh(new THREE.BufferGeometry(), new THREE.MeshBasicMaterial(glass));
    this.group.add(this.edges, this.sides);
    onTheme(() => {
      for (const part of this.group.children) part.material.color.set(themeColor("chosen"));
    });
  }

  show(path, i) {
    const corners = frustumCorners(path, i, this.size, this.shape);
    for (const [part, order] of [[this.edges, FRUSTUM_EDGES], [this.sides, FRUSTUM_SIDES]]) {
      part.geometry.dispose();
      part.geometry = lineGeometry(order.map((corner) => corners[corner]));
      part.frustumCulled = false;
    }
  }
}
