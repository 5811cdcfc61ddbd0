"""What a key's value must be, in words: for sentences about one that is empty, or none that it may be."""

from __future__ import annotations

import types
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin

_WORDS: Final = {
    bool: "true or false", int: "a whole number", float: "a number", str: "a text", Path: "a path",
    tuple: "a list", list: "a list", dict: "keys and values",
}  # fmt: skip


@dataclass(frozen=True)
class Words:
    """Beside a text's pattern, in an annotation: what such a text is."""

    words: str


def wanted(annotation: Any, limits: Iterable[Any] = (), *, whole: bool = False) -> str:
    """`a whole number from 1 to 64, or auto`: what a value of this type is, but for null.

    limits: pydantic's, as a field has them beside its annotation. whole: also how long texts and lists may be, and how
    texts are written.
    """
    found = list(dict.fromkeys(_alternatives(annotation, tuple(limits), whole)))
    if "a number" in found and "a whole number" in found:  # which is one
        found.remove("a whole number")
    return _listed(found, ", or " if " or " in "".join(found[:-1]) or " from " in "".join(found) else " or ")


def words_of(annotation: Any) -> list[str]:
    """The words that a value of this type may be, where it may be one of some."""
    if get_origin(annotation) is Literal:
        return [str(word) for word in get_args(annotation)]
    return [word for part in _parts(annotation) for word in words_of(part)]


def is_choice(annotation: Any) -> bool:
    """Whether a value may be of several types, null aside."""
    return len([part for part in _parts(annotation) if part is not types.NoneType]) > 1


def item_of(annotation: Any) -> Any:
    """The type of what stands in a list, or behind a user's own names, of this type; None where that is not known."""
    for one in _parts(annotation) or (annotation,):
        part = get_args(one)[0] if get_origin(one) is Annotated else one
        inner = get_args(part)
        if get_origin(part) in (tuple, list, dict):
            return inner[1] if get_origin(part) is dict else inner[0]
    return None


def _parts(annotation: Any) -> tuple[Any, ...]:
    """What a union is one of; empty for any other type."""
    return get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else ()


def _alternatives(annotation: Any, limits: tuple[Any, ...], whole: bool) -> list[str]:
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        own = (limit for one in inner[1:] for limit in getattr(one, "metadata", [one]))
        return _alternatives(inner[0], (*limits, *own), whole)
    if origin in (Union, types.UnionType):
        return [word for part in inner if part is not types.NoneType for word in _alternatives(part, limits, whole)]
    if origin is Literal:
        return [_listed([str(word) for word in inner], " or ")]
    if whole and (own_words := [limit.words for limit in limits if isinstance(limit, Words)]):
        return [",".join(filter(None, (word, _as_long(limits, "characters")))) for word in own_words]
    kind = origin or annotation
    if kind is tuple and inner and Ellipsis not in inner:
        return [f"a list of {len(inner)} {_WORDS.get(inner[0], 'a value').removeprefix('a ')}s"]
    word = _WORDS.get(kind, "a value")
    if kind in (int, float):
        return [word + _within(limits)]
    return [word + _as_long(limits, "characters" if kind is str else "items") if whole else word]


def _within(limits: Iterable[Any]) -> str:
    given = _given(limits, ("ge", "gt", "le", "lt"))
    if {"ge", "le"} <= given.keys():
        return f" from {_number(given['ge'])} to {_number(given['le'])}"
    words = (("ge", "of at least"), ("gt", "above"), ("le", "up to"), ("lt", "below"))
    parts = [f"{word} {_number(given[name])}" for name, word in words if name in given]
    return f" {' and '.join(parts)}" if parts else ""


def _as_long(limits: Iterable[Any], of: str) -> str:
    given = _given(limits, ("min_length", "max_length"))
    if len(given) == 2:
        return f" of {given['min_length']:,} to {given['max_length']:,} {of}"
    bound = next((f"{'least' if name == 'min_length' else 'most'} {number:,}" for name, number in given.items()), "")
    return f" of at {bound} {of.removesuffix('s') if bound.endswith(' 1') else of}" if bound else ""


def _given(limits: Iterable[Any], names: tuple[str, ...]) -> dict[str, Any]:
    """What pydantic's limits say by these names; of two that say the same, the last."""
    return {name: value for limit in limits for name in names if (value := getattr(limit, name, None)) is not None}


def _number(limit: float) -> str:
    return f"{int(limit):,}" if limit == int(limit) else f"{limit:g}"


def _listed(words: list[str], last: str) -> str:
    return last.join(filter(None, (", ".join(words[:-1]), *words[-1:])))
