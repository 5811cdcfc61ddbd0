"""Ray actors: what they import and compute with, and that losing one changes nothing but time."""

# ruff: noqa: F811 - fixtures that are imported
from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from space_dist import arithmetic
from space_dist import config as configs
from space_dist.arithmetic import digest, scipy_checks
from space_dist.errors import SpaceDistError
from space_dist.grid.planning import plan
from space_dist.ledger import METRICS, Ledger
from space_dist.run import ray_actors
from space_dist.run.building import Blueprint
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests
from tests.grids import write_grid
from tests.patience import PATIENCE
from tests.test_distributed import ROOT, config, reference, results  # noqa: F401
from tests.test_learners import config_for, learner_section

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("one_ray")]


def test_rollout_actors_of_mlp_policies_never_import_torch(cluster_class: Any) -> None:
    import ray

    run = config(1)
    blueprint = Blueprint.of(run)
    setup = blueprint.setup(*blueprint.instances())
    with cluster_class(run, setup) as cluster:
        policy = cluster.put(blueprint.learner().policy(0))
        decision = cluster.begin(cluster.start_values(policy))
        from space_dist.rollout.walk import Walk

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
    policy = {"policy": "MultiInputPolicy"} if env_id.endswith("dict") else {}
    config = config_for(tmp_path, learner_section("ppo", **policy), env_id)
    blueprint = Blueprint.of(config)
    setup = blueprint.setup(*blueprint.instances())
    shipped = configs.load(ROOT / "configs/pointmass_space.yaml", [f"curriculum={{kind: {kind}}}"])
    config = config.model_copy(update={"curriculum": shipped.curriculum})
    for wanted, is_central in ((rollout, False), (central, True)):
        parts = ray_actors.computes_with(config, setup, central=is_central)
        assert parts == ("numpy", *wanted)
        found = ray_actors.computed(parts)
        ray_actors.refuse_other_arithmetic(0, found)
        for part in parts:
            with pytest.raises(SpaceDistError, match=rf"computes other bits than this process with {part} \(0 there"):
                ray_actors.refuse_other_arithmetic(0, {**found, part: "0"})
    monkeypatch.setattr(arithmetic, "_late", ["numpy", "torch"])
    with pytest.raises(SpaceDistError, match=r"here numpy and torch had been imported before .* restart the kernel"):
        ray_actors.refuse_other_arithmetic(0, {"numpy": "0"})
    monkeypatch.setattr(ray_actors, "scipy_checks", lambda: iter([("qr", np.zeros(1))]))
    assert ray_actors.computed(["scipy"]) != {"scipy": digest(scipy_checks())}


def test_actors_close_their_environments_where_a_run_ends(tmp_path: Path) -> None:
    noted = tmp_path / "noted"
    noted.mkdir()
    env = {"id": "tests.tiny_env:make_noting", "kwargs": {"folder": str(noted)}}
    there = config_for(tmp_path, learner_section("ppo"), env=env, resources={"workers": 2})
    launch(there, tmp_path / "run", resume=True, stop=StopRequests())
    files = [path.name for path in noted.iterdir()]
    assert len({name.partition("-")[0] for name in files}) == 3  # processes: two actors, and the driver, to look at one
    assert [name for name in files if not name.endswith(".closed")] == []


def test_the_ray_that_auto_took_is_named(tmp_path: Path) -> None:
    """To whoever waits, in a line that stays, and in the run's log; of a Ray of our own there is nothing to tell."""
    import ray

    from space_dist.grid.jobs import _joined

    one, told = ray.get_runtime_context().gcs_address, list[str]()
    waited: dict[str, list[str]] = {"auto": [], "local": []}
    for address, lines in waited.items():
        run = config(1, f"resources.address={address}")
        launch(run, tmp_path / address, resume=True, stop=StopRequests(), waiting=lines.append, tell=told.append)
    assert told == [f"joined the Ray at {one} (auto)"]
    there = f"waiting for room for 1 rollout actor on the Ray at {one} (auto)"
    assert waited["auto"] == ["joining the Ray at auto", there, "preparing the learner"]
    assert waited["local"] == ["starting Ray with 1 rollout actor", "preparing the learner"]
    assert f"INFO {told[0]}\n" in (tmp_path / "auto/log.txt").read_text()
    said = list[str]()
    for address in waited:
        manifest = plan(write_grid(tmp_path), tmp_path / "runs").manifest
        with _joined(address, manifest, 1, lambda: None, said.append):
            pass
    assert said == [f"{manifest.name}: joined the Ray at {one} (auto)"]


@pytest.mark.parametrize(("fault", "ends"), [("exit", "failed"), ("_exit", "done")])
def test_an_exit_with_0_in_an_actor_never_passes_for_success(fault: str, ends: str, tmp_path: Path) -> None:
    """`sys.exit` is an error of the environment's; an actor that is gone is replaced, and its work is done again."""
    section = learner_section("ppo", n_steps=32, net_arch=[4])
    section |= {"n_epochs": 1}
    env = {"id": "tests.fault_env:make", "kwargs": {"fault": fault, "marker": str(tmp_path / "marker")}}
    run = config_for(tmp_path, section, env=env, budget={"steps": 960}, rollout={"shards": 2, "slots": 2},
                     resources={"workers": 1})  # fmt: skip
    if ends == "failed":
        with pytest.raises(SpaceDistError, match="SystemExit: 0"):
            launch(run, tmp_path / "run", resume=True, stop=StopRequests())
    else:
        launch(run, tmp_path / "run", resume=True, stop=StopRequests())
    assert (tmp_path / "marker").exists()
    assert Ledger(tmp_path / "run").status().state == ends
