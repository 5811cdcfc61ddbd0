"""`learner.update: lean` against Stable-Baselines3's own `train()`."""

from __future__ import annotations

import copy
import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from space_dist import config as configs
from space_dist.errors import ConfigError, Interrupted, SpaceDistError
from space_dist.kernels.ppo import CLIPPED, DIVERGENCE, NORM
from space_dist.learner import lean, make_learner
from space_dist.learner.lean import LeanBuffer
from space_dist.ledger import Ledger
from space_dist.run.building import Blueprint
from space_dist.run.launch import launch
from space_dist.run.training import Progress
from space_dist.system.interrupts import StopRequests
from tests.test_learner import (
    BOX,
    DISCRETE_LINE,
    LINE,
    bits,
    learner_for,
    resumed_to_the_bit,
    shards_of,
    small,
    update,
)

UPDATES = 20


class Casting(BaseFeaturesExtractor):
    """Flat observations in double: makes SB3's policy a double one."""

    def __init__(self, observation_space: spaces.Box) -> None:
        super().__init__(observation_space, features_dim=int(np.prod(observation_space.shape)))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return observations.flatten(1).double()


def doubled(learner: Any) -> Any:
    """The same learner, its networks and optimiser double."""
    policy = learner.model.policy
    casting = Casting(learner.model.observation_space)
    policy.features_extractor = policy.pi_features_extractor = policy.vf_features_extractor = casting
    policy.double()
    return learner


class Seen:
    """The norms before clipping, one entry per minibatch, and the last one's gradient after it in one row."""

    def __init__(self) -> None:
        self.norms: list[float] = []
        self.gradient: NDArray[Any] = np.zeros(0)
        self.stopped = False


@contextmanager
def recorded(learner: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Seen]:
    """What an update clips, be it stock or lean."""
    seen, policy = Seen(), learner.model.policy
    stock_clip, lean_update, lean_keep = torch.nn.utils.clip_grad_norm_, lean.Network.update, lean.Network._keep

    def stock(parameters: Any, largest: float) -> torch.Tensor:
        norm = stock_clip(parameters, largest)
        seen.norms.append(float(norm))
        seen.gradient = np.concatenate([parameter.grad.numpy().ravel() for parameter in policy.parameters()])
        return norm

    def ours(self: Any, *arguments: Any) -> lean.Report:
        report = lean_update(self, *arguments)
        seen.norms.extend(norm for norm in report.recorded[:, NORM] if norm)
        seen.stopped = report.recorded[-1, NORM] == 0.0
        seen.gradient = seen.gradient * min(1.0, learner.model.max_grad_norm / (seen.norms[-1] + 1e-6))
        return report

    def keep(self: Any, layout: Any, parts: Any, steps: int) -> None:
        seen.gradient = np.concatenate([parts[1][layout.places[name]] for name, _ in policy.named_parameters()])
        lean_keep(self, layout, parts, steps)

    with monkeypatch.context() as patched:
        patched.setattr(torch.nn.utils, "clip_grad_norm_", stock)
        patched.setattr(lean.Network, "update", ours)
        patched.setattr(lean.Network, "_keep", keep)
        yield seen


def state(learner: Any) -> dict[str, NDArray[Any]]:
    """Weights and what the optimiser remembers."""
    arrays, _ = learner.save()
    return arrays


def pair(env_id: str, *, double: bool, clip_range_vf: float | None = None, **changes: Any) -> tuple[Any, Any]:
    learners = [learner_for(small(**changes, update=kind), env_id) for kind in ("stock", "lean")]
    for learner in learners:
        learner.model.clip_range_vf = None if clip_range_vf is None else lambda _: clip_range_vf
    assert isinstance(learners[1].model, lean.LeanPPO)
    assert not isinstance(learners[0].model, lean.LeanPPO)
    if double:
        learners = [doubled(learner) for learner in learners]
    return learners[0], learners[1]


def compare(
    stock: Any, ours: Any, env_id: str, monkeypatch: pytest.MonkeyPatch, *, tolerance: float, updates: int = UPDATES
) -> tuple[list[dict[str, float]], list[list[float]]]:
    """The same shards into both, update for update. Returns each update's metrics, and its norms before clipping."""
    told, norms = [], []
    for number in range(updates):
        shards = shards_of(stock, env_id, round=number)
        done, seen = [], []
        for learner in (stock, ours):
            with recorded(learner, monkeypatch) as one:
                done.append(learner.update(shards, round=number, steps=(number + 1) * stock._settings.n_steps))
            seen.append(one)
        assert done[0].gradient_steps == done[1].gradient_steps == len(seen[0].norms)
        assert list(done[0].metrics) == list(done[1].metrics)
        close(list(done[1].metrics.values()), list(done[0].metrics.values()), tolerance, str(list(done[0].metrics)))
        close(done[1].advantages, done[0].advantages, tolerance, "advantages")
        close(seen[1].norms, seen[0].norms, tolerance, "norms")
        if not seen[1].stopped:  # a minibatch that makes no step has no gradient
            close(seen[1].gradient, seen[0].gradient, tolerance, "gradient")
        expected, got = state(stock), state(ours)
        assert got.keys() == expected.keys()
        for name, array in expected.items():
            assert got[name].dtype == array.dtype, name
            close(got[name], array, tolerance, name)
        told.append(done[1].metrics)
        norms.append(seen[1].norms)
    return told, norms


def close(got: Any, expected: Any, tolerance: float, what: str) -> None:
    np.testing.assert_allclose(got, expected, rtol=tolerance, atol=tolerance, err_msg=what)


CASES: dict[str, dict[str, Any]] = {
    "tanh": {},
    "relu": {"activation": "relu", "net_arch": (8, 6), "ent_coef": 0.05, "vf_coef": 0.9},
    "no hidden layer": {"net_arch": ()},
    "stopped by target_kl": {"target_kl": 2e-4, "learning_rate": 1e-3},
    "gradients unclipped": {"max_grad_norm": None, "learning_rate": 1e-3},
    "all clipped": {"max_grad_norm": 0.01, "clip_range": 0.01, "learning_rate": 3e-3},
    "a smaller last minibatch": {"batch_size": 36},
    "a last minibatch of one": {"batch_size": 19},
    "one minibatch": {"batch_size": 1000, "normalize_advantage": False},
    "three odd hidden layers": {"net_arch": (33, 5, 17), "batch_size": 41},
    "wider than one panel": {"net_arch": (40, 72), "activation": "relu", "n_epochs": 1},
    "values clipped": {"clip_range_vf": 0.05, "learning_rate": 3e-3},
    "scaled": {"normalize_observations": True, "normalize_rewards": True, "learning_rate_schedule": "linear"},
}


@pytest.mark.parametrize("env_id", [LINE, DISCRETE_LINE], ids=["gaussian", "categorical"])
@pytest.mark.parametrize("case", CASES)
def test_twenty_updates_equal_stable_baselines3s(case: str, env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    stock, ours = pair(env_id, double=True, **CASES[case])
    told, norms = compare(stock, ours, env_id, monkeypatch, tolerance=1e-5)
    # A case must be what its name says.
    steps = {len(one) for one in norms}
    if case == "stopped by target_kl":
        assert min(steps) < max(steps) == 9
    if case == "gradients unclipped":
        assert max(max(one) for one in norms) > 0.5
    if case == "all clipped":
        assert min(min(one) for one in norms) > 0.01
        assert max(one["clip_fraction"] for one in told) > 0.1


@pytest.mark.parametrize("env_id", [LINE, DISCRETE_LINE], ids=["gaussian", "categorical"])
def test_single_precision_is_as_near_to_double_as_stable_baselines3s(env_id: str) -> None:
    # Adam divides gradients by their size, so where they vanish rounding alone moves weights by up to a learning rate:
    # no fixed tolerance is meaningful, but SB3's own distance from its update in double is.
    changes: dict[str, Any] = {"net_arch": (64, 64), "batch_size": 48}
    stock, ours = pair(env_id, double=False, **changes)
    exact = doubled(learner_for(small(**changes), env_id))
    for number in range(5):
        shards = shards_of(exact, env_id, round=number)
        for learner in (stock, ours, exact):
            learner.update(shards, round=number, steps=(number + 1) * 96)
    truth = vector(exact)
    distances = [np.sqrt(np.mean((vector(learner) - truth) ** 2)) for learner in (stock, ours)]
    assert 0.0 < distances[1] < 2.0 * distances[0] < 1e-4
    moved = np.abs(vector(learner_for(small(**changes), env_id)) - truth)
    assert moved.mean() > 1e-3


def vector(learner: Any) -> NDArray[np.float64]:
    """All weights in a row."""
    return np.concatenate([array.ravel() for array in learner.scored().values()]).astype(np.float64)


@pytest.mark.parametrize("env_id", [LINE, DISCRETE_LINE], ids=["gaussian", "categorical"])
def test_the_policy_that_acted_is_its_own_to_the_bit(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    learner, told = learner_for(small(update="lean", batch_size=19), env_id), []
    lean_update = lean.Network.update

    def watched(self: Any, *arguments: Any) -> lean.Report:
        told.append(lean_update(self, *arguments).recorded)
        return lean.Report(told[-1], 4, 0)

    monkeypatch.setattr(lean.Network, "update", watched)
    update(learner, 0, env_id)
    assert told[0][0, DIVERGENCE] == told[0][0, CLIPPED] == 0.0 < told[0][1, DIVERGENCE]


# ---- what it shares with stock ----


@pytest.mark.parametrize("env_id", [LINE, DISCRETE_LINE], ids=["gaussian", "categorical"])
def test_a_checkpoint_restores_it_bit_for_bit(env_id: str) -> None:
    resumed_to_the_bit(small(update="lean", learning_rate_schedule="linear"), env_id)


def test_it_goes_on_from_whatever_takes_the_place_of_its_tensors() -> None:
    fresh, used = (learner_for(small(update="lean"), LINE) for _ in range(2))
    shards = [shards_of(fresh, LINE, round=number) for number in range(3)]
    for number in range(2):
        fresh.update(shards[number], round=number, steps=(number + 1) * 96)
    for number in range(3):  # other shards, so that other numbers stand where SB3's tensors were
        used.update(shards[2 - number], round=number, steps=(number + 1) * 96)
    used.load(*fresh.save())
    for parameter in used.model.policy.parameters():
        parameter.data = parameter.data.clone()
    saved = state(fresh)
    for learner in (fresh, used):
        learner.update(shards[2], round=2, steps=288)
    ours, theirs = state(used), state(fresh)
    assert ours.keys() == theirs.keys()
    for name, array in theirs.items():
        np.testing.assert_array_equal(ours[name], array, err_msg=name)
        assert not np.array_equal(saved[name], array), name


def saved_and_loaded(model: Any) -> Any:
    file = io.BytesIO()
    model.save(file)
    file.seek(0)
    loaded = type(model).load(file)
    loaded.rollout_buffer = copy.deepcopy(model.rollout_buffer)
    return loaded


COPIES: dict[str, Callable[[Any], Any]] = {
    "itself": lambda model: model,
    "deepcopy": copy.deepcopy,
    "pickled": lambda model: cloudpickle.loads(cloudpickle.dumps(model)),
    "saved": saved_and_loaded,
    "shared": lambda model: model.policy.share_memory() and model,
}


@pytest.mark.parametrize("name", COPIES)
def test_a_copy_learns_as_the_original_does(name: str) -> None:
    """Whose numbers it must not touch."""
    learner = learner_for(small(update="lean"), LINE)
    learner.update(shards_of(learner, LINE), round=0, steps=96)
    model = learner.model
    other = COPIES[name](model)
    before = torch.nn.utils.parameters_to_vector(model.policy.parameters()).detach().clone()
    other.set_logger(model.logger)
    weights = []
    for one in (other, model) if other is not model else (other,):
        torch.testing.assert_close(torch.nn.utils.parameters_to_vector(one.policy.parameters()), before)
        np.random.seed(5)  # noqa: NPY002 - as SB3 draws
        one.rollout_buffer.generator_ready = False
        one.train()
        weights.append(torch.nn.utils.parameters_to_vector(one.policy.parameters()).detach())
    assert not torch.equal(weights[0], before)
    assert torch.equal(weights[0], weights[-1])


@pytest.mark.parametrize("env_id", [LINE, DISCRETE_LINE], ids=["gaussian", "categorical"])
def test_stock_and_lean_go_on_from_each_others_checkpoints(env_id: str) -> None:
    learners = [learner_for(small(update=kind), env_id) for kind in ("stock", "lean")]
    shards = shards_of(learners[0], env_id)
    for learner in learners:
        learner.update(shards, round=0, steps=96)
    saved = [learner.save() for learner in learners]
    assert saved[0][0].keys() == saved[1][0].keys()
    assert saved[0][1] == saved[1][1]
    shapes = [{name: (array.shape, array.dtype) for name, array in arrays.items()} for arrays, _ in saved]
    assert shapes[0] == shapes[1]
    for first, second in (("stock", "lean"), ("lean", "stock")):
        one, other = (doubled(learner_for(small(update=kind), env_id)) for kind in (first, second))
        one.update(shards, round=0, steps=96)
        other.load(*one.save())
        done = [learner.update(shards, round=1, steps=192) for learner in (one, other)]
        assert done[0].gradient_steps == done[1].gradient_steps
        np.testing.assert_allclose(vector(other), vector(one), rtol=1e-9, atol=1e-9)


def test_the_same_round_gives_the_same_bits_and_another_seed_others() -> None:
    shards = shards_of(learner_for(small()))
    learners = [learner_for(small(update="lean")) for _ in range(3)]
    before = torch.get_rng_state()
    for learner, number in zip(learners, (0, 1, 1), strict=True):
        learner.update(shards, round=number, steps=96)
    assert torch.equal(torch.get_rng_state(), before)
    first, second, third = map(bits, learners)
    assert first != second == third


def assert_resumed_to_the_same_bytes(run: configs.RunConfig, tmp_path: Path) -> None:
    """A run of 8 rounds of 128 steps: left alone, and stopped in the third and resumed."""
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    launch(run, whole, resume=False, stop=StopRequests())

    def stop_at_the_third(progress: Progress) -> None:
        if progress.steps == 3 * 128:
            Ledger(parts).stop_file.touch()

    with pytest.raises(Interrupted):
        launch(run, parts, resume=False, stop=StopRequests(), observe=stop_at_the_third)
    assert 0 < Ledger(parts).status().steps < 8 * 128
    launch(run, parts, resume=True, stop=StopRequests())
    for name in ("metrics.jsonl", "curriculum.jsonl", "model.npz"):
        assert (parts / name).read_bytes() == (whole / name).read_bytes(), name


def test_a_run_that_is_stopped_and_resumed_is_the_same_byte_for_byte(tmp_path: Path) -> None:
    for split, targets in (("train", (-0.75, 0.75)), ("test", (-0.7, 0.7))):
        rows = "".join(f"{number},{target}\n" for number, target in enumerate(targets))
        (tmp_path / f"{split}.csv").write_text(f"id,target\n{rows}")
    run = configs.parse(
        {
            "name": "lean", "env": {"id": LINE}, "curriculum": {"kind": "space"},
            "instances": {split: str(tmp_path / f"{split}.csv") for split in ("train", "test")},
            "learner": {"kind": "ppo", "update": "lean", "n_steps": 128, "n_epochs": 2},
            "rollout": {"shards": 2, "slots": 4}, "budget": {"steps": 8 * 128}, "evaluation": {"every_steps": 512},
            "tracking": {"uri": None}, "resources": {"workers": 0},
        },
        "test",
    )  # fmt: skip
    assert_resumed_to_the_same_bytes(run, tmp_path)


@pytest.mark.parametrize("reward", [np.nan, np.inf])
@pytest.mark.parametrize("env_id", [LINE, DISCRETE_LINE], ids=["gaussian", "categorical"])
def test_rewards_that_are_no_numbers_end_as_divergence(env_id: str, reward: float) -> None:
    learner = learner_for(small(update="lean"), env_id)
    first, second = shards_of(learner, env_id)
    second.rewards[5, 1] = reward
    with pytest.raises(SpaceDistError, match="training diverged in update 8"):
        learner.update([first, second], round=7, steps=96)


@pytest.mark.parametrize("rate", [1e30, 1e38])
def test_an_absurd_learning_rate_ends_as_divergence(rate: float) -> None:
    learner = learner_for(small(update="lean", learning_rate=rate))
    with pytest.raises(SpaceDistError, match=r"training diverged in update \d.*learning_rate"):  # noqa: PT012
        for number in range(4):
            update(learner, number)


# ---- config ----

SPACE = Path(__file__).parent.parent / "configs/pointmass_space.yaml"


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (["learner.update=lean", "learner.policy=CnnPolicy"], "learner: update: lean knows MlpPolicy only"),
        (["learner.update=lean", "learner.policy=my.module:Mine"], "knows MlpPolicy only, not my.module:M"),
        (["learner.update=leam"], "learner.update"),
        (["learner.update=lean", "learner.kind=a2c"], "learner.*update"),
    ],
)
def test_what_it_cannot_do_is_refused(overrides: list[str], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        configs.load(SPACE, overrides)


def test_observations_that_are_not_flat_are_refused() -> None:
    images = spaces.Box(0, 255, shape=(3, 36, 36), dtype=np.uint8)
    with pytest.raises(ConfigError, match="MlpPolicy needs flat observations"):
        make_learner(small(update="lean"), images, BOX, seed=0, n_slots=1, slot_length=4, total_steps=4)


def test_a_population_has_an_update_of_its_own() -> None:
    overrides = ["learner.update=lean", "resources.workers=0"]
    with pytest.raises(ConfigError, match=r"learner\.update: lean says nothing with engine: population"):
        configs.load(SPACE, [*overrides, "engine=population"])
    lean, stock = (configs.load(SPACE, [*some, "engine=auto"]) for some in (overrides, ()))
    assert Blueprint.of(lean).config.engine == "single"
    assert Blueprint.of(stock).config.engine == "population"


def test_the_update_is_part_of_what_a_run_is_and_stock_changes_no_identity() -> None:
    plain, stock, ours = (
        configs.identity(configs.load(SPACE, overrides), "train", "test")
        for overrides in ([], ["learner.update=stock"], ["learner.update=lean"])
    )
    assert plain == stock != ours


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_advantages_are_stable_baselines3s_to_the_bit(kind: type) -> None:
    random, space = np.random.default_rng(5), spaces.Box(-1.0, 1.0, (2,))
    stock, ours = (
        made(40, space, space, n_envs=7, gamma=0.97, gae_lambda=0.93) for made in (RolloutBuffer, LeanBuffer)
    )
    rewards, values, ends = random.normal(size=(40, 7)), random.normal(size=(40, 7)), random.random((41, 7)) < 0.2
    rewards[3, 2], rewards[39, 4] = np.inf, np.nan
    last_values = torch.as_tensor(random.normal(size=(7, 1)).astype(kind))
    for buffer in (stock, ours):
        buffer.rewards[:], buffer.values[:], buffer.episode_starts[:] = rewards, values, ends[:-1]
        with np.errstate(invalid="ignore"):
            buffer.compute_returns_and_advantage(last_values, ends[-1])
    np.testing.assert_array_equal(ours.advantages, stock.advantages)
    np.testing.assert_array_equal(ours.returns, stock.returns)
    assert np.isfinite(ours.advantages).any()
