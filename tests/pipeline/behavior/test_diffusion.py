import numpy as np
import pytest
import torch

from pipeline.behavior.denoisers import EMBEDDING, ControlUNet, UncontrolledUNet
from pipeline.behavior.diffusion import Schedule, guided, noised, sample

SCHEDULE = Schedule()


def ideal_network(mean: float, std: float):
    """The noise that an ideal network predicts when the data are N(mean, std^2)."""

    def denoise(x, t):
        share = SCHEDULE.alpha_bar[int(t)]
        clean = mean + np.sqrt(share) * std**2 / (share * std**2 + 1 - share) * (x - np.sqrt(share) * mean)
        return (x - np.sqrt(share) * clean) / np.sqrt(1 - share)

    return denoise


@pytest.mark.parametrize(
    ("method", "count", "tolerance"), [("ddpm", 50, 0.06), ("dpm_solver", 50, 0.03), ("dpm_solver", 10, 0.03)]
)
def test_samplers_reproduce_a_gaussian(method, count, tolerance):
    rng = np.random.default_rng(0)
    noise = rng.standard_normal(20000)
    x = sample(
        ideal_network(0.7, 0.5),
        noise,
        SCHEDULE,
        method=method,
        count=count,
        draw=lambda: rng.standard_normal(20000),
    )
    assert (
        abs(x.mean() - 0.7) < tolerance
    )  # 50 steps with the posterior variance shrink the variance, few steps with the large one increase it
    assert abs(x.std() - 0.5) < tolerance


def test_forward_variance_keeps_unit_variance_in_few_steps():
    rng = np.random.default_rng(0)
    spread = {}
    for method in ("ddpm", "ddpm_large"):
        x = sample(
            ideal_network(0.0, 1.0),
            rng.standard_normal(40000),
            SCHEDULE,
            method=method,
            count=20,
            draw=lambda: rng.standard_normal(40000),
        )
        spread[method] = x.std()
    assert spread["ddpm_large"] == pytest.approx(1.0, abs=0.02)  # the standard error is 0.004
    assert spread["ddpm"] < 0.95


@pytest.mark.parametrize(("std", "tolerance"), [(1.5, 0.02), (1.0, 0.02), (0.5, 0.02), (0.3, 0.04)])
def test_solver_keeps_the_variance_in_ten_steps(std, tolerance):
    x = sample(ideal_network(0.0, std), np.ones(1), SCHEDULE, method="dpm_solver", count=10)
    assert x[0] == pytest.approx(std, rel=tolerance)


def test_noising_keeps_unit_variance():
    rng = np.random.default_rng(0)
    clean, noise = rng.standard_normal((2, 100000))
    assert noised(clean, noise, 0.3).std() == pytest.approx(1, abs=0.01)


def test_schedule_ends_in_noise_and_samplers_use_both_end_points():
    assert SCHEDULE.alpha_bar[0] > 0.999
    assert SCHEDULE.alpha_bar[-1] < 0.01
    for count in (4, 10, 50):
        steps = SCHEDULE.visited(count, "ddpm")
        assert (steps[0], steps[-1], len(set(steps))) == (49, 0, count)
        steps = SCHEDULE.visited(count, "dpm_solver")
        assert (steps[0], steps[-1]) == (49, 0) and len(steps) <= count
        assert np.diff(steps).max() < 0


def test_guidance_is_linear_in_its_scale():
    blend = guided((lambda x, t: x + 3, lambda x, t: x + 1), (0.5,))
    assert blend(0.0, 0) == 2.0
    assert guided((lambda x, t: 3.0, lambda x, t: 1.0), (1.0,))(0.0, 0) == 3.0
    assert guided((lambda x, t: 3.0, lambda x, t: 1.0), (0.0,))(0.0, 0) == 1.0
    each = guided((lambda x, t: x + 3, lambda x, t: x + 1), (np.array([0.5, 1.0]),))
    np.testing.assert_allclose(each(np.zeros(2), 0), [2.0, 3.0])


def test_control_affects_every_block_and_can_be_dropped():
    torch.manual_seed(0)
    net = ControlUNet(4, 3, condition=8, widths=(8, 16)).eval()
    x, t, code = torch.randn(2, 4, 56), torch.tensor([3.0, 40.0]), torch.randn(2, 8)
    keep, drop = torch.ones(2, 1), torch.zeros(2, 1)
    first, second = torch.randn(2, 3), torch.randn(2, 3)
    torch.testing.assert_close(
        net(x, t, code, first, keep), net(x, t, code, second, keep)
    )  # initialized to zero
    assert len(net.inject) == 5
    for zero in net.inject:
        torch.nn.init.normal_(zero.weight)
    assert (net(x, t, code, first, keep) - net(x, t, code, second, keep)).abs().max() > 1e-3
    torch.testing.assert_close(net(x, t, code, first, drop), net(x, t, code, second, drop))
    sequence = first[..., None].expand(2, 3, 56)
    torch.testing.assert_close(net(x, t, code, first, keep), net(x, t, code, sequence, keep))


def test_uncontrolled_network_equals_controlled_one_without_control():
    torch.manual_seed(0)
    steered = ControlUNet(4, 3, condition=8, widths=(8, 16)).eval()
    free = UncontrolledUNet(4, torch.nn.Linear(8, EMBEDDING), widths=(8, 16)).eval()
    free.load_state_dict(
        {name: value for name, value in steered.state_dict().items() if name in free.state_dict()}
    )
    x = torch.randn(2, 4, 56)
    t = torch.tensor([3.0, 40.0])
    code = torch.randn(2, 8)
    control = torch.randn(2, 3)
    dropped = torch.zeros(2, 1)
    torch.testing.assert_close(free(x, t, code, control, dropped + 1), steered(x, t, code, control, dropped))


@pytest.mark.parametrize("course", ["linear", "rectified"])
def test_solver_is_deterministic_and_returns_the_corrected_estimate(course):
    """For any number of steps; corrected estimates are extrapolated, and the last one is returned."""
    schedule = Schedule(course=course)
    for count in (1, 2, 3, 10):
        assert schedule.visited(count, "dpm_solver")[0] == 49
        x = sample(
            lambda x, t: x,
            np.random.default_rng(0).standard_normal(100),
            schedule,
            method="dpm_solver",
            count=count,
            correct=lambda clean: np.abs(clean),
        )
        assert np.isfinite(x).all() and (count == 1 or (x >= 0).all())
