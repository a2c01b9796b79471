"""Which way the animal faces over time: the likeliest path through headings, and the placement of each frame on it.

To depth, front and back look almost alike, and every fit errs by some degrees; over time an animal turns steadily and
walks head first. Frames that show little, fit badly or repeat what was seen say little.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline import viterbi


@dataclass(frozen=True)
class HeadingOptions:
    """What speaks for a heading, in units of cost."""

    steps: int = 36
    """Headings of the grid."""
    noise_deg: float = 20.0
    """A placement turned by this from a heading costs one unit more ..."""
    most_cost: float = 12.0
    """... and one frame speaks against a heading by at most this."""
    motion_weight: float = 4.0
    """Units for walking tail first ..."""
    walking_m_s: tuple[float, float] = (0.25, 0.6)
    """... counting from the first speed, fully from the second, m/s: an animal that turns on the spot shows other sides."""
    turn_deg: float = 30.0
    """A turn by this in a tenth of a second costs one unit ..."""
    flip_cost: float = 40.0
    """... up to so many units."""
    still_weight: float = 0.06
    """Weight of a frame in which neither animal nor phone moves, against one that shows something new."""
    enough_share: float = 0.2
    """Frames that show less of the animal than this share count less, in proportion."""
    misfit: float = 6.0
    """Frames whose best placement costs so many units more than the usual frame's count half."""


@dataclass(frozen=True)
class Candidates:
    """Placements of one frame and what each costs, in units; pictures are read again when they are needed again."""

    frame: int
    world_from_agent: Float[np.ndarray, "candidate 4 4"]
    cost: Float[np.ndarray, "candidate"]
    least_misfit: float
    """Cost of the best placement, by shape and colour alone."""
    share: float
    """Visible area over the area in full view, 0..1."""
    middle_world: Float[np.ndarray, "3"]
    """Middle of the points that were seen."""
    eye_world: Float[np.ndarray, "3"]


@dataclass(frozen=True)
class Pace:
    """How things moved around each frame."""

    velocity: Float[np.ndarray, "glimpse 3"]
    """Horizontal velocity of the seen points' middle, m/s; zero across gaps."""
    novelty: Float[np.ndarray, "glimpse"]
    """0..1: how much a frame shows that its neighbours did not; repeated views err alike."""


def choose(timestamp_s: Float[np.ndarray, "frame"], candidates: list[Candidates], options: HeadingOptions) -> list[int]:
    """Choose one candidate per frame: the one that costs least, its turn from the likeliest heading included."""
    faced = path(timestamp_s, candidates, options)
    return [int(_turned_cost(each, angle, options).argmin()) for each, angle in zip(candidates, faced, strict=True)]


def path(timestamp_s: Float[np.ndarray, "frame"], candidates: list[Candidates], options: HeadingOptions) -> Float[np.ndarray, "glimpse"]:
    """Return the likeliest heading of each glimpse, radians, by dynamic programming over a grid of headings (Viterbi 1967)."""
    grid = 2 * np.pi * np.arange(options.steps) / options.steps - np.pi
    moves, weight = pace(timestamp_s, candidates, options.still_weight), weights(candidates, options)
    spoken = [_own_cost(each, grid, moves, index, options) * weight[index] for index, each in enumerate(candidates)]
    turn = (wrap(grid[:, None] - grid[None]) / np.deg2rad(options.turn_deg)) ** 2

    def turned(index: int) -> Float[np.ndarray, "before after"]:
        elapsed = timestamp_s[candidates[index].frame] - timestamp_s[candidates[index - 1].frame]
        tenths = max(elapsed / 0.1, 1.0)
        return np.minimum(turn / tenths, options.flip_cost / np.sqrt(tenths))

    return grid[viterbi.cheapest(spoken, turned)]


def weights(candidates: list[Candidates], options: HeadingOptions) -> Float[np.ndarray, "glimpse"]:
    """Return how far each frame is heard, 0..1: less where little is seen and where nothing fits, as under a wrong mask."""
    misfit, share = (np.array([getattr(each, name) for each in candidates]) for name in ("least_misfit", "share"))
    worse = np.maximum(misfit - np.median(misfit), 0) / options.misfit
    return np.minimum(share / options.enough_share, 1.0) / (1 + worse**2)


def pace(timestamp_s: Float[np.ndarray, "frame"], candidates: list[Candidates], still_weight: float, span: int = 3) -> Pace:
    """Measure motion over ``span`` glimpses before and after each."""
    middle = np.stack([each.middle_world for each in candidates]) * (1, 0, 1)
    phone = np.stack([each.eye_world for each in candidates])
    time = timestamp_s[[each.frame for each in candidates]]
    before, after = np.maximum(np.arange(len(time)) - span, 0), np.minimum(np.arange(len(time)) + span, len(time) - 1)
    elapsed = np.maximum(time[after] - time[before], 1e-3)[:, None]
    velocity = (middle[after] - middle[before]) / elapsed
    moved = np.linalg.norm(velocity, axis=1) + 0.5 * np.linalg.norm((phone[after] - phone[before]) / elapsed, axis=1)
    velocity[(elapsed[:, 0] > 1.2) | (elapsed[:, 0] < 0.15)] = 0
    return Pace(velocity, still_weight + (1 - still_weight) * np.minimum(moved / 0.4, 1.0))


def heading(world_from_agent: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch"]:
    """Return the angle of the head's direction (+z) about +y, radians."""
    return np.arctan2(world_from_agent[..., 0, 2], world_from_agent[..., 2, 2])


def wrap(angle: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    """Bring angles to -pi..pi."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _turned_cost(candidates, angle, options):
    """Return what each candidate costs as a sight of an animal that faces ``angle``."""
    turned = wrap(angle - heading(candidates.world_from_agent)) / np.deg2rad(options.noise_deg)
    return candidates.cost + np.minimum(turned**2, options.flip_cost)


def _own_cost(candidates, grid, moves, index, options):
    """Return what one frame says against each heading of the grid."""
    seen = _turned_cost(candidates, grid[:, None], options).min(1)
    cost = moves.novelty[index] * np.minimum(seen - seen.min(), options.most_cost)
    x, _, z = moves.velocity[index]
    slow, fast = options.walking_m_s
    walking = np.clip((np.hypot(x, z) - slow) / (fast - slow), 0, 1)
    return cost + options.motion_weight * walking * (1 - np.cos(grid - np.arctan2(x, z))) / 2
