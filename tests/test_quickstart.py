"""`make quickstart`, as a newcomer runs it, prints what docs say, to the digit, on every machine."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.patience import PATIENCE

ROOT = Path(__file__).resolve().parent.parent
NUMBERS = r"-?\d+\.\d\d \[-?\d+\.\d\d, -?\d+\.\d\d\]"


@pytest.mark.ray
def test_the_quickstart_prints_the_published_numbers(empty_store: Path, tmp_path: Path) -> None:
    """Where MLflow's database is already there: how it is made, `empty_store` shows."""
    shutil.copy(empty_store, tmp_path / "mlflow.db")
    done = subprocess.run(
        [sys.executable, str(ROOT / "jobs/quickstart.py")], cwd=tmp_path, capture_output=True, text=True,
        timeout=2 * PATIENCE,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    printed = re.findall(rf"^  (test return, IQM \[95 %\]: {NUMBERS} \(3/3\))$", done.stdout, re.MULTILINE)
    reached = re.findall(r"^(SPaCE's set reached all 100 instances in \d of 3 runs)", done.stdout, re.MULTILINE)
    assert (len(printed), len(reached)) == (2, 1)
    page = r"^Look at (http://127\.0\.0\.1:5000/#/experiments/\d+/runs\?workflowType=machine_learning) once `mlflow ui "
    assert len(re.findall(page, done.stderr, re.MULTILINE)) == 1
    quickstart, environments = ((ROOT / file).read_text() for file in ("docs/index.md", "docs/environments.md"))
    for line in (*printed, *reached):
        assert line in quickstart
    for line in printed:
        assert re.findall(NUMBERS, line)[0] in environments
    assert reached[0] in environments
