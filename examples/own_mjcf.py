"""A robot of your own from an MJCF file: simulate it with one fault at a time, then break it as it never was before.

python -m examples.own_mjcf   # less than a minute
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import tyro
from gymnasium.envs.mujoco import MujocoEnv

from famle_agent import FAMLE, FAMLEWrapper
from famle_agent.rollout import rollout
from famle_envs.faults import actuator_faults, make_faulty

MODEL = Path(__file__).with_name("arm.xml")
GOAL = (-0.3, 0.5)  # where the tip shall be (m)
UNSEEN = "motor 0 reversed, motor 1 at gain 0.4"  # each training situation has one fault


class Arm(MujocoEnv):
    """An arm of three joints at 50 Hz, whose motors follow the velocity that they are told (rad/s).

    It observes three angles (rad), three velocities (rad/s), and x and y of its tip (m).
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012 (as Gymnasium has it)
    angle_dims = (0, 1, 2)

    def __init__(self, **kwargs: Any) -> None:
        space = gym.spaces.Box(-np.inf, np.inf, (8,), np.float32)
        super().__init__(str(MODEL), frame_skip=10, observation_space=space, **kwargs)

    def observe(self) -> Any:
        """Returns the observation (8,)."""
        return np.concatenate([self.data.qpos, self.data.qvel, self.data.site("tip").xpos[:2]]).astype(np.float32)

    def reset_model(self) -> Any:
        """Puts the arm near its straight pose."""
        self.data.qpos[:] = self.np_random.uniform(-0.1, 0.1, 3)
        mujoco.mj_forward(self.model, self.data)
        self.command = np.zeros(3)
        return self.observe()

    def step(self, action: Any) -> Any:
        """Moves for 20 ms; the command takes some of them to get there, as on a robot."""
        before, late = self.observe(), self.np_random.integers(1, self.frame_skip)
        self.do_simulation(self.command, late)
        self.do_simulation(action, self.frame_skip - late)
        self.command, obs = action, self.observe()
        return obs, float(self.reward_fn(before, action, obs)), False, False, {}

    @staticmethod
    def reward_fn(obs: Any, action: Any, next_obs: Any) -> Any:
        """Returns 1 where the tip is at the goal, less elsewhere; for arrays and tensors (..., dim)."""
        x, y = next_obs[..., 6] - GOAL[0], next_obs[..., 7] - GOAL[1]
        return math.e ** (-5.0 * (x * x + y * y) ** 0.5)


gym.register("OwnArm-v0", entry_point=Arm, max_episode_steps=200)


def main(
    transitions: int = 2000, iterations: int = 2000, seed: int = 0, out: Path = Path("runs/own_mjcf/arm.zip")
) -> None:
    """Meta-learns in simulation, breaks the arm, and compares the agent with one that does not adapt.

    Args:
        transitions: Simulated in each situation.
        iterations: Of the learning.
        seed: Of everything.
        out: Where the agent is stored.
    """
    agent = FAMLE(
        "OwnArm-v0",
        seed=seed,
        policy_steps=0,  # random actions say enough about an arm; a robot that has to balance or walk needs a policy
        action_hold=10,  # each for 0.2 s, so that they lead somewhere
        transitions_per_situation=transitions,
        joint_iterations=iterations,
        hidden=(64, 64),  # small, so that a plan takes some milliseconds
    )
    agent.meta_learn(actuator_faults(gym.make("OwnArm-v0")), progress_bar=True)
    print(agent.last_check)
    agent.save(out)

    frozen = FAMLE.load(out, "OwnArm-v0", adapt_every=0)
    adapted, fixed = (rollout(FAMLEWrapper(make_faulty("OwnArm-v0", UNSEEN), a), seed).total for a in (agent, frozen))
    print(f"The arm has {UNSEEN}, which is no training situation. {agent.diagnose()}")
    print(f"Return of 200 steps: {adapted:.1f} with adaptation, {fixed:.1f} without.")


if __name__ == "__main__":
    tyro.cli(main)
