"""What a writer that died, or a disk that refused, has left of a run: restored to its last checkpoint."""

# ruff: noqa: F811 - fixtures that are imported
from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from space_dist.errors import LedgerError
from space_dist.ledger import (
    METRICS,
    ROW_FILES,
    TIMING,
    Ledger,
    RunWriter,
    encode_row,
)
from tests.faults.injection import Disk, Kills
from tests.three_rounds import (
    WRITES,
    append_round,
    checkpoint_of,
    contents,
    failing,
    ledger,  # noqa: F401
    restored,
    rows_until,
    status_of,
    write_rounds,
)

# ---- restoring ------------------------------------------------------------------------------------------------------


def test_restoring_cuts_what_no_checkpoint_covers(ledger: Ledger) -> None:
    with RunWriter(ledger) as writer:
        writer.restore()
        append_round(writer, 4)
    (ledger.folder / TIMING).open("ab").write(b'{"torn')
    assert restored(ledger) == 3
    with RunWriter(ledger) as writer:
        writer.restore()
        write_rounds(writer, 4, 5)
    assert restored(ledger) == 5


def test_restoring_nothing_starts_at_nothing(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "new")
    assert restored(ledger) == 0
    with RunWriter(ledger) as writer:
        writer.restore()
        append_round(writer, 1)
    assert restored(ledger) == 0


def damage_by_truncation(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def damage_by_a_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[content.index(b"NUMPY") + 100] ^= 1
    path.write_bytes(content)


def damage_by_emptying(path: Path) -> None:
    path.write_bytes(b"")


def damage_by_a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


@pytest.mark.parametrize("damage", [damage_by_truncation, damage_by_a_bit, damage_by_emptying])
def test_a_damaged_newest_checkpoint_gives_way_to_the_one_before(
    ledger: Ledger, damage: Callable[[Path], None]
) -> None:
    damage(ledger.checkpoint_files()[0])
    assert restored(ledger) == 2
    assert len(ledger.checkpoint_files()) == 1
    with RunWriter(ledger) as writer:
        writer.restore()
        write_rounds(writer, 3, 4)
    assert restored(ledger) == 4


def test_without_an_intact_checkpoint_nothing_is_touched(ledger: Ledger) -> None:
    for path in ledger.checkpoint_files():
        damage_by_truncation(path)
    before = contents(ledger.folder)
    with RunWriter(ledger) as writer, pytest.raises(LedgerError) as caught:
        writer.restore()
    for part in (str(ledger.folder), "no checkpoint is intact", "round-000000003.npz", "round-000000002.npz"):
        assert part in str(caught.value)
    after = contents(ledger.folder)
    assert {**after, "lock.json": b""} == {**before, "lock.json": b""}


@pytest.mark.parametrize("name", ROW_FILES)
def test_rows_that_changed_under_a_checkpoint_are_noticed(ledger: Ledger, name: str) -> None:
    path = ledger.folder / name
    content = path.read_bytes()
    third = len(b"".join(map(encode_row, rows_until(name, 2)))) + 5
    path.write_bytes(content[:third] + b"!" + content[third + 1 :])
    assert restored(ledger) == 2  # the second checkpoint covers only what is intact
    path.write_bytes(b"!" + path.read_bytes()[1:])
    with RunWriter(ledger) as writer, pytest.raises(LedgerError, match=f"{name} has changed since"):
        writer.restore()
    path.write_bytes(b"")
    with RunWriter(ledger) as writer, pytest.raises(LedgerError, match=f"{name} is shorter than it was"):
        writer.restore()


def test_pieces_of_a_replay_buffer_belong_to_their_checkpoint(ledger: Ledger) -> None:
    pieces = {"rewards": np.arange(4.0), "actions": np.ones((4, 1), dtype=np.int64)}
    with RunWriter(ledger) as writer:
        writer.restore()
        segments = []
        for number in (4, 5):
            segments.append(writer.write_segment(4 * (number - 4), 4, pieces))
            append_round(writer, number)
            writer.commit(checkpoint_of(number, segments=tuple(segments)), status_of(number))
        stray = writer.write_segment(8, 4, pieces)
        writer.commit(checkpoint_of(5, segments=tuple(segments)), status_of(5))  # the last round, committed again
        assert sorted(path.name for path in ledger.replay.iterdir()) == [segment.name for segment in segments]
        assert stray not in segments
    with RunWriter(ledger) as writer:
        checkpoint = writer.restore()
        assert checkpoint is not None
        assert checkpoint.segments == tuple(segments)
        for name, array in writer.read_segment(segments[1]).items():
            assert array.dtype == pieces[name].dtype
            np.testing.assert_array_equal(array, pieces[name])
    damage_by_a_bit(ledger.replay / segments[1].name)
    with RunWriter(ledger) as writer:
        checkpoint = writer.restore()
        assert checkpoint is not None
        assert checkpoint.round == 4
    (ledger.replay / segments[0].name).unlink()
    with RunWriter(ledger) as writer, pytest.raises(LedgerError, match="no checkpoint is intact"):
        writer.restore()


# ---- dying at any moment --------------------------------------------------------------------------------------------


def whole_run(folder: Path, last: int = 4) -> None:
    with RunWriter(Ledger(folder)) as writer:
        writer.write_config("name: x\n", "train\n", "test\n")
        writer.set_status(status_of(0))
        checkpoint = writer.restore()
        write_rounds(writer, 1 if checkpoint is None else checkpoint.round + 1, last)
        writer.commit(checkpoint_of(last), status_of(last))
        writer.write_model({"w": np.zeros(3)}, {"kind": "test"})
        writer.set_status(status_of(last, state="done"))


def test_a_run_killed_before_any_call_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)  # for speed
    run = tmp_path / "run"
    run.mkdir()
    kills = Kills(run, tmp_path / "killed", uncompared=())
    with Disk(run, kills).watched() as disk:
        whole_run(run)
    reference, reached = contents(run), set()
    for what, folder in kills.moments:
        ledger = Ledger(folder)
        said = 0
        if ledger.status_file.exists():
            status = ledger.status()
            said = status.round
            assert (ledger.config.read_bytes(), status.name) == (b"name: x\n", "name"), what
            if status.state == "done":
                assert ledger.model_description.exists(), what
        found = restored(ledger)
        assert found >= said, what
        reached.add(found)
        whole_run(folder)
        after = contents(folder)
        for name in (*ROW_FILES, "checkpoints/round-000000004.npz", "checkpoints/round-000000003.npz", "config.yaml"):
            assert after[name] == reference[name], (what, name)
        assert {name for name in after if not name.endswith(".tmp")} == set(reference), what
    assert reached == {0, 1, 2, 3, 4}
    assert disk.calls > 100


def test_a_resumption_killed_before_any_call_resumes(
    ledger: Ledger, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    """The newest checkpoint is damaged and rows are torn, so restoring has most to do."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)  # for speed
    damage_by_truncation(ledger.checkpoint_files()[0])
    (ledger.folder / METRICS).open("ab").write(b"torn")
    kills = Kills(ledger.folder, tmp_path / "killed", uncompared=())
    with Disk(ledger.folder, kills).watched() as disk, RunWriter(ledger) as writer:
        writer.restore()
    for what, folder in kills.moments:
        assert restored(Ledger(folder)) == 2, what
    assert disk.calls > 10


# ---- a disk that refuses --------------------------------------------------------------------------------------------


def failing_to_write(number: int) -> Callable[..., int]:
    """`os.open` on a disk that can be read."""
    really = os.open

    def fail(path: object, flags: int, *more: Any, **options: Any) -> int:
        if flags & (os.O_WRONLY | os.O_RDWR):
            raise OSError(number, os.strerror(number), str(path))
        return really(path, flags, *more, **options)  # type: ignore[call-overload, no-any-return]

    return fail


REFUSALS = [
    (errno.ENOSPC, "the disk is full"),
    (errno.EROFS, "the file system is read-only"),
    (errno.EDQUOT, "quota"),
    (errno.EACCES, "permission denied"),
    (errno.EIO, os.strerror(errno.EIO)),
]


@pytest.mark.parametrize(("number", "said"), REFUSALS, ids=[errno.errorcode[number] for number, _ in REFUSALS])
@pytest.mark.parametrize("write", WRITES)
@pytest.mark.parametrize("where", ["fsync", "open"])
def test_a_disk_that_refuses_is_told_in_one_sentence(
    ledger: Ledger, monkeypatch: pytest.MonkeyPatch, write: str, where: str, number: int, said: str
) -> None:
    with RunWriter(ledger) as writer:
        writer.restore()
        append_round(writer, 4)
        with monkeypatch.context() as patch:
            patch.setattr(os, where, failing_to_write(number) if where == "open" else failing(number))
            with pytest.raises(LedgerError) as caught:
                WRITES[write](writer)
        assert said in str(caught.value)
        assert str(ledger.folder) in str(caught.value)
        assert "\n" not in str(caught.value)
    assert restored(ledger) == 3


@pytest.mark.parametrize(("number", "said"), REFUSALS, ids=[errno.errorcode[number] for number, _ in REFUSALS])
def test_rows_on_a_disk_that_refuses(ledger: Ledger, monkeypatch: pytest.MonkeyPatch, number: int, said: str) -> None:
    with RunWriter(ledger) as writer:
        writer.restore()
        with monkeypatch.context() as patch:
            patch.setattr(os, "open", failing(number))
            with pytest.raises(LedgerError, match=said):
                write_rounds(writer, 4, 4)
    assert restored(ledger) == 3


def test_a_commit_that_failed_can_be_made_again(ledger: Ledger, monkeypatch: pytest.MonkeyPatch) -> None:
    fsync, calls = os.fsync, [0]

    def sometimes(descriptor: int) -> None:
        calls[0] -= 1
        if calls[0] == 0:
            raise OSError(errno.ENOSPC, "full")
        fsync(descriptor)

    for number in range(4, 30):
        failed = False
        with RunWriter(ledger) as writer:
            writer.restore()
            append_round(writer, number)
            calls[0] = number - 3  # which call fails
            with monkeypatch.context() as patch:
                patch.setattr(os, "fsync", sometimes)
                try:
                    writer.commit(checkpoint_of(number), status_of(number))
                except LedgerError:
                    failed = True
                    writer.commit(checkpoint_of(number), status_of(number))
        assert restored(ledger) == number
        if not failed:
            break
    assert number > 8


def test_a_folder_that_cannot_be_made_is_told_in_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    folders = (tmp_path / "file", tmp_path / "file" / "below", Path("/proc/space_dist_run"), tmp_path / ("x" * 300))
    for folder in folders:
        with pytest.raises(LedgerError) as caught, RunWriter(Ledger(folder)):
            pass
        assert str(folder) in str(caught.value)


def test_entering_that_fails_leaves_no_claim(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    ledger.checkpoints.write_text("in the way")
    with pytest.raises(LedgerError, match="in the way"), RunWriter(ledger):
        pass
    assert not ledger.owner_alive()
    ledger.checkpoints.unlink()
    assert restored(ledger) == 0
