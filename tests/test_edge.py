"""Edge, our curriculum: memory, neighbours, the critic's word and chances, against other people's arithmetic."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import scipy.optimize
import scipy.stats
from numpy.typing import NDArray

from space_dist import config as configs
from space_dist.curricula import Draws, edge
from space_dist.curricula.edge import Edge, EdgeState
from space_dist.errors import ConfigError
from space_dist.instances import ContextBounds
from tests.test_every_curriculum import set_up
from tests.test_learning_progress import told
from tests.test_rivals import SPACE, instances

Floats = NDArray[np.float64]


def made(n: int = 4, **changes: Any) -> Edge:
    settings: dict[str, Any] = {
        "outcome": "success", "lowest": 0.0, "largest": 1.0, "memory": 0.5, "width": 0.0, "strength": 0.0,
        "uniform_share": 0.2,
    }  # fmt: skip
    train = instances(n)
    names = train.names
    bounds = ContextBounds(names, np.full(len(names), -1.0), np.full(len(names), float(2 * n)))
    return Edge(train, seed=0, draws=Draws(40, 2), bounds=bounds, **{**settings, **changes})


def test_three_iterations_by_hand() -> None:
    # Without neighbours and critic: an instance is what was played on it, and one that was not counts as even.
    curriculum = made()
    state, selection = curriculum.start()
    assert state.chances.tolist() == [0.25] * 4
    assert len(selection.ids) == 40
    state, _, numbers = curriculum.step(state, told(0, [0, 0, 1, 0, 0], [1.0, 0.0, 0.0, 1.0, 0.0]))
    assert (state.won.tolist(), state.lost.tolist()) == ([2.0, 0, 0, 0], [2.0, 1.0, 0, 0])
    # Beta(2, 2): 4 / (4 * 5) = 1/5. Beta(0, 1): 0. Nothing: 1/6. Squares: 1/25, 0, 1/36, 1/36.
    assert numbers["largest_edge"] == pytest.approx(0.2)
    squares = np.array([1 / 25, 0.0, 1 / 36, 1 / 36])
    np.testing.assert_allclose(state.chances, 0.05 + 0.8 * squares / squares.sum())
    # Half of it is forgotten; instance 1 succeeds twice.
    state, _, numbers = curriculum.step(state, told(1, [1, 1], [1.0, 1.0]))
    assert (state.won.tolist(), state.lost.tolist()) == ([1.0, 2.0, 0, 0], [1.0, 0.5, 0, 0])
    assert numbers["remembered"] == 4.5
    # Beta(1, 1): 1/6; Beta(2, 1/2): 1 / (2.5 * 3.5).
    squares = np.array([1 / 6, 1 / 8.75, 1 / 6, 1 / 6]) ** 2
    np.testing.assert_allclose(state.chances, 0.05 + 0.8 * squares / squares.sum())
    # Where no episode ends, only time passes; in the end nothing is left, not even a last digit.
    for version in range(2, 15):
        state, _, _ = curriculum.step(state, told(version, [], []))
    assert not state.won.any()
    assert not state.lost.any()
    assert state.chances.tolist() == [0.25] * 4


def test_what_is_solved_everywhere_is_drawn_alike() -> None:
    state = EdgeState(0, np.full(4, 0.25), won=np.full(4, 30.0), lost=np.zeros(4))
    state, _, numbers = made().step(state, told(0, [0, 1], [1.0, 1.0]))
    assert numbers["largest_edge"] == 0.0
    assert state.chances.tolist() == [0.25] * 4


def test_neighbours_count_by_their_distance(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(0)
    places, won, lost = random.uniform(size=(7, 2)), random.uniform(size=7), random.uniform(size=7)
    won[2] = lost[2] = 0.0
    expected = [[sum(math.exp(-(math.dist(a, b) ** 2) / (2 * 0.3**2)) * count for b, count in zip(places, of,
                                                                                             strict=True))
                 for a in places] for of in (won, lost)]  # fmt: skip
    np.testing.assert_allclose(edge.neighbours(places, 0.3, won, lost), expected, rtol=1e-12)
    whole = edge.neighbours(places, 0.3, won, lost)
    monkeypatch.setattr(edge, "_CHUNK", 1)  # one instance at a time
    np.testing.assert_allclose(edge.neighbours(places, 0.3, won, lost), whole, rtol=1e-15)
    assert edge.neighbours(places, 0.0, won, lost) == (won, lost)
    nothing = np.zeros(7)
    assert not np.any(edge.neighbours(places, 0.3, nothing, nothing))


def least(values: Floats, won: Floats, lost: Floats) -> Floats:
    """The chances of the critic's word, by SciPy's optimiser from the penalised likelihood itself."""
    mean = np.average(values, weights=won + lost)
    z = (values - mean) / math.sqrt(np.average((values - mean) ** 2, weights=won + lost))

    def cost(ab: Floats) -> float:
        x = ab[0] + ab[1] * z
        likelihood = -(won * np.logaddexp(0.0, -x) + lost * np.logaddexp(0.0, x)).sum()
        return float(-likelihood + 0.05 * ab[0] ** 2 + 0.5 * ab[1] ** 2)

    found = scipy.optimize.minimize(cost, np.zeros(2), method="BFGS", options={"gtol": 1e-9}).x
    return 1.0 / (1.0 + np.exp(-(found[0] + found[1] * z)))


@pytest.mark.parametrize("seed", range(5))
def test_the_critics_word_is_the_most_likely_one(seed: int) -> None:
    random = np.random.default_rng(seed)
    values, episodes = random.normal(size=30), random.integers(0, 5, size=30)
    won = random.binomial(episodes, 1.0 / (1.0 + np.exp(-3.0 * values))).astype(np.float64)
    lost = episodes - won
    word = edge.critics_word(values, won, lost)
    np.testing.assert_allclose(word, least(values, won, lost), atol=1e-6)
    # In other units of reward, with another worth of failure: the same word.
    np.testing.assert_allclose(edge.critics_word(1000.0 * values - 7.0, won, lost), word, rtol=1e-9)


def test_the_critic_has_nothing_to_say_of_what_it_does_not_tell_apart() -> None:
    values = np.array([0.3, 0.3, 0.3])
    assert edge.critics_word(values, np.zeros(3), np.zeros(3)).tolist() == [0.5] * 3
    word = edge.critics_word(values, np.array([3.0, 0.0, 0.0]), np.array([0.0, 9.0, 0.0]))
    assert len(set(word.tolist())) == 1
    assert word[0] == pytest.approx(0.25, abs=0.02)
    # Nor is it overheard where everything, or nothing, succeeds: it is never sure.
    for won, lost in ((50.0, 0.0), (0.0, 50.0)):
        word = edge.critics_word(np.array([-1.0, 0.0, 1e6]), np.full(3, won), np.full(3, lost))
        assert np.isfinite(word).all()
        assert 0.0 < word.min() <= word.max() < 1.0


def test_the_edge_is_the_expected_variance_of_success() -> None:
    successes, failures = np.array([0.5, 2.0, 7.5, 1e-3]), np.array([0.5, 1.0, 0.25, 4.0])
    expected = []
    for a, b in zip(successes, failures, strict=True):
        of_p = scipy.stats.beta(a, b)
        expected.append(of_p.mean() - of_p.moment(2))
    np.testing.assert_allclose(edge.variance(successes, failures), expected, rtol=1e-9)
    assert edge.variance(np.zeros(1), np.zeros(1))[0] == pytest.approx(scipy.stats.beta(1, 1).mean() / 3)


def test_the_first_success_makes_its_neighbours_likely() -> None:
    curriculum = made(8, width=0.15, strength=4.0, memory=0.9, uniform_share=0.1)
    state, _ = curriculum.start()
    state, _, _ = curriculum.step(state, told(0, [*range(8)], [0.0] * 8, n=8))
    # Nothing has succeeded: breadth. The ends of the line have fewer neighbours, whose failures count.
    assert state.chances.max() < 1.25 * state.chances.min()
    state, _, _ = curriculum.step(state, told(1, [*range(8)], [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0], n=8))
    order = np.argsort(-state.chances)
    assert order[0] == 2
    assert set(order[:3].tolist()) == {1, 2, 3}
    assert state.chances.min() >= 0.1 / 8  # nothing is ever given up


def test_returns_count_as_declared() -> None:
    curriculum = made(outcome="return", lowest=-10.0, largest=30.0)
    returns = [-20.0, 0.0, 10.0, 50.0]
    state, _, _ = curriculum.step(curriculum.start()[0], told(0, [0, 1, 2, 3], [math.nan] * 4, returns=returns))
    assert state.won.tolist() == [0.0, 0.25, 0.5, 1.0]
    assert state.lost.tolist() == [1.0, 0.75, 0.5, 0.0]
    assert not curriculum.wants.success
    assert made().wants.success


def test_success_must_be_known_before_the_run_starts() -> None:
    silent = "env.id=tests.test_every_curriculum:make_silent"
    with pytest.raises(ConfigError, match="edge needs to know whether an episode succeeded"):
        set_up("curriculum={kind: edge}", silent)
    set_up("curriculum={kind: edge, outcome: return, largest_return: 5}", silent)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ("outcome: return, lowest_return: 2, largest_return: 1", "lowest_return: 2 must be below largest_return: 1"),
        ("outcome: return", "outcome: return needs largest_return"),
        ("outcome: return, lowest_return: -1", "outcome: return needs largest_return"),
        ("memory: 1", "curriculum.memory"),
        ("width: -0.1", "curriculum.width"),
        ("strenght: 2", "did you mean 'strength'?"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings: str, words: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        configs.load(SPACE, [f"curriculum={{kind: edge, {settings}}}"])
    assert words in str(refusal.value)
