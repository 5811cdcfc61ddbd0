"""Prioritised level replay: scores, ranks, staleness and draws, worked out by hand."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from space_dist import config as configs
from space_dist.curricula import (
    Draws,
    Feedback,
    Wants,
)
from space_dist.curricula.plr import LevelReplay, Robust, replay_chances, replayed
from space_dist.errors import ConfigError
from space_dist.ledger import METRICS, VALUES, Ledger, decode_values
from space_dist.rollout import Episodes as Table
from space_dist.rollout.episodes import mean_sizes
from space_dist.run.launch import launch
from space_dist.run.training import Training
from space_dist.seeding import Purpose, generator
from space_dist.system.interrupts import StopRequests
from tests.test_every_curriculum import set_up
from tests.test_rivals import SPACE, feedback, instances, tiny_shards, vds_config


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


# ---- positive_value_loss, max_mc, and robust -------------------------------------------------------------------------


def plr(n: int = 6, **changes: Any) -> LevelReplay:
    settings: dict[str, Any] = {"temperature": 1.0, "staleness_share": 0.0, "within_update": "fixed_chances"}
    return LevelReplay(instances(n), seed=0, draws=Draws(12, 2), **{**settings, **changes})


def test_what_counts_of_an_advantage_by_hand() -> None:
    # One slot: an episode of 1, -4 and 3, and 2 steps of another, -2 and -1, which the next round ends with 5.
    def shard(times: list[int], lengths: list[int], start: bool) -> Any:
        slots, nothing = np.zeros(len(times), dtype=np.int64), np.zeros(0)
        table = Table(slots, np.zeros((0, 1)), slots, np.array(times), np.array(lengths), *[nothing] * 3)
        return SimpleNamespace(episodes=table, rewards=np.zeros((5, 1)), starts=np.array([start]))

    first, second = np.array([[1.0, -4.0, 3.0, -2.0, -1.0]]).T, np.array([[5.0, -9.0, -9.0, -9.0, -9.0]]).T
    for part, early, later in (("size", 8 / 3, 8 / 3), ("positive", 4 / 3, 5 / 3)):
        wants = Wants(episodes=True, advantages=True, advantage_part=part)  # type: ignore[arg-type]
        means, running = mean_sizes([shard([2], [3], True)], wants.counted(first), np.zeros(1))
        assert means == pytest.approx([early])
        means, _ = mean_sizes([shard([0], [3], False)], wants.counted(second), running)
        assert means == pytest.approx([later])
    for score, part in (("value_l1", "size"), ("positive_value_loss", "positive")):
        wants = plr(score=score).wants
        assert (wants.advantages, wants.advantage_part) == (True, part)


def test_positive_value_loss_is_the_mean_of_what_an_episode_did_better_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Step by step, over episodes that go on from round to round."""
    rounds, told, account, step = [], [], Training._account, LevelReplay.step

    def accounted(self: Training, shards: Any, update: Any) -> None:
        rounds.append((shards, update.advantages))
        account(self, shards, update)

    def stepped(self: LevelReplay, state: Any, feedback: Feedback) -> Any:
        assert feedback.episodes is not None
        told.extend(feedback.episodes.advantages.tolist())
        return step(self, state, feedback)

    monkeypatch.setattr(Training, "_account", accounted)
    monkeypatch.setattr(LevelReplay, "step", stepped)
    config = configs.load(SPACE, [
        "curriculum={kind: plr, score: positive_value_loss}", "learner.n_steps=160", "learner.n_epochs=1",
        "learner.net_arch=[8]", "rollout.slots=2", "rollout.shards=2", "budget.steps=1600", "env.kwargs.horizon=30",
        "evaluation.every_steps=100000", "tracking.uri=null", "resources.workers=0",
    ])  # fmt: skip
    launch(config, tmp_path / "run", resume=False, stop=StopRequests())
    expected, better = [], [[0.0, 0], [0.0, 0], [0.0, 0], [0.0, 0]]
    for shards, advantages in rounds:
        for number, shard in enumerate(shards):
            ended = sorted(zip(shard.episodes.times.tolist(), shard.episodes.slots.tolist(), strict=True))
            found = {}
            for time, row in enumerate(advantages.tolist()):
                for slot in range(2):
                    book = better[2 * number + slot]
                    book[0] += row[2 * number + slot] if row[2 * number + slot] > 0.0 else 0.0
                    book[1] += 1
                    if (time, slot) in ended:
                        found[time, slot] = book[0] / book[1]
                        book[:] = [0.0, 0]
            expected.extend(found[one] for one in ended)
    assert len(told) > 40
    np.testing.assert_allclose(told, expected[: len(told)], rtol=1e-9)


def told_returns(version: int, indices: list[int], returns: list[float], values: list[float]) -> Feedback:
    whole = feedback(version, np.array(indices, dtype=np.int64), n=len(values))
    assert whole.episodes is not None
    episodes = dataclasses.replace(whole.episodes, discounted_returns=np.array(returns))
    return dataclasses.replace(whole, episodes=episodes, values_after=np.array(values))


def test_the_highest_return_less_the_value_by_hand() -> None:
    made = plr(4, score="max_mc")
    assert not made.wants.advantages
    state, _ = made.start()
    told = told_returns(0, [0, 1, 0, 2], [1.0, -3.0, 4.0, 2.0], [1.0, -2.0, 2.5, 9.0])
    state, _, numbers = made.step(state, told)
    assert state.best is not None
    assert state.best.tolist() == [4.0, -3.0, 2.0, 0.0]  # of two episodes the better one; a loss is a loss
    assert state.scores.tolist() == [3.0, -1.0, -0.5, 0.0]
    # Ranks 1, 3 and 2 of those seen: 1, 1/3 and 1/2, whose sum is 11/6.
    np.testing.assert_allclose(state.chances, [6 / 11, 2 / 11, 3 / 11, 0.0])
    assert (numbers["largest_score"], numbers["seen"]) == (3.0, 3)
    # A worse episode changes nothing, and values are those of now, whether or not an instance was played.
    state, _, _ = made.step(state, told_returns(1, [0, 3], [1.0, 5.0], [3.75, -4.0, 1.0, 4.5]))
    assert state.best is not None
    assert state.best.tolist() == [4.0, -3.0, 2.0, 5.0]
    assert state.scores.tolist() == [0.25, 1.0, 1.0, 0.5]
    tied = sorted(state.chances.tolist(), reverse=True)
    np.testing.assert_allclose(tied, [12 / 25, 6 / 25, 4 / 25, 3 / 25])
    assert tied[2:] == [state.chances[3], state.chances[0]]


@pytest.mark.parametrize("rule", ["without_repetition", "fixed_chances"])
def test_robust_replay_explores_unlearned_and_replays_what_was_scored(rule: Any) -> None:
    made = plr(6, robust=Robust(replay_share=0.5, scored_share=0.5), within_update=rule)
    assert made.wants.unlearned
    state, selection = made.start()
    order = in_order(selection) - 10
    # Nothing is scored: what was never begun first, then any; and nothing is learned from it.
    assert (sorted(order[:6]), selection.learned) == (list(range(6)), False)
    state, selection, numbers = made.step(state, feedback(0, order[:2], n=6, advantages=[1.0, 2.0], running=order[2:4]))
    assert (selection.learned, numbers["learned"]) == (False, False)  # two of six are less than half
    assert set(in_order(selection)[:2] - 10) == set(order[4:6])
    state, selection, _ = made.step(state, feedback(1, order[2:3], n=6, advantages=3.0, running=order[3:4]))
    learned = []
    for version in range(2, 42):
        again = made.selection(state)
        assert (again.ids.tolist(), again.learned) == (selection.ids.tolist(), selection.learned)
        learned.append(selection.learned)
        drawn = in_order(selection) - 10
        if selection.learned:  # of the scored ones alone
            assert set(drawn) <= set(order[:3])
        else:  # what was never begun, and then of all
            assert drawn[:2].tolist() == order[4:6].tolist()
            assert not set(drawn) <= set(order[:3])
        state, selection, numbers = made.step(
            state, feedback(version, order[:1], n=6, advantages=1.0, running=order[3:4])
        )
        assert numbers["learned"] == learned[-1]
    assert 0.2 < np.mean(learned) < 0.8
    always = plr(6, robust=Robust(replay_share=1.0, scored_share=0.5), within_update=rule)
    assert all(always.selection(dataclasses.replace(state, version=version)).learned for version in range(40))


def test_what_a_temperature_leaves_to_the_first_rank_of_a_hundred() -> None:
    """The numbers of docs/curricula.md."""
    shares = {}
    for beta in (0.1, 0.3, 0.5, 1.0, 2.0):
        weights = [rank ** (-1.0 / beta) for rank in range(1, 101)]
        first = weights[0] / math.fsum(weights)
        entropy = -math.fsum(one / math.fsum(weights) * math.log(one / math.fsum(weights)) for one in weights)
        shares[beta] = (round(100 * first, 1), round(math.exp(entropy), 1))
        chances = replay_chances(
            np.arange(100.0), np.zeros(100, dtype=np.int64), np.ones(100, dtype=np.bool_),
            np.arange(100, dtype=np.uint64), beta, 0.0,
        )  # fmt: skip
        assert chances.max() == pytest.approx(first)
    assert shares == {0.1: (99.9, 1.0), 0.3: (87.2, 1.7), 0.5: (61.2, 4.8), 1.0: (19.3, 39.7), 2.0: (5.4, 84.4)}


def test_a_round_that_is_looked_at_leaves_the_weights_and_tells_the_same_advantages() -> None:
    trpo = "learner={kind: trpo, n_steps: 128, gamma: 0.5}"
    for more in ("learner.normalize_rewards=true", "learner.update=lean", trpo):
        config = vds_config("curriculum={kind: plr}", more)
        (_, learner, shards), (_, twin, _) = tiny_shards(config), tiny_shards(config)
        before = learner.scored()
        seen = learner.look_at(shards, round=0)
        after = learner.scored()
        assert all(array.tobytes() == after[name].tobytes() for name, array in before.items())
        assert (seen.gradient_steps, seen.metrics) == (0, {})
        made = twin.update(shards, round=0, steps=128)
        assert seen.advantages is not None
        assert seen.advantages.tobytes() == made.advantages.tobytes()
        assert learner.statistics.reward_std == twin.statistics.reward_std
        assert any(array.tobytes() != after[name].tobytes() for name, array in twin.scored().items())


def test_rounds_that_are_not_learned_from_are_charged_and_leave_the_weights(tmp_path: Path) -> None:
    config = configs.load(SPACE, [
        "curriculum={kind: plr, robust: true, score: max_mc, temperature: 1}", "learner.n_steps=512",
        "learner.n_epochs=1", "learner.net_arch=[8]", "rollout.slots=4", "rollout.shards=1", "budget.steps=20480",
        "evaluation.every_steps=100000", "tracking.uri=null", "resources.workers=0",
    ])  # fmt: skip
    launch(config, tmp_path / "run", resume=False, stop=StopRequests())
    rows = [row for row in Ledger(tmp_path / "run").rows(METRICS) if row["kind"] == "iteration"]
    assert [row["steps"] for row in rows] == [512 * number for number in range(1, 41)]
    learned = [row["curriculum"]["learned"] for row in rows if row["complete"]]
    assert not any(learned[:8])  # half of the hundred must be scored, by five or so an iteration
    assert 4 < sum(learned) < 36
    for row in rows[: len(learned)]:
        assert (row["gradient_steps"] > 0) == row["curriculum"]["learned"]
        assert (row["learner"] != {}) == row["curriculum"]["learned"]
    values = [decode_values(row["after"]) for row in Ledger(tmp_path / "run").rows(VALUES)]
    for number, some in enumerate(learned):
        assert (values[number].tobytes() != values[number + 1].tobytes()) == some


def test_rounds_cannot_be_left_unlearned_by_who_remembers_them() -> None:
    dqn = ["env.id=tests.tiny_env:make_discrete", "learner={kind: dqn, n_steps: 2048}"]
    with pytest.raises(ConfigError, match=r"plays rounds that are not learned from.*Allowed learners: ppo"):
        set_up("curriculum={kind: plr, robust: true, score: max_mc}", *dqn)
    set_up("curriculum={kind: plr, score: max_mc}", *dqn)  # which needs no advantages


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
        told, advantage = np.zeros((length, slots)), np.zeros(slots)
        for time in reversed(range(length)):
            for slot in range(slots):
                following = last[slot] if time == length - 1 else values[time + 1, slot]
                ended = (time, slot) in behind
                delta = shard.rewards[time, slot] + 0.5 * behind.get((time, slot), following) - values[time, slot]
                advantage[slot] = delta + (0.0 if ended else 0.5 * 0.5 * advantage[slot])
                told[time, slot] = advantage[slot]
        expected.append(told)
    update = learner.update(shards, round=0, steps=128)
    np.testing.assert_allclose(update.advantages, np.concatenate(expected, axis=1), atol=1e-4)
    assert update.advantages is not None
    assert 0.0 < (update.advantages < 0.0).mean() < 1.0
