"""Rays of our own: started one at a time, again where one does not come up, and not at all is an error."""

from __future__ import annotations

import signal
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from space_dist import config as configs
from space_dist.errors import SpaceDistError
from space_dist.ledger import CURRICULUM, METRICS
from space_dist.run.building import Blueprint
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests
from tests.patience import PATIENCE

ROOT = Path(__file__).resolve().parent.parent
SMALL = [
    "budget.steps=8192", "learner.n_steps=1024", "rollout.slots=2", "learner.n_epochs=2", "evaluation.every_steps=4000",
    "tracking.uri=null", "curriculum.eta=0.1", "curriculum.kappa=1",
]  # fmt: skip

pytestmark = pytest.mark.ray


def config(workers: int, *settings: str) -> configs.RunConfig:
    return configs.load(ROOT / "configs/pointmass_space.yaml", [*SMALL, f"resources.workers={workers}", *settings])


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("reference")
    launch(config(0), folder, resume=True, stop=StopRequests())
    return results(folder)


def results(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in (METRICS, CURRICULUM, "model.npz")}


def test_an_actor_that_cannot_be_placed_is_an_error(cluster_class: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    import ray

    run = config(2, "resources.room_seconds=3")
    started = ray.init
    monkeypatch.setattr(ray, "init", lambda **options: started(**{**options, "num_cpus": 1}))
    said = "2 rollout actors of one CPU each: in 3 s .*the cluster has 1 CPUs"
    with pytest.raises(SpaceDistError, match=said), cluster_class(run, _setup(run)):
        pass
    assert not ray.is_initialized()


def test_workers_that_nobody_asked_for_are_no_more_than_there_are_cpus(
    cluster_class: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    import ray

    run = configs.load(ROOT / "configs/pointmass_space.yaml", [*SMALL, "resources.room_seconds=30"])
    started = ray.init
    monkeypatch.setattr(ray, "init", lambda **options: started(**{**options, "num_cpus": 1}))
    monkeypatch.setattr("space_dist.run.ray_cluster.n_workers", lambda config, spec: config.rollout.shards)
    assert run.rollout.shards == 4
    with cluster_class(run, _setup(run)):
        (room,) = ray.util.placement_group_table().values()
        assert len(room["bundles"]) == 1


@pytest.mark.usefixtures("cluster_class")
def test_a_ray_that_does_not_start_in_time_is_started_again(
    reference: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import ray

    started, halves = ray.init, []

    def on_a_busy_machine(**options: Any) -> Any:
        if len(halves) < 2:  # what it has started by then goes on
            halves.append(subprocess.Popen(["/bin/sleep", "600"]))
            raise Exception("The current node timed out during startup.\nThis could happen because")
        return started(**options)

    monkeypatch.setattr(ray, "init", on_a_busy_machine)
    launch(config(1), tmp_path, resume=True, stop=StopRequests())
    assert results(tmp_path) == reference
    assert [half.wait(timeout=PATIENCE) for half in halves] == [-signal.SIGKILL] * 2
    log = (tmp_path / "log.txt").read_text()
    assert log.count("Ray did not start (The current node timed out during startup.); trying again") == 2


def test_a_ray_that_never_starts_is_an_error(cluster_class: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    import ray

    begun = []

    def never(**options: Any) -> Any:
        begun.append(options["address"])
        raise Exception("The current node timed out during startup.\nThis could happen because")

    monkeypatch.setattr(ray, "init", never)
    monkeypatch.setattr("space_dist.run.ray_watch.REACH_SECONDS", 1.0)
    way_out = ". `ray start --head` starts one there; where no address is given, a run starts a private Ray"
    up = "The current node timed out during startup."
    for address, starts, what in (
        ("local", 5, up),
        ("auto", 1, up),
        ("127.0.0.1:1", 0, f"nobody listens there, for 1 s{way_out}"),
    ):
        run = config(1, f"resources.address={address}")
        where = rf"at '{address}' \(resources.address, or --address\)"
        said = f"^Ray cannot be started or reached {where}: {what}$"
        with pytest.raises(SpaceDistError, match=said), cluster_class(run, _setup(run)):
            pass
        assert begun == [address] * starts
        begun.clear()


@pytest.mark.usefixtures("cluster_class")
def test_where_no_ray_runs_the_next_step_is_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    import ray

    from space_dist.run.ray_session import join_ray

    def none_runs(**options: Any) -> Any:
        raise ConnectionError(
            f"Could not find any running Ray instance at {options['address']}. Please specify the one to connect to by "
            "setting `--address` flag or `RAY_ADDRESS` environment variable."
        )

    monkeypatch.setattr(ray, "init", none_runs)
    with pytest.raises(SpaceDistError, match=r"no Ray runs on this machine\. `ray start --head` starts one") as told:
        join_ray("auto", 1)
    assert "RAY_ADDRESS" not in str(told.value)


@pytest.mark.usefixtures("cluster_class")
def test_rays_of_our_own_start_one_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from space_dist.errors import Interrupted
    from space_dist.run import ray_session

    order = []

    def other() -> None:
        with ray_session._turn_to_start(lambda: None):
            order.append("other")

    thread = threading.Thread(target=other)
    with ray_session._turn_to_start(lambda: None):
        thread.start()
        time.sleep(0.5)
        order.append("first")
    thread.join()
    assert order == ["first", "other"]
    with ray_session._turn_to_start(lambda: None):
        (tmp_path / "stop").touch()
        stop = StopRequests()
        stop.watch(tmp_path / "stop", 1.0)

        def raise_if_stopped() -> None:
            if reason := stop.reason():
                raise Interrupted(reason)

        with pytest.raises(Interrupted), ray_session._turn_to_start(raise_if_stopped):  # who waits hears a stop
            pass
        monkeypatch.setattr(ray_session, "_TURN_SECONDS", 0.3)
        with ray_session._turn_to_start(lambda: None):  # one that never ends holds nobody up
            pass


def _setup(run: configs.RunConfig) -> Any:
    blueprint = Blueprint.of(run)
    return blueprint.setup(*blueprint.instances())
