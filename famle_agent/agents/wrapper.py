"""A Gymnasium wrapper that adapts an agent while its robot runs."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import RecordConstructorArgs

from famle_agent.agents.agent import ModelBasedAgent
from famle_agent.agents.presets import make_env
from famle_agent.data import gate
from famle_agent.data.gate import check_action
from famle_agent.data.watch import Watch
from famle_agent.monitoring.adaptation_log import AdaptationLog

__all__ = ["FAMLEWrapper"]

Array = npt.NDArray[Any]


class _SpecWithAgent(EnvSpec):
    """What an environment is made of, an agent included."""

    def to_json(self) -> str:
        """Refuses.

        Raises:
            TypeError: Always, since the weights of an agent are no JSON.
        """
        raise TypeError(
            "The spec of a FAMLEWrapper holds its agent, which is no JSON: store env.env.spec.to_json() and "
            "agent.save(path), and make it of both, FAMLEWrapper(gym.make(spec), FAMLE.load(path))."
        )


class FAMLEWrapper(gym.Wrapper[Array, Array, Array, Array], RecordConstructorArgs):
    """Shows every transition of a robot to its agent, which adapts every K steps (Algorithm 2).

    Each step's ``info["famle"]`` says what the agent believes: ``situation``, the most likely training situation;
    ``probability``, how likely it is among them; ``posterior``, all of them by name; ``adaptations``, how often the
    agent has adapted; ``diverged``, how often its gradient steps left the finite numbers and were taken back;
    ``recognised``, whether the robot is as it was once before it changed; and what was missing or late, see
    :meth:`~famle_agent.agents.agent.ModelBasedAgent.health`. The memory outlasts a reset, as
    damage does; ``agent.forget()`` empties it.

    An observation that cannot be a measurement, such as NaN, is passed on as it is. Give it to ``agent.predict``, which
    plans from where its model says that the robot is; see :class:`~famle_agent.adaptation.perception.Safety`.

    Args:
        env: The robot's environment.
        agent: A meta-learned agent; one agent serves one wrapper at a time.
        log: Where to show in TensorBoard what the agent goes through; closing the wrapper ends it.

    Raises:
        NotLearnedError: The agent has no model yet.
        ValueError: The environment's spaces or its task are not the agent's.
    """

    def __init__(self, env: gym.Env[Array, Array], agent: ModelBasedAgent, log: AdaptationLog | None = None) -> None:
        RecordConstructorArgs.__init__(self, _disable_deepcopy=True, agent=agent, log=log)
        gym.Wrapper.__init__(self, make_env(env))  # type: ignore[arg-type]
        agent.posterior()  # an agent without a model should say so here, not in the middle of a run
        if env.observation_space != agent.observation_space or env.action_space != agent.action_space:
            raise ValueError(
                f"The environment's spaces, {env.observation_space} and {env.action_space}, are not the agent's, "
                f"{agent.observation_space} and {agent.action_space}."
            )
        agent.check_task(env)
        self.agent, self.log, self._watch = agent, log, Watch(env)
        self._obs: Array | None = None  # None where nobody knows where the robot is; NaN where no sensor tells
        self._begun = False
        self._calls = self._resets = 0

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]
        """What ``gymnasium.make`` makes the same of, with the same agent; no JSON holds that."""
        known = super().spec
        if known is None or isinstance(known, _SpecWithAgent):
            return known
        self._cached_spec = _SpecWithAgent(
            **{item.name: getattr(known, item.name) for item in fields(known) if item.init}
        )
        return self._cached_spec

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Resets the environment; the agent's plan is void, its memory stays."""
        self._obs = None
        obs, info = self.env.reset(seed=seed, options=options)
        self.agent.serve(self)
        self.agent.begin_episode()
        self._begun = True
        self.agent.locate(obs)
        self._know(obs)
        return obs, info | {"famle": self._belief()}

    def step(self, action: Array) -> tuple[Array, Any, bool, bool, dict[str, Any]]:
        """Steps the environment and shows the transition to the agent, if it was one step and nothing else.

        What lies across a reset, a step that failed, or a time in which somebody else moved the robot is not shown.

        Raises:
            RuntimeError: Another wrapper was reset with the same agent.
            ValueError: The action has a wrong shape or is not finite, or something that the environment returned has a
                wrong type or shape.
        """
        if not self._begun:
            raise gym.error.ResetNeeded("Call reset() before step().")
        self.agent.serve(self, takes_over=False)
        check_action(action, self.agent.action_space)  # before anything moves
        commanded = np.array(action)
        if self._watch.resets != self._resets:  # by somebody else
            self.agent.begin_episode()
        resets, before = self._watch.resets, self._obs if self._watch.calls == self._calls else None
        self._obs = None
        try:
            step = gate.robot_step(self.env, commanded)
        except BaseException:
            self.agent.locate(None, dropped=True)
            raise
        was_reset = self._watch.resets != resets
        reached = step.final_obs if was_reset else step.obs
        dropped = before is None or (was_reset and reached is None)
        if not dropped:
            self.agent.observe(before, commanded, reached)
        if was_reset:
            self.agent.begin_episode()
        if was_reset or dropped:
            self.agent.locate(step.obs, dropped)
        self._know(step.obs)
        if self.log is not None:
            ended = step.terminated or step.truncated
            self.log.step(None if dropped else self.agent.newest, [step.reward], [ended])
        return step.obs, step.reward, step.terminated, step.truncated, step.info | {"famle": self._belief()}

    def close(self) -> None:
        """Closes the environment, after the last entry in TensorBoard."""
        if self.log is not None:
            self.log.close()
        super().close()

    def _know(self, obs: Array | None) -> None:
        """Notes where the robot is, and that nobody has moved it since."""
        self._obs = gate.reading(obs, self.agent.observation_space)
        self._calls, self._resets = self._watch.calls, self._watch.resets

    def _belief(self) -> dict[str, Any]:
        posterior, belief = self.agent.posterior(), self.agent.belief
        situation = max(posterior, key=lambda name: posterior[name])
        return {
            "situation": situation,
            "probability": posterior[situation],
            "posterior": posterior,
            "adaptations": belief.adaptations,
            "diverged": int(belief.diverged.sum()),
            "recognised": bool(belief.recognised[0]),
            **self.agent.health(),
        }
