"""Tasks as SLURM's arrays: what `--array` says, within what a site allows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple


class Array(NamedTuple):
    """One array job. first: the task that its index 0 stands for. indices: the value of `--array`, like `0-99%4`."""

    first: int
    indices: str


def arrays_of(tasks: Sequence[int], size: int, throttle: int | None) -> list[Array]:
    """Arrays of these tasks, which ascend: MaxArraySize (`size`) bounds the largest index, not only their number."""
    spans: dict[int, list[list[int]]] = {}
    for task in tasks:
        index = task % size
        of_array = spans.setdefault(task - index, [])
        if of_array and of_array[-1][1] == index - 1:
            of_array[-1][1] = index
        else:
            of_array.append([index, index])
    limit = "" if throttle is None else f"%{throttle}"
    return [
        Array(first, ",".join(f"{begin}-{end}" for begin, end in of_array) + limit) for first, of_array in spans.items()
    ]
