"""Runs that ended before anything came of them: whose folder is anyone's, and whose is not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

import space_dist
from space_dist.errors import ConfigError
from space_dist.ledger import METRICS, RunWriter, Status, encode_row
from space_dist.run.training import Training
from tests.test_learners import N_STEPS, config_for, learner_section
from tests.test_python import everything, files

SELDOM = {"every_rounds": 1000, "every_seconds": 1e6}


@pytest.mark.parametrize("resume", [True, False])
@pytest.mark.parametrize("how", ["stopped", "killed", "stopped behind a round"])
def test_a_run_that_ended_before_its_first_round_takes_any_budget(
    how: str, resume: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    section = learner_section("ppo")
    long, short = (config_for(tmp_path, section, checkpoint=SELDOM, budget={"steps": n * N_STEPS}) for n in (6, 4))
    run = tmp_path / "run"

    def give_up(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        if how != "stopped behind a round":
            patched.setattr(Training, "run", give_up)
        if how == "killed":
            patched.setattr(RunWriter, "set_status", killed_behind(RunWriter.set_status))
        with pytest.raises(KeyboardInterrupt):
            space_dist.train(long, out=run, progress=give_up)
    status = space_dist.Run(run).status
    assert (status.checkpoint, status.state) == (None, "running" if how == "killed" else "interrupted")
    if how == "stopped behind a round":
        (run / METRICS).write_bytes(encode_row({"kind": "evaluation", "round": 1}))  # which somebody may want
        before = everything(run)
        with pytest.raises(ConfigError, match="may only grow" if resume else "already holds a run"):
            space_dist.train(short, out=run, resume=resume, progress=False)
        assert everything(run) == before
        return
    space_dist.train(short, out=run, resume=resume, progress=False)
    space_dist.train(short, out=tmp_path / "whole", progress=False)
    assert files(run) == files(tmp_path / "whole")


def killed_behind(really: Callable[..., None]) -> Callable[..., None]:
    """Of what writes a status: only the first is."""
    written: list[Status] = []

    def write(writer: RunWriter, status: Status) -> None:
        written.append(status)
        if len(written) == 1:
            really(writer, status)

    return write


def test_a_run_that_began_anew_is_not_taken_for_one_of_which_nothing_came(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A finished one, under a larger budget, stopped when its rows were gone and before its first round."""
    section = learner_section("ppo")
    short = config_for(tmp_path, section, checkpoint=SELDOM)
    run = space_dist.train(short, out=tmp_path / "run", progress=False).folder
    long = config_for(tmp_path, section, checkpoint=SELDOM, budget={"steps": 8 * N_STEPS})

    def give_up(training: Training) -> None:
        next(training.work())
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Training, "run", give_up)
        with pytest.raises(KeyboardInterrupt):
            space_dist.train(long, out=run, resume=True, progress=False)
    assert space_dist.Run(run).status.checkpoint is None
    before = everything(run)
    with pytest.raises(ConfigError, match="may only grow"):
        space_dist.train(short, out=run, resume=True, progress=False)
    assert everything(run) == before
    space_dist.train(long, out=run, resume=True, progress=False)
    space_dist.train(long, out=tmp_path / "whole", progress=False)
    assert files(run) == files(tmp_path / "whole")
