"""The same bits on every machine: golden digests of short runs; `test_golden_amd` and `_intel` have them emulated."""

from __future__ import annotations

from pathlib import Path

import pytest

from space_dist.arithmetic import REFERENCE
from space_dist.run.claiming import arithmetic_digest
from tests.golden.cases import CASES, run
from tests.golden.emulation import GOLDEN


def test_this_machine_computes_what_published_numbers_are_made_with() -> None:
    assert arithmetic_digest() == REFERENCE["all"] == GOLDEN["arithmetic"]


@pytest.mark.parametrize("name", CASES)
def test_every_part_gives_the_golden_bits(name: str, tmp_path: Path) -> None:
    assert run(name, tmp_path / "case") == GOLDEN["cases"][name]
