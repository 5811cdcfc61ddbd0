from __future__ import annotations

import dataclasses
import math
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from space_dist.envs import BatchedPointMass, ContextObservation, ContextVisible, unwrapped
from space_dist.envs.spec import read_spec
from tests.one_slot import seen_by

ENV_ID = "space_dist/PointMass-v0"
LOW, HIGH = np.array([-4.0, 0.5, 0.0]), np.array([4.0, 8.0, 4.0])
OPEN = np.array([0.0, 8.0, 1.0])  # the gate is as wide as the world
FloatArray = NDArray[np.float64]


class Reference:
    """One PointMass in plain scalars, written from algorithm.md alone."""

    def __init__(self, context: FloatArray, seed: int) -> None:
        self.gate_x, self.gate_width, self.friction = (float(feature) for feature in context)
        self.x, self.vx, self.y, self.vy = 0.0, 0.0, 3.0, 0.0
        self.noise = 0.05 * np.random.default_rng(seed).standard_normal((100, 10, 2))
        self.time, self.crashed, self.from_below = 0, False, False

    def step(self, action: FloatArray) -> float:
        ax, ay = (min(10.0, max(-10.0, float(a))) for a in action)
        for noise_x, noise_y in self.noise[self.time]:
            x = min(4.0, max(-4.0, self.x + 0.01 * self.vx))
            y = min(4.0, max(-4.0, self.y + 0.01 * self.vy))
            vx = self.vx + 0.01 * (1.5 * ax - self.friction * self.vx + noise_x)
            vy = self.vy + 0.01 * (1.5 * ay - self.friction * self.vy + noise_y)
            if (self.y > 0) != (y > 0):
                share = self.y / (self.y - y)
                wall_x = (1.0 - share) * self.x + share * x
                if abs(wall_x - self.gate_x) > self.gate_width / 2:
                    self.crashed, self.from_below = True, self.y < 0
                    self.x, self.vx, self.y, self.vy = wall_x, 0.0, 0.0, 0.0
                    break
            self.x, self.vx, self.y, self.vy = x, vx, y, vy
        self.time += 1
        return math.exp(-0.6 * math.sqrt(self.x**2 + (self.y + 3.0) ** 2))


def reset(env: BatchedPointMass | ContextVisible, contexts: FloatArray, seeds: range) -> NDArray[np.float32]:
    return env.reset(np.arange(env.n_slots), contexts, np.array(seeds, dtype=np.uint64))


def fly(
    env: gym.Env, actions: FloatArray, *, seed: int | None, context: FloatArray | None = None
) -> list[tuple[tuple[float, ...], float, bool, bool]]:
    """(observation, reward, terminated, truncated) at reset and after each step, to the episode's end."""
    observation, _ = env.reset(seed=seed, options=None if context is None else {"context": context})
    told = [(tuple(observation.tolist()), 0.0, False, False)]
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        told.append((tuple(observation.tolist()), reward, terminated, truncated))
        if terminated or truncated:
            break
    return told


def toward(observations: NDArray[np.float32], goal: tuple[float, float]) -> NDArray[np.float32]:
    """Spring and damper: brings any slot to rest at `goal`."""
    x, vx, y, vy = observations.T
    return np.stack([10.0 * (goal[0] - x) - 4.0 * vx, 10.0 * (goal[1] - y) - 4.0 * vy], axis=1)


def test_follows_the_papers_physics() -> None:
    n = 400
    random = np.random.default_rng(0)
    contexts = random.uniform(LOW, HIGH, size=(n, 3))
    env = BatchedPointMass(n)
    observations = reset(env, contexts, range(n))
    references = [Reference(context, seed) for seed, context in enumerate(contexts)]
    np.testing.assert_array_equal(observations, np.tile(np.float32([0, 0, 3, 0]), (n, 1)))
    # Pushes that last 10 steps and far exceed the limits now and then: walls, corners and both sides are visited.
    pushes = np.repeat(random.normal([0.0, -1.0], [6.0, 8.0], size=(n, 10, 2)), 10, axis=1).astype(np.float32)
    # Every fourth slot flies through the gate, waits behind it, and rams the wall from below, mostly beside the gate.
    alive = np.ones(n, dtype=np.bool_)
    clipped_at: set[tuple[int, float]] = set()
    for time in range(100):
        actions = pushes[:, time].copy()
        for slot in range(0, n, 4):
            goal = (contexts[slot, 0], 2.0 if time < 20 else -1.0) if time < 60 else (-contexts[slot, 0], 3.0)
            actions[slot] = toward(observations[slot : slot + 1], goal)[0]
        step = env.step(actions)
        for slot in np.flatnonzero(alive):
            reference = references[slot]
            reward = reference.step(actions[slot])
            assert step.rewards[slot] == pytest.approx(reward, rel=1e-9, abs=1e-9)
            state = (reference.x, reference.vx, reference.y, reference.vy)
            np.testing.assert_allclose(step.observations[slot], np.float32(state), rtol=2e-7, atol=1e-9)
            assert bool(step.terminated[slot]) == reference.crashed
            clipped_at |= {(axis, state[axis]) for axis in (0, 2) if abs(state[axis]) == 4.0}
        alive &= ~step.terminated
        observations = step.observations
    from_below = sum(reference.from_below for reference in references)
    from_above = sum(reference.crashed and not reference.from_below for reference in references)
    through = sum(reference.y < 0 for reference in references)
    assert min(from_below, from_above, through) >= 20
    assert clipped_at == {(0, 4.0), (0, -4.0), (2, 4.0), (2, -4.0)}


@pytest.mark.parametrize(("width", "crashes"), [(2.0, False), (np.nextafter(2.0, 0.0), True)])
def test_the_gates_edge_belongs_to_the_gate(width: float, crashes: bool) -> None:
    # Pushed against x = 4 the mass reaches the wall at exactly 4, which is exactly 1 from the gate's centre.
    env = BatchedPointMass(1)
    reset(env, np.array([[3.0, width, 0.0]]), range(7, 8))
    for _ in range(20):
        step = env.step(np.array([[10.0, -3.0]]))
        if step.terminated[0] or step.observations[0, 2] < 0:
            break
    assert step.observations[0, 0] == 4.0
    assert bool(step.terminated[0]) == crashes
    if crashes:
        np.testing.assert_array_equal(step.observations[0], [4.0, 0.0, 0.0, 0.0])


def test_first_reward_by_hand() -> None:
    # Full thrust down, no friction: v = -0.15 k after k inner steps, so y = 3 - 0.01 * 0.15 * 45 = 2.9325 after ten.
    # The k-th noise term acts on the 9 - k position updates that follow the next one.
    random = np.random.default_rng(3).standard_normal((100, 10, 2))[0]
    drift = 0.01 * 0.01 * 0.05 * (np.arange(9, -1, -1) @ random)
    env = BatchedPointMass(1)
    reset(env, np.array([[0.0, 8.0, 0.0]]), range(3, 4))
    reward = env.step(np.array([[0.0, -10.0]])).rewards[0]
    assert reward == pytest.approx(math.exp(-0.6 * math.hypot(drift[0], 5.9325 + drift[1])), rel=1e-12)
    assert reward == pytest.approx(0.028453, abs=2e-5)  # without noise


def test_slots_of_any_age_equal_the_single_environment() -> None:
    n, horizon = 7, 100
    random = np.random.default_rng(1)
    env, single = BatchedPointMass(n), gym.make(ENV_ID)
    contexts, seeds = random.uniform(LOW, HIGH, size=(n, 3)), np.arange(n)
    observations = reset(env, contexts, range(n))
    told = [[(tuple(observations[slot].tolist()), 0.0, False, False)] for slot in range(n)]
    done: list[list[NDArray[np.float32]]] = [[] for _ in range(n)]
    compared: list[int] = []
    for time in range(3 * horizon):
        actions = random.normal(0.0, 6.0, size=(n, 2)).astype(np.float32)
        step = env.step(actions)
        restart = []
        for slot in range(n):
            done[slot].append(actions[slot])
            ended = bool(step.terminated[slot]), bool(step.truncated[slot])
            told[slot].append((tuple(step.observations[slot].tolist()), float(step.rewards[slot]), *ended))
            if any(ended) or time == 10 * (slot + 1):  # some are reset in mid-flight, so that ages differ
                expected = fly(single, np.array(done[slot]), seed=int(seeds[slot]), context=contexts[slot])
                assert told[slot] == expected
                compared.append(len(expected))
                restart.append(slot)
        slots = np.array(restart, dtype=np.int64)
        if len(slots):
            contexts[slots] = random.uniform(LOW, HIGH, size=(len(slots), 3))
            seeds[slots] += n
            for slot, start in zip(restart, env.reset(slots, contexts[slots], seeds[slots].astype(np.uint64)),
                                   strict=True):  # fmt: skip
                told[slot], done[slot] = [(tuple(start.tolist()), 0.0, False, False)], []
    assert len(set(compared)) > 5


def test_neighbours_and_the_number_of_slots_do_not_matter() -> None:
    random = np.random.default_rng(2)
    context, actions = np.array([1.0, 2.0, 0.5]), random.normal(0.0, 5.0, size=(100, 2))

    def alone_among(n: int, slot: int) -> list[tuple[bytes, float]]:
        contexts = random.uniform(LOW, HIGH, size=(n, 3))
        contexts[slot] = context
        env, seeds = BatchedPointMass(n), random.integers(1 << 40, size=n).astype(np.uint64)
        seeds[slot] = 11
        env.reset(np.arange(n), contexts, seeds)
        return seen_by(slot, env, actions, lambda: random.normal(0.0, 20.0, size=(n, 2)))

    alone = alone_among(1, 0)
    assert all(alone_among(n, slot) == alone for n, slot in ((2, 1), (8, 3), (33, 32)))


@pytest.mark.parametrize("context_visible", [False, True])
def test_gymnasiums_own_checker_accepts_it(context_visible: bool) -> None:
    env = gym.make(ENV_ID, disable_env_checker=True).unwrapped
    check_env(ContextObservation(env) if context_visible else env, skip_render_check=True)


TRAJECTORY = """
import gymnasium, numpy, space_dist.envs
env = gymnasium.make("space_dist/PointMass-v0")
env.reset(seed=5, options={"context": numpy.array([1.0, 6.0, 0.5])})
for action in numpy.random.default_rng(8).normal(0.0, 5.0, size=(60, 2)):
    observation, reward, terminated, *_ = env.step(action)
    print(observation.tobytes().hex(), reward.hex(), terminated)
    if terminated:
        break
"""


def test_importing_the_package_registers_it_and_another_process_flies_the_same() -> None:
    answer = subprocess.run([sys.executable, "-c", TRAJECTORY], capture_output=True, text=True, check=True)
    actions = np.random.default_rng(8).normal(0.0, 5.0, size=(60, 2))
    here = fly(gym.make(ENV_ID), actions, seed=5, context=np.array([1.0, 6.0, 0.5]))[1:]
    assert answer.stdout.splitlines() == [
        f"{np.float32(observation).tobytes().hex()} {reward.hex()} {terminated}"
        for observation, reward, terminated, _ in here
    ]


def test_what_was_flown_before_does_not_matter() -> None:
    random = np.random.default_rng(4)
    context, actions = np.array([-1.0, 3.0, 0.2]), random.normal(0.0, 5.0, size=(100, 2))
    env = gym.make(ENV_ID)
    first = fly(env, actions, seed=6, context=context)
    for length in (1, 3, 100):
        fly(env, random.normal(0.0, 9.0, size=(length, 2)), seed=length, context=random.uniform(LOW, HIGH))
        assert fly(env, actions, seed=6, context=context) == first
    assert fly(env, actions, seed=7, context=context) != first


@pytest.mark.parametrize("length", [0, 1, 19, 20, 21, 60, 100])
def test_an_episode_that_is_begun_again_has_the_noise_it_had(length: int) -> None:
    """However much of it was drawn: an episode that goes on to the horizon draws more."""
    actions = np.random.default_rng(5).normal(0.0, 1.0, size=(100, 2))
    fresh = fly(gym.make(ENV_ID), actions, seed=6, context=OPEN)
    assert len(fresh) == 101
    env = gym.make(ENV_ID)
    for _ in range(2):
        assert fly(env, actions[:length], seed=6, context=OPEN) == fresh[: length + 1]
    assert fly(env, actions, seed=6, context=OPEN) == fresh


def test_an_unseeded_reset_goes_on_in_the_seeded_stream() -> None:
    env, actions = gym.make(ENV_ID), np.zeros((5, 2))

    def three() -> list[object]:
        return [fly(env, actions, seed=seed, context=OPEN) for seed in (9, None, None)]

    seeded, second, third = three()
    assert seeded != second != third
    assert three() == [seeded, second, third]


def test_without_a_context_one_is_drawn_within_the_bounds() -> None:
    env = gym.make(ENV_ID)
    drawn = np.array([env.reset(seed=seed)[1]["context"] for seed in range(50)])
    assert ((drawn >= LOW) & (drawn <= HIGH)).all()
    assert (np.ptp(drawn, axis=0) > 0.7 * (HIGH - LOW)).all()
    np.testing.assert_array_equal(drawn[13], env.reset(seed=13)[1]["context"])


def pushed(context: list[float], action: tuple[float, float], steps: int) -> tuple[NDArray[np.float32], bool]:
    """State after `steps` equal actions or a crash, and whether it crashed."""
    env = BatchedPointMass(1)
    reset(env, np.array([context]), range(1))
    for _ in range(steps):
        step = env.step(np.array([action]))
        if step.terminated[0]:
            return step.observations[0], True
    return step.observations[0], False


def test_friction_slows() -> None:
    # Constant thrust F = 1.5 * 2 with friction f: after one second v = F for f = 0 and (1 - 0.99^... ) F / f else,
    # for f = 4: 3 / 4 * (1 - 0.96^100) = 0.737. The noise adds a standard deviation of at most 0.005.
    free, _ = pushed([0.0, 8.0, 0.0], (2.0, 0.0), 10)
    slowed, _ = pushed([0.0, 8.0, 4.0], (2.0, 0.0), 10)
    assert free[1] == pytest.approx(3.0, abs=0.03)
    assert slowed[1] == pytest.approx(0.75 * (1 - 0.96**100), abs=0.03)


def test_the_gates_width_decides_who_crashes() -> None:
    # Straight down in the middle of the world, the gate's centre at 1: reached at x = 0 within the noise.
    narrow, crashed = pushed([1.0, 1.9, 0.0], (0.0, -5.0), 15)
    assert crashed
    np.testing.assert_array_equal(narrow[[1, 2, 3]], 0.0)  # left at the wall, at rest
    assert abs(narrow[0]) < 0.01
    wide, crashed = pushed([1.0, 2.1, 0.0], (0.0, -5.0), 15)
    assert not crashed
    assert wide[2] < 0


def test_the_gates_place_decides_who_crashes() -> None:
    assert pushed([0.9, 2.0, 0.0], (0.0, -5.0), 15)[1] is False
    assert pushed([1.1, 2.0, 0.0], (0.0, -5.0), 15)[1] is True
    assert pushed([-0.9, 2.0, 0.0], (0.0, -5.0), 15)[1] is False
    assert pushed([-1.1, 2.0, 0.0], (0.0, -5.0), 15)[1] is True


def test_a_context_stays_until_another_is_given() -> None:
    env = gym.make(ENV_ID)
    first, second = np.array([1.0, 2.0, 3.0]), np.array([-1.0, 4.0, 0.0])
    _, info = env.reset(seed=0, options={"context": first})
    first[0] = 2.0  # the caller's array is the caller's
    for _ in range(2):
        env.step(np.zeros(2))
        info["context"][:] = 0.0
        _, info = env.reset()
        np.testing.assert_array_equal(info["context"], [1.0, 2.0, 3.0])
    _, info = env.reset(options={})
    np.testing.assert_array_equal(info["context"], [1.0, 2.0, 3.0])
    _, info = env.reset(options={"context": second})
    np.testing.assert_array_equal(info["context"], second)
    np.testing.assert_array_equal(env.reset()[1]["context"], second)


@pytest.mark.parametrize(
    "context", [[0.0, 0.4, 0.0], [4.1, 1.0, 0.0], [0.0, 1.0, -0.1], [0.0, math.nan, 1.0], [0.0, 1.0], [[0.0, 1.0, 1.0]]]
)
def test_a_context_out_of_bounds_or_shape_is_refused(context: list[float]) -> None:
    env = gym.make(ENV_ID)
    with pytest.raises(ValueError, match="gate_x, gate_width, friction"):
        env.reset(seed=0, options={"context": np.array(context)})


def test_observed_contexts_are_scaled_to_one() -> None:
    contexts = np.array([LOW, HIGH, (LOW + HIGH) / 2, [2.0, 2.375, 1.0]])
    scaled = np.float32([[-1, -1, -1], [1, 1, 1], [0, 0, 0], [0.5, -0.5, -0.5]])
    batched, single = ContextVisible(BatchedPointMass(4)), ContextObservation(gym.make(ENV_ID))
    assert batched.observation_space == single.observation_space
    started = reset(batched, contexts, range(4))
    stepped = batched.step(np.zeros((4, 2))).observations
    for observations in (started, stepped):
        np.testing.assert_array_equal(observations[:, 4:], scaled)
    for slot, context in enumerate(contexts):
        observation, _ = single.reset(seed=slot, options={"context": context})
        np.testing.assert_array_equal(observation, started[slot])
        np.testing.assert_array_equal(single.step(np.zeros(2))[0], stepped[slot])


def test_actions_are_clipped_and_left_alone() -> None:
    random = np.random.default_rng(5)
    wild = random.choice([-1e6, -10.5, -3.0, 0.0, 3.0, 10.5, np.inf], size=(50, 2)).astype(np.float32)
    given = wild.copy()
    env = gym.make(ENV_ID)
    first = fly(env, wild, seed=1, context=OPEN)
    assert first == fly(env, np.clip(given, -10.0, 10.0), seed=1, context=OPEN)
    batched = BatchedPointMass(50)
    reset(batched, np.tile(OPEN, (50, 1)), range(50))
    batched.step(wild)
    np.testing.assert_array_equal(wild, given)


def test_truncated_at_step_100_and_never_while_terminated() -> None:
    random = np.random.default_rng(6)
    env = BatchedPointMass(64)
    reset(env, random.uniform(LOW, HIGH, size=(64, 3)), range(64))
    alive, crashed_at = np.ones(64, dtype=np.bool_), []
    for time in range(1, 101):
        step = env.step(np.stack([np.zeros(64), np.linspace(-10.0, 0.0, 64)], axis=1))
        assert not (step.terminated & step.truncated).any()
        np.testing.assert_array_equal(step.truncated[alive], (time == 100) & ~step.terminated[alive])
        crashed_at += [time] * int((step.terminated & alive).sum())
        alive &= ~step.terminated
    assert alive.any()
    assert len(set(crashed_at)) > 5
    # Who crashes in the very last step has crashed, and was not cut off by the clock.
    for horizon, ends in ((8, (True, False)), (7, (False, True))):
        last = BatchedPointMass(1, horizon=horizon)
        reset(last, np.array([[4.0, 0.5, 0.0]]), range(1))
        for _ in range(horizon):
            step = last.step(np.array([[0.0, -7.5]]))  # 3 = 11.25 t^2 / 2 in 0.73 seconds
        assert (bool(step.terminated[0]), bool(step.truncated[0])) == ends


def test_success_is_being_near_the_goal_now() -> None:
    env = BatchedPointMass(3)
    observations = reset(env, np.array([[0.0, 8.0, 0.0], [0.5, 4.0, 2.0], [-1.0, 6.0, 4.0]]), range(3))
    seen = []
    for time in range(100):
        goal = (0.0, -3.0) if time < 70 else (0.0, -2.0)  # there, and away again
        step = env.step(toward(observations, goal))
        observations = step.observations
        distance = np.hypot(observations[:, 0].astype(np.float64), observations[:, 2] + 3.0)
        assert step.success is not None
        np.testing.assert_array_equal(step.success, distance < 0.25)
        np.testing.assert_allclose(step.rewards, np.exp(-0.6 * distance), rtol=1e-5)
        seen.append(step.success)
    assert not np.any(seen[0])
    assert np.all(seen[69])
    assert not np.any(seen[99])


def test_success_is_told_in_info() -> None:
    env = gym.make(ENV_ID)
    observation, _ = env.reset(seed=0, options={"context": OPEN})
    told = []
    for _ in range(60):
        observation, _, _, _, info = env.step(toward(observation[None], (0.0, -3.0))[0])
        told.append(info["success"])
    assert (told[0], told[-1]) == (False, True)


@pytest.mark.parametrize("n_slots", [1, 3, 16, 70])
@pytest.mark.parametrize("size", [1.0, 6.0, 50.0])
def test_compiled_physics_have_the_same_bits(n_slots: int, size: float) -> None:
    """Over crashes, ends and new episodes; and for actions that are no numbers."""
    plain, compiled = BatchedPointMass(n_slots), BatchedPointMass(n_slots)
    compiled.compile_physics()
    rng = np.random.default_rng(n_slots)
    contexts = rng.uniform(LOW, HIGH, (n_slots, 3))
    beginning, seeds, crashes, ends = np.arange(n_slots), np.arange(n_slots, dtype=np.uint64), 0, 0
    for _ in range(250):
        starts = [env.reset(beginning, contexts[beginning], seeds[beginning]) for env in (plain, compiled)]
        assert starts[0].tobytes() == starts[1].tobytes()
        actions = rng.normal(0.0, size, (n_slots, 2)).astype(np.float32)
        one, two = plain.step(actions), compiled.step(actions)
        for name in ("observations", "rewards", "terminated", "truncated", "success"):
            assert getattr(one, name).tobytes() == getattr(two, name).tobytes()
        beginning = np.flatnonzero(one.terminated | one.truncated)
        seeds[beginning] += np.uint64(n_slots)
        crashes, ends = crashes + int(one.terminated.sum()), ends + int(one.truncated.sum())
    assert n_slots < 16 or (ends if size == 1.0 else crashes)
    for broken in (np.nan, np.inf, -np.inf):
        actions[:, 0] = broken
        one, two = plain.step(actions), compiled.step(actions)
        assert one.observations.tobytes() == two.observations.tobytes()


def test_whoever_wraps_it_reaches_the_compiled_physics() -> None:
    spec = read_spec(ENV_ID, context_visible=True)
    with dataclasses.replace(spec, compiled=True).opened(2) as compiled, spec.opened(2) as plain:
        assert (unwrapped(compiled)._compiled is None, unwrapped(plain)._compiled is None) == (False, True)
