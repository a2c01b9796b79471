"""Warm start from a former reconstruction of the same home: its fields, body and motion.

New recordings are posed from their registration as usual; the others keep their poses. All are then optimized
together for `SHARE` of the usual steps.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from pipeline.core.errors import InputError, other_versions_refused
from pipeline.data import motion
from pipeline.data.motion import Motion
from pipeline.fields import fields
from pipeline.fields.encodings import DenseGrid
from pipeline.fields.fields import Field, Reconstruction
from pipeline.geometry import rigid
from stages.reconstruct.assemble import KNOT_FRAMES, RegisteredVideo, scene_first, scene_ids
from stages.reconstruct.config import PhaseSteps
from stages.reconstruct.problem import Problem

SHARE = 0.3
"""share of the usual steps of the scene and joint phases: the fields have nearly converged"""
SAME_WORLD_M = 0.3
"""largest median distance between a recording's cameras now and then, in one world: another walk-through has
another, and each turnaround's is its animal's"""
SAME_BONES = 0.01
"""largest difference of bones at rest, meters and axes, of one template that was built again"""
REBUILT = ("grid.levels.", "codes.", "fused.")
"""prefixes of the scene field's parameters whose shapes depend on the recordings; not loaded as they are"""


@dataclass(frozen=True)
class KnownMotion:
    """The agent's motion in the recordings of the former reconstruction."""

    frame: Int[Tensor, "known"]
    root: Float[Tensor, "known 6"]
    bone: Float[Tensor, "known bone 6"]

    @torch.no_grad()
    def write(self, problem: Problem) -> None:
        """Write root and bones into the motion table, as corrections of its initial poses."""
        table = problem.motion
        table.root[self.frame] = self.root.to(table.root)
        table.bone[self.frame] = self.bone.to(table.bone)


def begin(problem: Problem, videos: Sequence[RegisteredVideo], folder: Path) -> KnownMotion:
    """Initialize the problem's fields, body and cameras from the reconstruction at ``folder``.

    Returns the motion of the recordings it contains. Raises InputError RCN-003 if its fields have other
    sizes, its animal another template or its world another origin, ART-007 if another version wrote it.
    """
    with other_versions_refused("reconstruction", str(folder)):
        loaded = fields.load(folder, str(problem.device))
    former = {video.id: found for video in videos if (found := _former_motion(folder, video)) is not None}
    moved_m = {video.id: _moved_m(former[video.id], video) for video in videos if video.id in former}
    differences = _differences(problem, loaded)
    differences += [f"{id}'s cameras moved by {m:.1f} m" for id, m in moved_m.items() if m > SAME_WORLD_M]
    if differences:
        what = f"its fields differ from this recipe's: {differences[0]}"
        raise InputError("RCN-003", what, str(folder), "take it away to start from nothing")
    _load_fields(problem, loaded, scene_ids(videos))
    frames, roots, bones = [], [], []
    for index, video in enumerate(scene_first(videos)):
        if video.id in former:
            frame = torch.nonzero(problem.video == index)[:, 0]
            _load_cameras(problem, frame, former[video.id])
            frames.append(frame)
            roots.append(_twists(problem.motion.initial_agent[frame], former[video.id].world_from_agent))
            rest = problem.motion.agent_from_bone_rest.expand(len(frame), -1, -1, -1)
            bones.append(_twists(rest, former[video.id].agent_from_bone))
    count = len(problem.motion.agent_from_bone_rest)
    nothing = problem.video[:0], torch.zeros(0, 6), torch.zeros(0, count, 6)
    parts = zip(nothing, (frames, roots, bones), strict=True)
    return KnownMotion(*(torch.cat([empty, *found]) for empty, found in parts))


def shorter(steps: PhaseSteps) -> PhaseSteps:
    """Return the steps after a warm start: the agent's field needs no copy of the template."""
    return replace(steps, template=0, scene=round(SHARE * steps.scene), joint=round(SHARE * steps.joint))


def _former_motion(folder: Path, video: RegisteredVideo) -> Motion | None:
    """Return a recording's former motion; None if it was not part of the reconstruction or has changed."""
    for path in (folder / video.id / "motion.npz", folder / "templates" / f"{video.id}.npz"):
        if path.is_file():
            found = motion.load(path)
            if np.array_equal(found.timestamp_s, video.timestamp_s):
                return found
    return None


def _moved_m(former: Motion, video: RegisteredVideo) -> float:
    """Return the median distance between a recording's cameras then and now; 0 if none is known in both."""
    moved = np.linalg.norm((former.world_from_camera - video.world_from_camera)[:, :3, 3], axis=1)
    return float(np.nanmedian(moved)) if np.isfinite(moved).any() else 0.0


def _differences(problem: Problem, loaded: Reconstruction) -> list[str]:
    """Return what differs in kind, size or template between the former fields and the problem's."""
    grids = [isinstance(field.grid, DenseGrid) for field in (loaded.scene, problem.scene)]
    voxels_m = [field.shape.voxel_m for field in (loaded.scene, problem.scene)]
    found = [] if all(grids) else ["a scene without a grid is tied to its box"]
    found += [f"scene voxels of {voxels_m[0]} m, not {voxels_m[1]} m"] if voxels_m[0] != voxels_m[1] else []
    rest, own = (body.agent_from_bone_rest.cpu() for body in (loaded.body, problem.body))
    if rest.shape == own.shape and (moved_m := float((rest - own).abs().max())) > SAME_BONES:
        found.append(f"another agent template, whose bones differ by {moved_m:.2f}")
    for name in ("agent", "body", "scene"):
        before, now = (
            {key: tuple(value.shape) for key, value in getattr(whole, name).state_dict().items()}
            for whole in (loaded, problem)
        )
        for key in sorted(before.keys() | now.keys()):
            if before.get(key) != now.get(key) and not (name == "scene" and key.startswith(REBUILT)):
                found.append(f"{name}.{key} {before.get(key, 'missing')}, not {now.get(key, 'missing')}")
    return found


@torch.no_grad()
def _load_fields(problem: Problem, loaded: Reconstruction, ids: Sequence[str]) -> None:
    problem.agent.load_state_dict(loaded.agent.state_dict())
    problem.body.load_state_dict(loaded.body.state_dict())
    scene, former = problem.scene, loaded.scene
    rebuilt, before = (
        {name: value for name, value in field.state_dict().items() if name.startswith(REBUILT) == is_own}
        for field, is_own in ((scene, True), (former, False))
    )
    scene.load_state_dict(before | rebuilt)
    _resample_grid(scene, former)
    if scene.codes is not None and former.codes is not None:
        scene.codes.weight[:] = former.codes.weight.mean(0)
        for index, id in enumerate(ids):
            if id in loaded.videos:
                scene.codes.weight[index] = former.codes.weight[loaded.video_code(id)]


def _resample_grid(scene: Field, former: Field) -> None:
    """Resample the former grids at the nodes of the current ones, whose bounding box may differ."""
    grid, before = scene.grid, former.grid
    assert isinstance(grid, DenseGrid) and isinstance(before, DenseGrid), (grid, before)
    for level, extent, source, source_extent in zip(
        grid.levels, grid.extents, before.levels, before.extents, strict=True
    ):
        z, y, x = (torch.linspace(0, 1, count) for count in level.shape[2:])
        nodes = torch.stack(torch.meshgrid(z, y, x, indexing="ij")[::-1], dim=-1).to(level)
        place = (grid.low + nodes * extent - before.low.to(level)) / source_extent.to(level) * 2 - 1
        read = nn.functional.grid_sample(
            source.to(level), place[None], padding_mode="border", align_corners=True
        )
        level.copy_(read)


@torch.no_grad()
def _load_cameras(problem: Problem, frame: Int[Tensor, "frame"], former: Motion) -> None:
    """Set one recording's camera knots, each from the nearest frame with a known camera."""
    table = problem.motion
    known = np.flatnonzero(np.isfinite(former.world_from_camera).all((1, 2)))
    if not len(known):
        return
    twist = _twists(table.initial_camera[frame[known]], former.world_from_camera[known])
    first = int(table.knot[frame[0]])
    for knot in range(-(-len(frame) // KNOT_FRAMES) + 1):
        nearest = int(np.abs(known - knot * KNOT_FRAMES).argmin())
        table.camera[first + knot] = twist[nearest].to(table.camera)


def _twists(a_from_b: Float[Tensor, "*batch 4 4"], a_from_c: Float[np.ndarray, "*batch 4 4"]) -> Tensor:
    """Return the twists of ``b_from_c``; 0 where it is unknown."""
    b_from_c = rigid.inverse(a_from_b.double().cpu().numpy()) @ a_from_c
    known = np.isfinite(b_from_c).all((-1, -2))
    b_from_c[~known] = np.eye(4)
    return torch.from_numpy(rigid.log(b_from_c)).float()
