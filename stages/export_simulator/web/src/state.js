// The settings of the page, mirrored in the address after '#', so that a behaviour can be linked.

const DEFAULTS = {
  interactivity: 1, scene: 1, observer: 1, past: 1, goal: 1,
  samples: 4, steps: 10, seed: 0, replay: '', speed: 1,
  aim: '', route: '', at: '', view: 'room', goals: 1, path: 1,
};

export const SPEEDS = [1, 0.3]; // seconds of the animal's life a second
export const VIEWS = ['room', 'animal', 'you'];

export function readState() {
  const state = { ...DEFAULTS };
  for (const [key, value] of new URLSearchParams(location.hash.slice(1))) {
    if (!(key in DEFAULTS)) continue;
    if (typeof DEFAULTS[key] === 'string') state[key] = value;
    else if (Number.isFinite(Number(value))) state[key] = Number(value);
  }
  state.interactivity = Math.min(1, Math.max(0, state.interactivity));
  state.samples = [1, 4, 16].includes(state.samples) ? state.samples : DEFAULTS.samples;
  state.steps = [10, 50].includes(state.steps) ? state.steps : DEFAULTS.steps;
  state.speed = SPEEDS.includes(state.speed) ? state.speed : DEFAULTS.speed;
  state.view = VIEWS.includes(state.view) ? state.view : DEFAULTS.view;
  state.seed = Math.min(999999, Math.max(0, Math.round(state.seed)));
  return state;
}

export function writeState(state) {
  const changed = Object.entries(state).filter(([key, value]) => key in DEFAULTS && value !== DEFAULTS[key]);
  const hash = new URLSearchParams(changed.map(([key, value]) => [key, String(value)])).toString();
  history.replaceState(null, '', hash ? `#${hash}` : location.pathname + location.search);
}

// 'x,z;x,z;...' in metres to a list of points; none where it is something else.
export function readPlaces(text) {
  const points = text.split(';').map(readPoint);
  return points.every(Boolean) ? points : [];
}

// 'x,z' in metres to two numbers, or null.
export function readPoint(text) {
  const point = text.split(',').map(Number);
  return text && point.length === 2 && point.every(Number.isFinite) ? point : null;
}
