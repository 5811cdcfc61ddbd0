"""Every block of the pages that one types is executed, as it is written, by bash.

Here those that need neither a cluster nor a server; the others in tests/test_site_cluster.py (Ray, MLflow),
tests/test_site_benchmarks.py, tests/test_quickstart.py (make) and tests/test_slurm_cluster.py, and those of pages that
are an example from their first block to the last, in tests of their own (`ELSEWHERE` of tests/test_site.py).

In small (tests/shell.py): budgets, grids and sets. Replaced is what stands for something of the reader's own, always
in sight of the test. Not done is what `NOT_DONE` names, with its reason.
"""

from __future__ import annotations

import importlib
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from space_dist.cli import health
from space_dist.ledger import Ledger
from tests.own_code import blocks as code_blocks
from tests.shell import Block, Shell, bash_blocks, executes, one_server
from tests.test_site import ELSEWHERE, PAGES

MODULES = ("test_site_commands", "test_site_cluster", "test_site_benchmarks", "test_quickstart", "test_slurm_cluster")
NOT_DONE = {
    "pip install": "it would fetch gigabytes: tests/test_installing.py installs the wheel into an environment that has "
    "the rest, .ci/run begins with `make setup`",
    "source .venv/bin/activate": "the tests have their environment already",
}
WITHOUT = 'pip() { echo "not done: pip $*"; }\n'


@pytest.fixture(scope="module")
def _supervised() -> Iterator[None]:
    with one_server():
        yield


@pytest.fixture
def shell(
    _supervised: None, empty_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> Iterator[Shell]:  # fmt: skip
    """A clone in small whose grids are all worked through by one process, and whose MLflow is a file that is there."""
    shutil.copy(empty_store, tmp_path / "mlflow.db")
    found = Shell(tmp_path, monkeypatch)
    yield found
    assert set(found.done) == set(request.function.executes)


# ---- none is left out ------------------------------------------------------------------------------------------------


def test_every_block_is_executed_by_a_test() -> None:
    there = {(page.name, number) for page in PAGES for number in range(len(bash_blocks(page.name)))
             if page.name not in ELSEWHERE}  # fmt: skip
    claimed: list[Block] = []
    for name in MODULES:
        module = importlib.import_module(f"tests.{name}")
        claimed += [block for test, function in vars(module).items() if test.startswith("test_")
                    for block in vars(function).get("executes", ())]  # fmt: skip
    assert set(claimed) == there
    assert len(claimed) == len(there)
    assert len(there) > 30


def test_what_is_not_done_is_on_a_page() -> None:
    text = "".join(block for page in PAGES for block in bash_blocks(page.name))
    assert all(command in text for command in NOT_DONE)


def test_a_block_that_fails_is_found(shell: Shell) -> None:
    for script in (
        "space-dist trian x",
        "space-dist configs && false",
        "python jobs/nothing.py",
        "space-dist env check x",
    ):
        with pytest.raises(AssertionError):
            shell.run(script)
    shell.run("for name in a b; do space-dist configs --copy quickstart $name; done; [ -d b/grids ]")
    assert [words[-1] for words in shell.typed[-2:]] == ["a", "b"]
    with pytest.raises(AssertionError, match="no 'HOST' in"):
        shell.run("space-dist configs", {"HOST": "here"})


test_a_block_that_fails_is_found.executes = ()  # type: ignore[attr-defined]


# ---- pages -----------------------------------------------------------------------------------------------------------


@executes(("training.md", 0), ("training.md", 2))
def test_training(shell: Shell) -> None:
    """All in one folder, as one would go through the page."""
    _, _, instances, _ = bash_blocks("training.md")
    shell.block("training.md", 0, {"source .venv/bin/activate": ":"})
    shell.block("training.md", 2)
    assert (shell.folder / "policy.zip").is_file()
    assert (shell.folder / "report/report.png").is_file()
    assert [Ledger(shell.folder / f"runs/pointmass_space/s{seed}").status().state for seed in (0, 1)] == ["done"] * 2
    assert "my_instances" in instances


@executes(("training.md", 3), ("environments.md", 4), ("environments.md", 5))
def test_ones_own_environment(shell: Shell) -> None:
    """The package that the page calls my_package has the environment of docs/your_environment.md."""
    package = shell.folder / "my_package"
    package.mkdir()
    (package / "my_module.py").write_text(code_blocks("your_environment.md", "python")[0] + "\n\nmake = Lander\n")
    shell.run("space-dist train configs/pointmass_space.yaml --out runs/my_run/s0")  # which can be drawn
    shell.block("training.md", 3)
    assert len(list((shell.folder / "pictures").glob("*.gif"))) == 3
    shell.block("environments.md", 4, {"--out sets": "--out carl_sets"})
    shell.block("environments.md", 5, prelude=WITHOUT)


@executes(("installing.md", 0), ("installing.md", 1))
def test_installing(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    """`doctor` starts a Ray; what it imports to see whether that works is imported here anyway."""
    failure = health._failure
    monkeypatch.setattr(
        health, "_failure", lambda code, kind="import": failure(code, kind) if kind == "ray" else None
    )  # fmt: skip
    shell.block("installing.md", 0, prelude=WITHOUT)
    shell.block("installing.md", 1)
    assert (shell.folder / "my_project/README.md").is_file()
    assert (shell.folder / "my_configs/grids/quickstart.yaml").is_file()


@executes(*(("environments.md", number) for number in (0, 1, 2, 3, 6)))
def test_environments(shell: Shell) -> None:
    shell.block("environments.md", 0)
    shell.block("environments.md", 1, {"for seed in 0 1 2": "for seed in 0"})
    printed = re.findall(r"^runs/(\w+)/s0 512 (\S+) (\S+) ", shell.said.read_text(), re.MULTILINE)
    assert [name for name, *_ in printed] == ["antgoal", "ballcatching"]
    shell.block("environments.md", 2, {"for seed in 0 1 2": "for seed in 0"})
    evaluated = [words[2] for words in shell.typed if words[1] == "evaluate"]
    assert len(evaluated) == 3
    assert len({*evaluated}) == 2
    shell.block("environments.md", 3)
    assert len((shell.folder / "my_padded_train.csv").read_text().splitlines()) == 1 + 100 + 100
    shell.block("environments.md", 6)
    assert len(list((shell.folder / "pictures").glob("*.gif"))) == 3


@executes(("curricula.md", 0), ("curricula.md", 1), ("curricula.md", 2), ("results.md", 0), ("grids.md", 1))
def test_curricula_and_results(shell: Shell) -> None:
    for number in range(3):
        shell.block("curricula.md", number)
    shell.block("results.md", 0)
    shell.block("grids.md", 1)
    found = {path.parent.parent.name for path in (shell.folder / "runs").glob("*/report/report.html")}
    assert found == {"rivals_pointmass", "rivals_maze", "paper-pointmass-uniform",
                     "paper-pointmass-multiply-scale-0.02"}  # fmt: skip


@executes(("tuning.md", 0))
def test_tuning(shell: Shell) -> None:
    shell.block("tuning.md", 0)
    assert (shell.folder / "runs/pointmass_tuned/report/report.md").is_file()
    assert (shell.folder / "runs/pointmass_tuned-confirm").is_dir()


@executes(("reports.md", 0))
def test_reports(shell: Shell) -> None:
    """Of the grid of the pages, which is run for it."""
    shell.run("space-dist grid run configs/grids/pointmass_small.yaml")
    shell.block("reports.md", 0, {"runs/GRID": "runs/pointmass_small", "CELL": "space kappa=16", "FOLDER": "elsewhere"})
    assert (shell.folder / "elsewhere/report.html").is_file()


@executes(("arithmetic.md", 0))
def test_arithmetic(shell: Shell) -> None:
    """In a process of its own: libraries choose when they are loaded."""
    shell.block("arithmetic.md", 0, {"--set arithmetic=native": "--set arithmetic=native --set tracking.uri=null"})
    status = Ledger(shell.folder / "runs/native/s0").status()
    assert (status.state, shell.typed) == ("done", [])
