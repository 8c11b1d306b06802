"""Learning in simulation: the part of every agent's face that is about Algorithm 1."""

from __future__ import annotations

import os
import warnings
from contextlib import closing
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import configure_logger
from stable_baselines3.common.vec_env import VecEnv
from tqdm.auto import tqdm
from typing_extensions import Self

from famle_agent.agents.check import Check, check_plans
from famle_agent.agents.keywords import SAFETY
from famle_agent.agents.meta_training import meta_train, planning_policy, simulate
from famle_agent.agents.stored_agent import StoredAgent
from famle_agent.data.description import first_env
from famle_agent.data.envs import SituationEnvs, SituationsLike, situation_envs
from famle_agent.data.identity import identity
from famle_agent.data.policies import MakeBatchPolicy
from famle_agent.data.transitions import Transitions, check_names
from famle_agent.monitoring.logs import close_when_let_go, console_for_bars
from famle_agent.monitoring.tensorboard import log_embeddings
from famle_agent.training.run_folder import RunFolder

__all__ = ["MetaLearningAgent"]


class MetaLearningAgent(StoredAgent):
    """An algorithm of Stable-Baselines3 that learns a model in simulation.

    Attributes:
        num_iterations: Iterations of learning in the last meta-training.
        last_check: What planning was worth in simulation when it ended; None where nobody looked.
    """

    num_iterations: int
    last_check: Check | None

    @torch.inference_mode(mode=False)
    def meta_learn(
        self,
        envs: SituationsLike | Transitions | None = None,
        callback: MaybeCallback = None,
        tb_log_name: str | None = None,
        progress_bar: bool = False,
        n_jobs: int = 1,
        folder: str | os.PathLike[str] | None = None,
        check: bool = True,
    ) -> Self:
        """Learns in simulation: collects transitions in every situation, then learns the model from them.

        With ``rounds`` in the settings it goes round: the agent plans with its model in every simulated situation, and
        learns on from all transitions. Callbacks are called once an iteration, which ``num_iterations`` counts;
        ``num_timesteps`` counts steps of the robot and stands still.

        Args:
            envs: One environment, factory or :class:`~famle_envs.Situation` per situation, in a list or in a mapping
                from what each is called; None takes the training situations that the agent's environment names. Or
                :class:`Transitions` that were collected before, which are then all that is learnt from.
                List the situation first that the robot is in until it shows otherwise.
            callback: Stable-Baselines3 callbacks, or a function.
            tb_log_name: Name of the run in TensorBoard; by default the class and ``_meta``.
            progress_bar: Whether to show progress bars; with ``verbose=1``, in the place of the tables of losses.
            n_jobs: Processes that simulate, -1 for one a core. The result does not depend on it. A policy is learnt in
                this process alone.
            folder: Where transitions are stored as they come, the model after each round, and once a minute how far
                a round has got. The same call goes on where one that was stopped had got to.
            check: Whether to let the agent plan in simulation in the end, to compare it with doing nothing and acting
                at random, and to warn where it is not better. What its errors are there, a diagnosis takes for usual.
                The result is in ``last_check``, in TensorBoard, and printed with ``verbose=1``.

        Returns:
            The agent.

        Raises:
            ValueError: There are no situations, or their names cannot be told apart; an environment's spaces differ
                from the agent's; or the folder is of a run with other settings.
        """
        source = envs if isinstance(envs, Transitions) else self.situation_envs(envs)
        check_names(source.situations)
        run = RunFolder(folder, {} if folder is None else self._fingerprint(source))  # which reads all transitions
        self._close_logger()
        if not self._custom_logger:
            name = tb_log_name or f"{type(self).__name__}_meta"
            self._logger = close_when_let_go(configure_logger(self.verbose, self.tensorboard_log, name))
        hooks = self._init_callback(callback)
        # The name that callbacks look for.
        total_timesteps = self.config.iterations(0 if isinstance(source, Transitions) else self.config.last_round)
        known, self.num_iterations = self.policy.world, 0
        self._online.forget()
        if folder is not None and self.seed is not None:
            self.generator.manual_seed(self.seed)  # the same call draws the same numbers, be it the first or not
        hooks.on_training_start(locals(), globals())
        try:
            with (
                console_for_bars(self.logger, progress_bar),
                closing(meta_train(self, source, run, n_jobs, progress_bar)) as training,
            ):
                for metrics in training:
                    for key, value in metrics.items():
                        self.logger.record(key, value)
                    self.logger.record("time/iterations", self.num_iterations, exclude="tensorboard")
                    if self.num_iterations % max(1, total_timesteps // 200) == 0:
                        self.logger.dump(self.num_iterations)
                    hooks.update_locals(locals())
                    if not hooks.on_step():
                        break
            if (model := self.model).n_situations > 1:
                log_embeddings(self.logger, model.embeddings[0], self.situations, self.num_iterations)
        except BaseException:
            self.policy.world = known  # a half-learnt model is none
            raise
        hooks.on_training_end()
        if isinstance(source, SituationEnvs) and check:
            self._check(source)
        return self

    def _check(self, envs: SituationEnvs) -> None:
        """Compares planning in simulation with knowing nothing, and warns where it is not better."""
        found = self.last_check = check_plans(self, envs, self.seed or 0)
        self.model.usual_error.fill_(float(np.median(found.errors).clip(min=1.0)))
        for name in ("planned", "nothing", "random"):
            self.logger.record(f"check/{name}", float(np.median(getattr(found, name))))
        self.logger.dump(self.num_iterations)
        if self.verbose:
            print(found)
        if not found.worth:
            warnings.warn(
                "In simulation, planning with what was learnt is no better than doing nothing or acting at random, so "
                "that it will not be on the robot either. Try more simulated steps (policy_steps), a reward_fn, fewer "
                f"or milder situations, or whether Stable-Baselines3's SAC learns the intact robot at all.\n{found}",
                stacklevel=4,
            )

    @torch.inference_mode(mode=False)
    def collect(self, envs: SituationsLike | None = None, progress_bar: bool = False, n_jobs: int = 1) -> Transitions:
        """Collects random transitions in every situation; arguments as of :meth:`meta_learn`.

        They are what that learns from, but where it learns a policy first (``policy_steps``).
        """
        source = self.situation_envs(envs)
        n = self.config.simulation.transitions_per_situation * len(source.sources)
        with tqdm(total=n, desc="Simulating", unit="step", mininterval=1.0, disable=not progress_bar) as bar:
            return simulate(self, source, 0, n_jobs, None, bar.update)

    def situation_envs(self, envs: SituationsLike | None = None) -> SituationEnvs:
        """Makes or takes one environment per training situation; arguments and errors as of :meth:`meta_learn`."""
        return situation_envs(self._require_env(), envs, self.config.simulation.episode_length)

    def planning_policy(self) -> MakeBatchPolicy:
        """Returns what makes policies that plan with what was meta-learned, and know which situations they are in."""
        return planning_policy(self.policy)

    def _fingerprint(self, source: SituationEnvs | Transitions) -> dict[str, Any]:
        """What two runs must have in common for one to go on where the other stopped."""
        return {
            "agent": type(self).__name__,
            "env": self._env_spec,
            "dimensions": {name: list(dims) for name, dims in self.dims.items()},
            "environment": None if self.env is None else identity(first_env(self.env)),
            "reward_fn": identity(self.policy.user_reward_fn),
            "termination_fn": identity(self.policy.user_termination_fn),
            "seed": self.seed,
            "sources": None if isinstance(source, Transitions) else identity(source.sources),
            "situations": list(source.situations),
            "transitions": source.digest() if isinstance(source, Transitions) else None,
            "hyperparameters": {name: value for name, value in self.config.to_dict().items() if name not in SAFETY},
        }

    def draw_seed(self) -> int:
        """Draws a seed from the agent's generator."""
        return int(torch.randint(2**31, (), generator=self.generator, device=self.device))

    def _require_env(self) -> VecEnv:
        if self.env is None:
            raise ValueError(
                f"The agent has no environment; call set_env(env) or {type(self).__name__}.load(path, env)."
            )
        return self.env

    def _close_logger(self) -> None:
        """Ends the logger of the last call, which another takes the place of: TensorBoard's has a thread."""
        if hasattr(self, "_logger") and not self._custom_logger:
            self._logger.close()
