"""How methods are called and drawn. One without an entry in :data:`LOOKS` is shown under its own name."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

__all__ = ["LOOKS", "Look", "in_order", "look"]


@dataclass(frozen=True)
class Look:
    """How a method is shown.

    Attributes:
        label: Its name.
        colour: Of its line, box or point.
        line: Style of its line.
        paper: The paper's name of what it stands beside.
    """

    label: str
    colour: str
    line: str = "-"
    paper: str = ""


LOOKS: Mapping[str, Look] = {
    "famle": Look("FAMLE", "#0072b2", paper="FAMLE"),
    "famle-paper": Look("FAMLE, the paper's settings", "#56b4e9", paper="FAMLE"),
    "famle-paper-held": Look("FAMLE, the paper's settings on held actions", "#56b4e9", "-."),
    "famle-original": Look("FAMLE, the authors' code's settings", "#6f4fa2", paper="FAMLE"),
    "famle-anew": Look("FAMLE, anew at each adaptation", "#3f7fbf"),
    "famle-48": Look("FAMLE, 48 candidates", "#88aadd"),
    "famle-likeliest": Look("FAMLE, one start for all networks", "#117733"),
    "famle-select": Look("FAMLE, embeddings only", "#44aa99"),
    "famle-nearest": Look("FAMLE, nearest embedding only", "#66bb55"),
    "famle-h": Look("FAMLE, gradient steps on h", "#7777cc"),
    "famle-theta": Look("FAMLE, gradient steps on theta and h", "#aa66cc"),
    "famle-validated": Look("FAMLE, gradient steps that must prove themselves", "#cc6677", "-."),
    "famle-window": Look("FAMLE, a window instead of the filter", "#ddaa33", "--"),
    "members-1": Look("FAMLE, one network", "#cc79a7"),
    "members-2": Look("FAMLE, ensemble of two", "#999933"),
    "members-3": Look("FAMLE, ensemble of three", "#44aa99"),
    "random-shooting": Look("FAMLE, random shooting with 10,000 candidates", "#8c6d31", "--"),
    "famle-frozen": Look("FAMLE, no adaptation", "#777777", ":"),
    "without-embeddings": Look("without embeddings, two rounds of ten", "#b8860b"),
    "ampc": Look("AMPC", "#8c510a", paper="AMPC"),
    "ampc-reptile": Look("AMPC-MAML (Reptile)", "#e69f00", paper="AMPC-MAML"),
    "ampc-original": Look("AMPC, the authors' code's settings", "#8c510a", "--", paper="AMPC"),
    "ampc-reptile-original": Look(
        "AMPC-MAML (Reptile), the authors' code's settings", "#e69f00", "--", paper="AMPC-MAML"
    ),
    "ampc-paper": Look("AMPC, the paper's settings", "#8c510a", "-.", paper="AMPC"),
    "ampc-reptile-paper": Look("AMPC-MAML (Reptile), the paper's settings", "#e69f00", "-.", paper="AMPC-MAML"),
    "ampc-fomaml-paper": Look("AMPC-MAML (first order), the paper's settings", "#f0675c", "-.", paper="AMPC-MAML"),
    "ampc-maml-paper": Look("AMPC-MAML (second order), the paper's settings", "#b2182b", "-.", paper="AMPC-MAML"),
    "ampc-reptile-paper-held": Look("AMPC-MAML (Reptile), the paper's settings on held actions", "#e69f00", ":"),
    "ampc-fomaml-paper-held": Look("AMPC-MAML (first order), the paper's settings on held actions", "#f0675c", ":"),
    "ampc-maml-paper-held": Look("AMPC-MAML (second order), the paper's settings on held actions", "#b2182b", ":"),
    "ampc-fomaml": Look("AMPC-MAML (first order)", "#f0675c", paper="AMPC-MAML"),
    "ampc-maml": Look("AMPC-MAML (second order)", "#b2182b", paper="AMPC-MAML"),
    "ppo": Look("PPO", "#e07bb5", paper="PPO"),
    "ppo-pretrained": Look("PPO, trained in simulation first", "#882255"),
    "one-simulator": Look("intact simulator only", "#999933"),
    "informed": Look("FAMLE, told the damage and trained on it for one round more", "#000000", "-."),
    "oracle": Look("oracle", "#000000", "--"),
}
"""Methods that are shown under another name than their own, in the order of tables and legends."""

_SPARE_COLOURS = ("#17becf", "#bcbd22", "#8c6d31", "#3182bd", "#e6550d", "#31a354", "#756bb1", "#636363")


def look(method: str) -> Look:
    """How a method is shown; an unknown one under its own name, in the same colour every time."""
    spare = _SPARE_COLOURS[zlib.crc32(method.encode()) % len(_SPARE_COLOURS)]
    return LOOKS.get(method, Look(method, spare))


def in_order(methods: Iterable[str]) -> list[str]:
    """Methods in the order of :data:`LOOKS`, those that are not in it at the end."""
    rank = {method: i for i, method in enumerate(LOOKS)}
    return sorted(methods, key=lambda method: (rank.get(method, len(rank)), method))
