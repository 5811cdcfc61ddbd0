"""What the SLURM scripts do, run by bash against stand-ins: chunks, signals, requeues, submission."""

# ruff: noqa: F811 - fixtures that are imported
from __future__ import annotations

import dataclasses
import re
import signal
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from space_dist.api.grids import frozen
from space_dist.errors import Interrupted, SpaceDistError
from space_dist.experiment.endings import Cause, Ended
from space_dist.experiment.manifest import Grid, Manifest, Run
from space_dist.experiment.status import Attempts, slurm_job, unheard
from space_dist.grid.conductor import Conductor, adopt, working_on
from space_dist.slurm import Export, export
from space_dist.slurm.export import AGGREGATE, JOBS, SUBMIT, TRAIN
from space_dist.slurm.node import address_facing
from space_dist.slurm.queue import queue_of
from space_dist.system.interrupts import StopRequests
from tests.commanding import command
from tests.patience import PATIENCE
from tests.test_slurm import GRID, Stubs, grid, manifest, profile, short, stubs, write  # noqa: F401
from tests.tunes import write_tune

# ---- what a task does -----------------------------------------------------------------------------------------------


def test_a_requeued_jobs_runs_were_preempted_and_others_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    here = {"slurm_job": "17", "restarts": 0}
    assert unheard(here).cause is Cause.KILLED  # nobody here is of SLURM
    monkeypatch.setenv("SLURM_JOB_ID", "17")
    assert slurm_job() == here
    assert unheard(here).cause is Cause.KILLED  # it was this very job that lost it
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    assert unheard(here).cause is Cause.PREEMPTED
    assert unheard({"slurm_job": "18", "restarts": 0}).cause is Cause.KILLED
    assert unheard({}).cause is Cause.KILLED


class Idle:
    """An executor that must never be asked to start anything."""

    def room(self) -> int:
        return 1

    def start(self, run: Run, attempt: int) -> None:
        raise AssertionError((run, attempt))

    def poll(self) -> list[tuple[Run, Ended | None]]:
        return []

    def wait(self, seconds: float) -> None:
        time.sleep(seconds)

    def stop(self) -> None:
        pass

    def adopt(self, runs: Sequence[Run]) -> list[Run]:  # noqa: ARG002 - it has none
        return []


def test_a_task_obeys_the_users_stop_and_only_the_whole_grid_ends_it(
    grid: Grid, manifest: Manifest, tmp_path: Path
) -> None:
    place = adopt(grid, tmp_path)
    place.stop_file.touch()
    task = Conductor(place, manifest, manifest.runs()[:1], Idle(), stop_requested=lambda: None)
    with pytest.raises(Interrupted, match="the grid's file `stop`"):
        task.conduct()
    assert place.stop_file.exists()
    quiet = dataclasses.replace(manifest, tracking=manifest.tracking.model_copy(update={"uri": None}))
    said: list[str] = []
    time.sleep(0.1)  # more than a tick of the clock that files have
    with working_on(place, quiet, wait=False, stop=StopRequests(), say=said.append):
        assert not place.stop_file.exists()
    assert "is from before this began" in said[0]


def test_who_asks_a_grid_to_stop_while_it_starts_is_heard(grid: Grid, manifest: Manifest, tmp_path: Path) -> None:
    place = adopt(grid, tmp_path)
    quiet = dataclasses.replace(manifest, tracking=manifest.tracking.model_copy(update={"uri": None}))
    stop = StopRequests()
    place.stop_file.touch()
    with working_on(place, quiet, wait=False, stop=stop, say=print):
        conductor = Conductor(place, manifest, manifest.runs()[:1], Idle(), stop_requested=stop.reason)
        with pytest.raises(Interrupted, match="the grid's file `stop`"):
            conductor.conduct()


def test_tasks_may_freeze_their_grid_all_at_once(grid: Grid, manifest: Manifest, tmp_path: Path) -> None:
    with ThreadPoolExecutor(8) as pool:
        places = list(pool.map(lambda _: adopt(grid, tmp_path / "root"), range(32)))
    assert {place.folder for place in places} == {tmp_path / "root" / manifest.name}
    assert places[0].manifest() == manifest
    assert places[0].instance_files(manifest) == grid.instance_files(manifest)


def test_runs_go_to_the_grids_name_below_any_root(grid: Grid, manifest: Manifest, tmp_path: Path) -> None:
    """Though the exported folder lies in the root, under another name."""
    root = tmp_path / "s"
    made = Export(manifest, profile(), "array", root)
    export(made, grid.instance_files(manifest), root / "exported")
    submitted = (root / "exported" / SUBMIT).read_text()
    assert f"\ngrid={root / manifest.name}\n" in submitted
    for _ in range(2):  # the second task finds what the first has frozen
        assert frozen(root / "exported/manifest.json", root)[0].folder == root / manifest.name
    assert frozen(root / manifest.name / "manifest.json", root)[0].folder == root / manifest.name
    assert frozen(root / "exported", root)[0].folder == root / "exported"  # a folder is meant as it is named


# ---- what the scripts do --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("code", "extra", "requeued", "said"),
    [
        (0, {}, False, ""),
        (1, {}, False, ""),
        (2, {}, False, ""),
        (3, {}, False, ""),
        (75, {}, True, "requeued for the 1. time"),
        (75, {"SLURM_RESTART_COUNT": "3"}, True, "requeued for the 4. time"),
        (75, {"SLURM_RESTART_COUNT": "4"}, False, "not requeued for more than 4 times"),
    ],
)
def test_a_task_goes_back_into_the_queue_only_if_interrupted(
    code: int, extra: dict[str, str], requeued: bool, said: str, manifest: Manifest, stubs: Stubs, tmp_path: Path,
    short: str,
) -> None:  # fmt: skip
    folder = write(Export(manifest, profile(max_requeues=4, temp=short), "array"), tmp_path / "x")
    got, text = stubs.run(folder / TRAIN, STUB_CODE=str(code), **extra)
    assert got == code
    assert said in text
    calls = stubs.calls()
    assert [call[1:] for call in calls if call[0] == "scontrol"] == ([["requeue", "7_0"]] if requeued else [])
    assert list((tmp_path / "node").iterdir()) == []


RAYLESS = """#!/bin/bash
if [ "$2" = address ]; then
  echo 127.0.0.1
elif [ "$1" = grid ]; then
  [ -z "${STUB_BEGINS:-}" ] || { sleep 0.05; mkdir -p cell/s0; echo begun >cell/s0/status.json; }
  exit 1
fi
"""


@pytest.mark.parametrize("linked", [False, True])
def test_a_job_whose_ray_never_comes_up_ends_after_a_few_tries(
    linked: bool, manifest: Manifest, stubs: Stubs, tmp_path: Path, short: str
) -> None:
    """Its nodes' step ends at once each time. A try in which a run began, and a job of another number, count anew."""
    folder = write(Export(manifest, profile(temp=short), "cluster"), tmp_path / "x")
    if linked:  # a run's folder may lie elsewhere
        (tmp_path / "elsewhere").mkdir()
        (folder / "cell").mkdir()
        (folder / "cell/s0").symlink_to(tmp_path / "elsewhere")
    (stubs.folder / "space-dist").unlink()
    (stubs.folder / "space-dist").write_text(RAYLESS)
    (stubs.folder / "space-dist").chmod(0o755)

    def tried(**extra: str) -> tuple[int, bool, str]:
        code, said = stubs.run(folder / TRAIN, **extra)
        return code, ["scontrol", "requeue", extra.get("SLURM_JOB_ID", "17")] in stubs.calls(), said

    for number, begins in enumerate(("", "", "yes", "", "")):
        code, requeued, said = tried(STUB_BEGINS=begins, SLURM_RESTART_COUNT=str(number))
        assert (code, requeued) == (75, True), said
    assert tried(SLURM_JOB_ID="18")[:2] == (75, True)
    assert tried(SLURM_JOB_ID="18", SLURM_RESTART_COUNT="1")[:2] == (75, True)
    code, requeued, said = tried(SLURM_JOB_ID="18", SLURM_RESTART_COUNT="2")
    assert (code, requeued) == (1, False)
    assert "3 times in a row Ray did not come up" in said
    assert not (folder / "ray-tries").exists()
    assert list((tmp_path / "node").iterdir()) == []


def test_a_users_stop_is_respected(manifest: Manifest, stubs: Stubs, tmp_path: Path, short: str) -> None:
    folder = write(Export(manifest, profile(temp=short), "array"), tmp_path / "x")
    (folder / "stop").touch()
    code, said = stubs.run(folder / TRAIN, STUB_CODE="75")
    assert code == 75
    assert "stopped by its user" in said
    assert stubs.calls("scontrol") == []
    assert stubs.run(folder / SUBMIT)[0] == 0  # which means: go on
    assert not (folder / "stop").exists()


def _await(path: Path) -> None:
    until = time.monotonic() + PATIENCE
    while not path.exists():
        assert time.monotonic() < until
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("number", "reason", "requeued"),
    [(signal.SIGUSR1, "", True), (signal.SIGTERM, "None", False), (signal.SIGTERM, "TimeLimit", True)],
)
def test_a_signal_becomes_a_flag_file(
    number: signal.Signals, reason: str, requeued: bool, manifest: Manifest, stubs: Stubs, tmp_path: Path, short: str
) -> None:
    folder = write(Export(manifest, profile(temp=short), "array"), tmp_path / "x")
    waits = tmp_path / "waits"
    process = stubs.start(
        folder / TRAIN, STUB_WAITS=str(waits), STUB_FLAG=f"{short}/r17/stop", STUB_CODE="75", STUB_QUEUE=reason
    )
    _await(waits)
    for _ in range(20):  # it may come more than once, at any moment
        process.send_signal(number)
        time.sleep(0.002)
    out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 75, err
    assert ("interrupted; requeued for the 1. time" in out) is requeued
    calls = stubs.calls()
    assert [call[1:] for call in calls if call[0] == "scontrol"] == ([["requeue", "7_0"]] if requeued else [])
    asked = [call[-1] for call in calls if call[0] == "squeue"]
    assert asked == (["--jobs=7_0"] if number == signal.SIGTERM else [])
    assert list((tmp_path / "node").iterdir()) == []


def test_a_signal_before_anything_runs_is_not_lost(
    manifest: Manifest, stubs: Stubs, tmp_path: Path, short: str
) -> None:
    folder = write(Export(manifest, profile(temp=short, modules=["slow"]), "array"), tmp_path / "x")
    loading = tmp_path / "loading"
    process = stubs.start(folder / TRAIN, STUB_LOADING=str(loading), STUB_WAITS=str(tmp_path / "w"),
                          STUB_FLAG=f"{short}/r17/stop", STUB_CODE="75")  # fmt: skip
    _await(loading)
    process.send_signal(signal.SIGUSR1)
    process.communicate(timeout=PATIENCE)
    assert process.returncode == 75
    assert [call[1:] for call in stubs.calls("scontrol")] == [["requeue", "7_0"]]
    assert not (tmp_path / "w").exists()  # the flag was there before the work began


@pytest.mark.parametrize("submitted_from", ["elsewhere", "nowhere"])
def test_a_task_in_a_wrong_folder_says_so(
    submitted_from: str, manifest: Manifest, stubs: Stubs, tmp_path: Path, short: str
) -> None:
    folder = write(Export(manifest, profile(temp=short), "array"), tmp_path / "x")
    (tmp_path / "elsewhere").mkdir()
    code, said = stubs.run(folder / TRAIN, SLURM_SUBMIT_DIR=str(tmp_path / submitted_from))
    assert code == 2
    assert ("holds no manifest.json" if submitted_from == "elsewhere" else "does not see") in said
    assert stubs.calls("space-dist") == []


@pytest.mark.parametrize(("per_task", "max_size", "throttle"), [(1, 1001, None), (4, 1001, 1), (1, 2, 2), (2, 2, None)])
def test_every_run_is_in_exactly_one_task(
    per_task: int, max_size: int, throttle: int | None, manifest: Manifest, stubs: Stubs, tmp_path: Path, short: str
) -> None:
    site = profile(cells_per_task=per_task, max_array_size=max_size, throttle=throttle, temp=short)
    folder = write(Export(manifest, site, "array"), tmp_path / "x")
    code, said = stubs.run(folder / SUBMIT, "--partition=other")
    assert code == 0, said
    *trains, aggregate = stubs.calls("sbatch")
    parts: list[int] = []
    literal = re.search(r"^#SBATCH --array=(\S+)", (folder / TRAIN).read_text(), re.MULTILINE)
    assert literal is not None
    for number, call in enumerate(trains):
        assert "--partition=other" in call
        given = [option.partition("=")[2] for option in call if option.startswith("--array=")]
        span, percent, limit = (given or [literal[1]])[0].partition("%")
        assert (percent, limit) == (("%", str(throttle)) if throttle else ("", ""))
        waits = [option for option in call if option.startswith("--dependency")]
        assert waits == ([f"--dependency=afterany:{100 + number}"] if throttle and number else [])
        last = int(span.removeprefix("0-"))
        assert last < max_size
        for index in range(last + 1):
            stubs.run(folder / TRAIN, *call[call.index(TRAIN) + 1 :], SLURM_ARRAY_TASK_ID=str(index))
            [task] = stubs.calls("space-dist")
            first, _, end = task[task.index("--part") + 1].partition("-")
            parts += range(int(first), min(int(end), 5) + 1)
    assert parts == list(range(6))
    jobs = ":".join(str(101 + number) for number in range(len(trains)))
    assert aggregate == ["sbatch", "--parsable", f"--dependency=afterany:{jobs}", AGGREGATE]
    assert (folder / JOBS).read_text().split("\n")[-2] == f"{101 + len(trains)} aggregate"


def test_submission_is_all_or_nothing_and_happens_once(manifest: Manifest, stubs: Stubs, tmp_path: Path) -> None:
    folder = write(Export(manifest, profile(max_array_size=2, output="out put/%x.out"), "array"), tmp_path / "x")
    code, said = stubs.run(folder / SUBMIT, STUB_REFUSES="103")
    assert code != 0
    assert "cancelling what was submitted: 101 102" in said
    assert [call[1:] for call in stubs.calls("scancel")] == [["101", "102"]]
    assert not (folder / JOBS).exists()
    assert stubs.run(folder / SUBMIT)[0] == 0
    assert (folder / "out put").is_dir()
    assert len(stubs.calls("sbatch")) == 4
    code, said = stubs.run(folder / SUBMIT, STUB_QUEUE="103\n")
    assert (code, "already in the queue, nothing to do: 103" in said) == (0, True)
    code, said = stubs.run(folder / SUBMIT, STUB_SQUEUE="1")  # a controller that restarts: they may well be queued
    assert (code, "squeue does not answer" in said) == (1, True)
    assert stubs.calls("sbatch") == []
    assert stubs.run(folder / SUBMIT, STUB_QUEUE="99\n1030\n")[0] == 0  # others' jobs, and its own are over
    assert len(stubs.calls("sbatch")) == 4


def test_an_exported_folder_says_where_its_results_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, root, tune = tmp_path / "out", tmp_path / "my results", write_tune(tmp_path / "tune")

    def told(*words: object) -> str:
        capsys.readouterr()
        assert command(monkeypatch, *words) in (0, 3)
        return " ".join(capsys.readouterr().err.split())

    for what, name, asked in ((GRID, "pointmass_small", "grid"), (tune, "search", "tune")):
        export_it = ("slurm", "export", what, "--out", out / asked)
        told(*export_it, "--root", root)
        said = f"{out / asked} was exported with --root, and holds no results: "
        assert f"{said}its jobs will put them into '{root / name}'" in told(asked, "status", out / asked)
        (root / name).mkdir(parents=True)
        said += f"name '{root / name}' instead"
        assert said in told(asked, "status", out / asked)
        assert said in told("grid", "stop", out / asked)
        told(*export_it)
        assert "exported" not in told(asked, "status", out / asked)
        told("slurm", "export", what, "--out", out / name, "--root", out)  # itself
        assert "exported" not in told(asked, "status", out / name)


@pytest.mark.parametrize(
    ("code", "said", "not_said"),
    [
        ("0", "", "./submit.sh"),
        ("1", "runs failed for good (how many, and why: see above), which ./submit.sh does not try again; "
              "`space-dist grid retry {folder} --cause CAUSE` gives them another try, then ./submit.sh", "see above);"),
        ("3", "the grid is not complete (see above); ./submit.sh goes on with it", "retry"),
    ],
)  # fmt: skip
def test_what_gathers_results_says_how_the_grid_goes_on(
    code: str, said: str, not_said: str, manifest: Manifest, stubs: Stubs, tmp_path: Path
) -> None:
    folder = write(Export(manifest, profile(), "array"), tmp_path / "x")
    got, told = stubs.run(folder / AGGREGATE, STUB_CODE=code)
    assert got == int(code)
    assert said.format(folder=folder) in told
    assert not_said not in told


def test_a_failed_run_of_an_exported_grid_is_tried_again_by_submit_sh(
    grid: Grid, manifest: Manifest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    place = Grid(tmp_path / "my grid")
    export(Export(manifest, profile(), "array"), grid.instance_files(manifest), place.folder)
    for run in manifest.runs()[:2]:
        attempts = Attempts(place.ledger(run))
        attempts.begin(1, {})
        attempts.end(1, Ended(Cause.CRASH, "made to"))
    assert command(monkeypatch, "grid", "status", place.folder, "--by-cause") == 1
    told = " ".join(capsys.readouterr().out.split())
    again = f"`space-dist grid retry '{place.folder}' --cause crash` gives another try"
    assert f"2 runs failed for good; {again}" in told
    assert command(monkeypatch, "grid", "retry", place.folder, "--cause", "crash") == 0
    told = " ".join(capsys.readouterr().out.split())
    assert f"2 runs may be tried again; `'{place.folder / SUBMIT}'`, on SLURM, or" in told
    (place.folder / SUBMIT).unlink()  # as below another root, where only the jobs' numbers are
    (place.folder / JOBS).touch()
    attempts.begin(2, {})
    attempts.end(2, Ended(Cause.CRASH, "made to"))
    assert command(monkeypatch, "grid", "retry", place.folder, "--cause", "crash") == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "1 run may be tried again; `./submit.sh` of the exported folder, on SLURM, or" in told


def test_submit_sh_says_what_was_asked_for(manifest: Manifest, stubs: Stubs, tmp_path: Path) -> None:
    folder = write(Export(manifest, profile(), "array"), tmp_path / "x")
    assert f"submitted {manifest.name}, 6 runs in all; results: {folder}\n" in stubs.run(folder / SUBMIT)[1]
    told = stubs.run(folder / SUBMIT, "--array=0-1", "--hold")[1]
    assert f"submitted {manifest.name}, 6 runs in all, with --array=0-1 --hold; results" in told


def test_what_slurm_knows_is_asked_once(stubs: Stubs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in stubs.environment.items():
        monkeypatch.setenv(name, value)
    assert queue_of(tmp_path) is None
    (tmp_path / JOBS).write_text("7 train\n8 train\n9 aggregate\nrm -rf train\n")
    monkeypatch.setenv("STUB_QUEUE", "7|RUNNING|None\n7|RUNNING|None\n8|PENDING|Resources\n99|RUNNING|None\n")
    monkeypatch.setenv("STUB_PAST", "7_1|RUNNING|0:0\n7_2|TIMEOUT|0:0\n7_3|FAILED|1:0\n")
    found = queue_of(tmp_path)
    assert found is not None
    assert found.live == {"train running": 2, "train pending (Resources)": 1}
    assert found.ended == {"train timeout": 1, "train failed (1:0)": 1}
    assert found.in_words() == (
        "SLURM jobs: train 7, 8; aggregate 9; 2 train running, 1 train pending (Resources); "
        "ended: 1 train timeout, 1 train failed (1:0)"
    )
    assert [call[0] for call in stubs.calls()] == ["squeue", "sacct"]
    monkeypatch.setenv("STUB_SACCT", "1")
    assert "ended" not in queue_of(tmp_path).in_words()  # type: ignore[union-attr]
    monkeypatch.setenv("PATH", "/nowhere")
    assert "squeue does not answer here" in queue_of(tmp_path).in_words()  # type: ignore[union-attr]


def test_a_nodes_address_is_one_that_others_reach() -> None:
    with pytest.raises(SpaceDistError, match=r"no IPv4 address on interface 'ib99'"):
        address_facing("localhost", "ib99")
    assert address_facing("localhost", "lo") == "127.0.0.1"  # whoever says so gets it
