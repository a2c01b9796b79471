// Assets ride in the page as gzip + base64 text; in the folder variant they lie beside it as
// `assets/<name>.gz`. Nothing is ever requested from elsewhere. Arrays are stored byte by byte of their
// records (first all first bytes, then all second ones), which compresses better; `data-record` says how long
// a record is.

export async function bytes(name) {
  const source = document.getElementById(`asset-${name}`);
  if (!source) return null;
  const response = await fetch(
    source.dataset.file ?? `data:application/octet-stream;base64,${source.textContent}`,
  );
  if (!response.ok) throw new Error(`${source.dataset.file} is missing beside the page`);
  const stream = response.body.pipeThrough(new DecompressionStream('gzip'));
  return records(new Uint8Array(await new Response(stream).arrayBuffer()), Number(source.dataset.record));
}

export async function json(name) {
  return JSON.parse(new TextDecoder().decode(await bytes(name)));
}

export async function floats(name) {
  const raw = await bytes(name);
  return new Float32Array(raw.buffer, raw.byteOffset, raw.byteLength / 4);
}

function records(planes, length) {
  if (length === 1) return planes;
  const count = Math.floor(planes.length / length);
  const whole = new Uint8Array(planes.length);
  for (let place = 0; place < length; place++) {
    for (let i = 0, from = place * count, to = place; i < count; i++, from++, to += length)
      whole[to] = planes[from];
  }
  whole.set(planes.subarray(count * length), count * length);
  return whole;
}
