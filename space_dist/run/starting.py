"""Starting from what another run has learned: `init_from`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from space_dist.errors import ConfigError, LedgerError
from space_dist.learner import Learner
from space_dist.ledger import Ledger, absent, decode_arrays, encode_arrays
from space_dist.system.files import read_file

_WEIGHTS: Final = re.compile(r"(?:\d+/)?(?:policy/.*|normaliser/(?!running$).*)")  # of what a learner saves
# A file that somebody names is read whole into memory: bounded.
_MAX_BYTES: Final = 4 << 30


def weights_in(path: Path) -> bytes:
    """The networks of a run's last checkpoint, and its scales where it normalises, as an npz; equal for equal ones.

    path: the run's folder, or a file that this function's result was written to. Raises ConfigError for anything else.
    """
    try:
        if path.is_dir():
            ledger = Ledger(path)
            ledger.status()
            checkpoint = ledger.last_checkpoint()
            if checkpoint is None:
                raise ConfigError(f"init_from: {path} has no policy yet: no checkpoint was written")
            learned = checkpoint.under("learner/")
        else:
            learned = decode_arrays(read_file(path, _MAX_BYTES))
    except LedgerError as error:
        raise ConfigError(f"init_from: {error}") from None
    except FileNotFoundError:
        raise ConfigError(f"init_from: {absent(path, '; it is the folder of a run')}") from None
    except OSError as error:
        raise ConfigError(f"init_from: {path} cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ConfigError(f"init_from: {path} holds no weights of a run: {error}") from None
    return encode_arrays({name: learned[name] for name in sorted(learned) if _WEIGHTS.fullmatch(name)})


def start_from(learner: Learner, weights: bytes) -> None:
    """Give a fresh learner the networks, and scales, that `weights_in` gave; its optimisers stay fresh.

    Raises ConfigError where they are others' than this learner's.
    """
    given = decode_arrays(weights)
    arrays, data = learner.save()
    own = {name: array for name, array in arrays.items() if _WEIGHTS.fullmatch(name)}
    for name in [*own, *given]:
        if name not in given:
            raise ConfigError(f"init_from: that run has no {name!r}, which this one's learner has: {_ALIKE}")
        if name not in own:
            raise ConfigError(f"init_from: this run's learner has no {name!r}, which that run has: {_ALIKE}")
        if own[name].shape != given[name].shape:
            raise ConfigError(
                f"init_from: {name!r} has the shape {given[name].shape} in that run, and {own[name].shape} here: "
                f"{_ALIKE}"
            )
    # Whatever was not given stays fresh: optimisers, counters, running returns.
    learner.load({**arrays, **given}, data)


_ALIKE: Final = (
    "both need the same spaces and env.context_visible, and learners whose policies are alike (policy, net_arch, "
    "normalisation)"
)
