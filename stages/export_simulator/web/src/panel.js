// The controls: they read and write the state and call back; they know nothing of the room.

import { AWAY, SPEEDS, readDoings, readScales } from './state.js';

const at = (id) => document.getElementById(id);
const touch = matchMedia('(pointer: coarse)').matches;
const HOW = at(touch ? 'help-touch' : 'help-mouse').innerHTML;
at('help').innerHTML = HOW;
const HELP_MS = 12000; // the help stays this long at first
const TOOLS = {
  pen: 'Draw on the floor with one stroke; it walks there.',
  pins: 'Click one place after the other; it visits them in this order.',
  move: touch
    ? 'Drag a piece of furniture to where it shall stand.'
    : 'Drag a piece of furniture, or take one up with Enter, move it with the arrows, and set it down with Enter.',
};

export function buildPanel(state, contract, on) {
  const { controls } = contract;
  const sync = [];
  const change = (key, value) => {
    state[key] = value;
    sync.forEach((update) => update());
    on.change(key);
  };

  sync.push(interactivity(state, contract, change, on.guide));

  for (const box of document.querySelectorAll('[data-sense]')) toggle(box, box.dataset.sense);
  for (const box of document.querySelectorAll('[data-layer]')) toggle(box, box.dataset.layer);
  function toggle(box, key) {
    box.addEventListener('change', () => change(key, box.checked ? 1 : 0));
    sync.push(() => {
      box.checked = Boolean(state[key]);
    });
  }

  Object.assign(at('interactivity'), { min: controls.interactivity.least, max: controls.interactivity.most });
  choices('samples', controls.samples.choices);
  choices('steps', controls.steps.choices);
  function choices(key, values) {
    for (const value of values) {
      const button = Object.assign(document.createElement('button'), {
        textContent: value,
        title: `${value} ${key}`,
        ariaLabel: `${value} ${key === 'samples' ? 'goals' : key}`,
      });
      button.addEventListener('click', () => change(key, value));
      at(key).append(button);
      sync.push(() => button.setAttribute('aria-pressed', state[key] === value));
    }
  }

  at('seed').addEventListener('change', (event) =>
    change('seed', Math.min(999999, Math.max(0, Math.round(Number(event.target.value) || 0)))),
  );
  at('seed-next').addEventListener('click', () => change('seed', (state.seed + 1) % 1000000));
  sync.push(() => {
    at('seed').value = state.seed;
  });

  at('open').addEventListener('click', () => at('open-file').click());
  at('open-file').addEventListener('change', (event) => {
    if (event.target.files.length) on.open(event.target.files[0]);
    event.target.value = '';
  });
  addEventListener('dragover', (event) => event.preventDefault());
  addEventListener('drop', (event) => {
    event.preventDefault();
    if (event.dataTransfer.files.length) on.open(event.dataTransfer.files[0]);
  });
  at('replay').addEventListener('change', (event) => change('replay', event.target.value));
  sync.push(() => {
    at('replay').value = state.replay;
  });

  for (const button of document.querySelectorAll('[data-view]')) {
    button.addEventListener('click', () => change('view', button.dataset.view));
    sync.push(() => button.setAttribute('aria-pressed', state.view === button.dataset.view));
  }

  for (const name of ['csv', 'glb', 'film', 'toml', 'link']) at(name).addEventListener('click', on[name]);
  for (const tool of Object.keys(TOOLS)) at(tool).addEventListener('click', () => on.hold(tool));
  at('play').addEventListener('click', on.play);
  at('reset').addEventListener('click', on.reset);
  at('free').addEventListener('click', on.free);
  at('undo').addEventListener('click', on.undo);
  at('restore').addEventListener('click', on.restore);
  at('how').addEventListener('click', howTo);
  at('call').addEventListener('click', on.call);
  at('headset').addEventListener('click', on.headset);
  at('slow').addEventListener('click', () =>
    change(
      'speed',
      SPEEDS.find((speed) => speed !== state.speed),
    ),
  );
  sync.push(() => at('slow').setAttribute('aria-pressed', state.speed !== 1));

  if (contract.animals) sync.push(...residents(state, contract, change, on.employ));

  const fold = () =>
    at('panel-toggle').setAttribute('aria-expanded', !at('panel').classList.toggle('closed'));
  at('panel-toggle').addEventListener('click', fold);
  if (matchMedia('(max-width: 720px), (max-height: 620px)').matches) fold(); // as in style.css
  sync.forEach((update) => update());
  return { refresh: () => sync.forEach((update) => update()) };
}

// How strongly animals react to the visitor or, in a home of several, to one of them. Returns what refreshes it.
function interactivity(state, contract, change, guide) {
  const { animals = [] } = contract;
  at('whom').hidden = animals.length < 2;
  for (const { name } of animals)
    at('whom').append(
      Object.assign(document.createElement('option'), { value: name, textContent: `to ${name}` }),
    );
  const show = () => {
    const name = at('whom').value;
    const scale = name ? readScales(state.guidance, contract)[name] : state.interactivity;
    at('interactivity').value = scale;
    at('interactivity-value').textContent = scale.toFixed(2);
    for (const place of document.querySelectorAll('.whom')) place.textContent = name || 'you';
  };
  at('whom').addEventListener('change', show);
  at('interactivity').addEventListener('input', ({ target: { value } }) =>
    at('whom').value ? guide(at('whom').value, Number(value)) : change('interactivity', Number(value)),
  );
  return show;
}

// The animals of the home by name: which is selected, and what each does. Returns what refreshes the list.
function residents(state, contract, change, employ) {
  at('animals').hidden = at('company').hidden = false;
  document.querySelector('.key.animal').replaceWith(
    ...contract.animals.map(({ name }, i) =>
      Object.assign(document.createElement('span'), {
        className: `key animal a${i % 4}`,
        textContent: name,
      }),
    ),
  );
  return contract.animals.map(({ name, clips }) => {
    const radio = Object.assign(document.createElement('input'), {
      type: 'radio',
      name: 'animal',
      value: name,
    });
    const label = document.createElement('label');
    label.append(radio, Object.assign(document.createElement('span'), { textContent: name }));
    const does = Object.assign(document.createElement('select'), { ariaLabel: `What ${name} does` });
    const doings = [
      ['', 'lives'],
      [AWAY, 'is away'],
      ...clips.map((clip) => [clip.name, `replays ${clip.label}`]),
    ];
    for (const [value, textContent] of doings)
      does.append(Object.assign(document.createElement('option'), { value, textContent }));
    const row = Object.assign(document.createElement('div'), { className: 'resident' });
    row.append(label, does);
    at('residents').append(row);
    radio.addEventListener('change', () => change('animal', name));
    does.addEventListener('change', () => employ(name, does.value));
    return () => {
      radio.checked = state.animal === name;
      does.value = readDoings(state.does, contract)?.[name] ?? '';
    };
  });
}

// What can be replayed beside the selected animal: its own clips, and takes that were opened for it.
export function showClips(clips, chosen) {
  const option = ({ name: value, label: textContent = value }) =>
    Object.assign(document.createElement('option'), { value, textContent });
  at('replay').replaceChildren(option({ name: '', label: 'none' }), ...clips.map(option));
  at('replay').value = chosen;
}

export function showPlaying(playing) {
  at('play').textContent = playing ? 'pause' : 'go on';
}

// Whether there is a command that can be taken back, and how many goals a journey has that can be kept.
export function showCommands(any, goals) {
  at('free').hidden = !any;
  at('toml').hidden = goals === 0;
}

export function showTool(held) {
  for (const tool of Object.keys(TOOLS)) at(tool).setAttribute('aria-pressed', tool === held);
  at('view').classList.toggle('drawing', Boolean(held));
  help(TOOLS[held] ?? '');
  if (held === 'move') at('view').focus(); // arrows and Enter are for the furniture
}

// Whether furniture has been moved that can be put back.
export function showMoved(any) {
  at('undo').hidden = at('restore').hidden = !any;
}

export function showFilm(running, possible) {
  at('film').hidden = !possible;
  at('film').textContent = running ? 'stop filming' : 'film';
  at('film').setAttribute('aria-pressed', running);
}

// A line above the buttons, for as long as it matters.
export function help(text, seconds = 0) {
  at('help').classList.toggle('gone', !text);
  if (text) at('help').textContent = text;
  at('help').classList.toggle('asked', Boolean(text));
  clearTimeout(help.timer);
  if (seconds) help.timer = setTimeout(() => at('help').classList.add('gone'), 1000 * seconds);
}

// A sentence for those who hear the page; the same one again is spoken again.
export function say(text) {
  at('spoken').textContent = at('spoken').textContent === text ? `${text}\u00a0` : text;
}

export function showHeadset(possible) {
  at('headset').hidden = !possible;
}

// How to use the page: shown at first for a while, then when it is asked for.
export function howTo() {
  const box = at('help');
  const shown = box.classList.contains('asked') && box.innerHTML === HOW && !box.classList.contains('gone');
  clearTimeout(help.timer);
  box.innerHTML = HOW;
  box.classList.add('asked');
  box.classList.toggle('gone', shown);
}

export async function copyLink() {
  try {
    await navigator.clipboard.writeText(location.href);
    help('The address of this behavior is copied.', 4);
  } catch {
    help("The address of this behavior stands in the browser's address line.", 6);
  }
}

// What a visitor should know of this scene, beneath the name.
export function warn(text) {
  at('warning').textContent = text;
  at('warning').hidden = false;
}

export function status(text) {
  at('status').textContent = text;
}

export function progress(share, text) {
  at('splash-bar').value = share;
  at('splash-text').textContent = text;
}

export function ready() {
  at('splash').classList.add('gone');
  help.timer = setTimeout(() => at('help').classList.add('gone'), HELP_MS);
}

export { sorry } from './sorry.js';
