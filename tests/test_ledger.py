"""A run's folder: rows, status and checkpoints come back as they were written, or are refused."""

# ruff: noqa: F811 - fixtures that are imported
from __future__ import annotations

import dataclasses
import io
import json
import os
import random
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from space_dist.errors import LedgerError, NotPlannedError
from space_dist.ledger import (
    METRICS,
    ROW_FILES,
    Checkpoint,
    Ledger,
    RunWriter,
    Segment,
    decode_checkpoint,
    decode_row,
    encode_checkpoint,
    encode_row,
    find_ledgers,
)
from space_dist.ledger import checkpoint as checkpoints
from tests.three_rounds import (
    append_round,
    checkpoint_of,
    contents,
    ledger,  # noqa: F401
    row_of,
    rows_until,
    same,
    status_of,
)

quick = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=10,
)
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
    with pytest.raises(NotPlannedError, match="does not exist"):
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
