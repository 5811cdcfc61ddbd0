"""torch without its compiler, until somebody compiles.

torch's optimisers import `torch._dynamo` when they are made and at each step, only to say that they are not to be
compiled: a second of CPU time and 60 MB in every process that trains. What stands here in its place answers these
questions itself, and makes way for the compiler as soon as anything else is asked of it.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

NAME = "torch._dynamo"


class _Uncompiled(ModuleType):
    """`torch._dynamo` as optimisers see it while nothing is compiled."""

    def disable(self, fn: Callable[..., Any] | None = None, *rest: Any, **named: Any) -> Any:
        if fn is not None and named == {"wrapping": False}:  # as `torch/_compile.py` asks for parts of torch
            return fn
        return self._real().disable(fn, *rest, **named)

    @staticmethod
    def graph_break(*_: Any, **__: Any) -> None:
        pass

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__path__":  # whoever looks through all modules; not an import of a part
            raise AttributeError(name)
        return getattr(self._real(), name)

    def _real(self) -> Any:
        if sys.modules.get(NAME) is self:
            del sys.modules[NAME]
        return importlib.import_module(NAME)


def stand_in() -> None:
    """Take the compiler's place, where it has not been imported."""
    sys.modules.setdefault(NAME, _Uncompiled(NAME))
