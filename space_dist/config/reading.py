"""Reading configs: a file, what the command line changes of it, and the check against the schema."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from space_dist.config.explaining import explain
from space_dist.config.plain_yaml import parse_yaml, to_yaml
from space_dist.config.run import RunConfig
from space_dist.config.shipped import PREFIX, located, read_named
from space_dist.errors import ConfigError

_M = TypeVar("_M", bound=BaseModel)
_CREDENTIALS = re.compile(r"//[^/\s]*@")
_DOUBLED = re.compile(r"^(\w+): (?:\w+\.)*\1: ")  # an argument, and the key that is called as it is
_SEED = re.compile(r"^seed: 0$", re.MULTILINE)  # a run's own: those of sections do not begin a line
# What `slurm.profile` reads and a run does not: it is above this package, which may not import it.
_OF_PROFILES = frozenset((
    "account", "aggregate", "apptainer", "apptainer_options", "cells_per_task", "command", "comment", "conda",
    "constraint", "cpus_per_task", "dependency", "error", "exclude", "exclusive", "extra", "gpus", "gres", "interface",
    "job_name", "mail_type", "mail_user", "max_array_size", "max_requeues", "mem", "mem_per_cpu", "modules", "nodelist",
    "nodes", "output", "partition", "prologue", "qos", "reservation", "signal", "temp", "throttle", "time", "venv",
))  # fmt: skip
_OF_MANY = frozenset(("extends", "grid", "zip", "arms", "seeds"))  # what grids and searches have, and profiles do not


def load(path: Path, overrides: Sequence[str] = (), *, to_check: bool = False) -> RunConfig:
    """Read a config file, apply `a.b=c` overrides in their order, and check everything.

    Relative instance paths become absolute, from the config's folder (from the current one in an override).
    Raises ConfigError with the file and key of every fault. to_check: see `read`.
    """
    data = read(path, to_check=to_check)
    for override in overrides:
        apply_override(data, override)
    return parse(data, str(path), origins(overrides))


def origins(overrides: Sequence[str]) -> dict[str, str]:
    """By the key that it sets, each override as sentences name it."""
    return {override.partition("=")[0].strip(): told(override) for override in overrides}


def read(path: Path, *, to_check: bool = False) -> dict[str, Any]:
    """A run's config as plain data, not checked yet; relative paths in it become absolute, from its folder.

    Raises ConfigError for a file of another kind, with the command that takes it. to_check: whoever asks runs nothing.
    """
    place = located(path)
    data = read_named(path)
    if "env" not in data:
        command = f"plan {path}" if to_check else f"run {path} (from Python: space_dist."
        if "arms" in data:
            raise ConfigError(
                f"{path} is a search, of many runs: space-dist tune {command}{'' if to_check else 'run_search)'}"
            )
        if "extends" in data:
            raise ConfigError(
                f"{path} is a grid, of many runs: space-dist grid {command}{'' if to_check else 'run_grid)'}"
            )
    refuse_profile(data, path)
    from_its_folder(data, place.absolute().parent)
    return data


def refuse_profile(data: Mapping[str, Any], path: Path) -> None:
    """Raise ConfigError for what is a SLURM profile, and neither a run's config nor a file of many runs."""
    others = (RunConfig.model_fields.keys() - {"env"}) | _OF_MANY
    if not data.keys().isdisjoint(_OF_PROFILES) and data.keys().isdisjoint(others):
        raise ConfigError(f"{path} is a SLURM profile: space-dist slurm export GRID --out DIR --profile {path}")


def refuse_all_but_profiles(data: Mapping[str, Any], path: Path) -> None:
    """Raise ConfigError for what is a run's config, a grid or a search, and no SLURM profile."""
    if len(data.keys() & {"instances", "curriculum", "learner", "budget"}) > 1:
        what = f"the config of one run: space-dist train {path}"
    elif "extends" in data or "arms" in data:
        kind = "search" if "arms" in data else "grid"
        what = f"a {kind}: space-dist slurm export {path} --out DIR --profile PROFILE"
    else:
        return
    raise ConfigError(f"{path} is {what}. A SLURM profile has keys like partition, account and time")


def from_its_folder(data: dict[str, Any], folder: Path) -> None:
    """Take the relative paths in a run's plain data from `folder`."""
    data |= {key: from_folder(key, value, folder) for key, value in data.items()}


def from_folder(key: str, value: Any, folder: Path) -> Any:
    """The value of a config's key, the relative paths in it taken from `folder`."""
    if key == "instances" and isinstance(value, dict):
        return {name: beside(path, folder) for name, path in value.items()}
    if key == "curriculum" and isinstance(value, dict) and "of" in value:
        return {**value, "of": beside(value["of"], folder)}
    is_path = key in ("init_from", "curriculum.of") or key.partition(".")[0] == "instances"
    return beside(value, folder) if is_path else value


def beside(value: Any, folder: Path) -> Any:
    """A path in a config, relative to `folder` or `shipped:NAME`, as an absolute one; what is no path as it is."""
    if not isinstance(value, str) or not value:
        return value
    return str(located(value)) if value.startswith(PREFIX) else str(folder / value)


def parse(data: Mapping[str, Any], source: str, origins: Mapping[str, str] | None = None) -> RunConfig:
    """Check plain data against the schema of a run. `origins` says which keys came from elsewhere than `source`."""
    return check(RunConfig, data, source, origins)


def check(model: type[_M], data: Mapping[str, Any], source: str, origins: Mapping[str, str] | None = None) -> _M:
    """Check plain data against any schema made of sections. Raises ConfigError with the key of every fault."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        faults = [explain(fault, model, source, origins or {}, data) for fault in error.errors(include_url=False)[:10]]
        raise ConfigError("\n".join(dict.fromkeys(_DOUBLED.sub(r"\1: ", fault) for fault in faults))) from None


def dump(config: RunConfig) -> str:
    """The resolved config as YAML, every default written out."""
    data = config.model_dump(mode="json")
    # Only this line tells a cell's runs apart, and a population writes down as many as it has members.
    return _SEED.sub(f"seed: {data['seed']}", _text(json.dumps({**data, "seed": 0})), count=1)


@functools.lru_cache(maxsize=32)
def _text(data: str) -> str:
    return to_yaml(json.loads(data))


def put(data: dict[str, Any], key: str, value: Any, where: str) -> None:
    """Set `a.b` in nested data, making sections on the way. Raises ConfigError if `a` is no section."""
    section: Any = data
    *parents, last = key.split(".")
    for part in parents:
        if section.get(part) is None:  # or is empty, as `curriculum:` with nothing below it
            section[part] = {}
        section = section[part]
        if not isinstance(section, dict):
            raise ConfigError(f"{where}: {part!r} is not a section")
    section[last] = value


def apply_override(data: dict[str, Any], override: str) -> None:
    """Set what `a.b=c` says in plain data; the value is read as YAML. Raises ConfigError if it says nothing."""
    key, equals, text = override.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts) or not override.isprintable():
        raise ConfigError(f"{told(repr(override))}: write KEY=VALUE, like --set budget.steps=20000")
    value = parse_yaml(text, told(override))
    # Who types a path at a prompt means it from where they stand, and not from the config's folder.
    name = ".".join(parts)
    put(data, name, from_folder(name, value, Path.cwd()), told(override))


class _Typed(str):
    """An override that was told otherwise: `resources.workers=4`, from `--workers 4`, or by a program's argument."""

    __slots__ = ("typed",)
    typed: str


def from_program(argument: str, key: str, value: Any) -> str:
    """The override of a key by a plain value, as an argument of a program has it; sentences name the argument.

    Raises ConfigError for what can be no key.
    """
    if not all(part.strip() for part in key.split(".")) or "=" in key:
        raise ConfigError(f"{argument}: {key!r} is no key, like 'budget.steps'")
    is_told_plainly = isinstance(value, str) and _means_itself(value)
    override = _Typed(f"{key}={value if is_told_plainly else json.dumps(value, ensure_ascii=False)}")
    override.typed = argument
    return override


def _means_itself(text: str) -> bool:
    """Whether YAML reads a text as that text, so that it stands as a user types it."""
    try:
        return bool(parse_yaml(text, "") == text)
    except ConfigError:
        return False


def from_option(option: str, key: str, value: object) -> str:
    """The override `key=value` that an option stands for; sentences about it name the option."""
    override = _Typed(f"{key}={value}")
    override.typed = f"{option} {value}"
    return override


def told(override: str) -> str:
    """An override as sentences name it: without the credentials of a URI."""
    return override.typed if isinstance(override, _Typed) else f"--set {_CREDENTIALS.sub('//...@', override)}"
