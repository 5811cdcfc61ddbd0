"""Other makers' CPUs, by qemu-user: runs there must have the bits of runs here."""

from __future__ import annotations

import functools
import json
import os
import shutil
import subprocess
import sys
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from space_dist.errors import Interrupted
from space_dist.ledger import Ledger, Status
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests
from tests.golden.cases import DIGESTS, ROOT, config_of, digests_of

GOLDEN = json.loads(DIGESTS.read_text())
STOPPED = "spdrl"  # a run that is stopped here and goes on elsewhere: curriculum, optimiser, actors, learner
_PATIENCE = 2700.0  # seconds, of seven minutes of work on a machine with much else to do


def emulator() -> str | None:
    """qemu-user of version 8 or newer (7.2 emulates an instruction of NumPy's argsort wrongly)."""
    found = shutil.which("qemu-x86_64")
    if found is None:
        return None
    said = subprocess.run([found, "--version"], capture_output=True, text=True).stdout
    return found if int(said.split("version ")[1].split(".")[0]) >= 8 else None


needs_emulator = pytest.mark.skipif(emulator() is None, reason="qemu-user 8 or newer is not installed")


_CHATTER = ("TCG doesn't support", "Extension modules: ")  # by qemu for each thread, by Python for each crash
_TARGET = """
import json, llvmlite.binding as llvm
features = llvm.get_host_cpu_features().flatten()
print(json.dumps({"NUMBA_CPU_NAME": llvm.get_host_cpu_name(), "NUMBA_CPU_FEATURES": features}))
"""
_COMPILE = """
import numpy as np
from space_dist.kernels import dqn, goalmaze, pointmass, ppo, sac, td3
for algorithm in (dqn, ppo, sac, td3):
    algorithm.prepare(np.float32)
for world in (goalmaze, pointmass):
    world.prepare()
"""


class EmulatorError(Exception):
    """That what is emulated died of a signal, which none of it does on a CPU. Holds the end of what it said."""


def _run(command: list[str], environment: dict[str, str] | None = None) -> str:
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=ROOT, timeout=_PATIENCE, env=environment or dict(os.environ)
    )
    said = "\n".join(line for line in done.stderr.splitlines() if not any(map(line.__contains__, _CHATTER)))[-4000:]
    if "uncaught target signal" in said:
        raise EmulatorError(said)
    assert done.returncode == 0, said
    return done.stdout


@functools.cache
def _environment(cpu: str) -> dict[str, str]:
    """The environment of what is emulated: the kernels have been compiled here for the CPU that `cpu` says it is.

    Compiling under an emulator takes minutes, and is the same work: only what is compiled runs on the CPU.
    """
    target = json.loads(_run([emulator() or "", "-cpu", cpu, sys.executable, "-c", _TARGET]))
    # Kept from one run of the tests to the next, as pytest's own folders are not.
    folder = Path(tempfile.gettempdir()) / f"space-dist-golden-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    environment = dict(os.environ) | target | {
        "NUMBA_CACHE_DIR": str(folder),
        "QEMU_TB_SIZE": "1024",  # MiB for what is translated: 128 are full after a few runs, and all is done again
        "OPENBLAS_NUM_THREADS": "1",  # fewer threads for an emulator that is not always right about several
        "PYTHONFAULTHANDLER": "1",
    }  # fmt: skip
    _run([sys.executable, "-c", _COMPILE], environment)
    return environment


@dataclass(frozen=True)
class Emulated:
    """What one process under an emulator printed, and a run that was stopped here and went on there."""

    printed: Any
    stopped: Status
    ended: Status
    resumed: dict[str, str]


def emulate(cpu: str, folder: Path) -> Emulated:
    """All cases on `cpu`, after the rest of a run that was stopped natively. One process: its imports take a minute."""
    looks = 0

    class Stop(StopRequests):
        def reason(self) -> str | None:
            nonlocal looks
            looks += 1
            return "the test" if looks == 2 else None

    config, run = config_of(STOPPED, folder, ("checkpoint.every_rounds=1",)), folder / "run"
    with pytest.raises(Interrupted):
        launch(config, run, resume=False, stop=Stop())
    stopped = Ledger(run).status()
    command = [emulator() or "", "-cpu", cpu, sys.executable, "-m", "tests.golden", "--resume", str(run)]
    environment = _environment(cpu)
    try:
        printed = _run(command, environment)
    except EmulatorError as crash:
        # Seen once in some hundred times, of qemu 10.0.2 with all its cores busy. Code of ours that a CPU cannot run
        # crashes again; what was resumed goes on from its last checkpoint, as it does after any kill.
        warnings.warn(f"qemu-user crashed, and is asked once more: {crash}", stacklevel=2)
        printed = _run(command, environment)
    return Emulated(json.loads(printed.splitlines()[-1]), stopped, Ledger(run).status(), digests_of(run))
