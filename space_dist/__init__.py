"""space_dist: reinforcement learning that generalises over instances, with self-paced curricula, on Ray."""

from space_dist import arithmetic

arithmetic.settle()  # before any library is loaded that chooses its kernels by the CPU

from space_dist.errors import ConfigError, Interrupted, LedgerError, RunLockedError, SpaceDistError  # noqa: E402

__version__ = "0.1.0"
__all__ = ["ConfigError", "Interrupted", "LedgerError", "RunLockedError", "SpaceDistError", "__version__"]
