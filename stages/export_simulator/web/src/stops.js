// Goals that the visitor clicked, visited one after the other; also as the file that
// `python -m stages.simulate --subgoals` reads.

import { rotate } from './rigid.js';

export const ARRIVED_M = 0.25;

export class Stops {
  // points: [[x, z], ...] on the floor, or [x, z, up] above it, meters; from: the root's row where the
  // journey begins; rootAt: a point to the height of the root there.
  constructor(points = [], from = null, rootAt = null) {
    Object.assign(this, { points, from, rootAt, reached: 0, nearest: new Map() });
  }

  get left() {
    return this.points.slice(this.reached);
  }

  // Where to go now, [x, z] or [x, z, up], or null.
  get next() {
    return this.points[this.reached] ?? null;
  }

  // Leave what was reached as it is, then go on through other points.
  continue(points) {
    this.points = [...this.points.slice(0, this.reached), ...points];
  }

  // Note where the animal arrives that goes to a stop: in furniture it may not be.
  clear(stop, place) {
    this.nearest.set(stop, place);
  }

  // Note where the root is; true when a stop has just been reached: one on furniture not from beneath.
  visit([x, y, z]) {
    const { next } = this;
    if (!next) return false;
    const goal = this.nearest.get(next) ?? [next[0], next[2] ? this.rootAt(next) : y, next[1]];
    const level = !next[2] || Math.abs(goal[1] - y) < ARRIVED_M;
    const near = level && Math.hypot(goal[0] - x, goal[2] - z) < ARRIVED_M;
    if (near) this.reached += 1;
    return near;
  }

  // A goal as the file has it: on the floor without a height, on furniture with the root's.
  position(point) {
    return point[2] ? [point[0], this.rootAt(point), point[1]] : point.slice(0, 2);
  }

  // The whole journey, with where it begins: meters, world frame; 0 degrees looks along +z, 90 along +x.
  get toml() {
    const [x, y, z, ...turn] = this.from;
    const nose = rotate(turn, [0, 0, 1]);
    const heading = (Math.atan2(nose[0], nose[2]) * 180) / Math.PI;
    const begin =
      `# where it stood\n[[subgoal]]\nposition = [${[x, y, z].map(meters).join(', ')}]\n` +
      `heading_deg = ${heading.toFixed(1)}\n`;
    const stops = this.points.map(
      (point) => `[[subgoal]]\nposition = [${this.position(point).map(meters).join(', ')}]\n`,
    );
    return new Blob([[begin, ...stops].join('\n')], { type: 'application/toml' });
  }
}

export const meters = (value) => value.toFixed(2);

// Places on the floor as they stand in the address: 'x,z;x,z'.
export const placesText = (points) => points.map((point) => point.map(meters).join(',')).join(';');
