"""Assembly of the page is robust to special characters in names and addresses."""

from stages.export_simulator import page, writing
from tests.stages.export_simulator.test_support_twins import SOURCES, needs_node, run_node

READ = f"""
import {{ readState }} from '{SOURCES}/state.js';
const {{ keys }} = JSON.parse(await new Response(process.stdin).text());
const contract = {{ controls: {{ interactivity: {{ least: 0, most: 1, default: 1 }},
  samples: {{ choices: [1], default: 1 }}, steps: {{ choices: [4], default: 4 }} }}, scene: {{ bounds_m: [[-2, 0, -1], [2, 3, 1]] }} }};
const answers = keys.map((key) => {{
  const {{ state, ignored }} = readState(contract, () => [], `#${{key}}=1&seed=3`);
  return Number(ignored.join() === `${{key}}=1` && state.seed === 3 && !Object.hasOwn(state, key)
    && Object.getPrototypeOf(state) === Object.prototype);
}});
console.log(JSON.stringify(answers));
"""
ASKED = (
    READ.partition("const answers")[0]
    + """
const asked = (key) => readState(contract, () => [], `#${key}`).ignored.length;
console.log(JSON.stringify(keys.map(asked)));
"""
)

REFUSED = (
    READ.partition("const { keys }")[0].replace("readState", "defaults, writeState")
    + """
const { seeds } = JSON.parse(await new Response(process.stdin).text());
const contract = { controls: { interactivity: {}, samples: {}, steps: {} } };
let [written, refusals] = ['', 1];
globalThis.location = { pathname: '/', search: '' };
globalThis.history = {
  replaceState: (state, title, address) => {
    if (refusals-- > 0) throw new Error('SecurityError');
    written += address;
  },
};
for (const seed of seeds.slice(0, 1)) writeState({ ...defaults(contract), seed }, contract);
const first = written;
await new Promise((done) => setTimeout(done, 1500));
const later = written;
writeState({ ...defaults(contract), seed: seeds[1] }, contract);
console.log(JSON.stringify([Number(first === '') + Number(later === '#seed=3'), Number(written.endsWith('#seed=4'))]));
"""
)
FILMED = (
    f"import {{ Film }} from '{SOURCES}/film.js';"
    + """
const { kinds } = JSON.parse(await new Response(process.stdin).text());
const canvas = { captureStream: () => ({ getTracks: () => [] }) };
let number = 0;
class Recorder {
  constructor(stream, { mimeType }) {
    const name = ['first', 'second'][number++];
    Object.assign(this, { stream, mimeType, name });
  }
  start() {}
  stop() {
    setTimeout(() => {
      this.ondataavailable({ data: new Blob([this.name]) });
      this.onstop();
    });
  }
}
globalThis.MediaRecorder = Recorder;
const found = [];
for (const kind of kinds) {
  Recorder.isTypeSupported = (asked) => asked === kind;
  number = 0;
  const film = new Film(canvas);
  film.start();
  const stopped = film.stop();
  film.start();
  const { blob, ending } = await stopped;
  found.push([ending, blob.type, await blob.text()]);
}
console.log(JSON.stringify(found));
"""
)
NAMED = (
    f"import {{ fileStem }} from '{SOURCES}/take.js';"
    + """
const { names } = JSON.parse(await new Response(process.stdin).text());
console.log(JSON.stringify(names.map(fileStem)));
"""
)

VISITED = (
    f"import {{ Stops }} from '{SOURCES}/stops.js';"
    + """
const { visits } = JSON.parse(await new Response(process.stdin).text());
const points = [[1, 0, 0.5], [0, 0], [1, 0, 0.5]];
const stops = new Stops(points, null, (point) => 0.2 + (point[2] ?? 0));
const reached = visits.map((place, i) => {
  if (i === 4) stops.clear(points[2], [1.5, 0.2, 0]);
  return Number(stops.visit(place));
});
console.log(JSON.stringify(reached));
"""
)


def test_markup_in_names_is_escaped():
    marks = "@@ASSETS@@ @@SCRIPT@@ @@NAME@@"
    contract, assets = {"name": marks}, {"room": page.Asset(b"room")}
    text = page.page(contract, assets, page.compressed(contract, assets))
    assert f"<h1>{marks}</h1>" in text
    assert text.count('id="asset-room"') == 1


def test_page_of_two_animals_may_be_bigger():
    sizes_mb = {"program": 6.0, "networks": 20.0}
    assert [check.status for check in writing.page_checks(sizes_mb)] == ["warn", "ok", "ok"]
    whole, *parts = writing.page_checks(sizes_mb, animals=2)
    assert (whole.value, whole.warn, whole.status) == (26.0, 30.0, "ok")
    assert [(check.name, check.value) for check in parts] == [
        ("of the page: program", 6.0),
        ("of the page: networks", 20.0),
    ]


@needs_node
def test_address_changes_only_known_settings():
    """Inherited properties of JavaScript objects are no settings."""
    keys = ["constructor", "toString", "valueOf", "__proto__", "hasOwnProperty", "nothing"]
    assert run_node(READ, keys=keys).tolist() == [1] * len(keys)


@needs_node
def test_positions_outside_the_room_are_ignored():
    places = [
        "aim=1,0.5",
        "aim=1,0.5,0.4;-2,-1",
        "route=0,0;1,1",
        "aim=99,99",
        "aim=1,0.5;0,-7",
        "route=0,0;3,0",
        "at=1.5,0.5",
        "at=99,99",
        "at=1,0.5;0,0",
    ]
    assert run_node(ASKED, keys=places).tolist() == [0, 0, 0, 1, 1, 1, 0, 1, 1]


@needs_node
def test_refused_addresses_are_written_later():
    """Browsers refuse more than some hundred changes of the address in some seconds."""
    assert run_node(REFUSED, seeds=[3, 4]).tolist() == [2, 1], "attempts; of them with the last seed written"


@needs_node
def test_films_are_named_after_what_the_browser_records():
    """Safari records MP4. A film that is stopped is whole although the next one has begun."""
    assert run_node(FILMED, kinds=["video/webm", "video/mp4"]).tolist() == [
        ["webm", "video/webm", "first"],
        ["mp4", "video/mp4", "first"],
    ]


@needs_node
def test_files_are_named_after_animals_of_any_script():
    names = ["M\u00e4uschen", "\u732b", "a/b: c", "luna-2"]
    assert run_node(NAMED, names=names).tolist() == ["M\u00e4uschen", "\u732b", "a_b_c", "luna-2"]


@needs_node
def test_goals_on_furniture_are_not_reached_from_beneath():
    """Goals are on a table 0.5 m above the floor, on the floor, and again on the table, beside which a plan ends."""
    visits = [[1, 0.2, 0], [1, 0.6, 0], [0, 0.2, 0], [1, 0.2, 0], [1.5, 0.2, 0.1]]
    assert run_node(VISITED, visits=visits).tolist() == [0, 1, 1, 0, 1]
