"""Anyone's own environment, by import path: single ones made a batch of, and the example in the documentation."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit, TransformReward

from space_dist.cli import runs
from space_dist.envs import BatchedEnv, BatchedSingles, make_batched
from space_dist.envs.cartpole import BOUNDS as CARTPOLE_BOUNDS
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.instances import read_csv
from space_dist.ledger import Ledger
from space_dist.system.interrupts import StopRequests
from tests.commanding import command
from tests.faulty_env import HORIZON, Honest
from tests.own_code import blocks

PAGE = "your_environment.md"
HONEST = "tests.faulty_env:Honest"


def make(env_id: str, n_slots: int = 1, **kwargs: Any) -> BatchedEnv:
    return make_batched(env_id, n_slots, context_visible=False, kwargs=kwargs)


def test_slots_of_any_age_equal_the_single_environment() -> None:
    n = 5
    random = np.random.default_rng(0)
    env, single = make(HONEST, n), Honest()
    bounds = env.context_bounds
    assert (bounds.names, bounds.low.tolist(), bounds.high.tolist()) == (("gain", "drift"), [0.1, -0.5], [0.5, 0.5])
    contexts, seeds = random.uniform(bounds.low, bounds.high, size=(n, 2)), np.arange(n, dtype=np.uint64)
    started = env.reset(np.arange(n), contexts, seeds)
    told: list[list[Any]] = [[started[slot].tolist()] for slot in range(n)]
    done: list[list[int]] = [[] for _ in range(n)]
    compared = 0
    for time in range(4 * HORIZON):
        actions = random.integers(3, size=n)
        step = env.step(actions)
        restart = []
        for slot in range(n):
            done[slot].append(int(actions[slot]))
            told[slot] += [step.observations[slot].tolist(), step.rewards[slot],
                           bool(step.terminated[slot]), bool(step.truncated[slot])]  # fmt: skip
            ended = step.terminated[slot] or step.truncated[slot]
            if ended or time == 2 * slot + 1:  # some are reset on the way, so that ages differ
                context = {"context": contexts[slot].copy()}
                expected = [single.reset(seed=int(seeds[slot]), options=context)[0].tolist()]
                for action in done[slot]:
                    observation, reward, terminated, truncated, info = single.step(action)
                    expected += [observation.tolist(), reward, terminated, truncated]
                assert told[slot] == expected
                assert step.success is not None
                assert step.success[slot] == info["is_success"]
                compared += 1
                restart.append(slot)
        slots = np.array(restart, dtype=np.int64)
        if len(slots):
            contexts[slots] = random.uniform(bounds.low, bounds.high, size=(len(slots), 2))
            seeds[slots] += np.uint64(n)
            for slot, start in zip(restart, env.reset(slots, contexts[slots], seeds[slots]), strict=True):
                told[slot], done[slot] = [start.tolist()], []
    assert compared > 3 * n


class Timeless(Honest):
    """Knows no end and no success."""

    horizon = property()
    context_names = property()
    context_space = spaces.Box(np.float32(0.1), np.float32(0.7), shape=(1,), dtype=np.float32)

    def move(self, action: Any) -> float:
        assert self.context.dtype == np.float32
        return float(self.context[0] * (action - 1))

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, *_ = super().step(action)
        return observation, reward, False, False, {}


def test_an_environment_that_knows_no_end_gets_one() -> None:
    env = make(f"{__name__}:Timeless", 2, horizon=7)
    assert env.horizon == 7
    bounds = env.context_bounds
    assert (bounds.names, bounds.low.tolist(), bounds.high.tolist()) == (
        ("feature_0",),
        [0.1],
        [0.7],
    )  # not 0.10000000149
    env.reset(np.arange(2), np.array([[0.1], [0.7]]), np.zeros(2, dtype=np.uint64))
    for time in range(1, 8):
        if time == 4:
            env.reset(np.array([1]), np.array([[0.3]]), np.zeros(1, dtype=np.uint64))
        step = env.step(np.array([1, 1]))
        assert step.truncated.tolist() == [time == 7, False]
        assert not step.terminated.any()
        assert step.success is None
    with pytest.raises(ConfigError, match=r"length of its episodes is unknown.*env\.kwargs\.horizon"):
        make(f"{__name__}:Timeless")
    with pytest.raises(ConfigError, match="whole number of steps, at least 1, not '0'"):
        make(f"{__name__}:Timeless", horizon=0)


def limited() -> gym.Env[Any, Any]:
    env: gym.Env[Any, Any] = Timeless()
    for limit in (9, 6, 8):
        env = TimeLimit(env, limit)
    return TransformReward(env, abs)


def test_a_time_limit_is_a_horizon() -> None:
    env = make(f"{__name__}:limited", 2)
    assert env.horizon == 6  # of several the one that ends episodes
    env.reset(np.arange(2), np.array([[0.1], [0.7]]), np.zeros(2, dtype=np.uint64))
    ends = [env.step(np.array([1, 1])).truncated.tolist() for _ in range(6)]
    assert ends == [[False] * 2] * 5 + [[True] * 2]
    assert make(f"{__name__}:limited", 1, horizon=4).horizon == 4  # the config's word comes first


class Measured(Honest):
    """Its own arguments: `horizon` is one of them."""

    def __init__(self, horizon: int, scale: float = 1.0) -> None:
        super().__init__()
        self.horizon, self.scale = horizon, scale


def test_arguments_reach_the_function_that_has_them() -> None:
    env = make(f"{__name__}:Measured", 1, horizon=5, scale=2.0)
    assert isinstance(env, BatchedSingles)
    assert (env.horizon, env.first.get_wrapper_attr("scale")) == (5, 2.0)


def handed_on(**kwargs: Any) -> Any:
    return Measured(**kwargs)


class Wider(Measured):
    """Whose own argument stands beside those that it hands on."""

    def __init__(self, width: float = 1.0, **kwargs: Any) -> None:
        super().__init__(5, **kwargs)
        self.width = width


@pytest.mark.parametrize(
    ("env_id", "given", "told"),
    [
        (f"{__name__}:Measured", {"horizon": 5, "sclae": 2.0},
         "'sclae'; did you mean 'scale'? Its own are: horizon, scale"),
        (f"{__name__}:Measured", {"horizon": 5, "zzz": 2.0}, "'zzz'. Its own are: horizon, scale"),
        (HONEST, {"horizn": 5}, "'horizn'; did you mean 'horizon'? Its own are: render_mode, horizon"),
        (f"{__name__}:Wider", {"sclae": 2.0}, "'sclae'; did you mean 'scale'? Its own are: width, horizon, scale"),
        (f"{__name__}:handed_on", {"horizn": 5}, "'horizn'; did you mean 'horizon'?"),
        ("CartPole-v1", {"sutton_barto_rewrd": True}, "did you mean 'sutton_barto_reward'? Its own are: sutton_barto"),
        ("space_dist/PointMass-v0", {"closed_gate": True}, "did you mean 'closed_gates'? Its own are: "),
        ("space_dist/CartPole-v0", {"n_slot": 3}, "'n_slot'. Its own are: horizon, end_reward"),
    ],
)  # fmt: skip
def test_an_argument_that_is_not_known_is_told_the_nearest(env_id: str, given: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError, match=r"env\.kwargs: .* cannot be made with them: .*unexpected keyword") as refusal:
        make(env_id, 1, **given)
    assert told in str(refusal.value)


def several() -> Any:
    return gym.make_vec("CartPole-v1")


def test_an_id_registered_with_gymnasium_works_if_it_knows_contexts() -> None:
    gym.register("tests/Honest-v0", entry_point=HONEST, max_episode_steps=9)
    try:
        env = make("tests/Honest-v0", 2)
        assert env.horizon == HORIZON  # its own word comes first
        env.reset(np.arange(2), np.full((2, 2), 0.2), np.arange(2, dtype=np.uint64))
        for _ in range(9):
            step = env.step(np.array([0, 2]))
        assert step.truncated.all()  # Gymnasium's TimeLimit
    finally:
        gym.registry.pop("tests/Honest-v0")
    with pytest.raises(ConfigError, match=r"CartPole-v1.*no `context_space`"):
        make("CartPole-v1")
    with pytest.raises(ConfigError, match="vector environment"):
        make(f"{__name__}:several")


def test_half_a_step_of_a_whole_number_is_refused() -> None:
    env = make("tests.faulty_env:Whole")
    with pytest.raises(SpaceDistError, match="whole numbers"):
        env.reset(np.array([0]), np.array([[1.5]]), np.zeros(1, dtype=np.uint64))


# ---- the command line, and the example ----


def test_the_example_in_the_documentation_is_short_and_works(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (code,), (config,), (commands,) = (blocks(PAGE, language) for language in ("python", "yaml", "bash"))
    assert len(code.splitlines()) < 40
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(runs, "STOP", StopRequests())
    Path("my_lander.py").write_text(code)
    Path("my_lander.yaml").write_text(config)
    check, sample, train = (line.split("#")[0].split()[1:] for line in commands.splitlines())
    assert command(monkeypatch, *check) == 0
    assert "no fault found. Context: gravity, thrust. Horizon: 200 steps" in capsys.readouterr().out
    assert command(monkeypatch, *sample, "--train", "8", "--test", "4") == 0
    quick = ["budget.steps=2048", "resources.workers=0", "tracking.uri=null", "learner.n_epochs=1"]
    arguments = [*train, "--out", "run", *(part for setting in quick for part in ("--set", setting))]
    assert command(monkeypatch, *arguments) == 0, capsys.readouterr().err
    last = [row for row in Ledger(Path("run")).rows() if row["kind"] == "evaluation"][-1]
    assert last["steps"] == 2048
    assert 0.0 <= last["test"]["success"] <= 1.0
    assert command(monkeypatch, "evaluate", "run", "--instances", "instances/uniform_test.csv") == 0


def test_instances_are_sampled_within_any_environments_bounds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    counts = ["--train", "4", "--test", "3"]
    for env, where in (("space_dist/CartPole-v0", "a"), ("space_dist/Maze-v0", "b")):
        assert (
            command(monkeypatch, "instances", "sample", "uniform", "--env", env, *counts, "--out", tmp_path / where)
            == 0
        )
    poles = read_csv(tmp_path / "a" / "uniform_train.csv", CARTPOLE_BOUNDS)
    assert len(poles) == 4
    mazes = [tmp_path / "b" / f"uniform_{part}.csv" for part in ("train", "test")]
    assert command(monkeypatch, "instances", "check", *mazes, "--env", "space_dist/Maze-v0") == 0
    whole = ["--env", "tests.faulty_env:Whole", "--train", "2", "--test", "2", "--out", tmp_path / "c"]
    assert command(monkeypatch, "instances", "sample", "uniform", *whole) == 0
    drawn = (tmp_path / "c" / "uniform_train.csv").read_text() + (tmp_path / "c" / "uniform_test.csv").read_text()
    assert sorted(re.findall(r"^\d,(\d)\.0$", drawn, flags=re.MULTILINE)) == ["1", "2", "3", "4"]
    capsys.readouterr()
    assert command(monkeypatch, "instances", "sample", "uniform", "--out", tmp_path) == 2
    assert "needs --env" in capsys.readouterr().err
