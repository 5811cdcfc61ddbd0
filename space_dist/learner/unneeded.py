"""torch without its compiler, and Stable-Baselines3 without TensorBoard, until somebody asks for them.

Importing torch imports what it takes to export models and to trace them (`torch.export`, and how Python sees the shapes
of a few thousand operations, `torch._meta_registrations`); its optimisers import `torch._dynamo` when they are made and
at each step, only to say that they are not to be compiled; Stable-Baselines3's logger imports TensorBoard, with which
nothing of ours logs through it. Together that is two seconds of CPU time and 100 MB in every process that trains. What
stands here in their places answers these questions itself, and makes way for the real ones, all of them at once, as
soon as anything else is asked.

What has been imported already is left alone, so that a script that imports torch by itself (and `space_dist.sb3`, which
does) has all of it. In our own processes only tensors on torch's `meta` device lack something: the shapes of what is
written in Python, until `torch._dynamo` or `torch.export` is asked for anything.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable
from importlib.machinery import PathFinder
from importlib.metadata import version
from types import ModuleType
from typing import Any, Final

COMPILER: Final = "torch._dynamo"
TRACERS: Final = ("torch._meta_registrations", "torch.export")
_LOGS: Final = "torch.utils.tensorboard"
_SEEN_TO_WORK_WITHOUT_TRACERS: Final = "2.13."  # versions of torch; others import all of themselves
_GENERATORS: Final = "torch._prims.rng_prims"  # torch.Generator wants it, which the tracers import otherwise
# What parts of torch reach as an attribute, `torch._refs`, without importing it.
_REACHED: Final = ("torch._custom_op.impl", "torch._custom_ops", "torch._decomp", "torch._refs")


class _StandIn(ModuleType):
    """A module of torch's that nobody has asked for anything yet."""

    def __reduce_ex__(self, _: Any) -> tuple[Callable[[str], ModuleType], tuple[str]]:
        return importlib.import_module, (self.__name__,)  # as modules are pickled: by name

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__path__":  # whoever looks through all modules; not an import of a part
            raise AttributeError(name)
        return getattr(self._real(), name)

    def _real(self) -> ModuleType:
        for name in (*TRACERS, COMPILER):
            if isinstance(sys.modules.get(name), _StandIn):
                del sys.modules[name]
        for name in TRACERS:
            importlib.import_module(name)
        return importlib.import_module(self.__name__)


class _Compiler(_StandIn):
    """`torch._dynamo` as optimisers see it while nothing is compiled."""

    def disable(self, fn: Callable[..., Any] | None = None, *rest: Any, **named: Any) -> Any:
        if fn is not None and named == {"wrapping": False}:  # as `torch/_compile.py` asks for parts of torch
            return fn
        return self._real().disable(fn, *rest, **named)

    @staticmethod
    def graph_break(*_: Any, **__: Any) -> None:
        pass


def _writer(*args: Any, **kwargs: Any) -> Any:
    return importlib.import_module(_LOGS).SummaryWriter(*args, **kwargs)


def _hparams(*args: Any, **kwargs: Any) -> Any:
    return importlib.import_module(f"{_LOGS}.summary").hparams(*args, **kwargs)


def _stand_in() -> None:
    """Take the places of what has not been imported, and import torch and Stable-Baselines3."""
    first = "torch" not in sys.modules
    # Before torch, whose import may already import it: for debugging, or in the hooks of other people's backends.
    sys.modules.setdefault(COMPILER, _Compiler(COMPILER))
    if first and version("torch").startswith(_SEEN_TO_WORK_WITHOUT_TRACERS):
        for name in TRACERS:
            sys.modules.setdefault(name, _StandIn(name))
        importlib.import_module(_GENERATORS)
        for name in _REACHED:  # only as attributes: an import of one is an import
            package, _, attribute = name.rpartition(".")
            if name not in sys.modules:
                setattr(sys.modules[package], attribute, _StandIn(name))
        for name in {*TRACERS, COMPILER}:
            if isinstance(stand_in := sys.modules[name], _StandIn):
                stand_in.__spec__ = PathFinder.find_spec(name, sys.modules["torch"].__path__)
    summary = f"{_LOGS}.summary"
    if not {_LOGS, "stable_baselines3"} & set(sys.modules) and importlib.util.find_spec("tensorboard"):
        # Stable-Baselines3 takes these two names from there and calls them when it logs.
        sys.modules |= {_LOGS: ModuleType(_LOGS), summary: ModuleType(summary)}
        sys.modules[_LOGS].__dict__.update(SummaryWriter=_writer, __path__=[])
        sys.modules[summary].__dict__.update(hparams=_hparams)
        try:
            importlib.import_module("stable_baselines3")
        finally:
            del sys.modules[_LOGS], sys.modules[summary]


_stand_in()
