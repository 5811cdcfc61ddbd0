"""Why an attempt ended: the table in docs/grids.md, "When a run ends badly", read from there and decided row by row."""

from __future__ import annotations

import ast
import dataclasses
import json
import os
import re
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest

from space_dist import errors
from space_dist.experiment import endings
from space_dist.experiment.endings import Busy, Cause, Ended, Evidence, Said, why_ended
from space_dist.experiment.grid_file import Retry
from space_dist.experiment.status import may_retry
from space_dist.grid import supervisor
from tests.grids import ROOT

DONE, ELSEWHERE = "none: it is done", "none: another process works on it"


class Row(NamedTuple):
    """A row of the table; a cell that is empty there has the content of the one above it."""

    cause: str
    seen: str
    on_record: str
    retried: str


def table() -> list[Row]:
    _, _, section = (ROOT / "docs/grids.md").read_text().partition("\n## When a run ends badly\n")
    lines = [line for line in section.partition("\n## ")[0].splitlines() if line.startswith("|")]
    assert lines[0] == "| cause | what was seen | on record | tried again |"
    rows: list[Row] = []
    for line in lines[2:]:
        cause, seen, on_record, retried = (cell.strip() for cell in line.strip("|").split("|"))
        rows.append(Row(cause or rows[-1].cause, seen, on_record, retried or ("" if cause else rows[-1].retried)))
    return rows


ROWS = table()


def _said(name: str, message: str) -> Said:
    return Said(getattr(errors, name, errors.SpaceDistError).exit_code, name, message)


FACTS: dict[str, Callable[..., dict[str, Any]]] = {
    r"the run says (\w+): `([^`]+)`": lambda name, message: {"said": _said(name, message)},
    r"the run says that it is done": lambda: {"said": Said.of(None)},
    r"its ledger says so, too": lambda: {"done": True},
    r"its ledger does not": lambda: {"done": False},
    r"its ledger cannot be read: `([^`]+)`": lambda why: {"damage": why},
    r"another process owns its ledger": lambda: {"held": True},
    r"its process printed `([^`]+)`": lambda line: {"output": (line,)},
    r"its process ended with exit code (\d+)": lambda code: {"code": int(code)},
    r"its process ended by (SIG\w+)": lambda name: {"code": -signal.Signals[name]},
    r"meanwhile the kernel killed a process there for want of memory": lambda: {"oom_killed": True},
    r"its user asked it to stop": lambda: {"asked_by": "user"},
    r"somebody else asked it to stop": lambda: {"asked_by": "others"},
    r"it took longer than `resources.minutes`, (\d+), and was asked to checkpoint first": (
        lambda minutes: {"over_minutes": float(minutes)}
    ),
    r"its processes together used (\d+) MB \(RSS\); `resources.memory_mb` is (\d+)": (
        lambda used, limit: {"over_memory": (int(used), int(limit))}
    ),
    r"it was stopped \(SIGSTOP\) for (\d+) s": lambda seconds: {"halted_seconds": float(seconds)},
    r"(\d+) runs shared its process": lambda runs: {"runs": int(runs)},
    r"the grid's folder has a file `stop`": lambda: {"stop_file": True},
    r"it has rollout actors": lambda: {"has_actors": True},
    r"its Ray answers": lambda: {"ray_answers": True},
    r"its Ray does not answer": lambda: {"ray_answers": False},
    r"its (supervisor|worker) is gone": lambda part: {"gone": part},
    r"its supervisor is gone, with exit code (\d+)": lambda code: {"gone": "supervisor", "gone_code": int(code)},
    r"the worker's node, too": lambda: {"node_alive": False},
    r"all processes there were asked to end by (SIG\w+)": lambda name: {"all_asked": name},
    r"Ray says of its job: `([^`]+)`": lambda message: {"job": message},
    r"Ray does not know its job": lambda: {"job": ""},
    r"Ray calls its job a success": lambda: {"job_succeeded": True},
    r"SLURM requeued its job": lambda: {"requeued": True},
    r"its supervisor, on `([^`]+)`, is gone": lambda host: {"began_on": host},
    r"nobody recorded an end": dict,
}
"""What the table's words mean as evidence."""


def facts(text: str) -> list[tuple[str, dict[str, Any]]]:
    """Each fact of a row, by the pattern that it matches."""
    found = []
    while text:
        for pattern, meaning in FACTS.items():
            if match := re.match(rf"{pattern}(?:; |$)", text):
                found.append((pattern, meaning(*match.groups())))
                text = text[match.end() :]
                break
        else:
            pytest.fail(f"the table says what no fact is: {text!r}")
    return found


def evidence(row: Row) -> Evidence:
    return Evidence(**{key: value for _, meaning in facts(row.seen) for key, value in meaning.items()})


@pytest.mark.parametrize("row", ROWS, ids=[f"{row.cause}: {row.seen}" for row in ROWS])
def test_every_row_of_the_table_is_what_is_decided(row: Row) -> None:
    ended = why_ended(evidence(row))
    if row.cause == ELSEWHERE:
        assert isinstance(ended, Busy)
        assert (ended.cause, row.on_record.partition(":")[0]) == (None, "nothing")
        return
    words = "\n".join(re.findall("`(.+?)`", row.on_record))
    assert bool(words) != row.on_record.startswith("nothing")
    cause = None if row.cause == DONE else next(one for one in Cause if one.in_words == row.cause)
    assert ended.on_record == Ended(cause, words)


def test_the_table_has_every_cause_and_every_kind_of_evidence() -> None:
    assert {row.cause for row in ROWS} == {DONE, ELSEWHERE, *(cause.in_words for cause in Cause)}
    named = [fact for row in ROWS for fact in facts(row.seen)]
    assert {pattern for pattern, _ in named} == set(FACTS)
    assert {key for _, meaning in named for key in meaning} == {field.name for field in dataclasses.fields(Evidence)}
    assert len({evidence(row) for row in ROWS}) == len(ROWS)


def test_every_line_that_decides_has_a_row() -> None:
    source = Path(endings.__file__)
    deciding = ast.parse(source.read_text()).body
    first = next(one.lineno for one in deciding if isinstance(one, ast.FunctionDef) and one.name == "why_ended")
    returns = {node.lineno for one in deciding for node in ast.walk(one)
               if isinstance(node, ast.Return) and node.lineno > first}  # fmt: skip
    reached: set[int] = set()

    def trace(frame: Any, event: str, _: Any) -> Any:
        if frame.f_code.co_filename != str(source):
            return None
        if event == "line":
            reached.add(frame.f_lineno)
        return trace

    cases, before = [evidence(row) for row in ROWS], sys.gettrace()
    sys.settrace(trace)
    try:
        for case in cases:
            why_ended(case)
    finally:
        sys.settrace(before)
    assert len(returns) > 20
    assert returns - reached == set()


def test_no_more_than_the_last_lines_of_an_output_are_told() -> None:
    lines = tuple(f"line {number}" for number in range(9))
    told = why_ended(Evidence(code=-signal.SIGSEGV, output=lines)).detail.splitlines()
    assert told == list(lines[-6:])
    few = why_ended(Evidence(code=-signal.SIGSEGV, output=lines[:5])).detail.splitlines()
    assert few == ["ended by SIGSEGV", *lines[:5]]
    assert why_ended(Evidence(code=-signal.SIGKILL, output=lines)).detail == "SIGKILL"


@pytest.mark.parametrize("cause", Cause)
def test_attempts_are_repeated_as_often_as_the_table_says(cause: Cause) -> None:
    (retried,) = {row.retried for row in ROWS if row.cause == cause.in_words}
    if retried == "always":
        assert may_retry(cause, {cause: 10**6}, Retry())
        return
    most = 0 if retried == "never" else int(retried.removesuffix(" times"))
    assert may_retry(cause, {cause: most}, Retry())
    assert not may_retry(cause, {cause: most + 1}, Retry())
    most_generous = Retry(**dict.fromkeys(Retry.model_fields, 10**6))
    assert may_retry(cause, {cause: most + 1}, most_generous) == (retried != "never")


def test_a_signal_without_a_name_is_told_by_its_number() -> None:
    assert why_ended(Evidence(code=-40)) == Ended(Cause.CRASH, "ended by signal 40")


def test_a_run_tells_its_reason_though_its_output_cannot_be_written(tmp_path: Path) -> None:
    """As on a full disk, which may be the reason."""
    reading, writing = os.pipe()
    run: Any = SimpleNamespace(key="cell/s0")
    pid = os.fork()
    if not pid:
        code = 99
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
            reason = errors.LedgerError("the disk is full")
            code = supervisor._child_main(lambda tell: tell(run, reason), tmp_path / "output.txt", writing)
        finally:
            os._exit(code)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        told = [json.loads(line) for line in pipe]
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == errors.LedgerError.exit_code
    assert [(one["run"], one["error"], one["message"]) for one in told] == [
        ("cell/s0", "LedgerError", "the disk is full")
    ]
