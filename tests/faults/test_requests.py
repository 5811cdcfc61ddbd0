"""Requests to stop are heard at any time, and answered with 75."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.process import BaseProcess
from pathlib import Path

import psutil
import pytest

from space_dist import config as configs
from space_dist.grid import conductor
from space_dist.grid.planning import plan
from space_dist.ledger import Ledger
from space_dist.run.launch import launch
from space_dist.system.interrupts import STOP_SIGNALS, StopRequests
from space_dist.tracking.pusher import NO_LONGER
from tests import prepared
from tests.faults.slow_env import PAUSE, STEPPING
from tests.faults.test_every_write import short
from tests.grids import write_grid
from tests.patience import PATIENCE
from tests.test_learners import results

ROOT = Path(__file__).resolve().parent.parent.parent

WHAT_IS_IMPORTED = """
import sys
from space_dist.system.interrupts import StopRequests
def install(self):
    print(*sorted({name.partition(".")[0] for name in sys.modules}))
    raise SystemExit(0)
StopRequests.install = install
from space_dist.cli import main
sys.argv = ["space-dist", "train", "config.yaml"]
main()
"""


def test_handlers_stand_before_anything_heavy_is_imported() -> None:
    done = subprocess.run([sys.executable, "-c", WHAT_IS_IMPORTED], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    imported = set(done.stdout.split())
    assert {"space_dist", "typer"} <= imported
    assert not imported & {"numpy", "torch", "ray", "mlflow", "gymnasium", "scipy", "stable_baselines3"}


def test_handlers_stand_while_something_would_replace_them() -> None:
    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    stop = StopRequests()
    try:
        with stop.keeping_handlers():  # none were set
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_IGN
        stop.install()
        ours = signal.getsignal(signal.SIGTERM)
        with stop.keeping_handlers():
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            assert signal.getsignal(signal.SIGTERM) == ours
            signal.signal(signal.SIGUSR2, signal.SIG_IGN)  # none of ours
        assert signal.getsignal(signal.SIGUSR2) == signal.SIG_IGN
        assert signal.getsignal(signal.SIGTERM) == ours
    finally:
        signal.signal(signal.SIGUSR2, signal.SIG_DFL)
        for number, handler in before.items():
            signal.signal(number, handler)


def command(tmp_path: Path, *settings: str, env: str | None = None) -> list[object]:
    config = short(tmp_path, "ppo", 4)
    if env is not None:
        config = config.model_copy(update={"env": config.env.model_copy(update={"id": env})})
    (tmp_path / "config.yaml").write_text(configs.dump(config))
    made: list[object] = ["train", tmp_path / "config.yaml", "--resume", "--out", tmp_path / "run"]
    for setting in settings:
        made += ["--set", setting]
    return made


def test_a_round_longer_than_the_grace_time_ends_with_75_on_the_last_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = command(
        tmp_path, "resources.grace_seconds=0.3", "evaluation.every_steps=100000", env="tests.faults.slow_env:make"
    )
    monkeypatch.setenv(PAUSE, "0.3")
    process, said = prepared.command(slow, tmp_path / "said.txt"), tmp_path / "said.txt"
    monkeypatch.delenv(PAUSE)
    try:
        deadline = time.monotonic() + PATIENCE
        while not list((tmp_path / "run" / "checkpoints").glob("round-*2.npz")) and time.monotonic() < deadline:
            time.sleep(0.01)
            assert process.is_alive()
        send(process, signal.SIGUSR1)
        process.join(PATIENCE)
    finally:
        process.kill()
    assert process.exitcode == 75, said.read_text()
    assert "Traceback" not in said.read_text()
    first, last = re.findall(r"^space-dist: (.*)$", said.read_text(), re.MULTILINE)
    assert first == "SIGUSR1: ending with a checkpoint, which takes up to 0.3 s"
    assert last == "that took too long: ended on the last checkpoint (exit code 75)"
    status = Ledger(tmp_path / "run").status()
    assert status.checkpoint == "round-000000002.npz"
    config = configs.load(tmp_path / "config.yaml", ["evaluation.every_steps=100000"])
    launch(config, tmp_path / "run", resume=True, stop=StopRequests())
    launch(config, tmp_path / "reference", resume=True, stop=StopRequests())
    assert results(tmp_path / "run") == results(tmp_path / "reference")


def test_a_second_ctrl_c_ends_at_once_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said, stepping = tmp_path / "said.txt", tmp_path / "stepping"
    monkeypatch.setenv(PAUSE, "5")
    monkeypatch.setenv(STEPPING, str(stepping))
    process = prepared.command(command(tmp_path, env="tests.faults.slow_env:make"), said)
    monkeypatch.delenv(PAUSE)
    monkeypatch.delenv(STEPPING)
    try:
        deadline = time.monotonic() + PATIENCE
        while not stepping.exists() and time.monotonic() < deadline:  # before it, a first Ctrl-C ends at once
            time.sleep(0.01)
        send(process, signal.SIGINT)
        while "another Ctrl-C" not in said.read_text() and time.monotonic() < deadline:
            time.sleep(0.01)
        send(process, signal.SIGINT)
        process.join(PATIENCE)
    finally:
        process.kill()
    assert process.exitcode == 75, said.read_text()
    assert re.findall(r"^space-dist: (.*)$", said.read_text(), re.MULTILINE) == [
        "SIGINT: ending with a checkpoint, which takes up to 25 s; another Ctrl-C ends at once, without it",
        "SIGINT again: ended at once, on the last checkpoint that there is (exit code 75)",
    ]


def test_a_finished_run_that_waits_for_its_mirror_alone_ends_at_once(tmp_path: Path) -> None:
    said = tmp_path / "said.txt"
    with socket.create_server(("127.0.0.1", 0)) as mute:  # the kernel takes connections, and nobody answers
        uri = f"http://127.0.0.1:{mute.getsockname()[1]}"
        process = prepared.command(command(tmp_path, f"tracking.uri={uri}", "budget.steps=64"), said)
        try:
            deadline = time.monotonic() + PATIENCE
            while not (said.exists() and "mirroring to" in said.read_text()) and time.monotonic() < deadline:
                time.sleep(0.01)
            send(process, signal.SIGTERM)
            process.join(PATIENCE)
        finally:
            process.kill()
    assert process.exitcode == 0, said.read_text()
    assert Ledger(tmp_path / "run").status().state == "done"
    assert f"space-dist: SIGTERM: {NO_LONGER}\n" in said.read_text()
    found = re.search(rf"MLflow at {uri} is still being brought up to date, by process (\d+);", said.read_text())
    assert found, said.read_text()
    with suppress(ProcessLookupError):
        os.killpg(int(found[1]), signal.SIGKILL)


def test_where_nothing_is_left_a_request_ends_no_process() -> None:
    said: list[str] = []
    asked = StopRequests(tell=said.append)
    for stop in (StopRequests(shared=asked), asked):
        with stop.nothing_left("on it goes") as left:
            assert not left()
            if stop is not asked:
                asked._on_signal(signal.SIGTERM, None)
                assert left()
    assert said == ["SIGTERM: on it goes"]
    assert not [thread for thread in threading.enumerate() if isinstance(thread, threading.Timer)]
    assert asked.reason() == "SIGTERM"


def test_a_finished_grid_hears_a_request_as_soon_as_it_waits_for_its_mirror(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    stop = StopRequests(tell=said.append)

    class Mirror:
        where = "MLflow"

        def __init__(self, *_: object) -> None:
            pass

        def is_soon_over(self) -> bool:
            stop._on_signal(signal.SIGTERM, None)
            return False

        def warning(self, seconds: float, what: str, leave: Callable[[], bool]) -> str:
            return f"of a {what}, after {0 if leave() else seconds} s"

        def pages(self) -> list[str]:
            return []

    monkeypatch.setattr(conductor, "Pusher", Mirror)
    path = write_grid(tmp_path, tracking={"uri": "http://127.0.0.1:9"})
    made = plan(path, tmp_path / "runs")
    with conductor.working_on(made.grid, made.manifest, wait=False, stop=stop, say=said.append):
        pass
    assert said == [
        f"SIGTERM: {NO_LONGER}", "mirroring to MLflow, for 300 s at most", "warning: of a grid, after 0 s",
    ]  # fmt: skip
    assert not [thread for thread in threading.enumerate() if isinstance(thread, threading.Timer)]


@pytest.mark.ray
@pytest.mark.parametrize("progress", [0.0, 0.5, 1.0, None])
def test_sigterm_while_ray_starts_ends_with_75(tmp_path: Path, progress: float | None) -> None:
    """Once, at some moment; or (None) ever again, so that there is no moment at which it has not come."""
    said = tmp_path / "said.txt"
    process = prepared.command(
        command(tmp_path, "resources.workers=1", "budget.steps=320000", "resources.grace_seconds=100"), said
    )
    try:
        log, deadline = tmp_path / "run" / "log.txt", time.monotonic() + PATIENCE
        while not log.exists() and time.monotonic() < deadline:  # what is written just before Ray is started
            time.sleep(0.01)
        if progress is None:
            watched = psutil.Process(process.pid)
            while not any(child.name() == "gcs_server" for child in watched.children()):
                assert time.monotonic() < deadline
                time.sleep(0.01)
            while process.is_alive():
                assert time.monotonic() < deadline
                with suppress(ProcessLookupError):  # it ended since it was asked
                    send(process, signal.SIGTERM)
                time.sleep(0.01)
        else:
            time.sleep(4.0 * progress)
            send(process, signal.SIGTERM)
        process.join(PATIENCE)
    finally:
        process.kill()
    assert process.exitcode == 75, said.read_text()
    assert "stopped by SIGTERM" in said.read_text()
    assert Ledger(tmp_path / "run").status().state == "interrupted"
    assert os.environ.get("RAY_ADDRESS") is None


def send(process: BaseProcess, number: signal.Signals) -> None:
    assert process.pid is not None
    os.kill(process.pid, number)
