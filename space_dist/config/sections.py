"""What sections of a config are made of, and those that are short."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from space_dist.config.tracking_uri import AUTO, checked_uri
from space_dist.config.wanted import Words
from space_dist.system import ray_address
from space_dist.system.importing import why_refused

MAX_LIST = 10_000  # values of a list in a config
Sink = Literal["tensorboard", "wandb"]
SINKS: tuple[Sink, ...] = get_args(Sink)
_MAX_WORKERS = 4096  # as many as there may be shards
NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"
Name = Annotated[
    str, Field(pattern=NAME, max_length=100),
    Words("a name of letters, digits, dots, underscores and hyphens, the first a letter or a digit"),
]  # fmt: skip


class Section(BaseModel):
    """A part of a config: nothing unknown, nothing converted, nothing changed later."""

    model_config = ConfigDict(
        # strict: "1" is no number here, and 1 no truth value.
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True,
        serialize_by_alias=True,
    )  # fmt: skip


def refuse_library(value: str) -> str:
    """An id or import path, unless a library's: to read a stranger's config must call no function of a library."""
    if ":" in value and (reason := why_refused(value)) is not None:
        raise ValueError(reason)
    return value


def own_path(value: str, like: str) -> str:
    """An import path of somebody's own. `like`: a name for the sentence that any other word is refused with."""
    if not all(value.partition(":")):
        raise ValueError(f"must be an import path with a colon, like my_package.my_module:{like}")
    return refuse_library(value)


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
        return refuse_library(value)


class InstancesConfig(Section):
    """The instance sets."""

    # strict=False: YAML has no paths, only words.
    train: Path = Field(strict=False)
    """CSV of the training instances (columns: id and the context's features, in environment units); a relative path is
    relative to this config file."""
    test: Path = Field(strict=False)
    """CSV of the held-out instances: never trained on, and refused if it shares a context with `train`."""


_USUAL = 4  # shards and slots


class RolloutConfig(Section):
    """How transitions are collected; auto: by numbers that fit. All of it decides results; how many workers share the
    shards does not.
    """

    shards: int = Field(default=_USUAL, ge=1, le=4096)
    """Independent parts of a round; at most this many workers can share it. Left out, or auto: 4, or the most below
    with which shards * slots divides learner.n_steps."""
    slots: int = Field(default=_USUAL, ge=1, le=65536)
    """Environments stepped together in a shard. shards * slots must divide learner.n_steps; episodes go on from round
    to round, so n_steps / (shards * slots), the steps of a slot in a round, may be less than the horizon. Left out, or
    auto: as for shards."""
    passes: float = Field(default=1.0, gt=0.0)
    """Length of an iteration: as many updates as cover this many passes over the selected instances at full horizon."""
    start_states: int = Field(default=1, ge=1, le=1000)
    """Seeded start observations per instance whose mean value is its start value. One is exact where episodes start in
    one state (PointMass)."""
    overlap: bool = False
    """Collect a round while the update on the one before it runs, with the weights from before that update: for slow
    environments on rollout actors. Only the first round of an iteration waits for its selection. PPO, TRPO, A2C and
    RecurrentPPO without normalisation. Source: ours."""

    @model_validator(mode="before")
    @classmethod
    def _left_out(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        # Dropped, so that `model_fields_set` tells what a user chose; see `fitted`.
        return {key: value for key, value in data.items() if key not in ("shards", "slots") or value != "auto"}

    def fitted(self, n_steps: int | None) -> Self:
        """The same, with numbers that fit for what was left out. n_steps: of an update; None: it ends by episodes."""
        given = self.model_fields_set
        shards = self.shards if "shards" in given else _fitting(n_steps, self.slots if "slots" in given else 1)
        slots = self.slots if "slots" in given else _fitting(n_steps, shards)
        return self.model_copy(update={"shards": shards, "slots": slots})


def _fitting(n_steps: int | None, other: int) -> int:
    """The usual number, or the most below it whose product with `other` divides `n_steps`; 1 where none does."""
    if n_steps is None:
        return 1
    return next((number for number in range(_USUAL, 1, -1) if n_steps % (number * other) == 0), 1)


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


_USUAL_ROUNDS = 20  # between checkpoints
_WORTH = 0.01  # of a run's time


class CheckpointConfig(Section):
    """When the run makes its progress permanent; it does so too when asked to stop. Decides no result."""

    every_rounds: int | Literal["auto"] = Field(default="auto")
    """Updates between checkpoints, at most; auto: 20, and more where they would take more than a hundredth of the run's
    time."""
    every_seconds: float = Field(default=60.0, gt=0.0)
    """Seconds between checkpoints, at most (and at least one update)."""

    @field_validator("every_rounds")
    @classmethod
    def _some_rounds(cls, value: int | str) -> int | str:
        if isinstance(value, int) and value < 1:
            raise ValueError("must be at least 1, or auto")
        return value

    def is_due(self, rounds: int, seconds: float, cost: float) -> bool:
        """Whether to make one, so long after the last, whose writing took `cost` seconds."""
        if self.every_rounds != "auto":
            return rounds >= self.every_rounds or seconds >= self.every_seconds
        return seconds >= self.every_seconds or (rounds >= _USUAL_ROUNDS and cost <= _WORTH * seconds)


class Mirrors(Section):
    """Where a run or a grid is shown. Decides no result."""

    uri: str | None = Field(default=AUTO, max_length=2000)
    """MLflow tracking URI: sqlite:///FILE (relative to the current folder) or http(s)://HOST:PORT; auto:
    MLFLOW_TRACKING_URI of the environment, else sqlite:///mlflow.db; null: none."""
    sinks: tuple[Sink, ...] = Field(default=(), max_length=len(SINKS), strict=False)
    """Where else: tensorboard (event files) and wandb (Weights & Biases, offline), beside the run's own files. Each
    needs its package: space-dist[tensorboard], space-dist[wandb]."""

    @field_validator("uri")
    @classmethod
    def _known_kind(cls, value: str | None) -> str | None:
        return value if value in (None, AUTO) else checked_uri(value)

    @field_validator("sinks")
    @classmethod
    def _once(cls, value: tuple[Sink, ...]) -> tuple[Sink, ...]:
        if len({*value}) < len(value):
            raise ValueError("every sink once")
        return value

    @property
    def anywhere(self) -> bool:
        """Whether there is anything to mirror to."""
        return self.uri is not None or bool(self.sinks)


class TrackingConfig(Mirrors):
    """Where the run is shown: MLflow, TensorBoard, Weights & Biases. Decides no result."""

    experiment: str | None = Field(default=None, min_length=1, max_length=200)
    """MLflow experiment; null: MLFLOW_EXPERIMENT_NAME of the environment, else space_dist."""
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

    workers: int | Literal["auto"] = Field(default="auto")
    """Ray rollout actors; 0: everything in this process, without Ray. auto: of a Ray of its own, one for
    each CPU and shard at most, where slots are stepped one by one (single environments, PyBullet) and the budget is
    100,000 steps or more; else 0, as actors would gain nothing. In a cluster: one for each of its CPUs and shard at
    most."""
    address: str = Field(default="local", min_length=1, max_length=300)
    """local: a private Ray on this machine; auto or HOST:PORT: join that cluster."""
    grace_seconds: float = Field(default=25.0, gt=0.0)
    """After a signal, the time to reach a checkpoint; then the run ends on the last one. Both exit with 75."""

    @field_validator("workers")
    @classmethod
    def _so_many(cls, value: int | str) -> int | str:
        if isinstance(value, int) and not 0 <= value <= _MAX_WORKERS:
            raise ValueError(f"must be from 0 to {_MAX_WORKERS}, or auto")
        return value

    @field_validator("address")
    @classmethod
    def _of_a_ray(cls, value: str) -> str:
        if must := ray_address.fault(value):
            raise ValueError(must)
        return value


class CurriculumSection(Section):
    """A curriculum's settings, and what a run must know of it."""

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
