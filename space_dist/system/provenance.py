"""What results depend on besides config and seed: this code, a user's own, the libraries, and the arithmetic."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import importlib.util
import subprocess
from collections.abc import Iterable
from pathlib import Path

from space_dist.errors import ConfigError

_BITS_DEPEND_ON = ("numpy", "scipy", "torch", "stable-baselines3", "sb3-contrib", "gymnasium")
_MAX_SOURCES = 5_000  # files of a user's package
_DIGITS = 16


def fingerprint(arithmetic: str, also: Iterable[str] = (), import_paths: Iterable[str] = ()) -> dict[str, str]:
    """What bit-equality is promised for: what the arithmetic computes, this code, and versions of what else decides.

    arithmetic: `arithmetic.digest` of everything.  also: distributions that this run uses besides those of every run.
    import_paths: of somebody's own code that it uses, whose source counts by module.
    """
    versions = {name: _version(name) for name in (*_BITS_DEPEND_ON, *also)}
    sources = {f"source.{path.partition(':')[0]}": _source(path) for path in import_paths}
    return {"arithmetic": arithmetic, "code": code_digest(), **sources, **versions}


def _source(import_path: str) -> str:
    try:
        return source_digest(import_path)
    except ConfigError:  # it was imported all the same: a notebook's, or what is too large to read
        return "unknown"


@functools.cache
def _version(distribution: str) -> str:
    """Looked for once: the members of a population would look for all of theirs, every one."""
    return importlib.metadata.version(distribution)


@functools.cache
def code_digest() -> str:
    """`(16 hex digits)` a hash of this package's own source files, by their paths and content."""
    return _digest(Path(__file__).resolve().parents[1])


def source_digest(import_path: str) -> str:
    """`(16 hex digits)` a hash of the source behind `my_package.my_module:name`: all of the user's package.

    A module outside any package counts alone: what it imports from beside it is not seen.
    Raises ConfigError if there is no such module.
    """
    module = import_path.partition(":")[0]
    top = module.partition(".")[0]
    try:
        spec = importlib.util.find_spec(top)
    except (ImportError, ValueError) as error:
        raise ConfigError(f"{import_path!r}: cannot find the module {top!r}: {error}") from None
    if spec is None:
        raise ConfigError(f"{import_path!r}: there is no module {top!r}")
    digest = hashlib.sha256()
    for folder in spec.submodule_search_locations or ():
        digest.update(_digest(Path(folder)).encode())
    if not spec.submodule_search_locations:
        # A built-in or compiled module has no source: its name, and the libraries' versions, must do.
        has_source = spec.origin is not None and Path(spec.origin).is_file()
        digest.update(Path(str(spec.origin)).read_bytes() if has_source else top.encode())
    return digest.hexdigest()[:_DIGITS]


def _digest(folder: Path) -> str:
    files = sorted(folder.rglob("*.py"))
    if len(files) > _MAX_SOURCES:
        raise ConfigError(f"{folder} holds {len(files)} Python files; a package of your own may have {_MAX_SOURCES}")
    digest = hashlib.sha256()
    for file in files:
        # Path and size before the content: else the same bytes, cut into files otherwise, would have one digest.
        digest.update(f"{file.relative_to(folder).as_posix()}\0{file.stat().st_size}\0".encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()[:_DIGITS]


def git_state() -> dict[str, str]:
    """The commit this package was checked out at, and whether it was edited since; empty outside a repository."""
    here = Path(__file__).resolve().parents[1]

    def git(*arguments: str) -> str | None:
        try:
            done = subprocess.run(
                ["git", "-C", str(here), *arguments], capture_output=True, text=True, timeout=10, check=False  # noqa: S607
            )  # fmt: skip
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    commit = git("rev-parse", "HEAD")
    # Installed into somebody else's repository, the commit would be that one's.
    if commit is None or git("ls-files", "--error-unmatch", __file__) is None:
        return {}
    return {"git_commit": commit, "git_dirty": str(bool(git("status", "--porcelain", "--", "."))).lower()}
