"""The schema of a run: one YAML file, checked to the last key, every field explained (`space-dist config schema`)."""

from __future__ import annotations

import functools
import hashlib
import io
import json
import re
import reprlib
import types
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from ruamel.yaml import YAML
from ruamel.yaml.constructor import DuplicateKeyError, SafeConstructor
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import AliasEvent

from space_dist.config.tracking_uri import UriError, checked_uri
from space_dist.errors import ConfigError, nearest
from space_dist.system.importing import why_refused

M = TypeVar("M", bound=BaseModel)

_MAX_CONFIG_BYTES = 64 << 10
_MAX_ALIASES = 20  # each may double what a file means
_MAX_WORD = 100  # characters of a key
_MAX_LIST = 10_000
_MAX_BRACKETS = 200  # open at once
_MAX_NESTING = 50
NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"


class Section(BaseModel):
    """A part of a config: nothing unknown, nothing converted, nothing changed later."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True,
        serialize_by_alias=True,
    )  # fmt: skip


def _refuse_library(value: str) -> str:
    """An id or import path, unless a library's: to read a stranger's config must call no function of a library."""
    if ":" in value and (reason := why_refused(value)) is not None:
        raise ValueError(reason)
    return value


class EnvConfig(Section):
    """The environment."""

    id: str = Field(min_length=1, max_length=300)
    """Registered id (space_dist/PointMass-v0) or import path (my_package.my_module:make): of a Gymnasium environment
    with a context_space, of a function that makes one or a batched environment, or of a class of CARL's."""
    kwargs: dict[str, bool | int | float | str] = {}
    """Arguments of the environment, by name. What they mean, and their units, is the environment's."""
    context_visible: bool = True
    """Whether observations end with the context, scaled from its bounds to [-1, 1]. The released SPaCE code hides it;
    value-based curricula need it where all episodes start alike."""

    @field_validator("id")
    @classmethod
    def _no_library(cls, value: str) -> str:
        return _refuse_library(value)


class InstancesConfig(Section):
    """The instance sets."""

    train: Path = Field(strict=False)
    """CSV of the training instances (columns: id and the context's features, in environment units); a relative path is
    relative to this config file."""
    test: Path = Field(strict=False)
    """CSV of the held-out instances: never trained on, and refused if it shares a context with `train`."""


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
    initial_mean: tuple[float, ...] | None = Field(default=None, min_length=1, max_length=_MAX_LIST, strict=False)
    """Mean of the first contexts, one number a feature, in environment units; null: the middle of the bounds. Source:
    Klink et al. 2020 on PointMass, which is that middle."""
    initial_std: tuple[Annotated[float, Field(gt=0.0)], ...] | None = Field(
        default=None, min_length=1, max_length=_MAX_LIST, strict=False
    )
    """Standard deviations of the first contexts, in environment units; null: a quarter of the bounds' width. Source:
    Klink et al. 2020 on PointMass, which is that quarter."""
    target: Literal["normal", "set_moments"] = "set_moments"
    """What the distribution moves to. normal: target_mean and target_std. set_moments: mean and covariance of the
    training instances. Source: Klink et al. 2020; ours, for sets that are not drawn from a normal distribution."""
    target_mean: tuple[float, ...] | None = Field(default=None, min_length=1, max_length=_MAX_LIST, strict=False)
    """With target: normal, its mean, one number a feature, in environment units."""
    target_std: tuple[Annotated[float, Field(gt=0.0)], ...] | None = Field(
        default=None, min_length=1, max_length=_MAX_LIST, strict=False
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
        default=None, min_length=1, max_length=_MAX_LIST, strict=False
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
    members_see: tuple[str, ...] | None = Field(default=None, min_length=1, max_length=_MAX_LIST, strict=False)
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


class CustomConfig(_Curriculum):
    """A curriculum of your own: any that keeps the protocol (docs/your_curriculum.md)."""

    kind: Literal["custom"]
    """Which curriculum: your own."""
    import_path: str = Field(alias="import", min_length=1, max_length=300)
    """Import path (my_package.my_module:MyCurriculum) of a class derived from space_dist.curricula.Curriculum, or of a
    function that makes one."""
    kwargs: dict[str, bool | int | float | str] = {}
    """Arguments of the class, by name, besides the instances, seed, draws and bounds, which come from the run."""
    columns: tuple[Annotated[str, Field(min_length=1, max_length=100)], ...] = Field(
        default=(), max_length=_MAX_LIST, strict=False
    )
    """Columns of instances.train that it reads, besides id and features: one number per instance, of any unit."""

    @field_validator("import_path")
    @classmethod
    def _of_your_own(cls, value: str) -> str:
        if not all(value.partition(":")):
            raise ValueError("must be an import path with a colon, like my_package.my_module:MyCurriculum")
        return _refuse_library(value)

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
    | CustomConfig,
    Field(discriminator="kind"),
]


class _Learner(Section):
    has_advantages: ClassVar[bool] = False
    """Whether an update tells the advantages of the transitions it is made of."""
    keeps_next_observations: ClassVar[bool] = False
    """Whether it is off-policy: it learns from a replay buffer, which holds what each step led to."""
    can_be_stacked: ClassVar[bool] = False
    """Whether updates of several can be computed together (engine: population)."""
    actions: ClassVar[Literal["any", "discrete", "bounded"]] = "any"
    """What it chooses among. bounded: numbers within bounds. any: numbers, with bounds or without, or one of a few."""

    policy: str = Field(default="MlpPolicy", min_length=1, max_length=300)
    """SB3's MlpPolicy (acts in NumPy, without torch), CnnPolicy (images), MultiInputPolicy (dictionaries), or the
    import path of a policy class (my_package.my_module:MyPolicy)."""
    learning_rate_schedule: Literal["constant", "linear"] = "constant"
    """`linear` falls to 0 at the end of the budget."""
    gamma: float = Field(default=0.95, ge=0.0, le=1.0)
    """Discount per step. Source: the paper, appendix A (0.95)."""
    net_arch: tuple[Annotated[int, Field(ge=1, le=16384)], ...] = Field(default=(64, 64), max_length=16, strict=False)
    """Units of each hidden layer, for actor and critic each. Source: the paper, appendix A (two layers of 64)."""
    normalize_observations: bool = False
    """Scale observations to mean 0 and standard deviation 1, as of the rounds before; one round of actions that ignore
    the observation, charged to the budget, gives the first scales."""
    normalize_rewards: bool = False
    """Divide rewards by the standard deviation of the discounted return, as of the rounds before. Start values are
    reported in unscaled reward units."""

    @field_validator("policy")
    @classmethod
    def _known_policy(cls, value: str) -> str:
        known = ("MlpPolicy", "CnnPolicy", "MultiInputPolicy")
        if value not in known and ":" not in value:
            raise ValueError(
                f"not known{nearest(value, known)} Allowed: {', '.join(known)}, or an import path with a colon"
            )
        return _refuse_library(value)

    @property
    def episodes_per_round(self) -> int | None:
        """Episodes that end a round, where steps do not."""
        return None

    def policy_settings(self) -> dict[str, Any]:
        """What SB3's policies of this kind are made with, besides layers and their activation."""
        return {}

    def is_compiled(self, engine: str) -> bool:  # noqa: ARG002 - some are not with any
        """Whether its updates are a compiled function of ours with this engine, where they are computed on a CPU."""
        return False

    @model_validator(mode="after")
    def _lean_knows_mlps_only(self) -> Self:
        if getattr(self, "update", "stock") == "lean" and self.policy != "MlpPolicy":
            raise ValueError(f"update: lean knows MlpPolicy only, not {self.policy}; allowed with it: stock")
        return self


class _OnPolicy(_Learner):
    has_advantages: ClassVar[bool] = True

    n_steps: int = Field(default=2048, ge=2)
    """Environment transitions per update, over all shards and slots; the same constant for every curriculum. Source:
    SB3's PPO (2048); sb3-contrib's TRPO and the released SPaCE code on PointMass differ (2048 and 1024)."""
    learning_rate: float = Field(default=3e-4, gt=0.0)
    """Step size of Adam. Source: SB3's PPO (3e-4); for TRPO it is the critic's, sb3-contrib has 1e-3."""
    gae_lambda: float = Field(default=0.99, ge=0.0, le=1.0)
    """Lambda of generalised advantage estimation. Source: the paper, appendix A (0.99)."""
    normalize_advantage: bool = True
    """Scale advantages to mean 0 and standard deviation 1 per minibatch. Source: SB3's PPO; its A2C does not."""
    activation: Literal["tanh", "relu"] = "tanh"
    """Activation of the hidden layers. Source: SB3."""
    log_std_init: float = 0.0
    """Natural logarithm of the initial standard deviation of continuous actions, in action units. Source: SB3."""

    def policy_settings(self) -> dict[str, Any]:
        """See `_Learner`."""
        return {"log_std_init": self.log_std_init}


class PPOConfig(_OnPolicy):
    """Stable-Baselines3 PPO."""

    can_be_stacked: ClassVar[bool] = True
    kind: Literal["ppo"]
    """Which learner: PPO."""
    batch_size: int = Field(default=64, ge=2)
    """Transitions per minibatch. Source: SB3 (64)."""
    n_epochs: int = Field(default=10, ge=1)
    """Passes over each update's transitions. Source: SB3 (10); the paper's PPO2 default is 4."""
    clip_range: float = Field(default=0.2, gt=0.0)
    """Clipping of the probability ratio. Source: SB3."""
    ent_coef: float = Field(default=0.0, ge=0.0)
    """Weight of the entropy bonus. Source: the paper, appendix A (0)."""
    vf_coef: float = Field(default=0.5, ge=0.0)
    """Weight of the value loss. Source: SB3 (0.5); the reference for the paper's learners has 1."""
    max_grad_norm: float | None = Field(default=0.5, gt=0.0)
    """Largest norm of the gradient; null: no clipping (the paper, appendix A). Source of the default: SB3."""
    target_kl: float | None = Field(default=None, gt=0.0)
    """Stop an update's epochs early at 1.5 times this divergence; null: never. Source: SB3."""
    update: Literal["stock", "lean"] = "stock"
    """stock: SB3's own train(). lean: the same minibatches, loss and optimiser in one compiled function, many times
    faster where networks are small, equal but for rounding, and with the same bits on every CPU; MlpPolicy only. Part
    of what a run is."""

    def is_compiled(self, engine: str) -> bool:
        """See `_Learner`."""
        return engine == "population" or self.update == "lean"


class TRPOConfig(_OnPolicy):
    """sb3-contrib TRPO."""

    can_be_stacked: ClassVar[bool] = True
    kind: Literal["trpo"]
    """Which learner: TRPO."""
    learning_rate: float = Field(default=1e-3, gt=0.0)
    """Step size of the critic's Adam. Source: sb3-contrib (1e-3); the paper's old library: about 0.24 (appendix A)."""
    batch_size: int = Field(default=128, ge=2)
    """Transitions per minibatch of the critic. Source: sb3-contrib."""
    target_kl: float = Field(default=0.004, gt=0.0)
    """Largest KL divergence of one policy step. Source: the paper, appendix A (0.004); sb3-contrib has 0.01."""
    n_critic_updates: int = Field(default=10, ge=1)
    """Passes of the critic over each update's transitions. Source: sb3-contrib (10); the paper's old library: 3."""
    cg_max_steps: int = Field(default=15, ge=1)
    """Conjugate gradient steps. Source: sb3-contrib (15); the paper's old library: 10."""
    cg_damping: float = Field(default=0.1, ge=0.0)
    """Damping of the Hessian-vector product. Source: sb3-contrib (0.1); the paper's old library: 0.01."""
    line_search_shrinking_factor: float = Field(default=0.8, gt=0.0, lt=1.0)
    """Factor by which a rejected policy step is shortened. Source: sb3-contrib."""
    line_search_max_iter: int = Field(default=10, ge=1)
    """Shortened steps tried before an update is given up. Source: sb3-contrib."""


class A2CConfig(_OnPolicy):
    """Stable-Baselines3 A2C: one gradient step on all of an update's transitions."""

    kind: Literal["a2c"]
    """Which learner: A2C."""
    learning_rate: float = Field(default=7e-4, gt=0.0)
    """Step size. Source: SB3."""
    normalize_advantage: bool = False
    """Scale advantages to mean 0 and standard deviation 1. Source: SB3."""
    ent_coef: float = Field(default=0.0, ge=0.0)
    """Weight of the entropy bonus. Source: SB3."""
    vf_coef: float = Field(default=0.5, ge=0.0)
    """Weight of the value loss. Source: SB3."""
    max_grad_norm: float | None = Field(default=0.5, gt=0.0)
    """Largest norm of the gradient; null: no clipping. Source: SB3."""
    use_rms_prop: bool = True
    """RMSProp as in TensorFlow, instead of Adam. Source: SB3."""
    rms_prop_eps: float = Field(default=1e-5, gt=0.0)
    """Epsilon of RMSProp. Source: SB3."""


class _OffPolicy(_Learner):
    keeps_next_observations: ClassVar[bool] = True

    n_steps: int = Field(default=512, ge=1)
    """Environment transitions per round, over all shards and slots, collected with the policy of the round before:
    SB3's train_freq."""
    n_episodes: int | None = Field(default=None, ge=1)
    """End a round with this many episodes instead; rollout.shards and rollout.slots must be 1. null: by n_steps."""
    gamma: float = Field(default=0.99, ge=0.0, le=1.0)
    """Discount per step. Source: SB3."""
    activation: Literal["tanh", "relu"] = "relu"
    """Activation of the hidden layers. Source: SB3."""
    batch_size: int = Field(default=256, ge=1)
    """Transitions per gradient step. Source: SB3's SAC and TD3 (256); its DQN has 32."""
    buffer_size: int = Field(default=100_000, ge=1, le=10**8)
    """Transitions that the replay buffer remembers. Source: ours (SB3: 1e6)."""
    learning_starts: int = Field(default=100, ge=0)
    """Environment steps of uniformly random actions, and before the first gradient step. Source: SB3 (100)."""
    gradient_steps_per_step: float = Field(default=1.0, gt=0.0, le=100.0)
    """Gradient steps per environment step. Source: SB3's SAC and TD3 (1); its DQN makes 1 every 4 steps (0.25)."""
    tau: float = Field(default=0.005, gt=0.0, le=1.0)
    """Share of the online network that enters the target network per update. Source: SB3's SAC and TD3."""
    update: Literal["stock", "lean"] = "stock"
    """stock: SB3's own train(). lean: the same minibatches, losses and optimisers in one compiled function, several
    times faster where networks are small, equal but for rounding, and with the same bits on every CPU; MlpPolicy only.
    Part of what a run is."""

    @property
    def episodes_per_round(self) -> int | None:
        """See `_Learner`."""
        return self.n_episodes

    def is_compiled(self, engine: str) -> bool:  # noqa: ARG002 - there are no populations of these
        """See `_Learner`."""
        return self.update == "lean"


class DQNConfig(_OffPolicy):
    """Stable-Baselines3 DQN (Huber loss, linear epsilon)."""

    actions: ClassVar[Literal["any", "discrete", "bounded"]] = "discrete"
    kind: Literal["dqn"]
    """Which learner: DQN."""
    learning_rate: float = Field(default=1e-4, gt=0.0)
    """Step size of Adam. Source: SB3."""
    batch_size: int = Field(default=32, ge=1)
    """Transitions per gradient step. Source: SB3."""
    gradient_steps_per_step: float = Field(default=0.25, gt=0.0, le=100.0)
    """Gradient steps per environment step. Source: SB3 (one every 4 steps)."""
    tau: float = Field(default=1.0, gt=0.0, le=1.0)
    """Share of the online network that enters the target network per update. Source: SB3 (1: a copy)."""
    target_update_interval: int = Field(default=10_000, ge=1)
    """Environment steps between updates of the target network. Source: SB3."""
    exploration_fraction: float = Field(default=0.1, ge=0.0, le=1.0)
    """Share of the run over which epsilon falls. Source: SB3."""
    exploration_initial_eps: float = Field(default=1.0, ge=0.0, le=1.0)
    """Probability of a random action at the start. Source: SB3. Before `learning_starts` all actions are random, so of
    the schedule only what lies behind it acts, and is logged."""
    exploration_final_eps: float = Field(default=0.05, ge=0.0, le=1.0)
    """Probability of a random action in the end. Source: SB3."""
    max_grad_norm: float | None = Field(default=10.0, gt=0.0)
    """Largest norm of the gradient; null: no clipping. Source: SB3."""
    scored_network: Literal["online", "target"] = "online"
    """The network whose max_a Q is an instance's start value. Source: ours; the paper's notebook scores the target."""


class SACConfig(_OffPolicy):
    """Stable-Baselines3 SAC. Its start values contain the entropy bonus."""

    actions: ClassVar[Literal["any", "discrete", "bounded"]] = "bounded"
    kind: Literal["sac"]
    """Which learner: SAC."""
    learning_rate: float = Field(default=3e-4, gt=0.0)
    """Step size of Adam, for actor, critic and entropy coefficient. Source: SB3."""
    net_arch: tuple[Annotated[int, Field(ge=1, le=16384)], ...] = Field(default=(256, 256), max_length=16, strict=False)
    """Units of each hidden layer, for actor and critics each. Source: SB3."""
    ent_coef: Literal["auto"] | float = "auto"
    """Entropy coefficient alpha; auto: learned. Source: SB3."""
    target_update_interval: int = Field(default=1, ge=1)
    """Gradient steps between updates of the target network. Source: SB3."""

    @field_validator("ent_coef")
    @classmethod
    def _not_negative(cls, value: str | float) -> str | float:
        if not isinstance(value, str) and value < 0.0:
            raise ValueError("must be at least 0, or auto")
        return value


class TD3Config(_OffPolicy):
    """Stable-Baselines3 TD3."""

    actions: ClassVar[Literal["any", "discrete", "bounded"]] = "bounded"
    kind: Literal["td3"]
    """Which learner: TD3."""
    learning_rate: float = Field(default=1e-3, gt=0.0)
    """Step size of Adam. Source: SB3."""
    net_arch: tuple[Annotated[int, Field(ge=1, le=16384)], ...] = Field(default=(400, 300), max_length=16, strict=False)
    """Units of each hidden layer, for actor and critics each. Source: SB3."""
    action_noise_std: float = Field(default=0.1, ge=0.0)
    """Standard deviation of the noise on executed actions, scaled to [-1, 1]. Source: Fujimoto et al. 2018 (0.1); SB3
    has none."""
    policy_delay: int = Field(default=2, ge=1)
    """Critic updates per actor update. Source: SB3."""
    target_policy_noise: float = Field(default=0.2, ge=0.0)
    """Standard deviation of the noise on target actions. Source: SB3."""
    target_noise_clip: float = Field(default=0.5, ge=0.0)
    """Limit of that noise. Source: SB3."""


LearnerConfig = Annotated[
    PPOConfig | TRPOConfig | A2CConfig | DQNConfig | SACConfig | TD3Config, Field(discriminator="kind")
]


def learners_that(ability: Literal["has_advantages", "keeps_next_observations", "can_be_stacked"]) -> list[str]:
    """The kinds of learners that can do something, for sentences."""
    sections: tuple[type[_Learner], ...] = get_args(get_args(LearnerConfig)[0])
    able = (section for section in sections if getattr(section, ability))
    return [get_args(section.model_fields["kind"].annotation)[0] for section in able]


class RolloutConfig(Section):
    """How transitions are collected. All of it decides results; how many workers share the shards does not."""

    shards: int = Field(default=4, ge=1, le=4096)
    """Independent parts of a round; at most this many workers can share it."""
    slots: int = Field(default=4, ge=1, le=65536)
    """Environments stepped together in a shard. shards * slots must divide learner.n_steps; episodes go on from round
    to round, so n_steps / (shards * slots), the steps of a slot in a round, may be less than the horizon."""
    passes: float = Field(default=1.0, gt=0.0)
    """Length of an iteration: as many updates as cover this many passes over the selected instances at full horizon."""
    start_states: int = Field(default=1, ge=1, le=1000)
    """Seeded start observations per instance whose mean value is its start value. One is exact where episodes start in
    one state (PointMass)."""
    overlap: bool = False
    """Collect a round while the update on the one before it runs, with the weights from before that update: for slow
    environments on rollout actors. Only the first round of an iteration waits for its selection. PPO, TRPO and A2C
    without normalisation. Source: ours."""


class BudgetConfig(Section):
    """How long a run is."""

    steps: int = Field(ge=1, le=10**12)
    """Real environment steps of training, warm-up and probes included. A run makes as many whole updates as fit."""
    episodes: int | None = Field(default=None, ge=1)
    """Training episodes after which the run ends if its steps have not; null: no such limit."""


class EvaluationConfig(Section):
    """Deterministic evaluation on every training and test instance, on environments and seeds of its own."""

    every_steps: int | Literal["log"] = Field(default=10_000)
    """Environment steps between evaluations; log: at 1e3, 3e3, 1e4, 3e4, ... Step 0 and the end are evaluated too."""
    episodes: int = Field(default=1, ge=1, le=1000)
    """Episodes per instance and evaluation, with the same seeds each time."""
    legacy_metric: bool = False
    """Also report `legacy_return`: stochastic policy, sum of r_t * gamma^(T-1-t). Source: the released code's plots."""

    @field_validator("every_steps")
    @classmethod
    def _positive(cls, value: int | str) -> int | str:
        if isinstance(value, int) and value < 1:
            raise ValueError("must be at least 1, or log")
        return value


class CheckpointConfig(Section):
    """When the run makes its progress permanent; it does so too when asked to stop. Decides no result."""

    every_rounds: int = Field(default=20, ge=1)
    """Updates between checkpoints, at most."""
    every_seconds: float = Field(default=60.0, gt=0.0)
    """Seconds between checkpoints, at most (and at least one update)."""


class TrackingConfig(Section):
    """Where MLflow keeps its mirror of the run. Decides no result."""

    uri: str | None = Field(default="sqlite:///mlflow.db", max_length=2000)
    """MLflow tracking URI: sqlite:///FILE (relative to the current folder) or http(s)://HOST:PORT; null: none."""
    experiment: str = Field(default="space_dist", min_length=1, max_length=200)
    """MLflow experiment."""

    @field_validator("uri")
    @classmethod
    def _known_kind(cls, value: str | None) -> str | None:
        return None if value is None else checked_uri(value)

    live: bool = True
    """Push while the run trains, from a process of its own. With false, `space-dist sync` pushes later."""


class Patience(Section):
    """How long a run waits for room on Ray, and for answers of its actors."""

    room_seconds: float = Field(default=120.0, gt=0.0)
    """How long to wait for Ray to have room for all workers at once, and, when nodes are lost, for any of them."""
    late_factor: float = Field(default=20.0, ge=1.0)
    """An actor that takes this many times the median of such calls is replaced, and its work done elsewhere..."""
    late_seconds: float = Field(default=60.0, gt=0.0)
    """... but none before it has taken so many seconds."""
    first_answer_seconds: float = Field(default=900.0, gt=0.0)
    """The same limit for an actor's start, and for calls of a kind that has not been answered yet."""


class ResourcesConfig(Patience):
    """What the run may use. Decides no result."""

    workers: int = Field(default=1, ge=0, le=4096)
    """Ray rollout actors; 0: everything in this process, without Ray."""
    address: str = Field(default="local", min_length=1, max_length=300)
    """local: a private Ray on this machine; auto or HOST:PORT: join that cluster."""
    grace_seconds: float = Field(default=25.0, gt=0.0)
    """After a signal, the time to reach a checkpoint; then the run ends on the last one. Both exit with 75."""


class RunConfig(Section):
    """One run."""

    name: str = Field(pattern=NAME)
    """Name of the configuration, in folders, tables and MLflow: letters, digits, dot, underscore, hyphen."""
    seed: int = Field(default=0, ge=0, le=2**31 - 1)
    """The one number from which every random number of the run comes."""
    engine: Literal["auto", "single", "population"] = "single"
    """How updates are computed. single: by SB3 itself. population: the same losses for many runs of one shape at once
    (PPO, as with learner.update: lean, and TRPO, with MlpPolicy); a grid puts such runs together, and one alone has the
    same bits. auto: population
    where the learner allows it; decided when a grid is frozen or a run begins. Part of what a run is."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where updates are computed; cuda: a GPU, with engine: population, where up to 1,024 runs share a process. A
    member's last bits depend on its companions there. Part of what a run is."""
    arithmetic: Literal["one", "native"] = "one"
    """Whose bits results have. one: the same on every x86-64 CPU with AVX2 and FMA. native: those of the kernels that
    libraries choose by the CPU, in processes that have SPACE_DIST_ARITHMETIC=native in their environment. Part of what
    a run is."""
    env: EnvConfig
    instances: InstancesConfig
    curriculum: CurriculumConfig
    learner: LearnerConfig
    rollout: RolloutConfig = RolloutConfig()
    budget: BudgetConfig
    evaluation: EvaluationConfig = EvaluationConfig()
    checkpoint: CheckpointConfig = CheckpointConfig()
    tracking: TrackingConfig = TrackingConfig()
    resources: ResourcesConfig = ResourcesConfig()

    @model_validator(mode="after")
    def _overlap_is_possible(self) -> Self:
        if not self.rollout.overlap:
            return self
        if self.learner.keeps_next_observations:
            raise ValueError(
                f"rollout.overlap: true: learner.kind: {self.learner.kind} is off-policy, and learns from older rounds "
                "anyway; it works with ppo, trpo and a2c"
            )
        if self.learner.normalize_observations or self.learner.normalize_rewards:
            raise ValueError(
                "rollout.overlap: true cannot be combined with learner.normalize_observations or "
                "learner.normalize_rewards: a round's scales would not be those of its weights"
            )
        if self.engine == "population":
            raise ValueError("rollout.overlap: true gains nothing with engine: population; use engine: single")
        return self

    @model_validator(mode="after")
    def _one_way_to_update(self) -> Self:
        if self.device == "cuda" and self.engine != "population":
            raise ValueError(
                f"device: cuda needs engine: population, not {self.engine}: a single run is faster on a CPU"
            )
        if self.engine == "population" and isinstance(self.learner, PPOConfig) and self.learner.update != "stock":
            raise ValueError(
                f"learner.update: {self.learner.update} says nothing with engine: population, which has updates of its "
                "own; use engine: single"
            )
        return self

    @model_validator(mode="after")
    def _population_shares_a_curriculum(self) -> Self:
        if self.n_policies == 1:
            return self
        if self.engine == "single" or not self.learner.can_be_stacked:
            raise ValueError("curriculum.aggregate: population needs engine: population, and learner.kind: ppo or trpo")
        if self.learner.normalize_observations or self.learner.normalize_rewards:
            raise ValueError(
                "curriculum.aggregate: population cannot be combined with learner.normalize_observations or "
                "learner.normalize_rewards: the policies' values would have scales of their own"
            )
        return self

    @model_validator(mode="after")
    def _whole_slots(self) -> Self:
        per_step = self.rollout.shards * self.rollout.slots
        if self.n_episodes is not None:
            if per_step != 1:
                raise ValueError(
                    "learner.n_episodes ends rounds by episodes, which takes rollout.shards = 1 and rollout.slots = 1, "
                    f"not {self.rollout.shards} and {self.rollout.slots}"
                )
            return self
        if self.learner.n_steps % per_step:
            raise ValueError(
                f"learner.n_steps = {self.learner.n_steps} is not a multiple of rollout.shards * rollout.slots = "
                f"{self.rollout.shards} * {self.rollout.slots} = {per_step}"
            )
        if self.budget.steps < self.learner.n_steps:
            raise ValueError(
                f"budget.steps = {self.budget.steps} is less than one update of learner.n_steps = "
                f"{self.learner.n_steps}"
            )
        return self

    @property
    def n_policies(self) -> int:
        """Policies that the run trains."""
        return self.curriculum.policies_trained

    @property
    def import_paths(self) -> tuple[str, ...]:
        """What names code of somebody's own, which results depend on as well: environment, policy and curriculum."""
        named = (self.env.id, self.learner.policy, *self.curriculum.import_paths)
        return tuple(path for path in named if ":" in path)

    @property
    def n_episodes(self) -> int | None:
        """Episodes per round, where rounds end by episodes."""
        return self.learner.episodes_per_round

    def slot_length(self, horizon: int) -> int:
        """Transitions per slot and round; the most there can be, where rounds end by episodes."""
        if self.n_episodes is not None:
            return self.n_episodes * horizon
        return self.learner.n_steps // (self.rollout.shards * self.rollout.slots)

    def round_steps(self, horizon: int) -> int:
        """Environment steps of a round; the most there can be, where rounds end by episodes."""
        return self.slot_length(horizon) * self.rollout.shards * self.rollout.slots * self.n_policies


NOT_IDENTITY = ("name", "checkpoint", "tracking", "resources")  # what cannot change a result


def load(path: Path, overrides: Sequence[str] = (), *, seed: int | None = None) -> RunConfig:
    """Read a config file, apply `a.b=c` overrides and the seed, and check everything.

    Relative instance paths become absolute, from the config's folder (from the current one in an override).
    Raises ConfigError with the file and key of every fault.
    """
    data = read(path)
    for override in overrides:
        apply_override(data, override)
    if seed is not None:
        data["seed"] = seed
    origins = {override.partition("=")[0].strip(): f"--set {override}" for override in overrides}
    return parse(data, str(path), origins)


def read(path: Path) -> dict[str, Any]:
    """A run's config as plain data, not checked yet; relative instance paths become absolute, from its folder."""
    data = read_yaml(path)
    instances = data.get("instances")
    if isinstance(instances, dict):
        data["instances"] = from_folder(instances, path.absolute().parent)
    return data


def from_folder(instances: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The `instances` section with its relative paths taken from `folder`."""
    return {key: str(folder / value) if isinstance(value, str) and value else value for key, value in instances.items()}


def parse(data: Mapping[str, Any], source: str, origins: Mapping[str, str] | None = None) -> RunConfig:
    """Check plain data against the schema of a run. `origins` says which keys came from elsewhere than `source`."""
    return check(RunConfig, data, source, origins)


def check(model: type[M], data: Mapping[str, Any], source: str, origins: Mapping[str, str] | None = None) -> M:
    """Check plain data against any schema made of sections. Raises ConfigError with the key of every fault."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        faults = [_explain(fault, model, source, origins or {}) for fault in error.errors(include_url=False)[:10]]
        raise ConfigError("\n".join(dict.fromkeys(faults))) from None


def dump(config: RunConfig) -> str:
    """The resolved config as YAML, every default written out."""
    return to_yaml(config.model_dump(mode="json"))


def identity(
    config: RunConfig, train_digest: str, test_digest: str, *, sources: Mapping[str, str] = MappingProxyType({}),
    with_seed: bool = True,
) -> str:  # fmt: skip
    """`(64 hex digits)` a hash of everything that decides the run's results; without its seed, that of a grid's cell.

    Instance files count by their content, and so does a user's own code: `sources`, by import path. Fields at their
    default are left out, so that a field that is added later changes no identity.
    """
    exclude = {*NOT_IDENTITY, "seed"}
    data = config.model_dump(mode="json", exclude=exclude, exclude_defaults=True)
    data["instances"] = {"train": train_digest, "test": test_digest}
    if sources:
        data["sources"] = dict(sources)
    if with_seed:
        data["seed"] = config.seed
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def differences(one: RunConfig, other: RunConfig) -> list[str]:
    """`key: value -> value` for every key that decides results and differs; instance paths are left out."""
    exclude = {*NOT_IDENTITY, "instances"}
    left = dict(flattened(one.model_dump(mode="json", exclude=exclude)))
    right = dict(flattened(other.model_dump(mode="json", exclude=exclude)))
    return [f"{key}: {left.get(key)} -> {right.get(key)}" for key in sorted({*left, *right})
            if left.get(key) != right.get(key)]  # fmt: skip


def schema() -> Iterator[tuple[str, str, str, str]]:
    """(key, type, default, explanation) of every field, in order."""
    yield from _describe(RunConfig, "")


def flattened(data: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(`section.key`, value) of everything in nested settings; of an empty section nothing."""
    for key, value in data.items():
        if isinstance(value, Mapping):
            yield from flattened(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def to_yaml(data: Mapping[str, Any]) -> str:
    """Plain data as YAML text."""
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    buffer = io.StringIO()
    yaml.dump(dict(data), buffer)
    return buffer.getvalue()


def read_yaml(path: Path) -> dict[str, Any]:
    """The keys and values of a YAML file that is small, plain and UTF-8. Raises ConfigError otherwise."""
    try:
        if path.is_dir():
            raise ConfigError(f"{path} is a folder; a config is a YAML file")
        if path.exists() and not path.is_file():
            raise ConfigError(f"{path} is not a regular file")
        with path.open("rb") as file:
            content = file.read(_MAX_CONFIG_BYTES + 1)
    except FileNotFoundError:
        folder = path.parent
        siblings = [str(file) for file in folder.glob("*.yaml")] if folder.is_dir() else []
        raise ConfigError(f"{path} does not exist{nearest(str(path), siblings)}") from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if len(content) > _MAX_CONFIG_BYTES:
        raise ConfigError(f"{path} is larger than {_MAX_CONFIG_BYTES >> 10} KiB: that is no config")
    data = _parse_yaml(content, str(path))
    if not isinstance(data, dict):
        raise ConfigError(f"{path} must hold keys and values, like `name: my_run`; it holds {_short(data)}")
    return data


class _Constructor(SafeConstructor):
    """Numbers that cannot be read, and dates, stay words: the schema then says what is wrong, and with which key."""

    def _number_or_word(self, node: Any) -> Any:
        read = self.construct_yaml_int if node.tag.endswith(":int") else self.construct_yaml_float
        try:
            return read(node)
        except ValueError:
            return node.value


_Constructor.add_constructor("tag:yaml.org,2002:int", _Constructor._number_or_word)
_Constructor.add_constructor("tag:yaml.org,2002:float", _Constructor._number_or_word)
_Constructor.add_constructor("tag:yaml.org,2002:timestamp", SafeConstructor.construct_yaml_str)


class _ValueFaultError(ValueError):
    """A value that no config can hold; its text begins with the key."""


def _parse_yaml(content: bytes | str, source: str) -> Any:
    try:
        text = content.decode() if isinstance(content, bytes) else content
        return _plain(_loaded(text, source))
    except UnicodeDecodeError as error:
        raise ConfigError(f"{source} is not UTF-8 text (byte {error.start})") from None
    except DuplicateKeyError as error:
        where = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        problem = str(error.problem).split(" with value")[0]
        raise ConfigError(f"{source}{where}: {clean(problem)}: every key may stand once") from None
    except YAMLError as error:
        mark = error.problem_mark if isinstance(error, MarkedYAMLError) else None
        where = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = error.problem if isinstance(error, MarkedYAMLError) and error.problem else str(error)
        raise ConfigError(f"{source}{where} is not valid YAML: {clean(str(problem))}") from None
    except _ValueFaultError as error:
        raise ConfigError(f"{source}: {error}") from None
    except RecursionError:
        raise ConfigError(f"{source} is nested too deeply") from None
    except (ValueError, TypeError, AttributeError, KeyError, IndexError, OverflowError, NotImplementedError,
            AssertionError) as error:  # fmt: skip  # ruamel asserts that %YAML names a version it knows
        raise ConfigError(f"{source} is not valid YAML: {clean(str(error))}") from None


@functools.lru_cache(maxsize=64)
def _loaded(text: str, source: str) -> Any:
    """What a YAML text says, for `_plain` to copy: ten milliseconds for a run's, which is read several times."""
    yaml = YAML(typ="safe", pure=True)
    yaml.Constructor = _Constructor
    yaml.allow_duplicate_keys = False
    _refuse_tricks(text, source)
    return yaml.load(text)


def _refuse_tricks(text: str, source: str) -> None:
    """Refuse what makes a small file mean a large one, or name types. Raises ConfigError, RecursionError."""
    depth = 0
    for bracket in re.findall(r"[\[{}\]]", text):
        depth += 1 if bracket in "[{" else -1
        if depth > _MAX_BRACKETS:  # ruamel would take minutes to say so
            raise RecursionError
    aliases = 0
    for event in YAML(typ="safe", pure=True).parse(text):
        aliases += isinstance(event, AliasEvent)
        tag = getattr(event, "tag", None)
        if tag is not None and str(tag) != "!":
            line = event.start_mark.line + 1
            raise ConfigError(
                f"{source}, line {line} is not valid YAML for a config: tags like {clean(str(tag))!r} are not read"
            )
    if aliases > _MAX_ALIASES:
        raise ConfigError(f"{source} has {aliases} aliases; at most {_MAX_ALIASES} are read")


def _plain(value: Any, path: tuple[str, ...] = ()) -> Any:
    """Only what JSON knows, so that dates, sets and self-containing aliases cannot surprise anyone later."""
    if len(path) > _MAX_NESTING:
        raise RecursionError

    def fault(what: str) -> ValueError:
        return _ValueFaultError(f"{'.'.join(path) or 'the whole file'}: {what}")

    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str) or not key.isprintable() or len(key) > _MAX_WORD:
                raise ValueError(f"{'.'.join(path)}: the key {_short(key)} is not a word".removeprefix(": "))
        return {str(key): _plain(item, (*path, str(key))) for key, item in value.items()}
    if isinstance(value, list):
        if len(value) > _MAX_LIST:
            raise fault(f"a list of {len(value)} values")
        return [_plain(item, (*path, str(index))) for index, item in enumerate(value)]
    if isinstance(value, str) and not value.isprintable():
        raise fault(f"{_short(value)} holds characters that cannot be printed")
    if isinstance(value, int) and abs(value) >= 1 << 63:
        raise fault("a number of more than 63 bits")
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return int(value) if abs(value) < 1 << 63 and value.is_integer() else value  # 1e6 is how people write counts
    raise fault(f"{_short(value)} is a {type(value).__name__}; write numbers, words, lists and keys only")


def put(data: dict[str, Any], key: str, value: Any, where: str) -> None:
    """Set `a.b` in nested data, making sections on the way. Raises ConfigError if `a` is no section."""
    section: Any = data
    *parents, last = key.split(".")
    for part in parents:
        section = section.setdefault(part, {})
        if not isinstance(section, dict):
            raise ConfigError(f"{where}: {part!r} is not a section")
    section[last] = value


def apply_override(data: dict[str, Any], override: str) -> None:
    """Set what `a.b=c` says in plain data; the value is read as YAML. Raises ConfigError if it says nothing."""
    key, equals, text = override.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts) or not override.isprintable():
        raise ConfigError(f"--set {override!r}: write KEY=VALUE, like --set budget.steps=20000")
    value = _parse_yaml(text, f"--set {override}")
    if parts[0] == "instances":
        value = _from_here(value)
    put(data, ".".join(parts), value, f"--set {override}")


def _from_here(value: Any) -> Any:
    """Instance paths of an override, relative to the current folder, as absolute ones."""
    if isinstance(value, dict):
        return {key: _from_here(item) for key, item in value.items()}
    return str(Path(value).absolute()) if isinstance(value, str) and value else value


def _explain(fault: Any, root: type[BaseModel], source: str, origins: Mapping[str, str]) -> str:
    path, model = _locate(fault["loc"], root)
    if fault["type"].startswith("union_tag"):
        path.append("kind")
    key = ".".join(path)
    related = (
        origin for name, origin in origins.items() if f"{key}.".startswith(f"{name}.") or name.startswith(f"{key}.")
    )
    where = next(related, source)
    kind, given = fault["type"], fault.get("input")
    context = fault.get("ctx", {})
    if kind == "extra_forbidden":
        allowed = [_key(name, field) for name, field in model.model_fields.items()] if model else []
        return f"{where}: {key}: unknown key{nearest(path[-1], allowed)} Allowed here: {', '.join(allowed)}"
    if kind == "missing":
        return f"{where}: {key}: this key is required"
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        tags = [tag.strip("' ") for tag in str(context.get("expected_tags") or _tags(path[0])).split(",")]
        given_kind = given.get("kind") if isinstance(given, dict) else given
        hint = nearest(str(given_kind), tags) if given_kind is not None else "."
        return f"{where}: {key}: {_short(given_kind)} is not known{hint} Allowed: {', '.join(tags)}"
    if kind == "value_error":
        message = str(context.get("error", fault["msg"]))
        if isinstance(given, Mapping):  # a section whose keys do not go together; the message names them
            return f"{where}: {key}: {message}" if key else f"{where}: {message}"
        if isinstance(context.get("error"), UriError):
            return f"{where}: {key}: {message}"
        return f"{where}: {key}: {message}, not {_short(given)}"
    return f"{where}: {key or 'the whole file'}: {_short(given)}: {fault['msg']}"


def _tags(key: str) -> str:
    return ", ".join(
        str(get_args(option.model_fields["kind"].annotation)[0]) for option in _models(RunConfig.model_fields[key])
    )


def _locate(location: tuple[int | str, ...], root: type[BaseModel]) -> tuple[list[str], type[BaseModel] | None]:
    """Pydantic's location without the tags of unions, and the section it lies in."""
    path: list[str] = []
    model: type[BaseModel] | None = root
    options: list[type[BaseModel]] = []
    for part in location:
        tagged = [option for option in options if get_args(option.model_fields["kind"].annotation)[0] == part]
        if tagged:
            model, options = tagged[0], []
            continue
        if isinstance(part, str) and model is None:
            continue  # the name pydantic gives to one alternative of a value, like int or literal['log']
        path.append(str(part))
        field = model.model_fields.get(str(part)) if model else None
        inner = _models(field) if field else []
        if field is not None and part != location[-1]:
            model = inner[0] if len(inner) == 1 else None
            options = inner if len(inner) > 1 else []
    return path, model


def _models(field: Any) -> list[type[BaseModel]]:
    annotations = (
        get_args(field.annotation) if get_origin(field.annotation) in (Union, types.UnionType) else [field.annotation]
    )
    return [annotation for annotation in annotations
            if isinstance(annotation, type) and issubclass(annotation, BaseModel)]  # fmt: skip


def _key(name: str, field: Any) -> str:
    """What a config calls a field."""
    return str(field.alias or name)


def _describe(model: type[BaseModel], prefix: str) -> Iterator[tuple[str, str, str, str]]:
    for name, field in model.model_fields.items():
        key, inner = f"{prefix}{_key(name, field)}", _models(field)
        if not inner:
            default = "required" if field.is_required() else json.dumps(field.get_default(), default=str)
            yield key, _type_name(field), default, " ".join((field.description or "").split())
        for section in inner:
            tag = f" ({section.model_fields['kind'].annotation.__args__[0]})" if len(inner) > 1 else ""  # type: ignore[union-attr]
            yield f"{key}{tag}", "section", "", " ".join((section.__doc__ or "").split())
            yield from _describe(section, f"{key}.")


def _type_name(field: Any) -> str:
    annotation = field.annotation
    name = str(annotation) if get_origin(annotation) else annotation.__name__
    name = name.replace("typing.", "").replace("NoneType", "null").replace("None", "null")
    limits = [f"{symbol} {getattr(item, attribute)}" for item in field.metadata
              for attribute, symbol in (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="))
              if hasattr(item, attribute)]  # fmt: skip
    if name.startswith("tuple"):
        name = f"list of {re.findall(r'int|float|str', name)[0]}"
    return " ".join([name, *limits])


def clean(text: str) -> str:
    """At most 200 characters of somebody else's text, none of which commands a terminal."""
    line = (text.splitlines() or [""])[0][:200]
    return "".join(character if character.isprintable() else repr(character)[1:-1] for character in line)


def _short(value: object) -> str:
    shortener = reprlib.Repr()
    shortener.maxstring = shortener.maxother = 80
    shortener.maxlevel = 2
    return shortener.repr(value)
