// A metric grid on the ground, and the scale bar over the view.

const NUM_GRID_CELLS = 12;

/** Returns the largest round length (1, 2 or 5 times a power of ten) that is not above a length. */
function roundLength(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return [5, 2, 1].map((factor) => factor * power).find((round) => round <= length * 1.0001);
}

/** unit: "m", or that of a model whose scale nobody knows. */
function lengthText(length, unit) {
  if (unit !== "m") return `${+length.toPrecision(6)} ${unit}`;
  return length < 0.01 ? `${+(1000 * length).toPrecision(2)} mm` : length < 1 ? `${+(100 * length).toPrecision(2)} cm` : `${+length.toPrecision(6)} m`;
}

/** Returns the grid and the width of its cells in metres. */
function makeGrid(box, up) {
  const cell = roundLength((2.4 * box.radius) / NUM_GRID_CELLS);
  const numCells = 2 * Math.ceil((1.2 * box.radius) / cell);
  const grid = new THREE.GridHelper(cell * numCells, numCells);
  grid.material.vertexColors = false;
  onTheme(() => grid.material.color.set(themeColor("stage-grid")));
  const vertical = up.findIndex((value) => value !== 0);
  const middle = box.low.map((value, axis) => cell * Math.round((value + box.high[axis]) / 2 / cell));
  grid.position.set(...middle.with(vertical, box.ground));
  if (vertical === 2) grid.rotateX(Math.PI / 2); // three.js makes it with y up
  return { grid, cell };
}

/** Keeps the scale bar at a round length as the view changes. */
function attachScaleBar(stage, bar, unit) {
  stage.addEventListener("frame", () => {
    const perPixel = stage.metresPerPixel();
    const length = roundLength(130 * perPixel);
    bar.style.width = `${(length / perPixel).toFixed(1)}px`;
    bar.textContent = lengthText(length, unit);
  });
}
