"""Artifacts of another version are refused with ART-007, without a traceback or a misinterpretation."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from pipeline.behavior import model as behavior
from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.model import BehaviorNets
from pipeline.core.errors import InputError
from pipeline.data import glb
from pipeline.environments.world import AnimalWorld
from pipeline.longterm.bodies import PoseSpace
from pipeline.longterm.config import LongTermSizes
from pipeline.longterm.contacts import ContactVertices
from pipeline.longterm.motion_synthesis import LongTerm, MotionPrior
from pipeline.longterm.networks import PoseNet, RouteNet, StaticBody
from pipeline.workflow import artifact
from stages.export import reading
from stages.simulate import takes
from stages.simulate.config import Config
from stages.simulate.inputs import Inputs
from stages.train_behavior.export import write_contract
from tests.pipeline.behavior.wandering import ARCHITECTURE, REST, scaling
from tests.pipeline.environments.small_world import QUICK, write_build
from tests.stages.export import moving_tube


@pytest.fixture
def build(tmp_path):
    """Model, data and glTF of an animal, as this version writes them."""
    write_build(tmp_path)
    (tmp_path / "simulator").mkdir()
    data, _ = moving_tube.model()
    (tmp_path / "simulator/agent.glb").write_bytes(data)
    mesh, _, _ = glb.read_skinned(data)
    (tmp_path / "simulator/scene.glb").write_bytes(glb.static(mesh, "scene"))
    about = {"agent": {"skinning_residual_mm": {}}}
    (tmp_path / "simulator/simulator.json").write_text(json.dumps(about))
    return tmp_path


def with_json(path, *keys, value=None):
    """Set the entry at ``keys`` of a JSON file; None removes it."""
    document = json.loads(path.read_text())
    inner = document
    for key in keys[:-1]:
        inner = inner[key]
    if value is None:
        del inner[keys[-1]]
    else:
        inner[keys[-1]] = value
    path.write_text(json.dumps(document))


CHANGES = {
    "different exponent": (("path_encoding", "velocity_power"), 0.9),
    "different grid": (("grid", "cell_m"), 0.3),
    "different rate": (("rate_hz",), 30),
    "different channel order": (("channels", "goal"), ["z", "y", "x"]),
    "different schedule": (("schedule", "alpha_bar"), [1.0, 0.5]),
    "unknown setting": (("architecture", "memory"), 4),
    "missing setting": (("architecture", "unet_width"), None),
    "missing scale": (("scaling", "goal_std"), None),
    "missing table": (("path_encoding",), None),
}


@pytest.mark.parametrize("change", CHANGES)
def test_behavior_model_with_different_contract_is_refused(build, change):
    keys, value = CHANGES[change]
    with_json(build / "behavior/behavior.json", *keys, value=value)
    for load in (
        lambda: behavior.load(build / "behavior"),
        lambda: AnimalWorld.load(build, QUICK),
        lambda: takes.of_behavior(
            Inputs(build / "behavior_data", build / "behavior"), Config(seconds=0.1), "cpu"
        ),
    ):
        with pytest.raises(InputError, match="ART-007") as raised:
            load()
        assert keys[0] in str(raised.value) or keys[-1] in str(raised.value)
        assert "make" in raised.value.remedy


def test_missing_weights_are_refused(build):
    path = build / "behavior/behavior.safetensors"
    weights = load_file(path)
    save_file(dict(list(weights.items())[1:]), path)
    with pytest.raises(InputError, match="ART-007"):
        behavior.load(build / "behavior")
    path.unlink()
    with pytest.raises(InputError, match="ART-007"):
        behavior.load(build / "behavior")


def test_sampling_settings_are_not_part_of_the_contract(build):
    with_json(build / "behavior/behavior.json", "sampling", "goal_steps", value=3)
    behavior.load(build / "behavior")


LONG_TERM_KEYS = (
    "units", "up", "rate_hz", "frames", "bones", "sizes", "sees_scene", "motion_prior", "contact_vertices",
    "foot_of_contact_vertex",
)  # fmt: skip


def test_long_term_model_with_missing_key_is_refused(tmp_path):
    sizes = LongTermSizes(pose=3, latent=2, scene=4, hidden=4, width=4)
    nets = StaticBody(sizes), RouteNet(sizes), PoseNet(sizes)
    contacts = ContactVertices(np.array([4, 7]), np.array([0, 1]))
    made = LongTerm(sizes, PoseSpace(REST, 3), contacts, MotionPrior(0.2, 0.9, 0.1, 0.1), *nets)
    made.save(tmp_path)
    before, written = torch.random.get_rng_state(), (tmp_path / "longterm.json").read_text()
    assert LongTerm.load(tmp_path).contacts.vertices.tolist() == [4, 7]
    assert torch.equal(torch.random.get_rng_state(), before), "the random state is the program's"
    assert set(json.loads(written)) == set(LONG_TERM_KEYS)
    for key in LONG_TERM_KEYS:
        (tmp_path / "longterm.json").write_text(written)
        with_json(tmp_path / "longterm.json", key)
        with pytest.raises(InputError, match=f"ART-007.*{key}"):
            LongTerm.load(tmp_path)


@pytest.mark.parametrize("name", ["agent.glb", "scene.glb", "simulator.json"])
@pytest.mark.parametrize("content", [b"", b"{}", b"glTF" + bytes(40), None])
def test_invalid_simulator_files_are_refused(build, name, content):
    path = build / "simulator" / name
    if content is None:
        path.unlink()
    else:
        path.write_bytes(content)
    with pytest.raises(InputError, match="ART-007") as raised:
        reading.agent(build / "simulator", None, 30.0)
        reading.room(build / "simulator")
    assert "make" in raised.value.remedy


def test_mesh_without_skin_is_refused(build):
    path = build / "simulator/agent.glb"
    path.write_bytes((build / "simulator/scene.glb").read_bytes())  # a mesh without a skin
    with pytest.raises(InputError, match="ART-007"):
        reading.agent(build / "simulator", None, 30.0)
    inputs = Inputs(build / "behavior_data", build / "behavior", build / "simulator")
    with pytest.raises(InputError, match="ART-007"):
        takes.live(inputs, Config(), "cpu")


def test_artifact_of_another_stage_version_is_refused(build, monkeypatch):
    """Artifacts whose format is unchanged but whose meaning differs are detected by the version of their stage."""
    with artifact.create(build / "made", stage="train_behavior", config={}, inputs={}) as folder:
        (folder / "a.txt").write_text("a")
    assert artifact.opened(build / "made", "behavior").version == artifact.version_of("train_behavior")
    with_json(build / "made/manifest.json", "version", value=99)
    with pytest.raises(InputError, match=re.compile("ART-007.*version 99.*make", re.DOTALL)):
        artifact.opened(build / "made", "behavior")
    (build / "behavior/manifest.json").write_bytes((build / "made/manifest.json").read_bytes())
    with pytest.raises(InputError, match="ART-007"):
        AnimalWorld.load(build, QUICK)


def test_models_with_other_values_are_read(build):
    again = replace(scaling(), goal_std=np.array([0.2, 0.2, 0.2]))
    write_contract(build / "behavior", BehaviorNets(ARCHITECTURE), ARCHITECTURE, again, Schedule(), REST)
    np.testing.assert_array_equal(behavior.load(build / "behavior")[2].goal_std, again.goal_std)
    AnimalWorld.load(build, QUICK)
