"""What every agent has learnt, and how a file holds it: the part of its face that is about saving and loading."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from types import SimpleNamespace
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import get_system_info
from typing_extensions import Self

from famle_agent.adaptation.controller import Adapter, Controller
from famle_agent.adaptation.perception import Perception
from famle_agent.agents.checkpoint import Checkpoint, File, joined
from famle_agent.agents.config import Config
from famle_agent.agents.online_adaptation import OnlineAdaptation
from famle_agent.agents.parameters import Parameters, parameters_of, with_parameters
from famle_agent.agents.policy import AdaptivePolicy
from famle_agent.agents.presets import make_env
from famle_agent.agents.world_model import Interface
from famle_agent.data.description import different_arguments, env_attribute
from famle_agent.data.envs import situation_envs
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.reward import RewardFn, TerminationFn

__all__ = ["StoredAgent"]


class StoredAgent(BaseAlgorithm):
    """An algorithm of Stable-Baselines3 whose files hold JSON and tensors.

    Attributes:
        policy: What the agent has learnt, and how it acts on it.
        mode: The settings that it began with.
        generator: Source of its chance.
    """

    policy: AdaptivePolicy  # type: ignore[assignment]
    observation_space: spaces.Box
    action_space: spaces.Box
    mode: str
    generator: torch.Generator
    _online: OnlineAdaptation
    _env_spec: dict[str, Any] | None

    # --- what it has learnt -----------------------------------------------------------------------------

    @property
    def model(self) -> Dynamics:
        """The meta-learned model.

        Raises:
            NotLearnedError: The agent has no model yet.
        """
        return self.policy.model

    @property
    def dynamics(self) -> Dynamics | None:
        """The meta-learned model; None before :meth:`meta_learn`, where none is shipped."""
        return None if self.policy.world is None else self.policy.world.dynamics

    @property
    def situations(self) -> tuple[str, ...]:
        """What the training situations are called, in the order of the model's embeddings."""
        return () if self.policy.world is None else self.policy.world.situations

    @property
    def adapter(self) -> Adapter:
        """What adapts the model; see :class:`~famle_agent.agents.policy.AdaptivePolicy`, here and below."""
        return self.policy.adapter

    @property
    def controller(self) -> Controller:
        """Algorithm 2 with the agent's adapter, planner and reward."""
        return self.policy.controller

    @property
    def perception(self) -> Perception:
        """The controller on robots whose sensors may fail."""
        return self.policy.perception

    @property
    def config(self) -> Config:
        """The settings."""
        return self.policy.config

    @config.setter
    def config(self, config: Config) -> None:
        self.policy.config = config

    @property
    def hyperparameters(self) -> SimpleNamespace:
        """Deprecated: the settings by their keywords."""
        warnings.warn("hyperparameters is called config, whose to_dict() has the keywords.", DeprecationWarning, 2)
        return SimpleNamespace(**self.config.to_dict())

    @property
    def dims(self) -> Mapping[str, tuple[int, ...]]:
        """The special dimensions of an observation: ``angle_dims``, ``quaternion_dims`` and ``pose_dims``."""
        return {} if self.policy.robot is None else self.policy.robot.dims

    # --- saving and loading -----------------------------------------------------------------------------

    def save(  # type: ignore[override]
        self, path: File, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None
    ) -> None:
        """Writes the agent, what it believes now included, as JSON and safetensors in a zip; no pickle.

        The environment is named, not stored. A ``reward_fn`` given to the constructor is not stored either and has
        to be given to :meth:`load` again.

        Args:
            path: A path, ``.zip`` is appended where it has no suffix; or a binary file.
            exclude: What to leave out, such as ``"live"``, what the agent believes now, ``"seed"`` or
                ``"tensorboard_log"``. As in Stable-Baselines3, names that no file holds change nothing.
            include: What to store although it is in ``exclude``.

        Raises:
            ValueError: The agent has no environment; no agent can be made without what is excluded; or what is
                included is nothing that a file can hold.
        """
        if not hasattr(self, "observation_space"):
            raise ValueError("This agent has no environment, so that there is nothing to save; make it with one.")
        live = self._online.state
        Checkpoint(
            kind=type(self).__name__,
            mode=self.mode,
            config=self.config,
            observation_space=self.observation_space,
            action_space=self.action_space,
            dims=dict(self.dims),
            situations=self.situations,
            env=self._env_spec,
            needs_reward_fn=self.policy.user_reward_fn is not None,
            needs_termination_fn=self.policy.user_termination_fn is not None,
            seed=self.seed,
            num_timesteps=self.num_timesteps,
            episodes=self._episode_num,
            verbose=self.verbose,
            tensorboard_log=None if self.tensorboard_log is None else str(self.tensorboard_log),
            live=None if live is None else live.counts,
            tensors=joined(
                **parameters_of(self.policy.world),
                live={} if live is None else live.to_tensors(),
                # The state of another device's generator means nothing elsewhere.
                generator={"state": self.generator.get_state()} if self.device.type == "cpu" else {},
            ),
        ).without(exclude or (), include or ()).write(path)

    @classmethod
    @torch.inference_mode(mode=False)
    def load(  # type: ignore[override]
        cls,
        path: File,
        env: GymEnv | str | None = None,
        device: torch.device | str = "auto",
        reward_fn: RewardFn | None = None,
        termination_fn: TerminationFn | None = None,
        *,
        custom_objects: Mapping[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **overrides: Any,
    ) -> Self:
        """Reads an agent that :meth:`save` wrote; it acts as the saved one would have. Runs no code from the file.

        Args:
            path: A path or a binary file.
            env: The environment; None makes the one that the file names, if it is one of ``famle_envs``.
            device: As in the constructor.
            reward_fn: As in the constructor; needed where the agent was made with one.
            termination_fn: As in the constructor; needed where the agent was made with one.
            custom_objects: What to take in the place of what the file holds, by name. As in Stable-Baselines3, names
                that the file does not hold change nothing; among ``overrides`` they are refused.
            print_system_info: Whether to print which system and libraries these are; a file names none.
            force_reset: Accepted as in Stable-Baselines3. No file says where a robot is: the first :meth:`learn` resets
                it in any case.
            **overrides: Settings to change, and ``verbose`` or ``tensorboard_log``.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is damaged, foreign or another kind of agent; the environment does not fit; a
                ``reward_fn`` or a ``termination_fn`` is needed.
        """
        if "mode" in overrides:
            raise ValueError(
                "A stored agent has all its settings, and no other mode; give load() the settings to change."
            )
        if print_system_info:
            get_system_info()
        stored = Checkpoint.read(path)
        overrides = stored.replaced_by(custom_objects or {}) | overrides
        reward_fn = reward_fn or overrides.pop("reward_fn", None)
        termination_fn = termination_fn or overrides.pop("termination_fn", None)
        stored.check_agent(cls.__name__, reward_fn is not None, termination_fn is not None)
        if (made := stored.make_env() if env is None else make_env(env)) is not None:
            stored.check_spaces(made)
        # All settings are in the file, so that its mode need not be known for this environment.
        console = {"verbose": stored.verbose, "tensorboard_log": stored.tensorboard_log}
        settings = {"config": stored.config, **stored.dims, **console, **overrides}
        task: dict[str, Any] = {"reward_fn": reward_fn, "termination_fn": termination_fn}
        make: Any = cls  # whose constructor has more arguments than that of Stable-Baselines3's base
        agent: Self = make(made, **task, device=device, pretrained=False, **settings)
        agent.mode, agent.num_timesteps, agent._episode_num = stored.mode, stored.num_timesteps, stored.episodes
        if made is None:
            agent.observation_space, agent.action_space, agent.n_envs = stored.observation_space, stored.action_space, 1
            agent.policy.robot = Interface(stored.observation_space, stored.action_space, stored.dims)
        agent.set_random_seed(stored.seed)
        agent._take_over(stored)
        agent.set_random_seed(overrides.get("seed"))
        return agent

    @torch.inference_mode(mode=False)
    def restore(self, file: File) -> None:
        """Takes weights, belief and random numbers from the file of an agent with the same settings.

        Args:
            file: A path or a binary file.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is damaged, or its weights are of other settings.
        """
        self._take_over(Checkpoint.read(file))

    @torch.inference_mode(mode=False)
    def take_model(self, file: File) -> list[str]:
        """Takes the model from a file, if that is of the same kind, environment and settings of learning.

        Args:
            file: A path or a binary file.

        Returns:
            In what the two differ; nothing where the model was taken.
        """
        stored = Checkpoint.read(file)
        differing = [] if stored.kind == type(self).__name__ else ["kind of agent"]
        differing += self._differs(stored.env)
        differing += [name for name, dims in self.dims.items() if stored.dims[name] != dims]
        differing += stored.config.learnt_otherwise(self.config)
        if not stored.part("reward") and self.env is not None and self.policy.learns_reward:
            differing.append("reward")
        if not differing:
            self._take_over(stored.model_alone())
        return differing

    def _take_over(self, stored: Checkpoint) -> None:
        policy = self.policy
        known = policy.world, self._online.state
        try:
            weights = {name: stored.part(name) for name in ("dynamics", "reward", "termination", "actor_critic")}
            if weights["dynamics"]:
                policy.world = policy.builder.load(weights, stored.situations)
            if stored.live is not None:
                self._online.state = policy.stored_state(stored.part("live"), stored.live)
            if self.device.type == "cpu" and (generator := stored.part("generator")):
                self.generator.set_state(generator["state"])
        except (LookupError, RuntimeError, TypeError, ValueError) as error:
            policy.world, self._online.state = known  # nothing is half-taken
            raise ValueError(
                "The file's weights do not fit its settings; it is damaged, of an older version, or an override "
                f"changed the network: {error}"
            ) from error

    def _differs(self, env: dict[str, Any] | None) -> list[str]:
        """In what another environment differs from the agent's, as far as it matters to a model of all situations."""
        if env is None or self._env_spec is None or self.env is None or env["id"] != self._env_spec["id"]:
            return [] if env is None and self._env_spec is None else ["environment"]
        task = env_attribute(self.env, "task_arguments", ())
        names = [name for name in different_arguments(env, self._env_spec) if name not in task]
        return [f"environment ({', '.join(names)})"] if names else []

    def get_parameters(self) -> dict[str, dict[str, Any]]:
        """Returns the weights of each network by its name, ``"dynamics"`` first; nothing before it has learnt any."""
        return parameters_of(self.policy.world)

    @torch.inference_mode(mode=False)
    def set_parameters(  # type: ignore[override]
        self, load_path_or_dict: File | Parameters, exact_match: bool = True, device: torch.device | str = "auto"
    ) -> None:
        """Takes weights, and forgets what was believed of robots with others; all of them are taken, or none.

        Args:
            load_path_or_dict: A file that :meth:`save` wrote, or what :meth:`get_parameters` returns.
            exact_match: Whether all networks and all of their weights must be given.
            device: Accepted as in Stable-Baselines3; the weights go to the agent's own device.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is damaged or of another kind of agent; a network is unknown or missing; or the weights
                do not fit the settings.
        """
        if isinstance(load_path_or_dict, Mapping):
            given, situations = load_path_or_dict, self.situations or self._names_for(load_path_or_dict)
        else:
            stored = Checkpoint.read(load_path_or_dict)
            stored.check_agent(type(self).__name__, has_reward_fn=True, has_termination_fn=True)
            given, situations = stored.weights(), stored.situations
        self.policy.world = with_parameters(self.policy, given, situations, exact_match)
        self._online.state = None

    def _names_for(self, parameters: Parameters) -> tuple[str, ...]:
        """What the situations of an agent without a model are called, whose weights are given without any names."""
        embeddings = parameters.get("dynamics", {}).get("embeddings")
        n = 1 if embeddings is None else embeddings.shape[1]
        names: tuple[str, ...] = ()
        if self.env is not None and env_attribute(self.env, "training_situations", ()):
            names = tuple(situation_envs(self.env, None).situations)
        return names if len(names) == n else tuple(f"situation {i}" for i in range(n))

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return list(self.get_parameters()), []
