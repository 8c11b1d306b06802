"""What environments and functions are, as JSON types that are the same in another process."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Set
from functools import partial
from types import CodeType, FunctionType, MethodType
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from torch import Tensor, nn

from famle_agent.data.description import ONLOOKERS

__all__ = ["identity"]


def identity(value: Any) -> Any:
    """Says what a value is, so that two that do different things differ.

    A function is its code, and what it was given: defaults, what it encloses, and data among the globals that it names.
    An environment is the code of its class and of its wrappers', its arguments, and the functions that it was given. Of
    another object the fields count where it is a dataclass or can be called. What functions call in turn, and what else
    an object holds, is not looked at: it changes as it is used.

    Args:
        value: Anything.

    Returns:
        JSON types; long ones as a digest.
    """
    return _identity(value, ())


def _identity(value: Any, above: tuple[int, ...]) -> Any:
    """See :func:`identity`; ``above`` are the identities of the objects that hold this one."""
    if id(value) in above:
        return "itself"
    inner = partial(_identity, above=(*above, id(value)))
    for kinds, describe in _KINDS:
        if isinstance(value, kinds):
            return describe(value, inner)
    if callable(value) or dataclasses.is_dataclass(value):
        name = getattr(value, "__qualname__", "")  # of what Python and its libraries have in C
        return [type(value).__qualname__, name, inner(vars(value) if hasattr(value, "__dict__") else {})]
    return type(value).__qualname__


Inner = Callable[[Any], Any]
"""Says what a part of a value is."""


def _array(value: Any, _: Inner) -> Any:
    values = np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value)
    if values.dtype.hasobject:
        return [repr(values.dtype), list(values.shape)]
    return [str(values.dtype), list(values.shape), hashlib.sha256(values.tobytes()).hexdigest()[:16]]


def _function(function: FunctionType, inner: Inner) -> Any:
    code, known = function.__code__, function.__globals__
    enclosed = dict(zip(code.co_freevars, map(_content, function.__closure__ or ()), strict=True))
    named = {name: known[name] for name in sorted(set(_names(code))) if isinstance(known.get(name), _DATA)}
    given = [function.__defaults__, function.__kwdefaults__, enclosed, named]
    return [function.__qualname__, _code(code), *map(inner, given)]


def _env(env: gym.Env[Any, Any], inner: Inner) -> Any:
    layers = [layer for layer in _layers(env) if type(layer).__name__ not in ONLOOKERS]
    given = [{name: value for name, value in vars(layer).items() if isinstance(value, _FUNCTIONS)} for layer in layers]
    return [[_class(type(layer), inner) for layer in layers], inner(given), inner(env.spec)]


def _spec(spec: EnvSpec, inner: Inner) -> Any:
    wrappers = [item for item in spec.additional_wrappers if item.name not in ONLOOKERS]
    made = spec.id, inner(spec.entry_point), spec.max_episode_steps, inner(spec.kwargs)
    return [*made, [[item.name, inner(item.kwargs)] for item in wrappers]]


def _class(kind: type, _: Inner) -> Any:
    functions = {name: _code(value.__code__) for name, value in vars(kind).items() if isinstance(value, FunctionType)}
    return [kind.__qualname__, hashlib.sha256(repr(sorted(functions.items())).encode()).hexdigest()[:16]]


def _layers(env: gym.Env[Any, Any]) -> Iterator[gym.Env[Any, Any]]:
    while isinstance(env, gym.Wrapper):
        yield env
        env = env.env
    yield env


def _content(cell: Any) -> Any:
    """What a cell of a closure holds; None where that was not set yet."""
    try:
        return cell.cell_contents
    except ValueError:
        return None


def _names(code: CodeType) -> Iterator[str]:
    """The names of globals and attributes in a function, and in those inside it."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _code(code: CodeType) -> str:
    """A digest of what a function does, wherever it stands."""
    constants = [_code(item) if isinstance(item, CodeType) else _constant(item) for item in code.co_consts]
    parts = code.co_code, constants, code.co_names
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]


def _constant(value: Any) -> str:
    return repr(sorted(map(repr, value))) if isinstance(value, frozenset) else repr(value)  # which has no order


_DATA = (bool, int, float, str, tuple, np.ndarray, np.generic, Tensor)
_FUNCTIONS = (FunctionType, MethodType, partial)
_KINDS: tuple[tuple[Any, Callable[[Any, Inner], Any]], ...] = (
    ((type(None), bool, int, float, str), lambda value, _: value),
    ((np.ndarray, np.generic, Tensor), _array),
    (Mapping, lambda value, inner: [[str(key), inner(item)] for key, item in value.items()]),
    ((tuple, list), lambda value, inner: [inner(item) for item in value]),
    (Set, lambda value, inner: sorted(json.dumps(inner(item)) for item in value)),
    (type, _class),
    (FunctionType, _function),
    (MethodType, lambda value, inner: [inner(value.__func__), inner(value.__self__)]),
    (partial, lambda value, inner: [inner(value.func), inner(value.args), inner(value.keywords)]),
    (gym.Env, _env),
    (EnvSpec, _spec),
    (nn.Module, lambda value, inner: [type(value).__qualname__, inner(value.state_dict())]),
)
"""How each type is described; the first that fits counts."""
