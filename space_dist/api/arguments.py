"""What callers hand over, checked before anything is begun: each fault is a ConfigError that names the argument."""

from __future__ import annotations

import math
import numbers
import operator
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from space_dist import config as configs
from space_dist.config.quoting import short
from space_dist.errors import ConfigError

Overrides = Mapping[str, Any] | Sequence[str]


def as_changes(overrides: Overrides) -> list[str]:
    """`KEY=VALUE` for each override, as the command has them; sentences about those of a mapping name `overrides`.

    Raises ConfigError for what is neither a mapping nor a list of words.
    """
    if isinstance(overrides, Mapping):
        given = configs.plain(without_numpy(overrides), "overrides")
        return [configs.from_program("overrides", key, value) for key, value in given.items()]
    is_list = isinstance(overrides, Sequence) and not isinstance(overrides, str | bytes)
    if not is_list or not all(isinstance(override, str) for override in overrides):
        raise ConfigError(
            f"overrides must be a mapping or a list, like {{'budget.steps': 20000}} or ['budget.steps=20000'], not "
            f"{short(overrides)}"
        )
    return list(overrides)


def as_path(given: object, argument: str) -> Path:
    """A path that an argument names. Raises ConfigError for anything else, and where it is empty."""
    if not isinstance(given, str | os.PathLike) or not os.fspath(given):
        raise ConfigError(f"{argument} must be a path, not {short(given)}")
    return Path(given)


def as_count(given: object, argument: str, *, least: int, most: int | None = None) -> int:
    """A whole number that is not below `least`, nor above `most`. Raises ConfigError for anything else."""
    try:
        number = None if isinstance(given, bool | np.bool_) else operator.index(given)  # type: ignore[arg-type]
    except TypeError:
        number = None
    if number is None or number < least or (most is not None and number > most):
        end = "" if most is None else f" to {most:,}"
        raise ConfigError(f"{argument} must be a whole number from {least}{end}, not {short(given)}")
    return number


def as_limit(max_parallel: object) -> int | None:
    """How many runs may be under way at a time; None: no limit was given. Raises ConfigError for less than one."""
    return None if max_parallel is None else as_count(max_parallel, "max_parallel", least=1)


def as_share(given: object, argument: str) -> float:
    """A number above 0 and at most 1. Raises ConfigError for anything else."""
    is_number = isinstance(given, numbers.Real) and not isinstance(given, bool)
    share = float(given) if is_number else math.nan  # type: ignore[arg-type]
    if not 0.0 < share <= 1.0:  # NaN neither
        raise ConfigError(f"{argument} must be a number above 0 and at most 1, not {short(given)}")
    return share


def refuse_progress(given: object) -> None:
    """Raise ConfigError for what neither says whether progress is shown, nor can be called with it."""
    if not isinstance(given, bool) and not callable(given):
        raise ConfigError(f"progress must be True, False or a function, not {short(given)}")


def without_numpy(value: Any) -> Any:
    """What Python programs write, in the words of YAML: lists for tuples and arrays, text for paths."""
    if isinstance(value, Mapping):
        return {key: without_numpy(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return without_numpy(value.tolist())
    if isinstance(value, list | tuple):
        return [without_numpy(item) for item in value]
    return str(value) if isinstance(value, Path) else value
