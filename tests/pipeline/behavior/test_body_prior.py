import numpy as np
import torch
from scipy.fft import dct

from pipeline.behavior.body_denoiser import GaussianPrior
from pipeline.behavior.denoisers import NoiseFromVelocity
from pipeline.behavior.diffusion import Schedule, noised, sample

FRAMES, BONES, ROOT = 16, 12, 6


def motion(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Gaussian sequences of three components, in all channels, that start at a posture and forget it slowly."""
    generator = torch.Generator().manual_seed(seed)
    mixing = 0.5 * torch.randn(ROOT + BONES, 3, generator=torch.Generator().manual_seed(9))
    mixing[:ROOT] *= 0.2
    start = torch.randn(count, 3, 1, generator=generator)
    falloff = 2.0 / (1 + torch.arange(FRAMES)) ** 2
    spectrum = torch.randn(count, 3, FRAMES, generator=generator) * falloff
    forgotten = spectrum @ torch.from_numpy(dct(np.eye(FRAMES), norm="ortho", axis=0)).float()
    clean = mixing @ (torch.linspace(1, 0.2, FRAMES) * start + forgotten)
    clean = clean + 0.1 * torch.randn(clean.shape, generator=generator)
    return (mixing @ start).expand(-1, -1, FRAMES), clean


def fitted(components: int = 4) -> GaussianPrior:
    prior = GaussianPrior(ROOT, BONES, components, FRAMES)
    prior.fit(*motion(4096))
    return prior


def noisy_residual(prior: GaussianPrior, t: int, count: int = 2048):
    """Noised residuals of held-out sequences at a step, and their noise."""
    posture, clean = motion(count, seed=1)
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(2))
    share = torch.tensor(Schedule().alpha_bar[t]).float()
    x = noised(clean, noise, share)
    return x - share.sqrt() * prior.mean(posture), noise, torch.full((count,), float(t))


def test_unfitted_prior_is_v_prediction_of_the_residual():
    prior = GaussianPrior(ROOT, BONES, BONES, FRAMES)
    x, velocity = torch.randn(2, 3, ROOT + BONES, FRAMES)
    t = torch.tensor([0.0, 20.0, 49.0])
    torch.testing.assert_close(prior.mean(x), x, atol=1e-5, rtol=0)
    torch.testing.assert_close(prior.whitened(prior.coefficients(x), t), x, atol=1e-5, rtol=0)
    expected = NoiseFromVelocity(Schedule())(x, velocity, t)
    torch.testing.assert_close(prior.noise(prior.coefficients(x), velocity, t), expected, atol=1e-5, rtol=0)


def test_unet_reads_unit_variance_components():
    prior = fitted()
    for t in (0, 20, 49):
        residual, _, step = noisy_residual(prior, t)
        whitened = prior.whitened(prior.coefficients(residual), step)
        assert whitened.shape == (2048, ROOT + 4, FRAMES)
        assert (whitened[:, ROOT:].var((0, 2)) - 1).abs().max() < 0.15


def test_uncorrected_noise_is_the_best_linear_estimate():
    """Its residual is much smaller than for independent channels of unit variance."""
    prior, plain = fitted(), GaussianPrior(ROOT, BONES, BONES, FRAMES)
    for t in (5, 15, 30):
        residual, noise, step = noisy_residual(prior, t)
        zero = torch.zeros(len(residual), prior.corrected, FRAMES)
        error = (prior.noise(prior.coefficients(residual), zero, step) - noise)[:, ROOT:].square().mean()
        zero = torch.zeros(len(residual), plain.corrected, FRAMES)
        alone = (plain.noise(plain.coefficients(residual), zero, step) - noise)[:, ROOT:].square().mean()
        assert error < 0.4 * alone


def test_samples_have_the_covariance_of_the_data():
    """With the linear estimate alone and many solver steps; the data are Gaussian."""
    schedule = Schedule(steps=400, beta_last=0.04)
    prior = GaussianPrior(ROOT, BONES, 4, FRAMES, schedule)
    prior.fit(*motion(4096))
    posture, clean = motion(1024, seed=3)
    mean, zero = prior.mean(posture), torch.zeros(1024, prior.corrected, FRAMES)

    def denoise(x, t):
        share = schedule.alpha_bar[int(t)] ** 0.5
        return prior.noise(prior.coefficients(x - share * mean), zero, torch.full((1024,), t))

    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(4))
    drawn = sample(denoise, noise, schedule, method="dpm_solver", count=100)
    for each in (drawn, clean), (drawn.diff(dim=-1), clean.diff(dim=-1)):
        sampled, true = (torch.cov(sequence[:, ROOT:].transpose(0, 1).flatten(1)) for sequence in each)
        assert (sampled - true).norm() < 0.15 * true.norm()


def test_other_channels_keep_unit_variance():
    prior = fitted()
    assert (prior.std[:ROOT] == 1).all() and (prior.weight[:ROOT] == 1).all()
    assert (prior.basis[:ROOT, :ROOT] == torch.eye(ROOT)).all()
    assert (prior.std[ROOT:] != 1).all()
