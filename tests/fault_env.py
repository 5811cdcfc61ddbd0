"""The line of tiny_env, with a fault: `tests.fault_env:make` with env.kwargs fault and marker.

A fault happens once, when training is under way: after `marker` exists it does not happen again. With an empty marker
it happens every time.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from space_dist.envs.interface import Step
from space_dist.errors import ConfigError
from tests.tiny_env import Line
from tests.tiny_env import make as make_line

STEPS_BEFORE = 700  # steps of all slots together


class Faulty(Line):
    def __init__(self, n_slots: int, fault: str, marker: str) -> None:
        line = make_line(n_slots)
        super().__init__(n_slots, line.action_space)
        self._fault, self._marker = fault, Path(marker) if marker else None

    _steps = 0

    def step(self, actions: NDArray[np.generic]) -> Step:
        Faulty._steps += self.n_slots
        if Faulty._steps > STEPS_BEFORE and (self._marker is None or not self._marker.exists()):
            if self._marker is not None:
                self._marker.touch()
            self._happen()
        return super().step(actions)

    def _happen(self) -> None:
        if self._fault == "raise":
            raise RuntimeError("the ground gave way")
        if self._fault == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if self._fault == "segfault":
            os.kill(os.getpid(), signal.SIGSEGV)
        if self._fault == "stop":
            os.kill(os.getpid(), signal.SIGSTOP)
        if self._fault == "terminate":
            os.kill(os.getpid(), signal.SIGTERM)
        if self._fault == "config":
            raise ConfigError("env.kwargs: the ground is not known")
        if self._fault == "memory":
            self._hoard = np.ones(150_000_000)  # 1.2 GB
            time.sleep(60)
        if self._fault == "no_memory":
            raise MemoryError
        if self._fault == "exit":
            sys.exit(0)
        if self._fault == "_exit":
            os._exit(0)
        if self._fault == "exit from C":
            ctypes.CDLL(None)._exit(0)
        if self._fault == "fork":
            os.fork()
        if self._fault == "slow":
            time.sleep(60)


def make(n_slots: int, fault: str = "", marker: str = "") -> Faulty:
    return Faulty(n_slots, fault, marker)
