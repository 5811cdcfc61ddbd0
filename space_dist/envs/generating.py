"""What makes contexts of an environment anew, and edits them: its own methods, or the bounds of its contexts."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Final

import numpy as np

from space_dist.envs.interface import (
    BatchedEnv,
    Canonical,
    ContextVisible,
    DrawsContexts,
    EditsContexts,
    FloatArray,
)
from space_dist.envs.singles import BatchedSingles
from space_dist.errors import ConfigError
from space_dist.instances import ContextBounds

_OFFERED: Final = {"draw_contexts": DrawsContexts, "edit_contexts": EditsContexts, "canonical": Canonical}
STRIDE: Final = 0.1  # of a feature's width: the farthest that one edit moves it, where the environment has no edits


class EnvironmentGenerator:
    """Contexts of one environment; `space_dist.curricula.generating` says what the three methods answer.

    The environment's `draw_contexts(rng, n)`, `edit_contexts(rng, contexts, edits)` and `canonical(contexts)`, as far
    as it, batched or single, has them. Where it has neither of the first two, contexts are uniform within the bounds,
    and an edit moves one feature, which is drawn, by up to a tenth of its width.

    opened: a new environment of so many slots, for as long as the context lasts: each call is answered by one of its
        own, so that none can depend on the one before it.  where: what sentences call it.
    Raises ConfigError for an environment that draws its contexts and has no edits; and from every method where one
    fails, or answers anything but contexts within the bounds.
    """

    def __init__(self, opened: Callable[[int], AbstractContextManager[BatchedEnv]], where: str) -> None:
        self._opened, self._where = opened, where
        with opened(1) as env:
            if own_method(env, "draw_contexts") is not None and own_method(env, "edit_contexts") is None:
                raise ConfigError(
                    f"{where} draws its contexts itself, since not all numbers within their bounds make one, and has "
                    "no edit_contexts(rng, contexts, edits): nobody else can edit them"
                )

    def sample(self, random: np.random.Generator, count: int) -> FloatArray:
        """See `ContextGenerator`."""
        with self._opened(1) as env:
            bounds, draw = env.context_bounds, own_method(env, "draw_contexts")
            if draw is not None:
                return self._checked("draw_contexts", lambda: draw(random, count), bounds, count)
            if _whole(env):
                lowest, highest = np.ceil(bounds.low).astype(int), np.floor(bounds.high).astype(int)
                return random.integers(lowest, highest, size=(count, len(lowest)), endpoint=True).astype(np.float64)
            return random.uniform(bounds.low, bounds.high, size=(count, len(bounds.low)))

    def edit(self, random: np.random.Generator, contexts: FloatArray, edits: int) -> FloatArray:
        """See `ContextGenerator`."""
        with self._opened(1) as env:
            bounds, edit = env.context_bounds, own_method(env, "edit_contexts")
            if edit is None:
                return moved(random, contexts, edits, bounds, whole=_whole(env))
            own = contexts.copy()
            return self._checked("edit_contexts", lambda: edit(random, own, edits), bounds, len(contexts))

    def canonical(self, contexts: FloatArray) -> FloatArray:
        """See `ContextGenerator`."""
        with self._opened(1) as env:
            canonical = own_method(env, "canonical")
            if canonical is None:
                return contexts
            own = contexts.copy()
            return self._answer("canonical", lambda: canonical(own), len(contexts))

    def _checked(self, what: str, ask: Callable[[], Any], bounds: ContextBounds, count: int) -> FloatArray:
        found = self._answer(what, ask, count)
        wanted = (count, len(bounds.names))
        if found.shape != wanted:
            raise ConfigError(f"{self._where}: {what} gave an array of shape {found.shape}, not {wanted}")
        outside = ~((found >= bounds.low) & (found <= bounds.high))
        if outside.any():
            row, column = np.argwhere(outside)[0]
            raise ConfigError(
                f"{self._where}: {what} gave a context with {bounds.names[column]} = {found[row, column]:g}, not "
                f"within [{bounds.low[column]:g}, {bounds.high[column]:g}]"
            )
        return found

    def _answer(self, what: str, ask: Callable[[], Any], count: int) -> FloatArray:
        """`(count, ...)` numbers. Somebody else's environment may raise or return anything."""
        try:
            found = np.array(ask(), dtype=np.float64)
        except ConfigError as error:
            raise ConfigError(f"{self._where}: {error}") from None
        except (Exception, SystemExit) as error:
            raise ConfigError(f"{self._where}: {what} failed: {type(error).__name__}: {str(error)[:200]}") from error
        if found.ndim < 1 or len(found) != count:
            raise ConfigError(f"{self._where}: {what} gave an array of shape {found.shape}, not of {count} rows")
        return found


def moved(
    random: np.random.Generator, contexts: FloatArray, edits: int, bounds: ContextBounds, *, whole: bool
) -> FloatArray:  # fmt: skip
    """`(k, d)` contexts, in each of which a drawn feature was moved `edits` times, and stopped at its bounds.

    By a uniform number of up to a tenth of its width to either side; of whole numbers by at least 1.
    """
    found, rows, width = contexts.copy(), np.arange(len(contexts)), bounds.high - bounds.low
    low, high = (np.ceil(bounds.low), np.floor(bounds.high)) if whole else (bounds.low, bounds.high)
    for _ in range(edits):
        which = random.integers(len(width), size=len(rows))
        by = random.uniform(-STRIDE, STRIDE, size=len(rows)) * width[which]
        if whole:
            by = np.copysign(np.maximum(np.rint(np.abs(by)), 1.0), by)
        found[rows, which] = np.clip(found[rows, which] + by, low[which], high[which])
    return found


def _whole(env: BatchedEnv) -> bool:
    inner = env.unwrapped if isinstance(env, ContextVisible) else env
    return isinstance(inner, BatchedSingles) and inner.whole_contexts


def own_method(env: BatchedEnv, method: str) -> Callable[..., Any] | None:
    """A method of the environment itself, or of the single one that it steps; None where it has none."""
    inner = env.unwrapped if isinstance(env, ContextVisible) else env
    found: Callable[..., Any] | None = None
    if isinstance(inner, BatchedSingles):
        found = inner.first.get_wrapper_attr(method) if inner.first.has_wrapper_attr(method) else None
    elif isinstance(inner, _OFFERED[method]):
        found = getattr(inner, method)
    return found
