"""Situations that come and go."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy.typing as npt
from gymnasium.utils import RecordConstructorArgs

from famle_envs.situation import Situation

__all__ = ["RandomSituation"]

Array = npt.NDArray[Any]


class RandomSituation(gym.Wrapper[Array, Array, Array, Array], RecordConstructorArgs):
    """Draws a situation at each reset: domain randomisation.

    Args:
        env: A robot of this package, or one in a :class:`~famle_envs.faults.FaultWrapper`.
        situations: To draw from, with equal chance; None takes the robot's training situations.

    Raises:
        ValueError: There is nothing to draw from, or the environment takes no situation.

    Example:
        >>> import gymnasium as gym, famle_envs
        >>> from famle_envs.wrappers import RandomSituation
        >>> env = RandomSituation(gym.make("FamleReacher-v0"))
        >>> obs, info = env.reset(seed=0)
        >>> info["situation"] in [situation.name for situation in env.situations]
        True
        >>> env.close()
    """

    def __init__(self, env: gym.Env[Array, Array], situations: Sequence[Situation | str] | None = None) -> None:
        RecordConstructorArgs.__init__(self, situations=situations)
        gym.Wrapper.__init__(self, env)
        if not env.has_wrapper_attr("set_situation"):
            raise ValueError(f"{env} takes no situation; wrap it in famle_envs.faults.FaultWrapper.")
        self.situations = tuple(env.get_wrapper_attr("training_situations") if situations is None else situations)
        if not self.situations:
            raise ValueError("RandomSituation needs at least one situation to draw from.")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Resets the robot in a situation drawn with the environment's generator; ``options`` may name another."""
        if seed is not None:
            self.env.unwrapped.np_random, _ = gym.utils.seeding.np_random(seed)
        drawn = self.situations[int(self.env.unwrapped.np_random.integers(len(self.situations)))]
        return self.env.reset(seed=seed, options={"situation": drawn, **(options or {})})
