"""The cat: a mackerel tabby, and the body that the dog shares."""

import numpy as np
from jaxtyping import Float

from stages.synthesize_capture.anatomy import Anatomy, BoneRow, Flesh, both_sides, skeleton, tail_rows

TRUNK: list[BoneRow] = [
    ("pelvis", "spine", (0, 0.0, -0.10), (0, -0.005, -0.185), (0.072, 0.058)),
    ("spine", "loin", (0, 0.0, -0.02), (0, 0.0, -0.10), (0.073, 0.072)),
    ("loin", "", (0, 0.0, 0.0), (0, 0.0, 0.05), (0.074, 0.076)),
    ("chest", "loin", (0, 0.0, 0.05), (0, 0.012, 0.14), (0.078, 0.064)),
    ("neck", "chest", (0, 0.02, 0.15), (0, 0.075, 0.215), (0.05, 0.044)),
    ("head", "neck", (0, 0.088, 0.225), (0, 0.078, 0.285), (0.056, 0.030)),
    *tail_rows((0.0, 0.022, -0.20), (0.0, 0.0, -0.056), 0.006, (0.021, 0.0195, 0.0016)),
]
F, H = 0.045, 0.045 * 1.1
"""Lateral offset of fore and hind limbs, meters."""
LEFT: list[BoneRow] = [
    ("upper arm", "chest", (F, -0.005, 0.115), (F * 1.15, -0.103, 0.075), (0.042, 0.027)),
    ("forearm", "upper arm", (F * 1.15, -0.103, 0.075), (F, -0.203, 0.112), (0.025, 0.018)),
    ("hand", "forearm", (F, -0.203, 0.112), (F, -0.219, 0.14), (0.019, 0.018)),
    ("thigh", "pelvis", (H, 0.0, -0.155), (H * 1.25, -0.105, -0.115), (0.058, 0.034)),
    ("shank", "thigh", (H * 1.25, -0.105, -0.115), (H * 1.1, -0.148, -0.21), (0.031, 0.018)),
    ("foot", "shank", (H * 1.1, -0.148, -0.21), (H * 1.1, -0.214, -0.178), (0.017, 0.016)),
    ("toes", "foot", (H * 1.1, -0.214, -0.178), (H * 1.1, -0.22, -0.148), (0.018, 0.017)),
]
EAR = Flesh((0.030, 0.125, 0.225), (0.040, 0.168, 0.216), (0.020, 0.0065), 0.008)
CHEEK = Flesh((0.022, 0.068, 0.262), (0.014, 0.064, 0.283), (0.026, 0.018), 0.012)
BELLY = Flesh((0, -0.025, -0.08), (0, -0.022, 0.07), (0.06, 0.064), 0.03)


def _tabby(
    vertices: Float[np.ndarray, "vertex 3"], rng: np.random.Generator
) -> Float[np.ndarray, "vertex 4"]:
    """Draw a mackerel tabby: dark stripes across back, legs and tail, pale belly, muzzle and paws."""
    x, y, z = vertices.T
    ground = np.array([0.36, 0.22, 0.115]) * rng.uniform(0.8, 1.15)
    dark, pale = np.array([0.045, 0.032, 0.026]), np.array([0.72, 0.66, 0.56])
    phase = rng.uniform(0, 2 * np.pi, 6)
    wobble = (
        0.9 * np.sin(9 * y / 0.1 + phase[0])
        + 0.8 * np.sin(x / 0.022 + phase[1])
        + 0.6 * np.sin(z / 0.05 + phase[2])
    )
    body = np.sin(2 * np.pi * z / 0.052 + wobble)
    tail = np.sin(2 * np.pi * z / 0.045 + phase[3])
    leg = np.sin(2 * np.pi * y / 0.042 + 0.5 * np.sin(z / 0.02 + phase[4]))
    wave = np.where(z < -0.21, tail, np.where(y < -0.1, leg, body))
    stripe = np.clip((wave - 0.05) * 2.2, 0, 1) * np.where((y < -0.045) & (y > -0.1), 0.45, 1.0)
    blotch = np.clip(np.sin(x / 0.03 + phase[5]) * np.sin(z / 0.06 + phase[0]) * 1.5, 0, 1)
    light_part = np.clip((-y - 0.055) / 0.025, 0, 1) * (y > -0.11) * (np.abs(x) < 0.05)
    light_part = np.maximum(light_part, np.clip((-y - 0.19) / 0.012, 0, 1))
    light_part = np.maximum(
        light_part, np.clip((z - 0.262) / 0.015, 0, 1) * np.clip((0.085 - y) / 0.015, 0, 1)
    )
    light_part = np.maximum(
        light_part, np.clip((z - 0.13) / 0.03, 0, 1) * np.clip((0.0 - y) / 0.03, 0, 1) * (y > -0.1)
    )
    color = ground * (1 - 0.25 * blotch[:, None]) * (1 - stripe[:, None]) + dark * stripe[:, None]
    color = color * (1 - light_part[:, None]) + pale * light_part[:, None]
    face = np.stack([np.abs(x) - 0.024, y - 0.094, z - 0.273], axis=-1)
    color[np.linalg.norm(face, axis=-1) < 0.0115] = (0.28, 0.36, 0.06)
    color[(z > 0.3) & (np.abs(x) < 0.008) & (y > 0.07)] = (0.35, 0.12, 0.1)
    return np.concatenate([color, 0.55 * np.ones((len(vertices), 1))], axis=-1).astype(np.float32)


CAT = Anatomy(
    "cat",
    skeleton(TRUNK, LEFT),
    (*both_sides(EAR, CHEEK), BELLY),
    _tabby,
    shadow_balls=(
        ("pelvis", (0, 0, -0.14), 0.075),
        ("spine", (0, 0, -0.06), 0.075),
        ("loin", (0, 0, 0.02), 0.075),
        ("chest", (0, 0, 0.1), 0.075),
        ("head", (0, 0.08, 0.25), 0.055),
        ("left hand", (0.045, -0.21, 0.125), 0.03),
        ("right hand", (-0.045, -0.21, 0.125), 0.03),
        ("left toes", (0.05, -0.21, -0.165), 0.03),
        ("right toes", (-0.05, -0.21, -0.165), 0.03),
    ),
)
