// Read NPZ files: a zip archive of NumPy arrays, stored or deflated.

const ENTRY = 0x02014b50,
  END = 0x06054b50;
const KINDS = { '<f4': Float32Array, '<f8': Float64Array };

// bytes of the file -> {name: {shape, values}} of its arrays of floats; throws where it is none.
export async function arrays(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const end = bytes.byteLength - 22;
  if (end < 0 || view.getUint32(end, true) !== END) throw new Error('it is not an NPZ file');
  const found = {};
  let at = view.getUint32(end + 16, true);
  for (let left = view.getUint16(end + 10, true); left > 0; left--) {
    if (view.getUint32(at, true) !== ENTRY) throw new Error('its archive is damaged');
    const [packed, size, local] = [
      view.getUint16(at + 10, true) === 8,
      view.getUint32(at + 20, true),
      view.getUint32(at + 42, true),
    ];
    const [name, extra, comment] = [28, 30, 32].map((offset) => view.getUint16(at + offset, true));
    const start = local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
    const stored = bytes.subarray(start, start + size);
    const array = numbers(packed ? await inflated(stored) : stored);
    if (array)
      found[new TextDecoder().decode(bytes.subarray(at + 46, at + 46 + name)).replace(/\.npy$/, '')] = array;
    at += 46 + name + extra + comment;
  }
  return found;
}

async function inflated(bytes) {
  return new Uint8Array(
    await new Response(
      new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate-raw')),
    ).arrayBuffer(),
  );
}

// One .npy file, or null where it does not hold floats row by row.
function numbers(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const wide = bytes[6] > 1;
  const start = wide ? 12 + view.getUint32(8, true) : 10 + view.getUint16(8, true);
  const head = new TextDecoder().decode(bytes.subarray(10, start));
  const Kind = KINDS[/'descr': '([^']+)'/.exec(head)?.[1]];
  if (!Kind || !/'fortran_order': False/.test(head)) return null;
  const shape = (/'shape': \(([^)]*)\)/.exec(head)[1].match(/\d+/g) ?? []).map(Number);
  return { shape, values: new Kind(bytes.slice(start).buffer) };
}
