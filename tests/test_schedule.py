"""Runs that are paused and gone on with, and settings that change on the way."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from space_dist.config import RunConfig
from space_dist.errors import ConfigError
from space_dist.ledger import METRICS, Ledger
from space_dist.run.launch import Outcome, launch
from space_dist.run.population import advance, member
from space_dist.system.interrupts import StopRequests
from tests.test_learners import (
    KINDS,
    N_STEPS,
    ROUNDS,
    config_for,
    crashed,
    interrupted,
    learner_section,
    results,
    run,
    with_checkpoints,
)

STEPS = ROUNDS * N_STEPS
AT = 100  # in the third round, which ends at 120
# What of each learner changes, in both ways it can: by its optimiser, and by what is made anew with the learner.
CHANGES: dict[str, dict[str, Any]] = {
    "ppo": {"learner.learning_rate": 1e-2, "learner.clip_range": 0.4, "curriculum.kappa": 3},
    "a2c": {"learner.learning_rate": 1e-2, "learner.vf_coef": 1.0},
    "trpo": {"learner.learning_rate": 1e-2, "learner.target_kl": 0.1},
    "recurrent_ppo": {"learner.learning_rate": 1e-2, "learner.n_epochs": 1, "learner.batch_size": 24},
    "dqn": {"learner.learning_rate": 1e-2, "learner.batch_size": 8},
    "sac": {"learner.learning_rate": 1e-2, "learner.gamma": 0.5},
    "td3": {"learner.learning_rate": 1e-2, "learner.gamma": 0.5},
}
LEARNERS = [(kind, "stock") for kind in KINDS] + [("ppo", "lean"), ("ppo", "population"), ("trpo", "population")]


def configured(folder: Path, kind: str, how: str, **sections: Any) -> RunConfig:
    update = {"update": "lean"} if how == "lean" else {}
    engine = {"engine": "population"} if how == "population" else {}
    return config_for(folder, learner_section(kind, **update), **engine, **sections)


def paused(config: RunConfig, folder: Path, at: int) -> None:
    launch(config, folder, resume=True, stop=StopRequests(), pause_at=at)
    status = Ledger(folder).status()
    assert (status.state, status.paused_at) == ("paused", at)
    assert at <= status.steps < at + N_STEPS


def rows_until(folder: Path, steps: int) -> list[Any]:
    return [row for row in Ledger(folder).rows(METRICS) if row["steps"] <= steps]


@pytest.mark.parametrize(("kind", "how"), LEARNERS)
def test_a_paused_run_goes_on_to_the_same_bytes(kind: str, how: str, tmp_path: Path) -> None:
    config = configured(tmp_path, kind, how)
    expected = run(config, tmp_path / "whole")
    folder = tmp_path / "paused"
    for at in (1, AT, 200):
        paused(config, folder, at)
    assert not (folder / "model.npz").exists()
    before = (folder / METRICS).read_bytes()
    launch(config, folder, resume=True, stop=StopRequests(), pause_at=AT)  # it was there already
    assert (folder / METRICS).read_bytes() == before
    assert run(config, folder) == expected


@pytest.mark.parametrize(("kind", "how"), LEARNERS)
def test_settings_change_on_the_way(kind: str, how: str, tmp_path: Path) -> None:
    constant = configured(tmp_path, kind, how)
    config = configured(tmp_path, kind, how, schedule=[{"steps": AT, "set": CHANGES[kind]}])
    same = {"learner.learning_rate": constant.learner.learning_rate}
    unchanged = configured(tmp_path, kind, how, schedule=[{"steps": 50, "set": same}, {"steps": AT, "set": same}])
    without = run(constant, tmp_path / "constant")
    assert run(unchanged, tmp_path / "unchanged") == without
    expected = run(config, tmp_path / "changed")
    assert rows_until(tmp_path / "changed", AT) == rows_until(tmp_path / "constant", AT)
    assert expected["model.npz"] != without["model.npz"]
    seldom, folder = with_checkpoints(config, 20), tmp_path / "disturbed"
    interrupted(seldom, folder, 2)  # before the change
    crashed(seldom, folder, 2)  # behind it, back to where it came into force
    interrupted(seldom, folder, 1)
    assert run(config, folder) == expected
    # An heir: what was paused at the change goes on with it.
    heir = tmp_path / "heir"
    paused(constant, heir, AT)
    assert run(config, heir) == expected


def test_members_change_each_by_itself(tmp_path: Path) -> None:
    configs = [
        configured(tmp_path, "ppo", "population", seed=seed, schedule=[
            {"steps": at, "set": {"learner.learning_rate": 1e-2, "learner.n_epochs": 1 + seed}} for at in changes
        ])
        for seed, changes in enumerate(((), (AT,), (40, AT, 200)))
    ]  # fmt: skip
    expected = [run(config, tmp_path / f"alone{number}") for number, config in enumerate(configs)]
    folders = [tmp_path / f"together{number}" for number in range(3)]
    ends: dict[Path, Any] = {}
    for pause_at in (120, 0):
        members = {folder: member(config, folder, stop=StopRequests(), pause_at=pause_at)
                   for config, folder in zip(configs, folders, strict=True)}  # fmt: skip
        advance(members, ends.__setitem__)
        assert all(isinstance(ends[folder], Outcome) for folder in folders)
    assert [results(folder) for folder in folders] == expected


def test_only_the_run_that_is_paused_there_goes_on_under_another_schedule(tmp_path: Path) -> None:
    change = {"steps": AT, "set": {"learner.learning_rate": 1e-2}}
    constant, config = (configured(tmp_path, "ppo", "stock", schedule=some) for some in ([], [change]))
    interrupted(constant, tmp_path / "interrupted", 3)
    paused(constant, tmp_path / "earlier", 60)
    paused(constant, tmp_path / "later", 200)
    run(constant, tmp_path / "done")
    for name in ("interrupted", "earlier", "later", "done"):
        with pytest.raises(ConfigError, match=r"holds a run of another configuration .*schedule"):
            launch(config, tmp_path / name, resume=True, stop=StopRequests())
    paused(constant, tmp_path / "other", AT)
    other = configured(tmp_path, "ppo", "stock", schedule=[change], seed=5)
    with pytest.raises(ConfigError, match="seed: 0 -> 5"):
        launch(other, tmp_path / "other", resume=True, stop=StopRequests())


@pytest.mark.parametrize(
    ("schedule", "words"),
    [
        ([{"steps": 0, "set": {"learner.gamma": 0.5}}], "schedule.0.steps"),
        ([{"steps": STEPS, "set": {"learner.gamma": 0.5}}], f"below budget.steps = {STEPS}"),
        ([{"steps": 9, "set": {"learner.gamma": 0.5}}, {"steps": 9, "set": {"learner.gamma": 0.6}}], "must ascend"),
        ([{"steps": 9, "set": {}}], "schedule.0.set: changes nothing"),
        ([{"steps": 9, "set": {"learner.gama": 0.5}}], "did you mean 'learner.gamma'"),
        ([{"steps": 9, "set": {"learner.net_arch": [3]}}], "learner.net_arch cannot change on the way"),
        (
            [{"steps": 9, "set": {"learner.gamma": 1.5}}],
            "schedule.0: learner.gamma: must be a number from 0 to 1, not 1.5",
        ),
        ([{"steps": 9, "set": {"learner.gamma": "a"}}], "schedule.0: learner.gamma: .*number"),
        ([{"steps": 9, "set": {"learner.target_kl": 0.1, "learner.damping": 1}}], "learner.damping cannot"),
        ([{"step": 9, "set": {"learner.gamma": 0.5}}], "did you mean 'steps'"),
        ("gamma", "schedule"),
    ],
)
def test_schedules_that_cannot_be_are_refused(schedule: Any, words: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=words):
        config_for(tmp_path, learner_section("ppo"), schedule=schedule)


def test_a_threshold_that_was_raised_for_good_cannot_be_scheduled(tmp_path: Path) -> None:
    schedule = [{"steps": 9, "set": {"curriculum.eta": 0.5}}]
    config_for(tmp_path, learner_section("ppo"), schedule=schedule)
    with pytest.raises(ConfigError, match=r"curriculum\.eta says nothing once adaptive_eta: persistent"):
        config_for(tmp_path, learner_section("ppo"), schedule=schedule,
                   curriculum={"kind": "space", "adaptive_eta": "persistent"})  # fmt: skip
    with pytest.raises(ConfigError, match=r"schedule\.0: curriculum\.eta: unknown key\. Allowed here: kind"):
        config_for(tmp_path, learner_section("ppo"), schedule=schedule, curriculum={"kind": "round_robin"})
