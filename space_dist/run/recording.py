"""The curriculum of a run as others can follow it: `curriculum: {kind: replay, of: RUN}`."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from space_dist import config as configs
from space_dist.curricula import GENERATED
from space_dist.curricula.replay import Recording
from space_dist.errors import ConfigError, LedgerError
from space_dist.ledger import CURRICULUM, Ledger, absent
from space_dist.system.files import read_file

# A file that somebody names is read whole into memory: bounded.
_MAX_BYTES: Final = 4 << 30
_KEY: Final = "curriculum.of"


def recording_in(path: Path) -> bytes:
    """What a finished run was trained on, as an npz; equal for equal ones.

    path: the run's folder, or a file that this function's result was written to. Raises ConfigError for anything else.
    """
    try:
        if path.is_dir():
            return _recorded(Ledger(path)).encode()
        return Recording.decode(read_file(path, _MAX_BYTES)).encode()
    except LedgerError as error:
        raise ConfigError(f"{_KEY}: {error}") from None
    except FileNotFoundError:
        raise ConfigError(f"{_KEY}: {absent(path, '; it is the folder of a run')}") from None
    except OSError as error:
        raise ConfigError(f"{_KEY}: {path} cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ConfigError(f"{_KEY}: {path} holds no recorded curriculum: {error}") from None


def _recorded(ledger: Ledger) -> Recording:
    from space_dist.run.building import Blueprint  # which needs recordings itself

    status = ledger.status()
    if status.state != "done":
        raise ConfigError(
            f"{_KEY}: the run in {ledger.folder} is not done ({status.state}, {status.steps:,} of "
            f"{status.budget_steps:,} steps): its curriculum is not whole"
        )
    ledger.read(ledger.config)
    blueprint = Blueprint.of(configs.load(ledger.config))
    train, test = blueprint.instances()
    rows = ledger.rows(CURRICULUM, committed_only=True)
    ids = np.array([instance for row in rows for instance in row["trained"]], dtype=np.int64)
    contexts = [
        context for row in rows
        for instance, context in zip(row["trained"], row.get("contexts", ()), strict=False) if instance == GENERATED
    ]  # fmt: skip
    if not len(ids):
        raise ConfigError(f"{_KEY}: no episode ended in the run in {ledger.folder}")
    return Recording(
        drawn=blueprint.curriculum(train, test).start()[1].drawn,
        budget_steps=status.budget_steps,
        round_steps=blueprint.config.round_steps(blueprint.spec.horizon),
        lengths=np.array([len(row["trained"]) for row in rows], dtype=np.int64),
        ids=ids,
        generated=np.array(contexts, dtype=np.float64).reshape(-1, len(train.names)),
        set_ids=train.ids,
        set_contexts=train.contexts,
    )
