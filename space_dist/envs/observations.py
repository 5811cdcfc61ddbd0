"""Observations are arrays, or dictionaries of arrays; these few functions treat both alike. Rows come first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

Observations = NDArray[Any] | dict[str, NDArray[Any]]


def allocate(space: spaces.Space[Any], *leading: int) -> Observations:
    """Room for `(*leading, ...)` observations of `space`, a Box or a Dict of Boxes."""
    if isinstance(space, spaces.Dict):
        return {name: np.empty((*leading, *(part.shape or ())), dtype=part.dtype) for name, part in space.items()}
    return np.empty((*leading, *(space.shape or ())), dtype=space.dtype)


def put(target: Observations, index: Any, source: Observations) -> None:
    """`target[index] = source`, for every array."""
    if isinstance(target, dict) and isinstance(source, dict):
        for name, array in target.items():
            array[index] = source[name]
    elif isinstance(target, np.ndarray):
        target[index] = source


def each(change: Callable[[NDArray[Any]], NDArray[Any]], observations: Observations) -> Observations:
    """`change` applied to every array."""
    if isinstance(observations, dict):
        return {name: change(array) for name, array in observations.items()}
    return change(observations)


def take(observations: Observations, index: Any) -> Observations:
    """`observations[index]`, for every array; a copy, whatever the index."""
    return each(lambda array: np.array(array[index]), observations)


def concatenate(parts: Sequence[Observations], axis: int = 0) -> Observations:
    """The parts as one, along `axis`."""
    first = parts[0]
    if isinstance(first, dict):
        return {name: np.concatenate([part[name] for part in parts], axis=axis) for name in first}
    return np.concatenate(parts, axis=axis)  # type: ignore[arg-type]


def rows(observations: Observations) -> int:
    """How many there are."""
    first = next(iter(observations.values())) if isinstance(observations, dict) else observations
    return len(first)


def alike(observations: Observations) -> bool:
    """Whether all rows are the same."""
    arrays = observations.values() if isinstance(observations, dict) else [observations]
    return all(bool((array == array[:1]).all()) for array in arrays)


def distinct(observations: Observations) -> tuple[Observations, NDArray[np.int64] | None]:
    """The rows that differ, and `(n,)` which of these each row is; where all differ, all as they stand, and None.

    Rows of a matrix product are rounded by their place in it, so what must be equal for equal rows is computed once.
    The rows that differ come in the order of their bytes, so that it does not hang on where they stood.
    """
    arrays = list(observations.values()) if isinstance(observations, dict) else [observations]
    count = rows(observations)
    exact = [array + array.dtype.type(0) if array.dtype.kind == "f" else array for array in arrays]  # -0.0 is 0.0
    packed = [np.ascontiguousarray(array).reshape(count, -1).view(np.uint8) for array in exact]
    joined = packed[0] if len(packed) == 1 else np.concatenate(packed, axis=1)
    if not joined.shape[1]:  # of no numbers at all
        return observations, None
    whole = joined.view(np.dtype((np.void, joined.shape[1])))[:, 0]
    _, first, which = np.unique(whole, return_index=True, return_inverse=True)
    if len(first) == count:
        return observations, None
    return take(observations, first), which.reshape(count).astype(np.int64)
