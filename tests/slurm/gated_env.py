"""The tiny line of `tests.tiny_env`, as slow as a test wants: while the file GATE exists, a step takes PAUSE seconds.

With `fails`, its 51st step raises: a cell that fails on purpose.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.envs.interface import Step
from tests.tiny_env import Line

GATE = "SPACE_DIST_TEST_GATE"
PAUSE = 0.006


class Gated(Line):
    def __init__(self, n_slots: int, fails: bool) -> None:
        action_space: spaces.Space[Any] = spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32)
        super().__init__(n_slots, action_space)
        self._gate, self._steps_left = os.environ.get(GATE), 50 if fails else -1

    def step(self, actions: NDArray[np.generic]) -> Step:
        if self._steps_left == 0:
            raise RuntimeError("this environment was made to fail")
        self._steps_left -= 1
        if self._gate is not None and Path(self._gate).exists():
            time.sleep(PAUSE)
        return super().step(actions)


def make(n_slots: int, fails: bool = False) -> Gated:
    return Gated(n_slots, fails)
