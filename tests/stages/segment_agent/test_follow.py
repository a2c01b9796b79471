"""Masks from one box without depth, on a drawn scene."""

import numpy as np

from pipeline.data import images, npz
from pipeline.data.clips import Clip
from stages.segment_agent.follow import MOTION_GAP, Footage, cut_out, trimmed
from stages.segment_agent.prompt import Prompt

SIZE = (120, 160)
FRAMES = MOTION_GAP + 1
SHIFT_PX = 6


def test_motion_tells_the_animal_from_what_else_is_in_its_box(tmp_path):
    """A wall of a colour that is hardly seen outside the box stands in half of it; only the animal moves."""
    rng = np.random.default_rng(0)
    picture = np.full((*SIZE, 3), (40, 110, 40), np.uint8)
    picture[30:60, 40:120] = 190, 190, 180
    animal = np.zeros(SIZE, bool)
    animal[60:90, 40:120] = animal[30:60, 95:120] = True
    picture[animal] = 60, 40, 30
    noisy = np.clip(picture + rng.normal(0, 12, picture.shape), 0, 255).astype(np.uint8)
    for name in ("color", "depth"):
        (tmp_path / name).mkdir()
    for frame in range(FRAMES):
        images.write_color(tmp_path / "color" / f"{frame:06d}.jpg", noisy)
    images.write_depth(tmp_path / "depth" / "000000.exr", np.zeros((12, 16)))
    eye = np.tile(np.eye(3), (FRAMES, 1, 1))
    npz.save(
        tmp_path / "frames.npz",
        timestamp_s=np.arange(FRAMES) / 10,
        intrinsics=eye,
        depth_intrinsics=eye,
        quality=np.ones(FRAMES, np.float32),
        gravity_known=np.array(False),
    )
    flow = np.zeros((1, *SIZE, 2), np.float16)
    flow[0, animal, 0] = SHIFT_PX
    for way in ("fw", "bw"):
        sign = 1 if way == "fw" else -1
        npz.save(tmp_path / f"flow_{MOTION_GAP}_{way}.npz", flow=(sign * flow).astype(np.float16))
    footage = Footage(Clip.open(tmp_path), tmp_path, SIZE[0])
    found = cut_out(footage, Prompt(0, (40, 30, 120, 90)), np.random.default_rng(0))
    assert (found & animal).sum() > 0.95 * (found | animal).sum()


def test_a_rim_of_background_is_trimmed():
    """A mask 8 px too wide all around falls back to the animal; nothing is left as nothing."""
    rng = np.random.default_rng(0)
    animal, wide = np.zeros(SIZE, bool), np.zeros(SIZE, bool)
    animal[40:80, 50:110] = wide[32:88, 42:118] = True
    color = np.where(animal[..., None], (60, 40, 30), (40, 110, 40)) + rng.normal(0, 12, (*SIZE, 3))
    picture = np.clip(color, 0, 255).astype(np.uint8)
    found = trimmed(picture, wide, rng)
    assert (found & animal).sum() > 0.95 * (found | animal).sum()
    assert not trimmed(picture, np.zeros(SIZE, bool), rng).any()
