// What is under the reader's finger.

const REACH_PX = 14;
const SAME_SPOT_PX = 5;
const MAX_DRAG_PX = 5;

/** Calls back with the pixel of each click or tap that was no drag. */
function onClick(canvas, callback) {
  let start = null;
  canvas.addEventListener("pointerdown", (event) => {
    start = event.isPrimary ? [event.clientX, event.clientY] : null;
  });
  canvas.addEventListener("pointerup", (event) => {
    if (start === null || Math.hypot(event.clientX - start[0], event.clientY - start[1]) > MAX_DRAG_PX) return;
    const box = canvas.getBoundingClientRect();
    callback([event.clientX - box.left, event.clientY - box.top]);
  });
}

/**
 * The nearest of many positions to a pixel; of several on the same spot, the one in front.
 * values: their coordinates in turn, in steps from an origin. Returns {index, position, pixels, depth} or null.
 */
function nearestTo(stage, pixel, values, origin = [0, 0, 0], step = 1) {
  const matrix = stage.camera.projectionMatrix.clone().multiply(stage.camera.matrixWorldInverse).elements;
  const [width, height] = [stage.canvas.clientWidth, stage.canvas.clientHeight];
  const p = [0, 0, 0];
  let best = null;
  for (let i = 0; 3 * i < values.length; i++) {
    for (let axis = 0; axis < 3; axis++) p[axis] = origin[axis] + step * values[3 * i + axis];
    const w = matrix[3] * p[0] + matrix[7] * p[1] + matrix[11] * p[2] + matrix[15];
    if (w <= 0) continue;
    const x = ((matrix[0] * p[0] + matrix[4] * p[1] + matrix[8] * p[2] + matrix[12]) / w + 1) * 0.5 * width;
    const y = (1 - (matrix[1] * p[0] + matrix[5] * p[1] + matrix[9] * p[2] + matrix[13]) / w) * 0.5 * height;
    const pixels = Math.hypot(x - pixel[0], y - pixel[1]);
    if (pixels > REACH_PX) continue;
    const isCloser = best === null || pixels < best.pixels - SAME_SPOT_PX;
    const isInFront = best !== null && pixels < best.pixels + SAME_SPOT_PX && w < best.depth;
    if (isCloser || isInFront) best = { index: i, position: [...p], pixels, depth: w };
  }
  return best;
}
