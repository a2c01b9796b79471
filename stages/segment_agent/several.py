"""Masks of several animals: all are segmented together, so that each pixel belongs to one.

The network trained on all turnarounds (`identity`) classifies what moves; then each animal is handled like a
single one (`masks`): track, appearance in this recording, mask. In the masks of an animal, pixels of the
others are unknown.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.core.errors import InputError
from pipeline.core.progress import log
from pipeline.data.clips import Clip
from pipeline.geometry import subsampling
from stages.segment_agent import free_space, identity, masks, people
from stages.segment_agent.config import Config
from stages.segment_agent.evidence import ROOM, Evidence, EvidenceOf, motion_evidence
from stages.segment_agent.free_space import References
from stages.segment_agent.identity import Identities, Portrait
from stages.segment_agent.locate import AppearanceOf, find_mover, recognized_bodies
from stages.segment_agent.masks import Segmentation
from stages.segment_agent.segmenter import Mask, Segmenter, with_color_histogram
from stages.segment_agent.trajectory import estimate_without_movers
from stages.segment_agent.windows import Sphere, Window, tracked, working_picture, working_size

QUANTIZATION = 127 / identity.MAX_LOG_ODDS
"""8-bit levels per unit of stored log-odds"""
MIN_FRAMES = 5
"""frames in which a whole body must clearly show an animal for it to be present"""
OTHER_LOG_ODDS = -1.0
"""log-odds below which a pixel without evidence of an animal belongs to another one"""
PORTRAITS_SHARE = 0.25
"""portraits for training, as a share of the recording's examples: more would outweigh its room"""
LEARNING_ROUNDS = 2
"""rounds of learning: the first masks hold only animals that travel, the next ones those that rest, too"""
STRANGER_SHARE = 0.5
"""share of unknown animals among frames with a track above which an animal has no turnaround; fewer may be
visitors"""


@dataclass
class IdentityScores:
    """Log-odds of a frame's pixels per animal and for unknown ones, computed once and cached compressed."""

    clip: Clip
    network: Identities
    height_px: int
    cached: dict[int, bytes] = field(default_factory=dict)

    def of(self, animal: int) -> AppearanceOf:
        """Return the log-odds of one animal against all others; the index after the last is a stranger."""
        return lambda frame: self._all(frame)[animal]

    def recognized(self, animal: int) -> AppearanceOf:
        """Return the log-odds of one animal against all others and the room."""
        return lambda frame: self._all(frame)[animal] - identity.MOTION_LOG_ODDS

    def against_others(self, animal: int) -> AppearanceOf:
        """Return the log-odds of one animal against the others only, where geometry shows an animal."""
        return lambda frame: self._all(frame)[len(self.network.names) + 1 + animal]

    def _all(self, frame: int) -> Float[np.ndarray, "animal height width"]:
        animals = range(len(self.network.names))
        count = 2 * len(animals) + 1
        if frame not in self.cached:
            log_prob = self.network.predict(working_picture(self.clip, frame, self.height_px))
            log_odds = [identity.identity_log_odds(log_prob, animal) for animal in animals]
            log_odds.append(identity.stranger_log_odds(log_prob))
            log_odds += [identity.identity_log_odds(log_prob, animal, np.inf) for animal in animals]
            rounded = np.round(np.stack(log_odds) * QUANTIZATION + 128).astype(np.uint8)
            self.cached[frame] = cv2.imencode(".png", rounded.reshape(-1, rounded.shape[-1]))[1].tobytes()
        stored = cv2.imdecode(np.frombuffer(self.cached[frame], np.uint8), cv2.IMREAD_GRAYSCALE)
        assert stored is not None, "a PNG of our own"
        return (stored.reshape(count, -1, stored.shape[1]).astype(np.float32) - 128) / QUANTIZATION


def segment(
    clip: Clip, flow: Path, network: Identities, portraits: Sequence[Portrait], config: Config
) -> dict[str, Segmentation]:
    """Return each animal's masks, one per frame, with poses, people, and the share of unknown animals.

    Raises InputError MSK-007 if unknown animals prevail.
    """
    path = estimate_without_movers(clip, flow, config.references, config.seed)
    poses, scores = path.world_from_camera, IdentityScores(clip, network, config.height_px)
    references, persons = people.gather_without_people(clip, poses, config.references)
    stranger_margin = scores.of(len(network.names))
    unknown = tracked(find_mover(clip, poses, references, config.animal, None, margin_of=stranger_margin))
    segmenters = find_all(clip, poses, references, config, scores, portraits)
    known = [tracked(segmenter.spheres) for segmenter in segmenters]
    for name, seen in zip(network.names, known, strict=True):
        log(f"{name}: tracked in {seen.sum()} of {len(clip)} frames" if seen.any() else f"{name} is not here")
    share = unknown.sum() / max(np.any([unknown, *known], axis=0).sum(), MIN_FRAMES)
    if share > STRANGER_SHARE:
        what = f"in {100 * share:.0f} % of the frames that show an animal it matches no turnaround"
        remedy = "film a turnaround of each animal that lives here (turnaround_<name>), or leave this out"
        raise InputError("MSK-007", what, str(clip.folder), remedy)

    def segmentation(own: int) -> Segmentation:
        found = (resolve_overlaps(segmenters, scores, own, frame) for frame in range(len(clip)))
        found = people.hide(found, persons, clip, poses)
        return Segmentation(found, path, persons, float(unknown.mean()), references, "one of several")

    return {name: segmentation(index) for index, name in enumerate(network.names)}


def find_all(
    clip: Clip,
    poses: Float[np.ndarray, "frame 4 4"],
    references: References,
    config: Config,
    scores: IdentityScores,
    portraits: Sequence[Portrait],
) -> list[Segmenter]:
    """Prepare the masks of every animal: by motion and identity, then by the appearance learned from them."""
    animals = range(len(scores.network.names))
    evidence_of = motion_evidence(references)
    segmenters, known = [], []
    portrait_count = round(PORTRAITS_SHARE * config.learning.examples)
    margins = [scores.of(animal) for animal in animals]
    present = recognized_bodies(clip, poses, references, config.animal, margins) >= MIN_FRAMES
    for animal in animals:
        spheres: list[Sphere | None] = [None] * len(clip)
        if present[animal]:
            spheres = find_mover(clip, poses, references, config.animal, None, margin_of=margins[animal])
        own = identity_evidence(evidence_of, scores.against_others(animal))
        segmenters.append(with_color_histogram(Segmenter(clip, poses, spheres, own, config.height_px)))
        examples = examples_of(portraits, animal, portrait_count)
        known.append(masks.KnownAppearance(examples, scores.recognized(animal)))
    found, networks = segmenters.copy(), [None for _ in animals]

    def occluded(frame: int) -> Bool[np.ndarray, "height width"]:
        inside = [np.zeros(working_size(clip, config.height_px), bool)]
        for segmenter, network in zip(found, networks, strict=True):
            inside += [] if network is None else [masks.occlusion_mask(segmenter, frame, network)]
        return np.any(inside, axis=0)

    for attempt in range(LEARNING_ROUNDS):
        rngs = [np.random.default_rng([config.seed, animal, attempt]) for animal in animals]
        learned = [
            masks.learn_appearance(found[animal], references, config, rngs[animal], known[animal])
            for animal in animals
        ]
        networks = [new or old for new, old in zip(learned, networks, strict=True)]
        room = free_space.masked(references, occluded)
        for animal, network in enumerate(networks):
            if network is not None:
                appearance, margin_of = masks.appearance_of(found[animal], network), scores.of(animal)
                spheres = find_mover(clip, poses, room, config.animal, None, appearance, margin_of)
                spheres = masks.with_motion_radius(spheres, segmenters[animal].spheres)
                own = identity_evidence(motion_evidence(room), scores.against_others(animal))
                found[animal] = replace(found[animal], spheres=spheres, evidence_of=own, appearance=network)
    return found


def examples_of(portraits: Sequence[Portrait], animal: int, portrait_count: int) -> list[Portrait]:
    """Return evenly chosen portraits of one animal."""
    own = [each for each in portraits if each.animal == animal]
    return [own[index] for index in subsampling.evenly(len(own), portrait_count)]


def identity_evidence(evidence_of: EvidenceOf, margin_of: AppearanceOf) -> EvidenceOf:
    """Refine evidence: pixels of other animals count against this one."""

    def refined(frame: int, window: Window, sphere: Sphere) -> Evidence:
        evidence = evidence_of(frame, window, sphere)
        scores = margin_of(frame)[window.rows, window.columns]
        _, probability = identity.select_animal(evidence.log_odds > 0, scores)
        sharp = np.log(np.clip(probability, 1e-3, 1) / np.clip(1 - probability, 1e-3, 1))
        scores = np.where(evidence.log_odds > 0, sharp, cv2.blur(scores, (5, 5)))
        other_animal = scores < np.where(evidence.log_odds > 0, 0, OTHER_LOG_ODDS)
        return Evidence(
            np.where(other_animal, np.clip(scores, -ROOM, evidence.log_odds), evidence.log_odds),
            np.where(other_animal, np.maximum(evidence.certainty, 0.5), evidence.certainty),
            evidence.animal & ~other_animal,
            evidence.moving & ~other_animal,
            evidence.room | other_animal,
            np.where(other_animal, 0.0, evidence.color_log_odds),
        )

    return refined


def resolve_overlaps(segmenters: list[Segmenter], scores: IdentityScores, own: int, frame: int) -> Mask:
    """Make one animal's mask of a frame, at color resolution, with the others' pixels unknown."""
    found = [next(segmenter.masks([frame])) for segmenter in segmenters]
    own_mask, labels = found[own], found[own].labels.copy()
    own_margin = scores.against_others(own)(frame)
    own_margin = cv2.resize(own_margin, labels.shape[::-1], interpolation=cv2.INTER_LINEAR)
    for index, other in enumerate(found):
        if index == own:
            continue
        contested = (labels == 255) & (other.labels == 255)
        lost = contested & (own_margin < 0)
        labels[lost | ((other.labels > 0) & (labels != 255))] = 128
    visible = own_mask.visible and bool((labels == 255).any())
    return replace(own_mask, labels=labels, visible=visible)
