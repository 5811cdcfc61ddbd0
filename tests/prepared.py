"""Real processes to be signalled and killed, without the seconds that a new interpreter takes to import torch.

They are forked from a server that has imported what a run needs. Each is a process of its own all the same: with its
own number, main thread, signal handlers, locks and exit code.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["space_dist.cli.runs", "space_dist.run.launch", "stable_baselines3"])
_ROOT = Path(__file__).resolve().parent.parent


def command(arguments: list[object], output: Path, before: Callable[[], None] | None = None) -> BaseProcess:
    """`space-dist ARGUMENTS` in the repository's folder; what it says is appended to the file `output`.

    before: a function of a module, called in the new process first.
    """
    return _started(_command, [str(argument) for argument in arguments], str(output), dict(os.environ), before)


def slow_run(config: Path, folder: Path, seconds: float) -> BaseProcess:
    """A run that goes on, or starts, in `folder`, and rests so long after each round."""
    return _started(_slow_run, str(config), str(folder), seconds)


def _started(target: Any, *arguments: Any) -> BaseProcess:
    process = _CONTEXT.Process(target=target, args=arguments)
    process.start()
    return process


def _command(arguments: list[str], output: str, environment: dict[str, str], before: Callable[[], None] | None) -> None:
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(_ROOT)
    descriptor = os.open(output, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    for standard in (1, 2):
        os.dup2(descriptor, standard)
    from space_dist import cli

    if before is not None:
        before()
    sys.argv = ["space-dist", *arguments]
    cli.main()


def _slow_run(config: str, folder: str, seconds: float) -> None:
    from space_dist import config as configs
    from space_dist.run.launch import launch
    from space_dist.system.interrupts import StopRequests

    chosen = configs.load(Path(config))
    launch(chosen, Path(folder), resume=True, stop=StopRequests(), observe=lambda _: time.sleep(seconds))
