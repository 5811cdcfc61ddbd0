"""What a site and its user want from SLURM: one small YAML file. Scripts hold what is set or has a default."""

from __future__ import annotations

import functools
import importlib.resources
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, field_validator, model_validator

from space_dist import config as configs
from space_dist.config import Name, Section
from space_dist.config.wanted import Words
from space_dist.errors import nearest

_MAX_WORD, _MAX_LINE, _MAX_ITEMS = 200, 1000, 50  # sbatch reads a directive into 8 KiB
_EXTRA = re.compile(r"--([a-z][a-z0-9-]{0,40})(=.*)?")
_TIME = re.compile(r"(?:(?P<days>\d+)-)?(?P<rest>\d+(?::\d+){0,2})")
EARLY_SECONDS = 60  # by which SLURM may send a signal before it is due (sbatch(1), --signal)
_MEMORY = r"^[0-9]{1,12}[KMGT]?$"
_NAME = r"[A-Za-z_][A-Za-z0-9_]*"
_VARIABLE = re.compile(_NAME)
# A variable that a script sets, reads or unsets: `name=`, `${name`, `read -t name`, and those below.
_USED = re.compile(
    rf"(?<![\w$-])({_NAME})(?:\[[^]]*\])?\+?=|\$\{{?[#!]?({_NAME})|(?<![\w-])(?:mapfile|unset|export|read)((?: -?\w+)+)"
)
_COMMENT = re.compile(r"^\s*#.*$", re.MULTILINE)
# Bash's own: read-only, or set by itself, or a change of how it reads what follows.
_BASHS = frozenset((
    "CDPATH", "CHILD_MAX", "COLUMNS", "COMP_WORDBREAKS", "COPROC", "DIRSTACK", "ENV", "EPOCHREALTIME", "EPOCHSECONDS",
    "EUID", "EXECIGNORE", "FIGNORE", "FUNCNAME", "FUNCNEST", "GLOBIGNORE", "GROUPS", "HISTCMD", "HOSTNAME", "HOSTTYPE",
    "IFS", "INPUTRC", "LINENO", "LINES", "MACHTYPE", "MAPFILE", "OLDPWD", "OPTARG", "OPTERR", "OPTIND", "OSTYPE",
    "PIPESTATUS", "POSIXLY_CORRECT", "PPID", "PROMPT_COMMAND", "PS0", "PS1", "PS2", "PS3", "PS4", "PWD", "RANDOM",
    "REPLY", "SECONDS", "SHELLOPTS", "SHLVL", "SRANDOM", "TIMEFORMAT", "TMOUT", "UID", "_",
))  # fmt: skip
# What the scripts themselves are made of, and what would have sbatch do something else; in full: sbatch takes any
# beginning of a name for the whole.
_OURS = {
    "array", "chdir", "kill-on-invalid-dep", "ntasks", "ntasks-per-node", "open-mode", "parsable", "requeue",
    "no-requeue", "test-only", "wait", "wrap", "help", "usage", "version",
}  # fmt: skip
# Of which null is a choice of its own, and as good as any.
_NULL_SAYS_MORE = ("job_name", "cpus_per_task", "throttle", "error", "venv", "conda", "apptainer", "interface")


def _one_line(value: str) -> str:
    """Nothing that ends a line or commands a terminal; quoting takes care of all the rest."""
    if not value.isprintable():
        raise ValueError("it must be one line of printable characters")
    return value


def _no_option(value: str) -> str:
    if value.startswith("-"):
        raise ValueError("it must not begin with a hyphen")
    return _one_line(value)


def _unexpanded(value: str) -> str:
    """Quoted, a tilde is a letter."""
    if value.startswith("~"):
        raise ValueError("it must not begin with ~, since nothing in it is expanded: write the path from / on")
    return value


def _whole_path(value: str) -> str:
    if not value.startswith("/"):
        raise ValueError(
            "it must be a path from / on: jobs run in a folder of their own, and nothing in it is expanded"
        )
    return value


Word = Annotated[str, Field(min_length=1, max_length=_MAX_WORD), AfterValidator(_no_option)]
Text = Annotated[str, Field(min_length=1, max_length=_MAX_LINE), AfterValidator(_no_option)]
Line = Annotated[str, Field(min_length=1, max_length=_MAX_LINE), AfterValidator(_one_line)]
Memory = Annotated[str, Field(pattern=_MEMORY), Words("a size like 4000M or 16G")]
Interface = Annotated[
    str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._:-]{0,30}$"), Words("the name of a network interface, like ib0"),
]  # fmt: skip
NodesFolder = Annotated[
    str, Field(max_length=40, pattern=r"^/"), AfterValidator(_one_line),
    Words("a path from / on"),
]  # fmt: skip
MailType = Literal[
    "NONE", "BEGIN", "END", "FAIL", "REQUEUE", "ALL", "INVALID_DEPEND", "STAGE_OUT", "TIME_LIMIT", "TIME_LIMIT_90",
    "TIME_LIMIT_80", "TIME_LIMIT_50", "ARRAY_TASKS",
]  # fmt: skip


class Notice(Section):
    """The signal by which SLURM announces that a job's time is nearly over."""

    name: Literal["USR1", "USR2", "HUP"] = "USR1"
    """Which; TERM is none of them, since SLURM ends cancelled jobs with it, and these must not come back."""
    lead_seconds: int = Field(default=120, ge=10, le=65535)
    """How long before the time limit. SLURM may send it up to 60 s earlier. At least the grid's
    resources.grace_seconds and 10 s more."""


class Aggregation(Section):
    """What the job that checks and reports in the end, or has a search go on, needs where it differs from training."""

    partition: Word | None = None
    qos: Word | None = None
    time: str | int | None = None
    mem: Memory | int | None = None

    @field_validator("time")
    @classmethod
    def _time(cls, value: str | int | None) -> str | int | None:
        return _checked_time(value)


class Profile(Section):
    """A site's profile. Every field is optional; one without a default is written only if it is set."""

    job_name: Name | None = None
    """Name of the jobs; null: the grid's."""
    partition: Word | None = None
    """Partition, or several separated by commas; null: the cluster's default."""
    account: Word | None = None
    """Whom to charge; null: the cluster's default for the user."""
    qos: Word | None = None
    """Quality of service; null: the cluster's default."""
    constraint: Word | None = None
    """Features a node must have. Runs give the same bits on every x86-64 CPU with AVX2 and FMA: any of them will do."""
    nodelist: Word | None = None
    """Nodes to use."""
    exclude: Word | None = None
    """Nodes not to use."""
    reservation: Word | None = None
    """Reservation."""
    time: str | int | None = None
    """Time limit of a job, as SLURM writes it (minutes, HH:MM:SS, D-HH:MM:SS, ...); null: the partition's default.
    What is not done by then goes on from its checkpoint in the next one."""
    nodes: int = Field(default=2, ge=1, le=10_000)
    """Nodes of the one allocation in cluster mode. Array tasks have one each."""
    cpus_per_task: int | None = Field(default=None, ge=1, le=10_000)
    """CPUs of an array task, or of each node in cluster mode; null: what one run needs (1 + resources.workers)."""
    mem: Memory | int | None = None
    """Memory of a node's part of a job (megabytes, or with K, M, G, T); null: the cluster's default."""
    mem_per_cpu: Memory | int | None = None
    """Memory for each CPU instead of `mem`."""
    gres: Word | None = None
    """Generic resources, like gpu:1."""
    gpus: Word | int | None = None
    """GPUs."""
    exclusive: bool | Literal["user", "mcs"] = False
    """Whether to share nodes with no other job (true), or with none of another user."""
    throttle: int | None = Field(default=None, ge=1, le=1_000_000)
    """Array tasks at a time; in cluster mode: runs at a time. null: as many as there is room for."""
    cells_per_task: int = Field(default=1, ge=1, le=100_000)
    """Runs (not cells: a cell has one for each seed) that an array task does, one after another, or at once if it has
    the CPUs. More than 1 suits runs that are short beside the half minute it takes to start."""
    max_array_size: int = Field(default=1001, ge=2, le=4_000_001)
    """The site's MaxArraySize (`scontrol show config`). More tasks are written as several arrays."""
    output: Text = "logs/%x-%A_%a.out"
    """File of a job's output: %x its name, %A and %a array and task, %j job; for jobs that are no array, %A_%a is
    written as %j. Its folder is made before submission."""
    error: Text | None = None
    """File of a job's errors; null: the same."""
    mail_user: Word | None = None
    """Who gets mail."""
    mail_type: tuple[MailType, ...] = Field(default=(), strict=False)
    """When: [END, FAIL], ..."""
    dependency: Word | None = None
    """What training waits for, like afterok:1234."""
    signal: Notice = Notice()
    max_requeues: int = Field(default=50, ge=0, le=1000)
    """How often a job that was interrupted puts itself back into the queue."""
    comment: Text | None = None
    """A comment."""
    extra: tuple[Line, ...] = Field(default=(), max_length=_MAX_ITEMS, strict=False)
    """Further options of sbatch that have no field here: [--licenses=matlab:1, ...]."""
    aggregate: Aggregation = Aggregation()
    env: dict[str, Annotated[str, Field(max_length=_MAX_LINE), AfterValidator(_one_line)]] = Field(
        default={}, max_length=_MAX_ITEMS
    )
    """Environment variables, set to exactly these texts: nothing in them is expanded."""
    modules: tuple[Word, ...] = Field(default=(), max_length=_MAX_ITEMS, strict=False)
    """Modules to load."""
    venv: Annotated[Text, AfterValidator(_whole_path)] | None = None
    """Folder of a Python virtual environment to activate."""
    conda: Annotated[Text, AfterValidator(_unexpanded)] | None = None
    """Name or folder of a conda environment to activate."""
    apptainer: Annotated[Text, AfterValidator(_unexpanded)] | None = None
    """Container image to run everything in. It must see the grid's folder and `temp`."""
    apptainer_options: tuple[Line, ...] = Field(default=(), max_length=_MAX_ITEMS, strict=False)
    """Options of `apptainer exec`, a word each: [--bind, /scratch]."""
    prologue: tuple[Line, ...] = Field(default=(), max_length=_MAX_ITEMS, strict=False)
    """Lines of shell, written as they are, before anything of ours runs. Whoever writes them runs them."""
    command: tuple[Line, ...] = Field(default=("space-dist",), min_length=1, max_length=_MAX_ITEMS, strict=False)
    """How to call this package there, a word each: [python, -P, -m, space_dist.cli]."""
    interface: Interface | None = None
    """Network interface of the nodes for Ray in cluster mode, like ib0; null: the one that faces the other nodes."""
    temp: NodesFolder = "/tmp"  # noqa: S108 - the node's own
    """Folder on the nodes' own disks for what lives as long as a job. Short: Ray's sockets lie below it, and Linux
    allows 107 bytes for their paths."""

    @field_validator("time")
    @classmethod
    def _time(cls, value: str | int | None) -> str | int | None:
        return _checked_time(value)

    @field_validator("partition", "constraint", "nodelist", "exclude", "gres", mode="before")
    @classmethod
    def _one_text(cls, value: Any) -> Any:
        if isinstance(value, list) and value and all(isinstance(one, str) for one in value):
            raise ValueError(f"write several as one text, {','.join(value)}")
        return value

    @property
    def left_to_slurm(self) -> list[str]:
        """The keys that were given empty, where that says no more than that no option is written for them."""
        given = [name for name in type(self).model_fields if name in self.model_fields_set]
        return [name for name in given if name not in _NULL_SAYS_MORE and getattr(self, name) is None]

    @field_validator("extra")
    @classmethod
    def _extras(cls, lines: tuple[str, ...]) -> tuple[str, ...]:
        for line in lines:
            found = _EXTRA.fullmatch(line)
            if not found:
                raise ValueError(f"{line!r} is no long option of sbatch: write --name or --name=value")
            name = found.group(1)
            if (ours := _meant(name, sorted(_OURS))) is not None:
                raise ValueError(
                    f"--{name}{_in_full(name, ours)} is what these scripts are made of; it cannot be set here"
                )
            if (field := _meant(name, [one.replace("_", "-") for one in cls.model_fields])) is not None:
                raise ValueError(f"--{name}{_in_full(name, field)} has a field of its own: {field.replace('-', '_')}")
        return lines

    @field_validator("env", mode="before")
    @classmethod
    def _texts(cls, variables: Any) -> Any:
        """No number is taken for its text: YAML makes 10 of 010, and 1.1 of 1.10, and nobody would see that."""
        for name, value in variables.items() if isinstance(variables, dict) else ():
            if isinstance(value, int | float):
                text = json.dumps(value)
                raise ValueError(
                    f'{name}: {text} is no text; write it in quotes, {name}: "{text}", or --set \'env.{name}="{text}"\''
                )
            if value is None:
                raise ValueError(f'{name} is empty; write {name}: "" for a variable without a text, or leave it out')
        return variables

    @field_validator("env")
    @classmethod
    def _variables(cls, variables: dict[str, str]) -> dict[str, str]:
        for name in variables:
            if not _VARIABLE.fullmatch(name) or len(name) > _MAX_WORD:
                raise ValueError(f"{name[:_MAX_WORD]!r} is no name of an environment variable")
            if name == "PATH":
                raise ValueError(
                    "PATH: nothing in a value is expanded, so it could only be replaced, and SLURM's own commands be "
                    "lost; write a line into `prologue`: export PATH=/opt/bin:$PATH"
                )
            if name in _BASHS or name.startswith("BASH"):
                raise ValueError(f"{name} is bash's own")
            if name.startswith("SLURM_") or name in _variables_of_scripts():
                raise ValueError(f"{name} is set by SLURM or by these scripts")
        return variables

    @field_validator("command")
    @classmethod
    def _program(cls, words: tuple[str, ...]) -> tuple[str, ...]:
        _no_option(words[0])
        return words

    @model_validator(mode="after")
    def _together(self) -> Self:
        # sbatch refuses both together, but only once the job is submitted.
        if self.mem is not None and self.mem_per_cpu is not None:
            raise ValueError("mem and mem_per_cpu exclude each other")
        if self.apptainer_options and self.apptainer is None:
            raise ValueError("apptainer_options needs apptainer")
        if self.venv is not None and self.conda is not None:
            raise ValueError("venv and conda exclude each other")
        limit = seconds(self.time)
        if limit is not None and limit <= self.signal.lead_seconds:
            raise ValueError(
                f"time ({limit} s) must be longer than signal.lead_seconds ({self.signal.lead_seconds} s): else each "
                "job makes a checkpoint and goes back into the queue as soon as it begins"
            )
        return self


def variables_in(script: str) -> set[str]:
    """Every variable that the text of a script, or of a template of one, sets, reads or unsets by name."""
    found: set[str] = set()
    for assigned, read, listed in _USED.findall(_COMMENT.sub("", script)):
        found |= {assigned, read, *(word for word in listed.split() if not word.startswith("-"))} - {""}
    return found


@functools.cache
def _variables_of_scripts() -> frozenset[str]:
    folder = importlib.resources.files("space_dist.slurm") / "templates"
    texts = [file.read_text() for file in folder.iterdir() if file.name.endswith(("sbatch.j2", "sh.j2"))]
    return frozenset().union(*map(variables_in, texts))


def _meant(name: str, options: Sequence[str]) -> str | None:
    """The option that sbatch may take `name` for: itself, or one that begins so."""
    return name if name in options else next((option for option in options if option.startswith(name)), None)


def _in_full(name: str, option: str) -> str:
    return "" if name == option else f", which may be short for --{option},"


def load_profile(path: Path | None, overrides: Sequence[str] = ()) -> Profile:
    """A profile from its YAML file (None: all defaults), with `key=value` overrides.

    Raises ConfigError with file and key of every fault.
    """
    data: dict[str, Any] = {} if path is None else configs.read_yaml(configs.located(path))
    if path is not None:
        configs.refuse_all_but_profiles(data, path)
    for override in overrides:
        configs.apply_override(data, override)
    return configs.check(Profile, data, str(path or "the default profile"), configs.origins(overrides))


def seconds(time: str | int | None) -> int | None:
    """A time limit as SLURM writes it, in seconds; None without one."""
    if time is None:
        return None
    found = _TIME.fullmatch(str(time))
    if found is None:
        return None
    days, parts = int(found["days"] or 0), [int(part) for part in found["rest"].split(":")]
    if found["days"] is not None:  # D-HH[:MM[:SS]]
        hours, minutes, rest = (*parts, 0, 0)[:3]
    elif len(parts) == 3:
        hours, minutes, rest = parts
    else:  # MM[:SS]
        # SLURM's own reading (sbatch(1), --time): a lone number is minutes.
        hours, minutes, rest = 0, *(*parts, 0)[:2]
    return ((24 * days + hours) * 60 + minutes) * 60 + rest


def _checked_time(value: str | int | None) -> str | int | None:
    if value is not None and (len(str(value)) > 20 or not seconds(value)):
        near = nearest(str(value), ["30", "01:00:00", "1-00:00:00"])
        raise ValueError(f"write minutes, MM:SS, HH:MM:SS, D-HH, D-HH:MM or D-HH:MM:SS{near.rstrip('.')}")
    return value
