"""The tiny line, slowly: `tests.faults.slow_env:make`, for rounds that are longer than the grace time.

A step takes as many seconds as the environment variable PAUSE says: the same config is fast where there is none.
A step that pauses makes the file that STEPPING names, if it does.
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

PAUSE = "SPACE_DIST_TEST_PAUSE"
STEPPING = "SPACE_DIST_TEST_STEPPING"


class Slow(Line):
    def __init__(self, n_slots: int) -> None:
        super().__init__(n_slots, spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32))
        self._seconds = float(os.environ.get(PAUSE, "0"))

    def step(self, actions: NDArray[np.generic]) -> Step:
        if self._seconds > 0 and STEPPING in os.environ:
            Path(os.environ[STEPPING]).touch()
        time.sleep(self._seconds)
        return super().step(actions)


def make(n_slots: int, **_: Any) -> Slow:
    return Slow(n_slots)
