"""Learning what to do in every training situation at once, on the simulators themselves.

Stable-Baselines3's soft actor-critic is told which situation it is in. What it went through on the way, bad, middling
and good behaviour in every situation, is what a dynamics model learns from; the actor proposes plans on the robot, and
the critics see beyond their end.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from famle_agent.data import gate
from famle_agent.data.transitions import EnvSource, Transitions
from famle_agent.data.watch import Watch
from famle_agent.models.actor_critic import ActorCritic, Features
from famle_agent.utils.chance import GlobalChance

__all__ = ["PolicySearch", "Search"]

_CHUNK = 200  # steps of each situation between two reports
_EPSILON = 1e-20  # added to variances: the square of a unit so small that rounding alone is as large


@dataclass(frozen=True)
class PolicySearch:
    """How a policy for all situations is learnt in simulation.

    Attributes:
        steps: Simulated steps of all situations together; about 100,000 take three minutes of one core.
        updates_per_step: Gradient steps to each simulated step of any situation.
        batch_size: Transitions per gradient step.
        lr: Rate of actor and critics.
        hidden: Width of each of their hidden layers.
        interaction_rank: Products of the observation and the situation that they see.
        discount: gamma.
        random_steps: Steps of each situation at the beginning, whose actions are random.
        untold: Part of each batch in which the situation is not told, so that there is something to do before it is.
    """

    steps: int = 200_000
    updates_per_step: float = 0.25
    batch_size: int = 128
    lr: float = 1e-3
    hidden: tuple[int, ...] = (192, 192)
    interaction_rank: int = 36
    discount: float = 0.99
    random_steps: int = 800
    untold: float = 0.1

    def __post_init__(self) -> None:
        object.__setattr__(self, "hidden", tuple(int(width) for width in self.hidden))
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"policy_hidden must name the width of at least one layer, got {self.hidden}.")
        if self.interaction_rank < 1:
            raise ValueError(f"policy_interaction_rank must be at least 1, got {self.interaction_rank!r}.")
        if self.untold > 1.0:
            raise ValueError(f"policy_untold is a part of each batch, at most 1, got {self.untold!r}.")
        if not 0.0 < self.discount < 1.0:
            raise ValueError(f"discount must be above 0 and below 1, got {self.discount!r}.")

    def steps_of_each(self, situations: int) -> int:
        """Returns the simulated steps of each of N situations."""
        return max(1, self.steps // situations)


class Search:
    """A policy search on its way.

    Args:
        settings: How to learn.
        sources: The environment of each situation, or what makes it.
        situations: What each is called.
        seed: Seed of all the chance.
        episode_length: Steps after which an episode is cut short; 0 leaves its end to the environment.

    Attributes:
        sac: Stable-Baselines3's soft actor-critic.
        action_space: Of the robot.
        chance: What Stable-Baselines3 draws, which draws from the global generators.
    """

    def __init__(
        self,
        settings: PolicySearch,
        sources: Sequence[EnvSource],
        situations: Sequence[str],
        seed: int,
        episode_length: int = 0,
    ) -> None:
        self._settings, self._situations = settings, tuple(situations)
        made = [source if isinstance(source, gym.Env) else source() for source in sources]
        self._close = [env for env, source in zip(made, sources, strict=True) if env is not source]
        n = len(made)

        def told(i: int) -> gym.Env[Any, Any]:
            env = made[i]
            limited = gym.wrappers.TimeLimit(env, episode_length) if episode_length else env
            return Monitor(_Told(limited, i, n))

        self._steps = settings.steps_of_each(n)
        self.action_space: spaces.Box = made[0].action_space  # type: ignore[assignment]
        self._obs_dim = made[0].observation_space.shape[0]  # type: ignore[index]
        envs = DummyVecEnv([lambda i=i: told(i) for i in range(n)])  # type: ignore[misc]
        envs.seed(seed)
        self._envs = VecNormalize(envs, gamma=settings.discount, epsilon=_EPSILON)
        running: Any
        for running in (self._envs.obs_rms, self._envs.ret_rms):
            running.count = 0.0  # without a first guess of mean and variance, which would be one of units
        self.chance = GlobalChance(seed)
        train_every = max(1, 50 // n)
        features = {"obs_dim": self._obs_dim, "n_situations": n, "rank": settings.interaction_rank}
        with self.chance(), _float32():
            self.sac = SAC(
                "MlpPolicy",
                self._envs,
                learning_rate=settings.lr,
                batch_size=settings.batch_size,
                buffer_size=self._steps * n,
                learning_starts=min(settings.random_steps, self._steps // 2) * n,
                train_freq=train_every,
                gradient_steps=max(1, round(settings.updates_per_step * train_every * n)),
                gamma=settings.discount,
                replay_buffer_class=_PartlyUntold,
                replay_buffer_kwargs={"untold": settings.untold, "n_situations": n},
                policy_kwargs={
                    "net_arch": list(settings.hidden),
                    "features_extractor_class": _Features,
                    "features_extractor_kwargs": features,
                    "optimizer_kwargs": {"fused": True},
                },
                device="cpu",
            )
            self._envs.action_space.seed(seed)

    def run(self) -> Iterator[dict[str, float]]:
        """Searches; whoever has enough, stops.

        Yields:
            The mean return of the last episodes of all situations, after some steps of each.
        """
        n = self._envs.num_envs
        while self.sac.num_timesteps < self._steps * n:
            left = self._steps - self.sac.num_timesteps // n
            with self.chance(), _float32():
                self.sac.learn(min(_CHUNK, left) * n, log_interval=None, reset_num_timesteps=False)  # type: ignore[arg-type]
            returns = [info["r"] for info in self.sac.ep_info_buffer or ()]
            yield {"policy/return": float(np.mean(returns))} if returns else {}

    @property
    def done(self) -> int:
        """Simulated steps of all situations so far."""
        return self.sac.num_timesteps

    def transitions(self) -> Transitions:
        """Returns all that was gone through."""
        buffer: Any = self.sac.replay_buffer
        n = buffer.buffer_size if buffer.full else buffer.pos

        def of_each(values: npt.NDArray[Any]) -> Any:
            return np.ascontiguousarray(values[:n].swapaxes(0, 1), dtype=np.float32)

        told = buffer.observations, buffer.next_observations
        obs, next_obs = (of_each(values[..., : self._obs_dim]) for values in told)
        action: Any = self.sac.policy.unscale_action(of_each(buffer.actions))
        ended = of_each(buffer.dones * (1 - buffer.timeouts)) > 0
        return Transitions(obs, action, of_each(buffer.rewards), next_obs, self._situations, ended)

    def actor_critic(self) -> ActorCritic:
        """Returns what was learnt."""
        sac, scale, n = self.sac, self._envs, len(self._situations)
        with self.chance():
            sizes = self._obs_dim, self.action_space.shape[0], n
            rank = self._settings.interaction_rank
            made = ActorCritic(*sizes, self._settings.hidden, interaction_rank=rank)
        actor = sac.actor.features_extractor, sac.actor.latent_pi, sac.actor.mu
        learnt = [weights for part in (*actor, sac.critic) for weights in part.parameters()]
        ours = made.actor_features, made.actor, made.critic_features, made.critics
        obs_rms: Any = scale.obs_rms
        with torch.no_grad():
            for mine, theirs in zip((weights for part in ours for weights in part.parameters()), learnt, strict=True):
                mine.copy_(theirs)
            made.mean.copy_(torch.as_tensor(obs_rms.mean))
            # What never varied was 0 for the networks, and must not be blown up where it does.
            varies = obs_rms.var > (1e-6 * obs_rms.mean) ** 2
            made.std.copy_(torch.as_tensor(np.where(varies, np.sqrt(obs_rms.var + scale.epsilon), 1.0)))
            made.value_scale.fill_(float(np.sqrt(scale.ret_rms.var + scale.epsilon)))
            made.discount.fill_(self._settings.discount)
        return made.requires_grad_(False)

    def close(self) -> None:
        """Closes the environments that were made for it."""
        for env in self._close:
            env.close()


class _Told(gym.Wrapper[Any, Any, Any, Any]):
    """Tells the situation as a one-hot vector behind the observation, and lets nothing in that is no number."""

    def __init__(self, env: gym.Env[Any, Any], situation: int, situations: int) -> None:
        super().__init__(env)
        self._watch = Watch(env)
        self._told = np.eye(situations, dtype=np.float32)[situation]
        size = env.observation_space.shape[0] + situations  # type: ignore[index]
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See :meth:`gymnasium.Env.reset`."""
        obs, info = gate.reset(self.env, seed=seed, options=options)
        return self._tell(obs), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See :meth:`gymnasium.Env.step`."""
        resets = self._watch.resets
        step = gate.step(self.env, action)
        gate.check_not_reset(self.env, self._watch.resets - resets)
        return self._tell(step.obs), step.reward, step.terminated, step.truncated, step.info

    def _tell(self, obs: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
        return np.concatenate([obs.astype(np.float32), self._told])


class _Features(BaseFeaturesExtractor):
    """Lets the library's networks see products of the observation and the situation."""

    def __init__(self, observation_space: spaces.Box, **sizes: int) -> None:
        features = Features(**sizes)
        super().__init__(observation_space, features.size)
        self.features = features

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """See :meth:`torch.nn.Module.forward`."""
        seen: torch.Tensor = self.features(observations)
        return seen


class _PartlyUntold(ReplayBuffer):
    """Hides the situation in a part of each batch."""

    def __init__(self, *args: Any, untold: float, n_situations: int, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._untold, self._n = untold, n_situations

    def _get_samples(self, batch_inds: npt.NDArray[Any], env: VecNormalize | None = None) -> ReplayBufferSamples:
        batch = super()._get_samples(batch_inds, env)
        hidden = torch.as_tensor(np.random.random(len(batch_inds)) < self._untold, device=self.device)
        for obs in (batch.observations, batch.next_observations):
            obs[hidden, -self._n :] = 0.0
        return batch


@contextmanager
def _float32() -> Iterator[None]:
    """Lets Stable-Baselines3 make its networks of the numbers that its buffers hold, whatever else is the default."""
    outside = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(outside)
