"""A run is a pure function of (config, seed): not of workers, repetition, kills or resumption."""

from __future__ import annotations

import random
import time
from pathlib import Path

import pytest

from space_dist import config as configs
from space_dist.ledger import CURRICULUM, METRICS, Ledger
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests
from tests import prepared
from tests.patience import PATIENCE

ROOT = Path(__file__).resolve().parent.parent
CONFIG = ROOT / "configs/pointmass_space.yaml"
RESULTS = (METRICS, CURRICULUM, "model.npz", "model.json")


def settings(learner: str) -> list[str]:
    """Thirty short rounds: a slot makes seven steps in each, so that an episode, of up to 100, spans many."""
    made = [
        "budget.steps=3360", "learner.n_steps=112", "rollout.slots=4", "evaluation.every_steps=1680",
        "checkpoint.every_rounds=1", "tracking.uri=null", "learner.n_epochs=2",
        "curriculum.eta=0.1", "curriculum.kappa=1",  # a set that grows all along
    ]  # fmt: skip
    if learner == "trpo":  # the shipped config is PPO's: what only PPO has goes
        made.append(
            "learner={kind: trpo, n_steps: 112, gamma: 0.95, gae_lambda: 0.99, net_arch: [64, 64], target_kl: 0.004, "
            "n_critic_updates: 2}"
        )
    return made


def train(out: Path, learner: str, *, seed: int = 0, workers: int = 0, resume: bool = False) -> list[object]:
    command = ["train", CONFIG, "--out", out, "--seed", seed, "--workers", workers]
    for setting in settings(learner):
        command += ["--set", setting]
    return [*command, "--resume"] if resume else command


def run(command: list[object], said: Path) -> None:
    process = prepared.command(command, said)
    process.join(PATIENCE)
    assert process.exitcode == 0, said.read_text()


def results(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in RESULTS}


@pytest.fixture(scope="module", params=["ppo", "trpo"])
def reference(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """An undisturbed run without Ray, in a process of its own."""
    folder = tmp_path_factory.mktemp(request.param) / "reference"
    run(train(folder, request.param), folder.parent / "said.txt")
    return request.param, folder


@pytest.mark.ray
@pytest.mark.usefixtures("one_ray")
@pytest.mark.parametrize("workers", [1, 2, 4])
def test_the_number_of_workers_changes_no_byte(reference: tuple[str, Path], workers: int, tmp_path: Path) -> None:
    learner, folder = reference
    config = configs.load(CONFIG, [*settings(learner), f"resources.workers={workers}"])
    launch(config, tmp_path / "run", resume=False, stop=StopRequests())
    assert results(tmp_path / "run") == results(folder)


@pytest.mark.ray
@pytest.mark.parametrize("reference", ["ppo"], indirect=True)  # whose Ray it is, no learner learns
def test_the_command_with_a_ray_of_its_own_changes_no_byte(reference: tuple[str, Path], tmp_path: Path) -> None:
    learner, folder = reference
    run(train(tmp_path / "run", learner, workers=4), tmp_path / "said.txt")
    assert results(tmp_path / "run") == results(folder)


def test_repeated_it_is_the_same_and_another_seed_is_not(reference: tuple[str, Path], tmp_path: Path) -> None:
    learner, folder = reference
    run(train(tmp_path / "again", learner), tmp_path / "said.txt")
    run(train(tmp_path / "other", learner, seed=1), tmp_path / "said.txt")
    assert results(tmp_path / "again") == results(folder)
    for name, content in results(tmp_path / "other").items():
        assert content != (folder / name).read_bytes(), name


@pytest.mark.ray
def test_killed_five_times_and_resumed_it_is_the_same(reference: tuple[str, Path], tmp_path: Path) -> None:
    learner, folder = reference
    out = tmp_path / "run"
    moments = random.Random(f"kills of {learner}")
    for kill, target in enumerate(sorted(moments.sample(range(1, 10), 5))):
        said = tmp_path / f"said-{kill}.txt"
        # The last kills hit runs that have Ray actors, which must not outlive their driver.
        process = prepared.command(train(out, learner, workers=2 if kill >= 3 else 0, resume=True), said)
        deadline = time.monotonic() + PATIENCE
        while _round(out) < target and process.is_alive() and time.monotonic() < deadline:
            time.sleep(0.002)
        time.sleep(moments.uniform(0.0, 0.1))
        assert process.is_alive(), f"ended before it could be killed, in round {_round(out)}: {said.read_text()}"
        process.kill()
        process.join()
    assert Ledger(out).status().state == "running"  # nobody was left to say otherwise
    run(train(out, learner, resume=True), tmp_path / "said.txt")  # without the actors that it was begun with
    assert results(out) == results(folder)
    assert Ledger(out).status().state == "done"


def _round(folder: Path) -> int:
    """Updates under the last checkpoint."""
    names = sorted((folder / "checkpoints").glob("round-*.npz"))
    return int(names[-1].stem.removeprefix("round-")) if names else 0
