from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from famle_agent import FAMLE, Transitions
from famle_agent.utils.chance import GlobalChance


def draw() -> tuple[float, float]:
    return float(np.random.random()), float(torch.rand(()))


@given(st.integers(0, 2**40), st.lists(st.integers(0, 3), min_size=1, max_size=5))
def test_stream_is_its_own(seed: int, drawn_between: list[int]) -> None:
    whole, pieces = GlobalChance(seed), GlobalChance(seed)
    with whole():
        expected = [draw() for _ in drawn_between]
    found = []
    for others in drawn_between:
        for _ in range(others):
            draw()  # somebody else's
        with pieces():
            found.append(draw())
    assert found == expected


@given(st.integers(0, 2**40))
def test_global_generators_stay_as_they_were(seed: int) -> None:
    np.random.seed(1)
    torch.manual_seed(1)
    expected = draw()
    np.random.seed(1)
    torch.manual_seed(1)
    with GlobalChance(seed)():
        draw()
    assert draw() == expected


def test_agents_in_two_threads_learn_as_one_after_the_other(transitions: Transitions) -> None:
    def learn(seed: int) -> dict[str, Any]:
        agent = FAMLE("reacher", seed=seed, device="cpu", hidden=(8,), meta_iterations=2, inner_steps=2)
        return agent.meta_learn(transitions).model.state_dict()

    expected = [learn(seed) for seed in range(3)]
    for _ in range(3):
        with ThreadPoolExecutor(3) as threads:
            found = list(threads.map(learn, range(3)))
        for one, other in zip(found, expected, strict=True):
            assert all(torch.equal(one[name], other[name]) for name in other)


def test_loading_draws_nothing(agent: FAMLE, tmp_path: Any) -> None:
    agent.save(tmp_path / "agent.zip")
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    agent.restore(tmp_path / "agent.zip")
    assert torch.equal(torch.rand(3), expected)
