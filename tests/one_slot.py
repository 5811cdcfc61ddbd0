"""One slot of a batch of environments, among others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from numpy.typing import NDArray

from space_dist.envs import BatchedEnv


def seen_by(
    slot: int, env: BatchedEnv, actions: Sequence[Any] | NDArray[Any], drawn: Callable[[], NDArray[Any]]
) -> list[tuple[bytes, float]]:
    """(observation, reward) of each of its steps, until it terminates. drawn: actions of all slots, its own in vain."""
    told = []
    for action in actions:
        acting = drawn()
        acting[slot] = action
        step = env.step(acting)
        told.append((step.observations[slot].tobytes(), float(step.rewards[slot])))
        if step.terminated[slot]:
            break
    return told
