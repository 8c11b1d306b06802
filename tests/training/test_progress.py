"""Learners that are stopped at any iteration go on to the very same model."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from famle_agent.models.dynamics import Batch, Dynamics
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.training.maml import MAML
from famle_agent.training.multitask import JointTraining
from famle_agent.training.progress import Progress
from famle_agent.training.reptile import Reptile

N = 6
SGD = InnerLoop(steps=2, lr=0.05, embedding_lr=0.0)
Learn = Callable[[Dynamics, torch.Generator, Progress], Iterator[object]]


def situations() -> Batch:
    """A motor of four gains: y = gain * a + x / 2."""
    x = torch.rand(4, 60, 2, generator=torch.Generator().manual_seed(1)) * 2 - 1
    gain = torch.tensor([1.0, 0.0, -1.0, 0.5])[:, None, None]
    return Batch(x, gain * x[..., 1:] + 0.5 * x[..., :1], torch.ones(4, 60))


def joint(model: Dynamics, generator: torch.Generator, progress: Progress) -> Iterator[object]:
    return JointTraining(N, 0.01, 0.03, 16).steps(model, situations(), generator, progress)


def reptile(model: Dynamics, generator: torch.Generator, progress: Progress) -> Iterator[object]:
    return Reptile(N, 0.5, 0.5, 2, 8).steps(model, situations(), InnerLoop(2, 0.05, 0.2), generator, progress)


def maml(model: Dynamics, generator: torch.Generator, progress: Progress) -> Iterator[object]:
    return MAML(N, 0.03, 2, 8, 8).steps(model, situations(), SGD, generator, progress)


LEARNERS: dict[str, tuple[Learn, int]] = {"joint": (joint, 4), "reptile": (reptile, 4), "maml": (maml, 1)}
"""Each with the number of embeddings that it asks for."""


def learnt(name: str, progress: Progress, stop_after: int = N + 1) -> tuple[Dynamics, torch.Generator, int]:
    """The model, the generator that it was learnt with, and how many iterations that took."""
    learn, embeddings = LEARNERS[name]
    torch.manual_seed(0)
    model = Dynamics(1, 1, embeddings, embedding_dim=2, hidden=(8,), members=2)
    generator, done = torch.Generator().manual_seed(3), 0
    for _ in learn(model, generator, progress):
        if done + 1 == stop_after:
            break  # this iteration has not ended
        done += 1
    return model, generator, done


def assert_same(one: Dynamics, other: Dynamics) -> None:
    for name, value in one.state_dict().items():
        assert torch.equal(value, other.state_dict()[name]), name


@pytest.mark.parametrize("name", LEARNERS)
@pytest.mark.parametrize("stop_after", [1, 2, 4, N])
def test_stopped_learner_goes_on_to_the_same_model(name: str, stop_after: int, tmp_path: Path) -> None:
    whole, generator, _ = learnt(name, Progress())
    skipped: list[int] = []
    progress = Progress(tmp_path / "it.progress", skipped.append, every=0.0)
    stopped, _, before = learnt(name, progress, stop_after)
    assert before == stop_after - 1
    model, went_on, after = learnt(name, progress)
    assert before + after == N
    assert skipped == ([before] if before else [])
    assert_same(model, whole)
    assert torch.equal(went_on.get_state(), generator.get_state())
    assert torch.equal(stopped.theta["weight_0"], whole.theta["weight_0"]) == (stop_after == N)


@pytest.mark.parametrize("name", LEARNERS)
def test_finished_learner_does_nothing_again(name: str, tmp_path: Path) -> None:
    progress = Progress(tmp_path / "it.progress")
    whole, generator, _ = learnt(name, progress)
    again, went_on, done = learnt(name, progress)
    assert done == 0
    assert_same(again, whole)
    assert torch.equal(went_on.get_state(), generator.get_state())


def test_saves_now_and_then_and_in_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("famle_agent.training.progress.time.perf_counter", lambda: now[0])
    file, saved = tmp_path / "it.progress", list[int]()
    generator = torch.Generator()
    for iteration in Progress(file, every=10.0).iterations(8, generator):
        saved += [iteration] * file.exists()
        file.unlink(missing_ok=True)
        now[0] += 4.0
    assert saved == [3, 6]  # after 12 and 24 seconds
    assert list(Progress(file).iterations(8, generator)) == []
    assert [path.name for path in tmp_path.iterdir()] == ["it.progress"]


def test_without_a_file_nothing_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    progress = Progress(every=0.0)
    for _ in range(2):
        assert list(progress.iterations(3, torch.Generator())) == [0, 1, 2]
    assert list(tmp_path.iterdir()) == []


def test_failed_write_keeps_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    progress = Progress(tmp_path / "it.progress", every=0.0)
    whole, _, _ = learnt("joint", Progress())
    learnt("joint", progress, stop_after=3)
    before = (tmp_path / "it.progress").read_bytes()

    def fail(file: Path, content: bytes) -> None:
        with file.open("wb") as partial:
            partial.write(content[:100])
        raise OSError("No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", fail)
        with pytest.raises(OSError, match="No space left"):
            learnt("joint", progress)
    assert (tmp_path / "it.progress").read_bytes() == before
    assert_same(learnt("joint", progress)[0], whole)


@pytest.mark.parametrize("size", [0, 1, 100, -1])
def test_damaged_file_is_named(size: int, tmp_path: Path) -> None:
    file = tmp_path / "it.progress"
    learnt("joint", Progress(file))
    file.write_bytes(file.read_bytes()[:size])
    with pytest.raises(ValueError, match=r"it\.progress is damaged, or of another run .* Delete it"):
        learnt("joint", Progress(file))


def test_file_of_another_learner_is_refused(tmp_path: Path) -> None:
    learnt("reptile", Progress(tmp_path / "it.progress"))
    with pytest.raises(ValueError, match="of another run"):
        learnt("joint", Progress(tmp_path / "it.progress"))


class Planted:
    """Makes a file when it is unpickled."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.file,)


@pytest.mark.parametrize("write", [lambda value, file: file.write_bytes(pickle.dumps(value)), torch.save])
def test_code_in_a_file_does_not_run(write: Callable[[object, Path], object], tmp_path: Path) -> None:
    write(Planted(tmp_path / "ran"), tmp_path / "it.progress")
    with pytest.raises(ValueError, match="is damaged, or of another run"):
        learnt("joint", Progress(tmp_path / "it.progress"))
    assert not (tmp_path / "ran").exists()
