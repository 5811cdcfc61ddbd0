"""Single Gymnasium environments, stepped one after another as one batch."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray

from space_dist.envs.interface import FloatArray, IntArray, Step
from space_dist.envs.observations import Observations, allocate, put, take
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.instances import ContextBounds

SUCCESS_KEYS = ("success", "is_success")  # of an info
_RESET = ("observation", "info")  # what each returns in Gymnasium
_STEP = ("observation", "reward", "terminated", "truncated", "info")


class BatchedSingles:
    """`n_slots` Gymnasium environments that take their context with `reset(options={"context": array})`.

    Each needs a `context_space`, a one-dimensional Box with finite bounds, and may name its features
    (`context_names`; else feature_0, feature_1, ...). The context arrives in that space's dtype, and every episode
    brings a seed of its own. An episode that has not ended by itself is truncated after `horizon` steps: the argument,
    or the environment's own `horizon`, or that of its `TimeLimit`, or `spec.max_episode_steps`.

    Success is `info["success"]` or `info["is_success"]` at the end of every episode, or of none.

    make: gives a new environment at each call; called once at first, and once for every other slot that is used.
    Raises ConfigError if the environment lacks any of this.
    """

    def __init__(self, n_slots: int, make: Callable[[], gym.Env[Any, Any]], horizon: int | None = None) -> None:
        first = make()
        self._make, self._envs = make, {0: first}
        self.n_slots = n_slots
        self.observation_space: spaces.Space[Any] = first.observation_space
        self.action_space: spaces.Space[Any] = first.action_space
        _refuse_observation_space(self.observation_space)
        self._context_space = _context_space(first)
        self.context_bounds = _bounds(first, self._context_space)
        _refuse_reset(first)
        self.horizon = _horizon(first, horizon)
        self._time = np.zeros(n_slots, dtype=np.int64)
        self._observations = allocate(self.observation_space, n_slots)
        self._tells_success: bool | None = None  # until the first episode has ended
        self.infos: list[dict[str, Any]] = [{} for _ in range(n_slots)]
        """Of the last step, by slot, as the environments told them."""

    @property
    def first(self) -> gym.Env[Any, Any]:
        """The environment of slot 0."""
        return self._envs[0]

    def single(self, slot: int) -> gym.Env[Any, Any]:
        """The environment of a slot."""
        if slot not in self._envs:
            self._envs[slot] = self._another()
        return self._envs[slot]

    @property
    def whole_contexts(self) -> bool:
        """Whether contexts hold whole numbers only."""
        return bool(np.issubdtype(self._context_space.dtype, np.integer))

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> Observations:
        """Start new episodes. Raises SpaceDistError where the environment breaks its word."""
        for slot, context, seed in zip(slots.tolist(), contexts, seeds.tolist(), strict=True):
            given = context.astype(self._context_space.dtype)
            if self.whole_contexts and (given != context).any():
                raise SpaceDistError(f"the context {context.tolist()} must hold whole numbers, as context_space says")
            env = self.single(slot)
            told = env.reset(seed=seed, options={"context": given})
            if not _is_told(told, _RESET):
                raise _other_than(env, "reset", told, _RESET)
            self._keep(slot, told[0])
        self._time[slots] = 0
        return take(self._observations, slots)

    def step(self, actions: NDArray[np.generic]) -> Step:
        """One step of every environment, in slot order. Raises SpaceDistError where one breaks its word."""
        n = self.n_slots
        rewards, success = np.empty(n), np.zeros(n, dtype=np.bool_)
        terminated, truncated = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
        known = False
        self._time += 1
        for slot in range(n):
            action = int(actions[slot]) if actions.ndim == 1 else np.array(actions[slot])
            told = self._envs[slot].step(action)
            if not _is_told(told, _STEP):
                raise _other_than(self._envs[slot], "step", told, _STEP)
            observation, rewards[slot], ended, cut, info = told
            self._keep(slot, observation)
            self.infos[slot] = info
            terminated[slot] = ended
            truncated[slot] = (cut or self._time[slot] >= self.horizon) and not ended
            found = [info[key] for key in SUCCESS_KEYS if key in info]
            known |= bool(found)
            success[slot] = bool(found and found[0])
            if terminated[slot] or truncated[slot]:
                self._refuse_other_manners(bool(found))
        observations = take(self._observations, slice(None))
        return Step(observations, rewards, terminated, truncated, success if known else None)

    def frame(self, slot: int) -> NDArray[np.uint8]:
        """What the slot's own `render` draws. Raises ConfigError if that is no picture."""
        drawn = self._envs[slot].render() if self._envs[slot].render_mode == "rgb_array" else None
        if not isinstance(drawn, np.ndarray) or drawn.ndim != 3 or drawn.shape[2] != 3:
            raise ConfigError(
                "this environment draws no pictures: its function must take `render_mode` and hand it to a "
                "gymnasium.Env whose render() returns (height, width, 3) with render_mode='rgb_array'"
            )
        return drawn.astype(np.uint8, copy=False)

    def close(self) -> None:
        """Close the environments of all slots, whatever one of them raises. `reset` afterwards makes new ones."""
        envs, self._envs = self._envs, {}
        with contextlib.ExitStack() as closing:
            for env in envs.values():
                closing.callback(env.close)

    def _another(self) -> gym.Env[Any, Any]:
        env = self._make()
        if any(env is other for other in self._envs.values()):
            raise SpaceDistError("its function returned the same environment twice; every call must make a new one")
        return env

    def _keep(self, slot: int, observation: Any) -> None:
        """Refuses what assignment would stretch to fit without a word."""
        named = observation.items() if isinstance(observation, dict) else [("", observation)]
        for name, array in named:
            space = self.observation_space[name] if isinstance(self.observation_space, spaces.Dict) else None
            wanted = (space or self.observation_space).shape
            if np.shape(array) != wanted:
                where = f" {name!r}" if name else ""
                raise SpaceDistError(f"an observation{where} has shape {np.shape(array)}, its space has {wanted}")
        put(self._observations, slot, observation)

    def _refuse_other_manners(self, tells: bool) -> None:
        if self._tells_success is None:
            self._tells_success = tells
        if self._tells_success != tells:
            raise SpaceDistError(
                'info holds "success" (or "is_success") at the end of some episodes and not of others: tell it at the '
                "end of every episode, or never"
            )


def _refuse_observation_space(space: spaces.Space[Any]) -> None:
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
    if not all(isinstance(part, spaces.Box) for part in parts):
        raise ConfigError(f"its observation_space must be a Box or a Dict of Boxes, not {str(space)[:80]}")


def _context_space(env: gym.Env[Any, Any]) -> spaces.Box:
    try:
        space = env.get_wrapper_attr("context_space")
    except AttributeError:
        raise ConfigError(
            "it has no `context_space`, so it knows no contexts. Give it one (a gymnasium.spaces.Box with one number "
            'for each feature) and let reset() take options={"context": array}; docs/your_environment.md shows how'
        ) from None
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise ConfigError(f"its context_space must be a one-dimensional Box, not {str(space)[:80]}")
    return space


def _bounds(env: gym.Env[Any, Any], space: spaces.Box) -> ContextBounds:
    # The shortest decimals: a float32 bound of 0.1 means 0.1, not 0.10000000149.
    low, high = (np.array([float(str(bound)) for bound in side]) for side in (space.low, space.high))
    try:
        told = env.get_wrapper_attr("context_names")
    except AttributeError:
        told = [f"feature_{index}" for index in range(len(low))]
    if not isinstance(told, list | tuple) or len(told) != len(low):
        raise ConfigError(
            f"its context_names must be a tuple of {len(low)} names, one for each number of its context_space, not "
            f"{str(told)[:80]!r}"
        )
    names = tuple(map(str, told))
    try:
        return ContextBounds(names, low, high)
    except ConfigError as error:
        raise ConfigError(f"its context_space cannot be used: {error}") from None


def _refuse_reset(env: gym.Env[Any, Any]) -> None:
    """Refuse a `reset` that no seed or no context can be given; Gymnasium's wrappers hand on what they are given."""
    while isinstance(env, gym.Wrapper) and type(env).__module__.partition(".")[0] == "gymnasium":
        env = env.env
    try:
        parameters = inspect.signature(env.reset).parameters
    except (TypeError, ValueError):  # written in C
        return
    if any(one.kind is one.VAR_KEYWORD for one in parameters.values()):
        return
    missing = [f"`{name}`" for name in ("seed", "options") if name not in parameters]
    if missing:
        raise ConfigError(
            f"{type(env).__name__}.reset() takes no {' and no '.join(missing)}; as in Gymnasium it must be "
            'reset(self, *, seed=None, options=None), and contexts come as options={"context": array}'
        )


def _is_told(told: Any, parts: tuple[str, ...]) -> bool:
    """Whether a call returned as many parts as it should, and an info, of which nobody reads that of `reset`."""
    if not isinstance(told, tuple | list) or len(told) != len(parts):
        return False
    return isinstance(told[-1], Mapping) or (told[-1] is None and parts is _RESET)


def _other_than(env: gym.Env[Any, Any], method: str, told: Any, parts: tuple[str, ...]) -> SpaceDistError:
    if not isinstance(told, tuple | list):
        found = f"what it returned is no tuple but of type {type(told).__name__}"
    elif len(told) != len(parts):
        found = f"it returned {len(told)} values"
    else:
        found = f"the info that it returned is no dict but of type {type(told[-1]).__name__}"
    return SpaceDistError(
        f"{type(env.unwrapped).__name__}.{method}() must return ({', '.join(parts)}), as in Gymnasium; {found}"
    )


def _time_limit(env: gym.Env[Any, Any]) -> int | None:
    """Of the strictest `TimeLimit`, which tells it in its spec only if the environment was made by an id."""
    limits, wrapped = [], env
    while isinstance(wrapped, gym.Wrapper):
        if isinstance(wrapped, TimeLimit):
            limits.append(wrapped._max_episode_steps)
        wrapped = wrapped.env
    return min(limits, default=env.spec.max_episode_steps if env.spec is not None else None)


def _horizon(env: gym.Env[Any, Any], given: int | None) -> int:
    found: Any = given
    if found is None:
        try:
            found = env.get_wrapper_attr("horizon")
        except AttributeError:
            found = _time_limit(env)
    if found is None:
        raise ConfigError(
            "the length of its episodes is unknown: give it an attribute `horizon`, wrap it in Gymnasium's TimeLimit, "
            "or set env.kwargs.horizon: the number of steps after which an episode is truncated"
        )
    if not isinstance(found, int | np.integer) or isinstance(found, bool) or found < 1:
        raise ConfigError(f"its horizon must be a whole number of steps, at least 1, not {str(found)[:80]!r}")
    return int(found)
