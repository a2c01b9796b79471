"""Masks of one recording from its own pictures: the steps of this stage in order."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, assert_never

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.core.errors import InputError
from pipeline.data.clips import Clip, usable_depth
from pipeline.geometry import subsampling
from pipeline.segmentation.appearance import Appearance, Example, learn
from pipeline.segmentation.recognizer import SHORTER_PX
from stages.segment_agent import free_space, movers, people, prompts
from stages.segment_agent.config import Config
from stages.segment_agent.evidence import motion_evidence, prefer_first, view_evidence
from stages.segment_agent.follow import follow
from stages.segment_agent.footage import Footage
from stages.segment_agent.free_space import References
from stages.segment_agent.locate import AppearanceOf, find_mover
from stages.segment_agent.movers import PlacedPrompt
from stages.segment_agent.overlap import Subject
from stages.segment_agent.people import People
from stages.segment_agent.prompts import Prompt
from stages.segment_agent.refine import Edges
from stages.segment_agent.resting import find_resting, is_resting
from stages.segment_agent.segmenter import Mask, Segmenter, with_color_histogram
from stages.segment_agent.trajectory import CameraPath, estimate_trajectory
from stages.segment_agent.turnaround import EDGES, axes_focus, find_standing, foreground_evidence
from stages.segment_agent.windows import Sphere, project_sphere, tracked, working_size

LEARNING_ROUNDS, MIN_GROWTH = 3, 1.25
"""rounds of learning the appearance, and growth of the number of tracked frames for which there is another:
first masks may show the animal only close by or from one side"""
POSITIVES_PER_NEGATIVE = 3
"""ratio of training pictures with the animal to those without it"""
MIN_RECALL, ATTEMPTS = 0.6, 3
"""minimum recall on training pictures, since an undertrained network would suppress the animal; attempts to
reach it, each from other initial weights and with twice the steps"""
GROWTH = 2.0
"""factor on the search radius of presumed spheres once the appearance is known, and of a mapped foreground"""
STATIC_STRIDE = 3
"""stride of depth samples that test a frame without a track for motion, pixels"""
PROBES = 12
"""number of frames for checks for which a few suffice"""
ROOM_QUANTILE = 0.95
"""quantile of the room's log-odds that an animal near its track has to exceed to be recognized"""
OUTLINE = Edges(unsure=0.0)
"""outlines of what a recognizer finds: unknown where GrabCut disagrees"""
DILATION = np.ones((5, 5), np.uint8)
"""dilation of what looks like the animal or moves, pixels or samples"""


@dataclass(frozen=True)
class Segmentation:
    """Masks of a recording and what they are based on."""

    masks: Iterator[Mask]
    """One per frame, generated lazily."""
    path: CameraPath | None = None
    """Camera poses; None without depth."""
    people: People | None = None
    """People in a session with depth."""
    unknown_animals: float | None = None
    """Share of frames with a moving animal that is none of several known ones."""
    references: References | None = None
    """Depth pictures for checking the masks; None without depth."""
    shown: Subject = "moving"
    """What the masks are of."""


def segment(
    clip: Clip,
    flow: Path,
    role: Literal["turnaround", "session"],
    prompt: Prompt | None,
    config: Config,
    rng: np.random.Generator,
    recognizer: Appearance | None = None,
) -> Segmentation:
    """Return one mask per frame, generated lazily, with the camera poses used, and people.

    ``flow`` is the recording's flow folder. Without any depth, the prompt is propagated; there are no poses.
    With a ``recognizer``, the animal of a session without prompt is what it recognizes.

    Raises:
        InputError: MSK-004 without depth and prompt; MSK-002, MSK-003 if prompt or cameras point at nothing.
    """
    probes = subsampling.evenly(len(clip), PROBES).tolist()
    if not any((clip.depth(frame) > 0).any() for frame in probes):
        if prompt is None:
            what = "there is no depth, so motion alone does not separate the animal from the room"
            remedy = "give a prompt: one box around the animal in one frame (<recording>.prompt.toml)"
            raise InputError("MSK-004", what, str(clip.folder), remedy)
        return Segmentation(follow(Footage(clip, flow, config.height_px), prompt, config.learning, rng))
    path = estimate_trajectory(clip, flow, rng)
    poses = path.world_from_camera
    placed = None if prompt is None else prompts.place(prompt, clip, poses)
    match role:
        case "turnaround":
            masks = standing_segmenter(clip, poses, placed, config).masks(range(len(clip)))
            references = free_space.gather(clip, poses, config.references)
            return Segmentation(masks, path, references=references, shown="resting")
        case "session":
            references, persons = people.gather_without_people(clip, poses, config.references)
            if recognizer is not None and placed is None:
                segmenter = _recognized_segmenter(clip, poses, references, config, recognizer, rng)
            else:
                segmenter = _session_segmenter(clip, poses, references, placed, config, rng)
            masks = people.hide(segmenter.masks(range(len(clip))), persons, clip, poses)
            shown = "moving" if placed is None else "resting"
            return Segmentation(masks, path, persons, references=references, shown=shown)
        case _:
            assert_never(role)


def standing_segmenter(
    clip: Clip, poses: Float[np.ndarray, "frame 4 4"], placed: PlacedPrompt | None, config: Config
) -> Segmenter:
    """Prepare the masks of what stands where a turnaround's axes meet. Raises MSK-003 as `segment` does."""
    focus = axes_focus(poses) if placed is None else placed.center_world
    spheres, evidence_of = find_standing(clip, poses, focus)
    if clip.mapped:
        spheres = [each and replace(each, radius_m=GROWTH * each.radius_m) for each in spheres]
        evidence_of = foreground_evidence(clip, evidence_of, working_size(clip, config.height_px))
    return with_color_histogram(Segmenter(clip, poses, spheres, evidence_of, config.height_px, edges=EDGES))


def _session_segmenter(
    clip: Clip,
    poses: Float[np.ndarray, "frame 4 4"],
    references: References,
    placed: PlacedPrompt | None,
    config: Config,
    rng: np.random.Generator,
) -> Segmenter:
    """Prepare the masks of a session: by motion, from which appearance is learned, then by both."""
    spheres = find_mover(clip, poses, references, config.animal, placed)
    evidence_of, resting = motion_evidence(references), None
    held = tracked(spheres).any()
    if placed is not None and (not held or is_resting(clip, poses, references, placed)):
        spheres, resting = find_resting(clip, poses, placed, config.height_px, rng)
        evidence_of = resting
    segmenter = with_color_histogram(Segmenter(clip, poses, spheres, evidence_of, config.height_px))
    for _ in range(LEARNING_ROUNDS):
        network = learn_appearance(segmenter, references, config, rng)
        if network is None:
            break
        room = free_space.masked(references, partial(occlusion_mask, segmenter, network=network))
        found = find_mover(clip, poses, room, config.animal, placed, appearance_of(segmenter, network))
        found, evidence_of = with_motion_radius(found, spheres), motion_evidence(room)
        evidence_of = evidence_of if resting is None else prefer_first(resting, evidence_of)
        grown = tracked(found).sum() > MIN_GROWTH * tracked(segmenter.spheres).sum()
        segmenter = Segmenter(clip, poses, found, evidence_of, config.height_px, network)
        if not grown:
            break
    return segmenter


def _recognized_segmenter(
    clip: Clip,
    poses: Float[np.ndarray, "frame 4 4"],
    references: References,
    config: Config,
    recognizer: Appearance,
    rng: np.random.Generator,
) -> Segmenter:
    """Prepare the masks of a session whose depth comes from the map: tracked by motion, then recognized.

    Its depth was inferred from the same recognition, at the same scale, so it is no evidence of its own.
    """
    spheres = find_mover(clip, poses, references, config.animal, None)
    height_px = round(clip.color_size[0] * min(1.0, SHORTER_PX / min(clip.color_size)))
    segmenter = Segmenter(clip, poses, spheres, view_evidence(poses), height_px, recognizer, OUTLINE, rng)
    room = free_space.masked(references, lambda frame: occlusion_mask(segmenter, frame, recognizer))
    found = find_mover(clip, poses, room, config.animal, None, appearance_of(segmenter, recognizer))
    return replace(segmenter, spheres=with_motion_radius(found, spheres) if tracked(spheres).any() else found)


def with_motion_radius(spheres: list[Sphere | None], first: list[Sphere | None]) -> list[Sphere | None]:
    """Give spheres tracked by appearance the radius found by motion alone: furniture may touch the animal."""
    radius_m = next(sphere.radius_m for sphere in first if sphere is not None)
    return [each and replace(each, radius_m=radius_m * (GROWTH if each.presumed else 1)) for each in spheres]


def appearance_of(segmenter: Segmenter, network: Appearance) -> AppearanceOf:
    """Return the log-odds of a network at working resolution, frame by frame."""
    return lambda frame: network.log_odds(segmenter.working_picture(frame))


@dataclass(frozen=True)
class KnownAppearance:
    """The appearance of an animal in other recordings."""

    examples: Sequence[Example]
    """pictures of it"""
    recognized: AppearanceOf
    """log-odds of that appearance; near the track, what is recognized is unknown rather than background"""


def learn_appearance(
    segmenter: Segmenter,
    references: References,
    config: Config,
    rng: np.random.Generator,
    known: KnownAppearance | None = None,
) -> Appearance | None:
    """Train the appearance network on first masks, and on examples from other recordings if there are any.

    None if the animal is never seen, or recall is too low.
    """
    certain = tracked(segmenter.spheres)
    seen, empty = np.flatnonzero(certain), np.flatnonzero(~certain).tolist()
    if not len(seen):
        return None
    chosen = seen[subsampling.evenly(len(seen), config.learning.examples, rounded=True)]
    shown, credible = [], 0.0 if known is None else _credible_log_odds(segmenter, chosen, known.recognized)
    for frame in chosen.tolist():
        labels = segmenter.working_mask(frame).labels
        if known is not None:
            sought = _window(segmenter, frame, labels.shape)
            unsure = (labels == 0) & sought & (known.recognized(frame) > credible)
            labels = np.where(unsure, np.uint8(128), labels)
        shown.append(Example(segmenter.working_picture(frame), labels))
    room = [
        Example(segmenter.working_picture(frame), _label_room(segmenter, references, frame))
        for frame in empty[:: max(1, -(-len(empty) * POSITIVES_PER_NEGATIVE // len(shown)))]
    ]
    elsewhere = () if known is None else known.examples
    probes = [each for each in shown[:: max(1, len(shown) // PROBES)] if (each.labels == 255).any()]
    for attempt in range(ATTEMPTS if probes else 0):
        learning = replace(config.learning, steps=config.learning.steps << attempt)
        network = learn([*shown, *elsewhere], learning, rng, room=room)
        if network is None:
            break
        recall = [(network.log_odds(each.color)[each.labels == 255] > 0).mean() for each in probes]
        if np.mean(recall) > MIN_RECALL:
            return network
    return None


def _credible_log_odds(
    segmenter: Segmenter, seen: Int[np.ndarray, "frame"], recognized: AppearanceOf
) -> float:
    """Return the log-odds, at least 0, that the room rarely exceeds far from the animal's track."""
    far = [np.zeros(1, np.float32)]
    for frame in seen[subsampling.evenly(len(seen), PROBES)].tolist():
        log_odds = recognized(frame)
        far.append(log_odds[~_window(segmenter, frame, log_odds.shape)])
    return max(0.0, float(np.quantile(np.concatenate(far), ROOM_QUANTILE)))


def _label_room(
    segmenter: Segmenter, references: References, frame: int
) -> UInt8[np.ndarray, "height width"]:
    """Label a frame without a track: background, except for what moves, which is unknown.

    An undetected resting animal is outweighed by the frames in which it moves.
    """
    clip, pose = segmenter.clip, segmenter.world_from_camera[frame]
    depth = usable_depth(clip, frame, keep_steps=False)
    points = free_space.world_points(clip, frame, pose, depth, STATIC_STRIDE)
    moving = movers.moving(free_space.vote(references, points, frame))
    size, near = working_size(clip, segmenter.height_px), cv2.dilate(moving.astype(np.uint8), DILATION)
    return cv2.resize(near, size[::-1], interpolation=cv2.INTER_NEAREST) * np.uint8(128)


def occlusion_mask(segmenter: Segmenter, frame: int, network: Appearance) -> Bool[np.ndarray, "height width"]:
    """Mark where the animal, by its appearance, occludes the room; near its track, if it was seen to move."""
    color = segmenter.working_picture(frame)
    shown = network.log_odds(color) > 0
    if tracked(segmenter.spheres)[frame]:
        shown &= _window(segmenter, frame, color.shape[:2])
    return cv2.dilate(shown.astype(np.uint8), DILATION) > 0


def _window(segmenter: Segmenter, frame: int, size: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
    """Mark the search window: the bounding rectangle of the frame's sphere."""
    inside, sphere = np.zeros(size, bool), segmenter.spheres[frame]
    if sphere is not None:
        pose = segmenter.world_from_camera[frame]
        rows, columns = project_sphere(segmenter.clip, frame, pose, sphere, size)
        inside[rows, columns] = True
    return inside
