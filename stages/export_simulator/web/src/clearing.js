// Where the nearest voxel is that the animal's root may be in. Counterpart of Scenes.cleared in
// pipeline/behavior/scenes.py.

// For each voxel the number of the nearest allowed one, axis after axis; -1 throughout where none is allowed.
export function nearestAllowed(allowed, [nx, ny, nz]) {
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
