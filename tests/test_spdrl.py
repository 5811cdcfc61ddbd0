"""SPDRL against closed forms, finite differences, and the distributions of SciPy and torch."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats
from torch.distributions import MultivariateNormal, kl_divergence

from space_dist.curricula import Draws, Episodes, Feedback, spdrl
from space_dist.curricula.gaussian import Gaussian
from space_dist.curricula.spdrl import (
    ContextState,
    Objective,
    SelfPaced,
    by_conjugate_gradient,
    by_trust_region,
    weight_of_target,
)
from space_dist.instances import ContextBounds

EPSILON = 0.05


def some(seed: int, d: int = 3) -> Gaussian:
    random = np.random.default_rng(seed)
    factor = np.tril(random.normal(size=(d, d)))
    np.fill_diagonal(factor, np.exp(0.5 * random.normal(size=d)))
    return Gaussian(random.normal(size=d), factor)


def built(parameters: Any, d: int) -> MultivariateNormal:
    """The documented meaning of a parameter vector, in torch: (mean, log diag L, below the diagonal row by row)."""
    parameters = torch.as_tensor(parameters, dtype=torch.float64)
    factor = torch.diag(torch.exp(parameters[d : 2 * d]))
    place = 2 * d
    for row in range(d):
        for column in range(row):
            one = torch.zeros(d, d, dtype=torch.float64)
            one[row, column] = 1.0
            factor = factor + parameters[place] * one
            place += 1
    return MultivariateNormal(parameters[:d], scale_tril=factor)


def differences(function: Callable[[np.ndarray], float], at: np.ndarray, step: float = 1e-6) -> np.ndarray:
    return np.array([(function(at + step * one) - function(at - step * one)) / (2 * step) for one in np.eye(len(at))])


@pytest.mark.parametrize("d", [1, 2, 3, 5])
def test_densities_and_divergences_are_those_of_scipy_and_torch(d: int) -> None:
    one, other = some(1, d), some(2, d)
    points = np.random.default_rng(0).normal(size=(7, d))
    expected = stats.multivariate_normal(one.mean, one.factor @ one.factor.T).logpdf(points)
    np.testing.assert_allclose(one.log_density(points), expected, rtol=1e-10)
    divergence = kl_divergence(built(one.parameters, d), built(other.parameters, d))
    assert one.kl_to(other) == pytest.approx(float(divergence), rel=1e-10)
    assert one.kl_to(one) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(Gaussian.from_parameters(one.parameters).factor, one.factor, rtol=1e-14)
    np.testing.assert_allclose(one.std, np.sqrt(np.diag(one.factor @ one.factor.T)))


def test_the_divergence_of_two_numbers_by_hand() -> None:
    # KL(N(1, 2^2) || N(3, 4^2)) = log(4 / 2) + (2^2 + (1 - 3)^2) / (2 * 4^2) - 1 / 2
    found = Gaussian.of(np.array([1.0]), np.array([2.0])).kl_to(Gaussian.of(np.array([3.0]), np.array([4.0])))
    assert found == pytest.approx(math.log(2.0) + 8.0 / 32.0 - 0.5)


def test_every_gradient_is_that_of_finite_differences() -> None:
    old, target, now = some(3), some(4), some(5).parameters
    random = np.random.default_rng(1)
    contexts, values = random.normal(size=(20, 3)), random.normal(size=20)
    problem = Objective(old, target, contexts, values, alpha=0.3)

    def by_hand(parameters: np.ndarray) -> float:
        """mean_j [ p(c_j) / p_old(c_j) V_j ] - alpha KL(p || target), by torch."""
        new, before, goal = (built(one, 3) for one in (parameters, old.parameters, target.parameters))
        ratios = torch.exp(new.log_prob(torch.as_tensor(contexts)) - before.log_prob(torch.as_tensor(contexts)))
        return float((ratios * torch.as_tensor(values)).mean() - 0.3 * kl_divergence(new, goal))

    assert problem.value(now) == pytest.approx(by_hand(now), rel=1e-10)
    np.testing.assert_allclose(problem.gradient(now), differences(by_hand, now), rtol=1e-5, atol=1e-7)
    step = lambda one: float(kl_divergence(built(old.parameters, 3), built(one, 3)))  # noqa: E731
    assert problem.step_size(now) == pytest.approx(step(now), rel=1e-10)
    np.testing.assert_allclose(problem.step_size_gradient(now), differences(step, now), rtol=1e-5, atol=1e-7)


def test_the_fisher_matrix_is_torchs_hessian_of_the_divergence() -> None:
    one = some(6)
    fixed = built(one.parameters, 3)
    hessian = torch.autograd.functional.hessian(
        lambda parameters: kl_divergence(fixed, built(parameters, 3)), torch.as_tensor(one.parameters)
    )
    np.testing.assert_allclose(one.fisher(), hessian.numpy(), atol=1e-9)


def test_other_coordinates_change_no_divergence() -> None:
    one, other, third = some(7), some(8), some(9)
    assert one.seen_from(third).kl_to(other.seen_from(third)) == pytest.approx(one.kl_to(other), rel=1e-9)
    back = one.seen_from(third).back_from(third)
    np.testing.assert_allclose(back.parameters, one.parameters, atol=1e-12)
    np.testing.assert_allclose(one.seen_from(one).parameters, np.zeros(9), atol=1e-12)


@pytest.mark.parametrize(
    ("update", "performance", "divergence", "alpha"),
    [
        (1, 5.0, 10.0, 0.0),
        (9, 5.0, 10.0, 0.0),  # the tenth is the first with a pull
        (10, 5.0, 10.0, 0.8),  # 1.6 * 5 / 10
        (10, -5.0, 10.0, 0.0),
        (10, 5.0, 0.0, 1e5),
        (10, 5.0, 1e-4, 8e4),
    ],
)
def test_the_schedule_of_alpha(update: int, performance: float, divergence: float, alpha: float) -> None:
    assert weight_of_target(update, 10, 1.6, performance, divergence) == pytest.approx(alpha)


def line(alpha: float, target: Gaussian, slope: float = 1.0, mean: float = 0.0, std: float = 1.0) -> Objective:
    """Values rise with the context; the contexts are quantiles, so that means over them are nearly exact."""
    contexts = mean + std * stats.norm.ppf((np.arange(20_000) + 0.5) / 20_000)[:, None]
    old = Gaussian.of(np.array([mean]), np.array([std]))
    return Objective(old, target, contexts, slope * (contexts[:, 0] - mean) / std, alpha)


@pytest.mark.parametrize(("mean", "std"), [(0.0, 1.0), (3.0, 1e-3), (-50.0, 40.0)])
def test_the_best_step_up_a_slope_has_a_closed_form_at_any_scale(mean: float, std: float) -> None:
    """Maximise m subject to KL(N(0, 1) || N(m, s^2)) <= e: s = exp(e), m = sqrt(exp(2 e) - 1)."""
    problem = line(0.0, some(1, 1), mean=mean, std=std)
    step = by_trust_region(problem, EPSILON, None)
    assert step.accepted
    assert (step.distribution.mean[0] - mean) / std == pytest.approx(math.sqrt(math.exp(2 * EPSILON) - 1.0), rel=0.01)
    assert step.distribution.std[0] / std == pytest.approx(math.exp(EPSILON), rel=0.01)
    assert problem.old.kl_to(step.distribution) == pytest.approx(EPSILON, rel=1e-3)


def test_a_near_target_that_pulls_hard_is_reached_at_once() -> None:
    target = Gaussian(np.array([0.05, -0.05]), np.array([[1.02, 0.0], [0.03, 0.98]]))
    old = Gaussian.of(np.zeros(2), np.ones(2))
    assert old.kl_to(target) < EPSILON
    contexts = np.random.default_rng(0).normal(size=(50, 2))
    step = by_trust_region(Objective(old, target, contexts, contexts[:, 0], 1e5), EPSILON, None)
    np.testing.assert_allclose(step.distribution.parameters, target.parameters, atol=1e-4)


def test_a_far_target_is_approached_to_the_edge_of_the_trust_region_and_no_further() -> None:
    problem = line(10.0, Gaussian.of(np.array([6.0]), np.array([0.5])), slope=0.0)
    for move in (by_trust_region, by_conjugate_gradient):
        step = move(problem, EPSILON, None)
        assert step.accepted
        assert problem.old.kl_to(step.distribution) <= EPSILON * (1.0 + 1e-6)
        assert problem.old.kl_to(step.distribution) > 0.5 * EPSILON
        assert step.distribution.kl_to(problem.target) < problem.old.kl_to(problem.target)


@pytest.mark.parametrize("move", [by_trust_region, by_conjugate_gradient])
def test_the_diagonal_of_the_factor_keeps_its_limit(move: Any) -> None:
    narrow = Gaussian.of(np.array([0.0]), np.array([1e-3]))
    free = move(line(1.0, narrow, slope=0.0), EPSILON, None)
    assert free.distribution.factor[0, 0] < 0.9
    held = move(line(1.0, narrow, slope=0.0), EPSILON, np.array([0.95]))
    assert held.distribution.factor[0, 0] >= 0.95 - 1e-9
    assert held.distribution.factor[0, 0] == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize(
    ("ends_at", "success", "accepted"),
    [
        ([0.1, 0.0], True, True),
        ([0.1, 0.0], False, True),  # feasible and better
        ([-0.1, 0.0], False, False),  # feasible and worse
        ([2.0, 0.0], False, False),  # better and beyond the trust region
        ([np.nan, 0.0], True, False),
    ],
)
def test_a_failed_search_counts_only_if_it_ends_feasible_and_better(
    ends_at: list[float], success: bool, accepted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = SimpleNamespace(x=np.array(ends_at), success=success, nit=3)
    monkeypatch.setattr(spdrl, "minimize", lambda *_, **__: found)
    step = by_trust_region(line(0.0, some(1, 1)), EPSILON, None)
    assert (step.accepted, step.distribution.mean[0]) == (accepted, ends_at[0] if accepted else 0.0)


def hard(seed: int) -> Objective:
    """Moves on which trust-constr proposes log standard deviations of hundreds, or SciPy's own products overflow."""
    random = np.random.default_rng(seed)
    d = int(random.integers(1, 4))
    target = random.normal(size=d) * random.choice([0, 1, 10, 100])
    std = np.full(d, float(random.choice([0.01, 0.1, 1, 10])))
    count = int(random.integers(2, 30))
    contexts = random.standard_normal((count, d))
    values = random.normal(size=count) * random.choice([1, 10, 100, 1e4])
    values += random.choice([-1, 0, 1]) * random.choice([1, 10, 100, 1e5])
    alpha = float(random.choice([0, 0, 1e-3, 1, 1e2, 1e5]))
    return Objective(Gaussian.of(np.zeros(d), np.ones(d)), Gaussian.of(target, std), contexts, values, alpha)


@pytest.mark.parametrize("seed", [13, 82, 110])
def test_a_move_ends_within_the_trust_region_whatever_the_search_proposes(seed: int) -> None:
    problem = hard(seed)
    step = by_trust_region(problem, EPSILON, None)
    assert step.accepted
    assert problem.old.kl_to(step.distribution) <= EPSILON * (1.0 + 1e-6)
    assert problem.value(step.distribution.parameters) > problem.value(problem.old.parameters)


def proposing(monkeypatch: pytest.MonkeyPatch, proposals: list[list[float]], times: int) -> list[float]:
    """Let `minimize` ask for the value at `proposals` before it begins, `times` times; returns its first radii."""
    radii: list[float] = []
    truly = spdrl.minimize

    def minimize(function: Any, start: np.ndarray, **options: Any) -> Any:
        radii.append(options["options"]["initial_tr_radius"])
        for proposal in proposals if len(radii) <= times else []:
            function(np.array(proposal))
        return truly(function, start, **options)

    monkeypatch.setattr(spdrl, "minimize", minimize)
    return radii


def test_a_proposal_that_is_no_number_is_refused_and_the_search_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = line(0.0, some(1, 1))
    undisturbed = by_trust_region(problem, EPSILON, None)
    radii = proposing(monkeypatch, [[0.1, 0.0], [0.0, 800.0]], times=2)
    step = by_trust_region(problem, EPSILON, None)
    assert (step.accepted, step.refused, len(radii)) == (True, 2, 3)
    assert radii == sorted(radii, reverse=True)
    np.testing.assert_allclose(step.distribution.parameters, undisturbed.distribution.parameters, atol=1e-3)


def test_if_nothing_but_refused_proposals_comes_the_best_before_them_or_the_old_one_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = line(0.0, some(1, 1))
    with monkeypatch.context() as patched:
        proposing(patched, [[0.1, 0.0], [0.0, 800.0]], times=99)
        step = by_trust_region(problem, EPSILON, None)
        assert (step.accepted, step.distribution.mean.tolist(), step.refused) == (True, [0.1], 3)
    for nothing in ([0.0, 800.0], [0.0, -800.0], [np.nan, 0.0], [np.inf, 0.0]):
        with monkeypatch.context() as patched:
            proposing(patched, [nothing], times=99)
            step = by_trust_region(problem, EPSILON, None)
            assert (step.accepted, step.refused) == (False, 3)
            assert step.distribution is problem.old


def test_a_run_whose_search_finds_no_distribution_goes_on_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    proposing(monkeypatch, [[0.0, 0.0, 800.0, 0.0, 0.0]], times=99)
    one = curriculum(warm_up=0)
    state, selection = one.start()
    after, _, numbers = one.step(state, feedback(state, selection.contexts))
    assert (numbers["moved"], numbers["refused_proposals"], after.version) == (False, 3, 1)
    assert after.distribution.parameters.tolist() == state.distribution.parameters.tolist()


@pytest.mark.parametrize("values", [1e308, np.array([1e308, -1e308] * 6)])
def test_values_too_large_for_a_gradient_move_nothing(values: Any) -> None:
    for optimiser in ("trust_constr", "conjugate_gradient"):
        one = curriculum(warm_up=0, optimiser=optimiser)
        state, selection = one.start()
        _, _, numbers = one.step(state, feedback(state, selection.contexts, values))
        assert not numbers["moved"]


# ---- the curriculum ---------------------------------------------------------------------------------------------

BOUNDS = ContextBounds(("a", "b"), np.array([-1.0, 0.0]), np.array([1.0, 2.0]))


def curriculum(**settings: Any) -> SelfPaced:
    defaults: dict[str, Any] = {
        "seed": 0, "draws": Draws(12, 3), "bounds": BOUNDS, "zeta": 1.0, "offset": 1, "epsilon": EPSILON, "warm_up": 2,
        "initial": Gaussian.of(np.array([0.0, 1.0]), np.array([0.5, 2.0])),
        "target": Gaussian.of(np.array([0.5, 1.5]), np.array([0.1, 0.1])),
        "optimiser": "trust_constr", "least_std": None, "least_std_until": 0.0,
    }  # fmt: skip
    return SelfPaced(**{**defaults, **settings})


def feedback(state: ContextState, contexts: np.ndarray, values: Any = 1.0) -> Feedback:
    m = len(contexts)
    episodes = Episodes(
        indices=np.full(m, -1), contexts=contexts, returns=np.ones(m), discounted_returns=np.arange(m, dtype=float),
        lengths=np.ones(m, dtype=np.int64), success=np.zeros(m),
        start_values=np.broadcast_to(values, m).astype(float), advantages=np.full(m, np.nan),
        running=np.arange(0),
    )  # fmt: skip
    return Feedback(state.version, np.zeros(4), np.ones(4), 1, episodes=episodes)


def test_contexts_are_generated_within_the_bounds_and_belong_to_the_state() -> None:
    one = curriculum()
    state, selection = one.start()
    assert (selection.ids == -1).all()
    assert selection.drawn
    assert selection.contexts.shape == (12, 2)
    assert (selection.contexts >= BOUNDS.low).all()
    assert (selection.contexts <= BOUNDS.high).all()
    assert (selection.contexts == BOUNDS.low).any()  # a standard deviation of 2 within [0, 2]: clipped
    assert np.array_equal(curriculum().selection(state).contexts, selection.contexts)
    assert not np.array_equal(curriculum(seed=1).start()[1].contexts, selection.contexts)


def test_the_distribution_moves_once_the_warm_up_is_over_and_alpha_follows_performance() -> None:
    one = curriculum()
    state, selection = one.start()
    told = []
    for _ in range(5):
        state, selection, numbers = one.step(state, feedback(state, selection.contexts))
        told.append(numbers)
    assert [numbers["moved"] for numbers in told] == [False, False, True, True, True]
    assert [numbers["alpha"] for numbers in told[:2]] == [None, None]
    assert told[0]["mean_discounted_return"] == 5.5  # of 0 .. 11
    start = one.start()[0].distribution
    target = Gaussian.of(np.array([0.5, 1.5]), np.array([0.1, 0.1]))
    assert told[2]["alpha"] == pytest.approx(5.5 / start.kl_to(target))
    divergences = [numbers["kl_to_target"] for numbers in told]
    assert divergences[0] == divergences[1] > divergences[2] > divergences[3] > divergences[4]  # type: ignore[operator]
    assert (state.version, state.updates) == (5, 3)
    assert told[4]["mean_a"] == state.mean[0]
    assert told[4]["target_std_b"] == pytest.approx(0.1)


def test_an_iteration_in_which_no_episode_ended_moves_nothing() -> None:
    one = curriculum()
    state, selection = one.start()
    for _ in range(3):
        state, _, numbers = one.step(state, feedback(state, selection.contexts[:0]))
        assert (numbers["moved"], numbers["mean_discounted_return"], numbers["alpha"]) == (False, None, None)
    assert np.array_equal(state.mean, one.start()[0].mean)
    assert (state.version, state.updates) == (3, 0)


def test_the_limit_holds_only_while_the_target_is_far() -> None:
    least = np.array([0.45, 1.9])
    for until, held in ((0.0, True), (1e9, False)):
        one = curriculum(least_std=least, least_std_until=until, warm_up=0, zeta=100.0)
        state, selection = one.start()
        for _ in range(6):
            state, selection, _ = one.step(state, feedback(state, selection.contexts))
        assert bool((np.diag(state.factor) >= least - 1e-9).all()) == held


def test_values_that_hardly_differ_let_it_go_all_the_way_to_a_narrow_target() -> None:
    """Klink et al.'s initial and target distributions on PointMass, and their limits; the policy is made up."""
    bounds = ContextBounds(("gate_x", "gate_width", "friction"), np.array([-4.0, 0.5, 0.0]), np.array([4.0, 8.0, 4.0]))
    target = Gaussian.of(np.array([2.5, 0.5, 0.0]), np.array([4e-3, 3.75e-3, 2e-3]))
    one = curriculum(
        draws=Draws(40, 4), bounds=bounds, target=target, warm_up=0, offset=5, zeta=1.6, least_std_until=8000.0,
        initial=Gaussian.of(np.array([0.0, 4.25, 2.0]), np.array([2.0, 1.875, 1.0])),
        least_std=np.array([0.2, 0.1875, 0.1]),
    )  # fmt: skip
    state, selection = one.start()
    for _ in range(79):
        values = 5.0 + 0.2 * selection.contexts[:, 1]  # wide gates are a little better
        state, selection, numbers = one.step(state, feedback(state, selection.contexts, values))
        assert numbers["kl_step"] <= EPSILON * 1.001  # type: ignore[operator]
        if numbers["kl_to_target"] < 1e-3:  # type: ignore[operator]
            break
    assert numbers["kl_to_target"] < 1e-3  # type: ignore[operator]
    assert state.updates > 40  # no faster than the trust region allows
    np.testing.assert_allclose(selection.contexts.mean(axis=0), [2.5, 0.5, 0.0], atol=0.01)


@pytest.mark.parametrize("steers", [True, False])
def test_a_policy_that_ignores_the_gate_holds_the_distribution_where_its_way_still_leads_through(steers: bool) -> None:
    """A made-up policy crosses the wall at 0.41 wherever the gate is, or pays a little for a way through any gate.

    docs/curricula.md tells of the first kind, which PPO found. The pull grows with the mean return, but so does what is
    lost at the gate's edge.
    """
    bounds = ContextBounds(("gate_x", "gate_width", "friction"), np.array([-4.0, 0.5, 0.0]), np.array([4.0, 8.0, 4.0]))
    one = curriculum(
        draws=Draws(32, 4), bounds=bounds, warm_up=0, offset=10, zeta=1.6, least_std_until=8000.0,
        optimiser="conjugate_gradient", target=Gaussian.of(np.array([2.5, 0.5, 0.0]), np.array([4e-3, 3.75e-3, 2e-3])),
        initial=Gaussian.of(np.array([0.0, 4.25, 2.0]), np.array([2.0, 1.875, 1.0])),
        least_std=np.array([0.2, 0.1875, 0.1]),
    )  # fmt: skip
    state, selection = one.start()
    for _ in range(150):
        gate_x, gate_width, _ = selection.contexts.T
        straight = np.where(np.abs(gate_x - 0.41) < gate_width / 2, 12.5, 0.5)
        values = 12.5 - 0.2 * gate_x**2 if steers else straight
        told = feedback(state, selection.contexts, values)
        assert told.episodes is not None
        told.episodes.discounted_returns[:] = values
        state, selection, numbers = one.step(state, told)
        if numbers["kl_to_target"] < 1.0:  # type: ignore[operator]
            break
    assert (numbers["kl_to_target"] < 1.0) == steers  # type: ignore[operator]
    if not steers:
        assert numbers["kl_to_target"] > 5e4  # type: ignore[operator]
        assert 0.0 < state.mean[0] - state.mean[1] / 2 < 0.41
