"""What is BallCatching's own; what it shares with every environment on PyBullet is in test_bullet.py."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from space_dist.envs import BatchedBallCatching
from space_dist.envs.ballcatching import (
    ACTION_COST,
    ALIGNMENT_REWARD,
    BALL_START_Y,
    BALL_START_Z,
    CATCH_REWARD,
    DT,
    HOME,
    NET_CENTRE,
    RATE,
    STEP_REWARD,
    SUBSTEPS,
    BallWorld,
    flight_time_of,
    target_of,
)  # fmt: skip
from space_dist.envs.ballcatching import BOUNDS as BALLCATCHING_BOUNDS
from space_dist.instances import read_csv

INSTANCES = Path(__file__).parent.parent / "configs" / "instances"
FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Controller = Callable[[NDArray[np.float32], slice], FloatArray]

LENGTHS = (0.42, 0.40, 0.081 + NET_CENTRE)  # metres: upper arm, forearm, and from the wrist to the net's centre
SLOTS = 8


def posture(context: FloatArray) -> FloatArray:
    """(5,) joint positions that put the net's centre where the ball of this context goes.

    Of the arm's postures that do, on a grid of the last link's directions, the one nearest to HOME. All angles are
    in the arm's plane, from the vertical towards -y.
    """
    angle, radius, _ = context.tolist()
    goal = radius * np.array([np.cos(angle), np.sin(angle)])  # -y and z, from the shoulder
    upper, fore, hand = LENGTHS
    best, least = None, np.inf
    for direction in np.linspace(-np.pi, np.pi, 181):
        wrist = goal - hand * np.array([np.sin(direction), np.cos(direction)])
        cosine = (wrist @ wrist - upper**2 - fore**2) / (2 * upper * fore)
        if abs(cosine) > 1:
            continue
        for bend in (np.arccos(cosine), -np.arccos(cosine)):
            first = np.arctan2(*wrist) - np.arctan2(fore * np.sin(bend), upper + fore * np.cos(bend))
            joints = np.array([first, -bend, 0.0, direction - first - bend, 0.0])
            joints = (joints + np.pi) % (2 * np.pi) - np.pi
            way = np.abs(joints - HOME).max()
            if np.abs(joints).max() < 2.09 and way < least:
                best, least = joints, way
    assert best is not None, f"no posture for {context}"
    return best


def episodes(contexts: FloatArray, control: Controller) -> tuple[FloatArray, BoolArray]:
    """(returns, whether caught) of an episode on each context, the i-th with seed i."""
    env, returns, caught = BatchedBallCatching(SLOTS), np.zeros(len(contexts)), np.zeros(len(contexts), dtype=np.bool_)
    for first in range(0, len(contexts), SLOTS):
        part = slice(first, first + SLOTS)
        observations = env.reset(np.arange(SLOTS), contexts[part], np.arange(first, first + SLOTS, dtype=np.uint64))
        alive = np.ones(SLOTS, dtype=np.bool_)
        while alive.any():
            step = env.step(control(observations, part))
            assert step.success is not None
            observations = step.observations
            returns[part] += alive * step.rewards
            caught[part] |= alive & step.success
            alive &= ~(step.terminated | step.truncated)
    return returns, caught


@pytest.fixture(scope="module")
def contexts() -> FloatArray:
    """(200, 3) all training and test instances."""
    return np.concatenate(
        [read_csv(INSTANCES / f"ballcatching_uniform_{part}.csv", BALLCATCHING_BOUNDS).contexts
         for part in ("train", "test")]
    )  # fmt: skip


def towards(goals: FloatArray) -> Controller:
    return lambda seen, part: np.clip((goals[part] - seen[:, :5]) / (RATE * DT * SUBSTEPS), -1.0, 1.0)


def test_who_knows_the_ball_catches_it(contexts: FloatArray) -> None:
    """At least 90 % is asked for: every instance is catchable."""
    returns, caught = episodes(contexts, towards(np.array([posture(context) for context in contexts])))
    assert caught.mean() >= 0.99
    assert returns[caught].min() > CATCH_REWARD
    assert returns.mean() > 70.0


def test_who_acts_at_random_does_not(contexts: FloatArray) -> None:
    """Neither uniformly nor, as an untrained policy, normally; half of the slots each."""
    random, half = np.random.default_rng(0), (SLOTS // 2, 5)
    act = lambda: np.concatenate([random.uniform(-1.0, 1.0, half), random.normal(size=half)])  # noqa: E731
    assert episodes(contexts[:120], lambda seen, part: act())[1].mean() <= 0.05


def test_who_aims_at_another_instances_ball_misses_more(contexts: FloatArray) -> None:
    """The context matters, and is all that tells where the ball goes: start observations are equal."""
    goals = np.array([posture(context) for context in contexts[:24]])
    assert episodes(contexts[:24], towards(np.roll(goals, 1, axis=0)))[1].mean() < 0.5
    env = BatchedBallCatching(2)
    starts = env.reset(np.arange(2), contexts[:2], np.arange(2, dtype=np.uint64))
    np.testing.assert_array_equal(starts[0], starts[1])
    np.testing.assert_allclose(starts[0], [*HOME, *HOME, *[0.0] * 5], atol=1e-6)


def test_the_ball_is_where_it_should_be_when_it_should(contexts: FloatArray) -> None:
    """Alone in its world, it passes the target of its context at the flight time, from a start within the bounds."""
    world = BallWorld()
    starts = []
    for seed, context in enumerate(contexts[:20]):
        world.rewind()
        world.begin(context, seed)
        start = np.array(world.call("getBasePositionAndOrientation", world._ball)[0])
        starts.append(start)
        for joint in range(world.call("getNumJoints", world._arm)):  # out of its way
            world.call("setCollisionFilterPair", world._arm, world._ball, joint, -1, 0)
        for _ in range(round(flight_time_of(context) / DT)):
            world.call("stepSimulation")
        np.testing.assert_allclose(
            world.call("getBasePositionAndOrientation", world._ball)[0], target_of(context), atol=0.015
        )  # half a physics step of a ball at 7 m/s
    x, y, z = np.array(starts).T
    np.testing.assert_allclose(x, contexts[:20, 2])
    for values, (low, high) in ((y, BALL_START_Y), (z, BALL_START_Z)):
        assert (low <= values).all()
        assert (values <= high).all()
        assert np.ptp(values) > 0.7 * (high - low)


def test_the_arm_stays_in_its_plane_and_follows_what_is_desired() -> None:
    world = BallWorld()
    world.rewind()
    episode, observation = world.begin(np.array([0.4, 0.6, 4.0]), 0)
    action = np.array([-0.5, 0.5, 0.0, -0.3, 0.0])
    positions = []
    for _ in range(20):
        observation, reward, _, _ = world.act(episode, action)
        positions.append(observation[5:10])
    np.testing.assert_allclose(observation[:5], np.array(HOME) + 20 * RATE * DT * SUBSTEPS * action, atol=1e-5)
    np.testing.assert_allclose(observation[5:10], observation[:5], atol=0.1)  # behind by the time constant
    np.testing.assert_allclose(positions[-1] - positions[-11], 10 * RATE * DT * SUBSTEPS * action, atol=0.01)
    assert reward == pytest.approx(STEP_REWARD - ACTION_COST * (action @ action))
    for link in range(world.call("getNumJoints", world._arm)):
        assert abs(world.call("getLinkState", world._arm, link)[4][0]) < 1e-3


def test_what_is_desired_stops_at_the_joints_limits() -> None:
    world = BallWorld()
    world.rewind()
    episode, _ = world.begin(np.array([0.4, 0.6, 4.0]), 0)
    for _ in range(150):
        world.act(episode, np.ones(5))
    np.testing.assert_array_equal(episode.desired, world._high)


def test_how_a_ball_meets_the_net_decides_the_bonus() -> None:
    """Head on, at 60 degrees and from behind; the floor pays nothing, and ends it too."""
    world = BallWorld()
    for degrees, bonus in ((0.0, 25.0), (60.0, 25.0 * 0.5**5), (180.0, -25.0)):
        world.rewind()
        episode, _ = world.begin(np.array([0.4, 0.6, 4.0]), 0)
        net = np.array(world.call("getLinkState", world._arm, world._net)[4])
        way = np.array([np.cos(np.deg2rad(degrees)), 0.0, np.sin(np.deg2rad(degrees))])  # where it comes from
        world.call("resetBasePositionAndOrientation", world._ball, (net + 0.1 * way).tolist(), [0, 0, 0, 1])
        world.call("resetBaseVelocity", world._ball, (-5.0 * way).tolist())
        for _ in range(10):
            _, reward, ended, caught = world.act(episode, np.zeros(5))
            if ended:
                break
        assert (ended, caught) == (True, True)
        assert reward - STEP_REWARD == pytest.approx(CATCH_REWARD + bonus, abs=0.5)
    assert ALIGNMENT_REWARD == 25.0

    world.rewind()
    episode, _ = world.begin(np.array([0.4, 0.6, 4.0]), 0)
    world.call("resetBasePositionAndOrientation", world._ball, [3.0, 0.0, 0.05], [0, 0, 0, 1])
    world.call("resetBaseVelocity", world._ball, [0, 0, -1.0])
    rewards, ends = zip(*[world.act(episode, np.zeros(5))[1:3] for _ in range(3)], strict=True)
    assert any(ends)
    assert set(rewards) == {STEP_REWARD}


def test_even_the_longest_flight_has_ended_before_the_horizon() -> None:
    env = BatchedBallCatching(1)
    assert env.horizon == 200
    env.reset(np.array([0]), np.array([[0.5 * np.pi, 0.95, 4.0]]), np.zeros(1, dtype=np.uint64))
    ends = [bool(env.step(np.zeros((1, 5))).terminated[0]) for _ in range(150)]
    assert 70 < ends.index(True) < 150
