"""Bytes that nobody has written, for each reader of files and of text, guided by the code that they reach.

python -m benchmarks.fuzz --reader situation --seconds 300   # situations in words
python -m benchmarks.fuzz --reader checkpoint                 # agents in files; a process has one reader

Needs atheris, a fuzzer of Python code (pip install atheris), which ends the process at the first input that raises
anything but the errors that a reader promises, takes more than 10 seconds, or more than 2 GiB beside the libraries, and
stores it in the working directory. Prints how many inputs there were.
"""

from __future__ import annotations

import io
import json
import sys
import zipfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import tyro

ReaderName = Literal["situation", "settings", "checkpoint", "transitions", "progress", "folder", "results"]
Read = Callable[[bytes], object]
"""Reads any bytes, or raises the ValueError that each reader promises."""
SECONDS_OF_AN_INPUT, MEBIBYTES = 10, 3072
PACKAGES = ["famle_agent", "famle_envs", "benchmarks", "json", "zipfile", "numpy.lib", "yaml"]
"""Whose code guides the search."""


@dataclass(frozen=True)
class Args:
    """Gives a reader bytes that nobody has written."""

    reader: ReaderName = "situation"
    """What is read."""
    seconds: int = 60
    """How long."""
    seed: int = 1
    """Of the inputs."""


def main(args: Args) -> None:
    """Fuzzes; the process ends with it.

    Raises:
        ImportError: There is no atheris.
    """
    import atheris

    with TemporaryDirectory() as folder:
        with atheris.instrument_imports(include=PACKAGES):
            read, seeds = READERS[args.reader](Path(folder))
        corpus = Path(folder) / "corpus"
        corpus.mkdir()
        for i, seed in enumerate(seeds):
            (corpus / f"{i}").write_bytes(seed)
        limits = f"-max_total_time={args.seconds}", f"-timeout={SECONDS_OF_AN_INPUT}", f"-rss_limit_mb={MEBIBYTES}"
        options = [sys.argv[0], *limits, f"-seed={args.seed}", "-max_len=32768", "-print_final_stats=1", str(corpus)]
        atheris.Setup(options, partial(promised, read))
        atheris.Fuzz()


def promised(read: Read, data: bytes) -> None:
    """Reads, and lets only what no reader promises through."""
    with suppress(ValueError):
        read(data)


# --- readers, each with inputs to begin with --------------------------------------------------------------------------


def _situation(_: Path) -> tuple[Read, list[bytes]]:
    from famle_envs.reacher import ReacherEnv
    from famle_envs.situation import resolve_situation

    def read(data: bytes) -> None:
        text = data.decode(errors="replace")
        written = str(situation := resolve_situation(text, ReacherEnv.presets))
        if resolve_situation(written, {}) != situation:
            raise RuntimeError(f"{written!r} reads back as something else.")

    return read, [text.encode() for text in SITUATIONS]


SITUATIONS = (
    *("intact", "paper", "joint 0 dead + joint 3 reversed", "joint 1 locked, motor 2 strength x 1.5e-3"),
    *("motor 1 delayed by 3 steps, motor 0 stuck at -.5", "joint 4 sensor off by 30 deg", "sensor 2 at gain 0.5"),
    *("sensor 7 off by 1., sensor 7 noise 2e+1", "sensor 1 frozen, sensor 2 loses 0.2 of its readings"),
    *("yaw sensor off by -0.3 rad, friction x 0.5, base mass x 2", "body 3 mass x 3, mass x 2, damping x 4"),
)


def _settings(_: Path) -> tuple[Read, list[bytes]]:
    import yaml

    from famle_agent.agents.config import Config
    from famle_envs import Situation

    def read(data: bytes) -> None:
        try:
            values = yaml.safe_load(data)
        except (yaml.YAMLError, RecursionError):  # PyYAML's own
            return
        for build in (Config.of, Situation.from_dict):
            with suppress(TypeError, ValueError):
                build(values if isinstance(values, dict) else {})

    aliases = b"hidden: &a [9, 9]\nhorizon: &b [*a, *a]\nmembers: [*b, *b]\nfriction: [*b, *b]\n"
    files = Path(__file__).parents[1].glob("famle_agent/hyperparams/*.yaml")
    modes = [mode for file in files for mode in yaml.safe_load(file.read_text()).values() if isinstance(mode, dict)]
    return read, [aliases, *(yaml.safe_dump(mode).encode() for mode in modes)]


def _checkpoint(folder: Path) -> tuple[Read, list[bytes]]:
    from famle_agent.agents.famle import FAMLE

    settings: dict[str, Any] = {"transitions_per_situation": 20, "hidden": (4,), "meta_iterations": 1, "memory_size": 8}
    agent = FAMLE("reacher", seed=0, device="cpu", **settings).meta_learn(["intact", "joint 0 dead"]).learn(4)
    agent.save(folder / "agent.zip")
    return _entries(folder / "agent.zip", lambda content: agent.restore(io.BytesIO(content)))


def _transitions(folder: Path) -> tuple[Read, list[bytes]]:
    import numpy as np

    from famle_agent.data.transitions import Transitions

    file = folder / "file.npz"
    numbers: dict[str, Any] = {name: np.ones((2, 3, 2), np.float32) for name in ("obs", "action", "next_obs")}
    Transitions(**numbers, reward=np.ones((2, 3), np.float32), situations=("a", "b")).save(file)

    def read(content: bytes) -> None:
        file.write_bytes(content)
        Transitions.load(file)

    return _entries(file, read)


def _progress(folder: Path) -> tuple[Read, list[bytes]]:
    import torch

    from famle_agent.training.progress import Progress

    file, model = folder / "file", torch.nn.Linear(2, 1)
    optimizer = torch.optim.Adam(model.parameters())
    model(torch.ones(1, 2)).sum().backward()
    optimizer.step()

    def read(content: bytes | None) -> None:
        if content is not None:
            file.write_bytes(content)
        for _ in Progress(file, every=0.0).iterations(1, torch.Generator(), model=model, optimizer=optimizer):
            pass

    read(None)
    return _entries(file, read)


def _folder(folder: Path) -> tuple[Read, list[bytes]]:
    from famle_agent.training.run_folder import RunFolder

    fingerprint = {"agent": "FAMLE", "seed": 0, "hyperparameters": {"hidden": [70, 50]}}

    def read(data: bytes) -> None:
        (folder / "run.json").write_bytes(data)
        RunFolder(folder, fingerprint)

    return read, [json.dumps(fingerprint).encode()]


def _results(folder: Path) -> tuple[Read, list[bytes]]:
    from benchmarks.results import load

    def read(data: bytes) -> None:
        (folder / "table.csv").write_bytes(data)
        load(folder / "table.csv")

    return read, [b'method,seed,returns,versions\nfamle,0,"[1.5, 2]","{""torch"": ""2.9""}"\nppo,1,,\n']


READERS: Mapping[ReaderName, Callable[[Path], tuple[Read, list[bytes]]]] = {
    "situation": _situation,
    "settings": _settings,
    "checkpoint": _checkpoint,
    "transitions": _transitions,
    "progress": _progress,
    "folder": _folder,
    "results": _results,
}


def _entries(file: Path, read: Read) -> tuple[Read, list[bytes]]:
    """Reads zips: the first byte says which entry the others replace, or that they are the whole zip.

    A zip has a checksum of each entry, so that bytes changed at random come no further than that.
    """
    whole = file.read_bytes()
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    names = sorted(entries)

    def one(data: bytes) -> None:
        which, content = data[:1], data[1:]
        if which and which[0] < len(names):
            content = _zipped({**entries, names[which[0]]: content})
        read(content)

    return one, [bytes([len(names)]) + whole, *(bytes([i]) + entries[name] for i, name in enumerate(names))]


def _zipped(entries: Mapping[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return buffer.getvalue()


if __name__ == "__main__":
    main(tyro.cli(Args))  # what is read is imported by then alone, so that atheris sees it
