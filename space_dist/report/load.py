"""Ledgers read back: what a run was, how it went, and which runs are seeds of one configuration."""

from __future__ import annotations

import contextlib
import copy
import functools
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from space_dist import config as configs
from space_dist.errors import ConfigError, LedgerError
from space_dist.ledger import CURRICULUM, METRICS, VALUES, Ledger, Row, Status

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Split = Literal["test", "train"]

MEASURES: Final = ("return", "discounted_return", "length", "success")
_GENERATED: Final = -1  # the id of every context that was generated
_MAX_DIFFERENCE: Final = 60  # characters of the settings that a label names
SPLITS: Final[tuple[Split, ...]] = ("test", "train")


@dataclass(frozen=True, eq=False)
class Run:
    """One run as its ledger tells it. The k evaluations and the m iterations are in order of time.

    `instance_ids` `(n,)` are the training instances, ascending. `evaluation_steps` `(k,)` are real environment steps;
    `train` and `test` map each of MEASURES to `(k,)` means over the split's instances in the environment's units, NaN
    where there is no such number. `iteration_ends` `(m,)` are real environment steps, `set_sizes` `(m,)` how many
    instances each iteration was trained on. `generates_contexts`: some contexts it was trained on are not of the
    instance set (their id is -1). `all_instances_reached_at`: the real step from which the run was first trained on
    all its instances; None if it never was. `foreign`: the first iteration, counted from 1, with the ids that it was
    trained on and that no instance of its has; None where there is no such iteration.
    """

    ledger: Ledger
    config: Mapping[str, Any]
    status: Status
    instance_ids: IntArray
    evaluation_steps: IntArray
    train: Mapping[str, FloatArray]
    test: Mapping[str, FloatArray]
    iteration_ends: IntArray
    set_sizes: IntArray
    generates_contexts: bool
    all_instances_reached_at: int | None
    foreign: tuple[int, IntArray] | None = None

    def until(self, steps: int) -> Run:
        """The run as if its budget had ended with the first evaluation at or behind so many steps.

        It stays as it is where it has ended before that, and is unfinished where it was not evaluated so late. What is
        read anew from the ledger, but for `final_halves`,
        is the whole run's.
        """
        at = int(np.searchsorted(self.evaluation_steps, steps))
        if at == len(self.evaluation_steps):
            if self.finished:
                return self
            return replace(self, status=replace(self.status, state="interrupted"))
        end = int(self.evaluation_steps[at])
        complete = self.iteration_ends <= end
        reached = self.all_instances_reached_at
        return replace(
            self, status=replace(self.status, state="done", steps=end),
            evaluation_steps=self.evaluation_steps[: at + 1],
            train={name: column[: at + 1] for name, column in self.train.items()},
            test={name: column[: at + 1] for name, column in self.test.items()},
            iteration_ends=self.iteration_ends[complete], set_sizes=self.set_sizes[complete],
            all_instances_reached_at=None if reached is None or reached > end else reached,
        )  # fmt: skip

    @property
    def finished(self) -> bool:
        """Whether the run used up its budget; only then do its final numbers count."""
        return self.status.state == "done"

    @property
    def evaluated_at_end(self) -> bool:
        """Whether the run is finished and its last evaluation was of the policy it finished with."""
        return len(self.evaluation_steps) > 0 and self.status.is_final(self.evaluation_steps[-1])

    @property
    def trained(self) -> tuple[IntArray, ...]:
        """The m arrays of ids that were trained on, in order; read anew, for those of many runs fill the memory."""
        return _trained(self.ledger, _rows(self.ledger, CURRICULUM))

    @property
    def features(self) -> tuple[str, ...]:
        """Of a context, in the order of the instance files."""
        return tuple(name for name in _header(self.ledger) if name != "id")

    @property
    def instance_contexts(self) -> FloatArray | None:
        """`(n, d)` the contexts of the training instances by id, scaled from their bounds to [0, 1]; read anew.

        None where the ledger does not hold the bounds: the run was begun by an earlier version, or its set is too large
        for start values to be kept.
        """
        found = _contexts_of(_read_instances(self.ledger, "train"))
        rows = _rows(self.ledger, VALUES)[:1]
        if found is None or not rows or "low" not in rows[0]:
            return None
        with _readable(self.ledger):
            low, high = (np.array(rows[0][end], dtype=np.float64) for end in ("low", "high"))
            width = np.where(high > low, high - low, 1.0)
            return np.asarray((found[:, : len(low)] - low) / width)

    @property
    def legacy_returns(self) -> FloatArray | None:
        """`(k,)` the released code's return on the held-out instances (`evaluation.legacy_metric`); None without."""
        rows = [row for row in _rows(self.ledger, METRICS) if row.get("kind") == "evaluation"]
        with _readable(self.ledger):
            if not rows or any("legacy_return" not in row["test"] for row in rows):
                return None
            return np.array([row["test"]["legacy_return"] for row in rows], dtype=np.float64)

    def instance_returns(self, split: Split) -> FloatArray:
        """`(k, n)` each instance's mean return in each evaluation, instances by id; read anew.

        Raises LedgerError if an evaluation has none, or not as many as the others.
        """
        rows = [row for row in _rows(self.ledger, METRICS) if row.get("kind") == "evaluation"]
        with _readable(self.ledger):
            return np.array([row[split]["returns"] for row in rows], dtype=np.float64)

    def final_halves(self, split: Split) -> FloatArray | None:
        """`(2, n)` each instance's mean return over one half and the other of its last evaluation's episodes.

        Read anew. None where instances were evaluated on one episode each, or nothing was evaluated.
        """
        rows = [row for row in _rows(self.ledger, METRICS) if row.get("kind") == "evaluation"]
        rows = rows[: len(self.evaluation_steps)]  # more may have been written since, or be cut off (`until`)
        with _readable(self.ledger):
            found = rows[-1][split].get("halves") if rows else None
            return None if found is None else np.array(found, dtype=np.float64).reshape(2, -1)

    @property
    def contexts(self) -> tuple[FloatArray, ...]:
        """`(k, d)` contexts of each iteration whose contexts were generated, in environment units; read anew."""
        with _readable(self.ledger):
            rows = _rows(self.ledger, CURRICULUM)
            return tuple(np.array(row["contexts"], dtype=np.float64) for row in rows if "contexts" in row)

    @property
    def decisions(self) -> tuple[tuple[int, Mapping[str, Any]], ...]:
        """The steps of the complete iterations and what the curriculum logged at their end; read anew."""
        with _readable(self.ledger):
            return tuple((int(row["steps"]), dict(row["curriculum"])) for row in _rows(self.ledger, METRICS)
                         if row.get("kind") == "iteration" and row["curriculum"])  # fmt: skip

    def last(self, split: Split, measure: str) -> float:
        """The last evaluation's mean over the split: final, if `evaluated_at_end`.

        Raises LedgerError if nothing was evaluated yet.
        """
        if not len(self.evaluation_steps):
            raise LedgerError(f"{self.ledger.folder} holds no evaluation yet")
        return float((self.test if split == "test" else self.train)[measure][-1])

    @property
    def set_size(self) -> tuple[IntArray, IntArray]:
        """`(m,)` real steps at which each iteration began, and `(m,)` the size of the set it was trained on."""
        return _starts(self.iteration_ends), self.set_sizes


@dataclass(frozen=True, eq=False)
class Configuration:
    """Runs that differ by nothing but their seed, ordered by it. `label` is unique in the report.

    `absent` counts further seeds that are to run and have left nothing to read yet.
    """

    label: str
    runs: tuple[Run, ...]
    absent: int = 0

    @property
    def n_seeds(self) -> int:
        """All seeds, read or not."""
        return len(self.runs) + self.absent

    @property
    def finished(self) -> tuple[Run, ...]:
        """The runs whose final numbers count."""
        return tuple(run for run in self.runs if run.finished)

    @property
    def drawn(self) -> tuple[Run, ...]:
        """The evaluated runs whose curves are drawn: the finished ones; while there is none, the unfinished."""
        return tuple(run for run in self.finished or self.runs if len(run.evaluation_steps))

    def returns(self, split: Split) -> tuple[IntArray, FloatArray]:
        """`(k,)` real steps at which any drawn run was evaluated, and the `(runs, k)` mean undiscounted returns.

        Rounds that end by episodes differ in steps from seed to seed: between its evaluations, and behind its end, a
        run's last evaluation counts. Runs that have not finished are followed no further than the shortest.
        """
        if not self.drawn:
            return np.zeros(0, dtype=np.int64), np.zeros((0, 0))
        steps = functools.reduce(np.union1d, (run.evaluation_steps for run in self.drawn))
        if not self.finished:
            steps = steps[steps <= min(run.evaluation_steps[-1] for run in self.drawn)]
        steps = steps[steps >= max(run.evaluation_steps[0] for run in self.drawn)]
        curves = [
            (run.test if split == "test" else run.train)["return"][
                np.searchsorted(run.evaluation_steps, steps, side="right") - 1
            ]
            for run in self.drawn
        ]
        return steps, np.stack(curves)


def read_config(ledger: Ledger) -> dict[str, Any]:
    """A run's resolved config as plain data, so that runs of any version of the schema can be read.

    Raises LedgerError if it is missing, damaged, or not a YAML mapping.
    """
    try:
        data = copy.deepcopy(_loaded(ledger.read(ledger.config)))
    except (YAMLError, ValueError, RecursionError):
        raise LedgerError(f"{ledger.config} is damaged: it is not valid YAML") from None
    if not isinstance(data, dict):
        raise LedgerError(f"{ledger.config} is damaged: it holds no keys and values")
    return data


@functools.lru_cache(maxsize=64)
def _loaded(content: bytes) -> Any:
    return YAML(typ="safe", pure=True).load(content.decode())


def load_run(ledger: Ledger, config: Mapping[str, Any] | None = None) -> Run:
    """Everything reports need of a run, rows behind its last checkpoint included. `config`: the run's, if known.

    Raises LedgerError if the folder is damaged or incomplete; having no rows yet is neither.
    """
    status = ledger.status()  # before the rows: a run that is done now has all of them
    config = read_config(ledger) if config is None else config
    instance_ids = _instance_ids(ledger)
    evaluations = [row for row in _rows(ledger, METRICS) if row.get("kind") == "evaluation"]
    iterations = _rows(ledger, CURRICULUM)
    with _readable(ledger):
        steps = np.array([int(row["steps"]) for row in evaluations], dtype=np.int64)
        train, test = ({measure: _column(evaluations, split, measure) for measure in MEASURES}
                       for split in ("train", "test"))  # fmt: skip
        ends = np.array([int(row["steps"]) for row in iterations], dtype=np.int64)
    trained = _trained(ledger, iterations)
    return Run(
        ledger, config, status, instance_ids, steps, train, test, ends,
        set_sizes=np.array([_size(ids) for ids in trained], dtype=np.int64),
        generates_contexts=any(bool((ids < 0).any()) for ids in trained),
        all_instances_reached_at=_all_reached_at(instance_ids, _starts(ends), trained),
        foreign=_foreign(instance_ids, trained),
    )  # fmt: skip


def _trained(ledger: Ledger, iterations: Sequence[Row]) -> tuple[IntArray, ...]:
    with _readable(ledger):
        return tuple(np.array(row["trained"], dtype=np.int64) for row in iterations)


def _size(ids: IntArray) -> int:
    """Distinct instances; generated contexts, whose id is -1, count each."""
    return len(ids) if (ids < 0).any() else len(np.unique(ids))


@contextlib.contextmanager
def _readable(ledger: Ledger) -> Iterator[None]:
    try:
        yield
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise LedgerError(f"{ledger.folder} has rows that this version cannot read: {error!r}") from None


def _starts(ends: IntArray) -> IntArray:
    return np.concatenate((np.zeros(1, dtype=np.int64), ends))[:-1]


def _all_reached_at(instance_ids: IntArray, starts: IntArray, trained: Sequence[IntArray]) -> int | None:
    everything = len(instance_ids)
    for start, ids in zip(starts.tolist(), trained, strict=True):
        if len(ids) >= everything and len(np.unique(ids[ids >= 0])) == everything:
            return int(start)
    return None


def _foreign(instance_ids: IntArray, trained: Sequence[IntArray]) -> tuple[int, IntArray] | None:
    for number, ids in enumerate(trained, start=1):
        own = np.isin(ids, instance_ids) | (ids == _GENERATED)
        if not own.all():
            return number, np.unique(ids[~own])
    return None


def group(runs: Sequence[Run]) -> list[Configuration]:
    """The configurations in the order of their first run: runs of equal settings, whatever they are called.

    Where a seed is there twice, their names tell configurations apart; those of one name, the settings in which they
    differ. Raises ConfigError if a seed is there twice under one name.
    """
    group: dict[str, list[Run]] = {}
    for run in runs:
        group.setdefault(_identity(run), []).append(run)
    parts: list[tuple[str, str, list[Run]]] = []  # name, identity, runs
    for identity, alike in group.items():
        names = list(dict.fromkeys(run.status.name for run in alike))
        if len({run.status.seed for run in alike}) == len(alike):
            parts.append((" + ".join(names), identity, alike))
        else:
            parts += [(name, identity, [run for run in alike if run.status.name == name]) for name in names]
    of_name: dict[str, dict[str, Run]] = {}
    for name, identity, alike in parts:
        of_name.setdefault(name, {})[identity] = alike[0]
    told = {name: _told_apart(found) if len(found) > 1 else {} for name, found in of_name.items()}
    return [
        Configuration(f"{name} {told[name].get(identity, '')}".rstrip(), _by_seed(alike))
        for name, identity, alike in parts
    ]


def _told_apart(runs: Mapping[str, Run]) -> dict[str, str]:
    """By identity, what tells a run from the others: the settings in which they differ, as `kappa=2 eta=0.05`.

    Where that is too long, the kinds alone. The start of its identity stands behind what others have, too, as where
    instances differ. Nothing, where it merely lacks a setting that the others have.
    """
    settings = [_settings(run) for run in runs.values()]
    keys = [key for key in dict.fromkeys(key for one in settings for key in one) if _differs(key, settings)]
    kinds = [key for key in keys if key.endswith(".kind")]
    texts = _texts(settings, [*kinds, *(key for key in keys if key not in kinds)])
    if max(map(len, texts)) > _MAX_DIFFERENCE:
        texts = _texts(settings, kinds)
    shown = [text if len(text) <= _MAX_DIFFERENCE else "" for text in texts]
    return {
        identity: text if shown.count(text) == 1 else f"{text} {identity[:6]}".strip()
        for identity, text in zip(runs, shown, strict=True)
    }


def _settings(run: Run) -> dict[str, Any]:
    """What decides its results and can be read in its config, defaults included, sections taken apart."""
    try:
        config: Mapping[str, Any] = configs.parse(run.config, str(run.ledger.config)).model_dump(mode="json")
    except ConfigError:  # of another version's schema
        config = run.config
    left_out = {"seed", "instances", *configs.NOT_IDENTITY}  # instances: each run calls its own copy the same
    return dict(configs.flattened({key: value for key, value in config.items() if key not in left_out}))


def _differs(key: str, settings: Sequence[Mapping[str, Any]]) -> bool:
    """Whether a setting is another one in some; that other kinds of a section lack it says nothing but their kind."""
    kind = f"{key.partition('.')[0]}.kind"
    having = {str(one.get(kind)) for one in settings if key in one}
    lacking = {str(one.get(kind)) for one in settings if key not in one}
    return len({word(one[key]) for one in settings if key in one}) > 1 or bool(having & lacking)


def _texts(settings: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> list[str]:
    names = short_names(keys)
    return [" ".join(f"{names[key]}={word(one[key])}" for key in keys if key in one) for one in settings]


def word(value: Any) -> str:
    """A setting's value for people."""
    return configs.clean(value if isinstance(value, str) else json.dumps(value, default=str))


def short_names(keys: Sequence[str]) -> dict[str, str]:
    """Each key's last part, where that is unique."""
    ends = [key.rpartition(".")[2] for key in keys]
    return {key: configs.clean(end if ends.count(end) == 1 else key) for key, end in zip(keys, ends, strict=True)}


def _by_seed(runs: Sequence[Run]) -> tuple[Run, ...]:
    seeds: dict[int, Run] = {}
    for run in runs:
        twin = seeds.setdefault(run.status.seed, run)
        if twin is not run:
            raise ConfigError(
                f"seed {run.status.seed} of {run.status.name} is there twice: in {twin.ledger.folder} and in "
                f"{run.ledger.folder}. A seed may count once; leave one of the folders out"
            )
    return tuple(seeds[seed] for seed in sorted(seeds))


def _identity(run: Run) -> str:
    """A hash of all that decides results but the seed; instance files count by content, not by where they lay."""
    digests = [hashlib.sha256(_read_instances(run.ledger, split).encode()).hexdigest() for split in ("train", "test")]
    try:
        config = configs.parse(run.config, str(run.ledger.config))
        given = {key: run.ledger.read(run.ledger.given[key]) for key in config.given_paths}
        return configs.identity(config, *digests, given=given, with_seed=False)
    except ConfigError:  # of another version's schema: its words are compared as they stand
        data = {key: value for key, value in run.config.items() if key not in {"seed", *configs.NOT_IDENTITY}}
        data["instances"] = digests
        return hashlib.sha256(json.dumps(data, sort_keys=True, default=str).encode()).hexdigest()


def _read_instances(ledger: Ledger, split: Split) -> str:
    path = ledger.instances(split)
    try:
        return ledger.read(path).decode()
    except UnicodeDecodeError:
        raise LedgerError(f"{path} cannot be read") from None


def _instance_ids(ledger: Ledger) -> IntArray:
    ids = _ids_of(_read_instances(ledger, "train"))
    if ids is None:
        raise LedgerError(f"{ledger.instances('train')} is damaged: not every row has an id")
    return ids


@functools.lru_cache(maxsize=8)  # most runs of a report were trained on the same instances
def _ids_of(text: str) -> IntArray | None:
    """`(n,)` the ids in an instance file, ascending; None if not every row has one."""
    header, *lines = text.splitlines() or [""]
    try:
        column = [name.strip() for name in header.split(",")].index("id")
        return np.array(sorted(int(line.split(",")[column]) for line in lines if line.strip()), dtype=np.int64)
    except (ValueError, IndexError, OverflowError):
        return None


@functools.lru_cache(maxsize=8)
def _contexts_of(text: str) -> FloatArray | None:
    """`(n, d)` the columns but the id's, rows by id; None if they are not all numbers."""
    header, *lines = text.splitlines() or [""]
    names = [name.strip() for name in header.split(",")]
    try:
        table = np.array([[float(cell) for cell in line.split(",")] for line in lines if line.strip()])
        place = names.index("id")
        return np.delete(table[np.argsort(table[:, place], kind="stable")], place, axis=1)
    except (ValueError, IndexError):
        return None


def _header(ledger: Ledger) -> list[str]:
    """The columns of the training instances."""
    return [name.strip() for name in _read_instances(ledger, "train").partition("\n")[0].split(",")]


def _rows(ledger: Ledger, name: str) -> list[Row]:
    try:
        return ledger.rows(name)
    except OSError as error:
        raise LedgerError(f"{ledger.folder / name} cannot be read: {error.strerror}") from None


def _column(rows: Sequence[Row], split: str, measure: str) -> FloatArray:
    return np.array([np.nan if row[split][measure] is None else row[split][measure] for row in rows], dtype=np.float64)


def fingerprint_differences(runs: Sequence[Run]) -> dict[str, list[str]]:
    """What of code, machine and libraries differs between runs: field -> its values, sorted."""
    fields = sorted({field for run in runs for field in run.status.fingerprint})
    values = {
        field: sorted({str(run.status.fingerprint[field]) for run in runs if field in run.status.fingerprint})
        for field in fields
    }  # fmt: skip
    return {field: found for field, found in values.items() if len(found) > 1}


def state_in_words(run: Run) -> str:
    """Where a run stands, in words: `interrupted at 2,048 of 50,000 steps (SIGTERM)`."""
    status = run.status
    state: str = status.state
    if run.ledger.abandoned(status):
        state = "left behind by a process that is gone"
    reason = f" ({status.message.splitlines()[0][:200]})" if status.message else ""
    return f"{state} at {status.steps:,} of {status.budget_steps:,} steps{reason}"
