"""Lives that can go on after an interruption: agent, robots' random numbers and history of whole episodes.

What is stored belongs to the code that it lived with: another commit begins anew.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.base_class import BaseAlgorithm

from benchmarks.harness import commit, write_whole
from famle_agent import ModelBasedAgent

__all__ = ["History", "Repeatable", "read_life", "write_life"]

_AGENT, _HISTORY, _COMMIT = "agent.zip", "history.json", "commit"


class Repeatable(gym.Wrapper[Any, Any, Any, Any]):
    """Notes with which random numbers an episode began, so that it can begin once more.

    Attributes:
        began_with: The state of the environment's generator at the last reset that was not seeded.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.began_with: Mapping[str, Any] = {}
        self._begins_with: Mapping[str, Any] = {}

    def begin_with(self, state: Mapping[str, Any]) -> None:
        """Gives the next episode, however it is seeded, the random numbers of another one."""
        self._begins_with = state

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See :meth:`gymnasium.Env.reset`."""
        generator = self.unwrapped.np_random.bit_generator
        if self._begins_with:
            generator.state, self._begins_with, seed = dict(self._begins_with), {}, None
        self.began_with = generator.state
        return super().reset(seed=seed, options=options)


@dataclass(frozen=True)
class History:
    """What robots in step have gone through.

    Attributes:
        returns: Of the episodes of each robot.
        lengths: Of the same, in robot steps.
        seconds: Wall time.
        random: With which random numbers the next episode of each robot begins; empty before the first one.
    """

    returns: Sequence[Sequence[float]]
    lengths: Sequence[Sequence[int]]
    seconds: float = 0.0
    random: Sequence[Mapping[str, Any]] = ()

    @property
    def steps(self) -> int:
        """Robot steps of the robot that has fewest."""
        return min(sum(lengths) for lengths in self.lengths)


def write_life(path: Path, agent: BaseAlgorithm, history: History) -> None:
    """Writes a life, whole or not at all."""
    content, saved = io.BytesIO(), io.BytesIO()
    agent.save(saved)
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr(_COMMIT, commit())
        archive.writestr(_HISTORY, json.dumps(asdict(history)))
        archive.writestr(_AGENT, saved.getvalue())
    write_whole(path, content.getvalue())


def read_life(path: Path, agent: BaseAlgorithm) -> History | None:
    """Gives an agent what it had learnt, and says what it had gone through.

    One of ours goes on as if nothing had happened. One of Stable-Baselines3 has its networks and its optimizer, and
    goes on with other random numbers than it began with.

    Args:
        path: What :func:`write_life` wrote, or no file yet.
        agent: One that was made as the stored one was.

    Returns:
        None where there is no such life, or other code has lived it; the agent is as it was then.
    """
    if not path.exists():
        return None
    with zipfile.ZipFile(path) as archive:
        lived_with = archive.read(_COMMIT).decode()
        if lived_with != commit() or lived_with == "unknown" or lived_with.endswith("-dirty"):
            return None
        saved, history = io.BytesIO(archive.read(_AGENT)), History(**json.loads(archive.read(_HISTORY)))
    if isinstance(agent, ModelBasedAgent):
        agent.restore(saved)
    else:
        agent.set_parameters(saved, device=agent.device)  # type: ignore[arg-type]
        agent.set_random_seed((agent.seed or 0) + history.steps)
    return history
