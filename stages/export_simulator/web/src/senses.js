// What the animal perceives, in its ego frame: the scene on a grid, the observer's and its own last frames.
// The counterpart of pipeline/behavior/perception.py and behavior.py; both are held together by a golden
// plan.

import { FreeSpace } from './clearing.js';
import { Detour } from './detour.js';
import { Grid, movedFeatures } from './furniture.js';
import { Support } from './support.js';
import {
  ROW,
  apply,
  compose,
  conjugate,
  inverse,
  matrixFromTurn,
  multiply,
  place,
  rotate,
  turn,
  turnFromMatrix,
  turnFromVector,
} from './rigid.js';

const UPRIGHT = 0.2;
const [PERSON, ANIMAL] = [0, 1]; // kinds of others
const ABSENT_M = 1000; // where somebody is put who is not there
const TURNS = 8; // by which goals get out of something solid, up to a right angle either way
const STEP_FRAMES = 3; // that give the velocity at which the observer is expected to go on

export class Senses {
  // contract: simulator.json; volume: half-precision features, channel first; allowed: bytes per voxel.
  constructor(contract, volume, allowed) {
    const { behavior } = contract;
    this.ego = behavior.architecture.ego;
    this.anticipated = behavior.channels.others.anticipated_frames;
    this.grid = behavior.grid;
    this.recorded = halfTable(volume);
    this.about = contract.volume;
    this.furnish({ moves: [], allowed, band: null });
    this.rest = behavior.agent_from_bone_rest.map(rowFromMatrix);
  }

  // Perceive the home with furniture moved: [{cells, by}, ...], where the root may be then, and the layers that
  // a body takes up.
  furnish({ moves, allowed, band }) {
    const { recorded, about: volume } = this;
    const values = moves.length ? movedFeatures(recorded, new Grid(volume), moves) : recorded;
    this.volume = { ...volume, values };
    this.space = new FreeSpace(volume, allowed);
    this.support = new Support(this.volume, allowed);
    this.detour = moves.length ? new Detour(volume, allowed, moves, band) : null;
  }

  // past: frames of rows (root, bones); observer: rows of the phone; companions: places [x, y, z] of each
  // other animal, of which no more is known. Oldest first, then where the observer will be, going on as now.
  observe(past, observer, companions = []) {
    const frame = this.frame(past.at(-1));
    const egoFromWorld = inverse(frame);
    const unturned = [0, 0, 0, 0, 0, 0];
    const unknown = this.anticipated.map(() => [ABSENT_M, 0, 0, ...unturned, PERSON]);
    return {
      frame,
      sceneGrid: this.around(frame),
      others: Float32Array.from(
        [
          observer.map((row) => [...poseChannels(compose(egoFromWorld, row)), PERSON]),
          this.ahead(observer, past.at(-1)).map((point) => [
            ...apply(egoFromWorld, point),
            ...unturned,
            PERSON,
          ]),
          ...companions.flatMap((places) => [
            places.map((point) => [...apply(egoFromWorld, point), ...unturned, ANIMAL]),
            unknown,
          ]),
        ].flat(2),
      ),
      past: Float32Array.from(past.flatMap((rows) => this.pastChannels(egoFromWorld, rows))),
    };
  }

  // Where the observer will be if it goes on as now, up to where it is nearest to the animal.
  ahead(observer, animal) {
    const count = Math.min(STEP_FRAMES, observer.length - 1);
    const [now, before] = [observer.at(-1), observer.at(-1 - count)];
    const [x, z] = [0, 2].map((axis) => (now[axis] - before[axis]) / count);
    const nearest = ((animal[0] - now[0]) * x + (animal[2] - now[2]) * z) / Math.max(x * x + z * z, 1e-300);
    return this.anticipated.map((frame) => {
      const frames = nearest > 0 ? Math.min(frame, nearest) : frame;
      return [now[0] + x * frames, now[1], now[2] + z * frames];
    });
  }

  // world_from_ego at a root pose.
  frame(rows) {
    const root = Array.from(rows.slice(0, ROW));
    if (this.ego === 'full') return root;
    const head = rotate(turn(root), [0, 0, 1]);
    let forward = head;
    if (Math.hypot(head[0], head[2]) < UPRIGHT)
      forward = rotate(turn(root), [0, 1, 0]).map((value) => -Math.sign(head[1]) * value);
    const yaw = Math.atan2(forward[0], forward[2]);
    return [...place(root), Math.cos(yaw / 2), 0, Math.sin(yaw / 2), 0];
  }

  // Nearest voxels on the ego grid; zero outside the volume.
  around(frame) {
    const [nx, ny, nz] = this.grid.shape;
    const {
      shape: [channels, vx, vy, vz],
      origin,
      voxel_m: voxel,
      values,
    } = this.volume;
    const m = matrixFromTurn(turn(frame)).map((value) => value * (this.grid.cell_m / voxel));
    const base = [0, 1, 2].map((axis) => (frame[axis] - origin[axis]) / voxel);
    const out = new Float32Array(channels * nx * ny * nz);
    let cell = 0;
    for (let i = 0; i < nx; i++)
      for (let j = 0; j < ny; j++)
        for (let k = 0; k < nz; k++, cell++) {
          const [x, y, z] = [i + 0.5 - nx / 2, j + 0.5 - ny / 2, k + 0.5 - nz / 2];
          const a = Math.floor(base[0] + m[0] * x + m[1] * y + m[2] * z);
          const b = Math.floor(base[1] + m[3] * x + m[4] * y + m[5] * z);
          const c = Math.floor(base[2] + m[6] * x + m[7] * y + m[8] * z);
          if (a < 0 || b < 0 || c < 0 || a >= vx || b >= vy || c >= vz) continue;
          const at = (a * vy + b) * vz + c;
          for (let channel = 0; channel < channels; channel++)
            out[channel * nx * ny * nz + cell] = values[channel * vx * vy * vz + at];
        }
    return out;
  }

  // A goal, turned about where the animal is, as little as possible, to where the root may be; else cleared.
  turnedFree(goal, start) {
    const [cleared, [x, y, z]] = [this.space.cleared(goal), goal.map((value, axis) => value - start[axis])];
    const nearer = (cleared[0] - goal[0]) * z >= (cleared[2] - goal[2]) * x ? 1 : -1;
    for (let turns = 0; turns <= 2 * TURNS; turns++) {
      const angle = (nearer * Math.ceil(turns / 2) * (turns % 2 ? 1 : -1) * Math.PI) / 2 / TURNS;
      const [cosine, sine] = [Math.cos(angle), Math.sin(angle)];
      const turned = [cosine * x + sine * z, y, cosine * z - sine * x].map(
        (value, axis) => start[axis] + value,
      );
      if (this.space.allows(turned)) return turned;
    }
    return cleared;
  }

  pastChannels(egoFromWorld, rows) {
    const root = compose(egoFromWorld, Array.from(rows.slice(0, ROW)));
    const channels = poseChannels(root);
    this.rest.forEach((rest, bone) => {
      const row = Array.from(rows.slice((bone + 1) * ROW, (bone + 2) * ROW));
      channels.push(
        ...vectorFromTurn(multiply(turn(row), conjugate(turn(rest)))),
        row[0] - rest[0],
        row[1] - rest[1],
        row[2] - rest[2],
      );
    });
    return channels;
  }

  // One planned frame as rows: root from the path and the body's first six channels, bones from the rest.
  rows(frame, position, body) {
    const out = new Float32Array((this.rest.length + 1) * ROW);
    out.set(compose(frame, [...position, ...turnFromSix(body.slice(0, 6))]), 0);
    this.rest.forEach((rest, bone) => {
      const twist = body.slice(6 + 6 * bone, 12 + 6 * bone);
      const turned = multiply(turnFromVector(twist.slice(0, 3)), turn(rest));
      out.set([rest[0] + twist[3], rest[1] + twist[4], rest[2] + twist[5], ...turned], (bone + 1) * ROW);
    });
    return out;
  }
}

// Others with some of them, by number, the observer's 0, out of sight; `frames` of ten numbers each.
export function withoutSome(others, numbers, frames) {
  const out = Float32Array.from(others);
  for (const number of numbers) for (let i = 0; i < frames; i++) out[10 * (number * frames + i)] = ABSENT_M;
  return out;
}

function rowFromMatrix(m) {
  return [
    m[0][3],
    m[1][3],
    m[2][3],
    ...turnFromMatrix([...m[0].slice(0, 3), ...m[1].slice(0, 3), ...m[2].slice(0, 3)]),
  ];
}

function poseChannels(row) {
  return [...place(row), ...sixFromTurn(turn(row))];
}

// First two columns of the rotation.
function sixFromTurn(q) {
  const m = matrixFromTurn(q);
  return [m[0], m[3], m[6], m[1], m[4], m[7]];
}

// Gram-Schmidt on two columns.
function turnFromSix(six) {
  const length = Math.max(1e-6, Math.hypot(six[0], six[1], six[2]));
  const a = [six[0] / length, six[1] / length, six[2] / length];
  const dot = a[0] * six[3] + a[1] * six[4] + a[2] * six[5];
  let b = [six[3] - dot * a[0], six[4] - dot * a[1], six[5] - dot * a[2]];
  const other = Math.max(1e-6, Math.hypot(...b));
  b = b.map((value) => value / other);
  const c = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  return turnFromMatrix([a[0], b[0], c[0], a[1], b[1], c[1], a[2], b[2], c[2]]);
}

function vectorFromTurn([w, x, y, z]) {
  const sign = w < 0 ? -1 : 1;
  const length = Math.hypot(x, y, z);
  const scale = length < 1e-12 ? 2 * sign : (2 * sign * Math.atan2(length, Math.abs(w))) / length;
  return [x * scale, y * scale, z * scale];
}

function halfTable(bytes) {
  const halves = new Uint16Array(bytes.buffer, bytes.byteOffset, bytes.byteLength / 2);
  return Float32Array.from(halves, (half) => {
    const sign = half & 0x8000 ? -1 : 1,
      exponent = (half >> 10) & 31,
      fraction = half & 1023;
    if (exponent === 0) return sign * fraction * 2 ** -24;
    return exponent === 31 ? 0 : sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
  });
}
