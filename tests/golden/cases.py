"""Short runs of every learner, engine, environment and curriculum, whose files must have the same bits everywhere."""

from __future__ import annotations

import csv
import functools
import hashlib
from pathlib import Path

from space_dist import config as configs
from space_dist.ledger import CURRICULUM, METRICS, VALUES
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests

ROOT = Path(__file__).resolve().parent.parent.parent
DIGESTS = Path(__file__).with_name("digests.json")
FILES = (METRICS, CURRICULUM, VALUES, "model.npz")
_TRAIN, _TEST = 12, 2  # instances: enough to choose from, and cheap to emulate

# Few steps, each of many slots: what an emulator takes long for is Python, and then every sum.
_SHORT = [
    "budget.steps=384", "rollout.shards=2", "rollout.slots=4", "learner.n_steps=128", "env.kwargs.horizon=12",
    "evaluation.every_steps=100000", "tracking.uri=null", "resources.workers=0",
]  # fmt: skip
_PPO = [*_SHORT, "learner.n_epochs=2", "learner.net_arch=[32, 32]"]
_SMALL = [*_PPO, "learner.net_arch=[16, 16]"]
_LEAN = [*_SMALL, "learner.update=lean"]
_BULLET = ["budget.steps=96", "learner.n_steps=48", "learner.batch_size=24", "rollout.slots=1"]  # a world a slot
_TRPO = "learner={kind: trpo, n_steps: 128, n_critic_updates: 2, net_arch: [32, 32]}"
_CONTINUOUS = "net_arch: [32, 32], batch_size: 32, learning_starts: 128, gradient_steps_per_step: 0.05"


# Of twelve instances none would be left out where the set grows as in the shipped configs.
_GROWTH = ["curriculum.eta=0.1", "curriculum.kappa=1"]
_GROWING = {"pointmass_space", "antgoal_space", "ballcatching_space", "goalmaze_space", "mixed_maze_space"}

_COLUMN = "difficulty"  # what `manual` goes by; in the training instances of its case alone


def _curriculum(settings: str) -> str:
    return f"curriculum={{{settings}}}"


CASES: dict[str, tuple[str, list[str]]] = {
    # learners and engines
    "ppo": ("pointmass_space", [*_PPO, "curriculum.eta=4"]),
    "ppo relu, normalised": ("pointmass_space", [
        *_PPO, "learner.activation=relu", "learner.normalize_observations=true", "learner.normalize_rewards=true",
        "budget.steps=512",
    ]),
    "ppo lean": ("pointmass_space", [
        *_LEAN, "learner.net_arch=[40, 24]", "learner.ent_coef=0.01", "learner.target_kl=0.02",
    ]),
    "ppo population": ("pointmass_space", [
        *_PPO, "engine=population", "curriculum.eta=4", "learner.net_arch=[48]",
    ]),
    "ppo shared curriculum": ("pointmass_space", [
        *_PPO, "engine=population", "curriculum.aggregate=population", "curriculum.policies=2", "budget.steps=768",
        "learner.net_arch=[16, 16]",
    ]),
    "ppo overlap": ("pointmass_space", [*_PPO, "rollout.overlap=true"]),
    "trpo": ("pointmass_space", [*_SHORT, _TRPO]),
    "trpo population": ("pointmass_space", [*_SHORT, _TRPO, "engine=population"]),
    "a2c": ("pointmass_space", [*_SHORT, "learner={kind: a2c, n_steps: 128}"]),
    "recurrent_ppo": ("curricula/pointmass_plr", [
        *_SHORT, "env.context_visible=false",
        "learner={kind: recurrent_ppo, n_steps: 128, n_epochs: 2, net_arch: [16], lstm_hidden_size: 24}",
    ]),
    "dqn": ("cartpole_dqn_space", [
        "budget.steps=1000", "budget.episodes=20", "learner.learning_starts=200", "learner.net_arch=[32, 32]",
        "tracking.uri=null", "evaluation.episodes=1", "resources.workers=0",
    ]),
    "sac": ("pointmass_space", [*_SHORT, f"learner={{kind: sac, n_steps: 128, {_CONTINUOUS}}}"]),
    "td3": ("pointmass_space", [*_SHORT, f"learner={{kind: td3, n_steps: 128, {_CONTINUOUS}}}"]),
    "dqn lean": ("cartpole_dqn_space", [
        "budget.steps=1000", "budget.episodes=20", "learner.learning_starts=200", "learner.net_arch=[40, 24]",
        "learner.update=lean", "tracking.uri=null", "evaluation.episodes=1", "resources.workers=0",
    ]),
    "sac lean": ("pointmass_space", [*_SHORT, f"learner={{kind: sac, n_steps: 128, {_CONTINUOUS}, update: lean}}"]),
    "td3 lean": ("pointmass_space", [*_SHORT, f"learner={{kind: td3, n_steps: 128, {_CONTINUOUS}, update: lean}}"]),
    # environments
    "antgoal": ("antgoal_space", [*_SMALL, *_BULLET]),
    "ballcatching": ("ballcatching_space", [*_SMALL, *_BULLET, "env.kwargs.horizon=20"]),
    "maze": ("maze_space", [
        *_PPO, "env.kwargs.horizon=24", "learner.batch_size=64", "learner.net_arch=[32, 32]",
        "learner.update=stock",
    ]),
    "goalmaze": ("goalmaze_space", _LEAN),
    "mixed maze": ("mixed_maze_space", [*_PPO, "env.kwargs.horizon=24", "learner.batch_size=64"]),
    # curricula
    "cspace": ("pointmass_space", [*_LEAN, _curriculum("kind: cspace, kappa: 2, eta: 4")]),
    "round robin": ("pointmass_round_robin", _LEAN),
    "random growth": ("pointmass_space", [*_LEAN, _curriculum("kind: random_growth, kappa: 2, eta: 4")]),
    "fixed": ("pointmass_space", [*_LEAN, _curriculum("kind: fixed, ids: [0, 2]")]),
    "manual": ("pointmass_space", [*_LEAN, _curriculum(f"kind: manual, column: {_COLUMN}, kappa: 2, eta: 4")]),
    "uniform": ("curricula/pointmass_uniform", _LEAN),
    "spdrl": ("curricula/pointmass_spdrl", [
        *_LEAN, "budget.steps=512", "curriculum.warm_up=1", "curriculum.offset=1",
    ]),
    "vds": ("curricula/pointmass_vds", [*_LEAN, "curriculum.n_batches=4", "curriculum.batch_size=100"]),
    "alp_gmm": ("curricula/pointmass_alp_gmm", [
        *_LEAN, "budget.steps=640", "curriculum.fit_rate=12", "curriculum.components=3",
    ]),
    "plr": ("curricula/pointmass_plr", _LEAN),
    "plr robust": ("curricula/pointmass_plr_robust", [
        *_LEAN, "budget.steps=1024", "curriculum.replay_share=0.7",
    ]),
    "procurl": ("sparse_pointmass_procurl", _LEAN),
    "procurl space-alt": ("curricula/pointmass_space_alt", _LEAN),
    "learning_progress": ("curricula/pointmass_learning_progress", [
        *_LEAN, "budget.steps=512", "curriculum.outcome=return", "curriculum.lowest_return=0.25",
        "curriculum.largest_return=0.4",
    ]),
    "edge": ("sparse_pointmass_edge", [
        *_LEAN, "budget.steps=512", "curriculum.outcome=return", "learner.unrewarded=learn",
        "env.id=space_dist/PointMass-v0", "curriculum.lowest_return=0.25", "curriculum.largest_return=0.4",
    ]),
    "edge of sparse rewards": ("sparse_pointmass_edge", [*_LEAN, "budget.steps=512"]),
    "currot": ("curricula/pointmass_currot", [
        *_LEAN, "budget.steps=512", "curriculum.delta=0.253", "curriculum.particles=16",
    ]),
    "currot over the set": ("curricula/pointmass_currot", [
        *_LEAN, "budget.steps=512", _curriculum("kind: currot, delta: 0.253, particles: 16"),
    ]),
    "accel": ("curricula/mixed_maze_accel", [
        *_LEAN, "budget.steps=1024", "env.kwargs.horizon=14", "curriculum.buffer=8", "curriculum.batch=6",
    ]),
    "accel from the set": ("curricula/mixed_maze_accel", [
        *_LEAN, "budget.steps=1024", "env.kwargs.horizon=24",
        _curriculum("kind: accel, new_from: set, buffer: 6, batch: 4, edited: batch, score: max_mc, robust: false"),
    ]),
    "replayed draws": ("curricula/pointmass_plr", _LEAN),
    "forked": ("pointmass_space", [
        *_LEAN, "fork={seed: 3, steps: 100}",
        "schedule=[{steps: 200, set: {curriculum: {kind: uniform}, learner.learning_rate: 0.001}}]",
    ]),
    "learnability": ("cartpole_dqn_space", [
        *(setting for setting in _SMALL if "horizon" not in setting), "env.kwargs.horizon=20", "budget.episodes=null",
        "learner={kind: ppo, n_steps: 128, n_epochs: 2, net_arch: [16, 16]}", "budget.steps=1024",
        "evaluation.episodes=1",
        _curriculum("kind: learnability, every: 2, episodes: 4, top: 2"),
    ]),
}  # fmt: skip
"""Name -> (shipped config, settings)."""
_FOLLOWED = {"replayed draws": "plr"}  # the case whose curriculum another one's runs follow


@functools.cache
def _shipped(file: Path) -> configs.InstancesConfig:
    return configs.load(file).instances


@functools.cache
def _instances(file: Path, count: int) -> list[list[str]]:
    with file.open(newline="") as stream:
        return list(csv.reader(stream))[: count + 1]


def config_of(name: str, folder: Path, also: tuple[str, ...] = ()) -> configs.RunConfig:
    """A case's config, on the first instances of the shipped sets, which are copied into `folder`."""
    base, settings = CASES[name]
    file = ROOT / "configs" / f"{base}.yaml"
    shipped, made = _shipped(file), []
    for split, source, count in (("train", shipped.train, _TRAIN), ("test", shipped.test, _TEST)):
        target, rows = folder / f"{split}.csv", _instances(source, count)
        if (name, split) == ("manual", "train"):
            rows = [[*row, _COLUMN if row is rows[0] else str(5 * number % 7)] for number, row in enumerate(rows)]
        with target.open("w", newline="") as stream:
            csv.writer(stream).writerows(rows)
        made.append(f"instances.{split}={target}")
    chosen = any(setting.startswith("curriculum={") for setting in settings)
    growth = _GROWTH if base in _GROWING and not chosen else []
    return configs.load(file, [*growth, *settings, *made, *also])


def digests_of(folder: Path) -> dict[str, str]:
    """`(16 hex digits)` of each file of a finished run that holds results."""
    return {name: hashlib.sha256((folder / name).read_bytes()).hexdigest()[:16] for name in FILES}


def run(name: str, folder: Path) -> dict[str, str]:
    """Run a case in `folder`, in this process; the digests of what it wrote."""
    folder.mkdir(parents=True)
    also: tuple[str, ...] = ()
    if name in _FOLLOWED:
        launch(config_of(_FOLLOWED[name], folder), folder / "followed", resume=False, stop=StopRequests())
        also = (_curriculum(f"kind: replay, of: {folder / 'followed'}"), "seed=1")
    launch(config_of(name, folder, also), folder / "run", resume=False, stop=StopRequests())
    return digests_of(folder / "run")
