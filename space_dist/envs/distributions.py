"""What instances can be drawn from, and the drawing of a training and a test set that share nothing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from space_dist.envs import antgoal, ballcatching, cartpole, goalmaze, maze, mixed_maze, pointmass, sparse_pointmass
from space_dist.envs.interface import Distribution
from space_dist.errors import ConfigError, nearest
from space_dist.instances import MAX_INSTANCES, InstanceSet, repeats, shown
from space_dist.seeding import Purpose, generator

MAX_REDRAWS: Final = 100
DISTRIBUTIONS: Final[Mapping[str, Distribution]] = {
    name: distribution
    for env in (pointmass, sparse_pointmass, goalmaze, cartpole, antgoal, ballcatching, maze, mixed_maze)
    for name, distribution in env.DISTRIBUTIONS.items()
}


def sample(
    distribution: str, n_train: int, n_test: int, seed: int, known: Mapping[str, Distribution] = DISTRIBUTIONS
) -> tuple[InstanceSet, InstanceSet]:
    """A training set (ids 0 .. n_train - 1) and a test set (the ids after), from one of the `known`.

    They are disjoint by construction: one set of distinct contexts is drawn, what repeats drawn again, and then
    split. A pure function of its arguments. Raises ConfigError for an unknown distribution, for counts below 1
    or above 10 million together, for a negative seed, and if there are not that many distinct contexts to be found.
    """
    if distribution not in known:
        raise ConfigError(
            f"unknown distribution {shown(distribution)}{nearest(distribution[:100], known)} "
            f"(known are {', '.join(known)})"
        )
    total = n_train + n_test
    if min(n_train, n_test) < 1 or total > MAX_INSTANCES:
        raise ConfigError(
            f"cannot sample {n_train} training and {n_test} test instances: at least 1 of each, "
            f"at most {MAX_INSTANCES} together"
        )
    if seed < 0:
        raise ConfigError(f"the seed {seed} is negative; allowed are whole numbers from 0")
    chosen = known[distribution]
    rng = generator(seed, Purpose.INSTANCES, int.from_bytes(distribution.encode(), "big"), n_train, n_test)
    contexts = np.empty((0, len(chosen.bounds.names)))
    for _ in range(MAX_REDRAWS):
        contexts = np.vstack((contexts, chosen.draw(rng, total - len(contexts))))
        contexts = np.delete(contexts, repeats(chosen.content(contexts))[1], axis=0)
        if len(contexts) == total:
            ids, names = np.arange(total), chosen.bounds.names
            train = InstanceSet(ids[:n_train], contexts[:n_train], names)
            return train, InstanceSet(ids[n_train:], contexts[n_train:], names)
    raise ConfigError(f"found only {len(contexts)} distinct contexts of {distribution} where {total} were asked for")
