"""A run's curriculum, of its config."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from space_dist.config import RunConfig
from space_dist.curricula.draws import Draws
from space_dist.curricula.generating import ContextGenerator
from space_dist.curricula.interface import Curriculum
from space_dist.instances import ContextBounds, InstanceSet


def make_curriculum(
    config: RunConfig, train: InstanceSet, bounds: ContextBounds, given: Mapping[str, bytes] = MappingProxyType({}),
    *, generator: Callable[[], ContextGenerator] | None = None, held_out: InstanceSet | None = None,
) -> Curriculum:  # fmt: skip
    """The curriculum a config asks for. Raises ConfigError if it asks for instances or features that are not there.

    bounds: of the contexts of the config's environment. given: by other runs, see `RunConfig.given_paths`.
    generator: makes what makes contexts of the environment; asked where the curriculum generates and edits. held_out:
        instances that must not be trained on.
    """
    from space_dist.curricula.configured import Makers  # every curriculum, which rollout actors never need

    rollout = config.rollout
    return Makers(
        train, source=str(config.instances.train), seed=config.seed, bounds=bounds, recorded=given.get("curriculum.of"),
        generator=generator, held_out=held_out,
        draws=Draws(
            config.n_episodes or config.learner.n_steps * config.n_policies, rollout.shards * config.n_policies
        ),
    ).make(config.curriculum)  # fmt: skip
