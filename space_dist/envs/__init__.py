"""Contextual environments: batched for us, registered with Gymnasium for everyone else."""

from __future__ import annotations

import contextlib
import functools
import inspect
import sys
import warnings
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import load_env_creator

from space_dist.envs.antgoal import BatchedAntGoal
from space_dist.envs.ballcatching import BatchedBallCatching
from space_dist.envs.carl import CarlEnv, is_carl
from space_dist.envs.cartpole import BatchedCartPole
from space_dist.envs.goalmaze import BatchedGoalMaze
from space_dist.envs.interface import (
    BatchedEnv,
    ContextVisible,
    Distribution,
    Drawable,
    DrawsContexts,
    KnowsOptimum,
    Step,
    close,
)
from space_dist.envs.maze import BatchedMaze
from space_dist.envs.mixed_maze import BatchedMixedMaze
from space_dist.envs.observations import Observations
from space_dist.envs.pointmass import BatchedPointMass
from space_dist.envs.single import ContextObservation, SingleEnv
from space_dist.envs.singles import BatchedSingles
from space_dist.envs.sparse_pointmass import BatchedSparsePointMass
from space_dist.errors import ConfigError, nearest
from space_dist.instances import ContextBounds
from space_dist.system import arguments
from space_dist.system.import_paths import without_colon
from space_dist.system.importing import load

BATCHED: dict[str, Callable[..., BatchedEnv]] = {
    "space_dist/PointMass-v0": BatchedPointMass,
    "space_dist/SparsePointMass-v0": BatchedSparsePointMass,
    "space_dist/GoalMaze-v0": BatchedGoalMaze,
    "space_dist/CartPole-v0": BatchedCartPole,
    "space_dist/AntGoal-v0": BatchedAntGoal,
    "space_dist/BallCatching-v0": BatchedBallCatching,
    "space_dist/Maze-v0": BatchedMaze,
    "space_dist/MixedMaze-v0": BatchedMixedMaze,
}
BULLET_IDS = frozenset({"space_dist/AntGoal-v0", "space_dist/BallCatching-v0"})
"""Those whose physics are PyBullet's."""


def make_single(env_id: str, **kwargs: Any) -> SingleEnv:
    """The Gymnasium environment behind a registered id of ours. Raises ConfigError for another."""
    if env_id not in BATCHED:
        raise ConfigError(f"env.id {env_id!r} is none of ours{nearest(env_id, BATCHED)} Allowed: {', '.join(BATCHED)}")
    return SingleEnv(lambda n_slots: BATCHED[env_id](n_slots, **kwargs))


for _id in BATCHED:
    if _id not in gym.registry:
        gym.register(id=_id, entry_point="space_dist.envs:make_single", kwargs={"env_id": _id}, order_enforce=True)


def make_batched(
    env_id: str | Callable[..., Any], n_slots: int, *, context_visible: bool,
    kwargs: Mapping[str, Any] = MappingProxyType({}),
) -> BatchedEnv:  # fmt: skip
    """Build a batched environment by registered id, by import path (`my_package.my_module:make`), or by a function.

    A function that takes a number of slots (a parameter `n_slots`, or one without a default that
    `kwargs` does not give) is called with it and `kwargs`, and returns a `BatchedEnv`. Any other is called with
    `kwargs` alone and returns a `gymnasium.Env`, of which `BatchedSingles` makes a batch; `horizon` in `kwargs` is
    then for that, unless the function has a parameter of this name. Classes of CARL's are wrapped in `CarlEnv`.

    Raises ConfigError if there is no such environment, or none with such arguments.
    """
    make = env_id if callable(env_id) else _find(env_id)
    where = _named(env_id)
    try:
        if _takes_slots(make, kwargs):
            env = _made(env_id, make, (n_slots,), kwargs)
        else:
            own = dict(kwargs)
            horizon = None if _takes(make, "horizon") else own.pop("horizon", None)
            env = _made(env_id, make, (), own)
            if isinstance(env, gym.Env):
                # The first is here already; the others must be its equals and not itself.
                ready = [env]
                env = BatchedSingles(n_slots, lambda: ready.pop() if ready else make(**own), horizon)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
    except (Exception, SystemExit) as error:  # somebody else's code may raise anything
        of = " of env.kwargs" if kwargs else ""
        raise ConfigError(f"{where} cannot be made{of}: {type(error).__name__}: {str(error)[:200]}") from error
    _refuse_interface(where, env)
    batched: BatchedEnv = env
    return ContextVisible(batched) if context_visible else batched


def unwrapped(env: BatchedEnv) -> BatchedEnv:
    """The environment itself, without what makes its context visible."""
    return env.unwrapped if isinstance(env, ContextVisible) else env


def takes_argument(env_id: str, name: str) -> bool:
    """Whether the function or class behind an id has a parameter of this name."""
    return _takes(_find(env_id), name)


def _named(env_id: str | Callable[..., Any]) -> str:
    """What sentences call an environment."""
    if isinstance(env_id, str):
        return f"env.id {env_id!r}"
    return f"the environment {getattr(env_id, '__qualname__', repr(env_id))}"


def _takes(make: Callable[..., Any], name: str) -> bool:
    try:
        return name in inspect.signature(make).parameters
    except (TypeError, ValueError):  # written in C
        return False


def distribution_of(env_id: str, kwargs: Mapping[str, Any] = MappingProxyType({})) -> Distribution:
    """What an environment's contexts are drawn from where nothing else is known: uniform within the bounds.

    The environment's own, if it draws its contexts. Whole numbers, if its contexts are such.
    """
    env = make_batched(env_id, 1, context_visible=False, kwargs=kwargs)
    bounds = env.context_bounds
    if isinstance(env, DrawsContexts):  # stays open: whoever has the distribution draws with it
        return Distribution(f"{env_id}, its own", "the environment", bounds, env.draw_contexts)
    whole = isinstance(env, BatchedSingles) and env.whole_contexts
    close(env)
    if whole:
        return Distribution(
            f"{env_id}, whole numbers, uniform within the bounds", "the environment (the bounds)", bounds,
            lambda rng, n: rng.integers(
                np.ceil(bounds.low).astype(int), np.floor(bounds.high).astype(int), size=(n, len(bounds.low)),
                endpoint=True,
            ).astype(np.float64),
        )  # fmt: skip
    return Distribution(
        f"{env_id}, uniform within the bounds", "the environment (the bounds)", bounds,
        lambda rng, n: rng.uniform(bounds.low, bounds.high, size=(n, len(bounds.low))),
    )  # fmt: skip


def _takes_slots(make: Callable[..., Any], kwargs: Mapping[str, Any]) -> bool:
    try:
        parameters = inspect.signature(make).parameters
    except (TypeError, ValueError):  # written in C
        return True
    return "n_slots" in parameters or any(
        parameter.kind in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)
        and parameter.default is parameter.empty
        and name not in kwargs
        for name, parameter in parameters.items()
    )


def _made(
    env_id: str | Callable[..., Any], make: Callable[..., Any], positional: tuple[int, ...], kwargs: Mapping[str, Any]
) -> Any:  # fmt: skip
    """What `make` makes. Raises ConfigError if it does not take these arguments."""
    refused = "env.kwargs: it cannot be made with them"
    try:
        if kwargs:
            inspect.signature(make).bind(*positional, **kwargs)
    except TypeError as error:
        text = _unknown_argument(error, env_id, make, len(positional), kwargs)
        raise ConfigError(f"{refused}: {error if text is None else text}") from None
    try:
        return make(*positional, **kwargs)
    except TypeError as error:  # of what takes any argument, and hands it on
        if (text := _unknown_argument(error, env_id, make, len(positional), kwargs)) is None:
            raise
        raise ConfigError(f"{refused}: {text}") from error


def _unknown_argument(
    error: TypeError, env_id: str | Callable[..., Any], make: Callable[..., Any], positional: int,
    kwargs: Mapping[str, Any],
) -> str | None:  # fmt: skip
    """What to say of an argument in `kwargs` that an environment does not take; None if that is not what is wrong."""
    of_gymnasium = isinstance(env_id, str) and env_id not in BATCHED and env_id in gym.registry
    entry = gym.registry[str(env_id)].entry_point if of_gymnasium else None
    called = load_env_creator(entry) if isinstance(entry, str) else entry or make
    own = arguments.own_arguments(called, positional=positional)
    names = own if positional else list(dict.fromkeys([*own, "horizon"]))  # which a batch of single ones has
    return arguments.told(error, kwargs, lambda word: arguments.listing(nearest(word, names), own and names))


def _refuse_interface(where: str, env: Any) -> None:
    if isinstance(env, gym.Env):
        raise ConfigError(
            f"{where} was called with a number of slots and returned one gymnasium.Env; the function of a "
            "single environment needs no argument but those in env.kwargs"
        )
    if isinstance(env, gym.vector.VectorEnv):
        raise ConfigError(
            f"{where} made a Gymnasium vector environment, which resets by itself and so with no context; "
            "return a single gymnasium.Env instead"
        )
    if any(
        kind.__module__.startswith("stable_baselines3.") and kind.__name__ == "VecEnv" for kind in type(env).__mro__
    ):
        raise ConfigError(
            f"{where} made a {type(env).__name__}, a vectorised environment of Stable-Baselines3's, which resets by "
            "itself and so with no context; return a single environment, and wrap the ContextVecEnv made of it"
        )
    missing = [name for name in ("reset", "step", "horizon", "observation_space", "action_space", "context_bounds")
               if not hasattr(env, name)]  # fmt: skip
    if missing:
        raise ConfigError(f"{where} made a {type(env).__name__} without {', '.join(missing)}")
    wanted: dict[str, tuple[type, str]] = {
        "horizon": (int, "a whole number of steps, at least 1"),
        "context_bounds": (ContextBounds, "ContextBounds"),
        "observation_space": (gym.spaces.Space, "a Gymnasium space"),
        "action_space": (gym.spaces.Space, "a Gymnasium space"),
    }
    for name, (kind, what) in wanted.items():
        value: Any = getattr(env, name)
        if not isinstance(value, kind) or (name == "horizon" and env.horizon < 1):
            raise ConfigError(f"{where}: its {name} must be {what}, not {str(value)[:80]!r}")


def _alike(module: str, name: str) -> str:
    """`; did you mean 'Lander'?` where an imported module has something callable of such a name."""
    found = {known for known, value in vars(sys.modules[module]).items() if callable(value)}
    return nearest(name, found).removesuffix(".")


def _find(env_id: str) -> Callable[..., Any]:
    if env_id in BATCHED:
        return BATCHED[env_id]
    if env_id in gym.registry:  # somebody else's: made as Gymnasium makes it, TimeLimit included
        return lambda **kwargs: gym.make(env_id, disable_env_checker=True, **kwargs)
    module, colon, name = env_id.partition(":")
    if not colon:
        if (told := without_colon(env_id, gym.Env)) is not None:
            raise ConfigError(f"env.id {env_id!r}: {told}")
        raise ConfigError(
            f"env.id {env_id!r} is not known{nearest(env_id, BATCHED)} Known: {', '.join(BATCHED)}, "
            f"an id registered with Gymnasium, or an import path: MODULE:NAME, like my_package.my_module:make"
        )
    carl = module.partition(".")[0] == "carl"
    # Only where needed: leaving `catch_warnings` has Python forget what it has warned of already.
    with warnings.catch_warnings() if carl else contextlib.nullcontext():
        if carl:  # warns of each of its suites that is not installed
            warnings.simplefilter("ignore")
        found: Any = load(env_id, "env.id", of_library=gym.Env)
    if carl and not is_carl(found):
        raise ConfigError(
            f"env.id {env_id!r}: of CARL's modules a config names environments, like carl.envs:CARLCartPole"
        )
    if not callable(found):
        raise ConfigError(f"env.id {env_id!r}: {module!r} has no class or function {name!r}{_alike(module, name)}")
    made: Callable[..., Any] = functools.partial(CarlEnv, found) if is_carl(found) else found
    return made


__all__ = [
    "BatchedAntGoal",
    "BatchedBallCatching",
    "BatchedCartPole",
    "BatchedEnv",
    "BatchedGoalMaze",
    "BatchedMaze",
    "BatchedMixedMaze",
    "BatchedPointMass",
    "BatchedSingles",
    "BatchedSparsePointMass",
    "ContextObservation",
    "ContextVisible",
    "Distribution",
    "Drawable",
    "DrawsContexts",
    "KnowsOptimum",
    "Observations",
    "SingleEnv",
    "Step",
    "close",
    "distribution_of",
    "make_batched",
    "takes_argument",
    "unwrapped",
]
