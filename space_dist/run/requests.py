"""What a run in progress asks of whoever advances it: to wait for others' work, or to learn."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, TypeVar

from space_dist.learner import Arrays, Learner
from space_dist.rollout import Shard
from space_dist.run.cluster import Handle


@dataclass(frozen=True)
class Wait:
    """A run needs the values of `handles`, as a list, to go on."""

    handles: list[Handle]


@dataclass(frozen=True)
class Learn:
    """A run needs its learner's `Update` on a round's shards, to go on; see `Learner.update`."""

    learner: Learner
    shards: list[Shard]
    round: int
    steps: int
    acted: Arrays | None = None


T = TypeVar("T")
Work = Generator[Wait | Learn, Any, T]
