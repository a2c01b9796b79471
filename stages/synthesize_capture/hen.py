"""The hen: a round body on two legs, wings folded at its sides, a small head, a tail fan."""

import numpy as np
from jaxtyping import Float

from stages.synthesize_capture.anatomy import Anatomy, BoneRow, Flesh, Gait, both_sides, skeleton, tail_rows

TRUNK: list[BoneRow] = [
    ("pelvis", "spine", (0, 0.012, -0.06), (0, 0.035, -0.12), (0.072, 0.05)),
    ("spine", "loin", (0, 0.002, -0.01), (0, 0.012, -0.06), (0.08, 0.074)),
    ("loin", "", (0, 0.0, 0.0), (0, 0.003, 0.04), (0.082, 0.082)),
    ("chest", "loin", (0, 0.003, 0.04), (0, 0.022, 0.085), (0.082, 0.062)),
    ("neck", "chest", (0, 0.055, 0.095), (0, 0.15, 0.13), (0.048, 0.027)),
    ("head", "neck", (0, 0.172, 0.135), (0, 0.168, 0.16), (0.028, 0.022)),
    *tail_rows((0.0, 0.06, -0.135), (0.0, 0.024, -0.02), 0.0, (0.036, 0.034, 0.004)),
]
LEFT: list[BoneRow] = [
    ("upper arm", "chest", (0.062, 0.035, 0.065), (0.072, 0.022, 0.01), (0.03, 0.034)),
    ("forearm", "upper arm", (0.072, 0.022, 0.01), (0.068, 0.022, -0.055), (0.034, 0.03)),
    ("hand", "forearm", (0.068, 0.022, -0.055), (0.045, 0.04, -0.13), (0.028, 0.014)),
    ("thigh", "pelvis", (0.042, -0.02, -0.035), (0.052, -0.075, 0.03), (0.05, 0.034)),
    ("shank", "thigh", (0.052, -0.075, 0.03), (0.048, -0.13, -0.03), (0.03, 0.0145)),
    ("foot", "shank", (0.048, -0.13, -0.03), (0.048, -0.222, 0.0), (0.0125, 0.0125)),
    ("toes", "foot", (0.048, -0.222, 0.0), (0.048, -0.226, 0.045), (0.0125, 0.0105)),
]
BEAK = Flesh((0, 0.165, 0.175), (0, 0.156, 0.204), (0.014, 0.007), 0.006)
COMB = Flesh((0, 0.203, 0.122), (0, 0.204, 0.155), (0.013, 0.011), 0.004)
WATTLE = Flesh((0.008, 0.142, 0.168), (0.008, 0.128, 0.168), (0.01, 0.011), 0.004)
FAN = Flesh((0.014, 0.07, -0.14), (0.034, 0.165, -0.215), (0.03, 0.022), 0.02)
SIDE_TOES = [
    Flesh((0.048, -0.223, 0.0), (x, -0.227, z), (0.0115, 0.0105), 0.005)
    for x, z in ((0.072, 0.034), (0.026, 0.034), (0.048, -0.026))
]
BREAST = Flesh((0, -0.025, -0.03), (0, -0.012, 0.06), (0.068, 0.066), 0.03)


def _laced(
    vertices: Float[np.ndarray, "vertex 3"], rng: np.random.Generator
) -> Float[np.ndarray, "vertex 4"]:
    """Draw brown feathers with dark edges, a dark tail, a golden neck, yellow legs, a red comb and face."""
    x, y, z = vertices.T
    phase = rng.uniform(0, 2 * np.pi, 3)
    brown, dark, gold = np.array([[0.36, 0.13, 0.045], [0.035, 0.028, 0.026], [0.5, 0.3, 0.08]])
    scale = np.sin((z + y) / 0.0075 + phase[0]) * np.sin((z - y) / 0.0075 + 2 * np.sin(x / 0.03 + phase[1]))
    wing = np.sin(z / 0.009 + phase[2]) * (np.abs(x) > 0.07)
    edge = np.clip(2.5 * np.maximum(scale - 0.1, wing), 0, 1)[:, None]
    color = brown * (1 - edge) + dark * edge
    pale = (np.clip((-y - 0.02) / 0.04, 0, 1) * (z > -0.08))[:, None]
    color = color * (1 - 0.6 * pale) + 0.6 * pale * np.array([0.62, 0.5, 0.36])
    neck = (np.clip((y - 0.065) / 0.03, 0, 1) * (z > 0.03))[:, None]
    color = color * (1 - neck) + gold * neck * (0.6 + 0.4 * np.sin(x / 0.006)[:, None])
    color[(z < -0.13) & (y > 0.05)] = dark
    color[(y < -0.125)] = (0.62, 0.42, 0.1)
    red = (z > 0.1) & ((y > 0.193) | ((z > 0.145) & (y > 0.11)))
    color[red] = (0.5, 0.03, 0.025)
    color[(z > 0.18) & (y > 0.15)] = (0.6, 0.42, 0.15)
    eye = np.stack([np.abs(x) - 0.024, y - 0.178, z - 0.152], axis=-1)
    color[np.linalg.norm(eye, axis=-1) < 0.009] = 0.01
    return np.concatenate([color, 0.45 * np.ones((len(vertices), 1))], axis=-1).astype(np.float32)


HEN = Anatomy(
    "hen",
    skeleton(TRUNK, LEFT),
    (BEAK, COMB, BREAST, *both_sides(WATTLE, FAN, *SIDE_TOES)),
    _laced,
    Gait(
        stand_m=0.246,
        sit_m=0.125,
        lie_m=0.11,
        sit_pitch=0.0,
        sole_m=0.0125,
        forward=(0.0, 0.0),
        sitting=((0.0, 0.0), (0.05, 0.0)),
        lying=((0.0, 0.0), (0.05, 0.0)),
        eye=(0.0, 0.17, 0.13),
        fold_m=0.15,
        nod=0.16,
        flex=0.25,
        tail_sway=0.12,
        wings=True,
    ),
    box=((-0.12, 0.121), (-0.26, 0.24), (-0.28, 0.24)),
)
