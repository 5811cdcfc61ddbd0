"""The Stable-Baselines3 adapter: networks, updates, and what a checkpoint must hold of them.

Nothing of SB3 is written twice: what shards collected is put into SB3's own buffers, and SB3's own `train()` learns
from it. What SB3 does outside `train()` while it collects is done here, per transition. The exceptions, all on request
and held against SB3's in tests, are `lean` and `lean_replay` (PPO's `train()`, and DQN's, TD3's and SAC's, as compiled
functions, from `kernels`) and `population` with `stacked` and `trust_region` (PPO's on GPUs and sb3-contrib's TRPO's,
for many runs at once).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import space_dist.learner.unneeded  # noqa: F401 - before anything imports torch

# isort: split
import torch
from gymnasium import spaces

from space_dist.config import (
    LearnerConfig,
    PPOConfig,
    RecurrentPPOConfig,
    RunConfig,
    TRPOConfig,
    ValueDisagreementConfig,
)
from space_dist.errors import ConfigError
from space_dist.kernels import COMPILES
from space_dist.learner.coupled import CoupledLearner
from space_dist.learner.elementary import torch_checks  # and replaces kernels of torch
from space_dist.learner.ensemble import Ensemble
from space_dist.learner.interface import Arrays, Learner, SB3Learner, Update, refuse_spaces
from space_dist.learner.networks import is_mlp
from space_dist.learner.off_policy import OFF_POLICY, OffPolicyLearner
from space_dist.learner.on_policy import OnPolicyLearner
from space_dist.learner.population import PopulationLearner, learn_together, member_bytes, stack_key
from space_dist.learner.population import refuse as refuse_population
from space_dist.learner.recurrent import RecurrentLearner


def make_learner(
    config: LearnerConfig,
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    *,
    seed: int,
    n_slots: int,
    slot_length: int,
    total_steps: int,
    population: bool = False,
    device: str = "cpu",
) -> SB3Learner:
    """A config's learner with its initial networks, seeded.

    n_slots, slot_length: of a round, over all shards; total_steps: of the run, for schedules. population: one whose
    updates can be made together with others', on `device`.
    Raises ConfigError if the learner cannot work with these spaces.
    """
    torch.set_num_threads(1)  # 1 and 2 threads give different gradients
    if population and isinstance(config, PPOConfig | TRPOConfig):
        return PopulationLearner(
            config, observation_space, action_space,
            seed=seed, n_slots=n_slots, slot_length=slot_length, total_steps=total_steps, device=device,
        )  # fmt: skip
    if config.keeps_next_observations:
        learner = OFF_POLICY[type(config)]
        return learner(config, observation_space, action_space, seed=seed, total_steps=total_steps)
    kind = RecurrentLearner if isinstance(config, RecurrentPPOConfig) else OnPolicyLearner
    return kind(
        config, observation_space, action_space,
        seed=seed, n_slots=n_slots, slot_length=slot_length, total_steps=total_steps,
    )  # fmt: skip


def refuse_machine(config: RunConfig) -> None:
    """Raise ConfigError where a config's updates cannot be computed here."""
    if config.device == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device: cuda: torch finds no GPU on this machine; use device: cpu")
    if not COMPILES and config.device == "cpu" and config.learner.is_compiled(config.engine):
        what = "engine: population" if config.engine == "population" else "learner.update: lean"
        raise ConfigError(
            "NUMBA_DISABLE_JIT is set (in the environment, or in .numba_config.yaml), which keeps Numba from "
            f"compiling, and the update of {what} is a compiled function: unset it, or use learner.update: stock with "
            "engine: single"
        )


def make_ensemble(config: RunConfig, observation_space: spaces.Space[Any], features: Sequence[str]) -> Ensemble | None:
    """The ensemble of value functions that a config's curriculum asks for, if it does.

    features: of the context, which observations end with where `env.context_visible`.
    Raises ConfigError if it cannot work with these observations.
    """
    if not isinstance(config.curriculum, ValueDisagreementConfig):
        return None
    if config.curriculum.members_see is not None and not config.env.context_visible:
        raise ConfigError("curriculum.members_see: observations hold no context with env.context_visible: false")
    torch.set_num_threads(1)
    return Ensemble(config.curriculum, config.learner, observation_space, features, seed=config.seed)


__all__ = [
    "Arrays",
    "CoupledLearner",
    "Ensemble",
    "Learner",
    "OffPolicyLearner",
    "OnPolicyLearner",
    "PopulationLearner",
    "SB3Learner",
    "Update",
    "is_mlp",
    "learn_together",
    "make_ensemble",
    "make_learner",
    "member_bytes",
    "refuse_machine",
    "refuse_population",
    "refuse_spaces",
    "stack_key",
    "torch_checks",
]
