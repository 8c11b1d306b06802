"""The methods that are compared, each an agent with the face of a Stable-Baselines3 algorithm.

A method is one entry of :data:`METHODS`; every benchmark takes its agents from here.
"""

from __future__ import annotations

import json
import shutil
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from filelock import FileLock
from stable_baselines3.common.base_class import BaseAlgorithm

from benchmarks import ppo
from benchmarks.task import Task
from famle_agent import AMPC, AMPCMAML, FAMLE, ModelBasedAgent, Transitions
from famle_agent.agents.presets import known_robots
from famle_agent.agents.world_model import WorldModel
from famle_agent.data.collect import collect
from famle_agent.data.policies import make_held_uniform
from famle_agent.models.members import for_robots

Agent = TypeVar("Agent", bound=ModelBasedAgent)


@dataclass(frozen=True)
class Method:
    """How an agent comes to be.

    Attributes:
        agent: Makes the agent of a task, with all that it knows from simulation.
        learn: Learns in simulation what the replicates share, into the cache; does nothing where that is there.
        fleet: Makes one agent for the robots of many tasks, in which each robot has the network of its own replicate;
            None where replicates run one by one.
    """

    agent: Callable[[Task], BaseAlgorithm]
    learn: Callable[[Task], object] = lambda task: None
    fleet: Callable[[Sequence[Task]], ModelBasedAgent] | None = None

    def on(self, tasks: Sequence[Task]) -> BaseAlgorithm:
        """Makes the agent of one test robot, or of many in step.

        Raises:
            ValueError: The robots of this method run one by one.
        """
        if len(tasks) == 1:
            return self.agent(tasks[0])
        if self.fleet is None:
            raise ValueError(f"The replicates of this method run one by one, not {len(tasks)} in step.")
        return self.fleet(tasks)


def model_based(method: Method, task: Task) -> ModelBasedAgent:
    """Makes the agent of a test robot for a single episode, which a model-free one learns too little in.

    Raises:
        ValueError: The method is model-free.
    """
    agent = method.agent(task)
    if not isinstance(agent, ModelBasedAgent):
        raise ValueError("This method needs more steps than an episode has; take a model-based method.")
    agent.set_random_seed(task.seed)
    return agent


def about(agent: BaseAlgorithm, robot: int = 0) -> dict[str, Any]:
    """Tells what a result keeps of its agent: device, a short name of all settings, and how its adaptations went.

    Args:
        agent: One of ours, or of Stable-Baselines3, of which only the device is known.
        robot: Which of the robots that act in step.
    """
    known = {"device": agent.device.type}
    if not isinstance(agent, ModelBasedAgent):
        return known
    settings, belief = json.dumps(agent.config.to_dict(), sort_keys=True), agent.belief
    name = f"{zlib.crc32(settings.encode()):08x}"
    return {**known, "settings": name, "adaptations": belief.adaptations, "diverged": int(belief.diverged[robot])}


# --- FAMLE ------------------------------------------------------------------------------------------------------------


def from_cache(agent: Agent, path: Path, learn: Callable[[Agent], object] = lambda agent: agent.meta_learn()) -> Agent:
    """Gives an agent the model in a file, where that was learnt as this agent would; else it learns one and saves it.

    How it adapts and plans is the agent's own: a model outlasts a change of these settings. Of replicates that want it
    at the same time one learns, and the others wait. Learning may keep its progress in the folder :func:`on_its_way`.
    """

    def is_known() -> bool:
        if path.exists():
            agent.take_model(path)
        return agent.dynamics is not None

    if not is_known():
        path.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{path}.lock"):
            if not is_known():
                learn(agent)
                agent.save(path)
                shutil.rmtree(on_its_way(path), ignore_errors=True)
    return agent


def on_its_way(path: Path) -> Path:
    """Returns the folder beside a cached file from which learning that is stopped goes on, if it is asked for again."""
    return path.with_suffix("")


def famle(task: Task, **overrides: Any) -> FAMLE:
    """Makes FAMLE with the model that the package ships, or where it ships none one that is learnt in the cache."""
    if task.is_shipped:
        return shipped(task, **overrides)
    agent = FAMLE(task.simulated(), seed=task.meta_seed, device=task.device, pretrained=False, **overrides)
    path = task.cache / f"{task.robot}-ours-{task.meta_seed}.zip"
    return from_cache(agent, path, lambda agent: agent.meta_learn(folder=on_its_way(path)))


def shipped(task: Task, **overrides: Any) -> FAMLE:
    """Makes the agent that the package ships."""
    agent = FAMLE(task.simulated(), seed=task.seed, device="cpu", **overrides)
    if agent.dynamics is None:
        raise RuntimeError(f"The package ships no model that fits; make it with: famle meta-learn --robot {task.robot}")
    return agent


def oracle(task: Task) -> FAMLE:
    """Makes the upper line: FAMLE with a model of the very test robot, of as many transitions as of all situations.

    Where the test robot has a profile, its model is of 2,000 of its gaits. It adapts all the same.
    """
    broken = str(task.situation).replace(" ", "_")
    path = task.cache / f"{task.robot}-oracle-{task.profile or task.seed}-{broken}.zip"
    if task.profile:
        # Collected by hand: no agent meta-learns on a profile, and this one is not to be had on a real robot.
        agent = FAMLE(task.simulated(), seed=0, device="cpu", pretrained=False, compose=False)
        hold = make_held_uniform(agent.config.simulation.action_hold)
        return from_cache(
            agent,
            path,
            lambda agent: agent.meta_learn(collect([task.make], [task.situation.label], 2000, hold, seed=0)),
        )
    probe = FAMLE(task.simulated(), device="cpu", pretrained=False)
    situations = len(probe.situation_envs().situations)
    n = situations * probe.config.simulation.transitions_per_situation
    agent = FAMLE(task.simulated(), seed=task.seed, device="cpu", pretrained=False, transitions_per_situation=n)
    return from_cache(agent, path, lambda agent: agent.meta_learn([task.situation]))


def one_simulator(task: Task) -> FAMLE:
    """Makes an agent that knows only the intact robot in its simulator, four times as long as FAMLE knows each."""
    n = 4 * known_robots()[task.robot].config("ours").simulation.transitions_per_situation
    settings: dict[str, Any] = {"pretrained": False, "transitions_per_situation": n, "compose": False, "adapt_every": 0}
    agent = FAMLE(task.simulated(), seed=0, device="cpu", **settings)
    return from_cache(agent, task.cache / f"{task.robot}-one-simulator.zip", lambda agent: agent.meta_learn(["intact"]))


ANEW: Mapping[str, Any] = {"warm_start": False, "memory_size": 10, "selection_size": 0, "adapt_batch_size": 0}
"""FAMLE that begins with what was meta-learned at each adaptation, as the paper does, on the last ten transitions."""


# --- agents that are meta-trained for the benchmark -------------------------------------------------------------------


@dataclass(frozen=True)
class MetaTrained:
    """An agent whose meta-training the package does not ship.

    Where FAMLE's is shipped, all replicates share one model, as they share that one. Else replicates take turns with
    ``networks`` networks, all of them trained on the same simulated data: they are the members of one ensemble, which
    know nothing of each other, so that they cost less than one after the other would.

    Attributes:
        name: Of the file in the cache.
        cls: The kind of agent.
        mode: Of its settings.
        networks: Replicate i has network i, counted round.
        settings: Settings to change.
        simulation: Settings to change while the networks are learnt, and not on the robot.
    """

    name: str
    cls: type[ModelBasedAgent]
    mode: str = "ours"
    networks: int = 10
    settings: Mapping[str, Any] = field(default_factory=dict)
    simulation: Mapping[str, Any] = field(default_factory=dict)

    def method(self) -> Method:
        """Describes how this agent comes to be."""
        return Method(self.agent, self.learn, self.fleet)

    def agent(self, task: Task) -> ModelBasedAgent:
        """Makes the agent of a replicate."""
        return self.fleet([task])

    def fleet(self, tasks: Sequence[Task]) -> ModelBasedAgent:
        """Makes one agent whose robots have the networks of their replicates."""
        task, many = tasks[0], self.learn(tasks[0])
        agent = self._new(task)
        model = many.model
        if not task.is_shipped:
            model = for_robots(model, [task.seed % self.networks for task in tasks])
        agent.policy.world = WorldModel(model.to(agent.device), many.situations)
        return agent

    def learn(self, task: Task) -> ModelBasedAgent:
        """Learns the networks of all replicates, or takes them from the cache."""
        members = {} if task.is_shipped else {"members": self.networks}
        agent = self._new(replace(task, seed=0, device="cpu"), **self.simulation, **members)
        path = task.cache / f"{task.robot}-{self.name}.zip"
        return from_cache(agent, path, partial(self._learn, task=task, folder=on_its_way(path)))

    def _learn(self, agent: ModelBasedAgent, task: Task, folder: Path) -> None:
        data = simulated_data(task) if self.mode == "ours" else None
        agent.meta_learn(data, progress_bar=True, n_jobs=-1, folder=folder)

    def _new(self, task: Task, **more: Any) -> ModelBasedAgent:
        settings = {**self.settings, **more}
        return self.cls(task.simulated(), self.mode, seed=task.seed, device=task.device, pretrained=False, **settings)


def simulated_data(task: Task) -> Transitions:
    """Collects as many transitions of each situation as FAMLE's model has seen, once for all methods.

    Where FAMLE goes round, its planned transitions come from that very model: its own rounds began with a poor one,
    which the rivals are spared.

    Raises:
        ValueError: The cache has transitions of other situations, or another number.
    """
    path = task.cache / f"{task.robot}-transitions.npz"
    agent = FAMLE(task.simulated(), seed=0, device="cpu", pretrained=False)
    envs, how = agent.situation_envs(), agent.config.simulation
    if not path.exists():
        transitions = agent.collect(progress_bar=True, n_jobs=-1)
        if n := how.planned:
            planning = famle(replace(task, seed=0)).planning_policy()
            planned = collect(envs.sources, envs.situations, n, planning, seed=1, n_jobs=-1)
            transitions = transitions.followed_by(planned)
        path.parent.mkdir(parents=True, exist_ok=True)
        transitions.save(path)
    stored = Transitions.load(path)
    expected = tuple(envs.situations), how.transitions_per_situation + how.planned
    if (stored.situations, stored.obs.shape[1]) != expected:
        raise ValueError(f"{path} holds other transitions than FAMLE's settings ask for; delete it.")
    return stored


ORIGINAL_CANDIDATES = 64
"""Sequences that the planned episodes of the authors' data are planned with, of their 10,000: what can be afforded."""


# --- what they are called ---------------------------------------------------------------------------------------------


MAML: Mapping[str, Mapping[str, str]] = {
    "reptile": {"meta_learner": "reptile"},
    "fomaml": {"meta_learner": "first-order-maml"},
    "maml": {"meta_learner": "maml"},
}
"""The ways to meta-learn without embeddings, by the short name of the rival."""

PAPER: Mapping[str, tuple[int, Mapping[str, Any]]] = {"paper": (10, {}), "paper-held": (5, {"action_hold": 5})}
"""The number of networks and what is changed of the paper's settings: nothing, or random actions that are held."""

META_TRAINED: dict[str, MetaTrained] = {
    **{f"famle-{name}": MetaTrained(name, FAMLE, "paper", n, changed) for name, (n, changed) in PAPER.items()},
    "famle-original": MetaTrained("original", FAMLE, "original", 10, simulation={"candidates": ORIGINAL_CANDIDATES}),
    "ampc": MetaTrained("ampc", AMPC, networks=30),
    "ampc-paper": MetaTrained("paper-ampc", AMPC, "paper", 30),
    "ampc-original": MetaTrained("original-ampc", AMPC, "original", 30),
    "ampc-reptile-original": MetaTrained("original-reptile", AMPCMAML, "original", 10, MAML["reptile"]),
    **{f"ampc-{rival}": MetaTrained(rival, AMPCMAML, settings=settings) for rival, settings in MAML.items()},
    **{
        f"ampc-{rival}-{name}": MetaTrained(f"{name}-{rival}", AMPCMAML, "paper", n, {**settings, **changed})
        for rival, settings in MAML.items()
        for name, (n, changed) in PAPER.items()
    },
}
"""Those whose meta-training the package does not ship, by name."""

METHODS: dict[str, Method] = {
    "famle": Method(famle),
    "famle-frozen": Method(partial(famle, adapt_every=0)),
    "famle-anew": Method(partial(famle, **ANEW)),
    "famle-select": Method(partial(famle, adapt_steps=0)),
    "famle-nearest": Method(partial(famle, adapt_steps=0, compose=False)),
    **{name: recipe.method() for name, recipe in META_TRAINED.items()},
    "ppo": Method(ppo.from_scratch),
    "ppo-pretrained": Method(ppo.simulated_first, ppo.learn_simulated),
    "oracle": Method(oracle),
    "one-simulator": Method(one_simulator, one_simulator),
}
"""Methods by name."""

PPO_METHODS = ("ppo", "ppo-pretrained")
"""Those that need many more steps than the others."""
