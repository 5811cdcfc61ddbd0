"""Sections of the curricula that train on a set: one that grows, all, or a part."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from space_dist.config.sections import CurriculumSection


class GrowingConfig(CurriculumSection):
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
        """See `CurriculumSection`."""
        return self.v0 == "zero"

    @property
    def policies_trained(self) -> int:
        """See `CurriculumSection`."""
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
        """See `CurriculumSection`."""
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


class RoundRobinConfig(CurriculumSection):
    """All instances in turn, in a random order fixed by the seed (the paper's first baseline, section 5.2)."""

    kind: Literal["round_robin"]
    """Which curriculum: round robin."""


class FixedConfig(CurriculumSection):
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
    """Column of instances.train with one number per instance, of any unit, or a feature: the lowest come first.
    Source: ours."""
    growth: Literal["add", "multiply", "schedule"] = "schedule"
    """schedule: S + kappa after every iteration with a gradient step, whatever the values. add: S + kappa when values
    settle. multiply: S * kappa then (kappa of at least 2). Source: ours; as SPaCE's."""
    reverse: bool = False
    """Highest first. Source: ours."""

    @property
    def columns_read(self) -> tuple[str, ...]:
        """See `CurriculumSection`."""
        return (self.column,)
