"""space_dist: reinforcement learning that generalises over instances, with self-paced curricula, on Ray."""

import sys

if sys.argv[:1] == ["-m"] and not sys.flags.safe_path and any("space_dist." in word for word in sys.orig_argv[1:]):
    # `python -m space_dist.cli` has Python look into the current folder before its own library: see `importing`.
    del sys.path[0]

from space_dist import arithmetic

arithmetic.settle()  # before any library is loaded that chooses its kernels by the CPU

from space_dist.errors import ConfigError, Interrupted, LedgerError, RunLockedError, SpaceDistError  # noqa: E402

__version__ = "0.1.0"
__all__ = ["ConfigError", "Interrupted", "LedgerError", "RunLockedError", "SpaceDistError", "__version__"]
