"""Commands to start with: what ships, and a project of one's own that runs as it is written."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path
from typing import Annotated, Optional

import typer

from space_dist.cli.terminal import delivered, say, write
from space_dist.errors import ConfigError

_PROJECT = Path(__file__).with_name("project")
_PROFILE, _NO_FOLDER = "slurm.yaml", "# env: { PYTHONPATH: /home/me/my_project }"
_MAX_PATH = 1000  # characters of a value in a profile
_RUN_BY = {"arms": "tune run", "extends": "grid run", "env": "train"}  # by a key that such a file has
_DISGUISE = ".in"  # of files that would be taken for this package's own


def configs(
    copy: Annotated[
        Optional[str],  # noqa: UP045 - typer reads annotations at run time
        typer.Option("--copy", metavar="NAME", help="Copy one, and the files it names, into the folder DIR."),
    ] = None,
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Argument(metavar="DIR", help="With --copy NAME: the folder to copy into.", show_default=False),
    ] = None,
) -> None:
    """List the configs, grids and profiles that ship: a path like shipped:pointmass_space names one anywhere."""
    from space_dist.config import about_shipped, shipped_files

    if copy is not None:
        if out is None:
            raise ConfigError(
                f"--copy wants two words, NAME and DIR, the folder to copy into: space-dist configs --copy {copy} mine"
            )
        _copy(copy, out)
        return
    if out is not None:
        raise ConfigError(
            f"{out}: a folder goes with --copy, which names what to copy into it: space-dist configs --copy NAME {out}"
        )
    files = [file for file in shipped_files() if file.endswith(".yaml")]
    width = max(map(len, files)) - len(".yaml")
    for file in sorted(files, key=lambda file: ("/" in file, file)):
        say(f"shipped:{file.removesuffix('.yaml'):{width}}  {about_shipped(file)}")
    sets = [file.removeprefix("instances/").removesuffix(".csv") for file in shipped_files() if file.endswith(".csv")]
    say(f"and as instance sets, in shipped:instances/NAME.csv: {', '.join(sets)}")
    delivered()


def _copy(name: str, out: Path) -> None:
    from space_dist.config import located, read_yaml, shipped_files, with_what_it_names
    from space_dist.config.shipped import FOLDER, PREFIX

    chosen = located(PREFIX + name.removeprefix(PREFIX))
    (file,) = (file for file in shipped_files() if FOLDER / file == chosen)
    files = with_what_it_names(file)
    _refuse_what_is_there([out / one for one in files])
    for one in files:
        write(out / one, (FOLDER / one).read_text())
        say(str(out / one))
    keys = read_yaml(FOLDER / file) if file.endswith(".yaml") else {}
    if command := next((command for key, command in _RUN_BY.items() if key in keys), ""):
        say(f"Next: space-dist {command} {out / file}")


def _refuse_what_is_there(paths: list[Path]) -> None:
    for path in paths:
        if path.exists():
            raise ConfigError(f"{path} exists; choose another folder, or remove it")


def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A folder that is empty, or not there yet.")],
) -> None:
    """Write a project that runs as it is: environment, instances, config, grid, SLURM profile."""
    try:
        if folder.exists() and not folder.is_dir():
            raise ConfigError(f"{folder} is a file; a project is written into a folder of its own")
        if folder.exists() and any(folder.iterdir()):
            raise ConfigError(f"{folder} is not empty; a project is written into a folder of its own")
        for source in sorted(path for path in _PROJECT.rglob("*") if path.is_file()):
            target = folder / str(source.relative_to(_PROJECT)).removesuffix(_DISGUISE)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)
            say(str(target))
        _name_in_profile(folder)
    except OSError as error:
        raise ConfigError(f"cannot write {folder}: {error.strerror}") from None
    say(f"Next: cd {shlex.quote(str(folder))} && space-dist train slider.yaml   (README.md says what else)")


def _name_in_profile(folder: Path) -> None:
    """Have jobs look for modules in the project. A folder that PYTHONPATH cannot name is left to its user."""
    path, profile = str(folder.resolve() if ".." in folder.parts else folder.absolute()), folder / _PROFILE
    if path.isprintable() and ":" not in path and len(path) <= _MAX_PATH:
        line = f"env: {{ PYTHONPATH: {json.dumps(path, ensure_ascii=False)} }}"
        profile.write_text(profile.read_text(encoding="utf-8").replace(_NO_FOLDER, line), encoding="utf-8")
