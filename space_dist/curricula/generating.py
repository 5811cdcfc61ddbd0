"""Contexts of no instance set, made by an environment's generator, anew and by small changes of others."""

from __future__ import annotations

from typing import Final, Protocol

import numpy as np

from space_dist.curricula.interface import BoolArray, FloatArray
from space_dist.errors import ConfigError

MAX_REDRAWS: Final = 100  # of contexts that are held out


class ContextGenerator(Protocol):
    """What makes and changes an environment's contexts. Pure: equal arguments, equal answers, and no argument changed.

    `space_dist.envs.generating` makes one of an environment.
    """

    def sample(self, random: np.random.Generator, count: int) -> FloatArray:
        """`(count, d)` contexts within the bounds, independent rows."""

    def edit(self, random: np.random.Generator, contexts: FloatArray, edits: int) -> FloatArray:
        """`(k, d)` the (k, d) contexts, each after `edits` small changes of its own; valid contexts, within the bounds.

        None of them need be solvable.
        """

    def canonical(self, contexts: FloatArray) -> FloatArray:
        """`(k, ...)` rows that are equal where two of the (k, d) contexts mean the same."""


class Unheld:
    """A generator that gives no context of which the held-out instances have one that means the same.

    held_out: (h, d) contexts that must not be trained on; None: there are none.
    """

    def __init__(self, generator: ContextGenerator, held_out: FloatArray | None = None) -> None:
        self._generator = generator
        rows = () if held_out is None else _exact(generator.canonical(held_out))
        self._held = {row.tobytes() for row in rows}

    def sample(self, random: np.random.Generator, count: int) -> FloatArray:
        """`(k, d)` contexts: `count`, or as many as were found in 100 attempts.

        Raises ConfigError if there were none.
        """
        found = _exact(self._generator.sample(random, count))
        found = found[~self.holds(found)]
        for _ in range(MAX_REDRAWS):
            if len(found) == count:
                return found
            more = _exact(self._generator.sample(random, count - len(found)))
            found = np.concatenate([found, more[~self.holds(more)]])
        if not len(found):
            raise ConfigError(
                "curriculum.kind: accel: the environment's generator gives contexts of instances.test alone, which "
                "must not be trained on"
            )
        return found

    def edit(self, random: np.random.Generator, contexts: FloatArray, edits: int) -> FloatArray:
        """`(j, d)` the (k, d) contexts, edited; what became a held-out one is edited anew, 100 times, or left out."""
        edited = _exact(self._generator.edit(random, contexts, edits))
        for _ in range(MAX_REDRAWS):
            held = np.flatnonzero(self.holds(edited))
            if not len(held):
                return edited
            edited[held] = _exact(self._generator.edit(random, contexts[held], edits))
        return edited[~self.holds(edited)]

    def holds(self, contexts: FloatArray) -> BoolArray:
        """`(k,)` which of the (k, d) contexts are held out."""
        if not self._held:
            return np.zeros(len(contexts), dtype=np.bool_)
        rows = _exact(self._generator.canonical(contexts))
        return np.array([row.tobytes() in self._held for row in rows], dtype=np.bool_)


def _exact(contexts: FloatArray) -> FloatArray:
    """A copy in which equal contexts have equal bytes: there is no -0."""
    return contexts + 0.0
