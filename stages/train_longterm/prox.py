"""Reader of the published PROX dataset: scans with signed distances, and SMPL-X fits of people in them.

It reads `scenes/<scene>.ply`, `sdf/<scene>.json` with `sdf/<scene>_sdf.npy`, `cam2world/<scene>.json`, and
`PROXD/<scene>_<person>_<take>/results/<frame>/000.pkl`. Fits are in the camera's frame; a scan's up axis is
the one along which people stand.
"""

import json
import pickle
import re
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from scipy import ndimage

from pipeline.core.errors import InputError
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh
from pipeline.geometry.signed_distance import SignedDistance, voxel_centers
from pipeline.longterm.short_motions import RATE_HZ, STEPS, BodyMotion, resample_motion
from pipeline.longterm.smplx_bodies import BODY, Person, motion_from_parameters, smplx_body
from pipeline.longterm.surroundings import MotionScene

FITS = "PROXD"
GAP_S = 0.5
"""a longer gap without fits ends a stretch of motion"""
NECK = 12
"""SMPL-X joint above the pelvis of a standing or sitting person"""
SHORTEST_S = STEPS / RATE_HZ
LARGEST_FIT = 1 << 20
"""maximum size of a fit's file, bytes; usual ones have a few thousand"""
_CLOCK = re.compile(r"__(\d+)\.(\d+)\.(\d+)\.(\d+)$")
_NAMES = ("transl", "global_orient", "body_pose", "left_hand_pose", "right_hand_pose")
_ALLOWED = {
    ("numpy", "ndarray"), ("numpy", "dtype"), ("_codecs", "encode"),
    *((f"{core}.multiarray", name) for core in ("numpy.core", "numpy._core")
      for name in ("_reconstruct", "scalar")),
}  # fmt: skip
"""globals that pickled arrays need; a fit cannot load anything else"""


@dataclass(frozen=True)
class PersonRecording:
    """Stretches of one recording's motion in the world of its scene (+y up, meters)."""

    scene: str
    motions: tuple[BodyMotion, ...]
    world_from_scan: Float[np.ndarray, "4 4"]


def read(model: Path, folder: Path) -> tuple[Person, list[PersonRecording], dict[str, MotionScene]]:
    """Read all recordings and their scenes; the first person's shape is used for everyone.

    Raises InputError LTM-001 without recordings, LTM-005 for a damaged or missing file.
    """
    takes = sorted(each for each in (folder / FITS).iterdir() if (each / "results").is_dir())
    if not takes:
        remedy = f"put recordings there as {FITS}/<scene>_<person>_<take>/results/<frame>/000.pkl"
        raise InputError("LTM-001", "no SMPL-X motion to learn from", str(folder), remedy)
    fits = [_fits(take) for take in takes]
    person = smplx_body(model, fits[0][1]["betas"][0])
    recordings = [
        _recording(take.name.rsplit("_", 2)[0], clock, table, person, folder)
        for take, (clock, table) in zip(takes, fits, strict=True)
    ]
    scenes = {}
    for name in dict.fromkeys(each.scene for each in recordings):
        here = [each for each in recordings if each.scene == name]
        roots = [motion.world_from_agent[:, :3, 3] for each in here for motion in each.motions]
        if roots:
            scenes[name] = _scene(folder, name, here[0].world_from_scan, np.concatenate(roots))
    return person, recordings, scenes


def _fits(take: Path) -> tuple[Float[np.ndarray, "frame"], dict[str, np.ndarray]]:
    """Return times (seconds) and parameters of all frames of a recording, sorted by time."""
    rows, clock = [], []
    for number, frame in enumerate(sorted(each for each in (take / "results").iterdir() if each.is_dir())):
        file = frame / "000.pkl"
        if not file.is_file():
            continue
        rows.append(_fit(file))
        match = _CLOCK.search(frame.name)
        hours, minutes, seconds, thousandths = map(int, match.groups()) if match else (0, 0, 0, 0)
        time = timedelta(hours=hours, minutes=minutes, seconds=seconds, milliseconds=thousandths)
        clock.append(time.total_seconds() if match else number / RATE_HZ)
    if len(rows) < 2:
        raise _damaged("there are no fits of two frames", take)
    time_s, first = np.unique(clock, return_index=True)
    return time_s, {name: np.stack([rows[index][name] for index in first]) for name in rows[0]}


class _Arrays(pickle.Unpickler):
    """Unpickler restricted to arrays."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"{module}.{name} is no part of an array")
        return super().find_class(module, name)


def _fit(file: Path) -> dict[str, np.ndarray]:
    if file.stat().st_size > LARGEST_FIT:
        raise _damaged(f"is larger than {LARGEST_FIT} bytes", file)
    try:
        with file.open("rb") as opened:
            table = _Arrays(opened, encoding="latin1").load()
        found = {name: np.asarray(table[name], float).reshape(-1) for name in (*_NAMES, "betas")}
    except (pickle.UnpicklingError, EOFError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise _damaged(f"is no fit of SMPL-X ({error!r})", file) from error
    sizes = {name: found[name].size for name in _NAMES[:3]}
    if sizes != {"transl": 3, "global_orient": 3, "body_pose": BODY} or not all(
        np.isfinite(each).all() for each in found.values()
    ):
        raise _damaged(f"has parameters of other sizes than SMPL-X's, or not finite: {sizes}", file)
    return found


def _recording(
    scene: str, clock: np.ndarray, table: dict[str, np.ndarray], person: Person, folder: Path
) -> PersonRecording:
    scan_from_camera = _json(folder / "cam2world" / f"{scene}.json", (4, 4))
    hands = np.stack([table["left_hand_pose"], table["right_hand_pose"]], axis=1)
    transl, orient, pose = (table[name] for name in _NAMES[:3])
    motion = motion_from_parameters(person, transl, orient, pose, hands)
    roots = scan_from_camera @ motion.world_from_agent
    up = np.einsum("fij,fj->fi", roots[:, :3, :3], motion.agent_from_bone[:, NECK, :3, 3]).mean(0)
    world_from_scan = rigid.make(_upright(up), np.zeros(3))
    motion = BodyMotion(world_from_scan @ roots, motion.agent_from_bone)
    parts = np.split(np.arange(len(clock)), np.flatnonzero(np.diff(clock) > GAP_S) + 1)
    parts = [part for part in parts if clock[part[-1]] - clock[part[0]] >= SHORTEST_S]
    motions = tuple(resample_motion(clock[part], motion[part]) for part in parts)
    return PersonRecording(scene, motions, world_from_scan)


def _upright(up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation by multiples of 90 degrees that takes the axis nearest to ``up`` to +y."""
    axis = int(np.abs(up).argmax())
    across = np.eye(3)[(axis + 1) % 3]
    own = np.sign(up[axis]) * np.eye(3)[axis]
    return np.stack([across, own, np.cross(across, own)])


def _scene(
    folder: Path,
    name: str,
    world_from_scan: Float[np.ndarray, "4 4"],
    roots_world: Float[np.ndarray, "frame 3"],
) -> MotionScene:
    path = folder / "scenes" / f"{name}.ply"
    try:
        scan = cast(trimesh.Trimesh, trimesh.load(path, force="mesh", process=False))
        vertices = rigid.apply(world_from_scan, np.asarray(scan.vertices, float))
        scene = MotionScene.for_motion(Mesh(vertices, np.asarray(scan.faces, np.int32)), roots_world)
    except (ValueError, TypeError, OSError, KeyError, IndexError, AttributeError) as error:
        raise _damaged(f"is no scan ({error!r})", path) from error
    return replace(scene, known=_distances(folder / "sdf" / f"{name}_sdf.npy", world_from_scan, scene))


def _distances(file: Path, world_from_scan: np.ndarray, scene: MotionScene) -> SignedDistance | None:
    """Resample PROX's signed distance to the grid of a scene; None if the scan has none."""
    if not file.is_file():
        return None
    known = file.with_name(file.name.replace("_sdf.npy", ".json"))
    low, high = _json(known, (3,), "min"), _json(known, (3,), "max")
    try:
        values = np.load(file, allow_pickle=False).astype(np.float32)
        side = round(values.size ** (1 / 3))
        values = values.reshape(side, side, side)
    except (ValueError, EOFError, OSError) as error:
        raise _damaged(f"is no grid of distances ({error})", file) from error
    centers = voxel_centers(scene.low, scene.high, scene.voxel_m)
    points = rigid.apply(rigid.inverse(world_from_scan), centers.reshape(-1, 3))
    index = (points - low) / (high - low) * (side - 1)
    sampled = ndimage.map_coordinates(values, index.T, order=1, mode="nearest").reshape(centers.shape[:3])
    return SignedDistance(torch.from_numpy(sampled), torch.from_numpy(scene.low).float(), scene.voxel_m)


def _json(file: Path, shape: tuple[int, ...], key: str | None = None) -> np.ndarray:
    try:
        table = json.loads(file.read_text())
        found = np.asarray(table if key is None else table[key], float)
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise _damaged(f"is missing or cannot be read ({error!r})", file) from error
    if found.shape != shape or not np.isfinite(found).all():
        raise _damaged(f"does not hold numbers of the shape {shape}", file)
    return found


def _damaged(what: str, where: Path) -> InputError:
    return InputError("LTM-005", what, str(where), "copy it again from PROX as it was published")
