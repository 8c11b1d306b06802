"""A Gymnasium wrapper that adapts an agent while its robot runs."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.utils import RecordConstructorArgs

from famle_agent.agents.agent import ModelBasedAgent

__all__ = ["FAMLEWrapper"]

Array = npt.NDArray[Any]


class FAMLEWrapper(gym.Wrapper[Array, Array, Array, Array], RecordConstructorArgs):
    """Shows every transition of a robot to its agent, which adapts every K steps (Algorithm 2).

    Each step's ``info["famle"]`` says what the agent believes: ``situation``, the most likely training situation;
    ``probability``, how likely it is among them; ``posterior``, all of them by name; ``adaptations``, how often the
    agent has adapted; ``diverged``, how often its gradient steps left the finite numbers and were taken back. The
    memory outlasts a reset, as damage does; ``agent.forget()`` empties it.

    Args:
        env: The robot's environment.
        agent: A meta-learned agent; one agent serves one wrapper at a time.

    Raises:
        NotLearnedError: The agent has no model yet.
        ValueError: The environment's spaces are not the agent's.
    """

    def __init__(self, env: gym.Env[Array, Array], agent: ModelBasedAgent) -> None:
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, agent=agent)
        gym.Wrapper.__init__(self, env)
        agent.posterior()  # an agent without a model should say so here, not in the middle of a run
        if env.observation_space != agent.observation_space or env.action_space != agent.action_space:
            raise ValueError(
                f"The environment's spaces, {env.observation_space} and {env.action_space}, are not the agent's, "
                f"{agent.observation_space} and {agent.action_space}."
            )
        self.agent = agent
        self._obs: Array | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Resets the environment; the agent's plan is void, its memory stays."""
        obs, info = self.env.reset(seed=seed, options=options)
        self.agent.serve(self)
        self.agent.begin_episode()
        self._obs = np.array(obs)  # a copy: an environment may fill the same array again
        return obs, info | {"famle": self._belief()}

    def step(self, action: Array) -> tuple[Array, Any, bool, bool, dict[str, Any]]:
        """Steps the environment and shows the transition to the agent.

        Raises:
            RuntimeError: Another wrapper was reset with the same agent.
            ValueError: The environment returned an observation that is not finite.
        """
        if self._obs is None:
            raise gym.error.ResetNeeded("Call reset() before step().")
        self.agent.serve(self, takes_over=False)
        obs, reward, terminated, truncated, info = self.env.step(action)
        self.agent.observe(self._obs, action, obs)
        self._obs = np.array(obs)
        return obs, reward, terminated, truncated, info | {"famle": self._belief()}

    def _belief(self) -> dict[str, Any]:
        posterior, belief = self.agent.posterior(), self.agent.belief
        situation = max(posterior, key=lambda name: posterior[name])
        return {
            "situation": situation,
            "probability": posterior[situation],
            "posterior": posterior,
            "adaptations": belief.adaptations,
            "diverged": int(belief.diverged.sum()),
        }
