"""What an agent learns in simulation: the dynamics of every situation, and the reward where that is not known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor, nn

from famle_agent.data.action_scaling import ActionScale
from famle_agent.data.transitions import Transitions
from famle_agent.models.actor_critic import ActorCritic
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.observation import ObservationLayout
from famle_agent.models.reward import LearnedReward, LearnedTermination
from famle_agent.utils.chance import GlobalChance

__all__ = ["Interface", "ModelBuilder", "ModelConfig", "WorldModel"]


@dataclass(frozen=True)
class ModelConfig:
    """The architecture of the dynamics model, see :class:`~famle_agent.models.dynamics.Dynamics`.

    Attributes:
        hidden: Width of each hidden layer.
        embedding_dim: Size of a situation embedding h.
        egocentric: Whether the model sees a robot's pose on a floor from the robot itself, where the environment names
            it (``pose_dims``); the paper's does not.
        raw_angles: Whether the model sees angles as plain numbers, which jump from pi to -pi, instead of their sine and
            cosine; so does the authors' public code.
        gate_actions: Whether h scales the actions inside the model; the paper's network only concatenates it.
        interaction_rank: Rank of the products of h and the inputs in the first layer; 0 is the paper's network.
        members: Networks of the ensemble, each with its own embeddings; 1 is the paper's.
        degrees_of_freedom: Of the Student-t likelihood that tells situations apart; 0 is a Gaussian (the paper's).
        activation: Of the hidden layers, ``"silu"`` or, as the authors' public code, ``"relu"``.
        output_limit: L of a predicted change L tanh(z), in deviations of the data's; 0, the paper's, has no limit, the
            authors' code 10.
        normalise_actions: Whether the model sees actions of zero mean and unit deviation, as the authors' code does.
        initial_weights: Distribution of theta before learning: ``"normal"``, or ``"uniform"`` as PyTorch has it by
            itself, and so the authors' public code.
    """

    hidden: tuple[int, ...] = (200, 200)
    embedding_dim: int = 5
    egocentric: bool = True
    raw_angles: bool = False
    gate_actions: bool = True
    interaction_rank: int = 0
    members: int = 1
    degrees_of_freedom: float = 0.0
    activation: Literal["silu", "relu"] = "silu"
    output_limit: float = 0.0
    normalise_actions: bool = False
    initial_weights: Literal["normal", "uniform"] = "normal"

    def __post_init__(self) -> None:
        object.__setattr__(self, "hidden", tuple(int(width) for width in self.hidden))
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden must name the width of at least one layer, got {self.hidden}.")


@dataclass(frozen=True)
class WorldModel:
    """A model of all the situations that were simulated.

    Attributes:
        dynamics: Holds theta_meta and H_meta.
        situations: What the training situations are called, in the order of the embeddings.
        reward: The learnt reward; None where the environment or the user says it.
        termination: Where episodes end; None where somebody says it, or where none ended by itself.
        actor_critic: What to do in each situation, as learnt in simulation; None where that was not learnt.
    """

    dynamics: Dynamics
    situations: tuple[str, ...]
    reward: LearnedReward | None = None
    termination: LearnedTermination | None = None
    actor_critic: ActorCritic | None = None

    def parts(self) -> dict[str, nn.Module]:
        """The networks that there are, by name."""
        named = {"dynamics": self.dynamics, "reward": self.reward, "termination": self.termination}
        return {name: part for name, part in {**named, "actor_critic": self.actor_critic}.items() if part is not None}


@dataclass(frozen=True)
class Interface:
    """What a robot's observations and actions are.

    Attributes:
        observation_space: Of the robot.
        action_space: Of the robot.
        dims: The special dimensions of an observation by name, see
            :class:`~famle_agent.models.observation.ObservationLayout`.
    """

    observation_space: spaces.Box
    action_space: spaces.Box
    dims: Mapping[str, tuple[int, ...]]

    def __post_init__(self) -> None:
        _ = self.layout  # refuses what cannot be

    @property
    def layout(self) -> ObservationLayout:
        """What the dimensions of an observation are."""
        return ObservationLayout(self.observation_space.shape[0], **self.dims)


@dataclass(frozen=True)
class ModelBuilder:
    """Makes models for a robot, and turns its transitions into what they see.

    Attributes:
        config: The architecture.
        robot: What the robot's observations and actions are.
        device: Where models compute.
        shared_embedding: Whether one embedding stands for all situations, as in the agents that have none.
    """

    config: ModelConfig
    robot: Interface
    device: torch.device
    shared_embedding: bool

    def dynamics(self, situations: int, robots: int = 1) -> Dynamics:
        """Makes untrained dynamics.

        Args:
            situations: N.
            robots: Robots with a network each; 1 is a model that any number of robots share.
        """
        network = {name: value for name, value in vars(self.config).items() if name not in _NOT_OF_THE_NETWORK}
        settings: dict[str, Any] = {**network, **self.robot.dims, "robots": robots}
        return Dynamics(
            self.robot.observation_space.shape[0],
            self.robot.action_space.shape[0],
            1 if self.shared_embedding else situations,
            **settings,
        ).to(self.device)

    def reward(self) -> LearnedReward:
        """Makes an untrained reward r(s, a, s')."""
        return LearnedReward(self.robot.layout, self.robot.action_space.shape[0]).to(self.device)

    def termination(self) -> LearnedTermination:
        """Makes untrained ends of episodes."""
        return LearnedTermination(self.robot.layout).to(self.device)

    def actor_critic(self, situations: int, hidden: Sequence[int], interaction_rank: int) -> ActorCritic:
        """Makes an untrained actor-critic for N situations."""
        sizes = self.robot.observation_space.shape[0], self.robot.action_space.shape[0], situations
        return ActorCritic(*sizes, hidden, interaction_rank=interaction_rank).to(self.device)

    def load(self, weights: Mapping[str, dict[str, Tensor]], situations: tuple[str, ...]) -> WorldModel:
        """Makes a model of stored weights, by the names of :meth:`WorldModel.parts`.

        Raises:
            KeyError: Weights are missing.
            RuntimeError: The weights are of another architecture.
        """
        robots = max(1, len(weights["dynamics"]["embeddings"]) // self.config.members)
        on_paper = replace(self, device=torch.device("meta"))
        with on_paper.device:  # which takes no memory, of which settings that do not fit may ask for very much
            for name, part in on_paper.untrained(weights, situations, robots).items():
                part.load_state_dict(weights[name], assign=True)
        with GlobalChance(0)():  # initial weights, which are replaced
            parts = self.untrained(weights, situations, robots)
        for name, part in parts.items():
            part.load_state_dict(weights[name])
            part.requires_grad_(name == "dynamics")
        return WorldModel(situations=situations, **parts)

    def untrained(
        self, weights: Mapping[str, dict[str, Tensor]], situations: tuple[str, ...], robots: int
    ) -> dict[str, Any]:
        """Makes the parts that there are weights of."""
        parts: dict[str, Any] = {"dynamics": self.dynamics(len(situations), robots)}
        if weights.get("reward"):
            parts["reward"] = self.reward()
        if weights.get("termination"):
            parts["termination"] = self.termination()
        if policy := weights.get("actor_critic"):
            layers = {
                int(name.split(".")[1]): len(value) for name, value in policy.items() if name.startswith("actor.")
            }
            hidden, rank = [layers[i] for i in sorted(layers)[:-1]], len(policy["actor_features.of_obs.weight"])
            parts["actor_critic"] = self.actor_critic(len(situations), hidden, rank)
        return parts

    @property
    def action_scale(self) -> ActionScale:
        """Between the robot's actions and the model's, which lie in [-1, 1]."""
        return ActionScale.of(self.robot.action_space, self.device)

    def in_model_units(self, transitions: Transitions) -> Transitions:
        """Returns the same with actions in [-1, 1].

        Raises:
            ValueError: The observations or the actions are not of the robot's spaces.
        """
        obs_shape, action_shape = self.robot.observation_space.shape, self.robot.action_space.shape
        if (transitions.obs.shape[-1:], transitions.action.shape[-1:]) != (obs_shape, action_shape):
            raise ValueError(
                f"The transitions have observations {transitions.obs.shape} and actions {transitions.action.shape}; "
                f"the agent's spaces are {obs_shape} and {action_shape}."
            )
        action = self.action_scale.to_unit(self.tensor(transitions.action))
        return replace(transitions, action=action.cpu().numpy())

    def tensors(self, transitions: Transitions) -> tuple[Tensor, Tensor, Tensor]:
        """s, a and s' of the N situations, (N, n, ...) each."""
        return self.tensor(transitions.obs), self.tensor(transitions.action), self.tensor(transitions.next_obs)

    def tensor(self, values: Any) -> Tensor:
        """Numbers as a float tensor on the device."""
        return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=self.device)


_NOT_OF_THE_NETWORK = {"egocentric", "raw_angles"}
"""Settings that say what the dimensions are, which the builder is told."""
