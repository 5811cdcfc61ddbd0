"""What a run tells of itself while it goes on, beside what reports say of it later."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

import space_dist
from space_dist.ledger import CURRICULUM
from space_dist.report.load import load_run
from space_dist.run.training import Progress
from tests.test_learners import N_STEPS, config_for, learner_section


@pytest.mark.parametrize("curriculum", [{"kind": "space", "eta": 10.0}, {"kind": "space"}, {"kind": "uniform"}])
@pytest.mark.parametrize("rounds", [1, 4])
def test_the_last_set_is_the_one_that_reports_tell(rounds: int, curriculum: dict[str, Any], tmp_path: Path) -> None:
    told: list[Progress] = []
    config = config_for(tmp_path, learner_section("ppo"), curriculum=curriculum, budget={"steps": rounds * N_STEPS})
    run = space_dist.train(
        config, out=tmp_path / "run", progress=lambda now: told.append(dataclasses.replace(now))
    )  # fmt: skip
    assert told[-1].set_size == load_run(run.ledger).set_sizes[-1]
    assert told[-1].set_size == len(set(run.ledger.rows(CURRICULUM)[-1]["trained"]))
    assert told[-1].evaluated_at == [row["steps"] for row in run.ledger.rows() if row["kind"] == "evaluation"][-1]
    assert f"return {told[-1].returns}".endswith(f" at {told[-1].steps:,}")
