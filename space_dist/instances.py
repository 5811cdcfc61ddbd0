"""Instance sets: which contexts a run trains and is tested on. Read, checked and written here.

An *instance* is one context (a feature vector) with an id. Sets live in CSV files, one instance a line: `id` and one
column a feature. A file is checked whole before a run starts, because a bad row found after hours costs those hours.
"""

from __future__ import annotations

import hashlib
import stat
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from space_dist.config.shipped import located
from space_dist.errors import ConfigError, about, missing_folder, nearest

MAX_FILE_BYTES: Final = 512 * 2**20
MAX_LINE_BYTES: Final = 2**20  # some 40,000 features; a file without line ends never gets into memory whole
MAX_INSTANCES: Final = 10_000_000
MAX_ID: Final = 2**63 - 1
PADDING_IDS: Final = 9 * 10**15
"""From this id on, instances are padding: declared to be such that no policy can solve (`space_dist.envs.padding`)."""
_BYTE_ORDER_MARK: Final = b"\xef\xbb\xbf"
_SEPARATORS: Final = {";": "semicolons", "\t": "tabs", "|": "bars"}
_WIDE: Final = 1e300  # bounds where none are known


@dataclass(frozen=True, eq=False)
class ContextBounds:
    """The features of an environment's contexts and the closed interval each may lie in, in the environment's units.

    `names` are the d features, `low` and `high` are `(d,)`. `lower`, by feature: a lower bound that an argument of
    the environment allows, and that argument, for sentences alone. Raises ConfigError unless the names are distinct,
    can stand in a CSV header as they are, and low < high, both finite.
    """

    names: tuple[str, ...]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    lower: Mapping[str, tuple[float, str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_names(self.names)
        low, high = (np.array(side, dtype=np.float64) + 0.0 for side in (self.low, self.high))
        if low.shape != (len(self.names),) or high.shape != low.shape:
            raise ConfigError(f"bounds of shapes {low.shape} and {high.shape} for {len(self.names)} features")
        with np.errstate(over="ignore", invalid="ignore"):
            usable = np.isfinite(high - low) & (low < high)
        if not usable.all():
            bad = int(np.argmin(usable))
            raise ConfigError(
                f"feature {shown(self.names[bad])} has bounds [{low[bad]}, {high[bad]}]: "
                "they must be finite, the lower below the higher"
            )
        _freeze(self, low=low, high=high)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, ContextBounds):
            return NotImplemented
        return (
            self.names == other.names and np.array_equal(self.low, other.low) and np.array_equal(self.high, other.high)
        )

    def __hash__(self) -> int:
        return hash((self.names, self.low.tobytes(), self.high.tobytes()))

    def scale(self, contexts: NDArray[np.float64]) -> NDArray[np.float64]:
        """`(..., d)` contexts with the bounds moved to [-1, 1]; a context outside the bounds stays outside.

        Raises ConfigError if the last axis is not d long.
        """
        if contexts.shape[-1:] != self.low.shape:  # a last axis of 1 would broadcast without a word
            raise ConfigError(f"contexts of shape {contexts.shape} for the {len(self.names)} features of these bounds")
        scaled: NDArray[np.float64] = 2.0 * ((contexts - self.low) / (self.high - self.low)) - 1.0
        return scaled


@dataclass(frozen=True, eq=False)
class InstanceSet:
    """At least one instance, sorted by id, so that the order of a file's rows can decide nothing.

    `ids` are `(n,)` int64, ascending, unique and >= 0; `contexts` `(n, d)` float64 in the order of `ids`, without
    negative zeros; `names` the d features. `columns` are further numbers about each instance, `(n,)` by name, which no
    environment and no policy sees. All arrays are copies and read-only. Raises ConfigError for anything else.
    """

    ids: NDArray[np.int64]
    contexts: NDArray[np.float64]
    names: tuple[str, ...]
    columns: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.columns, Mapping) or not all(isinstance(name, str) for name in self.columns):
            raise ConfigError(f"columns are numbers by name, a word, not {_cut(repr(self.columns), 120)}")
        listed = isinstance(self.names, Iterable) and not isinstance(self.names, str)
        if not listed or not all(isinstance(name, str) for name in self.names):
            raise ConfigError(f"names of features are a tuple of words, not {self.names!r}")
        object.__setattr__(self, "names", tuple(self.names))
        _check_names((*self.names, *self.columns))
        given, contexts = np.asarray(self.ids), _numbers("the contexts", self.contexts)
        if contexts.ndim != 2 or given.shape != contexts.shape[:1] or contexts.shape[1] != len(self.names):
            raise ConfigError(
                f"ids of shape {given.shape}, contexts of shape {contexts.shape} and {len(self.names)} "
                "feature names do not make an instance set"
            )
        if not len(given):
            raise ConfigError("an instance set needs at least one instance")
        if not np.issubdtype(given.dtype, np.integer):
            raise ConfigError(f"ids must be whole numbers, not {given.dtype}")
        if given.min() < 0 or given.max() > MAX_ID:
            raise ConfigError(f"ids must be between 0 and {MAX_ID}, not {given.min()} to {given.max()}")
        if not np.isfinite(contexts).all():
            row, feature = np.argwhere(~np.isfinite(contexts))[0]
            raise ConfigError(
                f"instance {given[row]} has {shown(self.names[feature])} = {contexts[row, feature]}: "
                "contexts must be finite"
            )
        order = np.argsort(given, kind="stable")
        ids = given[order].astype(np.int64)
        if (repeated := np.flatnonzero(ids[1:] == ids[:-1])).size:
            raise ConfigError(f"two instances have the id {ids[repeated[0]]}")
        # + 0.0 turns -0.0 into 0.0: equal contexts shall have equal bytes, and so equal digests
        _freeze(self, ids=ids, contexts=contexts[order] + 0.0)
        columns = {name: _numbers(f"the column {shown(name)}", values) for name, values in self.columns.items()}
        for name, values in columns.items():
            if values.shape != given.shape or not np.isfinite(values).all():
                raise ConfigError(f"the column {shown(name)} must hold one finite number for each instance")
            columns[name] = values[order] + 0.0
            columns[name].setflags(write=False)
        object.__setattr__(self, "columns", columns)

    def __len__(self) -> int:
        return len(self.ids)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, InstanceSet):
            return NotImplemented
        return (
            self.names == other.names
            and np.array_equal(self.ids, other.ids)
            and np.array_equal(self.contexts, other.contexts)
            and list(self.columns) == list(other.columns)
            and all(np.array_equal(self.columns[name], other.columns[name]) for name in self.columns)
        )

    def __hash__(self) -> int:
        return hash((self.names, self.ids.tobytes(), self.contexts.tobytes()))

    @property
    def padding(self) -> NDArray[np.bool_]:
        """`(n,)` which instances are declared to be such that no policy can solve."""
        found: NDArray[np.bool_] = self.ids >= PADDING_IDS
        return found

    def to_csv(self) -> str:
        r"""The one canonical text of this set: `id,<names>,<columns>`, by id, shortest round-trip floats, `\n` ends."""
        numbers = np.column_stack((self.contexts, *self.columns.values()))
        rows = zip(self.ids.tolist(), numbers.tolist(), strict=True)
        lines = [",".join((str(identity), *map(repr, row))) for identity, row in rows]
        return "\n".join((",".join(("id", *self.names, *self.columns)), *lines, ""))

    def digest(self) -> str:
        """SHA-256, in hex, of the canonical text in UTF-8: equal for equal sets whatever file they came from."""
        return hashlib.sha256(self.to_csv().encode()).hexdigest()

    def subset(self, indices: NDArray[np.int64] | Sequence[int]) -> InstanceSet:
        """The instances at `(k,)` distinct positions (not ids, not a mask).

        Raises ConfigError if a position is doubled, no whole number or not there, or none is given.
        """
        chosen = np.asarray(indices)
        if not chosen.size:
            raise ConfigError("a subset is chosen by at least one position, a whole number; none is given")
        if chosen.ndim != 1 or not np.issubdtype(chosen.dtype, np.integer):
            what = f"a list of positions, whole numbers{' (not by a mask)' if chosen.dtype == np.bool_ else ''}"
            raise ConfigError(f"a subset is chosen by {what}, not by {_cut(repr(indices), 120)}")
        if absent := [index for index in chosen.tolist() if not -len(self) <= index < len(self)]:
            raise ConfigError(
                f"a subset is chosen by positions, here 0 to {len(self) - 1} (not by ids), not by {absent[0]}"
            )
        columns = {name: values[chosen] for name, values in self.columns.items()}
        return InstanceSet(self.ids[chosen], self.contexts[chosen], self.names, columns)


def read_csv(
    path: Path | str, bounds: ContextBounds, columns: Sequence[str] = (), *, if_there: bool = False,
    named_by: str = "columns",
) -> InstanceSet:  # fmt: skip
    r"""The instances of a CSV file, checked whole. `shipped:NAME` names one that comes with the package.

    The first line names `id`, the features of `bounds` and the further `columns`, in any order, and nothing else; each
    further line is one instance. With `if_there`, `columns` may be missing; a feature among them is a feature.
    `named_by` is what sentences call whatever names them.
    Cells are separated by commas; spaces around a cell, double quotes around a cell, a byte order mark, `\r\n` and
    blank lines at the end are accepted. Features come back in the order of `bounds`.

    Raises ConfigError, naming the file and where it can the row (the line as an editor numbers it) and the column,
    if the file cannot be read or is larger than 512 MiB, if ids are not whole numbers from 0 to 2**63 - 1, if a
    feature is not a number within its bounds, a further column not a finite number, or if an id or a context occurs
    twice.
    """
    path, columns = located(path), [name for name in columns if name not in bounds.names]
    try:
        _check_kind_and_size(path)
        with path.open("rb") as file:
            header = _read_header(file, bounds, columns, if_there, named_by)
            found = [name for name in columns if name in header]
            ids, numbers = _read_rows(file, header, bounds, found)
        d = len(bounds.names)
        contexts = numbers[:, :d]
        _refuse_repeats(ids, contexts)
        return InstanceSet(ids, contexts, bounds.names, {name: numbers[:, d + i] for i, name in enumerate(found)})
    except ConfigError as fault:
        raise ConfigError(f"{_shown_path(path)}: {fault}") from None
    except OSError as error:
        raise ConfigError(f"{_shown_path(path)}: cannot be read: {error.strerror}") from error


def read_features(
    path: Path | str, columns: Sequence[str] = (), *, named_by: str = "columns"
) -> tuple[InstanceSet, ContextBounds]:
    """The instances of a CSV file whose environment is not known, and the least bounds that they lie in.

    All columns but `id` and `columns` are features. Raises ConfigError as `read_csv` does.
    """
    path = located(path)
    names = tuple(name for name in _named_columns(path) if name not in ("id", *columns))
    if not names:
        raise ConfigError(f"{_shown_path(path)}: row 1 names no feature")
    wide = np.full(len(names), _WIDE)
    with about(_shown_path(path)):
        instances = read_csv(path, ContextBounds(names, -wide, wide), columns, named_by=named_by)
    low, high = instances.contexts.min(axis=0), instances.contexts.max(axis=0)
    return instances, ContextBounds(names, low, np.where(high > low, high, low + np.maximum(1.0, np.abs(low))))


def _named_columns(path: Path) -> list[str]:
    try:
        _check_kind_and_size(path)
        with path.open("rb") as file:
            row, line = next(_lines(file, first_row=1), (1, b""))
        cells = _split(row, line.removeprefix(_BYTE_ORDER_MARK))
        return [cell.decode(errors="replace").strip() for cell in cells]
    except ConfigError as fault:
        raise ConfigError(f"{_shown_path(path)}: {fault}") from None
    except OSError as error:
        raise ConfigError(f"{_shown_path(path)}: cannot be read: {error.strerror}") from error


def refuse_overlap(train: InstanceSet, test: InstanceSet, train_name: str, test_name: str) -> None:
    """Raise ConfigError if a context (compared by content, not by id) is in both sets, with the ids it has in each.

    Also raised if the sets have different features: then nothing could be compared.
    """
    if train.names != test.names:
        raise ConfigError(
            f"{train_name} and {test_name} have different features: "
            f"{_cut(', '.join(train.names), 120)} and {_cut(', '.join(test.names), 120)}"
        )
    first, second = repeats(np.vstack((train.contexts, test.contexts)))
    crossing = (first < len(train)) & (second >= len(train))
    if crossing.any():
        train_ids, test_ids = train.ids[first[crossing]], test.ids[second[crossing] - len(train)]
        pairs = [f"{a} is {b}" for a, b in zip(train_ids[:3].tolist(), test_ids[:3].tolist(), strict=True)]
        more = f" and {len(train_ids) - 3} more" if len(train_ids) > 3 else ""
        files = f"of {train_name} and {test_name}, by their ids: {', '.join(pairs)}{more}"
        what = f"both are {train_name}" if train_name == test_name else files
        raise ConfigError(
            f"training and test instances overlap: {what}. A policy must be tested on contexts it was not trained on"
        )


def refuse_padding(instances: InstanceSet, name: str) -> None:
    """Raise ConfigError if a set holds instances that are declared to be such that no policy can solve."""
    if count := int(instances.padding.sum()):
        raise ConfigError(
            f"{name}: {count} of {len(instances)} instances are padding, which no policy can solve (ids from "
            f"{PADDING_IDS}); only training sets are padded"
        )


def summary(instances: InstanceSet, bounds: ContextBounds) -> list[tuple[str, float, float, float]]:
    """(name, minimum, mean, maximum) of each feature over the set, in its own units.

    Raises ConfigError if the set does not have the features of `bounds`.
    """
    if instances.names != bounds.names:
        raise ConfigError(
            f"the set's features are {_cut(', '.join(instances.names), 120)}, "
            f"the environment's are {_cut(', '.join(bounds.names), 120)}"
        )
    lowest, mean, highest = (of(instances.contexts, axis=0).tolist() for of in (np.min, np.mean, np.max))
    return list(zip(instances.names, lowest, mean, highest, strict=True))


def _check_kind_and_size(path: Path) -> None:
    """Refuse by `stat` alone what must not be opened (a FIFO would block for ever) or is too large to be meant."""
    try:
        status = path.stat()
    except FileNotFoundError:
        raise ConfigError(f"there is no such file{_meant_path(path)}") from None
    except ValueError:  # Python's answer to a NUL in the name
        raise ConfigError("this cannot be the name of a file") from None
    if stat.S_ISDIR(status.st_mode):
        raise ConfigError("is a folder, not a CSV file")
    if not stat.S_ISREG(status.st_mode):
        raise ConfigError("is not a regular file (a pipe, socket or device)")
    if status.st_size == 0:
        raise ConfigError("is empty; the first line must name the columns")
    if status.st_size > MAX_FILE_BYTES:
        raise ConfigError(f"has {status.st_size} bytes; an instance file may have at most {MAX_FILE_BYTES}")


def _meant_path(path: Path) -> str:
    """A hint at the file, or at the first folder on the way to it that is misspelt; often empty."""
    hint = missing_folder(path, _shown_path) or nearest(path.name, (file.name for file in path.parent.glob("*.csv")))
    return hint.removesuffix(".")


def _lines(file: BinaryIO, first_row: int) -> Iterator[tuple[int, bytes]]:
    """(row number, line without surrounding white space) to the end of the file; never holds more than one line."""
    for row, line in enumerate(iter(lambda: file.readline(MAX_LINE_BYTES + 1), b""), start=first_row):
        if len(line) > MAX_LINE_BYTES:
            raise ConfigError(f"row {row} is longer than {MAX_LINE_BYTES} bytes")
        yield row, line.strip()


def _split(row: int, line: bytes) -> list[bytes]:
    """The cells of a line. A name or a number contains neither comma nor quote, so quotes can only surround it."""
    if b"\r" in line:
        raise ConfigError(f"row {row} contains a bare carriage return; lines must end in \\n or \\r\\n")
    cells = line.split(b",")
    if b'"' in line:
        bare = [cell.strip() for cell in cells]
        cells = [cell[1:-1] if len(cell) > 1 and cell[:1] == cell[-1:] == b'"' else cell for cell in bare]
    return cells


def _read_header(
    file: BinaryIO, bounds: ContextBounds, further: Sequence[str], if_there: bool, named_by: str
) -> list[str]:
    """The names of the columns, as the file orders them: `id`, each feature and the further ones, once each."""
    required = ("id", *bounds.names, *(() if if_there else further))
    expected = ("id", *bounds.names, *further)
    allowed = f"allowed are {_cut(', '.join(expected), 200)}, each once, separated by commas"
    row, line = next(_lines(file, first_row=1), (1, b""))
    line = line.removeprefix(_BYTE_ORDER_MARK)
    if b"\0" in line:
        raise ConfigError("row 1 contains a NUL byte: this is not a CSV file in UTF-8")
    try:
        columns = [cell.decode().strip() for cell in _split(row, line)]
    except UnicodeDecodeError:
        raise ConfigError(f"row 1 is not UTF-8 text: {shown(line)}") from None
    if columns == [""]:
        raise ConfigError(f"row 1 is blank where the columns must be named: {allowed}")
    known, seen = set(expected), set[str]()
    asked = [name for name in required if name in further and name not in columns]
    if asked and known.difference(further) <= {*columns}:  # the file may well be right, and the name wrong
        hint = nearest(asked[0], [name for name in columns if name not in known])
        there = f"There are {_cut(', '.join(columns), 200)}"
        raise ConfigError(f"row 1: there is no column {shown(asked[0])}, which {named_by} names{hint} {there}")
    for column in columns:
        if column not in known:
            missing = sorted(known.difference(columns))
            raise ConfigError(f"row 1: unknown column {shown(column)}{_meant(column, missing)} ({allowed})")
        if column in seen:
            raise ConfigError(f"row 1: the column {shown(column)} is there twice ({allowed})")
        seen.add(column)
    for name in required:
        if name not in seen:
            raise ConfigError(f"row 1: the column {shown(name)} is missing ({allowed})")
    return columns


def _meant(column: str, missing: Sequence[str]) -> str:
    """What an unknown column may have been meant for: a clause that follows it, or nothing."""
    for separator, called in _SEPARATORS.items():
        if len({part.strip(' "').lower() for part in column.split(separator)}.intersection(missing)) > 1:
            return f": the cells of this row are separated by {called}, where commas must be"
    alike = [name for name in missing if name.lower() == column.lower()]
    return nearest(alike[0] if alike else column[:100], missing).removesuffix(".")


def _read_rows(
    file: BinaryIO, columns: Sequence[str], bounds: ContextBounds, further: Sequence[str]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """`(n,)` ids and `(n, d + k)` numbers: features in the order of `bounds`, then `further` columns.

    Instances come in the order of the file.

    Row i stands on line i + 2 of the file, because no blank line is accepted before another row.
    """
    ids, values = array("q"), array("d")
    id_position = columns.index("id")
    features = [
        (columns.index(name), low, high)
        for name, low, high in zip(bounds.names, bounds.low.tolist(), bounds.high.tolist(), strict=True)
    ]
    largest = float(np.finfo(np.float64).max)
    features += [(columns.index(name), -largest, largest) for name in further]
    for row, line in _lines(file, first_row=2):
        if not line:
            _refuse_more(file, row)
            break
        if len(ids) == MAX_INSTANCES:
            raise ConfigError(f"holds more than {MAX_INSTANCES} instances")
        cells = _split(row, line)
        if len(cells) != len(columns):
            raise ConfigError(
                f"row {row} has {len(cells)} cells where row 1 names {len(columns)} columns "
                f"({_cut(', '.join(columns), 200)}): {shown(line)}"
            )
        position = id_position
        try:
            if b"_" in line:  # Python would read 1_0 as 10
                position = next(i for i, cell in enumerate(cells) if b"_" in cell)
                raise ValueError
            identity = int(cells[id_position])
            if identity < 0:
                raise ValueError
            ids.append(identity)
            for position, low, high in features:
                value = float(cells[position])
                if not low <= value <= high:  # also false for NaN
                    raise ValueError
                values.append(value)
        except (ValueError, OverflowError):
            raise ConfigError(_cell_fault(row, columns, cells, position, bounds)) from None
    if not ids:
        raise ConfigError("has a header but no instances")
    return np.frombuffer(ids, dtype=np.int64), np.frombuffer(values, dtype=np.float64).reshape(len(ids), -1)


def _refuse_more(file: BinaryIO, blank_row: int) -> None:
    """Refuse anything but white space from here to the end of the file."""
    while chunk := file.read(MAX_LINE_BYTES):
        if chunk.strip():
            raise ConfigError(f"row {blank_row} is blank, but more rows follow; blank lines may only end the file")


def _cell_fault(row: int, columns: Sequence[str], cells: Sequence[bytes], position: int, bounds: ContextBounds) -> str:
    """Why this cell was refused, and what would not have been."""
    cell, column = cells[position].strip(), columns[position]
    if column == "id":
        what, allowed = "is not an id", f"a whole number from 0 to {MAX_ID}"
    elif column not in bounds.names:
        what, allowed = "is not a number", "any finite number"
    else:
        feature = bounds.names.index(column)
        allowed = f"a number in [{bounds.low[feature]}, {bounds.high[feature]}]"
        try:
            if b"_" in cell:
                raise ValueError
            what = "is outside the bounds" if np.isfinite(float(cell)) else "is not finite"
            least, setting = bounds.lower.get(column, (np.inf, ""))
            if least <= float(cell) < bounds.low[feature]:
                # Who reads an instance file may set it by --set, by --kwarg, or, of a run that is done, not at all.
                allowed += f", and from {least:g} in an environment made with {setting} (env.kwargs)"
        except ValueError:
            what = "is not a number"
    return f"row {row}, column {shown(column)}: {shown(cell)} {what}; allowed is {allowed}"


def _refuse_repeats(ids: NDArray[np.int64], contexts: NDArray[np.float64]) -> None:
    """Refuse an id or a context that is there twice. Rows are `(n,)` and `(n, d)` in the order of the file."""
    first, second = repeats(ids[:, np.newaxis])
    if second.size:
        raise ConfigError(
            f"row {first[0] + 2} and row {second[0] + 2}, column 'id': both are {ids[first[0]]}; each id may occur once"
        )
    first, second = repeats(contexts)
    if second.size:
        raise ConfigError(
            f"row {first[0] + 2} (id {ids[first[0]]}) and row {second[0] + 2} (id {ids[second[0]]}) "
            "hold the same context; each context may occur once"
        )


def repeats(rows: NDArray[np.generic]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(earlier, later): for each of the k rows of `(n, d)` that occurred before, where it did last, and its own index.

    Both are `(k,)`, sorted by the later.
    """
    order = np.lexsort(rows.T)  # stable: among equal rows the index ascends
    ranked = rows[order]
    equal = np.flatnonzero((ranked[1:] == ranked[:-1]).all(axis=1))
    earlier, later = order[equal], order[equal + 1]
    by_later = np.argsort(later)
    return earlier[by_later], later[by_later]


def _numbers(what: str, given: Any) -> NDArray[np.float64]:
    try:
        return np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigError(f"{what} must be numbers, as many in each row") from None


def _check_names(names: tuple[str, ...]) -> None:
    """Refuse feature names that a CSV header could not carry unquoted, or that would be confused with another."""
    if not names:
        raise ConfigError("a context needs at least one feature")
    for name in names:
        if name == "id" or name != name.strip() or not name or not name.isprintable() or set(name) & set(',"'):
            raise ConfigError(
                f"{shown(name)} cannot name a feature: names are printable, neither 'id' nor empty, "
                "without commas, double quotes or surrounding spaces"
            )
    if len(set(names)) < len(names):
        doubled = next(name for name in names if names.count(name) > 1)
        raise ConfigError(f"the feature {shown(doubled)} is named twice")


def _freeze(owner: ContextBounds | InstanceSet, **arrays: NDArray[np.generic]) -> None:
    """Set fields of a frozen dataclass to arrays that can no longer be written to."""
    for name, values in arrays.items():
        values.setflags(write=False)
        object.__setattr__(owner, name, values)


def _cut(text: str, limit: int) -> str:
    return text if len(text) <= limit else text[: limit - 1] + "…"


def shown(found: str | bytes) -> str:
    """What was found, quoted and cut short: it may be hostile, and a terminal shall not act on it."""
    found = found[:200]
    if isinstance(found, bytes):
        try:
            found = found.decode()
        except UnicodeDecodeError:
            return _cut(repr(found), 60)
    return _cut(repr(found), 60)


def _shown_path(path: Path) -> str:
    """The path as it is where that is short and printable; else quoted, and its end, which tells files apart."""
    text = str(path) if str(path).isprintable() else repr(str(path))
    return text if len(text) <= 200 else "…" + text[-199:]
