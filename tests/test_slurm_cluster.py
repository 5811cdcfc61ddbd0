"""Grids and a search on a real Slurm of two nodes, which these tests start: preempted, out of time, short of a node.

Every test compares with `grid run` of the same grid here: the same `metrics.jsonl`, byte for byte; that of a search
with `tune run`: the same `manifest.json`.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from space_dist.config import to_yaml
from space_dist.experiment.manifest import Grid
from space_dist.experiment.status import Attempts
from space_dist.ledger import METRICS, Ledger
from space_dist.slurm import Export, Profile
from space_dist.slurm import export as write_scripts
from space_dist.slurm.export import AGGREGATE, JOBS, TRAIN, render
from tests.patience import PATIENCE
from tests.shell import bash_blocks, executes, write_small_configs
from tests.slurm.gated_env import GATE
from tests.slurm.profiles import FIELDS, RESERVATION, exports
from tests.test_grid_tracking import everything
from tests.test_tracking import histories

ROOT = Path(__file__).resolve().parent.parent
HERE = ROOT / "tests/slurm"
pytestmark = pytest.mark.slurm
KINDS = ({"kind": "space"}, {"kind": "round_robin"}, {"kind": "random_growth"}, {"kind": "space", "kappa": 2})


@dataclass
class Slurm:
    """A Slurm of its own. Node n1's /var/tmp is folder/tmp.n1 here, and nobody else's."""

    folder: Path

    def ask(self, *command: str) -> str:
        done = self.asked(*command)
        assert done.returncode == 0, (command, done.stdout, done.stderr)
        return done.stdout

    def asked(self, *command: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, env=self.environment)

    def end_now(self, job: str) -> bool:
        """Have a job's time be over. scontrol reads the clock: on a busy machine its `now` is over, and refused."""
        done = self.asked("scontrol", "update", f"JobId={job}", "EndTime=now")
        assert done.returncode == 0 or "Invalid time specified" in done.stderr, (job, done.stdout, done.stderr)
        return done.returncode == 0

    @property
    def environment(self) -> dict[str, str]:
        ours = {name: value for name, value in os.environ.items() if not name.startswith(("SLURM_", "RAY_"))}
        return {**ours, "SLURM_CONF": str(self.folder / "slurm.conf"), "PYTHONPATH": str(ROOT)}

    def job(self, job: str) -> dict[str, str]:
        """What scontrol tells of a job, or of one element of an array."""
        words = self.ask("scontrol", "-o", "show", "job", job).splitlines()[0].split()
        return {name: value for name, _, value in (word.partition("=") for word in words)}

    def node_holder(self, number: int) -> int:
        return int((self.folder / f"run/n{number}.host.pid").read_text())

    def left_on(self, number: int) -> list[str]:
        """Files of jobs on a node, and processes beside the node's own."""
        files = [path.name for path in (self.folder / f"tmp.n{number}").iterdir()]
        holder = self.node_holder(number)
        [init] = Path(f"/proc/{holder}/task/{holder}/children").read_text().split()
        space = Path(f"/proc/{init}/ns/pid").readlink()
        for process in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                if process.name.isdecimal() and (process / "ns/pid").readlink() == space:
                    words = (process / "cmdline").read_bytes().replace(b"\0", b" ").decode()
                    if words and not words.startswith(("slurmd", "bash -c", "slurmstepd")):
                        files.append(words)
        shared = [path.name for path in Path(f"/proc/{init}/root/dev/shm").iterdir() if path.name != "slurmd.pid"]
        return [*files, *shared]


@pytest.fixture(scope="module")
def disk() -> Iterator[Path]:
    """In place of pytest's folders, which may be in /dev/shm (`conftest`): each node has another one there."""
    with tempfile.TemporaryDirectory(prefix="space-dist-slurm-") as folder:
        yield Path(folder).resolve()


@pytest.fixture
def tmp_path(disk: Path) -> Path:
    return Path(tempfile.mkdtemp(dir=disk))


@pytest.fixture(scope="module")
def slurm(disk: Path) -> Iterator[Slurm]:
    installed = subprocess.run([HERE / "install.sh"], capture_output=True, text=True, timeout=PATIENCE)
    if installed.returncode:
        pytest.skip(f"Slurm cannot be installed here: {installed.stderr.strip().splitlines()[-1]}")
    probe = (
        "unshare --pid --fork --mount --net --uts --ipc true && ip link add spprobe type bridge && ip link del spprobe"
    )
    refused = subprocess.run(["bash", "-c", f"PATH=$PATH:/sbin:/usr/sbin; {probe}"], capture_output=True, text=True)
    if refused.returncode:
        pytest.skip(
            f"Slurm's two nodes need namespaces and a bridge, which this machine refuses: {refused.stderr.strip()}"
        )
    found = Slurm(disk / "slurm")
    found.folder.mkdir()
    try:
        up = subprocess.run([HERE / "up.sh", found.folder], capture_output=True, text=True, timeout=PATIENCE)
        assert up.returncode == 0, up.stdout + up.stderr
        yield found
    finally:
        subprocess.run([HERE / "down.sh", found.folder], capture_output=True, timeout=PATIENCE)


def space_dist(*arguments: object, slurm: Slurm | None = None) -> str:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)} if slurm is None else slurm.environment
    done = subprocess.run(
        [sys.executable, "-m", "space_dist.cli", *map(str, arguments)],
        capture_output=True, text=True, timeout=PATIENCE, env=environment, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def write_grid(folder: Path, name: str, *, seeds: tuple[int, ...], **more: object) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for split, targets in (("train", (-0.8, -0.3, 0.2, 0.7)), ("test", (-0.6, 0.5))):
        rows = "".join(f"{index},{target}\n" for index, target in enumerate(targets))
        (folder / f"{split}.csv").write_text("id,target\n" + rows)
    (folder / "run.yaml").write_text(to_yaml({
        "name": "base", "env": {"id": "tests.slurm.gated_env:make"},
        "instances": {"train": "train.csv", "test": "test.csv"}, "curriculum": {"kind": "space"},
        "learner": {"kind": "ppo", "n_steps": 512, "n_epochs": 1, "net_arch": [16]},
        "rollout": {"shards": 1, "slots": 1}, "budget": {"steps": 8192}, "evaluation": {"every_steps": 4096},
        "checkpoint": {"every_rounds": 1},
    }))  # fmt: skip
    (folder / f"{name}.yaml").write_text(to_yaml({
        "name": name, "extends": "run.yaml", "seeds": list(seeds), "tracking": {"uri": None},
        "resources": {"grace_seconds": 20.0}, **more,
    }))  # fmt: skip
    return folder / f"{name}.yaml"


def write_search(folder: Path) -> Path:
    """Two arms of two trials on the gated line, in two generations."""
    grid = write_grid(folder, "unused", seeds=(0,))
    (folder / "final.csv").write_text("id,target\n0,-0.5\n1,0.6\n")
    grid.with_name("search.yaml").write_text(to_yaml({
        "name": "search", "extends": "run.yaml", "trials": 2, "generation": 1, "seeds": [0, 1],
        "search": {"learner.learning_rate": {"float": [1.0e-4, 1.0e-2], "log": True}},
        "arms": {"space": {}, "robin": {"set": {"curriculum": {"kind": "round_robin"}}}},
        "confirm": {"seeds": [9], "instances": {"test": "final.csv"}},
        "tracking": {"uri": None}, "resources": {"grace_seconds": 20.0},
    }))  # fmt: skip
    return grid.with_name("search.yaml")


@pytest.fixture(scope="module")
def reference(disk: Path) -> Grid:
    """Eight runs, done by `grid run` here."""
    folder = disk / "here"
    grid = write_grid(folder, "eight", seeds=(0, 1), grid={"curriculum": list(KINDS)})
    space_dist("grid", "run", grid, "--root", folder / "runs")
    return Grid(folder / "runs/eight")


def export(
    grid: Path, out: Path, gate: Path, *options: object, python_path: str = str(ROOT), slurm: Slurm | None = None,
    **more: object,
) -> Path:  # fmt: skip
    profile = out.with_suffix(".yaml")
    profile.write_text(to_yaml({
        "mem": 1500, "temp": "/var/tmp", "signal": {"lead_seconds": 115},  # noqa: S108 - the nodes' own
        "command": [sys.executable, "-m", "space_dist.cli"],
        "env": {"PYTHONPATH": python_path, GATE: str(gate), "RAY_worker_niceness": "0"}, **more,
    }))  # fmt: skip
    space_dist("slurm", "export", grid, "--out", out, "--profile", profile, *options, slurm=slurm)
    return out


def await_(what: Callable[[], bool], why: str, folder: Path) -> None:
    until = time.monotonic() + PATIENCE
    while not what():
        if time.monotonic() > until:
            logs = "\n".join(f"== {log}\n{log.read_text()[-3000:]}" for log in sorted(folder.glob("logs/*")))
            pytest.fail(f"waited for {PATIENCE:.0f} s: {why}\n{logs}")
        time.sleep(0.3)


def submitted(slurm: Slurm, folder: Path) -> tuple[str, str]:
    """Ids of the training and the aggregating job, just submitted."""
    space_dist("slurm", "submit", folder, slurm=slurm)
    train, aggregate = [line.split()[0] for line in (folder / JOBS).read_text().splitlines()]
    return train, aggregate


def await_end(slurm: Slurm, job: str, folder: Path) -> str:
    """Its state in the end, and what it has said."""
    over = ("COMPLETED", "FAILED", "CANCELLED", "TIMEOUT", "NODE_FAIL")
    await_(lambda: slurm.job(job)["JobState"] in over, f"job {job} to end", folder)
    return slurm.job(job)["JobState"]


def under_way(ledger: Ledger) -> bool:
    """Whether a run has made a checkpoint, and is not done."""
    with contextlib.suppress(Exception):
        return ledger.status().checkpoint is not None and ledger.status().state == "running"
    return False


def assert_same_results(folder: Path, reference: Grid) -> None:
    runs = reference.manifest().runs()
    assert Grid(folder).manifest().runs_digest == reference.manifest().runs_digest
    for run in runs:
        ours = (Grid(folder).ledger(run).folder / METRICS).read_bytes()
        assert ours == (reference.ledger(run).folder / METRICS).read_bytes(), run.title
    assert len(runs) == 8


def hosts(folder: Path) -> set[str]:
    rows = [json.loads(line) for file in folder.glob("*/s*/attempts.jsonl") for line in file.read_text().splitlines()]
    return {row["where"]["host"] for row in rows if row["event"] == "begin"}


def test_an_array_survives_preemption_and_its_time_limit(
    slurm: Slurm, reference: Grid, empty_store: Path, tmp_path: Path
) -> None:
    gate, database = tmp_path / "gate", tmp_path / "mlflow.db"
    gate.touch()  # runs are slow until all that is to happen has happened
    shutil.copy(empty_store, database)
    grid_file = write_grid(
        tmp_path / "written", "eight", seeds=(0, 1), grid={"curriculum": list(KINDS)},
        tracking={"uri": f"sqlite:///{database}"},
    )  # fmt: skip
    # Exported, and then copied elsewhere, as a user would: with nothing but what is in the folder.
    made = export(grid_file, tmp_path / "out", gate, "--cells-per-task", 2, "--throttle", 3, "--check", slurm=slurm)
    folder = tmp_path / "else where" / "grid"
    shutil.copytree(made, folder)
    shutil.rmtree(made)
    train, aggregate = submitted(slurm, folder)
    assert "already in the queue" in space_dist("slurm", "submit", folder, slurm=slurm)
    grid, runs = Grid(folder), reference.manifest().runs()
    names = [f"{train}_{element}" for element in range(4)]

    def await_run(element: int) -> None:
        ledgers = [grid.ledger(run) for run in runs[2 * element : 2 * element + 2]]
        await_(lambda: any(map(under_way, ledgers)), f"element {element} to be under way", folder)

    for element in (0, 1, 2):
        await_run(element)
    assert slurm.job(names[3])["JobState"] == "PENDING"  # the throttle
    slurm.ask("scontrol", "update", f"JobId={names[2]}", "EndTime=now+110")  # which SLURM announces
    slurm.ask("scontrol", "requeue", names[0])
    slurm.ask("scontrol", "requeue", names[1])
    await_run(3)
    slurm.ask("scancel", "--batch", "--signal=USR1", names[3])
    await_(lambda: any(Attempts(grid.ledger(run)).history().begun == 2 for run in runs[:2]), "0 to be back", folder)
    await_(lambda: slurm.end_now(names[0]), "element 0 to be ended, without notice", folder)
    for name, restarts in zip(names, "2111", strict=True):
        await_(lambda: slurm.job(name).get("Restarts") == restarts, f"{name} to be requeued", folder)  # noqa: B023
    gate.unlink()
    assert await_end(slurm, aggregate, folder) == "COMPLETED"
    assert [slurm.job(name)["JobState"] for name in names] == ["COMPLETED"] * 4
    told = [(folder / f"logs/eight-{name}.out").read_text() for name in names]
    assert ["ended at its time limit, without notice" in text for text in told] == [True, False, False, False]
    assert "interrupted; requeued for the 2. time" in told[0]
    said = (folder / f"logs/eight-aggregate-{aggregate}.out").read_text()
    assert "eight: 8 of 8 runs done" in said
    assert "8 runs are up to date in MLflow (8 new" in said
    assert any((folder / "report").iterdir())
    assert_same_results(folder, reference)
    _, children = everything(f"sqlite:///{database}", "eight")
    assert {child.data.tags["space_dist.folder"] for child in children.values()} == {
        str(grid.ledger(run).folder) for run in runs
    }
    for child in children.values():
        assert child.info.status == "FINISHED"
        ledger = Ledger(Path(child.data.tags["space_dist.folder"]))
        evaluations = [(row["steps"], row["test"]["return"]) for row in ledger.rows() if row["kind"] == "evaluation"]
        stored = histories(f"sqlite:///{database}", child)["test/return"]
        assert [(step, value) for step, _, value in stored] == evaluations
    assert "(0 new, 0 rows pushed)" in space_dist("sync", folder)
    for node in (1, 2):
        await_(lambda node=node: slurm.left_on(node) == [], f"n{node} to be clean", folder)


def typed(script: str, status: str, slurm: Slurm, folder: Path) -> subprocess.CompletedProcess[str]:
    """What became of a page's block in an empty folder: configs in small, jobs held, and the status as JSON."""
    write_small_configs(folder / "configs")
    (folder / "configs/slurm/site.yaml").write_text(to_yaml({"mem": 1500, "temp": "/var/tmp"}))  # noqa: S108
    for old, new in (("/shared", f"{folder}/shared"), ("submit.sh ", "submit.sh --hold "),
                     (f"\nspace-dist {status}", f"\nspace-dist {status} --json")):  # fmt: skip
        assert old in script
        script = script.replace(old, new)
    command = f"{sys.executable} -P -m space_dist.cli"
    return subprocess.run(
        ["bash", "-c", f'set -e\nspace-dist() {{ {command} "$@" || [ $? = 3 ]; }}\n{script}'],
        cwd=folder, env=slurm.environment, capture_output=True, text=True, timeout=PATIENCE,
    )  # fmt: skip


@executes(("slurm.md", 0))
def test_what_the_page_has_one_type_is_taken(slurm: Slurm, tmp_path: Path) -> None:
    """Its block, on configs in small and with a profile of this Slurm; what it submits is held, and taken back."""
    [script] = bash_blocks("slurm.md")
    done = typed(script, "grid status", slurm, tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "sbatch --test-only: no objection" in done.stdout
    told = json.loads(done.stdout[done.stdout.index("{") :])
    assert (told["grid"], told["counts"]) == ("pointmass_small", {"waiting": 2})
    jobs = [line.split()[0] for line in (tmp_path / "shared/pointmass_small" / JOBS).read_text().splitlines()]
    assert len(jobs) == 2
    assert slurm.job(jobs[0])["JobState"] == "PENDING"
    slurm.ask("scancel", *jobs)


@executes(("tuning.md", 1))
def test_what_the_page_of_searches_has_one_type_is_taken(slurm: Slurm, tmp_path: Path) -> None:
    """Its block, in small; of what it submits nothing begins to train."""
    done = typed(bash_blocks("tuning.md")[1], "tune status", slurm, tmp_path)
    slurm.ask("scancel", "--user=root")
    assert done.returncode == 0, done.stdout + done.stderr
    told = json.loads(done.stdout[done.stdout.index("{") :])
    assert (told["over"], [*told["slurm"]["jobs"]]) == (False, ["advance"])


def test_a_failing_cell_blocks_nothing_and_is_named(slurm: Slurm, tmp_path: Path) -> None:
    kwargs = {"env.kwargs": [{"fails": True}, {"fails": False}]}
    grid = write_grid(tmp_path / "written", "two", seeds=(0,), grid=kwargs)
    folder = export(grid, tmp_path / "two", tmp_path / "no_gate", "--cells-per-task", 2)
    train, aggregate = submitted(slurm, folder)
    assert await_end(slurm, aggregate, folder) == "FAILED"  # it says that the grid is not complete
    assert slurm.job(aggregate)["ExitCode"] == "1:0"
    assert slurm.job(f"{train}_0")["JobState"] == "FAILED"
    said = (folder / f"logs/two-aggregate-{aggregate}.out").read_text()
    assert "1 of 2 runs done, 1 failed" in said
    assert "fails=true, seed 0" in said
    assert "this environment was made to fail" in said
    assert any((folder / "report").iterdir())


def test_one_ray_over_two_nodes_survives_the_loss_of_one(slurm: Slurm, reference: Grid, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    gate.touch()
    folder = export(
        reference.folder, tmp_path / "grid", gate, "--mode", "cluster", "--check", slurm=slurm,
        python_path=f"{HERE / 'short_lease'}:{ROOT}",
    )  # fmt: skip
    train, aggregate = submitted(slurm, folder)
    grid = Grid(folder)

    def running() -> int:
        return sum(under_way(grid.ledger(run)) for run in reference.manifest().runs())

    await_(lambda: running() == 2, "two runs to be under way", folder)
    assert hosts(folder) == {"n1", "n2"}
    os.kill(slurm.node_holder(2), signal.SIGKILL)
    await_(lambda: slurm.job(train).get("Restarts") == "1", "the job to be requeued", folder)
    gate.unlink()
    subprocess.run([HERE / "up.sh", slurm.folder, "node", "2"], check=True, timeout=PATIENCE)
    assert await_end(slurm, aggregate, folder) == "COMPLETED"
    assert slurm.job(train)["JobState"] == "COMPLETED"
    assert "eight: 8 of 8 runs done" in (folder / f"logs/eight-aggregate-{aggregate}.out").read_text()
    assert_same_results(folder, reference)
    for node in (1, 2):
        await_(lambda node=node: slurm.left_on(node) == [], f"n{node} to be clean", folder)


def test_a_search_survives_being_cancelled_and_the_loss_of_a_node(slurm: Slurm, tmp_path: Path) -> None:
    """Submitted twice, its array and the job after it cancelled, a node killed, the job between two arrays requeued."""
    gate, path = tmp_path / "gate", write_search(tmp_path / "written")
    space_dist("tune", "run", path, "--root", tmp_path / "here")
    gate.touch()
    folder = export(
        path, tmp_path / "grid", gate, "--check", "--cells-per-task", 2, "--set", "exclusive=true", slurm=slurm,
        python_path=f"{HERE / 'short_lease'}:{ROOT}",
    )  # fmt: skip
    grid = Grid(folder)

    def submit() -> list[str]:
        said = space_dist("slurm", "submit", folder, slurm=slurm)
        assert "already in the queue" in space_dist("slurm", "submit", folder, slurm=slurm)
        [first] = [line.split()[-1] for line in said.splitlines() if line.startswith("advance: job")]
        await_(lambda: slurm.job(first)["JobState"] == "COMPLETED", "the array to be submitted", folder)
        jobs = [line.split() for line in (folder / JOBS).read_text().splitlines()]
        assert [kind for _, kind in jobs] == ["train", "advance"]
        return [job for job, _ in jobs]

    def running() -> int:
        return sum(under_way(grid.ledger(run)) for run in grid.manifest().runs())

    jobs = submit()
    await_(lambda: running() == 2, "two runs to be under way", folder)
    slurm.ask("scancel", *jobs)
    await_(lambda: slurm.ask("squeue", "--noheader") == "", "the queue to be empty", folder)
    train, advance = submit()
    await_(lambda: running() == 2 and hosts(folder) == {"n1", "n2"}, "both nodes to be at work", folder)
    os.kill(slurm.node_holder(2), signal.SIGKILL)
    await_(
        lambda: "1" in {slurm.job(f"{train}_{number}").get("Restarts") for number in (0, 1)}, "a requeue", folder
    )  # fmt: skip
    gate.unlink()
    subprocess.run([HERE / "up.sh", slurm.folder, "node", "2"], check=True, timeout=PATIENCE)
    await_(lambda: slurm.job(advance)["JobState"] == "COMPLETED", "the next generation", folder)
    slurm.ask("scontrol", "requeue", advance)  # it is done, and finds so
    await_(
        lambda: grid.manifest().searched.over and slurm.ask("squeue", "--noheader") == "", "the search to end", folder
    )  # fmt: skip
    here = Grid(tmp_path / "here/search")
    assert grid.manifest_file.read_bytes() == here.manifest_file.read_bytes()
    for run in here.manifest().runs():
        assert (grid.ledger(run).folder / METRICS).read_bytes() == (here.ledger(run).folder / METRICS).read_bytes()
    assert (folder / "confirm/search-confirm.yaml").is_file()
    assert (folder / "report/report.html").is_file()
    logs = "".join(log.read_text() for log in folder.glob("logs/search-advance-*.out"))
    assert re.search("nothing to do: job [0-9]+ goes on", logs)  # what was requeued says
    assert "4 of 4 trials asked: 4 complete" in logs
    assert space_dist("tune", "status", folder, slurm=slurm)


def test_sbatch_reads_hostile_values_as_text(slurm: Slurm, reference: Grid, tmp_path: Path) -> None:
    for value in ('a "b" \\c # d', "$(touch canary) `touch canary`", "it's; touch canary #", "#x"):
        made = Export(reference.manifest(), Profile(comment=value), "array")
        (tmp_path / AGGREGATE).write_text(render(made)[AGGREGATE])
        held = subprocess.run(
            ["sbatch", "--parsable", "--hold", AGGREGATE], cwd=tmp_path, env=slurm.environment, text=True,
            capture_output=True, check=True, timeout=PATIENCE,
        )  # fmt: skip
        job = held.stdout.strip()
        shown = slurm.ask("scontrol", "show", "job", job)
        slurm.ask("scancel", job)
        assert f"Comment={value}" in [line.strip() for line in shown.splitlines()], shown
    assert list(tmp_path.glob("**/canary")) == []


def test_sbatch_accepts_every_drawn_profile(slurm: Slurm, reference: Grid, tmp_path: Path) -> None:
    def objection(folder: Path, script: str) -> str:
        done = subprocess.run(
            ["sbatch", "--test-only", script], cwd=folder, env=slurm.environment, text=True, capture_output=True,
            timeout=PATIENCE,
        )  # fmt: skip
        assert (done.returncode == 0) is ("to start at" in done.stderr), done.stderr
        return "" if done.returncode == 0 else done.stderr

    manifest, made = reference.manifest(), exports(reference.manifest(), 40)
    assert {name for one in made for name in one.profile.model_fields_set} == FIELDS | {"apptainer_options"}
    with contextlib.ExitStack() as stack:
        for number, one in enumerate(sorted(made, key=lambda one: one.profile.reservation or "")):
            if one.profile.reservation is not None and RESERVATION not in slurm.ask("scontrol", "show", "reservation"):
                slurm.ask("scontrol", "create", "reservation", f"ReservationName={RESERVATION}", "StartTime=now",
                          "Duration=UNLIMITED", "Users=root", "Nodes=n[1-2]", "Flags=IGNORE_JOBS")  # fmt: skip
                stack.callback(slurm.ask, "scontrol", "delete", f"ReservationName={RESERVATION}")
            write_scripts(one, reference.instance_files(manifest), tmp_path / str(number))
            for script in (TRAIN, AGGREGATE):
                said = objection(tmp_path / str(number), script)
                assert not said, (one.profile.model_dump(exclude_unset=True), script, said)
    assert list(tmp_path.glob("**/canary")) == []
    for wrong, what in (({"partition": "nowhere"}, "partition"), ({"nodelist": "n7"}, "node"), ({"mem": "99G"}, "")):
        refused = Export(manifest, Profile.model_validate(wrong), "array")
        write_scripts(refused, reference.instance_files(manifest), tmp_path / "wrong")
        assert what in objection(tmp_path / "wrong", TRAIN) != ""
