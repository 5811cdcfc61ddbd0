"""Padded sets: that what is declared unsolvable is, in every world that says what that means, and who refuses what."""

from __future__ import annotations

import dataclasses
import re
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from space_dist import config as configs
from space_dist.envs import BATCHED, make_batched
from space_dist.envs.distributions import sample
from space_dist.envs.interface import DrawsUnsolvable
from space_dist.envs.padding import pad
from space_dist.envs.pointmass import BOUNDS
from space_dist.envs.sparse_pointmass import BatchedSparsePointMass
from space_dist.errors import ConfigError
from space_dist.instances import PADDING_IDS, ContextBounds, InstanceSet, read_csv
from space_dist.run.building import Blueprint
from tests.commanding import command
from tests.faulty_env import Honest

ROOT = Path(__file__).parent.parent
CLOSED = {"closed_gates": True}
PADDED: dict[str, dict[str, Any]] = {
    "space_dist/PointMass-v0": CLOSED, "space_dist/SparsePointMass-v0": CLOSED, "space_dist/GoalMaze-v0": {},
    "space_dist/Maze-v0": {}, "space_dist/MixedMaze-v0": {},
}  # fmt: skip
DISTRIBUTION = {"space_dist/PointMass-v0": "pointmass_uniform", "space_dist/SparsePointMass-v0": "pointmass_bimodal",
                "space_dist/GoalMaze-v0": "goalmaze_feasible", "space_dist/Maze-v0": "maze_dfs",
                "space_dist/MixedMaze-v0": "mixed_maze"}  # fmt: skip


def padding(env_id: str, n: int = 60) -> NDArray[np.float64]:
    """As many unsolvable contexts as solvable ones."""
    train = sample(DISTRIBUTION[env_id], n, 1, 0)[0]
    padded = pad(train, 0.5, 0, env_id, PADDED[env_id])
    return padded.contexts[padded.padding]


def test_the_worlds_that_can_be_padded_are_these() -> None:
    made = {env_id: make_batched(env_id, 1, context_visible=False) for env_id in BATCHED}
    assert {env_id for env_id, env in made.items() if isinstance(env, DrawsUnsolvable)} == set(PADDED)


@pytest.mark.parametrize("env_id", PADDED)
@pytest.mark.parametrize(("share", "count"), [(0.5, 60), (0.25, 20), (0.9, 540)])
def test_the_share_is_what_is_declared(env_id: str, share: float, count: int) -> None:
    train, test = sample(DISTRIBUTION[env_id], 60, 60, 0)
    padded = pad(train, share, 3, env_id, PADDED[env_id])
    assert padded.padding.sum() == count
    assert padded.padding.mean() == pytest.approx(share)
    assert padded.subset(np.flatnonzero(~padded.padding)) == train
    assert padded.ids[padded.padding].tolist() == [PADDING_IDS + number for number in range(count)]
    everything = np.vstack((padded.contexts, test.contexts))
    assert len(np.unique(everything, axis=0)) == len(everything)
    bounds = make_batched(env_id, 1, context_visible=False, kwargs=PADDED[env_id]).context_bounds
    assert ((padded.contexts >= bounds.low) & (padded.contexts <= bounds.high)).all()
    assert pad(train, share, 3, env_id, PADDED[env_id]) == padded
    assert pad(train, share, 4, env_id, PADDED[env_id]) != padded


# ---- that no policy can --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", ["space_dist/Maze-v0", "space_dist/MixedMaze-v0"])
def test_no_way_leads_to_the_goal_of_a_padded_maze(env_id: str) -> None:
    """Every cell that can be come to, found by walking the world itself."""
    layouts = padding(env_id)
    env, n = make_batched(env_id, 4, context_visible=False), np.zeros(4, dtype=np.uint64)
    for context in layouts:
        side = 5 if len(context) == 25 else int(context[0])
        four = np.tile(context, (4, 1))
        start = tuple(env.reset(np.arange(4), four, n)[0].tolist())
        ways: dict[Any, list[int]] = {start: []}
        queue = deque(ways)
        while queue:
            cell = queue.popleft()
            env.reset(np.arange(4), four, n)
            for action in ways[cell]:
                env.step(np.full(4, action))
            step = env.step(np.arange(4))
            assert step.success is not None
            assert not step.success.any()
            for action, to in enumerate(map(tuple, np.asarray(step.observations).tolist())):
                if to not in ways:
                    ways[to] = [*ways[cell], action]
                    queue.append(to)
        assert (side - 1, side - 1) not in ways
        assert len(ways) < side**2


def test_mazes_are_closed_anywhere_on_the_way() -> None:
    """Some near the start, some near the goal, and by one wall only."""
    layouts = padding("space_dist/Maze-v0")
    assert (np.asarray([bin(int(number)).count("1") for number in layouts.ravel()]).reshape(-1, 25).sum(axis=1)
            == 2 * 23).all()  # fmt: skip
    sizes = []
    for layout in layouts:
        found, queue = {0}, [0]
        while queue:
            cell = queue.pop()
            for bit, to in ((1, cell - 5), (4, cell + 5), (2, cell + 1), (8, cell - 1)):
                if int(layout[cell]) & bit and to not in found:
                    found.add(to)
                    queue.append(to)
        sizes.append(len(found))
    assert min(sizes) <= 3
    assert max(sizes) >= 22


def test_no_place_is_near_enough_to_a_padded_goal() -> None:
    """Of all places, on a grid; what lies between its points is nearer by half of its diagonal at most."""
    contexts = padding("space_dist/GoalMaze-v0", 400)
    line = np.linspace(-7.0, 7.0, 281)
    places = np.stack(np.meshgrid(line, line), axis=2).reshape(-1, 2)
    places = places[(np.abs(places) >= 5.0).any(axis=1)]
    nearest = np.array([np.hypot(*(places - context[:2]).T).min() for context in contexts])
    assert (nearest >= contexts[:, 2]).all()
    assert (nearest - 0.05 / np.sqrt(2.0) >= contexts[:, 2]).mean() > 0.9
    in_the_block = (np.abs(contexts[:, :2]) < 5.0).all(axis=1)
    assert 0.2 < in_the_block.mean() < 0.9


@pytest.mark.parametrize("compiled", [False, True])
def test_nobody_gets_through_a_closed_gate(compiled: bool) -> None:
    """Also where they cross the wall exactly at its centre: pushed against x = 4 they are there."""
    contexts = padding("space_dist/SparsePointMass-v0")
    assert {*contexts[:, 1]} == {0.0}
    contexts[0] = [4.0, 0.0, 0.0]
    env = BatchedSparsePointMass(len(contexts), closed_gates=True)
    if compiled:
        env.compile_physics()
    seen = env.reset(np.arange(len(contexts)), contexts, np.arange(len(contexts), dtype=np.uint64))
    crashed = np.zeros(len(contexts), dtype=np.bool_)
    for _ in range(100):
        aside = contexts[:, 0] - seen[:, 0]
        down = np.where((np.abs(aside) < 0.1) & (np.abs(seen[:, 1]) < 0.5), -0.3, 0.2 * (3.0 - seen[:, 2] - seen[:, 3]))
        actions = np.clip(np.column_stack((0.5 * aside - 0.3 * seen[:, 1], down)), -1.0, 1.0)
        actions[0] = [1.0, -0.5]
        step = env.step(actions)
        seen = np.where(crashed[:, None], seen, step.observations)
        crashed |= step.terminated
        assert not step.rewards[~crashed].any()
        assert (seen[:, 2] >= 0.0).all()
    assert crashed.sum() > 30
    assert seen[0].tolist() == [4.0, 0.0, 0.0, 0.0]


def test_gates_are_open_as_they_were_unless_they_may_be_closed() -> None:
    dense, closed = (make_batched("space_dist/PointMass-v0", 1, context_visible=False, kwargs=kwargs)
                     for kwargs in ({}, CLOSED))  # fmt: skip
    assert dense.context_bounds.low.tolist() == [-4.0, 0.5, 0.0]
    assert closed.context_bounds.low.tolist() == [-4.0, 0.0, 0.0]
    assert dense.context_bounds.high.tolist() == closed.context_bounds.high.tolist()
    with pytest.raises(ConfigError, match="closed_gates is 'no'; allowed are true and false"):
        make_batched("space_dist/PointMass-v0", 1, context_visible=False, kwargs={"closed_gates": "no"})


# ---- what is refused -----------------------------------------------------------------------------------------------

TRAIN = sample("pointmass_uniform", 10, 5, 0)[0]
_SPACE: Any = Honest.context_space
OWN = InstanceSet(np.arange(10), np.linspace(_SPACE.low, _SPACE.high, 12)[1:-1], Honest.context_names)


@pytest.mark.parametrize(
    ("env_id", "kwargs", "share", "seed", "said"),
    [
        ("space_dist/PointMass-v0", CLOSED, 0.0, 0, "the share 0 is not between 0 and 1; 0.5 pads a set with as many"),
        ("space_dist/PointMass-v0", CLOSED, 1.0, 0, "the share 1 is not between"),
        ("space_dist/PointMass-v0", CLOSED, float("nan"), 0, "the share nan is not between"),
        ("space_dist/PointMass-v0", CLOSED, 0.01, 0, "a share of 0.01 beside 10 instances are 0: at least 1"),
        ("space_dist/PointMass-v0", CLOSED, 1 - 1e-9, 0, "at most 10000000 instances"),
        ("space_dist/PointMass-v0", CLOSED, 0.5, -1, "the seed -1 is negative"),
        ("space_dist/PointMass-v0", {}, 0.5, 0, "env.id 'space_dist/PointMass-v0': only with closed_gates: true"),
        ("space_dist/Maze-v0", {}, 0.5, 0, "the set's features are gate_x, gate_width, friction, not cell_0_0, cell_1"),
    ],
)
def test_what_cannot_be_padded_says_why(
    env_id: str, kwargs: dict[str, Any], share: float, seed: int, said: str
) -> None:  # fmt: skip
    with pytest.raises(ConfigError, match=said):
        pad(TRAIN, share, seed, env_id, kwargs)


class Hopeless(Honest):
    """A user's environment, of single episodes, that says what cannot be solved."""

    def __init__(self, fault: str = "none") -> None:
        super().__init__()
        self.fault = fault

    def draw_unsolvable(self, rng: np.random.Generator, n: int) -> Any:
        if self.fault == "raises":
            raise OSError("oh no")
        drawn = rng.uniform(_SPACE.low, _SPACE.high, size=(n, 2))
        if self.fault in ("bounds", "nan"):
            drawn[0, 0] = 1e9 if self.fault == "bounds" else np.nan
        wrong = {"shape": np.zeros(3), "words": "all of them", "alike": np.tile(_SPACE.low, (n, 1))}
        return wrong.get(self.fault, drawn)


@pytest.mark.parametrize(
    ("env_id", "kwargs", "said"),
    [
        ("tests.faulty_env:Honest", {}, "knows of no unsolvable instances, .*: it has no draw_unsolvable"),
        ("tests.test_padding:Hopeless", {"fault": "shape"}, r"gave an array of shape \(3,\), not \(10, 2\)"),
        ("tests.test_padding:Hopeless", {"fault": "bounds"}, "gave contexts outside the bounds"),
        ("tests.test_padding:Hopeless", {"fault": "nan"}, "gave contexts outside the bounds"),
        ("tests.test_padding:Hopeless", {"fault": "words"}, "draw_unsolvable failed: ValueError"),
        ("tests.test_padding:Hopeless", {"fault": "raises"}, "draw_unsolvable failed: OSError: oh no"),
        ("tests.test_padding:Hopeless", {"fault": "alike"}, "found only 1 distinct unsolvable instances where 10 were"),
    ],
)
def test_what_a_users_environment_draws_is_looked_at(env_id: str, kwargs: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=rf"^env\.id '{env_id}'.*{said}"):
        pad(OWN, 0.5, 0, env_id, kwargs)


def test_worlds_without_unsolvable_instances_are_named() -> None:
    train = sample("cartpole_uniform", 10, 5, 0)[0]
    with pytest.raises(ConfigError, match=r"env\.id 'space_dist/CartPole-v0' knows of no unsolvable instances"):
        pad(train, 0.5, 0, "space_dist/CartPole-v0", {})


def test_a_users_single_environment_may_say_it_too() -> None:
    assert pad(OWN, 0.75, 0, "tests.test_padding:Hopeless", {}).padding.sum() == 30


def test_a_padded_set_is_not_padded_again_and_no_test_set(tmp_path: Path) -> None:
    padded = pad(TRAIN, 0.5, 0, "space_dist/PointMass-v0", CLOSED)
    with pytest.raises(ConfigError, match="10 of 20 instances are padding, which no policy can solve"):
        pad(padded, 0.5, 0, "space_dist/PointMass-v0", CLOSED)
    files = {"train": padded, "test": sample("pointmass_uniform", 10, 5, 0)[1]}
    for name, instances in files.items():
        (tmp_path / f"{name}.csv").write_text(instances.to_csv())
    both = [f"instances.{name}={tmp_path / name}.csv" for name in files]
    config = configs.load(ROOT / "configs/sparse_pointmass_space.yaml", [*both, "env.kwargs.closed_gates=true"])
    assert Blueprint.of(config).instances() == (padded, files["test"])
    turned = config.model_copy(update={"instances": config.instances.model_copy(
        update={"train": config.instances.test, "test": config.instances.train})})  # fmt: skip
    with pytest.raises(ConfigError, match=r"instances\.test: .*train\.csv: 10 of 20 instances are padding"):
        Blueprint.of(turned).instances()
    without = configs.load(ROOT / "configs/sparse_pointmass_space.yaml", both)
    allowed = (
        "'gate_width': '0.0' is outside the bounds; allowed is a number in [0.5, 8.0], and from 0 in an "
        "environment made with closed_gates: true (env.kwargs)"
    )
    with pytest.raises(ConfigError, match=re.escape(allowed)):
        Blueprint.of(without).instances()
    (tmp_path / "beyond.csv").write_text("id,gate_x,gate_width,friction\n0,0,-1,0\n")
    with pytest.raises(ConfigError, match=r"'-1' is outside the bounds; allowed is a number in \[0\.5, 8\.0\]$"):
        read_csv(tmp_path / "beyond.csv", BOUNDS)


def test_ids_below_are_nobodys_padding() -> None:
    ids = np.array([0, PADDING_IDS - 1])
    ours = InstanceSet(ids, np.array([[0.0], [1.0]]), ("x",))
    assert not ours.padding.any()
    assert dataclasses.replace(ours, ids=ids + 1).padding.tolist() == [False, True]
    assert ContextBounds(("x",), np.array([0.0]), np.array([1.0])).names == ours.names


def test_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    source, out = ROOT / "configs/instances/maze_dfs_train.csv", tmp_path / "padded.csv"
    arguments = ["instances", "pad", source, "--share", "0.2", "--env", "space_dist/Maze-v0", "--out", out]
    assert command(monkeypatch, *arguments) == 0
    said = f"{out}: 125 instances, 25 of them padding that no policy can solve: a share of 0.2 (ids from {PADDING_IDS})"
    assert said in capsys.readouterr().out
    written = out.read_bytes()
    assert written.startswith(source.read_bytes())  # and then the padding
    assert command(monkeypatch, *arguments) == 2
    assert "padded.csv exists; choose another --out, or remove it" in capsys.readouterr().err
    out.unlink()
    assert command(monkeypatch, *arguments) == 0
    assert out.read_bytes() == written
    capsys.readouterr()
    test = ROOT / "configs/instances/maze_dfs_test.csv"
    assert command(monkeypatch, "instances", "check", out, test, "--env", "space_dist/Maze-v0") == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "25 of them padding that no policy can solve: a share of 0.2" in told
    assert command(monkeypatch, *arguments[:4], "0.2", "--env", "space_dist/AntGoal-v0", "--out", tmp_path / "b") == 2
    assert "Traceback" not in capsys.readouterr().err
