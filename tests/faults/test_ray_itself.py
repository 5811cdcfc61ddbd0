"""A Ray that hangs, dies or is not there: told within a bound, nothing left behind, nothing lost."""

from __future__ import annotations

import contextlib
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path

import psutil
import pytest

from space_dist.config import to_yaml
from space_dist.errors import SpaceDistError
from space_dist.ledger import Ledger
from space_dist.run import ray_watch
from space_dist.run.ray_watch import Started, asked, parts, reach
from tests import prepared
from tests.patience import PATIENCE

ROOT = Path(__file__).resolve().parents[2]
RUN: list[object] = ["train", ROOT / "configs/pointmass_space.yaml", "--workers", 1]
SMALL = ["learner.n_steps=512", "rollout.slots=1", "evaluation.every_steps=1000000", "tracking.uri=null"]


def impatient() -> None:
    ray_watch.SILENT_SECONDS, ray_watch._ASK_SECONDS = 8.0, 2.0


@pytest.fixture
def mute() -> Iterator[str]:
    """An address whose connections the kernel takes, and nobody answers: as of a stopped process."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"127.0.0.1:{server.getsockname()[1]}"


def nobodys() -> str:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"127.0.0.1:{server.getsockname()[1]}"


def test_what_hangs_is_told_from_what_is_gone(mute: str) -> None:
    assert asked(mute, 0.2) == "silent"
    assert asked(nobodys(), 0.2) == "gone"


def test_an_address_that_nobody_answers_at_is_told(mute: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_watch, "REACH_SECONDS", 1.0)
    heeded: list[int] = []
    for address, said in ((nobodys(), "nobody listens there"), (mute, "what listens there does not answer")):
        with pytest.raises(SpaceDistError, match=f"^{said}, for 1 s$"):
            reach(address, lambda: heeded.append(1))
    with pytest.raises(
        SpaceDistError, match=r"^the name 'nohost\.invalid' cannot be resolved \(.+\); is it spelt right"
    ):
        reach("nohost.invalid:6379", lambda: None)
    assert heeded
    reach("auto", lambda: None)  # Ray's to find
    with pytest.raises(
        SpaceDistError, match=r"^an address must be local, auto or HOST:PORT \(ray:// is a Ray client's"
    ):
        reach("ray://head:10001", lambda: None)


def test_only_what_we_started_is_ended() -> None:
    before = subprocess.Popen(["/bin/sleep", "600"])
    try:
        started = Started()
        other = subprocess.Popen(["/bin/sleep", "600"])  # ours, and no part of Ray
        rays = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)", "/ray/core/raylet"])
        time.sleep(0.2)
        started.look()
        started.end(0.0)
        assert rays.wait(PATIENCE) == -signal.SIGKILL
        assert (before.poll(), other.poll()) == (None, None)
    finally:
        for process in (before, other, rays):
            process.kill()
            process.wait()


def test_the_parts_are_the_control_store_and_this_nodes_raylet() -> None:
    nodes = [{"NodeID": name, "NodeManagerAddress": "10.0.0.1", "NodeManagerPort": port} for name, port in
             (("a", 1), ("b", 2))]  # fmt: skip
    assert parts(nodes, "b", "10.0.0.9:3") == {"the control store (GCS)": "10.0.0.9:3", "the raylet": "10.0.0.1:2"}


def ended(run: BaseProcess) -> int | None:
    run.join(PATIENCE)
    return run.exitcode


def end(below: list[psutil.Process], run: BaseProcess) -> None:
    """Leave nothing of a test that failed."""
    for process in below:
        with contextlib.suppress(psutil.Error):
            process.kill()
    run.kill()
    run.join()


@pytest.mark.ray
@pytest.mark.parametrize(
    ("victim", "number", "said"),
    [
        ("raylet", signal.SIGSTOP, "the raylet of the Ray of our own has not answered anything for"),
        ("gcs_server", signal.SIGSTOP, "the control store (GCS) of the Ray of our own has not answered anything for"),
        ("gcs_server", signal.SIGKILL, "the control store (GCS) of the Ray of our own has died"),
    ],
    ids=["a stopped raylet", "a stopped GCS", "a killed GCS"],
)
def test_a_ray_that_hangs_or_dies_ends_a_run_with_75(
    victim: str, number: signal.Signals, said: str, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    settings = [word for setting in SMALL for word in ("--set", setting)]
    run = prepared.command([*RUN, "--out", out, *settings], tmp_path / "said", impatient)
    below: list[psutil.Process] = []
    try:
        deadline = time.monotonic() + PATIENCE
        while not (out / "metrics.jsonl").exists() and run.is_alive() and time.monotonic() < deadline:
            time.sleep(0.2)
        below = psutil.Process(run.pid).children(recursive=True)
        (hit,) = [process for process in below if process.name() == victim]
        hit.send_signal(number)
        assert ended(run) == 75
        assert said in (out / "log.txt").read_text()
        assert said in (tmp_path / "said").read_text()
        assert psutil.wait_procs(below, timeout=PATIENCE)[1] == []
        status = Ledger(out).status()
        assert (status.state, said in str(status.message)) == ("interrupted", True)
    finally:
        end(below, run)


@pytest.mark.ray
def test_a_grid_whose_own_ray_dies_ends_with_75(tmp_path: Path) -> None:
    grid = tmp_path / "grid.yaml"
    grid.write_text(to_yaml({
        "name": "orphan", "extends": str(ROOT / "configs/pointmass_space.yaml"), "seeds": {"count": 1},
        "set": {
            "learner.n_steps": 512, "rollout.slots": 1, "evaluation.every_steps": 1_000_000,
        },
        "resources": {"workers": 1}, "tracking": {"uri": None},
    }))  # fmt: skip
    said, below = "the control store (GCS) of the Ray of our own has died", list[psutil.Process]()
    run = prepared.command(["grid", "run", grid, "--root", tmp_path], tmp_path / "said", impatient)
    try:
        deadline = time.monotonic() + PATIENCE
        while not [*tmp_path.glob("orphan/*/s0/metrics.jsonl")] and run.is_alive() and time.monotonic() < deadline:
            time.sleep(0.2)
        assert run.is_alive(), (tmp_path / "said").read_text()
        below = psutil.Process(run.pid).children(recursive=True)
        for process in below:
            if process.name() == "gcs_server":
                process.kill()
        assert ended(run) == 75, (tmp_path / "said").read_text()
        assert said in (tmp_path / "said").read_text()
        assert psutil.wait_procs(below, timeout=PATIENCE)[1] == []
    finally:
        end(below, run)


ENDS = """
import os, subprocess, sys, time
from pathlib import Path
import psutil
from space_dist.run import ray_watch

started, folder, found = ray_watch.Started(), Path(sys.argv[1]), {}
for name in ("raylet", "gcs_server"):
    (folder / name).write_text(f"#!{sys.executable}\\nimport time\\ntime.sleep(600)\\n")
    (folder / name).chmod(0o755)
    found[name] = subprocess.Popen([folder / name]).pid
    while psutil.Process(found[name]).name() != name:
        pass
really = os._exit

def end(code):
    raylet, until = psutil.Process(found["raylet"]), time.monotonic() + 8.0  # by 10 s it is killed all the same
    while raylet.status() not in (psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP) and time.monotonic() < until:
        time.sleep(0.01)  # told to stop, it does nothing more, and is seen as stopped once its turn on a CPU has come
    print(found["raylet"], found["gcs_server"], raylet.status(), flush=True)
    really(code)

os._exit = end
ray_watch._end("it hangs", started, 75, ray_watch.nowhere)
"""


def test_a_process_that_ends_with_its_ray_is_gone_before_its_raylet(tmp_path: Path) -> None:
    """Ray's library, which sees that its raylet is gone, would end it with a code of its own."""
    folder = tmp_path / "ray"
    folder.mkdir()
    done = subprocess.run(
        [sys.executable, "-c", ENDS, folder], capture_output=True, text=True, cwd=ROOT, timeout=PATIENCE, check=False
    )  # fmt: skip
    assert done.returncode == 75, done.stderr
    assert done.stderr.endswith("space-dist: it hangs\n")
    raylet, gcs_server, status = done.stdout.split()
    assert status in (psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP)
    deadline = time.monotonic() + PATIENCE
    while psutil.pid_exists(int(raylet)) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not psutil.pid_exists(int(raylet))
    assert not psutil.pid_exists(int(gcs_server))
