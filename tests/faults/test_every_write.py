"""A run that was killed, or refused by its disk, at any write and any end of a round is resumed to the same bytes."""

from __future__ import annotations

import errno
import os
import time
from pathlib import Path
from typing import Any

import pytest

from space_dist import config as configs
from space_dist.errors import LedgerError, SpaceDistError
from space_dist.ledger import Ledger
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests
from tests import prepared
from tests.faults.injection import Disk, Kills, bury_owner
from tests.patience import PATIENCE
from tests.test_learners import ROUNDS, config_for, crashed, learner_section, results, with_checkpoints

LEARNERS = ("ppo", "trpo", "dqn", "sac")
# Else each learner meets a quarter of the refusals, together all; and, as they write the same files, PPO and TRPO meet
# half of the kills and crashes each, and so do DQN and SAC.
ALL = bool(os.environ.get("SPACE_DIST_ALL_FAULTS"))
SHORT = 2  # rounds of the runs whose every write is hit


def short(folder: Path, learner: str, rounds: int = SHORT) -> configs.RunConfig:
    section = learner_section(learner, n_steps=32, net_arch=[4])
    if learner in ("dqn", "sac"):
        section |= {"learning_starts": 20, "batch_size": 8, "buffer_size": 50, "gradient_steps_per_step": 0.0625}
    return config_for(folder, section, budget={"steps": 32 * rounds}, rollout={"shards": 2, "slots": 2})


def its_half(faults: list[Any], learner: str) -> list[Any]:
    return faults if ALL else faults[LEARNERS.index(learner) % 2 :: 2]


def resume(config: configs.RunConfig, folder: Path) -> dict[str, bytes]:
    launch(config, folder, resume=True, stop=StopRequests())
    assert Ledger(folder).status().state == "done"
    assert not [path for path in folder.rglob("*") if path.name.endswith(".tmp")]
    return results(folder)


@pytest.fixture(autouse=True)
def _no_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


@pytest.mark.parametrize("learner", LEARNERS)
def test_a_run_killed_at_any_write_is_resumed_to_the_same_bytes(learner: str, tmp_path: Path) -> None:
    config = short(tmp_path, learner)
    kills = Kills(tmp_path / "run", tmp_path / "killed")
    with Disk(tmp_path / "run", kills).watched() as disk:
        launch(config, tmp_path / "run", resume=True, stop=StopRequests())
    reference = results(tmp_path / "run")
    assert disk.calls > 100
    assert len(kills.moments) > 40
    rounds = set()
    for what, folder in its_half(kills.moments, learner):
        names = sorted((folder / "checkpoints").glob("round-*.npz"))
        rounds.add(names[-1].stem if names else "none")
        assert resume(config, folder) == reference, f"killed before {what}, in {folder}"
    assert len(rounds) == 1 + SHORT  # the first checkpoint is that of the first round


@pytest.mark.parametrize("learner", LEARNERS)
def test_a_run_whose_disk_refuses_any_write_is_resumed_to_the_same_bytes(learner: str, tmp_path: Path) -> None:
    config = short(tmp_path, learner, rounds=2)
    reference = resume(config, tmp_path / "reference")
    refused, step = 0, 1 if ALL else len(LEARNERS)
    number = 1 - step if ALL else LEARNERS.index(learner) + 1 - step
    while True:
        number += step
        folder = tmp_path / f"run{number}"

        def refuse(call: int, what: str, number: int = number) -> None:
            full = call >= number if number % 2 else call == number  # for good, or just once
            if full and not what.startswith("unlink"):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), what)

        with Disk(folder, refuse).watched() as disk:
            try:
                launch(config, folder, resume=True, stop=StopRequests())
            except LedgerError as error:
                refused += "the disk is full" in str(error)
        bury_owner(folder)
        assert resume(config, folder) == reference, f"refused at call {number}"
        if disk.calls < number:
            break
    assert refused > 100 / step


@pytest.mark.parametrize("every_rounds", [1, 4])
@pytest.mark.parametrize("learner", LEARNERS)
def test_a_run_that_crashes_at_the_end_of_any_round_is_resumed_to_the_same_bytes(
    learner: str, every_rounds: int, tmp_path: Path
) -> None:
    config = with_checkpoints(short(tmp_path, learner, ROUNDS), every_rounds)
    reference = resume(config, tmp_path / "reference")
    for rounds in its_half(list(range(1, ROUNDS + 1)), learner):
        folder = tmp_path / f"run{rounds}"
        crashed(config, folder, rounds)
        assert Ledger(folder).status().state == "failed"
        assert resume(config, folder) == reference, rounds


@pytest.mark.parametrize("learner", LEARNERS)
def test_a_run_killed_twice_by_sigkill_is_resumed_to_the_same_bytes(learner: str, tmp_path: Path) -> None:
    config = short(tmp_path, learner, rounds=20)
    reference = resume(config, tmp_path / "reference")
    file, folder = tmp_path / "config.yaml", tmp_path / "run"
    file.write_text(configs.dump(config))
    for target in (5, 13):
        process = prepared.slow_run(file, folder, 0.05)
        try:
            deadline = time.monotonic() + PATIENCE
            while reached(folder) < target and process.is_alive() and time.monotonic() < deadline:
                time.sleep(0.003)
            assert process.is_alive(), "the run ended before it could be killed"
        finally:
            process.kill()
            process.join()
    assert Ledger(folder).status().state == "running"  # nobody was left to say otherwise
    assert resume(config, folder) == reference


def reached(folder: Path) -> int:
    names = sorted((folder / "checkpoints").glob("round-*.npz"))
    return int(names[-1].stem.removeprefix("round-")) if names else 0


def test_the_crash_is_a_sentence_and_its_traceback_is_in_the_log(tmp_path: Path) -> None:
    config = short(tmp_path, "ppo")

    def fail(_: Any) -> None:
        raise ZeroDivisionError("one of the user's")

    with pytest.raises(SpaceDistError, match=r"ZeroDivisionError: one of the user's.*log\.txt"):
        launch(config, tmp_path / "run", resume=True, stop=StopRequests(), observe=fail)
    assert "Traceback" in (tmp_path / "run" / "log.txt").read_text()
