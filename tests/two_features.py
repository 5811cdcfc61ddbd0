"""Instances with a context of two features, for tests of curricula, which know no environment."""

from __future__ import annotations

from typing import Any

import numpy as np

from space_dist.instances import ContextBounds, InstanceSet

BOUNDS = ContextBounds(("a", "b"), np.array([0.0, -10.0]), np.array([2.0, 10.0]))


class Generator:
    """Contexts anywhere within the bounds; an edit moves the first feature up by a hundredth."""

    def sample(self, random: np.random.Generator, count: int) -> np.ndarray:
        return random.uniform(BOUNDS.low, BOUNDS.high, size=(count, 2))

    def edit(self, random: np.random.Generator, contexts: np.ndarray, edits: int) -> np.ndarray:
        ahead = contexts[:, 0] + 0.01 * edits * random.random(len(contexts))
        return np.column_stack((np.minimum(ahead, BOUNDS.high[0]), contexts[:, 1]))

    def canonical(self, contexts: np.ndarray) -> np.ndarray:
        return contexts


def scattered(n: int, *, first_id: int = 0, **columns: Any) -> InstanceSet:
    """n instances that vary in every direction, so that their covariance is not singular."""
    contexts = np.random.default_rng(3).uniform(BOUNDS.low, BOUNDS.high, size=(n, 2))
    return InstanceSet(np.arange(first_id, first_id + n), contexts, BOUNDS.names, columns)
