"""Sections of the curricula that draw an instance, or a context, for each episode."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from space_dist.config.sections import MAX_LIST, CurriculumSection


class UniformConfig(CurriculumSection):
    """Domain randomisation over the set: every episode's instance is drawn uniformly."""

    kind: Literal["uniform"]
    """Which curriculum: uniform random."""


class SelfPacedConfig(CurriculumSection):
    """SPDRL (Klink et al. 2020): contexts from a normal distribution that moves from an initial one to a target.

    The defaults are the authors' PPO settings on PointMass.
    """

    kind: Literal["spdrl"]
    """Which curriculum: self-paced deep RL."""
    initial_mean: tuple[float, ...] | None = Field(default=None, min_length=1, max_length=MAX_LIST, strict=False)
    """Mean of the first contexts, one number a feature, in environment units; null: the middle of the bounds. Source:
    Klink et al. 2020 on PointMass, which is that middle."""
    initial_std: tuple[Annotated[float, Field(gt=0.0)], ...] | None = Field(
        default=None, min_length=1, max_length=MAX_LIST, strict=False
    )
    """Standard deviations of the first contexts, in environment units; null: a quarter of the bounds' width. Source:
    Klink et al. 2020 on PointMass, which is that quarter."""
    target: Literal["normal", "set_moments"] = "set_moments"
    """What the distribution moves to. normal: target_mean and target_std. set_moments: mean and covariance of the
    training instances. Source: Klink et al. 2020; ours, for sets that are not drawn from a normal distribution."""
    target_mean: tuple[float, ...] | None = Field(default=None, min_length=1, max_length=MAX_LIST, strict=False)
    """With target: normal, its mean, one number a feature, in environment units."""
    target_std: tuple[Annotated[float, Field(gt=0.0)], ...] | None = Field(
        default=None, min_length=1, max_length=MAX_LIST, strict=False
    )
    """With target: normal, its standard deviations, in environment units."""
    zeta: float = Field(default=1.6, gt=0.0)
    """Weight of the pull to the target: alpha is zeta * mean discounted return / KL. Source: Klink et al. 2020,
    PointMass (1.6)."""
    offset: int = Field(default=10, ge=0)
    """Moves before this one, counted from 1, have alpha 0. Source: Klink et al. 2020, PointMass (PPO 10, TRPO 20)."""
    epsilon: float = Field(default=0.05, gt=0.0)
    """Trust region: largest KL divergence, in nats, from one distribution to the next. Source: Klink et al. 2020."""
    warm_up: int = Field(default=5, ge=0)
    """Iterations before the distribution first moves. Source: Klink et al. 2020."""
    optimiser: Literal["trust_constr", "conjugate_gradient"] = "trust_constr"
    """trust_constr: SciPy's, with the least standard deviations as bounds. conjugate_gradient: one natural gradient
    step with line search, the standard deviations clamped behind it. Source: Klink et al. 2021 (JMLR); Klink et al.
    2020."""
    least_std: tuple[Annotated[float, Field(gt=0.0)], ...] | None = Field(
        default=None, min_length=1, max_length=MAX_LIST, strict=False
    )
    """The diagonal of the Cholesky factor stays at least this, in environment units, while the target is far; null:
    no limit. Source: Klink et al. 2020, PointMass (0.2, 0.1875, 0.1)."""
    least_std_until: float = Field(default=8000.0, ge=0.0)
    """The target is far while KL(p || target) is above this, in nats. Source: Klink et al. 2020."""
    allow_context_blind: bool = False
    """Run even though the policy cannot tell contexts apart at their start: all values tie, and only the target
    pulls."""

    @model_validator(mode="after")
    def _whole_target(self) -> Self:
        _refuse_half_a_target(self.target, self.target_mean, self.target_std)
        return self

    @property
    def ranks_by_start_value(self) -> bool:
        """See `CurriculumSection`."""
        return not self.allow_context_blind

    @property
    def libraries(self) -> tuple[str, ...]:
        """See `CurriculumSection`."""
        return ("scipy",)


class ValueDisagreementConfig(CurriculumSection):
    """The VDS sampler (Zhang et al. 2020) under our learner: instances whose value an ensemble disagrees about.

    The original is HER with DDPG and an ensemble of Q-functions over a replay buffer.
    """

    kind: Literal["vds"]
    """Which curriculum: value disagreement."""
    members: int = Field(default=3, ge=2, le=100)
    """Value functions in the ensemble. Source: Zhang et al. 2020 (3)."""
    members_see: tuple[str, ...] | None = Field(default=None, min_length=1, max_length=MAX_LIST, strict=False)
    """Features of the context that the members see, such as the goal alone; null: all. The policy sees all in any
    case. Source: the SPaCE paper, section 5.2 (on Ant, VDS knows goals only)."""
    learning_rate: float = Field(default=1e-3, gt=0.0)
    """Step size of the members' Adam. Source: Zhang et al. 2020 (1e-3)."""
    batch_size: int = Field(default=256, ge=1)
    """Transitions per minibatch of the members, at most a round's. Source: ours, as `n_batches` (Zhang et al. 2020:
    1,000)."""
    n_batches: int = Field(default=5, ge=1)
    """Minibatches per update. Source: ours, the better of the settings that docs/curricula.md compares (Zhang et al.
    2020: 100 a cycle)."""
    td_lambda: float = Field(default=0.95, ge=0.0, le=1.0)
    """Lambda of the returns that each member is fitted to, bootstrapped from itself. Source: ours; the original
    bootstraps Q-functions by one step (0), from a replay buffer."""

    @property
    def ranks_by_start_value(self) -> bool:
        """See `CurriculumSection`."""
        return True


class AlpGmmConfig(CurriculumSection):
    """ALP-GMM (Portelas et al. 2019): contexts from a mixture, in proportion to absolute learning progress."""

    kind: Literal["alp_gmm"]
    """Which curriculum: ALP-GMM."""
    over: Literal["set", "bounds"] = "set"
    """set: the training instance nearest to a sample. bounds: the sample itself, generated within the environment's
    bounds. Source: ours; Portelas et al. 2019."""
    random_share: float = Field(default=0.3, ge=0.0, le=1.0)
    """Share of uniform draws. Source: Klink et al. 2021 (JMLR), PointMass (PPO 0.3, TRPO 0.2)."""
    fit_rate: int = Field(default=100, ge=1)
    """Finished episodes between fits, rows of a fit, and uniform episodes at the start. Source: Klink et al. 2021
    (JMLR), PointMass (PPO 100, TRPO 50)."""
    history: int = Field(default=500, ge=1)
    """Finished episodes among which the nearest earlier context is sought. Source: Klink et al. 2021 (JMLR), PointMass
    (500)."""
    components: int = Field(default=10, ge=2, le=100)
    """Most components of the mixture; from 2 on, AIC chooses. Source: Portelas et al. 2019 (10)."""

    @model_validator(mode="after")
    def _enough_rows(self) -> Self:
        if self.fit_rate < self.components:
            raise ValueError(f"fit_rate: {self.fit_rate} rows cannot tell {self.components} components apart; "
                             f"fit_rate must be at least components")  # fmt: skip
        return self

    @property
    def libraries(self) -> tuple[str, ...]:
        """See `CurriculumSection`."""
        return ("scipy", "scikit-learn")


class LevelReplayConfig(CurriculumSection):
    """Prioritised level replay (Jiang et al. 2021): by rank of a score, and by how long ago.

    On-policy learners; with score: max_mc and without robust, any.
    """

    kind: Literal["plr"]
    """Which curriculum: prioritised level replay."""
    temperature: float = Field(default=0.1, gt=0.0)
    """Beta: the chance of rank r is proportional to r^(-1/beta). Source: Jiang et al. 2021 (0.1)."""
    staleness_share: float = Field(default=0.1, ge=0.0, le=1.0)
    """Rho: weight of the episodes since an instance was last trained on. Source: Jiang et al. 2021 (0.1)."""
    within_update: Literal["without_repetition", "fixed_chances"] = "without_repetition"
    """How the episodes of one update are drawn, between which no score can change. without_repetition: what was drawn
    leaves the ranking until everything else was. fixed_chances: the paper's chances as they stand, by which one
    instance has nearly all episodes of an update. Source: ours; Jiang et al. 2021, who decide before each episode."""
    score: Literal["value_l1", "positive_value_loss", "max_mc"] = "value_l1"
    """What instances are ranked by. value_l1: mean |GAE| of the episodes. positive_value_loss: mean max(GAE, 0).
    max_mc: the highest discounted return that an episode on it had so far, minus its start value. Source: Jiang et al.
    2021; for the others Jiang et al. 2021, "Replay-Guided Adversarial Environment Design", whose max_mc is a mean over
    all steps of an episode."""
    robust: bool = False
    """Learn from replayed instances only: rounds of uniform draws over the set are played and scored, charged to the
    budget, and not learned from. Source: the same (robust PLR)."""
    replay_share: float = Field(default=0.5, gt=0.0, le=1.0)
    """Of robust: the chance that an iteration replays, once enough was scored. Source: the authors' code (0.5)."""
    scored_share: float = Field(default=0.5, gt=0.0, le=1.0)
    """Of robust: the share of the set that must have been scored before anything is replayed. Source: the authors' code
    (0.5)."""


class AccelConfig(CurriculumSection):
    """ACCEL (Parker-Holder et al. 2022): contexts that are generated, replayed by an estimate of regret, and edited.

    Needs an environment whose contexts can be edited (docs/curricula.md). On-policy learners; with score: max_mc and
    robust: false, any.
    """

    kind: Literal["accel"]
    """Which curriculum: ACCEL."""
    new_from: Literal["generator", "set"] = "generator"
    """What contexts are new. generator: those that the environment makes. set: the training instances, drawn uniformly.
    Source: Parker-Holder et al. 2022; ours."""
    buffer: int = Field(default=1000, ge=1, le=100_000)
    """Contexts that are kept, at most. Source: the authors' code, BipedalWalker (1,000; mazes 4,000)."""
    filled_share: float = Field(default=0.5, ge=0.0, le=1.0)
    """Share of the buffer that must be filled before anything is replayed. Source: the authors' code (0.5)."""
    replay_share: float = Field(default=0.8, gt=0.0, le=1.0)
    """The chance that an iteration replays, once the buffer is filled so far. Source: Parker-Holder et al. 2022, mazes
    (0.8)."""
    batch: int = Field(default=32, ge=1, le=10_000)
    """Contexts of an iteration, which are played in turn, as far as its steps go. Source: the authors' code (32 at
    once)."""
    edits: int = Field(default=5, ge=1, le=1000)
    """Small changes that make one context of another. Source: Parker-Holder et al. 2022, mazes (5)."""
    edited: Literal["easiest", "batch"] = "easiest"
    """What of a replay is edited. easiest: the four contexts of highest mean return less score. batch: all. Source:
    Parker-Holder et al. 2022, mazes (easy)."""
    score: Literal["positive_value_loss", "value_l1", "max_mc"] = "positive_value_loss"
    """What contexts are kept and ranked by. positive_value_loss: mean max(GAE, 0). value_l1: mean |GAE|.
    max_mc: the highest discounted return that an episode on it had so far, minus its start value. Source:
    Parker-Holder et al. 2022 (positive value loss)."""
    temperature: float = Field(default=0.3, gt=0.0)
    """Beta: the chance of rank r is proportional to r^(-1/beta). Source: the authors' code (0.3)."""
    staleness_share: float = Field(default=0.3, ge=0.0, le=1.0)
    """Rho: weight of the episodes since a context was last played. Source: the authors' code (0.3)."""
    robust: bool = True
    """Learn from replayed contexts only: rounds of new and of edited ones are played and scored, charged to the budget,
    and not learned from. Source: Parker-Holder et al. 2022."""


class LearnabilityConfig(CurriculumSection):
    """Sampling for learnability (SFL; Rutherford et al. 2024): instances of highest p (1 - p), p the success rate.

    Needs an environment that reports success. Probe episodes cost environment steps, which the budget is charged.
    """

    kind: Literal["learnability"]
    """Which curriculum: learnability."""
    top: int = Field(default=20, ge=1)
    """Instances that are drawn as learnable. Source: ours, a fifth of 100 (the paper: 1,000 of 5,000)."""
    uniform_share: float = Field(default=0.5, ge=0.0, le=1.0)
    """Share of draws from all instances. Source: Rutherford et al. 2024 (0.5)."""
    every: int = Field(default=25, ge=1)
    """Iterations between probes, at least; the first follows the first training episode that succeeds: before, every
    rate would be 0. Source: ours, with `episodes` the best of the settings that docs/curricula.md compares (Rutherford
    et al. 2024: 50); the wait is ours."""
    candidates: int | None = Field(default=None, ge=1)
    """Instances that a probe takes, at random; null: all. Source: ours."""
    episodes: int = Field(default=2, ge=2, le=1000)
    """Probe episodes of each candidate, with the acting policy. Source: ours."""

    @property
    def may_probe(self) -> bool:
        """See `CurriculumSection`."""
        return True


class ProximalConfig(CurriculumSection):
    """ProCuRL (Tzannetos et al. 2023): instances whose value says that they succeed sometimes, by a softmax.

    No probes. Values are taken for probabilities of success, which they are where an episode's return is 1 or 0, or
    after scaling.
    """

    kind: Literal["procurl"]
    """Which curriculum: ProCuRL."""
    score: Literal["zone", "improvement"] = "zone"
    """zone: p (1 - p). improvement: by how much the value has risen in the last iteration, which is the control that
    its authors call `space-alt`. Source: Tzannetos et al. 2023."""
    beta: float = Field(default=20.0, gt=0.0)
    """Inverse temperature of the softmax. Source: the authors' code (20)."""
    scale: Literal["largest", "set"] = "largest"
    """What makes probabilities of values. largest: divided by `largest_return`, cut off at 0 and 1; for sparse rewards.
    set: from 0 for the least value of the set to 1 for the greatest. Source: the authors' code (both)."""
    largest_return: float = Field(default=1.0, gt=0.0)
    """Of scale: largest: the largest discounted return of an episode, in reward units."""

    @property
    def ranks_by_start_value(self) -> bool:
        """See `CurriculumSection`."""
        return True


class _OutcomeSection(CurriculumSection):
    outcome: Literal["success", "return"] = "success"
    """What an episode counts as. success: 1 or 0, as the environment says. return: its return, from 0 at lowest_return
    to 1 at largest_return, cut off at both ends. Source: Kanitscheider et al. 2021; ours."""
    lowest_return: float = 0.0
    """Of outcome: return: what counts as 0, in reward units."""
    largest_return: float = 1.0
    """Of outcome: return, where it must be given: what counts as 1, in reward units."""

    @model_validator(mode="after")
    def _rising(self) -> Self:
        if self.outcome == "return" and "largest_return" not in self.model_fields_set:
            raise ValueError(
                "outcome: return needs largest_return, the return that counts as 1 (and lowest_return, that of 0, "
                "where it is not 0): cut off at the default of 1, larger ones would all be alike"
            )
        if self.lowest_return >= self.largest_return:
            raise ValueError(
                f"lowest_return: {self.lowest_return:g} must be below largest_return: {self.largest_return:g}"
            )
        return self


class LearningProgressConfig(_OutcomeSection):
    """Bidirectional learning progress (Kanitscheider et al. 2021): instances whose success rate rises or falls.

    No probes: rates are those of the training episodes.
    """

    kind: Literal["learning_progress"]
    """Which curriculum: bidirectional learning progress."""
    smoothing: float = Field(default=0.1, gt=0.0, le=1.0)
    """Weight of the new in both averages: the fast one is of rates, the slow one of the fast one. Source: OMNI's code
    (0.1)."""
    theta: float = Field(default=0.1, gt=0.0, lt=1.0)
    """Rates p are reweighed as (1 - theta) p / (p + theta (1 - 2 p)), which makes much of changes near 0: theta itself
    becomes 1 / 2. Source: Kanitscheider et al. 2021 (0.1)."""
    uniform_share: float = Field(default=0.25, ge=0.0, le=1.0)
    """Share of draws from all instances: what always failed is tried by these alone. Source: Syllabus, where rates are
    those of training episodes as well (0.25)."""


class EdgeConfig(_OutcomeSection):
    """Instances in proportion to how uncertain the outcome of an episode is. Ours: docs/curricula.md.

    No probes: outcomes are those of training episodes, of their neighbours, and what the value function makes of them.
    The numbers are the same for every world.
    """

    kind: Literal["edge"]
    """Which curriculum: the edge of what the policy can do."""
    memory: float = Field(default=0.9, ge=0.0, lt=1.0)
    """Share of the remembered outcomes that an iteration leaves. Source: ours."""
    width: float = Field(default=0.1, ge=0.0)
    """How far outcomes speak for their neighbours: standard deviation of a normal kernel, in widths of the contexts'
    bounds; 0: not at all. Source: ours."""
    strength: float = Field(default=4.0, ge=0.0)
    """Episodes that the value function's word counts as, beside those played; 0: it has no say. Source: ours."""
    uniform_share: float = Field(default=0.1, ge=0.0, le=1.0)
    """Share of draws from all instances. Source: ours."""


class TransportConfig(CurriculumSection):
    """CURROT (Klink et al. 2022): contexts that move to a target as far as their expected return stays high enough.

    No probes, no values: expected returns are those of the episodes on contexts nearby.
    """

    kind: Literal["currot"]
    """Which curriculum: CURROT."""
    delta: float
    """The performance that contexts must be expected to reach, in reward units. Source: Klink et al. 2022, who choose
    one for each environment (their point mass: 4)."""
    performance: Literal["discounted_return", "return"] = "discounted_return"
    """What delta is compared with. Source: the authors' code (both)."""
    over: Literal["set", "bounds"] = "set"
    """set: the training instance nearest to a context. bounds: the context itself, generated within the environment's
    bounds. Source: ours; Klink et al. 2022."""
    target: Literal["set", "normal"] = "set"
    """What contexts move to. set: the training instances. normal: target_mean and target_std. Source: ours; Klink et
    al. 2022."""
    target_mean: tuple[float, ...] | None = Field(default=None, min_length=1, max_length=MAX_LIST, strict=False)
    """With target: normal, its mean, one number a feature, in environment units."""
    target_std: tuple[Annotated[float, Field(gt=0.0)], ...] | None = Field(
        default=None, min_length=1, max_length=MAX_LIST, strict=False
    )
    """With target: normal, its standard deviations, in environment units."""
    epsilon: float = Field(default=0.1, gt=0.0)
    """Trust region: how far a context moves in one iteration, where each feature's bounds are 0 and 1. Source: the
    authors' point mass, whose 0.7 are a tenth of the width of its bounds."""
    particles: int = Field(default=100, ge=2, le=500)
    """Contexts that move, and episodes that are remembered: as many that reached delta, and as many others. Source: the
    authors' point mass (100)."""

    @model_validator(mode="after")
    def _target_is_whole(self) -> Self:
        _refuse_half_a_target(self.target, self.target_mean, self.target_std)
        return self

    @property
    def libraries(self) -> tuple[str, ...]:
        """See `CurriculumSection`."""
        return ("scipy",)


def _refuse_half_a_target(target: str, mean: tuple[float, ...] | None, std: tuple[float, ...] | None) -> None:
    given = (mean is not None, std is not None)
    if target == "normal" and not all(given):
        raise ValueError("target: normal needs target_mean and target_std")
    if target != "normal" and any(given):
        raise ValueError(f"target_mean and target_std say nothing with target: {target}; use target: normal")
