"""The quickstart: round robin, SPaCE and edge side by side, five seeds each, in about two minutes.

On sparse PointMass, of whose training gates three quarters are closed. It is `space-dist grid run
configs/grids/quickstart.yaml`, and a report. Started again after an interruption, it goes on where it stopped.
"""

from __future__ import annotations

import sys
from pathlib import Path

from space_dist.cli.grids import run_frozen
from space_dist.cli.overview import tell
from space_dist.cli.runs import print_grid_report
from space_dist.cli.terminal import STOP, console, say, warn
from space_dist.errors import Interrupted, SpaceDistError
from space_dist.system.processes import collect_seldom

ROOT = Path(__file__).resolve().parent.parent
PAGE = "http://127.0.0.1:5000/#/experiments?workflowType=machine_learning"


def main() -> int:
    """Train, report, and say where to look."""
    STOP.install()
    collect_seldom()
    from space_dist.api.grids import frozen  # takes seconds

    place, manifest = frozen(ROOT / "configs/grids/quickstart.yaml", Path.cwd() / "runs")
    steps = manifest.cells[0].budget_steps
    say(
        "Through gates of which three quarters are closed, and a reward at the goal alone: round robin, SPaCE and edge,"
    )
    say(f"{len(manifest.seeds)} seeds each, {steps:,} environment steps a run; tested on other gates, open ones")
    found = run_frozen(place, manifest, mode="pool")
    code = tell(manifest, place, found)
    if code:
        say("`make quickstart` tries again and goes on where the others stopped.")
        return code
    from space_dist.report import build_grid_report

    print_grid_report(build_grid_report(place), console)
    say("A return of 1 is a goal reached, so the threshold is 80 % of the gates. With 20 seeds: docs/wins.md")
    say(f"MLflow:  make ui, then {PAGE} (experiment '{manifest.experiment}', {len(found)} runs)")
    say("Next:    source .venv/bin/activate; space-dist train configs/pointmass_space.yaml   (docs/training.md)")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except Interrupted as error:
        say(f"{error}. `make quickstart` goes on.")
        sys.exit(error.exit_code)
    except SpaceDistError as error:
        warn(f"quickstart: {error}")
        sys.exit(error.exit_code)
