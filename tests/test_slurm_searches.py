"""Searches on SLURM without one: what is exported, what the job between two arrays submits, and that nothing that
becomes of it changes what is searched. On a real Slurm: tests/test_slurm_cluster.py.
"""

# ruff: noqa: F811 - fixtures that are imported
from __future__ import annotations

import dataclasses
import os
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from space_dist.api.tuning import run_search
from space_dist.config import read_yaml, to_yaml
from space_dist.errors import ConfigError
from space_dist.experiment.endings import Cause
from space_dist.experiment.manifest import Grid, Manifest, Run
from space_dist.grid.trials import open_runs
from space_dist.grid.tuning import plan_search
from space_dist.slurm import Export, searches
from space_dist.slurm.arrays import arrays_of
from space_dist.slurm.export import ADVANCE, JOBS, NEXT, README, SUBMIT, TRAIN, render
from space_dist.slurm.searches import digest_of_trials, reached, runs_of_task
from tests.commanding import command
from tests.shell import one_server
from tests.slurm.profiles import exports
from tests.test_racing import population_tune, racing_tune
from tests.test_slurm import HOSTILE, MODES, Stubs, profile, short, stubs, write  # noqa: F401
from tests.tunes import Outcome, end, search_of, search_through, write_tune
from tests.tunes import reached as outcome_of

RACING = {"pruner": {"rungs": [1], "keep": 0.5}}
PLAN = "0123456789abcdef 0123456789abcdef-1-2048\n0 0-2%2\n1001 0-0,4-5%2\n"


@pytest.fixture(scope="module")
def tune(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a search with racing: two arms of six trials, in generations of two."""
    return write_tune(tmp_path_factory.mktemp("tune"), **RACING)


@pytest.fixture(scope="module")
def left_alone(tune: Path, tmp_path_factory: pytest.TempPathFactory) -> Grid:
    return search_through(tune, tmp_path_factory.mktemp("left_alone"))[0]


@pytest.fixture(scope="module")
def manifest(tune: Path, tmp_path_factory: pytest.TempPathFactory) -> Manifest:
    return plan_search(tune, tmp_path_factory.mktemp("planned")).manifest


@pytest.fixture(autouse=True)
def _no_network_file_system(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(searches, "_SEEN_SECONDS", 0.0)
    monkeypatch.setattr(searches, "_LOOK_SECONDS", 0.0)


# ---- what is exported -----------------------------------------------------------------------------------------------


def test_arrays_have_the_tasks_that_are_asked_for() -> None:
    assert arrays_of(range(5), 1001, None) == [(0, "0-4")]
    assert arrays_of([0, 1, 3, 8], 1001, 4) == [(0, "0-1,3-3,8-8%4")]
    assert arrays_of([1, 2, 3, 9], 3, None) == [(0, "1-2"), (3, "0-0"), (9, "0-0")]
    assert arrays_of([], 3, 1) == []


def test_a_search_becomes_scripts(tune: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    assert command(monkeypatch, "slurm", "export", tune, "--out", out, "--set", "dependency=afterok:9") == 0
    assert {path.name for path in out.iterdir()} == {TRAIN, ADVANCE, SUBMIT, README, "manifest.json", "instances"}
    assert os.access(out / SUBMIT, os.X_OK)
    first = plan_search(tune, tmp_path / "runs").grid.manifest_file.read_bytes()
    assert (out / "manifest.json").read_bytes() == first
    train, advance = (out / TRAIN).read_text(), (out / ADVANCE).read_text()
    assert "--array" not in train.partition("set -u")[0]  # which tasks: the job between two arrays knows
    assert "dependency" not in train.partition("set -u")[0]
    assert "--requeue\n" in advance
    assert "--dependency=afterok:9,singleton" in (out / SUBMIT).read_text()
    assert "up to 12 tasks" in (out / README).read_text()  # two trials of two arms, three seeds each


@pytest.mark.skipif(shutil.which("shellcheck") is None, reason="shellcheck is not installed")
def test_bash_and_shellcheck_object_to_no_script(manifest: Manifest, tmp_path: Path) -> None:
    files = []
    for number, made in enumerate(exports(manifest, 4)):
        folder = write(made, tmp_path / str(number))
        files += [folder / name for name in made.scripts]
    for file in files:
        subprocess.run(["bash", "-n", file], check=True)
    found = subprocess.run(["shellcheck", *files], capture_output=True, text=True)
    assert found.stdout + found.stderr == ""


def test_no_variable_of_the_scripts_is_a_profiles_to_set(manifest: Manifest) -> None:
    for mode in MODES:
        text = render(Export(manifest, profile(), mode))[ADVANCE]
        words = re.sub(r"^ *#.*$", "", text, flags=re.MULTILINE)
        assigned = set(re.findall(r"(?:^|[\s(;])([A-Za-z_]\w*)\+?=", words)) - {"IFS"}
        assert assigned >= {"grid", "after", "trains", "listed", "code", "submitted"}
        for variable in {*assigned, "trials", "reached", "indices", "lines"}:
            with pytest.raises(ValueError, match=rf"{variable} is"):
                profile(env={variable: "x"})


def test_hostile_values_do_nothing(manifest: Manifest, tmp_path: Path) -> None:
    canary, stand_ins = tmp_path / "canary", Stubs(tmp_path / "stubs")
    for index, value in enumerate(one for one in HOSTILE[::6] if one.isprintable()):
        root = tmp_path / "root" / value.replace("/", "_").strip()
        settings = {"comment": value, "apptainer": value} if not value.startswith("-") else {}
        made = Export(manifest, profile(env={"HOSTILE": value}, **settings), MODES[index % 2], root)
        folder = write(made, tmp_path / str(index))
        (root / manifest.name).mkdir(parents=True)
        (root / manifest.name / NEXT).write_text(PLAN)
        (stand_ins.folder / "apptainer").unlink()
        (stand_ins.folder / "apptainer").symlink_to(Path(__file__).parent / "slurm/stub")
        for script in (ADVANCE, SUBMIT):
            _, said = stand_ins.run(folder / script, "first", C=str(canary), STUB_CODE="3")
            assert "syntax error" not in said, (value, script)
        assert not canary.exists(), value
        assert stand_ins.calls("sbatch") != []


def test_what_cannot_be_exported_is_a_sentence(
    tune: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(*arguments: object) -> str:
        code = command(monkeypatch, "slurm", "export", *arguments)
        said = capsys.readouterr()
        assert (code != 0, "Traceback" in said.err) == (True, False)
        return " ".join(said.err.split())

    grid, _ = search_through(tune, tmp_path / "runs", generations=1)
    assert "goes on from its runs: export it to its own folder" in refused(grid.folder, "--out", tmp_path / "other")
    before = grid.manifest_file.read_bytes()
    for source in (grid.folder, tune):  # into the folder where it goes on
        assert command(monkeypatch, "slurm", "export", source, "--out", grid.folder) == 0
        assert grid.manifest_file.read_bytes() == before
    other = write_tune(tmp_path / "other_tune", seed=7)
    assert "holds another search of this name" in refused(other, "--out", grid.folder)
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged/manifest.json").write_text('{"format": 1, "search": {}}')
    assert "is damaged" in refused(tmp_path / "damaged", "--out", tmp_path / "out")
    assert "is damaged" in refused(tune, "--out", tmp_path / "damaged")
    assert not (tmp_path / "out").exists()


def test_more_trials_of_an_exported_search_are_taken(
    tune: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid, manifest = search_through(tune, tmp_path / "runs")
    longer = tune.with_name("longer.yaml")
    longer.write_text(to_yaml(read_yaml(tune) | {"trials": 8}))
    assert search_of(manifest).over
    assert command(monkeypatch, "slurm", "export", longer, "--out", grid.folder) == 0
    assert not search_of(grid.manifest()).over
    assert search_of(grid.manifest()).trials == search_of(manifest).trials


# ---- what the job between two arrays submits ------------------------------------------------------------------------


def between(manifest: Manifest, folder: Path, plan: str = PLAN, **settings: object) -> Path:
    """An exported folder whose `slurm advance` (a stand-in) has written down what is next."""
    write(Export(manifest, profile(**settings), "array"), folder)
    (folder / NEXT).write_text(plan)
    return folder / ADVANCE


def test_what_is_next_is_submitted_and_this_job_after_it(manifest: Manifest, stubs: Stubs, tmp_path: Path) -> None:
    script = between(manifest, tmp_path / "x", cells_per_task=3, max_array_size=1001, throttle=2)
    code, said = stubs.run(script, "0123456789abcdef-0-0", STUB_CODE="3")
    assert code == 0, said
    asked, *submitted = [call for call in stubs.calls() if call[0] in ("space-dist", "sbatch")]
    assert asked == [
        "space-dist", "slurm", "advance", str(script.parent), "--after", "0123456789abcdef-0-0", "--next",
        str(script.parent / NEXT), "--cells-per-task", "3", "--max-array-size", "1001", "--throttle", "2",
    ]  # fmt: skip
    assert [call[-1] for call in submitted] == ["0123456789abcdef"] * 2 + ["0123456789abcdef-1-2048"]


def submissions(stubs: Stubs) -> list[list[str]]:
    return [call[1:] for call in stubs.calls("sbatch")]


def test_arrays_wait_for_each_other_only_where_they_are_throttled(
    manifest: Manifest, stubs: Stubs, tmp_path: Path
) -> None:
    token, trials = "0123456789abcdef-1-2048", "0123456789abcdef"
    for throttle, waits in ((2, ["--dependency=afterany:101"]), (None, [])):
        stubs.log.with_name("calls.jobs").unlink(missing_ok=True)
        script = between(manifest, tmp_path / str(throttle), throttle=throttle)
        assert stubs.run(script, "first", "--partition=other", STUB_CODE="3")[0] == 0
        assert submissions(stubs) == [
            ["--parsable", "--partition=other", "--array=0-2%2", TRAIN, "0", trials],
            ["--parsable", "--partition=other", "--array=0-0,4-5%2", *waits, TRAIN, "1001", trials],
            ["--parsable", "--dependency=afterany:101:102,singleton", ADVANCE, token, "--partition=other"],
        ]
        assert (script.parent / JOBS).read_text() == "101 train\n102 train\n103 advance\n"
        assert not (script.parent / NEXT).exists()


def test_where_nothing_is_to_be_trained_it_goes_on_at_once(manifest: Manifest, stubs: Stubs, tmp_path: Path) -> None:
    assert stubs.run(between(manifest, tmp_path / "x", PLAN.splitlines()[0] + "\n"), "first", STUB_CODE="3")[0] == 0
    assert submissions(stubs) == [["--parsable", "--dependency=singleton", ADVANCE, "0123456789abcdef-1-2048"]]


def test_submitted_twice_or_requeued_it_submits_once(manifest: Manifest, stubs: Stubs, tmp_path: Path) -> None:
    script = between(manifest, tmp_path / "x")
    here, elsewhere = script.parent.resolve(), tmp_path
    queue = f"17|search-advance|{here}\n9|search-advance|{here}\n40|search-advance|{elsewhere}\n41|other|{here}\n"
    code, said = stubs.run(script, "first", STUB_CODE="3", STUB_QUEUE=f"{queue}18|search-advance|{here}\n")
    assert (code, "nothing to do: job 18 goes on" in said) == (0, True)
    assert stubs.calls("sbatch") + stubs.calls("space-dist") == []
    # Killed between the array and itself: that array is waited for, and none beside it.
    code, said = stubs.run(script, "first", STUB_CODE="3", STUB_QUEUE=f"{queue}12|search|{here}\n12|search|{here}\n")
    assert (code, "in the queue already: 12" in said) == (0, True)
    assert submissions(stubs) == [["--parsable", "--dependency=afterany:12,singleton", ADVANCE, "first"]]
    assert (script.parent / JOBS).read_text() == "12 train\n101 advance\n"


def test_all_is_submitted_or_nothing(manifest: Manifest, stubs: Stubs, tmp_path: Path) -> None:
    script = between(manifest, tmp_path / "x")
    code, said = stubs.run(script, "first", STUB_CODE="3", STUB_REFUSES="103")
    assert code != 0
    assert "cancelling what was submitted: 101 102" in said
    assert [call[1:] for call in stubs.calls("scancel")] == [["101", "102"]]
    assert not (script.parent / JOBS).exists()


@pytest.mark.parametrize("code", [0, 1, 2, 75])
def test_nothing_is_submitted_once_it_is_over_or_held_up(
    code: int, manifest: Manifest, stubs: Stubs, tmp_path: Path
) -> None:
    assert stubs.run(between(manifest, tmp_path / "x"), "first", STUB_CODE=str(code))[0] == code
    calls = stubs.calls()
    assert [call for call in calls if call[0] == "sbatch"] == []
    reports = [call[1:3] for call in calls if call[0] == "space-dist" and call[1] == "tune"]
    assert reports == ([["tune", "report"]] if code < 2 else [])


def test_a_node_without_sbatch_is_a_sentence(manifest: Manifest, stubs: Stubs, tmp_path: Path) -> None:
    (stubs.folder / "sbatch").unlink()
    for name in ("bash", "hostname", "dirname"):
        (stubs.folder / name).symlink_to(str(shutil.which(name)))
    script = between(manifest, tmp_path / "x")
    code, said = stubs.run(script, "first", PATH=str(stubs.folder))
    assert (code, "has no sbatch" in said, "aggregate.partition" in said) == (2, True, True)


def test_the_next_jobs_are_not_told_what_slurm_told_this_one(manifest: Manifest, stubs: Stubs, tmp_path: Path) -> None:
    """Else a task would take this job's memory for its own."""
    seen = tmp_path / "seen"
    (stubs.folder / "sbatch").unlink()
    (stubs.folder / "sbatch").write_text(f"#!/bin/bash\nenv | grep ^SLURM_ >>{seen}\necho 7\n")
    (stubs.folder / "sbatch").chmod(0o755)
    script = between(manifest, tmp_path / "x")
    assert stubs.run(script, "first", STUB_CODE="3", SLURM_CONF="/etc/x", SLURM_MEM_PER_NODE="500")[0] == 0
    assert {*seen.read_text().split()} == {"SLURM_CONF=/etc/x"}


def test_a_task_names_its_trials(manifest: Manifest, stubs: Stubs, tmp_path: Path, short: str) -> None:
    folder = write(Export(manifest, profile(temp=short, cells_per_task=2), "array"), tmp_path / "x")
    assert stubs.run(folder / TRAIN, "4", "abcd", SLURM_ARRAY_TASK_ID="1")[0] == 0
    [task] = stubs.calls("space-dist")
    assert task[1:6] == ["slurm", "task", str(folder), "--trials", "abcd"]
    assert task[-2:] == ["--part", "10-11"]
    code, said = stubs.run(folder / TRAIN)
    assert (code != 0, "advance.sbatch submits this" in said) == (True, True)


def test_submitting_by_hand_goes_on(manifest: Manifest, stubs: Stubs, tmp_path: Path) -> None:
    folder = write(Export(manifest, profile(), "array"), tmp_path / "x")
    (folder / "stop").touch()
    assert stubs.run(folder / SUBMIT, "--partition=other")[0] == 0
    assert not (folder / "stop").exists()
    assert submissions(stubs) == [["--parsable", "--dependency=singleton", ADVANCE, "first", "--partition=other"]]
    code, said = stubs.run(folder / SUBMIT, STUB_QUEUE="101\n")
    assert (code, "already in the queue" in said) == (0, True)


# ---- what becomes of a search ---------------------------------------------------------------------------------------


def advanced(monkeypatch: pytest.MonkeyPatch, folder: Path, after: str = "first", *more: object) -> int:
    return command(monkeypatch, "slurm", "advance", folder, "--after", after, "--next", folder / NEXT,
                   "--cells-per-task", 2, "--max-array-size", 3, *more)  # fmt: skip


def planned_tasks(folder: Path) -> tuple[str, str, list[int]]:
    """Of what is next: trials, reached, and the tasks."""
    first, *lines = (folder / NEXT).read_text().splitlines()
    tasks = []
    for line in lines:
        begin, indices = line.split()
        for span in indices.split(","):
            low, high = span.split("-")
            tasks += [int(begin) + index for index in range(int(low), int(high) + 1)]
    trials, so_far = first.split()
    return trials, so_far, tasks


def ended(grid: Grid, runs: list[Run], outcome: Outcome | None = None) -> None:
    for run in runs:
        if not grid.ledger(run).status_file.exists():
            end(grid, run, outcome_of(run) if outcome is None else outcome)


def test_a_search_ends_with_the_same_bytes(
    tune: Path, left_alone: Grid, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every second array is lost after its first task, and every step between two arrays is done twice."""
    assert command(monkeypatch, "slurm", "export", tune, "--out", tmp_path / "out") == 0
    grid, after, rounds, tasks_done = Grid(tmp_path / "out"), "first", 0, 0
    while (code := advanced(monkeypatch, grid.folder, after)) == 3:
        before = grid.manifest_file.read_bytes(), (grid.folder / NEXT).read_bytes()
        assert advanced(monkeypatch, grid.folder, "first") == 3
        assert (grid.manifest_file.read_bytes(), (grid.folder / NEXT).read_bytes()) == before
        trials, after, tasks = planned_tasks(grid.folder)
        found = runs_of_task(grid, trials)
        assert found is not None
        runs = found[1]
        for task in tasks[: 1 if rounds % 2 else None]:
            part = runs[2 * task : 2 * task + 2]
            assert not all(grid.ledger(run).status_file.exists() for run in part)  # none that has nothing to do
            ended(grid, part)
            tasks_done += 1
        rounds += 1
        assert rounds < 20
    assert code == 0
    assert grid.manifest_file.read_bytes() == left_alone.manifest_file.read_bytes()
    assert (grid.folder / "confirm/search-confirm.yaml").is_file()
    said = capsys.readouterr().out
    assert "generation 3 of 3" in said
    assert "12 of 12 trials asked" in said
    assert tasks_done >= 12
    (told,) = re.findall(
        r"^space-dist (slurm export .*) --profile PROFILE +#", (grid.folder / README).read_text(), re.M
    )
    assert command(monkeypatch, "tune", "report", grid.folder) == 0
    beside = tmp_path / "search-confirm"
    assert f"looked for in {beside}" in " ".join(capsys.readouterr().out.split())
    (grid.folder / JOBS).touch()
    assert command(monkeypatch, "tune", "confirm", grid.folder) == 0
    typed_there = f"slurm export {grid.folder / 'confirm/search-confirm.yaml'} --out {beside}`"
    assert typed_there in " ".join(capsys.readouterr().out.split())
    monkeypatch.chdir(grid.folder)
    assert command(monkeypatch, *told.split()) == 0
    confirming = Grid(beside)
    for run in confirming.manifest().runs():
        end(confirming, run, 40.0 + run.seed)
    capsys.readouterr()
    assert command(monkeypatch, "tune", "report", grid.folder) == 0
    assert "Confirmed with fresh seeds" in " ".join(capsys.readouterr().out.split())


@pytest.fixture
def _one_process() -> Iterator[None]:
    with one_server():
        yield


@pytest.mark.usefixtures("_one_process")
@pytest.mark.parametrize(("made", "seeds"), [(racing_tune, [0, 1]), (population_tune, [0])])
def test_trials_that_are_paused_go_on_in_later_arrays(
    made: Callable[..., Path], seeds: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Trained here, each task in its turn, as jobs do it; one of each array's is lost."""
    path = made(tmp_path, arms={"a": {}}, seeds=seeds)
    here = run_search(path, root=tmp_path / "runs", progress=False).grid
    assert command(monkeypatch, "slurm", "export", path, "--out", tmp_path / "out") == 0
    grid, after, arrays = Grid(tmp_path / "out"), "first", 0
    while (code := advanced(monkeypatch, grid.folder, after)) == 3:
        trials, after, tasks = planned_tasks(grid.folder)
        for task in tasks if arrays % 2 or len(tasks) == 1 else tasks[1:]:
            part = f"{2 * task}-{2 * task + 1}"
            assert command(monkeypatch, "slurm", "task", grid.folder, "--trials", trials, "--part", part) == 0
        arrays += 1
        assert arrays < 20
    assert code == 0
    assert arrays > 3
    assert grid.manifest_file.read_bytes() == here.manifest_file.read_bytes()


def test_what_gets_no_further_is_not_submitted_for_ever(
    tune: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    grid = plan_search(tune, tmp_path).grid
    assert advanced(monkeypatch, grid.folder) == 3
    _, after, _ = planned_tasks(grid.folder)
    capsys.readouterr()
    assert advanced(monkeypatch, grid.folder, after) == 1
    assert "none of its runs has got further" in " ".join(capsys.readouterr().err.split())
    ended(grid, open_runs(grid.manifest())[:1])
    assert advanced(monkeypatch, grid.folder, after) == 3
    assert reached(grid, grid.manifest()) == planned_tasks(grid.folder)[1] != after
    assert advanced(monkeypatch, grid.folder, "x; touch canary") == 2


def test_a_search_that_is_held_up_or_stopped_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def told(code: int) -> str:
        assert advanced(monkeypatch, grid.folder) == code
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        return " ".join(said.err.split())

    plain = write_tune(tmp_path, retry={"killed": 0})
    grid = plan_search(plain, tmp_path).grid
    runs = open_runs(grid.manifest())
    grid.stop_file.touch()
    assert "stopped by its user" in told(75)
    grid.stop_file.unlink()
    ended(grid, runs[1:])
    end(grid, runs[0], Cause.KILLED)
    assert "which says nothing of its setting" in told(1)
    assert command(monkeypatch, "grid", "retry", grid.folder, "--cause", "killed") == 0
    capsys.readouterr()
    assert advanced(monkeypatch, grid.folder) == 3
    assert planned_tasks(grid.folder)[2] == [0]
    grid.manifest_file.write_text(grid.manifest_file.read_text().replace("round_robin", "round_bin"))
    assert "is damaged" in told(1)


def test_where_an_arm_has_nothing_to_confirm_it_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_tune(tmp_path, trials=2, arms={"a": {}})
    grid = plan_search(path, tmp_path).grid
    ended(grid, open_runs(grid.manifest()), Cause.CRASH)
    assert advanced(monkeypatch, grid.folder) == 1
    assert "arm a has no complete trial" in capsys.readouterr().err


def test_a_task_of_earlier_trials_has_nothing_to_do(
    tune: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    grid = plan_search(tune, tmp_path).grid
    before = digest_of_trials(grid.manifest())
    ended(grid, open_runs(grid.manifest()))
    assert advanced(monkeypatch, grid.folder) == 3
    capsys.readouterr()
    assert command(monkeypatch, "slurm", "task", grid.folder, "--trials", before, "--part", "0-0") == 0
    assert "has gone on" in capsys.readouterr().out
    assert not any(grid.folder.glob("grid.log"))


def test_below_another_root_a_search_is_put_once(
    tune: Path, manifest: Manifest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source, root = plan_search(tune, tmp_path / "out").grid, tmp_path / "root"
    for _ in range(2):
        assert advanced(monkeypatch, source.folder, "first", "--root", root) == 3
        grid = Grid(root / "search")
        ended(grid, open_runs(grid.manifest()))
    assert search_of(grid.manifest()).trials != search_of(manifest).trials  # and goes on there
    assert source.manifest() == manifest
    other = plan_search(write_tune(tmp_path / "other", seed=7), tmp_path / "other").grid
    capsys.readouterr()
    assert advanced(monkeypatch, other.folder, "first", "--root", root) == 2
    assert "holds another search" in " ".join(capsys.readouterr().err.split())
    Grid(tmp_path / "grid").freeze(dataclasses.replace(manifest, search=None), {})
    with pytest.raises(ConfigError, match="holds a grid, and no search"):
        searches.settled_in(Grid(tmp_path / "grid"), None)
