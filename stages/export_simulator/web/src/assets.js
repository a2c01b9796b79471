// Assets ride in the page as gzip + base64 text; nothing is ever requested from outside.

export async function bytes(name) {
  const text = document.getElementById(`asset-${name}`)?.textContent;
  if (!text) return null;
  const response = await fetch(`data:application/octet-stream;base64,${text}`);
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
