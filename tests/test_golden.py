"""The same bits on every machine: golden digests, natively and as CPUs of two makers without AVX-512."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from space_dist.arithmetic import REFERENCE
from space_dist.errors import Interrupted
from space_dist.interrupts import StopRequests
from space_dist.launch import arithmetic_digest, launch
from space_dist.ledger import Ledger
from tests.golden.cases import CASES, DIGESTS, ROOT, config_of, digests_of, run
from tests.patience import PATIENCE

GOLDEN = json.loads(DIGESTS.read_text())
CPUS = ["Haswell", "EPYC-Rome"]  # an Intel and an AMD, both with AVX2 and FMA alone
STOPPED = "spdrl"  # a run that is stopped here and goes on elsewhere: curriculum, optimiser, actors, learner


def emulator() -> str | None:
    """qemu-user of version 8 or newer (7.2 emulates an instruction of NumPy's argsort wrongly)."""
    found = shutil.which("qemu-x86_64")
    if found is None:
        return None
    said = subprocess.run([found, "--version"], capture_output=True, text=True).stdout
    return found if int(said.split("version ")[1].split(".")[0]) >= 8 else None


needs_emulator = pytest.mark.skipif(emulator() is None, reason="qemu-user 8 or newer is not installed")


def emulated(cpu: str, *arguments: str) -> str:
    command = [emulator() or "", "-cpu", cpu, sys.executable, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=3 * PATIENCE)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def test_this_machine_computes_what_published_numbers_are_made_with() -> None:
    assert arithmetic_digest() == REFERENCE["all"] == GOLDEN["arithmetic"]


@pytest.mark.parametrize("name", CASES)
def test_every_part_gives_the_golden_bits(name: str, tmp_path: Path) -> None:
    assert run(name, tmp_path / "case") == GOLDEN["cases"][name]


@pytest.mark.qemu
@needs_emulator
@pytest.mark.parametrize("cpu", CPUS)
def test_another_cpu_gives_the_golden_bits(cpu: str) -> None:
    found = json.loads(emulated(cpu, "-m", "tests.golden").splitlines()[-1])
    assert found == GOLDEN


@pytest.mark.qemu
@needs_emulator
@pytest.mark.parametrize("cpu", CPUS)
def test_a_run_stopped_here_goes_on_there_unmarked(cpu: str, tmp_path: Path) -> None:
    also, committed = ("checkpoint.every_rounds=1",), 0

    class Stop(StopRequests):
        def reason(self) -> str | None:
            nonlocal committed
            committed += 1
            return "the test" if committed == 2 else None

    with pytest.raises(Interrupted):
        launch(config_of(STOPPED, tmp_path, also), tmp_path / "run", resume=False, stop=Stop())
    stopped = Ledger(tmp_path / "run").status()
    assert 0 < stopped.steps < stopped.budget_steps
    emulated(cpu, "-m", "space_dist.cli", "train", str(tmp_path / "run" / "config.yaml"), "--out",
             str(tmp_path / "run"), "--resume", "--workers", "0")  # fmt: skip
    status = Ledger(tmp_path / "run").status()
    assert (status.state, status.fingerprint_changed) == ("done", False)
    assert status.fingerprint == stopped.fingerprint
    assert digests_of(tmp_path / "run") == GOLDEN["cases"][STOPPED]
