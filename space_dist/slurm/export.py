"""A manifest and a profile become SLURM scripts: pure text, the same for the same input.

Templates are Jinja2 files, ours or a user's own of the same name. What they print is quoted for the shell unless it is
a number or was made safe before, so that no template can forget it: in the README, too, for its commands are pasted.
"""

from __future__ import annotations

import contextlib
import functools
import json
import re
import shlex
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import jinja2
import jinja2.meta
from jinja2.sandbox import ImmutableSandboxedEnvironment

from space_dist import config as configs
from space_dist.config import clean
from space_dist.errors import ConfigError, LedgerError, counted, nearest
from space_dist.experiment.manifest import Grid, Manifest
from space_dist.experiment.tuning import confirmation_of
from space_dist.slurm.arrays import Array, arrays_of
from space_dist.slurm.profile import EARLY_SECONDS, Profile, seconds, variables_in
from space_dist.system.files import atomic_write, read_file
from space_dist.system.importing import found_in, lost_elsewhere

Mode = Literal["array", "cluster"]
TRAIN, SUBMIT, README = "train.sbatch", "submit.sh", "README.md"
AGGREGATE = "aggregate.sbatch"  # once, after a grid's training
ADVANCE = "advance.sbatch"  # after each generation of a search
NEXT = "slurm_next.txt"  # in a search's folder: what is to be submitted next, while that is being done
JOBS = "slurm_jobs.txt"  # in the grid's folder: `<job id> <what it is>` a line, of the last submission
RESULTS = "slurm_results.txt"  # in an exported folder whose results go elsewhere (--root): where to
_MAX_ARRAYS = 1000
_MAX_NOTE_BYTES = 8 << 10  # longer than any path
_CHECKPOINT_SECONDS = 10  # beside the grace time: to notice the signal, and to get back into the queue
_RAY_TRIES = 3  # in a row, without a run that began: then what keeps Ray from coming up will not go away by itself
_PLAIN = re.compile(r"[A-Za-z0-9@%+,.:/_-]+")


class _Safe(str):
    """Text that goes into a script as it stands."""

    __slots__ = ()


@dataclass(frozen=True)
class Export:
    """How a grid, or a search, runs on SLURM. root: absolute; None: its folder is the one that holds the scripts.

    Raises ConfigError for what does not go together.
    """

    manifest: Manifest
    profile: Profile
    mode: Mode
    root: Path | None = None

    def __post_init__(self) -> None:
        need, lead = self.manifest.resources.grace_seconds + _CHECKPOINT_SECONDS, self.profile.signal.lead_seconds
        if lead < need:
            raise ConfigError(
                f"signal.lead_seconds: {lead} is too short for resources.grace_seconds of {self.manifest.name}; "
                f"it must be at least {need:g}"
            )
        if self.cpus < self.manifest.cpus_per_run:
            raise ConfigError(
                f"cpus_per_task: {self.cpus} are too few: each run of {self.manifest.name} needs "
                f"{self.manifest.cpus_per_run} (1 + resources.workers)"
            )
        if self.mode == "cluster" and self.profile.cells_per_task > 1:
            raise ConfigError("cells_per_task is for array mode; in cluster mode all nodes work on all runs")
        if self.root is not None and not (self.root.is_absolute() and str(self.root).isprintable()):
            raise ConfigError(f"--root {clean(str(self.root))!r}: an absolute path of printable characters is needed")
        if len(self.arrays) > _MAX_ARRAYS:
            raise ConfigError(f"{len(self.arrays):,} arrays are too many; raise cells_per_task")

    @property
    def cpus(self) -> int:
        """Of an array task, or of each node."""
        return self.profile.cpus_per_task or self.manifest.cpus_per_run

    def tracking_remark(self, folder: Path) -> str | None:
        """What is to be known of the MLflow that scripts in `folder` carry: a file that may be this machine's own."""
        uri = self.manifest.tracking.uri
        results = (self.root or folder).absolute()
        if uri is None or not uri.startswith("sqlite:") or Path(uri.removeprefix("sqlite:///")).is_relative_to(results):
            return None
        return (
            f"tracking.uri: {uri} is a file outside of {results}, and maybe of this machine alone: the job that "
            "gathers the results would then write to a new file of that name on its own node. Set tracking.uri in the "
            "grid's file, or MLFLOW_TRACKING_URI, to "
            f"http(s)://HOST:PORT or sqlite:///{results}/mlflow.db, and export again; or tracking.uri: null, and "
            "`space-dist sync` later"
        )

    def time_remark(self) -> str | None:
        """What is to be known of a time limit that SLURM may announce as soon as a job begins."""
        limit, lead = seconds(self.profile.time), self.profile.signal.lead_seconds
        if limit is None or limit > lead + EARLY_SECONDS:
            return None
        return (
            f"time: {limit} s, of which SLURM announces the end {lead} s before (signal.lead_seconds), or up to "
            f"{EARLY_SECONDS} s sooner: jobs may make a checkpoint and go back into the queue as soon as they begin, "
            f"until max_requeues. A time above {lead + EARLY_SECONDS} s leaves some for training"
        )

    def empty_remark(self) -> str | None:
        """What is to be known of keys of the profile that are there and empty."""
        if not (empty := self.profile.left_to_slurm):
            return None
        default = "; without time, the time limit is the partition's" if "time" in empty else ""
        return f"{', '.join(empty)}: empty, so jobs get what the cluster gives by default{default}"

    def nodes_remark(self) -> str | None:
        """What is to be known of a profile's nodes in array mode: its file may have them, for the other mode."""
        if self.mode != "array" or "nodes" not in self.profile.model_fields_set or self.profile.nodes == 1:
            return None
        return f"nodes: {self.profile.nodes} is for --mode cluster; in array mode, the default, each task has one node"

    @property
    def own_modules(self) -> list[str]:
        """The top-level modules of users' own that runs import: no folder of an export has them."""
        found = (configs.parse(cell.config, f"cell {cell.id}").import_paths for cell in self.manifest.cells)
        return sorted({path.partition(":")[0].partition(".")[0] for paths in found for path in paths})

    @property
    def _prologue_sets_path(self) -> bool:
        return any("PYTHONPATH" in line for line in self.profile.prologue)

    @property
    def sets_path(self) -> bool:
        """Whether the profile says itself where jobs find modules."""
        return bool(self.profile.env.get("PYTHONPATH")) or self._prologue_sets_path

    def import_remark(self) -> str | None:
        """What is to be known of modules that this machine finds only here, and jobs maybe nowhere."""
        if self._prologue_sets_path:
            return None
        given = self.profile.env.get("PYTHONPATH", "")
        folders = [folder for folder in given.split(":") if folder]
        lost = lost_elsewhere(name for name in self.own_modules if not found_in(name, folders))
        if not lost:
            return None
        kind, names = "grid" if self.manifest.search is None else "search", ", ".join(map(repr, lost))
        if unseen := [folder for folder in folders if not Path(folder).is_dir()]:
            return (
                f"the {kind} imports {names}, and env.PYTHONPATH names {unseen[0]}, which is not here: whether the "
                "nodes find it there cannot be told"
            )
        here = str(Path.cwd())
        is_here = all(found_in(name, [here]) for name in lost)
        line = json.dumps({"PYTHONPATH": ":".join([*folders, here if is_here else "/FOLDER"])}, ensure_ascii=False)
        where = f"found in {here} alone, where no job looks" if is_here else "not found here"
        return (
            f"the {kind} imports {names}, which is {where}. Write the folder, which all nodes must see, into the "
            f"profile, env: {line}, and export again; or install it beside space-dist on the nodes"
        )

    @property
    def n_runs(self) -> int:
        """All of the grid's; of a search, as many as are open at a time at most."""
        search = self.manifest.search
        if search is None:
            return len(self.manifest.runs())
        trials = int(search.config["trials"])
        if search.config["population"] is None:
            trials = min(trials, int(search.config["generation"]))
        return trials * len(search.arms) * len(self.manifest.seeds)

    @property
    def n_tasks(self) -> int:
        """Array tasks for so many runs."""
        return -(-self.n_runs // self.profile.cells_per_task)

    @property
    def scripts(self) -> tuple[str, str, str]:
        """What is submitted for training, what after it, and what submits them."""
        return TRAIN, AGGREGATE if self.manifest.search is None else ADVANCE, SUBMIT

    @property
    def parallel(self) -> int:
        """Runs at a time within an array task."""
        return min(self.profile.cells_per_task, self.cpus // self.manifest.cpus_per_run)

    @property
    def arrays(self) -> list[Array]:
        """All tasks."""
        return arrays_of(range(self.n_tasks), self.profile.max_array_size, self.profile.throttle)

    @property
    def job_name(self) -> str:
        """Of the training jobs."""
        return self.profile.job_name or self.manifest.name

    @property
    def begins_after(self) -> str:
        """What the first job of a search waits for: that of an earlier submission, too, which has the same name."""
        own = self.profile.dependency
        # SLURM takes "all of" (,) or "any of" (?), never both.
        return "singleton" if own is None else own if "?" in own else f"{own},singleton"

    def train_directives(self) -> Iterator[str]:
        """The `#SBATCH` lines of training."""
        profile = self.profile
        yield _directive("job-name", self.job_name)
        yield from self._common(aggregate=False)
        yield from _optional({"nodelist": profile.nodelist, "exclude": profile.exclude})
        if self.manifest.search is None:  # what a search waits for, its first job does
            yield from _optional({"dependency": profile.dependency})
        yield _directive("nodes", profile.nodes if self.mode == "cluster" else 1)
        yield _directive("ntasks-per-node", 1)
        yield _directive("cpus-per-task", self.cpus)
        yield from _optional({"time": profile.time, "mem": profile.mem, "mem-per-cpu": profile.mem_per_cpu,
                              "gres": profile.gres, "gpus": profile.gpus})  # fmt: skip
        if profile.exclusive:
            yield _directive("exclusive", None if profile.exclusive is True else profile.exclusive)
        yield from self._outputs(array=self.mode == "array")
        yield _directive("open-mode", "append")
        # Said, because a site may have JobRequeue=0: without it `scontrol requeue` is refused.
        yield _directive("requeue", None)
        # B: to the batch script alone, which tells the runs and decides about requeueing.
        yield _directive("signal", f"B:{profile.signal.name}@{profile.signal.lead_seconds}")
        if self.mode == "array" and self.manifest.search is None:
            yield _directive("array", self.arrays[0].indices)
        yield from self._extra()

    def aggregate_directives(self) -> Iterator[str]:
        """The `#SBATCH` lines of the job that checks and reports, or that has a search go on."""
        own = self.profile.aggregate
        yield _directive("job-name", f"{self.job_name}-{PurePosixPath(self.scripts[1]).stem}")
        yield from self._common(aggregate=True)
        yield _directive("nodes", 1)
        yield _directive("ntasks-per-node", 1)
        yield _directive("cpus-per-task", 1)
        yield from _optional({"time": own.time or self.profile.time, "mem": own.mem})
        yield from self._outputs(array=False)
        yield _directive("open-mode", "append")
        if self.manifest.search is not None:  # which would end with it
            yield _directive("requeue", None)
        yield from self._extra()

    def _common(self, *, aggregate: bool) -> Iterator[str]:
        profile, own = self.profile, self.profile.aggregate
        yield from _optional({
            "partition": (aggregate and own.partition) or profile.partition, "account": profile.account,
            "qos": (aggregate and own.qos) or profile.qos, "constraint": profile.constraint,
            "reservation": profile.reservation, "comment": profile.comment, "mail-user": profile.mail_user,
            "mail-type": ",".join(profile.mail_type) or None,
        })  # fmt: skip

    def _outputs(self, *, array: bool) -> Iterator[str]:
        files = {"output": self.profile.output, "error": self.profile.error}
        yield from _optional(
            # %A_%a of a job that is no array would be numbers that mean nothing.
            {name: file if array or not file else file.replace("%A_%a", "%j") for name, file in files.items()}
        )

    def _extra(self) -> Iterator[str]:
        for line in self.profile.extra:
            name, _, value = line[2:].partition("=")
            yield _directive(name, value if "=" in line else None)

    def log_folders(self) -> list[str]:
        """Folders that must be there before a job can write its output; those with a % in them are SLURM's business."""
        files = [file for file in (self.profile.output, self.profile.error) if file]
        folders = [str(PurePosixPath(file).parent) for file in files]
        return sorted({folder for folder in folders if "%" not in folder and folder != "."})


def export(
    grid: Export, instances: Mapping[str, bytes], folder: Path, templates: Path | None = None
) -> list[Path]:  # fmt: skip
    """Write the scripts, their README and the frozen grid into `folder`; returns the files, the manifest's last.

    A search that is there already, and may have gone on, stays as it is. Raises ConfigError if the folder holds another
    grid or search, or cannot be written.
    """
    there = Grid(folder)
    known = there.manifest_file.exists()
    if known and not _holds(there, grid.manifest):
        raise ConfigError(f"{folder} holds another grid or search; --out names another folder")
    written = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in render(grid, templates).items():
            atomic_write(folder / name, text.encode())
            if name == SUBMIT:
                (folder / name).chmod(0o755)
            written.append(folder / name)
        written += _note_results(grid, folder)
    except OSError as error:
        raise ConfigError(f"cannot write {folder}: {error.strerror}") from None
    # Last: a folder with a manifest has all its scripts.
    if not known or grid.manifest.search is None:
        there.freeze(grid.manifest, instances)
    return [*written, there.manifest_file]


def _note_results(grid: Export, folder: Path) -> list[Path]:
    """Have the exported folder know where its results are, if not in itself; returns what was written."""
    note = folder / RESULTS
    results = None if grid.root is None else grid.root / grid.manifest.name
    if results is None or results.resolve() == folder.resolve():
        note.unlink(missing_ok=True)  # of an export before
        return []
    atomic_write(note, f"{results}\n".encode())
    return [note]


def results_elsewhere(folder: Path) -> Path | None:
    """Where the results of an exported folder are, if it was exported with another root."""
    try:
        path = Path(read_file(folder / RESULTS, _MAX_NOTE_BYTES).decode().strip())
    except (OSError, UnicodeDecodeError):
        return None
    return path if path.is_absolute() and str(path).isprintable() else None


def _holds(there: Grid, manifest: Manifest) -> bool:
    """Whether a folder holds this grid, or this search, however far it is."""
    try:
        before = there.manifest()
    except LedgerError:
        return False
    if manifest.search is not None or before.search is not None:
        return same_search(before, manifest)
    return before.runs_digest == manifest.runs_digest


def same_search(one: Manifest, other: Manifest) -> bool:
    """Whether both are of one search, however far each of them is."""
    if one.search is None or other.search is None:
        return False
    return (one.name, one.seeds, one.search.with_trials(())) == (other.name, other.seeds, other.search.with_trials(()))


def render(grid: Export, templates: Path | None = None) -> dict[str, str]:
    """File name -> text of every script and of the README. `templates`: a folder whose files replace ours.

    Raises ConfigError with file and line of a template's fault.
    """
    shell = _environment(templates)
    _refuse_variables(grid.profile, templates)
    training, after, submitting = grid.scripts
    files = {training: f"{grid.mode}.sbatch.j2", after: f"{after}.j2", submitting: f"{submitting}.j2",
             README: f"{README}.j2"}  # fmt: skip
    values = _values(grid)
    texts = {}
    for name, template in files.items():
        try:
            texts[name] = shell.get_template(template).render(values)
        except jinja2.TemplateNotFound as error:
            raise ConfigError(f"template {error.name} is missing") from None
        except jinja2.TemplateSyntaxError as error:
            raise ConfigError(
                f"template {error.filename or error.name}, line {error.lineno}: {error.message}"
            ) from None
        except RecursionError as error:
            raise ConfigError(
                f"template {_location(template, error)}: it includes itself, or what includes it"
            ) from None
        except Exception as error:  # a template may compute anything
            what = error.message if isinstance(error, jinja2.TemplateError) else f"{type(error).__name__}: {error}"
            raise ConfigError(f"template {_location(template, error)}: {what}") from None
    if templates is not None:  # last: faults of theirs may hide what they include
        _refuse_unused(templates, shell)
    return texts


def _location(template: str, error: Exception) -> str:
    """Where in a template an error lies, as Jinja2 writes it into the traceback: file and line."""
    inside = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.endswith(".j2")]
    return f"{inside[-1].filename}, line {inside[-1].lineno}" if inside else template


def _refuse_variables(profile: Profile, templates: Path | None) -> None:
    """Raise ConfigError if a profile sets a variable of somebody's own templates; of ours it cannot."""
    for file in sorted(templates.glob("*.j2")) if templates is not None else ():
        try:
            taken = variables_in(file.read_text()) & profile.env.keys()
        except (OSError, ValueError) as error:
            raise ConfigError(f"template {file} cannot be read: {error}") from None
        if taken:
            raise ConfigError(f"env: {min(taken)} is a variable of the template {file}")


def _refuse_unused(templates: Path, shell: jinja2.Environment) -> None:
    """Raise ConfigError for a file that replaces none of our templates and is included by no other, or for no file."""
    ours = jinja2.PackageLoader("space_dist.slurm").list_templates()
    files = sorted(file for file in templates.iterdir() if file.is_file() and not file.name.startswith("."))
    if not files:
        raise ConfigError(f"--templates {templates} holds no file. Ours, which may be replaced: {', '.join(ours)}")
    included: set[str | None] = set()
    for file in files:
        with contextlib.suppress(jinja2.TemplateError, OSError, ValueError):  # of one that these scripts do not need
            included.update(jinja2.meta.find_referenced_templates(shell.parse(file.read_text())))
    for file in files:
        if file.name not in ours and not included & {file.name, None}:  # None: a name that is computed
            raise ConfigError(
                f"template {file} replaces none of ours, and none here includes it{nearest(file.name, ours)} "
                f"Allowed: {', '.join(ours)}"
            )


@functools.lru_cache(maxsize=4)
def _environment(templates: Path | None) -> jinja2.Environment:
    loader = jinja2.ChoiceLoader([
        *([jinja2.FileSystemLoader(templates)] if templates is not None else []),
        jinja2.PackageLoader("space_dist.slurm"),
    ])  # fmt: skip
    # A stranger's template may hold any shell, which its reader sees; to write it out must run none of its Python.
    made = ImmutableSandboxedEnvironment(
        loader=loader, undefined=jinja2.StrictUndefined, finalize=_quoted, trim_blocks=True, lstrip_blocks=True,
        keep_trailing_newline=True, autoescape=False,
    )  # fmt: skip
    made.globals |= {"shell_line": _shell_line, "counted": _counted}
    return made


def _values(grid: Export) -> dict[str, Any]:
    """What templates may print."""
    manifest, profile = grid.manifest, grid.profile
    return {
        "name": manifest.name, "mode": grid.mode, "job_name": grid.job_name, "digest": manifest.runs_digest,
        "n_runs": grid.n_runs, "n_cells": len(manifest.cells), "n_seeds": len(manifest.seeds),
        "n_tasks": grid.n_tasks, "per_task": profile.cells_per_task, "parallel": grid.parallel,
        "arrays": [array._asdict() for array in grid.arrays], "max_array_size": profile.max_array_size,
        "search": manifest.search is not None, "kind": "grid" if manifest.search is None else "search",
        "n_trials": 0 if manifest.search is None else manifest.search.total,
        "begins_after": grid.begins_after,
        "throttle": profile.throttle, "cpus": grid.cpus, "nodes": profile.nodes,
        "train_directives": [_Safe(line) for line in grid.train_directives()],
        "aggregate_directives": [_Safe(line) for line in grid.aggregate_directives()],
        "root": None if grid.root is None else str(grid.root), "log_folders": grid.log_folders(),
        "jobs": JOBS, "next": NEXT,
        "signal": profile.signal.name, "lead_seconds": profile.signal.lead_seconds,
        "max_requeues": profile.max_requeues, "ray_tries": _RAY_TRIES,
        "stop_seconds": round(manifest.resources.grace_seconds) + 60,
        "own_modules": grid.own_modules, "sets_path": grid.sets_path, **_confirmation(grid),
        "sync": manifest.tracking.anywhere,
        "where": "." if grid.root is None else str(grid.root / manifest.name),
        "env": {_Safe(name): value for name, value in profile.env.items()},
        "modules": profile.modules, "venv": profile.venv, "conda": profile.conda,
        "apptainer": profile.apptainer, "apptainer_options": profile.apptainer_options,
        "prologue": [_Safe(line) for line in profile.prologue], "command": profile.command,
        "interface": profile.interface, "temp": profile.temp,
    }  # fmt: skip


def _confirmation(grid: Export) -> dict[str, str]:
    """The file of the grid that confirms a search, and where `tune report` looks for its runs: beside the search's."""
    name = confirmation_of(grid.manifest.name)
    folder, beside = (".", "..") if grid.root is None else (str(grid.root / grid.manifest.name), str(grid.root))
    return {
        "confirmation": str(PurePosixPath(folder, "confirm", f"{name}.yaml")),
        "confirmed_in": str(PurePosixPath(beside, name)),
    }


def _shell_line(*words: object) -> _Safe:
    """A line that can be pasted into a shell: each of its words is one, whatever it holds."""
    return _Safe(f"{shlex.join(map(str, words)):<44}")


def _counted(number: int, what: str) -> _Safe:
    return _Safe(counted(number, what))


def _quoted(value: Any) -> Any:
    """For the shell; templates print numbers and what is safe already as they are."""
    # `True` and `None` in a script are a template's mistake, and bash would take them for words.
    if isinstance(value, bool) or value is None:
        raise jinja2.TemplateRuntimeError(f"prints {value!r}, which is no text")
    return value if isinstance(value, (int, _Safe)) else shlex.quote(str(value))


def _optional(options: Mapping[str, str | int | None]) -> Iterator[str]:
    for name, value in options.items():
        if value is not None:
            yield _directive(name, value)


def _directive(name: str, value: str | int | None) -> str:
    """One `#SBATCH` line. sbatch reads it with rules of its own: # begins a comment even in quotes."""
    if value is None:
        return f"#SBATCH --{name}"
    text = str(value)
    if not _PLAIN.fullmatch(text):
        text = '"' + re.sub(r'(["\\#])', r"\\\1", text) + '"'
    return f"#SBATCH --{name}={text}"
