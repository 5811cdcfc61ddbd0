"""What holds on every CPU that is emulated: tests of a module that says which `CPU` it is about.

There are two such modules, `test_golden_amd` and `test_golden_intel`: pytest-xdist deals tests out by file, and an
emulated CPU keeps a core busy for minutes.
"""

from __future__ import annotations

import pytest

from tests.golden.emulation import GOLDEN, STOPPED, Emulated, emulate, needs_emulator

pytestmark = [pytest.mark.qemu, pytest.mark.timeout(3000), needs_emulator]


@pytest.fixture(scope="module")
def emulated(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Emulated:
    return emulate(request.module.CPU, tmp_path_factory.mktemp("stopped"))


def test_runs_have_the_golden_bits(emulated: Emulated) -> None:
    assert emulated.printed == GOLDEN


def test_a_run_stopped_here_goes_on_there_unmarked(emulated: Emulated) -> None:
    assert 0 < emulated.stopped.steps < emulated.stopped.budget_steps
    assert (emulated.ended.state, emulated.ended.fingerprint_changed) == ("done", False)
    assert emulated.ended.fingerprint == emulated.stopped.fingerprint
    assert emulated.resumed == GOLDEN["cases"][STOPPED]
