"""From a config to what a run is made of: its setup, learner, ensemble and policies, or a sentence why that cannot be."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from space_dist.cluster import make_curriculum
from space_dist.config import PPOConfig, RunConfig, TRPOConfig
from space_dist.curricula import Curriculum
from space_dist.envs import BatchedEnv, make_batched
from space_dist.envs.observations import alike
from space_dist.errors import ConfigError
from space_dist.instances import InstanceSet
from space_dist.learner import (
    Arrays,
    CoupledLearner,
    Ensemble,
    Learner,
    PopulationLearner,
    make_ensemble,
    make_learner,
    member_bytes,
    refuse_population,
    refuse_spaces,
    stack_key,
)
from space_dist.ledger import Checkpoint
from space_dist.policy import MlpPolicy, Policy, Several, to_arrays
from space_dist.rollout import Setup
from space_dist.seeding import member_seeds

ON_POLICY = ("ppo", "trpo", "a2c")
_COMPARED_STARTS = 4096  # instances that are enough to see whether starts differ


def make_setup(config: RunConfig, train: InstanceSet, test: InstanceSet) -> Setup:
    """What workers must know. Raises ConfigError if the config cannot work with its environment or instances."""
    horizon = make_env(config).horizon
    setup = Setup(
        env_id=config.env.id,
        context_visible=config.env.context_visible,
        seed=config.seed,
        gamma=config.learner.gamma,
        shards=config.rollout.shards * config.members,
        slots=config.rollout.slots,
        slot_length=config.slot_length(horizon),
        start_states=config.rollout.start_states,
        evaluation_episodes=config.evaluation.episodes,
        train=train,
        test=test,
        env_kwargs=config.env.kwargs,
        episodes_per_round=config.n_episodes,
        keep_next_observations=config.learner.kind in ("dqn", "sac", "td3"),
        members=config.members,
    )
    probes = config.learner.normalize_observations or config.learner.normalize_rewards
    needed = config.round_steps(horizon) * (2 if probes else 1)
    if config.budget.steps < needed:
        raise ConfigError(
            f"budget.steps = {config.budget.steps} is less than the {needed} steps that one update may take"
            + (", and the round before it that gives normalisation its first scales" if probes else "")
        )
    env = make_env(config)
    refuse_spaces(config.learner, env.observation_space, env.action_space)
    if config.engine == "population":
        refuse_population(config.learner, env.observation_space, env.action_space)
    if config.curriculum.ranks_by_start_value and _starts_alike(config, train):
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
    _refuse_wants(config, make_curriculum(config, train))
    ensemble_of(config)
    return setup


def _refuse_wants(config: RunConfig, curriculum: Curriculum) -> None:
    """Raise ConfigError if learner or environment cannot give a curriculum the feedback it asks for."""
    kind, learner = config.curriculum.kind, config.learner.kind
    if curriculum.wants.advantages and learner not in ON_POLICY:
        raise ConfigError(
            f"curriculum.kind: {kind} scores episodes by their advantages, which learner.kind: {learner} does not "
            f"compute. Allowed learners: {', '.join(ON_POLICY)}"
        )
    if config.curriculum.probes and not _knows_success(config, curriculum.start()[1].contexts[:1]):
        raise ConfigError(
            f"curriculum.kind: {kind} needs to know whether an episode succeeded, and env.id {config.env.id!r} does "
            "not say (its steps have no `success`)"
        )


def _knows_success(config: RunConfig, contexts: NDArray[np.float64]) -> bool:
    """Whether a first step in a (1, d) context reports success, true or not."""
    with _failures_explained(config, "reset or a first step"):
        env = make_env(config)
        env.action_space.seed(0)
        env.reset(np.zeros(1, dtype=np.int64), contexts, np.zeros(1, dtype=np.uint64))
        return env.step(np.asarray(env.action_space.sample())[None]).success is not None


def _starts_alike(config: RunConfig, train: InstanceSet) -> bool:
    """Whether the context leaves no trace in the first observation: with one seed, all instances start the same."""
    slots = min(len(train), _COMPARED_STARTS)
    with _failures_explained(config, "reset"):
        env = make_env(config, slots)
        starts = env.reset(np.arange(slots), train.contexts[:slots], np.zeros(slots, dtype=np.uint64))
    return slots > 1 and alike(starts)


@contextlib.contextmanager
def _failures_explained(config: RunConfig, what: str) -> Iterator[None]:
    """Somebody else's environment may raise anything."""
    try:
        yield
    except ConfigError:
        raise
    except (Exception, SystemExit) as error:
        raise ConfigError(f"env.id {config.env.id!r}: {what} failed: {type(error).__name__}: {error}") from error


def make_env(config: RunConfig, n_slots: int = 1) -> BatchedEnv:
    """A config's environment, as its policy sees it."""
    env = config.env
    return make_batched(env.id, n_slots, context_visible=env.context_visible, kwargs=env.kwargs)


def total_steps(config: RunConfig, horizon: int) -> int:
    """Environment steps of a whole run: those of the rounds that fit.

    The budget, where rounds end by episodes or probes come between them.
    """
    if config.n_episodes is not None or config.curriculum.probes:
        return config.budget.steps
    return config.budget.steps // config.round_steps(horizon) * config.round_steps(horizon)


def resolved(config: RunConfig, *, can_share: bool = True) -> RunConfig:
    """The config with `engine: auto` decided: population where the learner allows it and runs `can_share` a process."""
    if config.engine != "auto":
        return config
    stock = getattr(config.learner, "update", "stock") == "stock"
    env, engine = make_env(config), "population" if can_share and stock and not config.rollout.overlap else "single"
    try:
        refuse_population(config.learner, env.observation_space, env.action_space)
    except ConfigError:
        engine = "single"
    return config.model_copy(update={"engine": engine})


def stack_of(config: RunConfig) -> str:
    """`(16 hex digits)` equal for runs that may be members of one population; empty for those of no population."""
    if config.engine != "population":
        return ""
    env = make_env(config)
    key = (
        config.env.model_dump_json(),
        config.device,
        stack_key(config.learner, env.observation_space, env.action_space),
    )
    return hashlib.sha256(repr(key).encode()).hexdigest()[:16]


def memory_of(config: RunConfig) -> int:
    """About what a run takes of the memory of the process that it shares, in MB; 0 for a run that works alone."""
    if config.engine != "population" or not isinstance(config.learner, PPOConfig | TRPOConfig):
        return 0
    env = make_env(config)
    each = member_bytes(config.learner, env.observation_space, env.action_space, config.device)
    return -(-config.members * each >> 20)


def learner_of(config: RunConfig) -> Learner | CoupledLearner:
    """A config's learner with its initial networks."""
    if config.members == 1:
        return _learner_of(config, config.seed)
    members = [_learner_of(config, int(seed)) for seed in member_seeds(config.seed, config.members)]
    return CoupledLearner([member for member in members if isinstance(member, PopulationLearner)])


def _learner_of(config: RunConfig, seed: int) -> Learner:
    env = make_env(config)
    return make_learner(
        config.learner, env.observation_space, env.action_space,
        seed=seed, n_slots=config.rollout.shards * config.rollout.slots,
        slot_length=config.slot_length(env.horizon), total_steps=total_steps(config, env.horizon),
        population=config.engine == "population", device=config.device,
    )  # fmt: skip


def ensemble_of(config: RunConfig) -> Ensemble | None:
    """The ensemble of value functions that a config's curriculum asks for, if it does, with its initial networks."""
    env = make_env(config)
    return make_ensemble(config, env.observation_space, env.context_bounds.names)


def policy_in(checkpoint: Checkpoint, config: RunConfig) -> Policy | Several:
    """The policy, or policies, that a checkpoint holds."""
    learner = learner_of(config)
    load_learner(learner, checkpoint)
    return learner.policy(checkpoint.round)


def model_of(learner: Learner | CoupledLearner, version: int) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """A trained policy as arrays and a description: layer by layer, or as torch's state where NumPy cannot act."""
    policy = learner.policy(version)
    if isinstance(policy, MlpPolicy):
        return to_arrays(policy)
    arrays = learner.scored()
    first = learner.members[0] if isinstance(learner, CoupledLearner) else learner
    return arrays, {
        "format": 2, "version": version, "policy": "torch", "class": str(type(first.model.policy)),
        "shapes": {name: list(array.shape) for name, array in arrays.items()},
    }  # fmt: skip


def load_learner(learner: Learner | CoupledLearner, checkpoint: Checkpoint) -> None:
    """Bring a learner to where it was when a checkpoint was written."""
    learner.load(under("learner/", checkpoint.arrays), checkpoint.data["learner"])


def under(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    """The arrays whose names begin with `prefix`, without it."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
