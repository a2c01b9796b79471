"""Masks of one animal of several: all of them are found in a recording together, so that each pixel is one's.

Who it is that moves is asked of the network that learned all turnarounds (`identity`); from there on each
animal goes the way of a single one (`masks`): its track, its appearance in this recording, its mask. Pixels
of the others are unknown in the mask of the one that is followed: neither it nor the room.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.core.errors import InputError
from pipeline.core.progress import log
from pipeline.data.clips import Clip
from pipeline.geometry import subsampling
from stages.segment_agent import free_space, masks, people
from stages.segment_agent.appearance import Appearance, Example
from stages.segment_agent.config import Config
from stages.segment_agent.evidence import ROOM, Evidence, Judge, judge_motion
from stages.segment_agent.free_space import References
from stages.segment_agent.identity import LIMIT, MOVES, Identities, Portrait, margin, of_one, stranger
from stages.segment_agent.locate import AppearanceOf, find_mover
from stages.segment_agent.masks import Segmentation
from stages.segment_agent.painting import Mask, Painter, learn_palette
from stages.segment_agent.refine import Palette
from stages.segment_agent.trajectory import steady
from stages.segment_agent.windows import Sphere, Window, working_picture

STEPS = 127 / LIMIT
"""kept log-odds are rounded to one part of so many"""
MIN_FRAMES, RECOGNIZED = 5, 0.75
"""frames in which an animal must be tracked to be in the recording, and the mean probability of its pixels"""
ANOTHERS = -1.0
"""log-odds from which on a pixel that geometry knows nothing of is another animal's"""
PORTRAITS_SHARE = 0.25
"""portraits to learn from, as a share of the recording's own examples: more outweigh its room"""
STRANGER_SHARE = 0.5
"""share of the frames in which anything is tracked that show a stranger, from which on an animal without a
turnaround lives here; less may be one that visits"""


@dataclass
class Margins:
    """Per animal, and for strangers, the log-odds of a frame's pixels, judged once and stored compressed."""

    clip: Clip
    network: Identities
    height_px: int
    judged: dict[int, bytes] = field(default_factory=dict)

    def of(self, animal: int) -> AppearanceOf:
        """Return the log-odds of one animal against all others; of the number after the last, of nobody."""
        return lambda frame: self._all(frame)[animal]

    def recognized(self, animal: int) -> AppearanceOf:
        """Return the log-odds of one animal against all others and the room."""
        return lambda frame: self._all(frame)[animal] - MOVES

    def between(self, animal: int) -> AppearanceOf:
        """Return the log-odds of one animal against the others alone: geometry says what is an animal."""
        return lambda frame: self._all(frame)[len(self.network.names) + 1 + animal]

    def _all(self, frame: int) -> Float[np.ndarray, "animal height width"]:
        animals = range(len(self.network.names))
        count = 2 * len(animals) + 1
        if frame not in self.judged:
            who = self.network.who(working_picture(self.clip, frame, self.height_px))
            own = [margin(who, animal) for animal in animals]
            found = [*own, stranger(who), *(margin(who, animal, np.inf) for animal in animals)]
            rounded = np.round(np.stack(found) * STEPS + 128).astype(np.uint8)
            self.judged[frame] = cv2.imencode(".png", rounded.reshape(-1, rounded.shape[-1]))[1].tobytes()
        stored = cv2.imdecode(np.frombuffer(self.judged[frame], np.uint8), cv2.IMREAD_GRAYSCALE)
        assert stored is not None, "a PNG of our own"
        return (stored.reshape(count, -1, stored.shape[1]).astype(np.float32) - 128) / STEPS


def segment(
    clip: Clip, flow: Path, followed: str, network: Identities, portraits: Sequence[Portrait], config: Config
) -> Segmentation:
    """Return one mask per frame of the animal that is followed, the poses they rest on, people, and the share
    of frames in which something moves about that is none of them.

    Raises InputError MSK-007 where that is most of them.
    """
    path = steady(clip, flow, np.random.default_rng(config.seed))
    poses, margins = path.world_from_camera, Margins(clip, network, config.height_px)
    references, walkers = people.set_apart(clip, poses, config.references)
    nobody = margins.of(len(network.names))
    strangers = tracked(find_mover(clip, poses, references, config.animal, None, apart=nobody))
    painters = find_all(clip, poses, references, config, margins, portraits)
    known = [tracked(painter.balls) for painter in painters]
    for name, seen in zip(network.names, known, strict=True):
        log(f"{name}: tracked in {seen.sum()} of {len(clip)} frames" if seen.any() else f"{name} is not here")
    _refuse_strangers(clip, strangers.sum() / max(np.any([strangers, *known], axis=0).sum(), MIN_FRAMES))
    own = network.names.index(followed)
    found = (joined(painters, margins, own, frame) for frame in range(len(clip)))
    found = people.hide(found, walkers, clip, poses)
    return Segmentation(found, path, walkers, float(strangers.mean()), references, "one of several")


def find_all(
    clip: Clip,
    poses: Float[np.ndarray, "frame 4 4"],
    references: References,
    config: Config,
    margins: Margins,
    portraits: Sequence[Portrait],
) -> list[Painter]:
    """Prepare the masks of every animal: what moves and is it, then the appearance learned from that."""
    count = len(margins.network.names)
    judge = judge_motion(references)
    painters, networks = [], []
    most = round(PORTRAITS_SHARE * config.learning.examples)
    for animal in range(count):
        apart = margins.of(animal)
        balls = find_mover(clip, poses, references, config.animal, None, apart=apart)
        own = judge_apart(judge, margins.between(animal))
        painter = Painter(clip, poses, balls, own, config.height_px, Palette())
        painter = replace(painter, appearance=learn_palette(painter))
        if not _is_here(painter, apart):
            painter = replace(painter, balls=[None] * len(clip))
        painters.append(painter)
        rng = np.random.default_rng([config.seed, animal])
        known = masks.Known(examples_of(portraits, animal, most), margins.recognized(animal))
        networks.append(masks.learn_appearance(painter, references, config, rng, known))
    room = free_space.without(references, lambda frame: _any_hidden(painters, networks, frame))
    judge = judge_motion(room)
    for animal, network in enumerate(networks):
        if network is None:
            continue
        painter, own = painters[animal], judge_apart(judge, margins.between(animal))
        like, apart = masks.appearance_of(painter, network), margins.of(animal)
        balls = find_mover(clip, poses, room, config.animal, None, like, apart)
        balls = masks.resized(balls, painter.balls)
        painters[animal] = replace(painter, balls=balls, judge=own, appearance=network)
    return painters


def examples_of(portraits: Sequence[Portrait], animal: int, most: int) -> list[Example]:
    """Return portraits of one animal as examples, evenly chosen."""
    own = [each for each in portraits if each.animal == animal]
    return [Example(own[index].color, own[index].labels) for index in subsampling.evenly(len(own), most)]


def judge_apart(judge: Judge, apart: AppearanceOf) -> Judge:
    """Evidence by a judge, where what another animal shows is not this one."""

    def judged(frame: int, window: Window, ball: Sphere) -> Evidence:
        evidence = judge(frame, window, ball)
        margins = apart(frame)[window.rows, window.columns]
        _, probability = of_one(evidence.log_odds > 0, margins)
        sharp = np.log(np.clip(probability, 1e-3, 1) / np.clip(1 - probability, 1e-3, 1))
        margins = np.where(evidence.log_odds > 0, sharp, cv2.blur(margins, (5, 5)))
        another = margins < np.where(evidence.log_odds > 0, 0, ANOTHERS)
        return Evidence(
            np.where(another, np.clip(margins, -ROOM, evidence.log_odds), evidence.log_odds),
            np.where(another, np.maximum(evidence.certainty, 0.5), evidence.certainty),
            evidence.animal & ~another,
            evidence.clear & ~another,
            evidence.room | another,
            np.where(another, 0.0, evidence.recolored),
        )

    return judged


def joined(painters: list[Painter], margins: Margins, own: int, frame: int) -> Mask:
    """Make the mask of one animal in one frame, at colour resolution, with the others' pixels unknown."""
    found = [next(painter.masks([frame])) for painter in painters]
    mine, labels = found[own], found[own].labels.copy()
    apart = margins.between(own)(frame)
    apart = cv2.resize(apart, labels.shape[::-1], interpolation=cv2.INTER_LINEAR)
    for index, other in enumerate(found):
        if index == own:
            continue
        contested = (labels == 255) & (other.labels == 255)
        lost = contested & (apart < 0)
        labels[lost | ((other.labels > 0) & (labels != 255))] = 128
    visible = mine.visible and bool((labels == 255).any())
    return replace(mine, labels=labels, visible=visible)


def _is_here(painter: Painter, apart: AppearanceOf) -> bool:
    """Return whether what was tracked is this animal, by most of its pixels."""
    seen = np.flatnonzero(tracked(painter.balls)).tolist()
    if len(seen) < MIN_FRAMES:
        return False
    shares = []
    for frame in seen[:: max(1, len(seen) // masks.PROBES)]:
        inside = painter.working_mask(frame).labels == 255
        if inside.any():
            shares.append(float((1 / (1 + np.exp(-apart(frame)[inside]))).mean()))
    return bool(shares) and float(np.mean(shares)) > RECOGNIZED


def _any_hidden(
    painters: list[Painter], networks: list[Appearance | None], frame: int
) -> UInt8[np.ndarray, "height width"]:
    """Mark where any of the animals hides the room."""
    found = [
        masks.hidden(painter, frame, network)
        for painter, network in zip(painters, networks, strict=True)
        if network is not None
    ]
    size = painters[0].working_picture(frame).shape[:2]
    return np.any([np.zeros(size, bool), *found], axis=0)


def tracked(balls: Sequence[Sphere | None]) -> Bool[np.ndarray, "frame"]:
    """Return in which frames something is seen to move about."""
    return np.array([ball is not None and not ball.presumed for ball in balls])


def _refuse_strangers(clip: Clip, share: float) -> None:
    if share > STRANGER_SHARE:
        what = f"in {100 * share:.0f} % of the frames that show an animal it is none of the turnarounds'"
        remedy = "film a turnaround of each animal that lives here (turnaround_<name>), or leave this out"
        raise InputError("MSK-007", what, str(clip.folder), remedy)
