// Paths around furniture that was moved: the networks avoid what they perceive, but nothing stops a path from
// crossing it. Without moved furniture there is no detour, and plans are those of Python.

import { Grid } from './furniture.js';

const HURRY = 1.2; // how much longer a step may be than the longest of the path that makes up for a detour
const LEAST_STEP_M = 0.04;
const SAMPLE = 0.2; // of a voxel's edge, between points of a way that are tested
const ARRIVED_M = 0.2;
const [STRAIGHT, DIAGONAL, CLOSE] = [5, 7, 3]; // costs of a step; times as much beside furniture
const STEPS = [-1, 0, 1].flatMap((da) => [-1, 0, 1].map((dc) => [da, dc])).filter(([da, dc]) => da || dc);

export class Detour {
  // moves: [{cells, by}, ...]; band: [lowest, highest] layer of voxels that an animal's body takes up as it
  // walks on the floor: up to its back, which is in the layer above the root's.
  constructor(volume, allowed, moves, band) {
    const grid = new Grid(volume);
    Object.assign(this, { grid, top: grid.origin[1] + (band[1] + 1) * grid.voxel });
    this.piece = new Uint8Array(grid.vx * grid.vz); // 0: none
    moves.forEach(({ cells, by }, index) => {
      for (const cell of cells) {
        const there = grid.moved(cell, by);
        const b = there < 0 ? -1 : grid.place(there)[1];
        if (b >= band[0] && b <= band[1]) this.piece[grid.column(there)] = index + 1;
      }
    });
    this.walkable = Uint8Array.from(this.piece, (_, column) => {
      const [a, c] = [Math.floor(column / grid.vz), column % grid.vz];
      for (let b = band[0]; b < band[1]; b++) if (allowed[grid.number(a, b, c)]) return 1;
      return 0;
    });
  }

  // What does not block a way: furniture that it leads onto, or begins on.
  exempt(from, to) {
    const kept = new Set([0, undefined, this.piece[this.grid.columnAt(from[0], from[2])]]);
    if (to[1] > this.top) kept.add(this.piece[this.grid.columnAt(to[0], to[2])]);
    return kept;
  }

  // Whether a straight way from one point to another leads through moved furniture.
  crosses(from, to, exempt = this.exempt(from, to)) {
    const far = Math.hypot(to[0] - from[0], to[2] - from[2]);
    const count = Math.ceil(far / (SAMPLE * this.grid.voxel)) || 1;
    for (let i = 1; i <= count; i++) {
      const [x, z] = [0, 2].map((axis) => from[axis] + (i / count) * (to[axis] - from[axis]));
      if (!exempt.has(this.piece[this.grid.columnAt(x, z)])) return true;
    }
    return false;
  }

  // The same for a whole path that begins after `start`.
  blocks(path, start) {
    const exempt = this.exempt(start, path.at(-1));
    return path.some((point, i) => this.crosses(i ? path[i - 1] : start, point, exempt));
  }

  // A path of points [x, y, z] that begins a frame after `start`, led around the furniture as fast as it was,
  // or a little faster; what it cannot do in time it leaves to the next plan.
  lead(path, start) {
    if (!this.blocks(path, start)) return path;
    const line = this.line(path, start, this.exempt(start, path.at(-1)));
    const [length, before] = [lengths(line), lengths([start, ...path])];
    const fastest = Math.max(
      LEAST_STEP_M,
      HURRY * Math.max(...path.map((_, i) => before[i + 1] - before[i])),
    );
    let along = 0;
    return path.map(([, y], i) => {
      const due = (length.at(-1) * before[i + 1]) / before.at(-1);
      along = Math.min(due, along + fastest);
      const [x, z] = pointAt(line, length, along);
      return [x, y, z];
    });
  }

  // The corners of that way.
  line(path, start, exempt) {
    const line = [start];
    for (let i = 0; i < path.length; i++) {
      if (!this.crosses(line.at(-1), path[i], exempt)) {
        line.push(path[i]);
        continue;
      }
      while (line.length > 1 && this.isClose(line.at(-1), exempt)) line.pop();
      while (i < path.length - 1 && this.isClose(path[i], exempt)) i++;
      line.push(...this.route(line.at(-1), path[i], exempt));
    }
    return line;
  }

  // Whether a point is in furniture or within a voxel of it.
  isClose([x, , z], exempt) {
    const column = this.grid.columnAt(x, z);
    return STEPS.concat([[0, 0]]).some(
      (step) => !exempt.has(this.piece[this.grid.movedColumn(column, step)]),
    );
  }

  // The shortest way over the floor, without its beginning, as points [x, y, z]: to `to` or, where that cannot
  // be reached, as near to it as can be.
  route(from, to, exempt = this.exempt(from, to)) {
    const { grid } = this;
    const begin = grid.columnAt(from[0], from[2]);
    const goal = grid.columnAt(to[0], to[2]);
    if (begin < 0) return [];
    const before = this.search(begin, goal, exempt);
    const far = (column) => {
      const [x, z] = grid.columnCenter(column);
      return Math.hypot(x - to[0], z - to[2]);
    };
    let end = goal;
    if (!before.has(goal))
      end = [...before.keys()].reduce((best, column) => (far(column) < far(best) ? column : best), begin);
    const columns = [];
    for (let column = end; column !== begin; column = before.get(column)) columns.unshift(column);
    const points = columns.map((column) => {
      const [x, z] = grid.columnCenter(column);
      return [x, from[1], z];
    });
    if (end === goal) points.splice(-1, 1, to);
    return rounded(points, from);
  }

  // Dijkstra's algorithm: the columns that were reached, each with the one before it.
  search(begin, goal, exempt) {
    const [cost, before, queue] = [new Map([[begin, 0]]), new Map([[begin, begin]]), [[begin]]];
    const open = (column) => column >= 0 && this.walkable[column] && exempt.has(this.piece[column]);
    for (let price = 0; price < queue.length; price++)
      for (const column of queue[price] ?? []) {
        if (cost.get(column) < price) continue;
        if (column === goal) return before;
        for (const step of STEPS) {
          const next = this.grid.movedColumn(column, step);
          const sides = [
            this.grid.movedColumn(column, [step[0], 0]),
            this.grid.movedColumn(column, [0, step[1]]),
          ];
          if (!open(next) || !sides.every((side) => side === column || open(side))) continue;
          const [x, z] = this.grid.columnCenter(next);
          const length =
            (step[0] && step[1] ? DIAGONAL : STRAIGHT) * (this.isClose([x, 0, z], exempt) ? CLOSE : 1);
          if (price + length >= (cost.get(next) ?? Infinity)) continue;
          cost.set(next, price + length);
          before.set(next, column);
          (queue[price + length] ??= []).push(next);
        }
      }
    return before;
  }

  // Whether a plan that ends at `end` leaves a part of the way to the goal to the next one.
  unfinished(start, end, goal) {
    if (!this.crosses(start, goal)) return false;
    const last = this.route(start, goal).at(-1) ?? start;
    return Math.hypot(end[0] - last[0], end[2] - last[2]) > ARRIVED_M;
  }

  // A path that ends where it would step into furniture: other corrections come after `lead`.
  halted(path, start) {
    const exempt = this.exempt(start, path.at(-1));
    let [here, stopped] = [start, false];
    return path.map((point) => {
      stopped ||= this.crosses(here, point, exempt);
      if (!stopped) here = point;
      return stopped ? [here[0], point[1], here[2]] : point;
    });
  }
}

// Corners taken less sharply: each point in the middle of its neighbors, which keeps a voxel's distance.
function rounded(points, from) {
  return points.map((point, i) => {
    const next = points[i + 1];
    if (!next) return point;
    const before = points[i - 1] ?? from;
    return point.map((value, axis) => (before[axis] + value + next[axis]) / 3);
  });
}

// How long a line is up to each of its points, over the floor.
function lengths(line) {
  let sum = 0;
  return line.map((point, i) => {
    if (i) sum += Math.hypot(point[0] - line[i - 1][0], point[2] - line[i - 1][2]);
    return sum;
  });
}

// The point [x, z] of a line after some of its length.
function pointAt(line, length, along) {
  const next = Math.max(
    1,
    length.findIndex((value) => value >= along - 1e-9),
  );
  const share = Math.min(1, (along - length[next - 1]) / Math.max(1e-9, length[next] - length[next - 1]));
  return [0, 2].map((axis) => line[next - 1][axis] + share * (line[next][axis] - line[next - 1][axis]));
}
