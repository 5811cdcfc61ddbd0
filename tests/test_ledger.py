"""The ledger: what is read is what was written, or an error; a run killed anywhere resumes; one process owns it."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import io
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from space_dist.errors import LedgerError, RunLockedError
from space_dist.ledger import (
    CURRICULUM,
    LEASE_SECONDS,
    METRICS,
    ROW_FILES,
    TIMING,
    Checkpoint,
    Ledger,
    RunWriter,
    Segment,
    Status,
    decode_checkpoint,
    decode_row,
    encode_checkpoint,
    encode_row,
    find_ledgers,
)

ROOT = Path(__file__).parent.parent
FLIPS = (0x01, 0x20, 0x80, 0xFF)
ROUNDS = 3


# ---- a small run -----------------------------------------------------------------------------------------------------


@pytest.fixture
def no_fsync(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that write a lot and lose no power."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


def rows_of(number: int) -> dict[str, list[dict[str, Any]]]:
    """What round `number` (from 1 on) adds to each file."""
    metrics = [{"row": 2 * number + i, "kind": "iteration", "return": -number / 7, "round": number} for i in (0, 1)]
    timing = [{"row": row["row"], "seconds": 0.125 * number, "round": number} for row in metrics]
    return {METRICS: metrics, TIMING: timing, CURRICULUM: [{"ids": list(range(number)), "round": number}]}


def all_rows(until: int, name: str) -> list[dict[str, Any]]:
    return [row for number in range(1, until + 1) for row in rows_of(number)[name]]


def status_of(number: int) -> Status:
    return Status(
        state="running", name="a rün", seed=3, steps=64 * number, budget_steps=256, round=number, started_at=1.75e9,
        updated_at=1.75e9 + number / 3, fingerprint={"cpu": "x", "numpy": "2.0"},
    )  # fmt: skip


def write_round(writer: RunWriter, number: int) -> None:
    for name, rows in rows_of(number).items():
        for row in rows:
            writer.append(name, row)
    segment = writer.write_segment(8 * number, 8, {"rewards": np.arange(8) + number})
    before = [Segment(8 * (number - 1), 8, "")] if number > 1 else []
    arrays = {"weights": np.full(5, number, np.float32), "n": np.array(number)}
    writer.commit(Checkpoint(number, arrays, {"rows": 2 * number}, (segment,)), status_of(number))
    writer.drop_segments({segment.name} | {old.name for old in before})


def write_run(folder: Path, until: int = ROUNDS, committed: Callable[[int], None] = lambda number: None) -> Ledger:
    """Start a run, or go on with one, until round `until`."""
    ledger = Ledger(folder)
    with RunWriter(ledger) as writer:
        checkpoint = writer.restore()
        for number in range(checkpoint.round if checkpoint else 0, until):
            write_round(writer, number + 1)
            committed(number + 1)
    return ledger


def contents(folder: Path) -> dict[str, bytes]:
    """Every file but the lock, which tells the time."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != "lock.json"]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def flip(path: Path, position: int, mask: int = 0x10) -> None:
    content = bytearray(path.read_bytes())
    content[position] ^= mask
    path.write_bytes(content)


def restored(folder: Path) -> int:
    """The round that a new owner goes on from (0 without a checkpoint); everything on disk agrees with it."""
    ledger = Ledger(folder)
    with RunWriter(ledger) as writer:
        checkpoint = writer.restore()
        number = 0 if checkpoint is None else checkpoint.round
        if checkpoint is not None:
            assert checkpoint.arrays["weights"].tolist() == [number] * 5
            assert checkpoint.data["rows"] == 2 * number
            (segment,) = checkpoint.segments
            assert writer.read_segment(segment)["rewards"].tolist() == [number + i for i in range(8)]
    for name in ROW_FILES:
        assert ledger.rows(name) == all_rows(number, name)
        assert (folder / name).read_bytes() == b"".join(map(encode_row, all_rows(number, name)))
    return number


# ---- rows ------------------------------------------------------------------------------------------------------------

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@settings(deadline=None, max_examples=150)
@given(st.dictionaries(st.text(), values, max_size=5))
@example({})
@example({"crc": "00000000"})
@example({"text": 'a\nb\r\u2028"}\\', "nested": {"crc": [1e-320, -0.0, 10**40]}})
def test_rows_come_back_as_they_were_written(row: dict[str, Any]) -> None:
    line = encode_row(row)
    assert repr(decode_row(line)) == repr(row)
    assert line.splitlines(keepends=True) == [line]
    assert line.endswith(b"\n")


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_row_that_is_not_json_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match="JSON"):
        encode_row({"return": value})


def test_every_flipped_byte_and_every_truncation_of_a_row_is_seen() -> None:
    line = encode_row({"row": 12, "return": -0.25, "name": "é", "ids": [1, 2]})
    for length in range(len(line)):
        assert decode_row(line[:length]) is None
        assert decode_row(line[length + 1 :]) is None
    for position in range(len(line)):
        for mask in range(1, 256):
            changed = bytearray(line)
            changed[position] ^= mask
            assert decode_row(bytes(changed)) is None
    assert decode_row(line + b"\n") is None
    assert decode_row(line + line) is None


def test_a_torn_last_row_is_left_out_at_every_length(tmp_path: Path) -> None:
    rows = all_rows(2, METRICS)
    whole = b"".join(map(encode_row, rows[:-1]))
    last = encode_row(rows[-1])
    ledger = Ledger(tmp_path)
    for length in range(len(last)):
        (tmp_path / METRICS).write_bytes(whole + last[:length])
        assert ledger.rows() == rows[:-1]
    (tmp_path / METRICS).write_bytes(whole + last)
    assert ledger.rows() == rows


def test_no_row_file_is_no_rows(tmp_path: Path) -> None:
    assert Ledger(tmp_path).rows() == []
    (tmp_path / METRICS).write_bytes(b"")
    assert Ledger(tmp_path).rows() == []


def test_a_damaged_row_is_named(tmp_path: Path) -> None:
    rows = all_rows(2, METRICS)
    lines = list(map(encode_row, rows))
    path = tmp_path / METRICS
    start = len(lines[0])
    for position in range(start, start + len(lines[1])):
        for mask in FLIPS:
            path.write_bytes(b"".join(lines))
            flip(path, position, mask)
            with pytest.raises(LedgerError) as caught:
                Ledger(tmp_path).rows()
            assert f"{path}, row 2:" in str(caught.value)
    path.write_bytes(b"".join([lines[0], lines[2], lines[1][:-9] + b"\n", lines[3]]))
    with pytest.raises(LedgerError, match=r"metrics\.jsonl, row 3:"):
        Ledger(tmp_path).rows()


def test_a_damaged_last_row_is_never_taken_for_right(tmp_path: Path) -> None:
    rows = all_rows(2, METRICS)
    lines = list(map(encode_row, rows))
    path = tmp_path / METRICS
    size = sum(map(len, lines))
    for position in range(size - len(lines[-1]), size - 1):
        path.write_bytes(b"".join(lines))
        flip(path, position)
        with pytest.raises(LedgerError, match="row 4"):
            Ledger(tmp_path).rows()
    path.write_bytes(b"".join(lines))
    flip(path, size - 1)  # without its line's end it could be a row that is just being written
    assert Ledger(tmp_path).rows() == rows[:-1]


@pytest.mark.usefixtures("no_fsync")
def test_only_committed_rows(tmp_path: Path) -> None:
    ledger = write_run(tmp_path, 2)
    with RunWriter(ledger) as writer:
        writer.restore()
        writer.append(METRICS, {"round": 3})
    assert ledger.rows() == [*all_rows(2, METRICS), {"round": 3}]
    assert ledger.rows(committed_only=True) == all_rows(2, METRICS)
    assert ledger.rows("other.jsonl", committed_only=True) == []


# ---- status.json -----------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("no_fsync")
def test_a_damaged_status_is_never_taken_for_right(tmp_path: Path) -> None:
    ledger = write_run(tmp_path, 1)
    good = ledger.status_file.read_bytes()
    right = ledger.status()
    assert dataclasses.replace(right, committed={}, checkpoint=None, checkpoint_sha256=None) == status_of(1)
    for length in range(len(good)):
        ledger.status_file.write_bytes(good[:length])
        with pytest.raises(LedgerError, match=r"status\.json is damaged"):
            ledger.status()
    refused = 0
    for position in range(len(good)):
        for mask in FLIPS:
            ledger.status_file.write_bytes(good)
            flip(ledger.status_file, position, mask)
            try:
                assert repr(ledger.status()) == repr(right)  # other white space, or \u00FC for \u00fc
            except LedgerError:
                refused += 1
    assert refused > 3 * len(good)


@pytest.mark.parametrize(
    "content",
    [b"", b"null", b"[]", b"3", b'"crc"', b"{}", b'{"crc": 1}', b"\0" * 50, b"\xff\xfe", b"[" * 100_000, b" " * 2**21],
    ids=lambda content: repr(content[:6]),
)
def test_anything_else_in_place_of_a_status(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "status.json").write_bytes(content)
    with pytest.raises(LedgerError, match=r"status\.json is damaged"):
        Ledger(tmp_path).status()


@pytest.mark.usefixtures("no_fsync")
def test_no_status_and_a_status_of_another_format(tmp_path: Path) -> None:
    with pytest.raises(LedgerError, match="holds no run"):
        Ledger(tmp_path).status()
    with RunWriter(Ledger(tmp_path)) as writer:
        writer.set_status(dataclasses.replace(status_of(1), format=99))
    with pytest.raises(LedgerError, match="format 99; this version reads format 1"):
        Ledger(tmp_path).status()
    (tmp_path / "status.json").unlink()
    (tmp_path / "status.json").mkdir()
    with pytest.raises(LedgerError, match="cannot be read"):
        Ledger(tmp_path).status()


@pytest.mark.usefixtures("no_fsync")
def test_a_new_status_keeps_what_the_commit_said(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    with RunWriter(ledger) as writer:
        writer.restore()
        write_round(writer, 1)
        committed = ledger.status()
        writer.set_status(dataclasses.replace(status_of(1), state="failed", message="ö"))
    assert ledger.status() == dataclasses.replace(committed, state="failed", message="ö")


# ---- checkpoints -----------------------------------------------------------------------------------------------------


def a_checkpoint(size: int = 3) -> Checkpoint:
    arrays = {
        "learner/weights": np.linspace(-1, 1, size, dtype=np.float32),
        "ids": np.arange(size, dtype=np.int64) - 2**62,
        "scalar": np.array(-0.5),
        "empty": np.zeros((0, 4), np.float32),
        "none": np.array([], dtype=np.int64),
        "nan": np.array([np.nan, np.inf, -0.0]),
        "flags": np.array([True, False]),
        "columns": np.asfortranarray(np.arange(6, dtype=np.uint8).reshape(2, 3)),
    }
    data = {"learner": {"gamma": 0.99, "big": 2**70}, "walk": [1, [2, 3]], "name": "é", "nothing": None}
    return Checkpoint(12, arrays, data, (Segment(0, 64, "ab" * 32), Segment(64, 8, "cd" * 32)))


def assert_same(found: Checkpoint, right: Checkpoint) -> None:
    assert (found.round, repr(found.data), found.segments) == (right.round, repr(right.data), right.segments)
    assert set(found.arrays) == set(right.arrays)
    for name, array in right.arrays.items():
        other = found.arrays[name]
        assert (other.dtype, other.shape, other.tobytes()) == (array.dtype, array.shape, array.tobytes()), name


def assert_refused_or_same(content: bytes, right: Checkpoint) -> bool:
    """Whether it was refused; any exception but ValueError goes through."""
    try:
        found = decode_checkpoint(content)
    except ValueError:
        return True
    assert_same(found, right)
    return False


def flipped(content: bytes, position: int, mask: int) -> bytes:
    changed = bytearray(content)
    changed[position] ^= mask
    return bytes(changed)


def headers(content: bytes) -> list[int]:
    """Where the .npy members of an npz begin."""
    return [i for i in range(len(content)) if content[i : i + 6] == b"\x93NUMPY"]


def test_a_checkpoint_comes_back_as_it_was_written() -> None:
    for checkpoint in (a_checkpoint(), a_checkpoint(5000), Checkpoint(0, {}, {})):
        assert_same(decode_checkpoint(encode_checkpoint(checkpoint)), checkpoint)
    assert encode_checkpoint(a_checkpoint()) == encode_checkpoint(a_checkpoint())


arrays_of_any_kind = st.builds(
    lambda kind, shape, seed: np.random.default_rng(seed).integers(0, 200, shape).astype(kind),
    st.sampled_from(["<i8", "<f4", "<f8", "?", "u1", ">i4"]),
    st.lists(st.integers(0, 3), max_size=3).map(tuple),
    st.integers(0, 9),
)


@settings(deadline=None, max_examples=50)
@given(
    st.dictionaries(st.text("abc/_0", min_size=1, max_size=6), arrays_of_any_kind, max_size=3),
    st.dictionaries(st.text(), values, max_size=3),
)
def test_any_checkpoint_comes_back(arrays: dict[str, Any], data: dict[str, Any]) -> None:
    checkpoint = Checkpoint(7, arrays, data)
    assert_same(decode_checkpoint(encode_checkpoint(checkpoint)), checkpoint)


def test_a_checkpoint_cut_anywhere_is_refused() -> None:
    content = encode_checkpoint(Checkpoint(3, {"w": np.arange(3, dtype=np.float32)}, {"a": 1}))
    for length in range(len(content)):
        with pytest.raises(ValueError):  # noqa: PT011 - whatever the words
            decode_checkpoint(content[:length])


def test_random_flips_in_a_checkpoint_are_refused_or_mean_nothing() -> None:
    right = a_checkpoint()
    content = encode_checkpoint(right)
    random.seed(1)
    places = [(random.randrange(len(content)), random.randrange(1, 256)) for _ in range(600)]
    refused = sum(assert_refused_or_same(flipped(content, *place), right) for place in places)
    assert refused > 300  # the rest are fields of the zip that nobody reads: dates, attributes


def test_flips_in_the_headers_of_large_arrays() -> None:
    """What is longer than zipfile's reading buffer is parsed before its CRC is known."""
    right = a_checkpoint(3000)
    content = encode_checkpoint(right)
    random.seed(2)
    for start in headers(content):
        for position in range(start, start + 100):
            assert_refused_or_same(flipped(content, position, random.randrange(1, 256)), right)


def test_several_flips_at_once() -> None:
    right = a_checkpoint()
    content = encode_checkpoint(right)
    random.seed(3)
    for _ in range(100):
        changed = content
        for _ in range(8):
            changed = flipped(changed, random.randrange(len(content)), random.randrange(1, 256))
        assert_refused_or_same(changed, right)


class Bomb:
    """What a pickle would run."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os._exit, (66,)


def repacked(content: bytes, compression: int = zipfile.ZIP_STORED, **members: bytes) -> bytes:
    """The same zip with other members or another compression; every checksum of the zip itself is right."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(buffer, "w", compression) as new:
        for name in old.namelist():
            new.writestr(name, members.get(name.removesuffix(".npy"), old.read(name)))
    return buffer.getvalue()


def npy(array: Any, *, allow_pickle: bool = False) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=allow_pickle)
    return buffer.getvalue()


def test_a_zip_that_is_whole_but_says_something_else_is_refused() -> None:
    checkpoint = Checkpoint(3, {"w": np.arange(3.0)}, {})
    content = encode_checkpoint(checkpoint)
    assert_same(decode_checkpoint(repacked(content)), checkpoint)
    meta = json.loads(np.load(io.BytesIO(content))["meta"].tobytes())
    others = {name: {**meta, name: value} for name, value in [("round", 4), ("data", {"a": 1}), ("format", 2)]}
    forged = [npy(np.frombuffer(json.dumps(other).encode(), np.uint8)) for other in (*others.values(), {}, [], 3)]
    for changed in (
        *(repacked(content, meta=other) for other in forged),
        repacked(content, meta=b"not an array"),
        repacked(content, **{"array/w": npy(np.arange(3.0) + 1)}),
        repacked(content, **{"array/w": npy(np.arange(3))}),
        repacked(content, **{"array/w": npy(np.arange(3.0)[:, None])}),
        repacked(content, **{"array/w": b""}),
        npy(np.arange(3.0)),
        b"",
        b"PK\x05\x06" + b"\0" * 18,
    ):
        with pytest.raises(ValueError):  # noqa: PT011 - whatever the words
            decode_checkpoint(changed)


def test_pickles_are_refused_both_ways() -> None:
    content = encode_checkpoint(Checkpoint(3, {"w": np.arange(3.0)}, {}))
    pickled = npy(np.array([Bomb()], dtype=object), allow_pickle=True)
    for changed in (repacked(content, **{"array/w": pickled}), repacked(content, meta=pickled), pickled):
        with pytest.raises(ValueError):  # noqa: PT011 - whatever the words
            decode_checkpoint(changed)
    with pytest.raises(ValueError, match="allow_pickle"):
        encode_checkpoint(Checkpoint(3, {"w": np.array([{}], dtype=object)}, {}))


def test_a_compressed_zip_is_refused() -> None:
    content = encode_checkpoint(Checkpoint(3, {"w": np.zeros(1000)}, {}))
    for compression in (zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        with pytest.raises(ValueError, match="compressed"):
            decode_checkpoint(repacked(content, compression))


# ---- restore ---------------------------------------------------------------------------------------------------------


def checkpoint_file(folder: Path, number: int) -> Path:
    return Ledger(folder).checkpoints / f"round-{number:09d}.npz"


@pytest.fixture
def run(tmp_path: Path, no_fsync: None) -> Path:  # noqa: ARG001 - a fixture asks for another by name
    """Committed until its last round, with rows behind it, the last of them torn."""
    ledger = write_run(tmp_path / "run")
    for name in ROW_FILES:
        line = encode_row({"round": ROUNDS + 1})
        with (ledger.folder / name).open("ab") as file:
            file.write(line + line[:-3])
    return ledger.folder


@pytest.mark.usefixtures("no_fsync")
def test_the_two_newest_checkpoints_are_kept(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    with RunWriter(ledger) as writer:
        writer.restore()
        for number in range(1, 13):
            write_round(writer, number)
            names = [f"round-{kept:09d}.npz" for kept in (number, number - 1) if kept > 0]
            assert sorted((path.name for path in ledger.checkpoints.iterdir()), reverse=True) == names
            assert [path.name for path in ledger.checkpoint_files()] == names
            assert len(list(ledger.replay.iterdir())) == len(names)
            assert ledger.status().checkpoint == names[0]


def test_the_newest_intact_checkpoint_is_restored_and_rows_are_cut_to_it(run: Path) -> None:
    assert restored(run) == ROUNDS
    assert restored(run) == ROUNDS


def test_without_a_checkpoint_rows_are_cut_to_nothing(tmp_path: Path) -> None:
    with RunWriter(Ledger(tmp_path)) as writer:
        assert writer.restore() is None
        writer.append(METRICS, {"row": 0})
    (tmp_path / TIMING).write_bytes(b"garbage")
    assert restored(tmp_path) == 0
    assert {(tmp_path / name).read_bytes() for name in ROW_FILES} == {b""}


def large_weights(folder: Path) -> Path:
    """Make the newest checkpoint one with large arrays."""
    path = checkpoint_file(folder, ROUNDS)
    checkpoint = decode_checkpoint(path.read_bytes())
    path.write_bytes(encode_checkpoint(dataclasses.replace(checkpoint, arrays={"weights": np.zeros(3000)})))
    return path


def damage_header_of_large_array(folder: Path) -> None:
    path = large_weights(folder)
    start = headers(path.read_bytes())[1]
    flip(path, path.read_bytes().index(b"}", start), 0x40)


def damage_row_file(folder: Path, name: str) -> None:
    """Change a byte of the newest round's first row."""
    before = b"".join(map(encode_row, all_rows(ROUNDS - 1, name)))
    flip(folder / name, len(before) + 3)


def shorten_row_file(folder: Path, name: str) -> None:
    """By one byte of what the newest checkpoint covers."""
    size = len(b"".join(map(encode_row, all_rows(ROUNDS, name))))
    os.truncate(folder / name, size - 1)


def newest_segment(folder: Path) -> Path:
    return max(Ledger(folder).replay.iterdir())


DAMAGES: dict[str, Callable[[Path], None]] = {
    "flipped": lambda folder: flip(checkpoint_file(folder, ROUNDS), 300),
    "cut": lambda folder: os.truncate(checkpoint_file(folder, ROUNDS), 700),
    "empty": lambda folder: os.truncate(checkpoint_file(folder, ROUNDS), 0),
    "zeros": lambda folder: checkpoint_file(folder, ROUNDS).write_bytes(bytes(2000)) and None,
    "header of a large array": damage_header_of_large_array,
    "row changed": lambda folder: damage_row_file(folder, METRICS),
    "row of another file changed": lambda folder: damage_row_file(folder, CURRICULUM),
    "rows shorter": lambda folder: shorten_row_file(folder, METRICS),
    "rows of another file shorter": lambda folder: shorten_row_file(folder, TIMING),
    "segment changed": lambda folder: flip(newest_segment(folder), 200),
    "segment missing": lambda folder: newest_segment(folder).unlink(),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_newest_checkpoint_gives_way_to_the_one_before(run: Path, tmp_path: Path, damage: str) -> None:
    DAMAGES[damage](run)
    assert restored(run) == ROUNDS - 1
    assert not checkpoint_file(run, ROUNDS).exists()
    write_run(run)
    assert contents(run) == contents(write_run(tmp_path / "undisturbed").folder)


def change_first_rows(folder: Path) -> None:
    flip(folder / METRICS, 5)


def remove_rows(folder: Path) -> None:
    (folder / METRICS).unlink()


def damage_both_checkpoints(folder: Path) -> None:
    flip(checkpoint_file(folder, ROUNDS), 300)
    os.truncate(checkpoint_file(folder, ROUNDS - 1), 10)


@pytest.mark.parametrize("damage", [change_first_rows, remove_rows, damage_both_checkpoints])
def test_a_run_without_an_intact_checkpoint_is_refused_unchanged(run: Path, damage: Callable[[Path], None]) -> None:
    damage(run)
    before = contents(run)
    with RunWriter(Ledger(run)) as writer, pytest.raises(LedgerError, match="Nothing was changed") as caught:
        writer.restore()
    assert contents(run) == before
    for part in (str(run), checkpoint_file(run, ROUNDS).name, checkpoint_file(run, ROUNDS - 1).name):
        assert part in str(caught.value)


# ---- killed at every write -------------------------------------------------------------------------------------------


class Stop(BaseException):
    """An interruption that nothing but this file knows."""


class Faults:
    """Counts what a process does to files, and calls `act` just before (or in the middle of) the `at`-th thing."""

    def __init__(self, at: int, act: Callable[[], None]) -> None:
        self.count, self.at, self.act = 0, at, act
        self.synced: dict[int, int] = {}  # inode -> bytes that survive a power cut

    def __call__(self) -> None:
        self.count += 1
        if self.count == self.at:
            self.act()

    def lose_power(self, folder: Path) -> None:
        """Forget everything in files that was not flushed to disk."""
        for path in folder.rglob("*"):
            if path.is_file():
                state = path.stat()
                os.truncate(path, min(state.st_size, self.synced.get(state.st_ino, 0)))


def hook(faults: Faults, patch: pytest.MonkeyPatch) -> None:
    """Let `faults` see every write (twice: before it and half-way), truncate, fsync, rename (twice) and unlink."""

    class File(io.FileIO):
        def write(self, data: Any) -> int:
            faults()
            half = super().write(bytes(data)[: len(data) // 2])
            faults()
            return half + super().write(bytes(data)[half:])

        def truncate(self, size: int | None = None) -> int:
            faults()
            return super().truncate(size)

    real_open, real_replace, real_unlink, real_fdopen = Path.open, Path.replace, Path.unlink, os.fdopen

    def opened(path: Path, mode: str = "r", *rest: Any, **more: Any) -> Any:
        if mode not in ("wb", "ab"):
            return real_open(path, mode, *rest, **more)
        file = File(path, mode)
        if mode == "wb":
            faults.synced[os.fstat(file.fileno()).st_ino] = 0
        return io.BufferedWriter(file)

    def fdopened(descriptor: int, mode: str = "r", *rest: Any, **more: Any) -> Any:
        if mode != "r+b":
            return real_fdopen(descriptor, mode, *rest, **more)
        return io.BufferedRandom(File(descriptor, mode))

    def fsynced(descriptor: int) -> None:
        faults()
        state = os.fstat(descriptor)
        faults.synced[state.st_ino] = state.st_size

    def replaced(path: Path, target: Path) -> Path:
        faults()
        result = real_replace(path, target)
        faults()
        return result

    def unlinked(path: Path, missing_ok: bool = False) -> None:
        faults()
        real_unlink(path, missing_ok=missing_ok)

    patch.setattr(Path, "open", opened)
    patch.setattr(Path, "replace", replaced)
    patch.setattr(Path, "unlink", unlinked)
    patch.setattr(os, "fdopen", fdopened)
    patch.setattr(os, "fsync", fsynced)


def kill_everywhere(root: Path, power: bool) -> None:
    """Fork a run for every k and kill it at its k-th step; `k.committed` holds the last commit it came back from.

    To be called in a process of its own, which has no threads that a fork could leave in the middle of something.
    """
    for k in range(1, 10_000):
        child = os.fork()
        if child == 0:
            code = 3
            with contextlib.suppress(Exception):
                run_and_die(root, k, power)
                code = 0
            os._exit(code)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if code == 0:
            (root / "count").write_text(str(k - 1))
            return
        assert code == -signal.SIGKILL, code


def run_and_die(root: Path, k: int, power: bool) -> None:
    told = os.open(root / f"{k}.committed", os.O_CREAT | os.O_WRONLY)

    def die() -> None:
        if power:
            faults.lose_power(root / str(k))
        os.kill(os.getpid(), signal.SIGKILL)

    def committed(number: int) -> None:
        os.pwrite(told, b"%d" % number, 0)

    faults = Faults(k, die)
    hook(faults, pytest.MonkeyPatch())
    write_run(root / str(k), committed=committed)


def assert_resumes(folder: Path, committed: int, undisturbed: dict[str, bytes]) -> None:
    """A reader sees nothing wrong, and a new owner continues to the very same bytes."""
    ledger = Ledger(folder)
    if ledger.status_file.exists():
        status = ledger.status()
        assert committed <= status.round <= committed + 1
        for name in ROW_FILES:
            assert ledger.rows(name, committed_only=True) == all_rows(status.round, name)
    else:
        assert committed == 0
    for name in ROW_FILES:
        rows = ledger.rows(name)
        assert rows == all_rows(ROUNDS, name)[: len(rows)]
    assert committed <= restored(folder) <= committed + 1
    write_run(folder, ROUNDS + 1)
    assert contents(folder) == undisturbed


@pytest.fixture
def undisturbed(tmp_path: Path, no_fsync: None) -> dict[str, bytes]:  # noqa: ARG001 - a fixture asks for another by name
    """What a run that was killed must have come to one round later."""
    return contents(write_run(tmp_path / "undisturbed", ROUNDS + 1).folder)


@pytest.mark.parametrize("power", [False, True], ids=["SIGKILL", "power cut"])
def test_a_run_killed_at_any_write_resumes(tmp_path: Path, undisturbed: dict[str, bytes], power: bool) -> None:
    root = tmp_path / "killed"
    root.mkdir()
    code = f"from pathlib import Path; from tests.test_ledger import *; kill_everywhere(Path({str(root)!r}), {power})"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, timeout=120)
    count = int((root / "count").read_text())
    assert count > 100
    for k in range(1, count + 1):
        committed = int((root / f"{k}.committed").read_text() or 0)
        assert_resumes(root / str(k), committed, undisturbed)
        shutil.rmtree(root / str(k))


def test_a_run_interrupted_at_any_write_resumes(
    tmp_path: Path, undisturbed: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An exception instead of a kill: `finally` and `with` still do their part, and the process lives on."""

    def stop() -> None:
        raise Stop

    committed: list[int] = [0]
    for k in range(1, 10_000):
        faults, folder = Faults(k, stop), tmp_path / str(k)
        committed[:] = [0]
        try:
            with RunWriter(Ledger(folder)) as writer, monkeypatch.context() as patch:
                hook(faults, patch)
                writer.restore()
                for number in range(1, ROUNDS + 1):
                    write_round(writer, number)
                    committed.append(number)
        except Stop:
            assert_resumes(folder, committed[-1], undisturbed)
            shutil.rmtree(folder)
        else:
            assert k > 100
            assert_resumes(folder, ROUNDS, undisturbed)
            return


def test_killed_again_while_restoring(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Falling back to an older checkpoint is itself a sequence of writes."""
    flip(checkpoint_file(run, ROUNDS), 300)

    def stop() -> None:
        raise Stop

    for k in range(1, 1000):
        folder = tmp_path / str(k)
        shutil.copytree(run, folder)
        try:
            with RunWriter(Ledger(folder)) as writer, monkeypatch.context() as patch:
                hook(Faults(k, stop), patch)
                writer.restore()
        except Stop:
            assert restored(folder) == ROUNDS - 1
        else:
            assert k > 5
            return


# ---- the lock --------------------------------------------------------------------------------------------------------

_OTHER = """
import json, os, sys, time
import numpy as np
from pathlib import Path
from space_dist.ledger import *

def race(folder, go):
    writer = RunWriter(Ledger(folder))
    while not Path(go).exists():
        time.sleep(0.0002)
    try:
        writer.__enter__()
    except RunLockedError as error:
        return str(error)
    return "won"

for line in sys.stdin:
    try:
        answer = {"value": repr(eval(line))}
    except Exception as error:
        answer = {"error": type(error).__name__, "text": str(error)}
    print(json.dumps(answer), flush=True)
"""


class Other:
    """Another process, which does what it is told in Python, line by line."""

    def __init__(self) -> None:
        command = [sys.executable, "-c", _OTHER]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, text=True)
        self.pid = self.process.pid

    def send(self, expression: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(expression + "\n")
        self.process.stdin.flush()

    def answer(self) -> str:
        assert self.process.stdout is not None
        answer = json.loads(self.process.stdout.readline())
        if "error" in answer:
            raise {"RunLockedError": RunLockedError, "LedgerError": LedgerError}.get(answer["error"], AssertionError)(
                answer["text"]
            )
        return str(answer["value"])

    def __call__(self, expression: str) -> str:
        self.send(expression)
        return self.answer()

    def own(self, folder: Path) -> None:
        self(f"(writer := RunWriter(Ledger({str(folder)!r}))).__enter__()")

    def kill(self) -> None:
        """And leave a zombie until `wait`."""
        self.process.send_signal(signal.SIGKILL)
        while psutil.Process(self.pid).status() != psutil.STATUS_ZOMBIE:
            time.sleep(0.001)

    def end(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            self.process.kill()
        for stream in (self.process.stdin, self.process.stdout):
            with contextlib.suppress(OSError):
                assert stream is not None
                stream.close()
        self.process.wait()


@pytest.fixture
def others() -> Iterator[Callable[[], Other]]:
    started: list[Other] = []

    def start() -> Other:
        started.append(Other())
        return started[-1]

    yield start
    for other in started:
        other.end()


def refused(folder: Path) -> str:
    with pytest.raises(RunLockedError) as caught, RunWriter(Ledger(folder)):
        pass
    return str(caught.value)


def taken_over(folder: Path) -> None:
    """By this process, which then lets go again."""
    with RunWriter(Ledger(folder)) as writer:
        assert json.loads((folder / "lock.json").read_text())["pid"] == os.getpid()
        writer.set_status(status_of(1))


def edit_lock(folder: Path, **fields: Any) -> None:
    path = folder / "lock.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **fields}))


def test_a_living_owner_is_left_alone_and_a_killed_one_replaced_at_once(
    tmp_path: Path, others: Callable[[], Other]
) -> None:
    owner = others()
    owner.own(tmp_path)
    owner("writer.restore()")
    message = refused(tmp_path)
    host = json.loads((tmp_path / "lock.json").read_text())["host"]
    for part in (str(tmp_path), f"process {owner.pid}", host):
        assert part in message
    assert Ledger(tmp_path).owner_alive()
    assert json.loads((tmp_path / "lock.json").read_text())["pid"] == owner.pid
    owner("writer.append(METRICS, {'row': 1})")  # being refused changed nothing for the owner
    owner("writer.commit(Checkpoint(1, {}, {}), Status('running', 'n', 1, 0, 9, 1, 0.0, 0.0))")

    lock = (tmp_path / "lock.json").read_bytes()
    owner.kill()  # a zombie first: its parent has not looked after it
    assert not Ledger(tmp_path).owner_alive()
    taken_over(tmp_path)
    (tmp_path / "lock.json").write_bytes(lock)
    owner.end()
    assert not Ledger(tmp_path).owner_alive()
    taken_over(tmp_path)


def test_release_leaves_the_lock_free(tmp_path: Path, others: Callable[[], Other]) -> None:
    with RunWriter(Ledger(tmp_path)):
        assert Ledger(tmp_path).owner_alive()
        assert f"process {os.getpid()}" in refused(tmp_path)  # the same process is no exception
    assert not Ledger(tmp_path).owner_alive()
    other = others()
    other.own(tmp_path)
    refused(tmp_path)
    other("writer.__exit__(None, None, None)")
    taken_over(tmp_path)  # although that process lives


@pytest.mark.parametrize(
    "elsewhere",
    [
        {"host": "node-17", "boot_id": "another-boot", "pid_namespace": "pid:[1]"},
        {"host": "node-17", "boot_id": "another-boot"},  # the same number of a namespace means nothing there
        {"host": "container-3", "pid_namespace": "pid:[1]"},  # a container on this machine: its pids are its own
        {"host": "node-17", "boot_id": "", "pid_namespace": ""},
    ],
    ids=["other machine", "other machine, same namespace", "container", "no /proc"],
)
def test_an_owner_elsewhere_is_believed_for_a_lease(tmp_path: Path, elsewhere: dict[str, str]) -> None:
    with RunWriter(Ledger(tmp_path)):
        lock = (tmp_path / "lock.json").read_bytes()
    for pid in (os.getpid(), 2**22 + 5):  # whether that pid lives here says nothing
        for age in (0.0, LEASE_SECONDS - 30):
            (tmp_path / "lock.json").write_bytes(lock)
            edit_lock(tmp_path, pid=pid, heartbeat=time.time() - age, **elsewhere)
            message = refused(tmp_path)
            assert f"process {pid} on {elsewhere['host']}" in message
            assert f"{LEASE_SECONDS:.0f} s" in message
            assert Ledger(tmp_path).owner_alive()
        (tmp_path / "lock.json").write_bytes(lock)
        edit_lock(tmp_path, pid=pid, heartbeat=time.time() - LEASE_SECONDS - 1, **elsewhere)
        assert not Ledger(tmp_path).owner_alive()
        taken_over(tmp_path)


@pytest.mark.usefixtures("no_fsync")
def test_a_commit_renews_the_lease(tmp_path: Path) -> None:
    with RunWriter(Ledger(tmp_path)) as writer:
        writer.restore()
        edit_lock(tmp_path, heartbeat=0.0)
        write_round(writer, 1)
        assert time.time() - json.loads((tmp_path / "lock.json").read_text())["heartbeat"] < LEASE_SECONDS / 2


def test_another_process_of_the_same_pid_is_not_the_owner(tmp_path: Path) -> None:
    with RunWriter(Ledger(tmp_path)):
        lock = (tmp_path / "lock.json").read_bytes()
    for later in (-100.0, 100.0):
        (tmp_path / "lock.json").write_bytes(lock)
        edit_lock(tmp_path, started=json.loads(lock)["started"] + later)
        assert not Ledger(tmp_path).owner_alive()
        taken_over(tmp_path)


def test_a_step_of_the_clock_does_not_make_a_living_owner_dead(
    tmp_path: Path, others: Callable[[], Other], monkeypatch: pytest.MonkeyPatch
) -> None:
    """When NTP sets the clock, the kernel's `btime`, from which start times are computed, moves with it."""
    owner = others()
    owner.own(tmp_path / "run")
    proc = tmp_path / "proc"
    proc.mkdir()
    for path in Path("/proc").iterdir():
        if path.name != "stat":
            (proc / path.name).symlink_to(path)
    lines = Path("/proc/stat").read_text().splitlines()
    shifted = [f"btime {int(line.split()[1]) + 5}" if line.startswith("btime") else line for line in lines]
    (proc / "stat").write_text("\n".join(shifted) + "\n")
    monkeypatch.setattr(psutil, "PROCFS_PATH", str(proc))
    assert f"process {owner.pid}" in refused(tmp_path / "run")


@pytest.mark.parametrize(
    "garbage",
    [
        b"", b"{", b"{}", b"[]", b"null", b"17", b'"x"', b"\0" * 300, b"\xff\xfe\x00", b'{"pid": "x"}',
        b'{"heartbeat": "soon"}', b'{"heartbeat": null, "pid": null}', b'{"pid": -1}', b'{"heartbeat": NaN}',
        b'{"heartbeat": 1' + b"0" * 400 + b"}", b"[" * 100_000,
    ],
    ids=lambda garbage: repr(garbage[:24]),
)  # fmt: skip
def test_garbage_in_the_lock_does_not_block(tmp_path: Path, garbage: bytes) -> None:
    (tmp_path / "lock.json").write_bytes(garbage)
    assert not Ledger(tmp_path).owner_alive()
    taken_over(tmp_path)


@pytest.mark.parametrize("pid", ["x", None, -1, 10**30, float("inf"), []], ids=repr)
def test_a_pid_that_is_none_does_not_block(tmp_path: Path, pid: Any) -> None:
    with RunWriter(Ledger(tmp_path)):
        pass
    edit_lock(tmp_path, pid=pid, released=False)
    assert not Ledger(tmp_path).owner_alive()
    taken_over(tmp_path)


def lose(writer: RunWriter, winner: Other) -> None:
    """Let `winner` take the run from `writer`, whose machine was not seen for longer than a lease."""
    folder = writer.ledger.folder
    edit_lock(folder, host="elsewhere", boot_id="x", heartbeat=time.time() - LEASE_SECONDS - 1)
    winner.own(folder)
    winner("writer.restore()")


def test_the_loser_of_a_takeover_changes_nothing_that_counts(tmp_path: Path, others: Callable[[], Other]) -> None:
    ledger, winner = Ledger(tmp_path), others()
    with RunWriter(ledger) as loser:
        loser.restore()
        write_round(loser, 1)
        lose(loser, winner)
        before = contents(tmp_path)
        loser.append(METRICS, {"row": "the loser's"})
        checkpoint = Checkpoint(2, {}, {})
        attempts: list[Callable[[], object]] = [
            lambda: loser.commit(checkpoint, status_of(2)),
            lambda: loser.set_status(status_of(2)),
            lambda: loser.write_config("c", "a", "b"),
            lambda: loser.write_model({"w": np.zeros(2)}, {}),
            lambda: loser.write_segment(16, 8, {"rewards": np.zeros(8)}),
            lambda: loser.drop_segments(set()),
            loser.restore,
        ]
        for attempt in attempts:
            with pytest.raises(RunLockedError, match=f"process {winner.pid}"):
                attempt()
    after = contents(tmp_path)
    assert after.pop(METRICS).startswith(before.pop(METRICS))
    assert after == before
    assert ledger.rows(committed_only=True) == all_rows(1, METRICS)
    lock = json.loads((tmp_path / "lock.json").read_text())
    assert lock["pid"] == winner.pid  # the loser's exit did not release what is not its own
    assert not lock.get("released")
    refused(tmp_path)
    winner.end()
    assert restored(tmp_path) == 1


def test_a_late_row_of_the_loser_does_not_spoil_what_the_winner_commits(
    tmp_path: Path, others: Callable[[], Other]
) -> None:
    ledger, winner = Ledger(tmp_path), others()
    with RunWriter(ledger) as loser:
        loser.restore()
        write_round(loser, 1)
        lose(loser, winner)
        loser.append(METRICS, rows_of(2)[METRICS][0])
    for number in (2, 3, 4):  # the winner either commits what can be resumed, or says that it could not
        try:
            winner(f"writer.append(METRICS, {rows_of(number)[METRICS][0]!r})")
            status = f"Status('running', 'n', 1, 0, 9, {number}, 0.0, 0.0)"
            winner(f"writer.commit(Checkpoint({number}, {{}}, {{}}), {status})")
        except LedgerError:
            winner.end()
            assert restored(tmp_path) == 1
            return
    winner.end()
    with RunWriter(ledger) as writer:
        checkpoint = writer.restore()
    assert checkpoint is not None
    assert checkpoint.round == 4


def test_one_of_many_gets_the_lock_of_a_dead_owner(tmp_path: Path, others: Callable[[], Other]) -> None:
    racers = [others() for _ in range(8)]
    dead = others()
    dead.own(tmp_path)
    lock = (tmp_path / "lock.json").read_bytes()
    dead.end()
    for attempt in range(3):
        folder, go = tmp_path / f"run {attempt}", tmp_path / f"go {attempt}"
        folder.mkdir()
        (folder / "lock.json").write_bytes(lock)
        for racer in racers:
            racer("None")
        for racer in racers:
            racer.send(f"race({str(folder)!r}, {str(go)!r})")
        go.touch()
        answers = [racer.answer() for racer in racers]
        winners = [racer for racer, answer in zip(racers, answers, strict=True) if answer == "'won'"]
        assert len(winners) == 1, answers
        assert json.loads((folder / "lock.json").read_text())["pid"] == winners[0].pid
        assert all(f"process {winners[0].pid}" in answer for answer in answers if answer != "'won'")


# ---- a disk that refuses ---------------------------------------------------------------------------------------------

REFUSALS = {
    errno.ENOSPC: "the disk is full",
    errno.EROFS: "the file system is read-only",
    errno.EACCES: "permission denied",
}


def break_disk(patch: pytest.MonkeyPatch, code: int) -> None:
    real_open = Path.open

    def opened(path: Path, mode: str = "r", *rest: Any, **more: Any) -> Any:
        if mode in ("wb", "ab"):
            raise OSError(code, os.strerror(code), str(path))
        return real_open(path, mode, *rest, **more)

    def fsynced(_: int) -> None:
        raise OSError(code, os.strerror(code))

    patch.setattr(Path, "open", opened)
    patch.setattr(os, "fsync", fsynced)


OPERATIONS: dict[str, Callable[[RunWriter], object]] = {
    "restore": lambda writer: writer.restore(),
    "append": lambda writer: writer.append(METRICS, {"row": 1}),
    "commit": lambda writer: writer.commit(Checkpoint(9, {}, {}), status_of(9)),
    "set_status": lambda writer: writer.set_status(status_of(9)),
    "write_config": lambda writer: writer.write_config("c", "a", "b"),
    "write_model": lambda writer: writer.write_model({"w": np.zeros(2)}, {}),
    "write_segment": lambda writer: writer.write_segment(80, 8, {"rewards": np.zeros(8)}),
    "drop_segments": lambda writer: writer.drop_segments(set()),
}


@pytest.mark.parametrize("code", REFUSALS, ids=errno.errorcode.get)
@pytest.mark.parametrize("operation", OPERATIONS)
def test_a_disk_that_refuses_is_named(run: Path, monkeypatch: pytest.MonkeyPatch, operation: str, code: int) -> None:
    with RunWriter(Ledger(run)) as writer:
        writer.restore()
        with monkeypatch.context() as patch:
            break_disk(patch, code)
            with pytest.raises(LedgerError) as caught:
                OPERATIONS[operation](writer)
    assert str(run) in str(caught.value)
    assert REFUSALS[code] in str(caught.value)
    assert restored(run) == ROUNDS


@pytest.mark.parametrize("code", REFUSALS, ids=errno.errorcode.get)
def test_a_disk_that_refuses_the_lock_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        break_disk(patch, code)
        with pytest.raises(LedgerError) as caught, RunWriter(Ledger(folder)):
            pass
    assert str(folder) in str(caught.value)
    assert REFUSALS[code] in str(caught.value)


def test_a_disk_that_fills_up_in_the_middle_of_a_row(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full() -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with RunWriter(Ledger(run)) as writer:
        writer.restore()
        with monkeypatch.context() as patch:
            hook(Faults(2, full), patch)
            with pytest.raises(LedgerError, match="the disk is full"):
                writer.append(METRICS, {"row": 99})
    assert Ledger(run).rows(committed_only=True) == all_rows(ROUNDS, METRICS)
    assert restored(run) == ROUNDS


def test_rows_that_cannot_be_read_are_a_ledger_error(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path) -> bytes:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, "read_bytes", refuse)
    with pytest.raises(LedgerError, match=METRICS):
        Ledger(run).rows()


@pytest.mark.parametrize("obstacle", ["a file named checkpoints", "fsync"])
def test_a_run_that_could_not_be_opened_can_be_once_the_cause_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, obstacle: str
) -> None:
    """In the same process, as a notebook or a worker of a grid would try again."""
    with monkeypatch.context() as patch:
        if obstacle == "fsync":
            break_disk(patch, errno.ENOSPC)
        else:
            (tmp_path / "checkpoints").write_text("in the way")
        with pytest.raises(LedgerError, match="cannot write to the run folder"):
            RunWriter(Ledger(tmp_path)).__enter__()
    if obstacle != "fsync":
        (tmp_path / "checkpoints").unlink()
    taken_over(tmp_path)


def test_a_folder_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("a file")
    for folder in (tmp_path / "run", tmp_path / "run" / "below"):
        with pytest.raises(LedgerError, match="a file") as caught, RunWriter(Ledger(folder)):
            pass
        assert str(folder) in str(caught.value)


# ---- finding runs ----------------------------------------------------------------------------------------------------


def test_runs_are_found_sorted_and_each_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders = [tmp_path / "grid" / name for name in ("b/s1", "a/s10", "a/s2", "a")]
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "status.json").touch()
    (tmp_path / "grid" / "not a run").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "grid" / "a")
    right = sorted(folders)
    assert [ledger.folder for ledger in find_ledgers([tmp_path / "grid"])] == right
    again = find_ledgers([*folders, tmp_path / "grid", tmp_path / "grid" / "b" / ".." / "a", tmp_path / "link"])
    assert [ledger.folder.resolve() for ledger in again] == right
    assert [ledger.folder for ledger in find_ledgers([folders[0]])] == [folders[0]]
    monkeypatch.chdir(tmp_path)
    assert [ledger.folder for ledger in find_ledgers([Path("grid")])] == right


def test_finding_no_run_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "status.json").touch()
    (tmp_path / "empty").mkdir()
    with pytest.raises(LedgerError, match="missing does not exist"):
        find_ledgers([tmp_path / "run", tmp_path / "missing"])
    for nothing in (tmp_path / "empty", tmp_path / "run" / "status.json"):
        with pytest.raises(LedgerError, match="no run found in") as caught:
            find_ledgers([tmp_path / "run", nothing])
        assert str(nothing) in str(caught.value)
