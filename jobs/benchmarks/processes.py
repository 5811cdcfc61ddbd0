"""Processes of a rehearsal: which are its own, what they are, and whether a signal has reached them."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterator, Sequence
from typing import Any

import psutil

MARK = "SPACE_DIST_CHAOS"  # in the environment of every process that belongs to one rehearsal

_END_SECONDS = 5.0  # for what is asked to end


def completed(words: Sequence[str], **how: Any) -> subprocess.CompletedProcess[str]:
    """As `subprocess.run`, with output as text; where we are to end meanwhile, all that it has started ends, too."""
    with all_ended():
        running = subprocess.Popen(words, text=True, start_new_session=True, **how)
        output, errors = running.communicate()
    return subprocess.CompletedProcess(words, running.returncode, output, errors)


@contextlib.contextmanager
def all_ended() -> Iterator[None]:
    """Children that this block starts, and theirs, end with it at the latest.

    Start them in sessions of their own: Ctrl-C must reach us alone, for a child that it ended first could leave what it
    has started. A signal may also come before `Popen` has returned: so we look for who is there, and need no `Popen`.
    """
    us = psutil.Process()
    before = us.children()
    try:
        yield
    finally:
        if children := [child for child in us.children() if child not in before]:
            everybody = [*children, *(one for child in children for one in _descendants(child))]
            for child in children:
                with contextlib.suppress(psutil.NoSuchProcess):
                    child.terminate()  # a grid has its runs end
            psutil.wait_procs(everybody, timeout=_END_SECONDS)
            everybody += [one for parent in everybody for one in _descendants(parent)]
            for process in everybody:
                with contextlib.suppress(psutil.NoSuchProcess):
                    process.kill()
            psutil.wait_procs(everybody, timeout=_END_SECONDS)


def _descendants(process: psutil.Process) -> list[psutil.Process]:
    with contextlib.suppress(psutil.NoSuchProcess):
        return process.children(recursive=True)
    return []


def is_named(process: psutil.Process, word: str) -> bool:
    """Whether its command line has this in it."""
    with contextlib.suppress(psutil.Error):
        return any(word in part for part in process.cmdline())
    return False


def is_live(process: psutil.Process) -> bool:
    """Whether it is there, and no zombie."""
    with contextlib.suppress(psutil.Error):
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    return False


def is_hit(process: psutil.Process, verb: str) -> bool:
    """Whether it is gone (kill), or stands still (stop)."""
    if verb == "kill":
        return not is_live(process)
    with contextlib.suppress(psutil.Error):
        return process.status() == psutil.STATUS_STOPPED
    return False


def marked(mark: str) -> list[psutil.Process]:
    """Every process of a rehearsal: an environment is inherited by whatever is started, on whatever detour."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            if process.status() != psutil.STATUS_ZOMBIE and process.environ().get(MARK) == mark:
                found.append(process)
    return found


def left_of_ours(mark: str) -> str:
    """Processes of ours, or that work for us, in words; Ray's own, its idle workers and MLflow's are not."""
    ours = ("-m space_dist", "ray::RolloutActor", "ray::CurriculumActor", "ray::PoolWorker")
    lines = map(in_words, marked(mark))
    return "; ".join(line for line in lines if any(word in line for word in ours))


def in_words(process: psutil.Process) -> str:
    """Its number, and how its command line begins."""
    with contextlib.suppress(psutil.Error):
        return f"{process.pid} {' '.join(process.cmdline())[:150]}"
    return f"{process.pid}"
