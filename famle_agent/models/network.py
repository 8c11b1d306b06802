"""The network of a dynamics model: a perceptron whose first layer depends on the embedding of the situation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own custom)

__all__ = ["Layers", "Network", "Theta"]

Theta = dict[str, Tensor]
"""Parameters by name; those of several networks are stacked along the leading axes."""

Layers = list[tuple[Tensor, Tensor]]
"""Weights (K, in, out) and biases (K, 1, out) of K networks whose situation is fixed.

Layers behind the first may have fewer, which several situations share.
"""


@dataclass(frozen=True)
class Network:
    """Computes K networks at once, one batched matrix product a layer.

    The embedding h enters the first layer as a bias, which is what concatenating it to the input amounts to. With
    ``gate_actions``, it scales each action too,

        a' = (1 + G^T h) * a,

    so that a motor's gain, its sign included, is linear in h instead of something to be learnt piecewise. With an
    ``interaction_rank`` R, a bilinear map of rank R joins the first layer,

        z = W^T x + C^T ((U^T x) * (V^T h)),

    in which a sensor that is turned is linear in h. What is linear in h adds up: two faults are the sum of theirs.

    With an ``output_limit`` L, the output is L tanh(z) of the last layer z, as in the authors' public code.

    Attributes:
        n_features: Inputs that describe the state; the actions follow them.
        action_dim: Number of action dimensions.
        embedding_dim: Size of an embedding.
        hidden: Width of each hidden layer.
        outputs: Number of outputs.
        gate_actions: Whether the embedding scales the actions; False is the paper's network.
        interaction_rank: R; 0 is the paper's network.
        activation: Of the hidden layers, ``"silu"`` or ``"relu"``.
        output_limit: L; 0 leaves the output free.
    """

    n_features: int
    action_dim: int
    embedding_dim: int
    hidden: tuple[int, ...]
    outputs: int
    gate_actions: bool = True
    interaction_rank: int = 0
    activation: Literal["silu", "relu"] = "silu"
    output_limit: float = 0.0

    def initial(self, networks: int, weights: Literal["normal", "uniform"]) -> Theta:
        """Draws the parameters of K networks from torch's global generator.

        Args:
            networks: K.
            weights: ``"normal"`` for deviations of 1 / sqrt(inputs) and no biases, ``"uniform"`` for weights and biases
                within 1 / sqrt(inputs).
        """

        def normal(fan_in: int, fan_out: int, inputs: int) -> Tensor:
            return torch.randn(networks, fan_in, fan_out, dtype=torch.float32) / math.sqrt(inputs)

        sizes = [self.n_features + self.action_dim, *self.hidden, self.outputs]
        E, R = self.embedding_dim, self.interaction_rank
        theta = {}
        for layer, (fan_in, fan_out) in enumerate(pairwise(sizes)):
            theta[f"weight_{layer}"] = normal(fan_in, fan_out, fan_in)
            theta[f"bias_{layer}"] = torch.zeros(networks, fan_out, dtype=torch.float32)
        theta["embedding"] = normal(E, sizes[1], sizes[0] + E)
        if weights == "uniform":
            for layer, fan_in in enumerate((sizes[0] + E, *self.hidden)):
                names = [f"weight_{layer}", f"bias_{layer}", *(["embedding"] if layer == 0 else [])]
                for name in names:
                    theta[name].uniform_(-1.0 / math.sqrt(fan_in), 1.0 / math.sqrt(fan_in))
        if self.gate_actions:
            theta["gate"] = normal(E, self.action_dim, E)
        if R:
            theta["interaction_input"] = normal(sizes[0], R, sizes[0])
            theta["interaction_situation"] = normal(E, R, E)
            theta["interaction_output"] = normal(R, sizes[1], R)
        return theta

    def __call__(self, theta: Theta, x: Tensor, h: Tensor) -> Tensor:
        """Computes the outputs, (K, n, outputs).

        Args:
            theta: Parameters, (K, ...).
            x: Inputs, (K, n, n_features + action_dim).
            h: Embeddings, (K, n, embedding_dim), or (K, 1, embedding_dim) for one situation in all rows.
        """
        if self.gate_actions:
            gate = 1.0 + h @ theta["gate"]  # (K, n, action_dim)
            x = torch.cat([x[..., : self.n_features], gate * x[..., self.n_features :]], dim=-1)
        z = torch.baddbmm(theta["bias_0"][:, None], x, theta["weight_0"]) + h @ theta["embedding"]
        if self.interaction_rank:
            interaction = (x @ theta["interaction_input"]) * (h @ theta["interaction_situation"])  # (K, n, R)
            z = torch.baddbmm(z, interaction, theta["interaction_output"])
        return self.through(self._layers_behind_the_first(theta), self._activate(z))

    def folded(self, theta: Theta, h: Tensor) -> Layers:
        """Fixes the situations: what h does to the first layer becomes part of its weights.

        The result of :meth:`through` is then that of :meth:`__call__`, at the cost of a network without embeddings.

        Args:
            theta: Parameters, (K, ...).
            h: Embeddings, (K * S, embedding_dim): S situations of each network, one after the other.

        Returns:
            A first layer of K * S networks, and the other layers of K.
        """
        S = len(h) // len(theta["weight_0"])

        def first(name: str) -> Tensor:  # (K * S, ...)
            return theta[name][:, None].expand(-1, S, *theta[name].shape[1:]).flatten(0, 1)

        weight = first("weight_0")  # (K * S, in, out)
        if self.interaction_rank:
            scale = torch.einsum("ke,ker->kr", h, first("interaction_situation"))
            weight = torch.baddbmm(weight, first("interaction_input") * scale[:, None], first("interaction_output"))
        if self.gate_actions:
            gate = 1.0 + torch.einsum("ke,kea->ka", h, first("gate"))
            weight = torch.cat([weight[:, : self.n_features], gate[..., None] * weight[:, self.n_features :]], dim=1)
        bias = first("bias_0") + torch.einsum("ke,keo->ko", h, first("embedding"))
        return [(weight, bias[:, None]), *self._layers_behind_the_first(theta)]

    def through(self, layers: Layers, x: Tensor) -> Tensor:
        """Computes the last layers, (K, n, in) -> (K, n, outputs).

        Where a layer has fewer than K networks, as many rows of K that follow each other share one.
        """
        K, n = x.shape[:2]
        for weight, bias in layers[:-1]:
            x = self._activate(torch.baddbmm(bias, _sharing(x, weight), weight))
        weight, bias = layers[-1]
        z = torch.baddbmm(bias, _sharing(x, weight), weight).view(K, n, self.outputs)
        return self.output_limit * z.tanh() if self.output_limit else z

    def _layers_behind_the_first(self, theta: Theta) -> Layers:
        layers = range(1, len(self.hidden) + 1)
        return [(theta[f"weight_{layer}"], theta[f"bias_{layer}"][:, None]) for layer in layers]

    def _activate(self, z: Tensor) -> Tensor:
        inplace = not torch.is_grad_enabled()
        return F.silu(z, inplace=inplace) if self.activation == "silu" else F.relu(z, inplace=inplace)


def _sharing(x: Tensor, weight: Tensor) -> Tensor:
    """Puts the rows that share weights together, (K, n, in) -> (k, K / k * n, in) for weights (k, in, out)."""
    return x if len(x) == len(weight) else x.reshape(len(weight), -1, x.shape[-1])
