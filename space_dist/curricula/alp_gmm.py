"""ALP-GMM (Portelas et al. 2019): train where returns change most, as a Gaussian mixture over contexts sees it."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from space_dist.curricula.draws import Draws, distinct, mean_values, needed_episodes
from space_dist.curricula.interface import (
    GENERATED,
    BoolArray,
    Curriculum,
    Feedback,
    FloatArray,
    Numbers,
    Selection,
    State,
    Wants,
)
from space_dist.instances import ContextBounds, InstanceSet
from space_dist.seeding import Purpose, generator, seed_sequence

FEWEST_POINTS = 5  # with no more than these in the history, absolute learning progress is 0 (the authors' code)
FEWEST_COMPONENTS = 2  # of the mixtures that AIC chooses from (the authors' code)


@dataclass(frozen=True)
class MixtureState(State):
    """contexts, returns: (m, d), (m,) the history, oldest first; contexts in the unit cube.

    recent: (r, d + 1) contexts and absolute learning progress of the last episodes, oldest first.
    episodes: how many were counted so far.
    means, covariances: (k, d + 1), (k, d + 1, d + 1) of the mixture's components; k = 0 before the first fit.
    """

    contexts: FloatArray
    returns: FloatArray
    recent: FloatArray
    episodes: int
    means: FloatArray
    covariances: FloatArray


class AlpGmm(Curriculum):
    """Draws contexts from the components of a Gaussian mixture in proportion to their mean absolute learning progress.

    from_set: draw the instance nearest to a sample, instead of the sample itself.
    random_share: the chance of a draw to be uniform (over the set, or over the bounds).
    fit_rate: finished episodes between two fits, and the rows of a fit; until the first, all draws are uniform.
    history: finished episodes that are remembered for learning progress.
    components: the most that a mixture may have; AIC chooses.
    """

    state_type = MixtureState
    wants = Wants(episodes=True)

    def __init__(
        self, instances: InstanceSet, *, seed: int, draws: Draws, bounds: ContextBounds, from_set: bool,
        random_share: float, fit_rate: int, history: int, components: int,
    ) -> None:  # fmt: skip
        self._instances, self._seed, self._draws, self._bounds = instances, seed, draws, bounds
        self._from_set, self._random_share = from_set, random_share
        self._fit_rate, self._history, self._components = fit_rate, history, components
        self._nearest = KDTree(self._to_cube(instances.contexts))

    def start(self) -> tuple[MixtureState, Selection]:
        """Nothing is known: all draws are uniform."""
        d = len(self._bounds.names)
        state = MixtureState(
            0, contexts=np.zeros((0, d)), returns=np.zeros(0), recent=np.zeros((0, d + 1)), episodes=0,
            means=np.zeros((0, d + 1)), covariances=np.zeros((0, d + 1, d + 1)),
        )  # fmt: skip
        return state, self.selection(state)

    def step(self, state: MixtureState, feedback: Feedback) -> tuple[MixtureState, Selection, Numbers]:
        """Take in the finished episodes one by one; fit where `fit_rate` of them are complete."""
        episodes = needed_episodes(feedback, "ALP-GMM")
        contexts, returns = state.contexts, state.returns
        recent, means, covariances = state.recent, state.means, state.covariances
        count = state.episodes
        new_contexts = self._to_cube(episodes.contexts)
        fit_rows: FloatArray | None = None
        for context, value in zip(new_contexts, episodes.returns, strict=True):
            progress = absolute_progress(context, float(value), contexts, returns)
            contexts = np.concatenate([contexts, context[None]])[-self._history :]
            returns = np.append(returns, value)[-self._history :]
            recent = np.concatenate([recent, [[*context, progress]]])[-self._fit_rate :]
            count += 1
            if count % self._fit_rate == 0:
                fit_rows, fitted_at = recent, count
        if fit_rows is not None:  # an earlier fit of the same iteration would never be drawn from
            root = seed_sequence(self._seed, Purpose.MIXTURE, fitted_at).generate_state(1, np.uint32)[0]
            means, covariances = fit_mixture(fit_rows, self._components, int(root))
        new = MixtureState(state.version + 1, contexts, returns, recent, count, means, covariances)
        numbers: Numbers = {
            "size": distinct(feedback) if self._from_set else len(episodes.indices),
            **mean_values(feedback),
            "finished_episodes": count,
            "fitted": fit_rows is not None,
            "components": len(means),
            "mean_progress": float(recent[:, -1].mean()) if len(recent) else None,
        }
        return new, self.selection(new), numbers

    def selection(self, state: MixtureState) -> Selection:
        """The draws of one iteration: a pure function of (seed, version, mixture)."""
        random = generator(self._seed, Purpose.DRAWS, state.version)
        count, n, d = self._draws.count, len(self._instances), len(self._bounds.names)
        uniform = random.random((count, d))
        instances = random.integers(n, size=count)
        # All of it is drawn whether or not a mixture is there: what is uniform does not depend on that.
        at_random: BoolArray = random.random(count) < self._random_share
        if len(state.means):
            drawn = self._from_mixture(state, random)
            instances = np.where(at_random, instances, self._nearest.query(drawn)[1])
            uniform = np.where(at_random[:, None], uniform, drawn)
        if self._from_set:
            ids, contexts = self._instances.ids[instances], self._instances.contexts[instances]
        else:
            low, high = self._bounds.low, self._bounds.high
            ids, contexts = np.full(count, GENERATED), np.clip(low + uniform * (high - low), low, high)
        deal = self._draws.dealt
        return Selection(state.version, deal(ids), deal(contexts), order_version=state.version, drawn=True)

    def _from_mixture(self, state: MixtureState, random: np.random.Generator) -> FloatArray:
        """`(count, d)` samples in the unit cube."""
        chances = component_chances(state.means[:, -1])
        chosen = random.choice(len(chances), size=self._draws.count, p=chances)
        normal = random.standard_normal((self._draws.count, state.means.shape[1]))
        roots = np.linalg.cholesky(state.covariances)
        samples = state.means[chosen] + np.einsum("nij,nj->ni", roots[chosen], normal)
        # Without the last feature, which is the learning progress.
        clipped: FloatArray = np.clip(samples[:, :-1], 0.0, 1.0)
        return clipped

    def _to_cube(self, contexts: FloatArray) -> FloatArray:
        return (self._bounds.scale(contexts) + 1.0) / 2.0


def absolute_progress(context: FloatArray, value: float, contexts: FloatArray, returns: FloatArray) -> float:
    """|value - the return of the nearest context of the history|; 0 while the history has no more than five.

    context: (d,), contexts: (m, d), returns: (m,), oldest first. Of equally near ones the newest counts: in a finite
    set that is the last time the instance was played. Portelas et al. 2019 have continuous contexts, where none are
    equal; the kd-tree of their code returns whichever it meets first.
    """
    if len(contexts) <= FEWEST_POINTS:
        return 0.0
    distances = ((contexts - context) ** 2).sum(axis=1)
    nearest = len(distances) - 1 - int(distances[::-1].argmin())
    return abs(value - float(returns[nearest]))


def component_chances(progress: FloatArray) -> FloatArray:
    """`(k,)` in proportion to the components' mean absolute learning progress; equal ones where there is none."""
    weights = np.maximum(progress, 0.0)
    total = weights.sum()
    return weights / total if total > 0.0 else np.full(len(weights), 1.0 / len(weights))


def fit_mixture(rows: FloatArray, most: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Means (k, d) and covariances (k, d, d) of the mixture of 2 to `most` components with the lowest AIC.

    rows: (m, d); there are never more components than rows.
    """
    from sklearn.mixture import GaussianMixture  # a second to import, and only this curriculum needs it
    from threadpoolctl import threadpool_limits

    # One thread: the bits of a product depend on how many share it.
    with warnings.catch_warnings(), threadpool_limits(limits=1):
        warnings.simplefilter("ignore")  # rows may repeat, and not every mixture need converge to be compared
        counts = range(FEWEST_COMPONENTS, min(most, len(rows)) + 1)
        fits = [GaussianMixture(count, covariance_type="full", random_state=seed).fit(rows) for count in counts]
    best = min(fits, key=lambda fit: float(fit.aic(rows)))
    return best.means_, best.covariances_
