"""From a config to a finished run: instances, folder, lock, cluster, training, and what is left behind if it fails."""

from __future__ import annotations

import contextlib
import contextvars
import io
import json
import logging
import os
import sys
import sysconfig
import time
import traceback
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn

import numpy as np
from threadpoolctl import threadpool_limits

from space_dist import arithmetic
from space_dist.config import RunConfig
from space_dist.envs.spec import EnvironmentSpec
from space_dist.errors import (
    CONTINUES,
    ConfigError,
    Interrupted,
    LedgerError,
    RunLockedError,
    SpaceDistError,
    counted,
    exits_refused,
)
from space_dist.ledger import (
    Ledger,
    RunWriter,
    State,
    Status,
)
from space_dist.rollout import Setup
from space_dist.rollout.policy import Policy, Several, from_arrays
from space_dist.run.building import Blueprint
from space_dist.run.claiming import already_there, claim, is_stillborn, stored_config
from space_dist.run.cluster import Cluster, InProcess, n_workers
from space_dist.run.training import Progress, Training
from space_dist.system.extras import needed_from
from space_dist.system.files import LogFile, in_words
from space_dist.system.interrupts import StopRequests
from space_dist.system.workplace import private_ray
from space_dist.tracking.pusher import NO_LONGER, Pusher
from space_dist.tracking.settling import settled

log = logging.getLogger("space_dist")

_PACKAGE = Path(__file__).parents[1]
_FINAL_PUSH_SECONDS = 45.0  # for all of it: a server that answers badly (20 s a request), the last rows, the pictures


@dataclass(frozen=True)
class Outcome:
    """How a launch ended: the run's ledger, whether it was done before, what MLflow's mirror lacks, and its pages.

    next_round: environment steps that another round would have taken: `2,048`, or `up to 1,600` by its episodes.
    """

    ledger: Ledger
    already_done: bool = False
    next_round: str = ""
    tracking_warning: str | None = None
    pages: tuple[str, ...] = ()


def launch(
    config: RunConfig,
    folder: Path,
    *,
    resume: bool,
    stop: StopRequests,
    pause_at: int = 0,
    observe: Callable[[Progress], None] = lambda progress: None,
    waiting: Callable[[str], None] = lambda what: None,
    tell: Callable[[str], None] = lambda sentence: None,
    going_on: Callable[[str], None] = lambda where: None,
) -> Outcome:
    """Run `config` in `folder` to its end, or go on where it stopped.

    pause_at: environment steps at which it is paused, behind the first update that is made then, to be gone on with by
    another launch; 0: nowhere. observe: told of progress. waiting: told what is waited for, before and behind that:
    `starting Ray`. tell: told what is worth a line of its own, which stands in the log, too. going_on: told
    where a run goes on that was there, `going on at 18,432 steps`; with `resume`, that one begins where none was.

    With `resume`, a run that is there is continued, and one that is not is started. Raises ConfigError if the folder
    holds another run, RunLockedError if somebody else works on it, Interrupted if asked to stop, and any other
    SpaceDistError after noting it in the run's status.
    """
    nothing_there = resume and not Ledger(folder).exists()
    with begun(config, folder, resume=resume, stop=stop, pause_at=pause_at) as active:
        if nothing_there:  # who resumes expects a run, and may have named another folder
            going_on(f"beginning anew: there was no run in {folder}")
        elif active.goes_on:
            going_on(active.goes_on)
        for part in active.parts():
            with _cluster(part, waiting, tell) as cluster:
                waiting("preparing the learner")
                part.training(cluster, observe).run()
    # The lock is free by now: a server that hangs keeps nobody from the run.
    if active.pusher is not None:
        waiting(f"mirroring to {active.pusher.where}, for {_FINAL_PUSH_SECONDS:.0f} s at most")
    return active.finished()


@dataclass
class ActiveRun:
    """A run that is this process's own now.

    outcome: how it ends; `already_done` where there is nothing to do. goes_on: where, in words; empty where it begins.
    pause_at and what follows: as of `Training`.
    """

    blueprint: Blueprint
    setup: Setup
    writer: RunWriter
    status: Status
    stop: StopRequests
    outcome: Outcome
    goes_on: str = ""
    pusher: Pusher | None = None
    pause_at: int = 0
    change_at: int = 0
    curriculum_number: int = 0
    ends_curriculum: bool = False

    def parts(self) -> Iterator[ActiveRun]:
        """What is left of it: all at once, or, under a schedule, the part up to each change, under what is in force.

        The next part is asked for when the one before it was trained to its end.
        """
        config, writer = self.blueprint.config, self.writer
        while not self.outcome.already_done and not writer.current.has_reached(self.pause_at):
            if not config.changes:
                yield self
                return
            checkpoint = writer.restore()
            steps = 0 if checkpoint is None else int(checkpoint.data["run"]["steps"])
            blueprint = self.blueprint.under(config.at(steps))
            setup = blueprint.setup(self.setup.train, self.setup.test)
            number, change_at = config.curriculum_number(steps), config.change_after(steps)
            yield replace(
                self, blueprint=blueprint, setup=setup, change_at=change_at, curriculum_number=number,
                ends_curriculum=config.curriculum_number(change_at) > number,
            )  # fmt: skip

    def training(self, cluster: Cluster, observe: Callable[[Progress], None] = lambda progress: None) -> Training:
        """What is left of it. Raises Interrupted if it was asked to stop meanwhile."""
        self.raise_if_stopped()
        return Training(
            self.blueprint, self.setup, cluster, self.writer,
            status=self.status, pause_at=self.pause_at, change_at=self.change_at,
            curriculum_number=self.curriculum_number, ends_curriculum=self.ends_curriculum,
            stop_requested=self.stop.reason, observe=observe,
        )  # fmt: skip

    def mirror(self) -> None:
        """Begin to keep what the config's tracking asks for. A run goes on without, and says so at its end."""
        tracking, folder = self.blueprint.config.tracking, self.outcome.ledger.folder
        if not (tracking.anywhere and tracking.live):
            return
        try:
            self.pusher = Pusher(tracking, folder, folder / "tracking.log")
        except OSError as error:
            warning = f"nothing was mirrored: {in_words(error)}. `space-dist sync {folder}` does it later"
            self.outcome = replace(self.outcome, tracking_warning=warning)

    def raise_if_stopped(self) -> None:
        """Raise Interrupted, before the first round, if it was asked to stop."""
        _stop_if_asked(self.writer, self.stop)

    def note(self, sentence: str, code: int) -> None:
        """Have the status say why this process ends, with this exit code, from another thread than this one."""
        with contextlib.suppress(LedgerError, RunLockedError):
            self.writer.note_end("interrupted" if code == Interrupted.exit_code else "failed", sentence)

    def finished(self) -> Outcome:
        """How it ended, once MLflow's mirror has what it can have."""
        if self.pusher is None:
            return self.outcome
        with self.stop.nothing_left(NO_LONGER) as left:
            warning = self.pusher.warning(_FINAL_PUSH_SECONDS, "run", left)
        return replace(self.outcome, tracking_warning=warning, pages=tuple(self.pusher.pages()))


@contextlib.contextmanager
def begun(
    config: RunConfig, folder: Path, *, resume: bool, stop: StopRequests, pause_at: int = 0
) -> Iterator[ActiveRun]:  # fmt: skip
    """Make the folder this run's, for as long as the context lasts. What is raised within is noted in its status.

    Raises as `launch` does.
    """
    # Environments are made and reset from here on.
    with exits_refused(), _zero_exits_reported(), _begun(config, folder, resume, stop, pause_at) as active:
        yield active


@contextlib.contextmanager
def _begun(
    config: RunConfig, folder: Path, resume: bool, stop: StopRequests, pause_at: int
) -> Iterator[ActiveRun]:  # fmt: skip
    threadpool_limits(limits=1)  # the bits of a matrix product depend on how many threads share it
    # `auto` is settled here, once: stored, it means the same server wherever the run is resumed.
    config = config.model_copy(update={"tracking": settled(config.tracking, "space_dist")})
    ledger, blueprint = Ledger(folder), Blueprint.of(config)
    # Whatever the config cannot do is refused before the folder is written to.
    setup = blueprint.setup(*blueprint.instances())
    blueprint.refuse_machine()
    # What was just begun looks stillborn, and is somebody's.
    if ledger.exists() and not resume and (ledger.owner_alive() or not is_stillborn(ledger)):
        raise ConfigError(already_there(config, ledger))
    with RunWriter(ledger) as writer:
        status, goes_on = claim(blueprint, setup, writer, stop, pause_at)
        done = Outcome(ledger, already_done=status.has_reached(pause_at), next_round=blueprint.round_in_words)
        active = ActiveRun(blueprint, setup, writer, status, stop, done, goes_on, pause_at=pause_at)
        if active.outcome.already_done:
            yield active
            return
        stop.watch(ledger.stop_file, blueprint.config.resources.grace_seconds)
        active.mirror()
        with _logging_to(ledger.log), _failures_noted(writer):
            if status.fingerprint_changed:
                log.warning(
                    "resumed with another arithmetic, other code (ours, or that of your own environment, policy, "
                    "learner or curriculum) or library versions: results are valid, but not "
                    "promised to be the bits of an uninterrupted run; the run is marked (fingerprint_changed)"
                )
            for remark in arithmetic.remarks(status.fingerprint["arithmetic"]):
                log.warning("%s", remark)
            episodes = blueprint.config.budget.episodes
            limit = "" if episodes is None else f", or of {episodes} episodes, whichever ends first"
            log.info("seed %d, budget of %d environment steps%s", status.seed, status.budget_steps, limit)
            if goes_on:
                log.info("%s", goes_on)
            active.raise_if_stopped()  # before Ray is started
            yield active


def _stop_if_asked(writer: RunWriter, stop: StopRequests) -> None:
    """Stop before the first round. Raises Interrupted; what was committed by then is all there is."""
    reason = stop.signalled or stop.filed
    if reason is not None and writer.status is not None:
        message = f"stopped by {reason} before its first round; {CONTINUES}"
        writer.set_status(replace(writer.status, state="interrupted", message=reason, updated_at=time.time()))
        raise Interrupted(message)


def policy_of(ledger: Ledger, spec: EnvironmentSpec) -> Policy | Several:
    """The policy, or policies, of a finished run, or those of an unfinished one's last checkpoint.

    spec: of the run's environment. Raises LedgerError where there is none, and where it is damaged.
    """
    model = (ledger.model_arrays, ledger.model_description)
    if ledger.status().state == "done" and all(path.exists() for path in model):
        content, described = ledger.read(ledger.model_arrays), ledger.read(ledger.model_description)
        try:
            description = json.loads(described)
            if description["policy"] != "torch":  # those come from the last checkpoint, below
                # Never pickle: the folder may be a stranger's.
                with np.load(io.BytesIO(content), allow_pickle=False) as file:
                    return from_arrays(dict(file), description)
        except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile, EOFError):
            raise LedgerError(f"the model in {ledger.folder} is damaged (model.npz, model.json)") from None
    checkpoint = ledger.last_checkpoint()
    if checkpoint is None:
        raise LedgerError(f"{ledger.folder} has no policy yet: no checkpoint was written")
    return Blueprint(stored_config(ledger), spec).policy_in(checkpoint)


@contextlib.contextmanager
def _cluster(
    active: ActiveRun, waiting: Callable[[str], None], tell: Callable[[str], None]
) -> Iterator[Cluster]:  # fmt: skip
    config = active.blueprint.config
    workers = n_workers(config, active.blueprint.spec)
    if workers == 0:
        with contextlib.closing(InProcess(config, active.setup)) as here:
            yield here
        return

    def told(sentence: str) -> None:
        log.warning("%s", sentence)
        tell(sentence)

    shards = active.blueprint.config.rollout.shards
    if workers > shards:
        told(
            f"resources.workers: {workers}: a round has {counted(shards, 'shard')} (rollout.shards), so more than "
            f"{counted(shards, 'actor')} take CPUs and gain nothing"
        )
    actors = counted(workers, "rollout actor")
    if config.resources.address == "local":
        waiting(f"starting Ray with {actors}")
        private_ray()
    else:
        waiting(f"joining the Ray at {config.resources.address}")
    with needed_from("ray", f"resources.workers: {workers}", "use resources.workers=0"):
        from space_dist.run.ray_cluster import RayCluster  # it takes a second, and is not needed without workers

    def joined(which: str) -> None:
        sentence = f"joined the Ray at {which}"
        log.info("%s", sentence)
        if config.resources.address == "auto":  # nobody has said which one, and the next line may pass at once
            tell(sentence)
        waiting(f"waiting for room for {actors} on the Ray at {which}")

    with contextlib.ExitStack() as stack:
        with active.stop.keeping_handlers():  # ray.init would replace SIGTERM's handler
            cluster = stack.enter_context(
                RayCluster(config, active.setup, active.raise_if_stopped, active.note, told, joined)
            )
        yield cluster


@contextlib.contextmanager
def _failures_noted(writer: RunWriter) -> Iterator[None]:
    """Leave a true status behind, whatever happens."""
    try:
        with exits_refused(), _unfinished_while(writer):
            yield
    except Interrupted as error:
        log.warning("%s", error)
        with contextlib.suppress(OSError):
            writer.ledger.stop_file.unlink(missing_ok=True)  # it asked us, and must not ask who goes on
        raise
    except RunLockedError as error:
        log.error("%s", error)  # the status now belongs to somebody else
        raise
    except SpaceDistError as error:
        _note_failure(writer, str(error))
        raise
    except KeyboardInterrupt:  # whoever calls us from a program of their own has no handlers of ours
        _note_failure(writer, "KeyboardInterrupt", "interrupted")
        raise
    except GeneratorExit:  # its population ends
        raise
    except BaseException as error:  # a user's environment may raise anything
        log.error("%s", traceback.format_exc())  # the traceback is for the log alone
        where = "".join(f" ({note})" for note in getattr(error, "__notes__", ())) or _raised_in(error)
        what = f"{type(error).__name__}: {error}{where}"
        _note_failure(writer, what)
        raise SpaceDistError(f"the run failed: {what[:500]}. The traceback is in {writer.ledger.log}") from error


def _raised_in(error: BaseException) -> str:
    """` (my_learner.py, line 14, in train)`: where in a user's own code, if it came from there."""
    installed = (*map(sysconfig.get_path, ("stdlib", "platstdlib", "purelib", "platlib")), str(_PACKAGE), "<")
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith(installed)]
    return f" ({Path(own[-1].filename).name}, line {own[-1].lineno}, in {own[-1].name})" if own else ""


def _note_failure(writer: RunWriter, message: str, state: State = "failed") -> None:
    log.error("%s", message)
    if writer.status is not None:
        with contextlib.suppress(LedgerError, RunLockedError):  # the disk may be what failed
            writer.set_status(replace(writer.status, state=state, message=message[:2000], updated_at=time.time()))


_unfinished: list[RunWriter] = []  # of the runs that this process is at, and that are its own by now
_at_work: list[object] = []  # one for each run, from before its environment is made for the first time
_restore: list[Callable[[int], NoReturn]] = []  # what `os._exit` is otherwise


@contextlib.contextmanager
def _zero_exits_reported() -> Iterator[None]:
    """Keep `os._exit(0)` from ending a run that is not done with the exit code of one that is.

    It cannot be caught, so it is stood in for while a run is unfinished. What ends the process from C is not noticed:
    that would take a parent process, through which every signal, lock and limit of the run had to go. Grids have one,
    the supervisor; elsewhere the run's owner is seen to be gone.
    """
    if not _at_work:
        end, owner = os._exit, os.getpid()

        def reported(code: int) -> NoReturn:
            if code == 0 and os.getpid() == owner:  # processes that were forked end so
                code = os.EX_SOFTWARE
                what = "the environment, or something that it uses, ended the process (os._exit(0))"
                print(f"space-dist: {what}", file=sys.stderr, flush=True)
                for unfinished in _unfinished:
                    _note_failure(unfinished, what)
            end(code)

        _restore.append(end)
        os._exit = reported  # type: ignore[assignment]
    mine = object()
    _at_work.append(mine)
    try:
        yield
    finally:
        _at_work.remove(mine)
        if not _at_work:
            os._exit = _restore.pop()  # type: ignore[assignment]


@contextlib.contextmanager
def _unfinished_while(writer: RunWriter) -> Iterator[None]:
    """Have an end of the process noted in this run's status, too."""
    _unfinished.append(writer)
    try:
        yield
    finally:
        _unfinished.remove(writer)


speaking: contextvars.ContextVar[Path | None] = contextvars.ContextVar("speaking", default=None)
"""The folder of the run that this process advances now, where it advances several: whose log it writes."""


@contextlib.contextmanager
def _logging_to(path: Path) -> Iterator[None]:
    try:
        handler = LogFile(path)
    except OSError as error:
        raise LedgerError(f"cannot write {path}: {in_words(error)}") from None
    handler.handleError = lambda record: None  # type: ignore[method-assign] # a full disk is the ledger's to tell
    # Runs of a population share a process and its logger: each log has its own run's lines.
    handler.addFilter(lambda record: speaking.get() in (None, path.parent))
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.removeHandler(handler)
        handler.close()
