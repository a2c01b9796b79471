"""Masks of several animals: all are segmented together, so that each pixel belongs to one.

The network trained on all turnarounds (`identity`) classifies what moves; then each animal is handled like a
single one (`masks`): track, appearance in this recording, mask. In the masks of an animal, pixels of the
others are unknown.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.core.errors import InputError
from pipeline.core.progress import log
from pipeline.data.clips import Clip
from pipeline.geometry import subsampling
from stages.segment_agent import bodies, free_space, identity, masks, people
from stages.segment_agent.bodies import Bodies
from stages.segment_agent.config import Config
from stages.segment_agent.evidence import ROOM, Evidence, EvidenceOf, motion_evidence
from stages.segment_agent.free_space import References
from stages.segment_agent.identity import Identities, Portrait
from stages.segment_agent.locate import AppearanceOf, find_mover
from stages.segment_agent.masks import Segmentation
from stages.segment_agent.segmenter import Mask, Segmenter, with_color_histogram
from stages.segment_agent.trajectory import estimate_trajectory
from stages.segment_agent.windows import Sphere, Window, tracked, working_picture, working_size

QUANTIZATION = 127 / identity.MAX_LOG_ODDS
"""8-bit levels per unit of stored log-odds"""
MIN_FRAMES = 5
"""frames in which a body must clearly show an animal for it to be present"""
OTHER_LOG_ODDS = -1.0
"""log-odds below which a pixel without evidence of an animal belongs to another one"""
PORTRAITS_SHARE = 0.25
"""portraits for training, as a share of the recording's examples: more would outweigh its room"""
ADAPTATION_ROUNDS, MIN_SURE = 2, 3
"""rounds of adapting the identity network, since it then recognizes more bodies; how many of each animal that
is here it takes"""
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
    adapted: bool = False
    """whether the network knows this recording's room, and so what furniture looks like an animal"""

    @property
    def margins(self) -> list[AppearanceOf]:
        """Return `of` every animal."""
        return [self.of(animal) for animal in range(len(self.network.names))]

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
    path = estimate_trajectory(clip, flow, np.random.default_rng(config.seed))
    poses, scores = path.world_from_camera, IdentityScores(clip, network, config.height_px)
    references, persons = people.gather_without_people(clip, poses, config.references)
    stranger_margin = scores.of(len(network.names))
    unknown = tracked(find_mover(clip, poses, references, config.animal, None, margin_of=stranger_margin))
    moving = bodies.find_bodies(clip, poses, references, config.animal)
    moving = bodies.recognize(clip, moving, scores.margins)
    present = bodies.count(moving) >= MIN_FRAMES
    portrait_count = round(PORTRAITS_SHARE * config.learning.examples)
    turnarounds = [
        masks.KnownAppearance(examples_of(portraits, animal, portrait_count), scores.recognized(animal))
        for animal in range(len(present))
    ]
    scores, moving = adapt(scores, portraits, moving, present, config)
    segmenters = find_all(clip, poses, references, config, scores, turnarounds, present)
    known = [tracked(segmenter.spheres) for segmenter in segmenters]
    for name, seen in zip(network.names, known, strict=True):
        log(f"{name}: tracked in {seen.sum()} of {len(clip)} frames" if seen.any() else f"{name} is not here")
    share = unknown.sum() / max(np.any([unknown, *known], axis=0).sum(), MIN_FRAMES)
    if share > STRANGER_SHARE:
        what = f"in {100 * share:.0f} % of the frames that show an animal it matches no turnaround"
        remedy = "film a turnaround of each animal that lives here (turnaround_<name>), or leave this out"
        raise InputError("MSK-007", what, str(clip.folder), remedy)

    @cache
    def packed(frame: int) -> list[tuple[Mask, UInt8[np.ndarray, "byte"]]]:
        """Make a frame's masks once for all animals, as PNG, so that those of all frames fit in memory."""
        found, none = resolve_overlaps(segmenters, scores, frame, moving[frame]), np.zeros((0, 0), np.uint8)
        return [(replace(each, labels=none), cv2.imencode(".png", each.labels)[1]) for each in found]

    def segmentation(own: int) -> Segmentation:
        rows = (packed(frame)[own] for frame in range(len(clip)))
        found = (replace(mask, labels=cv2.imdecode(png, cv2.IMREAD_GRAYSCALE)) for mask, png in rows)
        found = people.hide(found, persons, clip, poses)
        return Segmentation(found, path, persons, float(unknown.mean()), references, "one of several")

    return {name: segmentation(index) for index, name in enumerate(network.names)}


def adapt(
    before: IdentityScores,
    portraits: Sequence[Portrait],
    moving: list[Bodies],
    present: Bool[np.ndarray, "animal"],
    config: Config,
) -> tuple[IdentityScores, list[Bodies]]:
    """Train the identity network on with sure bodies of this recording; return scores of pixels and bodies.

    Half of an animal's pictures are of its turnaround. If one that is ``present`` has too few sure bodies,
    the network stays as it was, and bodies show no animal. They never show one that is absent.
    """
    scores, clip, names = before, before.clip, before.network.names
    here, most = np.flatnonzero(present).tolist(), config.learning.examples
    for attempt in range(ADAPTATION_ROUNDS):
        sure = [bodies.sure(moving, animal, most) for animal in here]
        if min(map(len, sure), default=0) < MIN_SURE:
            return before, bodies.restricted(moving, np.zeros_like(present))
        pictures = list(portraits)
        for animal, rows in zip(here, sure, strict=True):
            count = sum(each.animal == animal for each in portraits)
            shown = [bodies.portrait(clip, moving, config.height_px, animal, *row) for row in rows]
            pictures += shown * -(-count // len(shown))
        rng = np.random.default_rng([config.seed, len(names), attempt])
        network = identity.learn_identities(pictures, names, config.learning, rng, before.network)
        scores = IdentityScores(clip, network, config.height_px, adapted=True)
        moving = bodies.recognize(clip, moving, scores.margins)
    return scores, bodies.restricted(moving, present)


def find_all(
    clip: Clip,
    poses: Float[np.ndarray, "frame 4 4"],
    references: References,
    config: Config,
    scores: IdentityScores,
    known: Sequence[masks.KnownAppearance],
    present: Bool[np.ndarray, "animal"],
) -> list[Segmenter]:
    """Prepare the masks of all animals: by motion and identity, then by the appearance learned from them."""
    animals = range(len(scores.network.names))
    evidence_of = motion_evidence(references)
    segmenters = []
    for animal in animals:
        spheres: list[Sphere | None] = [None] * len(clip)
        if present[animal]:
            spheres = find_mover(clip, poses, references, config.animal, None, margin_of=scores.of(animal))
        own = identity_evidence(evidence_of, scores.against_others(animal))
        segmenters.append(with_color_histogram(Segmenter(clip, poses, spheres, own, config.height_px)))
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
                appearance = masks.appearance_of(found[animal], network)
                margin_of = scores.recognized(animal) if scores.adapted else scores.of(animal)
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
            evidence.seen_through & ~other_animal,
            evidence.room | other_animal,
            np.where(other_animal, 0.0, evidence.color_log_odds),
        )

    return refined


def resolve_overlaps(
    segmenters: Sequence[Segmenter], scores: IdentityScores, frame: int, moving: Bodies
) -> list[Mask]:
    """Make the animals' masks of a frame, at color resolution, with the others' pixels unknown.

    A body that surely shows an animal is that animal's as a whole; the network decides about other pixels.
    """
    found, resolved = [next(segmenter.masks([frame])) for segmenter in segmenters], []
    claims = np.stack([each.labels == 255 for each in found])
    claimed, touched = claims.any(0), np.any([each.labels > 0 for each in found], axis=0)
    height, width = claims.shape[1:]
    owner = bodies.owners(moving, (height, width))
    for animal, mask in enumerate(found):
        margin = scores.against_others(animal)(frame)
        margin = cv2.resize(margin, (width, height), interpolation=cv2.INTER_LINEAR)
        alone = claims[animal] & ((claims.sum(0) == 1) | (margin >= 0))
        own = claimed & np.where(owner == bodies.UNCLEAR, alone, mask.visible & (owner == animal))
        labels = np.where(own, np.uint8(255), touched * np.uint8(128))
        resolved.append(replace(mask, labels=labels, visible=mask.visible and bool(own.any())))
    return resolved
