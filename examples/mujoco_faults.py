"""Faults in the MuJoCo model of one of Gymnasium's robots: locked joints, a slippery floor, a load.

python -m examples.mujoco_faults                          # two to three minutes, most of them for the policy
python -m examples.mujoco_faults --policy-steps 200000    # runs faster
"""

from __future__ import annotations

from pathlib import Path

import tyro

from famle_agent import FAMLE, FAMLEWrapper
from famle_agent.rollout import rollout
from famle_envs.faults import make_faulty

ROBOT = "HalfCheetah-v5"
SITUATIONS = ("intact", *(f"joint {joint} locked" for joint in range(6)), "friction x 0.3", "mass x 1.5")
UNSEEN = (
    "joint 4 locked, mass x 1.5",
    "joint 0 locked, joint 3 locked",
    "joint 1 locked, friction x 0.3",
    "mass x 2.5",
)


def main(
    policy_steps: int = 40_000,
    iterations: int = 1500,
    steps: int = 300,
    seed: int = 0,
    out: Path = Path("runs/mujoco_faults/cheetah.zip"),
) -> None:
    """Meta-learns in simulation, and compares the agent on unseen robots with one that does not adapt.

    Args:
        policy_steps: Simulated steps of all situations together, in which a policy is learnt; the model learns from
            what it goes through.
        iterations: Of the model's learning.
        steps: Of each unseen robot.
        seed: Of everything.
        out: Where the agent is stored.
    """
    agent = FAMLE(ROBOT, seed=seed, policy_steps=policy_steps, joint_iterations=iterations)
    agent.meta_learn(SITUATIONS, progress_bar=True)
    print(agent.last_check)
    agent.save(out)

    print(f"Return of {steps} steps:")
    better = 0
    for situation in UNSEEN:
        adapted = FAMLE.load(out, ROBOT)
        frozen = FAMLE.load(out, ROBOT, adapt_every=0)
        with_adaptation, without = (live(agent, situation, steps, seed) for agent in (adapted, frozen))
        print(f"{situation}: {with_adaptation:.0f} with adaptation, {without:.0f} without. {adapted.diagnose()}")
        better += with_adaptation > without
    print(f"Adaptation was better on {better} of {len(UNSEEN)} unseen robots.")


def live(agent: FAMLE, situation: str, steps: int, seed: int) -> float:
    """Returns what an agent gets on a broken robot in one episode, its first."""
    robot = make_faulty(ROBOT, situation, max_episode_steps=steps)
    return rollout(FAMLEWrapper(robot, agent), seed).total


if __name__ == "__main__":
    tyro.cli(main)
