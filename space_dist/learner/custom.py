"""A learner of one's own, by import path: a class derived from one of Stable-Baselines3's, held to what is used of it.

Of an algorithm we call `__init__`, `_setup_model` and `train`, and, off-policy, `_on_step`. A class that writes another
method anew would see no call of it, and one whose attributes change while it trains would lose them at the first
resuming: both are said in a sentence instead (docs/your_learner.md).
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Mapping
from typing import Any, Final, NoReturn

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm

from space_dist.config import LearnerConfig
from space_dist.errors import ConfigError, SpaceDistError, nearest
from space_dist.learner.networks import ALGORITHMS, policy_class, policy_kwargs
from space_dist.system.arguments import listing, own_arguments, told
from space_dist.system.importing import load as imported

KEY: Final = "learner.import"
Numbers = Mapping[str, "bool | int | float"]

_NEVER_CALLED: Final = ("learn", "collect_rollouts", "predict", "_sample_action", "_store_transition", "dump_logs")
_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,199}")
_STORED_KINDS: Final = "biuf"  # of arrays: truth values, whole numbers, floats
_DEEPEST: Final = 6  # how far into an attribute's parts is looked

# What checkpoints hold of every algorithm, what every round sets anew, and what only counts for SB3's own loop.
_KEPT: Final = frozenset({
    "policy", "actor", "critic", "q_net", "log_ent_coef", "ent_coef_optimizer", "rollout_buffer", "replay_buffer",
    "_logger", "_custom_logger", "_n_updates", "_n_calls", "num_timesteps", "_current_progress_remaining",
    "exploration_rate", "_vec_normalize_env",
})  # fmt: skip
_KEPT_ENDS: Final = ("_target", "batch_norm_stats")


def algorithm_class(config: LearnerConfig) -> type[BaseAlgorithm]:
    """SB3's algorithm of a kind, or one's own. Raises ConfigError if that is none of this kind, or cannot work here."""
    base: type[BaseAlgorithm] = ALGORITHMS[config.kind]
    if config.import_path is None:
        return base
    module, _, name = config.import_path.partition(":")
    found = imported(config.import_path, KEY)
    if found is None:
        own = [known for known, value in vars(sys.modules[module]).items()
               if isinstance(value, type) and issubclass(value, BaseAlgorithm)]  # fmt: skip
        _refuse(config, f"{module!r} has no class {name!r}{nearest(name, own)}")
    if not isinstance(found, type) or not issubclass(found, base):
        _refuse(
            config,
            f"{name!r} is not derived from {base.__module__.partition('.')[0]}.{base.__name__}, which learner.kind: "
            f"{config.kind} stands for",
        )
    for method in _NEVER_CALLED:
        if getattr(found, method, None) is not getattr(base, method, None):
            _refuse(
                config,
                f"{name} has a {method}() of its own, which would never be called: transitions are collected by "
                "workers, and runs evaluated by them; what may differ is __init__, _setup_model and train",
            )
    # As SB3's own loops call it: on-policy without arguments, off-policy with these two.
    given = {"batch_size": 1, "gradient_steps": 1} if config.keeps_next_observations else {}
    try:
        inspect.signature(found.train).bind(None, **given)  # type: ignore[attr-defined]
    except TypeError as error:
        how = f"train({', '.join(['self', *given])})"
        _refuse(config, f"its train() is called as {how}: {error}")
    return found


def made(algorithm: Callable[..., Any], config: LearnerConfig, *arguments: Any, **settings: Any) -> Any:
    """An algorithm of these arguments, and of `learner.kwargs` if it is one's own. Raises ConfigError if it is none."""
    if config.import_path is None:
        return algorithm(*arguments, **settings)
    base = ALGORITHMS[config.kind]
    taken = {*inspect.signature(base.__init__).parameters, *settings}
    if both := sorted(taken & {*config.kwargs}):
        has_key = both[0] in type(config).model_fields
        raise ConfigError(
            f"learner.kwargs: {both[0]!r} is an argument of Stable-Baselines3's {config.kind}"
            + (
                f", and stands beside kwargs: learner.{both[0]}" if has_key
                else "; kwargs are those that your own class has beside them. What the config has no key for, your "
                "__init__ can set"
            )
        )  # fmt: skip

    def called() -> Any:
        try:
            return algorithm(*arguments, **settings, **config.kwargs)
        except TypeError as error:
            own = [name for name in own_arguments(algorithm, base=base) if name not in taken]
            if (text := told(error, config.kwargs, lambda word: _meant(word, own, config))) is None:
                raise
            raise TypeError(text) from error

    return _own_code(config, "be made of learner.kwargs", called)


def _meant(word: str, own: list[str], config: LearnerConfig) -> str:
    """What to say of an argument that a class does not take, behind that: the nearest, and where it stands."""
    keys = [name for name in type(config).model_fields if name not in own]
    hint = nearest(word, [*own, *keys])
    if beside := next((name for name in keys if f" {name!r}?" in hint), None):
        hint += f" That stands beside kwargs: learner.{beside}."
    return listing(hint, own)


def set_up(model: BaseAlgorithm, config: LearnerConfig) -> None:
    """Have a model make its networks. Raises ConfigError where those are others than what actors act with."""
    if config.import_path is None:
        model._setup_model()
        return
    _own_code(config, "be set up", model._setup_model)
    named = policy_class(config)
    asked = ALGORITHMS[config.kind].policy_aliases[named] if isinstance(named, str) else named
    if type(model.policy) is not asked:
        _refuse(
            config,
            f"it made a policy of the class {type(model.policy).__name__}, and actors act with {asked.__name__}: name "
            "a policy of your own in learner.policy",
        )
    wanted = policy_kwargs(config)
    others = sorted(name for name, value in wanted.items() if model.policy_kwargs.get(name) != value)
    if others or getattr(model, "use_sde", False):
        _refuse(
            config,
            f"it changed the policy's {others[0] if others else 'use_sde'}, and actors act with what the config says: "
            "leave policy_kwargs and use_sde as they are",
        )
    if model.device.type != "cpu":
        _refuse(config, f"it learns on {model.device}; learners of one's own learn on the CPU")


def saved(
    model: BaseAlgorithm, twin: BaseAlgorithm, config: LearnerConfig
) -> tuple[dict[str, NDArray[Any]], dict[str, bool | int | float]]:
    """What a checkpoint must hold of a class's own: arrays, and numbers, of its `extra_state()`.

    twin: a model just made, into which they are put back, to see that nothing gets lost.
    Raises SpaceDistError where `extra_state` gives what cannot be stored, and where a run that went on from here would
    have other attributes than this one.
    """
    extra: Any = getattr(model, "extra_state", dict)
    given = _own_code(config, "say what a checkpoint must hold", extra)
    if not isinstance(given, Mapping):
        _refuse(config, f"extra_state() must return a dictionary, not a {type(given).__name__}")
    arrays: dict[str, NDArray[Any]] = {}
    numbers: dict[str, bool | int | float] = {}
    for name, value in given.items():
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            _refuse(config, f"extra_state() names {name!r}; names are letters, digits, dot, hyphen and underscore")
        if type(value) in (bool, int, float):
            numbers[name] = value
        elif type(value) is np.ndarray and value.dtype.kind in _STORED_KINDS:
            arrays[name] = value.copy()
        else:
            _refuse(
                config,
                f"extra_state() gives {name} as {type(value).__name__}: a checkpoint holds int, float, bool and NumPy "
                "arrays of numbers (tensor.numpy(force=True), int(), float())",
            )
    load({**{name: array.copy() for name, array in arrays.items()}, **numbers}, twin, config)
    if lost := _differences(model, twin):
        _refuse(
            config,
            f"a run that goes on from a checkpoint would not have {', '.join(lost)} as training left it. Return it "
            "from extra_state() and set it in load_extra_state(); or name it in `transient`, if train() makes it anew "
            "each time",
        )
    return arrays, numbers


def load(extra: Mapping[str, Any], model: BaseAlgorithm, config: LearnerConfig) -> None:
    """Put back what `saved` gave."""
    taking: Any = getattr(model, "load_extra_state", None)
    if taking is None:
        if extra:
            _refuse(config, "it has an extra_state(), and no load_extra_state() that would put it back")
        return
    _own_code(config, "take back what its extra_state() gave", lambda: taking(dict(extra)))


def _refuse(config: LearnerConfig, sentence: str) -> NoReturn:
    raise ConfigError(f"{KEY} {config.import_path!r}: {sentence}")


def _own_code(config: LearnerConfig, what: str, call: Callable[[], Any]) -> Any:
    try:
        return call()
    except (Exception, SystemExit) as error:  # somebody else's code may raise anything
        text = str(error) if isinstance(error, SpaceDistError) else f"{type(error).__name__}: {str(error)[:200]}"
        raise ConfigError(f"{KEY} {config.import_path!r} cannot {what}: {text}") from error


def _differences(model: BaseAlgorithm, twin: BaseAlgorithm) -> list[str]:
    """The attributes by which one model will train otherwise than another, of those that no checkpoint holds anyway."""
    theirs = {id(parameter) for parameter in model.policy.parameters()}
    transient = set(getattr(model, "transient", ()))
    found = []
    for name, value in vars(model).items():
        if name in _KEPT or name.endswith(_KEPT_ENDS) or name in transient:
            continue
        if isinstance(value, torch.nn.Module) and all(id(parameter) in theirs for parameter in value.parameters()):
            continue  # a part of the policy, by another name
        if name not in vars(twin) or _content(value) != _content(vars(twin)[name]):
            found.append(name)
    return sorted(found)


def _content(value: Any, depth: int = 0) -> Any:
    """What two things have in common that are equal, to the bit, as far as can be told from outside."""
    if value is None or isinstance(value, bool | int | float | str | bytes | type | np.generic):
        return type(value), repr(value)
    if depth > _DEEPEST:
        return type(value)
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        # The bytes of an array of objects are addresses.
        return str(value.dtype), value.shape, value.tobytes() if value.dtype != object else repr(value.tolist())
    if isinstance(value, torch.nn.Module | torch.optim.Optimizer):
        value = value.state_dict()
    if isinstance(value, torch.Generator):
        value = value.get_state().numpy().tobytes()
    if isinstance(value, np.random.Generator):
        value = value.bit_generator.state
    if isinstance(value, Mapping):
        return [(_content(key, depth + 1), _content(part, depth + 1)) for key, part in value.items()]
    if isinstance(value, set | frozenset):
        return sorted(map(repr, value))
    if hasattr(value, "__iter__") and hasattr(value, "__len__"):
        return type(value), [_content(part, depth + 1) for part in value]
    return type(value), [(name, _content(part, depth + 1)) for name, part in getattr(value, "__dict__", {}).items()]
