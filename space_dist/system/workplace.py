"""Where this process is: in a Ray job, before a Ray of its own; and where its results therefore go."""

from __future__ import annotations

import os
import secrets
import sys
from pathlib import Path

from space_dist.errors import ConfigError

RAY_DEFAULTS = {
    # Ray would report usage to its makers.
    "RAY_USAGE_STATS_ENABLED": "0",
    # Ray would leave out lines that several workers write alike.
    "RAY_DEDUP_LOGS": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    # Its handler lets ours hear SIGTERM, and has the process killed by SIGABRT 3 s later.
    "RAY_DISABLE_FAILURE_SIGNAL_HANDLER": "1",
}
"""What the environment says of Ray, unless the user has decided it, before Ray is imported."""


def default_folder(name: str, seed: int) -> Path:
    """`runs/<name>/s<seed>`, here."""
    return workplace() / "runs" / name / f"s{seed}"


def absolute_uri(uri: str | None) -> str | None:
    """A tracking URI that means the same from any folder: `sqlite:///FILE` with the file's absolute path."""
    prefix = "sqlite:///"
    return f"{prefix}{workplace() / uri.removeprefix(prefix)}" if uri and uri.startswith(prefix) else uri


def in_ray_job() -> bool:
    """Whether `ray job submit` started this process."""
    return "RAY_JOB_CONFIG_JSON_ENV_VAR" in os.environ


def workplace() -> Path:
    """Where results go whose place nobody named: here; from within a Ray job, `~/space_dist`.

    A job's current folder is a copy that Ray removes when it needs the space.
    """
    return Path.home() / "space_dist" if in_ray_job() else Path.cwd()


def lasting(path: Path, option: str) -> Path:
    """The absolute path of a folder for results. Raises ConfigError for a relative one from within a Ray job."""
    if in_ray_job() and not path.is_absolute():
        raise ConfigError(
            f"{option} {path}: from within a Ray job the path must be absolute, on storage that outlives the job; "
            "the job's current folder is a copy that Ray removes when it needs the space"
        )
    return path.absolute()


def cores() -> int:
    """CPUs that are ours: SLURM may give us fewer than it lets us see."""
    found, given = len(os.sched_getaffinity(0)), os.environ.get("SLURM_CPUS_PER_TASK", "")
    return min(found, int(given)) if given.isdecimal() and int(given) else found


def private_ray() -> None:
    """Prepare this process for Rays of its own; to be called before Ray is imported, which reads these once.

    Ray runs whatever its ports are sent, so only who holds this process's own token may talk to them. (Unset, Ray makes
    up a token and leaves it in the user's home.)
    """
    if "ray" not in sys.modules:
        os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
