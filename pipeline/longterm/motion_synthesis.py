"""Long-term motion synthesis: the trained model, and motion through waypoints.

`LongTerm.load` reads what `train_longterm` wrote. `bodies` samples bodies at waypoints, `short_motions`
in-betweens two seconds between consecutive ones, `long_motion` does both for a sequence of waypoints;
`motion_optimization.optimize_motion` refines the result.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from safetensors.torch import load_file, save_file
from torch import Tensor

from pipeline.core.errors import other_versions_refused
from pipeline.geometry import rigid
from pipeline.longterm.bodies import PoseSpace, SkinnedBody
from pipeline.longterm.clip_channels import decode_clip, encode_clips, encode_places
from pipeline.longterm.config import LongTermSizes
from pipeline.longterm.contacts import ContactVertices
from pipeline.longterm.local_scene import LocalScene
from pipeline.longterm.motion_optimization import settle_bodies
from pipeline.longterm.networks import ROOT_CHANNELS, PoseNet, RouteNet, StaticBody
from pipeline.longterm.plausibility import PlausibilityMeter
from pipeline.longterm.short_motions import (
    RATE_HZ,
    STEPS,
    BodyMotion,
    concatenate_motions,
    jump_between_levels,
    limit_turn_rate,
    smooth_seams,
)
from pipeline.longterm.surroundings import MotionScene

NETWORKS = ("static", "route", "pose")
CONVENTIONS = {"units": "metres, radians, seconds", "up": [0, 1, 0], "rate_hz": RATE_HZ, "frames": STEPS + 1}
"""Conventions stored with a model; one with others is from another version."""
JUMP_M = 0.1
"""A leg whose ends differ in height by more than this is a jump."""
MOVING_M = 0.3
"""A displacement in two seconds that counts as locomotion."""
TURN_PERCENTILE = 99
"""Percentile taken as the fastest turn: jumps of the reconstruction are outliers."""
SWEEPS = 2
"""Iterations that resample the poses at waypoints in passing from the motion before and after them."""


@dataclass(frozen=True)
class MotionPrior:
    """Statistics of recorded motion."""

    clearance_m: float
    """median distance of the root from the scene in locomotion"""
    pace_m: float
    """median displacement over two seconds of locomotion"""
    above_m: float
    """median height of the highest bone above the root in locomotion"""
    turn_rad: float
    """rotation of the root per frame, 99th percentile"""


@dataclass(frozen=True)
class LongTerm:
    """A trained model of long-term motion of one body."""

    sizes: LongTermSizes
    poses: PoseSpace
    contacts: ContactVertices
    motion_prior: MotionPrior
    static: StaticBody
    route: RouteNet
    pose: PoseNet

    def save(self, folder: Path) -> None:
        """Write `longterm.safetensors` and `longterm.json`."""
        state = {f"poses.{name}": value for name, value in self.poses.state_dict().items()}
        for name in NETWORKS:
            state |= {f"{name}.{key}": value for key, value in getattr(self, name).state_dict().items()}
        state = {name: value.contiguous() for name, value in state.items()}
        save_file(state, folder / "longterm.safetensors")
        document = {
            **CONVENTIONS,
            "bones": len(self.poses.rest),
            "sizes": asdict(self.sizes),
            "sees_scene": self.route.with_scene,
            "motion_prior": asdict(self.motion_prior),
            "contact_vertices": self.contacts.vertices.tolist(),
            "foot_of_contact_vertex": self.contacts.foot.tolist(),
        }
        (folder / "longterm.json").write_text(json.dumps(document, indent=1) + "\n")

    @classmethod
    def load(cls, folder: Path) -> "LongTerm":
        """Read a trained model. Raises InputError ART-007 for one of another version."""
        refused = other_versions_refused("model of long-term motion", str(folder))
        with refused, torch.random.fork_rng(devices=[]):  # untrained weights are drawn
            document = json.loads((folder / "longterm.json").read_text())
            if other := [name for name, value in CONVENTIONS.items() if document[name] != value]:
                raise ValueError(f"longterm.json says otherwise about {', '.join(other)}")
            state, sizes = load_file(folder / "longterm.safetensors"), LongTermSizes(**document["sizes"])
            poses = PoseSpace(np.tile(np.eye(4), (document["bones"], 1, 1)), sizes.pose)
            seen = document["sees_scene"]
            nets = StaticBody(sizes), RouteNet(sizes, with_scene=seen), PoseNet(sizes, with_scene=seen)
            for name, module in zip(("poses", *NETWORKS), (poses, *nets), strict=True):
                own = [key for key in state if key.startswith(f"{name}.")]
                module.eval().load_state_dict({key.removeprefix(f"{name}."): state[key] for key in own})
            numbers = [np.array(document[name]) for name in ("contact_vertices", "foot_of_contact_vertex")]
            motion_prior = MotionPrior(**document["motion_prior"])
        return cls(sizes, poses, ContactVertices(*numbers), motion_prior, *nets)

    def bodies(
        self,
        world_from_agent: Float[np.ndarray, "body 4 4"],
        body: SkinnedBody,
        scene: MotionScene,
        rng: np.random.Generator,
        *,
        candidates: int = 8,
    ) -> BodyMotion:
        """Return a body at each waypoint: the best of several CVAE samples, refined by `settle_bodies`.

        The cost is gap to the scene plus penetration plus distance from the waypoint.
        """
        first = np.zeros(len(world_from_agent), int)
        places = encode_places(world_from_agent, first, [scene], self.sizes.points, rng)
        shape = torch.from_numpy(body.shape).float().expand(len(world_from_agent), -1)
        meter = PlausibilityMeter(body, self.contacts, scene.distance)
        roots, bones, costs, every = [], [], [], np.arange(len(world_from_agent))
        with torch.no_grad():
            condition = self.static.encode_condition(places.place, shape, places.points)
        for _ in range(candidates):
            z = torch.from_numpy(rng.standard_normal((len(condition), self.sizes.latent))).float()
            with torch.no_grad():
                channels = self.static.decode(z, condition)
            local = decode_clip(channels, np.eye(4), self.poses)
            sample = BodyMotion(places.world_from_place @ local.world_from_agent, local.agent_from_bone)
            offset = np.linalg.norm((sample.world_from_agent - world_from_agent)[:, :3, 3], axis=1)
            costs.append(sum(meter.gap_and_penetration(sample)) + offset)
            roots.append(sample.world_from_agent)
            bones.append(sample.agent_from_bone)
        best = np.argmin(costs, axis=0), every
        return settle_bodies(BodyMotion(np.stack(roots)[best], np.stack(bones)[best]), meter, self.poses)

    def short_motions(
        self, start: BodyMotion, end: BodyMotion, scene: MotionScene, rng: np.random.Generator
    ) -> list[BodyMotion]:
        """In-between each start body and its end body: 61 frames, both ends included."""
        root = np.stack([start.world_from_agent, end.world_from_agent], axis=1)
        bones = np.stack([start.agent_from_bone, end.agent_from_bone], axis=1)
        p = [self.poses.encode(self.poses.channels(each)) for each in (bones[:, 0], bones[:, 1])]
        where = np.zeros(len(root), int)
        ends = encode_clips(root, torch.stack(p, dim=1), where, [scene], self.sizes.points, rng)
        made = self.between(ends.channels[:, 0], ends.channels[:, 1], ends.seen)
        parts = zip(made, ends.world_from_clip, bones, strict=True)
        return [decode_clip(channels, frame, self.poses, given) for channels, frame, given in parts]

    def between(
        self, start: Float[Tensor, "clip channel"], end: Float[Tensor, "clip channel"], seen: LocalScene
    ) -> Float[Tensor, "clip frame channel"]:
        """Return t, r, p of all frames between first and last ones, in the clips' frames."""
        with torch.no_grad():
            route = self.route(start, end, seen)
            return self.pose(start[:, ROOT_CHANNELS:], end[:, ROOT_CHANNELS:], route, seen.points)

    def long_motion(
        self,
        world_from_agent: Float[np.ndarray, "body 4 4"],
        body: SkinnedBody,
        scene: MotionScene,
        rng: np.random.Generator,
        *,
        stops: Int[np.ndarray, "stop"] | None = None,
    ) -> tuple[BodyMotion, BodyMotion]:
        """Return motion through waypoints two seconds apart, and the bodies at the waypoints.

        At consecutive equal waypoints the body rests. Waypoints not in ``stops`` (None: all) are passed in
        locomotion: their poses are in-betweened from a second before to a second after, since a body sampled
        independently has an arbitrary gait phase.
        """
        index = np.arange(len(world_from_agent))
        rests = np.append(False, np.isclose(world_from_agent[1:], world_from_agent[:-1]).all((1, 2)))
        since = np.maximum.accumulate(np.where(rests, 0, index))
        bodies = self.bodies(world_from_agent, body, scene, rng)[since]
        sampled = np.isin(index, index if stops is None else [0, *stops, index[-1]])
        sampled |= rests | np.append(rests[1:], False)
        for _ in range(SWEEPS if not sampled.all() else 0):
            bodies = self._with_passing_poses(bodies, np.flatnonzero(~sampled), scene, rng)
        rise = np.abs(np.diff(world_from_agent[:, 1, 3]))
        parts = zip(self.short_motions(bodies[:-1], bodies[1:], scene, rng), rise > JUMP_M, strict=True)
        joined = concatenate_motions([jump_between_levels(part) if jumps else part for part, jumps in parts])
        return limit_turn_rate(smooth_seams(joined), self.motion_prior.turn_rad), bodies

    def _with_passing_poses(
        self,
        bodies: BodyMotion,
        passing: Int[np.ndarray, "place"],
        scene: MotionScene,
        rng: np.random.Generator,
    ) -> BodyMotion:
        parts = self.short_motions(bodies[:-1], bodies[1:], scene, rng)
        middle = BodyMotion(
            np.stack([part.world_from_agent[STEPS // 2] for part in parts]),
            np.stack([part.agent_from_bone[STEPS // 2] for part in parts]),
        )
        parts = self.short_motions(middle[passing - 1], middle[passing], scene, rng)
        bones = bodies.agent_from_bone.copy()
        bones[passing] = np.stack([part.agent_from_bone[STEPS // 2] for part in parts])
        return BodyMotion(bodies.world_from_agent, bones)


def measure_motion_prior(stretches: list[BodyMotion], scenes: list[MotionScene]) -> MotionPrior:
    """Measure motion statistics; locomotion is a displacement by `MOVING_M` in two seconds.

    Half a turn per second is always allowed, even for a body that was only recorded at rest.
    """
    clearance, above, displacements, turn = [], [], [], []
    for stretch, scene in zip(stretches, scenes, strict=True):
        root = stretch.world_from_agent[:, :3, 3]
        displacement = np.linalg.norm((root[STEPS:] - root[:-STEPS])[:, [0, 2]], axis=1)
        middle = slice(STEPS // 2, len(displacement) + STEPS // 2)
        bones = np.swapaxes(stretch.agent_from_bone[middle, :, :3, 3], 1, 2)
        up = (stretch.world_from_agent[middle, 1:2, :3] @ bones)[:, 0]
        clearance.append(scene.distance.at(torch.from_numpy(root[middle]).float()).numpy())
        above.append(up.max(1))
        displacements.append(displacement)
        rotation = stretch.world_from_agent[:, :3, :3]
        turn.append(rigid.rotation_angle(rotation[:-1], rotation[1:]))
    moves = np.concatenate(displacements) > MOVING_M
    moves = moves if moves.any() else ~moves
    medians = (float(np.median(np.concatenate(each)[moves])) for each in (clearance, displacements, above))
    clearance_m, pace_m, above_m = medians
    turn_rad = max(float(np.percentile(np.concatenate(turn), TURN_PERCENTILE)), np.pi / RATE_HZ)
    return MotionPrior(clearance_m, max(pace_m, MOVING_M), above_m, turn_rad)
