"""What is known of an environment without having one, and that whatever is made is closed."""

from __future__ import annotations

import logging
import pickle
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray
from typer.testing import CliRunner

from space_dist import config as configs
from space_dist.cli import app
from space_dist.config import to_yaml
from space_dist.envs import BatchedSingles, close, make_batched
from space_dist.envs.interface import Closable, FloatArray, IntArray, Observations, Step
from space_dist.envs.spec import read_spec
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.grid.planning import plan
from space_dist.run import cluster
from space_dist.run.building import spec_of
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests
from tests.faulty_env import Honest
from tests.grids import SMALL, write_grid, write_line_instances
from tests.patience import PATIENCE
from tests.test_learners import RESULTS, config_for, interrupted, learner_section, run
from tests.test_population import configured, together
from tests.tiny_env import Line

ROOT = Path(__file__).resolve().parent.parent

POINTMASS, BULLET, SINGLE = "space_dist/PointMass-v0", "space_dist/BallCatching-v0", "tests.faulty_env:Honest"
COUNTED = "tests.test_environment_spec:make_counted"


class Counted(Line):
    """The line, which notes how many slots each of its copies has, and which of them are open."""

    made: ClassVar[list[int]] = []
    opened: ClassVar[set[int]] = set()
    fails: ClassVar[str] = ""  # at what

    def __init__(self, n_slots: int) -> None:
        super().__init__(n_slots, spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32))
        self.number = len(self.made)
        self.made.append(n_slots)
        self.opened.add(self.number)

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> Observations:
        assert self.number in self.opened, "used after it was closed"
        return super().reset(slots, contexts, seeds)

    def step(self, actions: Any) -> Step:
        assert self.number in self.opened, "used after it was closed"
        if self.fails == "step":
            raise RuntimeError("the test's fault")
        return super().step(actions)

    def close(self) -> None:
        self.opened.discard(self.number)
        if self.fails == "close":
            raise OSError("the test's fault")


def make_counted(n_slots: int) -> Counted:
    return Counted(n_slots)


@pytest.fixture(autouse=True)
def _none_made() -> Iterator[None]:
    Counted.made.clear()
    Counted.opened.clear()
    Counted.fails = ""
    yield
    Counted.fails = ""


# ---- facts ----


@pytest.mark.parametrize("visible", [True, False])
@pytest.mark.parametrize("env_id", [POINTMASS, BULLET, SINGLE, "tests.tiny_env:make_image", "tests.tiny_env:make_dict"])
def test_a_spec_has_the_facts_of_an_environment(env_id: str, visible: bool) -> None:
    spec, env = read_spec(env_id, context_visible=visible), make_batched(env_id, 1, context_visible=visible)
    for name in ("horizon", "observation_space", "action_space", "context_bounds"):
        assert getattr(spec, name) == getattr(env, name), name
    assert (spec.env_id, spec.context_visible, spec.kwargs) == (env_id, visible, {})
    with spec.opened(3) as opened:
        assert opened.n_slots == 3
        assert opened.observation_space == spec.observation_space
    again = pickle.loads(pickle.dumps(spec))  # noqa: S301 - our own bytes
    assert (again, again.observation_space) == (spec, spec.observation_space)
    if isinstance(spec.observation_space, spaces.Dict):  # the order of a network's inputs
        assert list(again.observation_space) == list(env.observation_space)  # type: ignore[call-overload]


def test_kwargs_are_part_of_it() -> None:
    spec = read_spec(POINTMASS, context_visible=True, kwargs={"horizon": 7})
    assert (spec.horizon, spec.kwargs, spec.make(2).horizon) == (7, {"horizon": 7}, 7)
    with pytest.raises(ConfigError, match=r"env\.kwargs: "):
        read_spec(POINTMASS, context_visible=True, kwargs={"horizn": 7})


class OwnBox(spaces.Box):
    """A space of a user's own class."""


class OwnDiscrete(spaces.Discrete):
    """Likewise."""


class OwnSpaces(Honest):
    observation_space = spaces.Dict(
        [("z", OwnBox(-10.0, 10.0, shape=(1,), dtype=np.float32)), ("a", spaces.Box(0, 255, (2, 2), np.uint8))]
    )
    action_space = OwnDiscrete(3, start=-1)


def test_spaces_of_a_users_own_classes_can_be_unpickled_by_who_has_them_not() -> None:
    spec = read_spec("tests.test_environment_spec:OwnSpaces", context_visible=False)
    assert list(spec.observation_space.items()) == [  # type: ignore[attr-defined]
        ("z", spaces.Box(-10.0, 10.0, shape=(1,), dtype=np.float32)), ("a", spaces.Box(0, 255, (2, 2), np.uint8))
    ]  # fmt: skip
    assert spec.action_space == spaces.Discrete(3, start=-1)
    program = "import pickle, sys; print(pickle.load(sys.stdin.buffer).horizon)"
    done = subprocess.run([sys.executable, "-P", "-c", program], input=pickle.dumps(spec), capture_output=True,
                          timeout=PATIENCE, cwd="/")  # fmt: skip
    assert done.stdout == f"{spec.horizon}\n".encode(), done.stderr


def test_success_is_asked_for_and_not_looked_up() -> None:
    told = read_spec(COUNTED, context_visible=True)
    assert Counted.made == [1]
    assert told.knows_success(np.array([[0.5]]))
    assert Counted.made == [1, 1]
    assert not Counted.opened
    assert not read_spec("tests.test_rollout:Countdown", context_visible=True).knows_success(np.array([[4.0]]))


def test_starts_are_compared_within_one_environment() -> None:
    contexts = np.linspace(-1.0, 1.0, 5)[:, None]
    for visible in (True, False):
        spec = read_spec(COUNTED, context_visible=visible)
        assert spec.starts_alike(contexts) is not visible
        assert not spec.starts_alike(contexts[:1])
    assert Counter(Counted.made) == {1: 4, 5: 2}
    assert not Counted.opened


def test_what_an_environment_raises_when_it_is_asked_is_a_sentence_and_it_is_closed() -> None:
    spec = read_spec(COUNTED, context_visible=True)
    Counted.fails = "step"
    with pytest.raises(
        ConfigError, match=rf"env\.id '{COUNTED}': reset or a first step failed: RuntimeError: the test"
    ):
        spec.knows_success(np.array([[0.5]]))
    assert (Counted.made, Counted.opened) == ([1, 1], set())


# ---- closing ----


class Closing(Honest):
    closed: ClassVar[list[int]] = []

    def close(self) -> None:
        self.closed.append(id(self))
        super().close()


def test_every_slot_of_a_batch_of_singles_is_closed_and_made_anew() -> None:
    Closing.closed.clear()
    env = make_batched("tests.test_environment_spec:Closing", 3, context_visible=True)
    assert isinstance(env, Closable)
    contexts, seeds = np.full((3, 2), 0.25), np.arange(3, dtype=np.uint64)
    first = env.reset(np.arange(3), contexts, seeds)
    close(env)
    assert len(set(Closing.closed)) == 3
    close(env)
    assert len(Closing.closed) == 3
    assert np.array_equal(env.reset(np.arange(3), contexts, seeds), first)
    env.step(np.zeros(3, dtype=np.int64))
    close(env)
    assert len(Closing.closed) == 6


def test_all_are_closed_whatever_one_of_them_raises(caplog: pytest.LogCaptureFixture) -> None:
    left: list[gym.Env[Any, Any]] = []

    class Broken(Honest):
        def close(self) -> None:
            left.remove(self)
            raise SystemExit("the test's fault")

    def another() -> gym.Env[Any, Any]:
        left.append(Broken())
        return left[-1]

    env = BatchedSingles(3, another)
    env.reset(np.arange(3), np.full((3, 2), 0.25), np.arange(3, dtype=np.uint64))
    assert len(left) == 3
    with caplog.at_level(logging.WARNING, "space_dist"):
        close(env)
    assert (left, caplog.messages) == ([], ["an environment cannot be closed: SystemExit: the test's fault"])


def test_physics_clients_are_disconnected_behind_the_visible_context() -> None:
    import pybullet

    env = make_batched(BULLET, 2, context_visible=True)
    contexts = np.repeat(((env.context_bounds.low + env.context_bounds.high) / 2.0)[None], 2, axis=0)
    env.reset(np.arange(2), contexts, np.arange(2, dtype=np.uint64))
    env.step(np.zeros((2, *(env.action_space.shape or ())), dtype=np.float32))
    clients = [world.client for world in env.unwrapped._worlds.values()]  # type: ignore[attr-defined]
    assert [pybullet.isConnected(client) for client in clients] == [1, 1]
    close(env)
    assert [pybullet.isConnected(client) for client in clients] == [0, 0]


# ---- whole runs ----

# How many slots, and how often, beside those of every run: one to look at; 4 for the starts of all instances; 12 and 6
# for a part of an evaluation. All shards of 5 slots are collected together.
RUNS: dict[str, tuple[dict[str, Any], dict[int, int]]] = {
    "round_robin": ({"curriculum": {"kind": "round_robin"}}, {10: 1}),
    "space": ({"curriculum": {"kind": "space"}}, {10: 1, 4: 1}),  # are starts alike?
    "vds": ({"curriculum": {"kind": "vds"}}, {10: 1, 4: 1}),
    "spdrl": ({"curriculum": {"kind": "spdrl"}}, {10: 1, 4: 1, 5: 1}),  # contexts that are no instances' are scored
    "learnability": (  # is success known? And three candidates are probed, by turns
        {"curriculum": {"kind": "learnability", "top": 2, "every": 1, "candidates": 3, "episodes": 2},
         "budget": {"steps": 400}}, {10: 1, 1: 1, 3: 1},
    ),
    "several": (
        {"curriculum": {"kind": "space", "aggregate": "population", "policies": 2}, "engine": "population",
         "budget": {"steps": 480}}, {20: 1, 4: 1},
    ),
    "overlap": (
        {"curriculum": {"kind": "round_robin"}, "rollout": {"shards": 2, "slots": 5, "overlap": True}}, {10: 1},
    ),
}  # fmt: skip


def counted(folder: Path, **sections: Any) -> Any:
    usual = {
        "engine": "single",
        "rollout": {"shards": 2, "slots": 5},
        "evaluation": {"every_steps": 100, "episodes": 6},
    }
    return config_for(folder, learner_section("ppo"), COUNTED, **{**usual, **sections})


@pytest.mark.parametrize("name", RUNS)
def test_a_run_looks_at_its_environment_once_and_closes_all_that_it_makes(name: str, tmp_path: Path) -> None:
    sections, more = RUNS[name]
    launch(counted(tmp_path, **sections), tmp_path / "run", resume=False, stop=StopRequests())
    assert not Counted.opened
    assert Counter(Counted.made) == Counter({1: 1, 4: 1, 12: 1, 6: 1}) + Counter(more)


def test_a_resumed_run_and_a_failed_one_close_theirs(tmp_path: Path) -> None:
    config = counted(tmp_path)
    expected = run(config, tmp_path / "reference")
    interrupted(config, tmp_path / "run", 3)
    assert not Counted.opened
    assert run(config, tmp_path / "run") == expected
    assert not Counted.opened
    Counted.fails = "step"
    with pytest.raises(SpaceDistError, match="the test's fault"):
        launch(config, tmp_path / "failed", resume=False, stop=StopRequests())
    assert not Counted.opened
    assert Counter(Counted.made)[1] == 4  # runs


def test_an_environment_that_cannot_be_closed_changes_no_result(tmp_path: Path) -> None:
    config = counted(tmp_path)
    expected = run(config, tmp_path / "reference")
    Counted.fails = "close"
    assert run(config, tmp_path / "run") == expected
    log = (tmp_path / "run" / "log.txt").read_text()
    assert "an environment cannot be closed: OSError: the test's fault" in log


def test_members_of_a_population_close_theirs(tmp_path: Path) -> None:
    configs = [configured(tmp_path / str(number), number, env={"id": COUNTED}) for number in range(3)]
    folders = [tmp_path / f"run{number}" for number in range(3)]
    ends = together(configs, folders)
    assert not any(isinstance(end, SpaceDistError) for end in ends.values())
    assert not Counted.opened
    assert Counter(Counted.made)[1] == 3  # one for each member to look at
    results = [[(folder / name).read_bytes() for name in RESULTS] for folder in folders]
    Counted.fails = "step"
    others = [tmp_path / f"failed{number}" for number in range(3)]
    assert all(isinstance(end, SpaceDistError) for end in together(configs, others).values())
    assert not Counted.opened
    assert len(results) == 3


def test_commands_about_runs_and_environments_close_theirs(tmp_path: Path) -> None:
    config = counted(tmp_path)
    run(config, tmp_path / "run")
    path, test = tmp_path / "config.yaml", str(tmp_path / "test.csv")
    path.write_text(to_yaml(config.model_dump(mode="json")))
    for arguments, looked in (
        (["evaluate", str(tmp_path / "run"), "--instances", test], 1),
        (["explain", str(tmp_path / "run"), "--iteration", "1"], 1),
        (["config", "check", str(path)], 1),
        (["instances", "check", test, "--env", COUNTED], 1),
        (["instances", "sample", "uniform", "--env", COUNTED, "--out", str(tmp_path / "drawn")], 1),
        (["env", "check", COUNTED], None),
    ):
        Counted.made.clear()
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, (arguments, result.output, result.exception)
        assert not Counted.opened, arguments
        assert looked in (None, Counted.made.count(1)), arguments


def test_a_grid_is_planned_with_one_look_at_each_environment(tmp_path: Path) -> None:
    sections = {"env": {"id": COUNTED}, "curriculum": {"kind": "round_robin"}}
    axes = {"learner.gamma": [0.8, 0.9, 0.95], "env.context_visible": [True, False]}
    settings = {**SMALL, **sections, **write_line_instances(tmp_path)}
    made = plan(write_grid(tmp_path, set=settings, grid=axes), tmp_path / "runs")
    assert len(made.manifest.cells) == 6
    assert (Counted.made, Counted.opened) == ([1, 1], set())


def test_slots_that_are_stepped_one_by_one_are_few_and_have_equal_turns() -> None:
    together, one_by_one = (
        spec_of(configs.load(ROOT / f"configs/{name}_space.yaml")) for name in ("pointmass", "antgoal")
    )
    assert [together.slots_for(episodes) for episodes in (0, 1, 50, 2000)] == [0, 1, 50, 2000]
    assert [one_by_one.slots_for(episodes) for episodes in (0, 1, 16, 17, 50, 2000)] == [0, 1, 16, 9, 13, 16]


def test_actors_are_started_where_slots_are_stepped_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "cores", lambda: 4)
    together, one_by_one = (
        configs.load(ROOT / "configs/pointmass_space.yaml"),
        configs.load(ROOT / "configs/antgoal_space.yaml"),
    )
    assert cluster.n_workers(together, spec_of(together)) == 0
    spec = spec_of(one_by_one)
    assert cluster.n_workers(one_by_one, spec) == 4
    short = configs.load(ROOT / "configs/antgoal_space.yaml", ["budget.steps=99999"])
    assert cluster.n_workers(short, spec) == 0
    monkeypatch.setattr(cluster, "cores", lambda: 1)
    assert cluster.n_workers(one_by_one, spec) == 0
    told = configs.load(ROOT / "configs/antgoal_space.yaml", ["resources.workers=0"])
    assert cluster.n_workers(told, spec) == 0
    joined = configs.load(ROOT / "configs/pointmass_space.yaml", ["resources.address=auto"])
    assert cluster.n_workers(joined, spec_of(joined)) == 4
