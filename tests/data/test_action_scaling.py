from __future__ import annotations

import numpy as np
import torch
from gymnasium import spaces

from famle_agent.data.action_scaling import to_action_space


def test_integer_actions_are_the_nearest_ones() -> None:
    space = spaces.Box(-2, 2, (3,), np.int64)
    actions = to_action_space(torch.tensor([[-0.9, 0.3, 0.9]]), space)
    assert actions.dtype == np.int64
    assert actions.tolist() == [[-2, 1, 2]]
