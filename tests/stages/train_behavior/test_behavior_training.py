import json
from dataclasses import replace

import numpy as np
import onnxruntime
import pytest
import torch

from pipeline.baselines.predictors import Ats
from pipeline.baselines.samplers import sampler_of
from pipeline.behavior import model
from pipeline.behavior.body_denoiser import OneStageDenoiser
from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.diffusion import Schedule, noised
from pipeline.behavior.perception import GRID_SHAPE
from pipeline.behavior.planning import Sampler, TorchNetworks
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import ABSENT_M, PAST, TEST, frames_from_seconds
from pipeline.core import training as fit
from pipeline.core.errors import InputError
from pipeline.environments.homes import Habitat
from pipeline.geometry import rigid_torch
from stages.train_behavior import objective, outcome, pictures, training
from stages.train_behavior.baseline_losses import gaussian_losses
from stages.train_behavior.batches import (
    MAX_REPEATS,
    approached,
    draw_batch,
    largest_turn_rad,
    statistics_from_windows,
    windows_from_data,
)
from stages.train_behavior.config import (
    AugmentationConfig,
    BehaviorOptimizerConfig,
    BehaviorTrainingConfig,
    Config,
    ObjectiveConfig,
)
from stages.train_behavior.export import (
    difference,
    export_network,
    golden_observation,
    golden_plan,
    signature,
    write_contract,
    write_networks,
)
from stages.train_behavior.objective import (
    FORESEEN_SHARE,
    goal_error,
    joint_mask,
    losses,
    partly_foreseen,
    perceive,
    squared_error,
)
from stages.train_behavior.reactions import Reactions, measure, moments
from stages.train_behavior.refusals import check_settings
from stages.train_behavior.scene_sampler import SceneSampler
from stages.train_behavior.training import initial_nets, train, two_cosines
from tests.pipeline.behavior.wandering import ARCHITECTURE, REST, room, wandering

PAPER = replace(
    ARCHITECTURE,
    ego="full",
    observed_past="poses",
    body_components=0,
    ensemble_size=1,
    encoding="positions",
    corrections=False,
    guided="all",
)
PLAIN = AugmentationConfig(turn=0, mirror=0, past=0, posture_offset=0, hide_bones=0)


@pytest.fixture(scope="module")
def data():
    return wandering()


@pytest.fixture(scope="module")
def homes(data):
    return Habitat.of_one_home(data, Scenes.of(room()))


@pytest.fixture(scope="module")
def windows(homes):
    return windows_from_data(homes, ARCHITECTURE)


@pytest.fixture(scope="module")
def untrained(windows):
    """Networks with random weights, which tests do not change."""
    return initial_nets(ARCHITECTURE, Schedule(), statistics_from_windows(windows, 0.0), 0).eval()


def drawn(windows, augmentation, seed=0):
    statistics = statistics_from_windows(windows, largest_turn_rad(augmentation))
    batch = draw_batch(
        windows,
        SceneSampler(Scenes.of(room()), 4, "cpu"),
        statistics,
        augmentation,
        16,
        torch.Generator().manual_seed(seed),
    )
    return batch, statistics.scaling


def test_targets_have_unit_scale(windows):
    index = torch.arange(len(windows))
    scaling = statistics_from_windows(windows, 0.0).scaling
    goal = scaling.scaled_goal(windows.tracks(index).root[:, -1].numpy())
    assert np.sqrt((goal[:, [0, 2]] ** 2).mean()) == pytest.approx(1, abs=1e-3)
    path = windows.tracks(index).root[:, 8:].numpy().swapaxes(1, 2) / scaling.path_std
    np.testing.assert_allclose(np.sqrt((path[:, [0, 2]] ** 2).mean((0, 1)))[5:], 1, atol=1e-3)


@pytest.mark.parametrize("turn_rad", [0.0, np.pi])
def test_no_heading_is_clipped(windows, turn_rad):
    scaling = statistics_from_windows(windows, turn_rad).scaling
    for entry in (-1, 1):
        scaled = (entry - scaling.body_mean[:3]) / scaling.body_std[:3]
        assert np.abs(scaled).max() <= Schedule().clip + 1e-9
    assert scaling.body_std[0] < 0.45


@pytest.mark.parametrize("family", ["diffusion", "one_stage"])
def test_body_prior_is_fitted_to_training_windows(windows, family):
    """The linear estimate alone removes most noise from bones, but not from roots and paths of one-stage
    models.
    """
    architecture = replace(ARCHITECTURE, family=family, body_components=5)
    statistics = statistics_from_windows(windows, 0.0)
    body = initial_nets(architecture, Schedule(), statistics, 0).body
    posture, clean = body_sequences(body, windows, statistics)
    unfitted = linear_error(body.prior, posture, clean)
    nets = initial_nets(architecture, Schedule(), statistics, 0)
    scene = SceneSampler(Scenes.of(room()), 4, "cpu")
    training.fit_body_prior(nets, windows, scene, statistics, PLAIN, seed=0)
    bones = nets.body.prior.leading
    fitted = linear_error(nets.body.prior, posture, clean)
    torch.testing.assert_close(fitted[:bones], unfitted[:bones], atol=1e-4, rtol=0)
    assert fitted[bones:].mean() < 0.3 * unfitted[bones:].mean()


def body_sequences(body, windows, statistics):
    """The sequences of one batch and their initial postures."""
    scene = SceneSampler(Scenes.of(room()), 4, "cpu")
    batch = draw_batch(windows, scene, statistics, PLAIN, 64, torch.Generator().manual_seed(1))
    nothing = torch.zeros(64)
    held = (batch.held.mean(1) - statistics.past_mean) / statistics.past_std
    one_stage = isinstance(body, OneStageDenoiser)
    clean = torch.cat([batch.path, batch.body], dim=1) if one_stage else batch.body
    return body.posture(clean, nothing, held, batch.places)[0], clean


def linear_error(prior, posture, clean, t=20):
    """Mean squared error of the noise per channel without a correction by the UNet."""
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(2))
    share = torch.tensor(Schedule().alpha_bar[t]).float()
    residual = noised(clean, noise, share) - share.sqrt() * prior.mean(posture)
    zero = torch.zeros(len(clean), prior.corrected, clean.shape[-1])
    step = torch.full((len(clean),), float(t))
    return (prior.noise(prior.coefficients(residual), zero, step) - noise).square().mean((0, 2))


def test_bodies_have_a_prior_unless_they_are_regressed_or_trained_as_in_the_paper(data):
    scenes = Scenes.of(room())
    components = {
        "ours": outcome.architecture_for(Config(), data, scenes).body_components,
        "gaussian": outcome.architecture_for(Config(family="gaussian"), data, scenes).body_components,
        "paper": outcome.architecture_for(
            Config(training=BehaviorTrainingConfig(objective=ObjectiveConfig(weighting="noise"))),
            data,
            scenes,
        ).body_components,
        "positions": outcome.architecture_for(Config(encoding="positions"), data, scenes).body_components,
    }
    assert components["ours"] > 0 == components["gaussian"] == components["paper"] == components["positions"]


def test_windows_start_at_the_origin_facing_forward(windows):
    tracks = windows.tracks(torch.arange(len(windows)))
    assert tracks.root[:, 7].abs().max() < 1e-5
    torch.testing.assert_close(
        tracks.rotation[:, 7], torch.eye(3).expand(len(windows), 3, 3), atol=1e-5, rtol=0
    )


def test_rotation_and_mirroring_are_consistent(windows):
    plain, _ = drawn(windows, PLAIN)
    for augmentation in (replace(PLAIN, turn=1.0), replace(PLAIN, mirror=1.0)):
        moved, _ = drawn(windows, augmentation)
        for ours, theirs in ((plain.goal, moved.goal), (plain.path[:, :, 20], moved.path[:, :, 20])):
            torch.testing.assert_close(
                ours[:, [0, 2]].norm(dim=1), theirs[:, [0, 2]].norm(dim=1), atol=1e-4, rtol=1e-4
            )
            torch.testing.assert_close(ours[:, 1], theirs[:, 1])
        between = [
            b.others[:, 0, PAST - 1, :3]
            - torch.from_numpy(statistics_from_windows(windows, 0.0).scaling.goal(b.goal.numpy())).float()
            for b in (plain, moved)
        ]
        torch.testing.assert_close(between[0].norm(dim=1), between[1].norm(dim=1), atol=1e-4, rtol=1e-4)
        facing = [rigid_torch.rotation_from_6d(b.others[:, 0, :PAST, 3:9]) for b in (plain, moved)]
        turned = [each[:, 0].mT @ each[:, -1] for each in facing]
        for each in turned:
            torch.testing.assert_close(each @ each.mT, torch.eye(3).expand(16, 3, 3), atol=1e-4, rtol=0)
        trace = [each.diagonal(dim1=1, dim2=2).sum(1) for each in turned]
        torch.testing.assert_close(*trace, atol=1e-4, rtol=0)


def test_where_observers_will_be_is_turned_like_the_rest_and_known_in_some_samples(windows):
    recorded = windows.tracks(torch.arange(len(windows))).ahead.norm(dim=-1)
    nets = initial_nets(ARCHITECTURE, Schedule(), statistics_from_windows(windows, 0.0), 0)
    for augmentation in (replace(PLAIN, turn=1.0), replace(PLAIN, mirror=1.0)):
        batch, _ = drawn(windows, augmentation)
        distance = batch.others[:, 0, PAST:, :3].norm(dim=-1)
        assert (distance[:, None] - recorded).norm(dim=-1).min(dim=1).values.max() < 1e-3
        for share, bounds in ((0.0, (0, 0)), (0.5, (1, 15)), (1.0, (16, 16))):
            some = partly_foreseen(nets, batch, share, torch.Generator().manual_seed(0)).others
            known = (some[:, 0, PAST:, 0] < ABSENT_M).all(1)
            assert bounds[0] <= known.sum() <= bounds[1] and (some[known] == batch.others[known]).all()
            assert (some[:, :, :PAST] == batch.others[:, :, :PAST]).all()


def test_approaches_are_oversampled_and_perceived(windows, monkeypatch):
    monkeypatch.setattr(objective, "CONDITION_DROPOUT", 1.0)
    coming = replace(windows, approached=torch.tensor([7]))
    batch, _ = drawn(coming, replace(PLAIN, approached=1.0))
    assert batch.oversampled.all() and (batch.goal == batch.goal[0]).all()
    nets = initial_nets(ARCHITECTURE, Schedule(), statistics_from_windows(windows, 0.0), 0)
    seen, unseen = (
        perceive(
            nets,
            replace(batch, oversampled=chosen),
            ObjectiveConfig(code_dropout=0.0),
            torch.Generator().manual_seed(0),
            torch.ones(len(batch.goal), 1),
        )
        for chosen in (batch.oversampled, ~batch.oversampled)
    )
    assert (seen != unseen).any(1).all() and (unseen == unseen[0]).all()
    assert not drawn(replace(windows, approached=torch.zeros(0, dtype=torch.long)), PLAIN)[
        0
    ].oversampled.any()


def test_conditions_are_dropped_together_with_the_given_probability(windows, untrained, monkeypatch):
    monkeypatch.setattr(objective, "CONDITION_DROPOUT", 0.0)
    batch, _ = drawn(windows, replace(PLAIN, approached=0.0))
    settings = ObjectiveConfig(code_dropout=0.0, joint_dropout=0.5)
    generator = torch.Generator().manual_seed(0)
    joint = joint_mask(batch, settings, generator)
    assert 0 < joint.mean() < 1
    code = perceive(untrained, batch, settings, generator, joint)
    dropped = torch.isclose(code, code[joint[:, 0].argmin()], atol=1e-6).all(1)
    assert (dropped == (joint[:, 0] == 0)).all()
    assert (joint_mask(batch, ObjectiveConfig(), generator) == 1).all()


def test_approaches_are_near_and_towards_the_animal():
    agent = np.zeros((4, 3))
    walk, here = np.linspace(1, 0, 8)[:, None] * [0.0, 0.0, 0.7], np.array([0.0, 1.2, 1.0])
    far = np.array([0.0, 0.0, 2.0])
    observer = np.stack([here + walk, here + walk + far, here + walk[::-1], here + 0 * walk])
    assert approached(agent, observer).tolist() == [0]


def test_approaches_are_balanced_over_distances():
    walk = np.linspace(1, 0, 8)[:, None] * [0.0, 0.0, 0.7]
    distance = np.r_[np.full(20, 0.5), np.full(4, 1.5), 2.1]
    observer = walk + distance[:, None, None] * [0.0, 0.0, 1.0]
    asked = distance[approached(np.zeros((25, 3)), observer)]
    assert [(asked == near).sum() for near in (0.5, 1.5, 2.1)] == [20, 20, MAX_REPEATS]


def test_approaches_are_repeated_evenly():
    walk = np.linspace(1, 0, 8)[:, None] * [0.0, 0.0, 0.7]
    distance = np.r_[np.full(15, 0.5), np.full(10, 1.5)]
    observer = walk + distance[:, None, None] * [0.0, 0.0, 1.0]
    count = np.bincount(approached(np.zeros((25, 3)), observer))[15:]
    assert count.sum() == 15 and count[:5].sum() in (7, 8), "early windows are not drawn more often"


def test_past_augmentation_changes_only_the_past(windows):
    (plain, _), (with_posture_noise, _) = (
        drawn(windows, replace(PLAIN, posture_offset=share)) for share in (0.0, 1.0)
    )
    for name in ("scene", "others", "goal", "path", "body"):
        torch.testing.assert_close(getattr(with_posture_noise, name), getattr(plain, name))
    before, after = (batch.past.unflatten(1, (PAST, -1)) for batch in (plain, with_posture_noise))
    torch.testing.assert_close(after[:, -3:], with_posture_noise.held)
    torch.testing.assert_close(after[..., :3], before[..., :3])
    bent = after[..., 9:] - before[..., 9:]
    torch.testing.assert_close(bent, bent[:, :1].expand_as(bent), atol=1e-5, rtol=0)
    assert (bent.abs().amax((1, 2)) > 0).all()
    upright = after[..., 7]
    assert 0.05 < torch.arccos(upright[:, 0].clamp(max=1)).square().mean().sqrt() < 0.5, "radians"
    torch.testing.assert_close(after[..., 3:6].norm(dim=-1), torch.ones(16, PAST))


def test_mirrored_samples_swap_the_scene_and_hide_their_bones(windows):
    plain, _ = drawn(windows, PLAIN)
    mirrored, _ = drawn(windows, replace(PLAIN, mirror=1.0))
    assert not mirrored.bones_known.any()
    assert not mirrored.bones_keep.any()
    held = mirrored.held[..., 9:]
    torch.testing.assert_close(held, held[:1, :1].expand_as(held), msg="bones of nobody")
    assert not torch.equal(mirrored.held[..., 3:9], held[:1, :1, :6].expand_as(held[..., :6]))
    torch.testing.assert_close(mirrored.goal[:, 0], -plain.goal[:, 0])
    same = (mirrored.scene == plain.scene.flip(2)).all(1)
    assert same.float().mean() > 0.99  # points on voxel borders are ambiguous


def test_fast_scene_sampling_agrees_with_the_exact_grid(data, windows):
    volume = room()
    exact = torch.nn.functional.avg_pool3d(
        torch.from_numpy(volume.around(windows.world_from_ego[:4].numpy())), 4
    )
    fast = SceneSampler(Scenes.of(volume), 4, "cpu")(
        windows.world_from_ego[:4], torch.ones(4), torch.zeros(4, dtype=torch.long)
    )
    assert fast.shape == exact.shape == (4, 16, *(n // 4 for n in GRID_SHAPE))
    together = torch.stack([exact.flatten(), fast.flatten()])
    assert (
        torch.corrcoef(together)[0, 1] > 0.95
    )  # one reads smoothed voxels, the other averages the nearest ones


def test_rectified_flow_target_is_noise_minus_sample():
    schedule = Schedule(course="rectified")
    clean = torch.randn(64, 4, generator=torch.Generator().manual_seed(1))
    inputs_seen = {}

    def denoise(x, t):
        inputs_seen.update(x=x, t=t)
        return x.sin()

    error = squared_error(denoise, clean, schedule, "flow", torch.Generator().manual_seed(0))
    moment = ((inputs_seen["t"] + 1) / (schedule.steps + 1))[:, None]
    way = inputs_seen["x"] * ((1 - moment) ** 2 + moment**2).sqrt()
    true = (way - (1 - moment) * clean) / moment - clean
    predicted = inputs_seen["x"].sin() - (way - moment * inputs_seen["x"].sin()) / (1 - moment)
    torch.testing.assert_close(error, (predicted - true) ** 2, atol=1e-4, rtol=1e-3)


def test_high_frequency_errors_have_larger_weight():
    """Constant, alternating, and independent noise errors of size 1."""
    share, clean = torch.from_numpy(Schedule().alpha_bar).float(), torch.zeros(32, 3, 40)
    alone = torch.randn(clean.shape, generator=torch.Generator().manual_seed(1))
    alternating = 1 - 2.0 * (torch.arange(40) % 2)
    found = []
    for off in (torch.ones(40), alternating, alone):

        def denoise(x, t, off=off):
            return x / (1 - share[t.long()])[:, None, None].sqrt() + off

        generator = torch.Generator().manual_seed(0)
        found.append(float(squared_error(denoise, clean, Schedule(), "noise", generator, 4.0).mean()))
    assert found == pytest.approx([1 / 9, (1 + 16 * 39 / 40) / 9, 1.0], rel=0.03)


@pytest.mark.parametrize(
    ("shape", "names", "first"),
    [(ARCHITECTURE, ("path", "body"), 1), (replace(ARCHITECTURE, scene="volume"), ("goal",), 0)],
    ids=["unets", "volume"],
)
def test_mixed_precision_is_accurate_and_keeps_float32_weights(homes, shape, names, first):
    settings = BehaviorTrainingConfig(BehaviorOptimizerConfig(steps=3, goal_steps=1, batch=8))
    half = replace(settings, optimization=replace(settings.optimization, precision="bfloat16"))
    exact, rough = (train(homes, shape, Schedule(), each, seed=3) for each in (settings, half))
    for name in names:
        ours, theirs = rough.record.terms[name][first:], exact.record.terms[name][first:]
        np.testing.assert_allclose(ours, theirs, rtol=0.02)
        assert (ours != theirs).any(), "nothing was rounded"
    assert {value.dtype for value in rough.nets.state_dict().values() if value.is_floating_point()} == {
        torch.float32
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    "shape",
    [
        replace(ARCHITECTURE, control="concatenation"),
        replace(ARCHITECTURE, companions=True),
        replace(PAPER, scene="volume"),
    ],
    ids=["concatenation", "companions", "paper"],
)
def test_models_of_other_architectures_are_written_and_read(homes, tmp_path, shape):
    settings = BehaviorTrainingConfig(BehaviorOptimizerConfig(steps=2, goal_steps=1, batch=8))
    flow = Schedule(course="rectified")
    fitted = train(homes, shape, flow, settings, seed=0)
    outcome.write_trained(tmp_path, fitted, shape, flow, REST)
    architecture, nets, scaling, schedule, _ = model.load(tmp_path)
    assert (architecture, schedule) == (shape, flow)
    np.testing.assert_allclose(scaling.velocity_std, fitted.scaling.velocity_std)
    assert write_networks(tmp_path, nets.eval(), shape) < 5e-4


def test_model_as_in_the_paper_is_trained_read_and_sampled(data, homes, tmp_path):
    """Paths, goals and bodies are denoised as they are, and plans are what the networks predict."""
    schedule = Schedule(method="ddpm")
    objective = ObjectiveConfig(joint_dropout=0.1, weighting="noise", goal_draws=1, earlier_share=0.0)
    settings = BehaviorTrainingConfig(
        BehaviorOptimizerConfig(steps=3, goal_steps=0, batch=8, precision="bfloat16"), PLAIN, objective
    )
    fitted = train(homes, PAPER, schedule, settings, seed=0)
    assert all(np.isfinite(values).all() for values in fitted.record.terms.values())
    outcome.write_trained(tmp_path, fitted, PAPER, schedule, REST)
    assert json.loads((tmp_path / "behavior.json").read_text())["channels"]["path"] == ["x", "y", "z"]
    plain = Ats.load(tmp_path, Scenes.of(room()), PlanSamplingConfig())
    corrected = replace(plain, sampler=replace(plain.sampler, corrections=True))
    networks = replace(corrected, sampling=corrected.sampling.networks_only())
    context, _ = data.windows(data.indices(TEST)[:2])
    plans = [ats.sample(context, 2, np.random.default_rng(0)) for ats in (plain, networks, corrected)]
    np.testing.assert_array_equal(plans[0].path, plans[1].path)
    np.testing.assert_array_equal(plans[0].rotation, plans[1].rotation)
    assert np.abs(plans[0].path - plans[2].path).max() > 0.01
    assert np.linalg.norm(plans[0].path[:, :, -1] - plans[0].goal, axis=-1).min() > 1e-3, "snapped"


@pytest.mark.parametrize(
    "change", [{"family": "gaussian"}, {"family": "one_stage"}, {"control": "concatenation"}]
)
def test_baselines_and_ablations_of_positions_are_trained_and_sampled(homes, change):
    shape = replace(PAPER, observed_past="positions", guided="observer", **change)
    settings = BehaviorTrainingConfig(BehaviorOptimizerConfig(steps=2, goal_steps=0, batch=4))
    fitted = train(homes, shape, Schedule(), settings, seed=0)
    sampler = sampler_of(shape, TorchNetworks(fitted.nets), Schedule(), fitted.scaling)
    plan = sampler.plan(golden_observation(shape), PlanSamplingConfig(), np.random.default_rng(0), count=2)
    assert plan.path.shape == (2, 56, 3) and plan.body.shape == (2, 56, shape.body_channels)
    assert np.isfinite(plan.path).all() and np.isfinite(plan.body).all()


@pytest.mark.slow
def test_training_reduces_the_loss_and_resumes_bit_exactly(homes, tmp_path, monkeypatch):
    settings = BehaviorTrainingConfig(BehaviorOptimizerConfig(steps=8, goal_steps=4, batch=8))
    whole = train(homes, ARCHITECTURE, Schedule(), settings, seed=3)
    assert set(whole.record.terms) == {"goal", "path", "body"}
    learned = {
        name: np.flatnonzero(np.isfinite(values)).tolist() for name, values in whole.record.terms.items()
    }
    assert learned == {"goal": [0, 1, 2, 3], "path": [4, 5, 6, 7], "body": [4, 5, 6, 7]}
    restore = fit._Loop.advance

    def interrupted(self, *arguments):
        if self.step == 5:
            raise KeyboardInterrupt
        return restore(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(fit._Loop, "advance", interrupted)
        with pytest.raises(KeyboardInterrupt):
            train(homes, ARCHITECTURE, Schedule(), settings, seed=3, resume=tmp_path)
    resumed = train(homes, ARCHITECTURE, Schedule(), settings, seed=3, resume=tmp_path)
    for name, value in whole.nets.state_dict().items():
        torch.testing.assert_close(resumed.nets.state_dict()[name], value, atol=0, rtol=0)


def test_goals_and_paths_have_their_own_fraction_of_approaches(homes, monkeypatch):
    asked = []

    def watched(windows, scene, statistics, augmentation, *rest, **how):
        asked.append(augmentation.approached)
        return draw_batch(windows, scene, statistics, augmentation, *rest, **how)

    monkeypatch.setattr(training, "draw_batch", watched)
    settings = BehaviorTrainingConfig(
        BehaviorOptimizerConfig(steps=3, goal_steps=2, batch=4, goal_batch=4),
        AugmentationConfig(approached=0.2, approached_paths=0.5),
    )
    train(homes, ARCHITECTURE, Schedule(), settings, seed=0)
    prior = len(asked) - 3
    assert asked == [0.5] * prior + [0.2, 0.2, 0.5] and prior > 0


def test_contract_is_complete_and_round_trips(windows, untrained, tmp_path):
    scaling = statistics_from_windows(windows, 0.0).scaling
    write_contract(tmp_path, untrained, ARCHITECTURE, scaling, Schedule(), REST)
    contract = json.loads((tmp_path / "behavior.json").read_text())
    golden = json.loads((tmp_path / "golden.json").read_text())
    assert contract["architecture"]["bones"] == len(contract["bones"]) == 3
    assert len(golden["plans"]["guidance_1"]["path"]) == 56
    architecture, loaded, rescaled, schedule, rest = model.load(tmp_path)
    assert architecture == ARCHITECTURE
    assert schedule == Schedule()
    np.testing.assert_allclose(rest, REST)
    assert golden_plan(Sampler(TorchNetworks(loaded), schedule, rescaled), architecture) == golden


@pytest.mark.slow
def test_exported_network_is_exact_and_deterministic(untrained, tmp_path):
    inputs, output = signature("goal", ARCHITECTURE)
    for name in ("first", "second"):
        export_network(untrained.goal, tmp_path / f"{name}.onnx", inputs, output)
    assert difference(untrained.goal, tmp_path / "first.onnx", inputs) < 1e-5
    assert (tmp_path / "first.onnx").read_bytes() == (tmp_path / "second.onnx").read_bytes()


def test_golden_plan_uses_its_noise(windows, untrained):
    scaling = statistics_from_windows(windows, 0.0).scaling
    sampler = Sampler(TorchNetworks(untrained), Schedule(), scaling)
    golden = golden_plan(sampler, ARCHITECTURE)

    class Noted:
        def __init__(self):
            self.queue = [
                np.array([golden["noise"][level]], np.float32) for level in ("goal", "path", "body")
            ]

        def standard_normal(self, shape, dtype):
            assert self.queue[0].shape == tuple(shape)
            return self.queue.pop(0)

    plan = sampler.plan(golden_observation(ARCHITECTURE), PlanSamplingConfig("dpm_solver", 10, 10), Noted())
    np.testing.assert_allclose(plan.path[0], golden["plans"]["guidance_1.25"]["path"], atol=1e-4)


@pytest.mark.slow
def test_static_animal_is_exported(untrained, tmp_path):
    """All frames of the past are equal: the velocity is zero, and so is the base of its power."""
    inputs, output = signature("perception", ARCHITECTURE)
    export_network(untrained.perception, tmp_path / "perception.onnx", inputs, output)
    assert difference(untrained.perception, tmp_path / "perception.onnx", inputs) < 1e-4


class Timid:
    """Networks of an animal that moves one meter away from an observer within 4 m, with a standard deviation
    of 0.1 m.
    """

    def perceive(self, scene_grid, others, past, keep):
        position = others[:, 0, PAST - 1, :3:2] * keep[:, 1:2]
        distance = np.linalg.norm(position, axis=1, keepdims=True)
        return np.where((distance > 0) & (distance < 4), -position / np.maximum(distance, 1e-6), 0).astype(
            np.float32
        )

    def goal(self, x, t, condition):
        share = Schedule().alpha_bar[int(t[0])]
        condition = np.repeat(condition, len(x) // len(condition), axis=0)
        mean = np.stack([condition[:, 0], 0 * condition[:, 0], condition[:, 1]], axis=1)
        clean = mean + np.sqrt(share) * 0.01 / (share * 0.01 + 1 - share) * (x - np.sqrt(share) * mean)
        return (x - np.sqrt(share) * clean) / np.sqrt(1 - share)


def test_reactions_measure_a_known_animal(data, windows):
    seen = moments(data, Scenes.of(room()), ARCHITECTURE, 3)
    scaling = replace(statistics_from_windows(windows, 0.0).scaling, goal_std=np.ones(3))
    measured = measure(Sampler(Timid(), Schedule(), scaling), seen.observation, radius_m=4.0, seed=0)
    expected = Reactions(away_m=1.0, away_share=1.0, reversal_m=2.0, far_m=0.0, farther_m=0.0)
    for name, value in vars(expected).items():
        assert getattr(measured, name) == pytest.approx(value, abs=0.05), name


def test_paths_are_drawn_by_scale_of_guidance_for_every_window(data, windows):
    seen = moments(data, Scenes.of(room()), ARCHITECTURE, 2)
    statistics = statistics_from_windows(windows, 0.0)
    networks = TorchNetworks(initial_nets(ARCHITECTURE, Schedule(), statistics, 0))
    rooms = [pictures.RoomMap(room())] * 2
    for guided in ("observer", "all"):
        sampler = Sampler(networks, Schedule(), statistics.scaling, guided)
        image = pictures.guided_paths(rooms, sampler, seen.observation, seen.world_from_ego, 0)
        rows = np.array_split(image.astype(int), 3)
        assert all(row.std() > 1 for row in rows)
        assert np.abs(rows[0] - rows[2]).max() > 50, "guidance changes the paths"


def test_learning_rate_decays_twice():
    factor = [two_cosines(step / 100, 0.3) for step in range(100)]
    assert max(factor) == pytest.approx(1, abs=0.02)
    assert factor[29] < 0.05
    assert factor[40] > 0.9
    assert factor[99] < 0.05
    assert two_cosines(0.99, 2.5) < 0.05


def test_each_phase_trains_its_own_networks(data, windows):
    batch, _ = drawn(windows, AugmentationConfig())
    nets = initial_nets(ARCHITECTURE, Schedule(), statistics_from_windows(windows, 3.0), 0)
    every, bodiless = ObjectiveConfig(), ObjectiveConfig(body_share=0.0)
    parts = (
        ("goals", every, {"perception", "goal"}),
        ("sequences", every, {"path", "body"}),
        ("sequences", bodiless, {"path"}),
        ("all", every, {"perception", "goal", "path", "body"}),
    )
    for part, shares, learning in parts:
        nets.zero_grad(set_to_none=True)
        generator = torch.Generator().manual_seed(0)
        sum(losses(nets, batch, Schedule(), shares, generator, phase=part).values()).backward()
        assert {
            name.split(".")[0] for name, parameter in nets.named_parameters() if parameter.grad is not None
        } == learning


class Asked:
    """A goal network that records the requested part of the future and returns the true goal."""

    def __init__(self, track):
        self.goal, self.track, self.horizons = self, track, torch.zeros(0)

    def per_member(self, x, t, code, horizon):
        self.horizons = horizon
        row = code[:, 0].long().repeat_interleave(len(x) // len(code))
        clean = self.track[row, :, (horizon * self.track.shape[-1]).round().long() - 1]
        share = torch.from_numpy(Schedule().alpha_bar).float()[t.long()][:, None]
        return ((x - share.sqrt() * clean) / (1 - share).sqrt())[None]


@pytest.mark.parametrize(("share", "lowest", "highest"), [(0.0, 1.0, 1.0), (1.0, 0.2, 0.5)])
def test_earlier_goals_have_the_given_probability(windows, share, lowest, highest):
    batch, _ = drawn(windows, PLAIN)
    torch.testing.assert_close(batch.track[:, :, -1], batch.goal)
    nets, number = Asked(batch.track), torch.arange(len(batch.goal), dtype=torch.float32)[:, None]
    settings = ObjectiveConfig(earlier_share=share, goal_draws=4)
    error = goal_error(nets, batch, number, Schedule(), settings, torch.Generator().manual_seed(0))
    assert error.shape == (4 * len(batch.goal), 3)
    assert error.abs().max() < 1e-3  # the true goal for the requested time
    assert lowest - 1e-6 <= nets.horizons.min() <= highest


def test_gaussian_goals_are_learned_by_each_member_and_at_earlier_times(windows, untrained, monkeypatch):
    batch, _ = drawn(windows, PLAIN)
    asked, answers, of_each = [], [], untrained.goal.per_member

    def per_member(x, t, code, horizon):
        asked.append(horizon)
        answers.append(of_each(x, t, code, horizon))
        return answers[-1]

    monkeypatch.setattr(untrained.goal, "per_member", per_member)
    settings = ObjectiveConfig(goal_draws=4, code_dropout=0.0)
    generator = torch.Generator().manual_seed(0)
    found = gaussian_losses(untrained, batch, Schedule(), settings, generator, phase="goals")["goal"]
    assert all(len(horizon) == 4 * len(batch.goal) for horizon in asked)
    assert min(horizon.min() for horizon in asked) < 0.5 < 1 == max(horizon.max() for horizon in asked)
    errors = []
    for horizon, mean, log_std in zip(asked[::2], answers[::2], answers[1::2], strict=True):
        row = torch.arange(len(horizon)) // 4
        clean = batch.track[row, :, (horizon * batch.track.shape[-1]).round().long() - 1]
        errors.append(-torch.distributions.Normal(mean, log_std.clamp(-5, 2).exp()).log_prob(clean).mean())
    goal, informed = errors
    torch.testing.assert_close(found, (goal + FORESEEN_SHARE * informed) / (1 + FORESEEN_SHARE))


@pytest.mark.parametrize(
    ("settings", "code"),
    [
        (
            Config(training=BehaviorTrainingConfig(BehaviorOptimizerConfig(steps=100, goal_steps=200))),
            "REC-002",
        ),
        (Config(family="one_stage"), "REC-002"),
        (Config(horizon_s=60.0), "BEH-001"),
    ],
)
def test_impossible_configurations_are_refused(data, settings, code):
    def asked(config):
        longer = data.with_horizon(frames_from_seconds(config.horizon_s))
        check_settings(
            config, longer, outcome.architecture_for(config, longer, Scenes.of(room())), "behavior_data"
        )

    with pytest.raises(InputError, match=code):
        asked(settings)
    asked(Config())


@pytest.mark.slow
def test_exported_network_accepts_any_number_of_companions(tmp_path):
    torch.manual_seed(0)
    shape = replace(ARCHITECTURE, companions=True)
    nets = model.BehaviorNets(shape, Schedule()).eval()
    inputs, output = signature("perception", shape)
    export_network(nets.perception, tmp_path / "perception.onnx", inputs, output)
    assert difference(nets.perception, tmp_path / "perception.onnx", inputs) < 1e-4
    session = onnxruntime.InferenceSession(tmp_path / "perception.onnx")
    rng = np.random.default_rng(0)
    for count in (1, 2, 4):
        sizes = inputs | {"others": (count, *inputs["others"][1:])}
        drawn = {name: rng.standard_normal((3, *size), dtype=np.float32) for name, size in sizes.items()}
        with torch.inference_mode():
            expected = nets.perception(*map(torch.from_numpy, drawn.values())).numpy()
        np.testing.assert_allclose(session.run(None, drawn)[0], expected, atol=1e-4)
