"""ACCEL: its buffer, replays and edits worked out by hand; generators; and that the test set is not trained on."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from space_dist import config as configs
from space_dist.curricula import GENERATED, Draws, Feedback
from space_dist.curricula.accel import EDITED, NEW, REPLAYED, Accel, EditedState, Played, Replays, easiest, with_played
from space_dist.curricula.generating import Unheld
from space_dist.envs.mixed_maze import draw
from space_dist.envs.spec import read_spec
from space_dist.errors import ConfigError
from space_dist.instances import InstanceSet
from space_dist.ledger import CURRICULUM, METRICS, Ledger
from space_dist.run.launch import launch
from space_dist.seeding import Purpose, generator
from space_dist.system.interrupts import StopRequests
from tests.test_causal import run, together
from tests.test_learners import crashed, interrupted, with_checkpoints
from tests.test_plr import replayed_by_hand
from tests.test_rivals import ROOT, SPACE, feedback, made
from tests.tiny_env import Line
from tests.two_features import scattered


class Counting:
    """New contexts are (1, 0), (2, 0), ..., by the draws of the generator; an edit adds its number to the second."""

    def __init__(self) -> None:
        self.edited: list[list[list[float]]] = []

    def sample(self, random: np.random.Generator, count: int) -> np.ndarray:  # noqa: ARG002 - it counts
        return np.column_stack((np.arange(1.0, count + 1.0), np.zeros(count)))

    def edit(self, random: np.random.Generator, contexts: np.ndarray, edits: int) -> np.ndarray:  # noqa: ARG002
        self.edited.append(contexts.tolist())
        return contexts + np.column_stack((np.zeros(len(contexts)), edits + np.arange(len(contexts))))

    def canonical(self, contexts: np.ndarray) -> np.ndarray:
        return contexts


def accel(source: Any = None, **changes: Any) -> Accel:
    replays = {"share": 1.0, "filled": 3, "temperature": 1.0, "staleness_share": 0.0}
    replays |= {name: changes.pop(name) for name in list(changes) if name in replays}
    settings: dict[str, Any] = {
        "new_from": None, "buffer": 5, "batch": 3, "edits": 2, "edited": "easiest", "score": "positive_value_loss",
        "robust": True,
    }  # fmt: skip
    return Accel(
        seed=0, draws=Draws(12, 2), source=Unheld(source or Counting()), replays=Replays(**replays),  # type: ignore[arg-type]
        **{**settings, **changes},
    )  # fmt: skip


def told(version: int, contexts: list[list[float]], scores: Any = 0.0, **more: Any) -> Feedback:
    """That an episode ended in each of the contexts."""
    given = np.array(contexts, dtype=np.float64).reshape(-1, 2)
    returns = more.pop("returns", 0.0)
    found = feedback(version, np.full(len(given), GENERATED), given, advantages=scores, returns=returns)
    assert found.episodes is not None
    columns = {name: np.broadcast_to(value, len(given)).astype(np.float64) for name, value in more.items()}
    return dataclasses.replace(found, episodes=dataclasses.replace(found.episodes, **columns))


def walked(selection: Any) -> list[list[float]]:
    """The contexts of a selection in the order in which its two walks use them."""
    d = selection.contexts.shape[1]
    found: list[list[float]] = selection.contexts.reshape(2, -1, d).transpose(1, 0, 2).reshape(-1, d).tolist()
    return found


# ---- the buffer ------------------------------------------------------------------------------------------------------


def buffered(contexts: list[float], scores: list[float], last: list[int], episodes: int = 9) -> EditedState:
    column = np.array(contexts)[:, None]
    return EditedState(0, column, np.array(scores), np.array(scores), np.array(last), episodes, NEW, column)


def played(contexts: list[float], places: list[int], scores: list[float]) -> Played:
    g = len(contexts)
    return Played(
        np.array(contexts)[:, None], np.array(places, dtype=np.int64), np.zeros(g), np.array(scores),
        np.array(scores) + 1.0, np.arange(9, 9 + g),
    )  # fmt: skip


def test_what_is_kept_by_hand() -> None:
    state = buffered([1, 2, 3], [5.0, 1.0, 3.0], [0, 1, 2])
    # There is room for one: what was played again has its new score, and of the new ones the better enters.
    after = with_played(state, played([2, 7, 8], [1, -1, -1], [2.0, 0.5, 4.0]), 4)
    assert after.contexts.ravel().tolist() == [1, 2, 3, 8]
    assert (after.scores.tolist(), after.best.tolist(), after.last.tolist()) == (
        [5, 2, 3, 4],
        [5, 3, 3, 5],
        [0, 9, 2, 11],
    )
    # A new one must beat the least; 2 leaves for it, with the score that it has now.
    after = with_played(after, played([9, 10], [-1, -1], [2.0, 2.5]), 4)
    assert (after.contexts.ravel().tolist(), after.scores.tolist()) == ([1, 3, 8, 10], [5.0, 3.0, 4.0, 2.5])
    # 3 is played again and falls: it is what leaves. As good as the least is not better.
    after = with_played(after, played([3, 11, 12], [1, -1, -1], [0.0, 2.5, 1.0]), 4)
    assert (after.contexts.ravel().tolist(), after.scores.tolist()) == ([1, 8, 10, 11], [5.0, 4.0, 2.5, 2.5])
    after = with_played(after, played([13], [-1], [2.5]), 4)
    assert after.contexts.ravel().tolist() == [1, 8, 10, 11]
    # Of equal scores the older stays.
    assert with_played(after, played([14], [-1], [3.0]), 4).contexts.ravel().tolist() == [1, 8, 10, 14]
    assert with_played(after, played([], [], []), 4).contexts.ravel().tolist() == [1, 8, 10, 11]


def test_the_easiest_have_much_return_and_little_regret() -> None:
    returns, scores = np.array([1.0, 0.0, 3.0, 3.0, 2.0, 5.0]), np.array([0.5, 0.1, 3.0, 0.0, 0.5, 5.5])
    # 0.5, -0.1, 0, 3, 1.5 and -0.5.
    assert easiest(returns, scores).tolist() == [3, 4, 0, 2]
    assert easiest(returns[:2], scores[:2]).tolist() == [0, 1]


# ---- iterations ------------------------------------------------------------------------------------------------------


def test_new_contexts_are_played_in_turn_and_not_learned_from() -> None:
    state, selection = accel().start()
    assert walked(selection) == [[1, 0], [2, 0], [3, 0]] * 4
    assert (selection.drawn, selection.learned, set(selection.ids)) == (True, False, {GENERATED})
    assert (len(state.contexts), state.phase) == (0, NEW)


def test_new_then_replayed_then_edited_by_hand() -> None:
    source = Counting()
    made_one = accel(source)
    state, _ = made_one.start()
    # Two are scored, and three must be before anything is replayed.
    state, selection, numbers = made_one.step(state, told(0, [[2, 0], [1, 0], [2, 0]], [1.0, 5.0, 4.0]))
    assert (state.phase, state.episodes, selection.learned) == (NEW, 3, False)
    assert state.contexts.tolist() == [[1, 0], [2, 0]]
    assert (state.scores.tolist(), state.last.tolist()) == ([5.0, 2.5], [1, 2])  # two episodes: their mean
    assert (numbers["new"], numbers["replayed"], numbers["edited"], numbers["learned"]) == (True, False, False, False)
    assert (numbers["size"], numbers["buffer"], numbers["entered"], numbers["left"]) == (2, 2, 2, 0)
    # Three are: by ranks 1, 2 and 3 of a draw without repetition.
    state, selection, numbers = made_one.step(state, told(1, [[3, 0]], 3.0))
    assert (state.phase, selection.learned, numbers["mean_score"], numbers["largest_score"]) == (
        REPLAYED,
        True,
        3.5,
        5.0,
    )
    uniform = generator(0, Purpose.DRAWS, 2).random((3, 2))
    by_hand = replayed_by_hand([5.0, 2.5, 3.0], [1, 2, 3], 4, uniform, 1.0, 0.0)
    assert walked(selection) == [[[1, 0], [2, 0], [3, 0]][one] for one in by_hand] * 4
    assert sorted(by_hand) == [0, 1, 2]
    # What ended of it is edited, the easiest first and again; 9 was never in the buffer, and is no parent.
    returns = [0.0, 4.0, 9.0]
    state, selection, numbers = made_one.step(
        state, told(2, [[1, 0], [3, 0], [9, 0]], [2.0, 0.5, 0.0], returns=returns)
    )
    assert source.edited == [[[3, 0], [1, 0], [3, 0]]]
    assert walked(selection) == [[3, 2], [1, 3], [3, 4]] * 4
    assert (state.phase, selection.learned, numbers["replayed"], numbers["learned"]) == (EDITED, False, True, True)
    assert state.contexts.tolist() == [[1, 0], [2, 0], [3, 0], [9, 0]]
    assert state.scores.tolist() == [2.0, 2.5, 0.5, 0.0]
    # An edit is scored as anything else is. There are five places: the one with a score of 0 gives way to the second.
    state, selection, numbers = made_one.step(state, told(3, [[3, 2], [1, 3], [3, 0]], [1.0, 4.0, 0.25]))
    assert (numbers["edited"], numbers["entered"], numbers["left"], numbers["buffer"]) == (True, 2, 1, 5)
    assert state.contexts.tolist() == [[1, 0], [2, 0], [3, 0], [1, 3], [3, 2]]
    assert state.scores.tolist() == [2.0, 2.5, 0.25, 4.0, 1.0]
    assert state.phase == REPLAYED  # edits are not edited before they were replayed
    again = made_one.selection(state)
    assert (again.contexts.tolist(), again.learned) == (selection.contexts.tolist(), True)


def three(scores: np.ndarray, last: np.ndarray, *, phase: int = NEW, episodes: int = 9) -> EditedState:
    """With (1, 0), (2, 0) and (3, 0) in the buffer."""
    contexts = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])
    return EditedState(0, contexts, scores, np.ones(3), last, episodes, phase, contexts)


def test_all_of_a_batch_is_edited_where_that_is_asked_for() -> None:
    source = Counting()
    made_one = accel(source, edited="batch", batch=2)
    state = three(np.ones(3), np.arange(3), phase=REPLAYED)
    after, _, _ = made_one.step(state, told(0, [[3, 0], [1, 0], [2, 0], [1, 0]], returns=[9.0, 0.0, 1.0, 0.0]))
    assert source.edited == [[[1, 0], [2, 0], [3, 0]]]
    assert len(after.playing) == 3
    # Fewer have ended than are played at once.
    made_one.step(state, told(0, [[3, 0]]))
    assert source.edited[1] == [[3, 0], [3, 0]]
    # None has: there is nothing to edit, and it replays again.
    after, _, numbers = made_one.step(state, told(0, []))
    assert (after.phase, len(source.edited), numbers["size"], numbers["entered"]) == (REPLAYED, 2, 0, 0)


@pytest.mark.parametrize(("share", "robust"), [(0.5, True), (1.0, True), (0.5, False)])
def test_a_coin_says_whether_to_replay(share: float, robust: bool) -> None:
    made_one = accel(share=share, robust=robust)
    assert made_one.wants.unlearned == robust
    state, _ = made_one.start()
    state, _, _ = made_one.step(state, told(0, [[1, 0], [2, 0], [3, 0]], 1.0))
    phases = []
    for version in range(1, 61):
        # Nothing that was replayed ends, so there is nothing to edit.
        state, selection, _ = made_one.step(state, told(version, []))
        phases.append(state.phase)
        coin = generator(0, Purpose.DRAWS, state.version, 1).random()
        assert state.phase == (REPLAYED if coin < share else NEW)
        assert selection.learned == (state.phase == REPLAYED or not robust)
    assert (set(phases) == {REPLAYED}) == (share == 1.0)


def test_stale_contexts_come_back() -> None:
    """By staleness alone: 3, 1 and 0 episodes since each was last played are chances of 3/4, 1/4 and none."""
    made_one = accel(staleness_share=1.0, batch=1, filled=1)
    state = three(np.array([1.0, 5.0, 9.0]), np.array([0, 2, 3]), episodes=4)
    firsts = []
    for version in range(400):
        after, _, _ = made_one.step(dataclasses.replace(state, version=version), told(version, []))
        firsts.append(int(after.playing[0, 0]))
    assert firsts.count(3) == 0
    assert abs(firsts.count(1) / 400 - 0.75) < 5 * np.sqrt(0.75 * 0.25 / 400)


def test_scores_by_the_highest_return_less_the_value() -> None:
    made_one = accel(score="max_mc", filled=9)
    assert (made_one.wants.advantages, accel().wants.advantage_part) == (False, "positive")
    assert (accel(score="value_l1").wants.advantages, accel(score="value_l1").wants.advantage_part) == (True, "size")
    state, _ = made_one.start()
    given = {"discounted_returns": [1.0, 3.0, -2.0], "start_values": [0.5, 1.5, 1.0]}
    state, _, _ = made_one.step(state, told(0, [[1, 0], [1, 0], [2, 0]], **given))
    assert (state.best.tolist(), state.scores.tolist()) == ([3.0, -2.0], [2.0, -3.0])
    # A worse episode leaves the highest return; the value is that of when it was played.
    state, _, _ = made_one.step(state, told(1, [[1, 0]], discounted_returns=2.0, start_values=2.75))
    assert (state.best.tolist(), state.scores.tolist()) == ([3.0, -2.0], [0.25, -3.0])


def test_advantages_that_are_not_known_are_an_error() -> None:
    made_one = accel()
    with pytest.raises(ValueError, match="ACCEL needs the advantages"):
        made_one.step(made_one.start()[0], told(0, [[1, 0]], np.nan))


def test_instances_are_what_is_new_where_that_is_asked_for() -> None:
    train = scattered(7)
    made_one = made("{kind: accel, new_from: set, batch: 4}", train)
    state, selection = made_one.start()
    assert isinstance(state, EditedState)
    rows = {tuple(context) for context in state.playing.tolist()}
    assert len(rows) == 4
    assert rows <= {tuple(context) for context in train.contexts.tolist()}
    assert set(selection.ids) == {GENERATED}
    assert len(made("{kind: accel, new_from: set}", train).start()[0].playing) == 7  # type: ignore[attr-defined]


# ---- what is held out ------------------------------------------------------------------------------------------------


class Dice:
    """Whole numbers from 0 to 5, whose sign means nothing; an edit draws another."""

    def sample(self, random: np.random.Generator, count: int) -> np.ndarray:
        return random.integers(-5, 6, size=(count, 1)).astype(np.float64)

    def edit(self, random: np.random.Generator, contexts: np.ndarray, edits: int) -> np.ndarray:  # noqa: ARG002
        return np.where(contexts == 5.0, 5.0, self.sample(random, len(contexts)))

    def canonical(self, contexts: np.ndarray) -> np.ndarray:
        return np.abs(contexts)


def test_nothing_that_means_the_same_as_a_held_out_instance_is_given() -> None:
    random, held = np.random.default_rng(0), np.array([[-3.0], [1.0], [-0.0]])
    source = Unheld(Dice(), held)
    assert set(source.sample(random, 400).ravel()) == {-5, -4, -2, 2, 4, 5}
    assert set(source.edit(random, np.zeros((400, 1)), 1).ravel()) == {-5, -4, -2, 2, 4, 5}
    assert set(Unheld(Dice()).sample(random, 400).ravel()) == set(range(-5, 6))
    # What can become nothing else is left out.
    source = Unheld(Dice(), np.array([[5.0]]))
    assert source.edit(random, np.array([[5.0], [1.0], [5.0]]), 1).shape == (1, 1)
    source = Unheld(Dice(), np.arange(6.0)[:, None])
    with pytest.raises(ConfigError, match=r"gives contexts of instances\.test alone, which must not be trained on"):
        source.sample(random, 2)


def test_small_mazes_of_the_test_set_are_never_made() -> None:
    """Those of 3x3 are so few that a draw is often one of them."""
    random = np.random.default_rng(0)
    small = np.unique(draw(random, 3000), axis=0)
    small = small[small[:, 0] == 3]
    held_out, others = small[::2], small[1::2]
    assert len(small) < 193
    plain = read_spec("space_dist/MixedMaze-v0", context_visible=True).generator()
    held = {tuple(row) for row in held_out.tolist()}
    free, guarded = (one.sample(np.random.default_rng(1), 300) for one in (plain, Unheld(plain, held_out)))
    assert held & {tuple(row) for row in free.tolist()}
    assert (guarded[:, 0] == 3).any()
    assert not held & {tuple(row) for row in guarded.tolist()}
    edited = Unheld(plain, held_out).edit(np.random.default_rng(2), np.repeat(others, 3, axis=0), 2)
    assert len(edited) == 3 * len(others)
    assert not held & {tuple(row) for row in edited.tolist()}
    assert held & {tuple(row) for row in plain.edit(np.random.default_rng(2), np.repeat(others, 3, axis=0), 2).tolist()}


class Few(Line):
    """The line, whose contexts are eighths: 17 in all."""

    def draw_contexts(self, rng: np.random.Generator, n: int) -> np.ndarray:
        return rng.integers(-8, 8, size=(n, 1), endpoint=True) / 8.0

    def edit_contexts(self, rng: np.random.Generator, contexts: np.ndarray, edits: int) -> np.ndarray:
        return np.clip(contexts + rng.integers(-edits, edits, size=contexts.shape, endpoint=True) / 8.0, -1.0, 1.0)


def make_few(n_slots: int) -> Few:
    return Few(n_slots, spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32))


def line_config(folder: Path, *more: str) -> configs.RunConfig:
    train = InstanceSet(np.arange(3), np.array([[-0.5], [0.0], [0.5]]), ("target",))
    test = InstanceSet(np.arange(3), np.array([[-0.25], [0.25], [0.625]]), ("target",))
    for name, instances in (("train", train), ("test", test)):
        (folder / f"{name}.csv").write_text(instances.to_csv())
    return configs.load(SPACE, [
        "env={id: tests.test_accel:make_few}", "curriculum={kind: accel, buffer: 6, batch: 5, edits: 2}",
        f"instances.train={folder}/train.csv", f"instances.test={folder}/test.csv", "learner.n_steps=64",
        "learner.n_epochs=1", "learner.net_arch=[8]", "rollout.shards=2", "rollout.slots=2", "budget.steps=3200",
        "evaluation.every_steps=100000", "tracking.uri=null", "resources.workers=0", *more,
    ])  # fmt: skip


def test_a_run_trains_on_no_test_instance_and_says_what_its_iterations_were(tmp_path: Path) -> None:
    launch(line_config(tmp_path), tmp_path / "run", resume=False, stop=StopRequests())
    ledger = Ledger(tmp_path / "run")
    seen = {target for row in ledger.rows(CURRICULUM) for (target,) in row["contexts"]}
    assert not seen & {-0.25, 0.25, 0.625}
    assert len(seen) > 10
    assert {target * 8 for target in seen} <= set(range(-8, 9))
    rows = [row for row in ledger.rows(METRICS) if row["kind"] == "iteration"]
    assert [row["steps"] for row in rows] == [64 * number for number in range(1, 51)]  # every round is charged
    phases = []
    for row in (row for row in rows if row["complete"]):
        phase = [name for name in ("new", "replayed", "edited") if row["curriculum"][name]]
        phases += phase
        assert len(phase) == 1
        assert (row["gradient_steps"] > 0) == row["curriculum"]["learned"] == (phase == ["replayed"])
        assert row["curriculum"]["buffer"] <= 6
    for before, phase in itertools.pairwise(phases):
        assert (phase == "edited") == (before == "replayed")  # episodes of 8 steps always end
    assert set(phases) == {"new", "replayed", "edited"}


# ---- whole runs ------------------------------------------------------------------------------------------------------


def test_a_long_history_is_kept_as_the_rule_says() -> None:
    """The rule again, one context after another: who is the best of those that ask enters first."""
    made_one, random, most = accel(buffer=7, filled=100), np.random.default_rng(5), 7
    state, _ = made_one.start()
    kept: list[tuple[float, float, int]] = []  # context, score, when it was last played; oldest first
    count, refused = 0, 0
    for version in range(60):
        contexts = random.integers(30, size=random.integers(1, 9)).tolist()
        scores = random.integers(-2, 6, size=len(contexts)).astype(float).tolist()
        state, _, numbers = made_one.step(state, told(version, [[one, 0.5] for one in contexts], scores))
        now: dict[float, list[float]] = {}
        last = {context: count + place for place, context in enumerate(contexts)}
        for context, score in zip(contexts, scores, strict=True):
            now.setdefault(context, []).append(score)
        count += len(contexts)
        means = {context: sum(some) / len(some) for context, some in now.items()}
        known = {context for context, _, _ in kept}
        kept = [(one, means.get(one, score), last.get(one, when)) for one, score, when in kept]
        entered = 0
        for context in sorted(sorted(set(means) - known), key=lambda one: -means[one]):
            if len(kept) == most:
                least = min(score for _, score, _ in kept)
                if means[context] <= least:
                    refused += 1
                    continue
                kept.remove([one for one in kept if one[1] == least][-1])
            kept.append((context, means[context], last[context]))
            entered += 1
        expected = {context: (score, when) for context, score, when in kept}
        found = zip(state.contexts[:, 0].tolist(), state.scores.tolist(), state.last.tolist(), strict=True)
        assert {context: (score, when) for context, score, when in found} == expected
        assert (numbers["entered"], numbers["buffer"], state.episodes) == (entered, len(kept), count)
    assert refused > 20


def maze_config(*more: str, seed: int = 0) -> configs.RunConfig:
    return configs.load(ROOT / "configs/curricula/mixed_maze_accel.yaml", [
        "curriculum.buffer=8", "curriculum.batch=6", "learner.n_steps=128", "learner.n_epochs=1",
        "learner.batch_size=64", "learner.net_arch=[8]", "rollout.shards=2", "rollout.slots=4",
        "env.kwargs.horizon=24", "budget.steps=1408", "evaluation.every_steps=100000", "tracking.uri=null",
        "resources.workers=0", "instances.train=shipped:instances/mixed_maze_train.csv",
        "instances.test=shipped:instances/mixed_maze_test.csv", f"seed={seed}", *more,
    ])  # fmt: skip


@pytest.mark.parametrize("how", ["learner.update=lean", "engine=population"])
def test_over_mazes_neither_interruptions_nor_company_nor_a_fork_change_a_byte(how: str, tmp_path: Path) -> None:
    config = maze_config(how)
    expected = run(config, tmp_path / "whole")
    rows = [row["curriculum"] for row in Ledger(tmp_path / "whole").rows(METRICS) if row["kind"] == "iteration"]
    phases = {name for row in rows for name in ("new", "replayed", "edited") if row.get(name)}
    assert len(phases) == 3
    seldom = with_checkpoints(config, 20)
    interrupted(seldom, tmp_path / "disturbed", 3)
    crashed(seldom, tmp_path / "disturbed", 3)
    assert run(config, tmp_path / "disturbed") == expected
    assert run(maze_config(how, "fork={seed: 0, steps: 700}"), tmp_path / "fork") == expected
    if how == "engine=population":
        members = [maze_config(how, seed=seed) for seed in (0, 1)]
        assert together(members, tmp_path) == [expected, run(members[1], tmp_path / "other")]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ("buffer: 0", "curriculum.buffer"),
        (
            "edited: hardest",
            "curriculum.edited: 'hardest' is not known; did you mean 'easiest'? Allowed: easiest, batch",
        ),
        ("score: positive_value_los", "curriculum.score"),
        ("replay_share: 0", "curriculum.replay_share"),
        ("edit: 3", "curriculum.edit: unknown key; did you mean 'edits'?"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings: str, words: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        configs.load(SPACE, [f"curriculum={{kind: accel, {settings}}}"])
    assert words in str(refusal.value)


def test_worlds_and_learners_that_cannot_are_refused(tmp_path: Path) -> None:
    ant = configs.load(ROOT / "configs/antgoal_space.yaml", ["curriculum={kind: accel}", "tracking.uri=null"])
    with pytest.raises(ConfigError, match=r"env\.id 'space_dist/AntGoal-v0' draws its contexts itself"):
        launch(ant, tmp_path / "ant", resume=False, stop=StopRequests())
    dqn = ["env={id: tests.tiny_env:make_discrete}", "learner={kind: dqn, n_steps: 64}"]
    for more, words in (
        ("curriculum={kind: accel}", "accel scores episodes by their advantages"),
        ("curriculum={kind: accel, score: max_mc}", "plays rounds that are not learned from"),
    ):
        with pytest.raises(ConfigError, match=words):
            launch(line_config(tmp_path, *dqn, more), tmp_path / "dqn", resume=False, stop=StopRequests())
    assert not (tmp_path / "dqn").exists()
