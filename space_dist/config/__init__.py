"""The schema of a run: one YAML file, checked to the last key, every field explained (`space-dist config schema`).

    reading                                  a file, what the command line changes of it, and the check
    explaining, identities                   the schema and its faults in sentences; what of a config decides results
    run                                      a whole config, and what its sections must agree about
    curriculum, learner, sections            its sections
    shipped                                  what comes with the package
    plain_yaml, tracking_uri                 what is not about runs
    wanted, quoting                          values, and types, in sentences

Each imports from those below it.
"""

from __future__ import annotations

from space_dist.config.curriculum import (
    CurriculumConfig,
    CustomConfig,
    ReplayConfig,
    WatchedConfig,
)
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
from space_dist.config.explaining import schema, what_sb3_calls
from space_dist.config.growing import (
    ContextSpaceConfig,
    FixedConfig,
    GrowingConfig,
    ManualConfig,
    RandomGrowthConfig,
    RoundRobinConfig,
    SpaceConfig,
)
from space_dist.config.identities import NOT_IDENTITY, changes, differences, flattened, identity
from space_dist.config.learner import (
    A2CConfig,
    DQNConfig,
    LearnerConfig,
    PPOConfig,
    RecurrentPPOConfig,
    SACConfig,
    TD3Config,
    TRPOConfig,
    learners_that,
)
from space_dist.config.plain_yaml import plain, read_yaml, to_yaml
from space_dist.config.quoting import clean
from space_dist.config.reading import (
    apply_override,
    beside,
    check,
    dump,
    from_folder,
    from_its_folder,
    from_program,
    load,
    origins,
    parse,
    put,
    read,
    refuse_all_but_profiles,
    refuse_profile,
    told,
)
from space_dist.config.run import CHANGEABLE, Change, RunConfig
from space_dist.config.sections import (
    NAME,
    BudgetConfig,
    CheckpointConfig,
    EnvConfig,
    EvaluationConfig,
    InstancesConfig,
    Mirrors,
    Name,
    Patience,
    ResourcesConfig,
    RolloutConfig,
    Section,
    TrackingConfig,
)
from space_dist.config.shipped import about_shipped, located, read_named, shipped_as, shipped_files, with_what_it_names

__all__ = [
    "CHANGEABLE",
    "NAME",
    "NOT_IDENTITY",
    "A2CConfig",
    "AccelConfig",
    "AlpGmmConfig",
    "BudgetConfig",
    "Change",
    "CheckpointConfig",
    "ContextSpaceConfig",
    "CurriculumConfig",
    "CustomConfig",
    "DQNConfig",
    "EdgeConfig",
    "EnvConfig",
    "EvaluationConfig",
    "FixedConfig",
    "GrowingConfig",
    "InstancesConfig",
    "LearnabilityConfig",
    "LearnerConfig",
    "LearningProgressConfig",
    "LevelReplayConfig",
    "ManualConfig",
    "Mirrors",
    "Name",
    "PPOConfig",
    "Patience",
    "ProximalConfig",
    "RandomGrowthConfig",
    "RecurrentPPOConfig",
    "ReplayConfig",
    "ResourcesConfig",
    "RolloutConfig",
    "RoundRobinConfig",
    "RunConfig",
    "SACConfig",
    "Section",
    "SelfPacedConfig",
    "SpaceConfig",
    "TD3Config",
    "TRPOConfig",
    "TrackingConfig",
    "TransportConfig",
    "UniformConfig",
    "ValueDisagreementConfig",
    "WatchedConfig",
    "about_shipped",
    "apply_override",
    "beside",
    "changes",
    "check",
    "clean",
    "differences",
    "dump",
    "flattened",
    "from_folder",
    "from_its_folder",
    "from_program",
    "identity",
    "learners_that",
    "load",
    "located",
    "origins",
    "parse",
    "plain",
    "put",
    "read",
    "read_named",
    "read_yaml",
    "refuse_all_but_profiles",
    "refuse_profile",
    "schema",
    "shipped_as",
    "shipped_files",
    "to_yaml",
    "told",
    "what_sb3_calls",
    "with_what_it_names",
]
