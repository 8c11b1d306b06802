"""Files that are either whole or not there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

__all__ = ["whole_file"]


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Gives another path to write to, which takes the place of the file once all is written and on the disk.

    An older file stays until then; where writing fails, it stays for good.
    """
    partial = path.with_name(f"{path.name}.{uuid4().hex}.partial")  # threads and machines may write at once
    try:
        yield partial
        with partial.open("rb+") as written:
            os.fsync(written.fileno())  # or a loss of power could leave the new name with nothing in it
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
