"""Make every decision of a run again, from its ledger alone: `python jobs/audit.py RUN`.

Written from docs/algorithm.md, with NumPy, the standard library and a reader of YAML, and nothing of space_dist:
whoever trusts neither its code nor its tests can read this file in five minutes. Start values come from values.jsonl,
what was trained on from curriculum.jsonl, gradient steps and what the run said of itself from metrics.jsonl, settings
from config.yaml, and how much of these files counts from status.json.

Exit code 0: all decisions are as they should be. 1: the first that is not is printed. 2: this cannot be audited.
"""

from __future__ import annotations

import base64
import csv
import json
import sys
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML

Values = NDArray[np.float64]
Keys = NDArray[np.uint64]

TIES, RANDOM_GROWTH = 7, 8  # purposes of random numbers; see docs/algorithm.md, decision 7
FLOOR = 1e-8  # decision 5
LARGEST = float(np.finfo(np.float64).max)
GROWING = ("space", "random_growth", "cspace", "manual")
PASSED_OVER = ("round_robin", "fixed")


class NotAuditableError(Exception):
    """The folder holds no decisions that can be made again."""


class DisagreementError(Exception):
    """A decision is not what the paper's rule makes of the values."""


class Run(NamedTuple):
    """A ledger. values: per iteration, from 0 on, what V_t is, and what V_{t-1} was, if scored again."""

    curriculum: dict[str, Any]
    seed: int
    ids: NDArray[np.int64]
    contexts: Values
    columns: dict[str, Values]
    bounds: tuple[Values, Values]
    values: list[tuple[Values, Values | None]]
    trained: list[list[int]]
    numbers: list[dict[str, Any]]


# ---- reading ---------------------------------------------------------------------------------------------------------


def committed(folder: Path) -> dict[str, int] | None:
    """How many bytes of each file a checkpoint covers, as status.json says; None where there is no such file.

    What is behind them is of a run that is being written, or was killed: its files do not yet say the same.
    """
    try:
        sizes = json.loads((folder / "status.json").read_bytes())["committed"]
        found = {str(name): int(size) for name, size in sizes.items()}
    except FileNotFoundError:
        return None
    except (ValueError, TypeError, KeyError, AttributeError):
        raise NotAuditableError(f"{folder / 'status.json'} is damaged") from None
    if not found.get("metrics.jsonl"):
        raise NotAuditableError(f"{folder} has committed nothing yet: no checkpoint was written")
    return found


def rows(path: Path, sizes: dict[str, int] | None) -> list[dict[str, Any]]:
    """The rows of a file, each of which ends with a CRC-32 of what stands before it; an unfinished last one is none.

    sizes: see `committed`; None for all there is.
    """
    found = []
    content = path.read_bytes()[: None if sizes is None else sizes.get(path.name, 0)]
    for number, line in enumerate(content.splitlines(keepends=True), start=1):
        if not line.endswith(b"\n"):
            break
        body, _, crc = line.rpartition(b',"crc":"')
        if crc != f'{zlib.crc32(body + b"}"):08x}"}}\n'.encode():
            raise DisagreementError(f"{path.name}, row {number}: its checksum does not match: somebody changed it")
        found.append(json.loads(body + b"}"))
    return found


def floats(encoded: dict[str, str]) -> Values:
    """Little-endian floats of 4 or 8 bytes, in base64."""
    ((kind, text),) = encoded.items()
    return np.frombuffer(base64.b64decode(text), dtype=f"<{kind}").astype(np.float64)


def read(folder: Path) -> Run:
    """A run's ledger."""
    for name in ("config.yaml", "instances_train.csv", "values.jsonl", "curriculum.jsonl", "metrics.jsonl"):
        if not (folder / name).is_file():
            raise NotAuditableError(f"{folder} has no {name}; the folder of one run is wanted, runs/NAME/s0 for one")
    sizes = committed(folder)  # before the files: a run that goes on only adds to them
    config = YAML(typ="safe").load((folder / "config.yaml").read_text())
    settings = config["curriculum"]
    if any(key.partition(".")[0] == "curriculum" for change in config.get("schedule", ()) for key in change["set"]):
        raise NotAuditableError(f"{folder / 'config.yaml'}: schedule changes the curriculum's settings on the way")
    if config.get("fork") is not None:
        raise NotAuditableError(f"{folder / 'config.yaml'}: fork changes the seed on the way")
    with (folder / "instances_train.csv").open(newline="") as file:
        table = sorted(csv.DictReader(file), key=lambda row: int(row["id"]))
    scored = rows(folder / "values.jsonl", sizes)
    if [row["iteration"] for row in scored] != list(range(len(scored))) or not scored:
        raise NotAuditableError(
            f"{folder / 'values.jsonl'} does not hold the values of every decision from the first on"
        )
    bounds = np.array(scored[0]["low"]), np.array(scored[0]["high"])
    extra = [settings["column"]] if settings["kind"] == "manual" else []
    names = [name for name in table[0] if name != "id" and name not in extra]
    complete = [row for row in rows(folder / "metrics.jsonl", sizes) if row["kind"] == "iteration" and row["complete"]]
    return Run(
        curriculum=settings, seed=config["seed"], ids=np.array([int(row["id"]) for row in table]),
        contexts=np.array([[float(row[name]) for name in names] for row in table]),
        columns={name: np.array([float(row[name]) for row in table]) for name in extra}, bounds=bounds,
        values=[(floats(row["after"]), floats(row["before"]) if "before" in row else None) for row in scored],
        trained=[row["trained"] for row in rows(folder / "curriculum.jsonl", sizes)], numbers=complete,
    )  # fmt: skip


# ---- keys: what breaks ties (decision 7) -----------------------------------------------------------------------------


def mixed(keys: Keys) -> Keys:
    """The splitmix64 finaliser."""
    with np.errstate(over="ignore"):
        keys = (keys ^ (keys >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        keys = (keys ^ (keys >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return keys ^ (keys >> np.uint64(31))


def shifted(keys: Keys, number: int) -> Keys:
    """New keys from keys and a number: mixed(key + (number + 1) * golden ratio)."""
    with np.errstate(over="ignore"):
        return mixed(keys + np.uint64((number + 1) * 0x9E3779B97F4A7C15 & 0xFFFFFFFFFFFFFFFF))


def keys_of(run: Run, purpose: int) -> Keys:
    """`(n,)` from the run's seed, the purpose, the instance's id and its context, feature by feature."""
    start = np.random.SeedSequence([run.seed, purpose]).generate_state(1, np.uint64)[0]
    with np.errstate(over="ignore"):
        keys = mixed(run.ids.astype(np.uint64) + start)
    for feature in run.contexts.T:
        keys = mixed(shifted(keys, 0) ^ (np.ascontiguousarray(feature) + 0.0).view(np.uint64))
    return keys


def best(scores: Values, size: int, ties: Keys) -> NDArray[np.int64]:
    """The `size` highest scores, best first; equal scores by their keys, lowest first."""
    return np.lexsort((ties, -scores))[:size]


# ---- the decisions ---------------------------------------------------------------------------------------------------


def scores(run: Run, version: int, before: Values, after: Values, trained: NDArray[np.int64]) -> Values:
    """Line 12: what the instances are ranked by, highest first, in the decision behind selection `version`."""
    settings = run.curriculum
    found: Values
    kind, pic = settings["kind"], settings.get("pic")
    if kind == "random_growth" or pic == "random":
        return shifted(keys_of(run, RANDOM_GROWTH), version).astype(np.float64)
    if kind == "manual":
        column = run.columns[settings["column"]]
        found = column if settings["reverse"] else -column
        return found
    if kind == "cspace":
        low, high = run.bounds
        scaled = 2.0 * (run.contexts - low) / (high - low) - 1.0
        members = np.zeros(len(run.ids), dtype=np.bool_)
        members[trained] = True
        if settings["distance"] == "centroid":
            found = -np.linalg.norm(scaled - scaled[members].mean(axis=0), axis=1)
        else:
            found = np.ones(len(run.ids))  # members come first
            found[~members] = -np.linalg.norm(scaled[~members, None] - scaled[members], axis=2).min(axis=1)
    else:
        change = after - before  # line 11
        if pic == "improvement":
            found = change
        elif pic == "abs":
            found = np.abs(change)
        elif pic == "relative":
            with np.errstate(over="ignore"):
                found = change / np.maximum(np.abs(before), FLOOR)
        else:
            found = -after  # lowest_value
    return -found if settings["reverse"] else found


class Memory(NamedTuple):
    """What a growing curriculum remembers of the last decision."""

    stalled: int = 0
    mean: float | None = None
    eta: float | None = None


def grows(settings: dict[str, Any], before: Values, after: Values, steps: int, memory: Memory) -> tuple[bool, float]:
    """Lines 6 to 8: whether the set grows, and the eta that was asked. before, after: of the set just trained on."""
    eta = settings["eta"] if memory.eta is None else memory.eta
    if not steps:
        return False, eta
    if settings["growth"] == "schedule":
        return True, eta
    old, new = float(np.abs(before).mean()), float(np.abs(after).mean())
    stored = 0.0 if memory.mean is None else memory.mean
    change, reference = {
        "same_set": (abs(new - old), old),
        "as_printed": (abs(new - stored), stored),
        "mean_abs_change": (float(np.abs(after - before).mean()), old),
    }[settings["mean"]]
    if change <= eta * max(reference, FLOOR):
        return True, eta
    if settings["adaptive_eta"] != "off" and memory.stalled >= settings["patience"]:  # Theorem 2
        epsilon = settings["epsilon"]
        return True, max(eta, min(LARGEST, (change + epsilon) / max(reference, epsilon)))
    return False, eta


def audit(run: Run) -> int:
    """How many decisions were made again. Raises DisagreementError at the first that was made otherwise."""
    settings, n, ties = run.curriculum, len(run.ids), keys_of(run, TIES)
    kind = settings["kind"]
    if kind not in (*GROWING, *PASSED_OVER):
        what = "chooses by rules of its own" if kind == "custom" else "draws its instances"
        raise NotAuditableError(f"curriculum.kind: {kind} {what}; decisions on sets are made again only")
    if kind in PASSED_OVER:
        chosen = np.argsort(ties)
        if settings.get("ids") is not None:
            chosen = chosen[np.isin(run.ids[chosen], settings["ids"])]
        chosen = chosen[: settings.get("count")]
    elif kind == "manual":
        chosen = best(run.columns[settings["column"]] * (1 if settings["reverse"] else -1), 1, ties)
    else:
        chosen = np.argsort(ties)[:1]
    memory = Memory()
    expect(run, 1, "is the first", chosen)
    for version, numbers in enumerate(run.numbers):
        if version + 1 >= len(run.values):
            raise DisagreementError(f"iteration {version + 1} is complete, and its start values are not there")
        after, scored_again = run.values[version + 1]
        before = run.values[version][0] if scored_again is None else scored_again
        if len(after) != n or len(before) != n:
            raise DisagreementError(f"iteration {version + 1}: {len(after)} start values of {n} instances")
        inside, said = np.sort(chosen), numbers["curriculum"]
        mean = float(np.abs(after[inside]).mean())
        told(version + 1, "mean_value_after", said, mean)
        if kind in GROWING:
            steps = numbers["gradient_steps"]
            settled, eta = grows(settings, before[inside], after[inside], steps, memory)
            size = len(chosen)
            if settled:
                size = min(
                    n, size * settings["kappa"] if settings["growth"] == "multiply" else size + settings["kappa"]
                )
            grew = size > len(chosen)
            stalled = 0 if grew or size == n else memory.stalled + (steps > 0)
            memory = Memory(stalled, mean, eta if settings["adaptive_eta"] == "persistent" else None)
            chosen = best(scores(run, version, before, after, inside), size, ties)
            told(version + 1, "grew", said, grew)
            told(version + 1, "size", said, size)
        expect(run, version + 2, "follows", chosen)
    return len(run.numbers)


def told(iteration: int, name: str, said: dict[str, Any], found: float) -> None:
    """Raise DisagreementError if the run said otherwise."""
    if said[name] != found:
        raise DisagreementError(f"iteration {iteration}: the run says {name} = {said[name]}, its values say {found}")


def expect(run: Run, iteration: int, which: str, chosen: NDArray[np.int64]) -> None:
    """Raise DisagreementError if an iteration, where there is one, trained on other instances, or in another order."""
    if iteration > len(run.trained):
        return
    wanted, found = run.ids[chosen].tolist(), run.trained[iteration - 1]
    if wanted != found:
        at = next((place for place, (a, b) in enumerate(zip(wanted, found, strict=False)) if a != b), None)
        where = f"{len(found)} instances instead of {len(wanted)}" if at is None else (
            f"instance {found[at]} in place {at + 1} instead of {wanted[at]}"
        )  # fmt: skip
        raise DisagreementError(f"iteration {iteration} trained on another set than the one that {which}: {where}")


def main(arguments: list[str]) -> int:
    """The exit code."""
    if arguments in (["--help"], ["-h"]):
        print(__doc__)
        return 0
    if len(arguments) != 1 or arguments[0].startswith("-"):
        print("usage: python jobs/audit.py RUN, RUN being the folder of one run, runs/NAME/s0 for one", file=sys.stderr)
        return 2
    try:
        run = read(Path(arguments[0]))
        count = audit(run)
    except NotAuditableError as error:
        print(f"audit: {error}", file=sys.stderr)
        return 2
    except DisagreementError as error:
        print(f"audit: {arguments[0]}: {error}")
        return 1
    print(
        f"{arguments[0]}: all {count} decisions of {run.curriculum['kind']}, seed {run.seed}, are as the rule has them"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
