"""VDS, ALP-GMM, PLR, learnability, uniform and manual orders: answers worked out by hand."""

from __future__ import annotations

import dataclasses
import io
import itertools
import json
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from scipy import stats
from sklearn.mixture import GaussianMixture

from space_dist import config as configs
from space_dist.curricula import (
    Curriculum,
    Draws,
    Episodes,
    Feedback,
    Probes,
    State,
    Uniform,
    decode_state,
    encode_state,
)
from space_dist.curricula.alp_gmm import AlpGmm, MixtureState, absolute_progress, component_chances, fit_mixture
from space_dist.curricula.configured import Makers
from space_dist.curricula.draws import effective_size, proportional
from space_dist.curricula.learnability import Learnability, learnable_chances
from space_dist.curricula.making import make_curriculum
from space_dist.curricula.plr import LevelReplay, ReplayState, replay_chances, replayed
from space_dist.curricula.vds import ValueDisagreement, disagreement
from space_dist.envs import make_batched
from space_dist.errors import ConfigError
from space_dist.instances import InstanceSet, read_csv
from space_dist.learner import Ensemble, make_learner
from space_dist.rollout import Episodes as Table
from space_dist.rollout import Setup, Shard, Worker
from space_dist.rollout.episodes import mean_sizes
from space_dist.rollout.policy import EnsemblePolicy, Statistics
from space_dist.rollout.walk import Walk
from space_dist.run.building import Blueprint, spec_of
from space_dist.run.launch import launch
from space_dist.seeding import Purpose, generator
from space_dist.system.interrupts import StopRequests
from tests.tiny_env import Line
from tests.two_features import BOUNDS, scattered

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


# ---- PLR ------------------------------------------------------------------------------------------------------------


def test_the_chances_of_replay_by_hand() -> None:
    scores, staleness = np.array([3.0, 1.0, 2.0, 9.0]), np.array([0, 3, 1, 7])
    seen, ties = np.array([True, True, True, False]), np.arange(4, dtype=np.uint64)
    # Ranks 1, 3, 2 with beta 1: 1, 1/3, 1/2, whose sum is 11/6; staleness 0, 3, 1, whose sum is 4.
    expected = [0.75 * 6 / 11, 0.75 * 2 / 11 + 0.25 * 3 / 4, 0.75 * 3 / 11 + 0.25 / 4, 0.0]
    np.testing.assert_allclose(replay_chances(scores, staleness, seen, ties, 1.0, 0.25), expected)
    # Beta 1/2: 1, 1/9, 1/4, whose sum is 49/36. Nothing is stale: a third each.
    expected = [0.9 * 36 / 49 + 0.1 / 3, 0.9 * 4 / 49 + 0.1 / 3, 0.9 * 9 / 49 + 0.1 / 3, 0.0]
    np.testing.assert_allclose(replay_chances(scores, 0 * staleness, seen, ties, 0.5, 0.1), expected)
    # Equal scores are ranked by their keys: the third before the first.
    tied = replay_chances(np.ones(4), staleness, seen, ties[::-1].copy(), 1.0, 0.0)
    np.testing.assert_allclose(tied, [2 / 11, 3 / 11, 6 / 11, 0.0])


def test_what_was_never_trained_on_comes_first() -> None:
    plr = LevelReplay(
        instances(5), seed=0, draws=Draws(20, 2), temperature=0.1, staleness_share=0.1, within_update="fixed_chances"
    )
    state, selection = plr.start()
    heads = in_order(selection)
    assert sorted(heads[:5]) == [10, 11, 12, 13, 14]
    trained = heads[:3] - 10
    told = feedback(0, [*trained, trained[0]], n=5, advantages=[1.0, 3.0, 2.0, 2.0])
    state, selection, numbers = plr.step(state, told)
    assert state.scores[trained].tolist() == [1.5, 3.0, 2.0]  # two episodes of the first: their mean
    assert (state.last[trained].tolist(), state.episodes) == ([3, 1, 2], 4)  # the run's episodes, counted from 0
    assert (numbers["seen"], numbers["largest_score"]) == (3, 3.0)
    heads_after = in_order(selection)
    assert heads_after[:2].tolist() == heads[3:5].tolist()  # still unseen, in the same order
    assert set(heads_after[2:]) <= set(heads[:3])
    # Ranks 3, 1, 2, and 0, 2 and 1 episodes since the last: 1 / 10 of 0, 2 / 3 and 1 / 3.
    by_rank = np.array([3.0, 1.0, 2.0]) ** -10.0
    expected = 0.9 * by_rank / by_rank.sum() + 0.1 * np.array([0.0, 2.0, 1.0]) / 3.0
    np.testing.assert_allclose(state.chances[trained], expected)
    state, selection, _ = plr.step(state, feedback(1, [int(trained[0])], n=5, advantages=9.0))
    assert state.scores[trained].tolist() == [9.0, 3.0, 2.0]
    assert state.last[trained].tolist() == [4, 1, 2]
    assert (in_order(selection)[2:] == 10 + trained[0]).mean() > 0.5  # of the one of the highest score, again and again


def in_order(selection: Any, walks: int = 2) -> np.ndarray:
    """The ids of a selection in the order in which `walks` walks use them."""
    return selection.ids.reshape(walks, -1).T.ravel()


def replayed_by_hand(
    scores: list[float], last: list[int], episodes: int, uniform: np.ndarray, beta: float, rho: float
) -> list[int]:
    """Jiang et al.'s rule, episode for episode, over what was not played yet: fractions instead of cumulative sums."""
    last, left, played = list(last), [], []
    for now, (which, point) in enumerate(uniform, start=episodes):
        left = left or list(range(len(scores)))
        ranked = sorted(left, key=lambda one: -scores[one])
        if which < rho:
            weights = [now - 1 - last[one] for one in ranked]
            weights = weights if any(weights) else [1.0] * len(ranked)
        else:
            weights = [(rank + 1) ** (-1.0 / beta) for rank in range(len(ranked))]
        shares = itertools.accumulate(weight / math.fsum(weights) for weight in weights)
        one = next(one for one, below in zip(ranked, shares, strict=True) if point < below)
        left.remove(one)
        last[one] = now
        played.append(one)
    return played


@pytest.mark.parametrize(("beta", "rho"), [(0.1, 0.1), (1.0, 0.3), (0.3, 1.0), (2.0, 0.0)])
def test_draws_without_repetition_are_the_rule_of_each_episode_over_what_is_left(beta: float, rho: float) -> None:
    random = np.random.default_rng(0)
    scores, staleness, uniform = random.random(9), random.permutation(30)[:9], random.random((200, 2))
    ranked = np.argsort(-scores)
    found = replayed(ranked, staleness[ranked], uniform, beta, rho)
    assert found.tolist() == replayed_by_hand(scores.tolist(), (29 - staleness).tolist(), 30, uniform, beta, rho)
    passes = np.append(found, found[:7]).reshape(-1, 9)[:22]  # 22 whole passes, and the rest of the 200
    assert (np.sort(passes, axis=1) == np.arange(9)).all()


def test_the_first_draw_has_the_papers_chances() -> None:
    scores, staleness, count = np.array([3.0, 1.0, 2.0, 9.0]), np.array([0, 3, 1, 7]), 4000
    expected = replay_chances(scores, staleness, np.ones(4, dtype=np.bool_), np.arange(4, dtype=np.uint64), 1.0, 0.25)
    random, ranked = np.random.default_rng(1).random((count, 1, 2)), np.argsort(-scores)
    first = np.concatenate([replayed(ranked, staleness[ranked], one, 1.0, 0.25) for one in random])
    shares = np.bincount(first, minlength=4) / count
    assert (np.abs(shares - expected) < 5 * np.sqrt(expected * (1 - expected) / count)).all()


def test_one_instance_does_not_take_all_episodes_of_an_update_unless_asked_to() -> None:
    scores = np.array([1.0, 5.0, 4.0, 3.0, 2.0])
    spreads = {}
    for rule in ("without_repetition", "fixed_chances"):
        plr = LevelReplay(
            instances(5), seed=0, draws=Draws(20, 2), temperature=0.1, staleness_share=0.1, within_update=rule
        )
        state, _ = plr.start()
        state, selection, numbers = plr.step(state, feedback(0, range(5), n=5, advantages=scores))
        spreads[rule] = numbers["effective_size"]
        drawn = in_order(selection)
        if rule == "without_repetition":
            assert (np.sort(drawn.reshape(4, 5), axis=1) == np.arange(10, 15)).all()
            uniform = generator(0, Purpose.DRAWS, 1).random((20, 2))
            by_hand = replayed_by_hand(scores.tolist(), [0, 1, 2, 3, 4], 5, uniform, 0.1, 0.1)
            assert drawn.tolist() == [10 + one for one in by_hand]
        else:
            assert (drawn == 11).mean() > 0.5
    assert spreads["without_repetition"] == pytest.approx(5.0)
    assert spreads["fixed_chances"] < 3.0
    assert configs.load(SPACE, ["curriculum={kind: plr}"]).curriculum.within_update == "without_repetition"


@pytest.mark.parametrize("rule", ["without_repetition", "fixed_chances"])
def test_what_still_runs_is_not_begun_again(rule: Any) -> None:
    plr = LevelReplay(
        instances(6), seed=0, draws=Draws(12, 2), temperature=0.1, staleness_share=0.1, within_update=rule
    )
    state, selection = plr.start()
    heads = in_order(selection) - 10
    # Of the first four that were begun two have ended, the others run on.
    state, selection, _ = plr.step(state, feedback(0, heads[:2], n=6, advantages=[1.0, 2.0], running=heads[[3, 2, 2]]))
    assert state.running.tolist() == sorted(heads[2:4])
    drawn = in_order(selection) - 10
    assert drawn[:2].tolist() == heads[4:6].tolist()  # unseen, and not running
    assert set(drawn[2:4]) <= set(heads[:2])
    if rule == "without_repetition":
        assert set(drawn[2:4]) == set(heads[:2])  # both before any of those that run
        assert set(drawn[4:8]) == set(heads[:4])  # then all that were begun, anew
    # Of all that were begun everything runs: there is nothing else to draw.
    state, selection, _ = plr.step(state, feedback(1, heads, n=6, advantages=1.0, running=heads))
    assert set(in_order(selection)) <= set(range(10, 16))
    if rule == "without_repetition":
        assert (np.sort(in_order(selection).reshape(2, 6), axis=1) == np.arange(10, 16)).all()


def test_every_instance_is_begun_once_before_any_is_begun_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    """Episodes of 100 steps over rounds of 48 a slot: at any time most of what was begun has not ended."""
    begun, step = [], LevelReplay.step

    def recorded(self: LevelReplay, state: Any, feedback: Feedback) -> Any:
        assert feedback.episodes is not None
        ended = [one for episodes in begun[-1:] for one in episodes[0]] + feedback.episodes.indices.tolist()
        begun.append((ended, feedback.episodes.running.tolist()))
        return step(self, state, feedback)

    monkeypatch.setattr(LevelReplay, "step", recorded)
    config = configs.load(SPACE, [
        "curriculum={kind: plr}", "learner.n_steps=768", "learner.n_epochs=1", "learner.net_arch=[8]",
        "rollout.slots=8", "rollout.shards=2", "budget.steps=12288", "evaluation.every_steps=100000",
        "tracking.uri=null", "resources.workers=0",
    ])  # fmt: skip
    launch(config, tmp_path / "run", resume=False, stop=StopRequests())
    counts = [len(ended) + len(running) for ended, running in begun]
    assert counts[-1] > 100
    for ended, running in begun:
        together = [*ended, *running]
        assert len(together) > 90 or len(set(together)) == len(together)  # the shards do not begin equally many


def test_replay_goes_on_where_no_episode_has_ended_yet() -> None:
    plr = LevelReplay(
        instances(5), seed=0, draws=Draws(40, 4), temperature=0.1, staleness_share=0.1,
        within_update="without_repetition",
    )  # fmt: skip
    state, selection = plr.start()
    after, again, numbers = plr.step(state, feedback(0, np.zeros(0, dtype=np.int64), n=5, advantages=0.0))
    assert (after.version, numbers["seen"], numbers["mean_score"]) == (1, 0, None)
    assert set(again.ids) == set(selection.ids) == set(range(10, 15))


def test_mean_advantages_of_episodes_by_hand() -> None:
    def shard(slots: list[int], times: list[int], lengths: list[int], starts: list[bool]) -> Any:
        whole = (np.array(column, dtype=np.int64) for column in (slots, times, lengths))
        nothing = np.zeros(0)
        slots_, times_, lengths_ = whole
        table = Table(np.zeros(len(slots), dtype=np.int64), np.zeros((0, 1)), slots_, times_, lengths_, *[nothing] * 3)
        return SimpleNamespace(episodes=table, rewards=np.zeros((3, len(starts))), starts=np.array(starts))

    # Slots 0 and 1 are one shard's, slot 2 the other's. Slot 0 goes on with an episode that had 7 in 2 steps, and ends
    # it and another; slot 1 begins one that runs on; slot 2 goes on with one of 10, which ends at the last step.
    sizes = np.array([[1.0, 4.0, 2.0], [3.0, 2.0, 3.0], [5.0, 0.5, 4.0]])
    shards = [shard([0, 0], [0, 2], [3, 2], [False, True]), shard([0], [2], [8], [False])]
    means, later = mean_sizes(shards, sizes, np.array([7.0, 100.0, 10.0]))
    assert means.tolist() == [8.0 / 3, 4.0, 19.0 / 8]
    assert later.tolist() == [0.0, 6.5, 0.0]
    # The next round: nothing ends, slot 1 goes on, the others begin.
    shards = [shard([], [], [], [True, False]), shard([], [], [], [True])]
    means, later = mean_sizes(shards, sizes, later)
    assert (means.tolist(), later.tolist()) == ([], [9.0, 13.0, 9.0])


def test_advantages_are_those_of_generalised_advantage_estimation() -> None:
    config = vds_config("curriculum={kind: plr}", "learner.gae_lambda=0.5")
    _, learner, shards = tiny_shards(config)
    policy, expected = learner.policy(0), []
    for shard in shards:
        length, slots = shard.rewards.shape
        values = policy.values(shard.observations.reshape(-1, 2)).reshape(length, slots)  # type: ignore[union-attr]
        last, truncated = policy.values(shard.last_observations), policy.values(shard.truncated_observations)
        behind = {tuple(place): truncated[index] for index, place in enumerate(np.argwhere(shard.truncated))}
        sizes, advantage = np.zeros((length, slots)), np.zeros(slots)
        for time in reversed(range(length)):
            for slot in range(slots):
                following = last[slot] if time == length - 1 else values[time + 1, slot]
                ended = (time, slot) in behind
                delta = shard.rewards[time, slot] + 0.5 * behind.get((time, slot), following) - values[time, slot]
                advantage[slot] = delta + (0.0 if ended else 0.5 * 0.5 * advantage[slot])
                sizes[time, slot] = abs(advantage[slot])
        expected.append(sizes)
    update = learner.update(shards, round=0, steps=128)
    np.testing.assert_allclose(update.advantages, np.concatenate(expected, axis=1), atol=1e-4)


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
    return Makers(train, source="train.csv", seed=seed, draws=Draws(20, 2), bounds=BOUNDS).make(settings)


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
    with pytest.raises(ConfigError, match="the column 'effort' is missing"):
        read_csv(path, BOUNDS, ("effort",))
    path.write_text("id,b,a,effort\n7,1.0,0.5,much\n")
    with pytest.raises(ConfigError, match="row 2, column 'effort': 'much' is not a number"):
        read_csv(path, BOUNDS, ("effort",))
    with pytest.raises(ConfigError, match="unknown column 'effort'"):
        read_csv(path, BOUNDS)


# ---- all of them ----------------------------------------------------------------------------------------------------

KINDS = {
    "uniform": "{kind: uniform}",
    "spdrl": "{kind: spdrl, warm_up: 0, offset: 0}",
    "spdrl_cg": "{kind: spdrl, warm_up: 0, offset: 0, optimiser: conjugate_gradient}",
    "vds": "{kind: vds}",
    "alp_gmm": "{kind: alp_gmm, fit_rate: 12}",
    "alp_gmm_bounds": "{kind: alp_gmm, fit_rate: 12, over: bounds}",
    "plr": "{kind: plr}",
    "learnability": "{kind: learnability, top: 2, every: 2, episodes: 2}",
    "manual": "{kind: manual, column: effort}",
}


def wide(n: int = 6) -> InstanceSet:
    return scattered(n, effort=np.arange(n, 0.0, -1.0))


def driven(curriculum: Curriculum, train: InstanceSet, steps: int = 4, through: Callable[[State], State] | None = None):
    """(state, selection, numbers) of a made-up history, each state passed `through` something before it is used."""
    state, selection = curriculum.start()
    history: list[Any] = []
    for version in range(steps):
        random = np.random.default_rng(version)
        some = random.choice(len(selection.ids), size=8)
        ids = selection.ids[some]
        indices = np.where(ids < 0, -1, np.searchsorted(train.ids, ids))
        m, n = len(some), len(train)
        won = feedback(version, [0], n=n).episodes
        assert won is not None
        won.success[:] = 1.0
        probes, asked = None, curriculum.probes(state, won)
        if asked is not None:
            success = random.integers(2, size=len(asked)).astype(float)
            probes = Probes(asked, np.zeros(len(asked)), np.ones(len(asked), dtype=np.int64), success)
        told = feedback(
            version, indices, selection.contexts[some], n=n, returns=random.normal(size=m),
            advantages=random.random(m), members=random.normal(size=(n, 3)), probes=probes,
        )  # fmt: skip
        episodes = dataclasses.replace(
            told.episodes, start_values=random.random(m), discounted_returns=random.random(m)
        )  # fmt: skip
        told = dataclasses.replace(told, episodes=episodes)
        state, selection, numbers = curriculum.step(state if through is None else through(state), told)
        history.append((state, selection, numbers))
    return history


def plain(history: list[Any]) -> list[Any]:
    return [
        ({key: np.asarray(value).tolist() for key, value in vars(state).items()}, selection.ids.tolist(),
         selection.contexts.tolist(), numbers)
        for state, selection, numbers in history
    ]  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_a_state_survives_storage_and_the_rows_of_the_file_decide_nothing(kind: str) -> None:
    train = wide()
    curriculum = made(KINDS[kind], train)

    def stored(state: State) -> State:
        arrays, numbers = encode_state(state)
        file = io.BytesIO()
        np.savez(file, **arrays)
        file.seek(0)
        with np.load(file, allow_pickle=False) as loaded:
            return decode_state(curriculum.state_type, dict(loaded), json.loads(json.dumps(numbers, allow_nan=False)))

    history = driven(curriculum, train)
    json.dumps([numbers for _, _, numbers in history], allow_nan=False)
    assert plain(driven(made(KINDS[kind], train), train, through=stored)) == plain(history)
    turned = InstanceSet(train.ids[::-1], train.contexts[::-1], train.names, {"effort": train.columns["effort"][::-1]})
    assert plain(driven(made(KINDS[kind], turned), turned)) == plain(history)
    for state, selection, _ in history:
        again = curriculum.selection(state)
        assert again.ids.tolist() == selection.ids.tolist()
        assert again.contexts.tolist() == selection.contexts.tolist()
    other = driven(made(KINDS[kind], train, seed=1), train)
    if kind != "manual":  # whose order is the file's
        assert plain(other) != plain(history)


def test_every_kind_of_curriculum_is_covered() -> None:
    # test_curricula, test_curriculum_variants, test_user_curriculum
    known = {"space", "random_growth", "cspace", "round_robin", "fixed", "custom"}
    covered = {configs.load(SPACE, [f"curriculum={text}"]).curriculum.kind for text in KINDS.values()}
    import typing

    union = typing.get_args(configs.RunConfig.model_fields["curriculum"].annotation)
    kinds = {typing.get_args(section.model_fields["kind"].annotation)[0] for section in union}
    assert kinds == known | covered


@pytest.mark.parametrize(
    ("curriculum", "words"),
    [
        ("{kind: manual, column: effrot}", ["curriculum.column", "train.csv", "'effrot'", "did you mean 'effort'?"]),
        ("{kind: vds, members_see: [c]}", ["curriculum.members_see", "'c'", "Allowed: a, b"]),
        ("{kind: learnability, top: 7}", ["curriculum.top: 7", "holds 6 instances"]),
        ("{kind: learnability, top: 2, candidates: 9}", ["curriculum.candidates: 9", "holds 6 instances"]),
        ("{kind: spdrl, initial_mean: [1]}", ["curriculum.initial_mean", "1 numbers", "2 features", "(a, b)"]),
        ("{kind: spdrl, initial_mean: [1, 11]}", ["curriculum.initial_mean", "b = 11", "[-10, 10]"]),
    ],
)
def test_what_instances_or_environment_do_not_have_is_refused(curriculum: str, words: list[str]) -> None:
    with pytest.raises(ConfigError) as refusal:
        made(curriculum, wide())
    assert all(word in str(refusal.value) for word in words), str(refusal.value)


def test_moments_of_a_set_on_a_line_are_refused() -> None:
    for train in (instances(4), instances(1)):
        with pytest.raises(ConfigError, match=r"curriculum\.target: set_moments .* singular\. Use target: normal"):
            made("{kind: spdrl}", train)


def test_the_moments_of_the_set_are_the_target() -> None:
    train = wide(40)
    numbers = driven(made("{kind: spdrl}", train), train, 1)[0][2]
    assert numbers["target_mean_b"] == pytest.approx(train.contexts[:, 1].mean())
    assert numbers["target_std_b"] == pytest.approx(train.contexts[:, 1].std())
    assert numbers["mean_a"] == 1.0  # by default, from the middle of the bounds
    assert numbers["std_b"] == 5.0  # and a quarter of their width


@pytest.mark.parametrize(
    ("curriculum", "words"),
    [
        ("{kind: spdrl, target: normal}", "target: normal needs target_mean and target_std"),
        ("{kind: spdrl, target_std: [1]}", "say nothing with target: set_moments"),
        ("{kind: alp_gmm, fit_rate: 5}", "fit_rate must be at least components"),
        ("{kind: spdrl, initial_std: [0]}", "initial_std"),
        ("{kind: plr, temperature: 0}", "temperature"),
        ("{kind: manual}", "curriculum.column: this key is required"),
        ("{kind: space, pic: random, reverse: true}", "reverse: true changes nothing with pic: random"),
    ],
)
def test_settings_that_make_no_sense_are_refused(curriculum: str, words: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        configs.load(SPACE, [f"curriculum={curriculum}"])
    assert words in str(refusal.value)


def set_up(*overrides: str) -> None:
    config = configs.load(SPACE, list(overrides))
    spec = spec_of(config)
    bounds = spec.context_bounds
    middle = (bounds.low + bounds.high) / 2.0
    contexts = middle + np.linspace(-0.1, 0.1, 30)[:, None] * np.random.default_rng(0).random((30, len(middle)))
    train = InstanceSet(np.arange(30), contexts, bounds.names)
    Blueprint(config, spec).setup(train, InstanceSet(np.array([99]), middle[None], bounds.names))


class Silent(Line):
    """The line of `tests.tiny_env`, which does not say whether it succeeded."""

    def step(self, actions: Any) -> Any:
        return dataclasses.replace(super().step(actions), success=None)


def make_silent(n_slots: int) -> Silent:
    return Silent(n_slots, spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32))


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["curriculum={kind: plr}", "env.id=tests.tiny_env:make_discrete", "learner={kind: dqn, n_steps: 2048}"],
         "plr scores episodes by their advantages, which learner.kind: dqn does not compute. Allowed learners: ppo"),
        (["curriculum={kind: learnability}", "env.id=tests.test_rivals:make_silent"],
         "needs to know whether an episode succeeded"),
        (["curriculum={kind: vds}", "env.context_visible=false"], "vds ranks instances by the value of their start"),
        (["curriculum={kind: spdrl}", "env.context_visible=false"], "or curriculum.allow_context_blind: true"),
        (["curriculum={kind: vds, members_see: [gate_x]}", "env.context_visible=false"], "context_visible: true"),
        (["curriculum={kind: vds}", "env.id=tests.tiny_env:make_dict", "learner.policy=MultiInputPolicy"],
         "vds needs flat observations"),
    ],
)  # fmt: skip
def test_what_learner_or_environment_cannot_give_is_refused(overrides: list[str], words: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        set_up(*overrides)
    assert words in str(refusal.value)


def test_shipped_rivals_can_be_made() -> None:
    folder = ROOT / "configs/curricula"
    for path in sorted(folder.glob("*.yaml")):
        config = configs.load(path)
        assert path.stem == config.name
        if config.env.id == "space_dist/PointMass-v0":
            bounds = spec_of(config).context_bounds
            make_curriculum(config, read_csv(config.instances.train, bounds), bounds).start()


def test_contexts_of_instances_are_worth_what_their_start_values_say() -> None:
    config = vds_config()
    worker, learner, _ = tiny_shards(config)
    policy = learner.policy(0)
    found = worker.context_values(policy, worker._setup.train.contexts, version=3)
    assert found.tobytes() == worker.context_values(policy, worker._setup.train.contexts, version=3).tobytes()
    # The line's starts are random within 0.1 of 0, and the value of a fresh network hardly depends on that.
    np.testing.assert_allclose(found, worker.start_values(policy, 0), atol=0.3)
    still = configs.load(SPACE)
    spec = spec_of(still)
    bounds = spec.context_bounds
    train, test = (read_csv(path, bounds) for path in (still.instances.train, still.instances.test))
    point = Worker(Blueprint(still, spec).setup(train, test))
    policy = make_learner(
        still.learner, spec.observation_space, spec.action_space, seed=0, n_slots=16, slot_length=128, total_steps=2048
    ).policy(0)
    values = point.context_values(policy, train.contexts[:7], version=0)
    np.testing.assert_allclose(values, point.start_values(policy, 0)[:7], atol=1e-6)


def test_probes_act_with_noise_on_the_instances_asked_for() -> None:
    config = vds_config()
    worker, learner, _ = tiny_shards(config)
    policy, indices = learner.policy(0), np.repeat([0, 2], 4)
    parts = [worker.probe(policy, indices, 5, part) for part in range(2)]
    assert [part.lengths.tolist() for part in parts] == [[8] * 4, [8] * 4]
    assert len(set(parts[0].returns)) == 4  # the same instance, other noise
    again = Worker(worker._setup).probe(policy, indices, 5, 1)
    assert again.returns.tobytes() == parts[1].returns.tobytes()
    assert worker.probe(policy, indices, 6, 1).returns.tobytes() != parts[1].returns.tobytes()


def test_states_are_plain() -> None:
    for kind, text in KINDS.items():
        state = made(text, wide()).start()[0]
        assert isinstance(state, State)
        for name, value in vars(state).items():
            assert value is None or isinstance(value, int | float | np.ndarray), (kind, name)
    assert isinstance(made(KINDS["plr"], wide()).start()[0], ReplayState)
    assert isinstance(made(KINDS["alp_gmm"], wide()).start()[0], MixtureState)
