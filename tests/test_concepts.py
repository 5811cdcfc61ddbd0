"""jobs/concepts.py draws the figures of docs/concepts.md, of SPaCE on PointMass and of nothing else."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MAIN = runpy.run_path(str(ROOT / "jobs/concepts.py"))["main"]


def ledger(folder: Path, kind: str) -> Path:
    """As much of a run's folder as the figures are drawn from."""
    folder.mkdir()
    (folder / "config.yaml").write_text(f"env: {{id: space_dist/PointMass-v0}}\ncurriculum: {{kind: {kind}}}\n")
    (folder / "instances_train.csv").write_text("id,gate_x,gate_width,friction\n0,1.0,2.0,0.5\n1,-1.0,4.0,0.1\n")
    rows = [{"iteration": 1, "trained": [0]}, {"iteration": 2, "trained": [0, 1]}]
    (folder / "curriculum.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    return folder


def test_the_figures_go_where_one_wants_them(tmp_path: Path) -> None:
    run, there = ledger(tmp_path / "run", "space"), tmp_path / "figures"
    MAIN([str(run), str(there)])
    assert sorted(path.name for path in there.iterdir()) == ["grid.png", "iteration.png", "selections.png"]


def test_what_cannot_be_drawn_is_said_and_nothing_is_written(tmp_path: Path) -> None:
    other, there = ledger(tmp_path / "run", "round_robin"), tmp_path / "figures"
    for arguments, words in (
        ([str(other), str(there)], "it is a run of round_robin on space_dist/PointMass-v0; one of space"),
        ([str(tmp_path), str(there)], "it has no config.yaml; the folder of one run is wanted"),
        (["--help"], "usage: python jobs/concepts.py RUN"),
        ([], "usage: python jobs/concepts.py RUN"),
    ):
        with pytest.raises(SystemExit, match=words):
            MAIN(arguments)
    assert not there.exists()
