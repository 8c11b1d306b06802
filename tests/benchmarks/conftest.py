"""The benchmarks' results are PyBullet's, so that they are tested where it is installed."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session", autouse=True)
def _pybullet() -> None:
    pytest.importorskip("pybullet")
