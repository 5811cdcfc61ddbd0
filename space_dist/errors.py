"""What can go wrong, as a user sees it. Each class knows the exit code of the command it ends."""

from __future__ import annotations

import contextlib
import difflib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Final

CONTINUES: Final = "the same command goes on, `train` with --resume (from Python: resume=True)"
_NAMED = 3  # folders that a sentence names; the rest are counted
_SECTION_AND_KEY: Final = re.compile(r"[a-z]\w*(?:\.\w+)+")
_SECTION: Final = re.compile(r"(?<![\w.])[a-z]\w*(?=:| = )")


class SpaceDistError(Exception):
    """Base of every error this package raises on purpose; its text is meant for the user as it stands."""

    exit_code = 1


class ConfigError(SpaceDistError):
    """Something the user wrote (config, CSV, command line) cannot be used. Retrying cannot help."""

    exit_code = 2


class LedgerError(SpaceDistError):
    """A run's folder is damaged, incomplete, or belongs to another configuration."""


class UnreadableError(LedgerError):
    """A run cannot go on, for none of its checkpoints is as it was written."""


class NotPlannedError(LedgerError):
    """The run, grid or search that a user names was never begun there: another name, command, or root, is meant."""

    exit_code = 2  # 1 would say that runs of it have failed


class RunLockedError(SpaceDistError):
    """Another process owns the run."""


class Interrupted(SpaceDistError):  # noqa: N818 - an interruption is an outcome, not an error
    """The run was asked to stop and wrote a checkpoint: `--resume` continues it."""

    exit_code = 75  # EX_TEMPFAIL of sysexits.h: what batch systems take for "requeue me"


@contextlib.contextmanager
def exits_refused() -> Iterator[None]:
    """Around a user's code: have a `sys.exit` in it be an error, for it would end our process as if all were well."""
    try:
        yield
    except SystemExit as error:
        raise SpaceDistError(
            f"the environment, or something that it uses, tried to end the process (SystemExit: {error.code})"
        ) from error


def nearest(word: str, allowed: Iterable[str]) -> str:
    """`"; did you mean 'eta'?"`, of what in `allowed` begins with or resembles `word`; else `"."`: a clause's end."""
    names = list(allowed)
    close = [name for name in names if word and name.startswith(f"{word}_")]  # cpus: cpus_per_task rather than gpus
    close = close or difflib.get_close_matches(word, names, n=1, cutoff=0.5)
    return f"; did you mean {close[0]!r}?" if close else "."


def nearest_label(word: str, labels: Sequence[str]) -> str:
    """The same of labels of several words, whose beginning alone, or one of the words, may be meant, in any case."""
    if (whole := nearest(word, labels)) != ".":
        return whole
    parts: dict[str, str] = {}
    for label in labels:
        for part in (label[: len(word)], *re.split(r"[\s_=]+", label)):
            parts.setdefault(part.casefold(), label)
    close = difflib.get_close_matches(word.casefold(), parts, n=1, cutoff=0.6)
    return f"; did you mean {parts[close[0]]!r}?" if close else "."


def missing_folder(path: Path, shown: Callable[[Path], str] = str) -> str:
    """`; there is no folder docs/resluts; did you mean 'results'?` of a path that does not exist: the first folder on
    the way to it that is not there, and the nearest one beside that. Empty where only its last part is missing.
    """
    missing = path
    while not missing.parent.exists() and missing.parent != missing:
        missing = missing.parent
    if missing == path:
        return ""
    beside = sorted(other.name for other in missing.parent.glob("*/"))
    return f"; there is no folder {shown(missing)}{nearest(missing.name, beside)}"


def misspelt(word: str, allowed: Iterable[str]) -> str:
    """The same where `word` may be right and stand in the wrong place: of what it differs from by a letter or so."""
    close = difflib.get_close_matches(word, list(allowed), n=1, cutoff=0.82)
    return f"; did you mean {close[0]!r}?" if close else "."


def counted(number: int, what: str) -> str:
    """`1 run`, `2,000 runs`."""
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def below(folders: Sequence[Path]) -> str:
    """Which of these to name instead of a folder that is none of their kind itself, behind that it is not."""
    if len(folders) < 2:
        return "".join(f"; {folder} does" for folder in folders)
    more = f" and {len(folders) - _NAMED:,} more" if len(folders) > _NAMED else ""
    named = ", ".join(map(str, folders[:_NAMED]))
    return f"; {len(folders):,} folders below it do, of which one is to be named: {named}{more}"


@contextlib.contextmanager
def about(where: str, changes: Mapping[str, str] = MappingProxyType({})) -> Iterator[None]:
    """Say where a fault lies: the file or key goes before its sentence, unless it is there already.

    changes: see `with_changes`.
    """
    try:
        yield
    except ConfigError as error:
        text = str(error)
        there = text.startswith((where, "--set "))
        raise ConfigError(text if there else f"{with_changes(where, text, changes)}: {text}") from error


def with_changes(where: str, sentence: str, changes: Mapping[str, str]) -> str:
    """`FILE with --set learner.n_steps=1000`: a file, and those changes made to it that the sentence speaks of.

    changes: by key (of a section, or of something in one), how each was told. It is found by its key, or its value.
    """
    sections, keys = _SECTION.findall(sentence), _SECTION_AND_KEY.findall(sentence)
    named = [
        told for change, told in changes.items()
        if change in sections or any(f"{key}.".startswith(f"{change}.") or change.startswith(f"{key}.") for key in keys)
        or ((word := _value(told)) and (f"'{word}'" in sentence or ("." in word and f"/{word}" in sentence)))
    ]  # fmt: skip
    return " with ".join([where, " ".join(dict.fromkeys(named))]) if named else where


def _value(told: str) -> str:
    """The value of `--set a.b=c`; of a path, its last part."""
    return told.partition("=")[2].rpartition("/")[2]
