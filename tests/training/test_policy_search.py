from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from famle_agent.training.policy_search import PolicySearch, Search

TINY = PolicySearch(steps=120, updates_per_step=0.1, batch_size=8, hidden=(8,), random_steps=20)


class Reach(gym.Env[Any, Any]):
    """A point on a line whose motor may be reversed; a reward for being near 0, and an end beyond 2."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Box(-2.0, 2.0, (1,), np.float32)

    def __init__(self, gain: float) -> None:
        self.gain = gain

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.t = self.np_random.uniform(-1.0, 1.0, 1).astype(np.float32), 0
        return self.x.copy(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.x, self.t = (self.x + 0.25 * self.gain * np.asarray(action)).astype(np.float32), self.t + 1
        return self.x.copy(), -float(abs(self.x[0])), bool(abs(self.x[0]) > 2.0), self.t >= 10, {}


def search(settings: PolicySearch = TINY, seed: int = 0) -> Search:
    torch.manual_seed(seed)
    made = Search(settings, [lambda: Reach(1.0), lambda: Reach(-1.0)], ["intact", "reversed"], seed)
    for _ in made.run():
        pass
    made.close()
    return made


def test_all_that_was_gone_through_is_kept() -> None:
    data = search().transitions()
    assert data.situations == ("intact", "reversed")
    assert data.obs.shape == (2, 60, 1)
    for i, gain in enumerate((1.0, -1.0)):
        np.testing.assert_allclose(data.next_obs[i], data.obs[i] + 0.25 * gain * data.action[i], atol=1e-5)
    np.testing.assert_allclose(data.reward, -np.abs(data.next_obs[..., 0]), atol=1e-6)
    np.testing.assert_array_equal(data.ended, np.abs(data.next_obs[..., 0]) > 2.0)
    assert np.abs(data.action).max() > 1.0  # in the environment's units


def test_same_seed_gives_the_same_and_leaves_the_random_numbers_of_others() -> None:
    np.random.seed(5)
    one = search().transitions()
    assert np.random.random() == np.random.RandomState(5).random()
    other = search().transitions()
    np.testing.assert_array_equal(one.action, other.action)
    assert (search(seed=1).transitions().action != one.action).any()


@pytest.mark.slow
def test_policy_knows_what_to_do_in_each_situation() -> None:
    made = search(PolicySearch(steps=3000, updates_per_step=0.5, batch_size=64, hidden=(32, 32), random_steps=100))
    actor_critic = made.actor_critic()
    right, left = (actor_critic.act(torch.tensor([[-1.0], [1.0]]), told)[:, 0] for told in torch.eye(2))
    assert right[0] > 0.3 > -0.3 > right[1]
    assert left[0] < -0.3 < 0.3 < left[1]
    near, far = actor_critic.value(torch.tensor([[0.0], [1.8]]), torch.eye(2)[0])
    assert near > far


def test_actor_is_that_of_stable_baselines() -> None:
    """A model that is cut out of the library says the same, normalisation included."""
    made = search()
    actor_critic, sac = made.actor_critic(), made.sac
    obs = np.array([[0.3, 1.0, 0.0], [-0.4, 0.0, 1.0]], np.float32)
    expected, _ = sac.predict(sac.get_vec_normalize_env().normalize_obs(obs), deterministic=True)
    found = actor_critic.act(torch.as_tensor(obs[:, :1]), torch.eye(2))
    np.testing.assert_allclose(2.0 * found.numpy(), expected, rtol=1e-4, atol=1e-5)


def test_budget_is_of_all_situations_together() -> None:
    assert [PolicySearch(steps=1000).steps_of_each(n) for n in (1, 5, 3)] == [1000, 200, 333]
