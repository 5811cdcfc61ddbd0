"""A run's curriculum, of its config."""

from __future__ import annotations

from space_dist.config import RunConfig
from space_dist.curricula.draws import Draws
from space_dist.curricula.interface import Curriculum
from space_dist.instances import ContextBounds, InstanceSet


def make_curriculum(config: RunConfig, train: InstanceSet, bounds: ContextBounds) -> Curriculum:
    """The curriculum a config asks for. Raises ConfigError if it asks for instances or features that are not there.

    bounds: of the contexts of the config's environment.
    """
    from space_dist.curricula.configured import Makers  # every curriculum, which rollout actors never need

    rollout = config.rollout
    return Makers(
        train, source=str(config.instances.train), seed=config.seed, bounds=bounds,
        draws=Draws(
            config.n_episodes or config.learner.n_steps * config.n_policies, rollout.shards * config.n_policies
        ),
    ).make(config.curriculum)  # fmt: skip
