"""The dog: a larger cat's body with a long muzzle, hanging ears, no waist and a patched coat."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from stages.synthesize_capture.anatomy import Flesh, both_sides
from stages.synthesize_capture.cat import CAT

MUZZLE = Flesh((0, 0.07, 0.27), (0, 0.058, 0.312), (0.034, 0.021), 0.014)
WAIST = Flesh((0, -0.012, -0.1), (0, -0.012, 0.09), (0.085, 0.09), 0.03)
EAR = Flesh((0.046, 0.128, 0.222), (0.074, 0.045, 0.228), (0.017, 0.024), 0.008)


def _patched(
    vertices: Float[np.ndarray, "vertex 3"], rng: np.random.Generator
) -> Float[np.ndarray, "vertex 4"]:
    """Draw a white coat with large black patches, a black saddle and ears, and a brown face."""
    x, y, z = vertices.T
    white = np.array([0.74, 0.72, 0.68])
    black = np.array([0.022, 0.02, 0.02])
    brown = np.array([0.33, 0.15, 0.05])
    phase = rng.uniform(0, 2 * np.pi, 4)
    patch = np.sin(z / 0.05 + phase[0]) + np.sin(y / 0.04 + phase[1]) * np.sin(x / 0.05 + phase[2])
    saddle = 2.2 * np.clip((y - 0.01) / 0.05, -1, 1) * ((z > -0.2) & (z < 0.14))
    dark = np.clip((0.6 * patch + saddle - 0.2) * 4, 0, 1) * (y > -0.12)
    dark = np.maximum(dark, np.clip((np.abs(x) - 0.048) / 0.006, 0, 1) * (z > 0.19) * (y > 0.02))
    dark = np.maximum(dark, (z < -0.23) * np.clip(np.sin(z / 0.03 + phase[3]) * 3, 0, 1))
    color = white * (1 - dark[:, None]) + black * dark[:, None]
    face = ((z > 0.2) & (np.abs(x) > 0.016) & (z < 0.29) & (dark < 0.5))[:, None]
    color = np.where(face, brown, color)
    color[(z > 0.325) & (y > 0.05)] = black
    return np.concatenate([color, 0.35 * np.ones((len(vertices), 1))], axis=-1).astype(np.float32)


DOG = replace(CAT, name="dog", flesh=(*CAT.flesh, MUZZLE, WAIST, *both_sides(EAR)), coat=_patched, size=1.3)
