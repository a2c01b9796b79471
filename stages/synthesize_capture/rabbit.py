"""The rabbit: a short arched body, upright ears, a long hind foot, a tuft of a tail; it hops."""

import numpy as np
from jaxtyping import Float

from stages.synthesize_capture.anatomy import Anatomy, BoneRow, Flesh, Gait, both_sides, skeleton, tail_rows

TRUNK: list[BoneRow] = [
    ("pelvis", "spine", (0, 0.012, -0.075), (0, -0.012, -0.135), (0.086, 0.064)),
    ("spine", "loin", (0, 0.008, -0.02), (0, 0.012, -0.075), (0.08, 0.086)),
    ("loin", "", (0, 0.0, 0.0), (0, -0.008, 0.04), (0.078, 0.07)),
    ("chest", "loin", (0, -0.008, 0.04), (0, -0.012, 0.1), (0.07, 0.056)),
    ("neck", "chest", (0, 0.005, 0.105), (0, 0.045, 0.14), (0.05, 0.044)),
    ("head", "neck", (0, 0.062, 0.15), (0, 0.042, 0.212), (0.05, 0.03)),
    *tail_rows((0.0, 0.012, -0.19), (0.0, 0.005, -0.007), 0.0, (0.026, 0.026, 0.001)),
]
LEFT: list[BoneRow] = [
    ("upper arm", "chest", (0.04, -0.02, 0.085), (0.044, -0.078, 0.06), (0.034, 0.023)),
    ("forearm", "upper arm", (0.044, -0.078, 0.06), (0.04, -0.14, 0.088), (0.021, 0.016)),
    ("hand", "forearm", (0.04, -0.14, 0.088), (0.04, -0.147, 0.112), (0.017, 0.016)),
    ("thigh", "pelvis", (0.045, 0.0, -0.1), (0.066, -0.068, -0.03), (0.062, 0.036)),
    ("shank", "thigh", (0.066, -0.068, -0.03), (0.06, -0.11, -0.12), (0.032, 0.019)),
    ("foot", "shank", (0.06, -0.11, -0.12), (0.058, -0.14, -0.045), (0.018, 0.017)),
    ("toes", "foot", (0.058, -0.14, -0.045), (0.058, -0.146, -0.012), (0.017, 0.015)),
]
EAR = Flesh((0.018, 0.1, 0.148), (0.034, 0.205, 0.115), (0.018, 0.014), 0.01)
CHEEK = Flesh((0.02, 0.04, 0.175), (0.014, 0.032, 0.205), (0.03, 0.022), 0.012)
BELLY = Flesh((0, -0.03, -0.08), (0, -0.03, 0.05), (0.06, 0.05), 0.03)


def _harlequin(
    vertices: Float[np.ndarray, "vertex 3"], rng: np.random.Generator
) -> Float[np.ndarray, "vertex 4"]:
    """Draw a fawn coat with gray-brown patches, a white collar, blaze, belly and feet, and dark ears."""
    x, y, z = vertices.T
    phase = rng.uniform(0, 2 * np.pi, 4)
    fawn, gray, white = np.array([[0.42, 0.26, 0.13], [0.09, 0.075, 0.065], [0.76, 0.73, 0.69]])
    wave = np.sin(z / 0.028 + phase[0] + np.sin(x / 0.03 + phase[1])) + np.sin(y / 0.03 + phase[2])
    dark = np.clip(2 * wave, 0, 1)[:, None]
    color = fawn * (1 - dark) + gray * dark
    collar = (np.abs(z - 0.085) < 0.022 + 0.008 * np.sin(x / 0.012 + phase[3])) & (y < 0.09)
    blaze = (z > 0.14) & (np.abs(x) < 0.014) & (y < 0.105)
    color[collar | blaze | (y < -0.125) | ((y < -0.06) & (np.abs(x) < 0.05)) | (z < -0.2)] = white
    color[y > 0.118] = gray
    eye = np.stack([np.abs(x) - 0.04, y - 0.072, z - 0.178], axis=-1)
    color[np.linalg.norm(eye, axis=-1) < 0.014] = 0.01
    return np.concatenate([color, 0.5 * np.ones((len(vertices), 1))], axis=-1).astype(np.float32)


RABBIT = Anatomy(
    "rabbit",
    skeleton(TRUNK, LEFT),
    (*both_sides(EAR, CHEEK), BELLY),
    _harlequin,
    Gait(
        stand_m=0.168,
        sit_m=0.158,
        lie_m=0.098,
        sit_pitch=-0.3,
        walk_offset=(0.46, 0.4, 0.02, 0.0),
        trot_offset=(0.46, 0.4, 0.02, 0.0),
        duty=(0.5, 0.3, 0.48),
        forward=(0.0, 0.0),
        sitting=((0.036, 0.07), (0.07, -0.045)),
        lying=((0.04, 0.15), (0.08, -0.04)),
        eye=(0.0, 0.06, 0.15),
        fold_m=0.14,
        hop_m=0.05,
        hop_pitch=0.16,
        tail_sway=0.15,
    ),
    box=((-0.13, 0.131), (-0.2, 0.24), (-0.28, 0.28)),
)
