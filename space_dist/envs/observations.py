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
