"""Masks of a recording without depth, from one box: colour and flow only.

GrabCut cuts the animal out of the hinted frame and a network learns its appearance; it is followed both ways
from there (`_followed`) as what looks like it near where flow carries the last mask. That loses sides of the
animal never seen before, so the network learns again from the whole recording, where what moves against the
background beside the followed part counts too, and the animal is followed once more. What moves elsewhere is
some other mover. At last the rims of all masks are moved to where colours change.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.data.clips import Clip
from pipeline.data.flow import open_flow
from stages.segment_agent.appearance import Appearance, Example, learn
from stages.segment_agent.config import LearningConfig
from stages.segment_agent.painting import Mask
from stages.segment_agent.prompt import Prompt
from stages.segment_agent.windows import around, working_picture, working_size

SURE = 4.0
"""log-odds of a mask that is carried on"""
MOTION_GAP = 4
LEAST_MOVING = 0.15
"""share of the hinted box that must move for motion to separate the animal from the rest of the box"""
RIM_SHARE = 0.13
"""width of the rim of a followed mask that may be background, as a share of the root of its area"""
OUTSIDE_PX, AROUND_PX = 6, 30
"""how far outside a followed mask the animal may be, and how much of the picture around it is looked at"""
TRIM_ROUNDS = 3
"""of GrabCut, which begins close to the answer there"""
FIRST_STEPS, STEPS = 80, 160
"""training steps on the hinted frame, and on the whole recording"""
HINTED_SHARE = 0.17
"""share of the hinted frame among those examples"""
REACH_PX = 12
"""how far from the carried mask the animal is looked for, working pixels as all here"""
BESIDE_PX = 25
"""how far from the followed part something moving belongs to the animal"""
HALO_PX = 7
"""how far flow smears motion beyond the edge of what moves"""
CARRIED = 2.0
"""largest log-odds of the carried mask at first; half of it counts when the appearance is known better"""
MOVING, STILL = 4.0, 2.5
"""times the typical residual from which on a point moves against the background; up to which it does not"""


@dataclass(frozen=True)
class Footage:
    """Working pictures and flow at their size."""

    clip: Clip
    flow: Path
    height_px: int

    def color(self, frame: int) -> UInt8[np.ndarray, "height width 3"]:
        """Read a working picture."""
        return working_picture(self.clip, frame, self.height_px)

    def to(self, frame: int, other: int) -> Float[np.ndarray, "height width 2"] | None:
        """Read the flow from a frame to another, working pixels; None where none is stored."""
        first, gap = min(frame, other), abs(other - frame)
        table = open_flow(self.flow, gap, backward=other < frame)
        if not 0 <= first < len(table):
            return None
        size = working_size(self.clip, self.height_px)
        scale = size[0] / self.clip.color_size[0]
        return scale * cv2.resize(table[first].astype(np.float32), size[::-1], interpolation=cv2.INTER_LINEAR)


def follow(
    footage: Footage, hint: Prompt, learning: LearningConfig, rng: np.random.Generator
) -> Iterator[Mask]:
    """Return one mask per frame at colour resolution."""
    count = len(footage.clip)
    hinted = cut_out(footage, hint, rng)
    shown = Example(footage.color(hint.frame), hinted.astype(np.uint8) * 255)
    network = learn([shown], replace(learning, steps=FIRST_STEPS), rng, least_px=1, scaled=0.0)
    assert network is not None, "GrabCut leaves at least the hinted box"
    rough = _followed(footage, hint.frame, hinted, network, REACH_PX, CARRIED)
    chosen = np.unique(np.linspace(0, count - 1, learning.examples).round().astype(int)).tolist()
    examples = [_example(footage, frame, _unpacked(rough[frame])) for frame in chosen if frame != hint.frame]
    repeated = [shown] * max(1, round(HINTED_SHARE * len(examples)))
    network = learn(repeated + examples, replace(learning, steps=STEPS), rng, scaled=0.0)
    assert network is not None, "the hinted frame shows the animal"
    allowed = _allowed(rough)
    found = _followed(footage, hint.frame, hinted, network, REACH_PX + 3, CARRIED / 2, allowed)
    for frame, followed in enumerate(map(_unpacked, found)):
        mask = hinted if frame == hint.frame else trimmed(footage.color(frame), followed, rng)
        labels = cv2.resize(
            mask.astype(np.uint8) * 255, footage.clip.color_size[::-1], interpolation=cv2.INTER_LINEAR
        )
        yield Mask(np.where(labels > 127, 255, 0).astype(np.uint8), bool(mask.any()), 0.5)


def cut_out(footage: Footage, hint: Prompt, rng: np.random.Generator) -> Bool[np.ndarray, "height width"]:
    """Cut the animal out of the hinted frame; a click stands for a box around it."""
    color = footage.color(hint.frame)
    height, width = color.shape[:2]
    x0, y0, x1, y1 = np.array(hint.box_px) * height / footage.clip.color_size[0]
    if min(x1 - x0, y1 - y0) < 4:
        x0, y0, x1, y1 = x0 - 0.2 * height, y0 - 0.2 * height, x1 + 0.2 * height, y1 + 0.2 * height
    low = np.clip(np.floor([x0, y0]), 1, [width - 8, height - 8]).astype(int)
    high = np.minimum(np.ceil([x1, y1]).astype(int), [width - 1, height - 1])
    marks = np.full((height, width), cv2.GC_BGD, np.uint8)
    boxed = np.s_[low[1] : high[1], low[0] : high[0]]
    moves = residual(footage, hint.frame)[boxed]
    still = (moves < STILL) & ((moves > MOVING).mean() > LEAST_MOVING)
    marks[boxed] = np.where(still, cv2.GC_PR_BGD, cv2.GC_PR_FGD)
    inside = grab(color, marks, rng)
    return inside if inside.any() else marks != cv2.GC_BGD


def grab(
    color: UInt8[np.ndarray, "height width 3"],
    marks: UInt8[np.ndarray, "height width"],
    rng: np.random.Generator,
    rounds: int = 8,
) -> Bool[np.ndarray, "height width"]:
    """Cut something out of a picture by GrabCut (Rother et al. 2004); ``marks`` are OpenCV's four."""
    cv2.setRNGSeed(int(rng.integers(2**31 - 1)))
    models, by_mask = np.zeros((2, 1, 65)), cv2.GC_INIT_WITH_MASK
    found = cv2.grabCut(color, marks.copy(), (0, 0, 0, 0), models[0], models[1], rounds, by_mask)[0]
    return (found == cv2.GC_FGD) | (found == cv2.GC_PR_FGD)


def trimmed(
    color: UInt8[np.ndarray, "height width 3"],
    mask: Bool[np.ndarray, "height width"],
    rng: np.random.Generator,
) -> Bool[np.ndarray, "height width"]:
    """Move the rim of a mask to where colours change: what is followed gathers a rim of background."""
    rim = round(RIM_SHARE * np.sqrt(mask.sum()))
    core = ~_grown(~mask, max(rim // 2, 1))
    if not core.any():
        return mask
    part = around(mask, AROUND_PX)
    marks = np.where(core, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    marks[~_grown(mask, OUTSIDE_PX)] = cv2.GC_BGD
    marks[~_grown(~mask, max(rim, 1))] = cv2.GC_FGD
    found = np.zeros_like(mask)
    found[part] = grab(color[part], marks[part], rng, TRIM_ROUNDS)
    return found if found.any() else mask


def residual(footage: Footage, frame: int) -> Float[np.ndarray, "height width"]:
    """Return how far a point moves against the background, in typical residuals, mean of both directions of
    time.

    The background moves as most of the picture does, by a homography.
    """
    parts = []
    for other in (frame - MOTION_GAP, frame + MOTION_GAP):
        moved = footage.to(frame, other)
        if moved is None:
            continue
        pixel = np.stack(np.meshgrid(*(np.arange(side, dtype=np.float32) for side in moved.shape[1::-1])), -1)
        sparse = pixel[::8, ::8].reshape(-1, 2)
        matrix, _ = cv2.findHomography(sparse, sparse + moved[::8, ::8].reshape(-1, 2), cv2.RHO, 2.0)
        if matrix is not None:
            expected = cv2.perspectiveTransform(pixel.reshape(1, -1, 2), matrix).reshape(pixel.shape)
            error = np.linalg.norm(expected - pixel - moved, axis=-1)
            parts.append(error / max(float(np.median(error)), 0.5))
    return np.mean(parts, axis=0) if parts else np.zeros(working_size(footage.clip, footage.height_px))


def _example(footage: Footage, frame: int, rough: Bool[np.ndarray, "height width"]) -> Example:
    """Label a frame: what was followed or moves near it is animal, what is far or still is not."""
    moves = residual(footage, frame)
    beside = _grown(rough, BESIDE_PX)
    inner = _grown(~((moves > MOVING) | rough), HALO_PX)
    labels = np.full(rough.shape, 128, np.uint8)
    labels[~beside | ((moves < STILL) & ~rough)] = 0
    labels[beside & ~inner] = 255
    labels[rough & (moves > STILL)] = 255
    return Example(footage.color(frame), labels)


def _followed(
    footage: Footage,
    start: int,
    mask: Bool[np.ndarray, "height width"],
    network: Appearance,
    reach_px: int,
    carried: float,
    allowed: Callable[[int], Bool[np.ndarray, "height width"]] | None = None,
) -> list[bytes]:
    """Follow a mask both ways; entries are packed. A lost animal is looked for in the whole picture."""
    found = [b""] * len(footage.clip)
    found[start] = _packed(mask)
    for step in (1, -1):
        before, size = np.where(mask, SURE, -SURE).astype(np.float32), int(mask.sum())
        for frame in range(start + step, len(footage.clip) if step > 0 else -1, step):
            prior = _carried(footage, frame, frame - step, before)
            lost = not (prior > 0).any()
            near = np.ones_like(mask) if lost else _grown(prior > 0, reach_px)
            if allowed is not None:
                near &= allowed(frame)
            expected = 0 if lost else np.clip(prior, -carried, carried)
            log_odds = network.log_odds(footage.color(frame)) + expected
            log_odds[~near] = -SURE
            retained = _retained_parts(log_odds > 0, prior > 0, least_px=0.3 * size if lost else 0.0)
            before = np.where(retained, np.clip(log_odds, 1, SURE), np.clip(log_odds, -SURE, -1))
            before = before.astype(np.float32)
            size = int(retained.sum()) or size
            found[frame] = _packed(retained)
    return found


def _carried(
    footage: Footage, frame: int, other: int, log_odds: Float[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width"]:
    """Carry log-odds of another frame to this one along the flow."""
    moved = footage.to(frame, other)
    assert moved is not None, f"flow of gap 1 is stored for frames {frame} and {other}"
    columns, rows = (np.arange(side, dtype=np.float32) for side in log_odds.shape[::-1])
    x, y, border = moved[..., 0] + columns, moved[..., 1] + rows[:, None], cv2.BORDER_CONSTANT
    return cv2.remap(log_odds, x, y, cv2.INTER_LINEAR, borderMode=border, borderValue=-SURE)


def _retained_parts(
    inside: Bool[np.ndarray, "height width"], prior: Bool[np.ndarray, "height width"], least_px: float
) -> Bool[np.ndarray, "height width"]:
    """Keep the parts that meet the carried mask; with none carried, the largest one if large enough."""
    count, part, stats, _ = cv2.connectedComponentsWithStats(inside.astype(np.uint8))
    if count == 1:
        return inside
    met = np.bincount(part[prior], minlength=count) if prior.any() else stats[:, cv2.CC_STAT_AREA] * 1.0
    met[0] = 0
    if not prior.any():
        return (part == met.argmax()) & (met.max() >= least_px)
    return ((met > 0.1 * met.max()) & (met > 0))[part]


def _allowed(rough: list[bytes]) -> Callable[[int], Bool[np.ndarray, "height width"]]:
    """Return where the animal may be: near the followed part, anywhere where that was lost."""

    def allowed(frame: int) -> Bool[np.ndarray, "height width"]:
        followed = _unpacked(rough[frame])
        return _grown(followed, BESIDE_PX + 5) if followed.any() else ~followed

    return allowed


def _grown(mask: Bool[np.ndarray, "height width"], by_px: int) -> Bool[np.ndarray, "height width"]:
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * by_px + 1, 2 * by_px + 1))
    return cv2.dilate(mask.astype(np.uint8), disk) > 0


def _packed(mask: Bool[np.ndarray, "height width"]) -> bytes:
    """Compress a mask, so that a long recording fits in memory."""
    return cv2.imencode(".png", mask.astype(np.uint8))[1].tobytes()


def _unpacked(packed: bytes) -> Bool[np.ndarray, "height width"]:
    mask = cv2.imdecode(np.frombuffer(packed, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert mask is not None, "a PNG of our own"
    return mask > 0
