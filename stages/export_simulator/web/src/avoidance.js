// No path leads through somebody's body. Counterpart of pipeline/behavior/avoidance.py.

const PERSON_M = 0.12; // radius of a person: of the head, or of legs
const UNKNOWN_REACH_M = 0.28; // from the root to the muzzle of an animal without bones ahead of its root
const HURRY = 1.5; // how much longer a step may be that makes up for a detour
const LEAST_STEP_M = 0.04;

// The least distance of the root from somebody's middle: that of the foremost bone at rest (+z) and a person's
// radius.
export function clearanceOf(rest) {
  const reach = Math.max(...rest.map((bone) => bone[2][3]));
  return PERSON_M + (reach > 0 ? reach : UNKNOWN_REACH_M);
}

// A path of points [x, y, z] that begins a frame after `start`, led around a person who stands at [x, z]. An
// animal that is nearer than `clearance` already does not come nearer still. clear: moves a point to where the
// animal may be; where that leads to the person it waits.
export function aroundPerson(path, start, person, clearance, clear = (point) => point) {
  const away = ([x, , z]) => Math.hypot(x - person[0], z - person[1]);
  const reach = Math.min(clearance, away(start));
  let [here, before] = [start, start];
  return path.map((target) => {
    const step = Math.max(LEAST_STEP_M, HURRY * Math.hypot(target[0] - before[0], target[2] - before[2]));
    before = target;
    const gap = Math.hypot(target[0] - here[0], target[2] - here[2]);
    const share = gap > step ? step / gap : 1;
    let next = [here[0] + share * (target[0] - here[0]), target[1], here[2] + share * (target[2] - here[2])];
    if (crosses(here, next, person, reach)) {
      next = clear(alongCircle(here, target, step, person, reach));
      if (crosses(here, next, person, reach)) next = [here[0], target[1], here[2]];
    }
    here = next;
    return next;
  });
}

// Whether the way from one point to another comes nearer to the person than `reach`.
function crosses(from, to, person, reach) {
  const [dx, dz] = [to[0] - from[0], to[2] - from[2]];
  const [px, pz] = [person[0] - from[0], person[1] - from[2]];
  const share = Math.min(1, Math.max(0, (px * dx + pz * dz) / Math.max(dx * dx + dz * dz, 1e-12)));
  return Math.hypot(px - share * dx, pz - share * dz) < reach - 1e-9;
}

// The next point around the person, a tangential step further towards the target: on the circle itself, a step
// would cut it.
function alongCircle(here, target, step, person, reach) {
  const angle = Math.atan2(here[2] - person[1], here[0] - person[0]);
  const goalAngle = Math.atan2(target[2] - person[1], target[0] - person[0]);
  const away = Math.hypot(here[0] - person[0], here[2] - person[1]);
  const furthest = Math.atan(step / Math.max(reach, away, 1e-6));
  const whole = Math.atan2(Math.sin(goalAngle - angle), Math.cos(goalAngle - angle));
  const turn = Math.max(-furthest, Math.min(furthest, whole));
  const [radius, next] = [Math.max(reach / Math.cos(turn), away), angle + turn];
  return [person[0] + radius * Math.cos(next), target[1], person[1] + radius * Math.sin(next)];
}
