"""Ray actors: what they import, and that losing one changes nothing but time."""

from __future__ import annotations

import importlib
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from space_dist import config as configs
from space_dist.arithmetic import digest, scipy_probes
from space_dist.errors import SpaceDistError
from space_dist.interrupts import StopRequests
from space_dist.launch import launch, read_instances
from space_dist.ledger import CURRICULUM, METRICS, Ledger
from space_dist.place import private_ray
from space_dist.training import learner_of, make_setup
from tests.patience import PATIENCE
from tests.test_learners import config_for, learner_section

ROOT = Path(__file__).resolve().parent.parent
SMALL = [
    "budget.steps=8192", "learner.n_steps=1024", "rollout.slots=2", "learner.n_epochs=2", "evaluation.every_steps=4000",
    "tracking.uri=null",
]  # fmt: skip

pytestmark = pytest.mark.ray


def config(workers: int, *settings: str) -> configs.RunConfig:
    return configs.load(ROOT / "configs/pointmass_space.yaml", [*SMALL, f"resources.workers={workers}", *settings])


@pytest.fixture(scope="module")
def cluster_class() -> Any:
    private_ray()
    from space_dist.distributed import RayCluster

    return RayCluster


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("reference")
    launch(config(0), folder, resume=True, stop=StopRequests())
    return results(folder)


def results(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in (METRICS, CURRICULUM, "model.npz")}


def test_rollout_actors_of_mlp_policies_never_import_torch(cluster_class: Any) -> None:
    import ray

    run = config(1)
    setup = make_setup(run, *read_instances(run))
    with cluster_class(run, setup) as cluster:
        policy = cluster.put(learner_of(run).policy(0))
        decision = cluster.begin(cluster.start_values(policy))
        from space_dist.walk import Walk

        shards = cluster.collect(policy, decision.selection, Walk(-1, ()), round=0, steps=0, version=0)
        assert len(cluster.get([*shards, *cluster.evaluate(policy, "test")])) == 2 * run.rollout.shards
        for actor in cluster._actors.values():
            # By value: a function of this module would make the actor import it, and all that it imports.
            names = ray.get(actor.__ray_call__.remote(lambda self: list(__import__("sys").modules)))
            modules = {name.partition(".")[0] for name in names}
            assert "numpy" in modules
            assert not modules & {"torch", "stable_baselines3", "sb3_contrib", "mlflow"}


@pytest.mark.parametrize("victims", [(0,), (-1,), (0, 1, -1)], ids=["a rollout actor", "the curriculum actor", "all"])
def test_killed_actors_are_replaced_and_change_nothing(
    victims: tuple[int, ...], cluster_class: Any, reference: dict[str, bytes], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    import ray

    killed: list[int] = []
    collect: Callable[..., list[Any]] = cluster_class.collect

    def kill_then_collect(self: Any, *arguments: Any, round: int, **options: Any) -> list[Any]:
        handles = collect(self, *arguments, round=round, **options)
        if round in (2, 5):  # while the shards, and the decision they need, are under way
            for victim in victims:
                ray.kill(self._actors[victim])
                killed.append(victim)
        return handles

    monkeypatch.setattr(cluster_class, "collect", kill_then_collect)
    launch(config(2), tmp_path, resume=True, stop=StopRequests())
    assert killed == [*victims, *victims]
    assert results(tmp_path) == reference
    assert "computing it again" in (tmp_path / "log.txt").read_text()


def test_an_actor_that_cannot_be_placed_is_an_error(cluster_class: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    import ray

    from space_dist.errors import SpaceDistError

    run = config(2, "resources.room_seconds=3")
    started = ray.init
    monkeypatch.setattr(ray, "init", lambda **options: started(**{**options, "num_cpus": 1}))
    said = "2 rollout actors of one CPU each: in 3 s .*the cluster has 1 CPUs"
    with pytest.raises(SpaceDistError, match=said), cluster_class(run, _setup(run)):
        pass
    assert not ray.is_initialized()


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

    from space_dist.errors import SpaceDistError

    begun = []

    def never(**options: Any) -> Any:
        begun.append(options["address"])
        raise Exception("The current node timed out during startup.\nThis could happen because")

    monkeypatch.setattr(ray, "init", never)
    monkeypatch.setattr("space_dist.ray_watch.REACH_SECONDS", 1.0)
    up = "The current node timed out during startup."
    for address, starts, what in (
        ("local", 5, up),
        ("auto", 1, up),
        ("127.0.0.1:1", 0, "nobody listens there, for 1 s"),
    ):
        run = config(1, f"resources.address={address}")
        where = rf"at '{address}' \(resources.address, or --address\)"
        said = f"^Ray cannot be started or reached {where}: {what}$"
        with pytest.raises(SpaceDistError, match=said), cluster_class(run, _setup(run)):
            pass
        assert begun == [address] * starts
        begun.clear()


def test_rays_of_our_own_start_one_at_a_time(
    cluster_class: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from space_dist.errors import Interrupted

    module = importlib.import_module(cluster_class.__module__)
    order = []

    def other() -> None:
        with module._turn_to_start(lambda: None):
            order.append("other")

    thread = threading.Thread(target=other)
    with module._turn_to_start(lambda: None):
        thread.start()
        time.sleep(0.5)
        order.append("first")
    thread.join()
    assert order == ["first", "other"]
    with module._turn_to_start(lambda: None):
        (tmp_path / "stop").touch()
        stop = StopRequests()
        stop.watch(tmp_path / "stop", 1.0)

        def heed() -> None:
            if reason := stop.reason():
                raise Interrupted(reason)

        with pytest.raises(Interrupted), module._turn_to_start(heed):  # who waits hears a stop
            pass
        monkeypatch.setattr(module, "_TURN_SECONDS", 0.3)
        with module._turn_to_start(lambda: None):  # one that never ends holds nobody up
            pass


def _setup(run: configs.RunConfig) -> Any:
    return make_setup(run, *read_instances(run))


@pytest.mark.usefixtures("cluster_class")
def test_a_stop_request_ends_a_run_on_ray_with_a_checkpoint(reference: dict[str, bytes], tmp_path: Path) -> None:
    from space_dist.errors import Interrupted

    def stop_soon() -> None:
        deadline = time.monotonic() + PATIENCE
        while not (tmp_path / METRICS).exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        (tmp_path / "stop").touch()

    thread = threading.Thread(target=stop_soon)
    thread.start()
    with pytest.raises(Interrupted):
        launch(config(1), tmp_path, resume=True, stop=StopRequests())
    thread.join()
    status = Ledger(tmp_path).status()
    assert (status.state, status.steps < 8192) == ("interrupted", True)
    launch(config(0), tmp_path, resume=True, stop=StopRequests())
    assert results(tmp_path) == reference


@pytest.mark.usefixtures("cluster_class")  # imports it with settings for a Ray of our own
@pytest.mark.parametrize(
    ("env_id", "kind", "rollout", "central"),
    [
        ("tests.tiny_env:make", "space", (), ()),
        ("tests.tiny_env:make_dict", "space", ("torch",), ()),
        ("tests.tiny_env:make", "spdrl", (), ("scipy",)),
        ("tests.tiny_env:make", "alp_gmm", (), ("scipy", "scikit-learn")),
    ],
)
def test_actors_are_compared_by_all_that_they_compute_with(
    env_id: str, kind: str, rollout: tuple[str, ...], central: tuple[str, ...], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    from space_dist import distributed

    policy = {"policy": "MultiInputPolicy"} if env_id.endswith("dict") else {}
    config = config_for(tmp_path, learner_section("ppo", **policy), env_id)
    setup = make_setup(config, *read_instances(config))
    section = type("Section", (), {"kind": kind})()
    config = config.model_copy(update={"curriculum": section})
    for wanted, is_central in ((rollout, False), (central, True)):
        parts = distributed.computes_with(config, setup, central=is_central)
        assert parts == ("numpy", *wanted)
        found = distributed.computed(parts)
        distributed.refuse_other_arithmetic(0, found)
        for part in parts:
            with pytest.raises(SpaceDistError, match=rf"computes other bits than this process with {part} \(0 there"):
                distributed.refuse_other_arithmetic(0, {**found, part: "0"})
    monkeypatch.setattr(distributed, "scipy_probes", lambda: iter([("qr", np.zeros(1))]))
    assert distributed.computed(["scipy"]) != {"scipy": digest(scipy_probes())}
