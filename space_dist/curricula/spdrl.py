"""Self-paced deep reinforcement learning (SPDRL; Klink et al. 2020): a normal distribution of contexts on its way.

It starts where it is told to and is pulled towards a target distribution, as fast as the policy's values allow: after
an iteration, maximise

    mean_j [ p(c_j) / p_old(c_j) * V(s0, c_j) ] - alpha * KL(p || target)    subject to    KL(p_old || p) <= epsilon

over the iteration's contexts c_j. Its contexts are generated, so they are of no instance set; evaluation stays on the
instance sets of everyone. docs/curricula.md ("SPDRL") names what the published code does.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeVar

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import BFGS, Bounds, NonlinearConstraint, minimize
from scipy.sparse.linalg import cg

from space_dist.curricula.draws import Draws, mean_values, needed_episodes
from space_dist.curricula.gaussian import Gaussian
from space_dist.curricula.interface import (
    GENERATED,
    Curriculum,
    Feedback,
    FloatArray,
    Numbers,
    Selection,
    State,
    Wants,
)
from space_dist.instances import ContextBounds
from space_dist.seeding import Purpose, generator

LARGEST_ALPHA = 1e5  # the published code's: at the target the divergence is 0, and alpha would be no number
SMALLEST_KL = 1e-10  # what alpha is divided by at least
_LARGEST_LOG_RATIO = 50.0  # of densities; far outside any trust region
_GTOL, _XTOL = 1e-4, 1e-6  # of trust-constr, as in the published code
_FIRST_RADII = (1.0, 0.1, 0.01)  # of trust-constr; SciPy's own, and what is tried where that led nowhere
_CG_STEPS = 10  # iterations for a direction, at most
_LINE_SEARCH_STEPS, _SHRINK = 20, 0.8

Optimiser = Literal["trust_constr", "conjugate_gradient"]
Answer = TypeVar("Answer", float, FloatArray)


@dataclass(frozen=True)
class ContextState(State):
    """mean: (d,), factor: (d, d): the distribution that the next contexts are drawn from, as `Gaussian`.

    updates: how often it was asked to move ("teacher iterations").
    """

    mean: FloatArray
    factor: FloatArray
    updates: int

    @property
    def distribution(self) -> Gaussian:
        """What contexts are drawn from."""
        return Gaussian(self.mean, self.factor)


class Step(NamedTuple):
    """One move of the distribution, whether it was taken, and how many iterations the optimiser made.

    refused: how often the search had to turn back from a proposal whose density or divergence is no number.
    """

    distribution: Gaussian
    accepted: bool
    iterations: int
    refused: int = 0


class SelfPaced(Curriculum):
    """Contexts from a normal distribution that moves from `initial` to `target`.

    zeta, offset: of the schedule of alpha.
    epsilon: the trust region, KL(p_old || p), in nats.
    warm_up: iterations before the distribution first moves.
    least_std, least_std_until: log diag L stays at or above log `least_std` (d,) while KL(p || target) is above
        `least_std_until` nats; None: no such limit.
    """

    state_type = ContextState
    wants = Wants(episodes=True)

    def __init__(
        self, *, seed: int, draws: Draws, bounds: ContextBounds, initial: Gaussian, target: Gaussian,
        zeta: float, offset: int, epsilon: float, warm_up: int, optimiser: Optimiser,
        least_std: FloatArray | None, least_std_until: float,
    ) -> None:  # fmt: skip
        self._seed, self._draws, self._bounds = seed, draws, bounds
        self._initial, self._target = initial, target
        self._zeta, self._offset, self._epsilon, self._warm_up = zeta, offset, epsilon, warm_up
        self._optimiser = optimiser
        self._least_std, self._least_std_until = least_std, least_std_until

    def start(self) -> tuple[ContextState, Selection]:
        """The initial distribution."""
        state = ContextState(0, self._initial.mean, self._initial.factor, updates=0)
        return state, self.selection(state)

    def step(self, state: ContextState, feedback: Feedback) -> tuple[ContextState, Selection, Numbers]:
        """Move the distribution, once the warm-up is over."""
        episodes = needed_episodes(feedback, "SPDRL")
        old, updates = state.distribution, state.updates
        performance = float(episodes.discounted_returns.mean()) if len(episodes.indices) else None
        to_target = old.kl_to(self._target)
        moved, alpha = Step(old, False, 0), None
        if state.version >= self._warm_up and performance is not None:  # nothing to go by where no episode ended
            updates += 1
            alpha = weight_of_target(updates, self._offset, self._zeta, performance, to_target)
            limit = self._least_std if to_target > self._least_std_until else None
            move = {"trust_constr": by_trust_region, "conjugate_gradient": by_conjugate_gradient}[self._optimiser]
            moved = move(
                Objective(old, self._target, episodes.contexts, episodes.start_values, alpha), self._epsilon, limit
            )
        new = ContextState(state.version + 1, moved.distribution.mean, moved.distribution.factor, updates)
        numbers: Numbers = {
            "size": len(episodes.indices),
            **mean_values(feedback),
            "mean_discounted_return": performance,
            "alpha": alpha,
            "kl_to_target": moved.distribution.kl_to(self._target),
            "kl_step": old.kl_to(moved.distribution),
            "moved": moved.accepted,
            "optimiser_iterations": moved.iterations,
            "refused_proposals": moved.refused,
        }
        for which, one in (("", moved.distribution), ("target_", self._target)):
            for name, mean, std in zip(self._bounds.names, one.mean.tolist(), one.std.tolist(), strict=True):
                numbers |= {f"{which}mean_{name}": mean, f"{which}std_{name}": std}
        return new, self.selection(new), numbers

    def selection(self, state: ContextState) -> Selection:
        """The contexts of one iteration, clipped to the bounds: a pure function of (seed, version, distribution)."""
        random = generator(self._seed, Purpose.DRAWS, state.version)
        drawn = state.distribution.sample(random, self._draws.count)
        contexts = self._draws.dealt(np.clip(drawn, self._bounds.low, self._bounds.high))
        ids = np.full(len(contexts), GENERATED)
        return Selection(state.version, ids, contexts, order_version=state.version, drawn=True)


def weight_of_target(update: int, offset: int, zeta: float, performance: float, to_target: float) -> float:
    """Alpha of the update-th move, counted from 1: 0 before the `offset`-th, then as large as performance allows.

    performance: mean discounted return, in reward units.  to_target: KL(p || target), in nats.
    """
    if update < offset:
        return 0.0
    return min(LARGEST_ALPHA, zeta * max(0.0, performance) / max(to_target, SMALLEST_KL))


@dataclass(frozen=True)
class Objective:
    """What a move maximises. contexts: (m, d) drawn from `old`; values: (m,) their start values, in reward units."""

    old: Gaussian
    target: Gaussian
    contexts: FloatArray
    values: FloatArray
    alpha: float

    def value(self, parameters: FloatArray) -> float:
        """mean_j [ p(c_j) / p_old(c_j) V_j ] - alpha KL(p || target)."""
        new = Gaussian.from_parameters(parameters)
        return float((self._ratios(new) * self.values).mean() - self.alpha * new.kl_to(self.target))

    def gradient(self, parameters: FloatArray) -> FloatArray:
        """Of `value`, by the parameters."""
        new = Gaussian.from_parameters(parameters)
        weights = self._ratios(new) * self.values / len(self.values)
        gradient = new.log_density_gradient(self.contexts, weights)
        if self.alpha:
            gradient = gradient - self.alpha * new.kl_to_gradient(self.target)
        return gradient

    def step_size(self, parameters: FloatArray) -> float:
        """KL(p_old || p)."""
        return self.old.kl_to(Gaussian.from_parameters(parameters))

    def step_size_gradient(self, parameters: FloatArray) -> FloatArray:
        """Of `step_size`, by the parameters."""
        return Gaussian.from_parameters(parameters).kl_from_gradient(self.old)

    def _ratios(self, new: Gaussian) -> FloatArray:
        logs = new.log_density(self.contexts) - self.old.log_density(self.contexts)
        return np.exp(np.minimum(logs, _LARGEST_LOG_RATIO))


class _NoNumberError(ArithmeticError):
    """A proposed distribution has no density: its log standard deviations overflow or vanish as exponentials."""


class _Search:
    """An objective that an optimiser may ask about anything, and the best that it was asked about.

    best: the parameters of highest value within the trust region, the start among them.
    """

    def __init__(self, objective: Objective, start: FloatArray, epsilon: float) -> None:
        self._objective, self._epsilon = objective, epsilon
        self.best, self._most = start, -np.inf

    def value(self, parameters: FloatArray) -> float:
        value = _number(self._objective.value, parameters)
        if value > self._most and self.step_size(parameters) <= self._epsilon:
            self.best, self._most = parameters.copy(), value
        return value

    def step_size(self, parameters: FloatArray) -> float:
        return _number(self._objective.step_size, parameters)

    def gradient(self, parameters: FloatArray) -> FloatArray:
        return _number(self._objective.gradient, parameters)

    def step_size_gradient(self, parameters: FloatArray) -> FloatArray:
        return _number(self._objective.step_size_gradient, parameters)


def _number(ask: Callable[[FloatArray], Answer], parameters: FloatArray) -> Answer:
    """What `ask` answers. Raises _NoNumberError if that is no finite number."""
    try:
        with np.errstate(all="ignore"):
            answer = ask(parameters)
    except (ValueError, np.linalg.LinAlgError):  # SciPy's, of a factor that is infinite, or singular
        raise _NoNumberError from None
    if not np.isfinite(answer).all():
        raise _NoNumberError
    return answer


def by_trust_region(problem: Objective, epsilon: float, least_std: FloatArray | None) -> Step:
    """SciPy's trust-constr with analytic gradients. A failed search counts if it ends feasible and better.

    Now and then it proposes log standard deviations whose exponentials overflow. Such a proposal is refused, and the
    search goes on from the best that it has found, with a smaller first step and a fresh estimate of the curvature,
    which the refused one would spoil. Where nothing is found, the distribution stays.
    """
    objective, start, low = _standardised(problem, least_std)
    # SciPy asks for a feasible start where bounds must not be left.
    start = start if low is None else np.maximum(start, low)
    search, refused = _Search(objective, start, epsilon), 0
    trust = NonlinearConstraint(
        search.step_size, -np.inf, epsilon,
        jac=lambda parameters: search.step_size_gradient(parameters)[None], hess=BFGS(),
    )  # fmt: skip
    for first_radius in _FIRST_RADII:
        try:
            found = minimize(
                lambda parameters: -search.value(parameters), search.best, method="trust-constr",
                jac=lambda parameters: -search.gradient(parameters), hess=BFGS(), constraints=[trust],
                bounds=None if low is None else Bounds(low, np.inf, keep_feasible=True),
                options={"gtol": _GTOL, "xtol": _XTOL, "initial_tr_radius": first_radius},
            )  # fmt: skip
        except (_NoNumberError, ValueError, np.linalg.LinAlgError):  # ours; SciPy's own products may overflow as well
            refused += 1
            continue
        with contextlib.suppress(_NoNumberError):
            gained = search.value(found.x) - search.value(start)
            if found.success or (search.step_size(found.x) <= epsilon and gained >= 0.0):
                return Step(Gaussian.from_parameters(found.x).back_from(problem.old), True, int(found.nit), refused)
        return Step(problem.old, False, int(found.nit), refused)
    moved = not np.array_equal(search.best, start)
    return Step(
        Gaussian.from_parameters(search.best).back_from(problem.old) if moved else problem.old, moved, 0, refused
    )


def by_conjugate_gradient(problem: Objective, epsilon: float, least_std: FloatArray | None) -> Step:
    """A natural gradient step as TRPO makes it: conjugate gradients, then a line search for the trust region.

    The standard deviations are clamped behind the step, so a clamped step may leave the trust region.
    """
    objective, start, low = _standardised(problem, least_std)
    search, refused = _Search(objective, start, epsilon), 0
    try:
        before, gradient = search.value(start), search.gradient(start)
    except _NoNumberError:
        return Step(problem.old, False, 0, 1)
    fisher = objective.old.fisher()
    direction, _ = cg(fisher, gradient, maxiter=_CG_STEPS)
    length = float(direction @ fisher @ direction)
    if length > 0.0:
        step = np.sqrt(2.0 * epsilon / length) * direction
        for tried in range(1, _LINE_SEARCH_STEPS + 1):
            moved = start + step
            try:
                if search.step_size(moved) <= epsilon and search.value(moved) > before:
                    moved = moved if low is None else np.maximum(moved, low)
                    return Step(Gaussian.from_parameters(moved).back_from(problem.old), True, tried, refused)
            except _NoNumberError:
                refused += 1
            step = _SHRINK * step
    return Step(problem.old, False, _LINE_SEARCH_STEPS, refused)


def _standardised(problem: Objective, least_std: FloatArray | None) -> tuple[Objective, FloatArray, FloatArray | None]:
    """The problem in coordinates in which `old` is standard normal, its parameters there, and their lower limits.

    Ratios and divergences are the same in any coordinates, but in these the search is well conditioned however narrow
    the distribution has become: in the contexts' own, trust-constr stalls for 1,000 iterations.
    """
    old = problem.old
    contexts = solve_triangular(old.factor, (problem.contexts - old.mean).T, lower=True).T
    objective = Objective(old.seen_from(old), problem.target.seen_from(old), contexts, problem.values, problem.alpha)
    d, start = len(old.mean), objective.old.parameters
    if least_std is None:
        return objective, start, None
    low = np.full(len(start), -np.inf)
    # In these coordinates L is L_old^-1 L, whose diagonal is that of L over that of L_old.
    low[d : 2 * d] = np.log(least_std) - np.log(np.diag(old.factor))
    return objective, start, low
