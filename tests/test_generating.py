"""What makes contexts of an environment and edits them: mazes, numbers within bounds, and what is somebody's own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from space_dist.curricula.generating import Unheld
from space_dist.envs import BATCHED
from space_dist.envs.distributions import sample
from space_dist.envs.generating import moved
from space_dist.envs.mixed_maze import draw
from space_dist.envs.spec import read_spec
from space_dist.errors import ConfigError
from space_dist.instances import ContextBounds


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
    spec = read_spec("tests.test_generating:Own", context_visible=True)
    source = spec.generator()
    random = np.random.default_rng(0)
    assert source.sample(random, 3).tolist() == [[2.0], [2.0], [2.0]]
    assert source.edit(random, np.array([[2.0], [5.0]]), 3).tolist() == [[5.0], [8.0]]
    assert source.canonical(np.array([[2.5]])).tolist() == [[2.0]]
    whole = read_spec("tests.test_generating:Own", context_visible=True, kwargs={"silent": True}).generator()
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
    source = read_spec("tests.test_generating:Own", context_visible=True, kwargs={"wrong": wrong}).generator()
    with pytest.raises(ConfigError, match=f"env.id 'tests.test_generating:Own': {words}"):
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
