"""A short rehearsal of `jobs/benchmark.py chaos`: one fault of each of five kinds over a small grid."""

from __future__ import annotations

import sys
from collections import Counter

import pytest

from tests.grids import ROOT

sys.path.append(str(ROOT / "jobs"))

from benchmarks.chaos import KINDS, plan, rehearse

BOUNDED = ("kill rollout actor", "stop curriculum actor", "kill driver", "kill Ray head", "kill tracking server")


def test_the_plan_is_seeded_and_even() -> None:
    made = plan(KINDS, 50, 1000, seed=3)
    assert made == plan(KINDS, 50, 1000, seed=3)
    assert made != plan(KINDS, 50, 1000, seed=4)
    assert {*Counter(fault.kind for fault in made).values()} == {3, 4}
    moments = [fault.after_steps for fault in made]
    assert moments == sorted(moments)
    assert 0 < moments[0] < moments[-1] < 1000


@pytest.mark.ray
@pytest.mark.server
@pytest.mark.timeout(600)
def test_a_grid_under_faults_is_the_grid_left_alone() -> None:
    said: list[str] = []
    result = rehearse(runs=3, steps=51_200, seed=1, kinds=BOUNDED, count=len(BOUNDED), say=said.append)
    assert not result.faults, "\n".join([*result.faults, *said])
    assert sorted(hit.fault.kind for hit in result.hits) == sorted(BOUNDED)
    assert all(hit.seconds is not None for hit in result.hits)
    assert result.identical == 3
    assert result.submissions >= 2
