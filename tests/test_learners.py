"""Whole runs of every learner: the same bytes wherever and however often they are computed, and something learnt."""

from __future__ import annotations

import dataclasses
import inspect
import json
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.sac.policies import SACPolicy  # noqa: F401 - named by import path

from space_dist import config as configs
from space_dist.config import RunConfig
from space_dist.config.explaining import NOT_HERE, SET_BY_OWN_CLASS
from space_dist.envs.observations import Observations, rows
from space_dist.errors import ConfigError, Interrupted, LedgerError, SpaceDistError
from space_dist.learner import make_learner
from space_dist.learner.networks import ALGORITHMS, TorchPolicy
from space_dist.learner.recurrent import RecurrentTorchPolicy
from space_dist.ledger import CURRICULUM, FORMAT, METRICS, Ledger, RunWriter, decode_checkpoint
from space_dist.report import build_report, load_run
from space_dist.rollout import Worker
from space_dist.rollout.policy import MlpPolicy
from space_dist.rollout.walk import Walk
from space_dist.run.building import Blueprint, spec_of
from space_dist.run.launch import launch, policy_of
from space_dist.system.interrupts import StopRequests

LINE, DISCRETE_LINE, SCALED = "tests.tiny_env:make", "tests.tiny_env:make_discrete", "tests.tiny_env:make_scaled"
IMAGE, PARTS = "tests.tiny_env:make_image", "tests.tiny_env:make_dict"
KINDS = ("ppo", "a2c", "trpo", "recurrent_ppo", "dqn", "sac", "td3")
RESULTS = (METRICS, CURRICULUM, "model.npz", "model.json")
N_STEPS, ROUNDS = 40, 6  # five steps a slot: episodes, of eight, go on from round to round

LEARNERS: dict[str, dict[str, Any]] = {
    "ppo": {"batch_size": 32, "n_epochs": 2},
    "a2c": {},
    "trpo": {"batch_size": 32, "n_critic_updates": 2, "target_kl": 0.02},
    "recurrent_ppo": {"batch_size": 16, "n_epochs": 2, "lstm_hidden_size": 8},
    "dqn": {"gradient_steps_per_step": 0.5, "target_update_interval": 100, "exploration_fraction": 0.5},
    "sac": {"gradient_steps_per_step": 0.25},
    "td3": {"gradient_steps_per_step": 0.25},
}
# 150 transitions: less than the run's 384, so that the ring wraps around and pieces of it are forgotten.
OFF_POLICY = {"batch_size": 16, "learning_starts": 70, "buffer_size": 150}
NORMALISED = {"normalize_observations": True, "normalize_rewards": True}


def learner_section(kind: str, **changes: Any) -> dict[str, Any]:
    off_policy = OFF_POLICY if kind in ("dqn", "sac", "td3") else {}
    return {"kind": kind, "n_steps": N_STEPS, "net_arch": [16], **off_policy, **LEARNERS[kind], **changes}


def config_for(folder: Path, learner: dict[str, Any], env_id: str | None = None, **sections: Any) -> RunConfig:
    """A run on four instances of the line, six rounds long."""
    folder.mkdir(exist_ok=True)
    train, test = folder / "train.csv", folder / "test.csv"
    train.write_text("id,target\n0,-0.75\n1,0.75\n2,0.4\n3,-0.3\n")
    test.write_text("id,target\n0,-0.7\n1,0.7\n")
    data = {
        "name": "tiny", "env": {"id": env_id or (DISCRETE_LINE if learner["kind"] == "dqn" else LINE)},
        "instances": {"train": str(train), "test": str(test)}, "curriculum": {"kind": "space"}, "learner": learner,
        "rollout": {"shards": 4, "slots": 2}, "budget": {"steps": ROUNDS * N_STEPS}, "evaluation": {"every_steps": 100},
        "checkpoint": {"every_rounds": 1}, "tracking": {"uri": None}, "resources": {"workers": 0},
    }  # fmt: skip
    return configs.parse({**data, **sections}, "test")


def run(config: RunConfig, folder: Path) -> dict[str, bytes]:
    launch(config, folder, resume=True, stop=StopRequests())
    return results(folder)


def results(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in RESULTS}


class StopAfter(StopRequests):
    """Asks a run to stop after so many rounds."""

    def __init__(self, rounds: int) -> None:
        super().__init__()
        self._left = rounds

    def reason(self) -> str | None:
        self._left -= 1
        return "the test" if self._left == 0 else None


def interrupted(config: RunConfig, folder: Path, rounds: int) -> None:
    with pytest.raises(Interrupted):
        launch(config, folder, resume=True, stop=StopAfter(rounds))


def aged(folder: Path) -> None:
    """Have a run's status and checkpoint be of format 1, whose checkpoints have no episodes in progress."""
    ledger = Ledger(folder)
    with RunWriter(ledger) as writer:
        writer.status = ledger.status()
        checkpoint = writer.restore()
        assert checkpoint is not None
        assert checkpoint.format == FORMAT
        arrays = {name: array for name, array in checkpoint.arrays.items() if not name.startswith("unfinished/")}
        about = {name: value for name, value in checkpoint.data.items() if name != "about"}
        old = dataclasses.replace(checkpoint, arrays=arrays, data=about, format=1)
        writer.commit(old, dataclasses.replace(ledger.status(), format=1))


def test_a_run_of_an_earlier_format_is_read_and_not_gone_on_with(tmp_path: Path) -> None:
    config = config_for(tmp_path, learner_section("ppo"))
    out = tmp_path / "run"
    interrupted(config, out, 3)
    aged(out)
    before = {file.name: file.read_bytes() for file in out.iterdir() if file.is_file() and file.name != "lock.json"}
    words = r"begun by an earlier version of space_dist \(format 1 .* Use another folder, or the version that began it"
    with pytest.raises(ConfigError, match=words):
        launch(config, out, resume=True, stop=StopRequests())
    assert {name: (out / name).read_bytes() for name in before} == before
    assert policy_of(Ledger(out), spec_of(config)).version == 3
    assert load_run(Ledger(out)).status.format == 1
    (out / "status.json").unlink()
    with pytest.raises(ConfigError, match=words):
        launch(config, out, resume=True, stop=StopRequests())
    launch(config, tmp_path / "done", resume=True, stop=StopRequests())
    aged(tmp_path / "done")
    assert launch(config, tmp_path / "done", resume=True, stop=StopRequests()).already_done
    assert build_report([Ledger(tmp_path / "done")], tmp_path / "report").table[0]["seeds finished"] == "1/1"


def crashed(config: RunConfig, folder: Path, rounds: int) -> None:
    """A run that dies after so many rounds, before it commits what it did since its last checkpoint."""
    left = iter(range(rounds - 1))

    def die(_: Any) -> None:
        if next(left, None) is None:
            raise RuntimeError("the test's crash")

    with pytest.raises(SpaceDistError, match="the test's crash"):
        launch(config, folder, resume=True, stop=StopRequests(), observe=die)


def with_checkpoints(config: RunConfig, every_rounds: int) -> RunConfig:
    return config.model_copy(update={"checkpoint": config.checkpoint.model_copy(update={"every_rounds": every_rounds})})


def resumed(config: RunConfig, folder: Path) -> dict[str, bytes]:
    """Results of a run that was stopped twice and crashed once, two rounds' work behind its last checkpoint."""
    seldom = with_checkpoints(config, 20)
    interrupted(seldom, folder, 2)
    interrupted(seldom, folder, 1)
    crashed(seldom, folder, 2)
    assert Ledger(folder).checkpoint_files()[0].name == "round-000000003.npz"
    return run(config, folder)


# ---- the same bytes ----


@pytest.fixture(scope="module")
def references(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[RunConfig, Path, dict[str, bytes]]]:
    """An undisturbed run of each learner, with a checkpoint after every round."""
    done = {}
    for kind in KINDS:
        folder = tmp_path_factory.mktemp(kind)
        config = config_for(folder, learner_section(kind))
        done[kind] = config, folder / "run", run(config, folder / "run")
    return done


@pytest.mark.parametrize("kind", KINDS)
def test_runs_do_what_they_say(kind: str, references: Any) -> None:
    config, folder, _ = references[kind]
    ledger = Ledger(folder)
    iterations = [row for row in ledger.rows() if row["kind"] == "iteration"]
    assert ledger.status().state == "done"
    assert iterations[-1]["steps"] == ROUNDS * N_STEPS
    steps = sum(row["gradient_steps"] for row in iterations)
    if kind in ("dqn", "sac", "td3"):
        # learning_starts = 70 is behind the first round's 64 steps.
        expected = (ROUNDS - 1) * N_STEPS * LEARNERS[kind]["gradient_steps_per_step"]
        assert iterations[0]["gradient_steps"] == 0
    else:
        expected = {"ppo": 2 * 2, "a2c": 1, "trpo": 2 * 2, "recurrent_ppo": 2 * 3}[kind] * ROUNDS
    assert steps == expected
    if kind == "sac":
        log_alphas = [row["learner"]["log_alpha"] for row in iterations if row["gradient_steps"]]
        assert all(-0.2 < one < 0.0 for one in log_alphas)  # it starts at 0 and entropy is larger than its target
        assert log_alphas == sorted(log_alphas, reverse=True)
    blueprint = Blueprint.of(config)
    learner = blueprint.learner()
    checkpoint = decode_checkpoint(ledger.checkpoint_files()[0].read_bytes())
    learner.load(
        {name.removeprefix("learner/"): array for name, array in checkpoint.arrays.items()}, checkpoint.data["learner"]
    )
    observations = np.random.default_rng(0).uniform(-1.0, 1.0, size=(9, 2)).astype(np.float32)
    for policy in (policy_of(ledger, blueprint.spec), learner.policy(ROUNDS)):
        assert isinstance(policy, RecurrentTorchPolicy if kind == "recurrent_ppo" else MlpPolicy)
        np.testing.assert_array_equal(policy.outputs(observations), learner.policy(0).outputs(observations))
        np.testing.assert_array_equal(policy.values(observations), learner.policy(0).values(observations))


@pytest.mark.parametrize("kind", KINDS)
def test_stopped_crashed_and_resumed_a_run_is_the_same(kind: str, references: Any, tmp_path: Path) -> None:
    config, _, expected = references[kind]
    assert resumed(config, tmp_path / "run") == expected


@pytest.mark.parametrize("kind", KINDS)
def test_another_seed_is_another_run(kind: str, references: Any, tmp_path: Path) -> None:
    config, _, expected = references[kind]
    for name, content in run(config.model_copy(update={"seed": 1}), tmp_path / "run").items():
        assert content != expected[name] or name == "model.json", name


@pytest.mark.ray
@pytest.mark.usefixtures("one_ray")
@pytest.mark.parametrize(  # on-policy learners and off-policy ones meet every number; starting an actor takes seconds
    ("kind", "workers"),
    [
        ("ppo", 1),
        ("ppo", 4),
        ("a2c", 2),
        ("trpo", 1),
        ("recurrent_ppo", 1),
        ("recurrent_ppo", 4),
        ("dqn", 2),
        ("sac", 4),
        ("td3", 1),
    ],
)
def test_the_number_of_workers_changes_no_byte(kind: str, workers: int, references: Any, tmp_path: Path) -> None:
    config, _, expected = references[kind]
    there = config.model_copy(update={"resources": config.resources.model_copy(update={"workers": workers})})
    assert run(there, tmp_path / "run") == expected


# ---- replay buffers in the run's folder ----


def segments_named(folder: Path) -> list[set[str]]:
    """Of each checkpoint, newest first: the names of its pieces of the replay buffer."""
    files = Ledger(folder).checkpoint_files()
    return [{segment.name for segment in decode_checkpoint(file.read_bytes()).segments} for file in files]


def test_only_pieces_that_a_checkpoint_names_are_kept(references: Any) -> None:
    _, folder, _ = references["dqn"]
    named = segments_named(folder)
    # 150 transitions are those of the last four rounds, a part of the first of them; each checkpoint's own.
    assert named[-1] == {f"{first:012d}-{first + 40:012d}.npz" for first in (40, 80, 120, 160)}
    assert named[0] == {f"{first:012d}-{first + 40:012d}.npz" for first in (80, 120, 160, 200)}
    assert {file.name for file in Ledger(folder).replay.iterdir()} == set.union(*named), "a checkpoint lacks a piece"
    assert not Ledger(references["ppo"][1]).replay.exists()


def test_pieces_that_a_crash_left_behind_go_with_the_next_commit(references: Any, tmp_path: Path) -> None:
    config = references["dqn"][0]
    interrupted(config, tmp_path / "run", 3)
    stray = Ledger(tmp_path / "run").replay / "000000000192-000000000200.npz"
    stray.write_bytes(b"torn")
    assert run(config, tmp_path / "run") == references["dqn"][2]
    assert not stray.exists()


def damaged(content: bytes) -> bytes:
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


@pytest.mark.parametrize("how", ["changed", "torn", "gone"])
def test_a_damaged_piece_means_the_checkpoint_before(how: str, references: Any, tmp_path: Path) -> None:
    config, _, expected = references["sac"]
    folder = tmp_path / "run"
    interrupted(config, folder, 4)
    newest, older = segments_named(folder)
    (last,) = newest - older
    path = Ledger(folder).replay / last
    content = path.read_bytes()
    if how == "gone":
        path.unlink()
    else:
        path.write_bytes(damaged(content) if how == "changed" else content[:100])
    rounds: list[int] = []
    launch(config, folder, resume=True, stop=StopRequests(), observe=lambda progress: rounds.append(progress.steps))
    assert rounds[0] == 4 * N_STEPS  # the fourth round once more
    assert results(folder) == expected


@pytest.mark.parametrize("how", ["changed", "gone"])
def test_a_damaged_piece_of_every_checkpoint_is_refused(how: str, references: Any, tmp_path: Path) -> None:
    config, _, _ = references["td3"]
    folder = tmp_path / "run"
    interrupted(config, folder, 4)
    newest, older = segments_named(folder)
    path = Ledger(folder).replay / min(newest & older)
    content = path.read_bytes()
    if how == "gone":
        path.unlink()
    else:
        path.write_bytes(damaged(content))
    before = {name: (folder / name).read_bytes() for name in (METRICS, CURRICULUM)}
    for _ in range(2):  # and stays refused
        with pytest.raises(LedgerError, match=r"no checkpoint is intact.*00000000"):
            launch(config, folder, resume=True, stop=StopRequests())
    assert {name: (folder / name).read_bytes() for name in before} == before
    path.write_bytes(content)  # nothing was changed: once the piece is back, so is the run
    assert run(config, folder) == references["td3"][2]


def test_a_restored_learner_has_the_whole_buffer(references: Any) -> None:
    config, folder, _ = references["dqn"]
    ledger = Ledger(folder)
    checkpoint = decode_checkpoint(ledger.checkpoint_files()[0].read_bytes())
    learner = Blueprint.of(config).learner()
    for segment in checkpoint.segments:
        with np.load(ledger.replay / segment.name) as file:
            learner.remember(dict(file), segment.first)
    buffer = learner.model.replay_buffer
    assert (learner.seen, buffer.pos, buffer.full) == (ROUNDS * N_STEPS, ROUNDS * N_STEPS % 150, True)
    # Every transition is one of the line's.
    expected = np.clip(buffer.observations[:, 0, 0] + 0.25 * (buffer.actions[:, 0, 0] - 1.0), -1.0, 1.0)
    np.testing.assert_allclose(buffer.next_observations[:, 0, 0], expected, atol=1e-6)
    np.testing.assert_array_equal(buffer.next_observations[..., 1], buffer.observations[..., 1])
    reward = 1.0 - np.abs(buffer.next_observations[..., 0] - buffer.observations[..., 1])
    np.testing.assert_allclose(buffer.rewards, reward, atol=1e-6)
    np.testing.assert_array_equal(buffer.dones, buffer.timeouts)


# ---- learning ----

# As in test_learner, which has PPO and TRPO: who does not look at the target earns 2 in an episode, who goes there
# straight 7.2. Untrained argmaxes of Q depend on the target too: 4.3 with seed 0.
THRESHOLD = 6.0
REPLAYED = {
    "n_steps": 64, "gamma": 0.8, "net_arch": [32], "batch_size": 64, "buffer_size": 4000, "learning_starts": 128,
    "gradient_steps_per_step": 0.25, "tau": 0.05,
}  # fmt: skip
# Returns of seeds 0 to 5 at the end: A2C 6.9 to 7.4, DQN 6.7 to 7.2, SAC 6.9 to 7.2, TD3 6.5 to 7.3.
LEARNING: dict[str, tuple[int, dict[str, Any]]] = {
    "a2c": (16_384, {"n_steps": 64, "learning_rate": 1e-2, "normalize_advantage": True, "gae_lambda": 0.95,
                     "gamma": 0.8, "net_arch": [16]}),
    "dqn": (4096, REPLAYED | {"learning_rate": 5e-3, "batch_size": 32, "tau": 1.0, "target_update_interval": 64,
                              "exploration_fraction": 0.5}),
    "sac": (2048, REPLAYED | {"learning_rate": 1e-2}),
    "td3": (3072, REPLAYED | {"learning_rate": 5e-3, "action_noise_std": 0.3}),
}  # fmt: skip


def learnt(kind: str, folder: Path, **changes: Any) -> float:
    """Mean return on both training instances at the end of a run under SPaCE, whose set must have grown."""
    steps, settings = LEARNING[kind]
    config = config_for(
        folder, {"kind": kind, **settings, **changes}, rollout={"shards": 2, "slots": 4}, budget={"steps": steps},
        evaluation={"every_steps": steps}, checkpoint={"every_rounds": 1000},
    )  # fmt: skip
    (folder / "train.csv").write_text("id,target\n0,-0.75\n1,0.75\n")
    run(config, folder / "run")
    told = Ledger(folder / "run").rows()
    assert told[-1]["steps"] == steps
    assert next(row for row in reversed(told) if row.get("complete"))["curriculum"]["size"] == 2
    return float(next(row for row in reversed(told) if row["kind"] == "evaluation")["train"]["return"])


@pytest.mark.parametrize("kind", LEARNING)
def test_space_learns_a_tiny_environment(kind: str, tmp_path: Path) -> None:
    assert learnt(kind, tmp_path / "learning") >= THRESHOLD
    assert learnt(kind, tmp_path / "frozen", learning_rate=1e-12) < THRESHOLD - 1.0


# ---- policies through torch ----

TORCH = {
    "ppo-image": ("ppo", "CnnPolicy", IMAGE, {}, False),
    "ppo-image-and-context": ("ppo", "MultiInputPolicy", IMAGE, {}, True),
    "dqn-image": ("dqn", "CnnPolicy", IMAGE, {}, False),
    "ppo-dict": ("ppo", "MultiInputPolicy", PARTS, {}, True),
    "recurrent-image": ("recurrent_ppo", "CnnLstmPolicy", IMAGE, {}, False),
    "recurrent-dict": ("recurrent_ppo", "MultiInputLstmPolicy", PARTS, {}, True),
    "trpo-dict": ("trpo", "MultiInputPolicy", PARTS, {"discrete": True}, False),
    "dqn-dict": ("dqn", "MultiInputPolicy", PARTS, {"discrete": True}, True),
    "sac-dict": ("sac", "MultiInputPolicy", PARTS, {}, False),
    "td3-image": ("td3", "CnnPolicy", IMAGE, {"discrete": False}, False),
}


def torch_config(name: str, folder: Path, **changes: Any) -> RunConfig:
    kind, policy, env_id, kwargs, visible = TORCH[name]
    few = {"gradient_steps_per_step": 0.05, "batch_size": 8} if kind in ("dqn", "sac", "td3") else {}
    n_steps = 16
    learner = learner_section(kind, policy=policy, **few, **changes) | {"n_steps": n_steps}
    if few:
        learner |= {"learning_starts": 20, "buffer_size": 40}
    # A picture or a part shows the target even where the context is hidden: SPaCE may rank by it.
    return config_for(
        folder, learner, env={"id": env_id, "kwargs": kwargs, "context_visible": visible},
        curriculum={"kind": "space"},
        rollout={"shards": 2, "slots": 2}, budget={"steps": ROUNDS * n_steps}, evaluation={"every_steps": 40},
    )  # fmt: skip


@pytest.mark.parametrize("name", TORCH)
def test_policies_through_torch_train_and_resume(name: str, tmp_path: Path) -> None:
    config = torch_config(name, tmp_path)
    expected = run(config, tmp_path / "reference")
    iterations = [row for row in Ledger(tmp_path / "reference").rows() if row["kind"] == "iteration"]
    assert sum(row["gradient_steps"] for row in iterations) > 0
    assert resumed(config, tmp_path / "run") == expected
    blueprint = Blueprint.of(config)
    assert isinstance(policy_of(Ledger(tmp_path / "run"), blueprint.spec), TorchPolicy)
    # The model's arrays are torch's state.
    with np.load(tmp_path / "run" / "model.npz") as file:
        weights = {key: torch.as_tensor(file[key]) for key in file.files}
    blueprint.learner().model.policy.load_state_dict(weights)
    assert json.loads((tmp_path / "run" / "model.json").read_bytes())["policy"] == "torch"


@pytest.mark.ray
@pytest.mark.usefixtures("one_ray")
@pytest.mark.parametrize("what", ["torch", "normalised"])
def test_policies_of_other_kinds_on_ray(what: str, tmp_path: Path) -> None:
    normalised = config_for(tmp_path, learner_section("ppo", **NORMALISED))
    config = torch_config("ppo-dict", tmp_path) if what == "torch" else normalised
    expected = run(config, tmp_path / "reference")
    there = config.model_copy(update={"resources": config.resources.model_copy(update={"workers": 2})})
    assert run(there, tmp_path / "run") == expected


@pytest.mark.parametrize("name", TORCH)
def test_policies_through_torch_are_stable_baselines3s(name: str, tmp_path: Path) -> None:
    config = torch_config(name, tmp_path)
    learner = Blueprint.of(config).learner()
    kind, network = TORCH[name][0], learner.model.policy
    policy = learner.policy(3)
    assert isinstance(policy, TorchPolicy)
    assert policy.version == 3
    observations = samples(learner.model.observation_space, 20)
    told, values = policy.head.executed(policy.head.best(policy.outputs(observations))), policy.values(observations)
    expected, _ = network.predict(observations, deterministic=True)
    np.testing.assert_allclose(told, expected, rtol=1e-5, atol=1e-6)
    assert len(told) == rows(observations) == 20
    with torch.no_grad():
        inputs, _ = network.obs_to_tensor(observations)
        if kind == "recurrent_ppo":
            nothing = torch.zeros(1, 20, 8)
            worth = network.predict_values(inputs, (nothing, nothing), torch.zeros(20))[:, 0]
        elif kind in ("ppo", "trpo"):
            worth = network.predict_values(inputs)[:, 0]
        elif kind == "dqn":
            worth = network.q_net(inputs).max(dim=1).values
        else:
            best = network.actor(inputs, deterministic=True) if kind == "sac" else network.actor(inputs)
            worth = torch.cat(network.critic(inputs, best), dim=1).min(dim=1).values
    np.testing.assert_allclose(values, worth, rtol=1e-5, atol=1e-5)
    assert np.ptp(values) > 0
    # It is a copy: what the learner does next does not reach those who act.
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(2.0)
    np.testing.assert_array_equal(policy.values(observations), values)
    assert (learner.policy(4).values(observations) != values).any()
    np.testing.assert_array_equal(policy.values(observations), values)  # two policies in one process


@pytest.mark.parametrize(
    ("policy", "space"),
    [
        ("CnnPolicy", spaces.Box(-1.0, 1.0, shape=(2,))),
        ("CnnPolicy", spaces.Box(0, 255, shape=(36, 36, 1), dtype=np.uint8)),  # channels last
        ("CnnPolicy", spaces.Box(0, 255, shape=(1, 20, 20), dtype=np.uint8)),
        ("MultiInputPolicy", spaces.Box(-1.0, 1.0, shape=(2,))),
        (f"{__name__}:SACPolicy", spaces.Box(-1.0, 1.0, shape=(2,))),  # another learner's
    ],
    ids=["flat", "channels last", "too small", "no dictionary", "other learner"],
)
def test_policies_that_cannot_take_the_observations_are_refused(policy: str, space: spaces.Box) -> None:
    config = configs.PPOConfig(kind="ppo", policy=policy)
    with pytest.raises(ConfigError, match=r"learner\.policy"):
        make_learner(config, space, spaces.Discrete(2), seed=0, n_slots=1, slot_length=4, total_steps=4)


def samples(space: spaces.Space[Any], count: int) -> Observations:
    random = np.random.default_rng(0)
    if isinstance(space, spaces.Dict):
        return {name: np.asarray(samples(part, count)) for name, part in space.items()}
    assert isinstance(space, spaces.Box)
    if space.dtype == np.uint8:
        return random.integers(0, 256, size=(count, *space.shape), dtype=np.uint8)
    return random.uniform(-1.0, 1.0, size=(count, *space.shape)).astype(np.float32)


# ---- rounds of episodes ----


def test_rounds_of_one_episode_and_a_budget_of_episodes(tmp_path: Path) -> None:
    # Instances live 1, 2, 3 and 5 steps (the last until the horizon), once each and in turn, in a seeded order.
    lives = {0: 1, 1: 2, 2: 3, 3: 5}
    (tmp_path / "train.csv").write_text("id,length\n0,1\n1,2\n2,3\n3,99\n")
    (tmp_path / "test.csv").write_text("id,length\n0,4\n")
    data = {
        "name": "tiny", "env": {"id": "tests.test_rollout:Countdown", "context_visible": False},
        "instances": {name: str(tmp_path / f"{name}.csv") for name in ("train", "test")},
        "curriculum": {"kind": "round_robin"},
        "learner": learner_section("sac", n_episodes=1, learning_starts=3, gradient_steps_per_step=1.0),
        "rollout": {"shards": 1, "slots": 1}, "budget": {"steps": 1000, "episodes": 10},
        "evaluation": {"every_steps": 1000}, "checkpoint": {"every_rounds": 1}, "tracking": {"uri": None},
        "resources": {"workers": 0},
    }  # fmt: skip
    config = configs.parse(data, "test")
    steps: list[int] = []
    launch(config, tmp_path / "run", resume=True, stop=StopRequests(), observe=lambda one: steps.append(one.steps))
    told = Ledger(tmp_path / "run").rows()
    order = Ledger(tmp_path / "run").rows(CURRICULUM)[0]["trained"]
    expected = np.cumsum([lives[order[episode % 4]] for episode in range(10)])
    assert steps == expected.tolist()  # one round is one episode
    iterations = [row for row in told if row["kind"] == "iteration"]
    assert [row["steps"] for row in iterations] == [expected[3], expected[7], expected[9]]  # four rounds are a pass
    assert [row["complete"] for row in iterations] == [True, True, False]
    assert sum(row["episodes"] for row in iterations) == 10
    learnt = sum(after - before for before, after in zip([0, *expected], expected, strict=False) if after > 3)
    assert sum(row["gradient_steps"] for row in iterations) == learnt
    assert Ledger(tmp_path / "run").status().steps == expected[-1]
    again = tmp_path / "again"
    interrupted(config, again, 3)
    crashed(with_checkpoints(config, 20), again, 2)
    assert run(config, again) == results(tmp_path / "run")


def test_a_budget_of_steps_ends_rounds_of_episodes_too(tmp_path: Path) -> None:
    learner = learner_section("dqn", n_episodes=2)
    alone = {"shards": 1, "slots": 1}
    config = config_for(tmp_path, learner, rollout=alone, budget={"steps": 50})
    run(config, tmp_path / "run")
    assert config.n_episodes == 2
    assert Ledger(tmp_path / "run").status().steps == 48  # three rounds of two episodes of 8 steps


# ---- collecting while updating ----


@pytest.mark.parametrize("kind", ["ppo", "trpo", "a2c", "recurrent_ppo"])
def test_rounds_collected_ahead_are_the_same_wherever_and_after_any_interruption(kind: str, tmp_path: Path) -> None:
    curriculum = {"kind": "round_robin"}  # two rounds an iteration
    settings = {"rollout": {"shards": 4, "slots": 2, "overlap": True, "passes": 2.5}, "curriculum": curriculum}
    config = config_for(tmp_path, learner_section(kind), **settings)
    expected = run(config, tmp_path / "reference")
    iterations = [row for row in Ledger(tmp_path / "reference").rows() if row["kind"] == "iteration"]
    assert [row["lagged_steps"] for row in iterations] == [N_STEPS] * 3
    for rounds in range(1, ROUNDS):
        folder = tmp_path / f"run{rounds}"
        (interrupted if rounds % 2 else crashed)(config, folder, rounds)
        assert run(config, folder) == expected, rounds
    plain = config_for(tmp_path, learner_section(kind), **{**settings, "rollout": {"shards": 4, "slots": 2}})
    assert run(plain, tmp_path / "plain")["metrics.jsonl"] != expected["metrics.jsonl"]


def test_old_rounds_are_valued_by_the_weights_that_acted(tmp_path: Path) -> None:
    """After updates on other rounds, values and log-probabilities are still those of the round's own policy."""
    config = config_for(tmp_path, learner_section("ppo"))
    blueprint = Blueprint.of(config)
    setup = blueprint.setup(*blueprint.instances())
    learner, fresh = blueprint.learner(), blueprint.learner()
    worker, selection = Worker(setup), blueprint.curriculum(setup.train, setup.test).start()[1]
    asked: dict[str, Any] = {"steps": 0, "selection_version": 0}
    first = [worker.collect(learner.policy(0), selection, Walk(-1, ()), round=0, shard=k, **asked) for k in range(4)]
    acted = learner.scored()
    learner.update(first, round=0, steps=N_STEPS)
    behind = [worker.collect(fresh.policy(0), selection, Walk(-1, ()), round=1, shard=k, lag=1, **asked)
              for k in range(4)]  # fmt: skip
    with learner._weights(acted):
        lagged = learner.fill(behind)  # type: ignore[attr-defined]
    true = fresh.fill(behind)  # type: ignore[attr-defined]
    for name in ("values", "log_probs", "advantages", "returns"):
        assert np.array_equal(getattr(lagged, name), getattr(true, name)), name
    now = learner.scored()
    learner.update(behind, round=1, steps=2 * N_STEPS, acted=acted)
    assert any(not np.array_equal(now[name], learner.scored()[name]) for name in now)


@pytest.mark.parametrize(
    ("kind", "changes", "words"),
    [("sac", {}, "off-policy"), ("ppo", {"normalize_observations": True}, "normalize_observations"),
     ("ppo", {"engine": "population"}, "engine: single")],
)  # fmt: skip
def test_overlap_is_refused_where_it_cannot_be(kind: str, changes: Any, words: str, tmp_path: Path) -> None:
    engine = changes.pop("engine", "single")
    rollout = {"shards": 4, "slots": 2, "overlap": True}
    with pytest.raises(ConfigError, match=words):
        config_for(tmp_path, learner_section(kind, **changes), rollout=rollout, engine=engine)


@pytest.mark.ray
@pytest.mark.usefixtures("one_ray")
def test_rounds_collected_ahead_by_actors_are_the_same(tmp_path: Path) -> None:
    rollout = {"shards": 4, "slots": 2, "overlap": True, "passes": 2.5}
    config = config_for(tmp_path, learner_section("ppo"), rollout=rollout, curriculum={"kind": "round_robin"})
    there = config.model_copy(update={"resources": config.resources.model_copy(update={"workers": 2})})
    assert run(there, tmp_path / "actors") == run(config, tmp_path / "here")


def test_every_argument_of_stable_baselines3s_classes_has_a_key_or_is_told_why_not() -> None:
    elsewhere = {"self", "env", "seed", "device", "verbose", "stats_window_size", "_init_setup_model"}
    for section in get_args(get_args(configs.LearnerConfig)[0]):
        (kind,) = get_args(section.model_fields["kind"].annotation)
        told = {name for name, kinds in SET_BY_OWN_CLASS.items() if kind in kinds} | {*NOT_HERE}
        for name in inspect.signature(ALGORITHMS[kind].__init__).parameters.keys() - elsewhere:
            assert name in section.model_fields or name in told or configs.what_sb3_calls(name), (kind, name)
