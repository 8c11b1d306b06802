"""What speed costs: each part of the package beside the raw cost of the same work, on one machine, in one run.

python -m benchmarks.performance                                   # all parts, on all robots
python -m benchmarks.performance --robots ant --parts control      # whole control steps of the ant

What is compared takes turns, and the processor's time counts, so that a slow moment of the machine or another process
changes ratios little. Of parallel processes the wall time counts. Networks are untrained where none is shipped, since
a step costs the same whatever they know. How a cost grows is the slope of a line fitted to both logarithms: 1 is
growth in proportion.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from stable_baselines3.common.logger import Logger, configure

from benchmarks.raw_cost import OneByOne, bare_products
from benchmarks.results import provenance, store
from benchmarks.runner import launch
from benchmarks.stopwatch import growth_of, machine, medians, repeat
from benchmarks.untrained import SITUATIONS, agent_of, experienced, one_by_one, robot_of, taking_in
from famle_agent import AdaptationLog, FAMLEWrapper, ModelBasedAgent
from famle_agent.data.collect import collect
from famle_agent.data.policies import MakeBatchPolicy, MakePolicy, make_held_uniform
from famle_agent.models.dynamics import Batch
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.training.reptile import Reptile
from famle_envs.engines import ENGINES

ROBOTS = ("reacher", "ant", "quadruped", "minitaur")
"""Robots that are timed."""

_ROWS_IN_CACHE = 2500  # of a product
_MOST_CANDIDATES = 50_000  # embeddings and sums; more take more memory than a small computer has


@dataclass(frozen=True)
class Args:
    """Times all that takes time."""

    robots: tuple[str, ...] = ROBOTS
    """Robots that are timed."""
    parts: tuple[str, ...] = (
        *("planning", "adaptation", "selection", "training", "environment", "collection", "control"),
        *("logging", "many robots", "growth", "start-up"),
    )
    """What is timed."""
    repeats: int = 20
    """Timings of a figure; the median counts. What takes long is timed less often."""
    steps: int = 300
    """Control steps of an episode."""
    batches: tuple[int, ...] = (1, 8, 64, 512)
    """B, robots at once."""
    embeddings: tuple[int, ...] = (10, 100, 1000, 10_000)
    """N, embeddings to select from; with the sums of two where these are at most 50,000."""
    transitions: int = 500
    """Transitions that a process collects by chance; a fiftieth of them while planning."""
    threads: int = 1
    """Threads of torch."""
    out: Path = Path("benchmarks/results")
    """Folder of performance.csv."""

    def __post_init__(self) -> None:
        for name, known in ((self.robots, ROBOTS), (self.parts, PARTS)):
            if unknown := set(name) - set(known):
                raise ValueError(f"There is nothing to time of {', '.join(unknown)}. Known: {', '.join(known)}.")


def planning(robot: str, args: Args) -> dict[str, float]:
    """Times plans at our defaults and at the paper's budget against the bare matrix products of the same shapes."""
    ratios, times, obs = dict[str, float](), dict[str, float](), robot_of(robot).reset(seed=0)[0]
    for mode in ("ours", "paper"):
        agent = agent_of(robot, mode)
        planner, model = agent.config.planner, agent.policy.model
        # Bare products are fastest where what they work on stays in the processor's cache.
        parts = -(-planner.candidates // _ROWS_IN_CACHE)
        products = bare_products(model, model.members, planner.candidates // parts)
        steps = parts * planner.horizon * getattr(planner, "iterations", 1)
        plan, bare = medians(max(3, args.repeats // 4), partial(agent.predict, obs), partial(repeat, steps, products))
        ratios[f"{mode}: plan / bare products"] = plan / bare
        times |= {f"{mode}: plan (ms)": plan, f"{mode}: bare products (ms)": bare}
    return ratios | times


def adaptation(robot: str, args: Args) -> dict[str, float]:
    """Times an adaptation with a full memory against the bare products of its gradient steps."""
    agent = agent_of(robot)
    adapter, state, how = agent.controller.adapter, experienced(agent, 1), agent.config.adaptation.gradient
    if how is None:
        (adapt,) = medians(args.repeats, partial(adapter.adapt, state.memory, state.belief))
        return {"adaptation (ms)": adapt}
    model, k = agent.policy.model, how.inner_loop(state.memory.seen).steps
    products = bare_products(model, model.members, how.batch_size or state.memory.seen, backward=True)
    adapt, bare = medians(
        max(3, args.repeats // 4),
        partial(adapter.adapt, state.memory, state.belief),
        partial(repeat, k, products),
    )
    return {
        "adaptation / bare products": adapt / bare,
        "adaptation (ms)": adapt,
        "gradient steps": k,
        "bare products (ms)": bare,
    }


def selection(robot: str, args: Args) -> dict[str, float]:
    """Times how a transition is judged and the posterior updated, over N embeddings with and without their sums."""
    figures = dict[str, float]()
    for compose in (False, True):
        sizes, milliseconds = list[int](), list[float]()
        for n in args.embeddings:
            candidates = n + (n - 1) * (n - 2) // 2 if compose else n
            if candidates > _MOST_CANDIDATES:
                continue
            observe = taking_in(agent_of(robot, situations=n, compose=compose, adapt_every=10**6))
            sizes.append(n)
            milliseconds += medians(max(3, args.repeats // 4), observe)
        name = "embeddings and their sums" if compose else "embeddings"
        figures |= {f"{name}: N = {n} (ms)": ms for n, ms in zip(sizes, milliseconds, strict=True)}
        figures[f"{name}: growth with N"] = growth_of(sizes, milliseconds)
    return figures


def training(robot: str, args: Args) -> dict[str, float]:
    """Times inner gradient steps of Algorithm 1 against bare products, and a port of it that does one by one."""
    k, size, data = 20, 32, 500
    builder = agent_of(robot).policy.builder
    model = replace(builder, config=replace(builder.config, members=1)).dynamics(SITUATIONS)
    x, y = torch.randn(SITUATIONS, data, model.n_features + model.action_dim), torch.randn(1, 1, model.obs_dim)
    batch = Batch(x, y.expand(SITUATIONS, data, -1).contiguous(), torch.ones(SITUATIONS, data))
    chance = torch.Generator().manual_seed(0)
    ours = Reptile(10**6, meta_batch_size=SITUATIONS, batch_size=size).steps(model, batch, InnerLoop(k), chance)
    products = bare_products(model, SITUATIONS, size, backward=True)
    meta, sequential, bare = medians(
        max(3, args.repeats // 4),
        partial(next, ours),
        OneByOne(model, batch, InnerLoop(k), size).situation,
        partial(repeat, k, products),
    )
    step, port, raw = meta / (k * SITUATIONS), sequential / k, bare / (k * SITUATIONS)
    return {
        "steps of a sequential port / ours (time)": port / step,
        "ours / bare products": step / raw,
        "ours (steps / s)": 1e3 / step,
        "sequential port (steps / s)": 1e3 / port,
        "bare products (steps / s)": 1e3 / raw,
    }


def environment(robot: str, args: Args) -> dict[str, float]:
    """Times a step of the environment in each engine against the bare physics, and a second of its own time."""
    ratios, times = dict[str, float](), dict[str, float]()
    for engine in ENGINES:
        env: Any = robot_of(robot, engine=engine).unwrapped
        action = np.full(env.action_space.shape, 0.3)
        bare = partial(env.world.simulate, env.physics_steps)
        step, raw = medians(5 * args.repeats, partial(env.step, action), bare)
        times |= {f"{engine}: step (ms)": step, f"{engine}: bare physics (ms)": raw}
        times[f"{engine}: simulated second (ms)"] = step / env.control_period
        ratios[f"{engine}: step / bare physics"] = step / raw
        env.close()
    return ratios | times


def collection(robot: str, args: Args) -> dict[str, float]:
    """Times the collection of transitions by chance and by planning, all situations at once and one by one.

    The time of the processor in one process; the wall time with one process and with two.
    """
    agent = agent_of(robot)
    sources = agent.situation_envs().sources[:SITUATIONS]
    names = [f"situation {i}" for i in range(len(sources))]
    plans, chance = agent.planning_policy(), make_held_uniform(agent.config.simulation.action_hold)
    envs = [source() if callable(source) else source for source in sources]
    kinds: dict[str, tuple[MakePolicy | MakeBatchPolicy, int]] = {
        "by chance": (chance, args.transitions),
        "planned": (plans, max(2, args.transitions // 50)),
        "planned one by one": (one_by_one(plans), max(2, args.transitions // 50)),
    }
    calls = [partial(collect, envs, names, n, policy, 0) for policy, n in kinds.values()]
    times = medians(max(3, args.repeats // 4), *calls, warm_up=1)
    speeds = {
        f"{kind} (steps / s)": 1e3 * len(envs) * n / ms for (kind, (_, n)), ms in zip(kinds.items(), times, strict=True)
    }
    for env in envs:
        env.close()
    together, alone = speeds["planned (steps / s)"], speeds["planned one by one (steps / s)"]
    figures = {"planned: together / one by one": together / alone}
    for kind in ("by chance", "planned"):
        policy, n = kinds[kind][0], kinds[kind][1] * 5
        for jobs in (1, 2):
            collect(sources, names, 2, policy, 0, n_jobs=jobs)  # starts the processes
            start = time.perf_counter()
            collect(sources, names, n, policy, 0, n_jobs=jobs)
            wall = time.perf_counter() - start
            speeds[f"{kind}, {jobs} process(es), wall time (steps / s)"] = len(sources) * n / wall
        one, two = list(speeds.values())[-2:]
        figures[f"{kind}: two processes / one"] = two / one
    return figures | speeds


def control(robot: str, args: Args) -> dict[str, float]:
    """Times whole control steps against the robot's period: plan, simulation, evidence and adaptation."""
    agent = agent_of(robot)
    env = FAMLEWrapper(robot_of(robot), agent)
    obs, _ = env.reset(seed=0)
    milliseconds = np.zeros(args.steps)
    for i in range(args.steps):
        start = time.process_time()
        obs, _, terminated, truncated, _ = env.step(agent.predict(obs)[0])
        milliseconds[i] = 1e3 * (time.process_time() - start)
        if terminated or truncated:
            obs, _ = env.reset()
    period, mean, late = 1e3 * env.get_wrapper_attr("control_period"), milliseconds[10:].mean(), milliseconds[10:]
    env.close()
    return {
        "mean / period": mean / period,
        "99th percentile / period": float(np.percentile(late, 99)) / period,
        "within the period": float((late <= period).mean()),
        "mean (ms)": mean,
        "median (ms)": float(np.median(late)),
        "99th percentile (ms)": float(np.percentile(late, 99)),
        "period (ms)": period,
    }


class _TimedLog(AdaptationLog):
    """Takes the time of each step's entry in TensorBoard, in s."""

    def __init__(self, agent: ModelBasedAgent, logger: Logger) -> None:
        super().__init__(agent, logger)
        self.seconds = list[float]()

    def step(self, *args: Any) -> None:
        start = time.process_time()
        super().step(*args)
        self.seconds.append(time.process_time() - start)


def logging(robot: str, args: Args) -> dict[str, float]:
    """Times what TensorBoard takes of the control steps of an episode."""
    agent = agent_of(robot)
    with tempfile.TemporaryDirectory() as folder:
        logger = configure(folder, ["tensorboard"])
        log = _TimedLog(agent, logger)
        env = FAMLEWrapper(robot_of(robot), agent, log)
        (obs, _), start = env.reset(seed=0), time.process_time()
        for _ in range(args.steps):
            obs, _, terminated, truncated, _ = env.step(agent.predict(obs)[0])
            if terminated or truncated:
                obs, _ = env.reset()
        others = time.process_time() - start - sum(log.seconds)
        logger.close()
        env.env.close()
    return {
        "entries / other work": sum(log.seconds) / others,
        "a step without entries (ms)": 1e3 * others / args.steps,
        "entries, mean of all steps (ms)": 1e3 * float(np.mean(log.seconds)),
        "longest entry (ms)": 1e3 * max(log.seconds),
    }


def many_robots(robot: str, args: Args) -> dict[str, float]:
    """Times plans and adaptations of many robots at once, a robot."""
    agent, chance, figures = agent_of(robot), torch.Generator().manual_seed(0), dict[str, float]()
    plans, adaptations = list[float](), list[float]()
    for robots in args.batches:
        state = experienced(agent, robots)
        obs, starts = state.memory.obs[:, -1], torch.zeros(robots, dtype=torch.bool)
        plan, adapt = medians(
            1 if robots > 8 else args.repeats // 4,
            partial(agent.controller.act, state, obs, starts, chance),
            partial(agent.controller.adapter.adapt, state.memory, state.belief),
            warm_up=0 if robots > 64 else 1,
        )
        plans.append(plan)
        adaptations.append(adapt)
        figures |= {f"B = {robots}: plan (ms a robot)": plan / robots}
        figures |= {f"B = {robots}: adaptation (ms a robot)": adapt / robots}
    return {
        "plan: a robot of the most / one alone": plans[-1] / plans[0] * args.batches[0] / args.batches[-1],
        "plan: growth with B": growth_of(args.batches, plans),
        "adaptation: growth with B": growth_of(args.batches, adaptations),
    } | figures


def growth(robot: str, args: Args) -> dict[str, float]:
    """Fits how the cost of a plan grows with its size, and that of taking in a transition with the memory."""
    obs, repeats = robot_of(robot).reset(seed=0)[0], max(3, args.repeats // 4)
    figures = dict[str, float]()
    for setting, sizes in (("horizon", (5, 10, 20, 40)), ("candidates", (32, 128, 512, 2048))):
        settings: list[dict[str, Any]] = [{setting: size} for size in sizes]
        plans = [partial(agent_of(robot, **one).predict, obs) for one in settings]
        figures[f"plan: growth with {setting}"] = growth_of(sizes, medians(repeats, *plans))
    memories = (100, 1000, 10_000)
    takes = [taking_in(agent_of(robot, memory_size=size, adapt_every=10**6)) for size in memories]
    figures["a transition: growth with M"] = growth_of(memories, medians(repeats, *takes))
    return figures


def start_up(robot: str, args: Args) -> dict[str, float]:
    """Times a process of its own until a robot's first action, and takes its memory."""
    program = (
        "import json, time; start = time.process_time(); from benchmarks.performance import first_action; "
        f"imported = time.process_time(); first_action({robot!r}); acted = time.process_time(); "
        "memory = [line for line in open('/proc/self/status') if line.startswith('VmHWM')][0]; "
        "print(json.dumps([imported - start, acted - imported, int(memory.split()[1])]))"
    )
    out = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=os.environ)
    imports, acts, kilobytes = json.loads(out.stdout.splitlines()[-1])
    return {"imports (s)": imports, "then until the first action (s)": acts, "memory (MB)": kilobytes / 1024}


def first_action(robot: str) -> None:
    """Makes an agent and has it act once."""
    torch.set_num_threads(1)
    agent_of(robot).predict(robot_of(robot).reset(seed=0)[0])


PARTS: Mapping[str, Callable[[str, Args], Mapping[str, float]]] = {
    "planning": planning,
    "adaptation": adaptation,
    "selection": selection,
    "training": training,
    "environment": environment,
    "collection": collection,
    "control": control,
    "logging": logging,
    "many robots": many_robots,
    "growth": growth,
    "start-up": start_up,
}
"""What can be timed."""


def main(args: Args) -> None:
    """Measures, stores and prints."""
    torch.set_num_threads(args.threads)
    for robot in args.robots:
        for part in args.parts:
            with torch.no_grad() if part != "training" else torch.enable_grad():
                figures = PARTS[part](robot, args)
            about = {"robot": robot, "part": part, "threads": args.threads, "machine": machine()}
            rows = [{"figure": name, "value": float(value)} | about for name, value in figures.items()]
            store(
                args.out / "performance.csv", [row | provenance(sys.argv) for row in rows], ("robot", "part", "threads")
            )
            print(
                f"\n{robot}, {part}:", pd.Series(figures).to_string(float_format="{:.4g}".format), sep="\n", flush=True
            )


if __name__ == "__main__":
    launch(main, Args)
