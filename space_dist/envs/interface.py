"""What an environment is to us: many slots of the same environment, stepped together, each with its own context."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.instances import ContextBounds

FloatArray = NDArray[np.float64]
Observations = NDArray[np.float32]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Step:
    """What one step of all slots gave.

    observations: (n_slots, obs_dim) after the step; nothing resets by itself.
    rewards: (n_slots,).  terminated, truncated: (n_slots,).
    success: (n_slots,) whether the goal is reached *now*; None where the environment knows no success.
    """

    observations: Observations
    rewards: FloatArray
    terminated: BoolArray
    truncated: BoolArray
    success: BoolArray | None


class BatchedEnv(Protocol):
    """`n_slots` independent copies.

    An episode is a pure function of (context, seed, actions): never of its slot, its neighbours, or what ran before.
    """

    @property
    def n_slots(self) -> int:
        """How many episodes run at once."""

    @property
    def horizon(self) -> int:
        """Steps after which an episode is truncated."""

    @property
    def observation_space(self) -> spaces.Box:
        """Of one slot."""

    @property
    def action_space(self) -> spaces.Space[Any]:
        """Of one slot."""

    @property
    def context_bounds(self) -> ContextBounds:
        """Names and bounds of a context's features."""

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> Observations:
        """Start new episodes in `slots` (k,), with `contexts` (k, d) and `seeds` (k,); returns (k, obs_dim)."""

    def step(self, actions: NDArray[np.generic]) -> Step:
        """Step every slot. actions: (n_slots, *action_shape). A slot whose episode has ended must be reset first."""


MakeBatched = Callable[[int], BatchedEnv]


class ContextVisible:
    """A batched environment whose observations end with the context, scaled from its bounds to [-1, 1]."""

    def __init__(self, env: BatchedEnv) -> None:
        self._env = env
        self.n_slots, self.horizon = env.n_slots, env.horizon
        self.action_space, self.context_bounds = env.action_space, env.context_bounds
        space, n_features = env.observation_space, len(env.context_bounds.names)
        # Contexts outside their bounds are refused where they are read, but a sampler's rounding may touch them.
        self.observation_space = spaces.Box(
            np.concatenate([space.low, np.full(n_features, -1.0)]).astype(np.float32),
            np.concatenate([space.high, np.full(n_features, 1.0)]).astype(np.float32),
            dtype=np.float32,
        )
        self._scaled = np.zeros((env.n_slots, n_features), dtype=np.float32)

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> Observations:
        """As the wrapped environment's, with the context appended."""
        self._scaled[slots] = np.clip(self.context_bounds.scale(contexts), -1.0, 1.0)
        return np.concatenate([self._env.reset(slots, contexts, seeds), self._scaled[slots]], axis=1)

    def step(self, actions: NDArray[np.generic]) -> Step:
        """As the wrapped environment's, with the context appended."""
        step = self._env.step(actions)
        observations = np.concatenate([step.observations, self._scaled], axis=1)
        return Step(observations, step.rewards, step.terminated, step.truncated, step.success)
