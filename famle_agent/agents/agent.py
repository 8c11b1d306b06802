"""The face that all our agents share with Stable-Baselines3's algorithms: the part for the robot (Algorithm 2).

``learn`` runs the loop; ``predict`` and ``observe`` leave it to somebody else. All three hand arrays over to
:class:`~famle_agent.agents.online_adaptation.OnlineAdaptation` as tensors.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from contextlib import closing
from importlib.resources import as_file
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from typing_extensions import Self

from famle_agent.adaptation.adapters import EmbeddingAdapter, GradientAdapter
from famle_agent.adaptation.belief import Belief
from famle_agent.adaptation.diagnosis import Diagnosis
from famle_agent.adaptation.experience import Experience
from famle_agent.adaptation.state import OnlineState
from famle_agent.agents.config import Config
from famle_agent.agents.meta_learning_agent import MetaLearningAgent
from famle_agent.agents.online_adaptation import OnlineAdaptation
from famle_agent.agents.policy import AdaptivePolicy
from famle_agent.agents.presets import Robot, make_env, robot_of
from famle_agent.agents.world_model import Interface
from famle_agent.data.action_scaling import to_action_space
from famle_agent.data.description import check_spaces, env_id, env_spec, special_dims
from famle_agent.data.gate import check_action, reading, vec_readings
from famle_agent.data.watch import VecWatch
from famle_agent.models.gradient_steps import prepare_torch
from famle_agent.models.reward import RewardFn, TerminationFn
from famle_agent.monitoring.adaptation_log import AdaptationLog, log_belief
from famle_agent.monitoring.logs import close_when_let_go, log_episodes, log_time
from famle_agent.utils.chance import alone

__all__ = ["ModelBasedAgent"]

Array = npt.NDArray[Any]


class ModelBasedAgent(MetaLearningAgent):
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

    Raises:
        TypeError: An override is no setting.
        ValueError: The environment is unknown or its spaces are not supported; the policy is another; a setting is out
            of range, or has no effect beside the others.
    """

    implied: ClassVar[Mapping[str, Any]] = {}
    """Settings that the kind of agent implies, in every mode."""

    adapter_class: ClassVar[type[EmbeddingAdapter | GradientAdapter]]
    """What adapts its model; a gradient adapter has no use for more than one embedding."""

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
            self.policy.take_task(self.env)
            _ = self.policy.idle_action  # refuses a safe action that is none
        elif reward_fn is not None and not callable(reward_fn):
            raise ValueError(f"reward_fn must be a function, got {reward_fn!r}.")
        self._setup_model()
        if pretrained:
            self._take_shipped(robot)

    def _take_shipped(self, robot: Robot) -> None:
        """Takes the model that is shipped for a robot, and warns where it does not fit but a user may expect that."""
        if robot.pretrained is None:
            return
        with as_file(robot.pretrained) as file:
            differing = self.policy.not_taken = self.take_model(file)
        if self.mode == "ours" and differing and "kind of agent" not in differing:
            warnings.warn(
                f"The model that is shipped for this robot is not taken: it has another {', '.join(differing)}. "
                "meta_learn() learns one; pretrained=False asks for none.",
                stacklevel=4,
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
        self.policy.world, self._online = None, OnlineAdaptation(self.policy)
        self.num_iterations, self.last_check = 0, None
        self._wrapper: object = None  # whose robot the agent is on
        self._calls = 0  # of the environment's steps and resets when learn() last ended
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
        self.policy.take_task(wrapped)
        self.n_envs = wrapped.num_envs
        super().set_env(wrapped, force_reset)
        self._calls = VecWatch(wrapped).calls

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
        if not self._custom_logger:
            close_when_let_go(self.logger)
        hooks.on_training_start(locals(), globals())
        online, watch = self._online, VecWatch(env)
        state, self._calls = online.state_of(env.num_envs), watch.calls
        logger = Logger(None, []) if log_interval is None else self.logger
        with closing(AdaptationLog(self, logger, self.num_timesteps)) as log:
            while self.num_timesteps < total_timesteps:
                hooks.on_rollout_start()
                if watch.calls != self._calls:  # a callback has moved the robots
                    self._last_obs, self._last_episode_starts = env.reset(), np.ones(env.num_envs, dtype=bool)  # type: ignore[assignment]
                starts = self._flags(self._last_episode_starts)
                readings = self._tensor(vec_readings(self._last_obs, env))
                self._last_obs = None  # the next learn() resets, should this step fail
                action, state = online.act(state, readings, starts, self.generator)  # line 4
                try:
                    step, reset_alone = watch.step(to_action_space(action, self.action_space))
                except BaseException:
                    online.drop(state)
                    raise
                self.num_timesteps, self._calls = self.num_timesteps + env.num_envs, watch.calls
                moved = self._flags(step.known & ~reset_alone)
                state = online.learn(state, self._tensor(step.reached), moved)  # lines 5, 6, then 2 and 3
                # By names that callbacks know.
                new_obs, rewards, dones, infos = step.obs, step.rewards, step.dones, step.infos
                self._last_obs, self._last_episode_starts = new_obs, dones | reset_alone
                self._update_info_buffer(infos, dones)
                log.step(online.newest, rewards, dones)
                hooks.update_locals(locals())
                if not hooks.on_step():
                    break
                hooks.on_rollout_end()
                self._count_episodes(int(dones.sum()), log_interval)
        hooks.on_training_end()
        return self

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
        if (state := self._online.state) is not None:
            log_belief(self, self.logger, state)
        since_start = self.num_timesteps - self._num_timesteps_at_start
        log_time(self.logger, self.num_timesteps, since_start, self._episode_num, self.start_time)
        self.logger.dump(self.num_timesteps)

    @torch.inference_mode(mode=False)
    def predict(  # type: ignore[override]
        self,
        observation: Array | None,
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
        _ = self.model  # refuses to act on nothing, whatever the observation is
        try:
            numbers = reading(observation, self.observation_space)
        except ValueError:
            self._online.refuse(state)
            raise
        readings = self._tensor(np.atleast_2d(numbers))
        starts = self._flags(np.zeros(len(readings)) if episode_start is None else episode_start)
        if len(starts) != len(readings) or (state is not None and state.robots != len(readings)):
            raise ValueError(
                f"Got {len(readings)} observations, but {len(starts)} values of episode_start and a state of "
                f"{len(readings) if state is None else state.robots} robots; they must be of the same robots."
            )
        generator = torch.Generator(self.device).manual_seed(self.seed or 0) if deterministic else self.generator
        action, state = self._online.predict(state, readings, starts, generator)
        actions = to_action_space(action, self.action_space)
        return (actions[0] if numbers.ndim == 1 else actions), state

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
        _ = self.model  # refuses to learn with nothing, whatever the transition is
        s, s_next = self._readings(obs), self._readings(next_obs)
        a = self._tensor(np.atleast_2d(check_action(action, self.action_space)))
        if not len(s) == len(a) == len(s_next):
            raise ValueError(f"Got {len(s)} observations, {len(a)} actions and {len(s_next)} next observations.")
        a = self.policy.builder.action_scale.to_unit(a).clamp(-1.0, 1.0)
        self._online.observe(s, a, s_next)

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
        self._online.locate(self._readings(obs), dropped)

    @torch.inference_mode(mode=False)
    def begin_episode(self) -> None:
        """Tells the agent that its robot was reset: its plan is void, its memory stays."""
        self._online.begin_episode()

    def forget(self) -> None:
        """Returns to what was meta-learned, as for a robot that was just repaired; counts of sensors begin at 0."""
        self._online.forget()

    def serve(self, wrapper: object, takes_over: bool = True) -> None:
        """Notes whose robot the agent is on.

        Raises:
            RuntimeError: The agent serves another wrapper, and this one does not take over.
        """
        if takes_over:
            self._wrapper = wrapper
        elif self._wrapper is not wrapper:
            raise RuntimeError(
                "The agent has been taken over by another FAMLEWrapper. Call reset() to take it back, or give each "
                "robot an agent of its own: FAMLE.load(path)."
            )

    def check_task(self, env: gym.Env[Any, Any]) -> None:
        """Refuses a robot with another task than the agent plans for.

        Raises:
            ValueError: The robot's reward differs from that of the agent's environment.
        """
        self.policy.check_task(env)

    @property
    def belief(self) -> Belief:
        """What the agent believes of its robots now; of one robot where it has seen none."""
        return self._online.state_for(None, robot=0).belief

    @property
    def newest(self) -> Experience | None:
        """The last step that :meth:`learn` or :meth:`observe` learnt from, and what became of it."""
        return self._online.newest

    @property
    def overruns(self) -> int:
        """How often a step took longer than ``step_budget_ms``."""
        return self._online.overruns

    @property
    def cut_short(self) -> int:
        """How often the planner left out iterations, so that it would not."""
        return self._online.cut_short

    @property
    def left_out(self) -> int:
        """How many gradient steps were left out, for the same reason."""
        return self._online.left_out

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
        return self.adapter.posterior(self._online.state_for(state, robot).belief.of(robot), self.situations)

    @torch.inference_mode(mode=False)
    def marginals(self, state: OnlineState | None = None, robot: int = 0) -> dict[str, float]:
        """As :meth:`posterior`, but of each training situation, be it alone or a part of what is wrong."""
        return self.adapter.marginals(self._online.state_for(state, robot).belief.of(robot), self.situations)

    def diagnose(self, state: OnlineState | None = None, robot: int = 0) -> Diagnosis:
        """Says in words what is most likely wrong with a robot, and how sure that is: ``print(agent.diagnose())``.

        Arguments and errors as of :meth:`posterior`.
        """
        state = self._online.state_for(state, robot)
        error, steps = state.belief.errors[robot] / self.model.usual_error, int(state.memory.weight[robot].sum())
        recognised = bool(state.belief.recognised[robot])
        return Diagnosis.of(self.posterior(state, robot), float(error), steps, recognised)

    def health(self, state: OnlineState | None = None, robot: int = 0) -> dict[str, int]:
        """Counts what was missing or late on a robot, as ``info["famle"]`` and TensorBoard do.

        Args:
            state: As :meth:`predict` returns it; None asks for what the agent has been told last.
            robot: Which of the robots that run side by side.

        Returns:
            ``quarantined``, transitions that were not learnt from, since an observation could not be a measurement;
            ``blind``, observations since the last one that could; ``dropped``, steps that were no transition for
            another reason; ``repeated``, observations that were those of the step before to the last bit. Of all robots
            together, ``overruns``, how often a step took longer than ``step_budget_ms``; ``cut_short``, how often its
            plan left out iterations; and ``left_out``, the gradient steps for which there was no time.

        Raises:
            IndexError: There is no such robot.
        """
        return self._online.health(state, robot)

    def state_of(self, robots: int) -> OnlineState:
        """Returns what the agent believes now where that fits the number of robots, else what it meta-learned.

        Args:
            robots: B.

        Raises:
            NotLearnedError: The agent has no model yet.
        """
        return self._online.state_of(robots)

    # --- from arrays to tensors -------------------------------------------------------------------------

    def _readings(self, obs: Array | None) -> torch.Tensor:
        """What sensors say, (obs_dim,) or (B, obs_dim) or None -> (B, obs_dim)."""
        return self._tensor(np.atleast_2d(reading(obs, self.observation_space)))

    def _tensor(self, values: Array) -> torch.Tensor:
        return self.policy.builder.tensor(values)

    def _flags(self, values: Any) -> torch.Tensor:
        """Whether something is so of each robot, (B,)."""
        return torch.tensor(np.atleast_1d(values), dtype=torch.bool, device=self.device)


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
