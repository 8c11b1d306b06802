"""JSON and tensors in one zip: files that hold no code, and unpack to no more than a file of their size may."""

from __future__ import annotations

import io
import json
import os
import zipfile
import zlib
from collections.abc import Mapping
from tokenize import TokenError
from typing import Any, BinaryIO

from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

__all__ = ["DAMAGE", "check_sizes", "pack", "part_of", "unpack"]

_TENSORS = "tensors.safetensors"
_SIZE = 2**28  # bytes to which a file of any size may unpack
_RATIO = 100  # bytes to which each of its bytes may; arrays of numbers shrink to a half, zeros to a thousandth
_JSON = 2**24  # bytes of JSON, which takes many times as much memory as text

DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, EOFError, LookupError, SafetensorError, SyntaxError, TokenError),
    *(ArithmeticError, AttributeError, MemoryError, RuntimeError, SystemError, TypeError, ValueError),
)
"""What readers of zips, JSON and arrays make of bytes that nobody has written like this."""


def part_of(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Takes the tensors whose names begin with a prefix, by the rest of their names."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def pack(meta: Any, tensors: dict[str, Tensor], name: str) -> bytes:
    """Packs what JSON can say, in an entry of that name, and what it cannot."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, json.dumps(meta, indent=1))
        contiguous = {key: value.detach().cpu().contiguous().clone() for key, value in tensors.items()}
        archive.writestr(_TENSORS, save_tensors(contiguous))
    return buffer.getvalue()


def unpack(source: BinaryIO, name: str) -> tuple[Any, dict[str, Tensor]]:
    """Returns what :func:`pack` has packed.

    Raises:
        ValueError: It is damaged, something else, or a few bytes that unpack to very many.
    """
    try:
        size = source.seek(0, os.SEEK_END)
        with zipfile.ZipFile(source) as archive:
            check_sizes(archive, size)
            if archive.getinfo(name).file_size > _JSON:
                raise ValueError(f"{name} is longer than {_JSON} bytes")
            return json.loads(archive.read(name)), load_tensors(archive.read(_TENSORS))
    except DAMAGE as error:
        raise ValueError(str(error) or type(error).__name__) from error


def check_sizes(archive: zipfile.ZipFile, size: int) -> None:
    """Refuses a zip that would fill the memory.

    Args:
        archive: The zip.
        size: Its length in bytes.

    Raises:
        ValueError: It unpacks to more than 256 MiB and to more than 100 times its size, or has entries that are packed
            otherwise than ours.
    """
    entries = archive.infolist()
    if any(entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for entry in entries):
        raise ValueError("it is packed otherwise than by deflation")
    if (unpacked := sum(entry.file_size for entry in entries)) > max(_SIZE, _RATIO * size):
        raise ValueError(f"its {size} bytes would unpack to {unpacked}")
