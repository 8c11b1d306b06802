from __future__ import annotations

import pickle
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
import torch
from gymnasium import spaces
from torch import Tensor

from famle_agent.data.policies import (
    HeldUniformPolicy,
    MakeBatchPolicy,
    PlanningPolicy,
    Policy,
    make_held_uniform,
    make_planning,
)
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.simulator import Simulator
from famle_agent.planning import ICEM, MPPI, RandomShooting
from tests.clock import HIGH, LOW, Clock

Array = npt.NDArray[Any]
PLANNERS = [ICEM(4, candidates=60, iterations=4), MPPI(4, candidates=60, iterations=4), RandomShooting(2, 2000)]
every_planner = pytest.mark.parametrize("planner", PLANNERS, ids=lambda planner: type(planner).__name__)


# --- random actions -----------------------------------------------------------------------------------------


def test_drawn_action_is_not_shared() -> None:
    policy = HeldUniformPolicy(Clock.action_space, 3, np.random.default_rng(0))
    first = policy(np.zeros(3), True)
    original = first.copy()
    first += 1
    np.testing.assert_array_equal(policy(np.zeros(3), False), original)


# --- planned actions ----------------------------------------------------------------------------------------


class Plane(gym.Env[Array, Array]):
    """A point in the plane; its actions are far from [-1, 1]."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,))
    action_space = spaces.Box(LOW, HIGH)

    def __init__(self, goal: tuple[float, float] = (0.0, 0.0)) -> None:
        self.goal = goal

    def reward_fn(self, obs: Any, action: Any, next_obs: Any) -> Any:
        return -((next_obs[..., 0] - self.goal[0]) ** 2) - (next_obs[..., 1] - self.goal[1]) ** 2


def plane_model(members: int = 1) -> Dynamics:
    """next_obs = obs + gain * action / 10, with a gain of 1 in the first situation and of -1 in the second."""
    model = Dynamics(2, 2, n_situations=2, embedding_dim=1, hidden=(2,), members=members)
    far = 20.0  # where the hidden layer is linear
    with torch.no_grad():
        for value in model.theta.values():
            value.zero_()
        model.theta["weight_0"][:, 2:] = torch.eye(2)
        model.theta["bias_0"].fill_(far)
        model.theta["weight_1"][:] = 0.1 * torch.eye(2)
        model.theta["bias_1"].fill_(-0.1 * far)
        model.theta["gate"].fill_(1.0)
        model.embeddings[:] = torch.tensor([[0.0], [-2.0]])
    return model


def alone(make: MakeBatchPolicy, env: Plane, situation: int = 0, seed: int = 0) -> Policy:
    """The policy of one robot."""
    policy = make([env], [situation], np.random.default_rng(seed))
    return lambda obs, episode_start: policy(obs[None], np.array([episode_start]))[0]


def policy_of(situation: int, planner: Any, env: Plane, reward_fn: Any = None, members: int = 1) -> Policy:
    return alone(make_planning(plane_model(members), planner, reward_fn), env, situation)


def unit(action: Array) -> Array:
    return 2 * (action - LOW) / (HIGH - LOW) - 1


@every_planner
@pytest.mark.parametrize(("situation", "sign"), [(0, 1.0), (1, -1.0)])
def test_planning_knows_its_situation(planner: Any, situation: int, sign: float) -> None:
    policy = policy_of(situation, planner, Plane(goal=(3.0, -3.0)))
    action = policy(np.zeros(2, np.float32), True)
    assert action.dtype == np.float32
    assert sign * unit(action)[0] > 0.5
    assert sign * unit(action)[1] < -0.5


@every_planner
def test_planned_actions_lie_in_the_action_space(planner: Any) -> None:
    env = Plane(goal=(300.0, -300.0))
    policy = policy_of(0, planner, env)
    for step in range(10):
        assert env.action_space.contains(policy(np.zeros(2, np.float32), step == 0))


def test_reward_that_is_given_comes_before_the_environments_own() -> None:
    seen: list[Tensor] = []

    def reward(obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
        seen.append(action)
        return action[..., 0]

    env = Plane(goal=(-300.0, 0.0))
    action = policy_of(0, PLANNERS[0], env, reward)(np.zeros(2, np.float32), True)
    assert unit(action)[0] > 0.5
    actions = torch.cat([value.flatten(0, 1) for value in seen])  # in units of the environment
    assert torch.tensor(LOW).sub(actions).max() < 1e-5
    assert actions.sub(torch.tensor(HIGH)).max() < 1e-5
    assert actions[:, 0].min() < 2.5


def test_plan_goes_on_until_an_episode_begins() -> None:
    class Recorder(ICEM):
        def plan(self, judge: Any, start: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
            starts.append(start.clone())
            return super().plan(judge, start, generator)

    starts: list[Tensor] = []
    policy = policy_of(0, Recorder(4, candidates=20, iterations=2), Plane(goal=(3.0, 3.0)))
    for episode_start in (True, False, True):
        policy(np.zeros(2, np.float32), episode_start)
    assert starts[0].abs().max() == 0
    assert starts[1].abs().max() > 0.1
    assert starts[2].abs().max() == 0


def test_members_plan_together() -> None:
    one, three = (policy_of(0, PLANNERS[0], Plane(goal=(3.0, -3.0)), members=P) for P in (1, 3))
    obs = np.zeros(2, np.float32)
    np.testing.assert_allclose(one(obs, True), three(obs, True), atol=1e-5)  # the members are all alike
    model = plane_model(members=2)
    with torch.no_grad():
        model.embeddings[1, 0] = -2.0  # the other member believes that the robot moves the other way
        model.theta["weight_1"][1] *= 3.0
        model.theta["bias_1"][1] *= 3.0
    policy = alone(make_planning(model, PLANNERS[0], None), Plane(goal=(3.0, -3.0)))
    assert unit(policy(obs, True))[0] < -0.5


def test_chance_comes_from_the_generator_alone() -> None:
    make, obs, env = make_planning(plane_model(), PLANNERS[0], None), np.zeros(2, np.float32), Plane((0.3, -0.2))
    state = torch.get_rng_state()
    one, same, other = (alone(make, env, seed=seed)(obs, True) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize(
    ("make", "env", "situation", "obs"),
    [
        (make_held_uniform(3), Plane(), 1, np.ones(2, np.float32)),
        (make_planning(plane_model(), PLANNERS[0], None), [Plane()], [1], np.ones((1, 2), np.float32)),
    ],
)
def test_what_makes_a_policy_can_be_sent_to_a_process(make: Any, env: Any, situation: Any, obs: Array) -> None:
    sent = pickle.loads(pickle.dumps(make))  # noqa: S301 (our own)
    one, other = (each(env, situation, np.random.default_rng(5))(obs, np.array([True])) for each in (make, sent))
    np.testing.assert_array_equal(one, other)


def test_planning_leaves_the_model_as_it_is() -> None:
    model, before = plane_model(), plane_model()
    alone(make_planning(model, PLANNERS[0], None), Plane())(np.zeros(2, np.float32), True)
    for name, value in model.state_dict().items():
        assert torch.equal(value, before.state_dict()[name])


@pytest.mark.parametrize(("low", "high"), [(-1.1, 0.8), (-0.3, 0.7), (-2.9, 0.1)])
def test_planned_action_lies_in_the_action_space(low: float, high: float) -> None:
    space = spaces.Box(low, high, (2,), np.float64)
    ends = torch.tensor([[[1.0, -1.0]] * 2])
    planner: Any = SimpleNamespace(horizon=2, plan=lambda judge, plan, generator: (ends[:, 0], ends))
    chance = torch.Generator()
    model = plane_model()
    simulator = Simulator(model, model.embeddings_of(torch.tensor([0])))
    policy = PlanningPolicy(simulator, lambda obs, action, next_obs: obs[..., 0], planner, space, chance)
    (action,) = policy(np.zeros((1, 2), dtype=np.float32), np.array([True]))
    assert space.contains(action)
    np.testing.assert_allclose(action, [high, low], rtol=1e-6)


# --- several robots at once -----------------------------------------------------------------------------------


@every_planner
def test_robots_plan_together_each_for_its_situation_and_its_own_goal(planner: Any) -> None:
    goals = [(3.0, -3.0), (3.0, -3.0), (-3.0, 3.0), (-3.0, -3.0)]
    make = make_planning(plane_model(members=2), planner, None)
    policy = make([Plane(goal) for goal in goals], [0, 1, 0, 1], np.random.default_rng(0))
    actions = policy(np.zeros((4, 2), np.float32), np.ones(4, dtype=bool))
    assert actions.dtype == np.float32
    signs = np.array([[1.0, -1.0], [-1.0, 1.0], [-1.0, 1.0], [1.0, 1.0]])
    assert (signs * np.array([unit(action) for action in actions]) > 0.5).all()


def test_episode_that_begins_voids_the_plan_of_its_own_robot_alone() -> None:
    class Recorder(ICEM):
        def plan(self, judge: Any, start: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
            starts.append(start.clone())
            return super().plan(judge, start, generator)

    starts: list[Tensor] = []
    make = make_planning(plane_model(), Recorder(4, candidates=20, iterations=2), None)
    policy = make([Plane((3.0, 3.0)), Plane((-3.0, 3.0))], [0, 0], np.random.default_rng(0))
    for begins in ([True, True], [False, True]):
        policy(np.zeros((2, 2), np.float32), np.array(begins))
    assert starts[0].abs().max() == 0
    assert starts[1][0].abs().max() > 0.1
    assert starts[1][1].abs().max() == 0


def test_rewards_of_robots_may_be_numbers_and_numpy_arrays() -> None:
    class Odd(Plane):
        def reward_fn(self, obs: Any, action: Any, next_obs: Any) -> Any:
            return 1.0

    class Numpy(Plane):
        def reward_fn(self, obs: Any, action: Any, next_obs: Any) -> Any:
            return super().reward_fn(obs, action, next_obs).numpy()

    make = make_planning(plane_model(), PLANNERS[0], None)
    policy = make([Odd(), Numpy((3.0, -3.0))], [0, 0], np.random.default_rng(0))
    action = unit(policy(np.zeros((2, 2), np.float32), np.ones(2, dtype=bool))[1])
    assert action[0] > 0.5
    assert action[1] < -0.5


@pytest.mark.parametrize(("candidates", "members", "batch_size"), [(32, 4, 5), (10_000, 1, 1), (8, 2, 40)])
def test_plans_that_are_large_are_made_one_by_one(candidates: int, members: int, batch_size: int) -> None:
    assert make_planning(plane_model(members), ICEM(4, candidates=candidates), None).batch_size == batch_size
