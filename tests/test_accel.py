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
from space_dist.envs import BATCHED
from space_dist.envs.distributions import sample
from space_dist.envs.generating import moved
from space_dist.envs.mixed_maze import draw
from space_dist.envs.spec import read_spec
from space_dist.errors import ConfigError
from space_dist.instances import ContextBounds, InstanceSet
from space_dist.ledger import CURRICULUM, METRICS, Ledger
from space_dist.run.launch import launch
from space_dist.seeding import Purpose, generator
from space_dist.system.interrupts import StopRequests
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


# ---- generators ------------------------------------------------------------------------------------------------------


def openings(context: np.ndarray) -> tuple[int, set[Any]]:
    """The side of a maze, and the open walls between two of its cells, each said to be open by both."""
    side, layout = (5, context) if len(context) == 25 else (int(context[0]), context[1:])
    width = 5 if len(context) == 25 else 11
    found = set()
    for place, number in enumerate(layout.astype(int).tolist()):
        x, y = place % width, place // width
        assert number == 0 or (x < side and y < side)
        for dx, dy, bit, back in ((1, 0, 2, 8), (0, 1, 4, 1), (-1, 0, 8, 2), (0, -1, 1, 4)):
            if number & bit:
                assert 0 <= x + dx < side
                assert 0 <= y + dy < side
                assert int(layout[place + dx + width * dy]) & back
                found.add(frozenset([(x, y), (x + dx, y + dy)]))
    return side, found


def reachable(side: int, open_: set[Any]) -> set[Any]:
    known, trail = {(0, 0)}, [(0, 0)]
    while trail:
        x, y = trail.pop()
        for cell in ((x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)):
            if cell not in known and frozenset([(x, y), cell]) in open_:
                known.add(cell)
                trail.append(cell)
    assert all(x < side and y < side for x, y in known)
    return known


@pytest.mark.parametrize("edits", [1, 3, 40, 99])
def test_an_edit_of_a_maze_opens_or_closes_so_many_walls(edits: int) -> None:
    source = read_spec("space_dist/Maze-v0", context_visible=True).generator()
    mazes = sample("maze_dfs_raw", 30, 1, 0)[0].contexts
    kept = mazes.copy()
    edited = source.edit(np.random.default_rng(0), mazes, edits)
    assert (mazes == kept).all()
    changes = []
    for before, after in zip(source.canonical(mazes), edited, strict=True):
        changed = openings(before)[1] ^ openings(after)[1]
        assert len(changed) == min(edits, 40)
        changes.append(frozenset(changed))
    assert len(set(changes)) > 15 or edits >= 40  # each its own
    again = source.edit(np.random.default_rng(0), mazes, edits)
    assert again.tobytes() == edited.tobytes()
    assert source.edit(np.random.default_rng(0), mazes, 0).tobytes() == source.canonical(mazes).tobytes()


def test_raw_layouts_of_a_maze_mean_the_same_as_symmetrised_ones() -> None:
    source = read_spec("space_dist/Maze-v0", context_visible=False).generator()
    raw = sample("maze_dfs_raw", 20, 1, 0)[0].contexts
    there = Unheld(source, source.canonical(raw))
    assert (source.canonical(raw) != raw).any()
    assert there.holds(raw).all()
    assert not there.holds(sample("maze_dfs", 20, 1, 7)[0].contexts).any()


def test_edits_of_mixed_mazes_change_walls_and_move_the_goal() -> None:
    source = read_spec("space_dist/MixedMaze-v0", context_visible=True).generator()
    random = np.random.default_rng(3)
    mazes = draw(random, 400)
    edited = source.edit(random, mazes, 1)
    moves = [0, 0, 0]
    for before, after in zip(mazes, edited, strict=True):
        (side, was), (new_side, now) = openings(before), openings(after)
        moves[new_side - side + 1] += 1
        if new_side == side:
            assert len(was ^ now) == 1
        elif new_side > side:
            # What was there is as it was; the old goal leads to the new one, which had a way to it before.
            assert {wall for wall in now if all(max(cell) < side for cell in wall)} == was
            assert len(now - was) == 2 * side + 1  # a passage to each new cell
            assert len(reachable(new_side, now)) == new_side**2
        else:
            assert now == {wall for wall in was if all(max(cell) < new_side for cell in wall)}
    assert 60 < moves[0] + moves[2] < 140  # a quarter
    assert min(moves) > 15
    # Nothing is left at either end.
    for side, allowed in ((3, {3, 4}), (11, {10, 11})):
        some = source.edit(random, np.repeat(mazes[mazes[:, 0] == side][:1], 60, axis=0), 1)
        assert set(some[:, 0]) == allowed
    many = source.edit(random, mazes, 40)
    assert all(3 <= openings(one)[0] <= 11 for one in many)
    env = BATCHED["space_dist/MixedMaze-v0"](400)
    env.reset(np.arange(400), many, np.zeros(400, dtype=np.uint64))  # which refuses what is no maze


def test_numbers_within_bounds_are_edited_one_at_a_time() -> None:
    bounds = ContextBounds(("a", "b", "c"), np.array([0.0, -10.0, 5.0]), np.array([1.0, 10.0, 9.0]))
    contexts = np.tile([0.5, 10.0, 5.0], (600, 1))
    found = moved(np.random.default_rng(0), contexts, 1, bounds, whole=False)
    changed = found != contexts
    assert set(changed.sum(axis=1)) == {0, 1}  # none: stopped at its bounds
    assert 150 < changed[:, 0].sum() < 250
    for column, low, high in ((0, 0.4, 0.6), (1, 8.0, 10.0), (2, 5.0, 5.4)):
        some = found[changed[:, column], column]
        assert low <= some.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < some.max() <= high
    whole = moved(np.random.default_rng(0), np.tile([0.0, 1.0, 7.0], (600, 1)), 1, bounds, whole=True)
    assert set(whole[:, 2]) == {6.0, 7.0, 8.0}
    assert set(whole[:, 1]) == {-1.0, 0.0, 1.0, 2.0, 3.0}
    assert set(whole[:, 0]) == {0.0, 1.0}
    assert len(np.unique(moved(np.random.default_rng(0), contexts, 9, bounds, whole=False)[:, 0])) > 500


def test_a_single_environments_own_methods_are_used() -> None:
    spec = read_spec("tests.test_accel:Own", context_visible=True)
    source = spec.generator()
    random = np.random.default_rng(0)
    assert source.sample(random, 3).tolist() == [[2.0], [2.0], [2.0]]
    assert source.edit(random, np.array([[2.0], [5.0]]), 3).tolist() == [[5.0], [8.0]]
    assert source.canonical(np.array([[2.5]])).tolist() == [[2.0]]
    whole = read_spec("tests.test_accel:Own", context_visible=True, kwargs={"silent": True}).generator()
    drawn = whole.sample(random, 300)
    assert set(drawn.ravel()) == set(range(1, 10))
    assert set((whole.edit(random, drawn, 1) - drawn).ravel()) == {-1.0, 0.0, 1.0}


def Own(*, silent: bool = False, wrong: str = "") -> Any:  # noqa: N802 - a class to whoever reads the config
    import gymnasium as gym

    class Env(gym.Env[Any, Any]):
        context_space = spaces.Box(np.array([1]), np.array([9]), dtype=np.int64)
        observation_space = spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32)
        action_space = spaces.Discrete(2)
        horizon = 5

    if not silent:
        answers: dict[str, Any] = {
            "": lambda self, rng, contexts, edits: contexts + edits,
            "shape": lambda self, rng, contexts, edits: contexts[:, 0],
            "few": lambda self, rng, contexts, edits: contexts[1:],
            "bounds": lambda self, rng, contexts, edits: contexts + 100,
            "words": lambda self, rng, contexts, edits: [["four"]] * len(contexts),
            "raises": lambda self, rng, contexts, edits: contexts[17],
        }
        Env.draw_contexts = lambda self, rng, n: np.full((n, 1), 2)  # type: ignore[attr-defined]
        Env.edit_contexts = answers[wrong]  # type: ignore[attr-defined]
        Env.canonical = lambda self, contexts: np.floor(contexts)  # type: ignore[attr-defined]
    return Env()


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("shape", r"edit_contexts gave an array of shape \(2,\), not \(2, 1\)"),
        ("few", r"edit_contexts gave an array of shape \(1, 1\), not of 2 rows"),
        ("bounds", r"edit_contexts gave a context with feature_0 = 102, not within \[1, 9\]"),
        ("words", "edit_contexts failed: ValueError: could not convert string to float"),
        ("raises", "edit_contexts failed: IndexError"),
    ],
)
def test_edits_that_are_no_contexts_are_refused(wrong: str, words: str) -> None:
    source = read_spec("tests.test_accel:Own", context_visible=True, kwargs={"wrong": wrong}).generator()
    with pytest.raises(ConfigError, match=f"env.id 'tests.test_accel:Own': {words}"):
        source.edit(np.random.default_rng(0), np.array([[2.0], [3.0]]), 3)


@pytest.mark.parametrize("env_id", sorted({*BATCHED} - {"space_dist/AntGoal-v0"}))
def test_every_other_world_of_ours_can_be_edited(env_id: str) -> None:
    spec, random = read_spec(env_id, context_visible=True), np.random.default_rng(0)
    source, bounds = spec.generator(), spec.context_bounds
    drawn = source.sample(random, 20)
    edited = source.edit(random, drawn, 5)
    for contexts in (drawn, edited):
        assert ((contexts >= bounds.low) & (contexts <= bounds.high)).all()
    assert (drawn != edited).any(axis=1).all()
    assert source.canonical(edited).shape == edited.shape


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ("buffer: 0", "curriculum.buffer"),
        ("edited: hardest", "curriculum.edited: 'hardest': Input should be 'easiest' or 'batch'"),
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
