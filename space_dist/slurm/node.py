"""Ray on one node of an allocation, for as long as the job step that this process is: nothing of it is left behind.

Each node of a cluster-mode job runs `serve`. It starts Ray on the node's own interface and, when it is asked to end or
Ray ends, ends everything below itself and removes Ray's folder. No `ray stop`: that would end other people's Rays, too.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import psutil

from space_dist.errors import SpaceDistError, nearest
from space_dist.system.importing import PYTHON

_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36
_OBJECT_STORE_BYTES = 256 << 20
_LINGER_SECONDS = 20.0  # for runs to make a checkpoint, once their Ray is gone
_TRIES, _TRY_SECONDS = 60, 2.0  # for the head's port to open
_LOOK_SECONDS = 0.1


def address_facing(peer: str, interface: str | None = None) -> str:
    """The IPv4 address of this node: of `interface`, else the one from which it reaches `peer`, if not loopback.

    Raises SpaceDistError if there is none.
    """
    found = {
        name: [entry.address for entry in entries if entry.family == socket.AF_INET]
        for name, entries in psutil.net_if_addrs().items()
    }
    if interface is not None:
        if not found.get(interface):
            names = sorted(name for name, addresses in found.items() if addresses)
            raise SpaceDistError(
                f"{socket.gethostname()} has no IPv4 address on interface {interface!r}{nearest(interface, names)} "
                f"It has {', '.join(names)}"
            )
        return found[interface][0]
    candidates = [_source_towards(peer), *(address for addresses in found.values() for address in addresses)]
    for address in candidates:
        if address is not None and not address.startswith("127."):
            return address
    raise SpaceDistError(f"{socket.gethostname()} has no IPv4 address but loopback")


def _source_towards(peer: str) -> str | None:
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.connect((peer, 9))  # sends nothing
        address: str = udp.getsockname()[0]
        return address
    return None


def serve(head: str, port: int, *, cpus: int, temp: Path, interface: str | None) -> int:
    """Be a node of the Ray whose head is at `head`:`port`, until SIGTERM; returns an exit code: 0 if asked to end.

    temp: a short path on the node's own disk, which is made and removed. Ports from `port` to `port` + 9 are ours.
    """
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)  # whoever loses its parent below becomes our child
    asked = _Asked()
    own = address_facing(head, interface)
    shutil.rmtree(temp, ignore_errors=True)  # of this job before it was requeued
    try:
        temp.mkdir(mode=0o700)  # Ray opens its own folder to all
    except OSError as error:
        raise SpaceDistError(f"{socket.gethostname()} cannot make {temp}: {error.strerror}") from None
    try:
        if own != head:
            _await_port(head, port, asked)
        if asked.to_end:
            return 0
        print(f"{socket.gethostname()}: Ray at {own}, {'head' if own == head else 'worker'}, {cpus} CPUs", flush=True)
        ray = subprocess.Popen(
            [*PYTHON, "-m", "ray.scripts.scripts", "start", *_options(own, head, port, cpus, temp)],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            preexec_fn=_die_with_parent,  # noqa: PLW1509 - there are no threads here
        )  # fmt: skip
        while ray.poll() is None and not asked.to_end:
            time.sleep(_LOOK_SECONDS)
        if asked.to_end:
            return 0
        print(f"{socket.gethostname()}: Ray has ended with exit code {ray.returncode}", file=sys.stderr, flush=True)
        return 1
    finally:
        _end_all(temp)


def _options(own: str, head: str, port: int, cpus: int, temp: Path) -> list[str]:
    options = [
        f"--node-ip-address={own}", f"--num-cpus={cpus}", f"--object-store-memory={_OBJECT_STORE_BYTES}",
        # Short: Linux allows 107 bytes for a socket's path. Ports 0: as the kernel gives them; Ray's own range is
        # the same for every Ray of a node.
        f"--temp-dir={temp / 'r'}", "--min-worker-port=0", "--max-worker-port=0", "--disable-usage-stats", "--block",
        f"--dashboard-agent-listen-port={port + 1}", "--include-log-monitor=false",
    ]  # fmt: skip
    if own == head:
        return [*options, "--head", f"--port={port}", "--include-dashboard=false",
                f"--ray-client-server-port={port + 2}"]  # fmt: skip
    return [*options, f"--address={head}:{port}"]


class _Asked:
    """Whether SIGTERM (the job's script, or SLURM) or SIGINT has come."""

    def __init__(self) -> None:
        self.to_end = False
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._note)
        for number in (signal.SIGUSR1, signal.SIGUSR2, signal.SIGHUP):  # for runs, whose script tells them
            signal.signal(number, signal.SIG_IGN)  # Ray inherits it

    def _note(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002 - the signature is Python's
        self.to_end = True


def _die_with_parent() -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _await_port(host: str, port: int, asked: _Asked) -> None:
    for _ in range(_TRIES):
        if asked.to_end:
            return
        with contextlib.suppress(OSError), socket.create_connection((host, port), timeout=_TRY_SECONDS):
            return
        time.sleep(_TRY_SECONDS / 2)
    raise SpaceDistError(f"{socket.gethostname()} does not reach Ray's head at {host}:{port}")


def _end_all(temp: Path) -> None:
    """Ray at once, which keeps nothing; then what supervises runs, which notices, and gets time for a checkpoint."""
    for process in _below():
        if not _is_supervisor(process):
            _kill(process)
    shutil.rmtree(temp, ignore_errors=True)
    _reap_until(lambda: not _below(), _LINGER_SECONDS)
    for process in _below():
        _kill(process)
    _reap_until(lambda: not _below(), _LOOK_SECONDS)
    # Again: the last of Ray's processes may have written there as they ended.
    shutil.rmtree(temp, ignore_errors=True)


def _below() -> list[psutil.Process]:
    return [process for process in psutil.Process().children(recursive=True) if _alive(process)]


def _alive(process: psutil.Process) -> bool:
    with contextlib.suppress(psutil.Error):
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    return False


def _is_supervisor(process: psutil.Process) -> bool:
    """Whether it supervises a run, or is one: those are forks, with the same command line."""
    with contextlib.suppress(psutil.Error):
        return "space_dist.grid.supervisor" in process.cmdline()
    return False


def _kill(process: psutil.Process) -> None:
    with contextlib.suppress(psutil.Error):
        process.kill()


def _reap_until(done: Callable[[], bool], seconds: float) -> None:
    until = time.monotonic() + seconds
    while True:
        with contextlib.suppress(ChildProcessError):
            # As subreaper we are the parent of whatever lost its own, and nobody else would reap it.
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        if done() or time.monotonic() > until:
            return
        time.sleep(_LOOK_SECONDS)
