"""The configs, grids, profiles and instance sets that come with the package: `shipped:pointmass_space`."""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import Any, Final

from space_dist.config.plain_yaml import read_yaml
from space_dist.errors import ConfigError, nearest

FOLDER: Final = (Path(__file__).parents[1] / "shipped").resolve()
PREFIX: Final = "shipped:"
_SUFFIXES: Final = (".yaml", ".csv")


@functools.cache
def shipped_files() -> tuple[str, ...]:
    """The paths of all of them below `FOLDER`, sorted: `pointmass_space.yaml`, `grids/quickstart.yaml`, ..."""
    files = (path for path in FOLDER.rglob("*") if path.suffix in _SUFFIXES)
    return tuple(sorted(path.relative_to(FOLDER).as_posix() for path in files))


def located(path: Path | str) -> Path:
    """`shipped:NAME` as the path of that file; any other path as it is.

    NAME is a path below `FOLDER`, with its suffix or without, which YAML files go before; its folder can be left out
    where no other file is called so. Raises ConfigError for a name that no file has.
    """
    if not str(path).startswith(PREFIX):
        return Path(path)
    name, files = str(path).removeprefix(PREFIX), shipped_files()
    found: list[str] = []
    for wanted in [name] if name.endswith(_SUFFIXES) else [f"{name}{suffix}" for suffix in _SUFFIXES]:
        alike = [file for file in files if wanted in (file, Path(file).name)]
        found = found or [file for file in alike if file == wanted] or alike
    if len(found) == 1:
        return FOLDER / found[0]
    if found:
        raise ConfigError(f"{path}: several files are called so: {', '.join(found)}; name one of them whole")
    names = [short for file in files for short in (file, file.rpartition(".")[0], Path(file).stem, Path(file).name)]
    raise ConfigError(
        f"{path}: nothing of this name comes with space_dist{nearest(name, names)} `space-dist configs` lists what does"
    )


def read_named(path: Path) -> dict[str, Any]:
    """What a YAML file says that a user names, as `read_yaml`; the fault names the shipped file that may be meant."""
    place = located(path)
    if (meant := shipped_as(path)) and not place.exists():
        raise ConfigError(f"{path} does not exist; did you mean {meant!r}?")
    return read_yaml(place)


def shipped_as(path: Path) -> str:
    """`shipped:NAME` of the YAML file that is called as a path is, in the repository's `configs`; empty for none."""
    name = path.as_posix().removeprefix("configs/")
    if "/" in name or not name.removesuffix(".yaml"):
        return ""
    try:
        return f"{PREFIX}{name}" if located(f"{PREFIX}{name}").suffix == ".yaml" else ""
    except ConfigError:
        return ""


def about_shipped(file: str) -> str:
    """What a shipped YAML file is, in one sentence: the first of its comment."""
    comment: list[str] = []
    for line in (FOLDER / file).read_text().splitlines():
        if not line.startswith("# "):
            break
        comment.append(line.removeprefix("# ").strip())
    return re.split(r"(?<!et al)[.?](?: |$)", " ".join(comment), maxsplit=1)[0]


def with_what_it_names(file: str) -> list[str]:
    """A shipped file, and the shipped files that it names: what a grid or a search extends, and instance sets."""
    if not file.endswith(".yaml"):
        return [file]
    data, here = read_yaml(FOLDER / file), (FOLDER / file).parent
    extends, instances = data.get("extends", []), data.get("instances", {})
    settings, confirmed = data.get("set", {}), data.get("confirm", {}).get("instances", {})
    instances = {**instances, **{key: name for key, name in settings.items() if key.startswith("instances.")}}
    named = [*([extends] if isinstance(extends, str) else extends), *instances.values(), *confirmed.values()]
    below = [path.relative_to(FOLDER).as_posix() for path in ((here / name).resolve() for name in named)]
    return list(dict.fromkeys([file, *(one for name in below for one in with_what_it_names(name))]))
