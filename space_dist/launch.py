"""From a config to a finished run: instances, folder, lock, cluster, training, and what is left behind if it fails."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import logging
import os
import platform
import secrets
import subprocess
import sys
import time
import traceback
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from space_dist import config as configs
from space_dist.cluster import Cluster, InProcess
from space_dist.config import RunConfig
from space_dist.errors import ConfigError, Interrupted, LedgerError, RunLockedError, SpaceDistError
from space_dist.instances import InstanceSet, read_csv, refuse_overlap
from space_dist.interrupts import StopRequests
from space_dist.ledger import Ledger, RunWriter, Status, decode_checkpoint
from space_dist.policy import Policy, from_arrays
from space_dist.rollout import Setup
from space_dist.training import Progress, Training, make_env, make_setup, policy_in

log = logging.getLogger("space_dist")

_BITS_DEPEND_ON = ("numpy", "torch", "stable-baselines3", "sb3-contrib", "gymnasium", "space-dist")
_FINAL_PUSH_SECONDS = 120.0


@dataclass(frozen=True)
class Outcome:
    """How a launch ended: the run's ledger, whether it was done before, and what MLflow's mirror lacks, if anything."""

    ledger: Ledger
    already_done: bool = False
    tracking_warning: str | None = None


def default_folder(config: RunConfig) -> Path:
    """`runs/<name>/s<seed>` in the current folder."""
    return Path("runs") / config.name / f"s{config.seed}"


def read_instances(config: RunConfig) -> tuple[InstanceSet, InstanceSet]:
    """The training and test instances of a config. Raises ConfigError for a bad file, or one that shares a context."""
    bounds = make_env(config).context_bounds
    columns = config.curriculum.columns
    with about("instances.train"):
        train = read_csv(config.instances.train, bounds, columns)
    with about("instances.test"):
        test = read_csv(config.instances.test, bounds, columns, if_there=True)
    refuse_overlap(train, test, str(config.instances.train), str(config.instances.test))
    return train, test


@contextlib.contextmanager
def about(where: str) -> Iterator[None]:
    """Say where a fault lies: the file or key goes before its sentence, unless it is there already."""
    try:
        yield
    except ConfigError as error:
        text = str(error)
        raise ConfigError(text if text.startswith((where, "--set ")) else f"{where}: {text}") from error


def launch(
    config: RunConfig,
    folder: Path,
    *,
    resume: bool,
    stop: StopRequests,
    observe: Callable[[Progress], None] = lambda progress: None,
) -> Outcome:
    """Run `config` in `folder` to its end, or go on where it stopped.

    With `resume`, a run that is there is continued, and one that is not is started. Raises ConfigError if the folder
    holds another run, RunLockedError if somebody else works on it, Interrupted if asked to stop, and any other
    SpaceDistError after noting it in the run's status.
    """
    threadpool_limits(limits=1)  # the bits of a matrix product depend on how many threads share it
    ledger = Ledger(folder)
    train, test = read_instances(config)
    setup = make_setup(config, train, test)
    if ledger.exists() and not resume:
        raise ConfigError(f"{folder} already holds a run: --resume continues it, --out DIR starts another")
    with RunWriter(ledger) as writer:
        status = _claim(config, setup, writer)
        if status.state == "done":
            return Outcome(ledger, already_done=True)
        stop.watch(ledger.stop_file, config.resources.grace_seconds)
        pusher = _start_pusher(config, ledger)
        with _logging_to(ledger.log), _failures_noted(writer):
            if status.fingerprint_changed:
                log.warning(
                    "resumed on another CPU model or with other library versions: results are valid, but no longer "
                    "promised to be the bits of an uninterrupted run; the run is marked (fingerprint_changed)"
                )
            log.info("seed %d, budget of %d environment steps", config.seed, config.budget.steps)
            with _cluster(config, setup, stop) as cluster:
                Training(
                    config, setup, cluster, writer, status=status, stop_requested=stop.reason, observe=observe
                ).run()
    return Outcome(ledger, tracking_warning=_final_push(config, ledger, pusher))


def fingerprint() -> dict[str, str]:
    """What bit-equality is promised for: the CPU's model and the versions of what computes."""
    model = platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                model = line.partition(":")[2].strip()
                break
    versions = {name: importlib.metadata.version(name) for name in _BITS_DEPEND_ON}
    return {"cpu": model, "python": platform.python_version(), **versions}


def _claim(config: RunConfig, setup: Setup, writer: RunWriter) -> Status:
    """Make the folder this run's, or recognise it as such; returns where the run stands now."""
    ledger = writer.ledger
    now, here = time.time(), fingerprint()
    status = Status(
        state="running", name=config.name, seed=config.seed, steps=0, budget_steps=config.budget.steps, round=0,
        started_at=now, updated_at=now, fingerprint=here,
    )  # fmt: skip
    if ledger.config.exists():
        _refuse_other_run(config, setup, ledger)
    if ledger.status_file.exists():
        before = writer.status = ledger.status()
        if before.state == "done":
            return before
        changed = before.checkpoint is not None and dict(before.fingerprint) != here
        status = replace(
            status, steps=before.steps, round=before.round, started_at=before.started_at,
            fingerprint_changed=before.fingerprint_changed or changed,
        )  # fmt: skip
    writer.write_config(configs.dump(_self_contained(config)), setup.train.to_csv(), setup.test.to_csv())
    ledger.stop_file.unlink(missing_ok=True)
    writer.set_status(status)
    return status


def _refuse_other_run(config: RunConfig, setup: Setup, ledger: Ledger) -> None:
    stored = configs.load(ledger.config)
    train, test = read_instances(stored)
    same = configs.identity(config, setup.train.digest(), setup.test.digest())
    if same == configs.identity(stored, train.digest(), test.digest()):
        return
    changes = configs.differences(stored, config)
    if (train.digest(), test.digest()) != (setup.train.digest(), setup.test.digest()):
        changes.append("instances: other contexts or ids")
    raise ConfigError(
        f"{ledger.folder} holds a run of another configuration ({'; '.join(changes)}). A run's settings cannot change "
        "on the way: use --out DIR for a new run"
    )


def _self_contained(config: RunConfig) -> RunConfig:
    """The config as stored in the run's folder: with its own instance files, and no path relative to anywhere else."""
    instances = {"train": Path("instances_train.csv"), "test": Path("instances_test.csv")}
    return config.model_copy(
        update={
            "instances": config.instances.model_copy(update=instances),
            "tracking": config.tracking.model_copy(update={"uri": absolute_uri(config.tracking.uri)}),
        }
    )


def absolute_uri(uri: str | None) -> str | None:
    """A tracking URI that means the same from any folder: `sqlite:///FILE` with the file's absolute path."""
    prefix = "sqlite:///"
    return f"{prefix}{Path(uri.removeprefix(prefix)).absolute()}" if uri and uri.startswith(prefix) else uri


def policy_of(ledger: Ledger) -> Policy:
    """The policy of a finished run, or that of an unfinished one's last checkpoint. Raises LedgerError without any."""
    if ledger.model_arrays.exists() and ledger.model_description.exists():
        try:
            description = json.loads(ledger.model_description.read_bytes())
            if description["policy"] != "torch":  # those come from the last checkpoint, below
                with np.load(ledger.model_arrays, allow_pickle=False) as file:
                    return from_arrays(dict(file), description)
        except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile, EOFError):
            raise LedgerError(f"the model in {ledger.folder} is damaged (model.npz, model.json)") from None
    for file in ledger.checkpoint_files():
        with contextlib.suppress(ValueError, OSError):
            return policy_in(decode_checkpoint(file.read_bytes()), configs.load(ledger.config))
    raise LedgerError(f"{ledger.folder} has no policy yet: no checkpoint was written")


def private_ray() -> None:
    """Prepare this process for Rays of its own; to be called before Ray is imported, which reads these once.

    Ray runs whatever its ports are sent, so only who holds this process's own token may talk to them. (Unset, Ray makes
    up a token and leaves it in the user's home.)
    """
    if "ray" not in sys.modules:
        os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}


@contextlib.contextmanager
def _cluster(config: RunConfig, setup: Setup, stop: StopRequests) -> Iterator[Cluster]:
    if config.resources.workers == 0:
        yield InProcess(config, setup)
        return
    if config.resources.address == "local":
        private_ray()
    from space_dist.distributed import RayCluster  # Ray takes a second to import and is not needed without workers

    with RayCluster(config, setup) as cluster:
        stop.install()  # ray.init replaced SIGTERM's handler
        yield cluster


@contextlib.contextmanager
def _failures_noted(writer: RunWriter) -> Iterator[None]:
    """Leave a true status behind, whatever happens."""
    try:
        yield
    except Interrupted as error:
        log.warning("%s", error)
        raise
    except RunLockedError as error:
        log.error("%s", error)  # the status now belongs to somebody else
        raise
    except SpaceDistError as error:
        _note_failure(writer, str(error))
        raise
    except (Exception, SystemExit) as error:  # a user's environment may even exit
        log.error("%s", traceback.format_exc())  # the traceback is for the log alone
        what = f"{type(error).__name__}: {error}"
        _note_failure(writer, what)
        raise SpaceDistError(f"the run failed: {what[:500]}. The traceback is in {writer.ledger.log}") from error


def _note_failure(writer: RunWriter, message: str) -> None:
    log.error("%s", message)
    if writer.status is not None:
        with contextlib.suppress(LedgerError, RunLockedError):  # the disk may be what failed
            writer.set_status(replace(writer.status, state="failed", message=message[:2000], updated_at=time.time()))


@contextlib.contextmanager
def _logging_to(path: Path) -> Iterator[None]:
    try:
        handler = logging.FileHandler(path)
    except OSError as error:
        raise LedgerError(f"cannot write {path}: {error.strerror}") from None
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.removeHandler(handler)
        handler.close()


def _start_pusher(config: RunConfig, ledger: Ledger) -> subprocess.Popen[bytes] | None:
    """MLflow's mirror is kept by a process of its own: a slow or dead server costs training nothing."""
    if config.tracking.uri is None or not config.tracking.live:
        return None
    command = [sys.executable, "-m", "space_dist.cli", "sync", "--follow", "--", str(ledger.folder)]
    with (ledger.folder / "tracking.log").open("ab") as output:
        # A session of its own: Ctrl-C is for the run; the pusher ends by itself once the run has.
        return subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
        )  # fmt: skip


def _final_push(config: RunConfig, ledger: Ledger, pusher: subprocess.Popen[bytes] | None) -> str | None:
    if pusher is None:
        return None
    try:
        code = pusher.wait(timeout=_FINAL_PUSH_SECONDS)
    except subprocess.TimeoutExpired:
        pusher.terminate()
        code = 1
    if code == 0:
        return None
    return (
        f"MLflow at {config.tracking.uri} could not be brought up to date; nothing is lost: "
        f"`space-dist sync {ledger.folder}` replays the run (details: {ledger.folder / 'tracking.log'})"
    )
