"""Sections of the curricula: what each asks for, and what it says of itself."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from space_dist.config.sections import MAX_LIST, Section, own_path


class _Curriculum(Section):
    @property
    def ranks_by_start_value(self) -> bool:
        """Whether it makes no sense where the policy cannot tell instances apart at their start."""
        return False

    @property
    def starts_from_zero(self) -> bool:
        """Whether start values before the first update count as 0."""
        return False

    @property
    def policies_trained(self) -> int:
        """How many policies share the selection."""
        return 1

    @property
    def may_probe(self) -> bool:
        """Whether it may run probe episodes, whose steps cannot be foreseen."""
        return False

    @property
    def columns_read(self) -> tuple[str, ...]:
        """Columns of the training instances' CSV that it reads, beside id and features."""
        return ()

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions whose arithmetic its decisions depend on, beside NumPy."""
        return ()

    @property
    def import_paths(self) -> tuple[str, ...]:
        """Import paths of what somebody else has written."""
        return ()


class GrowingConfig(_Curriculum):
    """What all curricula share whose set grows by SPaCE's rule."""

    eta: float = Field(default=0.1, gt=0.0)
    """Growth threshold: the set grows when the mean start value changed by at most this share. Source: the authors' run
    scripts use 0.1, section 5.7 recommends 0.05, appendix A (CartPole) uses 0.025."""
    kappa: int = Field(default=1, ge=1)
    """Instances added per growth, or with growth: multiply the factor. Source: section 5.7 recommends 1."""
    growth: Literal["add", "multiply", "schedule"] = "add"
    """add: S + kappa. multiply: S * kappa (kappa of at least 2). Source: Algorithm 1; section 5.7, figure "fast rising
    set size"."""
    mean: Literal["same_set", "as_printed", "mean_abs_change"] = "same_set"
    """What eta is compared with. same_set: change of the mean |V| over the set just trained on. as_printed: V_{t-1} is
    the mean that the last iteration ended with, over its own set (at first 0). mean_abs_change: mean |change| of V, so
    that opposite changes do not cancel. Source: ours; Algorithm 1, lines 6-7; ours."""
    v0: Literal["network", "zero"] = "network"
    """Start values before the first update. network: the initial network's. zero: 0 for every instance. Source: ours;
    Algorithm 1, line 2, and the released code."""
    adaptive_eta: Literal["off", "once", "persistent"] = "off"
    """Raise eta so far that the set grows whenever `patience` tests in a row did not grow it: for that one test (once)
    or for good (persistent). Source: Theorem 2, which names no schedule; off: the released code."""
    patience: int = Field(default=5, ge=1)
    """Tests in a row without growth that adaptive_eta waits for. Source: ours."""
    epsilon: float = Field(default=1e-3, gt=0.0)
    """Reward units: adaptive_eta raises eta to (|change| + epsilon) / max(V_{t-1}, epsilon). Source: Theorem 2 (any
    number above 0); the value and the floor are ours."""
    aggregate: Literal["own", "population"] = "own"
    """Whose values decide. own: the policy's. population: the mean over `policies` policies, which the run trains side
    by side (engine: population) and which share the selection: one run, and one sample. Source: ours."""
    policies: int = Field(default=4, ge=2, le=64)
    """With aggregate: population, how many. Each collects learner.n_steps steps an update, and passes over the whole
    selection; all count in the budget."""

    @property
    def starts_from_zero(self) -> bool:
        """See `_Curriculum`."""
        return self.v0 == "zero"

    @property
    def policies_trained(self) -> int:
        """See `_Curriculum`."""
        return 1 if self.aggregate == "own" else self.policies

    @model_validator(mode="after")
    def _growth_is_possible(self) -> Self:
        if self.growth == "multiply" and self.kappa < 2:
            raise ValueError(f"growth: multiply with kappa: {self.kappa} never grows the set; it needs kappa >= 2")
        if self.growth == "schedule" and self.adaptive_eta != "off":
            raise ValueError(f"growth: schedule tests no eta that adaptive_eta: {self.adaptive_eta} could raise")
        return self


class SpaceConfig(GrowingConfig):
    """SPaCE (Eimer et al. 2021, Algorithm 1)."""

    kind: Literal["space"]
    """Which curriculum: SPaCE."""
    growth: Literal["add", "multiply"] = "add"
    """add: S + kappa. multiply: S * kappa (kappa of at least 2). Source: Algorithm 1; section 5.7, figure "fast rising
    set size"."""
    pic: Literal["improvement", "abs", "relative", "lowest_value", "random"] = "improvement"
    """What instances are ranked by. improvement: signed change of the start value, highest first. abs: its size.
    relative: signed change / max(|value before|, 1e-8). lowest_value: lowest value first. random: nothing, a control.
    Source: Definition 1; ours; the released code; the released code's default; ours."""
    allow_context_blind: bool = False
    """Run even though the policy cannot tell instances apart at their start (the released code's PointMass): all values
    tie, and the order is a random one."""
    reverse: bool = False
    """Rank the other way round: a control. Source: ours."""

    @property
    def ranks_by_start_value(self) -> bool:
        """See `_Curriculum`."""
        return self.pic != "random" and not self.allow_context_blind

    @model_validator(mode="after")
    def _something_to_reverse(self) -> Self:
        if self.reverse and self.pic == "random":
            raise ValueError("reverse: true changes nothing with pic: random")
        return self


class RandomGrowthConfig(GrowingConfig):
    """Control: grows exactly like SPaCE, but which instances are in the set is random."""

    kind: Literal["random_growth"]
    """Which curriculum: random growth, which is SPaCE with pic: random."""
    growth: Literal["add", "multiply"] = "add"
    """add: S + kappa. multiply: S * kappa (kappa of at least 2). As SPaCE's."""


class ContextSpaceConfig(GrowingConfig):
    """cSPaCE: SPaCE that ranks by distance in context space instead of values (section 5.2)."""

    kind: Literal["cspace"]
    """Which curriculum: cSPaCE."""
    growth: Literal["add", "multiply", "schedule"] = "add"
    """add: S + kappa. multiply: S * kappa (kappa of at least 2). schedule: S + kappa after every iteration with a
    gradient step, whatever the values; eta, mean and v0 then decide nothing. Source: the released code; as SPaCE's;
    ours."""
    distance: Literal["centroid", "nearest_member"] = "centroid"
    """Euclidean distance, with each feature scaled from its bounds to [-1, 1], to what of the current set: its mean, or
    its nearest instance, which never drops one. Source: the released code (with L1); ours."""
    reverse: bool = False
    """Rank the other way round, the farthest first: a control. Source: ours."""


class RoundRobinConfig(_Curriculum):
    """All instances in turn, in a random order fixed by the seed (the paper's first baseline, section 5.2)."""

    kind: Literal["round_robin"]
    """Which curriculum: round robin."""


class FixedConfig(_Curriculum):
    """Control: round robin over a part of the training instances. Give either `ids` or `count`."""

    kind: Literal["fixed"]
    """Which curriculum: a fixed subset."""
    ids: tuple[Annotated[int, Field(ge=0)], ...] | None = Field(default=None, min_length=1, strict=False)
    """Ids of the instances to train on. Source: ours."""
    count: int | None = Field(default=None, ge=1)
    """How many instances to train on: the first of round robin's order, so the seed chooses them. Source: ours."""

    @model_validator(mode="after")
    def _one_choice(self) -> Self:
        if (self.ids is None) == (self.count is None):
            raise ValueError("a fixed subset needs either ids or count")
        if self.ids is not None and len(set(self.ids)) < len(self.ids):
            raise ValueError("ids: every id may stand once")
        return self


class ManualConfig(GrowingConfig):
    """Control: grows in an order that a person wrote down, as a column of the training instances' CSV."""

    kind: Literal["manual"]
    """Which curriculum: a manual order."""
    column: str = Field(min_length=1, max_length=100)
    """Column of instances.train with one number per instance, of any unit: the lowest come first. Source: ours."""
    growth: Literal["add", "multiply", "schedule"] = "schedule"
    """schedule: S + kappa after every iteration with a gradient step, whatever the values. add: S + kappa when values
    settle. multiply: S * kappa then (kappa of at least 2). Source: ours; as SPaCE's."""
    reverse: bool = False
    """Highest first. Source: ours."""

    @property
    def columns_read(self) -> tuple[str, ...]:
        """See `_Curriculum`."""
        return (self.column,)


class UniformConfig(_Curriculum):
    """Domain randomisation over the set: every episode's instance is drawn uniformly."""

    kind: Literal["uniform"]
    """Which curriculum: uniform random."""


class SelfPacedConfig(_Curriculum):
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
        given = (self.target_mean is not None, self.target_std is not None)
        if self.target == "normal" and not all(given):
            raise ValueError("target: normal needs target_mean and target_std")
        if self.target == "set_moments" and any(given):
            raise ValueError("target_mean and target_std say nothing with target: set_moments; use target: normal")
        return self

    @property
    def ranks_by_start_value(self) -> bool:
        """See `_Curriculum`."""
        return not self.allow_context_blind

    @property
    def libraries(self) -> tuple[str, ...]:
        """See `_Curriculum`."""
        return ("scipy",)


class ValueDisagreementConfig(_Curriculum):
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
        """See `_Curriculum`."""
        return True


class AlpGmmConfig(_Curriculum):
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
        """See `_Curriculum`."""
        return ("scipy", "scikit-learn")


class LevelReplayConfig(_Curriculum):
    """Prioritised level replay (Jiang et al. 2021): by rank of mean |GAE|, and by how long ago. On-policy learners."""

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


class LearnabilityConfig(_Curriculum):
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
        """See `_Curriculum`."""
        return True


class ProximalConfig(_Curriculum):
    """ProCuRL (Tzannetos et al. 2023): instances whose value says that they succeed sometimes, by a softmax.

    No probes. Values are taken for probabilities of success, which they are where an episode's return is 1 or 0, or
    after scaling.
    """

    kind: Literal["procurl"]
    """Which curriculum: ProCuRL."""
    score: Literal["zone", "improvement"] = "zone"
    """zone: p (1 - p). improvement: by how much the value has risen in the last iteration (its authors' control
    `space-alt`). Source: Tzannetos et al. 2023."""
    beta: float = Field(default=20.0, gt=0.0)
    """Inverse temperature of the softmax. Source: the authors' code (20)."""
    scale: Literal["largest", "set"] = "largest"
    """What makes probabilities of values. largest: divided by `largest_return`, cut off at 0 and 1; for sparse rewards.
    set: from 0 for the least value of the set to 1 for the greatest. Source: the authors' code (both)."""
    largest_return: float = Field(default=1.0, gt=0.0)
    """Of scale: largest: the largest discounted return of an episode, in reward units."""

    @property
    def ranks_by_start_value(self) -> bool:
        """See `_Curriculum`."""
        return True


class WatchedConfig(_Curriculum):
    """Uniform draws that also count what every instance shows over time: what `space-dist headroom` measures with."""

    kind: Literal["watched"]
    """Which curriculum: uniform draws, watched."""
    iterations: int = Field(ge=1, le=10_000_000)
    """Of the whole run."""
    shares: int = Field(default=10, ge=1, le=1000)
    """Into which these are cut."""
    advantages: bool = True
    """Whether the sizes of advantages are counted, which on-policy learners have."""


class ReplayConfig(_Curriculum):
    """What another run was trained on, iteration after iteration: a *yoked* control, which adapts to nothing."""

    kind: Literal["replay"]
    """Which curriculum: another run's, replayed."""
    of: Path = Field(strict=False)
    """Folder of that run, which must be done, with a budget not smaller than this one's. A relative path is relative to
    this config file. It counts by its content, of which the run keeps a copy."""


class CustomConfig(_Curriculum):
    """A curriculum of your own: any that keeps the protocol (docs/your_curriculum.md)."""

    kind: Literal["custom"]
    """Which curriculum: your own."""
    import_path: str = Field(alias="import", min_length=1, max_length=300)
    """Import path (my_package.my_module:MyCurriculum) of a class derived from space_dist.curricula.Curriculum, or of a
    function that makes one."""
    kwargs: dict[str, bool | int | float | str] = Field(default={})
    """Arguments of the class, by name, besides the instances, seed, draws and bounds, which come from the run."""
    columns: tuple[Annotated[str, Field(min_length=1, max_length=100)], ...] = Field(
        default=(), max_length=MAX_LIST, strict=False
    )
    """Columns of instances.train that it reads, besides id and features: one number per instance, of any unit."""

    @field_validator("import_path")
    @classmethod
    def _of_your_own(cls, value: str) -> str:
        return own_path(value, "MyCurriculum")

    @property
    def may_probe(self) -> bool:
        """See `_Curriculum`. What it wants is known once it is made."""
        return True

    @property
    def columns_read(self) -> tuple[str, ...]:
        """See `_Curriculum`."""
        return self.columns

    @property
    def libraries(self) -> tuple[str, ...]:
        """See `_Curriculum`. SciPy's kernels are looked at wherever results may depend on them."""
        return ("scipy",)

    @property
    def import_paths(self) -> tuple[str, ...]:
        """See `_Curriculum`."""
        return (self.import_path,)


CurriculumConfig = Annotated[
    SpaceConfig
    | RoundRobinConfig
    | RandomGrowthConfig
    | ContextSpaceConfig
    | FixedConfig
    | ManualConfig
    | UniformConfig
    | SelfPacedConfig
    | ValueDisagreementConfig
    | AlpGmmConfig
    | LevelReplayConfig
    | LearnabilityConfig
    | ProximalConfig
    | ReplayConfig
    | WatchedConfig
    | CustomConfig,
    Field(discriminator="kind"),
]
