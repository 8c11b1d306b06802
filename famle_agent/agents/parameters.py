"""An agent's weights as Stable-Baselines3's parameters: the state of each network by its name."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from famle_agent.agents.policy import AdaptivePolicy
from famle_agent.agents.world_model import WorldModel

__all__ = ["Parameters", "parameters_of", "with_parameters"]

Parameters = Mapping[str, Mapping[str, Tensor]]

_NETWORKS = frozenset({"dynamics", "reward", "termination", "actor_critic"})


def parameters_of(world: WorldModel | None) -> dict[str, dict[str, Tensor]]:
    """Returns the state of each network by its name; nothing where nothing was learnt."""
    return {} if world is None else {name: part.state_dict() for name, part in world.parts().items()}


def with_parameters(
    policy: AdaptivePolicy, given: Parameters, situations: tuple[str, ...], exact_match: bool
) -> WorldModel:
    """Makes the model that has these weights; the policy's own stays what it is.

    Args:
        policy: Its settings count, and its own weights where others are missing.
        given: The weights of each network.
        situations: What the situations of the weights are called.
        exact_match: Whether all networks and all of their weights must be given.

    Raises:
        ValueError: A network is unknown or missing, or the weights do not fit the settings.
    """
    own = parameters_of(policy.world)
    if unknown := sorted(given.keys() - _NETWORKS):
        raise ValueError(f"An agent has no network {', '.join(unknown)}; it may have {', '.join(sorted(_NETWORKS))}.")
    expected = own.keys() or {"dynamics"}
    if missing := sorted(expected - given.keys() if exact_match else {"dynamics"} - own.keys() - given.keys()):
        raise ValueError(
            f"Names of parameters do not match: those of {', '.join(missing)} are missing. exact_match=False keeps the "
            "agent's own in their place, where it has any."
        )
    if exact_match:
        weights = {name: dict(state) for name, state in given.items()}
    else:
        weights = {name: _merged(own.get(name, {}), given.get(name, {})) for name in own.keys() | given.keys()}
    try:
        return policy.builder.load(weights, situations)
    except (KeyError, RuntimeError, TypeError) as error:
        raise ValueError(f"The parameters do not fit the agent's settings: {error}") from error


def _merged(own: Mapping[str, Tensor], given: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """A network's own weights with the given ones in their place; what it does not have is left out."""
    return {**own, **{name: value for name, value in given.items() if not own or name in own}}
