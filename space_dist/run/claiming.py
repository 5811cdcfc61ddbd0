"""Making a run's folder one's own: what lies there is recognised as this run, or refused before anything is written."""

from __future__ import annotations

import contextlib
import functools
import itertools
import logging
import math
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

from space_dist import arithmetic
from space_dist import config as configs
from space_dist.config import RunConfig
from space_dist.envs import BULLET_IDS
from space_dist.errors import ConfigError, LedgerError, SpaceDistError
from space_dist.learner import torch_checks
from space_dist.ledger import FORMAT, GIVEN, GOES_BACK, Ledger, RunWriter, Status, decode_checkpoint
from space_dist.rollout import Setup
from space_dist.run.building import Blueprint
from space_dist.run.continuing import is_longer, longer_in_words, takes_over, within
from space_dist.system.interrupts import StopRequests
from space_dist.system.provenance import fingerprint

log = logging.getLogger("space_dist")

_MOST_CHANGES: Final = 5  # that a sentence tells
_ANEW: Final = "beginning anew: no checkpoint had been written"


def claim(
    blueprint: Blueprint, setup: Setup, writer: RunWriter, stop: StopRequests, pause_at: int
) -> tuple[Status, str]:  # fmt: skip
    """Make the folder this run's, or recognise it as such; returns where the run stands now, and where it goes on."""
    config, ledger = blueprint.config, writer.ledger
    given = blueprint.given
    now, here = time.time(), fingerprint(arithmetic_digest(), _also_decide(config), config.import_paths)
    status = Status(
        state="running", name=config.name, seed=config.seed, steps=0, budget_steps=config.budget.steps, round=0,
        started_at=now, updated_at=now, fingerprint=here,
        identity=configs.identity(config, setup.train.digest(), setup.test.digest(), given=given),
    )  # fmt: skip
    before, earlier, goes_on, damage = None, None, "", list[str]()
    if is_stillborn(ledger) and ledger.status().identity != status.identity:
        goes_on = _ANEW
    else:
        before = writer.status = _status_before(ledger)
        earlier = _refuse_other_run(config, setup, given, ledger, status.identity, before)
    if before is not None:
        if before.has_reached(pause_at) and earlier is None:
            damage = ledger.damage() or _damage_behind(ledger)
            if not damage:
                return before, ""
        else:
            damage = _damaged_checkpoint(ledger)
    # A run that cannot go on stays as it is: above all one that is done, and was asked for a larger budget.
    kept = within(earlier, blueprint.spec.horizon) if earlier is not None else lambda checkpoint: True
    _refuse_unusable_checkpoints(ledger, before, longer=earlier is not None)
    writer.refuse_unrestorable(kept, status.identity)
    if before is not None:
        # Here, where no log is open yet, they are said on standard error.
        for sentence in damage:
            log.warning("%s; computing it again from the last checkpoint that is intact", sentence)
        changed = before.checkpoint is not None and dict(before.fingerprint) != here
        if not damage:
            goes_on = _where_it_goes_on(ledger, before)
        status = replace(
            status, steps=before.steps, round=before.round, started_at=before.started_at,
            # Once marked, always marked: rows from then on are in the results.
            fingerprint_changed=before.fingerprint_changed or changed,
            identity=before.identity if before.identity and earlier is None else status.identity,
        )  # fmt: skip
    stored = configs.dump(_self_contained(config))
    if earlier is not None:
        now_at = writer.hand_over(status, stored, kept)
        status = replace(status, steps=now_at.steps, round=now_at.round)
        goes_on = longer_in_words(earlier, config, now_at, same_bits=not status.fingerprint_changed)
    # Before the status, which names the digests of these files.
    writer.write_config(stored, setup.train.to_csv(), setup.test.to_csv(), given)
    if stop.sweep(ledger.stop_file):
        log.warning("%s is from before this began: it asked somebody else, and was removed", ledger.stop_file)
    writer.set_status(status)
    return status, goes_on


def _refuse_unusable_checkpoints(ledger: Ledger, before: Status | None, *, longer: bool) -> None:
    """Raise ConfigError if a run's checkpoints were removed and it is to be longer, or are of another format."""
    if before is None or before.checkpoint is None:
        return
    if longer and not ledger.checkpoint_files():
        raise ConfigError(
            f"{ledger.folder}: its checkpoints were removed, and a larger budget goes on from one of them: use "
            "--out DIR (from Python: out=DIR) for another run. With `init_from` it starts from this one's policy"
        )
    if before.format != FORMAT:
        raise ConfigError(
            f"{ledger.folder} was begun by an earlier version of space_dist (format {before.format} of its files; "
            f"this version writes {FORMAT}), whose checkpoints, up to commit 2f6e945, lack the episodes in "
            "progress: it can be evaluated and reported on, and not gone on with. Use another folder, or the "
            "version that began it"
        )


def _where_it_goes_on(ledger: Ledger, before: Status) -> str:
    """`going on at 18,432 steps`, of a run nothing of which is damaged; empty where that shows once it is restored."""
    newest = next(iter(ledger.checkpoint_files()), None)
    if newest is None:
        return "" if before.checkpoint else _ANEW
    # A run may have been killed between a checkpoint and the status that names it.
    return f"going on at {before.steps:,} steps" if newest.name == before.checkpoint else ""


def _damage_behind(ledger: Ledger) -> list[str]:
    """What is damaged of a run whose results are whole: its last checkpoint, where another can take its place.

    Who removed all checkpoints of a run that is done wanted the room.
    """
    if not ledger.checkpoint_files():
        return []
    try:
        ledger.last_checkpoint()
    except LedgerError as error:
        if ledger.has_intact_checkpoint():
            return [_without_advice(error)]
        log.warning("%s; the results of %s are whole: its checkpoints may be removed", error, ledger.folder)
    return []


def _damaged_checkpoint(ledger: Ledger) -> list[str]:
    """What has a run that is not done go back; nothing where it cannot, which `restore` says."""
    try:
        ledger.status()
    except LedgerError:
        return []  # `_status_before` told of it
    try:
        ledger.last_checkpoint()
    except LedgerError as error:
        return [_without_advice(error)] if ledger.has_intact_checkpoint() else []
    return []


def _without_advice(error: LedgerError) -> str:
    """What is damaged of a run that is being resumed, without the advice to resume it."""
    return str(error).removesuffix(f"; {GOES_BACK}")


def _also_decide(config: RunConfig) -> list[str]:
    """The distributions whose arithmetic this run uses, besides those that every run does."""
    compiled = config.learner.is_compiled(config.engine)
    also = {
        "scikit-learn": "scikit-learn" in config.libraries,
        "pybullet": config.env.id in BULLET_IDS,
        "numba": compiled,
        "llvmlite": compiled,
    }
    return [name for name, used in also.items() if used]


@functools.cache
def arithmetic_digest() -> str:
    """`arithmetic.digest` of all that a run computes with: it is what bits depend on, instead of the CPU's name."""
    checks = (arithmetic.numpy_checks(), arithmetic.scipy_checks(), torch_checks())
    return arithmetic.digest(itertools.chain(*checks))


def is_stillborn(ledger: Ledger) -> bool:
    """Whether a run ended there before anything came of it, and nothing is lost if one of another config takes over.

    It has no checkpoint, and failed within its first iteration, as by a fault of its learner, or was stopped or killed
    before its first round. One that began anew, without its checkpoints, still has rows, or the model of its first end.
    """
    with contextlib.suppress(LedgerError):
        status = ledger.status()
        models = (ledger.model_arrays, ledger.model_description)
        if status.checkpoint is not None or ledger.checkpoint_files() or any(path.exists() for path in models):
            return False
        first = 0 if status.state != "failed" else math.inf  # the round up to which its evaluations are no results
        return not any(row["kind"] == "iteration" or row.get("round", 0) > first for row in ledger.rows())
    return False


def _status_before(ledger: Ledger) -> Status | None:
    """Where the run stood: as its status says, or, where that is damaged or gone, its newest intact checkpoint."""
    try:
        return ledger.status() if ledger.status_file.exists() else _status_in(ledger)
    except LedgerError as error:
        status = _status_in(ledger)
        if status is None:
            raise
        log.warning("%s; going on from the checkpoint of round %d", error, status.round)
        return status


def _status_in(ledger: Ledger) -> Status | None:
    """A status from the newest intact checkpoint, which knows what decides whether and how the run may go on."""
    for file in ledger.checkpoint_files():
        # A damaged one: the one before it may be intact.
        with contextlib.suppress(ValueError, OSError):
            checkpoint = decode_checkpoint(file.read_bytes())
            about, now = checkpoint.data.get("about", {}), time.time()
            return Status(
                state="running", name="", seed=0, steps=about.get("steps", 0), budget_steps=0, round=checkpoint.round,
                started_at=now, updated_at=now, checkpoint=file.name, identity=about.get("identity"),
                fingerprint=about.get("fingerprint", {}), fingerprint_changed=about.get("fingerprint_changed", False),
                format=checkpoint.format,
            )  # fmt: skip
    return None


def _refuse_other_run(
    config: RunConfig,
    setup: Setup,
    given: Mapping[str, bytes],
    ledger: Ledger,
    identity: str | None,
    before: Status | None,
) -> RunConfig | None:
    """Raise ConfigError if the folder holds a run of another configuration, with what differs where that is known.

    Returns its config where it is this run with a smaller budget, or before the last change of its schedule.
    """
    if before is not None and before.identity == identity:
        return None  # the copies of config and instances in the folder are written anew
    if before is None and not ledger.config.exists():
        return None
    try:  # the stored config decides as this version reads it, if it is known to be what the run wrote
        stored = configs.load(ledger.config) if before is None else stored_config(ledger)
        train, test = Blueprint.of(stored).instances()
        taken = {key: ledger.read(ledger.given[key]) for key in stored.given_paths}
    except LedgerError as error:
        raise ConfigError(
            f"{ledger.folder} holds a run of another configuration; which cannot be told: {error}"
        ) from error
    digests = train.digest(), test.digest()
    if identity == configs.identity(stored, *digests, given=taken):
        if before is not None and len(before.files.get(ledger.config.name, [])) > 1:
            raise ConfigError(
                f"{ledger.folder} had been asked to go on under a larger budget, of {before.budget_steps:,} steps, "
                "when it was killed: ask for that budget again"
            )
        return None  # an earlier version's identity
    heir = stored.model_copy(update={"schedule": config.schedule})
    if identity == configs.identity(heir, *digests, given=taken) and takes_over(stored, config, before):
        return stored
    longer = stored.model_copy(update={"budget": config.budget})
    if identity == configs.identity(longer, *digests, given=taken) and is_longer(stored, config):
        return stored
    # A larger budget alone would be allowed.
    like = longer if _may_grow(stored, config) else stored
    changes = _differences(like, config) or _differences(stored, config)
    if taken.get("init_from") != given.get("init_from"):
        changes.append("init_from: other networks")
    if taken.get("curriculum.of") != given.get("curriculum.of"):
        changes.append("curriculum.of: another recorded curriculum")
    if (train.digest(), test.digest()) != (setup.train.digest(), setup.test.digest()):
        changes.append("instances: other contexts or ids")
    raise ConfigError(
        f"{ledger.folder} holds a run of another configuration ({'; '.join(changes)}). A run's settings cannot change "
        "on the way: give all that it was begun with again, or use --out DIR for a new run (from Python: overrides, "
        "out=DIR)"
    )


def _may_grow(stored: RunConfig, config: RunConfig) -> bool:
    """Whether the budgets of two configs, whatever else differs, are no reason to refuse one after the other."""
    try:
        return is_longer(stored, config)
    except ConfigError:
        return False


def _differences(stored: RunConfig, config: RunConfig) -> list[str]:
    """In words: of a section of another kind, whose keys all are others, the kind alone."""
    found = configs.differences(stored, config)
    kinds = [text for text in found if text.startswith(("learner.kind: ", "curriculum.kind: "))]
    others = tuple(f"{text.partition('.')[0]}." for text in kinds)
    return [*kinds, *(text for text in found if not text.startswith(others))]


def already_there(config: RunConfig, ledger: Ledger) -> str:
    """That a run is there, and what to do, by whether it seems to be this one."""
    with contextlib.suppress(SpaceDistError):
        may_grow = ("budget.", "schedule")
        changes = _differences(stored_config(ledger), config)
        if not all(text.startswith(may_grow) for text in changes):
            more = f", and {len(changes) - _MOST_CHANGES} more" if len(changes) > _MOST_CHANGES else ""
            return (
                f"{ledger.folder} already holds a run of another configuration: --out DIR starts another (from Python: "
                f"out=DIR). There to here: {', '.join(changes[:_MOST_CHANGES])}{more}"
            )
    return (
        f"{ledger.folder} already holds a run: --resume continues it, --out DIR starts another (from Python: "
        "resume=True, out=DIR)"
    )


def stored_config(ledger: Ledger) -> RunConfig:
    """The config in a run's folder. Raises LedgerError if it is not what the run wrote."""
    ledger.read(ledger.config)
    return configs.load(ledger.config)


def _self_contained(config: RunConfig) -> RunConfig:
    """The config as stored in the run's folder: with its own instance files, and no path relative to anywhere else."""
    instances = {"train": Path("instances_train.csv"), "test": Path("instances_test.csv")}
    return config.with_given({key: Path(GIVEN[key]) for key in config.given_paths}).model_copy(
        update={"instances": config.instances.model_copy(update=instances)}
    )
