"""Whose modules are imported, and what a config may have imported.

Libraries' modules and ours come first, a user's own last: `python -m` and Ray's workers would have it the other way
round, and a file `json.py` in the current folder would be taken for Python's. A config is data, whoever wrote it: its
import paths name what a user has made, and no function of a library.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.machinery
import importlib.metadata
import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

from space_dist.errors import ConfigError, nearest

PYTHON = (sys.executable, "-P")
"""How a Python of ours is started: -P keeps what happens to lie in the current folder from being imported first."""

_LOOKED_FOR = "import importlib.util, sys; print(*(m for m in sys.argv[1:] if not importlib.util.find_spec(m)))"
_SECONDS = 60.0  # for a Python that imports nothing
_OURS = "space_dist"
_CARL = "carl"
_COMES_WITH_PYTHON = ("pip", "setuptools", "wheel")
_ENVIRONMENTS = "pybullet-envs-gymnasium"  # a library that we test with, of environments alone
_REQUIREMENT = re.compile(r"\s*([A-Za-z0-9._-]+)\s*(?:\[([^\]]*)\])?")
_EXTRA = re.compile(r"""extra\s*==\s*["']([^"']+)["']""")


def look_here_too() -> None:
    """Look for a user's own modules in the current folder, after everywhere else."""
    with contextlib.suppress(FileNotFoundError):  # a folder that was removed holds none
        look_in([str(Path.cwd())])


def look_in(folders: Iterable[str]) -> None:
    """Look for modules in these folders, after everywhere else."""
    # At the end: a user's `json.py` does not stand in for Python's.
    sys.path.extend(folder for folder in folders if folder not in sys.path)


def folders_of_user() -> list[str]:
    """Where this process looks for modules, but for what belongs to its Python: for workers of its own, elsewhere."""
    here = str(Path.cwd())
    found = dict.fromkeys([*(str(Path(entry).absolute()) for entry in sys.path), here])
    # Other nodes have a Python of their own, at these or other places.
    pythons = (sys.prefix, sys.base_prefix)
    return [entry for entry in found if entry == here or not any(map(Path(entry).is_relative_to, pythons))]


def found_in(module: str, folders: Iterable[str]) -> bool:
    """Whether one of these folders has a module, or a package, of this top-level name."""
    return importlib.machinery.PathFinder.find_spec(module, list(folders)) is not None


def lost_elsewhere(modules: Iterable[str]) -> list[str]:
    """Those of these top-level modules that a Python like this one does not find, started in another folder.

    What is installed, in whatever way, and what PYTHONPATH names from / on is found. Imports nothing.
    """
    names = sorted(set(modules))
    if not names:
        return []
    try:
        asked = subprocess.run(
            [*PYTHON, "-c", _LOOKED_FOR, *names], cwd="/", capture_output=True, text=True, timeout=_SECONDS, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return []  # nobody can tell
    return asked.stdout.split()


def load(import_path: str, key: str, *, of_library: type | None = None) -> object:
    """What `my_package.my_module:name` names; None if the module has nothing of this name.

    key: what the config calls it, for sentences. of_library: a class whose subclasses may come from a library all the
    same, where a user's module has imported one. Raises ConfigError for a library's module or function, and for a
    module that cannot be imported.
    """
    module, _, name = import_path.partition(":")
    where = f"{key} {import_path!r}"
    look_here_too()
    if (reason := why_refused(import_path)) is not None:
        raise ConfigError(f"{where}: {reason}")
    try:
        found = getattr(importlib.import_module(module), name, None)
    except (Exception, SystemExit) as error:  # somebody else's module may raise anything
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        # `pkg.py:Name` may be a module of that name, which lacks another.
        if module.endswith(".py") and (module.startswith(".") or f"{module}.".startswith(f"{missing}.")):
            raise ConfigError(f"{where}: leave out `.py`: {as_import_path(module, name)}") from None
        what = f"{type(error).__name__}: {str(error)[:200]}"
        if missing == module.partition(".")[0]:
            hint = nearest(missing, _modules_here())
            what += f"{hint} It was looked for where Python looks (PYTHONPATH), and last in {Path.cwd()}"
            if missing == _CARL:
                what += '; CARL is the package carl-bench: docs/environments.md ("CARL") says how it is installed'
        raise ConfigError(f"{where}: cannot import {module!r}: {what}") from error
    if of_library is not None and isinstance(found, type) and issubclass(found, of_library):
        return found
    home = getattr(found, "__module__", None)
    # A partial is what a user made of a library's function, with arguments of theirs.
    if isinstance(home, str) and not isinstance(found, functools.partial) and (owner := _owner(home)) is not None:
        raise ConfigError(
            f"{where}: {module!r} has {name!r} from {home!r}, a module of {owner}; a config may name what you have "
            "made yourself: define a function that calls it"
        )
    return found


def as_import_path(file: str, name: str) -> str:
    """What names a file's module, and where to start if it lies in no folder below the current one."""
    path = Path(os.path.relpath(file)).with_suffix("")
    if ".." in path.parts:
        return f"{path.name}:{name}, and start in {Path(file).parent}"
    return f"{'.'.join(path.parts)}:{name}"


def _modules_here() -> list[str]:
    """The modules and packages of the current folder."""
    here = Path.cwd()
    return [*(file.stem for file in here.glob("*.py")), *(file.parent.name for file in here.glob("*/__init__.py"))]


def why_refused(import_path: str) -> str | None:
    """Why a config may not name this module, as a sentence; None if it may. Imports nothing."""
    module = import_path.partition(":")[0]
    owner = _owner(module)
    if owner is None:
        return None
    if owner == _OURS:
        return f"{module!r} is a module of space_dist itself, whose environments and policies are named by their ids"
    return (
        f"{module!r} is a module of {owner}, and an import path names a module of your own (which needs another name "
        "if this one is yours: a library's comes first)"
    )


@functools.cache
def _owner(module: str) -> str | None:
    """Who has brought a module: Python, a library that space_dist needs, or space_dist; None: the user."""
    top = module.partition(".")[0]
    if top == _OURS:
        return _OURS
    if top in sys.stdlib_module_names or top in sys.builtin_module_names:
        return "Python's standard library"
    if _lies_here(top):  # which spares reading the metadata of all libraries
        return None
    needed = _needed()
    return next((name for name in _providers().get(top, ()) if _normal(name) in needed), None)


def _lies_here(top: str) -> bool:
    try:
        spec: importlib.machinery.ModuleSpec | None = importlib.util.find_spec(top) if top else None
    except (ImportError, ValueError):
        return False
    if spec is None:
        return False
    places = [spec.origin] if spec.origin else list(spec.submodule_search_locations or ())
    return any(Path(place).parent in (Path.cwd(), Path.cwd() / top) for place in places)


@functools.cache
def _providers() -> dict[str, list[str]]:
    """Top-level module -> the installed distributions that have one."""
    return {module: list(names) for module, names in importlib.metadata.packages_distributions().items()}


@functools.cache
def _needed() -> frozenset[str]:
    """The distributions that this package needs, its extras' included, and theirs, and what every environment has."""
    try:
        extras = importlib.metadata.metadata("space-dist").get_all("Provides-Extra") or []
    except importlib.metadata.PackageNotFoundError:
        extras = []
    asked = [*((name, "") for name in _COMES_WITH_PYTHON), *(("space-dist", extra) for extra in ("", *extras))]
    seen: set[tuple[str, str]] = set()
    while asked:
        name, extra = asked.pop()
        if (name, extra) in seen:
            continue
        seen.add((name, extra))
        try:
            requirements = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:
            continue
        for text in requirements:
            found, wanted = _REQUIREMENT.match(text), _EXTRA.search(text)
            if found is not None and (wanted is None or wanted.group(1) == extra):
                asked += [(_normal(found[1]), one.strip()) for one in ("", *(found[2] or "").split(","))]
    return frozenset(name for name, _ in seen) - {_ENVIRONMENTS}


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
