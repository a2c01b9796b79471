// The settings of the page, mirrored in the address after '#', so that a behavior can be linked.

export const SPEEDS = [1, 0.3]; // seconds of the animal's life a second
export const VIEWS = ['room', 'animal', 'you'];
export const AWAY = 'off'; // what an animal does that is switched off
const LARGEST_SEED = 999999;
const AGAIN_MS = 1000; // after which an address is written that the browser refused
const SWITCHES = ['scene', 'observer', 'companions', 'past', 'goal', 'goals', 'path', 'outline'];

// Every setting with its default; those of the behavior model come with the contract.
export function defaults({ controls: { interactivity, samples, steps }, animals }) {
  return {
    interactivity: interactivity.default,
    guidance: '',
    scene: 1,
    observer: 1,
    companions: 1,
    past: 1,
    goal: 1,
    samples: samples.default,
    steps: steps.default,
    seed: 0,
    replay: '',
    speed: 1,
    aim: '',
    route: '',
    at: '',
    view: 'room',
    goals: 1,
    path: 1,
    outline: 0,
    animal: animals?.[0].name ?? '',
    does: '',
    moved: '',
  };
}

// The settings of an address, and what of it was ignored: {state, ignored: ['key=value', ...]}. clipsOf: from the
// name of an animal to its clips.
export function readState(contract, clipsOf, hash = location.hash) {
  const state = defaults(contract);
  const address = new URLSearchParams(hash.slice(1));
  const clips = clipsOf(address.get('animal'));
  const { interactivity, samples, steps } = contract.controls;
  const number = (least, most) => (text) =>
    text !== '' && Number(text) >= least && Number(text) <= most ? Number(text) : null;
  const among = (values) => (text) => values.find((value) => String(value) === text) ?? null;
  const [low, high] = contract.scene.bounds_m;
  const within = ([x, z]) => x >= low[0] && x <= high[0] && z >= low[2] && z <= high[2];
  const places = (text) => (readPlaces(text).length && readPlaces(text).every(within) ? text : null);
  const read = {
    interactivity: number(interactivity.least, interactivity.most),
    guidance: (text) => (readScales(text, contract) ? text : null),
    samples: among(samples.choices),
    steps: among(steps.choices),
    seed: (text) => (/^\d+$/.test(text) ? number(0, LARGEST_SEED)(text) : null),
    speed: among(SPEEDS),
    view: among(VIEWS),
    replay: (text) => (clips.some((clip) => clip.name === text) ? text : null),
    aim: places,
    route: places,
    at: (text) => (readPlaces(text).length === 1 ? places(text) : null),
    animal: among((contract.animals ?? []).map(({ name }) => name)),
    does: (text) => (readDoings(text, contract) ? text : null),
    moved: (text) => (readMoves(text).length ? text : null),
    ...Object.fromEntries(SWITCHES.map((key) => [key, among([0, 1])])),
  };
  const ignored = [];
  for (const [key, text] of address) {
    const value = Object.hasOwn(read, key) ? (read[key](text) ?? null) : null;
    if (value === null) ignored.push(`${key}=${text}`);
    else state[key] = value;
  }
  return { state, ignored };
}

export function writeState(state, contract) {
  const usual = defaults(contract);
  const changed = Object.entries(state).filter(([key, value]) => key in usual && value !== usual[key]);
  const hash = new URLSearchParams(changed.map(([key, value]) => [key, String(value)])).toString();
  clearTimeout(writeState.again);
  try {
    history.replaceState(null, '', hash ? `#${hash}` : location.pathname + location.search);
  } catch {
    // Safari and Firefox allow only so many changes in some seconds, as a dragged slider makes
    writeState.again = setTimeout(() => writeState(state, contract), AGAIN_MS);
  }
}

// 'name:off,name:clip,...', what animals do instead of living, to an object; null where it is something else.
export function readDoings(text, { animals = [] }) {
  const found = text ? text.split(',').map((each) => each.split(':')) : [];
  const sound = found.every(([name, does]) => {
    const animal = animals.find((each) => each.name === name);
    return animal && (does === AWAY || animal.clips.some((clip) => clip.name === does));
  });
  return sound ? Object.fromEntries(found) : null;
}

// 'name:scale,...', how strongly others react to animals, to the scales of all animals; null where it is something
// else.
export function readScales(text, { controls: { interactivity }, animals = [] }) {
  const found = text ? text.split(',').map((each) => each.split(':')) : [];
  const { least, most, companions } = interactivity;
  const sound = found.every(
    ([name, scale]) =>
      animals.some((each) => each.name === name) && scale && Number(scale) >= least && Number(scale) <= most,
  );
  const usual = animals.map(({ name }) => [name, companions]);
  const read = found.map(([name, scale]) => [name, Number(scale)]);
  return sound ? Object.fromEntries([...usual, ...read]) : null;
}

export const scalesText = (scales, { controls: { interactivity } }) =>
  Object.entries(scales)
    .filter(([, scale]) => scale !== interactivity.companions)
    .map((each) => each.join(':'))
    .join(',');

export const doingsText = (doings) =>
  Object.entries(doings)
    .filter(([, does]) => does)
    .map((each) => each.join(':'))
    .join(',');

// 'x,y,z,dx,dz;...', furniture by a place in it and how far it was moved, to numbers in meters; none where it is
// something else.
export function readMoves(text) {
  const moves = text.split(';').map((move) => move.split(',').map(Number));
  return moves.every((move) => move.length === 5 && move.every(Number.isFinite)) ? moves : [];
}

// 'x,z;x,z;...' in meters to a list of points; none where it is something else.
export function readPlaces(text) {
  const points = text.split(';').map(readPoint);
  return points.every(Boolean) ? points : [];
}

// 'x,z' in meters, or 'x,z,up' for what is above the floor, to numbers; or null.
export function readPoint(text) {
  const point = text.split(',').map(Number);
  return text && (point.length === 2 || point.length === 3) && point.every(Number.isFinite) ? point : null;
}
