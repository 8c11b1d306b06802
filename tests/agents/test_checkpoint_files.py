from __future__ import annotations

import io
import json
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import PPO

import famle_agent.utils.archive
from famle_agent import AMPCMAML, FAMLE
from famle_agent.agents.checkpoint import read_checkpoint, write_checkpoint


def rewrite(source: Path, target: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """A copy of a checkpoint with other metadata."""
    with zipfile.ZipFile(source) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(entries["agent.json"])
    change(meta)
    with zipfile.ZipFile(target, "w") as archive:
        for name, content in {**entries, "agent.json": json.dumps(meta).encode()}.items():
            archive.writestr(name, content)
    return target


# --- files --------------------------------------------------------------------------------------------------


def test_file_holds_json_and_tensors_and_no_pickle(agent_file: Path) -> None:
    with zipfile.ZipFile(agent_file) as archive:
        assert sorted(archive.namelist()) == ["agent.json", "tensors.safetensors"]
        assert json.loads(archive.read("agent.json"))["format"] == "famle-agent"
        assert not any(b"\x80\x04" in archive.read(name)[:2] for name in archive.namelist())


@pytest.mark.parametrize("name", ["agent", "agent.zip", "deep/er/agent", "v1.0"])
def test_suffix_is_added_and_folders_are_made(quick_agent: FAMLE, tmp_path: Path, name: str) -> None:
    quick_agent.save(tmp_path / name)
    quick_agent.save(str(tmp_path / name))
    loaded = FAMLE.load(tmp_path / name, device="cpu")
    assert loaded.situations == quick_agent.situations
    loaded.get_env().close()
    files = [path.name for path in tmp_path.rglob("*") if path.is_file()]
    assert files == ["agent.zip" if "agent" in name else name]


@pytest.mark.parametrize("failing", ["save_tensors", "write_bytes", "replace"])
def test_failed_save_leaves_the_old_file(
    quick_agent: FAMLE, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    path = tmp_path / "agent.zip"
    quick_agent.save(path)
    before = path.read_bytes()

    def fail(*args: Any) -> None:
        if failing == "write_bytes":
            with open(args[0], "wb") as file:
                file.write(args[1][: len(args[1]) // 2])
        raise OSError("No space left on device")

    monkeypatch.setattr(famle_agent.utils.archive if failing == "save_tensors" else Path, failing, fail)
    quick_agent.learn(3)
    with pytest.raises(OSError, match="No space left"):
        quick_agent.save(path)
    assert [file.name for file in tmp_path.iterdir()] == ["agent.zip"]
    assert path.read_bytes() == before


@pytest.mark.parametrize("part", [0.0, 0.01, 0.3, 0.6, 0.9, 0.99, 0.9999])
def test_truncated_file_is_refused(agent_file: Path, tmp_path: Path, part: float) -> None:
    content = agent_file.read_bytes()
    (tmp_path / "cut.zip").write_bytes(content[: int(part * len(content))])
    with pytest.raises(ValueError, match="no FAMLE checkpoint, or it is damaged"):
        FAMLE.load(tmp_path / "cut.zip")


@given(st.data())
def test_damaged_file_is_refused_or_harmless(agent_file: Path, data: st.DataObject) -> None:
    content = bytearray(agent_file.read_bytes())
    place = data.draw(st.integers(0, len(content) - 1))
    content[place] ^= data.draw(st.integers(1, 255))
    intact = read_checkpoint(agent_file)
    try:
        meta, tensors = read_checkpoint(io.BytesIO(content))
    except ValueError as error:
        assert "damaged" in str(error)  # noqa: PT017
        return
    assert meta == intact[0]
    assert all(torch.equal(value, tensors[name]) for name, value in intact[1].items())


def foreign(kind: str, path: Path) -> None:
    if kind == "text":
        path.write_text("not a checkpoint")
    elif kind == "empty zip":
        zipfile.ZipFile(path, "w").close()
    elif kind == "other zip":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("agent.json", '{"name": "Bond"}')
            archive.writestr("tensors.safetensors", b"\0" * 8)
    elif kind == "other agent.json":
        write_checkpoint(path, {"format": "something else"}, {})
    elif kind == "a list":
        write_checkpoint(path, {}, {})
        with zipfile.ZipFile(path) as archive:
            tensors = archive.read("tensors.safetensors")
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("agent.json", "[]")
            archive.writestr("tensors.safetensors", tensors)
    elif kind == "nothing but the format":
        write_checkpoint(path, {}, {})
    else:
        PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8, device="cpu").save(path)


@pytest.mark.parametrize(
    "kind", ["text", "empty zip", "other zip", "other agent.json", "a list", "nothing but the format", "PPO"]
)
def test_foreign_file_is_refused(tmp_path: Path, kind: str) -> None:
    foreign(kind, tmp_path / "file.zip")
    with pytest.raises(ValueError, match="no FAMLE checkpoint"):
        FAMLE.load(tmp_path / "file.zip")


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nothing"):
        FAMLE.load(tmp_path / "nothing")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 99}, "checkpoint version 99, this package reads 2; upgrade famle"),
        ({"version": 1}, "checkpoint version 1, this package reads 2"),
        ({"version": None}, "checkpoint version None"),
        ({"class": "SomethingElse"}, r"SomethingElse\.load\(\)"),
        ({"situations": ["intact"]}, "do not fit"),
    ],
)
def test_file_of_another_kind_is_refused(
    agent_file: Path, tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    path = rewrite(agent_file, tmp_path / "other.zip", lambda meta: meta.update(change))
    with pytest.raises(ValueError, match=message):
        FAMLE.load(path, device="cpu")


@pytest.mark.parametrize(
    "change",
    [
        {"env": {"id": "FamleReacher-v0", "kwargs": {"wheels": 4}}},
        {"env": "FamleReacher-v0"},
        {"hyperparameters": {"wheels": 4}},
        {"mode": "best"},
        {"live": {"steps": 1, "adaptations": 1}},
        {"action_space": {}},
        {"situations": 3},
        {"seed": "7"},
        {"num_timesteps": float("inf")},
        {"tensorboard_log": 5},
        {"class": []},
        {"angle_dims": ["x"]},
        {"env": {"id": "FamleReacher-v0", "kwargs": {"situation": {"motor_gain": [1] * 100_000}}}},
        {"env": {"id": "FamleReacher-v0", "kwargs": {"render_mode": "hologram"}}},
        *({"observation_space": {"low": [0], "high": [1], "shape": [1], "dtype": d}} for d in ("O", "V100000000", "?")),
    ],
    ids="-".join,
)
def test_file_that_makes_no_sense_is_refused(agent_file: Path, tmp_path: Path, change: dict[str, Any]) -> None:
    path = rewrite(agent_file, tmp_path / "odd.zip", lambda meta: meta.update(change))
    with pytest.raises(ValueError, match=r"\w"):
        FAMLE.load(path, device="cpu")


@pytest.mark.parametrize(
    "settings",
    [{"hidden": [10**5, 10**5]}, {"hidden": [10**19]}, {"members": 10**8}, {"embedding_dim": 10**10}],
    ids="-".join,
)
def test_file_cannot_ask_for_a_network_that_it_does_not_hold(
    agent_file: Path, tmp_path: Path, settings: dict[str, Any]
) -> None:
    path = rewrite(agent_file, tmp_path / "odd.zip", lambda meta: meta["hyperparameters"].update(settings))
    with pytest.raises(ValueError, match="do not fit"):  # which no memory would be enough to find out by making it
        FAMLE.load(path, device="cpu")


@pytest.mark.parametrize("name", ["h", "plan", "memory.obs", "theta.weight_0", "candidate"])
def test_belief_of_another_shape_is_refused(quick_agent: FAMLE, tmp_path: Path, name: str) -> None:
    quick_agent.learn(3)
    quick_agent.save(tmp_path / "agent.zip")
    meta, tensors = read_checkpoint(tmp_path / "agent.zip")
    tensors[f"live/{name}"] = tensors[f"live/{name}"].repeat_interleave(2, dim=-1)
    write_checkpoint(tmp_path / "odd.zip", {k: v for k, v in meta.items() if k not in ("format", "version")}, tensors)
    with pytest.raises(ValueError, match="do not fit"):
        FAMLE.load(tmp_path / "odd.zip", device="cpu")


@pytest.mark.parametrize("env_id", ["NoSuch-v0", "os:system", "famle_poison:Env-v0"])
def test_file_cannot_make_us_import_anything(
    agent_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, env_id: str
) -> None:
    (tmp_path / "famle_poison.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    path = rewrite(agent_file, tmp_path / "x.zip", lambda meta: meta.update(env={"id": env_id, "kwargs": {}}))
    agent = FAMLE.load(path, device="cpu")
    assert "famle_poison" not in sys.modules
    assert agent.get_env() is None
    assert agent.observation_space.shape == (12,)
    for call in (lambda: agent.learn(1), agent.meta_learn):
        with pytest.raises(ValueError, match=r"set_env\(env\)"):
            call()
    with pytest.raises(ValueError, match=r"env=\.\.\."):
        agent.predict(np.zeros(12, np.float32))
    agent.set_env(gym.make("FamleReacher-v0"))
    assert agent.predict(np.zeros(12, np.float32))[0].shape == (5,)
    agent.get_env().close()


def test_file_that_does_not_fit_changes_nothing(quick_agent: FAMLE, agent_file: Path, tmp_path: Path) -> None:
    odd = rewrite(agent_file, tmp_path / "odd.zip", lambda meta: meta.update(situations=["intact", "lost"]))
    model, situations, obs = quick_agent.dynamics, quick_agent.situations, np.zeros(12, np.float32)
    action = quick_agent.predict(obs, deterministic=True)[0]
    with pytest.raises(ValueError, match="do not fit"):
        quick_agent.restore(odd)
    assert quick_agent.dynamics is model
    assert quick_agent.situations == situations
    np.testing.assert_array_equal(quick_agent.predict(obs, deterministic=True)[0], action)


# --- files of earlier versions ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "name", "adaptations", "situation", "action"),
    [
        (FAMLE, "famle", 12, "joint 2 reversed", [-0.5158, -0.2944, -0.0092, -0.4479, 0.2613]),
        (AMPCMAML, "ampc-maml", 5, "every situation", [-0.9359, -0.8440, -0.2028, 0.5484, 0.5406]),
    ],
)
def test_file_of_an_earlier_version_goes_on_as_it_did_there(
    kind: type[FAMLE | AMPCMAML], name: str, adaptations: int, situation: str, action: list[float]
) -> None:
    """Both have lived 25 steps on a robot; the actions were measured with the version that wrote the files."""
    agent = kind.load(Path(__file__).parent / "files" / f"{name}.zip", device="cpu")
    assert agent.num_timesteps == 25
    assert agent.belief.adaptations == adaptations
    posterior = agent.posterior()
    assert max(posterior, key=lambda key: posterior[key]) == situation
    obs = np.linspace(-0.5, 0.5, 12, dtype=np.float32)
    np.testing.assert_allclose(agent.predict(obs, deterministic=True)[0], action, atol=1e-4)
    assert agent.learn(10, reset_num_timesteps=False).num_timesteps == 35
    agent.get_env().close()
