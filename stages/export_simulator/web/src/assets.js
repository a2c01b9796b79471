// Assets ride in the page as gzip + base64 text; in the folder variant they lie beside it as `assets/<name>.gz`.
// Nothing is ever requested from elsewhere.

export async function bytes(name) {
  const source = document.getElementById(`asset-${name}`);
  if (!source) return null;
  const response = await fetch(source.dataset.file ?? `data:application/octet-stream;base64,${source.textContent}`);
  if (!response.ok) throw new Error(`${source.dataset.file} is missing beside the page`);
  const stream = response.body.pipeThrough(new DecompressionStream('gzip'));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

export async function json(name) {
  return JSON.parse(new TextDecoder().decode(await bytes(name)));
}

export async function floats(name) {
  const raw = await bytes(name);
  return new Float32Array(raw.buffer, raw.byteOffset, raw.byteLength / 4);
}
