"""What a population takes: `python -m tests.population_memory CONFIG MEMBERS` prints its peak memory (RSS) in bytes."""

from __future__ import annotations

import resource
import sys
import tempfile
from pathlib import Path

from space_dist.config import load
from space_dist.errors import SpaceDistError
from space_dist.interrupts import StopRequests
from space_dist.launch import Outcome
from space_dist.population import advance, member


def raised(_: Path, outcome: Outcome | SpaceDistError) -> None:
    if isinstance(outcome, SpaceDistError):
        raise outcome


def main() -> None:
    config, members = load(Path(sys.argv[1])), int(sys.argv[2])
    with tempfile.TemporaryDirectory() as folder:
        folders = [Path(folder) / str(seed) for seed in range(members)]
        advance(
            {
                one: member(config.model_copy(update={"seed": seed}), one, stop=StopRequests())
                for seed, one in enumerate(folders)
            },
            raised,
        )
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)


if __name__ == "__main__":
    main()
