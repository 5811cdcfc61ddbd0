"""What a process that is ours alone does first: a command, a supervisor of runs."""

from __future__ import annotations

import atexit
import gc
from typing import Final

_NEW_OBJECTS: Final = 50_000  # between two looks for garbage; Python's own choice is 700


def collect_seldom() -> None:
    """Look for cyclic garbage seldom, and not when the process ends.

    Importing torch makes hundreds of thousands of objects that stay: looking through them, again and again, was a third
    of what it takes to start and end a command.
    """
    gc.set_threshold(_NEW_OBJECTS, *gc.get_threshold()[1:])
    atexit.unregister(gc.freeze)
    # Frozen objects are not looked through, so that the last collection, as Python ends, finds next to nothing to do.
    atexit.register(gc.freeze)
