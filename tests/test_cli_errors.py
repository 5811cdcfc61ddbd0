"""Whatever a user gets wrong: exit code 2 (or 1 for a bad run folder), file and key by name, and never a traceback.

The everyday mistakes, and runs that are stopped and resumed, are in test_cli.py; here are the generated and the odd.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from space_dist import cli
from space_dist import config as configs
from space_dist.interrupts import STOP_SIGNALS
from space_dist.ledger import CURRICULUM, METRICS, Ledger, RunWriter

ROOT = Path(__file__).resolve().parent.parent
CONFIG = ROOT / "configs/pointmass_space.yaml"
TRAIN, TEST = (ROOT / f"configs/instances/pointmass_uniform_{split}.csv" for split in ("train", "test"))
TEXT = CONFIG.read_text().replace("instances/", f"{CONFIG.parent}/instances/")
SMALL = (
    "budget.steps=4096", "learner.n_steps=512", "rollout.slots=1", "learner.n_epochs=1", "tracking.uri=null",
    "checkpoint.every_rounds=1", "evaluation.every_steps=2000", "resources.workers=0",
)  # fmt: skip
generated = settings(deadline=None, suppress_health_check=list(HealthCheck))


def cli_run(*arguments: object) -> tuple[int, str, str]:
    """Exit code, output and errors of one command, through the real entry point, in this process."""
    out, err = io.StringIO(), io.StringIO()
    handlers = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    before = (sys.argv, sys.path, cli.STOP)
    sys.argv = ["space-dist", *map(str, arguments)]
    sys.path = list(sys.path)
    cli.STOP = cli.StopRequests()
    code = 0
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            cli.main()
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else int(error.code is not None)
    finally:
        sys.argv, sys.path, cli.STOP = before
        for number, handler in handlers.items():
            signal.signal(number, handler)
    assert "Traceback" not in out.getvalue() + err.getvalue()
    return code, out.getvalue(), err.getvalue()


def refused(*arguments: object, code: int | tuple[int, ...] = 2) -> str:
    """The error text of a command that must fail, on one line, without the frame of usage errors."""
    got, _, error = cli_run(*arguments)
    assert got in ((code,) if isinstance(code, int) else code), f"exit code {got}: {error}"
    assert error.strip()
    assert len(error) < 6_000
    assert all(character.isprintable() or character == "\n" for character in error), repr(error)
    return " ".join(error.replace("│", " ").split())


def sets(*chosen: str) -> list[str]:
    return [part for setting in chosen for part in ("--set", setting)]


def train(*chosen: str, out: object = "run", config: object = CONFIG) -> list[object]:
    return ["train", config, "--out", out, *sets(*SMALL, *chosen)]


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)


def written(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


# ---- files and settings ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", [["train"], ["config", "check"]], ids=["train", "check"])
@pytest.mark.parametrize(
    ("config", "said"),
    [
        ("missing.yaml", "does not exist"), (".", "is a folder"), ("/dev/null", "not a regular file"),
        ("x" * 300, "cannot be read"), ("missing/deeper.yaml", "does not exist"), (f"{CONFIG}/below", "cannot be read"),
        ("", "is a folder"),
    ],
)  # fmt: skip
def test_configs_that_are_no_files(command: list[str], config: str, said: str) -> None:
    text = refused(*command, config)
    assert said in text
    assert config in text
    assert not Path("runs").exists()


def test_a_fifo_is_not_waited_for() -> None:
    os.mkfifo("pipe")
    assert "not a regular file" in refused("config", "check", "pipe")
    assert "pipe" in refused("instances", "check", "pipe")


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("", "KEY=VALUE"), ("=", "KEY=VALUE"), ("seed", "KEY=VALUE"), (".a=1", "KEY=VALUE"), ("seed=[", "--set seed=["),
        ("seed=-1", "seed: -1"), ("seed=1e400", "seed"), ("seed=true", "seed: True"), ("seed=null", "seed: None"),
        ("learner=3", "learner: 3"), ("curriculum=null", "curriculum: None"), ("rollout=[1]", "rollout: [1]"),
        ("learner.kind=pop", "did you mean 'ppo'?"), ("curriculum.kind=spacee", "did you mean 'space'?"),
        ("curriculum.kind=round_robin", "curriculum.eta: unknown key"), ("learner.gmma=1", "did you mean 'gamma'?"),
        ("name.x=1", "'name' is not a section"), ("budgett.steps=1", "did you mean 'budget'?"),
        ("name=a/b", "name: 'a/b'"), ("name=..", "name: '..'"), ("name=/etc/passwd", "name: '/etc/passwd'"),
        ("rollout.shards=3", "learner.n_steps = 2048 is not a multiple of"), ("rollout.slots=64", "horizon"),
        ("budget.steps=100", "budget.steps = 100"), ("evaluation.every_steps=0", "evaluation.every_steps"),
        ("resources.workers=-1", "resources.workers: -1"), ("tracking.uri=ftp://x", "tracking.uri"),
        ("instances.train=no.csv", "no.csv"), ("instances.test=.", "is a folder"), ("instances.train=''", "train"),
        ("instances.train=/dev/zero", "/dev/zero: is not a regular file"), (f"instances.test={TRAIN}", "overlap"),
        ("instances.train=3", "instances.train"), ("env.context_visible=false", "env.context_visible"),
        ("env.id=PointMass-v0", "did you mean 'space_dist/PointMass-v0'?"), ("env.id=''", "env.id"),
        ("env.id=:make", "env.id"), ("env.id=os:", "env.id"), ("env.id=.os:getcwd", "env.id"), ("env.id=os:sep", "env.id"),
        ("env.id=os:getcwd", "env.id"), ("env.id=sys:exit", "env.id"), ("env.id=no.such:make", "env.id"),
        ("env.id=builtins:list", "env.id"), ("env.id=builtins:print", "env.id"), ("env.id=a:b:c", "env.id"),
        ("env.id='os :getcwd'", "env.id"), ("env.kwargs={mass: 3}", "env.kwargs"), ("env.kwargs=3", "env.kwargs"),
        ('name="\\e[31m"', "name"), ('learner="\\u202e"', "learner"), ("seed=0x" + "f" * 5_000, "seed"),
        ("learner.learning_rate=0x" + "f" * 400, "learner.learning_rate"), ("seed=&a [*a]", "--set seed"),
        ("seed=!!python/name:os.system", "--set seed"), ("learner.net_arch=[0]", "learner.net_arch"),
        ("learner.policy=MlpPolcy", "did you mean 'MlpPolicy'?"), ("learner.policy=a:b", "learner.policy"),
        ("learner.policy=os:getcwd", "learner.policy"), ("learner.policy=CnnPolicy", "learner.policy"),
        ("learner={kind: dqn, n_steps: 2048}", "learner"), ("curriculum={kind: fixed, ids: [999999]}", "999999"),
        ("curriculum={kind: fixed, count: 101}", "count"), ("curriculum={kind: fixed}", "curriculum"),
        ("x\x1b[31m=1", "x"), ("seed=1\x07", "seed"),
    ],
)  # fmt: skip
def test_settings_that_cannot_be(setting: str, said: str) -> None:
    for arguments in (["config", "check", CONFIG, *sets(setting)], ["train", CONFIG, *sets("resources.workers=0", setting)]):
        text = refused(*arguments)
        assert said in text
    assert not Path("runs").exists()


@pytest.mark.parametrize(
    ("content", "key"),
    [
        (TEXT.replace("slots: 4", "slots: 64"), "rollout.slots"),
        (TEXT.replace("slots: 4", "slots: 3"), "rollout.slots"),
        (TEXT.replace("context_visible: true", "context_visible: false"), "env.context_visible"),
        (TEXT.replace("PointMass-v0", "PointMess-v0"), "env.id"),
        (TEXT.replace("space_dist/PointMass-v0", "no_such_module:make"), "env.id"),
        (TEXT.replace("space_dist/PointMass-v0", "os:getcwd"), "env.id"),
        (TEXT.replace("pointmass_uniform_test", "pointmass_uniform_train"), "instances"),
        (TEXT.replace("kind: ppo", "kind: ppoo"), "learner.kind"),
        (TEXT.replace("kappa: 1", "kappa: 0"), "curriculum.kappa"),
        (TEXT.replace("kappa: 1", "kapa: 1"), "curriculum.kapa"),
        (TEXT.replace("name: ", "nmae: "), "nmae"),
        (TEXT + "seed: 1\nseed: 2\n", "seed"),
        (TEXT.replace("space_dist/PointMass-v0", "space_dist/PointMass-v0\n  kwargs: {mass: 1}"), "env.kwargs"),
    ],
)
def test_a_fault_of_a_config_names_the_config_and_the_key(content: str, key: str, tmp_path: Path) -> None:
    text = refused("config", "check", written(tmp_path / "faulty.yaml", content))
    assert "faulty.yaml" in text
    assert key in text


@pytest.mark.parametrize(
    "arguments",
    [
        ["no-such-command"], ["train"], ["--no-such-option"], ["train", "--seed", "x", CONFIG], ["evaluate"], ["report"],
        ["train", CONFIG, "--workers", "1.5"], ["train", CONFIG, "--workers", "-1"], ["train", CONFIG, "--seed", "-1"],
        ["train", CONFIG, "--seed", str(2**40)], ["train", CONFIG, "--set"], ["train", CONFIG, "more"], ["config", "chek"],
        ["instances", "sample", "pointmass_uniform", "--out", ".", "--train", "0"], ["instances", "sample", "nothing"],
        ["instances", "sample", "nothing", "--out", "."], ["instances", "check"], ["instances", "check", ""],
        ["instances", "sample", "pointmass_uniform", "--out", CONFIG], ["instances", "check", TRAIN, "--env", "x"],
        ["instances", "sample", "pointmass_uniform", "--out", ".", "--seed", "-1"], ["instances", "check", "x" * 300],
        ["instances", "sample", "pointmass_uniform", "--out", "x" * 300], ["instances", "check", TRAIN, TEST, TRAIN],
    ],
    ids=lambda arguments: " ".join(str(argument)[-20:] for argument in arguments),
)  # fmt: skip
def test_command_lines_that_cannot_be(arguments: list[object]) -> None:
    refused(*arguments)


# ---- generated configs and instance files ---------------------------------------------------------------------------

junk = st.one_of(
    st.text(max_size=30), st.integers(), st.floats(), st.none(), st.lists(st.integers(), max_size=2),
    st.dictionaries(st.text(max_size=4), st.integers(), max_size=2), st.sampled_from(["", "..", "\x1b[2J", "[bold]x", "\0"]),
)  # fmt: skip


@settings(generated, max_examples=100)
@given(data=st.data())
def test_generated_configs(data: st.DataObject, tmp_path: Path) -> None:
    tree = configs.YAML(typ="safe", pure=True).load(TEXT)
    section = data.draw(st.sampled_from([name for name, value in tree.items() if isinstance(value, dict)]))
    place = data.draw(st.sampled_from([tree, tree[section]]))
    key = data.draw(st.sampled_from(sorted(place)))
    match data.draw(st.sampled_from(["value", "rename", "remove", "add"])):
        case "value":
            place[key] = data.draw(junk)
        case "rename":
            place[data.draw(st.text(max_size=12))] = place.pop(key)
        case "remove":
            del place[key]
        case _:
            place[data.draw(st.text(max_size=12))] = data.draw(junk)
    path = written(tmp_path / "generated.yaml", configs.to_yaml(tree))
    code, out, error = cli_run("config", "check", path)
    if code == 0:
        assert configs.load(written(tmp_path / "again.yaml", out)) == configs.load(path)
        return
    assert code == 2
    flat = error.replace("\n", "")
    assert "generated.yaml" in flat or ".csv" in flat or str(tmp_path) in flat
    assert "space-dist: " in error
    assert all(character.isprintable() or character == "\n" for character in error), repr(error)


@settings(generated, max_examples=60)
@given(content=st.one_of(st.binary(max_size=200), st.text("{}[]&*!|>%@'\",:?-# \nab01<=", max_size=80).map(str.encode)))
def test_random_bytes_as_a_config(content: bytes, tmp_path: Path) -> None:
    assert "random.yaml" in refused("train", written(tmp_path / "random.yaml", content))


@settings(generated, max_examples=100)
@given(seed=st.integers(0, 2**32))
def test_garbled_instance_files(seed: int, tmp_path: Path) -> None:
    rng = random.Random(seed)
    content = bytearray(b"".join(TRAIN.read_bytes().splitlines(keepends=True)[:6]))
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(content))
        match rng.randrange(4):
            case 0:
                content[at] = rng.randrange(256)
            case 1:
                del content[at : at + rng.randint(1, 30)]
            case 2:
                content[at:at] = rng.choice([b",", b"\n", b'"', b"\0", b"nan", b"-", b"1e999", b"\xff", b"\x1b[2J", b"\r"])
            case _:
                content[at:at] = content[at : at + rng.randint(1, 80)]
    path = written(tmp_path / "garbled.csv", bytes(content))
    code, _, error = cli_run("instances", "check", path)
    assert code in (0, 2)
    if code == 2:
        assert "garbled.csv" in error
        assert len(error) < 2_000
        assert all(character.isprintable() or character == "\n" for character in error), repr(error)
        text = refused("config", "check", CONFIG, *sets(f"instances.train={path}"))
        assert "garbled.csv" in text


@settings(generated, max_examples=40)
@given(content=st.one_of(st.binary(max_size=200), st.text('id,gate_xwh"friconm\n0129.-e', max_size=150).map(str.encode)))
def test_random_bytes_as_an_instance_file(content: bytes, tmp_path: Path) -> None:
    assert "random.csv" in refused("instances", "check", written(tmp_path / "random.csv", content))


# ---- a user's own environment ---------------------------------------------------------------------------------------

HEADER = "import sys\nimport numpy as np\nfrom tests.tiny_env import Line, make as line\n"
BROKEN: dict[str, tuple[str, str]] = {
    "raises_import_error": ("raise ImportError('no [bold]such[/bold] thing')", "no [bold]such[/bold] thing"),
    "divides_by_zero": ("1 / 0", "ZeroDivisionError"),
    "raises_os_error": ("open('/no/such/file')", "FileNotFoundError"),
    "is_no_python": ("def make(:", "SyntaxError"),
    "recurses": ("def f():\n    f()\nf()", "RecursionError"),
    "asserts": ("assert False, 'impossible'", "impossible"),
    "exits": ("sys.exit(0)", "SystemExit"),
    "has_no_make": ("", "no function 'make'"),
    "make_is_a_number": ("make = 3", "no function 'make'"),
    "make_raises": ("def make(n):\n    raise RuntimeError('line one\\nline two')", "RuntimeError"),
    "make_exits": ("def make(n):\n    sys.exit(0)", "SystemExit"),
    "make_needs_more": ("def make(n, m):\n    return line(n)", "TypeError"),
    "make_gives_none": ("def make(n):\n    return None", "NoneType"),
    "make_gives_a_class": ("def make(n):\n    return Line", "env.id"),
    "bounds_are_junk": ("def make(n):\n    e = line(n)\n    e.context_bounds = 3\n    return e", "env.id"),
    "bounds_are_none": ("def make(n):\n    e = line(n)\n    e.context_bounds = None\n    return e", "env.id"),
    "horizon_is_a_word": ("def make(n):\n    e = line(n)\n    e.horizon = 'long'\n    return e", "env.id"),
    "horizon_is_zero": ("def make(n):\n    e = line(n)\n    e.horizon = 0\n    return e", "env.id"),
    "space_is_junk": ("def make(n):\n    e = line(n)\n    e.observation_space = 'box'\n    return e", "env.id"),
    "actions_are_junk": ("def make(n):\n    e = line(n)\n    e.action_space = None\n    return e", "env.id"),
    "reset_raises": ("def make(n):\n    e = line(n)\n    e.reset = lambda *a: 1 / 0\n    return e", "env.id"),
    "reset_gives_none": ("def make(n):\n    e = line(n)\n    e.reset = lambda *a: None\n    return e", "env.id"),
    "reset_gives_too_few": (
        "def make(n):\n    e = line(n)\n    e.reset = lambda *a: np.zeros((1, 7), np.float32)\n    return e", "env.id",
    ),
}  # fmt: skip


@pytest.fixture
def line(tmp_path: Path) -> Path:
    """A config for environments made of `tests.tiny_env`."""
    written(tmp_path / "line_train.csv", "id,target\n0,-0.5\n1,0.5\n2,0.75\n")
    written(tmp_path / "line_test.csv", "id,target\n10,0.25\n")
    return written(tmp_path / "line.yaml", f"""
name: line
env: {{id: "tests.tiny_env:make"}}
instances: {{train: {tmp_path}/line_train.csv, test: {tmp_path}/line_test.csv}}
curriculum: {{kind: space}}
learner: {{kind: ppo, n_steps: 64, net_arch: [4], n_epochs: 1}}
rollout: {{shards: 2, slots: 2}}
budget: {{steps: 128}}
tracking: {{uri: null}}
resources: {{workers: 0}}
""")


def test_the_line_works(line: Path) -> None:
    assert cli_run("config", "check", line)[0] == 0
    assert cli_run("train", line, "--out", "run")[0] == 0


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_environment(name: str, line: Path, tmp_path: Path) -> None:
    source, said = BROKEN[name]
    module = f"user_{name}"
    written(tmp_path / f"{module}.py", HEADER + source)
    with contextlib.chdir(tmp_path):
        for command in (["config", "check", line], ["train", line, "--out", "run"]):
            text = refused(*command, *sets(f"env.id={module}:make"))
            assert "env.id" in text
            assert module in text
            assert said in text
        assert not Path("run").exists()
    sys.modules.pop(module, None)


LATE = {
    "raises": "lambda actions: 1 / 0",
    "gives_none": "lambda actions: None",
    "gives_nan": "lambda actions: S(np.full((n, 1), np.nan, np.float32), r, f, f, None)",
    "rewards_nan": "lambda actions: S(o, np.full(n, np.nan), f, f, None)",
    "too_few": "lambda actions: S(np.zeros((1, 1), np.float32), np.zeros(1), f[:1], f[:1], None)",
    "never_ends": "lambda actions: S(o, r, f, f, None)",
    "exits": "lambda actions: sys.exit(0)",
}


@pytest.mark.parametrize("name", LATE)
def test_an_environment_that_breaks_while_it_trains(name: str, line: Path, tmp_path: Path) -> None:
    module = f"late_{name}"
    written(tmp_path / f"{module}.py", HEADER + f"""
from space_dist.envs import Step as S
def make(n):
    e = line(n)
    o, r, f = np.zeros((n, 1), np.float32), np.zeros(n), np.zeros(n, bool)
    e.step = {LATE[name]}
    return e
""")
    with contextlib.chdir(tmp_path):
        refused("train", line, "--out", "run", *sets(f"env.id={module}:make"), code=(1, 2))
        status = Ledger("run").status()
    assert status.state == "failed"
    assert status.message
    sys.modules.pop(module, None)


# ---- run folders ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small run, left alone; copy it before changing it."""
    folder = tmp_path_factory.mktemp("done") / "run"
    code, _, error = cli_run(*train(out=folder))
    assert (code, error) == (0, "")
    return folder


@pytest.fixture
def run(done: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(done, tmp_path / "run"))


def test_a_folder_that_holds_a_run_is_not_begun_again(run: Path) -> None:
    text = refused(*train(out=run))
    assert "--resume continues it" in text
    assert str(run) in text


@pytest.mark.parametrize(
    ("setting", "key"),
    [
        ("learner.gamma=0.5", "learner.gamma: 0.95 -> 0.5"), ("seed=1", "seed: 0 -> 1"), ("name=other", "name"),
        ("rollout.shards=2", "rollout.shards: 4 -> 2"), ("curriculum={kind: round_robin}", "curriculum.kind"),
        ("learner={kind: trpo, n_steps: 512}", "learner.kind: ppo -> trpo"), ("budget.steps=8192", "budget.steps"),
        ("evaluation.episodes=2", "evaluation.episodes: 1 -> 2"), (f"instances.test={TRAIN.parent}/pointmass_target_test.csv",
                                                                    "instances: other contexts or ids"),
    ],
)  # fmt: skip
def test_a_run_cannot_be_resumed_with_other_settings(run: Path, setting: str, key: str) -> None:
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file() and path.name != "lock.json"}
    text = refused(*train(setting, out=run), "--resume")
    assert key in text
    assert str(run) in text
    assert {path: path.read_bytes() for path in before} == before


def test_a_run_that_is_done_is_done_with_whatever_decides_no_result(run: Path) -> None:
    moved = shutil.copy(TRAIN, run.parent / "moved.csv")
    code, out, _ = cli_run(*train(f"instances.train={moved}", "checkpoint.every_rounds=7", out=run), "--resume")
    assert (code, "already done" in out) == (0, True)


def test_the_flag_file_stops_a_run_which_then_ends_the_same(done: Path, tmp_path: Path) -> None:
    folder = tmp_path / "stopped"
    folder.mkdir()
    (folder / "stop").touch()  # an old flag is not for this run

    def flag() -> None:
        deadline = time.monotonic() + 60
        while not (folder / "status.json").exists() and time.monotonic() < deadline:
            time.sleep(0.001)
        (folder / "stop").touch()

    thread = threading.Thread(target=flag)
    thread.start()
    text = refused(*train(out=folder), code=75)
    thread.join()
    assert "--resume continues" in text
    status = Ledger(folder).status()
    assert status.state == "interrupted"
    assert 0 < status.steps < 4096
    assert cli_run(*train(out=folder), "--resume")[0] == 0
    for name in (METRICS, CURRICULUM, "model.npz"):
        assert (folder / name).read_bytes() == (done / name).read_bytes()


def test_a_run_that_another_process_owns_is_left_alone(run: Path) -> None:
    command = [sys.executable, "-m", "space_dist.cli", *map(str, train(out=run)), "--resume"]
    with RunWriter(Ledger(run)):
        before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file() and path.name != "lock.json"}
        other = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert {path: path.read_bytes() for path in before} == before
    assert other.returncode == 1
    assert f"process {os.getpid()} " in other.stderr
    assert "Traceback" not in other.stderr


@pytest.mark.parametrize("command", ["evaluate", "report", "sync", "train"])
@pytest.mark.parametrize("folder", ["missing", "empty", "file", "x" * 300, "file/below"])
def test_folders_that_hold_no_run(command: str, folder: str, tmp_path: Path) -> None:
    Path("empty").mkdir()
    Path("file").touch()
    if command == "train":
        if folder in ("missing", "empty"):
            pytest.skip("a run may begin there")
        text = refused(*train(out=folder), code=(1, 2))
    else:
        more = {"evaluate": ["--instances", TEST], "report": ["--out", tmp_path / "report"], "sync": []}[command]
        text = refused(command, folder, *more, code=(1, 2))
    assert folder in text
    assert not Path("report").exists()


def test_a_run_in_a_read_only_folder(tmp_path: Path) -> None:
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    if os.access(locked, os.W_OK):
        locked = Path("/proc/sys")  # where root may not make folders either
        if not locked.is_dir():
            pytest.skip("root may write anywhere")
    assert str(locked) in refused(*train(out=locked / "run"), code=(1, 2))


DAMAGED = ["status.json", "config.yaml", "instances_train.csv", "instances_test.csv", "metrics.jsonl", "timing.jsonl",
           "curriculum.jsonl", "model.npz", "model.json", "lock.json", "checkpoints", "log.txt"]  # fmt: skip


def damage(path: Path, how: str) -> None:
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    for file in files:
        content = file.read_bytes()
        match how:
            case "removed":
                file.unlink()
            case "emptied":
                file.write_bytes(b"")
            case "cut":
                file.write_bytes(content[: len(content) // 2])
            case "garbled":
                file.write_bytes(bytes(random.Random(1).choices(range(256), k=300)))
            case "json":
                file.write_bytes(b'{"a": [1, 2]}\n' * 3)
            case "folder":
                file.unlink()
                file.mkdir()


@pytest.mark.parametrize("how", ["removed", "emptied", "cut", "garbled", "json", "folder"])
@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_run_folder_never_ends_in_a_traceback(name: str, how: str, run: Path, tmp_path: Path) -> None:
    damage(run / name, how)
    for arguments in (
        ["evaluate", run, "--instances", TEST],
        ["report", run, "--out", tmp_path / "report"],
        [*train(out=run), "--resume"],
    ):
        code, _, error = cli_run(*arguments)
        assert code in (0, 1, 2)
        assert (code == 0) == (error == "") or "warning" in error
        if code:
            assert str(run) in error.replace("\n", "")


@pytest.mark.parametrize("how", ["removed", "emptied", "cut", "garbled", "folder"])
@pytest.mark.parametrize("name", [name for name in DAMAGED if name not in ("model.npz", "model.json")])
def test_a_damaged_unfinished_run_resumes_to_the_same_or_says_why_not(
    name: str, how: str, run: Path, done: Path
) -> None:
    unfinished(run)
    damage(run / name, how)
    code, _, error = cli_run(*train(out=run), "--resume")
    assert code in (0, 1, 2)
    if code:
        assert str(run) in error.replace("\n", "")
    else:
        for kept in (METRICS, CURRICULUM, "model.npz"):
            assert (run / kept).read_bytes() == (done / kept).read_bytes()


def unfinished(run: Path) -> None:
    """As if the run had been killed before its model was written."""
    import dataclasses

    with RunWriter(Ledger(run)) as writer:
        writer.status = writer.ledger.status()
        writer.set_status(dataclasses.replace(writer.status, state="running"))
    (run / "model.npz").unlink()
    (run / "model.json").unlink()


def test_evaluating_on_other_instances(run: Path, tmp_path: Path) -> None:
    bad = written(tmp_path / "bad.csv", "id,target\n0,1\n")
    text = refused("evaluate", run, "--instances", bad)
    assert "bad.csv" in text
    assert "row 1" in text
    assert "nowhere.csv" in refused("evaluate", run, "--instances", "nowhere.csv")
    assert str(tmp_path) in refused("evaluate", run, "--instances", TEST, "--out", tmp_path)
    assert "bad.csv" in refused("evaluate", run, "--instances", TEST, "--out", bad / "below.csv")
    code, out, _ = cli_run("evaluate", run, "--instances", TEST, "--json")
    assert (code, json.loads(out)["n_instances"]) == (0, 100)


def test_reports_that_cannot_be_written(run: Path, tmp_path: Path) -> None:
    blocked = written(tmp_path / "blocked", "")
    assert str(blocked) in refused("report", run, "--out", blocked)
    (tmp_path / "out" / "report.png").mkdir(parents=True)
    assert str(tmp_path / "out") in refused("report", run, "--out", tmp_path / "out")


# ---- as a user calls it ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    folder = tmp_path_factory.mktemp("processes")

    def call(*arguments: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "space_dist.cli", *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=folder)

    yield call
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["train", "missing.yaml"], "missing.yaml does not exist"),
        (["train", CONFIG, "--set", "learner.gmma=1"], "did you mean 'gamma'?"),
        (["train", CONFIG, "--set", "env.id=os:getcwd"], "env.id"),
        (["instances", "check", CONFIG], "pointmass_space.yaml"),
        (["nonsense"], "nonsense"),
    ],
    ids=range(5),
)
def test_real_processes(processes: Any, arguments: list[object], said: str) -> None:
    done = processes(*arguments)
    assert done.returncode == 2
    assert said in " ".join(done.stderr.replace("│", " ").split())
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
