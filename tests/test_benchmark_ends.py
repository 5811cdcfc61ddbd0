"""A benchmark that is told to end: nothing that it has started outlives it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import psutil
import pytest

from space_dist.errors import SpaceDistError
from tests.grids import ROOT
from tests.patience import PATIENCE

sys.path.append(str(ROOT / "jobs"))

from benchmarks.chaos import _ended_at_once
from benchmarks.processes import MARK, completed, marked
from benchmarks.servers import _Server, until

SLEEPS = [sys.executable, "-c", "import time; time.sleep(1000)"]


class Deaf(_Server):
    """It never answers."""

    name = "the deaf"

    def healthy(self) -> bool:
        return False

    def own(self) -> list[psutil.Process]:
        return [] if self.process is None or self.process.poll() is not None else [psutil.Process(self.process.pid)]


@pytest.mark.parametrize("end", [SystemExit(143), KeyboardInterrupt()])
def test_what_is_still_starting_is_killed_and_not_waited_for(end: BaseException, tmp_path: Path) -> None:
    mark, said = f"test-{os.getpid()}", list[str]()
    server = Deaf(SLEEPS, {**os.environ, MARK: mark}, tmp_path / "log")

    def start() -> None:
        try:
            server.start()
        except SpaceDistError as error:
            said.append(str(error))

    thread = threading.Thread(target=start)
    thread.start()
    assert until(lambda: bool(marked(mark)), PATIENCE)
    with pytest.raises(type(end)), _ended_at_once(mark, server):  # type: ignore[arg-type]
        raise end
    thread.join(PATIENCE)  # it would begin again four times, for 400 s each
    assert said == ["the deaf was given up while it started"]
    assert marked(mark) == []


def test_a_second_sigterm_does_not_stop_the_clearing_up() -> None:
    script = """
import signal, sys, time
sys.path.insert(0, "jobs")
import benchmark
signal.signal(signal.SIGTERM, benchmark._end)
try:
    print("ready", flush=True)
    time.sleep(1000)
finally:
    print("clearing", flush=True)
    sys.stdin.readline()
    print("cleared", flush=True)
"""
    process = subprocess.Popen(
        [sys.executable, "-c", script], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    process.send_signal(signal.SIGTERM)
    assert process.stdout.readline() == "clearing\n"
    process.send_signal(signal.SIGTERM)
    assert process.communicate("\n", timeout=PATIENCE)[0] == "cleared\n"
    assert process.returncode == 128 + signal.SIGTERM


@pytest.mark.parametrize("told", [signal.SIGTERM, signal.SIGINT], ids=["SIGTERM", "Ctrl-C"])
def test_what_a_benchmark_waits_for_ends_with_it(told: signal.Signals) -> None:
    """Its child, which does not hear SIGTERM, and that one's child in a session of its own."""
    child = (
        "import os, signal, subprocess, sys, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); "
        f"subprocess.Popen({SLEEPS!r}, start_new_session=True); print('ready', flush=True); time.sleep(1000)"
    )
    script = f"""
import signal, sys
sys.path.insert(0, "jobs")
from benchmarks import processes
processes._END_SECONDS = 0.2
signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(143))
signal.signal(signal.SIGINT, lambda number, frame: sys.exit(143))
processes.completed([sys.executable, "-c", {child!r}])
"""
    mark = f"test-{os.getpid()}-waits"
    process = subprocess.Popen(
        [sys.executable, "-c", script], cwd=ROOT, stdout=subprocess.PIPE, text=True, env={**os.environ, MARK: mark},
        start_new_session=True,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    assert len(marked(mark)) == 3
    os.killpg(process.pid, told)  # as a terminal does it
    assert process.wait(PATIENCE) == 143
    assert marked(mark) == []


def test_a_child_that_was_just_started_ends_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """The signal comes when the child is there, and `Popen` has not returned."""

    class Interrupted(subprocess.Popen[str]):
        def __init__(self, *words: Any, **how: Any) -> None:
            super().__init__(*words, **how)
            raise KeyboardInterrupt

    monkeypatch.setattr(subprocess, "Popen", Interrupted)
    mark = f"test-{os.getpid()}-started"
    with pytest.raises(KeyboardInterrupt):
        completed(SLEEPS, env={**os.environ, MARK: mark})
    assert marked(mark) == []
