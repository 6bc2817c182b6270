// Anchors with their names, error ellipsoids and mirror images.

function makeAnchors(anchors, size) {
  const group = new THREE.Group();
  const solid = new THREE.MeshBasicMaterial();
  const glass = new THREE.MeshBasicMaterial({ transparent: true, opacity: 0.3, depthWrite: false });
  const wire = new THREE.MeshBasicMaterial({ wireframe: true });
  onTheme(() => [solid, glass, wire].forEach((material) => material.color.set(themeColor("anchor"))));
  const sphere = new THREE.SphereGeometry(1, 24, 16);
  const octahedron = new THREE.OctahedronGeometry(size);
  const place = (object, position) => {
    object.position.set(...position);
    group.add(object);
    return object;
  };
  for (const { id, position, ellipsoid, mirror } of anchors) {
    place(new THREE.Mesh(octahedron, solid), position);
    place(makeLabel("anchor", id), position);
    if (ellipsoid !== null) {
      place(new THREE.Mesh(sphere, glass), position).scale.set(...ellipsoid.map((semiaxis) => Math.max(semiaxis, 1e-6)));
    }
    if (mirror !== null) {
      place(new THREE.Mesh(octahedron, wire), mirror);
      place(makeLabel("anchor", `${id} (mirror image)`), mirror);
      const dashes = new THREE.LineDashedMaterial({ dashSize: size, gapSize: size });
      group.add(themed(THREE.Line, [position, mirror], dashes, "anchor").computeLineDistances());
    }
  }
  return group;
}
