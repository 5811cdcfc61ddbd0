"""The same work on Ray actors: thin shells around `rollout.Worker` and `training.Central`.

Nothing here decides a result. A shard may be computed by any actor; values flow from rollout actors to the curriculum
actor, and its selection back to them, by object reference, without passing through the driver.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from types import TracebackType
from typing import Any

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("RAY_DEDUP_LOGS", "0")
os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")

import ray
from ray.exceptions import GetTimeoutError, RayError, RayTaskError
from threadpoolctl import threadpool_limits

from space_dist.config import RunConfig
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.rollout import Setup, Split, Walk, Worker
from space_dist.training import Central, Decision, Handle

_OBJECT_STORE_BYTES = 256 << 20
_START_SECONDS = 120.0


class RolloutActor(Worker):
    """A `Worker` in a process of its own, with one thread for its arithmetic."""

    def __init__(self, setup: Setup) -> None:
        threadpool_limits(limits=1)
        super().__init__(setup)

    def ready(self) -> bool:
        """Answers once the actor is up."""
        return True


class CurriculumActor(Central):
    """The central curriculum: aggregates the start values that all rollout actors send it, and decides."""

    def __init__(self, config: RunConfig, setup: Setup) -> None:
        threadpool_limits(limits=1)
        super().__init__(config, setup.train)

    def ready(self) -> bool:
        """Answers once the actor is up."""
        return True


class RayCluster:
    """Rollout actors and one curriculum actor; a context manager that leaves nothing behind.

    Raises SpaceDistError if Ray cannot be reached or has no room for the actors.
    """

    def __init__(self, config: RunConfig, setup: Setup) -> None:
        self._config, self._setup = config, setup
        self._workers: list[Any] = []

    def __enter__(self) -> RayCluster:
        resources = self._config.resources
        try:
            if resources.address == "local":
                ray.init(
                    address="local", num_cpus=resources.workers + 1, include_dashboard=False, log_to_driver=False,
                    logging_level=logging.ERROR, object_store_memory=_OBJECT_STORE_BYTES, configure_logging=False,
                )  # fmt: skip
            else:
                ray.init(
                    address=resources.address, log_to_driver=False, logging_level=logging.ERROR, configure_logging=False
                )  # fmt: skip
        except (ConnectionError, RuntimeError, ValueError, OSError) as error:
            raise SpaceDistError(
                f"Ray cannot be started or reached at resources.address = {resources.address!r}: "
                f"{str(error).splitlines()[0] if str(error) else type(error).__name__}"
            ) from error
        try:
            self._start_actors(resources.workers)
        except BaseException:
            ray.shutdown()
            raise
        return self

    def _start_actors(self, workers: int) -> None:
        setup = ray.put(self._setup)
        rollout = ray.remote(num_cpus=1, max_restarts=0)(RolloutActor)
        self._workers = [rollout.remote(setup) for _ in range(workers)]
        self._central: Any = ray.remote(num_cpus=0, max_restarts=0)(CurriculumActor).remote(self._config, setup)
        try:
            ray.get([actor.ready.remote() for actor in (*self._workers, self._central)], timeout=_START_SECONDS)
        except GetTimeoutError:
            total, free = _cpus()
            raise SpaceDistError(
                f"Ray did not start {workers} rollout actors of one CPU each within {_START_SECONDS:.0f} s; "
                f"the cluster has {total:.0f} CPUs, {free:.0f} of them free"
            ) from None
        except RayTaskError as error:
            raise _cause(error) from error

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for actor in (*self._workers, self._central):
            ray.kill(actor)
        ray.shutdown()

    def put(self, value: object) -> Handle:
        """See `training.Cluster`."""
        return ray.put(value)

    def collect(self, weights: Handle, selection: Handle, walk: Walk, *, round: int, version: int) -> list[Handle]:
        """See `training.Cluster`."""
        return [
            self._worker(shard).collect.remote(
                weights, selection, walk, round=round, shard=shard, selection_version=version
            )
            for shard in range(self._setup.shards)
        ]

    def start_values(self, weights: Handle) -> list[Handle]:
        """See `training.Cluster`."""
        return [self._worker(chunk).start_values.remote(weights, chunk) for chunk in range(self._setup.chunks)]

    def evaluate(self, weights: Handle, split: Split) -> list[Handle]:
        """See `training.Cluster`."""
        parts = range(self._setup.evaluation_parts)
        return [self._worker(part).evaluate.remote(weights, split, part) for part in parts]

    def begin(self, values: Sequence[Handle]) -> Decision:
        """See `training.Cluster`."""
        return Decision(*self._central.begin.options(num_returns=4).remote(*values))

    def decide(
        self, state: Handle, before: Handle, after: Sequence[Handle], *, version: int, gradient_steps: int
    ) -> Decision:
        """See `training.Cluster`."""
        answer = self._central.decide.options(num_returns=4)
        return Decision(*answer.remote(state, before, version, gradient_steps, *after))

    def get(self, handles: Sequence[Handle]) -> list[Any]:
        """Wait for values. Raises SpaceDistError if an actor died or failed."""
        try:
            return list(ray.get(list(handles)))
        except RayTaskError as error:
            raise _cause(error) from error
        except RayError as error:
            raise SpaceDistError(
                f"a part of the run on Ray was lost ({type(error).__name__}: {str(error).splitlines()[0][:200]}). "
                "What was committed is intact; --resume continues"
            ) from error

    def _worker(self, piece: int) -> Any:
        return self._workers[piece % len(self._workers)]


def _cpus() -> tuple[float, float]:
    """CPUs of the cluster: all, and free ones."""
    total: dict[str, float] = ray.cluster_resources()  # type: ignore[no-untyped-call]
    free: dict[str, float] = ray.available_resources()  # type: ignore[no-untyped-call]
    return total.get("CPU", 0.0), free.get("CPU", 0.0)


def _cause(error: RayTaskError) -> Exception:
    """What the code in the actor raised: our own errors as they are, others as a sentence."""
    cause = error.cause if isinstance(error.cause, Exception) else error
    if isinstance(cause, SpaceDistError):
        kind = ConfigError if isinstance(cause, ConfigError) else SpaceDistError
        return kind(str(cause.args[0]) if cause.args else str(cause))
    lines = str(error).strip().splitlines()
    return SpaceDistError(f"an actor failed: {lines[-1][:300] if lines else type(error).__name__}")
