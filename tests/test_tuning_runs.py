"""Searches that train: killed at random moments, with other numbers of workers, and a setting that makes runs fail."""

from __future__ import annotations

import contextlib
import os
import random
import time
from collections.abc import Mapping
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest

from space_dist.api.tuning import run_search
from space_dist.experiment.manifest import Grid
from tests import prepared
from tests.grids import TINY, write_line_instances
from tests.patience import PATIENCE
from tests.tunes import RATE, write_tune

KILLS = 10


def tiny_tune(folder: Path, changes: Mapping[str, Any] = MappingProxyType({}), /, **sections: Any) -> Path:
    """A search on the line, whose runs take a moment: two arms of four trials, in generations of two."""
    folder.mkdir(exist_ok=True, parents=True)
    instances = write_line_instances(folder)
    final = folder / "final.csv"
    final.write_text("id,target\n0,-0.55\n1,0.15\n2,0.75\n")
    settings = {**TINY, "env": {"id": "tests.tiny_env:make"}, "engine": "auto", "checkpoint.every_rounds": 1}
    defaults = {
        "set": {**settings, **instances, **changes}, "trials": 4, "seeds": [0, 1],
        "retry": {"killed": 100, "preempted": 100},
        "confirm": {"seeds": [9], "instances": {"test": str(final)}},
    }  # fmt: skip
    return write_tune(folder, **{**defaults, **sections})


@pytest.fixture(scope="module")
def left_alone(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Grid]:
    """The file of a search with racing, and that search, which nobody disturbed, one process after the other."""
    folder = tmp_path_factory.mktemp("left_alone")
    path = tiny_tune(folder, pruner={"rungs": [1], "keep": 0.5})
    return path, run_search(path, root=folder / "runs", max_parallel=1, progress=False).grid


def test_trials_train_and_are_told(left_alone: tuple[Path, Grid]) -> None:
    manifest = left_alone[1].manifest()
    assert manifest.search is not None
    assert manifest.search.over
    states = [[trial.state for trial in manifest.search.of_arm(arm)] for arm in manifest.search.arms]
    assert [sorted(of_arm) for of_arm in states] == [["complete", "complete", "pruned", "pruned"]] * 2
    assert len({trial.values[1] for trial in manifest.search.trials}) > 4
    assert all(cell.stack for cell in manifest.cells)  # which share processes


def test_killed_at_random_moments_it_ends_with_the_same_bytes(left_alone: tuple[Path, Grid], tmp_path: Path) -> None:
    """SIGKILL to the command and all that it has started; other numbers of workers each time."""
    path, undisturbed = left_alone
    moments, killed, searches = random.Random(0), 0, 1
    for attempt in range(6 * KILLS):
        root = tmp_path / str(searches)
        words = ["tune", "run", path, "--root", root, "--max-parallel", 1 + attempt % 3]
        process = prepared.command(words, tmp_path / "said.txt")
        try:
            # From its first moments to its end, whatever the machine: by what its folder holds.
            deadline, wanted = time.monotonic() + PATIENCE, moments.randrange(1, 16) if killed < KILLS else 10**9
            before = progress(root)
            while process.is_alive() and progress(root) - before < wanted and time.monotonic() < deadline:
                time.sleep(0.02)
            ended = process.exitcode
        finally:
            end_session(process)
        if ended is None:
            killed += 1
            continue
        assert ended == 0
        assert (root / "search/manifest.json").read_bytes() == undisturbed.manifest_file.read_bytes()
        if killed >= KILLS:
            return
        searches += 1  # it came to its end before it was killed so often: another one
    pytest.fail(f"{killed} kills, and no search came to its end behind them")


def progress(root: Path) -> int:
    """How many files the search has written by now; of folders that come and go meanwhile, some."""
    return sum(len(files) for _, _, files in os.walk(root))


def end_session(process: BaseProcess) -> None:
    """End a command of ours and every process that it has started, which have sessions of their own."""
    import psutil

    children: list[psutil.Process] = []
    with contextlib.suppress(psutil.NoSuchProcess):
        children = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    for child in children:
        with contextlib.suppress(psutil.NoSuchProcess):
            child.kill()
    psutil.wait_procs(children, timeout=PATIENCE)
    process.join()


def test_a_setting_that_makes_runs_fail_is_a_failed_trial(tmp_path: Path) -> None:
    """With a learning rate of 1e30 weights are no numbers after the first update."""
    rates = {"learner.learning_rate": {"choice": [1e-3, 1e30]}}
    path = tiny_tune(tmp_path, search=rates, arms={"a": {}}, sampler={"kind": "random"})
    manifest = run_search(path, root=tmp_path / "runs", progress=False).manifest
    assert manifest.search is not None
    assert manifest.search.over
    found = {(trial.parameters["learner.learning_rate"], trial.state) for trial in manifest.search.trials}
    assert found == {(1e-3, "complete"), (1e30, "failed")}


def test_an_ordinary_search_needs_no_file_of_its_own(tmp_path: Path) -> None:
    made = run_search(
        tiny_tune(tmp_path, arms={"a": {}}, search={"learner.learning_rate": RATE}), root=tmp_path, progress=False
    )  # fmt: skip
    assert repr(made).endswith("8 of 8 runs done)")
