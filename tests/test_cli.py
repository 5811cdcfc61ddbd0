"""The command line as a user meets it: exit codes, one clear sentence, never a traceback, and nothing lost."""

from __future__ import annotations

import functools
import io
import itertools
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import SimpleNamespace

import pytest
import typer
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from space_dist import cli
from space_dist.cli import overview, runs, terminal
from space_dist.config import BudgetConfig, RunConfig, reading
from space_dist.experiment.manifest import Cell, Grid, Run
from space_dist.grid.conductor import Overview
from space_dist.ledger import CURRICULUM, METRICS, Ledger, encode_row
from space_dist.run.launch import Outcome
from space_dist.run.training import Progress
from space_dist.slurm.profile import Profile
from space_dist.system.interrupts import StopRequests
from tests import prepared
from tests.patience import PATIENCE

ROOT = Path(__file__).resolve().parent.parent
CONFIG = ROOT / "configs/pointmass_space.yaml"
TRAIN, TEST = (ROOT / f"configs/instances/pointmass_uniform_{split}.csv" for split in ("train", "test"))
SMALL = (
    "budget.steps=4096", "learner.n_steps=256", "rollout.slots=1", "learner.n_epochs=1", "tracking.uri=null",
    "checkpoint.every_rounds=1", "evaluation.every_steps=1500", "resources.workers=0",
)  # fmt: skip


once_made = functools.cache(typer.main.get_command)  # from signatures and help, which takes as long as most commands


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit code, output and errors of one command, in this process."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)}
    sys.argv[1:] = [str(argument) for argument in arguments]
    try:
        cli.main()
        code = 0
    except SystemExit as error:
        code = int(error.code or 0)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err + captured.out
    return code, captured.out, captured.err


@pytest.fixture(autouse=True)
def _own_arguments(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(typer.main, "get_command", once_made)
    monkeypatch.setattr(sys, "argv", ["space-dist"])
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(runs, "STOP", StopRequests())
    monkeypatch.chdir(tmp_path)


def train(*settings: str, out: object = "run", config: object = CONFIG) -> list[object]:
    chosen = [*SMALL, *settings]
    return ["train", config, "--out", out, *(part for setting in chosen for part in ("--set", setting))]


# ---- what a user can get wrong ----


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["train", "missing.yaml"], ["missing.yaml", "does not exist"]),
        (["train", "."], ["is a folder"]),
        (["train", __file__], ["test_cli.py is Python; a config is a YAML file, which names what a module has"]),
        (["train", "/dev/null"], ["/dev/null", "not a regular file"]),
        (train("learner.n_stesp=3"), ["--set learner.n_stesp=3", "did you mean 'n_steps'?"]),
        (train("budget.steps"), ["--set", "KEY=VALUE"]),
        (train("curriculum.imports=a:b"), ["--set curriculum.imports=a:b: curriculum.imports: unknown key"]),
        (
            ["instances", "sample", "uniform", "--env", "a:B", "--out", "x", "--kwarg", "n=1", "--kwarg", "n=2"],
            ["--kwarg 'n=2': n is given twice, as 1 before; leave one out"],
        ),
        (train("curriculum.eta=-1"), ["curriculum.eta: must be a number above 0, not -1"]),
        (train("resources.workers=-1"), ["resources.workers", "-1"]),
        (train("resources.workers=4096"), ["resources.workers: 4096 rollout actors", "CPUs, at most", "4 shards"]),
        (train("kappa=4"), ["--set kappa=4", "unknown key; keys stand in sections: curriculum.kappa"]),
        (train("n_epochs=4"), ["keys stand in sections: learner.n_epochs"]),
        (train("kapa=4"), ["kapa: unknown key; did you mean 'curriculum.kappa'? Allowed here: name"]),
        (train("name=../../etc/passwd"), ["name", "etc/passwd"]),
        (train("env.id=space_dist/PointMas-v0"), ["env.id", "did you mean 'space_dist/PointMass-v0'?"]),
        (train("env.id=no_such_module:make"), ["env.id", "no_such_module", "and last in"]),
        (train("env.id=tests.faulty_env:Hole"), ["no class or function 'Hole'; did you mean 'Whole'?"]),
        (train("env.id=os:no_such_function"), ["env.id", "no_such_function"]),
        (train("env.kwargs={no_such: 1}"), ["env.kwargs", "no_such"]),
        (train("env.kwargs.no_such=1"), [f"{CONFIG} with --set env.kwargs.no_such=1: env.id "]),
        (train("env.context_visible=false"), ["all values tie", "env.context_visible"]),
        (train("learner.kind=dqn"), ["learner"]),
        (train("instances.train=nowhere.csv"), [f"{CONFIG} with --set instances.train=nowhere.csv: instances.train: "]),
        (
            train(f"instances.train={TEST}"),
            [f"--set instances.train={TEST}: training and test instances overlap: both are"],
        ),
        (train("tracking.uri=mysql://x"), ["tracking.uri", "sqlite:////absolute/path/mlflow.db"]),
        (["train", CONFIG, "--workers", "many"], ["--workers"]),
        (["train", CONFIG, "--workers", "-1"], ["space-dist: --workers -1: resources.workers: "]),
        (
            ["train", CONFIG, "--seed", "-1"],
            ["space-dist: --seed -1: seed: must be a whole number from 0 to 2,147,483,647, not -1"],
        ),
        (["train", CONFIG, "--no-such-option"], ["no-such-option"]),
        (["no-such-command"], ["no-such-command"]),
        (["instances", "sample", "pointmass_unifrom", "--out", "x"], ["did you mean 'pointmass_uniform'?"]),
        (
            ["instances", "sample", "unifrm", "--env", "tests.tiny_env:make", "--out", "x"],
            ["unknown distribution", "mean 'uniform'?"],
        ),
        (["report", CONFIG], ["is the config of one run", "report with the run's folder"]),
        (["train", ROOT / "configs/grids/pointmass_space.yaml"], ["does not exist; did you mean", "/../pointmass_sp"]),
        (["train", ROOT / "configs/pointmass_spce.yaml"], ["does not exist; did you mean", "/pointmass_space.yaml'"]),
        (["grid", "plan", ROOT / "configs/slurm/nope.yaml"], ["configs/slurm/nope.yaml does not exist."]),
        (["instances", "check", "nowhere.csv"], ["nowhere.csv"]),
        *(
            ([*words, ROOT / "docs/resluts/x"], ["there is no folder", "docs/resluts; did you mean 'results'?"])
            for words in (
                ["train"],
                ["evaluate"],
                ["report"],
                ["sync"],
                ["grid", "status"],
                ["grid", "plan"],
                ["render"],
            )
        ),
        (["instances", "check", str(TRAIN), str(TRAIN)], ["overlap"]),
        (["instances", "check", str(ROOT / "configs/instances/cartpole_train.csv")], ["length", "--env names another"]),
    ],
    ids=lambda value: " ".join(map(str, value[-1:])) if isinstance(value, list) else None,
)
def test_a_mistake_is_one_clear_sentence_and_exit_code_2(
    capsys: pytest.CaptureFixture[str], arguments: list[object], said: list[str]
) -> None:
    code, _, error = run(capsys, *arguments)
    assert code == 2, error
    text = " ".join(error.replace("│", " ").split())
    for part in said:
        assert part in text
    assert not Path("run").exists()  # nothing was begun


@pytest.mark.parametrize("setting", ["learner.update=lean", "engine=population"])
def test_numba_that_may_not_compile_is_told_before_anything_begins(setting: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "space_dist.cli", *map(str, train(setting, out=tmp_path / "run"))]
    variables = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=PATIENCE, env=variables)
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    for part in ("NUMBA_DISABLE_JIT is set", setting.replace("=", ": "), "unset it, or use learner.update: stock"):
        assert part in line
    assert not (tmp_path / "run").exists()


def test_an_output_that_does_not_block_is_waited_for_and_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    text = b"0123456789" * 30_000  # more than a pipe holds
    output, read = terminal._Output(writing, "w"), bytearray()

    def slowly() -> None:
        while len(read) < len(text):
            time.sleep(0.001)
            read.extend(os.read(reading, 1 << 14))

    reader = threading.Thread(target=slowly)
    reader.start()
    with io.BufferedWriter(output) as buffered:
        buffered.write(text)
        buffered.flush()
        reader.join()
        assert (read == text, output.lost) == (True, None)
        monkeypatch.setattr(terminal, "_READER_SECONDS", 0.05)
        while output.lost is None:  # nobody reads any more
            assert output.write(text) > 0
        assert isinstance(output.lost, TimeoutError)
        assert output.write(text) == len(text)  # and is not waited for again
    os.close(reading)


def test_what_a_terminal_cannot_show_ends_no_command() -> None:
    code = "from space_dist.cli.terminal import keep_outputs; keep_outputs(); print('IQM \u2014 1')"
    environment = {**os.environ, "PYTHONIOENCODING": "latin-1"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=True)
    assert done.stdout == b"IQM ? 1\n"


MODULES = {
    "fails_to_import": "raise ImportError('no such library')",
    "divides_at_import": "1 / 0",
    "is_no_python": "def (",
    "fails_to_make": "def make(n_slots):\n    raise KeyError('slots')",
    "makes_junk": "def make(n_slots):\n    return 3",
    "takes_nothing": "def make():\n    return 3",
    "exits": "raise SystemExit(0)",
}


@pytest.mark.parametrize("module", sorted(MODULES))
def test_a_users_broken_environment_is_named(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / f"{module}.py").write_text(MODULES[module])
    monkeypatch.syspath_prepend(tmp_path)
    code, _, error = run(capsys, *train(f"env.id={module}:make"))
    assert code == 2
    assert "env.id" in error
    assert module in error


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_broken_files_are_refused_by_name(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, data: st.DataObject
) -> None:
    """60 broken configs and 60 broken instance files."""
    text = CONFIG.read_text().splitlines()
    place = data.draw(st.integers(9, len(text) - 1))
    junk = st.sampled_from(["{", "- 1", "a: b: c", "\t", "'", "!!python/none", "? x", "&a *a", "[", "x\0"])
    text.insert(place, data.draw(junk))
    config = tmp_path / "broken.yaml"
    config.write_text("\n".join(text).replace("instances/", f"{ROOT}/configs/instances/"))
    code, _, error = run(capsys, *train(config=config))
    assert code == 2
    assert "broken.yaml" in error

    rows = TRAIN.read_text().splitlines()
    row = data.draw(st.integers(0, 20))
    cell = st.sampled_from(["nan", "inf", "-9", "1e400", "x", "", "1,2", "\0", "1_0", "id"])
    rows[row] = rows[row].rsplit(",", 1)[0] + "," + data.draw(cell)
    instances = tmp_path / "broken.csv"
    instances.write_text("\n".join(rows))
    code, _, error = run(capsys, *train(f"instances.train={instances}"))
    assert code == 2
    assert "broken.csv" in error
    assert f"row {row + 1}" in error


# ---- runs, and coming back to them ----


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small run, left alone."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    command = [sys.executable, "-m", "space_dist.cli", *map(str, train(out=folder))]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    waited, first, *others, last, ended = done.stdout.splitlines()
    assert waited.endswith(": preparing the learner")
    assert "256/4,096 steps" in first
    assert "4,096/4,096 steps" in last
    assert ended.endswith(f"environment steps. {folder}")
    assert all("/4,096 steps" in line for line in others)  # now and then
    return folder


def test_a_run_that_ends_by_its_episodes_says_so(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    config = ROOT / "configs/cartpole_dqn_space.yaml"
    settings = ("budget.episodes=4", "evaluation.episodes=1", "tracking.uri=null", "resources.workers=0")
    sets = [part for setting in settings for part in ("--set", setting)]
    code, out, _ = run(capsys, "train", config, "--out", tmp_path / "run", *sets)
    steps = Ledger(tmp_path / "run").status().steps
    *_, last, ended = out.splitlines()
    assert code == 0
    assert f"{steps:,}/20,000 steps, 4/4 episodes" in last
    assert f"done, 4 of 4 episodes, {steps:,} environment steps" in ended
    assert "budget of 20000 environment steps, or of 4 episodes" in (tmp_path / "run/log.txt").read_text()
    code, again, _ = run(capsys, "train", config, "--out", tmp_path / "run", *sets, "--resume")
    assert (code, again) == (0, f"{ended.replace(' done', ' was already done')}\n")


def same(one: Path, other: Path) -> bool:
    return all((one / name).read_bytes() == (other / name).read_bytes() for name in (METRICS, CURRICULUM, "model.npz"))


def test_a_run_that_is_there_is_neither_overwritten_nor_repeated(
    capsys: pytest.CaptureFixture[str], finished: Path
) -> None:
    before = {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()}
    code, _, error = run(capsys, *train(out=finished))
    assert (code, "--resume" in error) == (2, True)
    code, _, error = run(capsys, *train("curriculum.eta=0.2", "budget.steps=9000", out=finished), "--resume")
    assert code == 2
    assert "curriculum.eta: 0.4 -> 0.2" in error
    assert "budget.steps" not in error  # which may grow
    code, out, _ = run(capsys, *train(out=finished), "--resume")
    assert (code, "already done" in out) == (0, True)
    after = {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()}
    before.pop(finished / "lock.json"), after.pop(finished / "lock.json")
    assert after == before


def ended(process: BaseProcess, output: Path) -> tuple[int | None, str]:
    """Exit code of a command, and what it said."""
    process.join(PATIENCE)
    return process.exitcode, output.read_text()


def until_a_checkpoint(folder: Path) -> None:
    deadline = time.monotonic() + PATIENCE
    while not list(folder.glob("checkpoints/*.npz")) and time.monotonic() < deadline:
        time.sleep(0.005)


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT, signal.SIGUSR1, "file"])
def test_asked_to_stop_it_ends_with_75_and_resumes_to_the_same_bytes(
    capsys: pytest.CaptureFixture[str], finished: Path, tmp_path: Path, how: signal.Signals | str
) -> None:
    folder = tmp_path / "run"
    process = prepared.command(train(out=folder), tmp_path / "said")
    until_a_checkpoint(folder)
    if isinstance(how, signal.Signals):
        os.kill(process.pid or 0, how)
    else:
        (folder / "stop").touch()
    code, said = ended(process, tmp_path / "said")
    status = Ledger(folder).status()
    assert (code, status.state) == (75, "interrupted"), said
    assert 0 < status.steps < 4096
    assert f"after {status.steps:,} steps; the same command goes on, `train` with --resume" in said
    code, _, _ = run(capsys, *train(out=folder), "--resume")
    assert code == 0
    assert same(folder, finished)


def test_a_file_stop_is_heard_from_the_start_of_the_process_on_and_an_older_one_is_told(
    finished: Path, tmp_path: Path
) -> None:
    folder, stop = tmp_path / "run", tmp_path / "run/stop"
    folder.mkdir()
    process = prepared.command([*train(out=folder), "--resume"], tmp_path / "said")
    stop.touch()  # while it starts
    code, said = ended(process, tmp_path / "said")
    assert (code, stop.exists()) == (75, False), said
    assert f"stopped by the file {stop}" in said
    stop.touch()
    os.utime(stop, (1e9, 1e9))
    code, said = ended(prepared.command([*train(out=folder), "--resume"], tmp_path / "said"), tmp_path / "said")
    assert (code, stop.exists()) == (0, False)
    assert f"{stop} is from before this began" in said
    assert same(folder, finished)


def test_a_second_process_on_the_same_run_refuses(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    folder = tmp_path / "run"
    first = prepared.command(train("budget.steps=10000000", out=folder), tmp_path / "said")
    try:
        until_a_checkpoint(folder)
        code, _, error = run(capsys, *train("budget.steps=10000000", out=folder), "--resume")
        assert code == 1
        assert f"process {first.pid}" in error
        assert first.is_alive()
    finally:
        first.kill()
        first.join()


def test_a_round_longer_than_the_grace_time_ends_on_the_last_checkpoint(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    command = train("resources.grace_seconds=0.3", out=folder)
    process = prepared.command(command, tmp_path / "said")
    until_a_checkpoint(folder)
    for number in (signal.SIGSTOP, signal.SIGTERM, signal.SIGCONT):  # as if the round took for ever
        os.kill(process.pid or 0, number)
    assert ended(process, tmp_path / "said")[0] == 75
    code, said = ended(prepared.command([*command, "--resume"], tmp_path / "then"), tmp_path / "then")
    assert code == 0, said
    assert same(folder, finished)


# ---- what comes after a run ----


def test_evaluate_writes_over_nothing_that_it_reads(
    capsys: pytest.CaptureFixture[str], finished: Path, tmp_path: Path
) -> None:
    own = tmp_path / "test.csv"
    own.write_bytes(Path(TEST).read_bytes())
    for out, said in ((own, "is the file of the instances"), (finished / METRICS, "lies in the run's own folder")):
        before = out.read_bytes()
        code, _, error = run(capsys, "evaluate", finished, "--instances", own, "--out", out)
        assert (code, said in " ".join(error.split())) == (2, True)
        assert out.read_bytes() == before


def test_evaluate_gives_what_the_final_evaluation_of_a_policy_could_give(
    capsys: pytest.CaptureFixture[str], finished: Path, tmp_path: Path
) -> None:
    results = tmp_path / "results.csv"
    code, out, _ = run(capsys, "evaluate", finished, "--instances", TEST, "--json", "--out", results)
    assert code == 0
    answer = json.loads(out)
    assert (answer["n_instances"], answer["steps"]) == (100, 4096)
    rows = results.read_text().splitlines()
    assert rows[0] == "id,return,discounted_return,length,success"
    returns = [float(row.split(",")[1]) for row in rows[1:]]
    assert answer["return"] == pytest.approx(sum(returns) / 100)
    last = [row for row in Ledger(finished).rows() if row["kind"] == "evaluation"][-1]["test"]["return"]
    assert answer["return"] == pytest.approx(last, rel=0.2)  # the same policy and instances, other noise
    assert run(capsys, "evaluate", finished, "--instances", TEST, "--json")[1] == out


def test_evaluate_uses_the_last_checkpoint_of_an_unfinished_run(
    capsys: pytest.CaptureFixture[str], finished: Path, tmp_path: Path
) -> None:
    import shutil

    copy = tmp_path / "copy"
    shutil.copytree(finished, copy)
    (copy / "model.npz").unlink()
    whole = run(capsys, "evaluate", finished, "--instances", TEST, "--json")[1]
    from_checkpoint = run(capsys, "evaluate", copy, "--instances", TEST, "--json")[1]
    assert json.loads(from_checkpoint)["return"] == json.loads(whole)["return"]
    (copy / "model.npz").write_bytes(b"PK\x03\x04 nonsense")
    code, _, error = run(capsys, "evaluate", copy, "--instances", TEST)
    assert (code, "damaged" in error) == (1, True)


@pytest.mark.parametrize("command", ["report", "sync"])
def test_folders_without_runs_are_an_error(capsys: pytest.CaptureFixture[str], tmp_path: Path, command: str) -> None:
    code, _, error = run(capsys, command, tmp_path)
    assert code == 2
    assert str(tmp_path) in error.replace("\n", "")


def test_an_interrupted_headroom_goes_on_with_the_same_command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from space_dist.api import headroom

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(headroom, "measure_headroom", interrupted)
    code, _, error = run(capsys, "headroom", CONFIG, "--seeds", 1)
    assert code == 75
    assert "1 run of uniform draws" in error
    assert "the same command goes on" in error


def test_a_folder_of_seeds_is_told_from_a_run(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "s0").mkdir()
    (tmp_path / "s0/status.json").touch()
    code, _, error = run(capsys, "evaluate", tmp_path, "--instances", TEST)
    told = error.replace("\n", "")
    assert (code, f"{tmp_path} holds no run: it has no status.json; {tmp_path}/s0 does" in told) == (2, True)
    cell = tmp_path / "grid/cell"
    for seed in range(5):
        (cell / f"s{seed}").mkdir(parents=True)
        (cell / f"s{seed}/status.json").touch()
    listed = f"{cell}/s0, {cell}/s1, {cell}/s2 and 2 more"
    for folder, command in itertools.product((cell, cell.parent), ("explain", "evaluate", "render")):
        code, _, error = run(capsys, command, folder)  # whatever else it lacks
        told = error.replace("\n", "")
        assert (code, f"; 5 folders below it do, of which one is to be named: {listed}" in told) == (2, True)
    (cell.parent / "alone").mkdir()
    (cell.parent / "alone/status.json").touch()
    code, _, error = run(capsys, "explain", cell.parent)
    assert f"; 6 folders below it do, of which one is to be named: {cell.parent}/alone, " in error.replace("\n", "")
    code, _, error = run(capsys, "evaluate", CONFIG, "--instances", TEST)
    assert code == 2
    assert f"{Path(CONFIG).absolute()} is no run's folder: it is a file" in error.replace("\n", "")


def test_a_run_of_another_configuration_is_told_by_its_kind(capsys: pytest.CaptureFixture[str], finished: Path) -> None:
    command = [*train(out=finished), "--set", "curriculum={kind: round_robin}"]
    code, _, error = run(capsys, *command)
    told = error.replace("\n", "")
    assert code == 2
    assert f"{finished} already holds a run of another configuration: --out DIR starts another (from Python: " in told
    assert told.endswith("There to here: curriculum.kind: space -> round_robin")
    code, _, error = run(capsys, *command, "--resume")
    assert code == 2
    assert "of another configuration (curriculum.kind: space -> round_robin). A run's" in error.replace("\n", "")
    code, _, error = run(capsys, *train(out=finished))
    assert "already holds a run: --resume continues it, --out DIR" in error.replace("\n", "")


def test_a_current_folder_that_was_removed_is_told(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    words = [sys.executable, "-c", "import os, sys; os.rmdir(os.getcwd()); sys.path.insert(0, sys.argv.pop(1));"
             "from space_dist.cli import main; main()", str(ROOT), "configs"]  # fmt: skip
    ended = subprocess.run(words, cwd=gone, capture_output=True, text=True)
    assert (ended.returncode, "the current folder was removed: cd into" in ended.stderr) == (2, True)
    assert "Traceback" not in ended.stderr


def test_evaluate_without_a_run_is_an_error(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_run").mkdir()
    monkeypatch.chdir(tmp_path)
    more = {"evaluate": ("--instances", TEST), "explain": ("--iteration", 1), "export-sb3": (), "fork": ("--at", 1)}
    for command, options in {**more, "render": ("--out", "there")}.items():
        code, _, error = run(capsys, command, "my_run", *options)
        assert (code, "holds no run" in error) == (2, True)
        code, _, error = run(capsys, command, "my_rn", *options)
        assert (code, "my_rn does not exist; did you mean 'my_run'?" in error.replace("\n", "")) == (2, True)
    for command in ("report", "sync"):
        for named, said in (("my_rn", "my_rn is neither here nor"), (tmp_path / "my_rn", "my_rn does not exist")):
            code, _, error = run(capsys, command, named)
            assert (code, said in error.replace("\n", "")) == (2, True)
        code, _, error = run(capsys, command, tmp_path / "my_run")
        assert (code, bool(re.search("no run (or grid )?found in", error))) == (2, True)
    (tmp_path / "my_run/config.yaml").touch()  # there was a run, of which the status is lost
    code, _, error = run(capsys, "evaluate", "my_run", "--instances", TEST)
    assert (code, "holds no run" in error) == (1, True)


def test_a_run_folder_that_cannot_be_made_is_an_error(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    code, _, error = run(capsys, *train(out=tmp_path / "file" / "run"))
    assert (code, "cannot write to the run folder" in error, "--resume" in error) == (1, True, False)
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    if os.access(locked, os.W_OK):
        pytest.skip("root may write anywhere")
    code, _, error = run(capsys, *train(out=locked / "run"))
    assert (code, "permission denied" in error) == (1, True)


def test_a_dead_tracking_server_costs_a_warning_and_nothing_else(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    command = train("tracking.uri=http://127.0.0.1:9", out=folder)
    code, said = ended(prepared.command(command, tmp_path / "said"), tmp_path / "said")
    assert code == 0
    assert "warning: MLflow at http://127.0.0.1:9 could not be brought up to date" in said
    assert "replays the run, and with `--uri URI` elsewhere" in said
    assert same(folder, finished)


def test_schema_and_check_explain_the_config(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "config", "schema")
    assert code == 0
    assert "curriculum.kappa" in out
    code, out, _ = run(capsys, "config", "check", CONFIG)
    assert code == 0
    assert "name: pointmass_space" in out


def test_sampled_instances_are_checked_and_never_overwritten(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    sampled = ["instances", "sample", "pointmass_uniform", "--train", 5, "--test", 3, "--out", tmp_path / "sets"]
    assert run(capsys, *sampled)[0] == 0
    files = sorted((tmp_path / "sets").iterdir())
    assert run(capsys, "instances", "check", *files)[0] == 0
    code, _, error = run(capsys, *sampled)
    assert (code, "exists" in error) == (2, True)


def test_a_grid_is_told_from_a_run(capsys: pytest.CaptureFixture[str]) -> None:
    grid = ROOT / "configs/grids/quickstart.yaml"
    code, _, said = run(capsys, "train", grid)
    assert (code, said) == (
        2,
        f"space-dist: {grid} is a grid, of many runs: space-dist grid run {grid} (from Python: space_dist.run_grid)\n",
    )
    code, _, said = run(capsys, "grid", "run", CONFIG)
    assert code == 2
    assert said.startswith(f"space-dist: {CONFIG} is the config of one run: space-dist train {CONFIG}")
    code, _, said = run(capsys, "config", "check", grid)
    assert (code, said) == (2, f"space-dist: {grid} is a grid, of many runs: space-dist grid plan {grid}\n")
    search = ROOT / "configs/tune/pointmass.yaml"
    code, _, said = run(capsys, "config", "check", search)
    assert (code, said) == (2, f"space-dist: {search} is a search, of many runs: space-dist tune plan {search}\n")


def test_a_slurm_profile_is_told_from_a_run(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("env: {OMP_NUM_THREADS: '1'}\nvenv: /opt/venv\n")
    for profile in (ROOT / "configs/slurm/site.yaml", Path("shipped:slurm/site"), own):
        told = f"space-dist: {profile} is a SLURM profile: space-dist slurm export GRID --out DIR --profile {profile}\n"
        for command in (["train"], ["config", "check"]):
            code, _, said = run(capsys, *command, profile)
            assert (code, said) == (2, told)
    assert Profile.model_fields.keys() - RunConfig.model_fields.keys() == reading._OF_PROFILES


def test_the_schema_can_be_asked_for_a_part(capsys: pytest.CaptureFixture[str]) -> None:
    code, whole, _ = run(capsys, "config", "schema")
    assert code == 0
    _, gamma, _ = run(capsys, "config", "schema", "gamma")
    assert "learner (ppo)" in gamma
    assert {line.split(":")[0].strip() for line in gamma.splitlines() if line.startswith("  learner")} == {
        "learner.gamma"
    }
    _, kind, _ = run(capsys, "config", "schema", "plr")
    assert "curriculum.temperature" in kind
    assert "curriculum.kappa" not in kind
    assert len(kind) < len(whole) / 10
    code, _, said = run(capsys, "config", "schema", "gamm_")
    assert (code, said) == (2, "space-dist: config schema: no key has 'gamm_' in it; did you mean 'gamma'?\n")
    code, _, said = run(capsys, "config", "schema", "lr")
    assert (code, said) == (
        2,
        "space-dist: config schema: no key has 'lr' in it. What Stable-Baselines3 calls lr is learner.learning_rate "
        "here\n",
    )


def test_the_keys_of_grids_and_searches_are_explained(capsys: pytest.CaptureFixture[str]) -> None:
    _, grid, _ = run(capsys, "config", "schema", "--of", "grid")
    assert {f"  {key}:" in grid for key in ("name", "zip", "exclude", "retry.killed", "baseline")} == {True}
    _, search, _ = run(capsys, "config", "schema", "when", "--of", "search")
    keys = {line.split(":")[0].strip() for line in search.splitlines() if "dict" in line}
    assert keys == {"search.NAME.when", "arms.NAME.search.NAME.when"}
    code, _, said = run(capsys, "config", "schema", "retry")
    assert code == 2
    assert said.endswith("no key of a run has 'retry' in it; --of grid or --of search shows one that has\n")
    code, _, said = run(capsys, "config", "schema", "--of", "gird")
    assert (code, said) == (
        2,
        "space-dist: --of 'gird' is not known; did you mean 'grid'? Allowed: run, grid, search\n",
    )


def test_a_pipe_is_told_what_a_run_does(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    settings = [part for setting in SMALL for part in ("--set", setting)]
    code, said, _ = run(capsys, "train", CONFIG, *settings, "--out", tmp_path / "run")
    assert code == 0
    lines = said.splitlines()
    assert lines[0] == "pointmass_space s0: preparing the learner"
    assert lines[1].startswith("pointmass_space s0: 256/4,096 steps")
    assert lines[-2].startswith("pointmass_space s0: 4,096/4,096 steps")
    assert lines[-1].startswith("pointmass_space, seed 0: done, 4,096 environment steps.")


def test_progress_shows_the_last_evaluation_at_the_end_and_after_resuming(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def returns(evaluation: int) -> str:
        row = [row for row in Ledger(tmp_path / "run").rows() if row["kind"] == "evaluation"][evaluation]
        return f"return train {row['train']['return']:.2f} test {row['test']['return']:.2f} at {row['steps']:,}"

    settings = [part for setting in SMALL for part in ("--set", setting)]
    command = ["train", CONFIG, *settings, "--set", "evaluation.every_steps=4096", "--out", tmp_path / "run"]
    _, said, _ = run(capsys, *command)
    assert said.splitlines()[-2].endswith(returns(-1))
    _, said, _ = run(capsys, *command, "--set", "budget.steps=8192", "--resume")
    begun, first, *_, last, _ = [line for line in said.splitlines() if " steps" in line]
    assert begun == "pointmass_space s0: going on at 3,840 steps, under a larger budget: 4,096 -> 8,192 steps"
    assert returns(0) in first  # a larger budget goes on from the round before the last, and the last evaluation
    assert last.endswith(returns(-1))
    assert len({returns(0), returns(1), returns(2)}) == 3


@pytest.mark.parametrize(("width", "line"), [
    (None, "491,520/1,000,000 steps  12,097/s  1:04:23 left  set 33/100  return train -7.56 test 18.11 at 490,000"),
    (89, "491,520/1,000,000 steps  12,097/s  1:04:23 left  return train -7.56 test 18.11 at 490,000"),
    (81, "491,520/1,000,000  12,097/s  1:04:23 left  train -7.56 test 18.11 at 490,000"),  # of 100
    (61, "491,520/1,000,000  1:04:23  train -7.56 test 18.11 at 490,000"),  # of 80, behind `pointmass_space s0`
    (55, "491,520/1,000,000  1:04:23 left  train -7.56 test 18.11"),
    (9, "491,520/1,000,000  1:04:23 left  train -7.56 test 18.11"),
])  # fmt: skip
def test_a_narrow_terminal_shows_the_returns(width: int | None, line: str) -> None:
    progress = Progress(
        491_520, 1_000_000, 12_097.0, 33, 100, train_return=-7.56, test_return=18.11, seconds_left=3863.0,
        evaluated_at=490_000,
    )  # fmt: skip
    assert runs.in_words(progress, width) == line


def test_episodes_beyond_the_budget_are_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    ledger = Ledger(Path("run"))
    monkeypatch.setattr(Ledger, "status", lambda _: SimpleNamespace(steps=6144))
    monkeypatch.setattr(Ledger, "episodes", lambda _: 32)
    told = runs._taken(Outcome(ledger), BudgetConfig(steps=20_000, episodes=20))
    assert told == "32 episodes (the round in which episode 20 ended was finished), 6,144 environment steps"


def test_what_is_left_of_a_budget_and_where_a_run_goes_on_is_said(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    settings = [part for setting in (*SMALL, "checkpoint.every_rounds=1000") for part in ("--set", setting)]
    command = ["train", CONFIG, *settings, "--out", tmp_path / "run", "--resume"]
    short = (*command, "--set", "budget.steps=600")
    left_over = f"512 of 600 environment steps: another update takes 256. {tmp_path / 'run'}\n"
    _, said, _ = run(capsys, *short)
    assert "512/512 steps" in said
    assert said.endswith(f"done, {left_over}")
    _, said, _ = run(capsys, *short)
    assert said == f"pointmass_space, seed 0: was already done, {left_over}"
    _, said, _ = run(capsys, *command, "--set", "budget.steps=700")
    why = (
        "beginning anew, under a larger budget: 600 -> 700 steps; no checkpoint is from before the end of the smaller "
        "one, so it repeats it from its start, to the same bits, and goes beyond"
    )
    assert f"pointmass_space s0: {why}\n" in said
    assert why in (tmp_path / "run/log.txt").read_text()


def test_cells_never_look_alike_however_narrow_the_terminal(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = tmp_path / "wide.yaml"
    grid.write_text(
        f"name: wide\nextends: {os.path.relpath(CONFIG, tmp_path)}\ngrid:\n"
        "  learner.learning_rate: [1.0e-4, 3.0e-4]\n  learner.gae_lambda: [0.95, 0.99]\n  curriculum:\n"
        "    - {kind: space, eta: 0.05, kappa: 16, mean: mean_abs_change}\n"
        "    - {kind: space, eta: 0.05, kappa: 32, mean: mean_abs_change}\n"
        "seeds: [0]\n"
    )
    for width in (40, 80, 200):
        monkeypatch.setattr(terminal.console, "_width", width)  # `width` would be set for good when undone
        code, said, _ = run(capsys, "grid", "plan", grid, "--root", tmp_path)
        assert code == 0
        for rate in ("0.0001", "0.0003"):
            for lambda_ in ("0.95", "0.99"):
                for kappa in (16, 32):
                    label = (
                        f"learning_rate={rate} gae_lambda={lambda_} space eta=0.05 kappa={kappa} mean=mean_abs_change"
                    )
                    assert said.count(label) == 1


def begun_run(place: Path, config: dict[str, object], row: dict[str, object]) -> Run:
    """A grid's run with this last whole row, behind which another is half written."""
    run = Run(Cell("0" * 12, "cell", {}, config), 0)
    ledger = Grid(place).ledger(run)
    ledger.folder.mkdir(parents=True)
    (ledger.folder / METRICS).write_bytes(encode_row({"kind": "iteration", **row}) + b'{"kind":"iterat')
    return run


def test_time_left_is_told_by_the_rate_of_what_was_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(overview.time, "monotonic", lambda: now[0])
    left = overview._TimeLeft(Grid(tmp_path))
    assert left.in_words(Overview(4, 4000)) == ", 4,000 steps left"
    run = Run(Cell("0" * 12, "cell", {}, {}), 0)
    now[0] += 60.0  # in which it loaded libraries and compiled: nothing to go by
    assert left.in_words(Overview(4, 4000, running=[run])) == ", 4,000 steps left, starting"
    begun_run(tmp_path, {}, {"steps": 500})  # what runs counts by its rows
    now[0] += 6.0
    assert left.in_words(Overview(4, 4000, running=[run])) == ", 3,500 steps left"
    now[0] += 6.0  # seconds say little
    assert left.in_words(Overview(4, 3000, done=1)) == ", 3,000 steps left"
    now[0] += 54.0
    assert left.in_words(Overview(4, 3000, done=1, running=[run])) == ", 2,500 steps left, about 0:02:30"
    now[0] += 1.0  # too soon to count anew, but that another one is done
    assert left.in_words(Overview(4, 3000, done=1)) == ", 2,500 steps left, about 0:02:30"
    now[0] += 59.0
    assert left.in_words(Overview(4, 2000, done=2)) == ", 2,000 steps left, about 0:02:40"
    now[0] += 60.0
    assert left.in_words(Overview(4, 0, done=4)) == ""


def test_time_left_goes_by_episodes_where_these_end_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(overview.time, "monotonic", lambda: now[0])
    run = begun_run(tmp_path, {"budget": {"steps": 9000, "episodes": 40}}, {"steps": 500, "episodes": 10})
    by_episodes = functools.partial(Overview, 4, 36_000, by_episodes=True)
    left = overview._TimeLeft(Grid(tmp_path))
    assert left.in_words(by_episodes(160)) == ", 160 episodes left"
    assert left.in_words(by_episodes(160, running=[run])) == ", 160 episodes left"
    now[0] += 10.0
    assert left.in_words(by_episodes(160, running=[run])) == ", 150 episodes left"
    now[0] += 60.0
    seen = by_episodes(160, running=[run])
    seen.leave_out(run)
    assert (seen.steps_left, seen.episodes_left) == (27_000, 120)
    assert left.in_words(seen) == ", 110 episodes left, about 0:02:45"
    assert overview._TimeLeft(Grid(tmp_path)).in_words(by_episodes(None)) == ""  # they end some of the runs
