// Colours of the view: those of the page's style, so that both change together.

function themeColor(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/** Calls back now and whenever the reader's theme changes. */
function onTheme(callback) {
  callback();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", callback);
}

/** Lines or a mesh in a colour of the theme, always drawn: what of them is in view changes. */
function themed(Kind, positions, material, color) {
  onTheme(() => material.color.set(themeColor(color)));
  const made = new Kind(lineGeometry(positions), material);
  made.frustumCulled = false;
  return made;
}

function lineGeometry(positions) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(positions.flat()), 3));
  return geometry;
}
