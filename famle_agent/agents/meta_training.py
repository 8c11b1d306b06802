"""Meta-training in rounds: simulate every situation, learn from all transitions so far, plan there, and again.

One round is the paper's: random actions, then Algorithm 1.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Generator
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor
from tqdm.auto import tqdm

from famle_agent.agents.policy import AdaptivePolicy
from famle_agent.agents.world_model import WorldModel
from famle_agent.data.collect import collect
from famle_agent.data.envs import SituationEnvs
from famle_agent.data.policies import MakeBatchPolicy, MakePolicy, make_held_uniform, make_planning, reward_names
from famle_agent.data.transitions import Transitions
from famle_agent.models.actor_critic import ActorCritic
from famle_agent.models.dynamics import Batch, Dynamics
from famle_agent.models.scale import unresolved
from famle_agent.training.policy_search import PolicySearch, Search
from famle_agent.training.progress import Progress
from famle_agent.training.run_folder import RunFolder
from famle_agent.training.trainer import Metrics
from famle_agent.utils.atomic_write import whole_file
from famle_agent.utils.chance import GlobalChance

__all__ = ["Learner", "begin_model", "meta_train", "planning_policy", "search_policy", "simulate"]


class Learner(Protocol):
    """An agent, as far as meta-training knows it.

    Attributes:
        num_iterations: Iterations of learning that it has done in this meta-training.
        generator: Source of all the chance.
    """

    num_iterations: int
    generator: torch.Generator

    @property
    def policy(self) -> AdaptivePolicy:
        """Its settings, and what it has learnt so far."""

    def draw_seed(self) -> int:
        """Draws a seed from its generator."""

    def save(self, path: Path) -> None:
        """Stores it."""

    def restore(self, file: Path) -> None:
        """Goes back to where it was when it was stored."""


def meta_train(
    agent: Learner, source: SituationEnvs | Transitions, folder: RunFolder, n_jobs: int, progress_bar: bool
) -> Generator[Metrics]:
    """Runs Algorithm 1 round by round: simulates, and learns from all that has been simulated so far.

    Args:
        agent: Its ``policy.world`` becomes what was learnt, and changes as the iterator is advanced.
        source: The situations' environments, or transitions that were collected before.
        folder: Where it goes on from, and stores what it has done.
        n_jobs: Processes that simulate.
        progress_bar: Whether to show progress bars.

    Yields:
        The losses of each iteration.
    """
    policy, config, transitions, actor_critic = agent.policy, agent.policy.config, None, None
    last = 0 if isinstance(source, Transitions) else config.last_round
    bar = partial(_bar, rounds=last + 1, disable=not progress_bar)
    reports = 0  # iterations before the first of the model's
    for number in range(last + 1):
        # Lines 1 to 6: transitions D_c of every situation c.
        new = source
        if isinstance(new, SituationEnvs) and number == 0 and config.simulation.policy is not None:
            total = config.simulation.policy.steps_of_each(len(new.sources)) * len(new.sources)
            with bar("Learning a policy", number, total, "step") as shown:
                new, actor_critic = yield from search_policy(agent, new, folder, shown.update)
        elif isinstance(new, SituationEnvs):
            with bar("Simulating", number, config.simulation.transitions(number) * len(new.sources), "step") as shown:
                new = simulate(agent, new, number, n_jobs, folder.transitions(number), shown.update)
        reports = agent.num_iterations if number == 0 else reports
        if number == 0:
            _warn_of_resolution(new)
        new = policy.builder.in_model_units(new)
        transitions = new if transitions is None else transitions.followed_by(new)
        if (stored := folder.finished(number)) is not None:
            agent.restore(stored)
            agent.num_iterations = reports + config.iterations(number, number == last)
            continue

        # Lines 7 to 14: theta and H from them.
        left = reports + config.iterations(number, number == last) - agent.num_iterations
        with bar("Meta-learning", number, left, "it") as shown:
            anew = config.begins_anew(number, number == last)
            with GlobalChance(agent.draw_seed())():  # initial weights come from torch's global generator
                model, data = begin_model(policy, transitions, anew, agent.generator, actor_critic)
            progress = partial(_progress, agent, folder, number, shown)
            for metrics in config.trainer(number, number == last).fit(model, data, agent.generator, progress):
                shown.set_postfix({key.split("/")[-1]: f"{value:.3g}" for key, value in metrics.items()}, refresh=False)
                shown.update()
                agent.num_iterations += 1
                yield metrics
        folder.finish(number, agent.save)


def search_policy(
    agent: Learner, envs: SituationEnvs, folder: RunFolder, callback: Callable[[int], Any]
) -> Generator[Metrics, None, tuple[Transitions, ActorCritic]]:
    """Learns a policy for all situations, or reads the one that a stopped run has learnt.

    Args:
        agent: Its settings count.
        envs: The situations.
        folder: Where the policy and its transitions are stored.
        callback: Is told how many steps have been simulated since it was last told.

    Yields:
        Returns in simulation; each report counts as an iteration.

    Returns:
        All that the policy went through, and what was learnt.
    """
    builder, simulation, seed = agent.policy.builder, agent.policy.config.simulation, agent.draw_seed()
    settings = simulation.policy or PolicySearch()
    reported, (data, weights) = 0, folder.search()
    if data is not None and weights is not None and weights.exists():
        with GlobalChance(0)():  # initial weights, which are replaced
            actor_critic = builder.actor_critic(len(envs.situations), settings.hidden, settings.interaction_rank)
        try:
            actor_critic.load_state_dict(load_tensors(weights.read_bytes()))
        except (KeyError, RuntimeError, SafetensorError) as error:
            raise ValueError(f"{weights} is damaged ({error}). Delete it to begin anew.") from error
        return Transitions.load(data), actor_critic.requires_grad_(False)
    search = Search(settings, envs.sources, envs.situations, seed, simulation.episode_length)
    try:
        for metrics in search.run():
            callback(search.done - reported)
            reported = search.done
            agent.num_iterations += 1
            yield metrics
        transitions, actor_critic = search.transitions(), search.actor_critic()
    finally:
        search.close()
    if data is not None and weights is not None:
        transitions.save(data)
        with whole_file(weights) as partial_file:
            partial_file.write_bytes(save_tensors(actor_critic.state_dict()))
    return transitions, actor_critic.to(builder.device)


def simulate(
    agent: Learner, envs: SituationEnvs, number: int, n_jobs: int, folder: Path | None, callback: Callable[[int], Any]
) -> Transitions:
    """Collects random transitions in round 0, and the agent's own planning after that.

    Args:
        agent: Who plans.
        envs: The situations.
        number: The round, from 0.
        n_jobs: Processes; the result does not depend on it.
        folder: Where transitions are stored as they come.
        callback: Is told how many steps have been simulated since it was last told.
    """
    how = agent.policy.config.simulation
    make_policy: MakePolicy | MakeBatchPolicy = make_held_uniform(how.action_hold)
    if number:
        make_policy = planning_policy(agent.policy)
    seed = agent.draw_seed()
    n = how.transitions(number)
    return collect(envs.sources, envs.situations, n, make_policy, seed, callback, n_jobs, folder, how.episode_length)


def planning_policy(policy: AdaptivePolicy) -> MakeBatchPolicy:
    """Makes a policy for simulation that plans with what was learnt so far, and knows which situation it is in.

    Raises:
        NotLearnedError: Nothing was learnt yet.
    """
    model, reward_fn = deepcopy(policy.model).cpu(), policy.user_reward_fn
    if reward_fn is None and policy.world is not None and policy.world.reward is not None:
        learned = deepcopy(policy.world.reward).cpu()
        scale = replace(policy.builder, device=torch.device("cpu")).action_scale

        def reward_fn(obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
            return learned(obs, scale.to_unit(action), next_obs)  # type: ignore[no-any-return]

    rewards = reward_names(policy.config.planning_reward)
    return make_planning(model, policy.config.planner, reward_fn, rewards, policy.known_termination_fn)


def begin_model(
    policy: AdaptivePolicy,
    transitions: Transitions,
    anew: bool,
    generator: torch.Generator,
    actor_critic: ActorCritic | None = None,
) -> tuple[Dynamics, Batch]:
    """Gives a policy the model that is learnt in a round, and learns the reward where none is known.

    Ends of episodes that nobody names are learnt beside an actor-critic alone: the paper's planner knows of none.

    Args:
        policy: Its ``world`` is replaced.
        transitions: All so far, with actions in [-1, 1].
        anew: Whether to begin with a new model, instead of going on with the one so far.
        generator: Source of all the chance, but for the initial weights.
        actor_critic: What to do in each situation, if that was learnt.

    Returns:
        The model, and the transitions as it sees them.
    """
    builder, reward, termination = policy.builder, None, None
    obs, action, next_obs = builder.tensors(transitions)
    if policy.learns_reward:
        reward = builder.reward()
        reward.fit(obs, action, next_obs, builder.tensor(transitions.reward), generator)
    if actor_critic is not None and policy.known_termination_fn is None and transitions.ended.any():
        termination = builder.termination()
        ended = torch.as_tensor(transitions.ended, device=next_obs.device)
        termination.fit(next_obs, ended, generator)
    if anew:
        model = builder.dynamics(len(transitions.situations))
        model.fit_normalisation(obs, action, next_obs)
    else:
        model = policy.model
    policy.world = WorldModel(model, transitions.situations, reward, termination, actor_critic)
    return model, model.encode(obs, action, next_obs)


def _warn_of_resolution(transitions: Transitions) -> None:
    """Warns where robots move by less than a model can see of where they are."""
    obs, next_obs = (torch.from_numpy(values).flatten(0, 1) for values in (transitions.obs, transitions.next_obs))
    if torch.equal(obs, next_obs):
        what = "No dimension of the observations ever changes"
    elif lost := unresolved(obs, next_obs):
        what = f"Dimensions {', '.join(map(str, lost))} of the observations change"
    else:
        return
    warnings.warn(
        f"{what} by no more than single precision (float32, 7 digits) shows of numbers of this size, so that no model "
        "can learn how. Give the environment in coordinates that begin near the robot: subtract a constant in float64, "
        "as gymnasium.wrappers.TransformObservation can.",
        stacklevel=5,
    )


def _bar(name: str, number: int, total: int, unit: str, rounds: int, disable: bool) -> tqdm[Any]:
    desc = f"{name} {number + 1}/{rounds}" if rounds > 1 else name
    return tqdm(total=total, desc=desc, unit=unit, mininterval=1.0, disable=disable)


def _progress(agent: Learner, folder: RunFolder, number: int, bar: tqdm[Any], stage: str) -> Progress:
    """Returns where a stage of a round goes on from, and counts what had been done of it before."""

    def skipped(iterations: int) -> None:
        agent.num_iterations += iterations
        bar.update(iterations)

    return Progress(folder.progress(number, stage), skipped)
