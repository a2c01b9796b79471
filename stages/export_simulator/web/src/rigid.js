// Rigid motions as rows of seven numbers: place x y z (meters), quaternion w x y z. Named a_from_b, as
// everywhere here.

export const ROW = 7;

export function multiply(p, q) {
  return [
    p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
    p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
    p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
    p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
  ];
}

export function rotate(q, v) {
  const [w, x, y, z] = q;
  const tx = 2 * (y * v[2] - z * v[1]),
    ty = 2 * (z * v[0] - x * v[2]),
    tz = 2 * (x * v[1] - y * v[0]);
  return [v[0] + w * tx + y * tz - z * ty, v[1] + w * ty + z * tx - x * tz, v[2] + w * tz + x * ty - y * tx];
}

export const conjugate = (q) => [q[0], -q[1], -q[2], -q[3]];
export const place = (row) => [row[0], row[1], row[2]];
export const turn = (row) => [row[3], row[4], row[5], row[6]];

export function compose(aFromB, bFromC) {
  const moved = rotate(turn(aFromB), place(bFromC));
  return [
    aFromB[0] + moved[0],
    aFromB[1] + moved[1],
    aFromB[2] + moved[2],
    ...multiply(turn(aFromB), turn(bFromC)),
  ];
}

export function inverse(aFromB) {
  const back = conjugate(turn(aFromB));
  const moved = rotate(back, place(aFromB));
  return [-moved[0], -moved[1], -moved[2], ...back];
}

export function apply(aFromB, point) {
  const moved = rotate(turn(aFromB), point);
  return [moved[0] + aFromB[0], moved[1] + aFromB[1], moved[2] + aFromB[2]];
}

// Rotation matrix, row-major nine numbers.
export function matrixFromTurn([w, x, y, z]) {
  return [
    1 - 2 * (y * y + z * z),
    2 * (x * y - w * z),
    2 * (x * z + w * y),
    2 * (x * y + w * z),
    1 - 2 * (x * x + z * z),
    2 * (y * z - w * x),
    2 * (x * z - w * y),
    2 * (y * z + w * x),
    1 - 2 * (x * x + y * y),
  ];
}

export function turnFromMatrix(m) {
  const trace = m[0] + m[4] + m[8];
  const q = [0, 0, 0, 0];
  if (trace > 0) {
    const s = 2 * Math.sqrt(trace + 1);
    q[0] = s / 4;
    q[1] = (m[7] - m[5]) / s;
    q[2] = (m[2] - m[6]) / s;
    q[3] = (m[3] - m[1]) / s;
  } else {
    const i = m[0] >= m[4] && m[0] >= m[8] ? 0 : m[4] >= m[8] ? 1 : 2;
    const j = (i + 1) % 3,
      k = (i + 2) % 3;
    const s = 2 * Math.sqrt(1 + m[4 * i] - m[4 * j] - m[4 * k]);
    q[0] = (m[3 * k + j] - m[3 * j + k]) / s;
    q[1 + i] = s / 4;
    q[1 + j] = (m[3 * j + i] + m[3 * i + j]) / s;
    q[1 + k] = (m[3 * k + i] + m[3 * i + k]) / s;
  }
  const sign = q[0] < 0 ? -1 : 1;
  return q.map((value) => value * sign);
}

export function turnFromVector(v) {
  const angle = Math.hypot(...v);
  const scale = angle < 1e-8 ? 0.5 : Math.sin(angle / 2) / angle;
  return [Math.cos(angle / 2), v[0] * scale, v[1] * scale, v[2] * scale];
}

export function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

export function normalize(v) {
  const length = Math.hypot(...v) || 1;
  return v.map((value) => value / length);
}

// Blend whole frames (many rows): linear for places, shortest normalized arc for turns.
export function blend(first, second, share, out = new Float32Array(first.length)) {
  for (let at = 0; at < first.length; at += ROW) {
    for (let i = 0; i < 3; i++) out[at + i] = first[at + i] + share * (second[at + i] - first[at + i]);
    let dot = 0;
    for (let i = 3; i < ROW; i++) dot += first[at + i] * second[at + i];
    const other = dot < 0 ? -share : share;
    let length = 0;
    for (let i = 3; i < ROW; i++) {
      out[at + i] = (1 - share) * first[at + i] + other * second[at + i];
      length += out[at + i] ** 2;
    }
    length = Math.sqrt(length) || 1;
    for (let i = 3; i < ROW; i++) out[at + i] /= length;
  }
  return out;
}

// The pose of a camera (OpenCV axes: x right, y down, z forward) at `eye` that looks at `target`, upright.
export function lookAt(eye, target) {
  const forward = normalize([target[0] - eye[0], target[1] - eye[1], target[2] - eye[2]]);
  const right = normalize(cross(forward, [0, 1, 0]));
  const down = cross(forward, right);
  const m = [right[0], down[0], forward[0], right[1], down[1], forward[1], right[2], down[2], forward[2]];
  return [...eye, ...turnFromMatrix(m)];
}
