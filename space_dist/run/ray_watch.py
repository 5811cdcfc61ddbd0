"""Whether a Ray still answers, asked from a thread of its own: whoever waits for a Ray that hangs waits for ever.

The question is the greeting of HTTP/2, which every gRPC server answers by itself: a stopped process (SIGSTOP, a frozen
cgroup, a machine asleep) takes the connection, which is the kernel's work, and says nothing. A busy one answers late:
only minutes of silence without a single answer count. The thread cannot wake the one that waits inside Ray, so it ends
the process: with 75, for what was committed is intact and `--resume` goes on.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Literal

import psutil

from space_dist.errors import CONTINUES, Interrupted, SpaceDistError
from space_dist.system.ray_address import fault, split, unresolved

REACH_SECONDS = 30.0  # to get an answer from an address, before Ray is asked to join it
JOIN_SECONDS = 300.0  # for `ray.init` to join: more than it takes on a busy machine, less than its own 824 s
START_SECONDS = 900.0  # for a Ray of our own to be up, with all that it tries again
SILENT_SECONDS = 180.0  # without any answer, after which a Ray is taken to hang
GONE_SECONDS = 3.0  # that a Ray of our own is refused by: nobody else would start it again
OTHERS_GONE_SECONDS = 45.0  # that another's is: its head may come back; after 60 s Ray would abort this process

NOBODY_LISTENS = "nobody listens there"  # how a sentence begins, where an address is not a Ray's
_ASK_SECONDS = 10.0  # for one answer
_PAUSE_SECONDS = 2.0
_LOOK_SECONDS = 10.0  # between two looks at which processes a Ray of our own has
_NOTE_SECONDS = 5.0  # that it may take to note why the process ends
_END_SECONDS = 5.0  # that Ray's own processes get to end by themselves
# A client's preface and an empty SETTINGS frame: RFC 9113, sections 3.4 and 6.5.
_GREETING = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + b"\x00\x00\x00\x04\x00\x00\x00\x00\x00"

Note = Callable[[str, int], None]
"""Puts on record why, and with which exit code, the process ends. Called from a thread of its own."""

log = logging.getLogger("space_dist")


def nowhere(sentence: str, code: int) -> None:
    """A `Note` of whoever keeps no record."""


def asked(address: str, seconds: float = _ASK_SECONDS) -> Literal["answers", "silent", "gone"]:
    """What becomes of a greeting sent to HOST:PORT: answered, even by hanging up; not within `seconds`; or refused."""
    host, _, port = address.rpartition(":")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=seconds) as line:
            line.sendall(_GREETING)
            line.recv(1)
    except TimeoutError:
        return "silent"
    except ConnectionResetError:
        return "answers"
    except OSError:
        return "gone"
    return "answers"


def reach(address: str, raise_if_stopped: Callable[[], None]) -> None:
    """Wait until HOST:PORT answers, for 30 s at most; other addresses are Ray's to find. Raises SpaceDistError."""
    if must := fault(address):  # of RAY_ADDRESS, which `auto` stands for where it is set
        raise SpaceDistError(f"an address {must}, not {address[:100]!r}")
    host_and_port = split(address)
    if host_and_port is None:
        return
    until = time.monotonic() + REACH_SECONDS
    while (found := asked(address, max(0.1, min(_ASK_SECONDS, until - time.monotonic())))) != "answers":
        raise_if_stopped()
        if time.monotonic() > until:
            what = NOBODY_LISTENS if found == "gone" else "what listens there does not answer"
            raise SpaceDistError(unresolved(host_and_port[0]) or f"{what}, for {REACH_SECONDS:.0f} s")
        time.sleep(0.2)


class Started:
    """The processes that a Ray of our own consists of, and no others: what `ray.init` started, and its raylet did.

    Processes are told by their id and the time at which they began, so a number that was given anew is not mistaken.
    """

    def __init__(self) -> None:
        self._before = set(psutil.Process().children())
        self._known: set[psutil.Process] = set()

    def look(self) -> None:
        """Remember who belongs to it now: whose parents have died can no longer be told."""
        with contextlib.suppress(psutil.Error):
            ours = {one for one in set(psutil.Process().children()) - self._before if _is_of_ray(one)}
            self._known |= ours
            for one in ours:
                with contextlib.suppress(psutil.Error):
                    self._known |= set(one.children())

    def end(self, seconds: float = _END_SECONDS) -> None:
        """Kill those that do not end by themselves within `seconds`."""
        self.look()
        for process in psutil.wait_procs(self._known, timeout=seconds)[1]:
            with contextlib.suppress(psutil.Error):
                process.kill()

    def end_with_us(self) -> None:
        """Kill it for a process that ends now: all but the raylet at once, and that one when nobody is left to see it.

        Ray's library ends a process whose raylet is gone, with a code of its own. Until then the raylet is stopped, so
        that it starts nobody.
        """
        self.look()
        raylets = [process for process in self._known if _name(process) == "raylet"]
        for process in raylets:
            with contextlib.suppress(psutil.Error):
                process.suspend()
        for process in self._known - set(raylets):
            with contextlib.suppress(psutil.Error):
                process.kill()
        numbers = [str(process.pid) for process in raylets]
        try:
            subprocess.Popen(
                # -I and -S: it imports nothing of the user, whose folder or environment may be what failed.
                [sys.executable, "-I", "-S", "-c", _KILL_BEHIND, str(os.getpid()), *numbers], start_new_session=True,
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        except OSError:
            for process in raylets:
                with contextlib.suppress(psutil.Error):
                    process.kill()


# Kills processes once the one that started it is gone.
_KILL_BEHIND = """
import os, signal, sys, time
own, *numbers = map(int, sys.argv[1:])
until = time.monotonic() + 10.0
while os.getppid() == own and time.monotonic() < until:
    time.sleep(0.01)
for number in numbers:
    try:
        os.kill(number, signal.SIGKILL)
    except OSError:
        pass
"""


def _name(process: psutil.Process) -> str:
    try:
        name: str = process.name()
    except psutil.Error:
        return ""
    return name


def _is_of_ray(process: psutil.Process) -> bool:
    try:
        return any("/ray/" in part for part in process.cmdline())
    except psutil.Error:
        return False


@contextlib.contextmanager
def bounded(
    seconds: float, sentence: str, started: Started | None, code: int = SpaceDistError.exit_code, note: Note = nowhere
) -> Iterator[None]:
    """End the process with `sentence` and `code` if the block takes longer: Ray itself cannot be interrupted."""
    timer = threading.Timer(seconds, _end, (sentence, started, code, note))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextlib.contextmanager
def watched(
    addresses: Mapping[str, str], where: str, started: Started | None, *, gone: bool, note: Note = nowhere
) -> Iterator[None]:  # fmt: skip
    """Ask the parts of a Ray, `addresses` (name -> HOST:PORT), all the while; end the process with 75 if one hangs.

    where: of which Ray, for people. started: what it consists of, if it is our own, which is then killed. gone: whether
    one that nobody listens at any more is the end, too. note: is told of the end.
    """
    over = threading.Event()
    threading.Thread(target=_watch, args=(addresses, where, started, gone, over, note), daemon=True).start()
    try:
        yield
    finally:
        over.set()


def _watch(
    addresses: Mapping[str, str], where: str, started: Started | None, gone: bool, over: threading.Event, note: Note
) -> None:  # fmt: skip
    """The clock counts at most what asking takes: a process that was itself stopped, or slept, blames nobody."""
    limits = {"silent": SILENT_SECONDS, "gone": GONE_SECONDS if started else OTHERS_GONE_SECONDS}
    since = {name: dict.fromkeys(limits, 0.0) for name in addresses}
    last, looked = time.monotonic(), 0.0
    while not over.wait(_PAUSE_SECONDS):
        if started is not None and time.monotonic() - looked > _LOOK_SECONDS:
            started.look()
            looked = time.monotonic()
        found = {name: asked(target) for name, target in addresses.items()}
        now = time.monotonic()
        took, last = min(now - last, 1.5 * (len(addresses) * _ASK_SECONDS + _PAUSE_SECONDS)), now
        for name, answer in found.items():
            if answer == "answers":
                # A busy Ray answers now and then: only unbroken silence counts.
                since[name] = dict.fromkeys(limits, 0.0)
                continue
            since[name][answer] += took
            waited = since[name][answer]
            if waited >= limits[answer] and (answer == "silent" or gone) and not over.is_set():
                did = "has died" if answer == "gone" else f"has not answered anything for {waited:.0f} s"
                _end(
                    f"{name} of the Ray {where} {did}. What was committed is intact; {CONTINUES}", started,
                    Interrupted.exit_code, note,
                )  # fmt: skip


def _end(sentence: str, started: Started | None, code: int, note: Note) -> None:
    """End the process from another thread than the one that waits, which nothing could wake.

    What is noted is waited for a little: who waits for Ray may be in the middle of a write to a disk that hangs as
    well, and holds the ledger's lock then. The status stays `running` in that case, and its owner is seen to be gone.
    """
    try:
        log.error("%s", sentence)
        with contextlib.suppress(OSError, ValueError):
            print(f"space-dist: {sentence}", file=sys.stderr, flush=True)
        noting = threading.Thread(target=note, args=(sentence, code), daemon=True)
        noting.start()
        noting.join(_NOTE_SECONDS)
        if started is not None:
            started.end_with_us()
    finally:
        # `sys.exit` would end this thread alone.
        os._exit(code)


def parts(nodes: Iterable[Mapping[str, object]], node: object, gcs_address: str) -> dict[str, str]:
    """The control store's address, and that of the raylet of the node with id `node`, from what `ray.nodes()` says."""
    found = {"the control store (GCS)": gcs_address}
    for one in nodes:
        if one.get("NodeID") == node:
            found["the raylet"] = f"{one['NodeManagerAddress']}:{one['NodeManagerPort']}"
    return found
