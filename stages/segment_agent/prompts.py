"""A user's prompt: a box or a click on the animal in one frame, read from `<recording>.prompt.toml`."""

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.core.errors import InputError
from pipeline.data.clips import Clip, usable_depth
from pipeline.geometry import cameras, rigid
from stages.segment_agent.movers import PlacedPrompt

FORESHORTENED, MIN_BOX_M = 1.5, 0.02
"""reach of an animal in half box sizes, since it may be longer along the line of sight; half box size below
which a box is a click"""


@dataclass(frozen=True)
class Prompt:
    """A box of color pixels (x0, y0, x1, y1) in one frame, with the animal in its middle."""

    frame: int
    box_px: tuple[float, float, float, float]


def parse(path: Path, clip: Clip) -> Prompt:
    """Read ``frame`` or ``time_s`` (since the first frame), and ``box = [x0, y0, x1, y1]`` or ``click = [x,
    y]``.

    Coordinates are pixels of the stored picture, or fractions if none is above 1. Raises InputError MSK-001.
    """
    try:
        table = tomllib.loads(path.read_text("utf-8-sig"))
        unknown = table.keys() - {"frame", "time_s", "box", "click"}
        if unknown or ("frame" in table) == ("time_s" in table) or ("box" in table) == ("click" in table):
            given = ", ".join(table)
            raise ValueError(f"either frame or time_s, either box or click, and nothing else: {given}")
        passed_s = clip.timestamp_s - clip.timestamp_s[0]
        nearest = np.abs(passed_s - float(table.get("time_s", 0))).argmin()
        frame = int(table.get("frame", nearest))
        if "time_s" in table and not -0.5 <= float(table["time_s"]) <= passed_s[-1] + 0.5:
            raise ValueError(f"time_s = {table['time_s']} of a recording of {passed_s[-1]:.1f} s")
        box = np.array(table["box"] if "box" in table else table["click"] * 2, float)
        x0, y0, x1, y1 = (box * np.tile(clip.color_size[::-1], 2) if box.max() <= 1 else box).tolist()
        height, width = clip.color_size
        if not (0 <= frame < len(clip) and 0 <= x0 <= x1 <= width and 0 <= y0 <= y1 <= height):
            raise ValueError(f"frame {frame}, box {box.tolist()} is not inside the recording")
    except (OSError, KeyError, ValueError, TypeError, OverflowError, RecursionError) as error:
        places = "`box = [x0, y0, x1, y1]` or `click = [x, y]` in pixels or in shares of the picture"
        remedy = f"give `frame = 12` or `time_s = 1.2`, and {places}"
        raise InputError("MSK-001", f"not a usable prompt: {error}", str(path), remedy) from error
    return Prompt(frame, (x0, y0, x1, y1))


def place(prompt: Prompt, clip: Clip, world_from_camera: Float[np.ndarray, "frame 4 4"]) -> PlacedPrompt:
    """Lift a prompt to the world: a near surface point in its middle third; a box gives the animal's reach.

    Raises InputError MSK-002 without depth there.
    """
    x0, y0, x1, y1 = prompt.box_px
    scale = np.divide(clip.depth_size, clip.color_size)[::-1]
    center = np.array([x0 + x1, y0 + y1]) / 2 * scale
    half = np.maximum(np.array([x1 - x0, y1 - y0]) / 6 * scale, 2)
    low, high = np.maximum(np.floor(center - half), 0).astype(int), np.ceil(center + half).astype(int)
    depth = usable_depth(clip, prompt.frame, keep_steps=False)
    depth = depth[low[1] : high[1] + 1, low[0] : high[0] + 1]
    if not (depth > 0).any():
        what = "the prompt lies where depth is unknown"
        remedy = "point at another part of the animal or another frame"
        raise InputError("MSK-002", what, f"frame {prompt.frame}", remedy)
    z, pinhole = float(np.quantile(depth[depth > 0], 0.3)), clip.intrinsics[prompt.frame]
    point_camera = cameras.unproject(center / scale, pinhole) * z
    placed = PlacedPrompt(prompt.frame, rigid.apply(world_from_camera[prompt.frame], point_camera[None])[0])
    half_m = max(x1 - x0, y1 - y0) / 2 * z / pinhole[0, 0]
    return replace(placed, reach_m=FORESHORTENED * half_m) if half_m > MIN_BOX_M else placed
