from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

import space_dist
from space_dist import errors
from tests.patience import PATIENCE

ROOT = Path(__file__).parent.parent
HEAVY = ("ray", "torch", "mlflow", "stable_baselines3", "sb3_contrib", "pybullet", "pybullet_data")


def imported_with(module: str) -> set[str]:
    """The top-level packages that a fresh interpreter holds once it has imported `module`."""
    program = f"import json, sys, {module}; print(json.dumps(sorted({{name.split('.')[0] for name in sys.modules}})))"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout))


@pytest.mark.parametrize("module", ["space_dist.curricula", "space_dist.rollout"])
def test_importing_it_imports_nothing_heavy(module: str):
    imported = imported_with(module)
    assert {"space_dist", "numpy"} <= imported
    assert not imported.intersection(HEAVY)


@pytest.mark.parametrize(
    "module",
    [
        "space_dist.grid.jobs",
        "space_dist.grid.supervisor",
        "space_dist.slurm",
        "space_dist.api.grids",
        "space_dist.cli.grids",
    ],
)
def test_whoever_only_starts_runs_does_not_wait_for_torch(module: str):
    assert not imported_with(module).intersection({"torch", "mlflow", "stable_baselines3", "sb3_contrib", "matplotlib"})


def test_the_curricula_need_no_environment_either():
    assert "gymnasium" not in imported_with("space_dist.curricula")


def test_the_import_contracts_hold():
    program = Path(sys.executable).parent / "lint-imports"
    done = subprocess.run([program, "--no-cache"], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stdout + done.stderr


def errors_exported() -> set[str]:
    exported = {name: getattr(space_dist, name) for name in space_dist.__all__}
    return {name for name, one in exported.items() if isinstance(one, type) and issubclass(one, Exception)}


def test_the_error_tree_is_exported_whole():
    raised = {one for one in vars(errors).values() if isinstance(one, type) and issubclass(one, Exception)}
    assert {one.__name__ for one in raised} == errors_exported()
    for error in raised:
        assert getattr(space_dist, error.__name__) is error
        assert issubclass(error, space_dist.SpaceDistError)
        assert error.__doc__


def test_each_error_ends_a_command_with_its_documented_code():
    # 2: retrying cannot help. 75: EX_TEMPFAIL, "requeue me". 1: anything else. 0 would be success.
    codes = {name: getattr(space_dist, name).exit_code for name in errors_exported()}
    assert codes == {"SpaceDistError": 1, "ConfigError": 2, "LedgerError": 1, "NotPlannedError": 2,
                     "RunLockedError": 1, "UnreadableError": 1, "Interrupted": 75}  # fmt: skip


def test_a_command_looks_for_garbage_seldom_and_whoever_imports_us_as_ever():
    """Looking through what torch makes as it is imported was a third of a command's start and end."""
    say = "import gc, sys; sys.argv[1:] = ['--version']; {}; print(gc.get_threshold()[0])"
    run_it = "from space_dist import cli; exec('try: cli.main()\\nexcept SystemExit: pass')"
    said = [
        int(
            subprocess.run(
                [sys.executable, "-c", say.format(code)], capture_output=True, text=True, check=True
            ).stdout.split()[-1]
        )
        for code in ("pass", "import space_dist.cli", run_it)
    ]
    assert said[0] == said[1] < said[2]
