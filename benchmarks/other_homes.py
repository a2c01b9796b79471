"""Render the built-in animal in homes outside the design distribution: other floor plans, low contrast, thin-legged
furniture, a noisier depth sensor.

    python -m benchmarks.other_homes OUT --seeds 5 6 [--seconds 14]

Writes `recordings/session-<seed>.r3d` and `truth/session-<seed>.npz`, in the format that `benchmarks.semi_real` scores.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from benchmarks import command_lines
from pipeline.core.progress import log
from pipeline.data import npz
from stages.synthesize_capture import animal, dwellings, record3d, script, sheets, texture
from stages.synthesize_capture.config import Config
from stages.synthesize_capture.film import Stage
from stages.synthesize_capture.room import Room
from stages.synthesize_capture.script import PhoneFormat

FPS = 10.0
"""frames per second, the rate of extraction"""
CONTRAST = 0.35
"""remaining fraction of texture contrast"""


def home(rng: np.random.Generator) -> Room:
    """Sample another home with low contrast; add chairs on thin legs, a scratching post and a door frame."""
    room = dwellings.filmed_elsewhere(rng)
    paint = texture.wood(rng, (120, 96, 74))
    added = []
    for _ in range(3):
        x, z, yaw = rng.uniform(-1.8, 1.8), rng.uniform(-1.4, 1.4), rng.uniform(-np.pi, np.pi)
        parts = sheets.box((0, 0.45, 0), (0.4, 0.025, 0.4), paint, skip="")
        for sx, sz in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            parts += sheets.box((sx * 0.18, 0.22, sz * 0.18), (0.022, 0.44, 0.022), paint, skip="+y -y")
        for height in (0.55, 0.66, 0.77, 0.88):
            parts += sheets.box((0, height, -0.18), (0.38, 0.035, 0.015), paint, skip="")
        for sx in (-1, 1):
            parts += sheets.box((sx * 0.18, 0.68, -0.18), (0.022, 0.46, 0.022), paint, skip="-y")
        added += [sheet.moved(sheets.upright(x, z, yaw)) for sheet in parts]
    x, z = rng.uniform(-2, 2), rng.uniform(-1.5, 1.5)
    post = sheets.cylinder((0, 0.3, 0), 0.04, 0.6, texture.rope(rng, (190, 160, 120)), paint)
    post += sheets.box((0, 0.02, 0), (0.35, 0.04, 0.35), paint)
    added += [sheet.moved(sheets.upright(x, z)) for sheet in post]
    for x in (0.2, 1.1):
        added += [
            sheet.moved(sheets.upright(x, -2.3))
            for sheet in sheets.box((0, 1.0, 0), (0.07, 2.0, 0.12), paint)
        ]
    return replace(room, fixed=tuple(map(_reduce_contrast, (*room.fixed, *added))))


def _reduce_contrast(sheet: sheets.Sheet) -> sheets.Sheet:
    mean = sheet.picture.reshape(-1, 3).mean(0)
    gray = 0.5 * mean + 0.5 * mean.mean()
    return replace(sheet, picture=np.clip(gray + CONTRAST * (sheet.picture - mean), 0, 255).astype(np.uint8))


def add_sensor_noise(
    depth: Float[np.ndarray, "height width"], rng: np.random.Generator
) -> Float[np.ndarray, "height width"]:
    """Add noise of twice the built-in sensor's, jittered edges with holes beside them, and patches without depth."""
    height, width = depth.shape
    jitter = cv2.resize(rng.standard_normal((height // 5, width // 5, 3)).astype(np.float32), (width, height))
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    out = cv2.remap(np.nan_to_num(depth), x + jitter[..., 0], y + jitter[..., 1], cv2.INTER_NEAREST)
    grain = cv2.GaussianBlur(rng.standard_normal((height, width)), (0, 0), 2.0) * 7
    out += (out > 0) * (0.004 + 0.006 * out) * grain
    edge = cv2.morphologyEx(out, cv2.MORPH_GRADIENT, np.ones((5, 5))) > 0.08 + 0.03 * out
    out[edge & (jitter[..., 2] > 0.3)] = 0
    patch = cv2.resize(rng.standard_normal((height // 16, width // 16)).astype(np.float32), (width, height))
    out[(patch > 1.7) & (out > 1.5)] = 0
    return np.maximum(out, 0).astype(np.float32)


def render_session(out: Path, seed: int, seconds: float) -> None:
    """Render one session and its ground truth."""
    rng = np.random.default_rng([seed, 97])
    config = Config(
        seed, session_count=1, session_s=seconds, test_session_s=seconds, heldout_of=0, dim_session=0,
        sideways_session=0,
    )  # fmt: skip
    session_script = next(
        each for each in script.scripts(config, home(rng), PhoneFormat(fps=FPS)) if each.session is not None
    )
    motion = session_script.motions[0]
    assert motion is not None, "a session has an animal"
    name, masks = f"session-{seed}", []
    (out / "recordings").mkdir(parents=True, exist_ok=True)
    (out / "truth").mkdir(exist_ok=True)
    with record3d.Writer(out / "recordings" / f"{name}.r3d") as writer:
        for frame in Stage(session_script, animal.grow(np.random.default_rng([seed, 2]))).frames():
            depth = add_sensor_noise(frame.depth, rng)
            writer.add(
                frame.color, depth, np.where(depth > 0, np.maximum(frame.confidence, 1), 0).astype(np.uint8)
            )
            masks.append(frame.masks[0])
        writer.finish(session_script)
    packed = np.packbits(np.stack(masks), axis=-1)
    npz.save(
        out / "truth" / f"{name}.npz", compress=True, timestamp_s=session_script.timestamp_s, packed=packed,
        source_index=np.arange(len(masks)),
        shape=np.array([len(masks), *masks[0].shape]), world_from_camera=session_script.world_from_camera,
        world_from_agent=motion.world_from_agent,
    )  # fmt: skip
    log(f"{name}: {len(masks)} frames, the animal in {np.mean([m.mean() > 0.001 for m in masks]):.0%}")


def main() -> None:
    """Parse the command line."""
    parser = command_lines.described(__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[5])
    parser.add_argument("--seconds", type=float, default=14.0)
    arguments = parser.parse_args()
    for seed in arguments.seeds:
        render_session(arguments.out, seed, arguments.seconds)


if __name__ == "__main__":
    main()
