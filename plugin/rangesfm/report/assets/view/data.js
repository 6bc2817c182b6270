// The page's data blocks: JSON, and typed arrays in it as base64.

const ARRAY_TYPES = { uint8: Uint8Array, uint16: Uint16Array, int32: Int32Array, float32: Float32Array };

function readBlock(id) {
  const block = document.getElementById(id);
  return block === null ? null : unpackAll(JSON.parse(block.textContent));
}

/** Every {type, data} in a JSON value becomes a typed array. */
function unpackAll(value) {
  if (value === null || typeof value !== "object") return value;
  if (typeof value.data === "string" && value.type in ARRAY_TYPES) return unpackArray(value);
  for (const key of Object.keys(value)) value[key] = unpackAll(value[key]);
  return value;
}

function unpackArray({ type, data }) {
  const text = atob(data);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return new ARRAY_TYPES[type](bytes.buffer);
}

/** A place in the frame of a path's i-th camera, carried into the world; center: where the camera is then. */
function fromCamera(path, i, place, center) {
  const rotation = path.rotations.subarray(9 * i, 9 * i + 9);
  return center.map((value, axis) => {
    const [x, y, z] = row3(rotation, axis);
    return value + x * place[0] + y * place[1] + z * place[2];
  });
}

/** The i-th row of three of a flat array. */
function row3(values, i) {
  return [values[3 * i], values[3 * i + 1], values[3 * i + 2]];
}
