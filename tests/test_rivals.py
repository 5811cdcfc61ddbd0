"""VDS, ALP-GMM, learnability, uniform and manual orders: answers worked out by hand."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats
from sklearn.mixture import GaussianMixture

from space_dist import config as configs
from space_dist.curricula import (
    Curriculum,
    Draws,
    Episodes,
    Feedback,
    Probes,
    Uniform,
)
from space_dist.curricula.alp_gmm import AlpGmm, absolute_progress, component_chances, fit_mixture
from space_dist.curricula.configured import Makers
from space_dist.curricula.draws import effective_size, proportional
from space_dist.curricula.learnability import Learnability, learnable_chances
from space_dist.curricula.procurl import Proximal, scaled, softmax
from space_dist.curricula.vds import ValueDisagreement, disagreement
from space_dist.envs import make_batched
from space_dist.errors import ConfigError
from space_dist.instances import InstanceSet, read_csv
from space_dist.learner import Ensemble, make_learner
from space_dist.rollout import Setup, Shard, Worker
from space_dist.rollout.policy import EnsemblePolicy, Statistics
from space_dist.rollout.walk import Walk
from space_dist.run.building import Blueprint
from space_dist.seeding import Purpose, generator
from tests.two_features import BOUNDS, Generator

ROOT = Path(__file__).resolve().parent.parent
SPACE = ROOT / "configs/pointmass_space.yaml"


def instances(n: int, **columns: Any) -> InstanceSet:
    """n instances with ids 10, 11, ..., whose contexts lie on a diagonal."""
    shares = (np.arange(n) + 0.5) / n
    contexts = BOUNDS.low + shares[:, None] * (BOUNDS.high - BOUNDS.low)
    return InstanceSet(np.arange(10, 10 + n), contexts, BOUNDS.names, columns)


def feedback(
    version: int, indices: Any, contexts: np.ndarray | None = None, *, n: int = 4, returns: Any = 0.0,
    advantages: Any = math.nan, members: Any = None, probes: Probes | None = None, running: Any = (),
) -> Feedback:  # fmt: skip
    m = len(indices)
    broadcast = lambda value, kind=np.float64: np.broadcast_to(value, m).astype(kind)  # noqa: E731
    episodes = Episodes(
        indices=np.array(indices), contexts=np.zeros((m, 2)) if contexts is None else contexts,
        returns=broadcast(returns), discounted_returns=broadcast(0.0), lengths=broadcast(1, np.int64),
        success=broadcast(0.0), start_values=broadcast(0.0),
        advantages=broadcast(advantages), running=np.array(running, dtype=np.int64),
    )  # fmt: skip
    return Feedback(
        version, np.zeros(n), np.ones(n), 1, episodes=episodes, probes=probes,
        ensemble=None if members is None else np.array(members, dtype=np.float64),
    )  # fmt: skip


# ---- draws ----------------------------------------------------------------------------------------------------------


def test_the_head_of_the_draws_is_dealt_to_the_walks_that_use_them_first() -> None:
    dealt = Draws(count=6, walks=2).dealt(np.arange(6))
    assert dealt.tolist() == [0, 2, 4, 1, 3, 5]
    selection = dataclasses.replace(Uniform(instances(4), seed=0, draws=Draws(6, 2)).start()[1], ids=dealt)
    firsts = [Walk(-1, ()).position(selection, shard, 2) for shard in range(2)]
    walked = [dealt[first : first + 3].tolist() for first in firsts]
    assert walked == [[0, 2, 4], [1, 3, 5]]


def test_uniform_draws_every_instance_alike_and_anew() -> None:
    uniform = Uniform(instances(4), seed=0, draws=Draws(4000, 4))
    state, selection = uniform.start()
    assert selection.drawn
    counts = np.bincount(selection.ids - 10)
    assert (np.abs(counts - 1000) < 5 * math.sqrt(4000 * 0.25 * 0.75)).all()
    np.testing.assert_array_equal(selection.contexts, instances(4).contexts[selection.ids - 10])
    later, other, numbers = uniform.step(state, feedback(0, [0, 0, 3]))
    assert not np.array_equal(other.ids, selection.ids)
    assert (later.version, numbers["size"], numbers["effective_size"]) == (1, 2, pytest.approx(4.0))
    assert not np.array_equal(Uniform(instances(4), seed=1, draws=Draws(4000, 4)).start()[1].ids, selection.ids)


def test_chances_in_proportion_and_what_they_spread_over() -> None:
    assert proportional(np.array([1.0, 3.0, 0.0])).tolist() == [0.25, 0.75, 0.0]
    assert proportional(np.array([1e308, 1e308, 1e308, 1e308])).tolist() == [0.25] * 4
    assert proportional(np.array([0.0, 1e-9]), floor=1e-8).tolist() == [0.5, 0.5]
    assert effective_size(np.array([0.5, 0.5, 0.0])) == pytest.approx(2.0)
    assert effective_size(np.array([0.75, 0.25])) == pytest.approx(0.75**-0.75 * 0.25**-0.25)


# ---- VDS ------------------------------------------------------------------------------------------------------------


def test_the_disagreement_of_a_constructed_ensemble() -> None:
    members = np.array([[1.0, 1.0, 1.0], [0.0, 3.0, 6.0], [-1.0, -1.0, 2.0], [5.0, 5.0, 5.0]])
    # Means 1, 3, 0, 5; mean squared deviations 0, (9 + 0 + 9) / 3 = 6, (1 + 1 + 4) / 3 = 2, 0.
    np.testing.assert_allclose(disagreement(members), [0.0, math.sqrt(6.0), math.sqrt(2.0), 0.0])
    vds = ValueDisagreement(instances(4), seed=0, draws=Draws(2000, 4))
    state, selection, numbers = vds.step(vds.start()[0], feedback(0, [0, 1], members=members))
    share = math.sqrt(6.0) / (math.sqrt(6.0) + math.sqrt(2.0))
    np.testing.assert_allclose(state.chances, [0.0, share, 1.0 - share, 0.0])
    assert set(selection.ids) == {11, 12}
    assert abs((selection.ids == 11).mean() - share) < 5 * math.sqrt(share * (1 - share) / 2000)
    assert numbers["largest_disagreement"] == pytest.approx(math.sqrt(6.0))
    agreed, _, _ = vds.step(state, feedback(1, [1], members=np.ones((4, 3))))
    assert agreed.chances.tolist() == [0.25] * 4


def test_members_do_not_see_what_is_hidden_from_them() -> None:
    weights = np.array([[1.0], [10.0], [100.0]], dtype=np.float32)
    members = tuple(((factor * weights, np.zeros(1, dtype=np.float32)),) for factor in (1.0, 2.0))
    observations = np.array([[1.0, 1.0, 1.0], [0.0, 2.0, 3.0]], dtype=np.float32)
    seeing = EnsemblePolicy("tanh", members, np.array([], dtype=np.int64), Statistics(reward_std=2.0))
    assert seeing.values(observations).tolist() == [[222.0, 444.0], [640.0, 1280.0]]
    half_blind = EnsemblePolicy("tanh", members, np.array([2]))
    assert half_blind.values(observations).tolist() == [[11.0, 22.0], [20.0, 40.0]]


def vds_config(*overrides: str) -> configs.RunConfig:
    return configs.load(
        SPACE,
        ["env.id=tests.tiny_env:make", "curriculum={kind: vds, n_batches: 20, batch_size: 64, td_lambda: 0.5}",
         "learner.n_steps=128", "learner.gamma=0.5", "rollout.shards=2", "rollout.slots=2", "budget.steps=512",
         *overrides],
    )  # fmt: skip


def tiny_shards(config: configs.RunConfig, seed: int = 0) -> tuple[Worker, Any, list[Shard]]:
    """A worker, a learner, and a round that they collected on the line of `tests.tiny_env`."""
    line = InstanceSet(np.arange(3), np.array([[-0.5], [0.0], [0.5]]), ("target",))
    test = InstanceSet(np.array([9]), np.array([[0.25]]), ("target",))
    setup: Setup = Blueprint.of(config).setup(line, test)
    spec = setup.spec
    learner = make_learner(
        config.learner, spec.observation_space, spec.action_space, seed=seed, n_slots=4, slot_length=32, total_steps=512
    )
    selection = Uniform(line, seed=0, draws=Draws(64, 2)).start()[1]
    worker = Worker(setup)
    options = {"round": 0, "steps": 0, "selection_version": 0}
    policy = learner.policy(0)
    return worker, learner, [worker.collect(policy, selection, Walk(-1, ()), shard=k, **options) for k in range(2)]


def test_each_member_is_fitted_to_its_own_lambda_returns() -> None:
    config = vds_config()
    worker, _, shards = tiny_shards(config)
    spec = worker._setup.spec
    ensemble = Ensemble(config.curriculum, config.learner, spec.observation_space, ("target",), seed=0)  # type: ignore[arg-type]
    policy = ensemble.policy(Statistics())
    found = ensemble._targets(shards, Statistics()).returns
    shard, expected = shards[0], np.zeros((3, 32, 2))
    for member in range(3):
        values = policy.values(shard.observations.reshape(-1, 2))[:, member].reshape(32, 2)  # type: ignore[union-attr]
        last = policy.values(shard.last_observations)[:, member]
        behind_truncated = iter(policy.values(shard.truncated_observations)[:, member])
        behind = {tuple(place): next(behind_truncated) for place in np.argwhere(shard.truncated)}
        for slot in range(2):
            following = last[slot]
            for time in reversed(range(32)):
                value = last[slot] if time == 31 else values[time + 1, slot]
                target = 0.5 * value + 0.5 * following
                if (time, slot) in behind:
                    target = behind[time, slot]
                following = shard.rewards[time, slot] + 0.5 * target
                expected[member, time, slot] = following
    np.testing.assert_allclose(found[:, :64], expected.reshape(3, -1), atol=1e-5)


def test_an_ensemble_learns_differs_and_is_restored_bit_for_bit() -> None:
    config = vds_config()
    worker, _, shards = tiny_shards(config)
    spec = worker._setup.spec

    def fresh(seed: int = 0) -> Ensemble:
        return Ensemble(config.curriculum, config.learner, spec.observation_space, ("target",), seed=seed)  # type: ignore[arg-type]

    def scored(one: Ensemble) -> np.ndarray:
        return worker.start_values(one.policy(Statistics()), 0)

    one = fresh()
    assert scored(one).shape == (3, 3)
    first = one.update(shards, Statistics(), round=0)
    two = fresh()
    two.load(one.save())
    assert scored(two).tobytes() == scored(one).tobytes()
    losses = [one.update(shards, Statistics(), round=later)["ensemble_loss"] for later in (1, 2, 3)]
    assert [two.update(shards, Statistics(), round=later)["ensemble_loss"] for later in (1, 2, 3)] == losses
    assert losses[-1] < first["ensemble_loss"]
    assert scored(two).tobytes() == scored(one).tobytes()
    assert disagreement(scored(one)).min() > 0.0
    assert scored(fresh(1)).tobytes() != scored(fresh()).tobytes()


@pytest.mark.parametrize("units", [(1,), (8, 1), (1, 1)])
def test_gains_are_those_of_a_layers_place_and_not_of_its_width(units: tuple[int, ...]) -> None:
    """SB3's: the root of two in hidden layers, one of one unit as well, and 1 in the last."""
    config = vds_config()
    learner = config.learner.model_copy(update={"net_arch": units})
    space = Blueprint.of(config).spec.observation_space
    ensemble = Ensemble(config.curriculum, learner, space, ("target",), seed=0)  # type: ignore[arg-type]
    for layers in ensemble.policy(Statistics()).members:
        gains = [np.linalg.norm(weight, ord=2) for weight, _ in layers]  # of an orthogonal matrix
        assert gains == pytest.approx([np.sqrt(2.0)] * len(units) + [1.0], rel=1e-5)


def test_stacked_members_take_the_steps_that_each_would_take_alone() -> None:
    config = vds_config()
    worker, _, shards = tiny_shards(config)
    spec = worker._setup.spec
    ensemble = Ensemble(config.curriculum, config.learner, spec.observation_space, ("target",), seed=0)  # type: ignore[arg-type]
    targets = ensemble._targets(shards, Statistics())
    network = torch.nn.Sequential(
        torch.nn.Linear(2, 64), torch.nn.Tanh(), torch.nn.Linear(64, 64), torch.nn.Tanh(), torch.nn.Linear(64, 1)
    )
    member = 1
    with torch.no_grad():
        for layer, (weight, bias) in zip(network[::2], ensemble.policy(Statistics()).members[member], strict=True):
            layer.weight.copy_(torch.as_tensor(weight.T))
            layer.bias.copy_(torch.as_tensor(bias))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3, eps=1e-5)
    random = generator(0, Purpose.ENSEMBLE_UPDATE, 0)
    for _ in range(20):
        batch = random.choice(128, size=64, replace=False)
        error = network(torch.as_tensor(targets.inputs[batch]))[:, 0] - torch.as_tensor(targets.returns[member, batch])
        optimizer.zero_grad()
        (error**2).mean().backward()
        optimizer.step()
    ensemble.update(shards, Statistics(), round=0)
    with torch.no_grad():
        alone = network(torch.as_tensor(targets.inputs))[:, 0].numpy()
    np.testing.assert_allclose(ensemble.policy(Statistics()).values(targets.inputs)[:, member], alone, atol=2e-4)


def test_what_members_see_does_not_depend_on_the_hidden_part_of_the_context() -> None:
    env = make_batched("space_dist/PointMass-v0", 2, context_visible=True)
    config = configs.load(SPACE, ["curriculum={kind: vds, members_see: [gate_x]}"])
    names = env.context_bounds.names
    ensemble = Ensemble(config.curriculum, config.learner, env.observation_space, names, seed=0)  # type: ignore[arg-type]
    contexts = np.array([[1.0, 2.0, 0.5], [1.0, 7.0, 3.0]])
    one, two = ensemble.policy(Statistics()).values(env.reset(np.arange(2), contexts, np.zeros(2, dtype=np.uint64)))
    assert one.tolist() == two.tolist()
    contexts[1, 0] = 2.0
    one, two = ensemble.policy(Statistics()).values(env.reset(np.arange(2), contexts, np.zeros(2, dtype=np.uint64)))
    assert one.tolist() != two.tolist()


# ---- learnability ---------------------------------------------------------------------------------------------------


def test_learnability_by_hand() -> None:
    ties = np.arange(5, dtype=np.uint64)
    # p = 0, 1/4, 1/2, 3/4, 1: p (1 - p) = 0, 3/16, 4/16, 3/16, 0.
    scores = np.array([0.0, 3 / 16, 4 / 16, 3 / 16, 0.0])
    np.testing.assert_allclose(learnable_chances(scores, ties, 2, 0.5), [0.1, 0.35, 0.35, 0.1, 0.1])
    third = 0.1 + 1 / 6
    np.testing.assert_allclose(learnable_chances(scores, ties, 4, 0.5), [0.1, third, third, third, 0.1])
    np.testing.assert_allclose(learnable_chances(0 * scores, ties, 2, 0.5), [0.2] * 5)


def test_probes_are_counted_per_instance_and_old_rates_stand() -> None:
    sfl = Learnability(
        instances(5), seed=0, draws=Draws(20, 2), top=1, uniform_share=0.5, every=3, candidates=2, episodes=4
    )
    state, _ = sfl.start()
    won = dataclasses.replace(state, succeeded=True)
    asked = [sfl.probes(dataclasses.replace(won, version=version), None) for version in range(7)]
    assert all(one is not None and len(set(one)) == 2 and len(one) == 8 for one in asked)
    assert len({tuple(one) for one in asked if one is not None}) > 1  # other candidates each time
    probes = Probes(np.repeat([1, 3], 4), np.zeros(8), np.full(8, 5), np.array([1, 0, 0, 0, 1, 1, 0, 0], dtype=float))
    state, _, numbers = sfl.step(state, feedback(0, [0], n=5, probes=probes))
    assert state.success.tolist() == [0.0, 0.25, 0.0, 0.5, 0.0]
    np.testing.assert_allclose(state.chances, [0.1, 0.1, 0.1, 0.6, 0.1])
    assert (numbers["probe_steps"], numbers["probed"], numbers["learnable"]) == (40, 2, 2)
    state, _, numbers = sfl.step(state, feedback(1, [0], n=5))
    assert (state.success[3], numbers["probe_steps"]) == (0.5, 0)
    probes = Probes(np.repeat([3, 4], 4), np.zeros(8), np.full(8, 5), np.ones(8))
    state, _, _ = sfl.step(state, feedback(2, [0], n=5, probes=probes))
    assert state.success.tolist() == [0.0, 0.25, 0.0, 1.0, 1.0]
    np.testing.assert_allclose(state.chances, [0.1, 0.6, 0.1, 0.1, 0.1])


def test_the_first_probe_waits_for_the_first_success_and_the_next_for_its_turn() -> None:
    sfl = Learnability(
        instances(3), seed=0, draws=Draws(20, 2), top=1, uniform_share=0.5, every=3, candidates=None, episodes=2
    )
    # Iterations in which a training episode succeeds, and whether the budget has room when a probe is asked for.
    wins = [False, False, True, False, False, False, True, False, False]
    room = [True, True, True, True, True, False, True, True, True]
    state, asked = sfl.start()[0], []
    for version, (win, some) in enumerate(zip(wins, room, strict=True)):
        told = feedback(version, [0, 1], n=3)
        assert told.episodes is not None
        told.episodes.success[0] = float(win)
        indices = sfl.probes(state, told.episodes)
        asked.append(indices is not None)
        if indices is not None and some:
            probes = Probes(indices, np.zeros(6), np.full(6, 5), np.array([1, 0, 0, 0, 0, 0], dtype=float))
            told = dataclasses.replace(told, probes=probes)
        state, _, numbers = sfl.step(state, told)
        assert numbers["probe_steps"] == (30 if told.probes else 0)
    # The first success is in iteration 2. Due again in 5, where there is no room, so in 6; then in 9.
    assert asked == [False, False, True, False, False, True, True, False, False]
    assert (state.due, state.succeeded) == (9, True)
    unknown = feedback(0, [0], n=3)
    assert unknown.episodes is not None
    unknown.episodes.success[:] = np.nan
    assert sfl.probes(sfl.start()[0], unknown.episodes) is None


# ---- ProCuRL --------------------------------------------------------------------------------------------------------


def test_procurl_by_hand() -> None:
    train, draws = instances(5), Draws(20, 2)
    values = np.array([-0.5, 0.0, 0.5, 0.75, 2.0])
    told = dataclasses.replace(feedback(0, [0], n=5), values_after=values, values_before=np.array([0.0, 0, 0, 1, 1]))
    made = Proximal(train, seed=0, draws=draws, beta=math.log(16.0), score="zone", scale="largest", largest=1.0)
    state, selection, numbers = made.step(made.start()[0], told)
    # p = 0, 0, 1/2, 3/4, 1, so 16 to the power of p (1 - p) is 1, 1, 2, 16^(3/16) = 2^(3/4), 1.
    weights = np.array([1.0, 1.0, 2.0, 2.0**0.75, 1.0])
    np.testing.assert_allclose(state.chances, weights / weights.sum())
    assert (numbers["mean_score"], numbers["largest_score"]) == (pytest.approx(7 / 80), 0.25)
    assert len(selection.ids) == 20
    # Of a set from -0.5 to 2: 0, 0.2, 0.4, 0.5, 1.
    np.testing.assert_allclose(scaled(values, "set", 1.0), [0.0, 0.2, 0.4, 0.5, 1.0])
    np.testing.assert_allclose(scaled(values, "largest", 2.0), [0.0, 0.0, 0.25, 0.375, 1.0])
    assert scaled(np.full(3, 0.7), "set", 1.0).tolist() == [0.0] * 3


def test_procurls_control_goes_by_what_values_have_risen() -> None:
    values = np.array([-0.5, 0.0, 0.5, 0.75, 2.0])
    told = dataclasses.replace(feedback(0, [0], n=5), values_after=values, values_before=np.array([0.0, 0, 0, 1, 1]))
    chances = []
    for scale in ("largest", "set"):
        made = Proximal(
            instances(5), seed=0, draws=Draws(20, 2), beta=math.log(4.0), score="improvement", scale=scale, largest=2.0
        )
        chances.append(made.step(made.start()[0], told)[0].chances)
    # They rose by -0.5, 0, 0.5, -0.25 and 1; halved, or from 0 to 1.
    for found, powers in zip(chances, ([-0.25, 0, 0.25, -0.125, 0.5], [0, 1 / 3, 2 / 3, 1 / 6, 1]), strict=True):
        weights = 4.0 ** np.array(powers)
        np.testing.assert_allclose(found, weights / weights.sum())


@pytest.mark.parametrize("scale", ["largest", "set"])
def test_its_control_is_what_its_authors_call_space_alt(scale: Any) -> None:
    """Their rule, decision for decision: weights exp(20 (u - u_before)), u the values over the largest return, or the
    rises themselves from 0 for the least to 1 for the greatest."""
    values = [[0.1, 0.0, -0.2, 0.3, 1.0], [0.2, 0.0, 0.1, 0.1, 1.1], [0.9, 0.4, 0.1, 0.2, 1.0]]
    made = Proximal(instances(5), seed=0, draws=Draws(20, 2), beta=20.0, score="improvement", scale=scale, largest=2.0)
    state, before = made.start()[0], [0.0, 0.05, -0.1, 0.0, 0.5]
    for version, after in enumerate(values):
        told = dataclasses.replace(
            feedback(version, [0], n=5), values_before=np.array(before), values_after=np.array(after)
        )
        state, _, _ = made.step(state, told)
        rises = [(new - old) / 2.0 if scale == "largest" else new - old for new, old in zip(after, before, strict=True)]
        if scale == "set":
            rises = [(rise - min(rises)) / (max(rises) - min(rises)) for rise in rises]
        weights = [math.exp(20.0 * rise) for rise in rises]
        assert state.chances.tolist() == pytest.approx([weight / math.fsum(weights) for weight in weights])
        before = after


def test_large_values_do_not_overflow() -> None:
    assert np.isfinite(softmax(np.array([0.0, 1e5]), 20.0)).all()


# ---- ALP-GMM --------------------------------------------------------------------------------------------------------


def test_absolute_learning_progress_by_hand() -> None:
    contexts = np.array([[0.0, 0.0], [1.0, 1.0], [0.5, 0.5], [0.2, 0.0], [0.9, 0.1], [0.0, 1.0]])
    returns = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    assert absolute_progress(np.array([0.45, 0.5]), 10.0, contexts, returns) == 7.0
    assert absolute_progress(np.array([0.1, 0.0]), 0.0, contexts, returns) == 4.0  # as near as the first, and newer
    played = np.concatenate([contexts, contexts[:1]])
    assert absolute_progress(contexts[0], 9.0, played, np.append(returns, 7.5)) == 1.5  # the last time it was played
    assert absolute_progress(np.array([0.45, 0.5]), 10.0, contexts[:5], returns[:5]) == 0.0  # five are too few


def clusters(count: int) -> np.ndarray:
    """Rows of (context, ALP): `count` clouds, far apart."""
    random = np.random.default_rng(0)
    centres = np.array([[0.1, 0.1, 0.0], [0.9, 0.2, 3.0], [0.5, 0.9, 1.0], [0.1, 0.9, 2.0]])[:count]
    return np.concatenate([centre + 0.02 * random.normal(size=(80, 3)) for centre in centres])


@pytest.mark.parametrize("count", [3, 4])
def test_aic_finds_as_many_components_as_there_are(count: int) -> None:
    rows = clusters(count)
    means, covariances = fit_mixture(rows, 6, seed=0)
    assert means.shape == (count, 3)
    truth = rows.reshape(count, 80, 3)
    for cloud in truth:
        nearest = np.abs(means - cloud.mean(axis=0)).sum(axis=1).argmin()
        np.testing.assert_allclose(means[nearest], cloud.mean(axis=0), atol=1e-6)
        np.testing.assert_allclose(covariances[nearest], np.cov(cloud.T, ddof=0), atol=1e-5)


def test_the_number_of_components_has_the_lowest_aic() -> None:
    """On rows without clear clouds; likelihoods by SciPy."""
    rows = np.random.default_rng(1).random((120, 2)) ** 2
    criteria = {}
    for count in range(2, 8):
        mixture = GaussianMixture(count, random_state=5).fit(rows)
        parts = zip(mixture.weights_, mixture.means_, mixture.covariances_, strict=True)
        likelihood = sum(share * stats.multivariate_normal(mean, spread).pdf(rows) for share, mean, spread in parts)
        parameters = (count - 1) + 2 * count + 3 * count  # shares, means, symmetric 2 x 2 covariances
        criteria[count] = 2 * parameters - 2 * np.log(likelihood).sum()
    assert len(fit_mixture(rows, 7, seed=5)[0]) == min(criteria, key=lambda count: criteria[count])


def test_components_are_drawn_in_proportion_to_their_progress() -> None:
    assert component_chances(np.array([3.0, 1.0, -0.5])).tolist() == [0.75, 0.25, 0.0]
    assert component_chances(np.array([0.0, -1.0])).tolist() == [0.5, 0.5]
    one = AlpGmm(
        instances(10), seed=0, draws=Draws(4000, 4), bounds=BOUNDS, from_set=False, random_share=0.0, fit_rate=20,
        history=50, components=3,
    )  # fmt: skip
    means = np.array([[0.25, 0.25, 3.0], [0.75, 0.75, 1.0]])
    state = dataclasses.replace(one.start()[0], means=means, covariances=np.tile(1e-6 * np.eye(3), (2, 1, 1)))
    contexts = one.selection(state).contexts
    low = np.abs(contexts - [0.5, -5.0]).max(axis=1) < 0.2  # a quarter of the way through the bounds
    high = np.abs(contexts - [1.5, 5.0]).max(axis=1) < 0.2
    assert (low | high).all()
    assert abs(low.mean() - 0.75) < 5 * math.sqrt(0.75 * 0.25 / 4000)
    one = AlpGmm(
        instances(10), seed=0, draws=Draws(4000, 4), bounds=BOUNDS, from_set=True, random_share=0.2, fit_rate=20,
        history=50, components=3,
    )  # fmt: skip
    ids = one.selection(state).ids  # the middles of the instances are 0.05, 0.15, ...: 0.25 and 0.75 are ids 12 and 17
    for instance, share in ((12, 0.8 * 0.75 + 0.02), (17, 0.8 * 0.25 + 0.02), (10, 0.02)):
        assert abs((ids == instance).mean() - share) < 5 * math.sqrt(share * (1 - share) / 4000)


@pytest.mark.parametrize("from_set", [True, False])
def test_the_first_fit_comes_after_fit_rate_finished_episodes(from_set: bool) -> None:
    everyone = instances(10)
    one = AlpGmm(
        everyone, seed=0, draws=Draws(4000, 4), bounds=BOUNDS, from_set=from_set, random_share=0.2, fit_rate=20,
        history=24, components=3,
    )  # fmt: skip
    state, selection = one.start()
    assert set(selection.ids) == (set(range(10, 20)) if from_set else {-1})
    assert (selection.contexts >= BOUNDS.low).all()
    assert (selection.contexts <= BOUNDS.high).all()
    contexts = everyone.contexts[np.tile([0, 9], 8)]
    told = feedback(0, [0] * 15, contexts[:15], n=10, returns=np.arange(15.0))
    state, _, numbers = one.step(state, told)
    assert (numbers["finished_episodes"], numbers["fitted"], len(state.means)) == (15, False, 0)
    # Two contexts in turn. The seventh episode is the first that has more than five before it. Each is compared with
    # the newest of its context, two episodes ago.
    assert state.returns.tolist() == np.arange(15.0).tolist()
    assert state.recent[:, -1].tolist() == [0.0] * 6 + [2.0] * 9
    state, selection, numbers = one.step(state, dataclasses.replace(told, version=1))
    assert (numbers["finished_episodes"], numbers["fitted"]) == (30, True)
    assert len(state.means) >= 2
    assert (len(state.contexts), len(state.recent)) == (24, 20)
    again, start = one.selection(state), one.start()[1]
    assert again.contexts.tolist() == selection.contexts.tolist()
    assert again.contexts.tolist() != start.contexts.tolist()


# ---- manual and reverse orders --------------------------------------------------------------------------------------


def made(curriculum: str, train: InstanceSet, seed: int = 0) -> Curriculum:
    settings = configs.load(SPACE, [f"curriculum={curriculum}"]).curriculum
    return Makers(train, source="train.csv", seed=seed, draws=Draws(20, 2), bounds=BOUNDS, generator=Generator).make(
        settings
    )


def sets(curriculum: Curriculum, values: list[list[float]]) -> list[list[int]]:
    state, selection = curriculum.start()
    trained = [selection.ids.tolist()]
    for before, after in itertools.pairwise(values):
        told = Feedback(state.version, np.array(before), np.array(after), 1)
        state, selection, _ = curriculum.step(state, told)
        trained.append(selection.ids.tolist())
    return trained


def test_a_manual_order_is_grown_lowest_first_or_highest() -> None:
    train = instances(4, effort=np.array([2.5, -1.0, 7.0, 0.0]))
    values = [[0.0] * 4] * 5
    assert sets(made("{kind: manual, column: effort}", train), values) == [
        [11], [11, 13], [11, 13, 10], [11, 13, 10, 12], [11, 13, 10, 12]
    ]  # fmt: skip
    assert sets(made("{kind: manual, column: effort, reverse: true}", train), values)[:3] == [
        [12], [12, 10], [12, 10, 13]
    ]  # fmt: skip
    moving = [[1.0] * 4, [2.0] * 4, [2.0] * 4]
    assert [len(one) for one in sets(made("{kind: manual, column: effort, growth: add}", train), moving)] == [1, 1, 2]


def test_a_manual_order_may_be_a_features() -> None:
    train = instances(4)
    [name] = train.names[:1]
    grown = [sets(made(f"{{kind: manual, column: {name}, reverse: {back}}}", train), [[0.0] * 4] * 4)[3]
             for back in ("false", "true")]  # fmt: skip
    assert grown == [[10, 11, 12, 13], [13, 12, 11, 10]]


def test_reverse_orders_rank_the_other_way_round() -> None:
    values = [[1.0, 1.0, 1.0, 1.0], [1.0, 1.5, 0.5, 1.25], [1.0, 1.5, 0.5, 1.25]]
    forth = sets(made("{kind: space, eta: 1000}", instances(4)), values)[1]
    back = sets(made("{kind: space, eta: 1000, reverse: true}", instances(4)), values)[1]
    assert (forth, back) == ([11, 13], [12, 10])
    start = sets(made("{kind: cspace, growth: schedule}", instances(4)), values)[0][0]
    far = sets(made("{kind: cspace, growth: schedule, reverse: true}", instances(4)), values)[1]
    distances = [abs(one - start) for one in far]
    assert distances == sorted((abs(one - start) for one in range(10, 14)), reverse=True)[:2]


def test_a_column_of_the_csv_is_read_stored_and_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "train.csv"
    path.write_text("effort,id,b,a\n3,7,1.0,0.5\n-1e3,4,2.0,1.5\n")
    found = read_csv(path, BOUNDS, ("effort",))
    assert (found.ids.tolist(), found.columns["effort"].tolist()) == ([4, 7], [-1000.0, 3.0])
    assert found.contexts.tolist() == [[1.5, 2.0], [0.5, 1.0]]
    (tmp_path / "again.csv").write_text(found.to_csv())
    assert read_csv(tmp_path / "again.csv", BOUNDS, ("effort",)) == found
    assert found.subset([1]).columns["effort"].tolist() == [3.0]
    bare = InstanceSet(found.ids, found.contexts, found.names)
    assert bare != found
    assert bare.digest() != found.digest()
    path.write_text("id,b,a\n7,1.0,0.5\n")
    assert read_csv(path, BOUNDS, ("effort",), if_there=True).columns == {}
    with pytest.raises(ConfigError, match="there is no column 'effort', which columns names"):
        read_csv(path, BOUNDS, ("effort",))
    path.write_text("id,b,a,effort\n7,1.0,0.5,much\n")
    with pytest.raises(ConfigError, match="row 2, column 'effort': 'much' is not a number"):
        read_csv(path, BOUNDS, ("effort",))
    with pytest.raises(ConfigError, match="unknown column 'effort'"):
        read_csv(path, BOUNDS)
