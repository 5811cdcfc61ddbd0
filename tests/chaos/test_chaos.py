"""A short rehearsal of `jobs/benchmark.py chaos`: one fault of each of five kinds over a small grid."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import pytest

from space_dist import config as configs
from tests.grids import ROOT, write_line_instances
from tests.slurm.gated_env import GATE

sys.path.append(str(ROOT / "jobs"))

from benchmarks.chaos import rehearse
from benchmarks.faults import KINDS, plan

BOUNDED = ("kill rollout actor", "stop curriculum actor", "kill driver", "kill Ray head", "kill tracking server")


def test_the_plan_is_seeded_and_even() -> None:
    made = plan(KINDS, 50, 1000, seed=3)
    assert made == plan(KINDS, 50, 1000, seed=3)
    assert made != plan(KINDS, 50, 1000, seed=4)
    assert {*Counter(fault.kind for fault in made).values()} == {3, 4}
    moments = [fault.after_steps for fault in made]
    assert moments == sorted(moments)
    assert 0 < moments[0] < moments[-1] < 1000


POPULATIONS = ("kill driver",)


@pytest.mark.ray
@pytest.mark.server
@pytest.mark.parametrize(("engine", "kinds"), [("single", BOUNDED), ("population", POPULATIONS)])
def test_a_grid_under_faults_is_the_grid_left_alone(
    engine: str, kinds: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    """Runs whose environment sleeps until the last fault has fallen: the machine is left to what recovers."""
    base, gate, said = tmp_path / "run.yaml", tmp_path / "gate", list[str]()
    base.write_text(configs.to_yaml({
        "name": "base", "env": {"id": "tests.slurm.gated_env:make"}, "curriculum": {"kind": "space"},
        "learner": {"kind": "ppo", "n_epochs": 1, "net_arch": [16]}, "rollout": {"shards": 2, "slots": 2},
        "budget": {"steps": 1024}, "instances": {"train": "train.csv", "test": "test.csv"},
    }))  # fmt: skip
    instances = write_line_instances(tmp_path)
    gate.touch()
    monkeypatch.setenv(GATE, str(gate))
    result = rehearse(
        runs=3, steps=7680, seed=1, kinds=kinds, count=len(kinds), say=said.append, base=base, last=0.4,
        settings={**instances, "engine": engine, "learner.n_steps": 256, "evaluation.every_steps": 2560},
        after_faults=gate.unlink,
    )  # fmt: skip
    assert not result.faults, "\n".join([*result.faults, *said])
    assert sorted(hit.fault.kind for hit in result.hits) == sorted(kinds)
    assert all(hit.seconds is not None for hit in result.hits)
    assert result.identical == 3
    assert result.submissions >= (2 if "kill Ray head" in kinds else 1)
