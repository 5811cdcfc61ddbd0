"""What a run remembers of itself: every field comes back from a checkpoint, and lies in it where it always did."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from space_dist.config.sections import CheckpointConfig
from space_dist.curricula import Episodes
from space_dist.errors import SpaceDistError
from space_dist.instances import InstanceSet
from space_dist.ledger import Checkpoint, Ledger, RunWriter, Status, decode_checkpoint, encode_checkpoint
from space_dist.rollout.episodes import joined_episodes
from space_dist.rollout.walk import Unfinished, Walk
from space_dist.run import training
from space_dist.run.launch import launch
from space_dist.run.state import RunState
from space_dist.system.interrupts import StopRequests
from tests.test_learners import N_STEPS, config_for, interrupted, learner_section
from tests.test_rollout import setup_for

SETUP = dataclasses.replace(setup_for("tests.tiny_env:make"), shards=2, slots=3, train=setup_for().train)


def episodes(seed: int, n: int) -> Episodes:
    random = np.random.default_rng(seed)
    whole = {"indices", "lengths", "running"}
    return Episodes(**{
        field.name: random.normal(size=(n, 3)) if field.name == "contexts"
        else random.integers(9, size=n) if field.name in whole else random.normal(size=n)
        for field in dataclasses.fields(Episodes)
    })  # fmt: skip


def unfinished(seed: int, lengths: list[int]) -> Unfinished:
    random = np.random.default_rng(seed)
    steps = max(lengths)
    actions = random.normal(size=(steps, 3, 1)).astype(np.float32)
    return Unfinished(
        random.integers(9, size=3), random.normal(size=(3, 3)), random.integers(9, size=3).astype(np.uint64),
        np.array(lengths), *random.normal(size=(3, 3)), actions,
    )  # fmt: skip


def changed() -> dict[str, Any]:
    """A value of every field that is not the one that it begins with."""
    return {
        "scored": {"a/weight": np.arange(3.0), "bias": np.float32([0.1])},
        "acted": {"a/weight": np.arange(4.0)},
        "seen": [episodes(0, 2), episodes(1, 3)],
        "round": 7, "steps": 1234, "episodes": 56, "iteration": 3, "rounds_left": 2, "version": 5,
        "walk": Walk(4, (1, 6), (unfinished(0, [0, 2, 1]), unfinished(1, [5, 0, 3]))),
        "rows": 9, "evaluated_at": 1000, "rollouts": [{"return": 0.1, "success": float("nan")}, {"return": -0.3}],
        "updates": [{"loss": 1e-300}], "gradient_steps": 11, "sizes": np.arange(6.0),
        "curriculum_number": 2,
    }  # fmt: skip


def plain(value: Any) -> Any:
    """Comparable with `==`, bit by bit."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, float):
        return value.hex()
    if dataclasses.is_dataclass(value):
        return type(value).__name__, plain(vars(value))
    if isinstance(value, dict):
        return {name: plain(one) for name, one in value.items()}
    return [plain(one) for one in value] if isinstance(value, list | tuple) else value


def stored(run: RunState) -> Checkpoint:
    data, arrays = run.save()
    return decode_checkpoint(encode_checkpoint(Checkpoint(run.round, arrays, {"run": data})))


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(RunState)])
def test_every_field_comes_back_alone(name: str) -> None:
    value = changed()[name]
    run = dataclasses.replace(RunState(), **{name: value})
    again = RunState.restored(stored(run), SETUP)
    wanted = [joined_episodes(value)] if name == "seen" else value
    assert plain(getattr(again, name)) == plain(wanted)
    assert plain(dataclasses.replace(again, **{name: value})) == plain(run)
    assert plain(getattr(RunState(), name)) != plain(wanted)


def test_all_fields_come_back_together_and_lie_where_they_always_did() -> None:
    assert changed().keys() == {field.name for field in dataclasses.fields(RunState)}
    run = RunState(**changed())
    data, arrays = run.save()
    assert list(data) == [
        "round", "steps", "episodes", "iteration", "rounds_left", "version", "walk", "rows", "evaluated_at", "rollouts",
        "updates", "gradient_steps", "curriculum_number",
    ]  # fmt: skip
    # Only a curriculum that replaced another is told: checkpoints of runs with one are as they were.
    assert "curriculum_number" not in RunState().save()[0]
    assert data["walk"] == [4, [1, 6]]
    columns = [f"seen/{field.name}" for field in dataclasses.fields(Episodes)]
    running = [f"unfinished/{field.name}" for field in dataclasses.fields(Unfinished) if field.name != "memory"]
    assert list(arrays) == ["scored/a/weight", "scored/bias", "acted/a/weight", *columns, *running, "sizes"]
    again = RunState.restored(stored(run), SETUP)
    assert plain(again) == plain(dataclasses.replace(run, seen=[joined_episodes(run.seen)]))
    assert again.save()[1].keys() == arrays.keys()


def test_a_run_that_has_done_nothing_stores_no_arrays() -> None:
    data, arrays = RunState().save()
    assert (arrays, data["walk"], data["rounds_left"]) == ({}, [-1, []], None)
    assert plain(RunState.restored(stored(RunState()), SETUP)) == plain(RunState())


def test_episodes_of_another_run_are_refused() -> None:
    checkpoint = stored(RunState(**changed()))
    line = InstanceSet(np.arange(2), np.array([[0.5], [0.25]]), ("target",))
    for other in ({"slots": 4}, {"shards": 3}, {"train": line}):
        with pytest.raises(SpaceDistError, match="the checkpoint's episodes in progress are not those of a run"):
            RunState.restored(checkpoint, dataclasses.replace(SETUP, **other))


def test_what_a_recurrent_policy_remembers_comes_back_and_no_other_size_of_it() -> None:
    memories = np.random.default_rng(0).normal(size=(2, 3, 8)).astype(np.float32)
    walk = Walk(4, (1, 6), tuple(
        dataclasses.replace(unfinished(shard, [5, 0, 3]), memory=memory) for shard, memory in enumerate(memories)
    ))  # fmt: skip
    checkpoint = stored(RunState(walk=walk))
    assert plain(RunState.restored(checkpoint, dataclasses.replace(SETUP, memory_size=8)).walk) == plain(walk)
    for size in (0, 4):
        with pytest.raises(SpaceDistError, match="the checkpoint's episodes in progress are not those of a run"):
            RunState.restored(checkpoint, dataclasses.replace(SETUP, memory_size=size))
    without = stored(RunState(walk=changed()["walk"]))
    with pytest.raises(SpaceDistError, match="the checkpoint's episodes in progress are not those of a run"):
        RunState.restored(without, dataclasses.replace(SETUP, memory_size=8))
    assert not walk.unfinished[0].same(changed()["walk"].unfinished[0])  # type: ignore[union-attr]


def test_what_a_run_commits_is_its_state(tmp_path: Path) -> None:
    config = config_for(tmp_path, learner_section("ppo"))
    interrupted(config, tmp_path / "run", 3)
    checkpoint = decode_checkpoint(Ledger(tmp_path / "run").checkpoint_files()[0].read_bytes())
    data, _ = RunState().save()
    assert list(checkpoint.data["run"]) == list(data)
    assert checkpoint.round == checkpoint.data["run"]["round"] == 3
    kinds = list(dict.fromkeys(name.split("/")[0] for name in checkpoint.arrays))
    assert kinds == ["learner", "values", "curriculum", "unfinished"]


@pytest.mark.parametrize(
    ("settings", "rounds", "seconds", "cost", "due"),
    [
        ({}, 19, 59.0, 0.0, False),
        ({}, 20, 1.0, 0.0, True),
        ({}, 20, 1.0, 0.01, True),
        ({}, 20, 1.0, 0.011, False),  # more than a hundredth
        ({}, 1000, 59.0, 0.6, False),
        ({}, 1, 60.0, 5.0, True),
        ({"every_rounds": 3}, 2, 1.0, 0.0, False),
        ({"every_rounds": 3}, 3, 1.0, 5.0, True),  # as asked, whatever it takes
        ({"every_rounds": 3, "every_seconds": 0.5}, 1, 0.5, 0.0, True),
    ],
)
def test_when_a_checkpoint_is_due(
    settings: dict[str, Any], rounds: int, seconds: float, cost: float, due: bool
) -> None:  # fmt: skip
    assert CheckpointConfig(**settings).is_due(rounds, seconds, cost) == due


@pytest.mark.parametrize(("cost", "at"), [(0.1, [20, 40, 60, 80]), (0.25, [20, 45, 70, 80]), (2.0, [20, 80])])
def test_checkpoints_take_no_more_than_a_hundredth_of_a_run(
    cost: float, at: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rounds of one second, by a clock of the test's own, and checkpoints that take `cost`."""
    clock, commit, made = 0.0, RunWriter.commit, list[int]()

    def slow(self: RunWriter, checkpoint: Checkpoint, status: Status) -> None:
        nonlocal clock
        commit(self, checkpoint, status)
        clock += cost
        made.append(checkpoint.round)

    def round_over(_: Any) -> None:
        nonlocal clock
        clock += 1.0

    monkeypatch.setattr(RunWriter, "commit", slow)
    monkeypatch.setattr(training, "time", SimpleNamespace(monotonic=lambda: clock, time=time.time))
    config = config_for(tmp_path, learner_section("ppo"), checkpoint={}, budget={"steps": 80 * N_STEPS})
    launch(config, tmp_path / "run", resume=False, stop=StopRequests(), observe=round_over)
    assert sorted(set(made)) == at
