"""What all commands share: the terminal, and requests to stop.

Imported before anything heavy: one thread for all arithmetic in every process of ours, before any library reads these.
"""

from __future__ import annotations

import os

# ruff: noqa: E402 - what follows must happen before anything heavy is imported
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import contextlib
import errno
import io
import re
import select
import sys
from types import TracebackType
from typing import Any

CTRL_C = "ended by Ctrl-C"


def _end_in_a_sentence(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Of Ctrl-C while the command itself is being imported, which no handler hears yet; of all else Python's own."""
    if issubclass(kind, KeyboardInterrupt):
        os.write(2, f"space-dist: {CTRL_C}\n".encode())
    else:
        sys.__excepthook__(kind, error, trace)


sys.excepthook = _end_in_a_sentence

_READER_SECONDS = 60.0  # without reading, after which the reader of an output that does not block is taken to have left


class _Output(io.FileIO):
    """An output whose loss ends no work: once it is refused (a full disk, a reader that left), nothing more is written.

    lost: why, once that is so.
    """

    lost: OSError | None = None

    def write(self, data: Any, /) -> int:
        while self.lost is None:
            try:
                written = super().write(data)
                if written is not None:
                    return written
                self._await_room()
            except OSError as error:
                self.lost = error
        return memoryview(data).nbytes

    def _await_room(self) -> None:
        """Where the output does not block, and its reader is slow. Raises OSError for one that reads nothing more."""
        waiting = select.poll()
        waiting.register(self.fileno(), select.POLLOUT)
        if not waiting.poll(_READER_SECONDS * 1000.0):
            raise TimeoutError(errno.ETIMEDOUT, f"its reader has read nothing for {_READER_SECONDS:.0f} s")


_outputs: dict[int, _Output] = {}  # by descriptor, of this process's own


def keep_outputs() -> None:
    """Have nothing that becomes of standard output and error decide how a command ends.

    Where they are closed, their descriptors are taken: else the next file that is opened, a ledger's, would get what
    libraries print.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest that is free
    for number, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, io.TextIOWrapper(io.FileIO(number, "w", closefd=False)))
        elif stream is getattr(sys, f"__{name}__") and number not in _outputs:
            stream.flush()
            output = _outputs[number] = _Output(number, "w", closefd=False)
            at_once: bool = stream.write_through  # PYTHONUNBUFFERED
            setattr(sys, name, io.TextIOWrapper(
                output if at_once else io.BufferedWriter(output),  # as Python itself does
                encoding=stream.encoding,
                errors="replace" if stream.errors == "strict" else stream.errors,  # a terminal may lack some characters
                line_buffering=number == 2 or output.isatty(), write_through=at_once,
            ))  # fmt: skip


def output_left() -> bool:
    """Whether the reader of standard output has left, so that nobody needs more of it."""
    return 1 in _outputs and isinstance(_outputs[1].lost, BrokenPipeError)


def delivered() -> None:
    """For commands that are for their output. Raises SpaceDistError if it is lost, but not if its reader left."""
    with contextlib.suppress(AttributeError):
        sys.stdout.flush()
    lost = _outputs[1].lost if 1 in _outputs else None
    if lost is not None and not output_left():
        raise SpaceDistError(f"standard output cannot be written: {lost.strerror}")


from space_dist.system.interrupts import StopRequests


def _told_at_once(sentence: str) -> None:
    """To standard error, from within a signal's handler: nothing that is buffered may be touched, nor may it wait."""
    with contextlib.suppress(OSError, ValueError):
        if select.select([], [2], [], 0)[1]:
            # A progress bar hides the cursor, and what ends at once does not get to show it again.
            cursor = "\x1b[?25h" if os.isatty(2) else ""
            os.write(2, f"{cursor}space-dist: {sentence}\n".encode())


STOP = StopRequests(tell=_told_at_once)

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Optional

import typer
from rich.console import Console

from space_dist.errors import ConfigError, SpaceDistError, nearest
from space_dist.system.findings import Findings

console = Console(emoji=False)  # else `mine:b: ` becomes a picture
errors = Console(stderr=True, emoji=False)

Overrides = Annotated[
    Optional[list[str]],  # noqa: UP045 - typer reads annotations at run time
    typer.Option("--set", metavar="KEY=VALUE", help="Override a config key, e.g. budget.steps=20000. Repeatable."),
]

Changes = Annotated[
    Optional[list[str]],  # noqa: UP045 - typer reads annotations at run time
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Of a YAML file: a config key of every cell, like instances.train=mine.csv, in a folder of its own, "
        "NAME-set-DIGEST. Repeatable.",
    ),
]

Kwargs = Annotated[
    Optional[list[str]],  # noqa: UP045 - typer reads annotations at run time
    typer.Option(
        "--kwarg", metavar="NAME=VALUE", help="An argument of what is imported (kwargs in a config). Repeatable."
    ),
]

_SETTING = re.compile(r"[A-Za-z_][\w.]*=")  # a path before the `=` has a slash, or is a file's

Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def say(text: str) -> None:
    """Print a line as it is: no markup, no colours, no breaks."""
    console.print(text, highlight=False, markup=False, soft_wrap=True)


def warn(text: str) -> None:
    """The same, on standard error."""
    errors.print(text, highlight=False, markup=False, soft_wrap=True)


def tell_findings(findings: Findings, checked: str) -> None:
    """Say what a check of `checked` noted. Raises ConfigError with its faults, a line each, if it found any."""
    for note in findings.notes:
        say(f"note: {note}")
    if findings.faults:
        raise ConfigError("\n".join(one if checked in one else f"{checked}: {one}" for one in findings.faults))


def spread(arguments: Sequence[str]) -> list[str]:
    """A command's arguments, with `--set` before each of several settings behind one: `--set a=1 b=2`, as one types.

    Raises ConfigError for `--set a 1`, of which the option would take the first word alone.
    """
    spread_out: list[str] = []
    option = None  # the one whose settings these are, once its first has been seen
    for before, argument, after in zip(["", *arguments], arguments, [*arguments[1:], "-"], strict=False):
        if before in ("--set", "--kwarg"):
            option = before
            bare = "=" not in argument + after and not argument.startswith("-") and not after.startswith("-")
            if bare and not Path(after).exists():
                meant = f"{before} {argument}={after}"
                raise ConfigError(f"{before} {argument} {after}: write it as one word, with `=`: {meant}")
        elif not (_SETTING.match(argument) and not Path(argument).exists()):
            option = None
        elif option is not None:
            spread_out.append(option)
        spread_out.append(argument)
    return spread_out


def write(path: Path, text: str) -> None:
    """Write a file a user asked for. Raises ConfigError where that cannot be."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from None


def one_of(allowed: Sequence[str], text: str, option: str) -> str:
    """`text`, which an option was given. Raises ConfigError if it is not allowed."""
    if text not in allowed:
        raise ConfigError(f"{option} {text!r} is not known{nearest(text, allowed)} Allowed: {', '.join(allowed)}")
    return text


def parse_kwargs(given: list[str] | None) -> dict[str, Any]:
    """`NAME=VALUE` as YAML reads the value. Raises ConfigError for anything else."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    kwargs: dict[str, Any] = {}
    for one in given or []:
        name, equals, value = one.partition("=")
        if not equals or not name.isidentifier():
            raise ConfigError(f"--kwarg {one!r} is not NAME=VALUE")
        if name in kwargs:
            raise ConfigError(f"--kwarg {one!r}: {name} is given twice, as {kwargs[name]!r} before; leave one out")
        try:
            kwargs[name] = YAML(typ="safe", pure=True).load(value)
        except YAMLError:
            kwargs[name] = None
        if not isinstance(kwargs[name], bool | int | float | str):
            raise ConfigError(f"--kwarg {one!r}: the value must be a number, a word, true or false")
    return kwargs


def one_run(folder: Path) -> Path:
    """Of an argument: refuse what holds no run, or several, before any option that the command lacks is told."""
    from space_dist.ledger import Ledger, there

    Ledger(there(folder)).status()
    return folder
