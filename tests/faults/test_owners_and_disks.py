"""Two processes on one run, on one host or two; disks that are full or read-only."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from space_dist.ledger import Ledger
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests
from tests import prepared
from tests.faults.slow_env import PAUSE
from tests.faults.test_every_write import short
from tests.faults.test_requests import ROOT, command
from tests.patience import PATIENCE
from tests.test_learners import results


def can(*arguments: str) -> bool:
    return shutil.which(arguments[0]) is not None and subprocess.run(arguments, capture_output=True).returncode == 0


needs_namespaces = pytest.mark.skipif(
    not can("unshare", "--net", "--uts", "--mount", "true"), reason="takes the right to make namespaces (root)"
)


def on_host(name: str, *flags: str) -> list[str]:
    return ["unshare", "--net", "--uts", *flags, "sh", "-c", f'hostname {name} && exec "$@"', "sh"]


@needs_namespaces
@pytest.mark.parametrize("flags", [(), ("--pid", "--fork", "--kill-child")], ids=["hosts", "two containers"])
def test_of_two_processes_on_two_hosts_one_works_and_the_other_says_why(tmp_path: Path, flags: tuple[str, ...]) -> None:
    train = command(tmp_path, env="tests.faults.slow_env:make")
    words = [sys.executable, "-m", "space_dist.cli", *map(str, train)]
    both = [
        subprocess.Popen(
            [*on_host(f"node{number}", *flags), *words], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, env={**os.environ, PAUSE: "0.02"},
        )
        for number in (1, 2)
    ]  # fmt: skip
    said = [process.communicate(timeout=PATIENCE) for process in both]
    codes = [process.returncode for process in both]
    assert sorted(codes) == [0, 1], said
    winner, loser = codes.index(0), codes.index(1)
    assert "done" in said[winner][0]
    assert "is being worked on by process" in said[loser][1]
    assert f"on node{winner + 1}" in said[loser][1]
    assert "Traceback" not in said[loser][1]
    assert Ledger(tmp_path / "run").status().state == "done"


def ended(train: list[object], output: Path) -> tuple[int | None, str]:
    """Exit code of `space-dist ...`, and what it said."""
    process = prepared.command(train, output)
    process.join(PATIENCE)
    return process.exitcode, output.read_text()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of its own, so small that a run does not fit on it."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if not can("mount", "-t", "tmpfs", "-o", "size=56k", "tmpfs", str(disk)):
        pytest.skip("takes the right to mount (root)")
    yield disk
    assert can("umount", "--lazy", str(disk))


def test_a_full_disk_is_one_sentence_and_the_run_goes_on_once_there_is_room(tmp_path: Path, small_disk: Path) -> None:
    config = short(tmp_path, "ppo", 4)
    launch(config, tmp_path / "reference", resume=True, stop=StopRequests())
    train = [*command(tmp_path)[:-2], "--out", str(small_disk / "run")]
    code, said = ended(train, tmp_path / "full")
    assert code == 1
    assert "the disk is full" in said
    assert "Traceback" not in said
    assert can("mount", "-o", "remount,size=4m", str(small_disk))
    code, said = ended(train, tmp_path / "done")
    assert code == 0, said
    assert results(small_disk / "run") == results(tmp_path / "reference")


def test_a_read_only_folder_is_one_sentence(tmp_path: Path, small_disk: Path) -> None:
    assert can("mount", "-o", "remount,ro", str(small_disk))
    train = [*command(tmp_path)[:-2], "--out", str(small_disk / "run")]
    code, said = ended(train, tmp_path / "read-only")
    assert code == 1
    assert "the file system is read-only" in said
    assert "Traceback" not in said
    assert list(small_disk.iterdir()) == []


def test_a_dead_tracking_server_is_a_warning(tmp_path: Path) -> None:
    train = command(tmp_path, "tracking.uri=http://127.0.0.1:9", "tracking.live=false")
    code, said = ended(train, tmp_path / "done")
    assert code == 0, said
    assert Ledger(tmp_path / "run").status().state == "done"
