"""Faults of a robot's body, through its MuJoCo model."""

from __future__ import annotations

import copy
import sys
from typing import Any

import gymnasium as gym
import numpy as np

from famle_envs.arguments import number_within
from famle_envs.situation import Situation

__all__ = ["MUJOCO_FAULTS", "MujocoFaults", "model_of"]

MUJOCO_FAULTS = frozenset({"friction", "base_mass", "mass", "body_mass", "damping", "motor_strength", "locked_joints"})
"""The fields of a situation that need a MuJoCo model."""

_BODIES = ("body_mass", "body_inertia")
_FRICTION = ("geom_friction", "pair_friction")
_FORCE = ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange")
_LOCK = ("jnt_limited", "jnt_range", "jnt_margin", "jnt_solref", "jnt_solimp")
_DERIVED = (*("body_subtreemass", "body_invweight0", "dof_M0", "dof_invweight0", "tendon_invweight0", "actuator_acc0"),)
"""What MuJoCo computes from the masses when it compiles a model."""
_MULTIPLIERS = (1e-3, 1e3)
_UNIT = "times the robot's own"
_LOCK_MARGIN = 0.01  # of both ends of a locked joint's range, so that both hold it (rad or m)
_LOCK_IMPEDANCE = (0.9999, 0.9999, 0.001, 0.5, 2.0)  # nearly rigid
_LOCK_TIME = 0.02  # in which a locked joint comes to rest (s)


def model_of(env: gym.Env[Any, Any]) -> Any:
    """The ``mujoco.MjModel`` of an environment with ``model`` and ``data``, or None."""
    mujoco = sys.modules.get("mujoco")  # whoever has a model has imported it
    if mujoco is None or not isinstance(getattr(env.unwrapped, "data", None), mujoco.MjData):
        return None
    model = getattr(env.unwrapped, "model", None)
    return model if isinstance(model, mujoco.MjModel) else None


class MujocoFaults:
    """Puts situations into a MuJoCo model, always from the values that it had at first.

    Args:
        model: The ``mujoco.MjModel`` of an intact robot.
        n_motors: Dimensions of the action. Where they are the model's actuators, motors and joints can have faults.

    Attributes:
        n_bodies: Bodies of the robot and around it, without the world.
        supported: The fields of a situation that this model can have.
    """

    def __init__(self, model: Any, n_motors: int) -> None:
        import mujoco

        names = (*_BODIES, *_FRICTION, *_FORCE, *_LOCK, *_DERIVED, "dof_damping")
        self._as_built = {name: getattr(model, name).copy() for name in names}
        self.n_bodies = int(model.nbody) - 1
        self.supported = MUJOCO_FAULTS - {"motor_strength", "locked_joints"}
        if model.nu != n_motors:
            return
        # Of these, the force is a sum of the first three parameters times something.
        gains, biases = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE), (mujoco.mjtBias.mjBIAS_NONE, 1)
        if np.isin(model.actuator_gaintype, gains).all() and np.isin(model.actuator_biastype, biases).all():
            self.supported |= {"motor_strength"}
        drives_joint = np.isin(model.actuator_trntype, (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT))
        self._joints = model.actuator_trnid[:, 0].copy()
        one_axis = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        no_limits = mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        if model.opt.disableflags & no_limits:
            return
        if drives_joint.all() and np.isin(model.jnt_type[self._joints], one_axis).all():
            self.supported |= {"locked_joints"}

    @staticmethod
    def check(situation: Situation) -> None:
        """Refuses multipliers with which nothing can be simulated.

        Raises:
            ValueError: One lies outside 0.001 to 1,000.
        """
        for name in ("friction", "mass", "base_mass", "damping"):
            number_within(name, getattr(situation, name), *_MULTIPLIERS, _UNIT)
        for name in ("body_mass", "motor_strength"):
            for value in getattr(situation, name):
                number_within(name, value, *_MULTIPLIERS, _UNIT)

    def apply(self, model: Any, situation: Situation) -> None:
        """Makes the model that of a robot in a situation, whose joints all move; see :meth:`lock`."""
        for name, value in self._as_built.items():
            getattr(model, name)[:] = value
        for name in _FRICTION:
            getattr(model, name)[:] *= situation.friction
        model.dof_damping[:] *= situation.damping
        if "motor_strength" in situation.faults:
            strength = np.array(situation.motor_strength)[:, None]
            model.actuator_gainprm[:, :3] *= strength
            model.actuator_biasprm[:, :3] *= strength
            model.actuator_forcerange[:] *= strength
        if situation.faults & {"mass", "base_mass", "body_mass"}:
            self._scale_masses(model, situation)

    def _scale_masses(self, model: Any, situation: Situation) -> None:
        import mujoco

        factor = situation.mass * np.array(situation.body_mass)
        factor[0] *= situation.base_mass
        model.body_mass[1:] *= factor
        model.body_inertia[1:] *= factor[:, None]
        # On a copy: this would move the robot to its start.
        scratch = copy.copy(model)
        mujoco.mj_setConst(scratch, mujoco.MjData(scratch))
        for name in _DERIVED:
            getattr(model, name)[:] = getattr(scratch, name)

    def lock(self, model: Any, data: Any, situation: Situation) -> None:
        """Holds the locked joints where they are now, by a range of motion without width.

        Args:
            model: The model.
            data: Its ``mujoco.MjData``.
            situation: Which joints are locked.
        """
        for joint in self._joints[list(situation.locked_joints)] if situation.locked_joints else ():
            model.jnt_limited[joint] = 1
            model.jnt_range[joint] = data.qpos[model.jnt_qposadr[joint]]
            model.jnt_margin[joint] = _LOCK_MARGIN
            model.jnt_solref[joint] = (max(_LOCK_TIME, 2.0 * model.opt.timestep), 1.0)
            model.jnt_solimp[joint] = _LOCK_IMPEDANCE
