// The page's data blocks: JSON, and typed arrays in it as base64; the page's colours.

const ARRAY_TYPES = { uint8: Uint8Array, uint16: Uint16Array, int32: Int32Array, float32: Float32Array };

/** A block by its id, with every {type, data} in it as a typed array; null where there is none. */
function readBlock(id) {
  const block = document.getElementById(id);
  return block && JSON.parse(block.textContent, (_, value) => (ARRAY_TYPES[value?.type] ? unpacked(value) : value));
}

function unpacked({ type, data }) {
  return new ARRAY_TYPES[type](Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0)).buffer);
}

/** The i-th row of three of a flat array. */
function row3(values, i) {
  return [values[3 * i], values[3 * i + 1], values[3 * i + 2]];
}

/** A position of the scene in the frame of the result: all are relative to its origin, which may be far away. */
function inFrame({ origin }, position) {
  return position.map((value, axis) => value + origin[axis]);
}

/** A colour of the page's style, so that view and page change together. */
function themeColor(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/** Calls back now and whenever the reader's theme changes. */
function onTheme(callback) {
  callback();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", callback);
}
