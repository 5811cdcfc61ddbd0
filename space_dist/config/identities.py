"""What of a config decides results: a hash of it, and in what two differ."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

from space_dist.config.run import RunConfig

NOT_IDENTITY = ("name", "checkpoint", "tracking", "resources")  # what cannot change a result


def identity(
    config: RunConfig, train_digest: str, test_digest: str, *, given: Mapping[str, bytes] = MappingProxyType({}),
    sources: Mapping[str, str] = MappingProxyType({}), with_seed: bool = True,
) -> str:  # fmt: skip
    """`(64 hex digits)` a hash of everything that decides the run's results; without its seed, that of a grid's cell.

    Instance files count by their content, and so does what other runs have `given`, by its key, and a user's own code:
    `sources`, by import path. Fields at their default are left out, so that a field that is added later changes no
    identity.
    """
    data = config.model_dump(mode="json", exclude=_without("seed"), exclude_defaults=True)
    data["instances"] = {"train": train_digest, "test": test_digest}
    data |= {key: hashlib.sha256(content).hexdigest() for key, content in given.items()}
    if sources:
        data["sources"] = dict(sources)
    if with_seed:
        data["seed"] = config.seed
    # sort_keys: the order in which a file has its keys decides nothing.
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def differences(one: RunConfig, other: RunConfig) -> list[str]:
    """`key: value -> value` for every key that decides results and differs; paths are left out."""
    exclude = _without("instances")
    changed = changes(one.model_dump(mode="json", exclude=exclude), other.model_dump(mode="json", exclude=exclude))
    return [f"{key}: {before} -> {after}" for key, (before, after) in changed.items()]


def _without(*more: str) -> dict[str, Any]:
    """What of a config says nothing about what it is, as pydantic excludes it: paths among it."""
    return {**dict.fromkeys((*NOT_IDENTITY, "init_from", *more), True), "curriculum": {"of"}}


def changes(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """`section.key` -> its two values, sorted, where nested settings differ; None: it is not there."""
    left, right = dict(flattened(one)), dict(flattened(other))
    keys = sorted({*left, *right})
    return {key: (left.get(key), right.get(key)) for key in keys if left.get(key) != right.get(key)}


def flattened(data: Mapping[str, Any], prefix: str = "", *, empty: bool = False) -> Iterator[tuple[str, Any]]:
    """(`section.key`, value) of everything in nested settings; of an empty section nothing, or with `empty` itself."""
    for key, value in data.items():
        if isinstance(value, Mapping) and (value or not empty):
            yield from flattened(value, f"{prefix}{key}.", empty=empty)
        else:
            yield f"{prefix}{key}", value
