// Add one animation to a binary glTF whose skin's joints are siblings under one root.

import { ROW } from './rigid.js';

const FLOAT = 5126;
const [JSON_CHUNK, BIN_CHUNK, MAGIC] = [0x4e4f534a, 0x004e4942, 0x46546c67];

// model: bytes of a GLB; times: seconds; frames: root and joints as rows. Returns the bytes of the animated
// one.
export function animated(model, name, times, frames) {
  const { json, bin } = opened(model);
  const skin = json.skins[0];
  const root = json.nodes.findIndex((node) => node.children?.includes(skin.joints[0]));
  const parts = [bin];
  let length = bin.byteLength;
  const store = (values, type, bounds) => {
    const bytes = new Uint8Array(values.buffer, values.byteOffset, values.byteLength);
    json.bufferViews.push({ buffer: 0, byteOffset: length, byteLength: bytes.byteLength });
    const width = { SCALAR: 1, VEC3: 3, VEC4: 4 }[type];
    json.accessors.push({
      bufferView: json.bufferViews.length - 1,
      componentType: FLOAT,
      count: values.length / width,
      type,
      ...bounds,
    });
    parts.push(bytes);
    length += bytes.byteLength;
    return json.accessors.length - 1;
  };
  const input = store(times, 'SCALAR', { min: [times[0]], max: [times.at(-1)] });
  const animation = { name, channels: [], samplers: [] };
  [root, ...skin.joints].forEach((node, index) => {
    const rows = frames.map((frame) => frame.subarray(index * ROW, (index + 1) * ROW));
    const tracks = {
      translation: [rows.flatMap((row) => [...row.subarray(0, 3)]), 'VEC3'],
      rotation: [withoutFlips(rows), 'VEC4'],
    };
    for (const [path, [values, type]] of Object.entries(tracks)) {
      animation.channels.push({ sampler: animation.samplers.length, target: { node, path } });
      animation.samplers.push({
        input,
        output: store(Float32Array.from(values), type),
        interpolation: 'LINEAR',
      });
    }
  });
  json.animations = [animation];
  json.buffers[0].byteLength = length;
  return packed(json, parts, length);
}

// Quaternions xyzw, unit length, with neighbors on one side.
function withoutFlips(rows) {
  let last = null;
  return rows.flatMap((row) => {
    let q = [row[4], row[5], row[6], row[3]];
    const norm =
      Math.hypot(...q) * (last && q.reduce((sum, value, i) => sum + value * last[i], 0) < 0 ? -1 : 1);
    q = q.map((value) => value / norm);
    last = q;
    return q;
  });
}

function opened(model) {
  const view = new DataView(model.buffer, model.byteOffset, model.byteLength);
  const size = view.getUint32(12, true);
  const json = JSON.parse(new TextDecoder().decode(model.subarray(20, 20 + size)));
  const start = 20 + size;
  return { json, bin: model.subarray(start + 8, start + 8 + view.getUint32(start, true)) };
}

function packed(json, parts, length) {
  const text = new TextEncoder().encode(JSON.stringify(json));
  const padded = Math.ceil(text.length / 4) * 4;
  const out = new Uint8Array(12 + 8 + padded + 8 + length);
  const view = new DataView(out.buffer);
  [MAGIC, 2, out.length, padded, JSON_CHUNK].forEach((value, i) => view.setUint32(4 * i, value, true));
  out.fill(0x20, 20, 20 + padded).set(text, 20);
  view.setUint32(20 + padded, length, true);
  view.setUint32(24 + padded, BIN_CHUNK, true);
  let at = 28 + padded;
  for (const part of parts) {
    out.set(part, at);
    at += part.byteLength;
  }
  return out;
}
