// Goals, and paths as strides, in the channels that are diffused. Counterpart of
// pipeline/behavior/path_encoding.py, whose constants come with the contract as `path_encoding`.

// The same direction, the length raised to a power.
function withPoweredLength(way, power, minSquared) {
  const squared = way.reduce((sum, value) => sum + value * value, 0);
  const factor = Math.max(squared, minSquared) ** ((power - 1) / 2);
  return way.map((value) => value * factor);
}

// Goals in meters as they are diffused, and back.
export const scaledGoal = (goal, deviation, encoding) =>
  withPoweredLength(goal, encoding.goal_length_power, encoding.min_squared_m2).map(
    (value, axis) => value / deviation[axis],
  );
export const goalFrom = (scaled, deviation, encoding) =>
  withPoweredLength(
    Array.from(scaled, (value, axis) => value * deviation[axis]),
    1 / encoding.goal_length_power,
    encoding.min_squared_m2,
  );

// The places that scaled strides [numbers, frames] lead to, one after another, from `start` on.
export function pathFrom(scaled, frames, deviation, start, rate, encoding) {
  let place = start;
  return Array.from({ length: frames }, (_, i) => {
    const deviationHere = deviation[i] ?? deviation[0]; // of each frame on its own, or of all alike
    const stays = scaled[3 * frames + i] > 0 ? 1 : encoding.rest_damping;
    const root = [0, 1, 2].map((axis) => scaled[axis * frames + i] * deviationHere[axis] * stays);
    place = withPoweredLength(root, 1 / encoding.velocity_power, encoding.min_squared_m2).map(
      (value, axis) => place[axis] + value / rate,
    );
    return place;
  });
}

// Scaled strides [numbers, frames] that lead along another path, as far as they move.
export function velocityChannelsAlong(scaled, frames, deviation, start, path, rate, encoding) {
  const out = Float32Array.from(scaled);
  path.forEach((place, i) => {
    const [deviationHere, before] = [deviation[i] ?? deviation[0], i ? path[i - 1] : start];
    const root = withPoweredLength(
      place.map((value, axis) => (value - before[axis]) * rate),
      encoding.velocity_power,
      encoding.min_squared_m2,
    );
    const stays = scaled[3 * frames + i] > 0 ? 1 : encoding.rest_damping;
    for (const axis of [0, 1, 2]) out[axis * frames + i] = root[axis] / stays / deviationHere[axis];
  });
  return out;
}

// Bend a path so that it ends at its goal (pull 1), where it likes (0), or between; no stride by more than
// its length.
export function snappedToGoal(path, start, goal, pull) {
  let way = 0;
  const gone = path.map((place, i) => (way += distance(place, i ? path[i - 1] : start)));
  const missing = goal.map((value, axis) => value - path.at(-1)[axis]);
  const longest = Math.max(Math.hypot(...missing), way, Number.EPSILON);
  return path.map((place, i) =>
    place.map((value, axis) => value + (missing[axis] * pull * gone[i]) / longest),
  );
}

export const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
