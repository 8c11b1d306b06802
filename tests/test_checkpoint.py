from __future__ import annotations

import io
import json
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from stable_baselines3 import PPO

import famle_agent.checkpoint
from famle_agent import FAMLE, FAMLEWrapper, NotLearnedError, Transitions
from famle_agent.checkpoint import _box_from_json, _box_to_json, read_checkpoint, write_checkpoint
from famle_envs.reacher import ReacherEnv

Load = Callable[..., FAMLE]
MakeEnv = Callable[..., gym.Env[Any, Any]]
FLOAT32 = st.floats(width=32, allow_nan=False)


@pytest.fixture
def reload() -> Iterator[Callable[..., FAMLE]]:
    """Saves an agent to memory and loads it."""
    agents: list[FAMLE] = []

    def through_bytes(agent: FAMLE, **kwargs: Any) -> FAMLE:
        buffer = io.BytesIO()
        agent.save(buffer)
        buffer.seek(0)
        agents.append(FAMLE.load(buffer, device="cpu", **kwargs))
        return agents[-1]

    yield through_bytes
    for agent in agents:
        if agent.get_env() is not None:
            agent.get_env().close()


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


def actions(agent: FAMLE, n: int = 3, obs: Any = None) -> list[np.ndarray[Any, Any]]:
    if obs is None:
        obs = np.linspace(-0.5, 0.5, agent.observation_space.shape[0], dtype=np.float32)
    return [agent.predict(obs)[0] for _ in range(n)]


# --- what a loaded agent is -------------------------------------------------------------------------------


def test_fresh_agent_acts_as_the_saved_one(quick_agent: FAMLE, reload: Load) -> None:
    loaded = reload(quick_agent)
    assert loaded.hyperparameters == quick_agent.hyperparameters
    assert loaded.situations == quick_agent.situations
    assert (loaded.mode, loaded.seed) == (quick_agent.mode, quick_agent.seed)
    assert loaded.observation_space == quick_agent.observation_space
    assert loaded.get_env().get_attr("spec")[0].id == "FamleReacher-v0"
    np.testing.assert_array_equal(actions(loaded), actions(quick_agent))


def test_agent_that_learned_on_its_robot_goes_on(quick_agent: FAMLE, reload: Load, make_env: MakeEnv) -> None:
    env = FAMLEWrapper(make_env(situation="joint 0 reversed"), quick_agent)
    obs, _ = env.reset(seed=0)
    for _ in range(13):
        obs, *_ = env.step(quick_agent.predict(obs)[0])
    loaded = reload(quick_agent)
    assert loaded.posterior() == quick_agent.posterior()
    assert loaded.belief.adaptations == quick_agent.belief.adaptations == 2
    for agent in (loaded, quick_agent):  # the next adaptation comes at the same step
        agent.observe(obs, np.zeros(5), obs)
        assert agent.belief.adaptations == 2
        agent.observe(obs, np.zeros(5), obs)
        assert agent.belief.adaptations == 3
    np.testing.assert_array_equal(actions(loaded), actions(quick_agent))


def test_learned_reward_is_kept(reload: Load) -> None:
    agent = FAMLE("Pendulum-v1", seed=0, device="cpu", hidden=(8,), transitions_per_situation=30, meta_iterations=2)
    agent.meta_learn([lambda g=g: gym.make("Pendulum-v1", g=g) for g in (3.0, 10.0)])
    obs = np.array([1.0, 0.0, 0.5], dtype=np.float32)
    np.testing.assert_array_equal(actions(reload(agent), obs=obs), actions(agent, obs=obs))


def test_agent_that_has_learned_nothing(reload: Load) -> None:
    agent = FAMLE("reacher", "paper", seed=3, device="cpu", horizon=4)
    loaded = reload(agent)
    assert loaded.hyperparameters == agent.hyperparameters
    assert loaded.mode == "paper"
    with pytest.raises(NotLearnedError):
        loaded.posterior()
    agent.get_env().close()


def test_settings_and_environment_can_be_changed(agent_file: Path, make_env: MakeEnv) -> None:
    broken = make_env(situation="joint 3 dead")
    agent = FAMLE.load(agent_file, env=broken, device="cpu", adapt_every=0, candidates=5, verbose=1)
    assert agent.hyperparameters.adapt_every == 0
    assert agent.verbose == 1
    agent.learn(12)
    assert agent.belief.adaptations == 0
    assert agent.get_env().get_attr("situation")[0].label == "joint 3 dead"


def test_horizon_can_be_changed_where_the_agent_has_a_plan(quick_agent: FAMLE, reload: Load) -> None:
    quick_agent.learn(2)
    loaded = reload(quick_agent, horizon=3, memory_size=7)
    _, state = loaded.predict(np.zeros(12, np.float32))
    assert state.plan.shape == (1, 3, 5)
    assert state.memory.weight.shape == (1, 7)


def test_environment_that_was_given_later_is_the_one_named(quick_agent: FAMLE, reload: Load, make_env: MakeEnv) -> None:
    quick_agent.get_env().close()
    quick_agent.set_env(make_env(goal=(1.0, -0.5)))
    assert reload(quick_agent).get_env().get_attr("goal")[0] == (1.0, -0.5)


def test_situation_of_the_environment_is_named(make_env: MakeEnv, reload: Load) -> None:
    agent = FAMLE(make_env(situation={"motor_gain": [1, 0.5]}), device="cpu")
    assert reload(agent).get_env().get_attr("situation")[0].motor_gain[:2] == (1.0, 0.5)


def test_settings_that_change_the_network_are_refused(agent_file: Path) -> None:
    for override in ({"hidden": (3,)}, {"embedding_dim": 2}, {"gate_actions": False}):
        with pytest.raises(ValueError, match="an override changed the network"):
            FAMLE.load(agent_file, device="cpu", **override)


def test_environment_with_other_spaces_is_refused(agent_file: Path) -> None:
    with pytest.raises(ValueError, match="are not the agent's"):
        FAMLE.load(agent_file, env="Pendulum-v1", device="cpu")


def test_reward_function_has_to_be_given_again(transitions: Transitions, reload: Load) -> None:
    def reward(obs: torch.Tensor, action: torch.Tensor, next_obs: torch.Tensor) -> torch.Tensor:
        return -next_obs[..., 0]

    agent = FAMLE("reacher", reward_fn=reward, seed=0, device="cpu", meta_iterations=1, inner_steps=1)
    agent.get_env().close()
    agent.meta_learn(transitions)
    with pytest.raises(ValueError, match=r"reward_fn=\.\.\."):
        reload(agent)
    np.testing.assert_array_equal(actions(reload(agent, reward_fn=reward)), actions(agent))


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

    monkeypatch.setattr(famle_agent.checkpoint if failing == "save_tensors" else Path, failing, fail)
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
        ({"version": 99}, "checkpoint version 99.*upgrade famle"),
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
    ],
    ids="-".join,
)
def test_file_that_makes_no_sense_is_refused(agent_file: Path, tmp_path: Path, change: dict[str, Any]) -> None:
    path = rewrite(agent_file, tmp_path / "odd.zip", lambda meta: meta.update(change))
    with pytest.raises(ValueError, match=r"\w"):
        FAMLE.load(path, device="cpu")


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


def test_environment_that_no_file_can_name_has_to_be_given(make_env: MakeEnv, reload: Load) -> None:
    unregistered = ReacherEnv()
    wrapped = gym.wrappers.RescaleAction(make_env(), np.float32(-0.5), np.float32(0.5))
    for env in (unregistered, wrapped, make_env(goal=np.array([1.0, 1.0]))):
        agent = FAMLE(env, device="cpu")
        loaded = reload(agent)
        assert loaded.get_env() is None
        assert loaded.action_space == agent.action_space
        assert loaded.observation_space == agent.observation_space
        reload(agent, env=env)
    unregistered.close()


# --- the parts ----------------------------------------------------------------------------------------------


@given(
    st.dictionaries(st.text(), FLOAT32 | st.text() | st.none() | st.lists(st.integers())),
    st.dictionaries(
        st.text(st.characters(codec="ascii", exclude_categories=("C",)), min_size=1),
        npst.arrays(np.float32, npst.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3), elements=FLOAT32),
        max_size=3,
    ),
)
def test_what_is_written_is_read(meta: dict[str, Any], arrays: dict[str, Any]) -> None:
    meta = {key: value for key, value in meta.items() if key not in ("format", "version")}
    arrays.pop("__metadata__", None)
    buffer = io.BytesIO()
    write_checkpoint(buffer, meta, {name: torch.from_numpy(array) for name, array in arrays.items()})
    buffer.seek(0)
    read, tensors = read_checkpoint(buffer)
    assert {key: read[key] for key in meta} == meta
    assert set(tensors) == set(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(tensors[name].numpy(), array)


@given(
    st.sampled_from(["float32", "float64"]).flatmap(
        lambda dtype: st.tuples(
            st.just(dtype), npst.arrays(dtype, st.integers(1, 4), elements=st.floats(-1e6, 1e6, width=32))
        )
    ),
    st.lists(st.booleans(), min_size=4, max_size=4),
)
def test_spaces_survive(values: tuple[str, Any], infinite: list[bool]) -> None:
    dtype, low = values
    high = low + 1
    low, high = np.where(infinite[: len(low)], -np.inf, low), np.where(infinite[: len(low)][::-1], np.inf, high)
    space = spaces.Box(low.astype(dtype), high.astype(dtype), dtype=np.dtype(dtype).type)
    assert _box_from_json(json.loads(json.dumps(_box_to_json(space)))) == space
