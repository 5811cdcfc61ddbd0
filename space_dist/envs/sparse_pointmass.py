"""PointMass with a reward that most policies never see: 1 at the goal, where the episode ends, and nothing before.

The world is PointMass (`space_dist.envs.pointmass`, Klink et al. 2020); reward, end and radius are those of PointMass-s
of Tzannetos et al. 2023. That actions are in [-1, 1] is ours.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.envs.interface import Distribution, Step
from space_dist.envs.pointmass import ACTION_LIMIT, BOUNDS, GOAL, HORIZON, BatchedPointMass

GOAL_RADIUS: Final = 0.3  # within which, at the end of an action, the goal is reached
GATES: Final = (-3.0, 3.0)  # where a bimodal gate may be
GATE_WIDTH: Final = 0.5


def _draw_bimodal(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    """Narrow gates far to the left or to the right, each as likely; friction uniform within its bounds."""
    gate_x = rng.choice(GATES, size=n)
    friction = rng.uniform(BOUNDS.low[2], BOUNDS.high[2], size=n)
    return np.column_stack((gate_x, np.full(n, GATE_WIDTH), friction))


def _draw_mixed(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    """Each uniform within the bounds or bimodal, as likely."""
    anywhere = rng.random(n) < 0.5
    return np.where(anywhere[:, None], rng.uniform(BOUNDS.low, BOUNDS.high, size=(n, 3)), _draw_bimodal(rng, n))


DISTRIBUTIONS: Final = {
    "pointmass_bimodal": Distribution(
        description="PointMass, a gate of width 0.5 at x = -3 or x = 3, each as likely; friction uniform",
        source="after Klink et al. 2022 (CURROT), whose target has gates at both sides; that friction varies is ours",
        bounds=BOUNDS,
        draw=_draw_bimodal,
    ),
    "pointmass_mixed": Distribution(
        description="PointMass, each gate uniform within the bounds or bimodal, as likely",
        source="ours: narrow gates alone are found by no policy that starts from nothing",
        bounds=BOUNDS,
        draw=_draw_mixed,
    ),
}


class BatchedSparsePointMass(BatchedPointMass):
    """`n_slots` point masses. Context, state and observation are PointMass's; actions are in [-1, 1], times 10.

    Reward is 1 for the action at whose end the goal is nearer than 0.3, which ends the episode, and 0 for any other; so
    an episode's return is 1 if it succeeds, else 0.
    """

    def __init__(self, n_slots: int, *, horizon: int = HORIZON, closed_gates: bool = False) -> None:
        super().__init__(n_slots, horizon=horizon, closed_gates=closed_gates)
        self.action_space = spaces.Box(-1.0, 1.0, shape=(2,), dtype=np.float32)

    def step(self, actions: NDArray[np.generic]) -> Step:
        """As PointMass's, but for reward and end."""
        step = super().step(ACTION_LIMIT * np.asarray(actions, dtype=np.float64))
        reached = np.hypot(self._position[0] - GOAL[0], self._position[1] - GOAL[1]) < GOAL_RADIUS
        return dataclasses.replace(
            step, rewards=reached.astype(np.float64), terminated=step.terminated | reached,
            truncated=step.truncated & ~reached, success=reached,
        )  # fmt: skip
