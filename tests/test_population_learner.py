"""Members of a population against Stable-Baselines3's own updates, and against themselves in other company."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
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
from space_dist.learner.stack import Adam, Stack
from space_dist.learner.stacked import PPO, Minibatches
from space_dist.learner.trust_region import TRPO
from space_dist.ledger import Checkpoint, decode_checkpoint, encode_checkpoint
from space_dist.rollout import Shard
from tests.test_learner import BOX, DISCRETE_LINE, LENGTH, LINE, SLOTS, learner_for, shards_of, small

STEPS = 2 * SLOTS * LENGTH
CUDA = pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device"))
Gradients = list[dict[str, NDArray[Any]]]

# What may differ between the members of one stack. Of PPO's, the third and the last stop some updates early; of TRPO's,
# the second finds no step in some. (Many conjugate gradients with little damping amplify the last digit, whoever
# computes them, so there are fewer here than by default.)
OWN: dict[str, tuple[dict[str, Any], ...]] = {
    "ppo": (
        {},
        {"learning_rate": 1e-3, "learning_rate_schedule": "linear", "clip_range": 0.05, "gamma": 0.8,
         "gae_lambda": 0.7},
        {"learning_rate": 3e-3, "ent_coef": 0.01, "vf_coef": 1.0, "target_kl": 5e-4, "max_grad_norm": None},
        {"normalize_advantage": False, "max_grad_norm": 0.05, "ent_coef": 0.03, "vf_coef": 0.1},
        {"learning_rate": 1e-2, "target_kl": 0.005, "clip_range": 0.4, "max_grad_norm": 5.0},
    ),
    "trpo": (
        {"cg_max_steps": 8},
        {"learning_rate_schedule": "linear", "target_kl": 1.0, "line_search_max_iter": 1, "cg_damping": 1.0,
         "gamma": 0.8},
        {"cg_damping": 10.0, "gae_lambda": 0.7, "learning_rate": 3e-3},
        {"cg_max_steps": 3, "line_search_shrinking_factor": 0.5, "normalize_advantage": False},
        {"cg_damping": 0.05, "cg_max_steps": 6, "target_kl": 0.03, "line_search_max_iter": 3},
    ),
}  # fmt: skip


def member(config: LearnerConfig, env_id: str = LINE, *, seed: int = 0, updates: int = 4, **more: Any) -> Any:
    env = make_batched(env_id, 1, context_visible=True)
    return PopulationLearner(
        config, env.observation_space, env.action_space,
        seed=seed, n_slots=2 * SLOTS, slot_length=LENGTH, total_steps=updates * STEPS, **more,
    )  # fmt: skip


def stacked(config: LearnerConfig, env_id: str = LINE, **more: Any) -> Any:
    """A member whose updates are made in a stack, also where there is a faster way."""
    return member(config, env_id, stacked=True, **more)


class Doubled(FlattenExtractor):
    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return super().forward(observations).double()


def doubled(learner: OnPolicyLearner, env_id: str) -> OnPolicyLearner:
    """Stable-Baselines3's learner, computing in float64 with the same weights."""
    policy = learner.model.policy.double()
    extractor = Doubled(make_batched(env_id, 1, context_visible=True).observation_space)
    policy.features_extractor = policy.pi_features_extractor = policy.vf_features_extractor = extractor
    buffer: Any = learner.model.rollout_buffer
    drawn = buffer._get_samples

    def samples(*given: Any) -> Any:  # torch's mse_loss took two types only later than 2.11
        found = drawn(*given)
        return found._replace(returns=found.returns.double())

    buffer._get_samples = samples
    return learner


def weights(learner: Any) -> dict[str, NDArray[Any]]:
    return {name: tensor.detach().numpy().copy() for name, tensor in learner.model.policy.named_parameters()}


def collected(member: Any, env_id: str, round: int) -> list[Shard]:
    """What a member collects with its weights in float32."""
    policy = member.policy(round)
    parts = (policy.actor, *policy.critics)
    actor, critic = (tuple(tuple(array.astype(np.float32) for array in layer) for layer in part) for part in parts)
    head = policy.head
    if head.log_std is not None:
        head = dataclasses.replace(head, log_std=head.log_std.astype(np.float32))
    narrow = dataclasses.replace(policy, actor=actor, critics=(critic,), head=head)
    return shards_of(SimpleNamespace(policy=lambda _: narrow), env_id, round=round)  # type: ignore[arg-type]


def watch_stable_baselines3(learner: Any, patched: pytest.MonkeyPatch) -> Gradients:
    """The gradients of every optimiser step, by parameter; PPO's also before they were clipped, with their norm."""
    steps: Gradients = []
    clip, step, policy = torch.nn.utils.clip_grad_norm_, learner.model.policy.optimizer.step, learner.model.policy

    def gradients(prefix: str) -> dict[str, NDArray[Any]]:
        named = policy.named_parameters()
        return {prefix + name: one.grad.numpy().copy() for name, one in named if one.grad is not None}

    def clipping(*arguments: Any) -> Any:
        steps.append(gradients("before "))
        steps[-1]["norm"] = clip(*arguments).numpy().copy()

    def stepping(*arguments: Any) -> Any:
        if learner._settings.kind == "trpo":
            steps.append({})
        steps[-1] |= gradients("")
        return step(*arguments)

    patched.setattr(torch.nn.utils, "clip_grad_norm_", clipping)
    patched.setattr(policy.optimizer, "step", stepping)
    return steps


def watch_population(members: int, patched: pytest.MonkeyPatch) -> list[Gradients]:
    """The same of each member of a population."""
    steps: list[Gradients] = [[] for _ in range(members)]
    ppo, trpo = PPO.gradient_step, TRPO.critic_step

    def gradients(stack: Stack, member: int, prefix: str) -> dict[str, NDArray[Any]]:
        named = {name: stack.parameter(stack.gradient, name) for name in stack.layout.names}
        return {prefix + name: one[member].cpu().numpy().copy() for name, one in named.items()}

    def watch_ppo(self: PPO) -> None:
        stack, active = self._stack, list(self._active)
        before = [gradients(stack, member, "before ") for member in range(members)]
        ppo(self)
        for member, mine in enumerate(before):
            if active[member]:
                norm = np.sqrt(sum((array**2).sum() for array in mine.values()))
                steps[member].append({**mine, **gradients(stack, member, ""), "norm": norm})

    def watch_trpo(self: TRPO) -> None:
        trpo(self)
        for member in range(members):
            mine = gradients(self._stack, member, "")
            steps[member].append({name: array for name, array in mine.items() if "value" in name})

    patched.setattr(PPO, "gradient_step", watch_ppo)
    patched.setattr(TRPO, "critic_step", watch_trpo)
    return steps


def round_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a population's advantages differ in float32's last digit, as where a GPU sums them in another order."""
    draw, random = Minibatches.draw, torch.Generator().manual_seed(0)

    def drawn(self: Minibatches, places: NDArray[np.int64]) -> None:
        draw(self, places)
        noise = 2.0 * torch.rand(self.pulls.shape, dtype=self.pulls.dtype, generator=random) - 1.0
        self.pulls.mul_(1.0 + 2.0**-24 * noise)

    monkeypatch.setattr(Minibatches, "draw", drawn)


@pytest.mark.parametrize("device", ["cpu", "cpu, rounding otherwise", CUDA])
@pytest.mark.parametrize(
    ("kind", "env_id", "activation", "net_arch", "kernel"),
    [
        ("ppo", LINE, "tanh", (16, 8), "rows"),
        ("ppo", DISCRETE_LINE, "relu", (8,), "together"),
        ("trpo", LINE, "tanh", (8, 16, 16), "together"),
        ("trpo", DISCRETE_LINE, "relu", (16, 8), "rows"),
    ],
)
def test_every_member_learns_what_stable_baselines3_does(
    kind: str, env_id: str, activation: str, net_arch: tuple[int, ...], kernel: str, device: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Twenty updates in float64, from the same rollouts. A batch size that leaves a smaller last minibatch.

    Advantages are float32, as SB3's. Where those round otherwise, members begin each update with SB3's weights: over
    many updates TRPO's conjugate gradients would make much of that digit.
    """
    updates, exact = 20, device == "cpu"
    if device == "cpu, rounding otherwise":
        device = "cpu"
        round_otherwise(monkeypatch)
    if kernel == "together":
        monkeypatch.setattr(Adam, "_row_by_row", Adam._together)  # what devices other than the CPU use
    passes = {"n_epochs": 2} if kind == "ppo" else {"n_critic_updates": 2}
    shared = {"activation": activation, "net_arch": net_arch, "batch_size": 40, **passes}
    configs = [small(kind, **(shared | own)) for own in OWN[kind]]
    more = {"dtype": torch.float64, "device": device, "updates": updates}
    members = [stacked(config, env_id, seed=seed, **more) for seed, config in enumerate(configs)]
    references = [
        doubled(learner_for(config, env_id, seed=seed, updates=updates), env_id) for seed, config in enumerate(configs)
    ]
    least_steps, found = [], []
    for number in range(updates):
        rounds = [collected(one, env_id, number) for one in members]
        reached = (number + 1) * STEPS
        with monkeypatch.context() as patched:
            watched = watch_population(len(members), patched)
            results = learn_together(
                members, rounds, round=[number] * len(members), steps=[reached] * len(members)
            )  # fmt: skip
        for index, (reference, mine, result) in enumerate(zip(references, members, results, strict=True)):
            place = f"member {index}, update {number}"
            with monkeypatch.context() as patched:
                steps = watch_stable_baselines3(reference, patched)
                expected = reference.update(rounds[index], round=number, steps=reached)
            assert isinstance(result, Update), place
            assert result.gradient_steps == expected.gradient_steps == len(steps) == len(watched[index]), place
            assert result.metrics == {
                name: pytest.approx(value, rel=1e-5, abs=1e-5) for name, value in expected.metrics.items()
            }, place
            np.testing.assert_allclose(result.advantages, expected.advantages, rtol=1e-5, atol=1e-5, err_msg=place)
            for ours, theirs in zip([*watched[index], weights(mine)], [*steps, weights(reference)], strict=True):
                assert ours.keys() == theirs.keys()
                for name, array in theirs.items():
                    np.testing.assert_allclose(ours[name], array, rtol=1e-5, atol=1e-5, err_msg=f"{name}, {place}")
            least_steps.append(expected.gradient_steps)
            found.append(expected.metrics.get("is_line_search_success"))
            if not exact:
                mine.load(*reference.save())
    if kind == "ppo":
        assert min(least_steps) < 6 == max(least_steps)  # target_kl has stopped some, and left others alone
    else:
        assert 1.0 in found
        assert env_id != LINE or 0.0 in found  # elsewhere, whether one fails hangs on rounding
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


def company(
    kind: str, env_id: str, net_arch: tuple[int, ...], batch_size: int, way: Any
) -> Iterator[tuple[Any, list[list[Shard]]]]:
    """Twenty members of one shape with what each learns from in two updates; one of them will diverge."""
    for index in range(20):
        own = {"learning_rate": 1e30} if index == 7 else OWN[kind][index % 5]
        config = small(kind, **({"net_arch": net_arch, "batch_size": batch_size} | own))
        learner = way(config, env_id, seed=index)
        yield learner, [shards_of(learner, env_id, round=number) for number in range(2)]


@pytest.mark.parametrize(
    ("kind", "env_id", "net_arch", "batch_size", "way"),
    [
        ("ppo", LINE, (8,), 32, stacked),
        ("ppo", LINE, (13, 7), 23, stacked),
        ("ppo", LINE, (13, 7), 23, member),
        ("ppo", DISCRETE_LINE, (5, 16), 32, stacked),
        ("ppo", DISCRETE_LINE, (5, 16), 32, member),
        ("trpo", LINE, (13, 7), 23, member),
        ("trpo", DISCRETE_LINE, (5, 16), 32, member),
    ],
)
def test_companions_decide_nothing(
    kind: str, env_id: str, net_arch: tuple[int, ...], batch_size: int, way: Any
) -> None:
    everybody = list(company(kind, env_id, net_arch, batch_size, way))
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
                found[index].append(result)
        told = {
            index: [str(one) if isinstance(one, SpaceDistError) else one.metrics for one in found[index]]
            for index in together
        }
        return {index: (told[index], bits(everybody[index][0]), found[index]) for index in together}

    for index in range(5):
        alone |= learnt([index])
    counts = {sum(update.gradient_steps for update in alone[index][2]) for index in range(5)}
    assert (len(counts) > 1) == (kind == "ppo")  # of whom some have stopped early
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
                assert result[:2] == alone[index][:2], (index, together)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize("kind", ["ppo", "trpo"])
def test_companions_decide_little_on_cuda(kind: str) -> None:
    """There kernels may be chosen by the size of a stack: float32 weights may differ by 1e-4 after an update."""
    found = []
    for companions in (0, 1, 14):
        members = [member(small(kind), seed=seed, device="cuda") for seed in range(1 + companions)]
        rounds = [shards_of(one) for one in members]
        results = learn_together(members, rounds, round=[0] * len(members), steps=[STEPS] * len(members))
        assert all(isinstance(result, Update) for result in results)
        found.append(weights(members[0]))
    for other in found[1:]:
        for name, array in found[0].items():
            np.testing.assert_allclose(other[name], array, atol=1e-4, err_msg=name)


@pytest.mark.parametrize("env_id", [LINE, DISCRETE_LINE])
def test_on_a_cpu_ppo_learns_what_a_lean_run_does_to_the_bit(env_id: str) -> None:
    ours, alone = member(small(), env_id), learner_for(small(update="lean"), env_id)
    for number in range(2):
        shards = shards_of(ours, env_id, round=number)
        done, expected = (one.update(shards, round=number, steps=(number + 1) * STEPS) for one in (ours, alone))
        assert done.metrics == expected.metrics
    assert bits(ours) == bits(alone)
    assert member(small("trpo")).stacked
    assert stacked(small()).key != ours.key


# ---- a member by itself ----


@pytest.mark.parametrize(
    ("kind", "env_id", "net_arch", "scaled"),
    [
        ("ppo", LINE, (8,), False),
        ("ppo", LINE, (), True),
        ("ppo", DISCRETE_LINE, (), False),
        ("ppo", DISCRETE_LINE, (7, 9, 8), True),
        ("trpo", LINE, (), False),
        ("trpo", DISCRETE_LINE, (7,), True),
    ],
)
def test_checkpoints_do_not_tell_the_engine(kind: str, env_id: str, net_arch: tuple[int, ...], scaled: bool) -> None:
    config = small(kind, net_arch=net_arch, normalize_observations=scaled, normalize_rewards=scaled)
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
@pytest.mark.parametrize("kind", ["ppo", "trpo"])
def test_a_checkpoint_restores_a_member_bit_for_bit(kind: str, env_id: str) -> None:
    config = small(kind, learning_rate_schedule="linear", normalize_observations=True)
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


@pytest.mark.parametrize("kind", ["ppo", "trpo"])
def test_global_generators_are_left_alone(kind: str) -> None:
    learner = member(small(kind))
    shards = shards_of(learner)
    before = np.random.get_state()[1].tobytes(), torch.get_rng_state().numpy().tobytes()  # noqa: NPY002
    learner.update(shards, round=0, steps=STEPS)
    assert (np.random.get_state()[1].tobytes(), torch.get_rng_state().numpy().tobytes()) == before  # noqa: NPY002


@pytest.mark.filterwarnings("ignore:invalid value encountered")  # by SB3's buffer
@pytest.mark.parametrize("kind", ["ppo", "trpo"])
def test_divergence_is_told_as_stable_baselines3s_is(kind: str) -> None:
    config = small(kind)
    ours, stock = member(config), learner_for(config)
    shards = [dataclasses.replace(shard, rewards=shard.rewards * np.inf) for shard in shards_of(ours)]
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
    assert stack_key(small("trpo"), BOX, BOX) != key
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
        (DQNConfig(kind="dqn"), BOX, spaces.Discrete(2), "learner.kind: ppo or trpo"),
        (small(policy="CnnPolicy"), BOX, BOX, "learner.policy: MlpPolicy, not CnnPolicy"),
        (small(), spaces.Dict({"a": BOX}), BOX, "flat observations"),
        (small(), BOX, spaces.MultiDiscrete([2, 2]), "actions"),
    ],
)
def test_what_a_population_cannot_learn(config: Any, observations: Any, actions: Any, named: str) -> None:
    for ask in (refuse, stack_key):
        with pytest.raises(ConfigError, match=f"engine: population .*{named}"):
            ask(config, observations, actions)
