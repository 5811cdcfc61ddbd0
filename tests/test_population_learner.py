"""Members of a population against Stable-Baselines3's own updates, and against themselves in other company."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.torch_layers import FlattenExtractor

from space_dist.config import DQNConfig, LearnerConfig
from space_dist.envs import make_batched
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.learner import OnPolicyLearner, Update
from space_dist.learner.population import PopulationLearner, learn_together, refuse, stack_key
from space_dist.learner.stacked import PPO, Adam
from space_dist.ledger import Checkpoint, decode_checkpoint, encode_checkpoint
from space_dist.rollout import Shard
from tests.test_learner import BOX, DISCRETE_LINE, LENGTH, LINE, SLOTS, learner_for, shards_of, small

STEPS = 2 * SLOTS * LENGTH
CUDA = pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device"))
# What may differ between the members of one stack. The third and the last stop some updates early.
OWN: tuple[dict[str, Any], ...] = (
    {},
    {"learning_rate": 1e-3, "learning_rate_schedule": "linear", "clip_range": 0.05, "gamma": 0.8, "gae_lambda": 0.7},
    {"learning_rate": 3e-3, "ent_coef": 0.01, "vf_coef": 1.0, "target_kl": 0.002, "max_grad_norm": None},
    {"normalize_advantage": False, "max_grad_norm": 0.05, "ent_coef": 0.03, "vf_coef": 0.1},
    {"learning_rate": 1e-2, "target_kl": 0.01, "clip_range": 0.4, "max_grad_norm": 5.0},
)


def member(config: LearnerConfig, env_id: str = LINE, *, seed: int = 0, updates: int = 4, **more: Any) -> Any:
    env = make_batched(env_id, 1, context_visible=True)
    return PopulationLearner(
        config, env.observation_space, env.action_space,
        seed=seed, n_slots=2 * SLOTS, slot_length=LENGTH, total_steps=updates * STEPS, **more,
    )  # fmt: skip


class Doubled(FlattenExtractor):
    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return super().forward(observations).double()


def doubled(learner: OnPolicyLearner, env_id: str) -> OnPolicyLearner:
    """Stable-Baselines3's learner, computing in float64 with the same weights."""
    policy = learner.model.policy.double()
    extractor = Doubled(make_batched(env_id, 1, context_visible=True).observation_space)
    policy.features_extractor = policy.pi_features_extractor = policy.vf_features_extractor = extractor
    return learner


def weights(learner: Any) -> dict[str, NDArray[Any]]:
    return {name: tensor.detach().numpy().copy() for name, tensor in learner.model.policy.named_parameters()}


def collected(member: Any, env_id: str, round: int) -> list[Shard]:
    """What a member's weights collect, in float32 as ever."""
    actor = learner_for(member.settings, env_id)
    arrays, data = member.save()
    actor.load({name: array.astype(np.float32) if array.dtype == np.float64 else array
                for name, array in arrays.items()}, data)  # fmt: skip
    return shards_of(actor, env_id, round=round)


class Watched:
    """Gradients before and after clipping, by parameter, of every optimiser step."""

    def __init__(self) -> None:
        self.steps: list[list[dict[str, NDArray[Any]]]] = []

    def theirs(self, monkeypatch: pytest.MonkeyPatch, learner: Any) -> None:
        """Watch Stable-Baselines3."""
        self.steps = []
        clip = torch.nn.utils.clip_grad_norm_

        def gradients() -> dict[str, NDArray[Any]]:
            named = learner.model.policy.named_parameters()
            return {name: parameter.grad.numpy().copy() for name, parameter in named}

        def watch(*arguments: Any) -> Any:
            before = gradients()
            norm = clip(*arguments)
            self.steps.append([before, gradients(), {"norm": norm.numpy().copy()}])
            return norm

        monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", watch)

    def ours(self, monkeypatch: pytest.MonkeyPatch) -> list[list[list[dict[str, NDArray[Any]]]]]:
        """Watch a population: steps by member."""
        steps: list[list[list[dict[str, NDArray[Any]]]]] = [[] for _ in OWN]
        step = PPO.gradient_step

        def watch(self: PPO) -> None:
            stack = self._stack
            before = stack.gradient.clone()
            active = list(self._active)
            step(self)
            for index, mine in enumerate(steps):
                if active[index]:
                    one = [
                        {name: stack.parameter(rows, name)[index].cpu().numpy().copy() for name in stack.layout.names}
                        for rows in (before, stack.gradient)
                    ]
                    norm = np.sqrt(sum((array.astype(np.float64) ** 2).sum() for array in one[0].values()))
                    mine.append([*one, {"norm": norm}])

        monkeypatch.setattr(PPO, "gradient_step", watch)
        return steps


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize(
    ("env_id", "activation", "net_arch", "kernel"),
    [(LINE, "tanh", (16, 8), "rows"), (DISCRETE_LINE, "relu", (8,), "together")],
)
def test_every_member_learns_what_stable_baselines3_does(
    env_id: str, activation: str, net_arch: tuple[int, ...], kernel: str, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twenty updates in float64, from the same rollouts. A batch size that leaves a smaller last minibatch."""
    updates = 20
    if kernel == "together":
        monkeypatch.setattr(Adam, "_row_by_row", Adam._together)  # what devices other than the CPU use
    configs = [small(activation=activation, net_arch=net_arch, batch_size=40, **own) for own in OWN]
    more = {"dtype": torch.float64, "device": device, "updates": updates}
    members = [member(config, env_id, seed=seed, **more) for seed, config in enumerate(configs)]
    references = [
        doubled(learner_for(config, env_id, seed=seed, updates=updates), env_id) for seed, config in enumerate(configs)
    ]
    stopped = 0
    for number in range(updates):
        rounds = [collected(one, env_id, number) for one in members]
        steps = (number + 1) * STEPS
        with monkeypatch.context() as patched:
            watched = Watched().ours(patched)
            results = learn_together(members, rounds, round=[number] * len(OWN), steps=[steps] * len(OWN))
        for index, (reference, mine) in enumerate(zip(references, members, strict=True)):
            theirs = Watched()
            with monkeypatch.context() as patched:
                theirs.theirs(patched, reference)
                expected = reference.update(rounds[index], round=number, steps=steps)
            result = results[index]
            assert isinstance(result, Update)
            assert result.gradient_steps == expected.gradient_steps == len(theirs.steps) == len(watched[index])
            stopped += expected.gradient_steps < 9
            assert set(result.metrics) == set(expected.metrics)
            for name, value in expected.metrics.items():
                assert result.metrics[name] == pytest.approx(value, rel=1e-5, abs=1e-5), (name, index, number)
            np.testing.assert_allclose(result.advantages, expected.advantages, rtol=1e-5, atol=1e-5)
            for step, (ours, wanted) in enumerate(zip(watched[index], theirs.steps, strict=True)):
                for part, part_wanted in zip(ours, wanted, strict=True):
                    assert set(part) == set(part_wanted)
                    for name, array in part_wanted.items():
                        np.testing.assert_allclose(
                            part[name], array, rtol=1e-5, atol=1e-5, err_msg=f"{name} {index} {number} {step}"
                        )
            for name, array in weights(reference).items():
                np.testing.assert_allclose(weights(mine)[name], array, rtol=1e-5, atol=1e-5, err_msg=f"{name} {index}")
    assert stopped > 5
    for reference, mine in zip(references, members, strict=True):
        (theirs_saved, theirs_data), (saved, data) = reference.save(), mine.save()
        assert data == theirs_data
        assert {name: (array.shape, array.dtype) for name, array in saved.items()} == {
            name: (array.shape, array.dtype) for name, array in theirs_saved.items()
        }
        for name, array in theirs_saved.items():
            np.testing.assert_allclose(saved[name], array, rtol=1e-5, atol=1e-5, err_msg=name)


# ---- independence ----


def bits(learner: Any) -> dict[str, bytes]:
    arrays, data = learner.save()
    return {name: array.tobytes() for name, array in arrays.items()} | {"data": repr(data).encode()}


def company(env_id: str, net_arch: tuple[int, ...], batch_size: int) -> Iterator[tuple[Any, list[list[Shard]]]]:
    """Twenty members of one shape with what each learns from in two updates; one of them will diverge."""
    for index in range(20):
        own = {"learning_rate": 1e30} if index == 7 else OWN[index % len(OWN)]
        config = small(net_arch=net_arch, batch_size=batch_size, **own)
        learner = member(config, env_id, seed=index)
        yield learner, [shards_of(learner, env_id, round=number) for number in range(2)]


@pytest.mark.parametrize(
    ("env_id", "net_arch", "batch_size"), [(LINE, (8,), 32), (LINE, (13, 7), 23), (DISCRETE_LINE, (5, 16), 32)]
)
def test_companions_decide_nothing(env_id: str, net_arch: tuple[int, ...], batch_size: int) -> None:
    everybody = list(company(env_id, net_arch, batch_size))
    start = [learner.save() for learner, _ in everybody]
    alone: dict[int, Any] = {}

    def learnt(together: Sequence[int]) -> dict[int, Any]:
        found: dict[int, Any] = {index: [] for index in together}
        for index in together:
            everybody[index][0].load(*start[index])
            everybody[index][0].model.policy.optimizer.state.clear()
        for number in range(2):
            learners = [everybody[index][0] for index in together]
            rounds = [everybody[index][1][number] for index in together]
            numbers = [number + index for index in together]  # they need not be equally far
            results = learn_together(learners, rounds, round=numbers, steps=[(n + 1) * STEPS for n in numbers])
            for index, result in zip(together, results, strict=True):
                assert isinstance(result, SpaceDistError) == (index == 7)
                found[index].append(str(result) if isinstance(result, SpaceDistError) else result.metrics)
        return {index: (found[index], bits(everybody[index][0])) for index in together}

    for index in range(5):
        alone |= learnt([index])
    gradient_steps = {index: alone[index][1]["optimizer/policy/0/step"] for index in range(5)}
    assert len(set(gradient_steps.values())) > 1  # some have stopped early
    for together in (
        [0, 1],
        [4, 0],
        [2, 0, 1],
        [3, 2, 1, 0, 4],
        [7, 1],
        [0, 7, 2],
        [*range(5, 18), 0, 3, 2],
        range(20),
    ):
        for index, result in learnt(together).items():
            if index in alone:
                assert result == alone[index], (index, together)


# ---- a member by itself ----


@pytest.mark.parametrize(
    ("env_id", "net_arch", "scaled"),
    [(LINE, (8,), False), (LINE, (), True), (DISCRETE_LINE, (), False), (DISCRETE_LINE, (7, 9, 8), True)],
)
def test_checkpoints_do_not_tell_the_engine(env_id: str, net_arch: tuple[int, ...], scaled: bool) -> None:
    config = small(net_arch=net_arch, normalize_observations=scaled, normalize_rewards=scaled)
    ours, stock = member(config, env_id), learner_for(config, env_id)
    assert bits(ours) == bits(stock)
    for number in range(2):
        shards = shards_of(ours, env_id, round=number)
        done, expected = (one.update(shards, round=number, steps=(number + 1) * STEPS) for one in (ours, stock))
        assert done.metrics.keys() == expected.metrics.keys()
        for name, value in expected.metrics.items():
            assert done.metrics[name] == pytest.approx(value, rel=1e-4, abs=1e-5), name
        np.testing.assert_allclose(done.advantages, expected.advantages, rtol=1e-4)
        assert done.gradient_steps == expected.gradient_steps
    for writer, reader in ((ours, learner_for(config, env_id, seed=5)), (stock, member(config, env_id, seed=5))):
        stored = decode_checkpoint(encode_checkpoint(Checkpoint(2, *writer.save())))
        reader.load(stored.arrays, stored.data)
        assert bits(reader) == bits(writer)
        again = reader.update(shards_of(writer, env_id, round=2), round=2, steps=3 * STEPS)
        assert again.gradient_steps == 9
    told, wanted = ours.policy(2), stock.policy(2)
    for (matrix, bias), (expected_matrix, expected_bias) in zip(told.actor, wanted.actor, strict=True):
        np.testing.assert_allclose(matrix, expected_matrix, atol=1e-5)
        np.testing.assert_allclose(bias, expected_bias, atol=1e-5)


@pytest.mark.parametrize("env_id", [LINE, DISCRETE_LINE])
def test_a_checkpoint_restores_a_member_bit_for_bit(env_id: str) -> None:
    config = small(learning_rate_schedule="linear", normalize_observations=True)
    learner = member(config, env_id)
    rounds = [shards_of(learner, env_id, round=number) for number in range(4)]

    def learn(learner: Any, numbers: Sequence[int]) -> list[Any]:
        return [learner.update(rounds[one], round=one, steps=(one + 1) * STEPS).metrics for one in numbers]

    learn(learner, [0, 1])
    stored = decode_checkpoint(encode_checkpoint(Checkpoint(2, *learner.save())))
    scored = learner.scored()
    metrics = learn(learner, [2, 3])
    assert metrics[1]["learning_rate"] == 0.0
    fresh = member(config, env_id)
    fresh.load(stored.arrays, stored.data)
    assert all(np.array_equal(array, scored[name]) for name, array in fresh.scored().items())
    assert learn(fresh, [2, 3]) == metrics
    assert bits(fresh) == bits(learner)


def test_global_generators_are_left_alone() -> None:
    learner = member(small())
    shards = shards_of(learner)
    before = np.random.get_state()[1].tobytes(), torch.get_rng_state().numpy().tobytes()  # noqa: NPY002
    learner.update(shards, round=0, steps=STEPS)
    assert (np.random.get_state()[1].tobytes(), torch.get_rng_state().numpy().tobytes()) == before  # noqa: NPY002


def test_divergence_is_told_as_stable_baselines3s_is() -> None:
    config = small(learning_rate=1e30)
    ours, stock = member(config), learner_for(config)
    shards = shards_of(ours)
    messages = []
    for learner in (ours, stock):
        with pytest.raises(SpaceDistError, match="training diverged in update 3: the networks are no longer") as caught:
            learner.update(shards, round=2, steps=STEPS)
        messages.append(str(caught.value).partition(" (")[0])
    assert messages[0] == messages[1]


def test_who_can_learn_together() -> None:
    config = small()
    key = stack_key(config, BOX, BOX)
    same = {"learning_rate": 1.0, "clip_range": 0.3, "gamma": 0.1, "target_kl": 1.0, "normalize_rewards": True}
    assert stack_key(small(**same), BOX, BOX) == key
    for changes in ({"n_steps": 48}, {"batch_size": 16}, {"n_epochs": 2}, {"net_arch": (9,)}, {"activation": "relu"}):
        assert stack_key(small(**changes), BOX, BOX) != key
    assert stack_key(config, BOX, spaces.Discrete(2)) != key
    assert stack_key(config, spaces.Box(-1.0, 1.0, shape=(3,)), BOX) != key
    shards = shards_of(member(config))
    with pytest.raises(RuntimeError, match="different shapes"):
        learn_together([member(config), member(small(n_epochs=2))], [shards, shards], round=[0, 0], steps=[96, 96])
    with pytest.raises(RuntimeError, match=r"\[1, 0\]"):
        member(config).update(shards[::-1], round=0, steps=96)


@pytest.mark.parametrize(
    ("config", "observations", "actions", "named"),
    [
        (DQNConfig(kind="dqn"), BOX, spaces.Discrete(2), "learner.kind: ppo"),
        (small(policy="CnnPolicy"), BOX, BOX, "learner.policy: MlpPolicy, not CnnPolicy"),
        (small(), spaces.Dict({"a": BOX}), BOX, "flat observations"),
        (small(), BOX, spaces.MultiDiscrete([2, 2]), "actions"),
    ],
)
def test_what_a_population_cannot_learn(config: Any, observations: Any, actions: Any, named: str) -> None:
    for ask in (refuse, stack_key):
        with pytest.raises(ConfigError, match=f"engine: population .*{named}"):
            ask(config, observations, actions)
