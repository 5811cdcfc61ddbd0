"""Pictures of a finished run, for those who look at it in MLflow."""

from __future__ import annotations

import json
import logging
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING, Final

from space_dist.ledger import Ledger
from space_dist.system.importing import PYTHON

if TYPE_CHECKING:
    from space_dist.report.load import Run

log = logging.getLogger("space_dist.tracking")

_DRAW_SECONDS: Final = 30.0  # for the pictures of a run


def draw(ledger: Ledger, folder: Path, *, episodes: bool) -> list[Path]:
    """Figures of a finished run in `folder`; with `episodes`, what its policy does, too."""
    from space_dist.report import draw_curriculum, draw_learning_curve, load_run, save

    run = load_run(ledger)
    figures = {}
    if len(run.evaluation_steps):
        figures["learning_curve.png"] = draw_learning_curve(run)
    if len(run.set_sizes):
        figures["curriculum.png"] = draw_curriculum(run)
    for name, figure in figures.items():
        save(figure, folder / name)
    return [folder / name for name in figures] + (_draw_episodes(run, folder / "episodes") if episodes else [])


def _draw_episodes(run: Run, folder: Path) -> list[Path]:
    """What the policy does, in GIFs and PNGs, for our own environments and policies that act without torch.

    In a process of its own, which can be ended when it takes too long; a failure costs a warning.
    """
    ledger = run.ledger
    try:
        env_id = str(run.config["env"]["id"])
        policy = json.loads(ledger.model_description.read_bytes())["policy"]
    except (OSError, ValueError, KeyError, TypeError):
        return []  # nothing that acts
    if policy == "torch" or not env_id.startswith("space_dist/"):
        return []
    command = [*PYTHON, "-m", "space_dist.cli", "render", "--out", str(folder), "--", str(ledger.folder)]
    try:
        subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=_DRAW_SECONDS, check=True)
    except subprocess.CalledProcessError as error:
        said = error.stderr.decode(errors="replace").strip()
        log.warning("%s: its episodes were not drawn: %s", ledger.folder, said[:300])
    except subprocess.TimeoutExpired:
        log.warning("%s: its episodes were not drawn: that took longer than %.0f s", ledger.folder, _DRAW_SECONDS)
    except OSError as error:
        log.warning("%s: its episodes were not drawn: %s", ledger.folder, error)
    return sorted([*folder.glob("*.gif"), *folder.glob("*.png")])  # whole ones, also of a process that was ended
