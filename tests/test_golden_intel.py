"""The golden bits on an Intel with AVX2 and FMA alone, emulated."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.golden.emulation import PARTS, compare, needs_emulator, stop_here_go_on_there

CPU = "Haswell"
pytestmark = [pytest.mark.qemu, needs_emulator]


@pytest.mark.parametrize("part", range(PARTS))
def test_runs_have_the_golden_bits(part: int) -> None:
    compare(CPU, part)


def test_a_run_stopped_here_goes_on_there_unmarked(tmp_path: Path) -> None:
    stop_here_go_on_there(CPU, tmp_path)
