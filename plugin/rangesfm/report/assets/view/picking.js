// Finding what the reader clicked on.

const REACH_PX = 14;
const SAME_SPOT_PX = 5;
const MAX_DRAG_PX = 5;

/** Calls a function with the pixel of each click or tap that is not a drag. */
function onClick(canvas, callback) {
  let start = null;
  canvas.addEventListener("pointerdown", (event) => (start = event.isPrimary ? event : null));
  canvas.addEventListener("pointerup", ({ clientX: x, clientY: y }) => {
    if (start === null || Math.hypot(x - start.clientX, y - start.clientY) > MAX_DRAG_PX) return;
    const box = canvas.getBoundingClientRect();
    callback([x - box.left, y - box.top]);
  });
}

/** Returns the position nearest to a pixel, of several on the same spot the one in front; null if none is near. */
function nearestTo(stage, pixel, num, positionOf) {
  let best = null;
  for (let index = 0; index < num; index++) {
    const position = positionOf(index);
    const [x, y, depth] = stage.pixelOf(position);
    const pixels = Math.hypot(x - pixel[0], y - pixel[1]);
    if (depth > 1 || pixels > REACH_PX) continue; // behind the camera, or out of reach
    const ahead = best === null ? Infinity : best.pixels - pixels;
    if (ahead > SAME_SPOT_PX || (ahead > -SAME_SPOT_PX && depth < best.depth)) best = { index, position, pixels, depth };
  }
  return best;
}
