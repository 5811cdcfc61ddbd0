"""Every random number of a run comes from here: a pure function of (run seed, purpose, where it is used).

No generator's state is ever carried from one piece of work to the next or saved, so any piece can be computed
anywhere, in any order, twice, and gives the same bits.
"""

from __future__ import annotations

import enum
import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

UInt64Array = NDArray[np.uint64]


class Purpose(enum.IntEnum):
    """What a stream of random numbers is for. The numbers are part of every result: never reuse or renumber one.

    CUSTOM is for curricula that are not ours.
    """

    INITIAL_NETWORK = 1
    UPDATE = 2
    EPISODES = 3
    ACTIONS = 4
    START_STATES = 5
    EVALUATION = 6
    TIES = 7
    RANDOM_GROWTH = 8
    INSTANCES = 9
    BOOTSTRAP = 10
    DRAWS = 11
    PROBED = 12
    PROBE_EPISODES = 13
    CONTEXT_STARTS = 14
    MIXTURE = 15
    ENSEMBLE = 16
    ENSEMBLE_UPDATE = 17
    MEMBERS = 18
    CUSTOM = 19
    TRIALS = 20
    GENERATION = 21


def seed_sequence(seed: int, purpose: Purpose, *keys: int) -> np.random.SeedSequence:
    """The root of one stream. `keys` (round, shard, ...) are non-negative and tell equal purposes apart."""
    return np.random.SeedSequence([seed, int(purpose), *keys])


def generator(seed: int, purpose: Purpose, *keys: int) -> np.random.Generator:
    """A fresh generator for one piece of work."""
    return np.random.default_rng(seed_sequence(seed, purpose, *keys))


def episode_seeds(seed: int, purpose: Purpose, *keys: int, count: int) -> UInt64Array:
    """`(count,)` independent seeds, below 2**63 so that any Gymnasium environment takes them."""
    return seed_sequence(seed, purpose, *keys).generate_state(count, np.uint64) >> np.uint64(1)


def member_seeds(seed: int, count: int) -> UInt64Array:
    """`(count,)` seeds, below 2**31, of the policies of a run that trains several."""
    return seed_sequence(seed, Purpose.MEMBERS).generate_state(count, np.uint64) >> np.uint64(33)


def mix(values: UInt64Array) -> UInt64Array:
    """The splitmix64 finaliser (Steele et al. 2014), elementwise: equal in, equal out; else as good as random."""
    with np.errstate(over="ignore"):
        values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))


def combine(keys: UInt64Array, number: int) -> UInt64Array:
    """New keys from `keys` and one more number, as if they had been drawn afresh."""
    offset = (number * 0x9E3779B97F4A7C15 + 0x9E3779B97F4A7C15) & 0xFFFFFFFFFFFFFFFF
    with np.errstate(over="ignore"):
        return mix(keys + np.uint64(offset))


def instance_keys(seed: int, purpose: Purpose, ids: NDArray[np.int64], contexts: NDArray[np.float64]) -> UInt64Array:
    """`(n,)` keys from (seed, purpose, id, content of the context) of each instance.

    Ties are broken and first picks made by these, so the order of rows in a file can decide nothing.
    """
    start = seed_sequence(seed, purpose).generate_state(1, np.uint64)[0]
    with np.errstate(over="ignore"):
        keys: UInt64Array = mix(ids.astype(np.uint64) + start)
    for column in np.ascontiguousarray(contexts.T + 0.0):  # + 0.0 makes -0.0 and 0.0 the same bits
        keys = mix(combine(keys, 0) ^ column.view(np.uint64))
    return keys


def global_seeds(seed: int, purpose: Purpose, *keys: int) -> tuple[int, int, int]:
    """What Python's, NumPy's and torch's global generators are seeded with for code that insists on them."""
    python, numpy, torch = seed_sequence(seed, purpose, *keys).generate_state(3, np.uint32).tolist()
    return python, numpy, torch


@contextmanager
def global_generators(seed: int, purpose: Purpose, *keys: int) -> Iterator[None]:
    """Seed Python's and NumPy's *global* generators for code that insists on them; restored afterwards.

    SB3's buffers draw their minibatches from NumPy's global generator. torch's is seeded by `learner`, the one
    module that imports torch.
    """
    for_python, for_numpy, _ = global_seeds(seed, purpose, *keys)
    python_state, numpy_state = random.getstate(), np.random.get_state()  # noqa: NPY002
    random.seed(for_python)
    np.random.seed(for_numpy)  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(python_state)
        np.random.set_state(numpy_state)  # noqa: NPY002
