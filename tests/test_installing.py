"""What an installation brings: the wheel outside a checkout, extras, a project to start with, and the doctor."""

from __future__ import annotations

import http.server
import os
import re
import shutil
import site
import subprocess
import sys
import tarfile
import threading
import zipfile
from pathlib import Path

import pytest
import typer

import space_dist
from space_dist import cli
from space_dist import config as configs
from space_dist.cli import health
from space_dist.cli.health import Finding
from space_dist.errors import ConfigError, LedgerError
from space_dist.slurm import load_profile
from tests.commanding import command
from tests.patience import PATIENCE
from tests.test_report import start_run

ROOT = Path(__file__).parents[1]
SHORT = ("--set", "budget.steps=2048", "--set", "learner.n_steps=1024", "--set", "learner.n_epochs=1", "--set",
         "tracking.uri=null", "--set", "resources.workers=0")  # fmt: skip


def said(words: list[object], where: Path, code: int = 0, **environment: str) -> str:
    """What a program says, from a folder and without this checkout on its path; it must end with `code`."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [*map(str, words)], cwd=where, env={**kept, **environment}, capture_output=True, text=True, timeout=PATIENCE
    )
    assert done.returncode == code, done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    return done.stdout + done.stderr


# ---- wheel and sdist -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the wheel and the sdist of what is here."""
    out, source = tmp_path_factory.mktemp("dist"), tmp_path_factory.mktemp("source") / "space_dist"
    shutil.copytree(
        ROOT, source, symlinks=True,
        ignore=lambda folder, names: [
            name for name in names
            if name == "__pycache__" or (Path(folder) == ROOT and name not in {
                "space_dist", "configs", "pyproject.toml", "README.md", "LICENSE", "MANIFEST.in",
            })
        ],
    )  # fmt: skip
    for kind in ("wheel", "sdist"):
        code = f"import sys, setuptools.build_meta as build; print(build.build_{kind}(sys.argv[1]))"
        said([sys.executable, "-c", code, out], source)
    return out


def test_both_bring_every_config_instance_set_and_template(built: Path) -> None:
    (wheel,), (sdist,) = built.glob("*.whl"), built.glob("*.tar.gz")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert {f"space_dist/shipped/{file}" for file in configs.shipped_files()} <= names
    project = ROOT / "space_dist/cli/project"
    assert {f"space_dist/cli/project/{file.relative_to(project)}"
            for file in project.rglob("*") if file.is_file()} <= names  # fmt: skip
    assert {"space_dist/py.typed", "space_dist/report/page.html", "space_dist/slurm/templates/array.sbatch.j2"} <= names
    assert not [name for name in names if name.startswith(("tests", "configs", "jobs"))]
    with tarfile.open(sdist) as tar:
        inside = {name.partition("/")[2] for name in tar.getnames()}
    assert {"pyproject.toml", "LICENSE", "space_dist/py.typed", "space_dist/cli/project/slider.yaml"} <= inside


def test_what_was_installed_from_the_wheel_runs_from_any_folder(built: Path, tmp_path: Path) -> None:
    """Into an environment that has the dependencies: from where they are, not once more."""
    (wheel,) = built.glob("*.whl")
    home, place = tmp_path / "env", tmp_path / "somewhere"
    place.mkdir()
    said([sys.executable, "-m", "venv", "--without-pip", home], tmp_path)
    (packages,) = home.glob("lib/*/site-packages")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(packages)  # noqa: S202 - our own wheel
    (packages / "dependencies.pth").write_text("".join(f"{path}\n" for path in site.getsitepackages()))
    program = [home / "bin/python", "-P", "-m", "space_dist.cli"]
    where = said([home / "bin/python", "-P", "-c", "import space_dist; print(space_dist.__file__)"], place)
    assert where.strip() == str(packages / "space_dist/__init__.py")
    assert "shipped:pointmass_space" in said([*program, "configs"], place)
    told = said([*program, "train", "shipped:pointmass_space", *SHORT], place)
    assert "pointmass_space, seed 0: done, 2,048 environment steps" in told
    assert (place / "runs/pointmass_space/s0/model.npz").exists()
    said([*program, "init", "mine"], place)
    said([*program, "config", "check", "slider.yaml"], place / "mine")


# ---- what ships ------------------------------------------------------------------------------------------------------


def test_what_ships_is_named_with_or_without_its_folder_and_suffix() -> None:
    whole = ROOT / "configs/grids/quickstart.yaml"
    for name in ("grids/quickstart.yaml", "grids/quickstart", "quickstart", "quickstart.yaml"):
        assert configs.located(f"shipped:{name}").samefile(whole)
    for name in ("instances/cartpole_test.csv", "cartpole_test.csv", "instances/cartpole_test", "cartpole_test"):
        assert configs.located(f"shipped:{name}").samefile(ROOT / "configs/instances/cartpole_test.csv")
    assert configs.located(Path("configs/x.yaml")) == Path("configs/x.yaml")
    for bad in ("pointmas_space", "../pyproject", "/etc/passwd", ""):
        with pytest.raises(ConfigError, match=r"nothing of this name comes with space_dist.*`space-dist configs`"):
            configs.located(f"shipped:{bad}")
    with pytest.raises(ConfigError, match=r"did you mean 'pointmass_target_test\.csv'"):
        configs.located("shipped:pointmass_target_tset.csv")
    with pytest.raises(ConfigError, match="did you mean 'pointmass_space'"):
        configs.load(Path("shipped:pointmas_space"))


def test_it_is_taken_wherever_a_path_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text(
        "name: mine\nextends: shipped:pointmass_space\nzip: {instances.test: ['shipped:pointmass_target_test.csv']}\n"
        "seeds: [0]\n"
    )
    for words in (
        ("config", "check", "shipped:pointmass_space"), ("grid", "plan", "shipped:quickstart", "--root", "x"),
        ("grid", "plan", "mine.yaml", "--root", "x"), ("grid", "status", "shipped:quickstart", "--root", "x"),
        ("instances", "check", "shipped:pointmass_target_test.csv"),
        ("env", "check", "space_dist/PointMass-v0", "--instances", "shipped:pointmass_target_test.csv"),
        ("config", "check", "shipped:pointmass_space", "--set", "instances.test=shipped:pointmass_target_test.csv"),
    ):  # fmt: skip
        assert command(monkeypatch, *words) == (3 if "status" in words else 0), (words, capsys.readouterr().err)
    assert load_profile(Path("shipped:slurm/site")).partition == "cpu"
    capsys.readouterr()
    assert command(monkeypatch, "report", "shipped:quickstrat") == 2
    assert "did you mean 'quickstart'" in capsys.readouterr().err


def test_configs_lists_and_copies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command(monkeypatch, "configs") == 0
    *lines, sets = capsys.readouterr().out.splitlines()
    assert len(lines) == len([file for file in configs.shipped_files() if file.endswith(".yaml")])
    assert "shipped:instances/NAME.csv: " in sets
    assert "pointmass_target_test, " in sets
    assert all(re.fullmatch(r"shipped:[\w/]+ +\S.{10,}", line) for line in lines), lines
    assert command(monkeypatch, "configs", "--copy", "quickstart", "mine") == 0
    assert capsys.readouterr().out.splitlines()[-1] == "Next: space-dist grid run mine/grids/quickstart.yaml"
    copied = sorted(path.relative_to("mine").as_posix() for path in Path("mine").rglob("*.*"))
    assert copied == [
        "grids/quickstart.yaml", "instances/pointmass_uniform_test.csv", "instances/pointmass_uniform_train.csv",
        "instances/wins/final/pointmass_uniform_padded.csv", "instances/wins/final/pointmass_uniform_test.csv",
        "sparse_pointmass_edge.yaml",
    ]  # fmt: skip
    assert command(monkeypatch, "config", "check", "mine/sparse_pointmass_edge.yaml") == 0
    assert command(monkeypatch, "configs", "--copy", "sparse_pointmass_edge", "mine") == 2
    assert "exists" in capsys.readouterr().err
    assert command(monkeypatch, "configs", "--copy", "quickstart") == 2
    wanted = "NAME and DIR, the folder to copy into: space-dist configs --copy quickstart mine"
    assert wanted in capsys.readouterr().err
    assert command(monkeypatch, "configs", "mine") == 2
    assert "space-dist configs --copy NAME mine" in capsys.readouterr().err


# ---- a project to start with -----------------------------------------------------------------------------------------


def test_a_new_project_runs_as_it_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = tmp_path / "mine"
    assert command(monkeypatch, "init", mine) == 0
    assert f"Next: cd {mine}" in capsys.readouterr().out
    assert load_profile(mine / "slurm.yaml").env == {"PYTHONPATH": str(mine)}  # jobs start elsewhere
    monkeypatch.chdir(mine)
    monkeypatch.delitem(sys.modules, "slider", raising=False)
    page = (mine / "README.md").read_text()
    told = re.findall(r"^space-dist (.+?)(?:  +#.*)?$", page, re.MULTILINE)
    assert len(told) == 8
    for line in told:
        words = line.split()
        if words[0] == "train":
            words += ["--set", "budget.steps=4096", "--set", "tracking.uri=null"]
        if words[:2] == ["grid", "run"]:
            text = (mine / "grid.yaml").read_text().replace("count: 3", "count: 1")
            (mine / "grid.yaml").write_text(f"{text}set: {{ budget.steps: 2048 }}\ntracking: {{ uri: null }}\n")
            words += ["--max-parallel", "1"]
        assert command(monkeypatch, *words) == 0, (line, capsys.readouterr().err)
    (snippet,) = re.findall(r"^In Python: `(.+?)`", page, re.MULTILINE)
    config = (mine / "slider.yaml").read_text()
    assert "steps: 40960" in config
    (mine / "slider.yaml").write_text(config.replace("steps: 40960", "steps: 4096") + "tracking: { uri: null }\n")
    exec(snippet, found := {})  # noqa: S102 - the page's own
    assert set(found["run"].final) == {"train", "test"}
    for file in ("runs/slider_space/s0/model.npz", "report/report.png", "runs/slider/report/report.html",
                 "slurm_scripts/submit.sh", "more_instances/uniform_train.csv"):  # fmt: skip
        assert (mine / file).exists(), file
    for file in re.findall(r"`([\w/]+\.\w+)`", page):
        assert (mine / file).exists(), file


def test_a_folder_that_holds_something_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full/mine.txt").write_text("mine")
    (tmp_path / "file").write_text("mine")
    for name, why in (("full", "is not empty"), ("file", "is a file")):
        assert command(monkeypatch, "init", tmp_path / name) == 2
        assert f"{tmp_path / name} {why}; a project" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["mine.txt"]


# ---- extras ----------------------------------------------------------------------------------------------------------


def without(library: str, folder: Path) -> Path:
    """A script that is the command, where `library` cannot be imported."""
    script = folder / "hidden.py"
    script.write_text(
        "import sys\n"
        "class Hider:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name.partition('.')[0] == {library!r}:\n"
        "            raise ModuleNotFoundError(f'No module named {name!r}', name=name)\n"
        "sys.meta_path.insert(0, Hider())\n"
        "from space_dist.cli import main\nmain()\n"
    )
    return script


@pytest.mark.parametrize(("words", "sentence"), [
    (("train", "shipped:pointmass_space", "--workers", "2", "--out", "run"),
     "resources.workers: 2 needs Ray: pip install 'space-dist[ray]', or use resources.workers=0"),
    (("grid", "run", "shipped:pointmass_small", "--mode", "pool", "--root", "x"),
     "a grid on a cluster, or whose runs have rollout actors, needs Ray: pip install 'space-dist[ray]'"),
    (("grid", "submit", "shipped:pointmass_small", "--address", "http://127.0.0.1:1"),
     "`grid submit` needs Ray: pip install 'space-dist[ray]'"),
])  # fmt: skip
def test_a_missing_ray_is_named_with_its_extra(words: tuple[str, ...], sentence: str, tmp_path: Path) -> None:
    """PyBullet's: tests/test_bullet.py."""
    hidden = without("ray", tmp_path)
    quiet = ("--set", "tracking.uri=null") if words[0] == "train" else ()
    told = said([sys.executable, hidden, *words, *quiet], tmp_path, 2)
    assert sentence in " ".join(told.split())


def test_a_missing_mlflow_is_named_with_its_extra(tmp_path: Path) -> None:
    start_run(tmp_path / "run")
    told = said([sys.executable, without("mlflow", tmp_path), "sync", "run", "--uri", "sqlite:///m.db"], tmp_path, 2)
    assert "needs MLflow: pip install 'space-dist[mlflow]', or use tracking.uri=null" in told
    assert not (tmp_path / "m.db").exists()


# ---- version, completion, doctor -------------------------------------------------------------------------------------


def test_the_version_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert command(monkeypatch, "--version") == 0
    assert capsys.readouterr().out == f"space-dist {space_dist.__version__}\n"
    assert f'version = "{space_dist.__version__}"' in (ROOT / "pyproject.toml").read_text()


def test_shells_complete_commands(tmp_path: Path) -> None:
    told = said(
        [sys.executable, "-P", "-c", "import sys; sys.argv[0] = 'space-dist'; from space_dist.cli import main; main()"],
        tmp_path, _SPACE_DIST_COMPLETE="complete_bash", COMP_WORDS="space-dist exp", COMP_CWORD="1",
    )  # fmt: skip
    assert told.split() == ["explain", "export-sb3"] or told.split() == ["export-sb3"]


def test_the_doctor_finds_nothing_broken_here(tmp_path: Path) -> None:
    told = said([sys.executable, "-P", "-m", "space_dist.cli", "doctor", "--quick"], tmp_path)
    assert told.splitlines()[-1] == "nothing is broken"
    for word in ("space_dist", "numpy", "core", "memory", "arithmetic", "Ray", "MLflow", "PyBullet", "SLURM"):
        assert word in told


def test_what_is_broken_has_a_mend_and_an_exit_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(health, "_checks", lambda quick: [lambda: iter([Finding("broken", "it is ill", "rest")])])
    assert command(monkeypatch, "doctor") == 1
    assert capsys.readouterr().out == "BROKEN it is ill\n       -> rest\n1 broken\n"


def test_what_hangs_and_what_crashes_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    assert health._failure("pass") is None
    assert health._failure("raise OSError('no such cable')") == "OSError: no such cable"
    assert health._failure("import os; os.abort()") == "exit code -6"
    monkeypatch.setitem(health._SECONDS, "import", 0.5)
    assert health._failure("import time; time.sleep(60)") == "no answer within 0 s"
    monkeypatch.setattr(health, "_version", lambda distribution: None)
    for check in (health.mlflow_works(ask=True), health.ray_works(start=True), health.bullet_works()):
        (found,) = check
        assert (found.state, "pip install 'space-dist[" in found.mend) == ("note", True)


@pytest.mark.parametrize(("uri", "state", "told"), [
    ("nonsense://x", "broken", "a tracking URI of the kind nonsense: cannot be mirrored to"),
    ("rel.db", "broken", "the tracking URI 'rel.db' has no beginning that says what it is; did you mean sqlite:///rel.db?"),
    ("http://127.0.0.1:9", "broken", "no MLflow answers at 127.0.0.1:9: Connection refused"),
    ("http://127.0.0.1:{port}/", "broken", "no MLflow answers at 127.0.0.1:"),
    ("sqlite:///{there}/mlflow.db", "ok", "a database in {there}"),
    ("sqlite:///{there}/absent/mlflow.db", "note", "the folder {there}/absent of its database is not there"),
])  # fmt: skip
def test_where_the_environment_mirrors_to_is_looked_at(
    uri: str, state: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), http.server.BaseHTTPRequestHandler) as no_mlflow:
        threading.Thread(target=no_mlflow.serve_forever, daemon=True).start()
        words = {"port": no_mlflow.server_port, "there": tmp_path}
        monkeypatch.setenv("MLFLOW_TRACKING_URI", uri.format(**words))
        found = list(health.mlflow_works(ask=True))[-1]
        no_mlflow.shutdown()
    assert found.state == state
    assert f"MLFLOW_TRACKING_URI: {told.format(**words)}" in found.what
    assert len(found.what) <= 300 + len(str(tmp_path))
    if "no MLflow answers" in told:  # a run keeps the URI that it was begun with, which no environment changes
        assert "`space-dist sync RUN --uri URI` elsewhere" in found.mend


def test_the_command_lists_what_it_has() -> None:
    names = {info.name or info.callback.__name__ for info in cli.app.registered_commands if info.callback}
    assert {"init", "configs", "doctor", "train", "export_sb3"} <= names
    assert isinstance(cli.app, typer.Typer)
    assert issubclass(ConfigError, space_dist.SpaceDistError)
    assert issubclass(LedgerError, space_dist.SpaceDistError)
