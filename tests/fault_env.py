"""The line of tiny_env, with a fault: `tests.fault_env:make` with env.kwargs fault and marker.

A fault happens once, when training is under way: after `marker` exists it does not happen again. With an empty marker
it happens every time. With `where`, constructor or reset, it happens at that call's number `after`, from 0 on.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from space_dist.envs.interface import FloatArray, IntArray, Observations, Step
from space_dist.errors import ConfigError
from tests.tiny_env import Line
from tests.tiny_env import make as make_line

STEPS_BEFORE = 700  # steps of all slots together


class Faulty(Line):
    def __init__(self, n_slots: int, fault: str, marker: str, where: str, after: int) -> None:
        line = make_line(n_slots)
        super().__init__(n_slots, line.action_space)
        self._fault, self._marker = fault, Path(marker) if marker else None
        self._where, self._after = where, after
        self._called("constructor")

    _steps = 0
    _calls: ClassVar[dict[str, int]] = {"constructor": 0, "reset": 0}

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> Observations:
        self._called("reset")
        return super().reset(slots, contexts, seeds)

    def step(self, actions: NDArray[np.generic]) -> Step:
        Faulty._steps += self.n_slots
        if self._where == "step" and Faulty._steps > STEPS_BEFORE:
            self._once()
        return super().step(actions)

    def _called(self, what: str) -> None:
        number = self._calls[what]
        self._calls[what] += 1
        if (self._where, self._after) == (what, number):
            self._once()

    def _once(self) -> None:
        if self._marker is None or not self._marker.exists():
            if self._marker is not None:
                self._marker.touch()
            self._happen()

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


def make(n_slots: int, fault: str = "", marker: str = "", where: str = "step", after: int = 0) -> Faulty:
    return Faulty(n_slots, fault, marker, where, after)
