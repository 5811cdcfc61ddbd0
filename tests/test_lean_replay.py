"""`learner.update: lean` of DQN, TD3 and SAC against Stable-Baselines3's own `train()`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist import config as configs
from space_dist import learner as learners
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.learner import lean_replay, make_learner
from space_dist.ledger import Checkpoint, Ledger, decode_checkpoint, encode_checkpoint
from space_dist.rollout import Shard
from space_dist.run.building import Blueprint
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests
from tests.test_lean import Casting, assert_resumed_to_the_same_bytes, close
from tests.test_off_policy import CONFIGS, KINDS, ROUND, SEED, STEPS, Stream, action_space, learn, rounds_of, stream_for

UPDATES = 20  # that learn, after two rounds of random actions


def learner_for(kind: str, *, inputs: int = 3, **changes: Any) -> Any:
    settings: dict[str, Any] = {
        "kind": kind, "n_steps": ROUND, "net_arch": (12, 7), "batch_size": 8, "buffer_size": 256, "learning_starts": 40,
        "gradient_steps_per_step": 0.25, "learning_rate": 3e-3, "gamma": 0.9, "tau": 0.05,
    }  # fmt: skip
    settings |= {"target_update_interval": 30, "tau": 0.5} if kind == "dqn" else {}
    return make_learner(
        CONFIGS[kind](**(settings | changes)), spaces.Box(-5.0, 5.0, (inputs,), np.float32), action_space(kind),
        seed=SEED, n_slots=1, slot_length=ROUND, total_steps=STEPS,
    )  # fmt: skip


def doubled(learner: Any) -> Any:
    """The same learner, its networks and optimisers double."""
    model = learner.model
    for name in ("q_net", "q_net_target", "actor", "actor_target", "critic", "critic_target"):
        if hasattr(model, name):
            getattr(model, name).features_extractor = Casting(model.observation_space)
    model.policy.double()
    if getattr(model, "log_ent_coef", None) is not None:
        model.log_ent_coef.data = model.log_ent_coef.data.double()
    return learner


def pair(kind: str, *, double: bool = True, **changes: Any) -> tuple[Any, Any]:
    stock, ours = (learner_for(kind, update=update, **changes) for update in ("stock", "lean"))
    assert isinstance(ours.model, lean_replay.LEAN[kind])
    assert not isinstance(stock.model, lean_replay.LEAN[kind])
    return (doubled(stock), doubled(ours)) if double else (stock, ours)


def stream_of(kind: str, inputs: int = 3) -> Stream:
    random, stream = np.random.default_rng(8), stream_for(kind)
    seen, following = random.normal(size=(2, STEPS, inputs)).astype(np.float32)
    return dataclasses.replace(stream, observations=seen, following=following)


def rounds_for(kind: str, inputs: int = 3) -> list[list[Shard]]:
    return rounds_of(stream_of(kind, inputs))[: UPDATES + 2]


def compare(stock: Any, ours: Any, rounds: list[list[Shard]], *, tolerance: float) -> list[dict[str, float]]:
    """The same shards into both, update for update. Returns each update's metrics."""
    told = []
    for number, shards in enumerate(rounds):
        expected, got = (learner.update(shards, round=number, steps=(number + 1) * ROUND) for learner in (stock, ours))
        assert got.gradient_steps == expected.gradient_steps
        assert list(got.metrics) == list(expected.metrics)
        close(list(got.metrics.values()), list(expected.metrics.values()), tolerance, str(list(got.metrics)))
        (arrays, data), (ours_arrays, ours_data) = stock.save(), ours.save()
        assert ours_data == data
        assert ours_arrays.keys() == arrays.keys()
        for name, array in arrays.items():
            assert ours_arrays[name].dtype == array.dtype, name
            assert ours_arrays[name].shape == array.shape, name
            close(ours_arrays[name], array, tolerance, name)
        told.append(got.metrics)
    return told


CASES: dict[str, dict[str, Any]] = {
    "relu": {},
    "tanh": {"activation": "tanh"},
    "no hidden layer": {"net_arch": ()},
    "one hidden layer": {"net_arch": (9,)},
    "three odd hidden layers": {"net_arch": (33, 5, 17), "batch_size": 41},
    "wider than one panel": {"net_arch": (40, 72), "activation": "tanh"},
    "batches of one": {"batch_size": 1},
    "large batches": {"batch_size": 150, "net_arch": (20, 20)},
    "actions in two panels": {"inputs": 7, "net_arch": (20, 12)},
    "a wide observation": {"inputs": 37},
    "targets copied": {"tau": 1.0},
    "scaled": {"normalize_observations": True, "normalize_rewards": True, "learning_rate_schedule": "linear"},
}
OWN: dict[str, dict[str, dict[str, Any]]] = {
    "dqn": {
        "gradients unclipped": {"max_grad_norm": None},
        "all clipped": {"max_grad_norm": 0.01},
        "targets at every step": {"target_update_interval": 1, "tau": 0.01},
    },
    "td3": {
        "an actor that never waits": {"policy_delay": 1},
        "an actor that waits": {"policy_delay": 7},
        "no noise": {"target_policy_noise": 0.0},
        "noise cut short": {"target_policy_noise": 0.9, "target_noise_clip": 0.1},
    },
    "sac": {
        "a fixed coefficient": {"ent_coef": 0.2},
        "no entropy": {"ent_coef": 0.0},
        "targets at every third step": {"target_update_interval": 3},
        "certain actions": {"learning_rate": 0.03, "ent_coef": 0.0},
    },
}


@pytest.mark.parametrize(
    ("kind", "case"), [(kind, case) for kind in KINDS for case in (*CASES, *OWN[kind])], ids=lambda value: value
)
def test_twenty_updates_equal_stable_baselines3s(kind: str, case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    changes = (CASES | OWN[kind])[case]
    stock, ours = pair(kind, **changes)
    norms: list[float] = []
    if kind == "dqn":
        clip = torch.nn.utils.clip_grad_norm_
        monkeypatch.setattr(
            torch.nn.utils, "clip_grad_norm_", lambda *given: norms.append(float(found := clip(*given))) or found
        )
    told = compare(stock, ours, rounds_for(kind, changes.get("inputs", 3)), tolerance=1e-5)
    # A case must be what its name says.
    assert ["n_updates" in one for one in told] == [False] * 2 + [True] * UPDATES
    initial = learner_for(kind, **changes).model.policy.state_dict()
    moved = [not torch.equal(tensor.float(), initial[name]) for name, tensor in ours.model.policy.state_dict().items()]
    assert all(moved)
    if case == "all clipped":
        assert min(norms) > 0.01
    if case == "an actor that waits":
        assert {"actor_loss" in one for one in told[2:]} == {True, False}
    if case == "certain actions":
        observed = torch.as_tensor(stream_of(kind).observations)
        with torch.no_grad():
            _, log_std, _ = ours.model.actor.get_action_dist_params(observed)
        assert float(log_std.min()) < -2.0


def test_both_parts_of_hubers_loss_are_stable_baselines3s(monkeypatch: pytest.MonkeyPatch) -> None:
    stock, ours = pair("dqn")
    stream = stream_of("dqn")
    errors: list[torch.Tensor] = []
    loss = torch.nn.functional.smooth_l1_loss
    monkeypatch.setattr(
        torch.nn.functional, "smooth_l1_loss", lambda one, other: errors.append(one - other) or loss(one, other)
    )
    rounds = rounds_of(dataclasses.replace(stream, rewards=2.0 * stream.rewards))[: UPDATES + 2]
    compare(stock, ours, rounds, tolerance=1e-5)
    sizes = torch.cat(errors).detach().abs()
    assert int((sizes > 1.0).sum()) > 100
    assert int((sizes < 1.0).sum()) > 100


def test_deviations_beyond_their_limits_have_no_gradient() -> None:
    """SB3 limits the logarithm of SAC's standard deviation to [-20, 2]; both ends are met."""
    learners = pair("sac", ent_coef=0.1)
    for learner in learners:
        with torch.no_grad():
            learner.model.actor.log_std.bias.copy_(torch.tensor([-25.0, 2.3]))
    compare(*learners, rounds_for("sac"), tolerance=1e-5)
    for learner in learners:
        assert learner.model.actor.log_std.bias[0] == -25.0
        assert learner.model.actor.log_std.bias[1] != 2.3


@pytest.mark.parametrize("kind", KINDS)
def test_the_number_of_samples_that_are_drawn_together_changes_no_bit(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    learners = [learner_for(kind, update="lean", batch_size=24) for _ in range(2)]
    learn(learners[0], rounds_for(kind)[:6])
    monkeypatch.setattr(lean_replay, "_NUMBERS", 24 * 2 * 13)  # two gradient steps, or three
    learn(learners[1], rounds_for(kind)[:6])
    assert bits(learners[0]) == bits(learners[1])


def bits(learner: Any) -> dict[str, bytes]:
    """Weights, targets, and what optimisers remember."""
    return {name: array.tobytes() for name, array in learner.save()[0].items()}


def vector(learner: Any) -> NDArray[np.float64]:
    """All weights in a row."""
    return np.concatenate([array.ravel() for array in learner.scored().values()]).astype(np.float64)


@pytest.mark.parametrize("kind", KINDS)
def test_single_precision_is_as_near_to_double_as_stable_baselines3s(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def same_noise(shape: Any, dtype: torch.dtype, device: Any) -> torch.Tensor:
        return torch.empty(shape, device=device).normal_().to(dtype)  # for double networks torch draws others

    monkeypatch.setattr("torch.distributions.normal._standard_normal", same_noise)
    changes: dict[str, Any] = {"net_arch": (64, 64), "batch_size": 48, "learning_rate": 3e-4}
    stock, ours = pair(kind, double=False, **changes)
    exact = doubled(learner_for(kind, **changes))
    before, rounds = vector(exact), rounds_for(kind)[:8]
    for learner in (stock, ours, exact):
        learn(learner, rounds)
    truth = vector(exact)
    distances = [np.sqrt(np.mean((vector(learner) - truth) ** 2)) for learner in (stock, ours)]
    assert 0.0 < distances[1] < 2.0 * distances[0] < 1e-4
    assert np.abs(before - truth).mean() > 1e-3


# ---- what it shares with stock ----


@pytest.mark.parametrize("kind", KINDS)
def test_a_checkpoint_restores_it_bit_for_bit(kind: str) -> None:
    rounds = rounds_for(kind)
    learner = learner_for(kind, update="lean", learning_rate_schedule="linear")
    learn(learner, rounds[:5])
    stored = encode_checkpoint(Checkpoint(5, *learner.save()))
    remembered, at_the_time = learner.transitions(0), bits(learner)
    updates = learn(learner, rounds[:8], first=5)

    fresh = learner_for(kind, update="lean", learning_rate_schedule="linear")
    learn(fresh, rounds[:3])  # another state than the stored one, in every part
    again = decode_checkpoint(stored)
    fresh.load(again.arrays, again.data)
    fresh.remember(remembered, 0)
    assert bits(fresh) == at_the_time != bits(learner)
    assert learn(fresh, rounds[:8], first=5) == updates
    assert bits(fresh) == bits(learner)


@pytest.mark.parametrize("kind", KINDS)
def test_stock_and_lean_go_on_from_each_others_checkpoints(kind: str) -> None:
    rounds = rounds_for(kind)
    for first, second in (("stock", "lean"), ("lean", "stock")):
        one, other = (doubled(learner_for(kind, update=update)) for update in (first, second))
        learn(one, rounds[:5])
        other.load(*one.save())
        other.remember(one.transitions(0), 0)
        done = [learn(learner, rounds[:8], first=5) for learner in (one, other)]
        assert [update.gradient_steps for update in done[0]] == [update.gradient_steps for update in done[1]]
        np.testing.assert_allclose(vector(other), vector(one), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_round_gives_the_same_bits_and_another_seed_others(kind: str) -> None:
    rounds = rounds_for(kind)
    learners = [learner_for(kind, update="lean") for _ in range(3)]
    before = torch.get_rng_state()
    learners[2]._seed = 5
    for learner in learners:
        learn(learner, rounds[:4])
    assert torch.equal(torch.get_rng_state(), before)
    first, second, third = map(bits, learners)
    assert first == second != third


LINES = {"dqn": "tests.tiny_env:make_discrete", "td3": "tests.tiny_env:make", "sac": "tests.tiny_env:make"}
RESULTS = ("metrics.jsonl", "curriculum.jsonl", "model.npz")


def run_config(kind: str, folder: Path, workers: int = 0) -> configs.RunConfig:
    for split, targets in (("train", (-0.75, 0.75)), ("test", (-0.7, 0.7))):
        rows = "".join(f"{number},{target}\n" for number, target in enumerate(targets))
        (folder / f"{split}.csv").write_text(f"id,target\n{rows}")
    return configs.parse(
        {
            "name": "lean", "env": {"id": LINES[kind]}, "curriculum": {"kind": "space"},
            "instances": {split: str(folder / f"{split}.csv") for split in ("train", "test")},
            "learner": {"kind": kind, "update": "lean", "n_steps": 128, "batch_size": 32, "net_arch": [16, 16],
                        "gradient_steps_per_step": 0.1},
            "rollout": {"shards": 2, "slots": 4}, "budget": {"steps": 8 * 128}, "evaluation": {"every_steps": 512},
            "tracking": {"uri": None}, "resources": {"workers": workers},
        },
        "test",
    )  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_that_is_stopped_and_resumed_is_the_same_byte_for_byte(kind: str, tmp_path: Path) -> None:
    assert_resumed_to_the_same_bytes(run_config(kind, tmp_path), tmp_path)


@pytest.mark.ray
@pytest.mark.usefixtures("one_ray")
@pytest.mark.parametrize("kind", KINDS)
def test_the_number_of_workers_changes_no_byte(kind: str, tmp_path: Path) -> None:
    for workers in (0, 1, 2):
        launch(run_config(kind, tmp_path, workers), tmp_path / str(workers), resume=False, stop=StopRequests())
    for name in RESULTS:
        alone = (tmp_path / "0" / name).read_bytes()
        assert all((tmp_path / str(workers) / name).read_bytes() == alone for workers in (1, 2)), name


@pytest.mark.parametrize("kind", KINDS)
def test_rewards_that_are_no_numbers_end_as_divergence(kind: str) -> None:
    stream = stream_of(kind)
    rounds = rounds_of(dataclasses.replace(stream, rewards=np.full_like(stream.rewards, np.nan)))
    with pytest.raises(SpaceDistError, match="training diverged in update 3"):
        learn(learner_for(kind, update="lean"), rounds)


@pytest.mark.parametrize("kind", KINDS)
def test_an_absurd_learning_rate_ends_as_divergence(kind: str) -> None:
    learner = learner_for(kind, update="lean", learning_rate=1e38)
    with pytest.raises(SpaceDistError, match=r"training diverged in update \d.*learning_rate"):
        learn(learner, rounds_for(kind))


# ---- config ----

CARTPOLE = Path(__file__).parent.parent / "configs/cartpole_dqn_space.yaml"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("policy", ["CnnPolicy", "my.module:Mine"])
def test_other_policies_are_refused(kind: str, policy: str) -> None:
    with pytest.raises(ConfigError, match=f"learner: update: lean knows MlpPolicy only, not {policy}"):
        configs.load(CARTPOLE, [f"learner={{kind: {kind}, policy: '{policy}', update: lean}}"])


def test_images_are_refused() -> None:
    images = spaces.Box(0, 255, shape=(3, 36, 36), dtype=np.uint8)
    with pytest.raises(ConfigError, match="MlpPolicy needs flat observations"):
        make_learner(
            CONFIGS["dqn"](kind="dqn", update="lean"), images, spaces.Discrete(3),
            seed=0, n_slots=1, slot_length=4, total_steps=4,
        )  # fmt: skip


def test_the_update_is_part_of_what_a_run_is_and_stock_changes_no_identity() -> None:
    plain, stock, ours = (
        configs.identity(configs.load(CARTPOLE, overrides), "train", "test")
        for overrides in ([], ["learner.update=stock"], ["learner.update=lean"])
    )
    assert plain == stock != ours


@pytest.mark.parametrize("kind", KINDS)
def test_numba_that_may_not_compile_is_told(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learners, "COMPILES", False)
    stock, ours = (
        configs.load(CARTPOLE, [f"learner={{kind: {kind}, update: {update}}}"]) for update in ("stock", "lean")
    )
    learners.refuse_machine(stock)
    with pytest.raises(ConfigError, match=r"NUMBA_DISABLE_JIT is set .* the update of learner\.update: lean is a comp"):
        learners.refuse_machine(ours)


def test_there_is_no_population_of_it() -> None:
    config = configs.load(CARTPOLE, ["learner.update=lean", "engine=auto"])
    assert Blueprint.of(config).config.engine == "single"
    with pytest.raises(ConfigError, match=r"engine: population learns with learner\.kind: ppo or trpo, not dqn"):
        learners.refuse_population(config.learner, spaces.Box(-1.0, 1.0, (3,)), spaces.Discrete(2))


def test_what_compiled_it_is_part_of_what_a_run_is_compared_by(tmp_path: Path) -> None:
    launch(run_config("dqn", tmp_path), tmp_path / "run", resume=False, stop=StopRequests())
    assert {"numba", "llvmlite"} <= set(Ledger(tmp_path / "run").status().fingerprint)
