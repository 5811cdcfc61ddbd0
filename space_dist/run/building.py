"""From a config to what a run is made of (setup, learner, ensemble, policies), or a sentence why it cannot be."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from space_dist import arithmetic
from space_dist.config import RunConfig, learners_that
from space_dist.curricula import Curriculum
from space_dist.curricula.making import make_curriculum
from space_dist.curricula.replay import Replay
from space_dist.envs.spec import EnvironmentSpec, read_spec
from space_dist.errors import ConfigError, about, nearest
from space_dist.instances import InstanceSet, read_csv, refuse_overlap, refuse_padding
from space_dist.learner import (
    CoupledLearner,
    Ensemble,
    Learner,
    make_ensemble,
    make_learner,
    member_bytes,
    refuse_machine,
    refuse_population,
    refuse_spaces,
    stack_key,
)
from space_dist.ledger import Checkpoint
from space_dist.rollout import Setup
from space_dist.rollout.policy import MlpPolicy, Policy, Several, to_arrays
from space_dist.run.given import given_to
from space_dist.run.starting import start_from
from space_dist.seeding import member_seeds
from space_dist.system.workplace import cores

# A Ray of our own starts any number of actors, each a process; far beyond its cores a machine only stands still.
_FEW_ACTORS, _ACTORS_A_CORE = 16, 4
_COMPARED_STARTS = 4096  # instances that are enough to see whether starts differ


def spec_of(config: RunConfig) -> EnvironmentSpec:
    """What a config's environment is like: made once, read, and closed. Raises ConfigError if it cannot be made."""
    return read_spec(config.env.id, context_visible=config.env.context_visible, kwargs=config.env.kwargs)


@dataclass(frozen=True)
class Blueprint:
    """A config, and what its environment is like: what everything that a run is made of is made from."""

    config: RunConfig
    spec: EnvironmentSpec

    @classmethod
    def of(cls, config: RunConfig, spec: EnvironmentSpec | None = None, *, can_share: bool = True) -> Blueprint:
        """The config with `engine: auto` decided: population where the learner allows it.

        spec: of the config's environment, where that is known already. can_share: whether runs share a process.
        Raises ConfigError if the environment cannot be made.
        """
        drawn = cls(config, spec or spec_of(config))
        return dataclasses.replace(drawn, config=drawn._with_engine(can_share)) if config.engine == "auto" else drawn

    def _with_engine(self, can_share: bool) -> RunConfig:
        config, spec = self.config, self.spec
        # A config that asks for `lean` keeps the update it names; with a population `overlap` gains nothing.
        stock = not config.learner.is_compiled("single")
        engine = "population" if can_share and stock and not config.rollout.overlap else "single"
        try:
            refuse_population(config.learner, spec.observation_space, spec.action_space)
        except ConfigError:
            engine = "single"
        return config.model_copy(update={"engine": engine})

    @functools.cached_property
    def given(self) -> Mapping[str, bytes]:
        """What other runs give it, by the key that names it: read once. Raises ConfigError where it cannot be used."""
        return given_to(self.config)

    def under(self, config: RunConfig) -> Blueprint:
        """The same run under settings that are in force for a while: what other runs gave it is not read again."""
        found = dataclasses.replace(self, config=config)
        vars(found)["given"] = self.given
        return found

    def instances(self) -> tuple[InstanceSet, InstanceSet]:
        """The training and test instances, from their files.

        Raises ConfigError for a bad file, a context outside the environment's bounds, or one that both share; and for
        a test set with padding, in which no policy would succeed.
        """
        files, bounds, columns = self.config.instances, self.spec.context_bounds, self.config.columns_read
        with about("instances.train"):
            train = read_csv(files.train, bounds, columns, named_by=self.config.columns_key)
        with about("instances.test"):
            test = read_csv(files.test, bounds, columns, if_there=True)
        refuse_overlap(train, test, str(files.train), str(files.test))
        refuse_padding(test, f"instances.test: {files.test}")
        return train, test

    def setup(self, train: InstanceSet, test: InstanceSet) -> Setup:
        """What workers must know. Raises ConfigError if the config cannot work with its environment or instances."""
        config, spec = self.config, self.spec
        setup = Setup(
            spec=dataclasses.replace(spec, compiled=config.learner.is_compiled(config.engine)),
            seed=config.seed,
            gamma=config.learner.gamma,
            shards=config.rollout.shards * config.n_policies,
            slots=config.rollout.slots,
            slot_length=config.slot_length(spec.horizon),
            start_states=config.rollout.start_states,
            evaluation_episodes=config.evaluation.episodes,
            train=train,
            test=test,
            episodes_per_round=config.n_episodes,
            keep_next_observations=config.learner.keeps_next_observations,
            memory_size=config.learner.memory_size,
            policies=config.n_policies,
            given=self.given,
        )
        # Before the run's folder is touched: what cannot be leaves nothing behind.
        self._refuse_short_budget()
        refuse_spaces(config.learner, spec.observation_space, spec.action_space)
        if config.engine == "population":
            refuse_population(config.learner, spec.observation_space, spec.action_space)
        self._refuse_equal_starts(train)
        # Asks the curriculum for what is not there? Better refused now than on an actor.
        curriculum = self.curriculum(train, test)
        self._refuse_wants(curriculum)
        self._refuse_recording(curriculum)
        self.ensemble()
        if config.init_from is not None:
            start_from(self.learner(), self.given["init_from"])
        elif config.learner.import_path is not None:
            self.learner()  # what its class takes of learner.kwargs is known once it has taken it
        return setup

    def curriculum(self, train: InstanceSet, test: InstanceSet) -> Curriculum:
        """The curriculum over `train`, which trains on nothing of `test`.

        Raises ConfigError if it asks for instances or features that are not there.
        """
        return make_curriculum(
            self.config, train, self.spec.context_bounds, self.given, generator=self.spec.generator, held_out=test
        )

    def learner(self) -> Learner:
        """The learner, or all of several policies, with initial networks."""
        config = self.config
        if config.n_policies == 1:
            return self._one_learner(config.seed)
        coupled = [self._one_learner(int(seed)) for seed in member_seeds(config.seed, config.n_policies)]
        return CoupledLearner([one for each in coupled for one in each.learners])

    def _one_learner(self, seed: int) -> Learner:
        config, spec = self.config, self.spec
        return make_learner(
            config.learner, spec.observation_space, spec.action_space,
            seed=seed, n_slots=config.rollout.shards * config.rollout.slots,
            slot_length=config.slot_length(spec.horizon), total_steps=self.total_steps,
            population=config.engine == "population", device=config.device,
        )  # fmt: skip

    def ensemble(self) -> Ensemble | None:
        """The value functions that the curriculum asks for, if it does, with initial networks."""
        return make_ensemble(self.config, self.spec.observation_space, self.spec.context_bounds.names)

    @property
    def total_steps(self) -> int:
        """Environment steps of a whole run: those of the rounds that fit.

        The budget, where rounds end by episodes or probes may come between them. Learning rates fall by it.
        """
        return self._whole_rounds(probes=self.config.curriculum.may_probe)

    def reachable_steps(self, curriculum: Curriculum) -> int:
        """The same of a run under this curriculum, one of whose kind might probe, and this may not."""
        return self._whole_rounds(probes=curriculum.wants.probes)

    def _whole_rounds(self, *, probes: bool) -> int:
        config, round_steps = self.config, self.config.round_steps(self.spec.horizon)
        if config.n_episodes is not None or probes:
            return config.budget.steps
        return config.budget.steps // round_steps * round_steps

    @property
    def round_in_words(self) -> str:
        """Environment steps of a round: `2,048`, or `up to 1,600` where it ends by episodes."""
        most = self.config.round_steps(self.spec.horizon)
        return f"{most:,}" if self.config.n_episodes is None else f"up to {most:,}"

    @property
    def stack(self) -> str:
        """`(16 hex digits)` equal for runs that may be members of one population; empty for those of no population."""
        config = self.config
        if config.engine != "population":
            return ""
        key = (
            config.env.model_dump_json(),
            config.device,
            stack_key(config.learner, self.spec.observation_space, self.spec.action_space),
        )
        return hashlib.sha256(repr(key).encode()).hexdigest()[:16]

    @property
    def memory(self) -> int:
        """About what a run takes of the memory of the process that it shares, in MB; 0 for one that works alone."""
        config, spec = self.config, self.spec
        if config.engine != "population" or not config.learner.can_be_stacked:
            return 0
        each = member_bytes(config.learner, spec.observation_space, spec.action_space, config.device)
        worlds = config.rollout.shards * config.n_policies * spec.world_mb(config.rollout.slots)
        # Rounded up: 0 would mean that the run works alone.
        return -(-config.n_policies * each >> 20) + worlds

    def policy_in(self, checkpoint: Checkpoint) -> Policy | Several:
        """The policy, or policies, that a checkpoint holds."""
        learner = self.learner()
        load_learner(learner, checkpoint)
        return learner.policy(checkpoint.round)

    # ---- what cannot be ----

    def refuse_machine(self) -> None:
        """Raise ConfigError where this machine, or this process, cannot compute the run as its config says."""
        refuse_machine(self.config)
        _refuse_other_arithmetic(self.config)
        _refuse_crowds(self.config)

    def _refuse_short_budget(self) -> None:
        config = self.config
        scales = config.learner.normalize_observations or config.learner.normalize_rewards
        needed = config.round_steps(self.spec.horizon) * (2 if scales else 1)
        if config.budget.steps < needed:
            raise ConfigError(
                f"budget.steps = {config.budget.steps} is less than the {needed} steps that one update may take"
                + (", and the round before it that gives normalisation its first scales" if scales else "")
            )

    def _refuse_equal_starts(self, train: InstanceSet) -> None:
        settings = self.config.curriculum
        # Decision 10 of docs/algorithm.md.
        if settings.ranks_by_start_value and self.spec.starts_alike(train.contexts[:_COMPARED_STARTS]):
            raise ConfigError(
                f"curriculum.kind: {settings.kind} ranks instances by the value of their start, but all instances "
                "start with the same observation, so all values tie and the order would be a random one. Set "
                "env.context_visible: true"
                + (
                    ", or curriculum.allow_context_blind: true to run the released code's setting"
                    if "allow_context_blind" in type(settings).model_fields
                    else ""
                )
            )

    def _refuse_wants(self, curriculum: Curriculum) -> None:
        """Raise ConfigError if learner or environment cannot give a curriculum the feedback it asks for."""
        config, kind = self.config, self.config.curriculum.kind
        if curriculum.wants.advantages and not config.learner.has_advantages:
            raise ConfigError(
                f"curriculum.kind: {kind} scores episodes by their advantages, which learner.kind: "
                f"{config.learner.kind} does not compute. Allowed learners: "
                f"{', '.join(learners_that('has_advantages'))}"
            )
        if curriculum.wants.unlearned and not config.learner.has_advantages:
            raise ConfigError(
                f"curriculum.kind: {kind}, as it is set, plays rounds that are not learned from, and learner.kind: "
                f"{config.learner.kind} learns from what it remembers. Allowed learners: "
                f"{', '.join(learners_that('has_advantages'))}"
            )
        asks_success = curriculum.wants.probes or curriculum.wants.success
        if asks_success and not self.spec.knows_success(curriculum.start()[1].contexts[:1]):
            others = (
                ". curriculum.outcome: return, with curriculum.largest_return, goes by returns instead"
                if "outcome" in type(config.curriculum).model_fields
                else ""
            )
            raise ConfigError(
                f"curriculum.kind: {kind} needs to know whether an episode succeeded, and env.id {config.env.id!r} "
                f"does not say (its steps have no `success`){others}"
            )

    def _refuse_recording(self, curriculum: Curriculum) -> None:
        """Raise ConfigError for a recorded curriculum that iterations of this run cannot follow to their end."""
        if not isinstance(curriculum, Replay):
            return
        config, recording = self.config, curriculum.recording
        rounds = config.round_steps(self.spec.horizon)
        if recording.round_steps != rounds:
            raise ConfigError(
                f"curriculum.of: a round of that run has {recording.round_steps} steps, and one of this run {rounds}: "
                "iteration by iteration they would train at other times. Use its learner.n_steps"
            )
        if recording.budget_steps < config.budget.steps:
            raise ConfigError(
                f"budget.steps = {config.budget.steps} is more than the {recording.budget_steps} steps of the run that "
                "curriculum.of names: there is nothing to follow behind its end"
            )


def _refuse_crowds(config: RunConfig) -> None:
    """Raise ConfigError for more actors than this machine can start; in a cluster Ray says what it has room for."""
    workers, address, shards = config.resources.workers, config.resources.address, config.rollout.shards
    most = max(_FEW_ACTORS, _ACTORS_A_CORE * cores())
    if address == "local" and isinstance(workers, int) and workers > most:
        raise ConfigError(
            f"resources.workers: {workers} rollout actors are more than this machine can start: with {cores()} CPUs, "
            f"at most {most}. A round has {shards} shards (rollout.shards), so more than {shards} actors gain nothing"
        )


def _refuse_other_arithmetic(config: RunConfig) -> None:
    """Raise ConfigError where this process, which chose before it knew the config, computes with another arithmetic."""
    here, known = arithmetic.chosen(), ("one", "native")
    if here not in known:
        raise ConfigError(f"{arithmetic.CHOICE}={here} of the environment is not known{nearest(here, known)} "
                          "Allowed: one, native")  # fmt: skip
    if config.arithmetic == "native" and here != "native":
        raise ConfigError(
            f"arithmetic: native is chosen before libraries are loaded: start with {arithmetic.CHOICE}=native in the "
            "environment (of a grid: of all its nodes), or use arithmetic: one"
        )
    if config.arithmetic != here:
        raise ConfigError(
            f"{arithmetic.CHOICE}=native of the environment, and arithmetic: one in the config: unset it, or use "
            "--set arithmetic=native"
        )


def model_of(learner: Learner, version: int) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """A trained policy as arrays and a description: layer by layer, or as torch's state where NumPy cannot act."""
    policy = learner.policy(version)
    if isinstance(policy, MlpPolicy):
        return to_arrays(policy)
    arrays = learner.scored()
    return arrays, {
        "format": 2, "version": version, "policy": "torch", "class": learner.policy_name,
        "shapes": {name: list(array.shape) for name, array in arrays.items()},
    }  # fmt: skip


def load_learner(learner: Learner, checkpoint: Checkpoint) -> None:
    """Bring a learner to where it was when a checkpoint was written."""
    learner.load(checkpoint.under("learner/"), checkpoint.data["learner"])
