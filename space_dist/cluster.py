"""Where a run's work is done: the protocol, the curriculum's seat, and the twin of the Ray cluster in this process.

Imports neither Ray nor torch: rollout and curriculum actors are made of this module and `rollout`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from space_dist.config import ContextSpaceConfig, FixedConfig, GrowingConfig, RandomGrowthConfig, RunConfig, SpaceConfig
from space_dist.curricula import Curriculum, Feedback, RoundRobin, Selection, Space, State, variants
from space_dist.envs import make_batched
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.instances import InstanceSet
from space_dist.rollout import FloatArray, Setup, Split, Walk, Worker

Handle = Any  # of a value that may still be computed elsewhere; only a Cluster looks inside


@dataclass(frozen=True)
class Decision:
    """Handles of what a curriculum decided: its state, the selection, numbers for the log, and the values it saw."""

    state: Handle
    selection: Handle
    numbers: Handle
    values: Handle


class Cluster(Protocol):
    """Where work is done. All calls but `get` return at once; handles may be passed on without being waited for."""

    def put(self, value: object) -> Handle:
        """Make a value available to every worker."""

    def collect(
        self, policy: Handle, selection: Handle, walk: Walk, *, round: int, steps: int, version: int
    ) -> list[Handle]:
        """One `Shard` per shard, of a round that begins after `steps` environment steps."""

    def start_values(self, policy: Handle) -> list[Handle]:
        """One array per chunk of the training instances."""

    def evaluate(self, policy: Handle, split: Split, *, stochastic: bool = False) -> list[Handle]:
        """One `Outcomes` per part."""

    def begin(self, values: Sequence[Handle]) -> Decision:
        """The curriculum's first decision."""

    def decide(
        self, state: Handle, before: Handle, after: Sequence[Handle],
        *, version: int, gradient_steps: int, rescored: Sequence[Handle] = (),
    ) -> Decision:  # fmt: skip
        """The curriculum's next decision, on selection `version`.

        rescored: the values before, chunk by chunk, where scales have changed since and `before` is no longer true.
        """

    def get(self, handles: Sequence[Handle]) -> list[Any]:
        """Wait for values."""


class Central:
    """The curriculum's seat: joins the values of all chunks and asks the curriculum. Pure; keeps no state."""

    def __init__(self, config: RunConfig, train: InstanceSet) -> None:
        self._curriculum = make_curriculum(config, train)
        self._from_zero = isinstance(config.curriculum, GrowingConfig) and config.curriculum.v0 == "zero"

    def begin(self, *chunks: FloatArray) -> tuple[State, Selection, dict[str, Any], FloatArray]:
        """The first decision and V_0."""
        state, selection = self._curriculum.start()
        values = checked(np.concatenate(chunks), "start values")
        return state, selection, {}, np.zeros_like(values) if self._from_zero else values

    def decide(
        self, state: State, before: FloatArray, version: int, gradient_steps: int, n_after: int, *chunks: FloatArray
    ) -> tuple[State, Selection, dict[str, Any], FloatArray]:
        """The next decision and V_t: the first `n_after` chunks; further ones replace `before`.

        Raises RuntimeError if `state` is not the one that made selection `version`.
        """
        if state.version != version:
            raise RuntimeError(f"asked to go on from selection {version} with the state of {state.version}")
        after = checked(np.concatenate(chunks[:n_after]), "start values")
        if len(chunks) > n_after and not (self._from_zero and version == 0):
            before = checked(np.concatenate(chunks[n_after:]), "start values")
        new, selection, numbers = self._curriculum.step(state, Feedback(version, before, after, gradient_steps))
        return new, selection, numbers, after


class InProcess:
    """The cluster's twin without Ray: everything at once, here. Same bits."""

    def __init__(self, config: RunConfig, setup: Setup) -> None:
        self._setup, self._worker, self._central = setup, Worker(setup), Central(config, setup.train)

    def put(self, value: object) -> Handle:
        """The value itself."""
        return value

    def collect(
        self, policy: Handle, selection: Handle, walk: Walk, *, round: int, steps: int, version: int
    ) -> list[Handle]:
        """See `Cluster`."""
        asked = {"round": round, "steps": steps, "selection_version": version}
        return [
            self._worker.collect(policy, selection, walk, shard=shard, **asked) for shard in range(self._setup.shards)
        ]

    def start_values(self, policy: Handle) -> list[Handle]:
        """See `Cluster`."""
        return [self._worker.start_values(policy, chunk) for chunk in range(self._setup.chunks)]

    def evaluate(self, policy: Handle, split: Split, *, stochastic: bool = False) -> list[Handle]:
        """See `Cluster`."""
        parts = range(self._setup.evaluation_parts)
        return [self._worker.evaluate(policy, split, part, stochastic=stochastic) for part in parts]

    def begin(self, values: Sequence[Handle]) -> Decision:
        """See `Cluster`."""
        return Decision(*self._central.begin(*values))

    def decide(
        self, state: Handle, before: Handle, after: Sequence[Handle],
        *, version: int, gradient_steps: int, rescored: Sequence[Handle] = (),
    ) -> Decision:  # fmt: skip
        """See `Cluster`."""
        return Decision(
            *self._central.decide(state, before, version, gradient_steps, len(after), *after, *rescored)
        )  # fmt: skip

    def get(self, handles: Sequence[Handle]) -> list[Any]:
        """The values themselves."""
        return list(handles)


def make_curriculum(config: RunConfig, train: InstanceSet) -> Curriculum:
    """The curriculum a config asks for. Raises ConfigError if it asks for instances that are not there."""
    settings = config.curriculum
    if settings.kind == "round_robin":
        return RoundRobin(train, seed=config.seed)
    if settings.kind == "fixed":
        _refuse_missing(settings, train, str(config.instances.train))
        return RoundRobin(train, seed=config.seed, ids=settings.ids, count=settings.count)
    return Space(
        train, seed=config.seed, eta=settings.eta, kappa=settings.kappa, rank=_rank(config, settings, train),
        mean=settings.mean, growth=settings.growth, adaptive_eta=settings.adaptive_eta, patience=settings.patience,
        epsilon=settings.epsilon,
    )  # fmt: skip


def _rank(
    config: RunConfig, settings: SpaceConfig | RandomGrowthConfig | ContextSpaceConfig, train: InstanceSet
) -> variants.Rank:
    if settings.kind == "cspace":
        env = config.env
        bounds = make_batched(env.id, 1, context_visible=False, kwargs=env.kwargs).context_bounds
        by_distance = {"centroid": variants.near_centroid, "nearest_member": variants.near_member}
        return by_distance[settings.distance](bounds.scale(train.contexts))
    if settings.kind == "random_growth" or settings.pic == "random":
        return variants.at_random(train, seed=config.seed)
    return variants.BY_VALUE[settings.pic]


def _refuse_missing(settings: FixedConfig, train: InstanceSet, source: str) -> None:
    ids = train.ids.tolist()
    holds = f"{source} holds {len(ids)} instances, with ids from {ids[0]} to {ids[-1]}"
    if settings.count is not None and settings.count > len(ids):
        raise ConfigError(f"curriculum.count: {settings.count} is too many: {holds}")
    missing = sorted(set(settings.ids or ()).difference(ids))
    if missing:
        more = f" (nor {len(missing) - 1} more of these)" if len(missing) > 1 else ""
        closest = min(ids, key=lambda one: abs(one - missing[0]))
        raise ConfigError(f"curriculum.ids: there is no instance {missing[0]}{more}; the nearest is {closest}. {holds}")


def checked(values: FloatArray, what: str) -> FloatArray:
    """The values, if they are numbers. Raises SpaceDistError otherwise."""
    if not np.isfinite(values).all():
        raise SpaceDistError(
            f"training diverged: {int((~np.isfinite(values)).sum())} {what} are not finite numbers. A smaller "
            "learner.learning_rate usually helps, unless the environment itself gives such rewards or observations"
        )
    return values
