"""What an environment is to us: many slots of the same environment, stepped together, each with its own context."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.envs.observations import Observations, alike
from space_dist.errors import ConfigError
from space_dist.instances import ContextBounds

log = logging.getLogger("space_dist")

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Distribution:
    """What instances are drawn from. `draw(rng, n)` gives `(n, d)` contexts within `bounds`, independent rows.

    `content` turns `(n, d)` contexts into rows that are equal where two contexts mean the same.
    """

    description: str
    source: str
    bounds: ContextBounds
    draw: Callable[[np.random.Generator, int], NDArray[np.float64]]
    content: Callable[[NDArray[np.float64]], NDArray[np.float64]] = lambda contexts: contexts


@dataclass(frozen=True)
class Step:
    """What one step of all slots gave.

    observations: (n_slots, *observation_shape) after the step, or a dictionary of such; nothing resets by itself.
    rewards: (n_slots,).  terminated, truncated: (n_slots,).
    success: (n_slots,) whether the goal is reached *now*; None where the environment knows no success.
    """

    observations: Observations
    rewards: FloatArray
    terminated: BoolArray
    truncated: BoolArray
    success: BoolArray | None


class BatchedEnv(Protocol):
    """`n_slots` independent copies.

    An episode is a pure function of (context, seed, actions): never of its slot, its neighbours, or what ran before.
    """

    @property
    def n_slots(self) -> int:
        """How many episodes run at once."""

    @property
    def horizon(self) -> int:
        """Steps after which an episode is truncated."""

    @property
    def observation_space(self) -> spaces.Space[Any]:
        """Of one slot: a Box, or a Dict of Boxes."""

    @property
    def action_space(self) -> spaces.Space[Any]:
        """Of one slot."""

    @property
    def context_bounds(self) -> ContextBounds:
        """Names and bounds of a context's features."""

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> Observations:
        """Start new episodes in `slots` (k,), with `contexts` (k, d) and `seeds` (k,); returns (k, ...)."""

    def step(self, actions: NDArray[np.generic]) -> Step:
        """Step every slot. actions: (n_slots, *action_shape). A slot whose episode has ended must be reset first."""


@runtime_checkable
class Closable(Protocol):
    """A batched environment that holds more than memory of Python's."""

    def close(self) -> None:
        """Free it. May be called twice; `reset` afterwards takes it anew."""


def close(env: BatchedEnv) -> None:
    """Have an environment free what it holds, if it holds anything; nobody uses it afterwards.

    Somebody else's `close` may raise anything, and what is done with the environment is done: that is logged alone.
    """
    if isinstance(env, Closable):
        try:
            env.close()
        except (Exception, SystemExit) as error:
            log.warning("an environment cannot be closed: %s: %s", type(error).__name__, error)


MakeBatched = Callable[[int], BatchedEnv]


@contextlib.contextmanager
def opened(make: MakeBatched, n_slots: int) -> Iterator[BatchedEnv]:
    """A new environment for as long as the context lasts."""
    env = make(n_slots)
    try:
        yield env
    finally:
        close(env)


@runtime_checkable
class Compilable(Protocol):
    """A batched environment that has a compiled twin of its physics. Asked for where learners are compiled as well."""

    def compile_physics(self) -> None:
        """Compute steps by it from now on, with the same bits. May be called twice."""


@runtime_checkable
class DrawsContexts(Protocol):
    """A batched environment whose contexts are not just any numbers within their bounds."""

    def draw_contexts(self, rng: np.random.Generator, n: int) -> FloatArray:
        """`(n, d)` contexts for whoever gives none."""


@runtime_checkable
class EditsContexts(Protocol):
    """An environment, batched or single, whose contexts can be changed a little and stay contexts."""

    def edit_contexts(self, rng: np.random.Generator, contexts: FloatArray, edits: int) -> FloatArray:
        """`(n, d)` the (n, d) contexts, each after `edits` small changes of its own, within the bounds."""


@runtime_checkable
class Canonical(Protocol):
    """An environment, batched or single, of which contexts that differ in their numbers may mean the same."""

    def canonical(self, contexts: FloatArray) -> FloatArray:
        """`(n, ...)` rows that are equal where two of the (n, d) contexts mean the same."""


@runtime_checkable
class DrawsUnsolvable(Protocol):
    """An environment, batched or single, that knows of contexts in which no policy succeeds."""

    def draw_unsolvable(self, rng: np.random.Generator, n: int) -> FloatArray:
        """`(n, d)` such contexts, within the bounds, independent rows.

        Raises ConfigError if, made with these arguments, it has none.
        """


@runtime_checkable
class KnowsOptimum(Protocol):
    """A batched environment that knows what a perfect policy would earn."""

    def optimal_returns(self, contexts: FloatArray) -> FloatArray:
        """`(n, d) -> (n,)` the highest undiscounted return of an episode in each context."""


@runtime_checkable
class Drawable(Protocol):
    """A batched environment that can draw itself, for `space-dist render`."""

    def frame(self, slot: int) -> NDArray[np.uint8]:
        """`(height, width, 3)`: what a slot's episode looks like now. Drawing must not change the episode."""


class ContextVisible:
    """A batched environment whose observations hold the context, scaled from its bounds to [-1, 1].

    It is appended to flat observations; images and dictionaries become dictionaries with a part `context`.
    """

    def __init__(self, env: BatchedEnv) -> None:
        self.unwrapped = self._env = env
        self.n_slots, self.horizon = env.n_slots, env.horizon
        self.action_space, self.context_bounds = env.action_space, env.context_bounds
        inner, n_features = env.observation_space, len(env.context_bounds.names)
        context = spaces.Box(-1.0, 1.0, shape=(n_features,), dtype=np.float32)
        self.observation_space: spaces.Space[Any]
        if isinstance(inner, spaces.Box) and len(inner.shape) == 1:
            self.observation_space = spaces.Box(
                np.concatenate([inner.low, context.low]).astype(np.float32),
                np.concatenate([inner.high, context.high]).astype(np.float32),
                dtype=np.float32,
            )
        else:
            parts = inner.spaces if isinstance(inner, spaces.Dict) else {"observation": inner}
            self.observation_space = spaces.Dict({**parts, "context": context})
        self._scaled = np.zeros((env.n_slots, n_features), dtype=np.float32)

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> Observations:
        """As the wrapped environment's, with the context."""
        # Contexts outside their bounds are refused where they are read, but a sampler's rounding may touch them.
        self._scaled[slots] = np.clip(self.context_bounds.scale(contexts), -1.0, 1.0)
        return self._with_context(self._env.reset(slots, contexts, seeds), self._scaled[slots])

    def step(self, actions: NDArray[np.generic]) -> Step:
        """As the wrapped environment's, with the context."""
        step = self._env.step(actions)
        observations = self._with_context(step.observations, self._scaled.copy())
        return Step(observations, step.rewards, step.terminated, step.truncated, step.success)

    def close(self) -> None:
        """As the wrapped environment's, if it has one."""
        if isinstance(self._env, Closable):
            self._env.close()

    def _with_context(self, observations: Observations, context: NDArray[np.float32]) -> Observations:
        if isinstance(observations, dict):
            return {**observations, "context": context}
        if isinstance(self.observation_space, spaces.Dict):
            return {"observation": observations, "context": context}
        return np.concatenate([observations.astype(np.float32, copy=False), context], axis=1)


def refuse_actions(space: spaces.Space[Any]) -> None:
    """Raise ConfigError for an action space that no learner here has actions for."""
    flat = isinstance(space, spaces.Box) and len(space.shape) == 1
    if not flat and not (isinstance(space, spaces.Discrete) and space.start == 0):
        raise ConfigError(f"env.id: actions must be a one-dimensional Box or Discrete from 0, not {space}")


def starts_alike(env: BatchedEnv, contexts: FloatArray) -> bool:
    """Whether (n_slots, d) contexts leave no trace in the first observation: with one seed, all start the same."""
    slots = len(contexts)
    starts = env.reset(np.arange(slots), contexts, np.zeros(slots, dtype=np.uint64))
    return slots > 1 and alike(starts)


def knows_success(env: BatchedEnv, contexts: FloatArray) -> bool:
    """Whether a first step of an environment with one slot, in a (1, d) context, reports success, true or not."""
    env.action_space.seed(0)
    env.reset(np.zeros(1, dtype=np.int64), contexts, np.zeros(1, dtype=np.uint64))
    return env.step(np.asarray(env.action_space.sample())[None]).success is not None
