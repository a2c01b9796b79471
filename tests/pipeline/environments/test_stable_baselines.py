"""Stable-Baselines3 accepts the environment; ended episodes are reset within the same step."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.behavior.trajectories import TEST
from tests.pipeline.environments.small_world import QUICK, small_world

gymnasium = pytest.importorskip("gymnasium")
pytest.importorskip("stable_baselines3")


def test_ppo_runs():
    from stable_baselines3 import PPO

    from pipeline.environments.stable_baselines import PersonStableVecEnv

    env = PersonStableVecEnv(small_world(replace(QUICK, episode_s=1.0)), 4)
    model = PPO("MultiInputPolicy", env, n_steps=16, batch_size=32, n_epochs=1, seed=0, device="cpu")
    model.learn(64)
    action, _ = model.predict(env.reset(), deterministic=True)
    assert action.shape == (4, 3) and np.isfinite(action).all()


def test_ended_episodes_return_the_terminal_observation_and_reset():
    from pipeline.environments.stable_baselines import PersonStableVecEnv

    env = PersonStableVecEnv(small_world(replace(QUICK, episode_s=0.5, reward="calm")), 3)
    env.seed(0)
    env.reset()
    assert env.reset_infos == [{"home": 0, "share_known": 1.0}] * 3
    for frame in range(5):
        before = env.world.persons.position.copy()
        seen, _, done, info = env.step(np.zeros((3, 3)))
        assert done.tolist() == [frame == 4] * 3
    assert all(each["TimeLimit.truncated"] for each in info)
    assert np.abs(env.world.persons.position - before).max() > 0.1, "other starts"
    for row, each in enumerate(info):
        assert not np.allclose(each["terminal_observation"]["animal"], seen["animal"][row])


def test_the_split_may_be_given_as_an_option():
    from pipeline.environments.stable_baselines import PersonStableVecEnv

    env = PersonStableVecEnv(small_world(), 6)
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        env.step(np.zeros((6, 3)))
    data = env.world.habitat.data
    tested = {int(video) for video in data.video[data.split == TEST]}
    env.set_options({"split": "test"})
    env.reset()
    assert env.split == "test" and set(env.world.video.tolist()) <= tested
