"""Configs as text: trees of settings written out, in parts as nobody would write them."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from typing import Any


class Raw(str):
    """YAML text that `emitted` copies as it stands."""

    __slots__ = ()


def emitted(tree: dict[str, Any], indent: int = 0) -> str:
    lines = []
    for key, value in tree.items():
        if isinstance(value, dict) and value:
            lines.append(f"{' ' * indent}{key}:\n{emitted(value, indent + 2)}")
        else:
            text = value if isinstance(value, Raw) else json.dumps(value)
            lines.append(f"{' ' * indent}{key}: {text}\n")
    return "".join(lines)


def replaced(tree: dict[str, Any], key: str, value: Any, *, rename: str | None = None) -> str:
    tree = copy.deepcopy(tree)
    section = tree
    *sections, last = key.split(".")
    for part in sections:
        section = section.setdefault(part, {})
    if rename is not None:
        section[rename] = section.pop(last)
    else:
        section[last] = value
    return emitted(tree)


def leaves(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
