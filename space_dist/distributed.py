"""The same work on Ray actors: thin shells around `rollout.Worker` and `cluster.Central`.

Nothing here decides a result. A shard may be computed by any actor; values flow from rollout actors to the curriculum
actor, and its selection back to them, by object reference, without passing through the driver.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("RAY_DEDUP_LOGS", "0")
os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")

import ray
from ray.exceptions import GetTimeoutError, RayActorError, RayError, RayTaskError
from threadpoolctl import threadpool_limits

from space_dist.cluster import Central, Decision, Evidence, Handle
from space_dist.config import RunConfig
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.rollout import FloatArray, IntArray, Setup, Split, Walk, Worker

_OBJECT_STORE_BYTES = 256 << 20
_START_SECONDS = 120.0
_ATTEMPTS = 4
_CENTRAL = -1
_CENTRAL_ANSWERS = 4  # state, selection, numbers, values

log = logging.getLogger("space_dist")


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


@dataclass
class _Piece:
    """A handle: where a value is, or will be. Recomputing the value moves it."""

    ref: Any


@dataclass(frozen=True)
class _Call:
    """A call of an actor's method, kept until its answer has arrived so that it can be made again."""

    actor: int  # of the rollout actors; _CENTRAL for the curriculum actor
    method: str
    arguments: tuple[Any, ...]
    options: dict[str, Any]
    answers: list[_Piece]


class RayCluster:
    """Rollout actors and one curriculum actor; a context manager that leaves nothing behind.

    An actor that dies is replaced, and what it owed is computed again: every call is a pure function, so nothing but
    time is lost. Raises SpaceDistError if Ray cannot be reached or has no room for the actors.
    """

    def __init__(self, config: RunConfig, setup: Setup) -> None:
        self._config, self._setup = config, setup
        self._actors: dict[int, Any] = {}
        self._unanswered: list[_Call] = []

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
            self._setup_ref = ray.put(self._setup)
            for index in (*range(resources.workers), _CENTRAL):
                self._actors[index] = self._start_actor(index)
            self._wait_until_ready()
        except BaseException:
            ray.shutdown()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for actor in self._actors.values():
            ray.kill(actor)
        ray.shutdown()

    def put(self, value: object) -> Handle:
        """See `cluster.Cluster`."""
        return _Piece(ray.put(value))

    def collect(
        self, policy: Handle, selection: Handle, walk: Walk, *, round: int, steps: int, version: int
    ) -> list[Handle]:
        """See `cluster.Cluster`."""
        asked = {"round": round, "steps": steps, "selection_version": version}
        shards = range(self._setup.shards)
        return [self._ask(shard, "collect", policy, selection, walk, shard=shard, **asked)[0] for shard in shards]

    def start_values(self, policy: Handle) -> list[Handle]:
        """See `cluster.Cluster`."""
        return [self._ask(chunk, "start_values", policy, chunk)[0] for chunk in range(self._setup.chunks)]

    def context_values(self, policy: Handle, contexts: FloatArray, *, version: int) -> list[Handle]:
        """See `cluster.Cluster`."""
        return [self._ask(0, "context_values", policy, contexts, version)[0]]

    def probe(self, policy: Handle, indices: IntArray, *, version: int) -> list[Handle]:
        """See `cluster.Cluster`."""
        parts = range(self._setup.evaluation_parts)
        return [self._ask(part, "probe", policy, indices, version, part)[0] for part in parts]

    def evaluate(self, policy: Handle, split: Split, *, stochastic: bool = False) -> list[Handle]:
        """See `cluster.Cluster`."""
        parts = range(self._setup.evaluation_parts)
        return [self._ask(part, "evaluate", policy, split, part, stochastic=stochastic)[0] for part in parts]

    def begin(self, values: Sequence[Handle]) -> Decision:
        """See `cluster.Cluster`."""
        return Decision(*self._ask(_CENTRAL, "begin", *values))

    def decide(
        self, state: Handle, before: Handle, evidence: Evidence, *, version: int, gradient_steps: int
    ) -> Decision:
        """See `cluster.Cluster`."""
        layout, pieces = evidence.flat()
        return Decision(*self._ask(_CENTRAL, "decide", state, before, version, gradient_steps, layout, *pieces))

    def get(self, handles: Sequence[Handle]) -> list[Any]:
        """Wait for values; every call made so far is answered then. Raises SpaceDistError if work fails repeatedly."""
        for _ in range(_ATTEMPTS):
            try:
                values = ray.get([handle.ref for handle in handles])
            except RayTaskError as error:
                raise _cause(error) from error
            except RayError as error:
                log.warning("lost a part of the run (%s); computing it again", type(error).__name__)
                lost = error
                self._replace_dead()
                self._ask_again()
            else:
                self._unanswered.clear()
                return list(values)
        raise SpaceDistError(
            f"the same work was lost {_ATTEMPTS} times ({type(lost).__name__}: {str(lost).splitlines()[0][:200]}). "
            "What was committed is intact; --resume continues"
        ) from lost

    def _ask(self, piece: int, method: str, *arguments: Any, **options: Any) -> list[_Piece]:
        actor = piece if piece == _CENTRAL else piece % self._config.resources.workers
        answers = [_Piece(None) for _ in range(_CENTRAL_ANSWERS if actor == _CENTRAL else 1)]
        call = _Call(actor, method, arguments, options, answers)
        self._unanswered.append(call)
        self._submit(call)
        return answers

    def _submit(self, call: _Call) -> None:
        method = getattr(self._actors[call.actor], call.method).options(num_returns=len(call.answers))
        arguments = [argument.ref if isinstance(argument, _Piece) else argument for argument in call.arguments]
        refs = method.remote(*arguments, **call.options)
        for piece, ref in zip(call.answers, refs if len(call.answers) > 1 else [refs], strict=True):
            piece.ref = ref

    def _ask_again(self) -> None:
        for call in self._unanswered:  # in the order of submission, so that arguments are asked for before their users
            self._submit(call)

    def _replace_dead(self) -> None:
        for index, actor in self._actors.items():
            try:
                ray.get(actor.ready.remote(), timeout=_START_SECONDS)
            except RayActorError:
                self._actors[index] = self._start_actor(index)
            except GetTimeoutError:
                ray.kill(actor)
                self._actors[index] = self._start_actor(index)
        self._wait_until_ready()

    def _start_actor(self, index: int) -> Any:
        # Never restarted by Ray: an actor that came back blank would go on silently.
        if index == _CENTRAL:
            return ray.remote(num_cpus=0, max_restarts=0)(CurriculumActor).remote(self._config, self._setup_ref)
        return ray.remote(num_cpus=1, max_restarts=0)(RolloutActor).remote(self._setup_ref)

    def _wait_until_ready(self) -> None:
        try:
            ray.get([actor.ready.remote() for actor in self._actors.values()], timeout=_START_SECONDS)
        except GetTimeoutError:
            total, free = _cpus()
            raise SpaceDistError(
                f"Ray did not start {self._config.resources.workers} rollout actors of one CPU each within "
                f"{_START_SECONDS:.0f} s; the cluster has {total:.0f} CPUs, {free:.0f} of them free"
            ) from None
        except RayActorError as error:
            cause = error.__cause__ if isinstance(error.__cause__, SpaceDistError) else None
            raise cause or SpaceDistError(f"an actor died as it started: {str(error).splitlines()[0][:300]}") from error


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
