"""CARL's environments by config, against CARL itself. Skipped where carl-bench is not installed."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    carl_envs = pytest.importorskip("carl.envs")

from space_dist import cli
from space_dist.cli import runs
from space_dist.envs import BatchedEnv, make_batched
from space_dist.envs.checker import check
from space_dist.errors import ConfigError
from space_dist.ledger import Ledger
from space_dist.system.interrupts import StopRequests

CLASSIC = {
    "CARLCartPole": "length, gravity [5, 15]",
    "CARLPendulum": "l [0.5, 2], m [0.5, 2]",
    "CARLMountainCar": "gravity [0.001, 0.004], force [0.0005, 0.002]",
    "CARLMountainCarContinuous": "power [0.001, 0.003]",
    "CARLAcrobot": "LINK_LENGTH_1, LINK_MASS_1",
}


def make(name: str, n_slots: int = 1, **kwargs: Any) -> BatchedEnv:
    return make_batched(f"carl.envs:{name}", n_slots, context_visible=False, kwargs=kwargs)


@pytest.mark.parametrize("name", CLASSIC)
def test_a_batch_does_what_carl_does(name: str) -> None:
    env = make(name, 3, features=CLASSIC[name])
    bounds, random = env.context_bounds, np.random.default_rng(0)
    seeds = np.array([5, 6, 7], dtype=np.uint64)
    for _ in range(2):  # anew in the same environments, with other contexts
        contexts = random.uniform(bounds.low, bounds.high, size=(3, len(bounds.names)))
        env.action_space.seed(1)
        actions = np.array([[env.action_space.sample() for _ in range(3)] for _ in range(40)])
        started = env.reset(np.arange(3), contexts, seeds)
        steps = [env.step(row) for row in actions]
        for slot in range(3):
            named = dict(zip(bounds.names, contexts[slot].tolist(), strict=True))
            theirs = getattr(carl_envs, name)(contexts={0: named})
            observation, _ = theirs.reset(seed=int(seeds[slot]))
            np.testing.assert_array_equal(observation["obs"], started[slot])
            for time in range(40):
                action = actions[time, slot]
                observation, reward, terminated, _, _ = theirs.step(int(action) if action.ndim == 0 else action)
                np.testing.assert_array_equal(observation["obs"], steps[time].observations[slot])
                assert float(reward) == steps[time].rewards[slot]
                assert terminated == steps[time].terminated[slot]
                if terminated:
                    break


@pytest.mark.parametrize("name", CLASSIC)
def test_the_checker_finds_no_fault(name: str) -> None:
    assert check(f"carl.envs:{name}", {"features": CLASSIC[name]}).faults == []


def test_a_feature_of_carls_that_decides_nothing_is_noticed() -> None:
    """carl-bench 1.1.1 sets `masscart`, but not `total_mass`, which Gymnasium's CartPole computes from it once."""
    notes = check("carl.envs:CARLCartPole", {"features": "masscart, length"}).notes
    assert [note.split("'")[1] for note in notes if "changed nothing" in note] == ["masscart"]


@pytest.mark.parametrize(
    ("features", "said"),
    [
        ("", "must name the features of the context that vary, of: gravity, masscart"),
        ("lenght", "'lenght' is not known; did you mean 'length'?"),
        ("gravity", "CARL's bounds of 'gravity' are [0.1, inf]; give finite ones: `gravity [low, high]`"),
        ("length [0, 1]", "must lie within CARL's, [0.05, 5]"),
        ("length [1, 0.5]", "must lie within CARL's"),
        ("length [a, b]", "are not numbers"),
        ("length, length", "twice"),
        ("length; gravity", "is not `name` or `name [low, high]`"),
    ],
)
def test_mistakes_in_features_are_named(features: str, said: str) -> None:
    with pytest.raises(ConfigError) as error:
        make("CARLCartPole", features=features)
    assert said in str(error.value)


def test_a_run_by_config_only(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(runs, "STOP", StopRequests())
    features = CLASSIC["CARLCartPole"]
    Path("carl.yaml").write_text(f"""
name: carl
env: {{id: "carl.envs:CARLCartPole", kwargs: {{features: "{features}", horizon: 100}}}}
instances: {{train: uniform_train.csv, test: uniform_test.csv}}
curriculum: {{kind: space}}
learner: {{kind: ppo, n_steps: 512, n_epochs: 1}}
rollout: {{shards: 1, slots: 4}}
budget: {{steps: 1024}}
tracking: {{uri: null}}
resources: {{workers: 0}}
""")
    env = ["--env", "carl.envs:CARLCartPole", "--kwarg", f"features={features}", "--kwarg", "horizon=100"]
    for arguments in (
        ["instances", "sample", "uniform", *env, "--train", "6", "--test", "3", "--out", "."],
        ["train", "carl.yaml", "--out", "run"],
    ):
        monkeypatch.setattr(sys, "argv", ["space-dist", *arguments])
        with pytest.raises(SystemExit, match=r"^0$"):
            cli.main()
    assert Path("uniform_train.csv").read_text().splitlines()[0] == "id,length,gravity"
    last = [row for row in Ledger(Path("run")).rows() if row["kind"] == "evaluation"][-1]
    assert (last["steps"], len(last["test"]["returns"])) == (1024, 3)
