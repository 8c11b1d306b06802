from __future__ import annotations

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.callbacks import EvalCallback

from famle_agent import FAMLE
from famle_agent.models.observation import ObservationLayout
from famle_agent.models.reward import LearnedReward, LearnedTermination


def test_dimension_that_never_changes_is_not_blown_up() -> None:
    chance = torch.Generator().manual_seed(0)
    obs = torch.randn(1000, 3, generator=chance)
    next_obs = obs + 0.1 * torch.randn(1000, 3, generator=chance)
    obs[:, 2], next_obs[:, 2] = 1.0, 1.0
    action, reward = 2.0 * torch.rand(1000, 1, generator=chance) - 1.0, -next_obs[:, 0].square()
    learned = LearnedReward(ObservationLayout(3), 1)
    learned.fit(obs, action, next_obs, reward, chance, steps=300)
    drifted = next_obs + torch.tensor([0.0, 0.0, 0.01])
    torch.testing.assert_close(learned(obs, action, drifted), learned(obs, action, next_obs), atol=0.1, rtol=0.0)


def test_callbacks_let_an_agent_act_while_it_learns_its_reward() -> None:
    small = {"hidden": (8,), "policy_steps": 0, "transitions_per_situation": 50, "joint_iterations": 2}
    agent = FAMLE("Pendulum-v1", seed=0, device="cpu", candidates=8, **small)
    watch = EvalCallback(gym.make("Pendulum-v1", max_episode_steps=5), eval_freq=1, n_eval_episodes=1, verbose=0)
    agent.meta_learn([lambda: gym.make("Pendulum-v1")], callback=watch, check=False)
    assert np.isfinite(watch.last_mean_reward)


def test_ends_of_episodes_are_learnt_though_they_are_rare() -> None:
    chance = torch.Generator().manual_seed(0)
    obs = torch.randn(2, 3000, 3, generator=chance)
    ended = obs[..., 1] > 2.0
    assert 0.01 < ended.float().mean() < 0.04
    learned = LearnedTermination(ObservationLayout(3))
    learned.fit(obs, ended, chance, steps=800)
    unseen = torch.randn(5000, 3, generator=chance)
    true, found = unseen[:, 1] > 2.0, learned(unseen)
    assert found.dtype == torch.bool
    assert found[true].float().mean() > 0.85
    assert found[~true].float().mean() < 0.03
