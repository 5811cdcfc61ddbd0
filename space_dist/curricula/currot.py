"""CURROT (Klink et al. 2022, "Curriculum Reinforcement Learning via Constrained Optimal Transport").

Contexts move to a target distribution on the shortest way, as far as the policy is expected to do well enough on them:

    minimise W2(p, target)    subject to    p(J(c) >= delta) = 1    and    W2(p_old, p) <= epsilon

p is a set of particles. Optimal transport gives each a goal among samples of the target; each moves towards its goal,
by epsilon at most, to the nearest context of which the episodes nearby say that delta is reached. What is ours is in
docs/curricula.md ("CURROT"). All of it is computed in the unit cube: each feature from 0 to 1 between its bounds.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from space_dist.curricula.draws import Draws, distinct, mean_values, needed_episodes
from space_dist.curricula.gaussian import Gaussian
from space_dist.curricula.interface import (
    GENERATED,
    BoolArray,
    Curriculum,
    Feedback,
    FloatArray,
    IntArray,
    Numbers,
    Selection,
    State,
    Wants,
)
from space_dist.instances import ContextBounds, InstanceSet
from space_dist.seeding import Purpose, generator

BANDWIDTH = 0.3  # of the kernel, as a share of epsilon (the published code)
TRIED = 100  # random steps of each particle, from which the best is taken (the published code)
SEARCH_SPREAD = 0.25  # standard deviation of a search around a context of the worst return (the published code)
LEAST_SPREAD = 0.005  # around one that reached delta, as a share of epsilon (the published code)
JITTER = 1e-3  # of a generated context about its particle, to both sides (the published code)
_MOVE, _FIRST = 1, 2  # streams of random numbers beside that of the draws


@dataclass(frozen=True)
class TransportState(State):
    """All contexts are in the unit cube, performances in reward units.

    particles: (p, d) what the next contexts are drawn from.
    kept, kept_performance: (s, d), (s,) episodes that reached delta; until half of them do, the best so far.
    others, others_performance: (f, d), (f,) the last other episodes since then, oldest first.
    reached: whether half of what is kept has reached delta.
    lowest: the worst performance of the first iteration in which an episode ended; None before.
    """

    particles: FloatArray
    kept: FloatArray
    kept_performance: FloatArray
    others: FloatArray
    others_performance: FloatArray
    reached: bool
    lowest: float | None


class Transport(Curriculum):
    """Contexts from particles on their way to a target, which wait for the policy.

    from_set: draw the instance nearest to a particle, instead of the particle itself.
    target: what particles move to; None: the instances.
    delta: the performance that is to be expected, in reward units; discounted: of discounted returns.
    epsilon: how far a particle moves in one iteration, in the unit cube.
    particles: how many there are, and episodes of each sort that are remembered.
    """

    state_type = TransportState
    wants = Wants(episodes=True)

    def __init__(
        self, instances: InstanceSet, *, seed: int, draws: Draws, bounds: ContextBounds, from_set: bool,
        target: Gaussian | None, delta: float, discounted: bool, epsilon: float, particles: int,
    ) -> None:  # fmt: skip
        self._instances, self._seed, self._draws, self._bounds = instances, seed, draws, bounds
        self._from_set, self._target, self._delta, self._discounted = from_set, target, delta, discounted
        self._epsilon, self._count = epsilon, particles
        self._contexts = self._to_cube(instances.contexts)
        self._nearest = KDTree(self._contexts)

    def start(self) -> tuple[TransportState, Selection]:
        """Particles all over the bounds."""
        d = len(self._bounds.names)
        particles = generator(self._seed, Purpose.DRAWS, 0, _FIRST).random((self._count, d))
        nothing = (np.zeros((0, d)), np.zeros(0))
        state = TransportState(0, particles, *nothing, *nothing, reached=False, lowest=None)
        return state, self.selection(state)

    def step(self, state: TransportState, feedback: Feedback) -> tuple[TransportState, Selection, Numbers]:
        """Remember the finished episodes, and move."""
        episodes = needed_episodes(feedback, "CURROT")
        random = generator(self._seed, Purpose.DRAWS, state.version, _MOVE)
        targets = self._targets(random)
        new = dataclasses.replace(state, version=state.version + 1)
        expected = distance = None
        if len(episodes.indices) or state.lowest is not None:  # something is known
            performance = episodes.discounted_returns if self._discounted else episodes.returns
            memory = remembered(new, self._to_cube(episodes.contexts), performance, targets, self._delta, self._count)
            estimate = Estimate.of(memory, BANDWIDTH * self._epsilon)
            moved = self._moved(state.particles, memory, estimate, targets, random)
            new = dataclasses.replace(memory, particles=moved.particles)
            expected, distance = float(estimate(moved.particles).mean()), float(moved.distances.mean())
        numbers: Numbers = {
            "size": distinct(feedback) if self._from_set else len(episodes.indices),
            **mean_values(feedback),
            "reached": new.reached,
            "kept": int((new.kept_performance >= self._delta).sum()),
            "expected_performance": expected,
            "distance_to_target": distance,
        }
        low, width = self._bounds.low, self._bounds.high - self._bounds.low
        for which, some in (("", new.particles), ("target_", targets)):
            means, deviations = low + some.mean(axis=0) * width, some.std(axis=0) * width
            for name, mean, std in zip(self._bounds.names, means.tolist(), deviations.tolist(), strict=True):
                numbers |= {f"{which}mean_{name}": mean, f"{which}std_{name}": std}
        return new, self.selection(new), numbers

    def selection(self, state: TransportState) -> Selection:
        """The draws of one iteration: a pure function of (seed, version, particles)."""
        random, count = generator(self._seed, Purpose.DRAWS, state.version), self._draws.count
        drawn = state.particles[random.integers(len(state.particles), size=count)]
        if self._from_set:
            places = self._nearest.query(drawn)[1]
            ids, contexts = self._instances.ids[places], self._instances.contexts[places]
        else:
            low, high = self._bounds.low, self._bounds.high
            drawn = drawn + random.uniform(-JITTER, JITTER, size=drawn.shape)
            ids, contexts = np.full(count, GENERATED), np.clip(low + drawn * (high - low), low, high)
        deal = self._draws.dealt
        return Selection(state.version, deal(ids), deal(contexts), order_version=state.version, drawn=True)

    def _moved(
        self, particles: FloatArray, memory: TransportState, estimate: Estimate, targets: FloatArray,
        random: np.random.Generator,
    ) -> Moved:  # fmt: skip
        proposed = proposals(memory, random, self._delta, LEAST_SPREAD * self._epsilon, len(particles))
        begun, reach = restarted(particles, proposed, estimate, self._delta)
        steps = balls(random, begun.shape)
        return transported(begun, targets, estimate, reach, steps, self._delta, self._epsilon)

    def _targets(self, random: np.random.Generator) -> FloatArray:
        """`(p, d)` samples of the target; each instance as often as any other, but for a rest at random."""
        if self._target is not None:
            low, high = self._bounds.low, self._bounds.high
            return self._to_cube(np.clip(self._target.sample(random, self._count), low, high))
        n = len(self._contexts)
        rest = random.choice(n, size=self._count % n, replace=False)
        samples: FloatArray = self._contexts[np.concatenate([np.tile(np.arange(n), self._count // n), rest])]
        return samples

    def _to_cube(self, contexts: FloatArray) -> FloatArray:
        return (self._bounds.scale(contexts) + 1.0) / 2.0


class Estimate(NamedTuple):
    """The performance that is to be expected on a context: a mean of episodes' by a Gaussian kernel.

    contexts: (m, d).  performance: (m,).  bandwidth: standard deviation of the kernel.
    """

    contexts: FloatArray
    performance: FloatArray
    bandwidth: float

    @classmethod
    def of(cls, memory: TransportState, bandwidth: float) -> Estimate:
        """Of all episodes that are remembered."""
        return cls(
            np.concatenate([memory.kept, memory.others]),
            np.concatenate([memory.kept_performance, memory.others_performance]),
            bandwidth,
        )

    def __call__(self, points: FloatArray) -> FloatArray:
        """`(k,)` of (k, d) points; far from all episodes that of the nearest."""
        logs = -cdist(points, self.contexts, "sqeuclidean") / (2.0 * self.bandwidth**2)
        weights = np.exp(logs - logs.max(axis=1, keepdims=True))
        mean: FloatArray = (weights * self.performance).sum(axis=1) / weights.sum(axis=1)
        return mean


class Moved(NamedTuple):
    """particles: (p, d) after a move.  distances: (p,) of each to its goal."""

    particles: FloatArray
    distances: FloatArray


def remembered(
    state: TransportState, contexts: FloatArray, performance: FloatArray, targets: FloatArray, delta: float, most: int
) -> TransportState:  # fmt: skip
    """The state with what an iteration's (m, d) contexts and (m,) performances say; at most `most` of each sort.

    Until half of what is kept has reached delta, the best are kept, of equal ones the newest. Then only what reaches
    delta comes in, each in the place of one that does not; where there is none, those stay that optimal transport gives
    to the (p, d) samples of the target. Of the new ones those that are not kept are among the others.
    """
    m, before = len(performance), len(state.kept)
    pool, reward = np.concatenate([state.kept, contexts]), np.concatenate([state.kept_performance, performance])
    lowest = float(performance.min()) if state.lowest is None else state.lowest
    if not state.reached:
        best = np.lexsort((np.arange(before + m), reward))[-most:]
        reached = bool(np.median(reward[best]) >= delta)
        return dataclasses.replace(
            state, kept=pool[best], kept_performance=reward[best], reached=reached, lowest=lowest
        )  # fmt: skip
    enters = np.flatnonzero(performance >= delta) + before
    by_reward = np.argsort(state.kept_performance, kind="stable")
    leaves = by_reward[state.kept_performance[by_reward] < delta][: len(enters)]
    stays = np.concatenate([np.setdiff1d(np.arange(before), leaves), enters])
    if len(stays) > most:
        stays = np.sort(stays[assigned(targets[:most], pool[stays])])
    apart = np.setdiff1d(np.arange(before, before + m), stays)
    others = np.concatenate([state.others, pool[apart]])[-most:]
    others_performance = np.concatenate([state.others_performance, reward[apart]])[-most:]
    return dataclasses.replace(
        state, kept=pool[stays], kept_performance=reward[stays], others=others, others_performance=others_performance
    )


def assigned(goals: FloatArray, points: FloatArray) -> IntArray:
    """`(g,)` for each of (g, d) goals a point of its own, of (k, d) with k >= g: the least sum of squared distances."""
    places: IntArray = linear_sum_assignment(cdist(goals, points, "sqeuclidean"))[1]
    return places


def proposals(
    memory: TransportState, random: np.random.Generator, delta: float, least: float, count: int
) -> FloatArray:  # fmt: skip
    """`(count, d)` contexts near those that are kept: the farther, the more these lack of delta.

    Until delta is reached, near the better half of them, by chances in proportion to what they are better by than the
    other half. Then near each of them, and as many at random as are missing.
    """
    reward, chosen = memory.kept_performance, np.arange(len(memory.kept))[:count]
    if memory.reached:
        chosen = np.concatenate([chosen, random.integers(len(reward), size=count - len(chosen))])
    else:
        order = np.argsort(reward, kind="stable")
        half = len(order) // 2
        better = order[half:]
        gain = reward[better] - reward[order[max(half - 1, 0)]]
        chances = gain / gain.sum() if gain.any() else np.full(len(better), 1.0 / len(better))
        chosen = random.choice(better, size=count, p=chances)
    width = delta - (reward.min() if memory.lowest is None else memory.lowest)
    lack = np.clip(delta - reward[chosen], 0.0, width) / width if width > 0.0 else np.zeros(count)
    spread = least + SEARCH_SPREAD * lack
    found = memory.kept[chosen] + spread[:, None] * random.standard_normal((count, memory.kept.shape[1]))
    # Reflected at the bounds: clipped, many would lie on them.
    return np.clip(1.0 - np.abs(1.0 - np.abs(found)), 0.0, 1.0)


def restarted(
    particles: FloatArray, proposed: FloatArray, estimate: Estimate, delta: float
) -> tuple[FloatArray, BoolArray]:  # fmt: skip
    """The particles, those of which delta is not expected replaced, and whether delta is expected of each now.

    They are replaced by as many of the proposals, together the nearest; by such as reach delta, if there are enough.
    """
    reach: BoolArray = estimate(particles) >= delta
    failing = np.flatnonzero(~reach)
    if not len(failing):
        return particles, reach
    good = estimate(proposed) >= delta
    if good.sum() >= len(failing):
        proposed, good = proposed[good], good[good]
    places = assigned(particles[failing], proposed)
    begun, reach = particles.copy(), reach.copy()
    begun[failing], reach[failing] = proposed[places], good[places]
    return begun, reach


def balls(random: np.random.Generator, shape: tuple[int, ...]) -> FloatArray:
    """`(p, TRIED, d)` points, all over the unit ball, for `shape` (p, d)."""
    count, d = shape
    direction = random.standard_normal((count, TRIED, d))
    length = np.sqrt((direction**2).sum(axis=2, keepdims=True))
    radius = random.random((count, TRIED, 1)) ** (1.0 / d)
    ball: FloatArray = radius * direction / length
    return ball


def transported(
    particles: FloatArray, targets: FloatArray, estimate: Estimate, reach: BoolArray, steps: FloatArray, delta: float,
    epsilon: float,
) -> Moved:  # fmt: skip
    """The (p, d) particles, each moved towards the sample of the target that optimal transport gives it.

    A particle stays, takes the straight step, or one of its (TRIED, d) `steps` in the unit ball, scaled to epsilon or
    to the distance that is left; where delta is expected of it (`reach`), mirrored to lead nearer. It takes the one
    that ends nearest to its goal among those of which delta is expected, or else the one of which most is.
    """
    goals, ends = targets[assigned(particles, targets)], particles.copy()
    for place, (start, goal) in enumerate(zip(particles, goals, strict=True)):
        gap = goal - start
        distance = float(np.sqrt((gap**2).sum()))
        if distance == 0.0:
            continue
        radius, ahead = min(epsilon, distance), gap / distance
        ball = steps[place]
        along = (ball * ahead).sum(axis=1)
        if reach[place]:
            ball = ball - 2.0 * np.minimum(along, 0.0)[:, None] * ahead
        tried = np.clip(start + radius * np.concatenate([np.zeros((1, len(gap))), ahead[None], ball]), 0.0, 1.0)
        expected = estimate(tried)
        left = np.where(expected >= delta, ((tried - goal) ** 2).sum(axis=1), np.inf)
        ends[place] = tried[left.argmin() if np.isfinite(left).any() else expected.argmax()]
    return Moved(ends, np.sqrt(((ends - goals) ** 2).sum(axis=1)))
