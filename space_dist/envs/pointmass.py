"""PointMass (Klink et al. 2020): steer a point through a gate in a wall to a goal behind it.

Facts: docs/environments.md ("PointMass"); Klink et al., "Self-Paced Deep Reinforcement Learning", 2020.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.envs.interface import Distribution, FloatArray, IntArray, Step
from space_dist.errors import ConfigError
from space_dist.instances import ContextBounds

DT = 0.01  # seconds per inner step
INNER_STEPS = 10  # physics steps per action
FORCE = 1.5  # acceleration per unit of action
NOISE_STD = 0.05  # of the acceleration, per inner step and axis
ACTION_LIMIT = 10.0  # on each axis
POSITION_LIMIT = 4.0  # walls of the room, left, right, above and below
START = np.array([0.0, 0.0, 3.0, 0.0])  # x, vx, y, vy
GOAL = np.array([0.0, -3.0])
SUCCESS_DISTANCE = 0.25  # from the goal
REWARD_DECAY = 0.6  # per unit of distance to the goal
HORIZON = 100  # actions; the paper, appendix A
_BLOCK = 20  # actions whose noise is drawn together, when the first of them comes: most episodes end long before 100

BOUNDS: Final = ContextBounds(
    names=("gate_x", "gate_width", "friction"),
    low=np.array([-4.0, 0.5, 0.0]),
    high=np.array([4.0, 8.0, 4.0]),
    lower={"gate_width": (0.0, "closed_gates: true")},
)
"""PointMass (Klink et al. 2020): centre and width of the gate in the world's length units, friction in 1/s."""
BOUNDS_WITH_CLOSED_GATES: Final = ContextBounds(BOUNDS.names, np.array([-4.0, 0.0, 0.0]), BOUNDS.high)


def _draw_uniform(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    return rng.uniform(BOUNDS.low, BOUNDS.high, size=(n, 3))


def _draw_target(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    """The target N((2.5, 0.5, 0), sigma (4e-3, 3.75e-3, 2e-3)), *clipped* to the bounds.

    Two of its means lie on a lower bound, so about half of the gate widths are exactly 0.5 and half of the frictions
    exactly 0.
    """
    drawn = rng.normal((2.5, 0.5, 0.0), (4e-3, 3.75e-3, 2e-3), size=(n, 3))
    return np.clip(drawn, BOUNDS.low, BOUNDS.high)


def _draw_goal(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    """Gates uniform within the bounds, friction always in the middle of its own."""
    drawn = _draw_uniform(rng, n)
    drawn[:, 2] = (BOUNDS.low[2] + BOUNDS.high[2]) / 2.0
    return drawn


DISTRIBUTIONS: Final = {
    "pointmass_uniform": Distribution(
        description="PointMass, each feature uniform within its bounds",
        source="Klink et al. 2020 (the bounds)",
        bounds=BOUNDS,
        draw=_draw_uniform,
    ),
    "pointmass_target": Distribution(
        description="PointMass, N((2.5, 0.5, 0), sigma (4e-3, 3.75e-3, 2e-3)) clipped to the bounds, which puts "
        "about half of the gate widths at 0.5 and half of the frictions at 0",
        source="Klink et al. 2020 (the target distribution); the clipping is ours",
        bounds=BOUNDS,
        draw=_draw_target,
    ),
    "pointmass_goal": Distribution(
        description="PointMass, the gate uniform within its bounds, friction always 2: only the goal varies",
        source="the SPaCE paper's appendix on forgetting has such a set, without numbers; these are ours",
        bounds=BOUNDS,
        draw=_draw_goal,
    ),
}


class BatchedPointMass:
    """`n_slots` point masses. Context: (gate_x, gate_width, friction).

    State per slot: (x, vx, y, vy) in float64; observed as float32. An episode's noise, (horizon, inner steps, 2), comes
    from a generator of its own, so that it depends on nothing but its seed.

    With `closed_gates` gates may be as narrow as 0, which nothing gets through.
    """

    def __init__(self, n_slots: int, *, horizon: int = HORIZON, closed_gates: bool = False) -> None:
        if not isinstance(closed_gates, bool):
            raise ConfigError(f"closed_gates is {str(closed_gates)[:80]!r}; allowed are true and false")
        self.n_slots, self.horizon = n_slots, horizon
        limit = np.array([POSITION_LIMIT, np.inf, POSITION_LIMIT, np.inf], dtype=np.float32)
        self.observation_space = spaces.Box(-limit, limit, dtype=np.float32)
        self.action_space = spaces.Box(-ACTION_LIMIT, ACTION_LIMIT, shape=(2,), dtype=np.float32)
        self.context_bounds = BOUNDS_WITH_CLOSED_GATES if closed_gates else BOUNDS
        self._position = np.zeros((2, n_slots))  # x and y
        self._velocity = np.zeros((2, n_slots))
        self._context = np.zeros((3, n_slots))
        self._time = np.zeros(n_slots, dtype=np.int64)
        self._seeds = np.zeros(n_slots, dtype=np.uint64)
        self._noise = np.zeros((n_slots, horizon, INNER_STEPS, 2))
        self._drawn = np.zeros(n_slots, dtype=np.int64)  # actions whose noise is known
        self._random: dict[int, np.random.Generator] = {}  # where a slot's next noise comes from
        self._compiled: Callable[..., None] | None = None

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> NDArray[np.float32]:
        """Start new episodes at (0, 3), at rest."""
        self._position[:, slots] = START[[0, 2], None]
        self._velocity[:, slots] = START[[1, 3], None]
        self._context[:, slots] = contexts.T
        self._time[slots] = 0
        self._drawn[slots[self._seeds[slots] != seeds]] = 0  # who repeats an episode, to measure, has its noise
        self._seeds[slots] = seeds
        return self._observe()[slots]

    def step(self, actions: NDArray[np.generic]) -> Step:
        """Ten inner Euler steps. Crossing y = 0 outside the gate puts the mass at the wall and ends the episode."""
        for slot in np.flatnonzero((self._time >= self._drawn) & (self._drawn < self.horizon)).tolist():
            self._draw_noise(slot)
        crashed = self._advance(np.asarray(actions, dtype=np.float64))
        self._time += 1
        distance = np.hypot(self._position[0] - GOAL[0], self._position[1] - GOAL[1])
        return Step(
            observations=self._observe(),
            rewards=np.exp(-REWARD_DECAY * distance),
            terminated=crashed,
            truncated=(self._time >= self.horizon) & ~crashed,
            success=distance < SUCCESS_DISTANCE,
        )

    def _draw_noise(self, slot: int) -> None:
        """The next block of it. Not in `reset`: who only wants start states pays for none."""
        first = int(self._drawn[slot])
        if not first:
            self._random[slot] = np.random.default_rng(int(self._seeds[slot]))
        block = self._noise[slot, first : first + _BLOCK]
        self._random[slot].standard_normal(out=block)
        self._drawn[slot] = first + len(block)

    def compile_physics(self) -> None:
        """Have steps computed by a compiled twin from now on, with the same bits in a fraction of the time."""
        from space_dist.kernels.pointmass import Physics, prepare

        physics = Physics(DT, FORCE, NOISE_STD, ACTION_LIMIT, POSITION_LIMIT)
        self._compiled = functools.partial(prepare(), physics)

    def draw_unsolvable(self, rng: np.random.Generator, n: int) -> FloatArray:
        """`(n, 3)` contexts whose gate is closed, in all else uniform within the bounds.

        Raises ConfigError unless gates may be closed: any other lets somebody through.
        """
        if self.context_bounds != BOUNDS_WITH_CLOSED_GATES:
            raise ConfigError(
                "only with closed_gates: true (--kwarg closed_gates=true) is any instance unsolvable: gates of width 0"
            )
        drawn = _draw_uniform(rng, n)
        drawn[:, 1] = 0.0
        return drawn

    def _advance(self, actions: FloatArray) -> NDArray[np.bool_]:
        """Ten inner steps under (n_slots, 2) actions. Returns which slots hit the wall."""
        if self._compiled is not None:
            crashed = np.empty(self.n_slots, dtype=np.bool_)
            self._compiled(self._position, self._velocity, self._context, actions, self._noise, self._time, crashed)
            return crashed
        gate_x, gate_width, friction = self._context
        force = FORCE * np.clip(actions.T, -ACTION_LIMIT, ACTION_LIMIT)
        noise = self._noise[np.arange(self.n_slots), np.minimum(self._time, self.horizon - 1)]
        drive = np.ascontiguousarray(noise.transpose(1, 2, 0))  # (inner steps, 2, n_slots)
        drive *= NOISE_STD
        drive += force
        drive *= DT
        decay = 1.0 - DT * friction
        path = np.empty((INNER_STEPS + 1, 2, self.n_slots))
        path[0], velocity = self._position, self._velocity
        for inner in range(INNER_STEPS):
            position = path[inner + 1]
            np.multiply(velocity, DT, out=position)
            position += path[inner]
            np.minimum(position, POSITION_LIMIT, out=position)
            np.maximum(position, -POSITION_LIMIT, out=position)
            velocity *= decay
            velocity += drive[inner]
        self._position = path[-1].copy()
        return self._hit_wall(path, gate_x, gate_width)

    def _hit_wall(self, path: FloatArray, gate_x: FloatArray, gate_width: FloatArray) -> NDArray[np.bool_]:
        """Which slots crossed y = 0 outside their gate on `path` (inner + 1, 2, n_slots); they end at the wall."""
        crashed = np.zeros(self.n_slots, dtype=np.bool_)
        y = path[:, 1]
        if not ((y.min(axis=0) <= 0.0) & (y.max(axis=0) >= 0.0)).any():  # as in most steps
            return crashed
        y_before, y_after = y[:-1], y[1:]
        crossed = (y_before * y_after <= 0.0) & (y_before != y_after)
        for slot in np.flatnonzero(crossed.any(axis=0)):
            for inner in np.flatnonzero(crossed[:, slot]):
                (x0, y0), (x1, y1) = path[inner, :, slot], path[inner + 1, :, slot]
                wall_x = x0 + y0 / (y0 - y1) * (x1 - x0)
                half_width = gate_width[slot] / 2
                if abs(wall_x - gate_x[slot]) > half_width or half_width == 0.0:
                    crashed[slot] = True
                    self._position[:, slot] = wall_x, 0.0
                    self._velocity[:, slot] = 0.0
                    break
        return crashed

    def _observe(self) -> NDArray[np.float32]:
        observations = np.empty((self.n_slots, 4), dtype=np.float32)
        observations[:, ::2], observations[:, 1::2] = self._position.T, self._velocity.T
        return observations
