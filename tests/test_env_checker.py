"""Every fault is found, and said in the right words; what is without fault passes."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from space_dist.envs import BATCHED, make_batched
from space_dist.envs.checker import COMPARED_STEPS, check
from space_dist.errors import ConfigError
from space_dist.instances import InstanceSet
from tests.commanding import command
from tests.faulty_env import Honest

FAULTS = {
    "IgnoresContexts": "contexts are ignored: another context changes nothing",
    "UnseededStart": "the start state is not seeded",
    "UnseededStep": "unseeded randomness in step(): with the same seed, context and actions, two episodes differ from "
    "step 1 on",
    "Remembers": "depends on earlier episodes: played again after others, .* it differs from step 1 on",
    "KeepsFirstContext": "a context does not arrive: only that of the very first reset counts",
    "Forgets": "the context does not survive: after a reset without options",
    "NeedsOne": "before any context was given (there must be a default one) fails: AssertionError",
    "SharesItsState": "depends on the neighbours in the batch",
    "UsesGlobalGenerator": "depends on the neighbours in the batch",
    "WrongShape": "spaces are wrong: the observation at reset has shape (2,), its space says (1,)",
    "WrongDtype": "spaces are wrong: the observation at reset is of dtype float64, its space says float32",
    "NoArray": "the observation at reset is a list, not an array",
    "Outside": "spaces are wrong: the observation at step 5 holds 2 at [0], outside its space's bounds [-1, 1]",
    "NaNs": "the observation at step 4 holds NaN",
    "InfiniteReward": "a reward at step 1 is inf",
    "TellsNowAndThen": "at the end of some episodes and not of others",
    "NoOptions": "NoOptions.reset() takes no `options`; as in Gymnasium it must be reset(self, *, seed=None, "
    "options=None), and contexts come as",
    "NoInfo": "reset() must return (observation, info)",
    "OldStep": "step() must return (observation, reward, terminated, truncated, info)",
    "FailsAtTheEdge": "reset() with the context gain .* fails: KeyError: 'no such gain'",
    "Exits": "step() fails: SystemExit",
    "EndsInArrays": "step() must return terminated and truncated as a truth value each",
    "FromOne": "actions must be a one-dimensional Box or Discrete from 0, not Discrete(3, start=1)",
    "TwoChoices": "actions must be a one-dimensional Box or Discrete from 0, not MultiDiscrete",
    "FailsInStep": "step() fails: ZeroDivisionError",
    "ChangesActions": "step() changes the action it is given",
    "NumberObserved": "its observation_space must be a Box or a Dict of Boxes, not Discrete(5)",
    "OnePartOnly": "the observation at reset has the parts place, its space has clock, place",
    "EditsUnseeded": "edit_contexts() is not a function of its arguments",
    "EditsTooFar": "edit_contexts gave a context with drift = .* not within [-0.5, 0.5]",
    "EditsToTheUnplayable": "reset() with the context .* fails: KeyError: 'no such drift'",
    "NoContextSpace": "has no `context_space`",
    "EndlessBounds": "its context_space cannot be used: feature 'gain' has bounds [-inf, inf]",
    "NamesTwice": "the feature 'gain' is named twice",
    "OneName": "its context_names must be a tuple of 2 names, one for each number of its context_space, not",
    "Word": "its context_names must be a tuple of 2 names",
    "NoLength": "the length of its episodes is unknown",
    "the_same_one": "returned the same environment twice",
    "make": "called with a number of slots and returned one gymnasium.Env",
}
BATCHED_FAULTS = {
    "Endless": "episodes do not end: after its horizon of 8 steps",
    "Neighbourly": "depends on the neighbours in the batch",
    "SlotMatters": "depends on the neighbours in the batch",
    "ChangesContexts": "reset() changes the contexts it is given",
    "ChangesBatchedActions": "step() changes the actions it is given",
    "OneReward": "rewards at step 1 have shape (1,), not one number for each slot",
    "NumbersForEnds": "terminated at step 1 is of dtype float64, not bool",
    "Counts": "unseeded randomness in step()",
}


def said(fault: str, words: str) -> bool:
    """Whether all parts of `words`, which ` .* ` separates, stand in `fault` in this order."""
    at = 0
    for part in words.split(" .* "):
        at = fault.find(part, at)
        if at < 0:
            return False
    return True


@pytest.mark.parametrize("kind", FAULTS)
def test_a_single_environments_fault_is_named(kind: str) -> None:
    (fault,) = check(f"tests.faulty_env:{kind}").faults
    assert said(fault, FAULTS[kind]), fault


@pytest.mark.parametrize("kind", BATCHED_FAULTS)
def test_a_batched_environments_fault_is_named(kind: str) -> None:
    (fault,) = check("tests.faulty_env:batched", {"kind": kind}).faults
    assert said(fault, BATCHED_FAULTS[kind]), fault


@pytest.mark.parametrize("kind", ["Honest", "Whole", "Parts", "HalfUsed", "Edits", "EditsNothing"])
def test_without_fault(kind: str) -> None:
    findings = check(f"tests.faulty_env:{kind}")
    assert findings.faults == []
    assert findings.horizon == 12
    notes = [note for note in findings.notes if "'drift'" in note]
    assert len(notes) == (kind == "HalfUsed")
    assert any("edit_contexts() changed nothing" in note for note in findings.notes) == (kind == "EditsNothing")


@pytest.mark.parametrize("env_id", BATCHED)
def test_our_own_environments_pass(env_id: str) -> None:
    assert check(env_id).faults == []


@pytest.mark.parametrize("make", ["make", "make_discrete", "make_image", "make_dict", "make_scaled"])
def test_the_tests_own_environments_pass(make: str) -> None:
    assert check(f"tests.tiny_env:{make}").faults == []


class Long(Honest):
    """It never ends by itself."""

    observation_space: Any = spaces.Box(-300.0, 300.0, shape=(1,), dtype=np.float32)

    def __init__(self, horizon: int) -> None:
        super().__init__()
        self.horizon = horizon

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, *_, info = super().step(action)
        return observation, reward, False, False, info


@pytest.mark.parametrize("horizon", [2, COMPARED_STEPS - 1, COMPARED_STEPS, COMPARED_STEPS + 1])
def test_no_horizon_is_too_long_for_it(horizon: int) -> None:
    findings = check(f"{__name__}:Long", {"horizon": horizon})
    assert (findings.faults, findings.horizon) == ([], horizon)


def test_a_horizon_that_is_never_reached_may_be_any_number() -> None:
    assert check("tests.faulty_env:AnyHorizon").faults == []


class OverAtTheEnd(Long):
    def observe(self) -> Any:
        return np.array([np.nan if self.time == self.horizon else self.x], dtype=np.float32)


def test_the_last_observation_is_looked_at() -> None:
    (fault,) = check(f"{__name__}:OverAtTheEnd", {"horizon": COMPARED_STEPS}).faults
    assert fault == f"the observation at step {COMPARED_STEPS} holds NaN"


class Rounded(Honest):
    def __init__(self) -> None:
        super().__init__()
        self.observation_space = spaces.Box(np.array([-10.1]), np.array([10.1]), dtype=np.float32)
        warnings.warn("it is wet", stacklevel=1)


def test_rounded_bounds_are_told_once() -> None:
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        findings = check(f"{__name__}:Rounded")
    assert findings.faults == []
    assert len([note for note in findings.notes if "rounded to its float32" in note]) == 1
    assert [str(one.message) for one in warned] == ["it is wet"]  # what else it says is said, and once, too


def test_contexts_can_be_given() -> None:
    bounds = make_batched("tests.faulty_env:FailsAtTheEdge", 1, context_visible=False).context_bounds
    inside = InstanceSet(np.arange(2), np.array([[0.2, 0.1], [0.3, 0.0]]), bounds.names)
    faults = check("tests.faulty_env:FailsAtTheEdge", instances=inside).faults
    assert faults == []
    with pytest.raises(ConfigError, match="at least two"):
        check("tests.faulty_env:Honest", instances=inside.subset([0]))


def test_the_command_says_it_and_exits_with_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert command(monkeypatch, "env", "check", "tests.faulty_env:IgnoresContexts") == 2
    assert "tests.faulty_env:IgnoresContexts: contexts are ignored" in capsys.readouterr().err
    assert command(monkeypatch, "env", "check", "CartPole-v1") == 2
    error = capsys.readouterr().err
    assert error.count("CartPole-v1") == 1
    assert "has no `context_space`" in error
    assert command(monkeypatch, "env", "check", "tests.faulty_env:HalfUsed") == 0
    out = capsys.readouterr().out
    assert "note: changing 'drift' alone" in out
    assert "no fault found. Context: gain, drift. Horizon: 12 steps" in out
    assert command(monkeypatch, "env", "check", "tests.faulty_env:batched", "--kwarg", "kind=Endless") == 2
    assert "do not end" in capsys.readouterr().err
    assert command(monkeypatch, "env", "check", "tests.faulty_env:batched", "--kwarg", "kind") == 2
    assert "is not NAME=VALUE" in capsys.readouterr().err
    file = tmp_path / "contexts.csv"
    file.write_text("id,gain,drift\n0,0.2,0\n1,0.3,0.1\n")
    assert command(monkeypatch, "env", "check", "tests.faulty_env:FailsAtTheEdge", "--instances", str(file)) == 0
