from __future__ import annotations

import io
import json
import zipfile
from typing import Any

import pytest
import torch

from famle_agent.utils.archive import pack, unpack

META = {"name": "a", "numbers": [1, 2.5, None], "odd": float("inf")}
TENSORS = {"a/b": torch.arange(6.0).reshape(2, 3).T, "c": torch.tensor(3, dtype=torch.uint8), "d": torch.zeros(0, 4)}


def zipped(compression: int = zipfile.ZIP_DEFLATED, **entries: bytes) -> io.BytesIO:
    """A zip with the entries of a packed one, some of them replaced."""
    with zipfile.ZipFile(io.BytesIO(pack(META, TENSORS, "meta"))) as archive:
        content = {name: archive.read(name) for name in archive.namelist()} | entries
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, text in content.items():
            archive.writestr(name, text)
    return buffer


def test_what_is_packed_is_unpacked() -> None:
    meta, tensors = unpack(io.BytesIO(pack(META, TENSORS, "meta")), "meta")
    assert meta == META
    assert tensors.keys() == TENSORS.keys()
    for name, value in TENSORS.items():
        assert torch.equal(tensors[name], value)
        assert tensors[name].dtype == value.dtype


def test_file_may_stand_anywhere() -> None:
    buffer = io.BytesIO()
    buffer.write(pack(META, TENSORS, "meta"))
    assert unpack(buffer, "meta")[0] == META


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (zipped(more=bytes(2**28)), "would unpack to"),
        (zipped(meta=json.dumps("x" * 2**24).encode()), "longer than"),
        (zipped(meta=b"[" * 100_000), "recursion"),
        (zipped(compression=zipfile.ZIP_BZIP2), "otherwise than by deflation"),
        (io.BytesIO(pack(META, TENSORS, "other")), "meta"),
        (io.BytesIO(b"hello"), "not a zip"),
        (io.BytesIO(), "not a zip"),
        (zipped(**{"tensors.safetensors": b"\xff" * 100}), "."),
    ],
    ids=["bomb", "long JSON", "deep JSON", "bzip2", "another name", "text", "nothing", "no tensors"],
)
def test_what_nobody_packed_is_refused(source: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        unpack(source, "meta")


def test_large_arrays_of_numbers_are_no_bomb() -> None:
    tensors = {"noise": torch.randn(2**16), "zeros": torch.zeros(2**20)}
    assert unpack(io.BytesIO(pack({}, tensors, "meta")), "meta")[1]["zeros"].shape == (2**20,)
