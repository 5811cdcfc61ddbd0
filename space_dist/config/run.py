"""The whole config of a run, and what its sections must agree about."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal, Self

from pydantic import Field, ValidationError, ValidationInfo, field_validator, model_validator

from space_dist.config.curriculum import CurriculumConfig
from space_dist.config.learner import LearnerConfig, PPOConfig, learners_that
from space_dist.config.sections import (
    BudgetConfig,
    CheckpointConfig,
    EnvConfig,
    EvaluationConfig,
    InstancesConfig,
    Name,
    ResourcesConfig,
    RolloutConfig,
    Section,
    TrackingConfig,
)
from space_dist.errors import nearest

CHANGEABLE: Final = (
    "learner.learning_rate", "learner.gamma", "learner.gae_lambda", "learner.batch_size", "learner.n_epochs",
    "learner.clip_range", "learner.ent_coef", "learner.vf_coef", "learner.max_grad_norm", "learner.target_kl",
    "curriculum.eta", "curriculum.kappa", "curriculum",
)  # fmt: skip
"""What may change on the way: numbers that no array of a checkpoint has its shape by, and the curriculum as a whole."""


class Change(Section):
    """Settings that change on the way: a list, by steps, ascending; such as population-based training finds."""

    steps: int = Field(ge=1)
    """They are in force from the first update at or behind so many environment steps."""
    set: dict[str, Any]
    """Config keys and values: numbers of the learner's and of SPaCE's that decide no shape; or `curriculum`, a whole
    section, which begins anew."""

    @field_validator("set")
    @classmethod
    def _changeable(cls, given: dict[str, Any]) -> dict[str, Any]:
        if not given:
            raise ValueError(f"changes nothing. Allowed: {', '.join(CHANGEABLE)}")
        for key in given:
            if key not in CHANGEABLE:
                raise ValueError(
                    f"{key} cannot change on the way{nearest(key, CHANGEABLE)} Allowed: {', '.join(CHANGEABLE)}"
                )
        return given

    @property
    def replaces_curriculum(self) -> bool:
        """Whether another curriculum comes into force, which begins anew."""
        return "curriculum" in self.set


class Fork(Section):
    """A part of the run that another run shares: a continuation of what that has learned."""

    seed: int = Field(ge=0, le=2**31 - 1)
    """Of that run: every random number comes from it until then."""
    steps: int = Field(ge=1)
    """The run's own seed is in force from the first update at or behind so many environment steps."""


class RunConfig(Section):
    """One run: what checking a config gives. `Run(...).config` is one, and `train` takes one. None is made by hand."""

    name: Name
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
    init_from: Path | None = Field(default=None, strict=False)
    """Folder of a run whose last networks this one starts from; its optimisers and its curriculum are fresh. A relative
    path is relative to this config file. It counts by its content, of which the run keeps a copy. null: fresh ones."""
    env: EnvConfig
    instances: InstancesConfig
    curriculum: CurriculumConfig
    learner: LearnerConfig
    rollout: RolloutConfig = Field(default=RolloutConfig(), validate_default=True)  # behind learner, which it must fit
    budget: BudgetConfig
    schedule: tuple[Change, ...] = Field(default=(), max_length=1000, strict=False)
    """Settings that change on the way: a list, by steps, ascending; such as population-based training finds."""
    fork: Fork | None = None
    """How far the run is the same as one of another seed. null: it has its own from its start."""
    evaluation: EvaluationConfig = EvaluationConfig()
    checkpoint: CheckpointConfig = CheckpointConfig()
    tracking: TrackingConfig = TrackingConfig()
    resources: ResourcesConfig = ResourcesConfig()

    @field_validator("rollout", mode="before")
    @classmethod
    def _all_auto(cls, value: Any) -> Any:
        return {} if value == "auto" else value

    @field_validator("rollout")
    @classmethod
    def _fitting(cls, rollout: RolloutConfig, info: ValidationInfo) -> RolloutConfig:
        learner: LearnerConfig | None = info.data.get("learner")  # None: it has faults of its own
        if learner is None:
            return rollout
        return rollout.fitted(learner.n_steps if learner.episodes_per_round is None else None)

    @model_validator(mode="after")
    def _overlap_is_possible(self) -> Self:
        if not self.rollout.overlap:
            return self
        if self.learner.keeps_next_observations:
            raise ValueError(
                f"rollout.overlap: true: learner.kind: {self.learner.kind} is off-policy, and learns from older rounds "
                f"anyway; it works with {', '.join(learners_that('has_advantages'))}"
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
        if self.engine == "population" and self.learner.import_path is not None:
            raise ValueError(
                "learner.import says nothing with engine: population, which has updates of its own; use engine: single"
            )
        return self

    @model_validator(mode="after")
    def _population_shares_a_curriculum(self) -> Self:
        if self.n_policies == 1:
            return self
        if self.engine == "single" or not self.learner.can_be_stacked:
            raise ValueError("curriculum.aggregate: population needs engine: population, and learner.kind: ppo or trpo")
        if self.learner.import_path is not None:
            raise ValueError(
                "curriculum.aggregate: population needs engine: population, which has updates of its own, and so none "
                "for a class that learner.import names"
            )
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
        # A slot's share of a round must be whole: `n_steps` is the same constant for every curriculum (decision 8).
        if self.learner.n_steps % per_step:
            raise ValueError(
                f"learner.n_steps = {self.learner.n_steps} is not a multiple of rollout.shards * rollout.slots = "
                f"{self.rollout.shards} * {self.rollout.slots} = {per_step}. {self._ways_out(per_step)}"
            )
        if self.budget.steps < self.learner.n_steps:
            raise ValueError(
                f"budget.steps = {self.budget.steps} is less than one update of learner.n_steps = "
                f"{self.learner.n_steps}. Use budget.steps: {self.learner.n_steps} or more"
            )
        return self

    def _ways_out(self, per_step: int) -> str:
        """Numbers that would do instead of what a user gave."""
        n_steps = self.learner.n_steps
        fitting = RolloutConfig().fitted(n_steps)
        multiples = [f"{multiple}" for multiple in (n_steps // per_step * per_step, -(-n_steps // per_step) * per_step)
                     if multiple]  # fmt: skip
        return (
            f"Use rollout: auto ({fitting.shards} and {fitting.slots} here), or learner.n_steps: "
            f"{' or '.join(multiples)}"
        )

    @model_validator(mode="after")
    def _schedule_is_possible(self) -> Self:
        steps = [change.steps for change in self.schedule]
        if steps != sorted({*steps}) or (steps and steps[-1] >= self.budget.steps):
            raise ValueError(f"schedule: steps must ascend, and stay below budget.steps = {self.budget.steps}: {steps}")
        if any("curriculum.eta" in change.set for change in self.schedule) and (
            getattr(self.curriculum, "adaptive_eta", "off") == "persistent"
        ):
            raise ValueError("schedule: curriculum.eta says nothing once adaptive_eta: persistent has raised it")
        if self.fork is not None and self.fork.steps >= self.budget.steps:
            raise ValueError(f"fork.steps = {self.fork.steps} is not below budget.steps = {self.budget.steps}")
        for place, change in enumerate(self.schedule):
            try:
                found = self.at(change.steps)
            except ValidationError as error:
                from space_dist.config.explaining import explain  # which knows this schema

                fault = error.errors(include_url=False)[0]
                raise ValueError(explain(fault, RunConfig, f"schedule.{place}", {}, change.set)) from None
            if change.replaces_curriculum and found.n_policies != self.n_policies:
                raise ValueError(f"schedule.{place}: curriculum.aggregate: the number of policies cannot change")
            if change.replaces_curriculum and "curriculum.of" in found.given_paths:
                raise ValueError(f"schedule.{place}: curriculum.kind: replay follows a run from its start")
        return self

    def at(self, steps: int) -> RunConfig:
        """The config in force from the first update at or behind so many steps on: one that stays as it is."""
        if not self.changes:
            return self
        data = self.model_dump(exclude={"schedule", "fork"})
        if self.fork is not None and steps < self.fork.steps:
            data["seed"] = self.fork.seed
        for change in self.schedule:
            if change.steps <= steps:
                for key, value in change.set.items():
                    section, _, name = key.partition(".")
                    data[section] = {**data[section], name: value} if name else value
        return RunConfig.model_validate(data)

    @property
    def changes(self) -> tuple[int, ...]:
        """The steps at which something changes on the way, ascending."""
        return tuple(sorted({*(change.steps for change in self.schedule), *([self.fork.steps] if self.fork else ())}))

    def change_after(self, steps: int) -> int:
        """The steps of the next change behind so many; 0: there is none."""
        return next((change for change in self.changes if change > steps), 0)

    def curriculum_number(self, steps: int) -> int:
        """How many curricula were in force before the one that is, from the first update at or behind so many steps."""
        return sum(change.replaces_curriculum for change in self.schedule if change.steps <= steps)

    @property
    def curricula(self) -> tuple[CurriculumConfig, ...]:
        """All that come into force, in order."""
        later = (self.at(change.steps).curriculum for change in self.schedule if change.replaces_curriculum)
        return (self.curriculum, *later)

    @property
    def columns_read(self) -> tuple[str, ...]:
        """Columns of the training instances' CSV that its curricula read, beside id and features."""
        return tuple(dict.fromkeys(column for one in self.curricula for column in one.columns_read))

    @property
    def columns_key(self) -> str:
        """The key that names these columns."""
        return "curriculum.column" if any(hasattr(one, "column") for one in self.curricula) else "curriculum.columns"

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions whose arithmetic the decisions of its curricula depend on, beside NumPy."""
        return tuple(dict.fromkeys(library for one in self.curricula for library in one.libraries))

    @property
    def n_policies(self) -> int:
        """Policies that the run trains."""
        return self.curriculum.policies_trained

    @property
    def given_paths(self) -> dict[str, Path]:
        """What is taken from other runs: the folder, or the copy of what counts of it, by the key that names it."""
        paths = {"init_from": self.init_from, "curriculum.of": getattr(self.curriculum, "of", None)}
        return {key: path for key, path in paths.items() if path is not None}

    def with_given(self, paths: Mapping[str, Path]) -> RunConfig:
        """The same with other paths to what is taken from other runs."""
        changed: dict[str, Any] = {key: path for key, path in paths.items() if key == "init_from"}
        if "curriculum.of" in paths:
            changed["curriculum"] = self.curriculum.model_copy(update={"of": paths["curriculum.of"]})
        return self.model_copy(update=changed)

    @property
    def import_paths(self) -> tuple[str, ...]:
        """What names code of somebody's own, which results depend on: environment, policy, learner and curriculum."""
        of_env = (self.env.id,) if ":" in self.env.id else ()
        of_curricula = dict.fromkeys(path for one in self.curricula for path in one.import_paths)
        return (*of_env, *self.learner.import_paths, *of_curricula)

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
