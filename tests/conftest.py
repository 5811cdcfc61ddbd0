"""What all tests share: one thread for arithmetic, and nothing left outside pytest's own folders."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")


@pytest.fixture(scope="session", autouse=True)
def _sb3_logs_in_pytests_folder(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Stable-Baselines3's own `learn`, which some tests compare with, logs into the system's temporary folder."""
    folder: Path = tmp_path_factory.mktemp("sb3")
    os.environ["SB3_LOGDIR"] = str(folder)
