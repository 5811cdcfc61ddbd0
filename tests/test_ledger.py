"""A run's folder: what is written comes back or is refused, whenever its writer dies; and it has one writer at most."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import fcntl
import io
import json
import os
import random
import signal
import subprocess
import sys
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
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
from space_dist.ledger import checkpoint as checkpoints
from space_dist.ledger import lock as locks
from tests.faults.injection import Disk, Kills
from tests.patience import PATIENCE

quick = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=10,
)
ROWS_A_ROUND = 2


def status_of(round: int, **changes: Any) -> Status:
    fixed = Status(state="running", name="name", seed=3, steps=512 * round, budget_steps=4096, round=round,
                   started_at=1.5e9, updated_at=1.5e9 + round, fingerprint={"cpu": "none"})  # fmt: skip
    return dataclasses.replace(fixed, **changes)


def checkpoint_of(round: int, **changes: Any) -> Checkpoint:
    arrays = {
        "weights": np.full((2, 3), round, dtype=np.float32),
        "selected": np.arange(round, dtype=np.int64),
        "scalar": np.array(round, dtype=np.int64),
        "empty": np.empty((0, 4)),
    }
    return dataclasses.replace(Checkpoint(round, arrays, {"run": {"round": round, "sums": [0.5, None]}}), **changes)


def row_of(name: str, round: int, index: int) -> dict[str, Any]:
    return {"file": name, "round": round, "index": index, "value": round / 7}


def rows_until(name: str, round: int) -> list[dict[str, Any]]:
    return [row_of(name, one, index) for one in range(1, round + 1) for index in range(ROWS_A_ROUND)]


def append_round(writer: RunWriter, round: int) -> None:
    for name in ROW_FILES:
        for index in range(ROWS_A_ROUND):
            writer.append(name, row_of(name, round, index))


def write_rounds(writer: RunWriter, first: int, last: int) -> None:
    for number in range(first, last + 1):
        append_round(writer, number)
        writer.commit(checkpoint_of(number), status_of(number))


def same(one: Checkpoint, other: Checkpoint, *, without: tuple[str, ...] = ("files", "about")) -> bool:
    def plain(checkpoint: Checkpoint) -> Any:
        data = {key: value for key, value in checkpoint.data.items() if key not in without}
        arrays = {name: (array.dtype, array.shape, array.tobytes()) for name, array in checkpoint.arrays.items()}
        return checkpoint.round, json.dumps(data, sort_keys=True), arrays, checkpoint.segments

    return bool(plain(one) == plain(other))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture
def ledger(tmp_path: Path) -> Ledger:
    """Of a run of three rounds, whose writer is gone."""
    ledger = Ledger(tmp_path / "run")
    with RunWriter(ledger) as writer:
        assert writer.restore() is None
        write_rounds(writer, 1, 3)
    return ledger


# ---- rows -----------------------------------------------------------------------------------------------------------


@quick
@given(row=st.dictionaries(st.text(max_size=8), json_values, max_size=5))
def test_rows_come_back(row: dict[str, Any]) -> None:
    line = encode_row(row)
    assert line.endswith(b"\n")
    assert line.count(b"\n") == 1
    assert decode_row(line) == row
    if row:
        assert json.loads(line).keys() == {*row, "crc"}


@pytest.mark.parametrize("value", [float("nan"), float("inf"), {1, 2}, b"bytes"])
def test_rows_that_json_cannot_hold_are_refused_when_written(value: object) -> None:
    with pytest.raises((ValueError, TypeError)):
        encode_row({"value": value})


def test_any_changed_byte_and_any_torn_end_of_a_row_is_noticed() -> None:
    line = encode_row({"a": 1, "b": "x"})
    for length in range(len(line)):
        assert decode_row(line[:length]) is None
        assert decode_row(line[:length] + line[length + 1 :]) is None
        for byte in range(256):
            assert decode_row(line[:length] + bytes([byte]) + line[length:]) is None
            if byte != line[length]:
                assert decode_row(line[:length] + bytes([byte]) + line[length + 1 :]) is None


def test_a_torn_last_row_is_left_out_and_a_damaged_one_before_it_named(ledger: Ledger) -> None:
    path = ledger.folder / METRICS
    content = path.read_bytes()
    lines = content.splitlines(keepends=True)
    expected = rows_until(METRICS, 3)
    uncommitted = encode_row(row_of(METRICS, 4, 0))
    for torn in range(1, len(uncommitted)):
        path.write_bytes(content + uncommitted[:-torn])
        assert ledger.rows() == expected
    for short in range(1, len(content)):
        path.write_bytes(content[:-short])
        with pytest.raises(LedgerError, match=rf"metrics\.jsonl is damaged: it holds {len(content) - short} bytes"):
            ledger.rows()
    for number in range(1, len(lines) + 1):
        changed = [*lines]
        changed[number - 1] = changed[number - 1].replace(b'"round"', b'"ruond"')
        path.write_bytes(b"".join(changed))
        with pytest.raises(LedgerError, match=f"row {number}: damaged") as caught:
            ledger.rows()
        assert str(path) in str(caught.value)
    path.write_bytes(lines[0] + lines[1][:-5] + b"".join(lines[2:]) + uncommitted)
    with pytest.raises(LedgerError, match="row 2: damaged"):
        ledger.rows()


def test_a_changed_byte_anywhere_never_gives_wrong_rows(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    rows = [{"a": 1}, {"b": [2, None]}, {"c": "\r\n"}]
    content = b"".join(map(encode_row, rows))
    for at in range(len(content)):
        for change in (0x01, 0x20, 0x80, content[at] ^ 0x0A, content[at] ^ 0x0D):
            if change:
                (tmp_path / METRICS).write_bytes(content[:at] + bytes([content[at] ^ change]) + content[at + 1 :])
                try:
                    found = ledger.rows()
                except LedgerError:
                    continue
                assert found == rows[:-1]
                assert at == len(content) - 1  # only the last line end can go without an error


def test_committed_rows_are_those_under_the_last_checkpoint(ledger: Ledger) -> None:
    with RunWriter(ledger) as writer:
        writer.restore()
        append_round(writer, 4)
    for name in ROW_FILES:
        assert ledger.rows(name) == rows_until(name, 4)
        assert ledger.rows(name, committed_only=True) == rows_until(name, 3)


def test_missing_rows_are_none_and_unreadable_ones_an_error(tmp_path: Path) -> None:
    assert Ledger(tmp_path).rows() == []
    (tmp_path / METRICS).mkdir()
    with pytest.raises(LedgerError):
        Ledger(tmp_path).rows()


# ---- the status -----------------------------------------------------------------------------------------------------


def test_a_status_comes_back(ledger: Ledger) -> None:
    status = ledger.status()
    assert (status.round, status.name, status.state) == (3, "name", "running")
    assert status.committed == {name: (ledger.folder / name).stat().st_size for name in ROW_FILES}
    assert status.checkpoint == ledger.checkpoint_files()[0].name
    with RunWriter(ledger) as writer:
        writer.status = status
        writer.set_status(status_of(3, state="failed", message='a "quoted"\nü message'))
        assert ledger.status() == writer.status
    assert ledger.status().message == 'a "quoted"\nü message'
    assert ledger.status().committed == status.committed


def test_a_status_cut_short_is_damaged(ledger: Ledger) -> None:
    content = ledger.status_file.read_bytes()
    for length in range(len(content)):
        ledger.status_file.write_bytes(content[:length])
        with pytest.raises(LedgerError, match=r"status\.json is damaged"):
            ledger.status()


def test_a_status_with_a_changed_byte_is_damaged_or_says_the_same(ledger: Ledger) -> None:
    content, status = ledger.status_file.read_bytes(), ledger.status()
    rng = random.Random(0)
    harmless = 0
    for at in range(len(content)):
        for change in (1, 0x20, 0x80, 0xFF, content[at] ^ 0x20, rng.randrange(1, 256), rng.randrange(1, 256)):
            if not change:
                continue
            ledger.status_file.write_bytes(content[:at] + bytes([content[at] ^ change]) + content[at + 1 :])
            try:
                found = ledger.status()
            except LedgerError as error:
                text = str(error)
            else:
                assert found == status
                assert content[at : at + 1].isspace()
                harmless += 1
                continue
            assert str(ledger.status_file) in text
    assert harmless < len(content)


@pytest.mark.parametrize(
    "content",
    [b"", b"null", b"[]", b"{}", b'{"crc": 0}', b"\xff", b"[" * 100_000, b"9" * 5_000, b'{"a": 1, "crc": 1}', b"NaN",
     b'{"crc": {}}', b" " * (2 << 20), b'{"a":' * 10_000],
    ids=range(13),
)  # fmt: skip
def test_other_content_is_no_status(content: bytes, tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    ledger.status_file.write_bytes(content)
    with pytest.raises(LedgerError, match="damaged"):
        ledger.status()


def test_a_missing_or_unreadable_status_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(LedgerError, match=r"holds no run: it has no status\.json"):
        Ledger(tmp_path).status()
    assert not Ledger(tmp_path).exists()
    (tmp_path / "status.json").mkdir()
    with pytest.raises(LedgerError, match="cannot be read"):
        Ledger(tmp_path).status()


@pytest.mark.parametrize("extra", [{}, {"new_field": 1}])
def test_a_newer_format_is_named(ledger: Ledger, monkeypatch: pytest.MonkeyPatch, extra: dict[str, Any]) -> None:
    with monkeypatch.context() as patch, RunWriter(ledger) as writer:
        as_dict = dataclasses.asdict
        patch.setattr(dataclasses, "asdict", lambda status: {**as_dict(status), **extra})
        writer.set_status(status_of(3, format=3))
    with pytest.raises(LedgerError, match="format 3; this version reads formats 1 and 2"):
        ledger.status()


def test_ledgers_are_found_below_folders_each_once(tmp_path: Path) -> None:
    with pytest.raises(LedgerError, match="does not exist"):
        find_ledgers([tmp_path / "missing"])
    with pytest.raises(LedgerError, match="no run found"):
        find_ledgers([tmp_path])
    for name in ("b/s1", "a/s0", "b/s0"):
        with RunWriter(Ledger(tmp_path / name)) as writer:
            writer.set_status(status_of(0))
    found = find_ledgers([tmp_path, tmp_path / "b", tmp_path / "a" / "s0"])
    assert [str(one.folder.relative_to(tmp_path)) for one in found] == ["a/s0", "b/s0", "b/s1"]
    with pytest.raises(LedgerError, match="no run found"):
        find_ledgers([tmp_path / "a/s0/status.json"])


# ---- checkpoints ----------------------------------------------------------------------------------------------------

DTYPES = [np.int64, np.int32, np.uint8, np.float32, np.float64, np.bool_, np.dtype(">f8"), np.uint64]


@st.composite
def arrays(draw: st.DrawFn) -> np.ndarray:
    shape = draw(st.lists(st.integers(0, 3), max_size=3))
    array = np.frombuffer(draw(st.binary(min_size=216, max_size=216)), dtype=np.uint8)
    dtype = np.dtype(draw(st.sampled_from(DTYPES)))
    count = int(np.prod(shape))
    made = (array % 2).astype(dtype) if dtype == np.bool_ else np.frombuffer(array.tobytes(), dtype=dtype)
    chosen = made[:count].reshape(shape)
    return np.asfortranarray(chosen) if draw(st.booleans()) and chosen.ndim > 1 else chosen.copy()


@quick
@given(
    round=st.integers(0, 10**9),
    named=st.dictionaries(st.from_regex(r"[a-z](/?[a-z._0-9]?[a-z_0-9]){0,4}", fullmatch=True), arrays(), max_size=3),
    data=st.dictionaries(st.text(max_size=5), json_values, max_size=3),
)
def test_checkpoints_come_back_bit_by_bit(round: int, named: dict[str, np.ndarray], data: dict[str, Any]) -> None:
    checkpoint = Checkpoint(round, named, data, (Segment(0, 5, "ab"), Segment(5, 1, "cd")))
    again = decode_checkpoint(encode_checkpoint(checkpoint))
    assert same(again, checkpoint, without=())
    assert again.data == data


def forged(name: str = "array/weights", **changes: Any) -> bytes:
    """A checkpoint whose hashes are right, and whose names or numbers are those of somebody who means ill."""
    array, meta = np.zeros(3), {"round": 1, "data": {}, "segments": [], "format": 1, **changes}
    meta["sha256"] = checkpoints._digest(meta, {name.removeprefix("array/"): array})
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for member, content in (("meta", np.frombuffer(json.dumps(meta).encode(), dtype=np.uint8)), (name, array)):
            with archive.open(f"{member}.npy", "w") as file:
                np.lib.format.write_array(file, content)
    return buffer.getvalue()


HASH = "0" * 64
ELSEWHERE_NAMED: list[dict[str, Any]] = [
    *({"name": name} for name in ("array/../../x", "array//etc/passwd", "../../x", "/etc/passwd", "weights",
                                  "array/a/../b", "array/x\ny", "array/" + "x" * 1000)),
    *({"segments": [segment]} for segment in ([-1, 5, HASH], [0, -5, HASH], [0, 0, HASH], [10**12, 1, HASH],
                                              [0, 10**30, HASH], [1.5, 2, HASH], [True, 1, HASH], ["0", "1", HASH])),
    *({"round": number} for number in (-1, 10**12, 1.5, True, "1", None)),
]  # fmt: skip


def test_an_honest_checkpoint_made_by_hand_is_read() -> None:
    assert decode_checkpoint(forged(segments=[[0, 5, HASH]])).segments == (Segment(0, 5, HASH),)


@pytest.mark.parametrize("change", ELSEWHERE_NAMED, ids=range(len(ELSEWHERE_NAMED)))
def test_a_checkpoint_that_names_what_no_run_has_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"it names|it holds|its "):
        decode_checkpoint(forged(**change))


FILES_ELSEWHERE: list[dict[str, Any]] = [
    {"../../x": [0, HASH]}, {"/etc/passwd": [0, HASH]}, {METRICS: [-1, HASH]}, {METRICS: [1.5, HASH]},
    {METRICS: [10**30, HASH]}, {METRICS: 3}, {METRICS: ["x", HASH]},
]  # fmt: skip


@pytest.mark.parametrize("files", [*FILES_ELSEWHERE, None], ids=range(len(FILES_ELSEWHERE) + 1))
def test_a_checkpoint_over_files_that_no_run_has_is_not_resumed(ledger: Ledger, files: dict[str, Any] | None) -> None:
    for path in ledger.checkpoint_files():
        path.write_bytes(forged(data={} if files is None else {"files": files}))
    before = contents(ledger.folder)
    with RunWriter(ledger) as writer, pytest.raises(LedgerError, match="no checkpoint is intact"):
        writer.restore()
    assert {**contents(ledger.folder), "lock.json": b""} == {**before, "lock.json": b""}


@pytest.mark.parametrize("change", [{"checkpoint": "../../x.npz"}, {"checkpoint": "/etc/passwd"},
                                    {"files": {"../../x": [HASH]}}, {"files": {"/etc/passwd": [HASH]}}],
                         ids=range(4))  # fmt: skip
def test_a_status_that_names_files_elsewhere_is_damaged(ledger: Ledger, change: dict[str, Any]) -> None:
    status = {**dataclasses.asdict(ledger.status()), **change}
    crc = zlib.crc32(json.dumps(status, sort_keys=True).encode())
    ledger.status_file.write_text(json.dumps({**status, "crc": crc}))
    with pytest.raises(LedgerError, match="damaged"):
        ledger.status()


def test_a_piece_of_a_replay_buffer_is_no_bomb(ledger: Ledger) -> None:
    with RunWriter(ledger) as writer:
        segment = writer.write_segment(0, 1, {"w": np.zeros(4)})
        np.savez_compressed(ledger.replay / segment.name, w=np.zeros(1_000_000))
        with pytest.raises(LedgerError, match="compressed"):
            writer.read_segment(segment)


def test_a_checkpoint_cut_short_is_refused() -> None:
    content = encode_checkpoint(checkpoint_of(3))
    for length in range(len(content)):
        with pytest.raises(ValueError):  # noqa: PT011 - any reason will do
            decode_checkpoint(content[:length])


def test_a_checkpoint_with_changed_bytes_is_refused_or_the_same() -> None:
    checkpoint = checkpoint_of(3)
    content = encode_checkpoint(checkpoint)
    rng = random.Random(1)
    refused = 0
    for at in range(len(content)):
        for change in (1 << rng.randrange(8), rng.randrange(1, 256)):
            damaged = bytearray(content)
            damaged[at] ^= change
            for _ in range(rng.choice((0, 0, 3))):
                damaged[rng.randrange(len(content))] = rng.randrange(256)
            try:
                found = decode_checkpoint(bytes(damaged))
            except ValueError:
                refused += 1
            else:
                assert same(found, checkpoint, without=())
    assert refused > 300


def rewritten(checkpoint: Checkpoint, change: Callable[[dict[str, np.ndarray]], None], **options: Any) -> bytes:
    with np.load(io.BytesIO(encode_checkpoint(checkpoint)), allow_pickle=False) as file:
        entries = dict(file)
    change(entries)
    buffer = io.BytesIO()
    options.get("save", np.savez)(buffer, **entries)
    return buffer.getvalue()


def test_what_is_not_exactly_what_was_written_is_refused() -> None:
    checkpoint = checkpoint_of(3)
    assert same(decode_checkpoint(rewritten(checkpoint, lambda entries: None)), checkpoint, without=())

    def replace(name: str, value: np.ndarray) -> Callable[[dict[str, np.ndarray]], None]:
        return lambda entries: entries.update({name: value})

    changes: list[Callable[[dict[str, np.ndarray]], None]] = [
        replace("array/weights", np.zeros((2, 3), dtype=np.float32)),
        replace("array/weights", np.full((3, 2), 3, dtype=np.float32)),
        replace("array/weights", np.full((2, 3), 3, dtype=np.float64)),
        replace("array/more", np.zeros(1)),
        replace("weights", np.zeros(1)),
        lambda entries: entries.pop("array/weights"),
        lambda entries: entries.pop("meta"),
        replace("meta", np.zeros(0, dtype=np.uint8)),
        replace("meta", np.frombuffer(b"[]", dtype=np.uint8)),
        replace("meta", np.frombuffer(b"{}", dtype=np.uint8)),
        replace("meta", np.frombuffer(b'{"sha256": "x"}', dtype=np.uint8)),
        replace("meta", np.frombuffer(b"[" * 100_000, dtype=np.uint8)),
        replace("meta", np.frombuffer(b"\xff\xfe", dtype=np.uint8)),
        replace("meta", np.frombuffer(b"9" * 5_000, dtype=np.uint8)),
        replace("meta", np.array(0.5)),
    ]
    for change in changes:
        with pytest.raises(ValueError):  # noqa: PT011 - any reason will do
            decode_checkpoint(rewritten(checkpoint, change))


class Bomb:
    """Unpickling it would be seen."""

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.mkdir, ("unpickled",)


def test_pickles_are_neither_written_nor_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    bomb = np.array([Bomb()], dtype=object)
    for entry in ("array/weights", "meta", "array/more"):
        with pytest.raises(ValueError):  # noqa: PT011 - any reason will do
            decode_checkpoint(rewritten(checkpoint_of(1), lambda entries, entry=entry: entries.update({entry: bomb})))
    with pytest.raises((ValueError, TypeError)):
        encode_checkpoint(checkpoint_of(1, arrays={"weights": bomb}))
    assert list(tmp_path.iterdir()) == []


def test_compressed_and_swollen_archives_are_refused() -> None:
    compressed = rewritten(checkpoint_of(1), lambda entries: None, save=np.savez_compressed)
    with pytest.raises(ValueError, match="compressed"):
        decode_checkpoint(compressed)
    zeros = rewritten(
        checkpoint_of(1), lambda entries: entries.update({"array/z": np.zeros(10**7)}), save=np.savez_compressed
    )
    assert len(zeros) < 10**6
    with pytest.raises(ValueError, match="compressed"):
        decode_checkpoint(zeros)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("meta.npy", b"")
    for content in (b"", b"PK", buffer.getvalue(), b"\x80\x04K\x01.", os.urandom(500)):
        with pytest.raises(ValueError):  # noqa: PT011 - any reason will do
            decode_checkpoint(content)


def test_only_two_checkpoints_are_kept(ledger: Ledger) -> None:
    assert [path.name for path in ledger.checkpoint_files()] == ["round-000000003.npz", "round-000000002.npz"]
    assert sorted(path.name for path in ledger.checkpoints.iterdir()) == ["round-000000002.npz", "round-000000003.npz"]


# ---- restoring ------------------------------------------------------------------------------------------------------


def restored(ledger: Ledger) -> int:
    """The round that a fresh writer finds, with all rows and the checkpoint as they were written."""
    with RunWriter(ledger) as writer:
        checkpoint = writer.restore()
    found = 0 if checkpoint is None else checkpoint.round
    if checkpoint is not None:
        assert same(checkpoint, checkpoint_of(found))
    for name in ROW_FILES:
        assert (ledger.folder / name).read_bytes() == b"".join(map(encode_row, rows_until(name, found)))
    return found


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


def in_a_fork(action: Callable[[], object]) -> int:
    """Run `action` in a process of its own; 0 if it came to its end, 1 if it raised, else what it died of."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            action()
            code = 0
        except BaseException as error:
            os.write(2, f"{type(error).__name__}: {error}\n".encode())
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


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


def failing(number: int) -> Callable[..., NoReturn]:
    def fail(*_: object, **__: object) -> NoReturn:
        raise OSError(number, os.strerror(number), "somewhere")

    return fail


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
WRITES: dict[str, Callable[[RunWriter], object]] = {
    "commit": lambda writer: writer.commit(checkpoint_of(4), status_of(4)),
    "set_status": lambda writer: writer.set_status(status_of(3)),
    "write_config": lambda writer: writer.write_config("a", "b", "c"),
    "write_model": lambda writer: writer.write_model({"w": np.zeros(1)}, {}),
    "write_segment": lambda writer: writer.write_segment(0, 1, {"w": np.zeros(1)}),
    "restore": lambda writer: writer.restore(),
}


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


# ---- one owner ------------------------------------------------------------------------------------------------------

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
