"""CartPole (Barto et al. 1983; Gymnasium's CartPole-v1) whose pole's length is the context and changes the dynamics.

The physics are those of `gymnasium/envs/classic_control/cartpole.py`. Facts about the paper's three poles:
docs/environments.md ("CartPole").
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.envs.interface import Distribution, IntArray, Step
from space_dist.instances import ContextBounds

# Gymnasium's constants, in SI units: tests/test_cartpole.py holds every step against its own.
GRAVITY = 9.8
CART_MASS = 1.0
POLE_MASS = 0.1
TOTAL_MASS = POLE_MASS + CART_MASS
FORCE = 10.0
TAU = 0.02  # seconds per Euler step
X_LIMIT = 2.4
ANGLE_LIMIT = 12 * 2 * math.pi / 360
START_LIMIT = 0.05  # of each of the four numbers of a state
HORIZON = 200  # CartPole-v0's, as in the paper; v1 has 500

BOUNDS: Final = ContextBounds(names=("length",), low=np.array([0.1]), high=np.array([1.0]))
"""CartPole: *half* the pole's length in metres, as Gymnasium's `length` is. The bounds are ours.

`configs/instances/cartpole_train.csv` holds the paper's three poles: 0.3, 0.4 and 0.5. The paper holds none out; the
four of `cartpole_test.csv` are ours: one between each two of them, and one beyond each end.
"""


DISTRIBUTIONS: Final = {
    "cartpole_uniform": Distribution(
        description="CartPole, half the pole's length uniform within its bounds",
        source="ours; the paper has only the three poles of cartpole_train.csv and no test set",
        bounds=BOUNDS,
        draw=lambda rng, n: rng.uniform(BOUNDS.low, BOUNDS.high, size=(n, 1)),
    ),
}


class BatchedCartPole:
    """`n_slots` poles on carts. Context: (length,), which is *half* the pole's length, as Gymnasium's `length` is.

    The pole's mass is the same at every length, so `polemass_length` follows the context too. State per slot:
    (x, its velocity, angle, its velocity) in float64; observed as float32. An episode's start state is uniform in
    [-0.05, 0.05]^4 and drawn from its seed alone, as Gymnasium draws it; nothing else is random. Action 0 pushes left
    and 1 right.

    Each step pays 1. With `end_reward`, the last step of an episode pays that instead, be it a fall or the horizon
    (the paper's notebook: -100 for both). Success is balancing to the horizon, so it is true at a truncated step and
    at no other.
    """

    def __init__(self, n_slots: int, *, horizon: int = HORIZON, end_reward: float | None = None) -> None:
        self.n_slots, self.horizon = n_slots, horizon
        limit = np.array([2 * X_LIMIT, np.inf, 2 * ANGLE_LIMIT, np.inf], dtype=np.float32)  # holds the fallen too
        self.observation_space = spaces.Box(-limit, limit, dtype=np.float32)
        self.action_space = spaces.Discrete(2)
        self.context_bounds = BOUNDS
        self._end_reward = end_reward
        self._state = np.zeros((4, n_slots))
        self._rate = np.zeros((4, n_slots))  # of the state, per second
        self._length = np.ones(n_slots)
        self._time = np.zeros(n_slots, dtype=np.int64)

    def reset(self, slots: IntArray, contexts: NDArray[np.float64], seeds: NDArray[np.uint64]) -> NDArray[np.float32]:
        """Start new episodes near the upright."""
        for slot, seed in zip(slots.tolist(), seeds.tolist(), strict=True):
            self._state[:, slot] = np.random.default_rng(seed).uniform(-START_LIMIT, START_LIMIT, size=4)
        self._length[slots] = contexts[:, 0]
        self._time[slots] = 0
        return self._observe()[slots]

    def step(self, actions: NDArray[np.generic]) -> Step:
        """One Euler step. Ends beyond 2.4 from the middle or 12 degrees from the upright.

        Raises ValueError unless every action is 0 or 1.
        """
        right = actions == 1
        if not (right | (actions == 0)).all():
            raise ValueError(f"actions must be 0 or 1, not {np.array2string(actions, threshold=10)}")
        _, velocity, angle, spin = self._state
        cos, sin = np.cos(angle), np.sin(angle)
        pole_mass_length = POLE_MASS * self._length
        # Gymnasium's expressions in Gymnasium's order; its names for the two lines: temp, thetaacc
        push = (np.where(right, FORCE, -FORCE) + pole_mass_length * np.square(spin) * sin) / TOTAL_MASS
        spin_rate = (GRAVITY * sin - cos * push) / (
            self._length * (4.0 / 3.0 - POLE_MASS * np.square(cos) / TOTAL_MASS)
        )
        self._rate[0], self._rate[2], self._rate[3] = velocity, spin, spin_rate
        self._rate[1] = push - pole_mass_length * spin_rate * cos / TOTAL_MASS
        self._state += TAU * self._rate
        self._time += 1
        fallen = (np.abs(self._state[0]) > X_LIMIT) | (np.abs(self._state[2]) > ANGLE_LIMIT)
        truncated = (self._time >= self.horizon) & ~fallen
        rewards = np.ones(self.n_slots)
        if self._end_reward is not None:
            rewards[fallen | truncated] = self._end_reward
        return Step(self._observe(), rewards, terminated=fallen, truncated=truncated, success=truncated.copy())

    def _observe(self) -> NDArray[np.float32]:
        return self._state.T.astype(np.float32, order="C")
