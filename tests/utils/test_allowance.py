from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from famle_agent.utils.allowance import Allowance

seconds = st.floats(0.001, 10.0)


class Clock:
    """Tells the time that a test sets."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


@given(st.lists(st.tuples(seconds, seconds), min_size=1, max_size=50), st.floats(0.001, 0.5))
def test_work_on_the_side_takes_its_share_and_one_turn_at_most(turns: list[tuple[float, float]], share: float) -> None:
    clock = Clock()
    allowance, longest = Allowance(share, clock), 0.0
    for main_work, on_the_side in turns:
        clock.now += main_work
        if allowance.is_left():
            longest = max(longest, on_the_side)
            with allowance.spending():
                clock.now += on_the_side
        assert allowance.spent <= share * clock.now + longest + 1e-9


def test_work_is_allowed_again_after_a_while() -> None:
    clock = Clock()
    allowance = Allowance(0.1, clock)
    with allowance.spending():
        clock.now += 1.0
    assert not allowance.is_left()
    clock.now = 10.01
    assert allowance.is_left()
