"""A page about code of one's own, its example laid out and trained: what holds for curricula and learners alike."""

from __future__ import annotations

import contextlib
import functools
import os
import re
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from space_dist import config as configs
from space_dist.cli import runs
from space_dist.grid.planning import plan
from space_dist.ledger import Ledger, RunWriter
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests
from tests import prepared
from tests.commanding import command
from tests.patience import PATIENCE
from tests.test_learners import interrupted, results

DOCS = Path(__file__).parent.parent / "docs"


def blocks(page: str, language: str) -> list[str]:
    """The blocks of a page of the documentation in a language."""
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text(), flags=re.DOTALL)


@dataclass(frozen=True)
class Example:
    """The example of a page: a module and a config, both called `name`, and commands that sample and train.

    quick: settings with which a run takes a second, in `rounds` rounds.
    """

    page: str
    name: str
    quick: tuple[str, ...]
    rounds: int

    @property
    def config(self) -> Path:
        """In the current folder."""
        return Path(f"{self.name}.yaml")

    def blocks(self, language: str) -> list[str]:
        return blocks(self.page, language)

    @contextlib.contextmanager
    def laid_out(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
        """The current folder is one that holds what the page shows, and instances; a test may add a module `others`."""
        (code,), (config,) = self.blocks("python"), self.blocks("yaml")
        monkeypatch.chdir(folder)
        monkeypatch.syspath_prepend(str(folder))
        monkeypatch.setattr(runs, "STOP", StopRequests())
        Path(f"{self.name}.py").write_text(code)
        self.config.write_text(config)
        sample = self.blocks("bash")[0].splitlines()[0].partition("#")[0].split()[1:]
        assert command(monkeypatch, *sample, "--train", 12, "--test", 3) == 0
        yield
        for module in (self.name, "others"):
            sys.modules.pop(module, None)

    def chosen(self, *settings: str, workers: int = 0) -> configs.RunConfig:
        return configs.load(self.config, [*self.quick, f"resources.workers={workers}", *settings])

    def trained(self, folder: Path, *settings: str, workers: int = 0) -> dict[str, bytes]:
        launch(self.chosen(*settings, workers=workers), folder, resume=True, stop=StopRequests())
        return results(folder)

    def assert_a_kill_changes_no_byte(self, folder: Path, reference: dict[str, bytes]) -> None:
        """A run that is killed half way, in `folder`/killed, comes to the `reference`. The example lies in `folder`."""
        arguments = ["train", self.config, "--out", folder / "killed", "--workers", 0]
        arguments += [part for setting in self.quick for part in ("--set", setting)]
        victim = prepared.command(arguments, folder / "said.txt", functools.partial(_slowly, str(folder)))
        deadline = time.monotonic() + PATIENCE
        while len(list((folder / "killed/checkpoints").glob("round-*.npz"))) < 2:
            assert victim.is_alive(), (folder / "said.txt").read_text()
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert victim.pid is not None
        os.kill(victim.pid, signal.SIGKILL)
        victim.join(PATIENCE)
        status = Ledger(folder / "killed").status()
        assert (status.state, 0 < status.round < self.rounds) == ("running", True)
        assert self.trained(folder / "killed") == reference
        assert not Ledger(folder / "killed").status().fingerprint_changed

    def assert_its_source_is_part_of_a_run(self, folder: Path) -> None:
        """Once the module is edited, its runs are planned anew, and one that goes on is marked."""
        grid, module = folder / "grid.yaml", folder / f"{self.name}.py"
        grid.write_text(
            f"name: mine\nextends: {self.config}\nset: {{budget.steps: 2048}}\nzip: {{learner.n_epochs: [1]}}\n"
            "seeds: {start: 0, count: 1}\ntracking: {uri: null}\n"
        )
        planned = plan(grid, folder / "runs")
        interrupted(self.chosen(), folder / "run", 3)
        before = Ledger(folder / "run").status()
        assert f"source.{self.name}" in before.fingerprint
        assert plan(grid, folder / "runs").new_runs == 0
        module.write_text(module.read_text() + "\n# edited\n")
        again = plan(grid, folder / "runs")
        assert (planned.new_runs, again.new_runs, again.dropped_runs) == (1, 1, 1)
        launch(self.chosen(), folder / "run", resume=True, stop=StopRequests())
        assert Ledger(folder / "run").status().fingerprint_changed
        assert "that of your own environment, policy, learner or curriculum" in (folder / "run/log.txt").read_text()


@pytest.fixture
def example(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A current folder that holds the `EXAMPLE` of the test's module, and instances."""
    with request.module.EXAMPLE.laid_out(tmp_path, monkeypatch):
        yield tmp_path


def _slowly(folder: str) -> None:
    """In that folder, and with time after each commit to be killed in."""
    os.chdir(folder)
    commit = RunWriter.commit

    def resting(self: RunWriter, *arguments: object) -> None:
        commit(self, *arguments)  # type: ignore[arg-type]
        time.sleep(0.5)

    RunWriter.commit = resting  # type: ignore[method-assign, assignment]
