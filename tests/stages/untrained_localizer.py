"""Localizers as artifacts, with random weights and DINOv2 descriptors: they use all that runs on a device.

Pictures hardly influence their answers, which therefore agree.
"""

from pathlib import Path

import numpy as np
import torch

from pipeline.backends.descriptors import Describer
from pipeline.localization import localizer as localizers
from pipeline.localization.networks import PoseRegressor
from pipeline.localization.patches import PcaBasis, Target
from stages.train_localizer.training import AGENT_SAMPLING, SCENE_SAMPLING, SOLVERS
from tests.pipeline.backends import small_checkpoints

CHANNELS, AXES = 24, 16
"""Channels of the checkpoint, and principal components."""
ANSWER = (1.0, 0, 0, 0, 0, 0, -0.8, 0)
"""Quaternion, position (meters) and log error of all answers: 0.8 m behind the origin, looking along z."""
INFLUENCE = 0.01


def write(folder: Path, target: Target) -> Path:
    """Write a regressor that is certain of its answers; return its folder."""
    folder.mkdir()
    checkpoint = folder.parent / "dinov2"
    weights = checkpoint if checkpoint.exists() else small_checkpoints.dinov2(checkpoint)
    torch.manual_seed(0)
    basis = PcaBasis(np.zeros(CHANNELS, np.float32), np.eye(AXES, CHANNELS, dtype=np.float32))
    sampling = SCENE_SAMPLING if target == "scene" else AGENT_SAMPLING
    certain = localizers.Calibration(5.0, 0.0)
    net, describer = PoseRegressor(AXES, 8).eval(), Describer("dinov2", str(weights))
    with torch.no_grad():
        net.head[-1].weight *= INFLUENCE
        net.head[-1].bias.copy_(torch.tensor(ANSWER))
    found = localizers.Localizer(sampling, basis, net, certain, SOLVERS[target], describer)
    localizers.save(folder, found, {})
    return folder
