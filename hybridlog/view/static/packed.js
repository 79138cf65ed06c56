/** Reads answers that are arrays of numbers: see `packed_response` in `hybridlog/view/context.py`. */

const KINDS = {
  float32: Float32Array,
  float64: Float64Array,
  uint8: Uint8Array,
  uint16: Uint16Array,
  uint32: Uint32Array,
};

/** The values of the header, and under `arrays` the arrays by name, as views of the buffer. */
export function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const arrays = {};
  let place = 4 + length;
  for (const { name, type, count } of header.arrays) {
    arrays[name] = new KINDS[type](buffer, place, count);
    place += arrays[name].byteLength;
  }
  return { ...header, arrays };
}
