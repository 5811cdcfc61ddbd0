"""Population-based training in files: a copied member's runs begin as copies of its parent's.

A run under a schedule has, up to its last change, the bits of the run that has the schedule without that change: so
what its parent has computed and written is taken over, and nobody computes it again. Were the copies lost, the runs
would be computed from their start, with the same result.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Final

from space_dist.errors import LedgerError
from space_dist.experiment.manifest import Cell, Grid, Run
from space_dist.ledger import ROW_FILES, Ledger
from space_dist.system.files import in_words

_PREFIX: Final = ".heir-"


def take_over(grid: Grid, parent: Cell, heir: Cell, seeds: tuple[int, ...]) -> int:
    """Give each of an heir's runs what its parent's run of the same seed has written; one that is there stays.

    Returns the environment steps that the parent's have taken, all together; they are paused. Raises LedgerError if a
    folder cannot be read or written.
    """
    inherited = 0
    for seed in seeds:
        source, target = grid.ledger(Run(parent, seed)), grid.ledger(Run(heir, seed)).folder
        inherited += source.status().steps
        if target.exists():  # this step was made before, and its process killed
            continue
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            for left_behind in target.parent.glob(f"{_PREFIX}*"):
                shutil.rmtree(left_behind)
            new = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=target.parent))
            _copy(source, new)
            new.replace(target)
        except OSError as error:
            raise LedgerError(f"cannot copy {source.folder} to {target}: {in_words(error)}") from None
    return inherited


def _copy(source: Ledger, folder: Path) -> None:
    """What decides how a run goes on; not who worked on it, nor what was said of that."""
    folder.chmod(source.folder.stat().st_mode & 0o777)  # a temporary folder is its owner's alone
    one_by_one = [source.status_file, source.config, *source.given.values()]
    one_by_one += [source.instances("train"), source.instances("test"), *(source.folder / name for name in ROW_FILES)]
    for path in one_by_one:
        if path.exists():
            shutil.copy2(path, folder / path.name)
    for part in (source.checkpoints, source.replay):
        if part.exists():
            shutil.copytree(part, folder / part.name)
