"""The exported animal in Blender: a nightly check, for `bpy` is large and wants an environment of its own.

python -m venv .blender && .blender/bin/pip install bpy==5.0.1
ATS_BLENDER=.blender/bin/python .venv/bin/python -m pytest tests/stages/export/test_blender.py
"""

import json
import os
import subprocess

import numpy as np
import pytest

from tests.stages.export import moving_tube

BLENDER = os.environ.get("ATS_BLENDER")
SCRIPT = """
import json, sys
import bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=sys.argv[1])
frame = float(sys.argv[2]) * bpy.context.scene.render.fps
bpy.context.scene.frame_set(int(frame), subframe=frame % 1)
mesh = next(each for each in bpy.data.objects if each.type == "MESH" and each.find_armature())
moved = mesh.evaluated_get(bpy.context.evaluated_depsgraph_get())
places = [list(moved.matrix_world @ vertex.co) for vertex in moved.data.vertices]
print("RESULT", json.dumps({"names": [action.name for action in bpy.data.actions], "places": places}))
"""


@pytest.mark.skipif(BLENDER is None, reason="set ATS_BLENDER to a Python that has bpy")
def test_blender_animates_the_animal_like_python(tmp_path) -> None:
    model, places = moving_tube.model()
    (tmp_path / "agent.glb").write_bytes(model)
    command = [BLENDER, "-c", SCRIPT, str(tmp_path / "agent.glb"), str(moving_tube.SECONDS)]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    found = json.loads(
        next(line for line in output.splitlines() if line.startswith("RESULT")).removeprefix("RESULT")
    )
    assert any(name.startswith("walk") for name in found["names"])
    x, y, z = np.array(found["places"]).T  # +z is up in Blender
    np.testing.assert_allclose(np.stack([x, z, -y], 1), places, atol=2e-5)  # meters
