"""The quickstart: SPaCE and round robin on PointMass, three seeds each, side by side, in about two minutes.

It is `space-dist grid run configs/grids/quickstart.yaml`, and a report. Started again after an interruption, it goes on
where it stopped.
"""

from __future__ import annotations

import sys
from pathlib import Path

from space_dist.cli.grids import run_frozen
from space_dist.cli.overview import tell
from space_dist.cli.runs import print_grid_report
from space_dist.cli.terminal import STOP, console, say, warn
from space_dist.errors import Interrupted, SpaceDistError
from space_dist.experiment.status import RunStatus
from space_dist.system.processes import collect_seldom

ROOT = Path(__file__).resolve().parent.parent
INSTANCES = 100
PAGE = "http://127.0.0.1:5000/#/experiments?workflowType=machine_learning"


def main() -> int:
    """Train, report, and say what came out and where to look."""
    STOP.install()
    collect_seldom()
    from space_dist.api.grids import frozen  # takes seconds

    place, manifest = frozen(ROOT / "configs/grids/quickstart.yaml", Path.cwd() / "runs")
    steps = manifest.cells[0].budget_steps
    say(f"SPaCE and round robin on PointMass: {len(manifest.seeds)} seeds each, {steps:,} environment steps a run")
    found = run_frozen(place, manifest, mode="pool")
    code = tell(manifest, place, found)
    if code:
        say("`make quickstart` tries again and goes on where the others stopped.")
        return code
    from space_dist.report import build_grid_report

    report = build_grid_report(place)
    print_grid_report(report, console)
    of_space = [run_status for run_status in found if run_status.run.cell.settings["curriculum"]["kind"] == "space"]
    reached = [run_status for run_status in of_space if _reached_all(run_status)]
    say(
        f"SPaCE's set reached all {INSTANCES} instances in {len(reached)} of {len(of_space)} runs"
        + ("" if len(reached) == len(of_space) else ": the start's value settles too slowly for this short budget")
    )
    say(f"MLflow:  make ui, then {PAGE} (experiment '{manifest.experiment}', {len(found)} runs)")
    say("Next:    source .venv/bin/activate; space-dist train configs/pointmass_space.yaml   (docs/training.md)")
    return 0


def _reached_all(run_status: RunStatus) -> bool:
    rows = run_status.ledger.rows()
    return any(row["kind"] == "iteration" and row["curriculum"].get("size") == INSTANCES for row in rows)


if __name__ == "__main__":
    try:
        sys.exit(main())
    except Interrupted as error:
        say(f"{error}. `make quickstart` goes on.")
        sys.exit(error.exit_code)
    except SpaceDistError as error:
        warn(f"quickstart: {error}")
        sys.exit(error.exit_code)
