"""What somebody's function or class takes by name, for sentences about an argument that it does not take."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Collection, Sequence
from typing import Any, Final

_BY_NAME: Final = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
_UNKNOWN: Final = re.compile(r"unexpected keyword argument '(\w+)'")


def told(error: Exception, given: Collection[str], meant: Callable[[str], str]) -> str | None:
    """Python's sentence about an argument that is not taken, and behind it what `meant` says of that argument.

    None where the error is about something else, or about an argument that is not among those given.
    """
    unknown = _UNKNOWN.search(str(error)) if isinstance(error, TypeError) else None
    if unknown is None or unknown[1] not in given:
        return None
    return f"{str(error)[: unknown.end()]}{meant(unknown[1])}"  # what follows may be a guess of Python's own


def listing(hint: str, own: Sequence[str]) -> str:
    """The hint of `nearest`, and all that there are."""
    return f"{hint} Its own are: {', '.join(own)}" if own else hint.removesuffix(".")


def own_arguments(called: Callable[..., Any], *, base: type = object, positional: int = 0) -> list[str]:
    """What a function, or a class derived from `base`, takes by name, as far as it says so.

    Of a class also what the `__init__` of one above it takes, where its own hands on whatever it is given.
    positional: how many arguments each is called with beside those.
    """
    if not isinstance(called, type):
        return _named(called, positional)[0]
    line = inspect.getmro(called)
    found: list[str] = []
    for part in line[: line.index(base)] if base in line else ():
        if "__init__" in vars(part):
            names, hands_on = _named(vars(part)["__init__"], positional + 1)  # and itself
            found += names
            if not hands_on:
                break
    return list(dict.fromkeys(found))


def _named(function: Callable[..., Any], positional: int) -> tuple[list[str], bool]:
    """What a function takes by name, and whether it takes any name."""
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):  # written in C
        return [], True
    hands_on = any(one.kind is one.VAR_KEYWORD for one in parameters)
    return [one.name for one in parameters[positional:] if one.kind in _BY_NAME], hands_on
