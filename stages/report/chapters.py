"""The chapters of the report in flow order: one per artifact, with the words a newcomer needs."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Chapter:
    """One page of the report."""

    artifact: str
    title: str
    sentence: str
    """what happened here, in plain words"""
    per_video: bool = False
    nobody_in: tuple[str, ...] = ()
    """its pictures (names with *) that are drawn from numbers or show the animal alone: nobody, and no more
    of the home than its outline, can be in them"""


CHAPTERS = (
    Chapter(
        "frames", "Frames", "Each recording became upright pictures at 10 per second with metric depth.", True
    ),
    Chapter(
        "flow",
        "Optical flow",
        "How every pixel moves between neighbouring pictures, both ways in time.",
        True,
    ),
    Chapter(
        "masks", "Masks", "Which pixels show the animal, found from depth and motion alone.", True, ("area",)
    ),
    Chapter("feature_basis", "Feature basis", "One basis of picture features, shared by all recordings."),
    Chapter(
        "features",
        "Features",
        "Every picture described in that basis, so that places can be recognised.",
        True,
    ),
    Chapter(
        "scene_template",
        "Map of the room",
        "The walk-through became a metric, upright map with known cameras.",
    ),
    Chapter(
        "agent_template",
        "Shape of the animal",
        "The turnaround became a first body with 25 bones.",
        nobody_in=("*",),
    ),
    Chapter(
        "scene_localizer",
        "Finding the camera",
        "Views rendered from the map teach where a picture was taken.",
        nobody_in=("errors",),
    ),
    Chapter(
        "agent_localizer",
        "Finding the animal",
        "Views rendered from the body teach how the animal stands.",
        nobody_in=("*",),
    ),
    Chapter(
        "video_poses", "Sessions on the map", "Each session's cameras and animal, placed on the map.", True
    ),
    Chapter(
        "registration",
        "Registration",
        "All sessions together in one world; those that do not fit are named.",
        nobody_in=("*",),
    ),
    Chapter(
        "reconstruction",
        "4D reconstruction",
        "Room, animal, bones and motion, fitted to all recordings at once.",
        nobody_in=("losses",),
    ),
    Chapter("splats", "Gaussians", "The same world as 3D Gaussians, refined for looks and motion."),
    Chapter(
        "behavior_data",
        "Behaviour data",
        "The motion cut into windows of 6.4 s, split by recording.",
        nobody_in=("*",),
    ),
    Chapter(
        "behavior",
        "Behaviour model",
        "Goal, path and body diffusion, conditioned on room, observer and past.",
        nobody_in=("*",),
    ),
    Chapter(
        "longterm",
        "Long-term motion",
        "Bodies at sub-goals, routes between them and poses along routes, in two-second pieces.",
        nobody_in=("*",),
    ),
    Chapter("simulator", "Simulator", "The page that lets the animal live, and files for other programs."),
    Chapter(
        "evaluation",
        "Evaluation",
        "Everything measured against what is known to be true.",
        nobody_in=("chart_*",),
    ),
)
