"""Grids on Ray: on a private one on this machine, inside a cluster, and submitted to a cluster from outside.

Inside, a *conductor* works through the manifest: short runs on a warm pool (`ray_pool`), long ones as one Ray job each.
From outside, a grid is submitted as one job, its conductor; the frozen manifest travels with it. So a laptop may be
closed, and a conductor that is killed is simply submitted again: it finds the jobs that still live, and what is done.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import math
import os
import re
import shlex
import shutil
import tempfile
import textwrap
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

from space_dist.system.workplace import RAY_DEFAULTS, cores

os.environ.update(RAY_DEFAULTS | dict(os.environ))  # before Ray reads it

import ray
import requests
from ray.exceptions import AuthenticationError
from ray.job_submission import JobDetails, JobStatus, JobSubmissionClient

from space_dist.errors import Interrupted, SpaceDistError
from space_dist.experiment.endings import Busy, Ended, Evidence
from space_dist.experiment.manifest import Grid, Manifest, Run
from space_dist.experiment.status import Attempts, RunStatus, settled
from space_dist.grid.conductor import Conductor, Overview
from space_dist.grid.pool import Nonce, Pool
from space_dist.grid.supervisor import AttemptId, ray_answers
from space_dist.grid.warm import slurms_memory_of_a_core
from space_dist.run.ray_session import attended, join_ray, remove_session
from space_dist.system.importing import PYTHON
from space_dist.system.ray_address import unresolved

log = logging.getLogger("space_dist")

Mode = Literal["auto", "pool", "jobs"]
LONG_SECONDS = 300.0  # runs expected to take longer get a job each
STEPS_PER_SECOND = 4_000.0  # of a run whose speed nobody has measured yet: PPO on PointMass, one core
_POLL_SECONDS = 1.0
_NODES_SECONDS = 180.0  # for a batch system's nodes to join: they are granted together, and begin one by one
_AGENT_SECONDS = 60.0  # for the agent that starts jobs, which comes up after Ray itself
_LATE_SECONDS = 60.0  # without a sign of life of its supervisor a job is taken for lost
_LIVE = (JobStatus.PENDING, JobStatus.RUNNING)
_MAX_JOB_NAME = 60  # characters of a grid's name in its job's, which people read in lists


# ---- inside ---------------------------------------------------------------------------------------------------------


def conduct(
    grid: Grid, manifest: Manifest, runs: Sequence[Run], *, address: str, mode: Mode, max_parallel: int | None,
    nodes: int, stop_requested: Callable[[], str | None], reinstall: Callable[[], None],
    observe: Callable[[Overview], None] = lambda overview: None, say: Callable[[str], None] = lambda line: None,
) -> list[RunStatus]:  # fmt: skip
    """Work through `runs` on a private Ray (`address` local) or the cluster we are in; returns where they stand.

    max_parallel: runs at a time; None: as many as fit. nodes: how many to wait for at first. `reinstall` is called
    after Ray has taken the signal handlers. say: hears which cluster that is. Raises SpaceDistError if there is no room
    for one run, Interrupted if asked to stop.
    """
    with _joined(address, manifest, max_parallel, stop_requested, say) as dashboard:
        # `ray.init` replaces the handler of SIGTERM.
        reinstall()
        _await_nodes(nodes, stop_requested)
        size = _room_for(manifest, max_parallel)
        in_jobs = address != "local" and _as_jobs(grid, manifest, runs, mode)
        pool_size, memory_mb = min(size, max(1, len(runs))), _memory_per_process(manifest, address)
        with (
            Jobs(grid, manifest, size, memory_mb, dashboard)
            if in_jobs
            else Pool(grid, manifest, pool_size, memory_mb, stop_requested)
        ) as executor:
            return Conductor(
                grid, manifest, runs, executor, stop_requested=stop_requested, observe=observe
            ).conduct()  # fmt: skip


@contextlib.contextmanager
def _joined(
    address: str, manifest: Manifest, max_parallel: int | None, stop_requested: Callable[[], str | None],
    say: Callable[[str], None],
) -> Iterator[str]:  # fmt: skip
    """The address of the dashboard, which is the job server's; empty on a private Ray, which has none."""

    def raise_if_stopped() -> None:
        if reason := stop_requested():
            raise Interrupted(f"stopped before Ray was started ({reason})")

    def joined(which: str) -> None:
        sentence = f"joined the Ray at {which}"
        log.info("%s", sentence)
        say(f"{manifest.name}: {sentence}")

    # A run with rollout actors may have more processes than this machine has cores; they share them.
    most = max(cores(), (max_parallel or 1) * manifest.cpus_per_run)
    context = join_ray(address, most, raise_if_stopped, joined=joined)

    def leave() -> None:
        if ray_answers(context["gcs_address"]):
            ray.shutdown()  # where Ray is gone, this would end the process at once, before it has said so
            remove_session(context["session_dir"] if address == "local" else None)

    # Of a joined Ray that is gone, the conductor tells; from one of our own, Ray itself would end this process first.
    with attended(context, address, gone=address == "local", leave=leave):
        yield context.get("webui_url") or ""


def _await_nodes(count: int, stop_requested: Callable[[], str | None]) -> None:
    """Raises Interrupted if they do not come: the next allocation may do better."""
    until = time.monotonic() + _NODES_SECONDS
    while (alive := sum(node["Alive"] for node in ray.nodes())) < count:  # type: ignore[no-untyped-call]
        if reason := stop_requested():
            raise Interrupted(f"stopped while waiting for the cluster's nodes ({reason})")
        if time.monotonic() > until:
            raise Interrupted(f"only {alive} of {count} nodes have joined Ray within {_NODES_SECONDS:.0f} s")
        time.sleep(_POLL_SECONDS)


def _room_for(manifest: Manifest, max_parallel: int | None) -> int:
    """Runs that fit at a time, by CPUs that are free now. Raises SpaceDistError if the cluster is too small for one."""
    total: dict[str, float] = ray.cluster_resources()  # type: ignore[no-untyped-call]
    # Free now, not all there are: others may be at work on the same cluster.
    free: dict[str, float] = ray.available_resources()  # type: ignore[no-untyped-call]
    if total.get("CPU", 0.0) < manifest.cpus_per_run:
        raise SpaceDistError(
            f"the Ray cluster has {total.get('CPU', 0.0):g} CPUs, and each run of {manifest.name} needs "
            f"{manifest.cpus_per_run} (1 + resources.workers)"
        )
    fits = max(1, int(free.get("CPU", 0.0) // manifest.cpus_per_run))
    return fits if max_parallel is None else min(fits, max_parallel)


def _memory_per_process(manifest: Manifest, address: str) -> float:
    """Of the CPUs that a run takes, in MB, on the node that has least of it for each CPU; infinite if none says."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]  # type: ignore[no-untyped-call]
    shares = [node.get("memory", math.inf) / node["CPU"] / 2**20 for node in nodes if node.get("CPU")]
    if address == "local":
        shares += slurms_memory_of_a_core()
    return min(shares, default=math.inf) * manifest.cpus_per_run


def _as_jobs(grid: Grid, manifest: Manifest, runs: Sequence[Run], mode: Mode) -> bool:
    """Whether runs get a job each: on demand, or if they are expected to take long, by those that are done."""
    if mode != "auto":
        return mode == "jobs"
    rates = []
    for run in runs[:50]:
        with contextlib.suppress(SpaceDistError):
            status = grid.ledger(run).status()
            if status.state == "done" and status.updated_at > status.started_at:
                rates.append(status.steps / (status.updated_at - status.started_at))
    rate = sorted(rates)[len(rates) // 2] if rates else STEPS_PER_SECOND
    return max(cell.steps_to_take for cell in manifest.cells) / rate > LONG_SECONDS


class Jobs:
    """An `Executor` that gives each run a Ray job; admission is its own, so that no job waits inside Ray."""

    def __init__(
        self, grid: Grid, manifest: Manifest, max_in_flight: int, memory_mb: float, dashboard: str
    ) -> None:  # fmt: skip
        self._grid, self._manifest, self._max, self.memory_mb = grid, manifest, max_in_flight, memory_mb
        self._nonce = Nonce(grid)
        context = ray.get_runtime_context()
        if not dashboard:
            raise SpaceDistError("this Ray cluster runs no dashboard, and so takes no jobs; use --mode pool")
        self._client = _client(f"http://{dashboard}")
        # The conductor's own code is the runs': its uploaded folder, if it came with one.
        self._runtime_env = {key: value for key, value in dict(context.runtime_env).items()
                             if key in ("working_dir", "py_modules")}  # fmt: skip
        self._live: dict[str, list[tuple[Run, int]]] = {}
        self._looked = 0.0

    def __enter__(self) -> Jobs:
        self._nonce.place()
        return self

    def __exit__(self, *_: object) -> None:
        self._nonce.remove()

    def room(self) -> int:
        """See `grid.Executor`."""
        return self._max - len(self._live)

    def adopt(self, runs: Sequence[Run]) -> list[Run]:
        """See `grid.Executor`."""
        known = {run.key: run for run in runs}
        # Ray jobs outlive the conductor that submitted them.
        for job in self._client.list_jobs():
            metadata = job.metadata or {}
            if metadata.get("folder") != str(self._grid.folder) or job.status not in _LIVE:
                continue
            attempts = [AttemptId.parse(text) for text in metadata.get("runs", "").split()]
            mine = [
                (known[key], attempt_id.attempt)
                for attempt_id in attempts
                if (key := f"{attempt_id.cell}/s{attempt_id.seed}") in known
            ]
            if mine:
                self._live[str(job.submission_id)] = mine
        return [run for attempts in self._live.values() for run, _ in attempts]

    @property
    def size(self) -> int:
        """See `grid.Executor`."""
        return self._max

    def start(self, attempts: Sequence[tuple[Run, int]]) -> None:
        """See `grid.Executor`. A job of several runs is named after the first, and after how many it has."""
        (run, attempt), more = attempts[0], f"-p{len(attempts)}" if len(attempts) > 1 else ""
        while True:
            job = f"{_job_name(self._manifest)}-{run.cell.id}-s{run.seed}-a{attempt}{more}"
            attempt_ids = [AttemptId(run.cell.id, run.seed, attempt), *(AttemptId(one.cell.id, one.seed, number)
                                                                 for one, number in attempts[1:])]  # fmt: skip
            command = [
                *PYTHON, "-m", "space_dist.cli", "grid", "work", str(self._grid.folder), *map(str, attempt_ids),
                "--nonce", self._nonce.text, "--job", job,
            ]  # fmt: skip
            grace = self._manifest.resources.grace_seconds
            # Ray sends SIGKILL 3 s after SIGTERM unless told otherwise: too soon for a checkpoint.
            environment = {"RAY_JOB_STOP_WAIT_TIME_S": str(int(grace) + 30), "PYTHONUNBUFFERED": "1"}
            taken = _submit(
                self._client, entrypoint=shlex.join(command), submission_id=job, entrypoint_num_cpus=1,
                runtime_env={**self._runtime_env, "env_vars": environment},
                metadata={
                    "grid": self._manifest.name, "folder": str(self._grid.folder), "cell": run.cell.id,
                    "label": run.cell.label, "seed": str(run.seed), "attempt": str(attempt),
                    "runs": " ".join(map(str, attempt_ids)),
                    "code": self._manifest.code, **self._manifest.git,
                },
            )  # fmt: skip
            # Not taken and alive: an earlier conductor, killed since, had submitted this very attempt.
            if not taken and ((details := self._details(job)) is None or details.status not in _LIVE):
                attempt += 1  # an id can be used once, even if its job never began
                continue
            self._live[job] = [(run, attempt), *attempts[1:]]
            return

    def _details(self, job: str) -> JobDetails | None:
        try:
            return self._client.get_job_info(job)
        except RuntimeError:
            return None

    def poll(self) -> list[tuple[Run, Ended | None]]:
        """See `grid.Executor`."""
        if time.monotonic() - self._looked < _POLL_SECONDS:
            return []
        self._looked = time.monotonic()
        ended: list[tuple[Run, Ended | None]] = []
        for job, attempts in list(self._live.items()):
            details = self._details(job)
            if details is not None and details.status in _LIVE:
                self._end_if_silent(job, *attempts[0])
                continue
            del self._live[job]
            ended += [(run, self._how(run, attempt, details)) for run, attempt in attempts]
        return ended

    def wait(self, seconds: float) -> None:
        """See `grid.Executor`: nobody tells us of a job."""
        time.sleep(seconds)

    def _how(self, run: Run, attempt: int, details: JobDetails | None) -> Ended | None:
        """How a job's attempt ended: what its supervisor wrote; if it was lost, what Ray says."""
        seen = Evidence(job="") if details is None else Evidence(
            job=details.message or "", job_succeeded=details.status == JobStatus.SUCCEEDED
        )  # fmt: skip
        ended = settled(run, self._grid.ledger(run), attempt, seen)
        return None if isinstance(ended, Busy) else ended

    def _end_if_silent(self, job: str, run: Run, attempt: int) -> None:
        attempts = Attempts(self._grid.ledger(run))
        if attempts.history().begun < attempt:
            return  # its supervisor is still loading
        if time.time() - attempts.last_sign() > _LATE_SECONDS:
            log.warning("%s: no sign of life for %.0f s; stopping its job", run.title, _LATE_SECONDS)
            with contextlib.suppress(RuntimeError):
                self._client.stop_job(job)

    def stop(self) -> None:
        """See `grid.Executor`."""
        for job in self._live:
            with contextlib.suppress(RuntimeError):
                self._client.stop_job(job)


def _submit(client: JobSubmissionClient, **job: Any) -> bool:
    """Submit a job; False if its id is taken. Raises SpaceDistError if Ray does not take it."""
    deadline = time.monotonic() + _AGENT_SECONDS
    while True:
        try:
            client.submit_job(**job)
        except (RuntimeError, requests.RequestException) as error:
            # The job server answers with text alone; these are Ray 2.60's words.
            if "already exists" in str(error):
                return False
            if "No available agent" not in str(error) or time.monotonic() > deadline:
                raise SpaceDistError(f"Ray does not take the job {job['submission_id']}: {_first(error)}") from error
            time.sleep(_POLL_SECONDS)  # the cluster has only just started
        else:
            return True


def _job_name(manifest: Manifest) -> str:
    return manifest.name[:_MAX_JOB_NAME]


# ---- from outside ---------------------------------------------------------------------------------------------------


class Remote:
    """A grid on a cluster, through its job server."""

    def __init__(self, address: str, manifest: Manifest, root: Path) -> None:
        self._client = _client(address)
        self._manifest = manifest
        self._folder = root / manifest.name
        self._address = address

    def conductor(self) -> JobDetails | None:
        """The newest job that conducts this grid, dead or alive."""
        found = [job for job in self._list() if (job.metadata or {}).get("conducts") == str(self._folder)]
        return max(found, key=lambda job: job.start_time or 0, default=None)

    def submit(
        self, grid: Grid, *, mode: Mode, max_in_flight: int | None, py_modules: Sequence[Path], python: str
    ) -> str:
        """Submit a conductor, unless one is there; returns its job's id. The frozen grid travels with it."""
        alive = self.conductor()
        if alive is not None and alive.status in _LIVE:
            return str(alive.submission_id)
        before = [job for job in self._list() if (job.metadata or {}).get("conducts") == str(self._folder)]
        command = [python, *PYTHON[1:], "-m", "space_dist.cli", "grid", "run", "manifest.json",
                   "--root", str(self._folder.parent), "--address", "auto", "--mode", mode]  # fmt: skip
        if max_in_flight is not None:
            command += ["--max-parallel", str(max_in_flight)]
        folder = hashlib.sha256(str(self._folder).encode()).hexdigest()[:8]  # grids of one name in several roots
        job = f"{_job_name(self._manifest)}-{folder}-conductor-{len(before) + 1}"
        # A conductor ends after its runs have made their checkpoints; Ray's own 3 s would cut that short.
        environment = {"RAY_JOB_STOP_WAIT_TIME_S": "120", "PYTHONUNBUFFERED": "1"}
        # A folder of its own: Ray would upload all of the current one, and refuses what is above 100 MiB.
        with tempfile.TemporaryDirectory() as upload:
            shutil.copy(grid.manifest_file, upload)
            shutil.copytree(grid.instances, Path(upload) / "instances")
            runtime_env: dict[str, Any] = {"working_dir": upload, "env_vars": environment}
            if py_modules:
                runtime_env["py_modules"] = [str(path.absolute()) for path in py_modules]
            _submit(  # or somebody else was faster, with the same
                self._client, entrypoint=shlex.join(command), submission_id=job, runtime_env=runtime_env,
                metadata={"conducts": str(self._folder), "grid": self._manifest.name, "code": self._manifest.code,
                          **self._manifest.git},
            )  # fmt: skip
        return job

    def follow(self, job: str, say: Callable[[str], None], stop_requested: Callable[[], str | None]) -> int:
        """Repeat what a conductor says until it ends; returns its exit code.

        Raises Interrupted if asked to stop looking: the grid goes on.
        """
        shown = 0
        while True:
            with _while_away(self._address):
                details = self._client.get_job_info(job)
                text = self._client.get_job_logs(job)
                lines = text.splitlines()
                for line in lines[shown:]:
                    say(line)
                shown = len(lines)
                if details.status not in _LIVE:
                    # Not known of a job that was stopped.
                    code = details.driver_exit_code
                    return int(code) if code is not None else (0 if details.status == JobStatus.SUCCEEDED else 1)
            if stop_requested():
                raise Interrupted(f"the grid goes on in the cluster; `space-dist grid stop` ends it (job {job})")
            time.sleep(_POLL_SECONDS)

    def stop(self, job: str) -> None:
        """Ask a conductor to stop its runs, and itself."""
        self._client.stop_job(job)

    def logs(self, job: str) -> str:
        """What a job has said."""
        text: str = self._client.get_job_logs(job)
        return text

    def _list(self) -> list[JobDetails]:
        try:
            return list(self._client.list_jobs())
        except (RuntimeError, requests.RequestException) as error:
            raise SpaceDistError(f"Ray's job server at {self._address} does not answer: {_first(error)}") from error


@contextlib.contextmanager
def _while_away(address: str) -> Iterator[None]:
    try:
        yield
    except (RuntimeError, requests.RequestException, ConnectionError) as error:
        raise SpaceDistError(
            f"Ray's job server at {address} is gone: {_first(error)}. Submit again once it is back: what is done "
            "stays done, and the rest goes on from its checkpoints"
        ) from error


def _client(address: str) -> JobSubmissionClient:
    try:
        return JobSubmissionClient(address)
    except AuthenticationError as error:
        raise SpaceDistError(
            f"Ray's job server at {address} lets nobody in without its cluster's token: set RAY_AUTH_MODE=token, and "
            f"have that token in ~/.ray/auth_token ({_first(error)})"
        ) from error
    except (ConnectionError, RuntimeError, ValueError, requests.RequestException) as error:
        if (host := urlsplit(address).hostname) and (unknown := unresolved(host)):
            raise SpaceDistError(f"Ray's job server at {address} cannot be reached: {unknown}") from error
        raise SpaceDistError(
            f"Ray's job server at {address} does not answer: {_first(error)}. `ray start --head` on that machine "
            "starts one (--dashboard-host=0.0.0.0 where it is another than this); `space-dist grid run` needs none"
        ) from error


def _first(error: BaseException) -> str:
    """An error's first sentence, or what fits of it in whole words."""
    sentence = re.split(r"\.+(?:\s|$)", str(error).strip(), maxsplit=1)[0].partition("\n")[0]
    return textwrap.shorten(sentence, 300, placeholder=" ...") or type(error).__name__
