"""Curricula with one fault each, and without one, for `tests/test_curriculum_checker.py`."""

# ruff: noqa: ARG002 - signatures are the protocol's

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from space_dist.curricula import (
    GENERATED,
    Curriculum,
    Drawn,
    DrawnState,
    Draws,
    Feedback,
    Selection,
    State,
    Wants,
    proportional,
)
from space_dist.instances import ContextBounds, InstanceSet
from space_dist.seeding import Purpose, generator

_calls = itertools.count()


@dataclass(frozen=True)
class Scores(State):
    scores: NDArray[np.float64]


class Honest(Curriculum):
    """The better half by running mean of values; ties by the seed."""

    state_type: type[State] = Scores

    def __init__(self, instances: InstanceSet, seed: int, share: float = 0.5) -> None:
        self.instances, self.seed, self.size = instances, seed, max(1, round(share * len(instances)))

    def start(self) -> Any:
        state = self.made(0, np.zeros(len(self.instances)))
        return state, self.selection(state)

    def made(self, version: int, scores: NDArray[np.float64]) -> State:
        return Scores(version, scores)

    def step(self, state: Any, feedback: Feedback) -> Any:
        new = self.made(state.version + 1, self.scored(state, feedback))
        return new, self.selection(new), {"mean_score": new.scores.mean()}

    def scored(self, state: Any, feedback: Feedback) -> NDArray[np.float64]:
        return 0.5 * state.scores + 0.5 * feedback.values_after

    def order(self, state: Any) -> NDArray[np.int64]:
        ties = generator(self.seed, Purpose.CUSTOM).random(len(self.instances))
        return np.lexsort((ties, -state.scores))[: self.size]

    def selection(self, state: Any) -> Any:
        chosen = self.order(state)
        return Selection(
            state.version, self.instances.ids[chosen], self.instances.contexts[chosen], order_version=state.version
        )


class Drawing(Drawn):
    """By chance; asks for episodes, some of which may not end, and for a look at the first instances."""

    wants = Wants(episodes=True, probes=True)

    def step(self, state: DrawnState, feedback: Feedback) -> Any:
        assert feedback.episodes is not None
        weights = np.ones(len(self._instances))
        np.add.at(weights, feedback.episodes.indices, feedback.episodes.success)
        if feedback.probes is not None:
            np.add.at(weights, feedback.probes.indices, feedback.probes.success)
        new = DrawnState(state.version + 1, proportional(weights))
        return new, self.selection(new), {}

    def probes(self, state: DrawnState, episodes: Any) -> Any:
        return np.arange(2) if state.version % 2 else None


class Generates(Drawing):
    """Contexts from within the bounds."""

    wants = Wants()

    def __init__(self, instances: InstanceSet, *, seed: int, draws: Draws, bounds: ContextBounds) -> None:
        super().__init__(instances, seed=seed, draws=draws)
        self.bounds = bounds

    def step(self, state: DrawnState, feedback: Feedback) -> Any:
        new = DrawnState(state.version + 1, state.chances)
        return new, self.selection(new), {"spread": None}

    def selection(self, state: Any) -> Selection:
        random, n = generator(self._seed, Purpose.CUSTOM, state.version), self._draws.count
        contexts = random.uniform(self.bounds.low, self.bounds.high, size=(n, len(self.bounds.low)))
        return Selection(state.version, np.full(n, GENERATED), contexts, order_version=state.version, drawn=True)


# ---- not pure ----


class Unseeded(Honest):
    def scored(self, state: Any, feedback: Feedback) -> NDArray[np.float64]:
        return np.random.default_rng().random(len(state.scores))


class GlobalGenerator(Honest):
    def scored(self, state: Any, feedback: Feedback) -> NDArray[np.float64]:
        return np.random.random(len(state.scores))  # noqa: NPY002


class UnseededStart(Honest):
    def __init__(self, instances: InstanceSet, seed: int) -> None:
        super().__init__(instances, int(np.random.default_rng().integers(1 << 40)))


class CountsGlobally(Honest):
    def scored(self, state: Any, feedback: Feedback) -> NDArray[np.float64]:
        return super().scored(state, feedback) + next(_calls)


class Remembers(Honest):
    """In an attribute."""

    last: Any = 0.0

    def scored(self, state: Any, feedback: Feedback) -> NDArray[np.float64]:
        before, self.last = self.last, feedback.values_after
        return feedback.values_after - before


class KeepsItsGenerator(Honest):
    def __init__(self, instances: InstanceSet, seed: int) -> None:
        super().__init__(instances, seed)
        self.random = np.random.default_rng(seed)

    def scored(self, state: Any, feedback: Feedback) -> NDArray[np.float64]:
        return self.random.random(len(state.scores))


class NeedsItsStart(Honest):
    def start(self) -> Any:
        self.offset = 1.0
        return super().start()

    def scored(self, state: Any, feedback: Feedback) -> NDArray[np.float64]:
        return super().scored(state, feedback) + self.offset


class ChangesState(Honest):
    def scored(self, state: Any, feedback: Feedback) -> NDArray[np.float64]:
        state.scores[:] += feedback.values_after
        return state.scores.copy()


class ChangesFeedback(Honest):
    def scored(self, state: Any, feedback: Feedback) -> NDArray[np.float64]:
        feedback.values_after.sort()
        return super().scored(state, feedback)


class ProbesAtRandom(Drawing):
    def probes(self, state: DrawnState, episodes: Any) -> Any:
        return np.random.default_rng().integers(len(self._instances), size=30)


# ---- states ----


@dataclass(frozen=True)
class Listed(State):
    scores: Any


class StoresLists(Honest):
    state_type = Listed

    def made(self, version: int, scores: NDArray[np.float64]) -> State:
        return Listed(version, scores.tolist())

    def order(self, state: Any) -> NDArray[np.int64]:
        return np.arange(self.size)


class StoresObjects(StoresLists):
    def made(self, version: int, scores: NDArray[np.float64]) -> State:
        return Listed(version, np.array([{}, None]))


class StoresNumpyNumbers(StoresLists):
    def made(self, version: int, scores: NDArray[np.float64]) -> State:
        return Listed(version, np.int64(3))


@dataclass(frozen=True)
class Hiding(State):
    """Keeps an attribute that is no field."""

    scores: NDArray[np.float64]

    def __post_init__(self) -> None:
        object.__setattr__(self, "hidden", [])


class StoresBesideItsFields(Honest):
    """A state that counts in what no checkpoint holds."""

    state_type = Hiding

    def made(self, version: int, scores: NDArray[np.float64]) -> State:
        return Hiding(version, scores)

    def step(self, state: Any, feedback: Feedback) -> Any:
        new, _, numbers = super().step(state, feedback)
        object.__setattr__(new, "hidden", [*state.hidden, 1])
        return new, self.selection(new), {**numbers, "hidden": len(new.hidden)}


@dataclass(frozen=True)
class Refuses(State):
    scores: NDArray[np.float64]
    fresh: bool = dataclasses.field(default=True, init=False)


class CannotBeRestored(Honest):
    state_type = Refuses


class Undecorated(State):
    scores: NDArray[np.float64]


class NoDataclass(Honest):
    state_type = Undecorated


class NoStateType(Honest):
    state_type = dict


class OtherState(Honest):
    def made(self, version: int, scores: NDArray[np.float64]) -> State:
        return State(version)

    def order(self, state: Any) -> NDArray[np.int64]:
        return np.arange(self.size)


class ForgetsToCount(Honest):
    def made(self, version: int, scores: NDArray[np.float64]) -> State:
        return Scores(0, scores)


# ---- selections ----


class Empty(Honest):
    def order(self, state: Any) -> NDArray[np.int64]:
        return np.flatnonzero(state.scores > 1e9)


class IndicesForIds(Honest):
    def selection(self, state: Any) -> Any:
        chosen = self.order(state)
        return Selection(state.version, chosen, self.instances.contexts[chosen], order_version=state.version)


class OtherContexts(Honest):
    def selection(self, state: Any) -> Any:
        right = super().selection(state)
        return dataclasses.replace(right, contexts=right.contexts + 0.25)


class SortsIds(Honest):
    def selection(self, state: Any) -> Any:
        return dataclasses.replace(super().selection(state), ids=np.sort(super().selection(state).ids))


class SameOrder(Honest):
    def selection(self, state: Any) -> Any:
        return dataclasses.replace(super().selection(state), order_version=0)


class SelectsOtherwise(Honest):
    def step(self, state: Any, feedback: Feedback) -> Any:
        new, selection, numbers = super().step(state, feedback)
        return new, dataclasses.replace(selection, ids=selection.ids[::-1], contexts=selection.contexts[::-1]), numbers


class FewDraws(Drawing):
    def selection(self, state: Any) -> Selection:
        many = super().selection(state)
        return dataclasses.replace(many, ids=many.ids[:5], contexts=many.contexts[:5])


class OutOfBounds(Generates):
    def selection(self, state: Any) -> Selection:
        found = super().selection(state)
        return dataclasses.replace(found, contexts=found.contexts + 100.0)


class GeneratesASet(Generates):
    def selection(self, state: Any) -> Selection:
        return dataclasses.replace(super().selection(state), drawn=False)


class NoSelection(Honest):
    def selection(self, state: Any) -> Any:
        return super().selection(state).ids


class TwoAnswers(Honest):
    def step(self, state: Any, feedback: Feedback) -> Any:
        return super().step(state, feedback)[:2]


class ProbesNothing(Drawing):
    def probes(self, state: DrawnState, episodes: Any) -> Any:
        return np.array([], dtype=np.int64)


class ProbesOutside(Drawing):
    def probes(self, state: DrawnState, episodes: Any) -> Any:
        return np.array([0, len(self._instances)])


# ---- what it wants, says and raises ----


class WantsEnsemble(Honest):
    wants = Wants(ensemble=True)


class WantsAdvantages(Honest):
    wants = Wants(advantages=True)


class WantsNegatives(Honest):
    wants = Wants(episodes=True, advantages=True, advantage_part="postive")  # type: ignore[arg-type]


class WantsSuccess(Honest):
    wants = Wants(success=True)


class LearnsNot(Honest):
    """Has its first rounds played and not learned from, and has not said so before."""

    def selection(self, state: Any) -> Any:
        return dataclasses.replace(super().selection(state), learned=state.version > 2)


class LooksFirst(LearnsNot):
    wants = Wants(unlearned=True)


class WantsInWords(Honest):
    wants = ("episodes",)


class LogsNaN(Honest):
    wants = Wants(episodes=True)

    def step(self, state: Any, feedback: Feedback) -> Any:
        assert feedback.episodes is not None
        new, selection, _ = super().step(state, feedback)
        returns = feedback.episodes.returns
        return new, selection, {"mean_return": returns.mean() if len(returns) else np.float64("nan")}


class LogsArrays(Honest):
    def step(self, state: Any, feedback: Feedback) -> Any:
        new, selection, _ = super().step(state, feedback)
        return new, selection, {"scores": new.scores}


class Raises(Honest):
    def step(self, state: Any, feedback: Feedback) -> Any:
        raise KeyError("no such score")


class ForgetsToAsk(Honest):
    def scored(self, state: Any, feedback: Feedback) -> NDArray[np.float64]:
        return state.scores + feedback.episodes.returns.sum()  # type: ignore[union-attr, no-any-return]


class NeedsEpisodes(Honest):
    """Fails where none ended."""

    wants = Wants(episodes=True)

    def scored(self, state: Any, feedback: Feedback) -> NDArray[np.float64]:
        assert feedback.episodes is not None
        return state.scores + feedback.episodes.returns.max()


class NeedsSuccess(Honest):
    wants = Wants(episodes=True)

    def scored(self, state: Any, feedback: Feedback) -> NDArray[np.float64]:
        assert feedback.episodes is not None
        if np.isnan(feedback.episodes.success).any():
            raise ValueError("did it succeed?")
        return super().scored(state, feedback)


class ReadsSuccess(Honest):
    """Its scores become NaN, in silence, where success is not known."""

    wants = Wants(episodes=True)

    def step(self, state: Any, feedback: Feedback) -> Any:
        new, selection, _ = super().step(state, feedback)
        return new, selection, {}

    def scored(self, state: Any, feedback: Feedback) -> NDArray[np.float64]:
        assert feedback.episodes is not None
        scores = super().scored(state, feedback)
        np.add.at(scores, feedback.episodes.indices, feedback.episodes.success)
        return scores


class Copes(Honest):
    """Reads success where there is any, and has a way without."""

    wants = Wants(episodes=True)

    def scored(self, state: Any, feedback: Feedback) -> NDArray[np.float64]:
        assert feedback.episodes is not None
        scores = super().scored(state, feedback)
        np.add.at(scores, feedback.episodes.indices, np.nan_to_num(feedback.episodes.success))
        return scores


class Unmakeable(Honest):
    def __init__(self, instances: InstanceSet, seed: int) -> None:
        raise KeyError("no such setting")


class NeverChanges(Honest):
    def order(self, state: Any) -> NDArray[np.int64]:
        return np.arange(self.size)


def nothing(instances: InstanceSet) -> str:
    return f"a curriculum of {len(instances)}"


number = 3
