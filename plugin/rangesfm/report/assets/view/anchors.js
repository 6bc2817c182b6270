// Anchors with their error ellipsoids, where they were surveyed, and mirror images.

function makeAnchors(anchors, size) {
  const group = new THREE.Group();
  const solid = new THREE.MeshBasicMaterial();
  const glass = new THREE.MeshBasicMaterial({ transparent: true, opacity: 0.3, depthWrite: false });
  const wire = new THREE.MeshBasicMaterial({ wireframe: true });
  const dashes = new THREE.LineDashedMaterial({ dashSize: size, gapSize: size });
  onTheme(() => {
    for (const material of [solid, glass, wire, dashes]) material.color.set(themeColor("anchor"));
  });
  const sphere = new THREE.SphereGeometry(1, 24, 16);
  const octahedron = new THREE.OctahedronGeometry(size);
  const place = (mesh, position) => {
    mesh.position.set(...position);
    group.add(mesh);
    return mesh;
  };
  for (const anchor of anchors) {
    place(new THREE.Mesh(octahedron, solid), anchor.position);
    if (anchor.ellipsoid !== null) {
      const ellipsoid = place(new THREE.Mesh(sphere, glass), anchor.position);
      ellipsoid.scale.set(...anchor.ellipsoid.map((semiaxis) => Math.max(semiaxis, 1e-6)));
    }
    if (anchor.mirror !== null) {
      place(new THREE.Mesh(octahedron, wire), anchor.mirror);
      const line = new THREE.Line(lineGeometry([anchor.position, anchor.mirror]), dashes);
      line.computeLineDistances();
      group.add(line);
    }
  }
  return group;
}
