"""What benchmarks run against: a Ray cluster and an MLflow server of their own on loopback, which may be killed."""

from __future__ import annotations

import os
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import psutil
import requests

from space_dist.errors import SpaceDistError

_START_SECONDS = 400.0  # on a busy machine; who gives up sooner begins again from nothing
_END_SECONDS = 20.0
_STARTS = 5  # what was killed may hold its ports for a moment, and Ray gives up on a busy machine
_RESERVED: list[socket.socket] = []  # see `free_ports`


class _Server:
    """A process in a group of its own that is up once it answers, and can be started again at the same address."""

    name: str
    address: str

    def __init__(self, command: list[str], environment: Mapping[str, str], output: Path) -> None:
        self._command, self._environment, self._output = command, dict(environment), output
        self.process: subprocess.Popen[bytes] | None = None
        self._given_up = False

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    def start(self) -> None:
        """Returns once it answers. Raises SpaceDistError if it does not, or is given up meanwhile."""
        for _ in range(_STARTS):
            if self._given_up:
                raise SpaceDistError(f"{self.name} was given up while it started")
            with self._output.open("ab") as output:
                self.process = subprocess.Popen(
                    self._command, env=self._environment, start_new_session=True,
                    stdin=subprocess.DEVNULL, stdout=output, stderr=output,
                )  # fmt: skip
            deadline = time.monotonic() + _START_SECONDS
            while self.process.poll() is None and time.monotonic() < deadline and not self._given_up:
                with suppress(requests.RequestException):
                    if self.healthy():
                        return
                time.sleep(0.3)
            self.kill()
            time.sleep(0.0 if self._given_up else 2.0)
        raise SpaceDistError(f"{self.name} did not start; what it said is in {self._output}")

    def healthy(self) -> bool:
        """Whether it answers. May raise a RequestException, too."""
        raise NotImplementedError

    def own(self) -> list[psutil.Process]:
        """The processes that are the server, and not its users' work."""
        raise NotImplementedError

    def kill(self) -> list[psutil.Process]:
        """SIGKILL to all of it at once; returns what was killed."""
        victims = self.own()
        for victim in victims:
            with suppress(psutil.NoSuchProcess):
                victim.kill()
        if self.process is not None:
            self.process.wait()
        return victims

    def give_up(self) -> None:
        """For another thread than that of `start`: it need not come up any more."""
        self._given_up = True

    def end(self) -> None:
        """Ask it to end, and kill what does not."""
        if self.process is None or self.process.poll() is not None:
            return
        below = psutil.Process(self.process.pid).children(recursive=True)
        self.process.send_signal(signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(_END_SECONDS)
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        for process in psutil.wait_procs(below, timeout=2.0)[1]:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        self.process.wait()


class RayHead(_Server):
    """`ray start --head`: never `ray stop`, which would end other people's, too.

    temp: Ray's own folder; its path must be short, since sockets lie in it. `environment` is for whoever submits;
    `cluster` is the RAY_ADDRESS of whoever joins.
    """

    name = "Ray"

    def __init__(self, temp: Path, cpus: int, environment: Mapping[str, str], output: Path) -> None:
        token, binaries = secrets.token_hex(32), Path(sys.executable).parent
        ports = free_ports(3)
        self.address, self.cluster = f"http://127.0.0.1:{ports[1]}", f"127.0.0.1:{ports[0]}"
        self.environment = {
            **environment, "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": token, "RAY_USAGE_STATS_ENABLED": "0",
            "PATH": f"{binaries}{os.pathsep}{environment['PATH']}",
        }  # fmt: skip
        self._headers = {"Authorization": f"Bearer {token}"}
        command = [
            str(binaries / "ray"), "start", "--head", "--block", f"--num-cpus={cpus}", f"--port={ports[0]}",
            "--dashboard-host=127.0.0.1", f"--dashboard-port={ports[1]}", f"--dashboard-agent-listen-port={ports[2]}",
            "--object-store-memory=150000000", f"--temp-dir={temp}", "--disable-usage-stats",
        ]  # fmt: skip
        super().__init__(command, self.environment, output)

    def healthy(self) -> bool:
        """See `_Server`."""
        return requests.get(f"{self.address}/api/jobs/", headers=self._headers, timeout=5).ok

    def ask(self, path: str) -> Any:
        """What the dashboard answers, as JSON. Raises RequestException, or ValueError for what is none."""
        answer = requests.get(f"{self.address}{path}", headers=self._headers, timeout=20)
        answer.raise_for_status()
        return answer.json()

    def own(self) -> list[psutil.Process]:
        """Everything of Ray's but the workers, which are the raylet's children."""
        if self.process is None or self.process.poll() is not None:
            return []
        top = psutil.Process(self.process.pid)
        found = [top]
        for child in top.children():
            found.append(child)
            if Path(child.name()).name != "raylet":
                found += child.children(recursive=True)
        return found


class TrackingServer(_Server):
    """`mlflow server` with an SQLite file in `folder`."""

    name = "MLflow"

    def __init__(self, folder: Path, environment: Mapping[str, str], output: Path) -> None:
        [port] = free_ports(1)
        self.address, self.database = f"http://127.0.0.1:{port}", folder / "mlflow.db"
        command = [
            sys.executable, "-m", "mlflow", "server", "--backend-store-uri", f"sqlite:///{self.database}",
            "--artifacts-destination", str(folder / "artifacts"), "--host", "127.0.0.1", "--port", str(port),
            "--workers", "1", "--allowed-hosts", f"127.0.0.1:{port},localhost:{port}",
        ]  # fmt: skip
        quiet = {"MLFLOW_DISABLE_TELEMETRY": "true", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
        super().__init__(command, {**environment, **quiet}, output)

    def healthy(self) -> bool:
        """See `_Server`."""
        return requests.get(f"{self.address}/health", timeout=3).ok

    def own(self) -> list[psutil.Process]:
        """See `_Server`."""
        if self.process is None or self.process.poll() is not None:
            return []
        top = psutil.Process(self.process.pid)
        return [top, *top.children(recursive=True)]


def free_ports(count: int) -> list[int]:
    """Below Ray's own range for workers. Ray's default ports may be another Ray's.

    They are ours for as long as this process lives: nobody else who asks here is given them, though it takes a server
    seconds to listen at its own.
    """
    ports: list[int] = []
    while len(ports) < count:
        port, mark = 6400 + secrets.randbelow(3000), socket.socket(socket.AF_UNIX)
        try:
            mark.bind(f"\0space-dist-port-{port}")  # in no file system: gone with the last process that has it open
            with socket.socket() as listening:
                listening.bind(("", port))  # on any of the machine's addresses, as a server would
        except OSError:
            mark.close()
            continue
        _RESERVED.append(mark)
        ports.append(port)
    return ports


def until(condition: Callable[[], bool], seconds: float, pause: float = 0.1) -> bool:
    """Wait for a condition; False if it did not come true in time."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(pause)
    return True
