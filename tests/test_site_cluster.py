"""What the pages have one type at a Ray cluster and an MLflow server: on one of each, which all of it shares.

The cluster is started by the commands of docs/ray.md themselves, a second node included, which is a second raylet on
this machine. In small: tests/shell.py.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import signal
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest
from ray._private.authentication_test_utils import reset_auth_token_state

from space_dist.experiment.manifest import Grid
from space_dist.ledger import Ledger
from tests.grids import ROOT
from tests.shell import Shell, bash_blocks, executes, one_server

sys.path.append(str(ROOT / "jobs"))

from benchmarks.servers import TrackingServer, free_ports

pytestmark = [pytest.mark.ray, pytest.mark.server, pytest.mark.timeout(900)]  # `status --watch` waits for ever
MARK = "SPACE_DIST_PAGES"  # in the environment of all that is started here
STARTED = """ray() {
  if [ "$1" = start ]; then
    command ray "$@" --num-cpus=6 --object-store-memory=100000000 --dashboard-agent-listen-port="$AGENT" \\
      --include-log-monitor=false --disable-usage-stats
  else
    command ray "$@"
  fi
}
"""


@dataclass
class Place:
    """Where everything is. shared: the folder that all nodes see."""

    shell: Shell
    ports: list[int]
    shared: Path
    server: TrackingServer

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.ports[1]}"


def ours(mark: str) -> list[psutil.Process]:
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get(MARK) == mark and process.pid != os.getpid():
                found.append(process)
        except psutil.Error:
            continue
    return found


@contextlib.contextmanager
def ray_reads_its_environment_anew() -> Iterator[None]:
    """Behind it, for whoever starts Ray in this process next: it reads once whether there is a token."""
    try:
        yield
    finally:
        reset_auth_token_state()


@pytest.fixture(scope="module")
def place(empty_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    """A home folder, a shared one, a cluster as docs/ray.md starts it, and an MLflow server."""
    mark, sockets = secrets.token_hex(8), Path(f"/tmp/sd{secrets.token_hex(4)}")  # noqa: S108 - must be short
    folder, served = tmp_path_factory.mktemp("clone"), tmp_path_factory.mktemp("mlflow")
    shutil.copy(empty_store, served / "mlflow.db")
    with ray_reads_its_environment_anew(), pytest.MonkeyPatch.context() as patch, one_server():
        for name, value in {
            MARK: mark, "HOME": str(folder / "home"), "RAY_TMPDIR": str(sockets), "RAY_AUTH_MODE": "token",
            "PYTHONPATH": str(ROOT), "RAY_USAGE_STATS_ENABLED": "0",
        }.items():  # fmt: skip
            patch.setenv(name, value)
        reset_auth_token_state()
        for made in (folder / "home", sockets):
            made.mkdir()
        with TrackingServer(served, os.environ, folder / "server.txt") as server:
            found = Place(Shell(folder, patch), free_ports(5), folder / "shared", server)
            try:
                head(found)
                yield found
            finally:
                for process in ours(mark):
                    if process.pid != (server.process.pid if server.process else 0):
                        process.send_signal(signal.SIGKILL)
                shutil.rmtree(sockets, ignore_errors=True)


def head(place: Place, tries: int = 3) -> None:
    """The first block of docs/ray.md, on `head`; once more where somebody else came first at a port."""
    gcs, dashboard, agent, *_ = place.ports
    replaced = {"--port=6379": f"--port={gcs}", "8265": str(dashboard)}
    try:
        place.shell.block("ray.md", 0, replaced, f"AGENT={agent}\n{STARTED}")
    except AssertionError as error:
        if tries == 1 or f"The specified port is {gcs}." not in str(error):
            raise
        place.ports = free_ports(5)
        head(place, tries - 1)
    token = place.shell.folder / "home/.ray/auth_token"
    assert token.stat().st_mode & 0o77 == 0


def node(place: Place) -> None:
    """The second, on `node1`; after everything else, since a run that joined two raylets of one machine has failed."""
    place.shell.environment.pop("RAY_ADDRESS", None)  # a job server's, which is no address to `ray start`
    gcs, agent = place.ports[0], place.ports[3]
    place.shell.block("ray.md", 1, {"head:6379": f"127.0.0.1:{gcs}"}, f"AGENT={agent}\n{STARTED}")
    asked = f"ray status --address=127.0.0.1:{gcs}"  # Ray brings it up to date every 5 s
    asked = f"{asked} | tee status.txt; ! grep /12.0 status.txt"
    place.shell.run(f"for time in $(seq 30); do {asked} || break; sleep 1; done")
    assert "/12.0 CPU" in place.shell.said.read_text()


@executes(
    ("ray.md", 0), ("ray.md", 1), ("ray.md", 2), ("ray.md", 3), ("ray.md", 4), ("grids.md", 0), ("grids.md", 2),
    ("training.md", 1), ("tracking.md", 0),
)  # fmt: skip
def test_the_pages_on_a_cluster(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    shell, shared = place.shell, str(place.shared)
    monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{place.ports[0]}")  # what a shell on one of the nodes finds by itself
    shell.environment["RAY_ADDRESS"] = place.address  # what `ray job submit` wants of docs/ray.md's reader
    shell.block("ray.md", 2, {"http://head:8265": place.address, "/shared": shared})
    grid = Grid(place.shared / "runs/pointmass_small")
    runs = grid.manifest().runs()
    assert [grid.ledger(run).status().state for run in runs] == ["done"] * 2
    before = [grid.ledger(run).status_file.read_bytes() for run in runs]
    on_head = {"http://HEAD:8265": place.address, "/shared": shared}
    shell.block("grids.md", 0, on_head)
    assert (place.shell.folder / "home/space_dist/runs/pointmass_small/manifest.json").is_file()
    shell.block("training.md", 1, on_head)
    shell.block("ray.md", 3, {"/shared": shared})
    assert [grid.ledger(run).status_file.read_bytes() for run in runs] == before  # nothing ran twice
    assert Ledger(place.shared / "runs/pointmass_space/s0").status().state == "done"
    shell.block("ray.md", 4, {"--workers 4": "--workers 1"})
    assert Ledger(shell.folder / "runs/cartpole_space/s0").status().state == "done"
    shell.block("grids.md", 2, {
        "[--watch] [--json] [--by-cause]": "--watch --json --by-cause", "[--follow]": "--follow",
        "GRID": "runs/pointmass_small", "'CELL' [--seed 3] ": "'space kappa=16' --seed 0 ",
        "http://HOST:5000": place.server.address,
    })  # fmt: skip
    shell.run(
        "cp -r runs/pointmass_small runs/my_grid; cp configs/grids/pointmass_small.yaml configs/grids/my_grid.yaml"
    )
    shell.block("tracking.md", 0, {"http://127.0.0.1:5000": place.server.address})
    node(place)
    assert {page for page, _ in shell.done} == {"ray.md", "grids.md", "training.md", "tracking.md"}
    assert len(bash_blocks("ray.md")) == 5
