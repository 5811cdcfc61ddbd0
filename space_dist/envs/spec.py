"""What an environment is like, read once from one that is closed again: Acme's word for it is environment spec."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from gymnasium import spaces

from space_dist.envs import BULLET_IDS, BatchedEnv, bullet, close, make_batched, unwrapped
from space_dist.envs.generating import EnvironmentGenerator
from space_dist.envs.interface import Compilable, FloatArray, knows_success, opened, starts_alike
from space_dist.envs.singles import BatchedSingles
from space_dist.errors import ConfigError
from space_dist.instances import ContextBounds

_SLOTS_ONE_BY_ONE = 16
"""Slots of an environment that steps them one after another, at most, where it is left to us: episodes of unequal
length leave few of them idle at the end, and a policy's call is still shared. Decides no result."""


@dataclass(frozen=True)
class EnvironmentSpec:
    """How an environment is made, and what it is like as a policy sees it. It holds nothing open, and can be pickled.

    env_id, context_visible, kwargs: as for `make_batched`.
    horizon: steps after which an episode is truncated.
    observation_space, action_space: of one slot.
    context_bounds: names and bounds of a context's features.
    compiled: whether steps are computed by compiled code, where the environment has such: the same bits, sooner.
    one_by_one: whether slots are stepped one after another, in Python or in a simulator, so that sharing them pays.

    What takes an episode to know is a method, so that nobody pays for it who does not ask.
    """

    env_id: str
    context_visible: bool
    kwargs: Mapping[str, Any]
    horizon: int
    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]
    context_bounds: ContextBounds
    compiled: bool = False
    one_by_one: bool = False

    def make(self, n_slots: int) -> BatchedEnv:
        """A new environment, to be closed (`close`) by whoever asks for it."""
        env = make_batched(self.env_id, n_slots, context_visible=self.context_visible, kwargs=self.kwargs)
        inner = unwrapped(env)
        if self.compiled and isinstance(inner, Compilable):
            inner.compile_physics()
        return env

    def slots_for(self, episodes: int) -> int:
        """Slots in which to play so many episodes soonest: equal shares, or all at once where that takes no longer."""
        if not self.one_by_one:
            return episodes
        turns = max(1, -(-episodes // _SLOTS_ONE_BY_ONE))
        return -(-episodes // turns)

    @property
    def most_slots(self) -> int:
        """Slots that an environment steps without any of them waiting for another's place in a simulator."""
        return bullet.MAX_WORLDS if self.env_id in BULLET_IDS else sys.maxsize

    def world_mb(self, n_slots: int) -> int:
        """About what an environment of so many slots takes of the memory, beside arrays, in MB."""
        return min(n_slots, bullet.MAX_WORLDS) * bullet.WORLD_MB if self.env_id in BULLET_IDS else 0

    def opened(self, n_slots: int) -> AbstractContextManager[BatchedEnv]:
        """A new environment for as long as the context lasts."""
        return opened(self.make, n_slots)

    def generator(self) -> EnvironmentGenerator:
        """What makes contexts of this environment, and edits them. Raises ConfigError if they cannot be edited."""
        plain = dataclasses.replace(self, compiled=False)  # it takes no step
        return EnvironmentGenerator(plain.opened, f"env.id {self.env_id!r}")

    def knows_success(self, contexts: FloatArray) -> bool:
        """Whether a first step in a (1, d) context reports success, true or not.

        Raises ConfigError if the environment fails.
        """
        with self._failures_explained("reset or a first step"), self.opened(1) as env:
            return knows_success(env, contexts)

    def starts_alike(self, contexts: FloatArray) -> bool:
        """Whether (n, d) contexts leave no trace in the first observation: with one seed, they all start the same.

        A single one has nothing to be told from. Raises ConfigError if the environment fails.
        """
        with self._failures_explained("reset"), self.opened(len(contexts)) as env:
            return starts_alike(env, contexts)

    @contextlib.contextmanager
    def _failures_explained(self, what: str) -> Iterator[None]:
        """Somebody else's environment may raise anything."""
        try:
            yield
        except ConfigError:
            raise
        except (Exception, SystemExit) as error:
            raise ConfigError(f"env.id {self.env_id!r}: {what} failed: {type(error).__name__}: {error}") from error


def read_spec(
    env_id: str, *, context_visible: bool, kwargs: Mapping[str, Any] = MappingProxyType({})
) -> EnvironmentSpec:  # fmt: skip
    """Look at an environment of one slot, and close it. Raises ConfigError as `make_batched` does."""
    env = make_batched(env_id, 1, context_visible=context_visible, kwargs=kwargs)
    try:
        return EnvironmentSpec(
            env_id, context_visible, dict(kwargs), env.horizon,
            _of_gymnasium(env.observation_space), _of_gymnasium(env.action_space), env.context_bounds,
            one_by_one=env_id in BULLET_IDS or isinstance(unwrapped(env), BatchedSingles),
        )  # fmt: skip
    finally:
        close(env)


def _of_gymnasium(space: spaces.Space[Any]) -> spaces.Space[Any]:
    """The same space, of a class of Gymnasium's: a user's own is not found where an actor unpickles its setup."""
    if isinstance(space, spaces.Dict):
        parts = [(name, _of_gymnasium(part)) for name, part in space.items()]
        same = type(space) is spaces.Dict and all(part is space[name] for name, part in parts)
        return space if same else spaces.Dict(parts)  # pairs keep their order, which is that of a network's inputs
    if isinstance(space, spaces.Box) and type(space) is not spaces.Box:
        return spaces.Box(space.low, space.high, dtype=space.low.dtype.type)
    if isinstance(space, spaces.Discrete) and type(space) is not spaces.Discrete:
        return spaces.Discrete(int(space.n), start=int(space.start))
    return space
