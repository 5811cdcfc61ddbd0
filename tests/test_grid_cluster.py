"""Grids on a real Ray cluster: submitted once, run once, whoever submits how often, and whoever is killed."""

from __future__ import annotations

import json
import math
import os
import re
import secrets
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from space_dist.api.tuning import run_search
from space_dist.errors import SpaceDistError
from space_dist.experiment.manifest import Grid, Run
from space_dist.experiment.status import Attempts
from space_dist.grid.planning import plan
from space_dist.ledger import METRICS, this_process
from space_dist.run.claiming import stored_config
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests
from space_dist.system.workplace import private_ray
from tests.grids import ROOT, write_grid
from tests.test_tuning_runs import tiny_tune

sys.path.append(str(ROOT / "jobs"))

from benchmarks.servers import RayHead

from tests.patience import PATIENCE

pytestmark = pytest.mark.ray


@pytest.fixture(scope="module")
def cluster() -> Iterator[RayHead]:
    folder = Path(f"/tmp/sd{secrets.token_hex(4)}")  # noqa: S108 - socket paths must be short
    try:
        with RayHead(folder, 3, {**os.environ, "PYTHONPATH": str(ROOT)}, Path(os.devnull)) as head:
            yield head
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def searched_here(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Grid]:
    """The file of a search of two generations, and that search, run on no cluster."""
    folder = tmp_path_factory.mktemp("searched")
    path = tiny_tune(folder, arms={"a": {}}, pruner={"rungs": [1], "keep": 0.5})
    return path, run_search(path, root=folder / "runs", progress=False).grid


def start(cluster: RayHead, *arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "space_dist.cli", *map(str, arguments)], env=cluster.environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip


def begun(grid: Grid, runs: list[Run]) -> list[int]:
    return [sum(row["event"] == "begin" for row in Attempts(grid.ledger(run)).rows()) for run in runs]


def metrics(grid: Grid, runs: list[Run]) -> list[bytes]:
    return [(grid.ledger(run).folder / METRICS).read_bytes() for run in runs]


def test_six_jobs_submitted_by_two_at_once_run_once_each(cluster: RayHead, tmp_path: Path) -> None:
    path = write_grid(tmp_path, seeds={"count": 3})
    submit = ("grid", "submit", path, "--address", cluster.address, "--root", tmp_path / "runs", "--mode", "jobs")
    both = [start(cluster, *submit) for _ in range(2)]
    asked = start(cluster, *submit)
    assert asked.stdout is not None
    assert any("conducted by job" in line and f"into {tmp_path / 'runs/small'} there" in line for line in asked.stdout)
    asked.terminate()
    told = asked.communicate(timeout=PATIENCE)[0]
    assert asked.returncode == 75, told
    assert "SIGTERM: no longer looking on; what was submitted goes on in the cluster" in told
    assert "checkpoint, which takes" not in told
    said = [process.communicate(timeout=PATIENCE)[0] for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    assert all("small: 6 of 6 runs done" in text for text in said)
    grid = Grid(tmp_path / "runs/small")
    runs = grid.manifest().runs()
    assert begun(grid, runs) == [1] * 6
    jobs = [job for job in cluster.ask("/api/jobs/") if (job["metadata"] or {}).get("folder") == str(grid.folder)]
    assert sorted(job["submission_id"] for job in jobs) == sorted(f"small-{run.cell.id}-s{run.seed}-a1" for run in runs)
    assert {job["metadata"]["code"] for job in jobs} == {grid.manifest().code}
    assert all("/" not in job["submission_id"] for job in jobs)
    before = metrics(grid, runs)
    again = start(cluster, *submit)
    assert "6 of 6 runs done" in again.communicate(timeout=PATIENCE)[0]
    assert again.returncode == 0
    assert begun(grid, runs) == [1] * 6
    assert metrics(grid, runs) == before
    for number, run in enumerate(runs):
        alone = launch(stored_config(grid.ledger(run)), tmp_path / f"alone{number}", resume=False, stop=StopRequests())
        assert (alone.ledger.folder / METRICS).read_bytes() == before[number]
    status = start(cluster, "grid", "status", grid.folder, "--json")
    assert json.loads(status.communicate(timeout=PATIENCE)[0])["counts"] == {"done": 6}
    assert status.returncode == 0


@pytest.mark.parametrize("mode", ["jobs", "pool"])
def test_a_killed_conductor_and_a_killed_submitter_change_nothing(cluster: RayHead, tmp_path: Path, mode: str) -> None:
    path = write_grid(tmp_path, seeds={"count": 2})
    submit = ("grid", "submit", path, "--address", cluster.address, "--root", tmp_path / "runs", "--mode", mode)
    submitter = start(cluster, *submit)
    grid = Grid(tmp_path / "runs/small")
    deadline = time.monotonic() + PATIENCE

    def done() -> int:
        runs = grid.manifest().runs() if grid.manifest_file.exists() else []
        return sum(grid.ledger(run).status_file.exists() and grid.ledger(run).status().state == "done" for run in runs)

    while done() < 1 and time.monotonic() < deadline:
        time.sleep(0.1)
    assert done() < 4, "killed too late to show anything"
    submitter.kill()
    submitter.communicate()
    conductor = [process for process in psutil.process_iter(["cmdline"])
                 if "manifest.json" in (process.info["cmdline"] or []) and str(tmp_path / "runs") in
                 process.info["cmdline"]]  # fmt: skip
    assert conductor, "no conductor was there to be killed"
    for process in conductor:
        process.kill()
    again = start(cluster, *submit)
    said = again.communicate(timeout=PATIENCE)[0]
    assert again.returncode == 0, said
    assert "4 of 4 runs done" in said
    runs = grid.manifest().runs()
    finished_once = [
        sum(row["event"] == "end" and row["cause"] is None for row in Attempts(grid.ledger(run)).rows()) for run in runs
    ]
    assert finished_once == [1] * 4
    if mode == "jobs":  # they outlive their conductor
        assert begun(grid, runs) == [1] * 4


@pytest.mark.parametrize("mode", ["pool", "jobs"])
def test_a_search_ends_as_it_does_without_a_cluster(
    cluster: RayHead, searched_here: tuple[Path, Grid], tmp_path: Path, mode: str
) -> None:
    path, here = searched_here
    process = subprocess.Popen(
        [sys.executable, "-m", "space_dist.cli", "tune", "run", path, "--root", tmp_path / "runs", "--address", "auto",
         "--mode", mode],
        env={**cluster.environment, "RAY_ADDRESS": cluster.cluster}, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )  # fmt: skip
    said = process.communicate(timeout=PATIENCE)[0]
    assert process.returncode == 0, said
    port = cluster.cluster.rpartition(":")[2]
    assert re.search(rf"^search: joined the Ray at [0-9.]+:{port} \(auto\)$", said, re.MULTILINE)
    grid = Grid(tmp_path / "runs/search")
    assert grid.manifest_file.read_bytes() == here.manifest_file.read_bytes()
    runs = grid.manifest().runs()
    assert begun(grid, runs) == [1] * len(runs)
    assert metrics(grid, runs) == metrics(here, runs)
    jobs = [job for job in cluster.ask("/api/jobs/") if (job["metadata"] or {}).get("folder") == str(grid.folder)]
    assert bool(jobs) is (mode == "jobs")


def test_a_root_that_nodes_do_not_share_is_refused(cluster: RayHead, tmp_path: Path) -> None:
    work = start(cluster,
        "grid", "work", tmp_path, f"{'0' * 12}:0:1", "--nonce", "ab", "--job", "x"
    )  # fmt: skip
    said = work.communicate(timeout=PATIENCE)[0]
    assert work.returncode == 1
    assert "does not see the grid's folder" in said
    assert "Traceback" not in said


def test_a_dead_job_server_is_one_clear_sentence(cluster: RayHead, tmp_path: Path) -> None:
    submit = start(cluster,
        "grid", "submit", write_grid(tmp_path), "--address", "http://127.0.0.1:9", "--root", tmp_path / "runs"
    )  # fmt: skip
    said = submit.communicate(timeout=PATIENCE)[0]
    assert submit.returncode == 1
    assert "does not answer" in said
    assert "`ray start --head` on that machine starts one" in " ".join(said.split())
    assert "Traceback" not in said


def test_a_job_server_that_wants_another_token_is_one_clear_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ray.exceptions import AuthenticationError

    from space_dist.grid import jobs

    def refuse(_: str) -> None:
        raise AuthenticationError("Invalid authentication token.. Ensure that it is available in a local file")

    monkeypatch.setattr(jobs, "JobSubmissionClient", refuse)
    manifest = plan(write_grid(tmp_path), tmp_path / "runs").manifest
    with pytest.raises(SpaceDistError, match=r"lets nobody in .*=token.*\(Invalid authentication token\)$"):
        jobs.Remote("http://127.0.0.1:9", manifest, tmp_path / "runs")


def test_a_job_server_whose_name_nobody_knows_is_told_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from space_dist.grid import jobs

    def lost(_: str) -> None:
        raise ConnectionError("Failed to connect to Ray at address: http://nohost.invalid:8265.")

    monkeypatch.setattr(jobs, "JobSubmissionClient", lost)
    manifest = plan(write_grid(tmp_path), tmp_path / "runs").manifest
    with pytest.raises(SpaceDistError, match=r"reached: the name 'nohost\.invalid' cannot be resolved \(.+\)") as told:
        jobs.Remote("http://nohost.invalid:8265", manifest, tmp_path / "runs")
    assert "ray start" not in str(told.value)


def test_a_place_has_its_share_of_the_memory_of_the_poorest_node(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    private_ray()
    import ray

    from space_dist.grid.jobs import _memory_per_process

    manifest = plan(write_grid(tmp_path, resources={"workers": 1}), tmp_path / "runs").manifest
    gigabyte = 2.0**30
    nodes = [{"Alive": True, "Resources": {"CPU": 8.0, "memory": 64 * gigabyte}},
             {"Alive": True, "Resources": {"CPU": 8.0, "memory": 16 * gigabyte}},
             {"Alive": True, "Resources": {"memory": gigabyte}},
             {"Alive": False, "Resources": {"CPU": 8.0, "memory": gigabyte}}]  # fmt: skip
    monkeypatch.setattr(ray, "nodes", lambda: nodes)
    for name in ("SLURM_MEM_PER_CPU", "SLURM_MEM_PER_NODE"):
        monkeypatch.delenv(name, raising=False)
    assert _memory_per_process(manifest, "auto") == _memory_per_process(manifest, "local") == 4096.0
    monkeypatch.setenv("SLURM_MEM_PER_CPU", "1000")
    assert (_memory_per_process(manifest, "auto"), _memory_per_process(manifest, "local")) == (4096.0, 2000.0)
    monkeypatch.setenv("SLURM_MEM_PER_NODE", "900")
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "1")
    assert _memory_per_process(manifest, "local") == 1800.0
    monkeypatch.setattr(ray, "nodes", list)
    assert _memory_per_process(manifest, "auto") == math.inf


def test_the_nonces_of_killed_conductors_go_with_the_next_ones(tmp_path: Path) -> None:
    private_ray()
    from space_dist.grid.pool import Nonce, refuse_other_folder

    for name, content in (("torn", ""), ("elsewhere", json.dumps(this_process() | {"boot_id": "another"})),
                          ("dead", json.dumps(this_process() | {"started": 1})),
                          ("alive", json.dumps(this_process()))):  # fmt: skip
        (tmp_path / f".nonce-{name}").write_text(content)
    (tmp_path / ".nonce-old").write_text("")
    os.utime(tmp_path / ".nonce-old", (1e9, 1e9))
    nonce = Nonce(Grid(tmp_path))
    nonce.place()
    refuse_other_folder(tmp_path, nonce.text)
    nonce.remove()
    assert sorted(path.name for path in tmp_path.iterdir()) == [".nonce-alive", ".nonce-elsewhere", ".nonce-torn"]
