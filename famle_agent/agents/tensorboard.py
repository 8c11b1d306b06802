"""What TensorBoard shows beside the scalars of a run."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from tensorboard.compat.proto.summary_pb2 import Summary
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from famle_agent.adaptation.belief import Belief

__all__ = ["encode_gif", "log_adaptations", "log_embeddings", "log_gif", "log_health", "log_posterior"]

Frames = Sequence[npt.NDArray[np.uint8]]


def log_embeddings(logger: Logger, embeddings: Tensor, situations: Sequence[str], step: int) -> None:
    """Shows the map of the situations in the projector.

    Args:
        logger: The agent's logger; without a TensorBoard folder nothing happens.
        embeddings: H, (N, embedding_dim).
        situations: N names.
        step: Where on the time axis.
    """
    for writer in _writers(logger):
        writer.add_embedding(embeddings.detach().cpu(), metadata=list(situations), tag="situations", global_step=step)


def log_posterior(logger: Logger, posterior: dict[str, float]) -> None:
    """Records P(situation | memory) of every situation, for TensorBoard alone since there are many."""
    for name, probability in posterior.items():
        logger.record(f"posterior/{name}", probability, exclude=("stdout", "log", "json", "csv"))


def log_adaptations(logger: Logger, belief: Belief) -> None:
    """Records how often robots have adapted, and how often that diverged, all robots together."""
    logger.record("adapt/adaptations", belief.adaptations)
    logger.record("adapt/diverged", int(belief.diverged.sum()))


def log_health(logger: Logger, sensors: Mapping[str, Tensor], overruns: int, cut_short: int) -> None:
    """Records what was missing or late, all robots together.

    Args:
        logger: The agent's logger.
        sensors: What was counted of the sensors of each robot, (B,), by name.
        overruns: How often planning took too long.
        cut_short: How often the planner left out iterations.
    """
    for name, counts in sensors.items():
        logger.record(f"health/{name}", int(counts.sum()))
    logger.record("health/overruns", overruns)
    logger.record("health/cut_short", cut_short)


def log_gif(logger: Logger, tag: str, frames: Frames, fps: float, step: int) -> None:
    """Shows a moving picture among the images.

    Args:
        logger: The agent's logger.
        tag: Its name.
        frames: Pictures (height, width, 3).
        fps: Pictures per second.
        step: Where on the time axis.
    """
    height, width = frames[0].shape[:2]
    image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=encode_gif(frames, fps))
    for writer in _writers(logger):
        file = writer._get_file_writer()  # type: ignore[no-untyped-call]  # noqa: SLF001 - the only way to a GIF
        file.add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), step)


def encode_gif(frames: Frames, fps: float) -> bytes:
    """Frames (height, width, 3) as an endless GIF."""
    pictures = [Image.fromarray(frame).quantize(64) for frame in frames]
    buffer = io.BytesIO()
    pictures[0].save(
        buffer, "GIF", save_all=True, append_images=pictures[1:], duration=round(1000 / fps), loop=0, optimize=True
    )
    return buffer.getvalue()


def _writers(logger: Logger) -> list[SummaryWriter]:
    formats: list[Any] = logger.output_formats
    return [output.writer for output in formats if isinstance(output, TensorBoardOutputFormat)]
