import numpy as np
import torch

from pipeline.behavior.body_denoiser import BodyDenoiser, GaussianPrior, OneStageDenoiser, rotated_to_heading
from pipeline.behavior.denoisers import SequenceDenoiser
from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.path_encoding import velocity_channels_from_path
from pipeline.geometry import rigid_torch

FRAMES = 40


def identity_prior(channels: int) -> GaussianPrior:
    """A prior without bones, which returns its input."""
    return GaussianPrior(channels, 0, 0, FRAMES)


def walk(turns: torch.Tensor, speed_m_s: float) -> torch.Tensor:
    """A path that turns by a fixed angle per frame and stops after three quarters of its length."""
    yaw = turns.cumsum(0)
    pace = torch.where(torch.arange(FRAMES) < 30, speed_m_s / 10, 0.0)
    return torch.stack([yaw.sin() * pace, 0 * yaw, yaw.cos() * pace]).cumsum(1)[None], yaw


def columns(yaw: torch.Tensor) -> torch.Tensor:
    turn = rigid_torch.so3_exp(torch.stack([0 * yaw, yaw, 0 * yaw], dim=-1))
    return rigid_torch.rotation_to_6d(turn).mT[None]


def test_roots_face_the_path_and_keep_the_posture():
    net = BodyDenoiser(SequenceDenoiser(Schedule()), identity_prior(6), 6, FRAMES)
    for first, speed in ((0.4, 0.8), (0.4, 0.0)):
        path, yaw = walk(torch.full((FRAMES,), 0.03), speed)
        held = columns(torch.full((FRAMES,), first))
        looks = rotated_to_heading(held, net.headings(net.steps(path, torch.zeros(1), path), held))
        angle = torch.atan2(-looks[0, 2], looks[0, 0])  # of the x axis
        if speed:
            assert (angle - yaw)[10:30].abs().max() < 0.1
            assert (angle[30:] - angle[29]).abs().max() < 1e-4
        else:
            assert (angle - first).abs().max() < 1e-4


def test_one_stage_body_has_the_heading_of_its_path():
    """The heading is the same for given and for jointly denoised paths, and unknown where noise hides it."""
    net = OneStageDenoiser(SequenceDenoiser(Schedule()), identity_prior(10), 6, FRAMES)
    std = torch.tensor([0.4, 0.1, 0.4, 1.0])
    net.velocity_std[:] = std
    path, _ = walk(torch.full((FRAMES,), 0.03), 0.8)
    given = BodyDenoiser(SequenceDenoiser(Schedule()), identity_prior(6), 6, FRAMES).steps(
        path, torch.zeros(1), path
    )
    strides = velocity_channels_from_path(path.mT, path[..., 0] - given[..., 0]) / std
    whole = torch.cat([strides.mT, torch.randn(1, 6, FRAMES)], dim=1)
    clean, noisy = (
        net.steps(Schedule().alpha_bar[t] ** 0.5 * whole, torch.tensor([float(t)]), path * 0) for t in (0, 49)
    )
    torch.testing.assert_close(clean[..., :30], given[..., :30], atol=1e-4, rtol=1e-3)
    torch.testing.assert_close(clean[..., 31:], torch.zeros(1, 3, FRAMES - 31), atol=1e-4, rtol=0)
    assert (noisy.norm(dim=1) < given.norm(dim=1))[..., :30].all()


def test_residual_from_the_current_posture_is_denoised():
    class RecordingNetwork(SequenceDenoiser):
        def velocity(self, x, t, condition, control, keep):
            self.x = x
            return x

    net = BodyDenoiser(RecordingNetwork(Schedule()), identity_prior(9), 9, FRAMES)
    posture = torch.cat([columns(torch.zeros(1))[0, :, 0], torch.tensor([0.3, -0.2, 0.1])])[None]
    clean = posture[..., None].expand(-1, -1, FRAMES)
    noise = torch.randn(1, 9, FRAMES)
    t = torch.tensor([20.0])
    share = float(Schedule().alpha_bar[20])
    net(
        np.sqrt(share) * clean + np.sqrt(1 - share) * noise,
        t,
        torch.cat([torch.ones(1, 4), posture], dim=1),
        torch.zeros(1, 3, FRAMES),
        torch.ones(1, 1),
    )
    torch.testing.assert_close(
        net.unet.x, np.sqrt(1 - share).astype(np.float32) * noise, atol=6e-3, rtol=0
    )  # the heading channel is a vector slightly shorter than 1


def test_gates_scale_only_the_noisy_bones():
    net = BodyDenoiser(SequenceDenoiser(Schedule()), GaussianPrior(6, 12, 5, FRAMES), 18, FRAMES)
    velocity, whitened = torch.randn(2, 1, 11, FRAMES)
    gate = torch.randn(1, 5, FRAMES)
    given = net.gated(torch.cat([velocity, gate], dim=1), whitened)
    torch.testing.assert_close(given[:, :6], velocity[:, :6])
    torch.testing.assert_close(given[:, 6:], velocity[:, 6:] + gate * whitened[:, 6:])
    torch.testing.assert_close(net.gated(velocity, whitened), velocity)
