"""Learning in simulation: transitions of every situation, and a model from them."""

from __future__ import annotations

import os
from abc import abstractmethod
from collections.abc import Callable, Generator
from contextlib import closing
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import configure_logger
from torch import Tensor
from tqdm.auto import tqdm
from typing_extensions import Self

from famle_agent.agents.algorithm import ModelBasedAlgorithm
from famle_agent.data.action_scaling import ActionScale
from famle_agent.data.collect import collect
from famle_agent.data.envs import SituationEnvs, SituationsLike, situation_envs
from famle_agent.data.policies import MakePolicy, make_held_uniform, make_planning, reward_names
from famle_agent.data.transitions import Transitions
from famle_agent.models.dynamics import Batch, Dynamics
from famle_agent.training.maml import MAML
from famle_agent.training.progress import Progress
from famle_agent.training.reptile import Reptile
from famle_agent.training.run_folder import RunFolder
from famle_agent.training.trainer import Metrics

__all__ = ["SimulationLearner"]


class SimulationLearner(ModelBasedAlgorithm):
    """The part of an agent that learns its model in simulation.

    Subclasses say how it is meta-learned (:meth:`_meta_learner`). Arguments as for
    :class:`~famle_agent.agents.algorithm.ModelBasedAlgorithm`.
    """

    @abstractmethod
    def _meta_learner(self) -> Reptile | MAML | None:
        """Returns what comes after training on all situations at once."""

    @abstractmethod
    def forget(self) -> None:
        """Returns to what was meta-learned, as for a robot that was just repaired."""

    @abstractmethod
    def restore(self, file: Path) -> None:
        """Takes over the model of a stored agent, and where its random numbers had got to."""

    def _log_model(self) -> None:
        """Shows the learnt model where there is something to show."""

    def meta_learn(
        self,
        envs: SituationsLike | Transitions | None = None,
        callback: MaybeCallback = None,
        tb_log_name: str | None = None,
        progress_bar: bool = False,
        n_jobs: int = 1,
        folder: str | os.PathLike[str] | None = None,
    ) -> Self:
        """Learns in simulation: collects transitions in every situation, then learns the model from them.

        With ``rounds`` in the settings it goes round: the agent plans with its model in every simulated situation, and
        learns on from all transitions. While the model learns, ``num_timesteps`` counts the iterations, and callbacks
        are called once an iteration.

        Args:
            envs: One environment, factory or :class:`~famle_envs.Situation` per situation, in a list or in a mapping
                from what each is called; None takes the training situations that the agent's environment names. Or
                :class:`Transitions` that were collected before, which are then all that is learnt from.
                List the situation first that the robot is in until it shows otherwise.
            callback: Stable-Baselines3 callbacks, or a function.
            tb_log_name: Name of the run in TensorBoard; by default the class and ``_meta``.
            progress_bar: Whether to show progress bars.
            n_jobs: Processes that simulate, -1 for one a core. The result does not depend on it.
            folder: Where transitions are stored as they come, the model after each round, and once a minute how far
                a round has got. The same call goes on where one that was stopped had got to.

        Returns:
            The agent.

        Raises:
            ValueError: There are no situations, an environment's spaces differ from the agent's, or the folder is of a
                run with other settings.
        """
        source = envs if isinstance(envs, Transitions) else self.situation_envs(envs)
        rounds = 0 if isinstance(source, Transitions) else self.hyperparameters.rounds
        run = RunFolder(folder, {} if folder is None else self._fingerprint(source))  # which reads all transitions
        if not self._custom_logger:
            name = tb_log_name or f"{type(self).__name__}_meta"
            self._logger = configure_logger(self.verbose, self.tensorboard_log, name)
        hooks = self._init_callback(callback)
        total_timesteps = self.hyperparameters.iterations(rounds)  # the name that callbacks look for
        self.num_timesteps = 0
        self.forget()
        if folder is not None and self.seed is not None:
            self.generator.manual_seed(self.seed)  # the same call draws the same numbers, be it the first or not
        hooks.on_training_start(locals(), globals())
        known = self.situations, self.dynamics, self.learned_reward
        try:
            with closing(self._train(source, rounds, run, n_jobs, progress_bar)) as training:
                for metrics in training:
                    if not self.log_iteration(metrics, max(1, total_timesteps // 200), hooks):
                        break
            self._log_model()
        except BaseException:
            self.situations, self.dynamics, self.learned_reward = known  # half-learnt models are none
            self.num_timesteps = 0
            raise
        hooks.on_training_end()
        self.num_timesteps = 0
        return self

    def _train(
        self, source: SituationEnvs | Transitions, rounds: int, folder: RunFolder, n_jobs: int, progress_bar: bool
    ) -> Generator[Metrics]:
        """Runs Algorithm 1 round by round: simulates, and learns from all that has been simulated so far."""
        settings, transitions = self.hyperparameters, None

        def bar(name: str, number: int, total: int, unit: str) -> tqdm[Any]:
            desc = f"{name} {number + 1}/{rounds + 1}" if rounds else name
            return tqdm(total=total, desc=desc, unit=unit, mininterval=1.0, disable=not progress_bar)

        for number in range(rounds + 1):
            last = number == rounds
            # Lines 1 to 6: transitions D_c of every situation c.
            if isinstance(source, Transitions):
                new = source
            else:
                n = (settings.round_transitions if number else settings.transitions_per_situation) * len(source.sources)
                with bar("Simulating", number, n, "step") as simulating:
                    new = self._simulate(source, number, n_jobs, folder.transitions(number), simulating.update)
            new = self.in_model_units(new)
            transitions = new if transitions is None else transitions.followed_by(new)
            if (agent := folder.finished(number)) is not None:
                self.restore(agent)
                self.num_timesteps = settings.iterations(number, last)
                continue

            # Lines 7 to 14: theta and H from them.
            left = settings.iterations(number, last) - self.num_timesteps
            with bar("Meta-learning", number, left, "it") as learning, torch.random.fork_rng(devices=[]):
                torch.manual_seed(self._draw_seed())  # initial weights come from torch's global generator
                self.situations = transitions.situations
                self._learn_reward(transitions)  # first, so that callbacks can let the agent act
                model, data = self.begin_model(transitions, number == 0 or (last and settings.restart_last_round))
                progress = partial(self._progress, folder, number, learning)
                trainer = settings.trainer(number, self._meta_learner() if last else None)
                for metrics in trainer.fit(model, data, self.generator, progress):
                    shown = {key.split("/")[-1]: f"{value:.3g}" for key, value in metrics.items()}
                    learning.set_postfix(shown, refresh=False)
                    learning.update()
                    yield metrics
            folder.finish(number, self.save)

    def _progress(self, folder: RunFolder, number: int, bar: tqdm[Any], stage: str) -> Progress:
        """Returns where a stage of a round goes on from, and counts what had been done of it before."""

        def skipped(iterations: int) -> None:
            self.num_timesteps += iterations
            bar.update(iterations)

        return Progress(folder.progress(number, stage), skipped)

    def collect(self, envs: SituationsLike | None = None, progress_bar: bool = False, n_jobs: int = 1) -> Transitions:
        """Collects the random transitions that :meth:`meta_learn` learns from; arguments as there."""
        source = self.situation_envs(envs)
        n = self.hyperparameters.transitions_per_situation * len(source.sources)
        with tqdm(total=n, desc="Simulating", unit="step", mininterval=1.0, disable=not progress_bar) as bar:
            return self._simulate(source, 0, n_jobs, None, bar.update)

    def situation_envs(self, envs: SituationsLike | None = None) -> SituationEnvs:
        """Makes or takes one environment per training situation; arguments and errors as of :meth:`meta_learn`."""
        return situation_envs(self._require_env(), envs, self.hyperparameters.episode_length)

    def _simulate(
        self, envs: SituationEnvs, number: int, n_jobs: int, folder: Path | None, callback: Callable[[int], object]
    ) -> Transitions:
        """Collects random transitions in round 0, and the agent's own planning after that."""
        settings = self.hyperparameters
        make_policy: MakePolicy
        if number == 0:
            n, make_policy = settings.transitions_per_situation, make_held_uniform(settings.action_hold)
        else:
            n, make_policy = settings.round_transitions, self.planning_policy()
        seed, length = self._draw_seed(), settings.episode_length
        return collect(envs.sources, envs.situations, n, make_policy, seed, callback, n_jobs, folder, length)

    def planning_policy(self) -> MakePolicy:
        """Makes a policy that plans with what the agent has learnt so far, and knows which situation it is in."""
        model, reward_fn = deepcopy(self.model).cpu(), self._reward_fn
        if reward_fn is None and self.learned_reward is not None:
            learned, scale = (
                deepcopy(self.learned_reward).cpu(),
                ActionScale.of(self.action_space, torch.device("cpu")),
            )

            def reward_fn(obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
                return learned(obs, scale.to_unit(action), next_obs)  # type: ignore[no-any-return]

        names = reward_names(self.hyperparameters.planning_reward)
        return make_planning(model, self.hyperparameters.make_planner(), reward_fn, names)

    def _fingerprint(self, source: SituationEnvs | Transitions) -> dict[str, Any]:
        """What two runs must have in common for one to go on where the other stopped."""
        return {
            "agent": type(self).__name__,
            "env": self._env_spec,
            "dimensions": {name: list(dims) for name, dims in self.dims.items()},
            "needs_reward_fn": self._reward_fn is not None,
            "seed": self.seed,
            "situations": list(source.situations),
            "transitions": source.digest() if isinstance(source, Transitions) else None,
            "hyperparameters": self.hyperparameters.to_dict(),
        }

    def in_model_units(self, transitions: Transitions) -> Transitions:
        """Returns the same with actions in [-1, 1].

        Raises:
            ValueError: The observations or the actions are not of the agent's spaces.
        """
        if (
            transitions.obs.shape[-1:] != self.observation_space.shape
            or transitions.action.shape[-1:] != self.action_space.shape
        ):
            raise ValueError(
                f"The transitions have observations {transitions.obs.shape} and actions {transitions.action.shape}; "
                f"the agent's spaces are {self.observation_space.shape} and {self.action_space.shape}."
            )
        action = self._action_scale().to_unit(self._tensor(transitions.action))
        return replace(transitions, action=action.cpu().numpy())

    def _learn_reward(self, transitions: Transitions) -> None:
        if self._known_reward_fn() is None:
            self.learned_reward = self._new_reward()
            obs, action, next_obs = self._tensors(transitions.obs, transitions.action, transitions.next_obs)
            self.learned_reward.fit(obs, action, next_obs, self._tensor(transitions.reward), self.generator)

    def log_iteration(self, scalars: dict[str, float], interval: int, hooks: BaseCallback) -> bool:
        """Logs an iteration of the meta-training and returns whether the callbacks want to go on."""
        self.num_timesteps += 1
        for key, value in scalars.items():
            self.logger.record(key, value)
        if self.num_timesteps % interval == 0:
            self.logger.dump(self.num_timesteps)
        hooks.update_locals(locals())
        return hooks.on_step()

    def begin_model(self, transitions: Transitions, new: bool) -> tuple[Dynamics, Batch]:
        """Returns the model, be it a new one or the one so far, and the transitions as it sees them."""
        obs, action, next_obs = self._tensors(transitions.obs, transitions.action, transitions.next_obs)
        if new:
            self.dynamics = self.new_dynamics()
            self.dynamics.fit_normalisation(obs, action, next_obs)
        model = self.model
        return model, model.encode(obs, action, next_obs)
