"""What TensorBoard shows beside the scalars of a run."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image
from stable_baselines3.common.logger import HParam, Logger, TensorBoardOutputFormat
from tensorboard.compat.proto.summary_pb2 import Summary
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import text as text_summary

__all__ = [
    "encode_gif",
    "log_embeddings",
    "log_gif",
    "log_settings",
    "log_values",
    "picture",
    "scalar",
    "shows",
    "text",
]

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


def shows(logger: Logger) -> bool:
    """Says whether a logger has a TensorBoard folder."""
    return bool(_formats(logger))


def log_settings(logger: Logger, settings: Mapping[str, Any], metrics: Sequence[str], step: int) -> None:
    """Shows the settings of a run as text, and in the table that compares runs (HParams).

    Args:
        logger: The agent's logger.
        settings: By name.
        metrics: Tags of the scalars to compare runs by.
        step: Where on the time axis.
    """
    plain = {name: value if isinstance(value, bool | int | float) else str(value) for name, value in settings.items()}
    table = "\n".join(["| setting | value |", "| --- | --- |", *(f"| {name} | {v} |" for name, v in plain.items())])
    values = {"settings": table, "hparams": HParam(plain, dict.fromkeys(metrics, 0.0))}
    for output in _formats(logger):
        output.write(values, dict.fromkeys(values, ()), step)


def log_values(logger: Logger, values: Iterable[Summary.Value], step: int) -> None:
    """Writes values to TensorBoard alone and at once, all in one event: many small ones cost ten times as much.

    Args:
        logger: The agent's logger.
        values: What :func:`scalar`, :func:`text` and :func:`picture` make.
        step: Where on the time axis.
    """
    event = Summary(value=values)
    for writer in _writers(logger):
        file = writer._get_file_writer()  # type: ignore[no-untyped-call]  # noqa: SLF001 - the only way to an event
        file.add_summary(event, step)
        file.flush()


def scalar(tag: str, value: float) -> Summary.Value:
    """A number, for :func:`log_values`."""
    return Summary.Value(tag=tag, simple_value=value)


def text(tag: str, words: str) -> Summary.Value:
    """Some words, for :func:`log_values`."""
    (value,) = text_summary(tag, words).value  # type: ignore[no-untyped-call]
    return value


def picture(tag: str, drawn: Image.Image) -> Summary.Value:
    """A picture, for :func:`log_values`."""
    buffer = io.BytesIO()
    drawn.save(buffer, "PNG", compress_level=1)
    return _image(tag, drawn.height, drawn.width, buffer.getvalue())


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
    log_values(logger, [_image(tag, height, width, encode_gif(frames, fps))], step)


def encode_gif(frames: Frames, fps: float) -> bytes:
    """Frames (height, width, 3) as an endless GIF."""
    pictures = [Image.fromarray(frame).quantize(64) for frame in frames]
    buffer = io.BytesIO()
    pictures[0].save(
        buffer, "GIF", save_all=True, append_images=pictures[1:], duration=round(1000 / fps), loop=0, optimize=True
    )
    return buffer.getvalue()


def _image(tag: str, height: int, width: int, encoded: bytes) -> Summary.Value:
    image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=encoded)
    return Summary.Value(tag=tag, image=image)


def _formats(logger: Logger) -> list[TensorBoardOutputFormat]:
    return [output for output in logger.output_formats if isinstance(output, TensorBoardOutputFormat)]


def _writers(logger: Logger) -> list[SummaryWriter]:
    return [output.writer for output in _formats(logger)]
