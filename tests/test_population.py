from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.config import RunConfig
from space_dist.envs.interface import Step
from space_dist.errors import Interrupted, SpaceDistError
from space_dist.interrupts import StopRequests
from space_dist.launch import Outcome, launch
from space_dist.ledger import Ledger
from space_dist.population import advance, member
from tests.test_learners import LINE, N_STEPS, config_for, learner_section, results
from tests.tiny_env import Line

DISCRETE = "tests.tiny_env:make_discrete"
Ends = dict[Path, Outcome | SpaceDistError]


def configured(folder: Path, number: int, **sections: Any) -> RunConfig:
    """Member `number` of a population of runs that differ in all that members may."""
    folder.mkdir(parents=True, exist_ok=True)
    numbers = {"learning_rate": 1e-3 * (number + 1), "gamma": 0.9 - 0.05 * number, "clip_range": 0.1 + 0.05 * number}
    curricula = ({"kind": "space"}, {"kind": "round_robin"}, {"kind": "space", "kappa": 2, "eta": 0.5}, {"kind": "plr"})
    config = config_for(
        folder, learner_section("ppo", **{**numbers, **sections.pop("learner", {})}),
        curriculum=curricula[number % len(curricula)], engine="population", seed=number, **sections,
    )  # fmt: skip
    write_set(folder / "train.csv", np.linspace(-1.0, 1.0 - number / 11, 6 + number))
    return config


def write_set(path: Path, targets: NDArray[np.float64]) -> None:
    path.write_text("\n".join(["id,target", *(f"{number},{target}" for number, target in enumerate(targets))]) + "\n")


def together(configs: Sequence[RunConfig], folders: Sequence[Path]) -> Ends:
    ends: Ends = {}
    members = {
        folder: member(config, folder, stop=StopRequests()) for config, folder in zip(configs, folders, strict=True)
    }
    advance(members, ends.__setitem__)
    return ends


def alone(config: RunConfig, folder: Path) -> dict[str, bytes]:
    launch(config, folder, resume=True, stop=StopRequests())
    return results(folder)


@pytest.mark.parametrize("env_id", [LINE, DISCRETE])
@pytest.mark.parametrize("normalised", [False, True])
def test_a_member_is_what_its_run_is_alone(env_id: str, normalised: bool, tmp_path: Path) -> None:
    learner = {"normalize_observations": normalised, "normalize_rewards": normalised}
    configs = [
        configured(tmp_path / str(number), number, env={"id": env_id}, learner=learner,
                   evaluation={"every_steps": 100, "legacy_metric": True})
        for number in range(4)
    ]  # fmt: skip
    expected = [alone(config, tmp_path / f"alone{number}") for number, config in enumerate(configs)]
    for chosen in ([0, 1, 2, 3], [3, 1]):
        folders = [tmp_path / f"{len(chosen)}-{number}" for number in chosen]
        ends = together([configs[number] for number in chosen], folders)
        assert all(isinstance(ends[folder], Outcome) for folder in folders)
        for number, folder in zip(chosen, folders, strict=True):
            assert results(folder) == expected[number]
            assert Ledger(folder).status().state == "done"
    assert len({content["metrics.jsonl"] for content in expected}) == 4


def test_its_learning_is_stable_baselines3s_up_to_rounding(tmp_path: Path) -> None:
    config = configured(tmp_path, 0)
    ours, theirs = tmp_path / "population", tmp_path / "single"
    alone(config, ours)
    alone(config.model_copy(update={"engine": "single"}), theirs)
    rows = [[row for row in Ledger(folder).rows() if row["kind"] == "evaluation"] for folder in (ours, theirs)]
    for one, other in zip(*rows, strict=True):
        assert one["steps"] == other["steps"]
        assert one["test"]["returns"] == pytest.approx(other["test"]["returns"], abs=1e-3)
    assert results(ours)["model.npz"] != results(theirs)["model.npz"]


def test_whoever_is_lost_in_the_middle_goes_on_in_any_company(tmp_path: Path) -> None:
    configs = [configured(tmp_path / str(number), number) for number in range(3)]
    short = configured(tmp_path / "3", 3, budget={"steps": 2 * N_STEPS})
    folders = [tmp_path / f"run{number}" for number in range(4)]

    def die(folder: Path, outcome: Outcome | SpaceDistError) -> None:
        assert (folder, isinstance(outcome, Outcome)) == (folders[3], True)
        raise RuntimeError("the test's crash")

    members = [member(config, folder, stop=StopRequests())
               for config, folder in zip([*configs, short], folders, strict=True)]  # fmt: skip
    with pytest.raises(RuntimeError, match="crash"):
        advance(dict(zip(folders, members, strict=True)), die)
    for folder in folders[:3]:
        status = Ledger(folder).status()
        assert (status.state, status.steps) == ("running", 2 * N_STEPS)
        assert not Ledger(folder).owner_alive()
    assert together([configs[2]], [folders[2]]).keys() == {folders[2]}
    ends = together([short, configs[1], configs[0]], [folders[3], folders[1], folders[0]])
    assert [isinstance(end, Outcome) and end.already_done for end in ends.values()].count(True) == 1
    for number, config in enumerate(configs):
        assert results(folders[number]) == alone(config, tmp_path / f"alone{number}")


def test_a_member_that_is_asked_to_stop_stops_alone(tmp_path: Path) -> None:
    configs = [configured(tmp_path / str(number), number) for number in range(2)]
    folders = [tmp_path / "run0", tmp_path / "run1"]

    def stopped(work: Any) -> Any:
        """A member that is asked to stop, by its file, after five answers."""
        answer = None
        for count in range(1000):
            if count == 5:
                Ledger(folders[1]).stop_file.touch()
            try:
                request = work.send(answer)
            except StopIteration as end:
                return end.value
            answer = yield request

    members = [member(config, folder, stop=StopRequests()) for config, folder in zip(configs, folders, strict=True)]
    ends: Ends = {}
    advance({folders[0]: members[0], folders[1]: stopped(members[1])}, ends.__setitem__)
    assert isinstance(ends[folders[0]], Outcome)
    assert isinstance(ends[folders[1]], Interrupted)
    assert Ledger(folders[1]).status().state == "interrupted"
    assert alone(configs[1], folders[1]) == alone(configs[1], tmp_path / "alone")


class Fragile(Line):
    """The line, whose end at 1 nobody may want to reach."""

    def step(self, actions: NDArray[np.generic]) -> Step:
        if (self._target > 0.99).any():
            raise ValueError("the line is broken at its end")
        return super().step(actions)


def make_fragile(n_slots: int) -> Fragile:
    return Fragile(n_slots, spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32))


def test_who_breaks_an_environment_fails_alone(tmp_path: Path) -> None:
    """The environments of all members are one batch; only those whose contexts break it must bear that."""
    configs = [configured(tmp_path / str(number), number, env={"id": "tests.test_population:make_fragile"})
               for number in range(3)]  # fmt: skip
    folders = [tmp_path / f"run{number}" for number in range(3)]  # the first one's instances reach 1
    ends = together(configs, folders)
    assert "broken at its end" in str(ends[folders[0]])
    assert isinstance(ends[folders[0]], SpaceDistError)
    for number in (1, 2):
        assert isinstance(ends[folders[number]], Outcome)
        assert results(folders[number]) == alone(configs[number], tmp_path / f"alone{number}")
