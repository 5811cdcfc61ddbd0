"""What is meant by a word without a colon where an import path should stand: a module, its file, or a class alone."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from types import ModuleType

from space_dist.system.importing import as_import_path, look_here_too, why_refused

_SHOWN = 3


def without_colon(word: str, wanted: type) -> str | None:
    """What to say of a word that stands for an import path and has no colon; None where nobody can tell what it means.

    wanted: what the classes that are looked for are derived from. A module of the user's that the word names is
    imported, as the right word for it would have it imported; for a class alone, files of the current folder are read.
    """
    if word.endswith((".yaml", ".yml")):
        return f"a YAML file is no import path; `space-dist config check {word}` checks a config and what it imports"
    if word.endswith(".py"):
        module = as_import_path(word, "").partition(":")[0]
        names = _names(_imported(module), wanted) if Path(word).is_file() else []
        meant = [as_import_path(word, name) for name in names or ["NAME"]]
        return f"an import path has a colon, and no `.py`: {_listed(meant)}"
    if not all(part.isidentifier() for part in word.split(".")):
        return None
    parent, _, name = word.rpartition(".")
    if (found := _imported(word)) is not None:
        meant = [f"{word}:{each}" for each in _names(found, wanted) or ["NAME"]]
    elif parent and (found := _imported(parent)) is not None:
        names = [name] if hasattr(found, name) else _names(found, wanted)
        meant = [f"{parent}:{each}" for each in names or ["NAME"]]
    else:
        meant = [f"{file.stem}:{word}" for file in sorted(Path.cwd().glob("*.py")) if _defines(file, word)]
    return f"an import path has a colon: {_listed(meant)}" if meant else None


def _listed(paths: list[str]) -> str:
    return " or ".join(paths[:_SHOWN])


def _imported(module: str) -> ModuleType | None:
    """A user's own module; None where there is none, or none that can be imported."""
    look_here_too()
    if not all(part.isidentifier() for part in module.split(".")) or why_refused(module) is not None:
        return None
    try:
        return importlib.import_module(module)
    except (Exception, SystemExit):  # somebody else's module may raise anything; its right name will have that told
        return None


def _names(module: ModuleType | None, wanted: type) -> list[str]:
    """The classes derived from `wanted` that a module defines; else all classes and functions that it does."""
    if module is None:
        return []
    own = {
        name: value for name, value in vars(module).items()
        if not name.startswith("_") and callable(value) and getattr(value, "__module__", "") == module.__name__
    }  # fmt: skip
    return [name for name, value in own.items() if isinstance(value, type) and issubclass(value, wanted)] or [*own]


def _defines(file: Path, name: str) -> bool:
    """Whether a Python file has a class or a function of this name, as far as can be told without importing it."""
    try:
        return re.search(rf"^(class|def) {name}\b", file.read_text(encoding="utf-8"), re.MULTILINE) is not None
    except (OSError, ValueError):
        return False
