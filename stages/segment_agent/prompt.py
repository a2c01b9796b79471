"""A user's hint where the animal is: one box or one click in one frame, read from a small TOML file."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.errors import InputError
from pipeline.files.clips import Clip
from pipeline.space import cameras, rigid
from stages.segment_agent.free_space import usable_depth


@dataclass(frozen=True)
class Prompt:
    """A rectangle of colour pixels (x0, y0, x1, y1) in one frame that shows the animal in its middle."""

    frame: int
    box_px: tuple[float, float, float, float]


def parse(path: Path, clip: Clip) -> Prompt:
    """Read ``frame`` and ``box = [x0, y0, x1, y1]`` or ``click = [x, y]`` (colour pixels). Raises InputError MSK-001."""
    try:
        table = tomllib.loads(path.read_text())
        frame = int(table.pop("frame"))
        box = [float(value) for value in table["box"]] if "box" in table else [float(value) for value in table["click"] * 2]
        x0, y0, x1, y1 = box
        if not (0 <= frame < len(clip) and 0 <= x0 <= x1 <= clip.color_size[1] and 0 <= y0 <= y1 <= clip.color_size[0]):
            raise ValueError(f"frame {frame}, box {box} is not inside the recording")
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise InputError(
            "MSK-001",
            f"not a usable hint: {error}",
            str(path),
            "give `frame = 12` and `box = [x0, y0, x1, y1]` or `click = [x, y]` in colour pixels",
        ) from error
    return Prompt(frame, (x0, y0, x1, y1))


def position(prompt: Prompt, clip: Clip, world_from_camera: Float[np.ndarray, "frame 4 4"]) -> Float[np.ndarray, "3"]:
    """Return the nearest surface in the middle third of the box, in the world. Raises InputError MSK-002 without depth there."""
    x0, y0, x1, y1 = prompt.box_px
    scale = np.array([clip.depth_size[1] / clip.color_size[1], clip.depth_size[0] / clip.color_size[0]])
    centre, half = np.array([x0 + x1, y0 + y1]) / 2 * scale, np.maximum(np.array([x1 - x0, y1 - y0]) / 6 * scale, 2)
    low, high = np.maximum(np.floor(centre - half), 0).astype(int), np.ceil(centre + half).astype(int)
    depth = usable_depth(clip, prompt.frame)[low[1] : high[1] + 1, low[0] : high[0] + 1]
    if not (depth > 0).any():
        raise InputError(
            "MSK-002",
            "the hint lies where depth is unknown",
            f"frame {prompt.frame}",
            "point at another part of the animal or another frame",
        )
    z = float(np.quantile(depth[depth > 0], 0.3))
    point_camera = cameras.unproject(centre / scale, clip.intrinsics[prompt.frame]) * z
    return rigid.apply(world_from_camera[prompt.frame], point_camera[None])[0]
