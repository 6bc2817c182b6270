// The data of the page (JSON that holds typed arrays as base64), and its colours.

const ARRAY_TYPES = { uint8: Uint8Array, int16: Int16Array, uint16: Uint16Array, int32: Int32Array, float32: Float32Array };

/** Returns a block of data by its id, with each {type, data} in it as a typed array; null where there is none. */
function readBlock(id) {
  const block = document.getElementById(id);
  return block && JSON.parse(block.textContent, (_, value) => (ARRAY_TYPES[value?.type] ? unpacked(value) : value));
}

function unpacked({ type, data }) {
  return new ARRAY_TYPES[type](Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0)).buffer);
}

/** Returns the i-th row of three numbers of a flat array. */
function row3(values, i) {
  return [values[3 * i], values[3 * i + 1], values[3 * i + 2]];
}

/** Returns a position in the frame of the result; positions of the scene are relative to an origin in that frame. */
function inFrame({ origin }, position) {
  return position.map((value, axis) => value + origin[axis]);
}

/** Returns a colour of the page's style, so that the view has the theme of the page. */
function themeColor(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/** Calls a function now, and again whenever the reader's theme changes. */
function onTheme(callback) {
  callback();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", callback);
}
