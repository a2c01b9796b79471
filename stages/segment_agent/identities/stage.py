"""The stage: all turnarounds of a home -> the network that distinguishes its animals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from pipeline.core.errors import InputError
from pipeline.core.progress import log
from pipeline.core.videos import Video
from pipeline.data import plots, qa
from pipeline.data.clips import Clip
from pipeline.geometry import subsampling
from stages.segment_agent import identity, masks
from stages.segment_agent.config import Config as MaskConfig
from stages.segment_agent.identities.config import Config
from stages.segment_agent.identity import Identities, Portrait
from stages.segment_agent.trajectory import estimate_trajectory

MIN_RECOGNIZED = 0.8
"""minimum recall of each animal's pixels in test portraits"""
TEST_EVERY = 4
"""one portrait in so many is held out for testing"""


@dataclass(frozen=True)
class Inputs:
    """What the stage reads: folders of the turnarounds by id."""

    frames: Mapping[str, Path]
    flow: Mapping[str, Path]


def run(inputs: Inputs, config: Config, out: Path, *, videos: Sequence[Video] = ()) -> Identities:
    """Learn to distinguish the animals and write the network, and what it learned from, into `out`.

    Raises InputError MSK-005 where two look the same, MSK-008 where too few masks show one of them.
    """
    animal_of = {video.id: video.animal for video in videos if video.animal}
    names = tuple(sorted(animal_of[id] for id in inputs.frames))
    rng = np.random.default_rng(config.seed)
    learned, tested = [], []
    for id, folder in inputs.frames.items():
        found = portraits(folder, inputs.flow[id], names.index(animal_of[id]), config, rng)
        tested += found[TEST_EVERY // 2 :: TEST_EVERY]
        learned += [each for index, each in enumerate(found) if index % TEST_EVERY != TEST_EVERY // 2]
    for index, name in enumerate(names):
        if index not in {each.animal for each in tested}:
            remedy = f"film the turnaround of {name} again, closer and by more light"
            what = f"hardly any mask of the turnaround shows {name}"
            raise InputError("MSK-008", what, str(next(iter(inputs.frames.values())).parent), remedy)
    network = identity.learn_identities(learned, names, config, rng)
    shares = dict(zip(names, identity.recognition_rates(network, tested).tolist(), strict=True))
    log("recognized: " + ", ".join(f"{name} {100 * share:.0f} %" for name, share in shares.items()))
    if min(shares.values()) < MIN_RECOGNIZED:
        what = f"{' and '.join(names)} look the same: {100 * min(shares.values()):.0f} % recognized"
        remedy = "is it one animal with two turnarounds? Keep one; else film both by the same light"
        raise InputError("MSK-005", what, str(next(iter(inputs.frames.values())).parent), remedy)
    network.save(out)
    identity.save_portraits(out, learned)
    checks = [
        qa.Check(f"pixels of {name} recognized", 100 * share, "%", 92, 100 * MIN_RECOGNIZED, "higher")
        for name, share in shares.items()
    ]
    qa.write(
        out,
        good="each animal in one color, whole",
        bad="animals of two colors: they look alike, or one turnaround shows both",
        checks=checks,
        pictures=qa.captioned(
            {"portraits": "Held-out portraits, every pixel in the color of its predicted identity."},
            portraits=sheet(network, tested),
        ),
    )
    return network


def portraits(
    frames: Path, flow: Path, animal: int, config: Config, rng: np.random.Generator
) -> list[Portrait]:
    """Segment frames spread evenly over a turnaround, at working resolution."""
    clip = Clip.open(frames)
    poses = estimate_trajectory(clip, flow, rng).world_from_camera
    segmenter = masks.standing_segmenter(clip, poses, None, MaskConfig(height_px=config.height_px))
    found = [
        Portrait(segmenter.working_picture(frame), segmenter.working_mask(frame).labels, animal)
        for frame in subsampling.evenly(len(clip), config.portraits).tolist()
    ]
    return [each for each in found if (each.labels == 255).any()]


def sheet(
    network: Identities, tested: Sequence[Portrait], columns: int = 6
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw portraits with each of the animal's pixels in the color of its predicted identity."""
    tiles = []
    for each in tested[:: max(1, len(tested) // (2 * columns))]:
        taken = network.predict(each.color)[1:].argmax(0)
        hue = (taken * 180 / len(network.names)).astype(np.uint8)
        vivid = np.full_like(hue, 255)
        tint = cv2.cvtColor(np.dstack([hue, vivid, vivid]), cv2.COLOR_HSV2RGB)
        inside = (each.labels == 255)[..., None]
        tiles.append(np.where(inside, each.color // 3 + 2 * (tint // 3), each.color // 2).astype(np.uint8))
    return plots.grid(tiles, columns)
