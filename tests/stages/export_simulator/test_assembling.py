"""The page is put together as it is meant, whatever the animal is called and the address says."""

from stages.export_simulator import page
from tests.stages.export_simulator.test_support_twins import SOURCES, asked_of_node, needs_node

READ = f"""
import {{ readState }} from '{SOURCES}/state.js';
const {{ keys }} = JSON.parse(await new Response(process.stdin).text());
const contract = {{ controls: {{ interactivity: {{ least: 0, most: 1, default: 1 }},
  samples: {{ choices: [1], default: 1 }}, steps: {{ choices: [4], default: 4 }} }} }};
const answers = keys.map((key) => {{
  const {{ state, ignored }} = readState(contract, [], `#${{key}}=1&seed=3`);
  return Number(ignored.join() === `${{key}}=1` && state.seed === 3 && !Object.hasOwn(state, key)
    && Object.getPrototypeOf(state) === Object.prototype);
}});
console.log(JSON.stringify(answers));
"""


def test_a_name_that_is_a_mark_stays_a_name():
    marks = "@@ASSETS@@ @@SCRIPT@@ @@NAME@@"
    text = page.page(contract={"name": marks}, assets={"room": page.Asset(b"room")})
    assert f"<h1>{marks}</h1>" in text
    assert text.count('id="asset-room"') == 1


@needs_node
def test_an_address_sets_only_what_is_a_setting():
    """What every object of JavaScript has by birth is no setting."""
    keys = ["constructor", "toString", "valueOf", "__proto__", "hasOwnProperty", "nothing"]
    assert asked_of_node(READ, keys=keys).tolist() == [1] * len(keys)
