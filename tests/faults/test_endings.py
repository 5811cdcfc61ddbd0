"""Environments that end the process with 0, or double it, and outputs that nobody reads: what remains is true."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from space_dist import config as configs
from space_dist.errors import SpaceDistError
from space_dist.ledger import Ledger
from space_dist.report import load_run
from space_dist.report.load import state_in_words
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests
from tests import prepared
from tests.patience import PATIENCE
from tests.test_learners import config_for, learner_section, results

ROOT = Path(__file__).resolve().parent.parent.parent


def faulty(folder: Path, fault: str, **more: Any) -> configs.RunConfig:
    """A run whose environment has a fault after 700 steps, once; `more`: or when (`fault_env.make`)."""
    env = {"id": "tests.fault_env:make", "kwargs": {"fault": fault, "marker": str(folder / "marker"), **more}}
    section = learner_section("ppo", n_steps=32, net_arch=[4])
    return config_for(folder, section, env=env, budget={"steps": 960}, rollout={"shards": 2, "slots": 2})


def forked(folder: Path, *arguments: object) -> tuple[int | None, str]:
    """The exit code of `space-dist ARGUMENTS`, whose end as a process is not what is tested, and what it said."""
    said = folder / "said.txt"
    said.unlink(missing_ok=True)
    process = prepared.command(list(arguments), said)
    process.join(PATIENCE)
    return process.exitcode, said.read_text()


def resume(folder: Path, fault: str) -> tuple[int | None, str]:
    (folder / "config.yaml").write_text(configs.dump(faulty(folder, fault, where="step", after=0)))
    return forked(folder, "train", folder / "config.yaml", "--resume", "--out", folder / "run")


def train(
    folder: Path, fault: str, *, shell: str = "", where: str = "step", after: int = 0, **more: Any
) -> subprocess.CompletedProcess[str]:  # fmt: skip
    (folder / "config.yaml").write_text(configs.dump(faulty(folder, fault, where=where, after=after)))
    command = [sys.executable, "-m", "space_dist.cli", "train", str(folder / "config.yaml"), "--resume",
               "--out", str(folder / "run")]  # fmt: skip
    if shell:
        command = ["bash", "-c", f'set -o pipefail; "$@" {shell}', "bash", *command]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, **more)


@pytest.fixture(scope="module")
def unharmed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("unharmed")
    launch(faulty(folder, "none"), folder / "run", resume=True, stop=StopRequests())
    return results(folder / "run")


@pytest.mark.parametrize(("fault", "words"), [("exit", "SystemExit: 0"), ("_exit", "os._exit(0)")])
def test_an_exit_with_0_is_a_failure(
    fault: str, words: str, unharmed: dict[str, bytes], tmp_path: Path
) -> None:  # fmt: skip
    done = train(tmp_path, fault)
    assert done.returncode not in (0, 2, 75)
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    status = Ledger(tmp_path / "run").status()
    assert status.state == "failed"
    assert words in str(status.message)
    assert resume(tmp_path, fault)[0] == 0  # once is enough
    assert results(tmp_path / "run") == unharmed


@pytest.mark.parametrize(
    ("where", "after", "fault", "words"),
    [
        ("constructor", 0, "_exit", "os._exit(0)"),
        ("constructor", 3, "_exit", "os._exit(0)"),  # of the run itself, which has its folder by then
        ("reset", 0, "exit", "SystemExit: 0"),
    ],
)
def test_an_exit_with_0_in_a_constructor_or_a_reset_is_a_failure(
    where: str, after: int, fault: str, words: str, tmp_path: Path
) -> None:
    done = train(tmp_path, fault, where=where, after=after)
    assert (tmp_path / "marker").exists()
    assert done.returncode not in (0, 75), done.stderr
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    ledger = Ledger(tmp_path / "run")
    assert ledger.status_file.exists() == (after > 0)
    if after:
        status = ledger.status()
        assert (status.state, words in str(status.message)) == ("failed", True)


def test_an_exit_from_c_leaves_a_run_that_is_seen_to_be_abandoned(unharmed: dict[str, bytes], tmp_path: Path) -> None:
    assert train(tmp_path, "exit from C").returncode == 0  # nothing of Python's is asked
    ledger = Ledger(tmp_path / "run")
    assert ledger.abandoned(ledger.status())
    assert "left behind by a process that is gone" in state_in_words(load_run(ledger))
    said = forked(tmp_path, "evaluate", ledger.folder, "--json", "--instances", tmp_path / "test.csv")[1]
    assert '"state": "abandoned"' in said
    assert resume(tmp_path, "exit from C")[0] == 0
    assert results(tmp_path / "run") == unharmed


def test_an_environment_that_forks_leaves_one_run(unharmed: dict[str, bytes], tmp_path: Path) -> None:
    done = train(tmp_path, "fork")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "marker").exists()
    assert results(tmp_path / "run") == unharmed
    assert "forked by the environment" in done.stderr  # says the copy


def test_what_is_stood_in_for_is_put_back(tmp_path: Path) -> None:
    before, config = os._exit, faulty(tmp_path, "exit")
    with pytest.raises(SpaceDistError, match="tried to end the process"):
        launch(config, tmp_path / "run", resume=True, stop=StopRequests())
    assert os._exit is before


LINKED = ("log.txt", "lock.json")  # the others: tests/test_owner.py


@pytest.mark.parametrize("name", LINKED)
def test_a_run_folder_with_a_link_is_refused_in_a_sentence(name: str, tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("precious")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / name).symlink_to(tmp_path / "precious")
    code, said = resume(tmp_path, "none")
    assert code == 1
    assert f"{name} is a link" in said
    assert "Traceback" not in said
    assert (tmp_path / "precious").read_text() == "precious"


def test_what_the_mirror_says_is_not_written_through_a_link(tmp_path: Path) -> None:
    """A run is done whatever becomes of its mirror; the file that is linked stays as it was."""
    (tmp_path / "precious").write_text("precious")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "tracking.log").symlink_to(tmp_path / "precious")
    data = faulty(tmp_path, "none").model_dump(mode="json") | {"tracking": {"uri": f"sqlite:///{tmp_path}/mlflow.db"}}
    outcome = launch(configs.parse(data, "test"), tmp_path / "run", resume=True, stop=StopRequests())
    assert outcome.ledger.status().state == "done"
    assert "tracking.log is a link" in str(outcome.tracking_warning)
    assert (tmp_path / "precious").read_text() == "precious"
    assert not (tmp_path / "mlflow.db").exists()


@pytest.mark.parametrize("shell", [">/dev/full", "| head -0", ">&- 2>&-"])
def test_work_that_is_done_ends_with_0_whatever_became_of_its_output(shell: str, tmp_path: Path) -> None:
    done = train(tmp_path, "none", shell=shell)
    assert done.returncode == 0, done.stderr
    assert Ledger(tmp_path / "run").status().state == "done"
    assert done.stderr == ""


@pytest.mark.parametrize(("shell", "code"), [(">/dev/full", 1), ("| head -1", 0), (">/dev/null", 0)])
def test_a_command_that_is_for_its_output_says_that_it_is_lost(shell: str, code: int) -> None:
    command = f"set -o pipefail; {sys.executable} -m space_dist.cli config schema {shell}"
    done = subprocess.run(["bash", "-c", command], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == code
    assert done.stderr == ("space-dist: standard output cannot be written: No space left on device\n" if code else "")
