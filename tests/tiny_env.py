"""An environment that must be learnt in seconds: move along a line to a target, which only the context tells.

`tests.tiny_env:make` (continuous actions) and `tests.tiny_env:make_discrete` are its import paths for a config.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.envs.interface import FloatArray, IntArray, Observations, Step
from space_dist.instances import ContextBounds

HORIZON = 8
STRIDE = 0.25  # how far a full action moves
START = 0.1  # starts are uniform in [-START, START]
SUCCESS_DISTANCE = 0.1


class Line:
    """Position x in [-1, 1], reward 1 - |x - target|. Whoever stands still earns 1 - |target| a step."""

    def __init__(self, n_slots: int, action_space: spaces.Space[Any]) -> None:
        self.n_slots, self.horizon = n_slots, HORIZON
        self.observation_space = spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32)
        self.action_space = action_space
        self.context_bounds = ContextBounds(("target",), np.array([-1.0]), np.array([1.0]))
        self._x, self._target = np.zeros(n_slots), np.zeros(n_slots)
        self._time = np.zeros(n_slots, dtype=np.int64)

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> Observations:
        self._x[slots] = [np.random.default_rng(int(seed)).uniform(-START, START) for seed in seeds]
        self._target[slots], self._time[slots] = contexts[:, 0], 0
        return self._x[slots, None].astype(np.float32)

    def step(self, actions: NDArray[np.generic]) -> Step:
        if isinstance(self.action_space, spaces.Discrete):
            move = actions.astype(np.float64) - 1.0  # left, stay, right
        else:
            move = np.clip(actions[:, 0].astype(np.float64), -1.0, 1.0)
        self._x = np.clip(self._x + STRIDE * move, -1.0, 1.0)
        self._time += 1
        distance = np.abs(self._x - self._target)
        return Step(
            observations=self._x[:, None].astype(np.float32),
            rewards=1.0 - distance,
            terminated=np.zeros(self.n_slots, dtype=np.bool_),
            truncated=self._time >= HORIZON,
            success=distance < SUCCESS_DISTANCE,
        )


def make(n_slots: int) -> Line:
    return Line(n_slots, spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32))


def make_discrete(n_slots: int) -> Line:
    return Line(n_slots, spaces.Discrete(3))
