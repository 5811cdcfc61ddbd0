"""Curricula that draw an instance for each episode, each with its own chance; the simplest draws them all alike."""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from space_dist.curricula.interface import (
    Curriculum,
    Episodes,
    Feedback,
    FloatArray,
    IntArray,
    Numbers,
    Selection,
    State,
    Wants,
)
from space_dist.instances import InstanceSet
from space_dist.seeding import Purpose, generator

Outcome = Literal["success", "return"]


@dataclass(frozen=True)
class Draws:
    """How many draws a round can use: `count`, a multiple of the number of `walks` (shards) that share it."""

    count: int
    walks: int

    def dealt(self, sequence: NDArray[Any]) -> NDArray[Any]:
        """`(count, ...)` reordered so that the walks, which begin spread over it, use up the head of `sequence` first.

        The e-th episode of walk w gets draw number e * walks + w.
        """
        return np.concatenate([sequence[walk :: self.walks] for walk in range(self.walks)])


@dataclass(frozen=True)
class DrawnState(State):
    """chances: (n,) of each instance to be drawn; their sum is 1."""

    chances: FloatArray


class Drawn(Curriculum):
    """Every episode's instance is drawn anew, by `DrawnState.chances`, which are settled once an iteration."""

    state_type: type[State] = DrawnState
    wants = Wants(episodes=True)

    def __init__(self, instances: InstanceSet, *, seed: int, draws: Draws) -> None:
        self._instances, self._seed, self._draws = instances, seed, draws

    def start(self) -> tuple[DrawnState, Selection]:
        """Every instance has the same chance."""
        state = DrawnState(version=0, chances=uniform(len(self._instances)))
        return state, self.selection(state)

    @abc.abstractmethod
    def step(self, state: Any, feedback: Feedback) -> tuple[State, Selection, Numbers]:
        """See `Curriculum`."""

    def selection(self, state: Any) -> Selection:
        """The draws of one iteration: a pure function of (seed, version, chances)."""
        return self._drawn(state.version, self._by_chance(state.version, state.chances))

    def _by_chance(self, version: int, chances: FloatArray) -> IntArray:
        random = generator(self._seed, Purpose.DRAWS, version)
        return random.choice(len(chances), size=self._draws.count, p=chances)

    def _drawn(self, version: int, indices: IntArray, *, learned: bool = True) -> Selection:
        dealt = self._draws.dealt(indices)
        return Selection(
            version, self._instances.ids[dealt], self._instances.contexts[dealt], order_version=version, drawn=True,
            learned=learned,
        )  # fmt: skip

    def _numbers(self, feedback: Feedback, chances: FloatArray) -> Numbers:
        """What all of these log: instances trained on, how many the next draws spread over, and mean values."""
        return {
            "size": distinct(feedback),
            "effective_size": effective_size(chances),
            **mean_values(feedback),
        }


class Uniform(Drawn):
    """Domain randomisation over the instance set: every episode's instance is drawn uniformly, with replacement."""

    def step(self, state: DrawnState, feedback: Feedback) -> tuple[DrawnState, Selection, Numbers]:
        """The same chances; values are reported, not used."""
        new = DrawnState(state.version + 1, state.chances)
        return new, self.selection(new), self._numbers(feedback, new.chances)


def uniform(n: int) -> FloatArray:
    """`(n,)` equal chances."""
    return np.full(n, 1.0 / n)


def proportional(weights: FloatArray, floor: float = 0.0) -> FloatArray:
    """`(n,)` chances in proportion to weights that are not negative; equal ones where no weight is above `floor`."""
    if not (weights > floor).any():
        return uniform(len(weights))
    shares = weights / weights.max()  # else the sum of large weights may be infinite
    chances: FloatArray = shares / shares.sum()
    return chances


def effective_size(chances: FloatArray) -> float:
    """How many instances the chances spread over: the exponential of their entropy."""
    positive = chances[chances > 0.0]
    return float(np.exp(-(positive * np.log(positive)).sum()))


def mean_values(feedback: Feedback) -> Numbers:
    """Mean sizes of the start values of all instances, before and after the iteration's updates, in reward units."""
    return {
        "mean_value_before": float(np.abs(feedback.values_before).mean()),
        "mean_value_after": float(np.abs(feedback.values_after).mean()),
    }


def needed_episodes(feedback: Feedback, curriculum: str) -> Episodes:
    """The iteration's. Raises ValueError, which names the curriculum that needs them, if there are none."""
    if feedback.episodes is None:
        raise ValueError(f"{curriculum} needs the iteration's episodes")
    return feedback.episodes


def outcomes(episodes: Episodes, outcome: Outcome, lowest: float, largest: float) -> FloatArray:
    """`(m,)` what episodes count as, in [0, 1]: their success, or their return, from `lowest` (0) to `largest` (1)."""
    if outcome == "success":
        return episodes.success
    return np.clip((episodes.returns - lowest) / (largest - lowest), 0.0, 1.0)


def distinct(feedback: Feedback) -> int:
    """How many different instances were trained on."""
    return 0 if feedback.episodes is None else len(np.unique(feedback.episodes.indices))
