"""The golden bits on an AMD with AVX2 and FMA alone, emulated."""

from __future__ import annotations

import pytest

from tests.golden.emulation import GOLDEN, STOPPED, Emulated, emulate, needs_emulator

pytestmark = [pytest.mark.qemu, pytest.mark.timeout(3000), needs_emulator]


@pytest.fixture(scope="module")
def emulated(tmp_path_factory: pytest.TempPathFactory) -> Emulated:
    return emulate("EPYC-Rome", tmp_path_factory.mktemp("stopped"))


def test_runs_have_the_golden_bits(emulated: Emulated) -> None:
    assert emulated.printed == GOLDEN


def test_a_run_stopped_here_goes_on_there_unmarked(emulated: Emulated) -> None:
    assert 0 < emulated.stopped.steps < emulated.stopped.budget_steps
    assert (emulated.ended.state, emulated.ended.fingerprint_changed) == ("done", False)
    assert emulated.ended.fingerprint == emulated.stopped.fingerprint
    assert emulated.resumed == GOLDEN["cases"][STOPPED]
