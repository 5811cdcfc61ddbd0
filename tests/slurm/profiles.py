"""Profiles drawn at random, with values that the Slurm of `up.sh` knows: what a site might ask for, all of it."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

from space_dist.experiment.manifest import Manifest
from space_dist.slurm import Export, Mode, Profile

RESERVATION = "course"  # which the test makes
_ALONE = {"mem": "mem_per_cpu", "gres": "gpus", "venv": "conda", "nodelist": "exclude"}  # never both
_VALUES: dict[str, tuple[Any, ...]] = {
    "job_name": ("a_name", "run.7"),
    "partition": ("debug", "late", "debug,late"),
    "account": ("my_project",),
    "qos": ("normal",),
    "constraint": ("avx", "avx&sse", "avx|sse"),
    "nodelist": ("n[1-2]", "n1,n2"),
    "exclude": ("n2",),
    "reservation": (RESERVATION,),
    "time": (5, "10", "5:30", "1:00:00", "1-0", "2-03:04", "1-00:00:01"),
    "cpus_per_task": (1, 2),
    "mem": (500, "1500", "1G", "700M"),
    "mem_per_cpu": (300, "1G"),
    "gres": ("gpu:1", "gpu"),
    "gpus": (2, "2"),  # no fewer than there are nodes
    "exclusive": (True, "user"),
    "throttle": (1, 3),
    "output": ("logs/%x-%A_%a.out", "a folder/%x %A_%a.txt", "%A_%a.out"),
    "error": ("logs/%x-%A_%a.err", "it's #1/%A_%a.err"),
    "mail_user": ("me@example.org",),
    "mail_type": (("END", "FAIL"), ("ALL",), ("TIME_LIMIT_80", "ARRAY_TASKS")),
    "dependency": ("singleton",),
    "signal": ({"name": "USR2", "lead_seconds": 60}, {"name": "HUP", "lead_seconds": 200}, {"lead_seconds": 115}),
    "max_requeues": (0, 7),
    "comment": ("plain", "it's a \"comment\" # not", "$(touch canary) `touch canary` \\"),
    "extra": (
        ("--nice=100",), ("--nice",), ("--licenses=matlab:1", "--wckey=thesis"), ("--begin=now+1hour",),
        ("--mincpus=1", "--use-min-nodes"), ("--distribution=cyclic", "--threads-per-core=1"),
        ("--hold", "--export=NONE"), ("--deadline=now+30days", "--priority=17"), ("--no-kill", "--spread-job"),
        ("--contiguous",),
    ),
    "aggregate": ({"partition": "late", "time": "00:30:00"}, {"mem": "2G", "qos": "normal"}, {"time": 15}),
    "env": ({"A": "b c", "B_1": "$HOME"}, {"PYTHONPATH": "/a folder:/it's"}),
    "modules": (("python/3.11",), ("gcc", "python/3.11")),
    "venv": ("/a folder/it's", "/home/me/.venv"),
    "conda": ("space_dist", "/opt/my env"),
    "apptainer": ("/images/my image.sif",),
    "prologue": (("umask 027",), ("source /etc/profile", "ulimit -c 0")),
    "command": (("python", "-m", "space_dist.cli"), ("/opt/my tools/space-dist",)),
    "interface": ("ib0",),
    "temp": ("/var/tmp", "/local scratch"),  # noqa: S108 - the nodes' own
}  # fmt: skip
_OF_ARRAYS: dict[str, tuple[Any, ...]] = {"cells_per_task": (1, 2, 3), "max_array_size": (2, 3, 1001)}
_OF_CLUSTERS: dict[str, tuple[Any, ...]] = {"nodes": (1, 2)}


def drawn(chance: random.Random, mode: Mode) -> Profile:
    """About half of all fields are set."""
    fields = _VALUES | (_OF_ARRAYS if mode == "array" else _OF_CLUSTERS)
    settings = {name: chance.choice(values) for name, values in fields.items() if chance.random() < 0.5}
    for one, other in _ALONE.items():
        if one in settings and other in settings:
            del settings[chance.choice((one, other))]
    if mode == "array" or settings.get("nodes") == 1:
        settings |= {"nodelist": "n1"} if "nodelist" in settings else {}
    else:
        settings.pop("exclude", None)  # there are no more than two
    if "apptainer" in settings:
        settings["apptainer_options"] = chance.choice(((), ("--bind", "/scratch"), ("--nv",)))
    return Profile.model_validate(settings)


FIELDS = frozenset((*_VALUES, *_OF_ARRAYS, *_OF_CLUSTERS))


def exports(manifest: Manifest, count: int) -> list[Export]:
    """The same ones every time, of both modes in turn."""
    chance, made = random.Random(6), []
    for number in range(count):
        mode: Mode = "cluster" if number % 2 else "array"
        root = chance.choice((None, Path("/scratch/it's mine")))
        made.append(Export(manifest, drawn(chance, mode), mode, root))
    return made
