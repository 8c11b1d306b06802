"""The face that all our agents share with Stable-Baselines3's algorithms."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from importlib.resources import as_file
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import check_for_correct_spaces, configure_logger
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from tqdm.auto import tqdm
from typing_extensions import Self

from famle_agent.adaptation.adapters import EmbeddingAdapter, GradientAdapter
from famle_agent.adaptation.belief import Belief
from famle_agent.adaptation.controller import Adapter, Controller, OnlineState
from famle_agent.adaptation.diagnosis import Diagnosis
from famle_agent.adaptation.perception import Perception, senses_of
from famle_agent.adaptation.senses import Senses
from famle_agent.agents.adaptation_log import AdaptationLog, log_belief
from famle_agent.agents.check import Check, check_plans
from famle_agent.agents.config import Config
from famle_agent.agents.held_out import Experience
from famle_agent.agents.keywords import SAFETY
from famle_agent.agents.logs import console_for_bars, log_episodes, log_time
from famle_agent.agents.meta_training import meta_train, planning_policy, simulate
from famle_agent.agents.policy import AdaptivePolicy
from famle_agent.agents.presets import make_env, robot_of
from famle_agent.agents.stored_agent import StoredAgent
from famle_agent.agents.tensorboard import log_embeddings
from famle_agent.agents.world_model import Interface
from famle_agent.data.action_scaling import to_action_space
from famle_agent.data.description import check_spaces, env_id, env_spec, first_env, special_dims
from famle_agent.data.envs import SituationEnvs, SituationsLike, situation_envs
from famle_agent.data.gate import check_action, reading, vec_readings, vec_step
from famle_agent.data.identity import identity
from famle_agent.data.objective import other_reward, planning_reward, planning_termination
from famle_agent.data.policies import MakePolicy, reward_names
from famle_agent.data.probe import check_reward_fn, check_termination_fn
from famle_agent.data.transitions import Transitions, check_names
from famle_agent.data.watch import VecWatch
from famle_agent.models.gradient_steps import prepare_torch
from famle_agent.models.reward import RewardFn, TerminationFn
from famle_agent.training.run_folder import RunFolder
from famle_agent.utils.chance import alone
from famle_agent.utils.deadline import Deadline
from famle_agent.utils.errors import SensorError

__all__ = ["ModelBasedAgent"]

Array = npt.NDArray[Any]


class ModelBasedAgent(StoredAgent):
    """An agent that learns a model in simulation, adapts it on the robot, and plans with it.

    Args:
        env: A robot's name (``"reacher"``), a Gymnasium id, an environment or a ``VecEnv`` with one robot each.
        mode: ``"ours"`` for the settings that we found to be best, ``"paper"`` for the paper's, ``"original"`` for
            those of the authors' public code, where there is some for the robot.
        reward_fn: r(s, a, s') for torch tensors (..., dim) -> (...), what the planner maximises. None takes the
            environment's ``planning_reward_fn`` or ``reward_fn``, and where it has neither the reward is learnt with
            the dynamics.
        termination_fn: Whether an episode ends in s', for torch tensors (..., obs_dim) -> (...), so that the planner
            knows. None takes the environment's ``termination_fn``, and where it has none the ends are learnt beside
            a policy (``policy_steps``), if there are any.
        angle_dims: Observation dimensions that are angles in rad. None takes the environment's ``angle_dims`` unless
            the settings say ``raw_angles``.
        quaternion_dims: The four observation dimensions of a unit quaternion, or none of them. None takes the
            environment's ``quaternion_dims``.
        pose_dims: x, y and heading of a robot on a floor, the heading as an angle or as its sine and its cosine: with
            them, the model knows that a robot moves alike wherever it stands and looks. None takes the environment's
            ``pose_dims`` where the settings are ``egocentric``.
        policy: Accepted by name, as Stable-Baselines3's algorithms have it: None or ``"MlpPolicy"``. The agent plans
            with what it learns, and has no other.
        stats_window_size: Episodes over which :meth:`learn` reports mean returns and successes.
        tensorboard_log: Folder for TensorBoard; None logs nothing there.
        monitor_wrapper: Whether to wrap a single environment in a ``Monitor``, which reports the returns of episodes.
        verbose: 0 for silence, 1 for information, 2 for debugging.
        device: ``"auto"``, ``"cpu"`` or ``"cuda"``.
        seed: Seed of everything; the same seed gives the same agent.
        pretrained: Whether to begin with the meta-learned model that the package ships, where it ships one for this
            environment and these settings (``"ant"``). :meth:`meta_learn` learns anew all the same.
        config: All settings, instead of those of a mode.
        **overrides: Settings to change, by the keywords of :class:`~famle_agent.agents.config.Config`.

    Attributes:
        policy: What the agent has learnt, and how it acts on it.
        num_timesteps: Steps that the agent has lived on robots.
        num_iterations: Iterations of learning in the last meta-training.
        overruns: How often planning took longer than ``step_budget_ms``.
        cut_short: How often the planner left out iterations, so that it would not.
        newest: The last step that :meth:`learn` or :meth:`observe` learnt from, and what became of it.
        last_check: What planning was worth in simulation when it ended; None where nobody looked.

    Raises:
        TypeError: An override is no setting.
        ValueError: The environment is unknown or its spaces are not supported; the policy is another; a setting is out
            of range, or has no effect beside the others.
    """

    implied: ClassVar[Mapping[str, Any]] = {}
    """Settings that the kind of agent implies, in every mode."""

    adapter_class: ClassVar[type[EmbeddingAdapter | GradientAdapter]]
    """What adapts its model; a gradient adapter has no use for more than one embedding."""

    last_check: Check | None

    @torch.inference_mode(mode=False)
    def __init__(
        self,
        env: GymEnv | str | None,
        mode: str = "ours",
        *,
        reward_fn: RewardFn | None = None,
        termination_fn: TerminationFn | None = None,
        angle_dims: Sequence[int] | None = None,
        quaternion_dims: Sequence[int] | None = None,
        pose_dims: Sequence[int] | None = None,
        policy: str | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        monitor_wrapper: bool = True,
        verbose: int = 0,
        device: torch.device | str = "auto",
        seed: int | None = None,
        pretrained: bool = True,
        config: Config | None = None,
        **overrides: Any,
    ) -> None:
        _check_policy(env, policy)
        if env is not None:
            env = make_env(env)
            check_spaces(env.observation_space, env.action_space)
        super().__init__(
            policy=BasePolicy,
            env=env,
            learning_rate=0.0,  # the settings have rates of their own
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            monitor_wrapper=monitor_wrapper,
            verbose=verbose,
            device=device,
            support_multi_env=True,
            seed=seed,
        )
        self._monitor_wrapper = monitor_wrapper
        self.mode, self._env_spec = mode, None if self.env is None else _description(self.env)
        robot = robot_of(None if self.env is None else env_id(self.env))
        if config is None:
            config = robot.config(mode, self._preset(overrides), self._implied(overrides), **overrides)
        elif overrides:
            config = config.changed(**overrides)
        self.policy = AdaptivePolicy(config, self.adapter_class, self.device, reward_fn, termination_fn)
        self.generator = torch.Generator(self.device)
        if self.env is not None:
            given = {"angle_dims": angle_dims, "quaternion_dims": quaternion_dims, "pose_dims": pose_dims}
            dims = special_dims(self.env, given, config.model.egocentric, config.model.raw_angles)
            self.policy.robot = Interface(self.observation_space, self.action_space, dims)
            self._take_reward(self.env)
            _ = self.policy.idle_action  # refuses a safe action that is none
        elif reward_fn is not None and not callable(reward_fn):
            raise ValueError(f"reward_fn must be a function, got {reward_fn!r}.")
        self._setup_model()
        if pretrained and robot.pretrained is not None:
            with as_file(robot.pretrained) as file:
                self.policy.not_taken = self.take_model(file)
            if mode == "ours" and self.policy.not_taken and "kind of agent" not in self.policy.not_taken:
                warnings.warn(
                    f"The model that is shipped for this robot is not taken: it has another "
                    f"{', '.join(self.policy.not_taken)}. meta_learn() learns one; pretrained=False asks for none.",
                    stacklevel=3,
                )

    def _preset(self, overrides: Mapping[str, Any]) -> str:
        """Under which name ``hyperparams/`` has settings that were tuned for this kind of agent; empty for FAMLE."""
        return ""

    def _implied(self, overrides: Mapping[str, Any]) -> Mapping[str, Any]:
        """The settings that this kind of agent implies.

        Raises:
            ValueError: One of them is overridden by another value.
        """
        for name, value in self.implied.items():
            if overrides.get(name, value) != value:
                raise ValueError(f"{name} is {value!r} in every {type(self).__name__}; leave it out.")
        return self.implied

    def _setup_model(self) -> None:
        self.policy.world = self._live = None
        self.num_iterations, self.last_check = 0, None
        self._served: object = None
        self._told: tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None = None  # what observe() was last told
        self._refused: OnlineState | None = None  # the state whose last observation was refused
        self._senses: Senses | None = None  # of the robots of whom learn(), observe() and locate() were told last
        self._calls = 0  # of the environment's steps and resets when learn() last ended
        self._plan_ms: float | None = None  # what the plan of the step that is under way took
        self.newest: Experience | None = None
        self._warned_of_divergence = self._warned_of_sensors = False
        self.overruns = self.cut_short = 0
        self.generator.seed()
        self.set_random_seed(self.seed)
        if self.config.adaptation.gradient is not None:
            prepare_torch()

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seeds the environment, the meta-learning and the planner; None changes nothing."""
        if seed is None:
            return
        with alone():
            super().set_random_seed(seed)
        self.seed = self.policy.seed = seed
        self.generator.manual_seed(seed)

    @torch.inference_mode(mode=False)
    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Gives the agent another environment with the same spaces and any number of robots.

        Raises:
            ValueError: The spaces differ, or the environment normalises observations.
        """
        wrapped = self._wrap_env(make_env(env), self.verbose, self._monitor_wrapper)
        check_for_correct_spaces(wrapped, self.observation_space, self.action_space)
        self._env_spec = _description(wrapped)
        self._take_reward(wrapped)
        self.n_envs = wrapped.num_envs
        super().set_env(wrapped, force_reset)
        self._calls = VecWatch(wrapped).calls

    def _take_reward(self, env: VecEnv) -> None:
        """Looks for what to maximise in an environment, and for where it ends, unless the user has said it."""
        if self.policy.user_reward_fn is None:
            reward_fn, doubtful = planning_reward(env, self.config.planning_reward)
            self.policy.env_reward_fn, self.policy.doubts_reward_fn = reward_fn, doubtful
        if self.policy.user_termination_fn is None:
            self.policy.env_termination_fn = planning_termination(env)
        if (reward_fn := self.policy.user_reward_fn or self.policy.env_reward_fn) is not None:
            check_reward_fn(reward_fn, self.observation_space, self.action_space, self.device)
        if (termination_fn := self.policy.known_termination_fn) is not None:
            check_termination_fn(termination_fn, self.observation_space, self.device)

    def _require_env(self) -> VecEnv:
        if self.env is None:
            raise ValueError(
                f"The agent has no environment; call set_env(env) or {type(self).__name__}.load(path, env)."
            )
        return self.env

    def draw_seed(self) -> int:
        """Draws a seed from the agent's generator."""
        return int(torch.randint(2**31, (), generator=self.generator, device=self.device))

    # --- what it has learnt -----------------------------------------------------------------------------

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
        """The same on robots whose sensors may fail."""
        return self.policy.perception

    # --- learning in simulation -------------------------------------------------------------------------

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
            self._logger = configure_logger(self.verbose, self.tensorboard_log, name)
        hooks = self._init_callback(callback)
        # The name that callbacks look for.
        total_timesteps = self.config.iterations(0 if isinstance(source, Transitions) else self.config.last_round)
        known, self.num_iterations = self.policy.world, 0
        self.forget()
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

    def planning_policy(self) -> MakePolicy:
        """Makes a policy that plans with what the agent has meta-learned, and knows which situation it is in."""
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

    # --- living on a robot ------------------------------------------------------------------------------

    @torch.inference_mode(mode=False)
    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 1,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Lives on the robot (the agent's environment), adapting all the time: Algorithm 2 for some steps.

        Meta-learns first where that has not been done. What was learnt stays: :meth:`predict` without a state
        goes on from there, until :meth:`forget`, for as many observations as there are robots. What each of several
        robots has is its own: a single observation is then of a robot of which nothing is known. To callbacks each step
        is a rollout, as with an off-policy algorithm that learns at every step.

        An observation that cannot be a measurement is not learnt from, and the agent plans from where its model says
        that the robot is; see :class:`~famle_agent.adaptation.perception.Safety`. TensorBoard counts these under
        ``health``.

        Args:
            total_timesteps: Steps of the robot, all robots of a ``VecEnv`` counted.
            callback: Stable-Baselines3 callbacks, or a function.
            log_interval: Episodes between two logs; None logs when a callback asks for it (:meth:`dump_logs`).
            tb_log_name: Name of the run in TensorBoard; by default the class.
            reset_num_timesteps: Whether to count from 0 and to reset the environment.
            progress_bar: Whether to show a progress bar.

        Raises:
            SensorError: No robot has had an observation that can be a measurement for too long.
            ValueError: The agent has no environment, or ``log_interval`` is not positive.
        """
        if log_interval is not None and log_interval < 1:
            raise ValueError(f"log_interval must be a number of episodes, or None for no logs; got {log_interval}.")
        env = self._require_env()
        if self.policy.world is None:
            self.meta_learn(progress_bar=progress_bar)
        if VecWatch(env).calls != self._calls:  # somebody else has moved the robots since the last learn()
            self._last_obs = None
        self._close_logger()
        total_timesteps, hooks = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name or type(self).__name__, progress_bar
        )
        hooks.on_training_start(locals(), globals())
        perception, state, watch = self.perception, self.state_of(env.num_envs), VecWatch(env)
        self._told = None
        self._calls = watch.calls
        logger = Logger(None, []) if log_interval is None else self.logger
        with closing(AdaptationLog(self, logger, self.num_timesteps)) as log:
            while self.num_timesteps < total_timesteps:
                hooks.on_rollout_start()
                if watch.calls != self._calls:  # a callback has moved the robots
                    self._last_obs, self._last_episode_starts = env.reset(), np.ones(env.num_envs, dtype=bool)  # type: ignore[assignment]
                starts = torch.as_tensor(self._last_episode_starts, dtype=torch.bool, device=self.device)
                readings = self.policy.builder.tensor(vec_readings(self._last_obs, env))
                self._last_obs, resets = None, watch.resets()  # the next learn() resets, should this step fail
                state = perception.begin(state, readings, starts)
                action, state = self._act(perception, state, starts, self.generator, self._deadline())
                try:
                    step = vec_step(env, to_action_space(action, self.action_space))
                except BaseException:
                    self._senses = senses_of(state).dropping(torch.ones_like(starts))
                    raise
                self.num_timesteps, self._calls = self.num_timesteps + env.num_envs, watch.calls
                # By names that callbacks know.
                new_obs, rewards, dones, infos = step.obs, step.rewards, step.dones, step.infos
                reset_alone = watch.resets() - resets != dones if len(resets) else np.zeros_like(dones)
                lost = torch.as_tensor(reset_alone | ~step.known, device=self.device)
                state, transitions = perception.sense(state, self.policy.builder.tensor(step.reached), ~lost)
                state = replace(state, senses=senses_of(state).dropping(lost))
                state = self._live = self._observed(self._learnt_from(perception, state, transitions))
                self._senses = state.senses
                self._last_obs, self._last_episode_starts = new_obs, dones | reset_alone
                self._update_info_buffer(infos, dones)
                log.step(self.newest, rewards, dones)
                hooks.update_locals(locals())
                if not hooks.on_step():
                    break
                hooks.on_rollout_end()
                self._count_episodes(int(dones.sum()), log_interval)
        hooks.on_training_end()
        return self

    def _close_logger(self) -> None:
        """Ends the logger of the last call, which another takes the place of: TensorBoard's has a thread."""
        if hasattr(self, "_logger") and not self._custom_logger:
            self._logger.close()

    def _count_episodes(self, ended: int, log_interval: int | None) -> None:
        known, self._episode_num = self._episode_num, self._episode_num + ended
        if log_interval is not None and self._episode_num // log_interval > known // log_interval:
            self.dump_logs()

    def dump_logs(self) -> None:
        """Writes to the logger what :meth:`learn` knows now; Stable-Baselines3's ``LogEveryNTimesteps`` calls it.

        Raises:
            ValueError: Nothing was learnt yet, so that there is no logger.
        """
        if not hasattr(self, "_logger"):
            raise ValueError("The agent has no logger yet; call learn() or set_logger() first.")
        log_episodes(self.logger, self.ep_info_buffer or (), self.ep_success_buffer or ())
        if self._live is not None:
            log_belief(self, self.logger, self._live)
        since_start = self.num_timesteps - self._num_timesteps_at_start
        log_time(self.logger, self.num_timesteps, since_start, self._episode_num, self.start_time)
        self.logger.dump(self.num_timesteps)

    @torch.inference_mode(mode=False)
    def predict(  # type: ignore[override]
        self,
        observation: Array | dict[str, Array],
        state: OnlineState | None = None,
        episode_start: npt.NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[Array, OnlineState]:
        """Plans an action; with a ``state``, adapts as well.

        The state carries the memory and the adapted model, as a recurrent policy's carries its hidden state. Pass
        back what the last call returned, and every K steps the model is adapted to the last M transitions. Without
        a state, the agent acts on what it believes now: what :class:`FAMLEWrapper` or :meth:`learn` have taught it
        about this robot, or what it meta-learned. What it believes of several robots is of each of them: it acts on
        that where as many observations are given, and on what it meta-learned where there is another number.

        A step that :meth:`observe` was told of is not counted again: the state that is returned then believes what the
        agent believes. So a ``FAMLEWrapper`` and a loop that passes the state back (``evaluate_policy``) adapt once.

        Args:
            observation: (obs_dim,) for one robot or (B, obs_dim) for B; None where none came. What cannot be a
                measurement, such as NaN, is not learnt from: with a state, the agent plans from where its model says
                that the robot is, see :class:`~famle_agent.adaptation.perception.Safety`. So it does without one where
                :meth:`observe` was told of that observation.
            state: What the last call returned, or None.
            episode_start: Whether each robot has just been reset, (B,). The transition across it is dropped. After a
                step of Gymnasium's vector environments these are the robots whose episode has ended in that step; with
                ``AutoresetMode.NEXT_STEP``, their default, those whose episode has ended in the step before.
            deterministic: Whether the planner draws the same candidates at each call, so that equal observations and
                states give equal actions. Without a state, an agent that has lived on a robot goes on from the plan of
                its last call.

        Returns:
            The actions, (action_dim,) or (B, action_dim), and the new state.

        Raises:
            NotLearnedError: The agent has no model yet.
            SensorError: No robot has had an observation that can be a measurement for too long.
            ValueError: The observation has the wrong shape, or is of no numbers.
        """
        perception, deadline = self.perception, self._deadline()
        try:
            numbers = reading(observation, self.observation_space)
        except ValueError:
            self._refused = state  # whose next observation is not one step behind its last one
            raise
        was_refused = state is not None and state is self._refused
        readings = self.policy.builder.tensor(np.atleast_2d(numbers))
        starts = torch.zeros(len(readings), dtype=torch.bool, device=self.device)
        if episode_start is not None:
            starts = torch.tensor(np.atleast_1d(episode_start), dtype=torch.bool, device=self.device)
        if len(starts) != len(readings) or (state is not None and state.robots != len(readings)):
            raise ValueError(
                f"Got {len(readings)} observations, but {len(starts)} values of episode_start and a state of "
                f"{len(readings) if state is None else state.robots} robots; they must be of the same robots."
            )
        generator = self.generator
        if deterministic:
            generator = torch.Generator(self.device).manual_seed(self.seed or 0)
        given = state
        if state is not None and was_refused:
            state = replace(state, last=None)
        state = self.state_of(len(readings)) if state is None else self._caught_up(perception, state, readings, starts)
        state = perception.begin(state, readings, starts | was_refused)
        try:
            action, state = self._act(perception, state, starts, generator, deadline)
        except SensorError:
            self._refused = given
            raise
        if given is None and self._live is not None and self._live.robots == len(readings):
            self._live = replace(self._live, plan=state.plan)  # a loop that drops the state keeps its plan
        self._observed(state)
        actions = to_action_space(action, self.action_space)
        return (actions[0] if numbers.ndim == 1 else actions), state

    def _act(
        self,
        perception: Perception,
        state: OnlineState,
        starts: torch.Tensor,
        generator: torch.Generator,
        deadline: Deadline | None,
    ) -> tuple[torch.Tensor, OnlineState]:
        """Plans by a deadline, and counts what was late."""
        start = time.perf_counter()
        planned = perception.act(state, starts, generator, deadline)
        self._plan_ms = 1e3 * (time.perf_counter() - start)
        if deadline is not None:
            self.overruns += deadline.passed
            self.cut_short += deadline.cut_short
        return planned

    def _learnt_from(self, perception: Perception, state: OnlineState, transitions: torch.Tensor) -> OnlineState:
        """Learns from a step that ends here, and notes what became of it."""
        start, self.newest = time.perf_counter(), None  # whose memory would be a third one
        after = perception.observe(state, transitions)
        self.newest = Experience(state, after, transitions, self._plan_ms, 1e3 * (time.perf_counter() - start))
        self._plan_ms = None
        return after

    def _deadline(self) -> Deadline | None:
        budget = self.config.safety.step_budget_ms
        return None if budget is None else Deadline(budget, self.device)

    def _caught_up(
        self, perception: Perception, state: OnlineState, readings: torch.Tensor, starts: torch.Tensor
    ) -> OnlineState:
        """Adds the step that ends here to a state, unless :meth:`observe` was told of it."""
        if state.last is None:
            return state
        sensed, transitions = perception.sense(state, readings, ~starts)
        if self._live is None or self._told is None or len(self._told[0]) != len(readings):
            return perception.observe(sensed, transitions)
        (s, a, s_next), (last_s, last_a) = self._told, state.last
        same_step = torch.equal(s, last_s) and torch.allclose(a, last_a, atol=1e-5)
        if not (same_step and torch.equal(s_next[~starts], senses_of(sensed).obs[~starts])):
            return perception.observe(sensed, transitions)
        return replace(self._live, plan=state.plan, last=None, senses=self._senses)

    @torch.inference_mode(mode=False)
    def observe(self, obs: Array | None, action: Array, next_obs: Array | None) -> None:
        """Tells the agent of a transition of its robot; every K transitions it adapts.

        A transition with an observation that cannot be a measurement, such as NaN, is counted and not learnt from.

        Args:
            obs: (obs_dim,) or (B, obs_dim); None where none came.
            action: (action_dim,) or (B, action_dim); clipped to the action space, as a robot clips it.
            next_obs: As ``obs``.

        Raises:
            NotLearnedError: The agent has no model yet.
            ValueError: A shape is wrong, or the action is not finite.
        """
        perception, space = self.perception, self.observation_space
        s, s_next = (self.policy.builder.tensor(np.atleast_2d(reading(o, space))) for o in (obs, next_obs))
        a = self.policy.builder.tensor(np.atleast_2d(check_action(action, self.action_space)))
        if not len(s) == len(a) == len(s_next):
            raise ValueError(f"Got {len(s)} observations, {len(a)} actions and {len(s_next)} next observations.")
        a = self.policy.builder.action_scale.to_unit(a).clamp(-1.0, 1.0)
        everyone = torch.ones(len(s), dtype=torch.bool, device=self.device)
        state = perception.begin(self.state_of(len(s)), s, ~everyone)
        s = senses_of(state).obs
        state, transitions = perception.sense(replace(state, last=(s, a)), s_next, everyone)
        self._told = s, a, senses_of(state).obs
        self._live = self._observed(self._learnt_from(perception, state, transitions))
        self._senses = self._live.senses

    @torch.inference_mode(mode=False)
    def locate(self, obs: Array | None, dropped: bool = False) -> None:
        """Tells the agent where its robot is, where nobody knows how it got there.

        Args:
            obs: (obs_dim,) or (B, obs_dim); None where none came.
            dropped: Whether to count a step of the robot that was no transition, such as one that failed.

        Raises:
            NotLearnedError: The agent has no model yet.
            ValueError: The shape is wrong.
        """
        readings = self.policy.builder.tensor(np.atleast_2d(reading(obs, self.observation_space)))
        everyone = torch.ones(len(readings), dtype=torch.bool, device=self.device)
        state = self.perception.begin(self.state_of(len(readings)), readings, everyone)
        self._senses = senses_of(state).dropping(everyone & dropped)

    @torch.inference_mode(mode=False)
    def begin_episode(self) -> None:
        """Tells the agent that its robot was reset: its plan is void, its memory stays."""
        if self._live is not None:
            starts = torch.ones(self._live.robots, dtype=torch.bool, device=self.device)
            self._live = self._observed(self.controller.reset(self._live, starts))

    def forget(self) -> None:
        """Returns to what was meta-learned, as for a robot that was just repaired; counts of sensors begin at 0."""
        self._live = self._senses = self.newest = None

    def serve(self, wrapper: object, takes_over: bool = True) -> None:
        """Notes whose robot the agent is on.

        Raises:
            RuntimeError: The agent serves another wrapper, and this one does not take over.
        """
        if takes_over:
            self._served = wrapper
        elif self._served is not wrapper:
            raise RuntimeError(
                "The agent has been taken over by another FAMLEWrapper. Call reset() to take it back, or give each "
                "robot an agent of its own: FAMLE.load(path)."
            )

    def check_task(self, env: gym.Env[Any, Any]) -> None:
        """Refuses a robot with another task than the agent plans for.

        Raises:
            ValueError: The robot's reward differs from that of the agent's environment.
        """
        known, names = self.policy.known_reward_fn, reward_names(self.config.planning_reward)
        if known is None or known is self.policy.user_reward_fn:
            return
        own = other_reward(env, known, names, self.observation_space, self.action_space)
        if own is not None:
            raise ValueError(
                f"The agent plans for the {own} of its own environment, which gives other rewards than that of the "
                "environment to be wrapped, because of its goal or of a wrapper: call agent.set_env(env) first, or "
                "give the agent a reward_fn."
            )

    @property
    def belief(self) -> Belief:
        """What the agent believes of its robots now; of one robot where it has seen none."""
        return (self._live or self.state_of(self.model.robots)).belief

    @torch.inference_mode(mode=False)
    def posterior(self, state: OnlineState | None = None, robot: int = 0) -> dict[str, float]:
        """Says how likely each situation is by name, P(situation | memory).

        Where faults are composed, ``"a + b"`` is the situation with both. An agent without embeddings has one model
        for ``"every situation"``.

        Args:
            state: As :meth:`predict` returns it; None asks what the agent believes now.
            robot: Which of the robots that run side by side.

        Raises:
            IndexError: There is no such robot.
            NotLearnedError: The agent has no model yet.
        """
        return self.adapter.posterior(self._state_for(state, robot).belief.of(robot), self.situations)

    @torch.inference_mode(mode=False)
    def marginals(self, state: OnlineState | None = None, robot: int = 0) -> dict[str, float]:
        """As :meth:`posterior`, but of each training situation, be it alone or a part of what is wrong."""
        return self.adapter.marginals(self._state_for(state, robot).belief.of(robot), self.situations)

    def diagnose(self, state: OnlineState | None = None, robot: int = 0) -> Diagnosis:
        """Says in words what is most likely wrong with a robot, and how sure that is: ``print(agent.diagnose())``.

        Arguments and errors as of :meth:`posterior`.
        """
        state = self._state_for(state, robot)
        error, steps = state.belief.errors[robot] / self.model.usual_error, int(state.memory.weight[robot].sum())
        return Diagnosis.of(self.posterior(state, robot), float(error), steps)

    def health(self, state: OnlineState | None = None, robot: int = 0) -> dict[str, int]:
        """Counts what was missing or late on a robot, as ``info["famle"]`` and TensorBoard do.

        Args:
            state: As :meth:`predict` returns it; None asks for what the agent has been told last.
            robot: Which of the robots that run side by side.

        Returns:
            ``quarantined``, transitions that were not learnt from, since an observation could not be a measurement;
            ``blind``, observations since the last one that could; ``dropped``, steps that were no transition for
            another reason; ``repeated``, observations that were those of the step before to the last bit. Of all robots
            together, ``overruns``, how often planning took longer than ``step_budget_ms``, and ``cut_short``, how often
            it left out iterations.

        Raises:
            IndexError: There is no such robot.
        """
        senses = self._senses if state is None else state.senses
        if senses is None:
            senses = senses_of(self._state_for(state, robot))
        if not 0 <= robot < senses.robots:
            raise IndexError(f"There are robots 0 to {senses.robots - 1}, not {robot}.")
        counts = {name: int(count[robot]) for name, count in senses.counts.items()}
        return {**counts, "overruns": self.overruns, "cut_short": self.cut_short}

    def _state_for(self, state: OnlineState | None, robot: int) -> OnlineState:
        state = state or self._live or self.state_of(self.model.robots)
        if not 0 <= robot < state.robots:
            raise IndexError(f"There are robots 0 to {state.robots - 1}, not {robot}.")
        return state

    def _observed(self, state: OnlineState) -> OnlineState:
        """Passes a state on, and warns of the first adaptation that diverged and of the first sensor that failed."""
        senses = state.senses
        if not self._warned_of_sensors and senses is not None and not senses.measured.all():
            self._warned_of_sensors = True
            robots = (~senses.measured).nonzero()[:, 0].tolist()
            warnings.warn(
                f"An observation of robot {', '.join(map(str, robots))} cannot be a measurement: "
                f"{senses.reading[robots[0]].tolist()}. It is not learnt from, and plans begin where the model "
                'says that the robot is. info["famle"] and TensorBoard count these from here on.',
                stacklevel=4,
            )
        if not self._warned_of_divergence and state.belief.diverged.any():
            self._warned_of_divergence = True
            warnings.warn(
                f"Adaptation {state.belief.adaptations} diverged: its gradient steps left the finite numbers and were "
                "taken back. Take smaller rates (adapt_lr, adapt_embedding_lr), or meta-learn on data that reach where "
                'the robot is (action_hold, episode_length, rounds). info["famle"]["diverged"] and adapt/diverged '
                "count them from here on.",
                stacklevel=4,
            )
        return state

    @torch.inference_mode(mode=False)
    def state_of(self, robots: int) -> OnlineState:
        """Returns what the agent believes now where that fits the number of robots, else what it meta-learned.

        Args:
            robots: B.

        Raises:
            NotLearnedError: The agent has no model yet.
        """
        senses = self._senses if self._senses is not None and self._senses.robots == robots else None
        if self._live is not None and self._live.robots == robots:
            return replace(self._live, last=None, senses=senses)
        return replace(self.policy.initial(robots), senses=senses)


def _check_policy(env: object, policy: object) -> None:
    """Refuses a policy that the agent does not have.

    Raises:
        ValueError: It is another than an MLP, or it is given where the environment belongs.
    """
    if isinstance(env, str) and env.endswith("Policy"):
        raise ValueError(f"The environment comes first, and a policy may follow by name: (env, policy={env!r}).")
    if policy not in (None, "MlpPolicy"):
        raise ValueError(f"policy must be 'MlpPolicy' or None, got {policy!r}: the agent plans, and learns no other.")


def _description(env: VecEnv) -> dict[str, Any] | None:
    """What an environment is called, and its arguments.

    Raises:
        ValueError: It normalises observations.
    """
    if (normalised := unwrap_vec_normalize(env)) is not None and normalised.norm_obs:
        raise ValueError(
            "The model normalises observations by itself: give VecNormalize(env, norm_obs=False), or the environment "
            "without VecNormalize."
        )
    return env_spec(env)
