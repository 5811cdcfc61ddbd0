"""What is wrong with a curriculum of one's own, in plain words: `space-dist curriculum check`.

A curriculum must be a pure function of state and feedback: it is asked in another process, or once more, whenever an
actor is lost or a run goes on. So a made-up history is walked, and every decision in it is made again: by the object
that made it, by new ones, and from a state that was stored as a checkpoint stores it; what should be equal is compared
bit by bit. Faults are looked for in an order in which each can be told from the ones before.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from space_dist.curricula.custom import Custom, make_custom
from space_dist.curricula.draws import Draws
from space_dist.curricula.interface import (
    GENERATED,
    Episodes,
    Feedback,
    FloatArray,
    IntArray,
    Probes,
    Selection,
    State,
    decode_state,
    encode_state,
)
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.instances import ContextBounds, InstanceSet
from space_dist.ledger import Checkpoint, decode_checkpoint, encode_checkpoint
from space_dist.seeding import Purpose, generator
from space_dist.system.findings import FaultError, Findings

DECISIONS: Final = 30
_DRAWS: Final = Draws(count=64, walks=4)
_LONGEST: Final = 20  # steps of an episode
_MOST_EPISODES: Final = 24  # that end in an iteration
_SEED: Final = 0
_START, _STEP, _SELECTION, _PROBES = "start()", "step()", "selection()", "probes()"


@dataclass(frozen=True)
class _Iteration:
    """One iteration, made up. flavour: what is uncommon about it, in words that follow a verb; often nothing."""

    episodes: Episodes
    values: FloatArray
    gradient_steps: int
    flavour: str


def check(
    import_path: str, instances: InstanceSet, bounds: ContextBounds, kwargs: Mapping[str, Any] = MappingProxyType({})
) -> Findings:
    """Look for every fault that a run would suffer from, in DECISIONS decisions on made-up feedback. All is seeded.

    bounds: of contexts. Raises ConfigError for a single instance.
    """
    if len(instances) < 2:
        raise ConfigError("it takes at least two instances to see what a curriculum chooses")
    findings = Findings()
    try:
        _Check(import_path, instances, bounds, kwargs, findings).run()
    except FaultError as fault:
        findings.faults.append(str(fault))
    return findings


class _Check:
    def __init__(
        self, import_path: str, instances: InstanceSet, bounds: ContextBounds, kwargs: Mapping[str, Any],
        findings: Findings,
    ) -> None:  # fmt: skip
        self._import_path, self._instances, self._bounds, self._kwargs = import_path, instances, bounds, kwargs
        self._findings = findings
        self._wants = self._make().wants

    def run(self) -> None:
        self._check_start()
        self._note_habits(self._check_history())
        if self._wants.episodes and not self._wants.probes and not self._wants.success:
            self._try_without_success()

    # ---- the checks ----

    def _check_start(self) -> None:
        """Where it begins is decided by seed and instances."""
        used = self._make()
        first, again, other = (_called(_START, one.start) for one in (used, used, self._make()))
        if (difference := _difference(again, other)) is not None or (
            difference := _difference(first, other)
        ) is not None:
            raise FaultError(
                f"start() is not a function of instances and seed: asked again, it gives another {_named(difference)}. "
                f"{_WHERE_FROM}"
            )

    def _check_history(self) -> list[Selection]:
        """Decisions of one object, each made again in every other way in which a run may come to make it."""
        used = self._make()
        state, selection = _called(_START, used.start)
        selections, values = [selection], generator(_SEED, Purpose.EPISODES).normal(size=len(self._instances))
        for decision in range(1, DECISIONS + 1):
            restored = self._check_stored(state, selection)
            iteration = self._iteration(decision, selection, values)
            feedback = self._feedback(used, state, iteration, values)
            answer = self._check_decision(used, (state, restored), feedback, decision, iteration.flavour)
            (state, selection, _), values = answer, iteration.values
            selections.append(selection)
        self._check_stored(state, selection)
        return selections

    def _check_decision(
        self, used: Custom, states: tuple[State, State], feedback: Feedback, decision: int, flavour: str
    ) -> tuple[State, Selection, Any]:
        """states: the one that the object returned, and the same as a checkpoint gives it back."""
        state, restored = states
        what = f"step(){flavour}"
        # Copies are handed over, so that a change in place is seen beside what was meant.
        given = copy.deepcopy((state, feedback))
        answer: tuple[State, Selection, Any] = _called(what, lambda: used.step(*given))
        for name, before, after in zip(("state", "feedback"), (state, feedback), given, strict=True):
            if (difference := _difference(before, after, name)) is not None:
                raise FaultError(
                    f"step() changes {difference}, which it was given, in place; whoever asks again would ask "
                    "something else. Copy it first"
                )
        begun = [copy.deepcopy((one, feedback)) for one in (state, state, restored)]
        new = [_called(f"{what}, of an object that made no decision before,", functools.partial(self._step_anew, *one),
                       hint=". What it remembers must be in its state") for one in begun]  # fmt: skip
        if (difference := _difference(new[0], new[1])) is not None:
            raise FaultError(
                f"two new objects, given the same state and feedback, give another {_named(difference)} each (decision "
                f"{decision}): it is not a function of these. {_WHERE_FROM}"
            )
        again = _called(what, lambda: used.step(*copy.deepcopy((state, feedback))))
        for one in (again, answer):
            if (difference := _difference(one, new[0])) is not None:
                raise FaultError(
                    f"the object remembers something that is not in its state: it gives another {_named(difference)} "
                    f"than a new one that is given the same state and feedback (decision {decision}). Put all that "
                    "changes, that of random generators included, into the state; attributes must stay as __init__ "
                    "made them"
                )
        if (difference := _difference(new[2], new[0])) is not None:
            raise FaultError(
                "the state does not survive storing: as a checkpoint gives it back, it leads to another "
                f"{_named(difference)} (decision {decision})"
            )
        return answer

    def _step_anew(self, state: State, feedback: Feedback) -> tuple[State, Selection, Any]:
        return self._make().step(state, feedback)

    def _check_stored(self, state: State, selection: Selection) -> State:
        """A checkpoint gives back what it was given, and another process selects by it what was selected."""
        kind = self._make().state_type
        arrays, numbers = encode_state(state)
        stored = decode_checkpoint(encode_checkpoint(Checkpoint(0, arrays, {"curriculum": numbers})))
        restored: State = _called(
            f"{kind.__name__}, made of its fields as they are stored,",
            lambda: decode_state(kind, stored.arrays, stored.data["curriculum"]),
        )
        if (difference := _difference(state, restored, kind.__name__)) is not None:
            raise FaultError(f"the state does not survive storing: {difference} comes back as another")
        again = _called(_SELECTION, lambda: self._make().selection(restored))
        if (difference := _difference(selection, again, "selection")) is not None:
            raise FaultError(
                f"selection() of a state gives another {difference} than start() or step() returned with it; a run "
                "that goes on would train on something else"
            )
        return restored

    def _note_habits(self, selections: Sequence[Selection]) -> None:
        """What is allowed, and costs something or says that nothing was learnt from the feedback."""
        if selections[0].drawn:
            return
        pairs = list(itertools.pairwise(selections))
        if all(_difference(one.ids, other.ids) is None for one, other in pairs):
            self._findings.notes.append(f"in {DECISIONS} decisions it selected the same instances, in the same order")
            if any(one.order_version != other.order_version for one, other in pairs):
                self._findings.notes.append(
                    "its order_version changes and its instances do not, so that the walk over them starts over each "
                    "time; keep it while ids stay"
                )

    def _try_without_success(self) -> None:
        """Most environments do not say whether an episode succeeded."""
        used = self._make()
        state, selection = used.start()
        values = np.zeros(len(self._instances))
        try:
            for decision in range(1, DECISIONS + 1):
                iteration = self._iteration(decision, selection, values)
                episodes = dataclasses.replace(
                    iteration.episodes, success=np.full(len(iteration.episodes.success), np.nan)
                )
                feedback = self._feedback(used, state, dataclasses.replace(iteration, episodes=episodes), values)
                known = dataclasses.replace(feedback, episodes=iteration.episodes)
                answer, told = used.step(state, feedback), self._step_anew(*copy.deepcopy((state, known)))
                if (unknown := _nan_of_one(answer[0], told[0])) is not None:
                    self._findings.notes.append(
                        "it reads the success of episodes without Wants(success=True): where the environment does not "
                        f"say whether an episode succeeded, {unknown} becomes NaN; if it has to know, say so, and "
                        "other environments are refused"
                    )
                    return
                (state, selection, _), values = answer, iteration.values
        except Exception as error:  # somebody else's code may raise anything
            text = str(error) if isinstance(error, SpaceDistError) else f"{type(error).__name__}: {error}"
            self._findings.notes.append(
                "where the environment does not say whether an episode succeeded (success is NaN), it fails: "
                f"{text[:300]}; if it has to know, say Wants(success=True), and other environments are refused"
            )

    # ---- what it is told ----

    def _make(self) -> Custom:
        try:
            return make_custom(
                self._import_path, self._kwargs,
                instances=self._instances, seed=_SEED, draws=_DRAWS, bounds=self._bounds,
            )  # fmt: skip
        except ConfigError as error:
            raise FaultError(str(error)) from None

    def _iteration(self, decision: int, selection: Selection, before: FloatArray) -> _Iteration:
        """One iteration: seeded, and by turns without an episode that ended, and without a gradient step."""
        random = generator(_SEED, Purpose.EPISODES, decision)
        idle, empty = decision % 7 == 3, decision % 5 == 2
        m = 0 if empty else int(random.integers(1, _MOST_EPISODES))
        places = np.arange(m) % len(selection.ids)
        ids = selection.ids[places]
        indices = np.where(ids == GENERATED, GENERATED, np.searchsorted(self._instances.ids, ids))
        returns = random.normal(size=m)
        episodes = Episodes(
            indices=indices, contexts=selection.contexts[places], returns=returns, discounted_returns=0.9 * returns,
            lengths=random.integers(1, _LONGEST, size=m), success=random.integers(2, size=m).astype(np.float64),
            start_values=random.normal(size=m),
            advantages=random.random(m) if self._wants.advantages else np.full(m, np.nan),
            running=indices[indices != GENERATED][:3],
        )  # fmt: skip
        values = before if idle else 0.9 * before + 0.3 * random.normal(size=len(before))
        flavour = " where no episode ended" if empty else " where no gradient step was made" if idle else ""
        return _Iteration(episodes, values, 0 if idle else 10, flavour)

    def _feedback(self, used: Custom, state: State, iteration: _Iteration, before: FloatArray) -> Feedback:
        episodes = iteration.episodes if self._wants.episodes else None
        return Feedback(
            version=state.version, values_before=before, values_after=iteration.values,
            gradient_steps=iteration.gradient_steps, episodes=episodes,
            probes=self._probed(used, state, episodes) if self._wants.probes else None,
        )  # fmt: skip

    def _probed(self, used: Custom, state: State, episodes: Episodes | None) -> Probes | None:
        """What it asks to be probed; by turns there is no room in the budget for that."""
        asked = [_called(_PROBES, functools.partial(one.probes, *copy.deepcopy((state, episodes))))
                 for one in (used, self._make())]  # fmt: skip
        if _difference(*asked) is not None:
            raise FaultError(
                "probes() is not a function of state and episodes: asked again, it names other instances. "
                f"{_WHERE_FROM}"
            )
        indices: IntArray | None = asked[0]
        if indices is None or state.version % 3 == 2:
            return None
        random, k = generator(_SEED, Purpose.PROBE_EPISODES, state.version), len(indices)
        success = random.integers(2, size=k).astype(np.float64)
        return Probes(indices, random.normal(size=k), random.integers(1, _LONGEST, size=k), success)


_WHERE_FROM: Final = (
    "Random numbers must come from space_dist.seeding: generator(seed, Purpose.CUSTOM, state.version); clocks, globals "
    "and class attributes may decide nothing"
)
_ANSWER: Final = ("state", "selection", "numbers")


def _difference(one: Any, other: Any, name: str = "") -> str | None:
    """Where two values first differ, bit by bit, as `state.last`; None: nowhere. Tuples are answers of a curriculum."""
    if isinstance(one, tuple) and isinstance(other, tuple):
        pairs = list(zip(_ANSWER, one, other, strict=False))
    elif dataclasses.is_dataclass(one) and type(one) is type(other):
        pairs = [(f"{name}.{each.name}", getattr(one, each.name), getattr(other, each.name))
                 for each in dataclasses.fields(one)]  # fmt: skip
    elif isinstance(one, dict) and isinstance(other, dict):
        pairs = [(f"{name}[{key!r}]", one.get(key), other.get(key)) for key in {**one, **other}]
    elif isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        same = (one.dtype, one.shape) == (other.dtype, other.shape) and one.tobytes() == other.tobytes()
        return None if same else name
    else:
        floats = isinstance(one, float) and isinstance(other, float)  # a NumPy float comes back from JSON as Python's
        equal = one == other or (one != one and other != other)  # NaN is itself here
        same = (floats or type(one) is type(other)) and equal
        return None if same else name
    found = (_difference(here, there, part) for part, here, there in pairs)
    return next((one for one in found if one is not None), None)


def _nan_of_one(one: State, other: State) -> str | None:
    """What of a state is NaN, or has one, where the other state has a number; None: nothing."""
    names = [field.name for field in dataclasses.fields(one)]
    return next((f"state.{name}" for name in names if _more_nan(getattr(one, name), getattr(other, name))), None)


def _more_nan(one: Any, other: Any) -> bool:
    here, there = np.asarray(one), np.asarray(other)
    floats = here.dtype.kind == there.dtype.kind == "f" and here.shape == there.shape
    return floats and bool((np.isnan(here) & ~np.isnan(there)).any())


def _named(part: str) -> str:
    return part or "answer"


def _called(what: str, call: Callable[[], Any], hint: str = "") -> Any:
    try:
        return call()
    except FaultError:
        raise
    except ConfigError as error:  # an answer that breaks the protocol
        raise FaultError(str(error)) from None
    except (Exception, SystemExit) as error:  # somebody else's code may raise anything
        raise FaultError(f"{what} fails: {type(error).__name__}: {str(error)[:300]}{hint}") from None
