"""The SLURM scripts as text: quoting, and nothing that a value holds can do anything."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from space_dist import cli
from space_dist.errors import ConfigError
from space_dist.experiment.grid_file import load_grid
from space_dist.experiment.manifest import Grid, Manifest
from space_dist.experiment.tuning import load_tune
from space_dist.grid.planning import plan
from space_dist.slurm import Export, Mode, Profile, export, load_profile
from space_dist.slurm.export import AGGREGATE, SUBMIT, TRAIN, render
from space_dist.slurm.profile import seconds
from tests.commanding import command
from tests.patience import PATIENCE
from tests.slurm.profiles import exports

ROOT = Path(__file__).resolve().parent.parent
GRID, SITE = ROOT / "configs/grids/pointmass_small.yaml", ROOT / "configs/slurm/site.yaml"
EXAMPLES = ROOT / "slurm/examples"
MODES: tuple[Mode, ...] = ("array", "cluster")
STUBS = ("sbatch", "squeue", "sacct", "scancel", "scontrol", "srun", "module", "conda", "apptainer", "space-dist")


@pytest.fixture(scope="module")
def grid(tmp_path_factory: pytest.TempPathFactory) -> Grid:
    """Three cells x two seeds, frozen."""
    return plan(GRID, tmp_path_factory.mktemp("frozen")).grid


@pytest.fixture(scope="module")
def manifest(grid: Grid) -> Manifest:
    return grid.manifest()


def profile(**settings: Any) -> Profile:
    return Profile.model_validate(settings)


class Stubs:
    """A PATH on which every command of SLURM and ours only writes down how it was called."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.log = folder / "bin", folder / "calls"
        self.folder.mkdir(parents=True)
        for name in STUBS:
            (self.folder / name).symlink_to(ROOT / "tests/slurm/stub")
        self.environment = {
            "PATH": f"{self.folder}:/usr/bin:/bin", "STUB_LOG": str(self.log), "HOME": str(folder),
            "SLURM_JOB_ID": "17", "SLURM_ARRAY_JOB_ID": "7", "SLURM_ARRAY_TASK_ID": "0", "SLURM_CPUS_PER_TASK": "2",
            "SLURM_JOB_NUM_NODES": "2", "SLURM_JOB_NODELIST": "n[1-2]",
        }  # fmt: skip

    def start(self, script: Path, *arguments: str, **extra: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            ["bash", str(script), *arguments], cwd=script.parent,
            env={**self.environment, "SLURM_SUBMIT_DIR": str(script.parent), **extra},
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def run(self, script: Path, *arguments: str, **extra: str) -> tuple[int, str]:
        """Exit code, and all that was said."""
        process = self.start(script, *arguments, **extra)
        out, err = process.communicate(timeout=PATIENCE)
        return process.returncode, out + err

    def calls(self, name: str | None = None) -> list[list[str]]:
        """Every call since the last time this was asked: name and arguments."""
        parts = self.log.read_text().split("\0") if self.log.exists() else []
        self.log.unlink(missing_ok=True)
        found, index = [], 0
        while index < len(parts) - 1:
            count = int(parts[index])
            found.append(parts[index + 1 : index + 2 + count])
            index += 2 + count
        return [call for call in found if name in (None, call[0])]


@pytest.fixture
def stubs(tmp_path: Path) -> Stubs:
    return Stubs(tmp_path / "stubs")


def write(made: Export, folder: Path) -> Path:
    """The scripts, without the grid itself."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in render(made).items():
        (folder / name).write_text(text)
    (folder / "manifest.json").touch()
    (folder / "t").mkdir(exist_ok=True)
    return folder


def temp(folder: Path) -> str:
    """A short path to a folder of a test's own, for what would be in /tmp."""
    link = Path(f"/tmp/sp{os.getpid()}-{abs(hash(str(folder))) % 10**6}")  # noqa: S108 - sockets need short paths
    link.unlink(missing_ok=True)
    link.symlink_to(folder)
    return str(link)


@pytest.fixture
def short(tmp_path: Path) -> Iterator[str]:
    (tmp_path / "node").mkdir()
    link = temp(tmp_path / "node")
    yield link
    Path(link).unlink()


# ---- text -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_the_examples_are_what_export_writes(mode: Mode, manifest: Manifest) -> None:
    settings = ["cells_per_task=2", "throttle=2"] if mode == "array" else ["cpus_per_task=4"]
    texts = render(Export(manifest, load_profile(SITE, settings), mode))
    assert {name: (EXAMPLES / mode / name).read_text() for name in texts} == texts
    assert render(Export(manifest, load_profile(SITE, settings), mode)) == texts


def test_only_what_is_set_is_written(manifest: Manifest) -> None:
    bare = render(Export(manifest, profile(), "array"))[TRAIN]
    assert re.findall(r"^#SBATCH --([a-z-]+)", bare, re.MULTILINE) == [
        "job-name", "nodes", "ntasks-per-node", "cpus-per-task", "output", "open-mode", "requeue", "signal", "array",
    ]  # fmt: skip
    full = render(Export(manifest, _everything(), "array"))
    for name in ("partition", "account", "qos", "constraint", "nodelist", "exclude", "reservation", "time", "mem",
                 "gres", "gpus", "exclusive", "error", "mail-user", "mail-type", "dependency", "comment",
                 "licenses"):  # fmt: skip
        assert len(re.findall(rf"^#SBATCH --{name}\b(?!-)", full[TRAIN], re.MULTILINE)) == 1, name
    assert "#SBATCH --partition=late\n" in full[AGGREGATE]
    assert "--nodelist" not in full[AGGREGATE]
    assert "--array" not in full[AGGREGATE]


def _everything(**more: Any) -> Profile:
    return profile(**{
        "partition": "cpu", "account": "me", "qos": "high", "constraint": "avx", "nodelist": "n[1-3]", "exclude": "n9",
        "reservation": "r", "time": "1-00:00:00", "mem": "3G", "gres": "gpu:1", "gpus": 1, "exclusive": "user",
        "error": "logs/%A_%a.err", "mail_user": "me@x.org", "mail_type": ["END", "FAIL"], "dependency": "afterok:1",
        "comment": "a comment", "extra": ["--licenses=m:1"], "aggregate": {"partition": "late"}, "throttle": 2,
        "modules": ["python/3.11"], "conda": "env", "env": {"A": "b"}, "prologue": ["umask 027"], "interface": "ib0",
        "apptainer": "/x.sif", "apptainer_options": ["--bind", "/scratch"], **more,
    })  # fmt: skip


def test_the_commented_profile_names_every_field() -> None:
    text = SITE.read_text()
    assert [name for name in Profile.model_fields if not re.search(rf"^(# )?{name}:", text, re.MULTILINE)] == []


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["partitoin=x"], ["partitoin", "did you mean 'partition'?"]),
        (["time=soon"], ["time", "'soon'", "HH:MM:SS"]),
        (["time=1"], ["time (60 s)", "signal.lead_seconds (120 s)", "back into the queue as soon as it begins"]),
        (["mem=3 GB"], ["mem", "3 GB"]),
        (["mem=3G", "mem_per_cpu=1G"], ["mem and mem_per_cpu exclude each other"]),
        (["extra=[--partition=x]"], ["--partition has a field of its own: partition"]),
        (["extra=[--wrap=ls]"], ["--wrap", "cannot be set here"]),
        (["extra=[-p x]"], ["no long option of sbatch"]),
        (["extra=[-a0-9999]"], ["no long option of sbatch"]),
        (["extra=[--arra=0-9999]"], ["--arra, which may be short for --array, is what these scripts are made of"]),
        (["extra=[--a=0-9999]"], ["extra", "--a, which may be short for --array"]),
        (["extra=[--wra=id]"], ["--wra, which may be short for --wrap"]),
        (["extra=[--test]"], ["--test, which may be short for --test-only"]),
        (["extra=[--chdi=/]"], ["--chdi, which may be short for --chdir"]),
        (["extra=[--no-req]"], ["--no-req, which may be short for --no-requeue"]),
        (["extra=[--parti=x]"], ["--parti, which may be short for --partition, has a field of its own: partition"]),
        (["extra=[--mail-u=x]"], ["has a field of its own: mail_user"]),
        (["mail_type=[SOMETIMES]"], ["mail_type", "SOMETIMES"]),
        (["partition=-x"], ["partition", "must not begin with a hyphen"]),
        (["env={A-B: x}"], ["env", "no name of an environment variable"]),
        (["env={RAY_AUTH_TOKEN: x}"], ["RAY_AUTH_TOKEN", "set by SLURM or by these scripts"]),
        (["env={scratch: /home/me}"], ["env: scratch is set by SLURM or by these scripts"]),
        (
            ["env.OMP_NUM_THREADS=1"],
            [
                "--set env.OMP_NUM_THREADS=1: env: OMP_NUM_THREADS: 1 is no text; write it in quotes",
                ', OMP_NUM_THREADS: "1", ',
                "or --set 'env.OMP_NUM_THREADS=\"1\"'",
            ],
        ),
        (["env={A: true}"], ['env: A: true is no text; write it in quotes, A: "true"']),
        (["env={A: }"], ["env: A is empty"]),
        (["modules=null"], ["modules: is empty; give it a list, [] for none, or leave the key out"]),
        (["command=null"], ["command: is empty; give it a list, or leave the key out"]),
        (["env={UID: '0'}"], ["env: UID is bash's own"]),
        (["env={BASH_ENV: /x}"], ["BASH_ENV is bash's own"]),
        (["env={POSIXLY_CORRECT: '1'}"], ["POSIXLY_CORRECT is bash's own"]),
        (["env={PATH: /opt/bin}"], ["PATH", "prologue", "export PATH=/opt/bin:$PATH"]),
        (["temp=relative"], ["temp", "relative"]),
        (["venv=.venv"], ["venv", "must be a path from / on", "nothing in it is expanded"]),
        (["venv=~/.venv"], ["venv", "must be a path from / on"]),
        (["conda=~/envs/mine"], ["conda", "must not begin with ~"]),
        (["apptainer=~/space_dist.sif"], ["apptainer", "must not begin with ~"]),
        (["cpus=4"], ["cpus", "did you mean 'cpus_per_task'?"]),
        (["job_name=../../x"], ["job_name", "../../x"]),
        (["throttle=0"], ["throttle", "0"]),
        (["signal.name=TERM"], ["signal.name", "TERM"]),
    ],
)
def test_a_wrong_profile_is_refused_in_a_sentence(settings: list[str], said: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        load_profile(None, settings)
    for part in said:
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("time", "lead", "told"), [(3, 120, True), ("3:01", 120, False), ("5:00", 240, True), (None, 120, False)]
)
def test_a_time_limit_that_is_announced_at_once_is_told(
    time: str | int | None, lead: int, told: bool, manifest: Manifest
) -> None:
    said = Export(manifest, profile(time=time, signal={"lead_seconds": lead}), "array").time_remark()
    assert (said is not None) == told
    assert said is None or f"{lead} s before (signal.lead_seconds), or up to 60 s sooner" in said


def test_what_is_told_of_a_number_for_a_variable_is_taken() -> None:
    with pytest.raises(ConfigError) as caught:
        load_profile(None, ["env.OMP_NUM_THREADS=1"])
    (told,) = re.findall(r"or (--set .*)$", str(caught.value))
    assert load_profile(None, shlex.split(told)[1:]).env == {"OMP_NUM_THREADS": "1"}
    assert load_profile(None, ["modules=[]"]).modules == ()


def test_what_does_not_go_together_is_refused(manifest: Manifest) -> None:
    with pytest.raises(ConfigError, match=r"lead_seconds: 30 is too short for resources.grace_seconds"):
        Export(manifest, profile(signal={"lead_seconds": 30}), "array")
    with pytest.raises(ConfigError, match="in cluster mode all nodes work on all runs"):
        Export(manifest, profile(cells_per_task=2), "cluster")
    with pytest.raises(ConfigError, match="absolute path"):
        Export(manifest, profile(), "array", Path("runs"))
    wide = dataclasses.replace(manifest, resources=manifest.resources.model_copy(update={"workers": 3}))
    with pytest.raises(ConfigError, match=r"cpus_per_task: 2 are too few: each run of pointmass_small needs 4"):
        Export(wide, profile(cpus_per_task=2), "array")
    assert Export(wide, profile(cells_per_task=4, cpus_per_task=9), "array").parallel == 2


@pytest.mark.parametrize(
    ("text", "expected"),
    [("30", 1800), (90, 5400), ("1:30", 90), ("2:00:00", 7200), ("1-0", 86400), ("1-2:03", 93780),
     ("1-00:00:01", 86401), ("", None), ("1:2:3:4", None), ("x", None)],
)  # fmt: skip
def test_time_limits_are_read_as_slurm_does(text: str | int, expected: int | None) -> None:
    assert seconds(text) == expected


def test_templates_can_be_replaced_and_their_faults_are_named(manifest: Manifest, tmp_path: Path) -> None:
    made = Export(manifest, profile(comment="it's"), "array")
    (tmp_path / "finish.sh.j2").write_text('echo {{ temp ~ "\'" }}\nexit 0\n')
    text = render(made, tmp_path)[TRAIN]
    assert text.endswith("""echo '/tmp'"'"''\nexit 0\n""")  # quoted without being asked to
    assert 'exit "$code"' not in text
    (tmp_path / "finish.sh.j2").write_text("\n{% if %}")
    with pytest.raises(ConfigError, match=r"finish\.sh\.j2, line 2"):
        render(made, tmp_path)
    (tmp_path / "finish.sh.j2").write_text("{{ no_such_value }}")
    with pytest.raises(ConfigError, match="no_such_value"):
        render(made, tmp_path)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ('{% include "finish.sh.j2" %}', r"finish\.sh\.j2, line 1: it includes itself"),
        ('{% include "a.sh.j2" %}', r"[ab]\.sh\.j2, line 1: it includes itself"),
        ("\n{{ 1 / 0 }}", r"finish\.sh\.j2, line 2: ZeroDivisionError: division by zero"),
        ("{{ temp + 1 }}", r"finish\.sh\.j2, line 1: TypeError"),
        ("{{ 'x' * 10 ** 20 }}", r"finish\.sh\.j2, line 1"),
        ("{{ lines() }}", "'lines' is undefined"),
        ("{% for n in range(10 ** 9) %}{{ n }}{% endfor %}", r"finish\.sh\.j2, line 1: OverflowError"),
        ("{{ temp.__class__.__mro__ }}", r"finish\.sh\.j2, line 1: access to attribute '__class__'"),
        ('{% include "nowhere.j2" %}', r"template nowhere\.j2 is missing"),
    ],
)
def test_a_templates_fault_is_a_sentence(content: str, said: str, manifest: Manifest, tmp_path: Path) -> None:
    (tmp_path / "finish.sh.j2").write_text(content)
    (tmp_path / "a.sh.j2").write_text('{% include "b.sh.j2" %}')
    (tmp_path / "b.sh.j2").write_text('{% include "a.sh.j2" %}')
    with pytest.raises(ConfigError, match=said):
        render(Export(manifest, profile(), "array"), tmp_path)


def test_a_file_that_replaces_no_template_is_refused(manifest: Manifest, tmp_path: Path) -> None:
    made = Export(manifest, profile(), "array")
    with pytest.raises(ConfigError, match=r"holds no file\. Ours, which may be replaced: README\.md\.j2, advance\."):
        render(made, tmp_path)
    (tmp_path := tmp_path / "mine").mkdir()
    (tmp_path / ".hidden").touch()
    (tmp_path / "finish.sh.j2").write_text('{% include "mine.txt" %}\n')
    (tmp_path / "mine.txt").write_text("exit 0\n")
    assert render(made, tmp_path)[TRAIN].endswith("exit 0\n")
    (tmp_path / "sumbit.sh").touch()
    said = r"sumbit\.sh replaces none of ours, .*; did you mean 'submit\.sh\.j2'\? Allowed: README\.md\.j2, .*cluster"
    with pytest.raises(ConfigError, match=said):
        render(made, tmp_path)


def test_the_page_names_every_template_and_default() -> None:
    page = (ROOT / "docs/slurm.md").read_text()
    templates = [file.name for file in (ROOT / "space_dist/slurm/templates").iterdir()]
    bare = Profile()
    signal = f"`signal` is\n{bare.signal.name}, {bare.signal.lead_seconds} s before"
    defaults = [f"`nodes` is {bare.nodes} in", f"`output` is `{bare.output}`", signal]
    assert [word for word in (*(f"`{name}`" for name in templates), *defaults) if word not in page] == []
    assert f"# nodes: 2 # cluster mode only; default: {bare.nodes}\n" in SITE.read_text()


def test_a_template_that_is_no_text_is_a_sentence(manifest: Manifest, tmp_path: Path) -> None:
    (tmp_path / "finish.sh.j2").write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match=r"finish\.sh\.j2 cannot be read"):
        render(Export(manifest, profile(), "array"), tmp_path)


def test_no_variable_of_the_scripts_is_a_profiles_to_set(manifest: Manifest, tmp_path: Path) -> None:
    """What bash itself says that a script assigns, by its own reading of it."""
    for mode in MODES:
        for name, text in render(Export(manifest, profile(), mode)).items():
            if name == "README.md":
                continue
            words = re.sub(r"^ *#.*$", "", text, flags=re.MULTILINE).split()
            assigned = {found[1] for word in words if (found := re.match(r"['(]?([A-Za-z_]\w*)\+?=", word))}
            assert len(assigned) > 3, name
            for variable in {*assigned, "nodes" if mode == "cluster" else "task"}:
                with pytest.raises(ValueError, match=rf"{variable} is"):
                    profile(env={variable: "x"})
    (tmp_path / "finish.sh.j2").write_text("mine=1\n")
    with pytest.raises(ConfigError, match=r"env: mine is a variable of the template .*finish\.sh\.j2"):
        render(Export(manifest, profile(env={"mine": "x"}), "array"), tmp_path)
    render(Export(manifest, profile(env={"mine": "x"}), "array"))


def test_no_variable_of_bash_is_a_profiles_to_set() -> None:
    """All that bash has in an empty environment, but for what programs read."""
    told = subprocess.run(["bash", "--norc", "-c", "compgen -v"], env={}, capture_output=True, text=True, check=True)
    variables = {*told.stdout.split()} - {"TERM", "SHELL"}
    assert {"UID", "IFS", "PPID", "SHELLOPTS"} <= variables
    for variable in variables:
        with pytest.raises(ValueError, match=rf"{variable}"):
            profile(env={variable: "x"})
    assert profile(env={"LD_LIBRARY_PATH": "/a", "PYTHONPATH": "/b", "RAY_worker_niceness": "0"}).env


def test_options_that_only_look_like_others_are_taken() -> None:
    lines = (
        "--wait-all-nodes=1",
        "--ntasks-per-core=1",
        "--time-min=5",
        "--mem-bind=local",
        "--gpus-per-node=1",
        "--hint=x",
    )
    assert profile(extra=lines).extra == lines


def test_export_freezes_the_grid_and_refuses_to_mix_two(grid: Grid, manifest: Manifest, tmp_path: Path) -> None:
    files = grid.instance_files(manifest)
    export(Export(manifest, profile(), "array"), files, tmp_path / "out")
    assert Grid(tmp_path / "out").manifest() == manifest
    assert os.access(tmp_path / "out" / SUBMIT, os.X_OK)
    before = (tmp_path / "out" / TRAIN).read_text()
    export(Export(manifest, profile(comment="again"), "array"), files, tmp_path / "out")
    assert (tmp_path / "out" / TRAIN).read_text() != before
    other = dataclasses.replace(manifest, seeds=(5,))
    with pytest.raises(ConfigError, match="holds another grid"):
        export(Export(other, profile(), "array"), files, tmp_path / "out")


def test_the_command_line(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))

    def run(*arguments: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["space-dist", *map(str, arguments)])
        try:
            cli.main()
            code = 0
        except SystemExit as error:
            code = int(error.code or 0)
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        return code, said.out + said.err

    stand_ins = Stubs(tmp_path / "stubs")
    monkeypatch.setenv("PATH", f"{stand_ins.folder}:{os.environ['PATH']}")
    monkeypatch.setenv("STUB_LOG", str(stand_ins.log))
    out = tmp_path / "out"
    code, said = run("slurm", "export", GRID, "--out", out, "--profile", SITE, "--throttle", 2, "--cells-per-task", 4,
                     "--set", "partition=long", "--check")  # fmt: skip
    assert code == 0, said
    assert "6 runs in 2 array tasks" in said
    assert f"mlflow.db is a file outside of {out}" in " ".join(said.split())
    assert "MLFLOW_TRACKING_URI" in said
    assert "sbatch --test-only: no objection" in said
    text = (out / TRAIN).read_text()
    assert "#SBATCH --array=0-1%2\n" in text
    assert "#SBATCH --partition=long\n" in text
    assert [call[1:] for call in stand_ins.calls("sbatch")] == [["--test-only", TRAIN], ["--test-only", AGGREGATE]]
    assert run("slurm", "submit", out)[0] == 0
    code, said = run("grid", "status", out)
    assert code == 3
    assert "SLURM jobs: train 103; aggregate 104; none in the queue now" in said
    assert f"what the jobs said is in {out / 'logs'}" in " ".join(said.split())
    assert run("slurm", "submit", tmp_path)[0] == 2
    code, said = run("slurm", "submit", GRID)
    assert (code, f"{GRID} is a file: name the folder DIR of" in " ".join(said.split())) == (2, True)
    code, said = run("slurm", "export", GRID, "--out", GRID)
    assert (code, f"--out {GRID} is a file; a folder" in " ".join(said.split())) == (2, True)
    for option, value, key in (("--throttle", -1, "throttle"), ("--cells-per-task", 0, "cells_per_task")):
        code, said = run("slurm", "export", GRID, "--out", tmp_path / "none", option, value)
        assert (code, f"space-dist: {option} {value}: {key}: must be a whole number from 1 to " in said) == (2, True)
    code, said = run("slurm", "export", GRID, "--out", tmp_path / "none", "--set", "partition=long", "--set", "nodes=3")
    assert (code, "--set nodes=3: nodes is for --mode cluster" in " ".join(said.split())) == (2, True)
    assert not (tmp_path / "none").exists()
    for mode, nodes, words in (("array", 1, "6 runs in 6 array tasks"), ("cluster", 3, "6 runs in one job of 3 nodes")):
        code, said = run("slurm", "export", GRID, "--out", tmp_path / mode, "--mode", mode, "--set", f"nodes={nodes}")
        assert (code, words in said) == (0, True)
    (tmp_path / "site.yaml").write_text("nodes: 4\n")  # for either mode
    code, said = run("slurm", "export", GRID, "--out", tmp_path / "array", "--profile", tmp_path / "site.yaml")
    assert (code, "warning: nodes: 4 is for --mode cluster; in array mode" in " ".join(said.split())) == (0, True)
    assert run("slurm", "export", out, "--out", tmp_path / "copy")[0] == 0
    code, said = run("slurm", "export", out, "--out", tmp_path / "copy", "--mode", "arry")
    assert (code, "did you mean 'array'?" in said) == (2, True)
    code, said = run("grid", "run", out, "--part", "0-0", "--runs", "0123456789abcdef")
    assert (code, "export the grid again" in said) == (2, True)


@pytest.mark.parametrize("name", ["mine", 'my "own" it\'s {x}: #1'])
def test_a_module_that_no_job_would_find_is_told(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = tmp_path / name
    monkeypatch.chdir(tmp_path)
    assert command(monkeypatch, "init", name) == 0
    if name != "mine":  # a folder of this name cannot be one of PYTHONPATH
        assert "\n# env: { PYTHONPATH" in (mine / "slurm.yaml").read_text()
        mine = mine.rename(tmp_path / name.replace(":", ""))
        shutil.rmtree(mine)
        assert command(monkeypatch, "init", mine) == 0
    monkeypatch.chdir(mine)
    monkeypatch.delitem(sys.modules, "slider", raising=False)
    assert load_profile(Path("slurm.yaml")).env == {"PYTHONPATH": str(mine)}

    def told(*words: object, grid: Path = mine / "grid.yaml") -> str:
        capsys.readouterr()
        assert command(monkeypatch, "slurm", "export", grid, "--out", tmp_path / "out", *words) == 0
        return " ".join(capsys.readouterr().err.split())

    without = told()
    assert f"warning: the grid imports 'slider', which is found in {mine} alone, where no job looks" in without
    (line,) = re.findall(r"into the profile, (env: .+}), and export again; or install it", without)
    (tmp_path / "site.yaml").write_text(f"{line}\n")
    assert load_profile(tmp_path / "site.yaml").env == {"PYTHONPATH": str(mine)}
    readme, advice = tmp_path / "out/README.md", "`env: {PYTHONPATH: /FOLDER}`.\n\n```bash"
    assert "Not in this folder is code of your own that runs import: slider. The nodes must" in readme.read_text()
    assert advice in readme.read_text()
    for words in (
        ("--profile", tmp_path / "site.yaml"), ("--profile", mine / "slurm.yaml"),
        ("--set", "prologue=[export PYTHONPATH=/mine]"),
    ):  # fmt: skip
        assert "imports" not in told(*words)
        assert (
            "slider. All nodes must see\nthe folder of it that the profile's PYTHONPATH names.\n\n```bash"
            in readme.read_text()
        )
    said = told("--set", f"env.PYTHONPATH={tmp_path}")  # where it is not
    assert f"{json.dumps(f'{tmp_path}:{mine}', ensure_ascii=False)}}}, and export" in said
    said = told("--set", "env.PYTHONPATH=/of/the/cluster")
    assert "env.PYTHONPATH names /of/the/cluster, which is not here: whether" in said
    monkeypatch.chdir(tmp_path)
    assert "'slider', which is not found here. Write" in told(grid=tmp_path / "out")
    monkeypatch.setenv("PYTHONPATH", str(mine))  # which sbatch hands on
    assert "imports" not in told(grid=tmp_path / "out")


# ---- nothing a value holds can do anything --------------------------------------------------------------------------

_ACTS = (
    '"; >$C; "', "'; >$C; '", "$(>$C)", "`>$C`", "; >$C #", "| >$C", "&& >$C", "& >$C &", '\\"; >$C; #', "\\'; >$C; '",
    '"$(>$C)"', "'\"'\"'; >$C; '", "$((a[$(>$C)]))", ">$C", "<(>$C)", "\\\n>$C\n", "x\r\n>$C", "${x:-$(>$C)}",
    "{{ 7*7 }}; >$C", "{% raw %}$(>$C)", ") ; >$C ; (", "!! # \\", "~/*; >$C",
)  # fmt: skip
_BEFORE = ("", "x", " ", "'", '"', "\\", "$", "`", "-", "%")
HOSTILE = [before + act for before in _BEFORE for act in _ACTS]


def test_the_hostile_values_are_hostile(tmp_path: Path) -> None:
    """Unquoted, or in quotes of the template's, many of them act: the tests below can fail."""
    acted = 0
    for index, value in enumerate(HOSTILE):
        canary = tmp_path / str(index)
        for form in (f"echo {value}", f'echo "{value}"', f"echo '{value}'"):
            subprocess.run(
                ["bash", "-c", form], env={"C": str(canary), "PATH": "/bin"}, capture_output=True, cwd=tmp_path
            )
        acted += canary.exists()
    assert len(HOSTILE) >= 200
    assert acted > 120


def _sbatch_reads(line: str) -> str:
    """What sbatch's own parser takes for the one argument of an `#SBATCH` line (src/sbatch/opt.c, _get_argument)."""
    text, quote, escaped, said = line.removeprefix("#SBATCH "), "", False, ""
    for character in text:
        if escaped:
            escaped = False
        elif character == "\\":
            escaped = True
            continue
        elif quote and character == quote:
            quote = ""
            continue
        elif not quote and character in "\"'":
            quote = character
            continue
        elif not quote and (character.isspace() or character == "#"):
            raise AssertionError(f"{line!r} goes on after its argument")
        said += character
    assert not quote
    assert not escaped
    return said


def _hostile_profile(value: str) -> tuple[dict[str, Any], list[str]]:
    """A profile with `value` in every field that holds text, where the schema lets it be; and the fields that do."""
    one = {"conda": value, "apptainer": value, "output": value, "error": value, "comment": value, "mail_user": value,
           "partition": value, "account": value, "qos": value, "constraint": value, "nodelist": value,
           "exclude": value, "reservation": value, "gres": value, "gpus": value, "dependency": value,
           "time": value, "mem": value, "mem_per_cpu": value, "job_name": value, "interface": value,
           "temp": f"/{value}", "venv": f"/{value}", "exclusive": value}  # fmt: skip
    wrapped: dict[str, Any] = {
        "modules": [value], "apptainer_options": [value], "extra": [f"--licenses={value}"], "env": {"HOSTILE": value},
        "command": ["space-dist", value], "mail_type": [value], "signal": {"name": value},
        "aggregate": {"partition": value, "qos": value, "mem": "1G"},
    }  # fmt: skip
    taken: dict[str, Any] = {}
    for name, setting in {**one, **wrapped}.items():
        try:
            Profile.model_validate({name: setting} | ({"apptainer": "x"} if name == "apptainer_options" else {}))
        except ValueError:
            continue
        taken[name] = setting
    return taken, [*one, *wrapped]


def test_the_hostile_profile_has_every_field_that_holds_text() -> None:
    numbers = {"nodes", "cpus_per_task", "throttle", "cells_per_task", "max_array_size", "max_requeues"}
    assert {*_hostile_profile("x")[1]} | numbers | {"prologue"} == {*Profile.model_fields}  # a prologue is shell


def test_hostile_values_do_nothing(manifest: Manifest, tmp_path: Path) -> None:
    def attempt(index: int) -> list[str]:
        value, folder = HOSTILE[index], tmp_path / str(index)
        settings, _ = _hostile_profile(value)
        for name in ("time", "mem", "mem_per_cpu", "job_name", "interface", "mail_type", "signal", "exclusive"):
            assert name not in settings, (name, value)  # these hold no free text at all
        venv = settings.pop("venv", None)
        if "apptainer" not in settings:
            settings.pop("apptainer_options", None)
        short_enough = "temp" in settings
        if short_enough:
            settings["temp"] = str(folder / "t")[-40:] if len(str(folder / "t")) <= 40 else "/tmp"  # noqa: S108
        made = Export(manifest, profile(**settings), "array", tmp_path / "root" / value.replace("/", "_").strip()
                      if value.isprintable() else None)  # fmt: skip
        write(made, folder / "x")
        canary, stand_ins = folder / "canary", Stubs(folder / "stubs")
        (stand_ins.folder / "sleep").symlink_to("/bin/true")  # for there are many
        for script in (TRAIN, AGGREGATE, SUBMIT) if index % 4 == 0 else (TRAIN,):
            _, said = stand_ins.run(folder / "x" / script, C=str(canary), SLURM_JOB_ID=f"17{os.getpid()}{index}")
            assert "syntax error" not in said, (value, script)
            for line in (folder / "x" / script).read_text().splitlines():
                if line.startswith("#SBATCH"):
                    _sbatch_reads(line)
        calls = stand_ins.calls()
        if "command" in settings and "apptainer" in settings and "env" in settings:
            [train] = [call for call in calls if call[0] == "apptainer" and "--part" in call]
            assert train[:5] == ["apptainer", "exec", *settings.get("apptainer_options", []), value, "space-dist"][:5]
            assert value in train
            text = (folder / "x" / TRAIN).read_text()
            directives = {_sbatch_reads(line) for line in text.splitlines() if line.startswith("#SBATCH")}
            assert {f"--comment={value}", f"--partition={value}", f"--licenses={value}"} <= directives
        if venv is not None and index % 5 == 0:
            write(Export(manifest, profile(venv=venv), "array"), folder / "v")
            code, said = stand_ins.run(folder / "v" / TRAIN, C=str(canary), SLURM_JOB_ID=f"18{os.getpid()}{index}")
            assert code == 1, said
            assert "cannot activate" in said
        assert not canary.exists(), value
        return [*settings]

    with ThreadPoolExecutor(2) as pool:
        taken = list(pool.map(attempt, range(len(HOSTILE))))
    # printable values that do not begin with a hyphen are taken, and quoted; the others never get anywhere
    assert sum("comment" in names for names in taken) > 150
    shutil.rmtree(tmp_path)


def test_a_profile_line_is_one_line() -> None:
    for name in ("prologue", "extra", "command", "apptainer_options", "modules"):
        for value in ("a\nb", "a\rb", "\x1b[2J", "a\0b", "a\u2028b"):
            with pytest.raises(ValueError, match="one line of printable characters"):
                profile(**{name: [value], **({"apptainer": "x"} if name == "apptainer_options" else {})})


def test_commands_of_the_readme_do_nothing_else_when_pasted(manifest: Manifest, tmp_path: Path) -> None:
    canary, stand_ins = tmp_path / "canary", Stubs(tmp_path / "stubs")
    for index, value in enumerate(one for one in HOSTILE[::3] if one.isprintable()):
        root = Path("/nowhere") / value.replace("/", "_")
        made = Export(manifest, profile(output=f"x{value}/%x.out"), MODES[index % 2], root)
        folder = write(made, tmp_path / str(index))
        blocks = re.findall(r"^```bash\n(.*?)^```", (folder / "README.md").read_text(), re.DOTALL | re.MULTILINE)
        assert len(blocks) == 3
        pasted = folder / "pasted"
        pasted.write_text("".join(blocks).replace("./submit.sh", ":"))
        _, said = stand_ins.run(pasted, C=str(canary))
        assert "syntax error" not in said, value
        assert not canary.exists(), value
        asked = [call[1:] for call in stand_ins.calls("space-dist")]
        results = str(root / manifest.name)
        assert asked == [
            ["grid", "status", results], ["sync", results, "--uri", "URI"], ["grid", "stop", results],
            ["grid", "retry", results, "--cause", "CAUSE"],
        ]  # fmt: skip


@pytest.mark.parametrize(
    ("words", "objects"),
    [("sbatch: fatal: Could not establish a configuration source", False), ("sbatch: error: Bad constraints", True)],
)
def test_a_check_tells_an_objection_from_an_sbatch_without_a_cluster(
    words: str, objects: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sbatch, out = tmp_path / "bin/sbatch", tmp_path / "out"
    sbatch.parent.mkdir()
    sbatch.write_text(f"#!/bin/sh\necho '{words}' >&2\nexit 1\n")
    sbatch.chmod(0o755)
    monkeypatch.setenv("PATH", f"{sbatch.parent}:{os.environ['PATH']}")
    words_typed = ["slurm", "export", GRID, "--out", out, "--profile", SITE, "--check"]
    monkeypatch.setattr(sys, "argv", ["space-dist", *map(str, words_typed)])
    monkeypatch.setattr(sys, "path", list(sys.path))
    code = 0
    try:
        cli.main()
    except SystemExit as error:
        code = int(error.code or 0)
    told = " ".join(capsys.readouterr().err.split())
    assert (out / TRAIN).exists()
    assert code == int(objects)
    assert (f"not checked by sbatch, which finds no cluster here: {words}" in told) != objects
    assert ("sbatch objects to" in told) == objects


def test_a_check_says_what_of_the_environment_is_not_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    programs, venv = tmp_path / "bin", tmp_path / "venv"
    for folder in (programs, venv / "bin"):
        folder.mkdir(parents=True)
    for name in ("sbatch", "shellcheck"):
        (programs / name).symlink_to("/bin/true")
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")

    def told(*words: str) -> str:
        capsys.readouterr()
        settings = [word for setting in words for word in ("--set", setting)]
        assert command(monkeypatch, "slurm", "export", GRID, "--out", tmp_path / "out", "--check", *settings) == 0
        return " ".join(capsys.readouterr().err.split())

    asked = ("modules=[gcc, python/3.11]", f"venv={venv}")
    said = told(*asked)
    assert re.search(r"modules: `module load` of gcc, python/3\.11 fails here, .*module.*not found", said)
    assert f"venv: {venv} has no bin/activate here" in said
    assert "module load" not in told(*asked, "prologue=[source /etc/profile.d/modules.sh]")
    (programs / "module").write_text('#!/bin/sh\n[ "$*" = "load gcc" ] || [ "$*" = "load python/3.11" ]\n')
    (programs / "module").chmod(0o755)
    (venv / "bin/activate").touch()
    said = told(*asked)
    assert ("modules:" in said, f"venv: {venv} has no bin/space-dist here" in said) == (False, True)
    (venv / "bin/space-dist").touch()
    assert "venv:" not in told(*asked)
    assert "modules:" in told("modules=[gcc, python/3.12]")


@pytest.mark.skipif(shutil.which("shellcheck") is None, reason="shellcheck is not installed")
def test_bash_and_shellcheck_object_to_no_script(manifest: Manifest, tmp_path: Path) -> None:
    files = []
    for number, made in enumerate(exports(manifest, 24)):
        folder = write(made, tmp_path / str(number))
        files += [folder / name for name in (TRAIN, AGGREGATE, SUBMIT)]
    for example in EXAMPLES.glob("*/*.s*"):
        files.append(example)
    for file in files:
        subprocess.run(["bash", "-n", file], check=True)
    found = subprocess.run(["shellcheck", *files], capture_output=True, text=True)
    assert found.stdout + found.stderr == ""
    found = subprocess.run(["shellcheck", *(ROOT / "tests/slurm").glob("*.sh")], capture_output=True, text=True)
    assert found.stdout + found.stderr == ""


def test_what_a_profile_leaves_empty_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "site.yaml").write_text("partition: cpu\ntime:\ngres:\njob_name:\n")
    words = ["slurm", "export", GRID, "--out", tmp_path / "out", "--profile", tmp_path / "site.yaml"]
    assert command(monkeypatch, *words, "--set", "partition=") == 0
    told = " ".join(capsys.readouterr().err.split())
    assert "warning: partition, time, gres: empty, so jobs get what the cluster gives by default" in told
    assert "#SBATCH --time" not in (tmp_path / "out" / TRAIN).read_text()
    with pytest.raises(ConfigError, match="partition: write several as one text, cpu,long, not"):
        load_profile(None, ["partition=[cpu, long]"])


def test_grids_searches_runs_and_profiles_are_told_apart() -> None:
    for path, kind in ((GRID, "a grid"), (ROOT / "configs/tune/pointmass.yaml", "a search"),
                       (ROOT / "configs/pointmass_space.yaml", "the config of one run")):  # fmt: skip
        with pytest.raises(ConfigError) as caught:
            load_profile(path)
        assert str(caught.value).startswith(f"{path} is {kind}: space-dist ")
        assert str(caught.value).endswith(". A SLURM profile has keys like partition, account and time")
    for reading in (load_grid, load_tune):
        with pytest.raises(ConfigError) as caught:
            reading(SITE)
        told = f"{SITE} is a SLURM profile: space-dist slurm export GRID --out DIR --profile {SITE}"
        assert str(caught.value) == told


def test_where_sbatch_takes_nothing_that_is_said(grid: Grid, manifest: Manifest, tmp_path: Path) -> None:
    out = tmp_path / "out"
    export(Export(manifest, Profile(), "array"), grid.instance_files(manifest), out)
    stand_in = tmp_path / "bin" / "sbatch"
    stand_in.parent.mkdir()
    stand_in.write_text("#!/bin/sh\necho 'sbatch: fatal: Could not establish a configuration source' >&2\nexit 1\n")
    stand_in.chmod(0o755)
    environment = {**os.environ, "PATH": f"{stand_in.parent}:{os.environ['PATH']}"}
    done = subprocess.run([out / SUBMIT], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.splitlines()[1:] == [
        "submit.sh: nothing was submitted; ./submit.sh tries again, once what is said above is mended"
    ]
