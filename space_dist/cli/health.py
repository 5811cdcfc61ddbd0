"""`space-dist doctor`: what this machine and this environment have, what is wrong, and how it is mended."""

from __future__ import annotations

import functools
import importlib.metadata
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal
from urllib.parse import urlsplit

import typer

from space_dist.cli.terminal import delivered, say
from space_dist.system.importing import PYTHON

_NEEDED: Final = (
    "numpy", "scipy", "torch", "stable-baselines3", "sb3-contrib", "gymnasium", "numba", "llvmlite", "pydantic",
    "matplotlib",
)  # fmt: skip
_LEAST_MB, _LEAST_FREE_MB = 2000, 1000  # of memory for a run with a Ray of its own; of disk for its files
_NO_ANSWER = "no answer within"
_LONGEST: Final = 120  # characters of a cause, so that its line is read at a glance
_SECONDS: Final = {"import": 60.0, "ray": 120.0, "command": 10.0, "server": 30.0}  # before a check is given up
_START_RAY: Final = """
from space_dist.system.workplace import private_ray
private_ray()
import ray
from space_dist.run.ray_session import join_ray, remove_session
found = join_ray("local", 1)
ray.shutdown()
remove_session(found["session_dir"])
"""
_ASK_MLFLOW: Final = """
import os
os.environ.update(MLFLOW_HTTP_REQUEST_TIMEOUT="5", MLFLOW_HTTP_REQUEST_MAX_RETRIES="0")
from space_dist.tracking.store import ask
ask(os.environ["MLFLOW_TRACKING_URI"].rstrip("/"))
"""

State = Literal["ok", "note", "broken"]


@dataclass(frozen=True)
class Finding:
    """What was found of one thing. mend: what to do about it; empty where there is nothing to do."""

    state: State
    what: str
    mend: str = ""


def doctor(
    quick: Annotated[bool, typer.Option("--quick", help="Start no Ray, and ask no server.")] = False,
) -> None:
    """Look at this machine and environment: versions, cores, memory, Ray, MLflow, Slurm, and what is wrong.

    Exit code 1: something is broken.
    """
    broken = 0
    for check in _checks(quick):
        for found in check():
            mark = {"ok": "ok     ", "note": "note   ", "broken": "BROKEN "}[found.state]
            say(f"{mark}{found.what}" + (f"\n       -> {found.mend}" if found.mend else ""))
            broken += found.state == "broken"
    say(f"{broken} broken" if broken else "nothing is broken")
    delivered()
    if broken:
        raise typer.Exit(1)


def _checks(quick: bool) -> list[Callable[[], Iterator[Finding]]]:
    return [
        versions, cores_and_memory, disk, arithmetic_here, functools.partial(ray_works, start=not quick),
        functools.partial(mlflow_works, ask=not quick), bullet_works, slurm_here,
    ]  # fmt: skip


def versions() -> Iterator[Finding]:
    """Python, this package, and the libraries without which no run begins."""
    from space_dist import __version__

    yield Finding("ok", f"space_dist {__version__} on Python {sys.version.split()[0]}, {sys.prefix}")
    found, missing = [], []
    for name in _NEEDED:
        try:
            found.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
    yield Finding("ok", ", ".join(found))
    for name in missing:
        yield Finding("broken", f"{name} is not installed", f"pip install {name}")
    why = _failure("import stable_baselines3, sb3_contrib, numba, matplotlib, scipy")
    if why is not None:
        yield _not_imported("the libraries", why, "space-dist")


def cores_and_memory() -> Iterator[Finding]:
    """What this process may use of the machine."""
    import psutil

    from space_dist.system.workplace import cores

    ours, seen = cores(), os.cpu_count() or 1
    yield Finding("ok", f"{ours} core{'s' if ours > 1 else ''}" + (f" of {seen} that are seen" if ours < seen else ""))
    free = psutil.virtual_memory().available
    for file in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        text = Path(file).read_text().strip() if Path(file).is_file() else ""
        if text.isdecimal():
            free = min(free, int(text))
    megabytes = free >> 20
    what = f"{megabytes:,} MB of memory are free"
    yield _noted_unless(
        megabytes >= _LEAST_MB, what, f"{what}; a run with Ray takes about {_LEAST_MB:,}",
        "use --workers 0, which needs no Ray",
    )  # fmt: skip


def disk() -> Iterator[Finding]:
    """Where runs go, unless somebody says otherwise."""
    from space_dist.system.workplace import workplace

    place = workplace()
    while not place.exists():
        place = place.parent
    if not os.access(place, os.W_OK):
        yield Finding("note", f"{place} cannot be written to: runs would go there", "use another folder, or --out DIR")
        return
    free = shutil.disk_usage(place).free >> 20
    what = f"{free:,} MB are free in {place}, where runs go"
    yield _noted_unless(free >= _LEAST_FREE_MB, what, what, "make room, or use --out DIR")


def arithmetic_here() -> Iterator[Finding]:
    """Whether results have the bits that are published."""
    from space_dist import arithmetic
    from space_dist.errors import SpaceDistError

    try:
        from space_dist.run.claiming import arithmetic_digest

        found = arithmetic_digest()
    except (ImportError, OSError, SpaceDistError) as error:
        yield Finding("broken", f"the arithmetic cannot be computed: {error}", "mend the libraries first")
        return
    if found == arithmetic.REFERENCE["all"]:
        yield Finding("ok", f"arithmetic: {found}, the reference: results have the published bits")
        return
    for remark in arithmetic.remarks(found):
        yield Finding("note", remark, "pip install --constraint constraints.txt space-dist (docs/arithmetic.md)")


def ray_works(*, start: bool) -> Iterator[Finding]:
    """Ray: rollout actors, and grids whose runs go side by side."""
    version = _version("ray")
    if version is None:
        yield Finding(
            "note", "Ray is not installed: runs go in one process (--workers 0)", "pip install 'space-dist[ray]'"
        )
    elif (why := _failure("import ray")) is not None:
        yield _not_imported(f"Ray {version}", why, "ray")
    elif not start:
        yield Finding("ok", f"Ray {version}")
    elif (why := _failure(_START_RAY, "ray")) is not None:
        yield Finding(
            "broken", f"Ray {version} does not start here: {why}",
            "use --workers 0; look into /tmp/ray/session_latest/logs; free space in /dev/shm and /tmp",
        )  # fmt: skip
    else:
        yield Finding("ok", f"Ray {version}: a private one starts here")


def mlflow_works(*, ask: bool) -> Iterator[Finding]:
    """MLflow: the mirror of runs."""
    version = _version("mlflow")
    if version is None:
        yield Finding("note", "MLflow is not installed: nothing is mirrored", "pip install 'space-dist[mlflow]'")
        return
    if (why := _failure("from mlflow import MlflowClient")) is not None:
        yield _not_imported(f"MLflow {version}", why, "mlflow")
        return
    yield Finding("ok", f"MLflow {version}")
    yield from _store_of_environment(ask=ask)


def _store_of_environment(*, ask: bool) -> Iterator[Finding]:
    """What MLFLOW_TRACKING_URI names, if it is set: where runs are mirrored to, unless a config says otherwise."""
    from space_dist.config.tracking_uri import URI_VARIABLE, UriError, checked_uri

    if not (uri := os.environ.get(URI_VARIABLE, "")):
        return
    try:
        parts = urlsplit(checked_uri(uri))
    except UriError as error:
        yield Finding("broken", f"{URI_VARIABLE}: {error}", f"name one of those, or unset {URI_VARIABLE}")
        return
    if parts.scheme == "sqlite":
        folder = Path(uri.removeprefix("sqlite:///")).absolute().parent
        there = folder.is_dir() and os.access(folder, os.W_OK)
        yield _noted_unless(
            there, f"{URI_VARIABLE}: a database in {folder}",
            f"{URI_VARIABLE}: the folder {folder} of its database is not there, or cannot be written to",
            "the first run that is mirrored makes it, if it may; or name another one",
        )  # fmt: skip
    elif ask:
        why = _failure(_ASK_MLFLOW, "server")
        yield Finding("ok", f"{URI_VARIABLE}: an MLflow answers at {parts.netloc}") if why is None else Finding(
            "broken", f"{URI_VARIABLE}: no MLflow answers at {parts.netloc}: {_cause(why)}",
            f"start the server, or unset {URI_VARIABLE} before a run begins: it keeps the URI it was begun with; "
            "nothing of a run is lost meanwhile: `space-dist sync RUN` mirrors it later, `space-dist sync RUN --uri "
            "URI` elsewhere",
        )  # fmt: skip


def bullet_works() -> Iterator[Finding]:
    """PyBullet: AntGoal and BallCatching."""
    version = _version("pybullet")
    if version is None:
        yield Finding(
            "note", "PyBullet is not installed: AntGoal and BallCatching cannot be made",
            "pip install 'space-dist[bullet]' (it has wheels for Python 3.11 and older)",
        )  # fmt: skip
    elif (why := _failure("import pybullet, pybullet_data")) is not None:
        yield _not_imported(f"PyBullet {version}", why, "pybullet")
    else:
        yield Finding("ok", f"PyBullet {version}")


def slurm_here() -> Iterator[Finding]:
    """SLURM: only to submit from here."""
    program = shutil.which("sbatch")
    if program is None:
        yield Finding("ok", "no SLURM here: `slurm export` writes scripts all the same; submit them where sbatch is")
        return
    for words in ([program, "--version"], [shutil.which("scontrol") or "scontrol", "ping"]):
        try:
            done = subprocess.run(words, capture_output=True, text=True, timeout=_SECONDS["command"], check=False)
            said = (done.stdout or done.stderr).strip().partition("\n")[0][:200]
            fine = done.returncode == 0
        except (OSError, subprocess.TimeoutExpired) as error:
            said, fine = str(error), False
        yield _noted_unless(
            fine, f"SLURM: {said}", f"SLURM: {Path(words[0]).name} fails: {said}",
            "nothing, unless this machine should submit jobs: then ask who runs the cluster",
        )  # fmt: skip
        if not fine:
            return


def _cause(why: str) -> str:
    """What the first sentence of an exception of ours gives as the reason, behind whose store it is."""
    sentence = why.partition("Error: ")[2].partition(". ")[0] or why
    cause = sentence.partition(" cannot be written to: ")[2] or sentence
    return cause if len(cause) <= _LONGEST else f"{cause[:_LONGEST]}..."


def _noted_unless(fine: bool, what: str, otherwise: str, mend: str) -> Finding:
    """`what` is ok; where it is not `fine`, a note says what is `otherwise` and how to mend it."""
    return Finding("ok", what) if fine else Finding("note", otherwise, mend)


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def _not_imported(what: str, why: str, distribution: str) -> Finding:
    if why.startswith(_NO_ANSWER):
        return Finding("note", f"{what}: importing gave {why}", "try again when the machine and its disk are less busy")
    return Finding("broken", f"{what} cannot be imported: {why}", f"pip install --force-reinstall {distribution}")


def _failure(code: str, kind: Literal["import", "ray", "server"] = "import") -> str | None:
    """Why Python fails at this, in a process of its own, which can crash and hang as it likes; None if it does not."""
    try:
        done = subprocess.run(
            [*PYTHON, "-c", code], capture_output=True, text=True, timeout=_SECONDS[kind], check=False
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"{_NO_ANSWER} {_SECONDS[kind]:.0f} s"
    except OSError as error:
        return str(error)
    if done.returncode == 0:
        return None
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    return lines[-1][:300] if lines else f"exit code {done.returncode}"
