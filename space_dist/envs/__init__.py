"""Contextual environments: batched for us, registered with Gymnasium for everyone else."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import gymnasium as gym

from space_dist.envs.cartpole import BatchedCartPole
from space_dist.envs.interface import BatchedEnv, ContextVisible, Step
from space_dist.envs.maze import BatchedMaze
from space_dist.envs.observations import Observations
from space_dist.envs.pointmass import BatchedPointMass
from space_dist.envs.single import ContextObservation, SingleEnv
from space_dist.errors import ConfigError, nearest
from space_dist.instances import ContextBounds

BATCHED: dict[str, Callable[..., BatchedEnv]] = {
    "space_dist/PointMass-v0": BatchedPointMass,
    "space_dist/CartPole-v0": BatchedCartPole,
    "space_dist/Maze-v0": BatchedMaze,
}


def make_single(env_id: str, **kwargs: Any) -> SingleEnv:
    """The Gymnasium environment behind a registered id."""
    return SingleEnv(lambda n_slots: BATCHED[env_id](n_slots, **kwargs))


for _id in BATCHED:
    if _id not in gym.registry:
        gym.register(id=_id, entry_point="space_dist.envs:make_single", kwargs={"env_id": _id}, order_enforce=True)


def make_batched(
    env_id: str, n_slots: int, *, context_visible: bool, kwargs: Mapping[str, Any] = MappingProxyType({})
) -> BatchedEnv:
    """Build a batched environment by registered id or by import path (`my_package.my_module:make`).

    A function at an import path is called with the number of slots, and `kwargs`, and returns a `BatchedEnv`.
    Raises ConfigError if there is no such environment, or none with such arguments.
    """
    make = _find(env_id)
    if kwargs:
        try:
            inspect.signature(make).bind(n_slots, **kwargs)
        except TypeError as error:
            raise ConfigError(f"env.kwargs: {env_id} cannot be made with them: {error}") from None
    try:
        env: BatchedEnv = make(n_slots, **kwargs)
    except (Exception, SystemExit) as error:  # somebody else's code may raise anything
        raise ConfigError(f"env.id {env_id!r} cannot be made: {type(error).__name__}: {str(error)[:200]}") from error
    missing = [name for name in ("reset", "step", "horizon", "observation_space", "action_space", "context_bounds")
               if not hasattr(env, name)]  # fmt: skip
    if missing:
        raise ConfigError(f"env.id {env_id!r} made a {type(env).__name__} without {', '.join(missing)}")
    wanted: dict[str, tuple[type, str]] = {
        "horizon": (int, "a whole number of steps, at least 1"),
        "context_bounds": (ContextBounds, "ContextBounds"),
        "observation_space": (gym.spaces.Space, "a Gymnasium space"),
        "action_space": (gym.spaces.Space, "a Gymnasium space"),
    }
    for name, (kind, what) in wanted.items():
        value: Any = getattr(env, name)
        if not isinstance(value, kind) or (name == "horizon" and env.horizon < 1):
            raise ConfigError(f"env.id {env_id!r}: its {name} must be {what}, not {str(value)[:80]!r}")
    return ContextVisible(env) if context_visible else env


def _find(env_id: str) -> Callable[[int], Any]:
    if env_id in BATCHED:
        return BATCHED[env_id]
    module_name, colon, name = env_id.partition(":")
    if not colon:
        raise ConfigError(
            f"env.id {env_id!r} is not known{nearest(env_id, BATCHED)} Known: {', '.join(BATCHED)}, "
            "or an import path like my_package.my_module:make"
        )
    try:
        found = getattr(importlib.import_module(module_name), name, None)
    except (Exception, SystemExit) as error:  # somebody else's module may raise anything
        what = f"{type(error).__name__}: {str(error)[:200]}"
        raise ConfigError(f"env.id {env_id!r}: cannot import {module_name!r}: {what}") from error
    if not callable(found):
        raise ConfigError(f"env.id {env_id!r}: {module_name!r} has no function {name!r}")
    made: Callable[[int], Any] = found
    return made


__all__ = [
    "BatchedCartPole",
    "BatchedEnv",
    "BatchedMaze",
    "BatchedPointMass",
    "ContextObservation",
    "ContextVisible",
    "Observations",
    "SingleEnv",
    "Step",
    "make_batched",
]
