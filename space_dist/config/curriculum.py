"""What `curriculum` of a config may be: sets (`growing`), draws (`drawing`), and what is neither."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator

from space_dist.config.drawing import (
    AccelConfig,
    AlpGmmConfig,
    EdgeConfig,
    LearnabilityConfig,
    LearningProgressConfig,
    LevelReplayConfig,
    ProximalConfig,
    SelfPacedConfig,
    TransportConfig,
    UniformConfig,
    ValueDisagreementConfig,
)
from space_dist.config.growing import (
    ContextSpaceConfig,
    FixedConfig,
    ManualConfig,
    RandomGrowthConfig,
    RoundRobinConfig,
    SpaceConfig,
)
from space_dist.config.sections import MAX_LIST, CurriculumSection, own_path


class WatchedConfig(CurriculumSection):
    """Uniform draws that also count what every instance shows over time: what `space-dist headroom` measures with."""

    kind: Literal["watched"]
    """Which curriculum: uniform draws, watched."""
    iterations: int = Field(ge=1, le=10_000_000)
    """Of the whole run."""
    shares: int = Field(default=10, ge=1, le=1000)
    """Into which these are cut."""
    advantages: bool = True
    """Whether the sizes of advantages are counted, which on-policy learners have."""


class ReplayConfig(CurriculumSection):
    """What another run was trained on, iteration after iteration: a *yoked* control, which adapts to nothing."""

    kind: Literal["replay"]
    """Which curriculum: another run's, replayed."""
    of: Path = Field(strict=False)
    """Folder of that run, which must be done, with a budget not smaller than this one's. A relative path is relative to
    this config file. It counts by its content, of which the run keeps a copy."""


class CustomConfig(CurriculumSection):
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
        """See `CurriculumSection`. What it wants is known once it is made."""
        return True

    @property
    def columns_read(self) -> tuple[str, ...]:
        """See `CurriculumSection`."""
        return self.columns

    @property
    def libraries(self) -> tuple[str, ...]:
        """See `CurriculumSection`. SciPy's kernels are looked at wherever results may depend on them."""
        return ("scipy",)

    @property
    def import_paths(self) -> tuple[str, ...]:
        """See `CurriculumSection`."""
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
    | AccelConfig
    | LearnabilityConfig
    | ProximalConfig
    | LearningProgressConfig
    | TransportConfig
    | EdgeConfig
    | ReplayConfig
    | WatchedConfig
    | CustomConfig,
    Field(discriminator="kind"),
]
