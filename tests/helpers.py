"""What several tests share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import cache
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
import torch
from hypothesis import strategies as st
from torch import Tensor

from famle_agent import FAMLE, OnlineState, Transitions
from famle_agent.adaptation.belief import Belief, prior
from famle_agent.adaptation.candidates import Candidates
from famle_agent.adaptation.memory import Memory
from famle_agent.adaptation.posterior import window_posterior
from famle_agent.adaptation.update import descend, select
from famle_agent.models.dynamics import Batch, Dynamics, Theta
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.models.observation import DIMS, ObservationLayout
from famle_envs.engines import resolve_engine
from famle_envs.gait_env import GaitEnv
from famle_envs.profile import Profile
from famle_envs.quadruped import QuadrupedEnv
from famle_envs.reacher import ReacherEnv

Array = npt.NDArray[Any]


def some_observations(transitions: Transitions, n: int) -> Array:
    return transitions.obs[0, :n].copy()


def run(agent: FAMLE, env: gym.Env[Any, Any], steps: int, seed: int = 0) -> OnlineState:
    """Lives in an environment with the memory in the state."""
    obs, _ = env.reset(seed=seed)
    state, start = None, np.array([True])
    for _ in range(steps):
        action, state = agent.predict(obs, state, start)
        obs, _, terminated, truncated, _ = env.step(action)
        start[:] = terminated or truncated
        if start[0]:
            obs, _ = env.reset()
    assert state is not None
    return state


# --- robots that walk a gait a second -----------------------------------------------------------------------


@cache
def draws(engine: str) -> bool:
    """Whether an engine can render here; MuJoCo needs OpenGL."""
    with closing(ReacherEnv(engine=engine, render_mode="rgb_array")) as env:
        env.reset(seed=0)
        try:
            env.render()
        except RuntimeError:
            return False
    return True


def skip_what_cannot_be_drawn(engine: str | None, render_mode: str | None) -> None:
    """Skips the test where the engine, by its name, cannot render here."""
    if render_mode is not None and not draws(resolve_engine(engine)):
        pytest.skip("no OpenGL to render with")


@contextmanager
def making(robot: Callable[..., Any], engine: str | None = None) -> Iterator[Callable[..., Any]]:
    """Makes robots in an engine, already reset, and closes them in the end."""
    made: list[Any] = []

    def make(*args: Any, **kwargs: Any) -> Any:
        skip_what_cannot_be_drawn(engine, kwargs.get("render_mode"))
        made.append(robot(*args, **{"engine": engine, **kwargs}))
        made[-1].reset(seed=0)
        return made[-1]

    yield make
    for env in made:
        env.close()


def quadruped_with(situation: Any = None, *, engine: str | None = None, **ingredients: Any) -> QuadrupedEnv:
    """A quadruped with a profile of some ingredients."""
    profile = Profile("test", **ingredients) if ingredients else "simulator"
    return QuadrupedEnv(situation=situation, profile=profile, engine=engine)


def walk(env: GaitEnv, action: Any, gaits: int = 1) -> Array:
    """The observations after each of some equal gaits, (gaits, obs_dim)."""
    return np.stack([env.step(np.asarray(action, np.float64))[0] for _ in range(gaits)])


def watch(env: GaitEnv, action: Any, read: Callable[[GaitEnv], Any]) -> Array:
    """What ``read`` sees of the robot after each call of the simulator in one gait."""
    rows, simulate = [], env.world.simulate

    def simulate_and_read() -> None:
        simulate()
        rows.append(read(env))

    with patch.object(env.world, "simulate", simulate_and_read):
        env.step(np.asarray(action, np.float64))
    return np.array(rows)


# --- models -------------------------------------------------------------------------------------------------


@st.composite
def layouts(draw: st.DrawFn, max_obs_dim: int = 12) -> ObservationLayout:
    """Observations with special dimensions of all kinds, in any order."""
    obs_dim = draw(st.integers(1, max_obs_dim))
    free = list(draw(st.permutations(range(obs_dim))))
    dims: dict[str, tuple[int, ...]] = {}
    for name, sizes in (("quaternion_dims", (0, 4)), ("pose_dims", (0, 3, 4)), ("angle_dims", (0, 1, 2, 3))):
        size = draw(st.sampled_from([size for size in sizes if size <= len(free)]))
        dims[name], free = tuple(free[:size]), free[size:]
    return ObservationLayout(obs_dim, **dims)


@st.composite
def models(draw: st.DrawFn) -> Dynamics:
    """Models of many shapes, with a normalisation that is not the identity."""
    layout, action_dim, members = draw(layouts(8)), draw(st.integers(1, 3)), draw(st.integers(1, 3))
    obs_dim = layout.obs_dim
    torch.manual_seed(draw(st.integers(0, 1000)))
    model = Dynamics(
        obs_dim,
        action_dim,
        n_situations=draw(st.integers(1, 5)),
        embedding_dim=draw(st.integers(1, 4)),
        hidden=draw(st.lists(st.integers(1, 9), min_size=1, max_size=3)),
        **{name: getattr(layout, name) for name in DIMS},
        gate_actions=draw(st.booleans()),
        interaction_rank=draw(st.integers(0, 3)),
        members=members,
        degrees_of_freedom=draw(st.sampled_from([0.0, 3.0])),
        activation=draw(st.sampled_from(["silu", "relu"])),
        output_limit=draw(st.sampled_from([0.0, 10.0])),
        normalise_actions=draw(st.booleans()),
    )
    obs, action, next_obs = (torch.randn(50, dim) for dim in (obs_dim, model.action_dim, obs_dim))
    model.fit_normalisation(3 + 2 * obs, 0.5 * action, 3 + 2 * next_obs)
    model.noise_std.copy_(torch.rand(members, obs_dim) + 0.5)
    return model


def simple_model(**kwargs: Any) -> Dynamics:
    torch.manual_seed(0)
    return Dynamics(**{"obs_dim": 3, "action_dim": 2, "n_situations": 4, "hidden": (8, 8), **kwargs})


def random_theta(model: Dynamics, size: int) -> Theta:
    """Parameters of every member for each of ``size`` robots, (B, P, ...)."""
    return {name: torch.randn(value.shape) for name, value in model.theta_of(size).items()}


def random_h(model: Dynamics, size: int) -> Tensor:
    """An embedding of every member for each of ``size`` robots, (B, P, embedding_dim)."""
    return torch.randn(size, model.members, model.embeddings.shape[-1])


def random_transitions(model: Dynamics, *shape: int) -> tuple[Tensor, Tensor, Tensor]:
    obs = torch.randn(*shape, model.obs_dim)
    return obs, torch.rand(*shape, model.action_dim) * 2 - 1, obs + 0.3 * torch.randn_like(obs)


def rows_of(theta: Theta, rows: slice) -> Theta:
    return {name: value[rows] for name, value in theta.items()}


def log_likelihood(model: Dynamics, data: Batch, h: Tensor, theta: Theta | None = None) -> Tensor:
    """Log p(s' | s, a, h) of each transition with the fitted noise, a mean over the members, (B, n)."""
    return model.log_density(model.residuals(data, h, theta))


def memory_of(model: Dynamics, candidates: Candidates, obs: Tensor, action: Tensor, next_obs: Tensor) -> Memory:
    """A memory full of the transitions of B robots, (B, M, ...)."""
    log_p = candidates.log_likelihood(model, model.encode(obs, action, next_obs))
    return Memory.full(obs, action, next_obs, log_p)


def adapted(model: Dynamics, candidates: Candidates, memory: Memory, inner_loop: InnerLoop) -> Belief:
    """Algorithm 2, lines 2 and 3, for robots that have seen nothing but their memory."""
    start = prior(model, candidates, len(memory.weight))
    likely = replace(start, log_posterior=window_posterior(candidates, memory))
    return descend(model, select(model, candidates, likely), memory, inner_loop)
