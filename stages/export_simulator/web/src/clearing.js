// Where the animal's root may be. Counterpart of Scenes.inside_solid and Scenes.out_of_solid in
// pipeline/behavior/scenes.py.

const WITHIN = 0.01; // how far inside an allowed voxel a point is put, in edges of the voxel

export class FreeSpace {
  // volume: simulator.json's, with shape, origin and voxel_m; allowed: a byte per voxel.
  constructor(volume, allowed) {
    Object.assign(this, { volume, allowed });
  }

  // Whether the root may be at a point of the world; nowhere outside the volume.
  allows(point) {
    const {
      shape: [, vx, vy, vz],
      origin,
      voxel_m: voxel,
    } = this.volume;
    const [a, b, c] = [0, 1, 2].map((axis) => Math.floor((point[axis] - origin[axis]) / voxel));
    return (
      a >= 0 && b >= 0 && c >= 0 && a < vx && b < vy && c < vz && this.allowed[(a * vy + b) * vz + c] > 0
    );
  }

  // A point of the world, moved to the nearest voxel where the root may be; the point itself where it may be
  // there, or nowhere.
  cleared(point) {
    if (this.allows(point)) return point;
    const {
      shape: [, vx, vy, vz],
      origin,
      voxel_m: voxel,
    } = this.volume;
    this.nearest ??= nearestAllowed(this.allowed, [vx, vy, vz]);
    const clamped = [vx, vy, vz].map((count, axis) =>
      Math.min(count - 1, Math.max(0, Math.floor((point[axis] - origin[axis]) / voxel))),
    );
    const target = this.nearest[(clamped[0] * vy + clamped[1]) * vz + clamped[2]];
    if (target < 0) return point;
    return [Math.floor(target / (vy * vz)), Math.floor(target / vz) % vy, target % vz].map((index, axis) => {
      const low = origin[axis] + (index + WITHIN) * voxel;
      return Math.min(low + (1 - 2 * WITHIN) * voxel, Math.max(low, point[axis]));
    });
  }
}

// For each voxel the number of the nearest allowed one, axis after axis; -1 throughout where none is allowed.
function nearestAllowed(allowed, [nx, ny, nz]) {
  const target = Int32Array.from(allowed, (mark, i) => (mark > 0 ? i : -1));
  const square = Float64Array.from(allowed, (mark) => (mark > 0 ? 0 : Infinity));
  for (const [stride, length] of [
    [1, nz],
    [nz, ny],
    [ny * nz, nx],
  ]) {
    const [from, known] = [target.slice(), square.slice()];
    for (let i = 0; i < target.length; i++) {
      const here = Math.floor(i / stride) % length;
      for (let there = 0; there < length; there++) {
        const at = i + (there - here) * stride;
        const far = known[at] + (there - here) ** 2;
        if (far < square[i]) [square[i], target[i]] = [far, from[at]];
      }
    }
  }
  return target;
}
