"""Why an attempt of a run ended: from all that was seen of it to one cause, and its words.

Whoever starts, watches or misses a process gathers an `Evidence` and asks `why_ended`; nobody else decides. What it
decides is the table in docs/grids.md, "When a run ends badly", which tests/test_endings.py reads and has it decide.
"""

from __future__ import annotations

import signal
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from space_dist.errors import ConfigError, Interrupted, RunLockedError, SpaceDistError, UnreadableError

_ELSEWHERE = "another process is working on it"
_LINES = 6  # of what is told of a crash: its words, and what its process printed last
_JOB_CHARACTERS = 500  # of what Ray says of a job
_NODE_WORDS = ("node", "head", "unexpected", "supervisor actor")  # in what Ray says of a job that it lost with its node


class Cause(StrEnum):
    """Why an attempt ended before its run was done."""

    CONFIG_ERROR = "config_error"
    OUT_OF_MEMORY = "out_of_memory"
    PREEMPTED = "preempted"
    NODE_LOST = "node_lost"
    TIMEOUT = "timeout"
    CRASH = "crash"
    UNREADABLE = "unreadable"  # files of its folder, by whatever hand: no attempt of it can mend that
    KILLED = "killed"
    STOPPED = "stopped"  # on the user's own request; not a failure

    @property
    def in_words(self) -> str:
        """For people."""
        return _WORDS[self]


_WORDS = {
    Cause.CONFIG_ERROR: "config error",
    Cause.OUT_OF_MEMORY: "out of memory",
    Cause.PREEMPTED: "preempted",
    Cause.NODE_LOST: "node lost",
    Cause.TIMEOUT: "timeout",
    Cause.CRASH: "crash",
    Cause.UNREADABLE: "unreadable",
    Cause.KILLED: "killed by an unknown hand",
    Cause.STOPPED: "stopped",
}


@dataclass(frozen=True)
class Ended:
    """How an attempt ended. cause: None where its run is done. detail: one or more lines for people."""

    cause: Cause | None
    detail: str = ""

    @property
    def on_record(self) -> Ended:
        """What `attempts.jsonl` keeps of an attempt that had begun."""
        return self


@dataclass(frozen=True)
class Busy(Ended):
    """The attempt was none: another process is working on the run."""

    @property
    def on_record(self) -> Ended:
        """See `Ended`."""
        return Ended(Cause.STOPPED, _ELSEWHERE)


@dataclass(frozen=True)
class Said:
    """A run's own word on its end. code: the exit code that goes with it. error: its class's name, empty if none."""

    code: int
    error: str = ""
    message: str = ""

    @classmethod
    def of(cls, error: SpaceDistError | None) -> Said:
        """What it has to say of this error; None where the run is done."""
        if error is None:
            return cls(0)
        kind = MemoryError if isinstance(error.__cause__, MemoryError) else type(error)
        return cls(error.exit_code, kind.__name__, str(error))


AskedBy = Literal["user", "others"]
"""Who wants a run to end early: its user, through the grid, or anybody else, by a signal or by leaving it alone."""


@dataclass(frozen=True)
class Evidence:
    """What was seen of an attempt that is over. Nobody sees all of it: what was not looked at stays at its default.

    The run's folder. done: its ledger says so. damage: why it cannot be read; empty if it can. held: another process
    owns its lock.
    The run. said: its last word; None if it left without one. output: the last lines that its process printed.
    Its process. code: the exit code, or minus the number of the signal that ended it; None where nobody saw it end.
    oom_killed: meanwhile the kernel killed a process of its control group for want of memory.
    Its supervisor, of what it ended the process for. asked_by: whose request it passed on. over_minutes: the time, in
    minutes, that it took longer than. over_memory: what it used and `memory_mb`, both in MB. halted_seconds: how long
    it was stopped (SIGSTOP). runs: how many shared the process. stop_file: the grid's folder has a file `stop`.
    Ray. has_actors: the run has some. ray_answers: the Ray that it joined does. gone: which process above the run is
    missing. gone_code: its exit code, where that was seen. node_alive: that of the pool's worker is. all_asked: by what
    all processes were asked to end; empty if they were not. job: what Ray says of a job that has ended; None if there
    was none. job_succeeded: Ray says so.
    SLURM. requeued: it has begun its job anew since.
    began_on: the host of a supervisor that is gone; empty if that was not looked up.
    """

    done: bool = False
    damage: str = ""
    held: bool = False
    said: Said | None = None
    output: tuple[str, ...] = ()
    code: int | None = None
    oom_killed: bool = False
    asked_by: AskedBy | None = None
    over_minutes: float | None = None
    over_memory: tuple[int, int] | None = None
    halted_seconds: float | None = None
    runs: int = 1
    stop_file: bool = False
    has_actors: bool = False
    ray_answers: bool = True
    gone: Literal["supervisor", "worker"] | None = None
    gone_code: int | None = None
    node_alive: bool = True
    all_asked: str = ""
    job: str | None = None
    job_succeeded: bool = False
    requeued: bool = False
    began_on: str = ""


def why_ended(seen: Evidence) -> Ended:
    """How an attempt ended: `Ended(None)` if its run is done, `Busy` if it never was its own, else with its cause.

    Pure. A run that knows why it ends is believed before anybody who wanted it to end as well; one that was merely
    interrupted, or said nothing, may not know.
    """
    said, code = seen.said, seen.code if seen.said is None else seen.said.code
    if seen.done:
        return Ended(None)
    if said is not None and said.error == RunLockedError.__name__:
        return Busy(None, said.message)
    if seen.held or seen.job_succeeded:
        return Busy(None, _ELSEWHERE)
    if seen.damage:
        return Ended(Cause.UNREADABLE, seen.damage)
    if code is None:
        return _not_seen_to_end(seen)
    knows = said is not None and code != Interrupted.exit_code
    return (None if knows else _ended_by_others(seen)) or _ended_by_itself(seen, code)


def _ended_by_others(seen: Evidence) -> Ended | None:
    """By its supervisor, which had its reasons, or by Ray's library in its process."""
    each = f" for each of {seen.runs} runs" if seen.runs > 1 else ""
    if seen.asked_by == "user":
        return Ended(Cause.STOPPED)
    if seen.asked_by == "others":
        return Ended(Cause.PREEMPTED)
    if seen.over_minutes is not None:
        return Ended(Cause.TIMEOUT, f"it took longer than {seen.over_minutes:g} minutes{each}")
    if seen.over_memory is not None:
        used, limit = seen.over_memory
        each = each and f",{each}"
        return Ended(Cause.OUT_OF_MEMORY, f"its processes used {used} MB; memory_mb is {limit}{each}")
    if seen.halted_seconds is not None:
        return Ended(Cause.KILLED, f"it was stopped by a signal (SIGSTOP) for {seen.halted_seconds:.0f} s")
    # Where the Ray of its node is gone, Ray ends a process at once: with 1 and no word to it, or by SIGABRT.
    silent, aborted = seen.code == 1 and seen.said is None, seen.code == -signal.SIGABRT and not seen.ray_answers
    if seen.has_actors and (silent or aborted):
        return Ended(Cause.NODE_LOST, "Ray on its node is gone, and the run with it")
    return None


def _name_of(number: int) -> str:
    """A signal's; most real-time ones have none."""
    known = {one.value: one.name for one in signal.Signals}
    return known.get(number, f"signal {number}")


def _ended_by_itself(seen: Evidence, code: int) -> Ended:
    """By the exit code that the run gave for itself, or by its process's if it has said nothing."""
    error, message = ("", "") if seen.said is None else (seen.said.error, seen.said.message)
    if code == Interrupted.exit_code and seen.stop_file:
        return Ended(Cause.STOPPED, message)
    if code == Interrupted.exit_code:
        return Ended(Cause.PREEMPTED, message)
    if code == ConfigError.exit_code:
        return _with_output(Cause.CONFIG_ERROR, message, seen)
    if error == UnreadableError.__name__:
        return Ended(Cause.UNREADABLE, message)
    if error == MemoryError.__name__ or (code == -signal.SIGKILL and seen.oom_killed):
        return Ended(Cause.OUT_OF_MEMORY, message or "the system had no memory left, and killed it")
    if code == -signal.SIGKILL:
        return Ended(Cause.KILLED, "SIGKILL")
    if code < 0:
        return _with_output(Cause.CRASH, f"ended by {_name_of(-code)}", seen)
    if code == 0 and seen.said is not None:
        return _with_output(Cause.CRASH, "it said that it was done, and is not", seen)
    return _with_output(Cause.CRASH, message or f"its process ended with exit code {code} and without a word", seen)


def _with_output(cause: Cause, words: str, seen: Evidence) -> Ended:
    return Ended(cause, "\n".join([*filter(None, [words]), *seen.output][-_LINES:]))


def _not_seen_to_end(seen: Evidence) -> Ended:
    """Of an attempt that whoever watched it can tell nothing more of."""
    if seen.gone is not None and not seen.node_alive:
        return Ended(Cause.NODE_LOST, f"the node of its {seen.gone} is gone")
    if seen.gone is not None and seen.all_asked:
        # A batch system that ends a job signals all its processes, and so us, too: that is nobody's failure.
        return Ended(Cause.PREEMPTED, f"all processes were asked to end ({seen.all_asked})")
    if seen.gone is not None and (seen.gone_code or 0) > 0:  # by itself, and before it could begin the run
        return Ended(
            Cause.CRASH, f"its {seen.gone} ended with exit code {seen.gone_code}: pool.log of the grid says why"
        )
    if seen.gone is not None:
        return Ended(Cause.KILLED, f"its {seen.gone} was killed")
    if seen.job is not None:
        words = seen.job or "its job is gone"
        line = words.splitlines()[0][:_JOB_CHARACTERS]
        if any(word in words.lower() for word in _NODE_WORDS):
            return Ended(Cause.NODE_LOST, line)
        return Ended(Cause.KILLED, line)
    if seen.requeued:
        return Ended(Cause.PREEMPTED, "SLURM requeued its job")
    if seen.began_on:
        return Ended(Cause.KILLED, f"it began on {seen.began_on} and was not heard of again")
    return Ended(Cause.KILLED, "not heard of again")
