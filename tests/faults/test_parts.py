"""Parts of a run that die, stop or vanish with their node: what they owed is computed elsewhere, to the same bytes."""

from __future__ import annotations

import os
import platform
import re
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from space_dist import config as configs
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests
from tests.faults.test_every_write import short
from tests.test_learners import results

pytestmark = pytest.mark.ray
CENTRAL = -1
QUICK = {"late_seconds": 3.0, "late_factor": 1.0, "first_answer_seconds": 60.0, "room_seconds": 30.0}


def with_resources(config: configs.RunConfig, **resources: Any) -> configs.RunConfig:
    return config.model_copy(update={"resources": config.resources.model_copy(update={**QUICK, **resources})})


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("reference")
    launch(short(folder, "ppo", 6), folder / "run", resume=True, stop=StopRequests())
    return results(folder / "run")


def pid_of(actor: Any) -> int:
    import ray

    return int(ray.get(actor.__ray_call__.remote(lambda self: __import__("os").getpid())))


def hurting(cluster_class: Any, method: str, occasions: set[int], hurt: Callable[[Any], None]) -> Callable[..., Any]:
    """`method`, after which `hurt` happens on some occasions."""
    original, count = getattr(cluster_class, method), iter(range(1_000))

    def call(self: Any, *arguments: Any, **options: Any) -> Any:
        now = next(count) in occasions
        if now:
            hurt(self)
        return original(self, *arguments, **options)

    return call


def test_stopped_and_killed_actors_are_noticed_and_change_nothing(
    cluster_class: Any, reference: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stopped rollout actor owes start values, too: the curriculum actor's queue is blocked behind them."""
    hit: list[tuple[int, int]] = []

    def hurt(victim: int, number: int) -> Callable[[Any], None]:
        def now(cluster: Any) -> None:
            pid = pid_of(cluster._actors[victim])
            os.kill(pid, number)
            hit.append((victim, number))

        return now

    for method, occasion, victim, number in (
        ("start_values", 1, 0, signal.SIGSTOP),
        ("decide", 1, CENTRAL, signal.SIGSTOP),
        ("collect", 4, 1, signal.SIGSTOP),
        ("evaluate", 4, 0, signal.SIGKILL),
        ("decide", 3, CENTRAL, signal.SIGKILL),
    ):
        monkeypatch.setattr(cluster_class, method, hurting(cluster_class, method, {occasion}, hurt(victim, number)))
    config = with_resources(short(tmp_path, "ppo", 6), workers=2)
    launch(config, tmp_path / "run", resume=True, stop=StopRequests())
    assert len(hit) == 5
    assert results(tmp_path / "run") == reference
    said = (tmp_path / "run" / "log.txt").read_text()
    assert said.count("replacing it") >= 3
    assert "rollout actor 0 has not answered" in said
    assert "the curriculum actor has not answered" in said


def test_a_false_alarm_changes_nothing_and_lost_objects_are_put_again(
    cluster_class: Any, reference: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import ray

    class Gone:
        def value(self) -> None:
            time.sleep(1_000)

    lost, alarms = [], []
    late = cluster_class._late

    evaluate = cluster_class.evaluate

    def evaluate_what_is_lost(cluster: Any, policy: Any, split: str, **options: Any) -> list[Any]:
        if cluster._submitted > 8 and len(lost) < 2:
            gone = ray.remote(num_cpus=0)(Gone).remote()
            policy.ref = gone.value.remote()  # an object that will never be had
            ray.kill(gone)
            lost.append(policy)
        return list(evaluate(cluster, policy, split, **options))

    def too_late(cluster: Any) -> set[int]:
        if cluster._submitted in range(20, 60) and len(alarms) < 3:
            alarms.append(len(alarms) % 2 - 1)  # the curriculum actor, a rollout actor, the curriculum actor
            return {alarms[-1]}
        return set(late(cluster))

    monkeypatch.setattr(cluster_class, "evaluate", evaluate_what_is_lost)
    monkeypatch.setattr(cluster_class, "_late", too_late)
    config = with_resources(short(tmp_path, "ppo", 6), workers=2)
    launch(config, tmp_path / "run", resume=True, stop=StopRequests())
    assert (len(lost), alarms) == (2, [CENTRAL, 0, CENTRAL])
    assert results(tmp_path / "run") == reference


@pytest.fixture
def two_nodes(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Ray's own cluster on this machine: a head with one CPU, and a node with three."""
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_TMPDIR", f"/tmp/sd{os.getpid()}")  # noqa: S108 - socket paths are limited to 107 bytes
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[2]))
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        node = cluster.add_node(num_cpus=3)
        yield cluster, node
    finally:
        cluster.shutdown()
        shutil.rmtree(os.environ["RAY_TMPDIR"], ignore_errors=True)


@pytest.mark.parametrize(
    ("workers", "said"),
    [(3, "room is left for 1 of 3 rollout actors"), (4, "lost a part of the run")],
    ids=["with all actors", "with all rollout actors but one"],
)
def test_a_lost_node_is_survived_with_what_is_left(
    workers: int, said: str, cluster_class: Any, reference: dict[str, bytes], two_nodes: Any, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    cluster, node = two_nodes
    on_lost_node: list[int] = []

    def lose(actors: Any) -> None:
        import ray

        indices = [
            index for index, actor in actors._actors.items()
            if ray.get(actor.__ray_call__.remote(
                lambda self: __import__("ray").get_runtime_context().get_node_id()
            )) == node.node_id
        ]  # fmt: skip
        on_lost_node.extend(indices)
        cluster.remove_node(node, allow_graceful=False)

    monkeypatch.setattr(cluster_class, "collect", hurting(cluster_class, "collect", {3}, lose))
    config = with_resources(short(tmp_path, "ppo", 6), workers=workers, address=cluster.address, late_seconds=20.0)
    launch(config, tmp_path / "run", resume=True, stop=StopRequests())
    assert len(set(on_lost_node) - {CENTRAL}) == 3
    log = (tmp_path / "run" / "log.txt").read_text()
    assert said in log
    lost = re.findall(rf"lost (.*) \(on {platform.node()}\); what was owed is computed again", log)
    assert {"rollout actor 0", "rollout actor 1"} & set(", ".join(lost).split(", "))
    assert len(re.findall(r"more than 2 actors take CPUs and gain nothing", log)) == 1
    assert results(tmp_path / "run") == reference
