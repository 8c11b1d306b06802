"""The scalars that an agent logs while it lives on robots, by the names that Stable-Baselines3 gives them."""

from __future__ import annotations

import sys
import time
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from stable_baselines3.common.logger import HumanOutputFormat, KVWriter, Logger
from stable_baselines3.common.utils import safe_mean

__all__ = ["close_when_let_go", "console_for_bars", "log_episodes", "log_time"]


def close_when_let_go(logger: Logger) -> Logger:
    """Closes what a logger writes to as soon as nobody has the logger: TensorBoard's writer has a thread.

    Args:
        logger: A logger that was made for an agent.

    Returns:
        The logger.
    """
    weakref.finalize(logger, _close, logger.output_formats).atexit = False
    return logger


def _close(formats: Sequence[KVWriter]) -> None:
    for output in formats:
        with suppress(FileNotFoundError):  # its folder was removed, and what was in it with that
            output.close()


def log_time(logger: Logger, total: int, since_start: int, episodes: int, start: float) -> None:
    """Records how far and how fast robots have gone.

    Args:
        logger: The agent's logger.
        total: Steps of all robots.
        since_start: Those since ``start``.
        episodes: Episodes that have ended.
        start: When learning began, in ns; 0 where it never did.
    """
    logger.record("time/episodes", episodes, exclude="tensorboard")
    logger.record("time/total_timesteps", total, exclude="tensorboard")
    if start:
        seconds = max((time.time_ns() - start) / 1e9, sys.float_info.epsilon)
        logger.record("time/fps", int(since_start / seconds))
        logger.record("time/time_elapsed", int(seconds), exclude="tensorboard")


def log_episodes(logger: Logger, episodes: Iterable[Mapping[str, Any]], successes: Iterable[bool]) -> None:
    """Records the mean of the last episodes.

    Args:
        logger: The agent's logger.
        episodes: Return ``"r"`` and length ``"l"`` of each, as a ``Monitor`` reports them; the last one is the newest.
        successes: Whether each reached its goal, where the environment says so (``info["is_success"]``).
    """
    if episodes := list(episodes):
        logger.record("rollout/ep_rew_mean", safe_mean([info["r"] for info in episodes]))
        logger.record("rollout/ep_len_mean", safe_mean([info["l"] for info in episodes]))
        logger.record("rollout/ep_rew_last", episodes[-1]["r"])
    if successes := list(successes):
        logger.record("rollout/success_rate", safe_mean(successes))


@contextmanager
def console_for_bars(logger: Logger, bars: bool) -> Iterator[None]:
    """Keeps a logger's tables off the console while progress bars are drawn there; files get all of them.

    Args:
        logger: The agent's logger.
        bars: Whether there are any bars.
    """
    formats = logger.output_formats
    if bars:
        console = (sys.stdout, sys.stderr)
        logger.output_formats = [
            output for output in formats if not (isinstance(output, HumanOutputFormat) and output.file in console)
        ]
    try:
        yield
    finally:
        logger.output_formats = formats
