from __future__ import annotations

import math
import os
import pickle
import random
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from space_dist import instances as module
from space_dist.envs.distributions import DISTRIBUTIONS, sample
from space_dist.envs.pointmass import BOUNDS as POINTMASS_BOUNDS
from space_dist.errors import ConfigError
from space_dist.instances import (
    MAX_FILE_BYTES,
    MAX_LINE_BYTES,
    ContextBounds,
    InstanceSet,
    read_csv,
    refuse_overlap,
    summary,
)

CHECKED_IN = Path(__file__).parent.parent / "configs" / "instances"
BOUNDS = ContextBounds(("gate_x", "gate_width", "friction"), np.array([-4.0, 0.5, 0.0]), np.array([4.0, 8.0, 4.0]))
WIDE = ContextBounds(("a", "b"), np.array([-1e300, -1e300]), np.array([1e300, 1e300]))
HEADER = "id,gate_x,gate_width,friction\n"
VALID = HEADER + "0,1.0,2.0,3.0\n1,1.5,2.5,3.5\n2,-1.0,0.5,0.0\n"

files = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
instance_sets = st.lists(
    st.tuples(
        st.integers(0, 2**63 - 1),
        st.tuples(*[st.floats(-1e300, 1e300, allow_nan=False)] * 2),
    ),
    min_size=1,
    max_size=12,
    unique_by=(lambda row: row[0], lambda row: row[1]),  # -0.0 == 0.0 here too
).map(lambda rows: InstanceSet(np.array([i for i, _ in rows]), np.array([c for _, c in rows]), WIDE.names))


def written(folder: Path, content: str | bytes, name: str = "set.csv") -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def refusal(path: Path, bounds: ContextBounds = BOUNDS) -> str:
    with pytest.raises(ConfigError) as caught:
        read_csv(path, bounds)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert len(text) < 800
    assert text.isprintable()
    return text.removeprefix(f"{path}: ")


# ---- reading and writing


@files
@given(instances=instance_sets)
def test_round_trip(tmp_path: Path, instances: InstanceSet) -> None:
    back = read_csv(written(tmp_path, instances.to_csv()), WIDE)
    assert back == instances
    assert back.to_csv() == instances.to_csv()
    assert back.digest() == instances.digest()
    assert hash(back) == hash(instances)


@files
@given(instances=instance_sets, seed=st.integers(0, 1000))
def test_order_of_rows_and_columns_decides_nothing(tmp_path: Path, instances: InstanceSet, seed: int) -> None:
    table = [line.split(",") for line in instances.to_csv().splitlines()]
    shuffle = random.Random(seed)
    rows = table[1:]
    shuffle.shuffle(rows)
    columns = shuffle.sample(range(3), 3)
    text = "".join(",".join(row[column] for column in columns) + "\n" for row in (table[0], *rows))
    back = read_csv(written(tmp_path, text), WIDE)
    assert back == instances
    assert back.digest() == instances.digest()
    assert back.names == WIDE.names


def test_canonical_text_and_digest_are_fixed() -> None:
    instances = InstanceSet(np.array([7, 0]), np.array([[0.1, -0.0], [1e-300, 2.0]]), ("a", "b"))
    assert instances.to_csv() == "id,a,b\n0,1e-300,2.0\n7,0.1,0.0\n"
    # printf 'id,a,b\n0,1e-300,2.0\n7,0.1,0.0\n' | sha256sum
    assert instances.digest() == "c641707b66816e2374fef9f1acd8a608bfa498fb5375c6b536d6bb4f78ce6dc6"


@pytest.mark.parametrize(
    "content",
    [
        VALID,
        VALID.rstrip("\n"),
        "\ufeff" + VALID,
        VALID.replace("\n", "\r\n"),
        VALID + "\n\n  \n\t\r\n",
        VALID.replace(",", " , "),
        VALID.replace("1.0,2.0", " 1 ,\t2e0"),
        '"id","gate_x","gate_width","friction"\n"0","1.0","2.0",3.0\n1, "1.5" ,2.5,3.5\n2,-1.0,0.5,-0.0\n',
    ],
    ids=["as written", "no last line end", "BOM", "CRLF", "blank end", "spaces", "other spellings", "quoted"],
)
def test_accepted_spellings(tmp_path: Path, content: str) -> None:
    expected = InstanceSet(np.arange(3), np.array([[1, 2, 3], [1.5, 2.5, 3.5], [-1, 0.5, 0]]), BOUNDS.names)
    assert read_csv(written(tmp_path, content), BOUNDS) == expected


# ---- every fault of a file


def with_cell(row: int, column: int, cell: str) -> str:
    table = [line.split(",") for line in VALID.splitlines()]
    table[row - 1][column] = cell
    return "".join(",".join(cells) + "\n" for cells in table)


FAULTS: list[tuple[str, str | bytes, list[str]]] = [
    ("empty", "", ["is empty"]),
    ("blank header", "\n" + VALID, ["row 1 is blank", "id, gate_x, gate_width, friction"]),
    ("header only", HEADER, ["has a header but no instances"]),
    ("header and blanks", HEADER + "\n\n", ["has a header but no instances"]),
    ("no header", "0,1.0,2.0,3.0\n", ["row 1: unknown column '0'", "id, gate_x"]),
    ("typo", with_cell(1, 2, "gate_widht"), ["row 1: unknown column 'gate_widht'", "did you mean 'gate_width'?"]),
    ("extra column", VALID.replace("\n", ",9\n").replace("friction,9", "friction,mass"), ["unknown column 'mass'"]),
    ("missing column", "id,gate_x,friction\n0,1,2\n", ["row 1: the column 'gate_width' is missing"]),
    ("no ids", "gate_x,gate_width,friction\n1,2,3\n", ["row 1: the column 'id' is missing"]),
    ("doubled column", with_cell(1, 2, "gate_x"), ["row 1: the column 'gate_x' is there twice"]),
    ("semicolons", VALID.replace(",", ";"), ["row 1: unknown column 'id;gate_x;", "separated by commas"]),
    ("semicolons are named", VALID.replace(",", ";"), ["are separated by semicolons, where commas must be (allowed"]),
    ("tabs are named", VALID.replace(",", "\t"), ["are separated by tabs, where commas must be (allowed"]),
    ("capitals", VALID.replace("id,", "ID,"), ["row 1: unknown column 'ID'; did you mean 'id'? (allowed"]),
    ("nothing near", VALID.replace("\n", ",9\n").replace("friction,9", "friction,note"), ["'note' (allowed are id"]),
    ("trailing commas", VALID.replace("\n", ",\n"), ["row 1: unknown column ''"]),
    ("nan", with_cell(3, 1, "nan"), ["row 3, column 'gate_x': 'nan' is not finite", "[-4.0, 4.0]"]),
    ("inf", with_cell(2, 3, "-Infinity"), ["row 2, column 'friction': '-Infinity' is not finite", "[0.0, 4.0]"]),
    ("overflow", with_cell(2, 3, "1e999"), ["row 2, column 'friction': '1e999' is not finite"]),
    ("word", with_cell(4, 2, "wide"), ["row 4, column 'gate_width': 'wide' is not a number", "[0.5, 8.0]"]),
    ("empty cell", with_cell(4, 2, ""), ["row 4, column 'gate_width': '' is not a number"]),
    ("underscore", with_cell(2, 2, "1_0"), ["row 2, column 'gate_width': '1_0' is not a number"]),
    ("underscore in id", with_cell(2, 0, "1_0"), ["row 2, column 'id': '1_0' is not an id"]),
    ("decimal comma", with_cell(2, 2, "1,5"), ["row 2 has 5 cells", "row 1 names 4 columns"]),
    ("short row", HEADER + "0,1.0,2.0,3.0\n1,2.0\n", ["row 3 has 2 cells", "'1,2.0'"]),
    ("other digits", with_cell(2, 2, "\u0661"), ["row 2, column 'gate_width': '\u0661' is not a number"]),
    ("below", with_cell(3, 2, "-0.3"), ["row 3, column 'gate_width': '-0.3' is outside the bounds", "[0.5, 8.0]"]),
    ("above", with_cell(3, 1, "4.0000001"), ["row 3, column 'gate_x': '4.0000001' is outside the bounds"]),
    ("negative id", with_cell(3, 0, "-1"), ["row 3, column 'id': '-1' is not an id", "from 0 to 9223372036854775807"]),
    ("fractional id", with_cell(3, 0, "1.0"), ["row 3, column 'id': '1.0' is not an id"]),
    ("huge id", with_cell(3, 0, str(2**63)), ["row 3, column 'id': '9223372036854775808' is not an id"]),
    ("very long id", with_cell(3, 0, "9" * 5000), ["row 3, column 'id': '9999", "…"]),
    ("missing id", with_cell(3, 0, ""), ["row 3, column 'id': '' is not an id"]),
    ("doubled id", with_cell(4, 0, "0"), ["row 2 and row 4, column 'id': both are 0"]),
    ("doubled context", VALID + "9,1.5,2.50,35e-1\n", ["row 3 (id 1) and row 5 (id 9)", "same context"]),
    ("first of two", VALID + "9,1.5,2.5,3.5\n8,-1.0,0.5,0.0\n7,-1.0,0.5,0.0\n", ["row 3 (id 1) and row 5 (id 9)"]),
    ("first of two ids", VALID + "2,0,1,1\n0,0,2,2\n", ["row 4 and row 5, column 'id': both are 2"]),
    ("zero twice", VALID + "9,-1.0,0.5,-0.0\n", ["row 4 (id 2) and row 5 (id 9)", "same context"]),
    ("blank line within", HEADER + "0,1.0,2.0,3.0\n\n\n1,2.0,2.0,2.0\n", ["row 3 is blank, but more rows follow"]),
    ("open quote", with_cell(3, 1, '"1.5'), ["row 3, column 'gate_x': '\"1.5' is not a number"]),
    ("lone quote", with_cell(3, 1, '"'), ["row 3, column 'gate_x': '\"' is not a number"]),
    ("open quote in header", with_cell(1, 1, '"gate_x'), ["unknown column '\"gate_x'", "did you mean 'gate_x'?"]),
    ("old Mac line ends", VALID.replace("\n", "\r"), ["row 1 contains a bare carriage return"]),
    ("one old Mac line end", HEADER + "0,1.0,2.0,3.0\r1,1.0,2.0,4.0\n", ["row 2 contains a bare carriage return"]),
    ("Latin-1 header", "id,größe\n".encode("latin-1"), ["row 1 is not UTF-8 text", "b'id,gr\\xf6"]),
    ("Latin-1 cell", with_cell(2, 1, "ö").encode("latin-1"), ["row 2, column 'gate_x': b'\\xf6' is not a number"]),
    ("UTF-16", VALID.encode("utf-16"), ["row 1 contains a NUL byte"]),
    ("NUL in a cell", with_cell(2, 1, "1\0"), ["row 2, column 'gate_x': '1\\x00' is not a number"]),
    ("terminal escapes", with_cell(2, 1, "\x1b[2J" * 50), ["row 2, column 'gate_x': '\\x1b[2J", "…"]),
    ("long line", HEADER + "0," + "1" * MAX_LINE_BYTES + "\n", [f"row 2 is longer than {MAX_LINE_BYTES} bytes"]),
    ("long header", "x" * (MAX_LINE_BYTES + 1), [f"row 1 is longer than {MAX_LINE_BYTES} bytes"]),
    ("many columns", "id" + ",x" * 200_000 + "\n", ["row 1: unknown column 'x'"]),
    ("many cells", HEADER + "1," * 200_000 + "\n", ["row 2 has 200001 cells"]),
]


@pytest.mark.parametrize(("content", "said"), [fault[1:] for fault in FAULTS], ids=[fault[0] for fault in FAULTS])
def test_faults_are_named(tmp_path: Path, content: str | bytes, said: list[str]) -> None:
    text = refusal(written(tmp_path, content))
    for part in said:
        assert part in text


def test_a_misspelt_folder_is_named_with_the_nearest(tmp_path: Path) -> None:
    (tmp_path / "instances" / "small").mkdir(parents=True)
    (tmp_path / "instances.csv").write_text(VALID)
    text = refusal(tmp_path / "instnaces" / "small" / "train.csv")
    folder = tmp_path / "instnaces"
    assert text.endswith(f"there is no such file; there is no folder {folder}; did you mean 'instances'?")
    text = refusal(tmp_path / "instances" / "smal" / "train.csv")
    assert text.endswith(f"there is no folder {tmp_path / 'instances' / 'smal'}; did you mean 'small'?")
    assert refusal(tmp_path / "zzz" / "train.csv").endswith(f"there is no folder {tmp_path / 'zzz'}")
    (tmp_path / "instances" / "train.csv").write_text(VALID)
    text = refusal(tmp_path / "instances" / "trian.csv")
    assert text.endswith("there is no such file; did you mean 'train.csv'?")


def test_what_is_not_a_file(tmp_path: Path) -> None:
    assert "no such file" in refusal(tmp_path / "absent.csv")
    assert "is a folder" in refusal(tmp_path)
    assert "Not a directory" in refusal(written(tmp_path, VALID) / "under.csv")
    assert "not a regular file" in refusal(Path("/dev/zero"))
    os.mkfifo(tmp_path / "pipe.csv")
    assert "not a regular file" in refusal(tmp_path / "pipe.csv")
    loop = tmp_path / "loop.csv"
    loop.symlink_to(loop)
    assert "cannot be read" in refusal(loop)
    for name in ("nul\0.csv", "\ud800.csv", "new\nline.csv", "x" * 5000):
        with pytest.raises(ConfigError) as caught:
            read_csv(Path(name), BOUNDS)
        assert str(caught.value).isprintable()
        assert len(str(caught.value)) < 300


def test_unreadable_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, VALID)
    path.chmod(0)
    if os.access(path, os.R_OK):  # root reads everything, so the system's refusal is played

        def refuse(*_: object, **__: object) -> None:
            raise PermissionError(13, "Permission denied", str(path))

        monkeypatch.setattr(Path, "open", refuse)
    assert refusal(path) == "cannot be read: Permission denied"


def test_file_emptied_after_its_size_was_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_check_kind_and_size", lambda _: None)
    assert "row 1 is blank" in refusal(written(tmp_path, ""))


@pytest.mark.parametrize("size", [2**30, MAX_FILE_BYTES])
def test_garbage_by_the_gigabyte_is_refused_quickly(tmp_path: Path, size: int) -> None:
    path = written(tmp_path, b"")
    os.truncate(path, size)
    start = time.monotonic()
    text = refusal(path)
    assert time.monotonic() - start < 1
    assert (f"has {size} bytes" if size > MAX_FILE_BYTES else "row 1 is longer") in text


def test_more_instances_than_anyone_means(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, VALID)
    monkeypatch.setattr(module, "MAX_INSTANCES", 3)
    assert len(read_csv(path, BOUNDS)) == 3
    monkeypatch.setattr(module, "MAX_INSTANCES", 2)
    assert refusal(path) == "holds more than 2 instances"


# ---- files nobody thought of

JUNK = [
    b"",
    b" ",
    b"\0",
    b"\r",
    b"\n",
    b",",
    b"1;2",
    b'"',
    b'""',
    b'"1"',
    b"\xff\xfe",
    b"\xef\xbb\xbf",
    b"\x1b[31m",
    b"\xe2\x80\xae",
    b"\xf0\x9f\x92\xa9",
    b"nan",
    b"inf",
    b"None",
    b"=1+1",
    b"id",
    b"0",
    b"-0.0",
    b"-1",
    b"1.0.0",
    b"1_0",
    b"0x10",
    b"1e400",
    b"1e-400",
    b"9" * 5000,
    b"18446744073709551616",
]


def put_cell(table: list[list[bytes]], row: int, column: int, junk: bytes) -> None:
    table[row][column % len(table[row])] = junk


def drop_cell(table: list[list[bytes]], row: int, column: int, _: bytes) -> None:
    del table[row][column % len(table[row])]
    if not table[row]:
        table[row].append(b"")


def drop_row(table: list[list[bytes]], row: int, _: int, junk: bytes) -> None:
    table[row] = [junk]


def double_row(table: list[list[bytes]], row: int, _: int, __: bytes) -> None:
    table.insert(row, list(table[row]))


def shuffle_columns(table: list[list[bytes]], row: int, column: int, _: bytes) -> None:
    order = random.Random(row * 100 + column)
    for number, cells in enumerate(table):
        if number == 0 or column % 2:
            order.shuffle(cells)


MUTATIONS = [put_cell, drop_cell, drop_row, double_row, shuffle_columns]
mutated = st.tuples(
    st.lists(
        st.tuples(st.sampled_from(MUTATIONS), st.integers(0, 3), st.integers(0, 3), st.sampled_from(JUNK)),
        min_size=1,
        max_size=3,
    ),
    st.one_of(st.none(), st.integers(0, len(VALID))),
)
Mutation = Callable[[list[list[bytes]], int, int, bytes], None]


def refused_or_valid(path: Path) -> bool:
    """Whether the file is valid; checks that a refusal is fit to be read, and a set what it promises to be."""
    try:
        instances = read_csv(path, BOUNDS)
    except ConfigError:
        refusal(path)
        return False
    assert (instances.contexts >= BOUNDS.low).all()
    assert (instances.contexts <= BOUNDS.high).all()
    assert len(np.unique(instances.contexts, axis=0)) == len(instances)
    assert read_csv(written(path.parent, instances.to_csv(), "again.csv"), BOUNDS) == instances
    return True


@settings(files, max_examples=400)
@given(recipe=mutated)
def test_mutated_files_are_refused_or_valid(
    tmp_path: Path, recipe: tuple[list[tuple[Mutation, int, int, bytes]], int | None]
) -> None:
    table = [line.split(b",") for line in VALID.encode().splitlines()]
    for mutation, row, column, junk in recipe[0]:
        mutation(table, row, column, junk)
    refused_or_valid(written(tmp_path, b"\n".join(b",".join(cells) for cells in table)[: recipe[1]]))


@settings(files, max_examples=200)
@given(garbage=st.binary(max_size=300), header=st.booleans())
def test_random_bytes_are_refused_or_valid(tmp_path: Path, garbage: bytes, header: bool) -> None:
    refused_or_valid(written(tmp_path, HEADER.encode() + garbage if header else garbage))


@pytest.mark.parametrize("cut", range(len(VALID)))
def test_truncated_files_are_refused_or_valid(tmp_path: Path, cut: int) -> None:
    # a file cut inside its last number can be a valid one: nothing in a CSV says where it was meant to end
    last = VALID[:cut].splitlines()[-1:]
    complete = cut > len(HEADER) and last[0].count(",") == 3 and not last[0].endswith(",")
    assert refused_or_valid(written(tmp_path, VALID[:cut])) == complete


# ---- the classes


def test_bounds_scale() -> None:
    contexts = np.array([[[-4.0, 0.5, 0.0], [4.0, 8.0, 4.0]], [[0.0, 4.25, 2.0], [8.0, 4.25, 1.0]]])
    expected = [[[-1, -1, -1], [1, 1, 1]], [[0, 0, 0], [2, 0, -0.5]]]
    np.testing.assert_array_equal(BOUNDS.scale(contexts), expected)
    np.testing.assert_array_equal(BOUNDS.scale(contexts[0, 0]), [-1, -1, -1])
    for shape in ((3, 1), (2,), ()):
        with pytest.raises(ConfigError, match="of shape"):
            BOUNDS.scale(np.zeros(shape))


@pytest.mark.parametrize(
    ("names", "low", "high", "said"),
    [
        ((), [], [], "at least one feature"),
        (("a", "a"), [0, 0], [1, 1], "'a' is named twice"),
        (("id",), [0], [1], "'id' cannot name a feature"),
        (("a,b",), [0], [1], "'a,b' cannot name a feature"),
        ((" a",), [0], [1], "cannot name a feature"),
        (("",), [0], [1], "cannot name a feature"),
        (("a\nb",), [0], [1], "cannot name a feature"),
        (("a",), [0, 0], [1], "shapes"),
        (("a",), [1], [1], r"'a' has bounds \[1.0, 1.0\]"),
        (("a", "b"), [0, 2], [1, 1], r"'b' has bounds \[2.0, 1.0\]"),
        (("a",), [0], [math.inf], "must be finite"),
        (("a",), [math.nan], [1], "must be finite"),
        (("a",), [-1e308], [1e308], "must be finite"),  # their distance is not
    ],
)
def test_bounds_refused(names: tuple[str, ...], low: list[float], high: list[float], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        ContextBounds(names, np.array(low), np.array(high))


@pytest.mark.parametrize(
    ("ids", "contexts", "said"),
    [
        ([], np.empty((0, 2)), "at least one instance"),
        ([0, 0], [[1, 2], [3, 4]], "two instances have the id 0"),
        ([-1, 0], [[1, 2], [3, 4]], "between 0 and"),
        ([0.0, 1.0], [[1, 2], [3, 4]], "whole numbers"),
        ([0, 1], [[1, 2], [3, math.nan]], "instance 1 has 'b' = nan"),
        ([0], [[1, 2], [3, 4]], "do not make an instance set"),
        ([0, 1], [[1], [3]], "do not make an instance set"),
        ([0, 1], [1, 2], "do not make an instance set"),
        (np.array([0, 2**63], dtype=np.uint64), [[1, 2], [3, 4]], "between 0 and"),
    ],
)
def test_instance_set_refused(ids: list[int], contexts: list[list[float]], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        InstanceSet(np.array(ids), np.array(contexts), ("a", "b"))


@pytest.mark.parametrize(
    ("contexts", "names", "columns", "said"),
    [
        ([["x"]], ("a",), {}, "the contexts must be numbers, as many in each row"),
        ([[1.0], [1.0, 2.0]], ("a",), {}, "the contexts must be numbers, as many in each row"),
        ([[1.0]], (3,), {}, "names of features are a tuple of words"),
        ([[1.0]], "a", {}, "names of features are a tuple of words"),
        ([[1.0]], None, {}, "names of features are a tuple of words, not None"),
        ([[1.0]], ("a",), None, "columns are numbers by name, a word, not None"),
        ([[1.0]], ("a",), {"level": ["high"]}, "the column 'level' must be numbers"),
    ],
)
def test_what_is_no_number_and_no_word_is_refused(contexts: Any, names: Any, columns: Any, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        InstanceSet(np.arange(len(contexts)), contexts, names, columns)


def test_names_may_be_listed() -> None:
    listed: Any = ["a", "b"]
    assert InstanceSet(np.array([0]), np.array([[1.0, 2.0]]), listed).names == ("a", "b")


def test_instance_set_is_sorted_and_frozen() -> None:
    ids, contexts = np.array([5, 1, 3]), np.array([[50.0, 5], [10, 1], [30, 3]])
    instances = InstanceSet(ids, contexts, ("a", "b"))
    assert instances.ids.tolist() == [1, 3, 5]
    assert instances.contexts.tolist() == [[10, 1], [30, 3], [50, 5]]
    ids[0] = contexts[0, 0] = 99  # the set has copies
    assert instances.contexts.max() == 50
    with pytest.raises(ValueError, match="read-only"):
        instances.contexts[0, 0] = 0
    assert pickle.loads(pickle.dumps(instances)) == instances  # noqa: S301 - our own bytes
    assert instances != InstanceSet(instances.ids, instances.contexts, ("a", "c"))
    assert instances != InstanceSet(instances.ids + 1, instances.contexts, ("a", "b"))
    assert instances != InstanceSet(instances.ids, instances.contexts + 1, ("a", "b"))
    assert instances != "instances"


def test_equality_of_bounds() -> None:
    assert BOUNDS == POINTMASS_BOUNDS
    assert hash(BOUNDS) == hash(POINTMASS_BOUNDS)
    assert BOUNDS != WIDE
    assert replace(BOUNDS, low=BOUNDS.low - 1) != BOUNDS
    assert BOUNDS != "bounds"


def test_subset() -> None:
    instances = InstanceSet(np.array([5, 1, 3]), np.array([[50.0], [10], [30]]), ("a",))
    chosen = instances.subset(np.array([2, 0]))
    assert chosen.ids.tolist() == [1, 5]
    assert chosen.contexts.tolist() == [[10], [50]]
    for positions, said in (
        ([0, 0], "the id 1"),
        ([], "at least one position, a whole number; none is given"),
        ([True, False, True], r"\(not by a mask\), not by \[True, False, True\]"),
        (3, "a list of positions, whole numbers, not by 3"),
        ([[0]], r"a list of positions, whole numbers, not by \[\[0\]\]"),
        (None, "not by None"),
        ([3], r"0 to 2 \(not by ids\), not by 3"),
        ([0, -4], "not by -4"),
    ):
        with pytest.raises(ConfigError, match=said):
            instances.subset(positions)  # type: ignore[arg-type]


def test_summary() -> None:
    instances = InstanceSet(np.arange(3), np.array([[1.0, 2, 3], [2, 3, 4], [-3, 7, 2]]), BOUNDS.names)
    assert summary(instances, BOUNDS) == [("gate_x", -3, 0, 2), ("gate_width", 2, 4, 7), ("friction", 2, 3, 4)]
    with pytest.raises(ConfigError, match="the set's features are gate_x"):
        summary(instances, WIDE)


def test_overlap() -> None:
    train = InstanceSet(np.arange(5), np.arange(10.0).reshape(5, 2), ("a", "b"))
    apart = InstanceSet(np.arange(5), np.arange(10.0).reshape(5, 2) + 0.5, ("a", "b"))
    refuse_overlap(train, apart, "train.csv", "test.csv")  # equal ids are no overlap
    doubled = InstanceSet(np.arange(2), np.full((2, 2), -1.0), ("a", "b"))  # within one set: no overlap either
    refuse_overlap(doubled, apart, "train.csv", "test.csv")
    refuse_overlap(apart, doubled, "train.csv", "test.csv")
    shared = InstanceSet(np.array([70, 71]), np.array([[0.0, 9.0], [4.0, 5.0]]), ("a", "b"))
    with pytest.raises(ConfigError, match=r"of train.csv and test.csv, by their ids: 2 is 71\. A policy"):
        refuse_overlap(train, shared, "train.csv", "test.csv")
    with pytest.raises(ConfigError, match="and 2 more"):
        refuse_overlap(train, train, "train.csv", "test.csv")
    with pytest.raises(ConfigError, match=r"overlap: both are train\.csv\. A policy"):
        refuse_overlap(train, train, "train.csv", "train.csv")
    with pytest.raises(ConfigError, match=r"train\.csv and test\.csv have different features: a, b and a, c"):
        refuse_overlap(train, replace(apart, names=("a", "c")), "train.csv", "test.csv")


# ---- sampling


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_samples(name: str) -> None:
    train, test = sample(name, 300, 200, seed=1)
    bounds = DISTRIBUTIONS[name].bounds
    assert train.ids.tolist() == list(range(300))
    assert test.ids.tolist() == list(range(300, 500))
    assert train.names == test.names == bounds.names
    both = np.vstack((train.contexts, test.contexts))
    assert ((both >= bounds.low) & (both <= bounds.high)).all()
    assert len(np.unique(both, axis=0)) == 500
    refuse_overlap(train, test, "train", "test")
    assert sample(name, 300, 200, seed=1) == (train, test)
    for other in (sample(name, 300, 200, seed=2), sample(name, 200, 300, seed=1)):
        shared = (both[:, None] == np.vstack([part.contexts for part in other])).all(axis=2).any(axis=1)
        # There are only so many mazes; of 3x3, which are a ninth of the mixed ones, 192.
        assert shared.sum() <= {"mixed_maze": 40}.get(name, 5 if name.startswith("maze") else 0)


def test_each_distribution_has_its_own_stream() -> None:
    one = DISTRIBUTIONS["pointmass_uniform"]
    known = {"one": one, "other": one}
    assert sample("one", 5, 5, seed=0, known=known) != sample("other", 5, 5, seed=0, known=known)


def assert_moments(values: np.ndarray, mean: float, std: float, fourth: float) -> None:
    """Within 5 standard errors: std / sqrt(n) of the mean, and sqrt(m4 - std^4) / (2 std sqrt(n)) of the std."""
    n = len(values)
    assert abs(values.mean() - mean) < 5 * std / math.sqrt(n)
    assert abs(values.std() - std) < 5 * math.sqrt(fourth - std**4) / (2 * std * math.sqrt(n))


def test_moments_of_the_uniform_distribution() -> None:
    contexts = sample("pointmass_uniform", 20_000, 1, seed=0)[0].contexts
    for values, low, high in zip(contexts.T, BOUNDS.low, BOUNDS.high, strict=True):
        span = high - low
        assert_moments(values, (low + high) / 2, span / math.sqrt(12), span**4 / 80)


def test_moments_of_the_target_distribution() -> None:
    gate_x, gate_width, friction = sample("pointmass_target", 20_000, 1, seed=0)[0].contexts.T
    assert_moments(gate_x, 2.5, 4e-3, 3 * 4e-3**4)
    # Y = max(0, Z) has E Y = a = 1/sqrt(2 pi), E Y^2 = 1/2, E Y^3 = 2 a, E Y^4 = 3/2, hence these central moments
    a = 1 / math.sqrt(2 * math.pi)
    std, fourth = math.sqrt(0.5 - a**2), 1.5 - 5 * a**2 - 3 * a**4
    for values, bound, sigma in ((gate_width, 0.5, 3.75e-3), (friction, 0.0, 2e-3)):
        assert_moments(values, bound + sigma * a, sigma * std, sigma**4 * fourth)
        assert abs((values == bound).mean() - 0.5) < 5 * 0.5 / math.sqrt(20_000)


def test_repeated_draws_are_drawn_again() -> None:
    dice = replace(
        DISTRIBUTIONS["pointmass_uniform"],
        bounds=ContextBounds(("side",), np.array([0.0]), np.array([5.0])),
        draw=lambda rng, n: rng.integers(0, 6, (n, 1)).astype(float),
    )
    train, test = sample("dice", 4, 2, seed=0, known={"dice": dice})
    assert sorted([*train.contexts[:, 0], *test.contexts[:, 0]]) == [0, 1, 2, 3, 4, 5]
    with pytest.raises(ConfigError, match="found only 6 distinct contexts of dice where 7 were asked for"):
        sample("dice", 4, 3, seed=0, known={"dice": dice})


@pytest.mark.parametrize(
    ("name", "n_train", "n_test", "seed", "said"),
    [
        (
            "pointmass_unifrom",
            1,
            1,
            0,
            r"did you mean 'pointmass_uniform'\? \(known are pointmass_uniform, pointmass_t",
        ),
        ("pointmass_uniform", 0, 1, 0, "cannot sample 0 training and 1 test"),
        ("pointmass_uniform", 1, 0, 0, "at least 1 of each"),
        ("pointmass_uniform", 10**12, 1, 0, "at most 10000000 together"),
        ("pointmass_uniform", 1, 1, -1, "the seed -1 is negative"),
    ],
)
def test_sampling_refused(name: str, n_train: int, n_test: int, seed: int, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        sample(name, n_train, n_test, seed)


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_checked_in_sets_are_what_the_sampler_gives(name: str) -> None:
    parts = dict(zip(("train", "test"), sample(name, 100, 100, seed=0), strict=True))
    for part, instances in parts.items():
        path = CHECKED_IN / f"{name}_{part}.csv"
        assert path.read_bytes() == instances.to_csv().encode()
        assert read_csv(path, DISTRIBUTIONS[name].bounds) == instances
