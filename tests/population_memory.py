"""What populations take: `python -m tests.population_memory CONFIG MEMBERS...` prints peaks of memory (RSS) in bytes.

First of a population with the first number of members, then of this process that has had one with the next, too.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from space_dist.config import load
from space_dist.errors import SpaceDistError
from space_dist.run.launch import Outcome
from space_dist.run.population import advance, member
from space_dist.system.interrupts import StopRequests


def raised(_: Path, outcome: Outcome | SpaceDistError) -> None:
    if isinstance(outcome, SpaceDistError):
        raise outcome


def main() -> None:
    config = load(Path(sys.argv[1]))
    for members in map(int, sys.argv[2:]):
        with tempfile.TemporaryDirectory() as folder:
            folders = [Path(folder) / str(seed) for seed in range(members)]
            advance(
                {
                    one: member(config.model_copy(update={"seed": seed}), one, stop=StopRequests())
                    for seed, one in enumerate(folders)
                },
                raised,
            )
        # Not getrusage: what it says begins with the size of the process that forked this one.
        peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:"))
        print(int(peak.split()[1]) * 1024)


if __name__ == "__main__":
    main()
