"""From a config to what a run is made of (setup, learner, ensemble, policies), or a sentence why it cannot be."""

from __future__ import annotations

import hashlib
from typing import Any

from numpy.typing import NDArray

from space_dist.config import RunConfig, learners_that
from space_dist.curricula import Curriculum
from space_dist.curricula.making import make_curriculum
from space_dist.envs.spec import EnvironmentSpec, read_spec
from space_dist.errors import ConfigError
from space_dist.instances import InstanceSet
from space_dist.learner import (
    CoupledLearner,
    Ensemble,
    Learner,
    make_ensemble,
    make_learner,
    member_bytes,
    refuse_population,
    refuse_spaces,
    stack_key,
)
from space_dist.ledger import Checkpoint
from space_dist.rollout import Setup
from space_dist.rollout.policy import MlpPolicy, Policy, Several, to_arrays
from space_dist.seeding import member_seeds

_COMPARED_STARTS = 4096  # instances that are enough to see whether starts differ


def spec_of(config: RunConfig) -> EnvironmentSpec:
    """What a config's environment is like: made once, read, and closed. Raises ConfigError if it cannot be made."""
    return read_spec(config.env.id, context_visible=config.env.context_visible, kwargs=config.env.kwargs)


def make_setup(config: RunConfig, spec: EnvironmentSpec, train: InstanceSet, test: InstanceSet) -> Setup:
    """What workers must know. Raises ConfigError if the config cannot work with its environment or instances."""
    setup = Setup(
        spec=spec,
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
        policies=config.n_policies,
    )
    scales = config.learner.normalize_observations or config.learner.normalize_rewards
    needed = config.round_steps(spec.horizon) * (2 if scales else 1)
    if config.budget.steps < needed:
        raise ConfigError(
            f"budget.steps = {config.budget.steps} is less than the {needed} steps that one update may take"
            + (", and the round before it that gives normalisation its first scales" if scales else "")
        )
    refuse_spaces(config.learner, spec.observation_space, spec.action_space)
    if config.engine == "population":
        refuse_population(config.learner, spec.observation_space, spec.action_space)
    if config.curriculum.ranks_by_start_value and spec.starts_alike(train.contexts[:_COMPARED_STARTS]):
        raise ConfigError(
            f"curriculum.kind: {config.curriculum.kind} ranks instances by the value of their start, but all instances "
            "start with the same observation, so all values tie and the order would be a random one. Set "
            "env.context_visible: true"
            + (
                ", or curriculum.allow_context_blind: true to run the released code's setting"
                if "allow_context_blind" in type(config.curriculum).model_fields
                else ""
            )
        )
    # Asks the curriculum for what is not there? Better refused now than on an actor.
    _refuse_wants(config, spec, make_curriculum(config, train, spec.context_bounds))
    ensemble_of(config, spec)
    return setup


def _refuse_wants(config: RunConfig, spec: EnvironmentSpec, curriculum: Curriculum) -> None:
    """Raise ConfigError if learner or environment cannot give a curriculum the feedback it asks for."""
    kind = config.curriculum.kind
    if curriculum.wants.advantages and not config.learner.has_advantages:
        raise ConfigError(
            f"curriculum.kind: {kind} scores episodes by their advantages, which learner.kind: {config.learner.kind} "
            f"does not compute. Allowed learners: {', '.join(learners_that('has_advantages'))}"
        )
    if curriculum.wants.probes and not spec.knows_success(curriculum.start()[1].contexts[:1]):
        raise ConfigError(
            f"curriculum.kind: {kind} needs to know whether an episode succeeded, and env.id {config.env.id!r} does "
            "not say (its steps have no `success`)"
        )


def total_steps(config: RunConfig, horizon: int) -> int:
    """Environment steps of a whole run: those of the rounds that fit.

    The budget, where rounds end by episodes or probes come between them.
    """
    if config.n_episodes is not None or config.curriculum.may_probe:
        return config.budget.steps
    return config.budget.steps // config.round_steps(horizon) * config.round_steps(horizon)


def resolved(config: RunConfig, spec: EnvironmentSpec, *, can_share: bool = True) -> RunConfig:
    """The config with `engine: auto` decided: population where the learner allows it and runs `can_share` a process."""
    if config.engine != "auto":
        return config
    stock = not config.learner.is_compiled("single")
    engine = "population" if can_share and stock and not config.rollout.overlap else "single"
    try:
        refuse_population(config.learner, spec.observation_space, spec.action_space)
    except ConfigError:
        engine = "single"
    return config.model_copy(update={"engine": engine})


def stack_of(config: RunConfig, spec: EnvironmentSpec) -> str:
    """`(16 hex digits)` equal for runs that may be members of one population; empty for those of no population."""
    if config.engine != "population":
        return ""
    key = (
        config.env.model_dump_json(),
        config.device,
        stack_key(config.learner, spec.observation_space, spec.action_space),
    )
    return hashlib.sha256(repr(key).encode()).hexdigest()[:16]


def memory_of(config: RunConfig, spec: EnvironmentSpec) -> int:
    """About what a run takes of the memory of the process that it shares, in MB; 0 for a run that works alone."""
    if config.engine != "population" or not config.learner.can_be_stacked:
        return 0
    each = member_bytes(config.learner, spec.observation_space, spec.action_space, config.device)
    return -(-config.n_policies * each >> 20)


def learner_of(config: RunConfig, spec: EnvironmentSpec) -> Learner:
    """A config's learner with its initial networks."""
    if config.n_policies == 1:
        return _learner_of(config, spec, config.seed)
    coupled = [_learner_of(config, spec, int(seed)) for seed in member_seeds(config.seed, config.n_policies)]
    return CoupledLearner([one for each in coupled for one in each.learners])


def _learner_of(config: RunConfig, spec: EnvironmentSpec, seed: int) -> Learner:
    return make_learner(
        config.learner, spec.observation_space, spec.action_space,
        seed=seed, n_slots=config.rollout.shards * config.rollout.slots,
        slot_length=config.slot_length(spec.horizon), total_steps=total_steps(config, spec.horizon),
        population=config.engine == "population", device=config.device,
    )  # fmt: skip


def ensemble_of(config: RunConfig, spec: EnvironmentSpec) -> Ensemble | None:
    """The ensemble of value functions that a config's curriculum asks for, if it does, with its initial networks."""
    return make_ensemble(config, spec.observation_space, spec.context_bounds.names)


def policy_in(checkpoint: Checkpoint, config: RunConfig, spec: EnvironmentSpec) -> Policy | Several:
    """The policy, or policies, that a checkpoint holds."""
    learner = learner_of(config, spec)
    load_learner(learner, checkpoint)
    return learner.policy(checkpoint.round)


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
