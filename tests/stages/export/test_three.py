"""three.js loads the exported animal and skins it like Python."""

import base64
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.stages.export import moving_tube
from tests.stages.export_simulator import browser

WEB = Path(__file__).parents[3] / "stages/export_simulator/web"
ENTRY = """
import { AnimationMixer, Vector3 } from 'three';
import { GLTFLoader } from 'three/examples/jsm/loaders/GLTFLoader.js';
window.moved = async (text, seconds) => {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const { scene, animations } = await new GLTFLoader().parseAsync(bytes.buffer, '');
  let mesh;
  scene.traverse((node) => { if (node.isSkinnedMesh) mesh = node; });
  const mixer = new AnimationMixer(scene);
  mixer.clipAction(animations[0]).play();
  mixer.setTime(seconds);
  scene.updateMatrixWorld(true);
  const count = mesh.geometry.attributes.position.count;
  const places = Array.from({ length: count }, (_, i) => mesh.getVertexPosition(i, new
  Vector3()).applyMatrix4(mesh.matrixWorld).toArray()); return { names: animations.map((animation) =>
  animation.name), places };
};
"""


@pytest.mark.skipif(not Path(browser.CHROMIUM).exists(), reason="Chromium is not installed")
@pytest.mark.skipif(
    shutil.which("node") is None or not (WEB / "node_modules/three").is_dir(),
    reason="needs node, and `npm ci` in stages/export_simulator/web",
)
def test_three_animates_the_animal_like_python() -> None:
    model, places = moving_tube.model()
    bundler = ["node_modules/.bin/esbuild", "--bundle", "--format=iife", "--log-level=error"]
    script = subprocess.run(bundler, cwd=WEB, input=ENTRY, capture_output=True, text=True, check=True).stdout
    with browser.chromium() as opened:
        page = opened.new_page()
        page.add_script_tag(content=script)
        loaded = page.evaluate(
            "([text, seconds]) => moved(text, seconds)",
            [base64.b64encode(model).decode(), moving_tube.SECONDS],
        )
    assert loaded["names"] == ["walk"]
    np.testing.assert_allclose(loaded["places"], places, atol=2e-5)  # meters
