from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks.results import load
from benchmarks.sine import N_POINTS, Args, Sines, first, main

TINY: dict[str, Any] = {
    "replicates": 2,
    "train_sines": 8,
    "validation_sines": 4,
    "test_sines": 5,
    "famle_iterations": 3,
    "maml_iterations": 3,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sine")
    main(Args(**TINY, out=out))
    return out


def test_stores_picture_and_statistics(folder: Path) -> None:
    table = load(folder / "sine.csv")
    assert {"title", "args", "rates", "wall_seconds", "command", "commit", "versions"} <= set(table)
    assert set(table["method"]) == {"FAMLE", "MAML", "selection only"}
    for row in table.to_dict("records"):
        assert row["points"] in N_POINTS
        assert row["seeds"] == [0, 1]
        assert row["quartiles"][0] <= row["median"] <= row["quartiles"][1]
        assert row["iqm_interval"][0] <= row["iqm"] <= row["iqm_interval"][1]
        assert len(row["iqm_per_replicate"]) == len(row["meta_learning_seconds"]) == 2
    assert (folder / "sine.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "sine.png").stat().st_size < 150_000


def test_same_seeds_same_numbers(folder: Path, tmp_path: Path) -> None:
    main(Args(**TINY, out=tmp_path))
    one, other = (load(path / "sine.csv") for path in (folder, tmp_path))
    figures = ["method", "points", "median", "quartiles", "iqm_per_replicate", "famle_better_than_maml", "rates"]
    assert one[figures].equals(other[figures])


def test_points_lie_on_their_sine() -> None:
    generator = torch.Generator().manual_seed(0)
    sines = Sines.sample(50, generator)
    assert sines.amplitude.min() >= 0.1
    assert sines.amplitude.max() <= 5.0
    assert sines.phase.min() >= 0.0
    assert sines.phase.max() <= math.pi
    points = sines.observe(max(N_POINTS), generator)
    x = points.obs[..., 0]
    assert x.abs().max() <= 5.0
    torch.testing.assert_close(points.next_obs[..., 0] - x, sines.amplitude * torch.sin(x + sines.phase))


def test_more_points_contain_the_fewer() -> None:
    points = Sines.sample(2, torch.Generator().manual_seed(0)).observe(5, torch.Generator().manual_seed(1))
    assert torch.equal(first(points, 4).obs[:, :3], first(points, 3).obs)
    assert first(points, 3).weight.shape == (2, 3)


def test_impossible_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="test_sines must be at least 1"):
        Args(test_sines=0)
    with pytest.raises(ValueError, match="at least two test sines"):
        Args(replicates=1, test_sines=1)
