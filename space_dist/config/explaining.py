"""The schema in sentences: what every key means, and what is wrong with one."""

from __future__ import annotations

import json
import keyword
import re
import types
from collections.abc import Iterator, Mapping, Sized
from typing import Annotated, Any, Final, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel

from space_dist.config.curriculum import CustomConfig
from space_dist.config.learner import LearnerSection
from space_dist.config.quoting import short
from space_dist.config.run import RunConfig
from space_dist.config.sections import CurriculumSection, EnvConfig
from space_dist.config.tracking_uri import UriError
from space_dist.config.wanted import is_choice, item_of, wanted, words_of
from space_dist.errors import misspelt, nearest, with_changes

# What scripts with SB3 say, and where a config says it.
_SB3_NAMES = {
    "lr": "learner.learning_rate",
    "learning_rate": "learner.learning_rate",
    "n_envs": "rollout.shards * rollout.slots",
    "num_envs": "rollout.shards * rollout.slots",
    "total_timesteps": "budget.steps",
    "timesteps": "budget.steps",
    "env_id": "env.id",
    "env_kwargs": "env.kwargs",
    "eval_freq": "evaluation.every_steps",
    "n_eval_episodes": "evaluation.episodes",
    "tensorboard_log": "tracking",
    "policy_kwargs": "learner.net_arch, learner.activation and the like",
    "algo": "learner.kind",
    "normalize": "learner.normalize_observations and learner.normalize_rewards",
    "norm_obs": "learner.normalize_observations",
    "norm_reward": "learner.normalize_rewards",
    "save_freq": "checkpoint.every_rounds",
    "train_freq": "learner.n_steps or learner.n_episodes",
    "gradient_steps": "learner.gradient_steps_per_step",
    "action_noise": "learner.action_noise_std (of td3)",
}

SET_BY_OWN_CLASS = {
    "clip_range_vf": ("ppo", "recurrent_ppo"), "sub_sampling_factor": ("trpo",), "target_entropy": ("sac",),
}  # fmt: skip
"""Stable-Baselines3's arguments that have no key, and that a class of one's own can set: the kinds that have each."""
NOT_HERE = (
    "use_sde", "sde_sample_freq", "use_sde_at_warmup", "rollout_buffer_class", "rollout_buffer_kwargs",
    "replay_buffer_class", "replay_buffer_kwargs", "optimize_memory_usage",
)  # fmt: skip
"""Stable-Baselines3's arguments that a run cannot have."""

_TAKES_KWARGS = {EnvConfig: "the environment", CustomConfig: "a curriculum of your own"}
_CUSTOM = "custom"
_OWN_CURRICULUM = f"a curriculum of your own, which import names, has `kind: {_CUSTOM}`"

# Of keys that some take another to be instead of: what stands behind a sentence about their lack.
_BESIDE: Final = {
    "budget.steps": ": budget.episodes is a limit beside it, and the one that is reached first ends a run",
}


def schema(of: type[BaseModel] = RunConfig) -> Iterator[tuple[str, str, str, str]]:
    """(key, type, default, explanation) of every field of a file, in order; NAME in a key is of the user's choosing."""
    yield from _describe(of, "")


def _describe(model: type[BaseModel], prefix: str) -> Iterator[tuple[str, str, str, str]]:
    for name, field in model.model_fields.items():
        key, inner = f"{prefix}{_key(name, field)}", _models(field) or _items(field)
        if (named := _by_name(field)) is not None:
            key, inner = f"{key}.NAME", [named]
        if not inner:
            default = "required" if field.is_required() else json.dumps(field.get_default(), default=str)
            yield key, _type_name(field), default, " ".join((field.description or "").split())
        for section in inner:
            tag = f" ({section.model_fields['kind'].annotation.__args__[0]})" if len(inner) > 1 else ""  # type: ignore[union-attr]
            about = (None if tag else field.description) or section.__doc__ or ""
            yield f"{key}{tag}", "section", "", " ".join(about.split())
            yield from _describe(section, f"{key}.")


def _type_name(field: Any) -> str:
    name = _in_words(field.annotation)
    limits = [f"{symbol} {getattr(item, attribute)}" for item in field.metadata
              for attribute, symbol in (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="))
              if hasattr(item, attribute)]  # fmt: skip
    return " ".join([name, *limits])


def _in_words(annotation: Any) -> str:
    """A type as the schema names it: `int | null`, `list of float`, `dict[str, list of any]`."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _in_words(inner[0])
    if origin in (Union, types.UnionType):
        return " | ".join(map(_in_words, inner))
    if origin in (tuple, list):
        count = f"{len(inner)} " if origin is tuple and Ellipsis not in inner else ""
        return f"list of {count}{_in_words(inner[0])}"
    if origin is dict:
        return f"dict[{', '.join(map(_in_words, inner))}]"
    if origin is not None:
        return str(annotation).replace("typing.", "")
    return {types.NoneType: "null", Any: "any"}.get(annotation) or str(annotation.__name__)


def explain(
    fault: Any, root: type[BaseModel], source: str, origins: Mapping[str, str], data: Mapping[str, Any]
) -> str:  # fmt: skip
    """A fault that pydantic found in a config of the schema `root`: where it lies, what it is, and what is allowed.

    fault: one of `ValidationError.errors()`. source: the file. origins: which keys came from elsewhere. data: all that
    was checked.
    """
    path, model, field, value = _locate(fault["loc"], root)
    # Pydantic places a tag's fault at the section; the key that people wrote is its `kind`.
    if fault["type"].startswith("union_tag"):
        path.append("kind")
    key = ".".join(path)
    # An override's key may be a section above the fault, or one below it.
    related = (
        origin for name, origin in origins.items() if f"{key}.".startswith(f"{name}.") or name.startswith(f"{key}.")
    )
    where = next(related, source)
    kind, given = fault["type"], fault.get("input")
    context = fault.get("ctx", {})
    if where == source and kind in ("extra_forbidden", "missing") and (of_kind := origins.get(f"{path[0]}.kind")):
        where = f"{source} with {of_kind}"  # by which the section has other keys than the file's
    if kind == "extra_forbidden":
        if where.startswith(f"{source} with ") and (told := _of_another_kind(path, model, origins, data)):
            return f"{where}: {told}"
        return f"{where}: {key}: unknown key{_what_is_known(path, model, root, given, data)}"
    options = _sections(field) if field else []
    if kind == "missing" and isinstance(fault["loc"][-1], int):  # of a list of so many
        return explain({**fault, "type": "too_short", "loc": fault["loc"][:-1]}, root, source, origins, data)
    if kind == "missing":
        way_out = f"; `space-dist config schema {key}` explains it" if root is RunConfig else ""
        if root is not RunConfig and keyword.iskeyword(path[-1]):  # the key is an argument, and Python's own word
            way_out = f"; as an argument it is written **{{{path[-1]!r}: ...}}"
        needed = f": a section with {needs}" if (needs := _needs(options)) else ""
        if key == "budget.steps" and isinstance(given, Mapping) and "episodes" in given:
            needed = _BESIDE[key]
        return f"{where}: {key}: this key is required{needed}{way_out}{_allowed_kinds(options)}"
    if kind in ("model_type", "model_attributes_type"):
        # An item of a list, or what a user's own name stands for, is no field: then the model is its own.
        named = [one for one in (*options, model) if one and one.__name__ == context.get("class_name")]
        return f"{where}: {key or 'the whole file'}: {_no_section(given, named or options)}"
    if kind.startswith("union_tag"):
        tags = [tag.strip("' ") for tag in str(context.get("expected_tags") or _tags(path[0])).split(",")]
        return f"{where}: {key}: {_no_kind(given, tags)}"
    if kind == "value_error":
        message = str(context.get("error", fault["msg"]))
        if isinstance(given, Mapping):  # a section whose keys do not go together; the message names them
            if not key:
                return f"{with_changes(source, message, origins)}: {message}"
            changed = " ".join(dict.fromkeys(
                origin for name, origin in origins.items()
                if name.startswith(f"{key}.") and re.search(rf"\b{re.escape(name[len(key) + 1:])}\b", message)
            ))  # fmt: skip
            return f"{f'{source} with {changed}' if changed else where}: {key}: {message}"
        # A value is not repeated here: a URI may hold a password.
        if isinstance(context.get("error"), UriError):
            return f"{where}: {key}: {message}"
        if given is None:
            return f"{where}: {key}: is empty; {message}"
        return f"{where}: {key}: {message}, not {short(given)}"
    if given is None:
        return f"{where}: {key}: is empty; give it {_what_to_give(field, value, fault)}{_BESIDE.get(key, '')}"
    if kind == "literal_error" and isinstance(given, str) and not is_choice(value):
        words = re.findall(r"'([^']+)'", str(context.get("expected")))
        return f"{where}: {key}: {short(given)} is not known{nearest(given, words)} Allowed: {', '.join(words)}"
    if kind == "invalid_key" or fault["loc"][-1] == "[key]":  # of a section, or of a user's own names
        return f"{where}: {key.removesuffix('.[key]')}: a key must be a text; write it in quotes"
    return f"{where}: {key or 'the whole file'}: {_no_such_value(field, value, fault)}"


def _no_such_value(field: Any, value: Any, fault: Any) -> str:
    """What to say of a value that its key cannot have: what it must be. field, value: see `_Place`."""
    kind, given = fault["type"], fault.get("input")
    whole = is_choice(value) or not kind.endswith("_type")
    words = wanted(value, field.metadata if field else (), whole=whole)
    if kind == "finite_number":
        words = words.replace("a number", "a finite number")
    if "a value" in words:  # of no type that has words
        return f"{short(given)}: {fault['msg']}"
    if kind.endswith("too_long") and not is_choice(value) and isinstance(given, Sized):
        return f"must be {words}, not of {len(given):,}"
    hint = nearest(given, words_of(value)).removesuffix(".") if isinstance(given, str) else ""
    if kind == "string_type" and not is_choice(value) and isinstance(given, int | float):
        hint = "; write it in quotes"
    return f"must be {words}, not {short(given)}{hint}"


def _what_to_give(field: Any, value: Any, fault: Any) -> str:
    """What to write in place of nothing. field: of the key that is empty; None for what stands in a list or by name."""
    if field is None:
        return f"{wanted(value)}, or leave it out"
    what = wanted(value, field.metadata)
    if fault["type"] == "tuple_type" and not any(getattr(limit, "min_length", 0) for limit in field.metadata):
        what += ", [] for none"
    return what if field.is_required() else f"{what}, or leave the key out"


def _no_kind(given: object, tags: list[str]) -> str:
    """What to say of a section whose kind is missing, or not known. tags: those that are."""
    kind = given.get("kind") if isinstance(given, Mapping) else given
    what = "this key is required" if kind is None else f"{short(kind)} is not known"
    allowed = f"Allowed: {', '.join(tags)}"
    if isinstance(given, Mapping) and given.get("import") is not None:
        if _CUSTOM in tags:
            return f"{what}: {_OWN_CURRICULUM}"
        return f"{what}: beside import it says which of Stable-Baselines3's classes yours is derived from. {allowed}"
    return f"{what}. {allowed}" if kind is None else f"{what}{nearest(str(kind), tags)} {allowed}"


def _what_is_known(
    path: list[str], model: type[BaseModel] | None, root: type[BaseModel], given: object, data: Mapping[str, Any]
) -> str:
    """What to say of a key that a file may not have, behind "unknown key". model: the section that it stands in."""
    key = path[-1]
    if key == "import" and model is not None and issubclass(model, CurriculumSection):
        return f"; {_OWN_CURRICULUM}"
    if root is RunConfig and (meant := what_sb3_calls(key)) is not None:
        return f". {meant}"
    if root is RunConfig and len(path) == 1 and (sections := _sections_with(key)):
        return f"; keys stand in sections: {' or '.join(f'{section}.{key}' for section in sections)}"
    if root is RunConfig and len(path) > 1 and key in RunConfig.model_fields:
        return f": {key} stands outside of {path[0]}"
    allowed = _names(model) if model else []
    of_sb3 = _of_sb3_alone(path, data)
    taker = _taker(model, data.get(path[0])) if isinstance(given, bool | int | float | str) else None
    hint = "." if key in of_sb3 else (misspelt if taker else nearest)(key, [*allowed, *of_sb3])
    if model is not None and (field := model.model_fields.get(key)) is not None:  # what Python calls it
        hint = f"; did you mean {_key(key, field)!r}?"
    if hint == "." and root is RunConfig and len(path) == 1:  # misspelt, and without its section
        below = {name: f"{section}.{name}" for section in allowed for name in _names_below(section)}
        close = nearest(key, below)
        hint = next((f"; did you mean {whole!r}?" for name, whole in below.items() if f" {name!r}?" in close), hint)
    told = next((said for name, said in of_sb3.items() if key == name or f" {name!r}?" in hint), "")
    if told:
        return f"{hint} {told}. Allowed here: {', '.join(allowed)}"
    way_out = "" if taker is None or hint != "." else f" What {taker} takes stands in kwargs: {short({key: given})}."
    return f"{hint}{way_out} Allowed here: {', '.join(allowed)}"


def _of_another_kind(
    path: list[str], model: type[BaseModel] | None, origins: Mapping[str, str], data: Mapping[str, Any]
) -> str:  # fmt: skip
    """One sentence about all that a file's section says for the kind that it had before another was set; else empty."""
    name, section = path[0], data.get(path[0])
    if len(path) != 2 or model is None or not isinstance(section, Mapping) or name not in RunConfig.model_fields:
        return ""
    own, of_all = _names(model), _names_below(name)
    left = [key for key in section if key in of_all and key not in own and f"{name}.{key}" not in origins]
    if path[1] not in left:
        return ""
    kind = section["kind"]
    in_python = origins[f"{name}.kind"].startswith("overrides")
    instead = f"overrides={{{name!r}: {{'kind': {kind!r}}}}}" if in_python else f"--set '{name}={{kind: {kind}}}'"
    return f"{instead} puts another section in place of the file's, of which {kind} has no {', no '.join(left)}"


def _of_sb3_alone(path: list[str], data: Mapping[str, Any]) -> dict[str, str]:
    """Arguments of Stable-Baselines3's that have no key beside a key of a learner's, and what to say of each."""
    section = data.get(path[0])
    if path[:-1] != ["learner"] or not isinstance(section, Mapping):
        return {}
    kind = section.get("kind")
    own = f"Stable-Baselines3's {kind} has it, a config no key for it: a class of your own can set it (learner.import)"
    settable = {name: own for name, kinds in SET_BY_OWN_CLASS.items() if kind in kinds}
    return settable | dict.fromkeys(NOT_HERE, "Stable-Baselines3 has it, and runs here do without")


def _taker(model: type[BaseModel] | None, section: object) -> str | None:
    """What takes the kwargs of a section; None for one that has none."""
    if model is not None and issubclass(model, LearnerSection):
        has_own = isinstance(section, Mapping) and section.get("import") is not None
        return "a learner of your own" if has_own else None
    return _TAKES_KWARGS.get(model) if model else None


def _no_section(given: object, options: list[type[BaseModel]]) -> str:
    """What to say of a value that stands where a section should. options: what the section may be."""
    needs = _needs(options)
    if given is None:
        way_out = f"it needs {needs}" if needs else "give it keys and values, or leave the key out"
        keys = "" if len(options) != 1 else f". Allowed here: {', '.join(_names(options[0]))}"
        return f"the section is empty: {way_out}{keys or _allowed_kinds(options)}"
    kinds = _kinds(options)
    if isinstance(given, str) and given in kinds:
        return f"{short(given)} is no section; write {{kind: {given}}}"
    needed = f", and needs {needs}" if needs else ""
    return f"{short(given)} is no section: it takes keys and values{needed}{_allowed_kinds(options)}"


def _needs(options: list[type[BaseModel]]) -> str:
    """The keys that a section cannot do without, whichever of `options` it is: `train and test`; often empty."""
    if kinds := _kinds(options):
        return f"a kind, like `kind: {kinds[0]}`"
    fields = options[0].model_fields if options else {}
    required = [_key(name, field) for name, field in fields.items() if field.is_required()]
    return " and ".join(filter(None, (", ".join(required[:-1]), *required[-1:])))


def _names(section: type[BaseModel]) -> list[str]:
    return [_key(name, field) for name, field in section.model_fields.items()]


def _kinds(options: list[type[BaseModel]]) -> list[str]:
    """What tells several sections apart; empty for a single one."""
    return [str(get_args(one.model_fields["kind"].annotation)[0]) for one in options] if len(options) > 1 else []


def _allowed_kinds(options: list[type[BaseModel]]) -> str:
    kinds = _kinds(options)
    return f". Allowed: {', '.join(kinds)}" if kinds else ""


def what_sb3_calls(name: str) -> str | None:
    """A sentence that says what a word of Stable-Baselines3's is in a run's config; None for any other."""
    return f"What Stable-Baselines3 calls {name} is {_SB3_NAMES[name]} here" if name in _SB3_NAMES else None


def _sections_with(key: str) -> list[str]:
    """The sections of a run's config that have such a key, of whatever kind they are."""
    return [
        name for name, field in RunConfig.model_fields.items()
        if any(key in model.model_fields for model in _models(field))
    ]  # fmt: skip


def _names_below(section: str) -> list[str]:
    return [name for model in _models(RunConfig.model_fields[section]) for name in _names(model)]


def _tags(key: str) -> str:
    return ", ".join(_kinds(_models(RunConfig.model_fields[key])))


class _Place(NamedTuple):
    path: list[str]
    """Pydantic's location, without the tags of unions."""
    model: type[BaseModel] | None
    """The section it lies in."""
    field: Any
    """What lies there; None for what is no key but stands in a list, or behind a user's own name."""
    value: Any
    """Its type."""


def _locate(location: tuple[int | str, ...], root: type[BaseModel]) -> _Place:
    path: list[str] = []
    field: Any = None
    value: Any = None
    model: type[BaseModel] | None = root
    options: list[type[BaseModel]] = []
    # What each item of a list, or of a user's own names, stands for, where the next part is one.
    named: type[BaseModel] | None = None
    alternative = False  # whether the next part names the one that a value was taken for
    for part in location:
        if alternative:
            alternative = False
            continue
        if named is not None:
            path.append(str(part))
            model, named, field = named, None, None
            continue
        tagged = [option for option in options if get_args(option.model_fields["kind"].annotation)[0] == part]
        if tagged:
            model, options = tagged[0], []
            continue
        if isinstance(part, str) and model is None:
            if get_origin(value) is dict:  # a user's own name
                path.append(part)
                field, value = None, item_of(value)
            continue  # or the name pydantic gives to one alternative of a value, like int or literal['log']
        path.append(str(part))
        field = _field(model, str(part)) if model else None
        value = field.annotation if field else item_of(value)
        inner = _models(field) if field else []
        if field is not None and part != location[-1]:
            model = inner[0] if len(inner) == 1 else None
            alternative = model is not None and len(_annotations(field).keys() - {types.NoneType}) > 1
            options = inner if len(inner) > 1 else []
            named = next(iter(_items(field)), None) or _by_name(field)
    return _Place(path, model, field, value)


def _items(field: Any) -> list[type[BaseModel]]:
    """The section that each item of a list is, in a field that is such a list."""
    of = get_args(field.annotation)[:1] if get_origin(field.annotation) is tuple else ()
    return [one for one in of if isinstance(one, type) and issubclass(one, BaseModel)]


def _by_name(field: Any) -> type[BaseModel] | None:
    """The section that each name of a user's own stands for, in a field that maps names to sections."""
    if get_origin(field.annotation) is not dict:
        return None
    value = get_args(field.annotation)[1]
    return value if isinstance(value, type) and issubclass(value, BaseModel) else None


def _models(field: Any) -> list[type[BaseModel]]:
    return [one for one in _annotations(field) if isinstance(one, type) and issubclass(one, BaseModel)]


def _sections(field: Any) -> list[type[BaseModel]]:
    """The sections that a field may be; empty where it may be something else, too."""
    found = _models(field)
    return found if len(found) == len(_annotations(field).keys() - {types.NoneType}) else []


def _annotations(field: Any) -> dict[Any, None]:
    """What a field may be, in order."""
    union = get_origin(field.annotation) in (Union, types.UnionType)
    alternatives = get_args(field.annotation) if union else [field.annotation]
    return {get_args(one)[0] if get_origin(one) is Annotated else one: None for one in alternatives}


def _field(model: type[BaseModel], key: str) -> Any:
    """A section's field by what a config calls it; None if there is none."""
    return next((field for name, field in model.model_fields.items() if _key(name, field) == key), None)


def _key(name: str, field: Any) -> str:
    """What a config calls a field."""
    return str(field.alias or name)
