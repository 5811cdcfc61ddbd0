"""Goal maze (Klink et al. 2022): walk round a block to a goal, if it is where one can come near enough to it.

Facts: docs/environments.md ("Goal maze"); Klink et al., "Curriculum Reinforcement Learning via Constrained Optimal
Transport", ICML 2022, and its public code, of which there is nothing here.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.envs.interface import BoolArray, Distribution, FloatArray, IntArray, Step
from space_dist.errors import ConfigError
from space_dist.instances import ContextBounds

WALL: Final = 7.0  # |x| and |y| at most: the outer walls
BLOCK: Final = 5.0  # nobody is where both |x| and |y| are less
STRIDE: Final = 0.3  # length of the longest step
START_LOW, START_HIGH = -7.0, -5.0  # of both coordinates: the lower left corner
TOLERANCE, WIDEST = 0.05, 18.0  # the least, that of the target's goals, and the greatest
HORIZON: Final = 200

BOUNDS: Final = ContextBounds(
    names=("goal_x", "goal_y", "tolerance"),
    low=np.array([-9.0, -9.0, TOLERANCE]),
    high=np.array([9.0, 9.0, WIDEST]),
)
"""Goal maze (Klink et al. 2022): the goal, and how far from it is near enough, in the world's length units."""


def distances(goals: FloatArray) -> FloatArray:
    """`(n, 2) -> (n,)` how far the nearest place to each goal is where one can be; 0 in the corridor."""
    size = np.abs(goals)
    outside = np.hypot(*np.maximum(size - WALL, 0.0).T)
    found: FloatArray = np.where((size < BLOCK).all(axis=1), BLOCK - size.max(axis=1), outside)
    return found


def reachable(contexts: FloatArray) -> BoolArray:
    """`(n, 3) -> (n,)` whether the goal can be come near enough to, from where episodes start, by any policy at all."""
    found: BoolArray = distances(contexts[:, :2]) < contexts[:, 2]
    return found


def _draw_uniform(rng: np.random.Generator, n: int) -> FloatArray:
    return rng.uniform(BOUNDS.low, BOUNDS.high, size=(n, 3))


def _draw_target(rng: np.random.Generator, n: int) -> FloatArray:
    """Goals anywhere, 70 % of them in the block or outside the walls; the least tolerance."""
    drawn = _draw_uniform(rng, n)
    drawn[:, 2] = TOLERANCE
    return drawn


def _draw_graded(rng: np.random.Generator, n: int) -> FloatArray:
    """Goals anywhere; tolerances of every order of magnitude as likely."""
    drawn = _draw_uniform(rng, n)
    share = (drawn[:, 2] - TOLERANCE) / (WIDEST - TOLERANCE)
    drawn[:, 2] = np.clip(TOLERANCE * (WIDEST / TOLERANCE) ** share, TOLERANCE, WIDEST)
    return drawn


def _draw_solvable(rng: np.random.Generator, n: int) -> FloatArray:
    """As graded, but for those whose goal cannot be reached."""
    return _those(rng, n, _draw_graded, reachable)


def _draw_feasible(rng: np.random.Generator, n: int) -> FloatArray:
    """Goals in the corridor; the least tolerance."""
    return _those(rng, n, _draw_target, lambda contexts: distances(contexts[:, :2]) == 0.0)


def _those(
    rng: np.random.Generator, n: int, draw: Callable[[np.random.Generator, int], FloatArray],
    wanted: Callable[[FloatArray], BoolArray],
) -> FloatArray:  # fmt: skip
    """`(n, 3)` of the drawn that are wanted."""
    found = np.empty((0, 3))
    while len(found) < n:
        drawn = draw(rng, n)
        found = np.vstack((found, drawn[wanted(drawn)]))
    return found[:n]


DISTRIBUTIONS: Final = {
    "goalmaze_uniform": Distribution(
        description="Goal maze, each feature uniform within its bounds",
        source="Klink et al. 2022 (the bounds, and what their random curriculum draws from)",
        bounds=BOUNDS,
        draw=_draw_uniform,
    ),
    "goalmaze_target": Distribution(
        description="Goal maze, goals uniform within their bounds, of which 70 % cannot be reached; tolerance 0.05",
        source="Klink et al. 2022 (the target distribution)",
        bounds=BOUNDS,
        draw=_draw_target,
    ),
    "goalmaze_graded": Distribution(
        description="Goal maze, goals uniform within their bounds, tolerance log-uniform within its own: 35 % of the "
        "goals cannot be reached",
        source="Klink et al. 2022 (the bounds); the tolerances are ours",
        bounds=BOUNDS,
        draw=_draw_graded,
    ),
    "goalmaze_solvable": Distribution(
        description="Goal maze, as goalmaze_graded, but for the goals that cannot be reached",
        source="Klink et al. 2022 (the bounds); the tolerances are ours",
        bounds=BOUNDS,
        draw=_draw_solvable,
    ),
    "goalmaze_feasible": Distribution(
        description="Goal maze, goals uniform in the corridor; tolerance 0.05",
        source="Klink et al. 2022 (what their public code evaluates on: the target's goals that can be reached)",
        bounds=BOUNDS,
        draw=_draw_feasible,
    ),
}


class BatchedGoalMaze:
    """`n_slots` walkers. Context: (goal_x, goal_y, tolerance).

    State per slot: (x, y) in float64; observed as float32. An episode starts where its seed says, uniform in the lower
    left corner; nothing else is random. An action is a step, of which what is longer than 1 is shortened to 1, times
    0.3; the walls and the block stop it. Nearer to the goal than the tolerance, at the end of a step, the episode ends
    with success.

    Reward is 1 for the step that succeeds and 0 for any other, less `step_cost`: 0 is what Klink et al.'s curricula and
    evaluations go by, 1 (so 0 for success and -1 a step) what their learner does.
    """

    def __init__(self, n_slots: int, *, horizon: int = HORIZON, step_cost: float = 0.0) -> None:
        if isinstance(step_cost, bool) or not isinstance(step_cost, int | float) or not 0.0 <= step_cost <= 1.0:
            raise ConfigError(f"step_cost is {str(step_cost)[:80]!r}; allowed is a number from 0 to 1")
        self.n_slots, self.horizon = n_slots, horizon
        self.observation_space = spaces.Box(-WALL, WALL, shape=(2,), dtype=np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, shape=(2,), dtype=np.float32)
        self.context_bounds = BOUNDS
        self._cost = float(step_cost)
        self._position = np.zeros((2, n_slots))
        self._context = np.zeros((3, n_slots))
        self._time = np.zeros(n_slots, dtype=np.int64)
        self._compiled: Callable[..., None] | None = None

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> NDArray[np.float32]:
        """Start new episodes in the lower left corner."""
        for slot, seed in zip(slots.tolist(), seeds.tolist(), strict=True):
            self._position[:, slot] = np.random.default_rng(seed).uniform(START_LOW, START_HIGH, size=2)
        self._context[:, slots] = contexts.T
        self._time[slots] = 0
        return self._observe()[slots]

    def step(self, actions: NDArray[np.generic]) -> Step:
        """One step, as far as walls and block let it."""
        reached = self._advance(np.asarray(actions, dtype=np.float64))
        self._time += 1
        return Step(
            observations=self._observe(),
            rewards=reached.astype(np.float64) - self._cost,
            terminated=reached,
            truncated=(self._time >= self.horizon) & ~reached,
            success=reached.copy(),
        )

    def compile_physics(self) -> None:
        """Have steps computed by a compiled twin from now on, with the same bits in a fraction of the time."""
        from space_dist.kernels.goalmaze import World, prepare

        self._compiled = functools.partial(prepare(), World(WALL, BLOCK, STRIDE))

    def draw_unsolvable(self, rng: np.random.Generator, n: int) -> FloatArray:
        """`(n, 3)` contexts, uniform within the bounds, but for those whose goal can be reached."""
        return _those(rng, n, _draw_uniform, lambda contexts: ~reachable(contexts))

    def _advance(self, actions: FloatArray) -> BoolArray:
        """One step under (n_slots, 2) actions. Returns which slots are near enough to their goal."""
        if self._compiled is not None:
            reached = np.empty(self.n_slots, dtype=np.bool_)
            self._compiled(self._position, self._context, actions, reached)
            return reached
        step = np.clip(actions.T, -1.0, 1.0)
        # Not np.hypot: a square root of a sum is rounded alike everywhere, and in the compiled twin.
        step = STRIDE * (step / np.maximum(np.sqrt(step[0] * step[0] + step[1] * step[1]), 1.0))
        before = self._position
        after = np.clip(before + step, -WALL, WALL)
        within = (np.abs(after) < BLOCK).all(axis=0)
        after = np.where(within & (before <= -BLOCK), -BLOCK, after)
        self._position = np.where(within & (before >= BLOCK), BLOCK, after)
        off_x, off_y = self._context[:2] - self._position
        found: BoolArray = off_x * off_x + off_y * off_y < self._context[2] * self._context[2]
        return found

    def _observe(self) -> NDArray[np.float32]:
        return self._position.T.astype(np.float32)
