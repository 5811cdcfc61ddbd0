"""The tiny line, slowly: `tests.faults.slow_env:make`, for rounds that are longer than the grace time."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.envs.interface import Step
from tests.tiny_env import Line


class Slow(Line):
    def __init__(self, n_slots: int, seconds: float) -> None:
        super().__init__(n_slots, spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32))
        self._seconds = seconds

    def step(self, actions: NDArray[np.generic]) -> Step:
        time.sleep(self._seconds)
        return super().step(actions)


def make(n_slots: int, seconds: float = 0.0, **_: Any) -> Slow:
    return Slow(n_slots, seconds)
