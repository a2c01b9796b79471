"""Make recordings and truth of all scripts, several at once.

Each is a function of its script alone, so order and number of workers change nothing.
"""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from pipeline.core import processes, progress
from pipeline.data import plots, ply
from pipeline.geometry.meshes import Mesh
from stages.synthesize_capture import record3d, sheets
from stages.synthesize_capture.animal import BONES, Animal
from stages.synthesize_capture.film import Stage
from stages.synthesize_capture.room import Room
from stages.synthesize_capture.script import Script
from stages.synthesize_capture.truth import TruthWriter, write_flow

FLOW_PAIRS = 40
THUMBNAILS, OUTLINE = 6, (255, 0, 255)
"""Frames of a recording on the quality page, and the color around its animals."""


@dataclass(frozen=True)
class FilmedRecording:
    """A finished recording, as shown on the quality page."""

    visible_share: float | None
    """Share of the frames that show an animal; None if none is present."""
    thumbnails: list[UInt8[np.ndarray, "height width 3"]]
    """Some frames with the animals' outlines."""


def produce(
    scripts: list[Script],
    creature: Animal,
    recordings: Path,
    truth: Path,
    *,
    workers: int,
    companion: Animal | None = None,
) -> list[FilmedRecording]:
    """Make everything, longest recordings first; return in the order of the scripts.

    In a home of two each animal has a truth of its own, in a folder of its name.
    """
    order = sorted(range(len(scripts)), key=lambda index: -len(scripts[index].timestamp_s))
    jobs = [(scripts[index], creature, recordings, truth, companion) for index in order]
    if workers <= 1:
        done = ((number, record(*job)) for number, job in enumerate(jobs))
    else:
        done = processes.unordered(record, jobs, workers)
    made = {order[number]: each for number, each in progress.track(done, "recordings", total=len(jobs))}
    return [made[index] for index in range(len(scripts))]


def record(
    script: Script, creature: Animal, recordings: Path, truth_folder: Path, companion: Animal | None = None
) -> FilmedRecording:
    """Film one script into a `.r3d` file and its truth, for each animal its own."""
    stage = Stage(script, creature, companion)
    keep_depth = script.name == "heldout"
    truths = {truth_folder: TruthWriter(script, keep_depth)}
    if companion is not None:
        animals = enumerate((creature, companion))
        truths = {
            truth_folder / each.anatomy.name: TruthWriter(script, keep_depth, number)
            for number, each in animals
        }
    chosen = np.linspace(0, len(script.timestamp_s) - 1, THUMBNAILS).astype(int)
    thumbnails = []
    with record3d.Writer(recordings / f"{script.name}.r3d") as writer:
        for index, frame in enumerate(stage.frames()):
            writer.add(frame.color, frame.depth, frame.confidence)
            for truth in truths.values():
                truth.add(frame, index)
            if index in chosen:
                outlined = plots.outlined(frame.color, frame.masks[0] | frame.masks[1], OUTLINE)
                thumbnails.append(outlined[::2, ::2])
        writer.finish(script)
    for folder, truth in truths.items():
        folder.mkdir(exist_ok=True)
        truth.write(folder)
    if script.session is not None:
        first, *others = truths
        write_flow(stage, first, pairs=FLOW_PAIRS)
        for folder in others:
            shutil.copy(first / f"{script.name}.flow.npz", folder)
    there = any(motion is not None for motion in script.motions)
    visible = max(float(truth.visible().mean()) for truth in truths.values()) if there else None
    return FilmedRecording(visible, thumbnails)


def write_world(room: Room, creature: Animal, seed: int, folder: Path) -> None:
    """Write the room of the walk-through (world frame), the animal at rest (agent frame), and names."""
    about = {"seed": seed, "up": [0, 1, 0], "bones": [bone.name for bone in BONES]}
    (folder / "world.json").write_text(json.dumps(about, indent=1) + "\n")
    vertices, faces, coordinates, _owner = sheets.triangles(room.sheets())
    ply.write_ply(folder / "scene.ply", Mesh(vertices, faces, _room_colors(room, coordinates)))
    color = (np.clip(creature.fur[:, :3], 0, 1) ** (1 / 2.2) * 255).astype(np.uint8)
    ply.write_ply(folder / "agent.ply", Mesh(creature.vertices, creature.faces, color))


def _room_colors(room: Room, coordinates: np.ndarray) -> UInt8[np.ndarray, "vertex 3"]:
    colors, start = [], 0
    for sheet in room.sheets():
        count = sheet.points.shape[0] * sheet.points.shape[1]
        height, width, _ = sheet.picture.shape
        at = (coordinates[start : start + count] * [width - 1, height - 1]).astype(int)
        colors.append(sheet.picture[at[:, 1], at[:, 0]])
        start += count
    return np.concatenate(colors)
