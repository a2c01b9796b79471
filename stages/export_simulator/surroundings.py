"""Where the animal lives on the page: in its own home, or in that of another build, where a take was made."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.behavior.trajectories import UP, BehaviorData
from pipeline.core.errors import InputError
from pipeline.data import npz
from pipeline.geometry import rigid
from stages.export_simulator import reading
from stages.export_simulator.actions import SessionClip

_CLIP = "take"
REMEDY = "make it: make simulate AGENT=... HOME=..."
"""How a take in another home is made."""


@dataclass(frozen=True)
class Surroundings:
    """What a page shows of a home, and what happened in it."""

    surface: Path
    """PLY of the room's surface, world frame."""
    splats: Path
    """PLY of its Gaussians."""
    volume: Path
    """`volume.npz`, what the animal perceives."""
    motions: list[SessionClip]
    """To begin from and to replay."""
    roots_world: Float[np.ndarray, "frame 3"]
    """Where the animal has been, meters."""
    labels: dict[str, str] = field(default_factory=dict)
    """Of motions, where they are not recordings."""
    remark: str | None = None
    """What a visitor should know of them."""


def of(
    reconstruction: Path, splats: Path, behavior_data: Path, home: Path | None, take: Path | None, name: str
) -> Surroundings:
    """Return an animal's own home or, given both, the ``home`` of another build with a ``take`` in it.

    Raises EXP-003 where one of both is missing, and what `elsewhere` raises.
    """
    if home is None and take is None:
        return at_home(reconstruction, splats, behavior_data)
    if home is not None and take is not None:
        return elsewhere(home, take, name)
    what = "a page of another home needs that build and a take in it"
    raise InputError("EXP-003", what, "export_simulator", "give both --home and --take")


def at_home(reconstruction: Path, splats: Path, behavior_data: Path) -> Surroundings:
    """Return the animal's own home with its recordings."""
    tracks = BehaviorData.load(behavior_data).trajectories.values()
    roots = np.concatenate([track.world_from_agent[track.valid, :3, 3] for track in tracks])
    files = reconstruction / "scene.ply", splats / "scene.ply", behavior_data / "volume.npz"
    return Surroundings(*files, reading.motions(behavior_data), roots)


def elsewhere(home: Path, take: Path, name: str) -> Surroundings:
    """Return the home of another build with a take in it.

    Raises ART-003 where the build lacks its surfaces, EXP-003 for a take of the animal's own home.
    """
    surface, splats = home / "reconstruction/scene.ply", home / "splats/scene.ply"
    for file in (surface, splats):
        if not file.is_file():
            remedy = f"make it: make <agent>.{file.parent.name}"
            raise InputError("ART-003", f"has no {file.parent.name}", str(home), remedy)
    if not (take / "home.json").is_file():
        raise InputError("EXP-003", "is no take in another home", str(take), REMEDY)
    share = json.loads((take / "home.json").read_bytes())["share_known"]
    clip = _clip(take)
    remark = f"Home of {home.name}: {share:.0%} of it looks like the home that {name} knows."
    roots = clip.world_from_agent[:, :3, 3]
    labels = {_CLIP: f"a take in the home of {home.name}"}
    return Surroundings(surface, splats, take / "volume.npz", [clip], roots, labels, remark)


def _clip(take: Path) -> SessionClip:
    """Return a take as a motion; its observer looks at the animal."""
    names = ("timestamp_s", "world_from_agent", "agent_from_bone", "observer_world")
    time_s, agent, bones, eyes = (npz.load(take / "take.npz", names)[name] for name in names)
    camera = rigid.look_at(eyes, agent[:, :3, 3], UP)
    return SessionClip(_CLIP, time_s, agent, bones.astype(np.float64), camera)
