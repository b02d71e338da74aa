// Decodes what arrays.py encoded.

const TYPES = {
  float16: Uint16Array, float32: Float32Array, uint16: Uint16Array, uint8: Uint8Array, int32: Int32Array,
};

async function decoded(content) {
  const packed = Uint8Array.from(atob(content.data), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const Type = TYPES[content.type];
  const size = Type.BYTES_PER_ELEMENT;
  const count = planes.length / size;
  const bytes = new Uint8Array(planes.length);
  for (let k = 0; k < size; k++) {
    for (let i = 0; i < count; i++) bytes[i * size + k] = planes[k * count + i];
  }
  return { values: new Type(bytes.buffer), shape: content.shape, type: content.type };
}
