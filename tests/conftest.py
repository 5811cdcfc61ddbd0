"""What all tests share: one thread for arithmetic, and nothing left outside pytest's own folders."""

from __future__ import annotations

import functools
import os
import shutil
from collections.abc import Generator, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import space_dist  # noqa: F401 # isort: skip - its settings come before NumPy is loaded

import pytest
from hypothesis import settings

from space_dist.system.processes import collect_seldom

# Their asserts show what they compared, as those of test modules do.
pytest.register_assert_rewrite("tests.golden.on_another_cpu", "tests.own_code", "tests.three_rounds")

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
for _name in ("MLFLOW_TRACKING_URI", "MLFLOW_EXPERIMENT_NAME"):
    os.environ.pop(_name, None)
os.environ.setdefault("RAY_worker_niceness", "0")  # beside other tests, the nice ones' turn would hardly ever come

_MEMORY = Path("/dev/shm")  # noqa: S108 - pytest makes a folder of this user's own there
_ENOUGH = 6 << 30  # bytes; what the tests write is a tenth of it, and Ray's objects live there, too


def _keep_folders_in_memory() -> None:
    """Have pytest make its folders where writing, renaming and removing a file takes no milliseconds, if there is room.

    Runs force what they write to disk, a dozen files a round, and whole runs are made by the thousand here: on a disk
    the tests wait for it for most of their time.
    """
    try:
        found = os.statvfs(_MEMORY)
    except OSError:
        return
    if found.f_bavail * found.f_frsize >= _ENOUGH and not found.f_flag & os.ST_NOEXEC and os.access(_MEMORY, os.W_OK):
        os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(_MEMORY))


_keep_folders_in_memory()
collect_seldom()


# Files that take longest, from the longest on: minutes of waiting, of emulating, or of both.
_LONGEST = (
    "chaos/test_chaos", "test_golden_intel", "test_golden_amd", "test_slurm_cluster", "test_determinism",
    "test_grid_cluster", "test_site_cluster", "test_lean_replay", "test_learners", "faults/test_parts",
    "test_grid_tracking", "faults/test_every_write", "faults/test_ray_itself", "test_importing",
    "faults/test_endings", "test_rival_runs", "test_actors", "test_distributed", "faults/test_owners_and_disks",
    "faults/test_requests", "faults/test_damage",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files come first, then others that start Slurm, an emulator, Ray or servers.

    pytest-xdist deals out whole files in this order, with `--no-loadscope-reorder`: one that is begun last would be
    waited for on one core.
    """
    here, places = Path(__file__).parent, {name: place for place, name in enumerate(_LONGEST)}
    ranks: dict[Path, int] = {}
    for item in items:
        marks = {mark.name for mark in item.iter_markers()}
        rank = len(places) + (0 if marks & {"slurm", "qemu", "ray", "server"} else 1)
        if item.path.is_relative_to(here):
            rank = places.get(item.path.relative_to(here).with_suffix("").as_posix(), rank)
        ranks[item.path] = min(rank, ranks.get(item.path, rank))
    items.sort(key=lambda item: ranks[item.path])
    _until[0] = sum(os.times()[:4])  # what was imported is no test's


_CPU = "cpu_seconds"
_COSTLY_FILES = 25  # of which a run of the whole suite tells what they took
_until = [0.0]  # CPU seconds of this process, and of children that it waited for, at the last report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Every report says what its phase cost: on a busy machine seconds by the clock tell little."""
    report = yield
    now = sum(os.times()[:4])
    report.user_properties = [*report.user_properties, (_CPU, now - _until[0])]
    _until[0] = now
    return report


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Where the suite's time goes, by file; of a few files pytest's own durations say enough."""
    files: dict[str, list[float]] = {}
    reports = [report for several in terminalreporter.stats.values() for report in several]
    for report in reports:
        if isinstance(report, pytest.TestReport):
            took = files.setdefault(report.nodeid.partition("::")[0], [0.0, 0.0])
            took[0] += report.duration
            took[1] += sum(value for name, value in report.user_properties if name == _CPU and isinstance(value, float))
    if len(files) <= _COSTLY_FILES:
        return
    terminalreporter.section(f"the {_COSTLY_FILES} longest of {len(files)} files: seconds, and CPU seconds")
    for name, (wall, cpu) in sorted(files.items(), key=lambda each: -each[1][0])[:_COSTLY_FILES]:
        terminalreporter.write_line(f"{wall:8.0f} {cpu:8.0f}  {name}")
    wall, cpu = (sum(took[column] for took in files.values()) for column in (0, 1))
    terminalreporter.write_line(f"{wall:8.0f} {cpu:8.0f}  all of them")


@pytest.fixture(scope="session", autouse=True)
def _sb3_logs_in_pytests_folder(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Stable-Baselines3's own `learn`, which some tests compare with, logs into the system's temporary folder."""
    folder: Path = tmp_path_factory.mktemp("sb3")
    os.environ["SB3_LOGDIR"] = str(folder)


@pytest.fixture(scope="session")
def empty_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database with MLflow's tables: making them takes seconds, so it happens once, for all of pytest's processes."""
    from space_dist.system.files import locked
    from space_dist.tracking import sync
    from tests.patience import PATIENCE
    from tests.test_report import start_run

    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    made = folder / "empty_store.db"
    with locked(folder / "empty_store.lock", PATIENCE):
        if not made.exists():
            own = tmp_path_factory.mktemp("store")
            sync([start_run(own / "run")], f"sqlite:///{own / 'mlflow.db'}", "unused")
            (own / "mlflow.db").rename(made)
    return made


@pytest.fixture
def uri(empty_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A store of the test's own, in a folder whose name needs care, and a current folder that must stay empty."""
    store = tmp_path / "a store #1"
    store.mkdir()
    shutil.copy(empty_store, store / "mlflow.db")
    (tmp_path / "cwd").mkdir()
    monkeypatch.chdir(tmp_path / "cwd")
    return f"sqlite:///{store / 'mlflow.db'}"


@pytest.fixture
def type_in(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Any:
    """What is typed into a terminal in `tmp_path`, behind `space-dist`; see `commanding.typed`."""
    from tests.commanding import typed

    monkeypatch.chdir(tmp_path)
    return functools.partial(typed, monkeypatch, capsys)


@pytest.fixture(scope="module")
def cluster_class() -> Any:
    """The cluster of actors on a private Ray, imported once its settings are made."""
    from space_dist.system.workplace import private_ray

    private_ray()
    from space_dist.run.ray_cluster import RayCluster

    return RayCluster


@pytest.fixture(scope="module")
def one_ray() -> Iterator[None]:
    """One private Ray for all clusters of a module: to start it takes longer than the runs."""
    from space_dist.system.workplace import private_ray

    private_ray()
    import ray

    from space_dist.run.ray_session import join_ray, remove_session

    found = join_ray("local", 5)
    joined = SimpleNamespace(address_info={**found, "session_dir": None})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ray, "init", lambda **_: joined)  # none of its own
        patch.setattr(ray, "shutdown", lambda: None)
        yield
    ray.shutdown()
    remove_session(found["session_dir"])


# How long an example takes says more about the machine than about us.
settings.register_profile("ours", deadline=None)
settings.load_profile("ours")
