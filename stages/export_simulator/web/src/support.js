// What carries the animal, column by column of the feature volume. Counterpart of
// pipeline/behavior/support.py.

export class Support {
  // volume: simulator.json's, with shape, origin, voxel_m and support {mark, range_m, flight}; allowed: a
  // mark per voxel.
  constructor(volume, allowed) {
    Object.assign(this, { volume, allowed });
  }

  // The heights of the tops that carry the animal at [x, z], world meters, lowest first; none outside the
  // volume.
  tops(x, z) {
    const {
      shape: [, vx, vy, vz],
      origin,
      voxel_m: voxel,
      support,
    } = this.volume;
    const [a, c] = [Math.floor((x - origin[0]) / voxel), Math.floor((z - origin[2]) / voxel)];
    const tops = [];
    if (!support || a < 0 || c < 0 || a >= vx || c >= vz) return tops;
    for (let b = 0; b < vy; b++)
      if (this.allowed[(a * vy + b) * vz + c] >= support.mark) tops.push(origin[1] + b * voxel);
    return tops;
  }

  // The height, nearest to a point's, at which what carries the animal bears its root; the point's own where
  // nothing does.
  carried(point, moves) {
    let nearest = Infinity;
    for (const top of this.tops(point[0], point[2])) {
      const [low, high] = this.volume.support.range_m[moves ? 1 : 0];
      const height = Math.min(top + high, Math.max(top + low, point[1]));
      if (Math.abs(height - point[1]) < Math.abs(nearest - point[1])) nearest = height;
    }
    return Number.isFinite(nearest) ? nearest : point[1];
  }

  // A path of the world, which begins a frame after `start`, on what carries the animal; steps become jumps.
  follow(path, start, fastest) {
    const { support } = this.volume;
    if (!support) return path;
    const heights = path.map((place, i) => {
      const before = i ? path[i - 1] : start;
      return this.carried(place, Math.hypot(place[0] - before[0], place[2] - before[2]) > fastest);
    });
    const reach = (support.flight.length - 1) / 2;
    const padded = [...Array(reach).fill(start[1]), ...heights, ...Array(reach).fill(heights.at(-1))];
    const flown = heights.map((_, i) =>
      support.flight.reduce((sum, share, k) => sum + share * padded[i + k], 0),
    );
    return path.map(([x, , z], i) => [x, Math.max(heights[i], flown[i]), z]);
  }
}
