"""CURROT: what it remembers, expects and moves, worked out by hand; and that particles wait for the policy."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from space_dist import config as configs
from space_dist.curricula import Draws
from space_dist.curricula.currot import (
    TRIED,
    Estimate,
    Transport,
    TransportState,
    assigned,
    balls,
    proposals,
    remembered,
    restarted,
    transported,
)
from space_dist.curricula.gaussian import Gaussian
from space_dist.errors import ConfigError
from tests.test_every_curriculum import wide
from tests.test_rivals import SPACE, feedback, instances, made
from tests.two_features import BOUNDS


def column(*values: float) -> np.ndarray:
    return np.array(values)[:, None]


def memory(kept: np.ndarray, performance: list[float], *, reached: bool, lowest: float | None = 0.0) -> TransportState:
    nothing = np.zeros((0, kept.shape[1]))
    return TransportState(0, nothing, kept, np.array(performance), nothing, np.zeros(0), reached, lowest)


STEP = Estimate(column(0.0, 1.0), np.array([10.0, 0.0]), 0.05)
"""10 below one half, 0 above."""


def test_what_is_expected_is_a_mean_by_distance() -> None:
    estimate = Estimate(column(0.0, 0.5), np.array([0.0, 10.0]), 0.25)
    # A distance of two standard deviations: exp(-2).
    far = math.exp(-2.0)
    found = estimate(column(0.25, 0.0, 0.5, 50.0))
    np.testing.assert_allclose(found, [5.0, 10.0 * far / (1.0 + far), 10.0 / (1.0 + far), 10.0])


def test_each_goal_gets_a_point_of_its_own() -> None:
    # 0.5 is the nearest to 0.45 and to 0.4, and the sum is least where 0.4 takes 0.3.
    assert assigned(column(0.45, 0.1, 0.4), column(0.9, 0.3, 0.5, 0.0)).tolist() == [2, 3, 1]


def test_what_is_remembered_by_hand() -> None:
    targets = column(0.25, 0.42, 0.52, 0.95)

    def after(state: TransportState, contexts: np.ndarray, performance: list[float]) -> TransportState:
        return remembered(state, contexts, np.array(performance), targets, 5.0, 4)

    # Below delta the best are kept: of 1, 6 and 3 all.
    state = after(memory(np.zeros((0, 1)), [], reached=False, lowest=None), column(0.1, 0.2, 0.3), [1.0, 6.0, 3.0])
    assert (state.kept_performance.tolist(), state.reached, state.lowest) == ([1.0, 3.0, 6.0], False, 1.0)
    # Of five the best four, whose median is 6.
    state = after(state, column(0.4, 0.5), [7.0, 6.0])
    assert (state.kept.ravel().tolist(), state.reached) == ([0.3, 0.2, 0.5, 0.4], True)
    # From now on what reaches delta takes the place of what does not, and the rest is remembered apart.
    state = after(state, column(0.6, 0.7), [8.0, 2.0])
    assert state.kept.ravel().tolist() == [0.2, 0.5, 0.4, 0.6]
    assert state.kept_performance.tolist() == [6.0, 6.0, 7.0, 8.0]
    assert (state.others.tolist(), state.others_performance.tolist()) == ([[0.7]], [2.0])
    # All reach delta: of 0.2, 0.4, 0.5, 0.6 and 0.9 the target takes all but 0.6.
    state = after(state, column(0.9), [9.0])
    assert sorted(state.kept.ravel().tolist()) == [0.2, 0.4, 0.5, 0.9]
    state = after(state, column(0.61), [9.0])
    assert sorted(state.kept.ravel().tolist()) == [0.2, 0.4, 0.5, 0.9]
    assert (state.others.ravel().tolist(), state.others_performance.tolist()) == ([0.7, 0.61], [2.0, 9.0])
    # The last four others stay.
    state = after(state, column(0.71, 0.72, 0.73), [0.0, 1.0, 2.0])
    assert state.others.ravel().tolist() == [0.61, 0.71, 0.72, 0.73]
    assert state.lowest == 1.0


def test_proposals_are_the_farther_from_what_is_kept_the_more_that_lacks() -> None:
    asked: list[Any] = []

    def choice(places: np.ndarray, size: int, p: np.ndarray) -> np.ndarray:
        asked.append((places.tolist(), size, p.tolist()))
        return np.array([1, 3])

    chance: Any = SimpleNamespace(choice=choice, standard_normal=np.ones, integers=lambda _, size: np.zeros(size, int))
    kept = memory(column(0.1, 0.5, 0.2, 0.6), [0.0, 3.0, 1.0, 4.0], reached=False)
    found = proposals(kept, chance, 10.0, 0.01, 2)
    # The better half are 3 and 4; the best of the other is 1: 2 and 3 parts of 5.
    assert asked == [([1, 3], 2, [pytest.approx(0.4), pytest.approx(0.6)])]
    # They lack 0.7 and 0.6 of what lay between the worst and delta, a quarter of which is their spread.
    np.testing.assert_allclose(found, column(0.5 + 0.01 + 0.175, 0.6 + 0.01 + 0.15))
    # What would lie outside is reflected: 0.95 + 0.16 is 1.11.
    kept = dataclasses.replace(kept, kept=column(0.1, 0.95, 0.2, 0.6))
    assert proposals(kept, chance, 10.0, -0.015, 2)[0, 0] == pytest.approx(0.89)
    # Once delta is reached: each of those kept, and others again; 8 lacks 0.2, and the others nothing.
    kept = memory(column(0.1, 0.5), [8.0, 11.0], reached=True)
    np.testing.assert_allclose(proposals(kept, chance, 10.0, 0.01, 3), column(0.16, 0.51, 0.16))


def test_particles_of_which_too_little_is_expected_begin_elsewhere() -> None:
    begun, reach = restarted(column(0.9, 0.2), column(0.05, 0.4, 0.6), STEP, 5.0)
    assert (begun.ravel().tolist(), reach.tolist()) == ([0.4, 0.2], [True, True])  # 0.6 is nearer, and fails as well
    begun, reach = restarted(column(0.9, 0.2, 0.8), column(0.7, 0.4), STEP, 5.0)
    assert begun.ravel().tolist() == [0.7, 0.2, 0.4]
    assert reach.tolist() == [False, True, True]
    assert restarted(column(0.1), column(0.2), STEP, 5.0)[0].tolist() == [[0.1]]


def test_where_nothing_binds_a_particle_takes_the_straight_step() -> None:
    """The exact solution: of all points within epsilon that is the nearest to the goal."""
    particles = np.array([[0.1, 0.1], [0.9, 0.9], [0.5, 0.5]])
    targets = np.array([[0.9, 0.8], [0.53, 0.54], [0.1, 0.4]])
    steps = balls(np.random.default_rng(0), particles.shape)
    assert steps.shape == (3, TRIED, 2)
    lengths = np.sqrt((steps**2).sum(axis=2))
    assert lengths.max() <= 1.0
    assert (lengths < math.sqrt(0.5)).mean() == pytest.approx(0.5, abs=0.1)  # half of the disc's area
    all_reach = Estimate(np.array([[0.5, 0.5]]), np.array([10.0]), 0.1)
    moved = transported(particles, targets, all_reach, np.ones(3, dtype=np.bool_), steps, 5.0, 0.06)
    # The third goal is nearer than epsilon.
    np.testing.assert_allclose(moved.particles, [[0.1, 0.16], [0.9, 0.84], [0.53, 0.54]])
    np.testing.assert_allclose(moved.distances, [0.24, 0.04, 0.0], atol=1e-12)


def test_a_particle_goes_no_farther_than_delta_is_expected() -> None:
    steps = np.array([0.25, 0.45, -0.3, 0.9])[None, :, None]
    # Towards 0.9 by 0.2 at most: 0.45, 0.49, 0.46 (mirrored) and 0.58, and 0.6 straight on; 10 is expected below 0.5.
    moved = transported(column(0.4), column(0.9), STEP, np.array([True]), steps, 5.0, 0.2)
    assert moved.particles[0, 0] == pytest.approx(0.49)
    # Nowhere: it goes where most is expected, which from 0.7, unmirrored, is 0.64.
    moved = transported(column(0.7), column(0.9), STEP, np.array([False]), steps, 20.0, 0.2)
    assert moved.particles[0, 0] == pytest.approx(0.64)
    assert transported(column(0.9), column(0.9), STEP, np.array([False]), steps, 5.0, 0.2).particles.tolist() == [[0.9]]


def test_particles_wait_for_the_policy_and_then_arrive() -> None:
    """Contexts succeed up to a frontier along the first feature, which rises from 0.3 to all."""
    goal = Gaussian.of(BOUNDS.low + 0.9 * (BOUNDS.high - BOUNDS.low), 0.01 * (BOUNDS.high - BOUNDS.low))
    curriculum = Transport(
        instances(4), seed=0, draws=Draws(40, 2), bounds=BOUNDS, from_set=False, target=goal, delta=5.0,
        discounted=False, epsilon=0.1, particles=40,
    )  # fmt: skip
    state, selection = curriculum.start()
    assert (state.particles[:, 0] > 0.5).mean() > 0.2
    waited = []
    for version in range(40):
        frontier = 0.3 if version < 20 else 1.0
        cube = (selection.contexts - BOUNDS.low) / (BOUNDS.high - BOUNDS.low)
        returns = np.where(cube[:, 0] < frontier, 10.0, 0.0)
        told = feedback(version, np.full(40, -1), selection.contexts, returns=returns)
        state, selection, numbers = curriculum.step(state, told)
        waited.append((state.particles[:, 0].max(), numbers["distance_to_target"]))
    assert state.reached
    assert 0.2 < waited[19][0] < 0.45  # at the frontier
    assert waited[19][1] > 0.45  # type: ignore[operator]
    assert waited[39][1] < 0.05  # type: ignore[operator]
    np.testing.assert_allclose(state.particles.mean(axis=0), 0.9, atol=0.03)


def test_instances_are_drawn_where_particles_are() -> None:
    train = wide(30)
    curriculum = made("{kind: currot, delta: 0, particles: 8}", train)
    state, selection = curriculum.start()
    cube = (train.contexts - BOUNDS.low) / (BOUNDS.high - BOUNDS.low)
    nearest = ((state.particles[:, None] - cube[None]) ** 2).sum(axis=2).argmin(axis=1)
    assert set(selection.ids) <= set(train.ids[nearest])  # 20 draws of up to eight instances
    assert len(set(selection.ids)) > len(set(nearest)) / 2
    np.testing.assert_array_equal(selection.contexts, train.contexts[np.searchsorted(train.ids, selection.ids)])
    # The target is the set: with a multiple of it, each instance as often as any other.
    whole = made("{kind: currot, delta: 0, particles: 60}", train)
    targets = whole._targets(np.random.default_rng(0))  # type: ignore[attr-defined]
    np.testing.assert_allclose(np.sort(targets, axis=0), np.sort(np.repeat(cube, 2, axis=0), axis=0))


def test_nothing_moves_before_the_first_episode_has_ended() -> None:
    curriculum = made("{kind: currot, delta: 0}", wide())
    state, _ = curriculum.start()
    same, _, numbers = curriculum.step(state, feedback(0, np.zeros(0, dtype=np.int64), np.zeros((0, 2)), n=6))
    assert same.particles.tobytes() == state.particles.tobytes()  # type: ignore[attr-defined]
    assert (same.version, numbers["expected_performance"], numbers["kept"]) == (1, None, 0)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ("over: set", "curriculum.delta: this key is required"),
        ("delta: 1, target: normal", "target: normal needs target_mean and target_std"),
        ("delta: 1, target_std: [1]", "say nothing with target: set; use target: normal"),
        ("delta: 1, over: sets", "curriculum.over: 'sets' is not known; did you mean 'set'? Allowed: set, bounds"),
        ("delta: 1, epsilom: 0.2", "did you mean 'epsilon'?"),
        ("delta: 1, particles: 1", "curriculum.particles"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings: str, words: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        configs.load(SPACE, [f"curriculum={{kind: currot, {settings}}}"])
    assert words in str(refusal.value)


def test_a_target_of_another_environment_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"curriculum\.target_mean: 1 numbers for the 2 features"):
        made("{kind: currot, delta: 1, target: normal, target_mean: [1], target_std: [1]}", wide())
