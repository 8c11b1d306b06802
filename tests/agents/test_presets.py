from __future__ import annotations

from typing import Any

import pytest

from famle_agent.agents.presets import whole_entry

FILES: dict[str, dict[str, Any]] = {
    "a": {"env_id": "A-v0", "ours": {"horizon": 5}, "paper": {}},
    "b": {"env_id": "B-v0", "like": "a", "paper": {"horizon": 9}},
    "c": {"env_id": "C-v0", "like": "b"},
}


def test_robot_has_the_settings_of_all_that_it_is_like() -> None:
    found = whole_entry(FILES, "c")
    assert (found["env_id"], found["ours"], found["paper"]) == ("C-v0", {"horizon": 5}, {"horizon": 9})


@pytest.mark.parametrize(
    ("end", "way"),
    [({"like": "c"}, "c is like b is like a is like c"), ({"like": "moon"}, "c is like b is like a is like moon")],
)
def test_likeness_without_an_end_is_refused(end: dict[str, Any], way: str) -> None:
    with pytest.raises(ValueError, match=rf"{way}\. Name another robot"):
        whole_entry({**FILES, "a": end}, "c")
