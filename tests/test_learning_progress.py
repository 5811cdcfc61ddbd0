"""Bidirectional learning progress: averages, reweighing and chances, worked out by hand."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from space_dist import config as configs
from space_dist.curricula import Draws, Feedback
from space_dist.curricula.learning_progress import LearningProgress, averaged, progress_chances, reweighed
from space_dist.errors import ConfigError
from tests.test_every_curriculum import set_up
from tests.test_rivals import SPACE, feedback, instances


def progress(n: int = 4, **changes: Any) -> LearningProgress:
    settings: dict[str, Any] = {
        "outcome": "success", "lowest": 0.0, "largest": 1.0, "smoothing": 0.5, "theta": 0.1, "uniform_share": 0.2,
    }  # fmt: skip
    return LearningProgress(instances(n), seed=0, draws=Draws(40, 2), **{**settings, **changes})


def told(version: int, indices: list[int], success: list[float], n: int = 4, returns: Any = 0.0) -> Feedback:
    whole = feedback(version, np.array(indices, dtype=np.int64), n=n, returns=returns)
    assert whole.episodes is not None
    return dataclasses.replace(whole, episodes=dataclasses.replace(whole.episodes, success=np.array(success)))


def test_rates_near_zero_are_magnified() -> None:
    # With theta 1/10, p becomes 9 p / (1 + 8 p): theta itself 1/2, and 1/2 is 9/10.
    rates = np.array([0.0, 0.01, 0.1, 0.5, 1.0])
    np.testing.assert_allclose(reweighed(rates, 0.1), [0.0, 0.09 / 1.08, 0.5, 0.9, 1.0])
    # With theta 1/2 nothing changes.
    np.testing.assert_allclose(reweighed(rates, 0.5), rates)


def test_averages_move_where_something_is_new_and_begin_with_it() -> None:
    found = averaged(
        np.array([0.5, 0.5, 0.0, 0.0]), np.array([1.0, 1.0, 1.0, 1.0]), now=np.array([True, False, True, False]),
        known=np.array([True, True, False, False]), smoothing=0.25,
    )  # fmt: skip
    assert found.tolist() == [0.625, 0.5, 1.0, 0.0]


def test_chances_by_hand() -> None:
    # Of the first three, progress 0, 0.1 and 0.5: mean 0.2, deviations -0.2, -0.1, 0.3, variance (4 + 1 + 9) / 300.
    values = np.array([0.0, 0.1, 0.5, 0.0, 0.0])
    fast, played = np.array([0.9, 0.2, 0.3, 0.0, 0.0]), np.array([True, True, True, True, False])
    deviation = math.sqrt(14 / 300)
    weights = [1 / (1 + math.exp(-z / deviation)) for z in (-0.2, -0.1, 0.3)]
    # The fourth has always failed; the fifth was never played and weighs one half.
    weights += [0.0, 0.5]
    expected = [0.2 / 5 + 0.8 * weight / sum(weights) for weight in weights]
    np.testing.assert_allclose(progress_chances(values, fast, played, 0.2), expected)
    # All alike: one half each, but for what has always failed.
    alike = progress_chances(np.zeros(5), fast, played, 0.0)
    np.testing.assert_allclose(alike, [0.25, 0.25, 0.25, 0.0, 0.25])
    # Nothing has ever succeeded, and all was played: there is nothing to go by.
    hopeless = progress_chances(np.zeros(5), np.zeros(5), np.ones(5, dtype=np.bool_), 0.0)
    assert hopeless.tolist() == [0.2] * 5


def test_three_iterations_by_hand() -> None:
    made = progress()
    state, selection = made.start()
    assert state.chances.tolist() == [0.25] * 4
    assert len(selection.ids) == 40
    # The first rates stand for both averages: instance 0 succeeds in one of two episodes, 1 in none.
    state, _, numbers = made.step(state, told(0, [0, 1, 0], [1.0, 0.0, 0.0]))
    assert (state.fast.tolist(), state.slow.tolist()) == ([0.5, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0])
    assert (state.played.tolist(), numbers["seen"], numbers["largest_progress"]) == ([True, True, False, False], 2, 0.0)
    # 1/2 for instance 0, whose progress is the mean one, none for 1, and 1/2 for each that was never played.
    np.testing.assert_allclose(state.chances, [0.05 + 0.8 / 3, 0.05, 0.05 + 0.8 / 3, 0.05 + 0.8 / 3])
    # Both 0 and 1 succeed. Fast: 3/4 and 1/2. Slow: 1/2 + (3/4 - 1/2) / 2 = 5/8, and 1/4.
    state, _, numbers = made.step(state, told(1, [0, 1], [1.0, 1.0]))
    assert state.fast.tolist() == [0.75, 0.5, 0.0, 0.0]
    assert state.slow.tolist() == [0.625, 0.25, 0.0, 0.0]
    # Reweighed: 27/28 and 9/10; 15/16 and 3/4. Progress: 3/112 and 3/20, of which z is -1 and 1.
    assert numbers["largest_progress"] == pytest.approx(3 / 20)
    assert numbers["mean_progress"] == pytest.approx((3 / 112 + 3 / 20) / 2)
    low, high = 1 / (1 + math.e), math.e / (1 + math.e)  # together 1, and one half twice
    np.testing.assert_allclose(state.chances, [0.05 + 0.4 * low, 0.05 + 0.4 * high, 0.25, 0.25])
    # Instance 1 fails again: forgetting is progress as well. 1/4, 1/4: there both averages meet, and progress is 0.
    state, _, _ = made.step(state, told(2, [1, 1], [0.0, 0.0]))
    assert (state.fast[1], state.slow[1]) == (0.25, 0.25)
    state, _, numbers = made.step(state, told(3, [1], [0.0]))
    assert (state.fast[1], state.slow[1]) == (0.125, 0.1875)
    # 9/16 against 27/40: less than before, and progress all the same.
    assert numbers["largest_progress"] == pytest.approx(27 / 40 - 9 / 16)
    # Where no episode ended nothing changes.
    same, _, numbers = made.step(state, told(4, [], []))
    assert same.fast.tolist() == state.fast.tolist()
    assert same.chances.tolist() == state.chances.tolist()


def test_returns_count_as_declared() -> None:
    made = progress(outcome="return", lowest=-10.0, largest=30.0)
    returns = [-20.0, 0.0, 10.0, 50.0]
    state, _, _ = made.step(made.start()[0], told(0, [0, 1, 2, 3], [math.nan] * 4, returns=returns))
    assert state.fast.tolist() == [0.0, 0.25, 0.5, 1.0]
    assert not made.wants.success
    assert progress().wants.success


def test_success_must_be_known_before_the_run_starts() -> None:
    silent = "env.id=tests.test_every_curriculum:make_silent"
    with pytest.raises(ConfigError, match="learning_progress needs to know whether an episode succeeded"):
        set_up("curriculum={kind: learning_progress}", silent)
    set_up("curriculum={kind: learning_progress, outcome: return, largest_return: 5}", silent)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ("outcome: return, lowest_return: 2, largest_return: 1", "lowest_return: 2 must be below largest_return: 1"),
        ("outcome: return", "outcome: return needs largest_return"),
        ("outcome: return, lowest_return: -1", "outcome: return needs largest_return"),
        (
            "outcome: returns",
            "curriculum.outcome: 'returns' is not known; did you mean 'return'? Allowed: success, return",
        ),
        ("theta: 1", "curriculum.theta"),
        ("smooting: 0.2", "did you mean 'smoothing'?"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings: str, words: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        configs.load(SPACE, [f"curriculum={{kind: learning_progress, {settings}}}"])
    assert words in str(refusal.value)
