"""A Ray to work on: started or joined, watched as long as it is ours to use, and left without a trace."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import socket
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from space_dist.system.workplace import RAY_DEFAULTS

os.environ.update(RAY_DEFAULTS | dict(os.environ))  # before Ray reads it

import psutil
import ray
from ray.job_config import JobConfig

from space_dist.errors import Interrupted, SpaceDistError
from space_dist.run.ray_watch import (
    JOIN_SECONDS,
    NOBODY_LISTENS,
    SILENT_SECONDS,
    START_SECONDS,
    Note,
    Started,
    bounded,
    nowhere,
    parts,
    reach,
    watched,
)

_OBJECT_STORE_BYTES = 256 << 20  # policies and shards are some MB; Ray's default is 30 % of the memory
_NONE_RUNS = "Could not find any running Ray"  # Ray's own words
_STARTS = 5  # of a Ray of our own
_TURN_SECONDS = 300.0  # that one waits for others to be up
_LOOK_SECONDS = 0.2  # between two looks whether it is

log = logging.getLogger("space_dist")


class _Driver(JobConfig):
    """What Ray tells workers of their driver, but for its folders, where they would look before anywhere else."""

    def _serialize(self) -> str:
        self._py_driver_sys_path: list[str] = []
        return super()._serialize()


def join_ray(
    address: str, cpus: int, raise_if_stopped: Callable[[], None] = lambda: None, note: Note = nowhere,
    joined: Callable[[str], None] = lambda which: None,
) -> dict[str, Any]:  # fmt: skip
    """Start a Ray of our own with `cpus` CPUs (`address` local), or join the one at `address`; what it says of itself.

    A start that fails is tried again: Ray gives some of its processes 15 s, which no setting changes, and which are
    not enough on a busy machine. While that lasts, `raise_if_stopped` is called, and may raise what ends it. Raises
    SpaceDistError if Ray cannot be started or reached; where it takes our call and does not return, the process ends
    with that, and `note` is told. joined: told which one was, `10.0.0.1:6379 (auto)`, as soon as it is.
    """
    where = f"at {address!r} (resources.address, or --address)"
    ours = address == "local"
    options: dict[str, Any] = (
        {"num_cpus": cpus, "include_dashboard": False, "object_store_memory": _OBJECT_STORE_BYTES} if ours else {}
    )
    failures, most = 0, START_SECONDS if ours else JOIN_SECONDS
    late = f"Ray cannot be started or reached {where}: it did not come up in {most:.0f} s"
    while True:
        before, started = set(psutil.Process().children()), Started() if ours else None
        raise_if_stopped()
        try:
            if not ours:
                # `ray.init` itself gives up on an address where nobody answers only after 824 s.
                reach(os.environ.get("RAY_ADDRESS", address) if address == "auto" else address, raise_if_stopped)
            with (
                _turn_to_start(raise_if_stopped) if ours else contextlib.nullcontext(),
                bounded(most, late, started, note=note),
            ):
                context = ray.init(
                    address=address, log_to_driver=False, logging_level=logging.ERROR, configure_logging=False,
                    job_config=_Driver(), **options,
                )  # fmt: skip
        except Interrupted:
            raise
        except Exception as error:  # Ray raises bare ones, too
            failures += 1
            what = first_line(error)
            if not ours or failures == _STARTS:
                raise SpaceDistError(f"Ray cannot be started or reached {where}: {_in_our_words(what)}") from error
            log.warning("Ray did not start (%s); trying again", what)
            ray.shutdown()
            for process in set(psutil.Process().children()) - before:  # halves of a Ray
                with contextlib.suppress(psutil.Error):
                    process.kill()
        else:
            found: dict[str, Any] = context.address_info  # type: ignore[attr-defined]
            if not ours:
                joined(f"{found['gcs_address']} (auto)" if address == "auto" else address)
            return {**found, "started": started}


def _in_our_words(what: str) -> str:
    """Why no Ray was found, and what to do then: Ray's own advice names options that are not ours."""
    if _NONE_RUNS in what:
        what = "no Ray runs on this machine"
    elif not what.startswith(NOBODY_LISTENS):
        return what
    return f"{what}. `ray start --head` starts one there; where no address is given, a run starts a private Ray"


@contextlib.contextmanager
def attended(
    found: Mapping[str, Any], address: str, *, gone: bool, leave: Callable[[], None], note: Note = nowhere
) -> Iterator[None]:  # fmt: skip
    """Watch the Ray that `join_ray` `found` at `address`; see `ray_watch.watched`. Afterwards none of ours is left.

    leave: shuts down or disconnects, once nobody watches any more: what ends on purpose has not died.
    """
    started: Started | None = found["started"]
    where = "of our own" if started else f"at {address!r} (resources.address, or --address)"
    addresses = parts(ray.nodes(), found["node_id"], found["gcs_address"])  # type: ignore[no-untyped-call]
    if started is not None:
        # While its parents live: whose parent has died can no longer be told.
        started.look()
    try:
        with watched(addresses, where, started, gone=gone, note=note):
            yield
    finally:
        late = f"the Ray {where} did not shut down in {SILENT_SECONDS:.0f} s. What was committed is intact"
        with bounded(SILENT_SECONDS, late, started, Interrupted.exit_code, note):
            leave()
        if started is not None:
            started.end()


@contextlib.contextmanager
def _turn_to_start(raise_if_stopped: Callable[[], None]) -> Iterator[None]:
    """Wait for other Rays of ours on this machine to be up: together, nine processes each, all would be too slow.

    An abstract socket is held, which is nobody's file, and free again whatever becomes of its holder.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as turn:
        until = time.monotonic() + _TURN_SECONDS
        # Abstract sockets are Linux's alone (unix(7)). Out of time, it starts all the same: turns only save time.
        while sys.platform == "linux" and time.monotonic() < until:
            try:
                turn.bind(f"\0space_dist starts a Ray for {os.getuid()}")
                break
            except OSError:
                raise_if_stopped()
                time.sleep(_LOOK_SECONDS)
        yield


def shut_down() -> None:
    """Leave Ray; one of our own ends."""
    ray.shutdown()


def remove_session(folder: str | None) -> None:
    """Remove what a Ray of our own has left of its sockets and logs: Ray itself never does."""
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)


def first_line(error: Exception) -> str:
    """Of what it says, or its kind where it says nothing."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:300]


def cpus() -> tuple[float, float]:
    """CPUs of the cluster: all, and free ones."""
    total: dict[str, float] = ray.cluster_resources()  # type: ignore[no-untyped-call]
    free: dict[str, float] = ray.available_resources()  # type: ignore[no-untyped-call]
    return total.get("CPU", 0.0), free.get("CPU", 0.0)
