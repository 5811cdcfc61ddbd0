"""A run has one writer at most, wherever it lives, and whatever becomes of it."""

# ruff: noqa: F811 - fixtures that are imported
from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from space_dist.errors import LedgerError, RunLockedError
from space_dist.ledger import (
    CURRICULUM,
    LEASE_SECONDS,
    METRICS,
    ROW_FILES,
    Ledger,
    RunWriter,
)
from space_dist.ledger import lock as locks
from tests.patience import PATIENCE
from tests.three_rounds import (
    WRITES,
    append_round,
    checkpoint_of,
    contents,
    failing,
    in_a_fork,
    ledger,  # noqa: F401
    restored,
    rows_until,
    status_of,
)

HOLD = """
import sys
from space_dist.ledger import Ledger, RunWriter
with RunWriter(Ledger(sys.argv[1])) as writer:
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def owner(ledger: Ledger) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds the ledger."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(ledger.folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdin is not None
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()
    process.stdin.close()
    process.stdout.close()


def lock_of(ledger: Ledger) -> dict[str, Any]:
    return json.loads(ledger.lock_file.read_bytes())


def refused(ledger: Ledger) -> str:
    before = contents(ledger.folder)
    with pytest.raises(RunLockedError) as caught, RunWriter(ledger):
        pass
    assert contents(ledger.folder) == before
    assert ledger.owner_alive()
    return str(caught.value)


def test_a_second_process_is_refused_while_the_first_lives(ledger: Ledger, owner: subprocess.Popen[str]) -> None:
    text = refused(ledger)
    assert f"process {owner.pid} " in text
    assert lock_of(ledger)["host"] in text
    assert owner.stdin is not None
    owner.stdin.close()
    owner.wait()
    assert not ledger.owner_alive()
    assert restored(ledger) == 3


@pytest.mark.parametrize("reaped", [True, False])
def test_a_killed_owner_is_followed_at_once(ledger: Ledger, owner: subprocess.Popen[str], reaped: bool) -> None:
    owner.send_signal(signal.SIGKILL)
    if reaped:
        owner.wait()
    else:  # a zombie until its parent asks
        os.waitid(os.P_PID, owner.pid, os.WEXITED | os.WNOWAIT)
    start = time.monotonic()
    assert not ledger.owner_alive()
    assert restored(ledger) == 3
    assert time.monotonic() - start < 5


def test_a_stopped_owner_is_still_the_owner(ledger: Ledger, owner: subprocess.Popen[str]) -> None:
    owner.send_signal(signal.SIGSTOP)
    lock = lock_of(ledger)
    ledger.lock_file.write_text(json.dumps({**lock, "heartbeat": lock["heartbeat"] - 10 * LEASE_SECONDS}))
    refused(ledger)


def test_a_copy_of_the_owner_changes_nothing(ledger: Ledger) -> None:
    """The case: an environment forks, and the copy goes on as if it were the run."""
    with RunWriter(ledger) as writer:
        writer.restore()
        append_round(writer, 4)
        before = contents(ledger.folder)
        said, tell = os.pipe()

        def go_on_as_the_run() -> None:
            for write in WRITES.values():
                with pytest.raises(RunLockedError) as caught:
                    write(writer)
            with pytest.raises(RunLockedError):
                append_round(writer, 5)
            os.write(tell, str(caught.value).encode())
            writer.__exit__(None, None, None)

        assert in_a_fork(go_on_as_the_run) == 0
        text = os.read(said, 10_000).decode()
        assert f"is process {os.getpid()}'s" in text
        assert "forked" in text
        assert contents(ledger.folder) == before
        assert ledger.owner_alive()
        writer.commit(checkpoint_of(4), status_of(4))
    assert ledger.rows(METRICS, committed_only=True) == rows_until(METRICS, 4)


def test_a_copy_made_while_the_lock_was_taken_does_not_keep_it(ledger: Ledger) -> None:
    go, start = os.pipe()
    with RunWriter(ledger) as writer:
        with writer._lock.held():
            child = os.fork()
            if child == 0:
                os.close(start)
                os.read(go, 1)
                os._exit(0)
        writer.set_status(status_of(3))
    assert restored(ledger) == 3
    os.close(start)
    os.waitpid(child, 0)


HOLD_IN_A_WRITE = """
import os, signal, sys
from space_dist.ledger import Ledger, RunWriter
with RunWriter(Ledger(sys.argv[1])) as writer, writer._lock.held():
    print("held", flush=True)
    os.kill(os.getpid(), signal.SIGSTOP)
"""


def test_an_owner_stopped_in_a_write_is_told_in_a_sentence(ledger: Ledger, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locks, "CLAIM_SECONDS", 0.1)
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD_IN_A_WRITE, str(ledger.folder)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)
        text = refused(ledger)
    finally:
        process.kill()
        process.communicate()
    assert f"process {process.pid} on" in text
    assert "in the middle of a write" in text


def test_a_lock_that_a_stranger_holds_is_told_in_a_sentence(ledger: Ledger, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locks, "CLAIM_SECONDS", 0.1)
    monkeypatch.setattr(locks, "OWNER_SECONDS", 0.1)
    with ledger.lock_file.open("rb") as stranger:
        fcntl.flock(stranger, fcntl.LOCK_EX)
        with pytest.raises(RunLockedError, match=r"cannot claim .*held its lock for 0 s \(`fuser"), RunWriter(ledger):
            pass
        fcntl.flock(stranger, fcntl.LOCK_UN)
        with RunWriter(ledger) as writer:
            writer.restore()
            fcntl.flock(stranger, fcntl.LOCK_EX)
            for write in WRITES.values():
                with pytest.raises(RunLockedError, match="held its lock"):
                    write(writer)
            fcntl.flock(stranger, fcntl.LOCK_UN)
            writer.set_status(status_of(3))
    assert restored(ledger) == 3


def test_only_the_owners_user_can_take_the_lock(ledger: Ledger, tmp_path: Path) -> None:
    ledger.lock_file.chmod(0o644)  # as versions before left it
    assert restored(ledger) == 3
    with RunWriter(Ledger(tmp_path / "new")):
        for path in (ledger.lock_file, tmp_path / "new" / "lock.json"):
            assert path.stat().st_mode & 0o777 == 0o600


def test_a_lock_that_cannot_be_read_is_judged_by_its_age(ledger: Ledger, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locks, "_owner", failing(errno.EACCES))
    assert ledger.owner_alive()
    os.utime(ledger.lock_file, (time.time(), time.time() - LEASE_SECONDS - 1))
    assert not ledger.owner_alive()


def test_a_pipe_for_a_lock_keeps_nobody_waiting(ledger: Ledger) -> None:
    ledger.lock_file.unlink()
    os.mkfifo(ledger.lock_file)
    assert not ledger.owner_alive()
    with pytest.raises(LedgerError, match=r"lock\.json is no regular file"), RunWriter(ledger):
        pass


LINKS: dict[str, Callable[[Path, Path], None]] = {
    "is a link": lambda path, target: path.symlink_to(target),
    "hard link": lambda path, target: path.hardlink_to(target),
    "no regular file": lambda path, target: os.mkfifo(path),
}


@pytest.mark.parametrize("kind", LINKS)
@pytest.mark.parametrize("name", ["lock.json", *ROW_FILES, ".status.json.tmp", ".config.yaml.tmp"])
def test_nothing_is_written_through_a_link(ledger: Ledger, tmp_path: Path, name: str, kind: str) -> None:
    target = tmp_path / "precious"
    path, precious = ledger.folder / name, list[bytes]()

    def put() -> None:
        content = path.read_bytes() if path.exists() else b"precious"
        path.unlink(missing_ok=True)
        target.write_bytes(content)
        precious.append(content)
        LINKS[kind](path, target)

    def write() -> None:
        if name == "lock.json":
            put()
        with RunWriter(ledger) as writer:
            if name != "lock.json":
                put()
            writer.restore()
            writer.write_config("a", "b", "c")
            writer.set_status(status_of(3))

    with pytest.raises(LedgerError) as caught:
        write()
    assert f"{name} " in str(caught.value)
    assert kind in str(caught.value)
    assert "\n" not in str(caught.value)
    assert target.read_bytes() == precious[0]


@pytest.mark.parametrize("name", ["checkpoints", "replay"])
def test_nothing_is_written_or_removed_below_a_link(tmp_path: Path, name: str) -> None:
    """What looks like ours in the folder that it leads to would be taken for checkpoints too many, or left over."""
    precious = tmp_path / "precious"
    precious.mkdir()
    for file in ("round-000000001.npz", "measured.npz", ".measured.tmp"):
        (precious / file).write_text("precious")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / name).symlink_to(precious)
    with pytest.raises(LedgerError, match=rf"{name} is a link"), RunWriter(Ledger(tmp_path / "run")):
        pass
    (tmp_path / "run" / name).unlink()
    with RunWriter(Ledger(tmp_path / "run")) as writer:
        if name == "replay":
            (tmp_path / "run" / name).symlink_to(precious)
            with pytest.raises(LedgerError, match="replay is a link"):
                writer.write_segment(0, 1, {"w": np.zeros(1)})
    assert {file.read_text() for file in precious.iterdir()} == {"precious"}
    assert len([*precious.iterdir()]) == 3


def test_the_same_process_cannot_own_a_run_twice(ledger: Ledger) -> None:
    with RunWriter(ledger):
        refused(ledger)
    assert restored(ledger) == 3


ELSEWHERE = [
    {"host": "elsewhere", "boot_id": "another", "pid_namespace": "pid:[1]"},
    {"boot_id": "another"},
    {"pid_namespace": "pid:[1]"},
    {"boot_id": "", "pid_namespace": ""},
]


@pytest.mark.parametrize("other", ELSEWHERE)
def test_an_owner_elsewhere_is_believed_for_its_lease(ledger: Ledger, other: dict[str, str]) -> None:
    lock = {key: value for key, value in lock_of(ledger).items() if key != "released"}
    far = {**lock, "host": "elsewhere", "pid": 1, **other}
    for age in (0.0, LEASE_SECONDS - 10):
        ledger.lock_file.write_text(json.dumps({**far, "heartbeat": time.time() - age}))
        text = refused(ledger)
        assert "process 1 on elsewhere" in text
        assert f"{LEASE_SECONDS:.0f} s" in text
    ledger.lock_file.write_text(json.dumps({**far, "heartbeat": time.time() - LEASE_SECONDS - 1}))
    assert not ledger.owner_alive()
    assert restored(ledger) == 3


def test_an_owner_that_gave_up_is_not_waited_for(ledger: Ledger) -> None:
    assert lock_of(ledger)["released"] is True
    ledger.lock_file.write_text(json.dumps({**lock_of(ledger), "host": "elsewhere", "boot_id": "another"}))
    assert restored(ledger) == 3


def test_another_process_with_the_owners_number_is_not_the_owner(ledger: Ledger) -> None:
    lock = {key: value for key, value in lock_of(ledger).items() if key != "released"}
    for pid in (os.getpid(), os.getppid(), 1):
        ledger.lock_file.write_text(json.dumps({**lock, "pid": pid, "started": lock["started"] - 1_000}))
        assert not ledger.owner_alive()
        assert restored(ledger) == 3


@pytest.mark.parametrize(
    "garbage",
    [b"", b"{}", b"[]", b"null", b"\0" * 100, b"\xff\xfe", b'{"host": "x", "pi', b'"text"', b"[" * 100_000,
     b"9" * 5_000,
     b'{"heartbeat": "soon"}', b'{"heartbeat": null}', b'{"heartbeat": NaN}', b'{"heartbeat": 1e300}',
     b'{"heartbeat": ' + b"9" * 400 + b"}"],
    ids=range(15),
)  # fmt: skip
def test_a_garbled_lock_blocks_nobody(ledger: Ledger, garbage: bytes) -> None:
    ledger.lock_file.write_bytes(garbage)
    assert not ledger.owner_alive()
    assert restored(ledger) == 3


@pytest.mark.parametrize(
    "change",
    [{"pid": None}, {"pid": "x"}, {"pid": -1}, {"pid": 0}, {"pid": 2**70}, {"pid": [1]}, {"pid": 1e999},
     {"started": None}, {"started": "x"}, {"started": 10**400}, {"started": float("nan")}],
    ids=range(11),
)  # fmt: skip
def test_a_lock_with_a_garbled_owner_blocks_nobody(ledger: Ledger, change: dict[str, Any]) -> None:
    lock = {key: value for key, value in lock_of(ledger).items() if key != "released"}
    ledger.lock_file.write_text(json.dumps({**lock, **change}))
    assert not ledger.owner_alive()
    assert restored(ledger) == 3


def take_over(ledger: Ledger) -> None:
    """As if a process on another host had become the owner."""
    ledger.lock_file.write_text(
        json.dumps({"host": "elsewhere", "boot_id": "b", "pid_namespace": "p", "pid": 7, "started": 1.0,
                    "heartbeat": time.time()})
    )  # fmt: skip


@pytest.mark.parametrize("write", WRITES)
def test_who_lost_a_run_changes_nothing_more(ledger: Ledger, write: str) -> None:
    with RunWriter(ledger) as writer:
        writer.restore()
        append_round(writer, 4)
        writer.write_segment(8, 1, {"w": np.zeros(1)})
        take_over(ledger)
        before = contents(ledger.folder)
        with pytest.raises(RunLockedError, match="taken over by process 7 on elsewhere"):
            WRITES[write](writer)
        assert contents(ledger.folder) == before
    assert contents(ledger.folder) == before  # leaving does not release another's lock


def test_the_rows_of_who_lost_a_run_do_not_reach_it(ledger: Ledger) -> None:
    """The case: a process is suspended for longer than its lease, and wakes in the middle of its successor's round."""
    to_child, from_parent = os.pipe()
    to_parent, from_child = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            with RunWriter(ledger) as late:
                late.restore()
                os.write(from_child, b"1")
                os.read(to_child, 1)
                with contextlib.suppress(RunLockedError):
                    append_round(late, 4)
                os.write(from_child, b"2")
                os.read(to_child, 1)
        finally:
            os._exit(0)
    try:
        assert os.read(to_parent, 1) == b"1"
        lock = lock_of(ledger)
        long_ago = time.time() - 2 * LEASE_SECONDS
        ledger.lock_file.write_text(json.dumps({**lock, "boot_id": "another", "heartbeat": long_ago}))
        with RunWriter(ledger) as successor:
            successor.restore()
            append_round(successor, 4)
            os.write(from_parent, b"1")
            assert os.read(to_parent, 1) == b"2"
            append_round(successor, 5)
            successor.commit(checkpoint_of(5), status_of(5))
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        for descriptor in (to_child, from_parent, to_parent, from_child):
            os.close(descriptor)
    assert ledger.rows(CURRICULUM, committed_only=True) == rows_until(CURRICULUM, 5)
    assert restored(ledger) == 5


@pytest.mark.parametrize("trial", range(5))
def test_of_many_that_race_for_a_dead_owners_run_one_wins(ledger: Ledger, trial: int) -> None:
    def die_holding_it() -> None:
        RunWriter(ledger).__enter__()
        os.kill(os.getpid(), signal.SIGKILL)

    assert in_a_fork(die_holding_it) == -signal.SIGKILL
    assert not ledger.owner_alive()
    go, start = os.pipe()
    end, finish = os.pipe()
    result, report = os.pipe()
    children = []
    for number in range(8):
        child = os.fork()
        if child == 0:
            try:
                os.close(start)
                os.close(finish)
                os.read(go, 1)  # until the parent closes its end
                try:
                    with RunWriter(ledger) as writer:
                        checkpoint = writer.restore()
                        assert checkpoint is not None
                        append_round(writer, checkpoint.round + 1)
                        writer.commit(checkpoint_of(checkpoint.round + 1), status_of(checkpoint.round + 1))
                        os.write(report, b"W")
                        os.read(end, 1)
                except RunLockedError:
                    os.write(report, b"L")
                except BaseException:
                    os.write(report, b"E")
            finally:
                os._exit(0)
        children.append(child)
        assert number < 8
    for descriptor in (go, end, report):
        os.close(descriptor)
    os.close(start)
    answers = b""
    while len(answers) < len(children):
        answers += os.read(result, 1)
    os.close(finish)
    os.close(result)
    for child in children:
        os.waitpid(child, 0)
    assert sorted(answers.decode()) == ["L"] * 7 + ["W"], f"trial {trial}"
    assert restored(ledger) == 4


def test_the_owner_keeps_its_lease(ledger: Ledger, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locks, "HEARTBEAT_SECONDS", 0.02)
    with RunWriter(ledger):
        first = lock_of(ledger)["heartbeat"]
        deadline = time.monotonic() + PATIENCE
        while lock_of_or_none(ledger) in (None, first) and time.monotonic() < deadline:
            time.sleep(0.01)
        assert lock_of_or_none(ledger) != first
        take_over(ledger)
        mine = ledger.lock_file.read_bytes()
        time.sleep(0.2)
        assert ledger.lock_file.read_bytes() == mine  # a heartbeat does not take a run back


def lock_of_or_none(ledger: Ledger) -> float | None:
    """The heartbeat, unless it is just being written."""
    try:
        return float(lock_of(ledger)["heartbeat"])
    except ValueError:
        return None
