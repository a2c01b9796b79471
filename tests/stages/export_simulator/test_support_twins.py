"""The page puts paths on what carries the animal exactly as Python does."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pipeline.models.perception import FeatureVolume
from pipeline.models.scenes import Ground, Scenes
from pipeline.models.strides import STAYS_M_S
from pipeline.models.support import Support, marked
from pipeline.models.trajectories import RATE_HZ
from stages.export_simulator.reading import support

SOURCES = Path(__file__).parents[3] / "stages/export_simulator/web/src"
ASK = """
import { Senses } from '%s/senses.js';
const { volume, marks, paths, fastest } = JSON.parse(await new Response(process.stdin).text());
const senses = Object.create(Senses.prototype);
Object.assign(senses, { volume, allowed: Uint8Array.from(marks) });
console.log(JSON.stringify(paths.map((path) => senses.trodden(path.slice(1), path[0], fastest))));
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
def test_page_and_python_tread_the_same_way():
    rng = np.random.default_rng(0)
    occupancy = (rng.random((12, 8, 12)) < 0.2).astype(np.uint8)
    occupancy[:, 0] = 1
    scene = FeatureVolume(np.zeros((1, *occupancy.shape), np.float32), occupancy, np.array([-0.6, -0.1, -0.6]), 0.1)
    marks, range_m = marked(occupancy == 0, occupancy), np.array([[0.05, 0.14], [0.08, 0.12]])
    paths = np.cumsum(rng.normal(0, [0.02, 0.01, 0.02], (20, 57, 3)), axis=1)
    paths[..., 1] += 0.3
    scenes = Scenes((scene,), (marks > 0,), np.zeros(1, int), (Support.of(scene, marks, range_m),))
    ours = Ground(scenes, np.tile(np.eye(4), (20, 1, 1)), None).trodden(paths[:, 1:], paths[:, 0])
    asked = {
        "volume": {"shape": [1, *occupancy.shape], "origin": scene.origin.tolist(), "voxel_m": 0.1, "support": support(range_m)},
        "marks": marks.ravel().tolist(),
        "paths": paths.tolist(),
        "fastest": STAYS_M_S / RATE_HZ,
    }
    node = ["node", "--no-warnings", "--input-type=module", "-e", ASK % SOURCES]
    told = subprocess.run(node, input=json.dumps(asked), capture_output=True, text=True, check=True)
    np.testing.assert_allclose(json.loads(told.stdout), ours, atol=1e-9)
    assert np.abs(ours - paths[:, 1:])[..., 1].max() > 0.02
