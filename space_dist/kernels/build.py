"""Compiling the entries once per machine, and finding them again: nobody waits twice, and nobody needs a compiler.

What Numba has compiled is kept in a folder of its own for each combination of code, versions and CPU, so that an index
never has more than one entry: Numba's own index, shared by two kinds of CPU on one home, could name the other's code.
Of many processes that start at once one compiles, and the others wait for it.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import os
import platform
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba.core.registry import cpu_target

_PATIENCE = 60.0  # seconds for another process that compiles: several times what that takes
_READY = "ready"


def ready(entries: Sequence[tuple[Any, Sequence[Any]]]) -> None:
    """Have each entry compiled for arguments like these, from the folder or into it."""
    kinds = [tuple(numba.typeof(argument) for argument in arguments) for _, arguments in entries]
    functions = [entry for entry, _ in entries]
    with _plain():
        folder = _folder(repr(kinds))
        if folder is None or (folder / _READY).exists():
            _compile(functions, kinds, folder)
        else:
            with _alone(folder, (folder / _READY).exists):
                _compile(functions, kinds, folder)


@contextlib.contextmanager
def _plain() -> Iterator[None]:
    """Without what optimises loops: ours are vectors already, and half of the time to compile them went there."""
    settings = {"OPT": type(numba.config.OPT)(1), "LOOP_VECTORIZE": 0, "SLP_VECTORIZE": 0, "DISABLE_JIT": 0}
    before = {name: getattr(numba.config, name) for name in settings}
    for name, value in settings.items():
        setattr(numba.config, name, value)
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(numba.config, name, value)


def _compile(functions: Sequence[Any], kinds: Sequence[Any], folder: Path | None) -> None:
    """Raises nothing for a folder that is damaged or full: that costs time, not the run."""
    try:
        for function, kind in zip(functions, kinds, strict=True):
            if folder is not None:
                _keep(function, folder)
            function.compile(kind)
        if folder is not None:
            # Last: who finds it loads without the lock.
            (folder / _READY).touch()
    except Exception:
        if folder is None:
            raise
        # Whatever is half there would be found by the next process.
        shutil.rmtree(folder, ignore_errors=True)
        for function, kind in zip(functions, kinds, strict=True):
            function._cache.disable()
            function.compile(kind)


def _keep(function: Any, folder: Path) -> None:
    """Have Numba keep what it compiles of this function there."""
    config = numba.config
    before = config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES
    config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = str(folder), ""
    try:
        function.enable_caching()
    finally:
        config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = before


def _folder(kinds: str) -> Path | None:
    """Where this code for this CPU is kept: under NUMBA_CACHE_DIR, the user's cache, or the temporary folder.

    What lies there is run: only a folder of the user's own, which nobody else may write to, is good. None if there is
    none.
    """
    what = [
        platform.python_version(), numba.__version__, llvmlite.__version__, _source(), kinds,
        repr(cpu_target.target_context.codegen().magic_tuple()),
    ]  # fmt: skip
    name = hashlib.sha256("\0".join(what).encode()).hexdigest()[:16]
    home = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    temporary = Path(tempfile.gettempdir()) / f"space-dist-{os.getuid()}"
    places = [Path(home) / "space_dist", temporary]
    if os.environ.get("NUMBA_CACHE_DIR"):
        places.insert(0, Path(os.environ["NUMBA_CACHE_DIR"]))
    for place in places:
        folder = place / "kernels" / name
        with contextlib.suppress(OSError):
            place.parent.mkdir(parents=True, exist_ok=True)
            way = (place, folder.parent, folder)
            for one in way:  # one by one: a mode is that of the last folder alone, the others would have the umask's
                one.mkdir(mode=0o700, exist_ok=True)
            if all(_own(one) for one in way):
                # A folder that is there may lie on a full or read-only file system all the same.
                tempfile.TemporaryFile(dir=folder).close()
                return folder
    return None


def _own(folder: Path) -> bool:
    """Whether a folder is the user's and nobody else can write there."""
    found = folder.lstat()
    return found.st_uid == os.getuid() and stat.S_ISDIR(found.st_mode) and not found.st_mode & 0o022


@functools.cache
def _source() -> str:
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


@contextlib.contextmanager
def _alone(folder: Path, done: Callable[[], bool]) -> Iterator[None]:
    """Only one process of this machine at a time, until it is `done` or patience has an end.

    A file system without locks, or one whose locks hang, has everybody compile for themselves.
    """
    try:
        lock = os.open(folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError:
        yield
        return
    try:
        deadline = time.monotonic() + _PATIENCE
        while time.monotonic() < deadline and not done():
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                time.sleep(0.05)
            except OSError:
                break
        yield
    finally:
        # Which lets go of the lock, also where the process is killed.
        os.close(lock)
