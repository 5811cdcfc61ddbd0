"""Grids on SLURM: written as scripts that people can read, check and trust, and looked after from their files."""

from space_dist.slurm.export import Export, Mode, export
from space_dist.slurm.profile import Profile, load_profile

__all__ = ["Export", "Mode", "Profile", "export", "load_profile"]
