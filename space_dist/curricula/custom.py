"""A curriculum of one's own, by import path: made, and held to the protocol of `interface` answer by answer.

What our own curricula are tested for, somebody else's is asked about at every decision, as far as it costs next to
nothing: an answer that breaks the protocol would otherwise fail later and elsewhere, in words about arrays, or not fail
at all. Whether a curriculum is pure, which takes asking it twice, is found out by `checker`.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import sys
from collections.abc import Callable, Mapping
from typing import Any, Final, NoReturn, get_args

import numpy as np

from space_dist.curricula.draws import Draws
from space_dist.curricula.interface import (
    GENERATED,
    AdvantagePart,
    Curriculum,
    Episodes,
    Feedback,
    IntArray,
    Numbers,
    Selection,
    State,
    Wants,
)
from space_dist.errors import ConfigError, SpaceDistError, nearest
from space_dist.instances import ContextBounds, InstanceSet
from space_dist.system import arguments
from space_dist.system.import_paths import without_colon
from space_dist.system.importing import load

KEY: Final = "curriculum.import"
_FROM_THE_RUN: Final = ("seed", "draws", "bounds")
_STORED_KINDS: Final = "biuf"  # of arrays: truth values, whole numbers, floats
_STORED: Final = "a state's fields are int, float, bool, None, or NumPy arrays of numbers"


def load_maker(import_path: str) -> Callable[..., Any]:
    """The class or function behind an import path. Raises ConfigError if there is none, or one of no curriculum."""
    where = f"{KEY} {import_path!r}"
    module, colon, name = import_path.partition(":")
    if not colon:
        example = "an import path has a colon, like my_package.my_module:MyCurriculum"
        raise ConfigError(f"{where}: {without_colon(import_path, Curriculum) or example}")
    found: Any = load(import_path, KEY)
    if not callable(found):
        raise ConfigError(f"{where}: {module!r} has no class {name!r}{nearest(name, _curricula_of(module))}")
    _refuse_another_class(where, found, module)
    maker: Callable[..., Any] = found
    return maker


def make_custom(
    import_path: str, kwargs: Mapping[str, Any], *, instances: InstanceSet, seed: int, draws: Draws,
    bounds: ContextBounds,
) -> Custom:  # fmt: skip
    """The curriculum that `my_package.my_module:MyCurriculum` makes of the instances and `kwargs`.

    The class, or function, is called with the instances; with `seed`, `draws` (how many a round can use) and `bounds`
    (of contexts), each if it has a parameter of that name; and with `kwargs`.
    Raises ConfigError if there is none, if it cannot be made so, or if what it makes is no `Curriculum`.
    """
    where, found = f"{KEY} {import_path!r}", load_maker(import_path)
    signature = _signature(found)
    offered: dict[str, Any] = {"seed": seed, "draws": draws, "bounds": bounds}
    given = {each: value for each, value in offered.items() if signature is None or each in signature.parameters}
    first = list(signature.parameters)[:1] if signature is not None else []  # which the instances are given as
    if taken := sorted({*_FROM_THE_RUN, *first} & set(kwargs)):
        raise ConfigError(f"curriculum.kwargs: {taken[0]!r} comes from the run, not from the config; leave it out")
    refused = f"{where} cannot be made of the instances and curriculum.kwargs"
    try:
        if signature is not None:
            signature.bind(instances, **given, **kwargs)
    except TypeError as error:
        if (text := _unknown_argument(error, found, kwargs)) is not None:
            raise ConfigError(f"{refused}: {text}") from None
        raise ConfigError(
            f"{refused}: {error}. It is called with the instances, "
            "then by name with seed, draws and bounds, as far as it has these parameters, and with curriculum.kwargs"
        ) from None
    try:
        own = found(instances, **given, **kwargs)
    except (Exception, SystemExit) as error:  # somebody else's code may raise anything
        if isinstance(error, TypeError) and (told := _unknown_argument(error, found, kwargs)) is not None:
            raise ConfigError(f"{refused}: {told}") from error
        text = str(error) if isinstance(error, SpaceDistError) else f"{type(error).__name__}: {str(error)[:200]}"
        raise ConfigError(f"{refused if kwargs else f'{where} cannot be made'}: {text}") from error
    if not isinstance(own, Curriculum):
        raise ConfigError(
            f"{where} made a {type(own).__name__}, which is no curriculum: derive its class from "
            "space_dist.curricula.Curriculum"
        )
    return Custom(own, where, instances, draws, bounds)


def _curricula_of(module: str) -> list[str]:
    """The classes of curricula that an imported module has."""
    return [known for known, value in vars(sys.modules[module]).items()
            if isinstance(value, type) and issubclass(value, Curriculum)]  # fmt: skip


def _refuse_another_class(where: str, found: object, module: str) -> None:
    """Refuse a class that is no curriculum's before it is called with what it does not expect."""
    if isinstance(found, type) and not issubclass(found, Curriculum):
        own = [known for known in _curricula_of(module) if getattr(sys.modules[module], known).__module__ == module]
        hint = f"; {module!r} has {', '.join(own[:3])}" if own else ""
        raise ConfigError(f"{where} is no curriculum: derive it from space_dist.curricula.Curriculum{hint}")


def _unknown_argument(error: TypeError, found: Callable[..., Any], kwargs: Mapping[str, Any]) -> str | None:
    """What to say of an argument in `kwargs` that a curriculum does not take; None if that is not what is wrong."""
    own = [name for name in arguments.own_arguments(found, positional=1) if name not in _FROM_THE_RUN]
    return arguments.told(error, kwargs, lambda word: arguments.listing(nearest(word, own), own))


def _signature(found: Callable[..., Any]) -> inspect.Signature | None:
    try:
        return inspect.signature(found)
    except (TypeError, ValueError):  # written in C
        return None


class Custom(Curriculum):
    """Somebody's own curriculum, whose answers are looked at before they are believed.

    where: what sentences about it begin with.
    Raises ConfigError, here and from every method, at the first answer that breaks the protocol. What the curriculum
    itself raises passes through, with a note of where.
    """

    def __init__(
        self, own: Curriculum, where: str, instances: InstanceSet, draws: Draws, bounds: ContextBounds
    ) -> None:
        self._own, self._where, self._instances, self._draws, self._bounds = own, where, instances, draws, bounds
        self.state_type, self.wants = self._checked_type(getattr(own, "state_type", None)), self._checked_wants()

    def start(self) -> tuple[State, Selection]:
        """See `Curriculum`."""
        answer: Any = self._own.start()
        if not isinstance(answer, tuple) or len(answer) != 2:
            self._refuse("start() must return (state, selection)")
        state, selection = answer
        self._look_at_state(state, 0, "start()")
        self._look_at_selection(selection, state, "start()")
        return state, selection

    def step(self, state: Any, feedback: Feedback) -> tuple[State, Selection, Numbers]:
        """See `Curriculum`. The numbers hold at least `size`, how many instances are selected."""
        try:
            answer: Any = self._own.step(state, feedback)
        except Exception as error:  # somebody else's code may raise anything
            if feedback.episodes is None and "NoneType" in str(error):
                self._refuse(
                    f"step() fails: {type(error).__name__}: {str(error)[:200]}. feedback.episodes is None, for the "
                    "class does not say that it wants them: wants = Wants(episodes=True)"
                )
            error.add_note(f"in {self._where}: step()")
            raise
        if not isinstance(answer, tuple) or len(answer) != 3:
            self._refuse("step() must return (state, selection, numbers for the log)")
        new, selection, numbers = answer
        self._look_at_state(new, state.version + 1, "step()")
        self._look_at_selection(selection, new, "step()")
        before = self._own.selection(state)
        if selection.order_version == before.order_version and not np.array_equal(selection.ids, before.ids):
            self._refuse(
                "step() selects other instances under the same order_version, and the walk over the old ones would go "
                "on; set order_version to the version at which ids last changed"
            )
        return new, selection, self._plain(numbers, selection)

    def selection(self, state: Any) -> Selection:
        """See `Curriculum`."""
        selection: Any = self._own.selection(state)
        self._look_at_selection(selection, state, "selection()")
        return selection  # type: ignore[no-any-return]

    def probes(self, state: Any, episodes: Episodes | None) -> IntArray | None:
        """See `Curriculum`."""
        indices: Any = self._own.probes(state, episodes)
        if indices is None:
            return None
        if not _is_vector(indices, np.int64) or not len(indices):
            self._refuse(
                f"probes() must return whole numbers, one index of an instance for each probe episode, or None where "
                f"nothing shall be probed; it returned {_described(indices)}"
            )
        if indices.min() < 0 or indices.max() >= len(self._instances):
            bad = indices[(indices < 0) | (indices >= len(self._instances))][0]
            self._refuse(f"probes() asks for index {bad}; the set has indices 0 to {len(self._instances) - 1}")
        return indices  # type: ignore[no-any-return]

    def _refuse(self, sentence: str) -> NoReturn:
        raise ConfigError(f"{self._where}: {sentence}")

    # ---- what it says of itself ----

    def _checked_type(self, kind: Any) -> type[State]:
        if not isinstance(kind, type) or not issubclass(kind, State):
            self._refuse(
                "its `state_type` must be a dataclass derived from space_dist.curricula.State, which says what it "
                f"remembers; it is {getattr(kind, '__name__', kind)!r}"
            )
        own = vars(kind).get("__annotations__", {})
        if own and "__dataclass_fields__" not in vars(kind):
            self._refuse(f"its state_type {kind.__name__} is no dataclass: write @dataclass(frozen=True) above it")
        if unset := [field.name for field in dataclasses.fields(kind) if not field.init]:
            self._refuse(
                f"{kind.__name__}.{unset[0]} cannot be restored from a checkpoint: a state is made of all its fields, "
                "and this one has init=False"
            )
        return kind

    def _checked_wants(self) -> Wants:
        wants: Any = getattr(self._own, "wants", None)
        if not isinstance(wants, Wants):
            self._refuse(f"its `wants` must be a space_dist.curricula.Wants, not {_described(wants)}")
        if wants.ensemble:
            self._refuse(
                "it wants the values of an ensemble, which is trained for curriculum.kind: vds alone; set "
                "Wants(ensemble=False)"
            )
        if wants.advantages and not wants.episodes:
            self._refuse("it wants advantages, which are told by episode, and no episodes: set Wants(episodes=True)")
        if wants.advantage_part not in get_args(AdvantagePart):
            self._refuse(
                f"its `wants` has advantage_part {wants.advantage_part!r:.60}"
                f"{nearest(str(wants.advantage_part), get_args(AdvantagePart))} Allowed: size, positive"
            )
        if wants.success and not wants.episodes:
            self._refuse("it wants success, which is told by episode, and no episodes: set Wants(episodes=True)")
        return wants

    # ---- what it answers ----

    def _look_at_state(self, state: Any, version: int, who: str) -> None:
        kind = self.state_type
        if type(state) is not kind:
            self._refuse(f"{who} returned a {type(state).__name__} for a state; its state_type is {kind.__name__}")
        for field in dataclasses.fields(kind):
            what = _unstorable(getattr(state, field.name))
            if what is not None:
                self._refuse(f"{kind.__name__}.{field.name} is {what}, which no checkpoint can store: {_STORED}")
        if type(state.version) is not int or state.version != version:
            self._refuse(f"{who} returned a state of version {state.version}, not {version}: versions count decisions")

    def _look_at_selection(self, selection: Any, state: State, who: str) -> None:
        if not isinstance(selection, Selection):
            self._refuse(f"{who} returned a {type(selection).__name__} for a selection")
        for name in ("version", "order_version"):
            number = getattr(selection, name)
            if type(number) is not int or not 0 <= number <= state.version:
                self._refuse(f"{who} selects with {name} {number!r}, and the state's version is {state.version}")
        if selection.version != state.version:
            self._refuse(f"{who} selects with version {selection.version}; the state's is {state.version}")
        ids, contexts, n = selection.ids, selection.contexts, len(self._instances)
        if not _is_vector(ids, np.int64):
            self._refuse(f"{who} selects ids that are {_described(ids)}, not whole numbers (int64) in one dimension")
        if not len(ids):
            self._refuse(f"{who} selects nothing: there must be an instance to train on")
        shape = (len(ids), len(self._instances.names))
        if not isinstance(contexts, np.ndarray) or contexts.dtype != np.float64 or contexts.shape != shape:
            self._refuse(f"{who} selects contexts that are {_described(contexts)}, not float64 of shape {shape}")
        places = np.minimum(np.searchsorted(self._instances.ids, ids), n - 1)
        known, generated = self._instances.ids[places] == ids, ids == GENERATED
        if not (known | generated).all():
            self._refuse(
                f"{who} selects an instance with id {ids[~(known | generated)][0]}, which is none of the set's {n}, "
                f"whose ids go from {self._instances.ids[0]} to {self._instances.ids[-1]} (that of index i is "
                "instances.ids[i])"
            )
        others = (self._instances.contexts[places] != contexts).any(axis=1) & known
        if others.any():
            self._refuse(f"{who} selects instance {ids[others][0]} with another context than its own")
        if generated.any():
            self._look_at_generated(contexts[generated], drawn=selection.drawn, who=who)
        if not selection.learned and not self.wants.unlearned:
            self._refuse(f"{who} selects what shall not be learned from; say so before: set Wants(unlearned=True)")
        if selection.drawn and len(ids) < self._draws.count:
            self._refuse(f"{who} draws {len(ids)} times; a round can use {self._draws.count} (draws.count)")

    def _look_at_generated(self, contexts: Any, *, drawn: bool, who: str) -> None:
        bounds = self._bounds
        outside = ~((contexts >= bounds.low) & (contexts <= bounds.high))
        if outside.any():
            row, column = np.argwhere(outside)[0]
            self._refuse(
                f"{who} generates a context with {bounds.names[column]} = {contexts[row, column]:g}, not within "
                f"[{bounds.low[column]:g}, {bounds.high[column]:g}]"
            )
        if not drawn:
            self._refuse(f"{who} generates contexts (id {GENERATED}) that are not drawn: set Selection(drawn=True)")

    def _plain(self, numbers: Any, selection: Selection) -> Numbers:
        if not isinstance(numbers, Mapping):
            self._refuse(f"step() must return its numbers for the log as a dictionary, not {_described(numbers)}")
        found: Numbers = {"size": len(np.unique(selection.ids))}
        for name, value in numbers.items():
            number = value.item() if isinstance(value, np.generic) else value
            if not isinstance(name, str) or not name.isidentifier():
                self._refuse(f"step() logs {name!r}: names in the log are letters, digits and underscores")
            if not (number is None or isinstance(number, bool | int | float)):
                self._refuse(f"step() logs {name} = {_described(value)}; the log takes int, float, bool and None")
            if isinstance(number, float) and not math.isfinite(number):
                self._refuse(f"step() logs {name} = {number}, which is no number: log None where there is none")
            found[name] = number
        if not isinstance(found["size"], int):
            self._refuse(f"step() logs size = {found['size']}; it is how many instances are selected")
        return found


def _is_vector(value: Any, kind: type[np.generic]) -> bool:
    return isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype == kind


def _unstorable(value: Any) -> str | None:
    """What a field of a state is, if a checkpoint could not give it back; None: it could."""
    if value is None or isinstance(value, float) or type(value) in (bool, int):
        return None
    if isinstance(value, np.generic):
        return f"a NumPy number ({value.dtype}; int(), float() or bool() make it plain)"
    if type(value) is np.ndarray and value.dtype.kind in _STORED_KINDS:
        return None
    return _described(value)


def _described(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"an array of dtype {value.dtype} and shape {value.shape}"
    return "nothing" if value is None else f"a {type(value).__name__}"
