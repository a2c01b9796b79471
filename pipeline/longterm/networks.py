"""Networks of long-term motion: static bodies, routes between them, poses along routes (LTM, Sec. 3).

Inputs and outputs are in a clip's frame, +y up: `t` is the root's position in meters, `r` its rotation in 6D
(first two columns), `p` the pose in `pipeline.longterm.bodies.PoseSpace`. RouteNet, PoseNet and BaseNet
predict offsets from linear interpolation between start and end that vanish at both ends, so that clips join.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from pipeline.geometry import rigid_torch
from pipeline.longterm import local_scene
from pipeline.longterm.bodies import LEVER_M
from pipeline.longterm.config import LongTermSizes
from pipeline.longterm.local_scene import LocalScene
from pipeline.longterm.short_motions import RATE_HZ, STEPS

ROOT_CHANNELS = 9
"""channels of t and r"""
REACH_M = 1.5
"""radius around a clip's center within which scene points are sampled"""
BODY_REACH_M = 0.8
"""radius around a static body within which scene points are sampled"""
LEAK = 0.2
"""negative slope of LeakyReLU"""
MIN_GAIT_CYCLES = 0.4
"""lowest initial frequency of the gait phases per meter and per second of locomotion; they span 2 more"""
IDLE_M_S = 0.1
"""speed at which time counts half as time of locomotion"""


class PointNet(nn.Module):
    """Encoder of a point set: a shared MLP, then max pooling (no transformation nets)."""

    def __init__(self, code: int, with_scene: bool = True):
        super().__init__()
        self.with_scene, self.code = with_scene, code
        self.layers = (
            nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, 64), nn.ReLU(), nn.Linear(64, code))
            if with_scene
            else None
        )

    def forward(self, points: Float[Tensor, "batch point 3"]) -> Float[Tensor, "batch code"]:
        if self.layers is None:
            return points.new_zeros(len(points), self.code)
        return self.layers(points).amax(1)


class ResidualBlock(nn.Module):
    """Two linear layers with a skip connection."""

    def __init__(self, width: int):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(width, width), nn.LeakyReLU(LEAK), nn.Linear(width, width), nn.LeakyReLU(LEAK)
        )

    def forward(self, x: Float[Tensor, "batch width"]) -> Float[Tensor, "batch width"]:
        return x + self.layers(x)


class StaticBody(nn.Module):
    """A CVAE of bodies: (t, r, p) given shape, clearance, orientation and scene points (Sec. 3.2)."""

    def __init__(self, sizes: LongTermSizes):
        super().__init__()
        self.sizes = sizes
        body, width = ROOT_CHANNELS + sizes.pose, sizes.width
        self.point_net = PointNet(sizes.scene)
        self.condition = nn.Sequential(nn.Linear(sizes.scene + sizes.shape + 7, width), nn.LeakyReLU(LEAK))
        self.encoder_in = nn.Linear(body, width)
        self.encoder = nn.Sequential(ResidualBlock(width), ResidualBlock(width))
        self.encoder_out = nn.Sequential(
            nn.Linear(2 * width, width), nn.LeakyReLU(LEAK), nn.Linear(width, 2 * sizes.latent)
        )
        self.decoder_in = nn.Linear(sizes.latent + width, width)
        self.decoder = nn.Sequential(ResidualBlock(width), ResidualBlock(width))
        self.decoder_out = nn.Linear(width, body)

    def encode_condition(
        self,
        place: Float[Tensor, "batch 7"],
        shape: Float[Tensor, "batch shape"],
        points: Float[Tensor, "batch point 3"],
    ) -> Float[Tensor, "batch width"]:
        """Encode the condition: ``place`` is the clearance above the scene and r, in the heading frame."""
        return self.condition(torch.cat([self.point_net(points), shape, place], dim=-1))

    def encode(
        self, body: Float[Tensor, "batch channel"], given: Float[Tensor, "batch width"]
    ) -> tuple[Float[Tensor, "batch latent"], Float[Tensor, "batch latent"]]:
        """Return mean and log variance of z."""
        features = self.encoder(self.encoder_in(body))
        return self.encoder_out(torch.cat([features, given], dim=-1)).chunk(2, dim=-1)

    def decode(
        self, z: Float[Tensor, "batch latent"], given: Float[Tensor, "batch width"]
    ) -> Float[Tensor, "batch channel"]:
        """Return a body: t and r in the heading frame of its place, p."""
        out = self.decoder_out(self.decoder(self.decoder_in(torch.cat([z, given], dim=-1))))
        upright = out.new_tensor([0.0, 0, 0, 1, 0, 0, 0, 1, 0])
        return torch.cat([out[:, :ROOT_CHANNELS] * 0.1 + upright, out[:, ROOT_CHANNELS:]], dim=-1)


class InbetweenNet(nn.Module):
    """A bidirectional LSTM over interpolated ends, then an MLP that also sees the scene's PointNet code."""

    def __init__(self, channels: int, extra: int, sizes: LongTermSizes, with_scene: bool):
        super().__init__()
        self.point_net = PointNet(sizes.scene, with_scene)
        self.lstm = nn.LSTM(3 * channels + extra + 2, sizes.hidden, batch_first=True, bidirectional=True)
        self.out = nn.Sequential(
            nn.Linear(2 * sizes.hidden + sizes.scene, sizes.width),
            nn.ReLU(),
            nn.Linear(sizes.width, channels),
        )

    def forward(
        self,
        start: Float[Tensor, "batch channel"],
        end: Float[Tensor, "batch channel"],
        points: Float[Tensor, "batch point 3"],
        extra: Float[Tensor, "batch frame extra"] | None = None,
        coarse: Float[Tensor, "batch frame channel"] | None = None,
    ) -> Float[Tensor, "batch frame channel"]:
        """Return the channels of all k + 1 frames: ``coarse``, or the interpolated ends, plus an offset."""
        share = torch.linspace(0, 1, STEPS + 1).to(start)[None, :, None].expand(len(start), -1, 1)
        line = torch.lerp(start[:, None], end[:, None], share)
        both = torch.cat([start, end], dim=-1)[:, None].expand(-1, STEPS + 1, -1)
        parts = [line, both, share, 4 * share * (1 - share)] + ([] if extra is None else [extra])
        features, _ = self.lstm(torch.cat(parts, dim=-1))
        code = self.point_net(points)[:, None].expand(-1, STEPS + 1, -1)
        offset = self.out(torch.cat([features, code], dim=-1))
        return (line if coarse is None else coarse) + end_window(line) * offset


class CoarseToFine(nn.Module):
    """A coarse prediction without the scene, refined with the signed distance around each of its frames.

    The distances beside the coarse route show directly where it must bend, unlike a code of all points.
    """

    def __init__(self, channels: int, extra: int, sizes: LongTermSizes, with_scene: bool):
        super().__init__()
        self.with_scene = with_scene
        self.coarse = InbetweenNet(channels, extra, sizes, False)
        smaller = replace(sizes, hidden=max(1, 2 * sizes.hidden // 3))
        known = local_scene.READ_CHANNELS + channels + 2 * ROOT_CHANNELS
        self.fine = InbetweenNet(channels, known, smaller, False)

    def stages(
        self,
        start: Float[Tensor, "batch channel"],
        end: Float[Tensor, "batch channel"],
        seen: LocalScene,
        extra: Float[Tensor, "batch frame extra"] | None = None,
    ) -> list[Float[Tensor, "batch frame channel"]]:
        """Return coarse and refined prediction, t in meters and r orthonormal, in the clip's frame."""
        coarse = orthonormalized(self.coarse(start, end, seen.points, extra))
        fixed = coarse.detach()
        distances = (
            local_scene.read_distances(seen.field, fixed[..., :3])
            if self.with_scene
            else fixed.new_zeros(*fixed.shape[:2], local_scene.READ_CHANNELS)
        )
        known = torch.cat([distances, fixed, with_velocity(fixed[..., :ROOT_CHANNELS])], dim=-1)
        return [coarse, orthonormalized(self.fine(start, end, seen.points, known, fixed))]


def end_window(like: Float[Tensor, "batch frame channel"]) -> Float[Tensor, "frame 1"]:
    """Return a window over the frames: 0 at both ends, near 1 from a tenth of a second away from them."""
    share = torch.linspace(0, 1, STEPS + 1, dtype=like.dtype, device=like.device)[:, None]
    return torch.tanh(STEPS / 3 * share) * torch.tanh(STEPS / 3 * (1 - share))


def orthonormalized(channels: Float[Tensor, "*batch channel"]) -> Float[Tensor, "*batch channel"]:
    """Orthonormalize the columns of r."""
    r = rigid_torch.rotation_to_6d(rigid_torch.rotation_from_6d(channels[..., 3:ROOT_CHANNELS]))
    return torch.cat([channels[..., :3], r, channels[..., ROOT_CHANNELS:]], dim=-1)


class RouteNet(nn.Module):
    """Root positions and, unless PoseNet predicts them, rotations between start and end (Eq. 1).

    Beyond the paper, it sees the poses at both ends, which show whether the body is walking, and refines a
    coarse route by the signed distance around it. If ``blind`` it sees only scene points, as in the paper.
    """

    def __init__(
        self,
        sizes: LongTermSizes,
        *,
        with_scene: bool = True,
        predicts_rotation: bool = True,
        blind: bool = False,
    ):
        super().__init__()
        self.predicts_rotation, self.blind, self.with_scene = predicts_rotation, blind, with_scene
        self.between: InbetweenNet | CoarseToFine = (
            InbetweenNet(ROOT_CHANNELS, 0, sizes, with_scene)
            if blind
            else CoarseToFine(ROOT_CHANNELS, 2 * sizes.pose, sizes, with_scene)
        )

    def stages(
        self, start: Float[Tensor, "batch channel"], end: Float[Tensor, "batch channel"], seen: LocalScene
    ) -> list[Float[Tensor, "batch frame 9"]]:
        """Return the routes of all stages, the final one last."""
        first, last = start[:, :ROOT_CHANNELS], end[:, :ROOT_CHANNELS]
        if isinstance(self.between, InbetweenNet):
            routes = [orthonormalized(self.between(first, last, seen.points))]
        else:
            poses = torch.cat([start[:, ROOT_CHANNELS:], end[:, ROOT_CHANNELS:]], -1)[:, None]
            routes = self.between.stages(first, last, seen, poses.expand(-1, STEPS + 1, -1))
        if self.predicts_rotation:
            return routes
        share = torch.linspace(0, 1, STEPS + 1, device=first.device)[None, :, None]
        rotation = torch.lerp(first[:, None, 3:], last[:, None, 3:], share)
        return [orthonormalized(torch.cat([route[..., :3], rotation], dim=-1)) for route in routes]

    def forward(
        self, start: Float[Tensor, "batch channel"], end: Float[Tensor, "batch channel"], seen: LocalScene
    ) -> Float[Tensor, "batch frame 9"]:
        """Return t and r of all frames; r is interpolated unless the network predicts it."""
        return self.stages(start, end, seen)[-1]


class GaitPhase(nn.Module):
    """Phase features: the poses of both ends, advanced along the route as by a gait.

    A pose is encoded as ``waves`` complex numbers that rotate at learned rates with distance and time of
    locomotion. An LSTM learns such products of pose and phase slowly, and without them feet skate.
    """

    def __init__(self, pose: int, waves: int = 16):
        super().__init__()
        self.code = nn.Linear(pose, 2 * waves)
        step = torch.linspace(0, 1, waves)
        cycles = [MIN_GAIT_CYCLES + 2 * step, MIN_GAIT_CYCLES + 2 * ((7 * step) % 1), 0 * step]
        self.rate = nn.Parameter(2 * torch.pi * torch.stack(cycles, dim=-1))

    @property
    def channels(self) -> int:
        """Channels per frame."""
        return 2 * self.code.out_features

    def forward(
        self,
        start: Float[Tensor, "batch pose"],
        end: Float[Tensor, "batch pose"],
        route: Float[Tensor, "batch frame 9"],
    ) -> Float[Tensor, "batch frame channel"]:
        """Return the code of start rotated forward in phase, and that of end rotated backward."""
        phase = gait_progress(route) @ self.rate.T
        return torch.cat([self._rotated(start, phase), self._rotated(end, phase - phase[:, -1:])], dim=-1)

    def _rotated(
        self, pose: Float[Tensor, "batch pose"], phase: Float[Tensor, "batch frame wave"]
    ) -> Float[Tensor, "batch frame channel"]:
        real, imaginary = self.code(pose)[:, None].chunk(2, dim=-1)
        cosine, sine = torch.cos(phase), torch.sin(phase)
        return torch.cat([real * cosine - imaginary * sine, real * sine + imaginary * cosine], dim=-1)


class PoseNet(nn.Module):
    """Poses between start and end along a route (Eq. 2); variants ignore the route or also predict rotations.

    Beyond the paper, with ``strides``, it has the phase features of both ends along the route (`GaitPhase`).
    """

    def __init__(
        self,
        sizes: LongTermSizes,
        *,
        with_scene: bool = True,
        follows_route: bool = True,
        predicts_rotation: bool = False,
        strides: bool = True,
    ):
        super().__init__()
        self.follows_route, self.predicts_rotation = follows_route, predicts_rotation
        self.strides = GaitPhase(sizes.pose) if follows_route and strides else None
        extra = 2 * ROOT_CHANNELS * follows_route + (self.strides.channels if self.strides is not None else 0)
        self.between = InbetweenNet(sizes.pose + (6 if predicts_rotation else 0), extra, sizes, with_scene)
        self.short = nn.Linear(self.strides.channels, sizes.pose) if self.strides is not None else None

    def forward(
        self,
        start: Float[Tensor, "batch pose"],
        end: Float[Tensor, "batch pose"],
        route: Float[Tensor, "batch frame 9"],
        points: Float[Tensor, "batch point 3"],
    ) -> Float[Tensor, "batch frame channel"]:
        """Return t, r and p of all frames: the route with poses, r predicted by the variant that does so."""
        if self.predicts_rotation:
            start, end = torch.cat([route[:, 0, 3:], start], -1), torch.cat([route[:, -1, 3:], end], -1)
        if self.strides is None or self.short is None:
            pose = self.between(start, end, points, with_velocity(route) if self.follows_route else None)
        else:
            phase = self.strides(start, end, route)
            pose = self.between(start, end, points, torch.cat([with_velocity(route), phase], dim=-1))
            pose = pose + end_window(pose) * self.short(phase)
        if self.predicts_rotation:
            return orthonormalized(torch.cat([route[..., :3], pose], dim=-1))
        return torch.cat([route, pose], dim=-1)


def with_velocity(route: Float[Tensor, "batch frame 9"]) -> Float[Tensor, "batch frame 18"]:
    """Return a route with its change per tenth of a second, the velocity in the body's frame."""
    rate = functional.pad(route[:, 1:] - route[:, :-1], (0, 0, 0, 1), mode="replicate") * (RATE_HZ / 10)
    body_from_clip = rigid_torch.rotation_from_6d(route[..., 3:]).transpose(-1, -2)
    return torch.cat([route, (body_from_clip @ rate[..., :3, None])[..., 0], rate[..., 3:]], dim=-1)


def gait_progress(route: Float[Tensor, "batch frame 9"]) -> Float[Tensor, "batch frame 3"]:
    """Return since the start: distance (m), time of locomotion (s), and path length of the forward axis."""
    distance = (route[:, 1:, :3] - route[:, :-1, :3])[..., [0, 2]].norm(dim=-1)
    forward = rigid_torch.rotation_from_6d(route[..., 3:])[..., 2]
    turn = (forward[:, 1:] - forward[:, :-1]).norm(dim=-1)
    speed = RATE_HZ * (distance + LEVER_M * turn)
    steps = torch.stack([distance, speed / (speed + IDLE_M_S) / RATE_HZ, turn], dim=-1)
    return functional.pad(steps.cumsum(1), (0, 0, 1, 0))


class BaseNet(nn.Module):
    """Route and poses from one coarse-to-fine network (ablation)."""

    def __init__(self, sizes: LongTermSizes, *, with_scene: bool = True):
        super().__init__()
        self.between = CoarseToFine(ROOT_CHANNELS + sizes.pose, 0, sizes, with_scene)

    def stages(
        self, start: Float[Tensor, "batch channel"], end: Float[Tensor, "batch channel"], seen: LocalScene
    ) -> list[Float[Tensor, "batch frame channel"]]:
        """Return the motions of all stages, the final one last."""
        return self.between.stages(start, end, seen)

    def forward(
        self, start: Float[Tensor, "batch channel"], end: Float[Tensor, "batch channel"], seen: LocalScene
    ) -> Float[Tensor, "batch frame channel"]:
        """Return t, r and p of all frames."""
        return self.stages(start, end, seen)[-1]
