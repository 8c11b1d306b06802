from __future__ import annotations

import io
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from famle_agent.data.transitions import Transitions
from tests.clock import Clock, collected

Array = npt.NDArray[Any]
FLOAT32 = st.floats(width=32, allow_nan=False, allow_infinity=False)


def some_transitions(**changes: Any) -> Transitions:
    values = {
        "obs": np.zeros((2, 3, 4), np.float32),
        "action": np.zeros((2, 3, 1), np.float32),
        "reward": np.zeros((2, 3), np.float32),
        "next_obs": np.zeros((2, 3, 4), np.float32),
        "situations": ("intact", "broken"),
    }
    return Transitions(**{**values, **changes})


# --- storing ----------------------------------------------------------------------------------------------


@st.composite
def any_transitions(draw: st.DrawFn) -> Transitions:
    N, n, obs_dim, action_dim = (draw(st.integers(1, 3)) for _ in range(4))

    def array(*shape: int) -> Array:
        return draw(npst.arrays(np.float32, shape, elements=FLOAT32))

    names = draw(st.lists(st.text(st.characters(exclude_categories=("C",))), min_size=N, max_size=N))
    return Transitions(array(N, n, obs_dim), array(N, n, action_dim), array(N, n), array(N, n, obs_dim), tuple(names))


@given(any_transitions())
def test_what_is_saved_is_loaded(tmp_path_factory: pytest.TempPathFactory, data: Transitions) -> None:
    path = tmp_path_factory.mktemp("transitions") / "data.npz"
    data.save(path)
    loaded = Transitions.load(path)
    assert loaded.situations == data.situations
    for name in ("obs", "action", "reward", "next_obs"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(data, name))
        assert getattr(loaded, name).dtype == np.float32
    assert [file.name for file in path.parent.iterdir()] == ["data.npz"]


@pytest.mark.parametrize("part", [0.0, 0.1, 0.5, 0.9, 0.99])
def test_truncated_file_is_refused(tmp_path: Path, part: float) -> None:
    path = tmp_path / "data.npz"
    collected().save(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    with pytest.raises(ValueError, match="collect them again"):
        Transitions.load(path)


@given(st.data())
def test_damaged_file_is_refused_or_harmless(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    path, original = tmp_path_factory.mktemp("transitions") / "data.npz", collected()
    original.save(path)
    content = bytearray(path.read_bytes())
    content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    try:
        loaded = Transitions.load(path)
    except ValueError:
        return
    np.testing.assert_array_equal(loaded.obs, original.obs)
    np.testing.assert_array_equal(loaded.reward, original.reward)


def npz(**arrays: Any) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def npy(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


GOOD = {name: getattr(some_transitions(), name) for name in ("obs", "action", "reward", "next_obs", "situations")}


def claiming(shape: tuple[int, ...], dtype: str = "<f4", padding: bytes = b"") -> bytes:
    """A file whose observations say that they have a shape, and are padding."""
    header, buffer = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": dtype, "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("obs.npy", header.getvalue() + padding)
    return buffer.getvalue()


@pytest.mark.parametrize(
    "content",
    [
        claiming((10**13,)),
        claiming((10**9, 10)),
        claiming((10**30,)),
        claiming((-5,)),
        claiming((2**28,), "|u1", bytes(2**28)),
        claiming((1,), "|O"),
        npz(**GOOD | {"situations": np.array([0xFFFFFFFF, 0x61], "<u4").view("<U1")}),
        b"\x93NUMPY\x01\x00" + (5000).to_bytes(2, "little") + b"(" * 5000,
        b"hello",
        npz(weights=np.ones(3)),
        npy(np.ones(3)),
        npz(**{**GOOD, "obs": np.array([{"a": 1}], dtype=object)}),
        npz(**{**GOOD, "obs": np.array(["a", "b"])}),
        npz(**{**GOOD, "situations": np.array("intact")}),
        npz(**{**GOOD, "reward": np.zeros((2, 4), np.float32)}),
        npz(**{**GOOD, "action": np.full((2, 3, 1), np.nan, np.float32)}),
    ],
    ids=[
        *("36 TiB", "37 GiB", "too many", "negative", "bomb", "objects", "no letters", "deep header"),
        *("text", "other arrays", "one array", "pickle", "strings", "one situation", "shape", "NaN"),
    ],
)
def test_foreign_file_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "data.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"holds no transitions|expected|finite|must be an array of numbers"):
        Transitions.load(tmp_path / "data.npz")


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Transitions.load(tmp_path / "data.npz")


def test_failed_save_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "data.npz"
    collected().save(path)
    before = path.read_bytes()

    def fail(file: Any, **_: Any) -> None:
        file.write(b"half of it")
        raise OSError("No space left on device")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(OSError, match="No space left"):
        collected(seed=1).save(path)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["data.npz"]


# --- more of the same situations --------------------------------------------------------------------------


@given(st.integers(1, 4), st.integers(1, 4))
def test_more_transitions_follow_behind(n: int, more: int) -> None:
    one, other = collected(n=n), collected(n=more, seed=1)
    both = one.followed_by(other)
    assert both.situations == one.situations
    for name in ("obs", "action", "reward", "next_obs"):
        joined = getattr(both, name)
        assert joined.shape[:2] == (2, n + more)
        np.testing.assert_array_equal(joined[:, :n], getattr(one, name))
        np.testing.assert_array_equal(joined[:, n:], getattr(other, name))


@pytest.mark.parametrize("situations", [("broken", "intact"), ("intact",)])
def test_transitions_of_other_situations_do_not_follow(situations: tuple[str, ...]) -> None:
    n = len(situations)
    shapes = {"obs": (n, 3, 4), "action": (n, 3, 1), "reward": (n, 3), "next_obs": (n, 3, 4)}
    others = Transitions(**{k: np.zeros(v, np.float32) for k, v in shapes.items()}, situations=situations)
    with pytest.raises(ValueError, match=r"cannot follow those of \('intact', 'broken'\)"):
        some_transitions().followed_by(others)


# --- what is refused --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"obs": np.zeros((2, 3), np.float32)}, "obs has shape"),
        ({"obs": np.zeros((3, 3, 4), np.float32)}, "obs has shape"),
        ({"action": np.zeros((2, 2, 1), np.float32)}, "action has shape"),
        ({"reward": np.zeros((2, 3, 1), np.float32)}, "reward has shape"),
        ({"next_obs": np.zeros((2, 3, 5), np.float32)}, "must have the same shape"),
        ({"situations": ("intact",)}, "obs has shape"),
        ({"next_obs": np.full((2, 3, 4), np.nan, np.float32)}, "next_obs holds values that are not finite"),
        ({"reward": np.full((2, 3), np.inf, np.float32)}, "reward holds values that are not finite"),
    ],
)
def test_transitions_that_do_not_fit_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        some_transitions(**changes)


def test_robot_that_gives_no_numbers_is_refused() -> None:
    class Broken(Clock):
        def observe(self) -> Array:
            return super().observe() * (np.nan if self.clock == 3 else 1.0)

    with pytest.raises(ValueError, match="observation holds NaN"):
        collected(envs=[Broken()])


def test_transitions_are_frozen() -> None:
    data = some_transitions()
    with pytest.raises(AttributeError):
        data.obs = data.next_obs  # type: ignore[misc]
    assert replace(data, situations=("a", "b")).situations == ("a", "b")
