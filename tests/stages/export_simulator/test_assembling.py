"""Assembly of the page is robust to special characters in names and addresses."""

from stages.export_simulator import page, writing
from tests.stages.export_simulator.test_support_twins import SOURCES, needs_node, run_node

READ = f"""
import {{ readState }} from '{SOURCES}/state.js';
const {{ keys }} = JSON.parse(await new Response(process.stdin).text());
const contract = {{ controls: {{ interactivity: {{ least: 0, most: 1, default: 1 }},
  samples: {{ choices: [1], default: 1 }}, steps: {{ choices: [4], default: 4 }} }}, scene: {{ bounds_m: [[-2, 0, -1], [2, 3, 1]] }} }};
const answers = keys.map((key) => {{
  const {{ state, ignored }} = readState(contract, [], `#${{key}}=1&seed=3`);
  return Number(ignored.join() === `${{key}}=1` && state.seed === 3 && !Object.hasOwn(state, key)
    && Object.getPrototypeOf(state) === Object.prototype);
}});
console.log(JSON.stringify(answers));
"""
ASKED = (
    READ.partition("const answers")[0]
    + """
const asked = (key) => readState(contract, [], `#${key}`).ignored.length;
console.log(JSON.stringify(keys.map(asked)));
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
    ]
    assert run_node(ASKED, keys=places).tolist() == [0, 0, 0, 1, 1, 1]
