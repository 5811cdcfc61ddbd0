"""The README's two commands, as a newcomer types them: `make quickstart` prints what docs say, on every machine.

Of `make test`, which runs what this is a part of, the tests of one file are only collected.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.patience import PATIENCE
from tests.shell import bash_blocks, executes

ROOT = Path(__file__).resolve().parent.parent
NUMBERS = r"-?\d+\.\d+ \[-?\d+\.\d+, -?\d+\.\d+\]"


@executes(("README.md", 0), ("index.md", 0))
@pytest.mark.ray
def test_the_quickstart_prints_the_published_numbers(empty_store: Path, tmp_path: Path) -> None:
    """Where MLflow's database is already there: how it is made, `empty_store` shows."""
    shutil.copy(empty_store, tmp_path / "mlflow.db")
    for name in ("Makefile", "pyproject.toml", "constraints.txt", "jobs", "configs", "space_dist", "tests"):
        (tmp_path / name).symlink_to(ROOT / name)
    environment = tmp_path / ".venv"  # this one, in which everything is installed
    environment.mkdir()
    for path in Path(sys.prefix).iterdir():
        (environment / path.name).symlink_to(path)
    (environment / ".installed").unlink(missing_ok=True)
    (environment / ".installed").touch()
    [script], [other] = map(bash_blocks, ("README.md", "index.md"))
    assert script == other
    done = subprocess.run(
        ["bash", "-e", "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=2 * PATIENCE,
        env={**os.environ, "PYTEST_ADDOPTS": "--collect-only -q tests/test_purity.py"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert re.search(r"^tests/test_purity.py: \d+$", done.stdout, re.MULTILINE)
    returns = re.findall(rf"^  (test return, IQM \[95 %\]: {NUMBERS} \(5/5\))$", done.stdout, re.MULTILINE)
    steps = re.findall(r"^  (steps to the threshold: [\d,]+ \[.*\], \d/5 censored)$", done.stdout, re.MULTILINE)
    assert (len(returns), len(steps)) == (3, 3)
    page = r"^Look at (http://127\.0\.0\.1:5000/#/experiments/\d+/runs\?workflowType=machine_learning) once `mlflow ui "
    assert len(re.findall(page, done.stderr, re.MULTILINE)) == 1
    quickstart = (ROOT / "docs/index.md").read_text()
    for line in (*returns, *steps):
        assert line in quickstart
