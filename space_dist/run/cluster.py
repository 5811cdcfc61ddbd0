"""Where a run's work is done: the protocol, the curriculum's host, and the twin of the Ray cluster in this process.

Imports neither Ray nor torch: rollout and curriculum actors are made of this module and `rollout`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np

from space_dist.config import CurriculumConfig, RunConfig
from space_dist.curricula import Curriculum, Episodes, Feedback, Probes, Selection, State
from space_dist.curricula.generating import ContextGenerator
from space_dist.envs.spec import EnvironmentSpec
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.instances import ContextBounds, InstanceSet
from space_dist.rollout import FloatArray, IntArray, Outcomes, Setup, Split, Worker, joined
from space_dist.rollout.walk import Walk
from space_dist.system.workplace import cores

_WORTH_RAY = 100_000  # environment steps: at some thousand a second, several times what it takes to start Ray
_SILENT = "curriculum.kind: it needs to know whether an episode succeeded, and env.id does not say"
Handle = Any  # of a value that may still be computed elsewhere; only a Cluster looks inside


@dataclass(frozen=True)
class Decision:
    """Handles of what a curriculum decided: its state, the selection, numbers for the log, and the values it saw."""

    state: Handle
    selection: Handle
    numbers: Handle
    values: Handle


@dataclass(frozen=True)
class Evidence:
    """Handles of what an iteration showed, in pieces; `Central.decide` is given their values in the order of fields.

    after: start values of all instances, chunk by chunk.
    rescored: the values before, chunk by chunk, where scales have changed since and those kept are no longer true.
    ensemble: start values of all instances by each member of an ensemble, chunk by chunk.
    episodes: one `Episodes`, whose start values are filled in where the curriculum is hosted.
    context_values: start values of the episodes' contexts, where those are no instances.
    probes: one `Outcomes` per part.
    """

    after: Sequence[Handle]
    rescored: Sequence[Handle] = ()
    ensemble: Sequence[Handle] = ()
    episodes: Sequence[Handle] = ()
    context_values: Sequence[Handle] = ()
    probes: Sequence[Handle] = ()

    def flat(self) -> tuple[dict[str, int], list[Handle]]:
        """How many handles each field has, and all of them: Ray only sees handles that are arguments themselves."""
        fields = {field.name: list(getattr(self, field.name)) for field in dataclasses.fields(self)}
        return {name: len(handles) for name, handles in fields.items()}, [
            handle for handles in fields.values() for handle in handles
        ]


class Cluster(Protocol):
    """Where work is done. All calls but `get` return at once; handles may be passed on without being waited for."""

    def put(self, value: object) -> Handle:
        """Make a value available to every worker."""

    def collect(
        self, policy: Handle, selection: Handle, walk: Walk, *, round: int, steps: int, version: int, lag: int = 0
    ) -> list[Handle]:
        """One `Shard` per shard, of a round that begins after `steps` environment steps; see `Setup.rollout`."""

    def start_values(self, policy: Handle) -> list[Handle]:
        """One array per chunk of the training instances. `policy` may be an ensemble."""

    def context_values(self, policy: Handle, contexts: FloatArray, *, version: int) -> list[Handle]:
        """One array: the start values of (m, d) contexts of selection `version`."""

    def probe(self, policy: Handle, indices: IntArray, *, version: int) -> list[Handle]:
        """One `Outcomes` per part, of probe episodes on the training instances at (k,) `indices`."""

    def evaluate(self, policy: Handle, split: Split, *, stochastic: bool = False) -> list[Handle]:
        """One `Outcomes` per part."""

    def begin(self, values: Sequence[Handle]) -> Decision:
        """The curriculum's first decision."""

    def decide(
        self, state: Handle, before: Handle, evidence: Evidence, *, version: int, gradient_steps: int
    ) -> Decision:
        """The curriculum's next decision, on selection `version`. before: the values that it saw last."""

    def get(self, handles: Sequence[Handle]) -> list[Any]:
        """Wait for values."""


def n_workers(config: RunConfig, spec: EnvironmentSpec) -> int:
    """Rollout actors of a run; 0: everything in its own process. Decides no result."""
    resources = config.resources
    if isinstance(resources.workers, int):
        return resources.workers
    if resources.address != "local":
        # That Ray is up already, so it costs no start: as many as can share a round.
        return config.rollout.shards
    most = min(config.rollout.shards, cores())  # the run's own process waits while they collect
    return most if spec.one_by_one and most > 1 and config.budget.steps >= _WORTH_RAY else 0


class CurriculumHost:
    """The curriculum's host: joins what all parts showed and asks the curriculum. Pure; keeps no state.

    settings: what the curriculum was made of.
    """

    def __init__(self, curriculum: Curriculum, settings: CurriculumConfig) -> None:
        self.curriculum = curriculum
        self._from_zero = settings.starts_from_zero

    def begin(self, *chunks: FloatArray) -> tuple[State, Selection, dict[str, Any], FloatArray]:
        """The first decision and V_0."""
        state, selection = self.curriculum.start()
        values = checked(np.concatenate(chunks), "start values")
        # `v0: zero`: line 2 of Algorithm 1 as printed; decision 3 of docs/algorithm.md says why it is no default.
        return state, selection, {}, np.zeros_like(values) if self._from_zero else values

    def decide(
        self, state: State, before: FloatArray, version: int, gradient_steps: int, layout: Mapping[str, int],
        *pieces: Any,
    ) -> tuple[State, Selection, dict[str, Any], FloatArray]:  # fmt: skip
        """The next decision and V_t. layout, pieces: `Evidence.flat`, with values for handles.

        Raises RuntimeError if `state` is not the one that made selection `version`.
        """
        if state.version != version:
            raise RuntimeError(f"asked to go on from selection {version} with the state of {state.version}")
        arriving = iter(pieces)
        seen = {name: [next(arriving) for _ in range(count)] for name, count in layout.items()}
        # A comparison with NaN is false: unchecked, a curriculum would go on in silence.
        after = checked(np.concatenate(seen["after"]), "start values")
        if seen.get("rescored"):
            before = checked(np.concatenate(seen["rescored"]), "start values")
        ensemble = checked(np.concatenate(seen["ensemble"]), "values of the ensemble") if seen.get("ensemble") else None
        feedback = Feedback(
            version, before, after, gradient_steps, ensemble=ensemble,
            episodes=next(self._valued(seen, after), None), probes=self._probed(state, seen),
        )  # fmt: skip
        episodes = feedback.episodes
        if self.curriculum.wants.success and episodes is not None and np.isnan(episodes.success).any():
            raise ConfigError(_SILENT)
        new, selection, numbers = self.curriculum.step(state, feedback)
        return new, selection, numbers, after

    def _valued(self, seen: Mapping[str, list[Any]], after: FloatArray) -> Iterator[Episodes]:
        """The episodes with their start values: those of their instances, or of the contexts that were generated."""
        for episodes in seen.get("episodes", []):
            values = seen.get("context_values") or [after[episodes.indices]]
            yield dataclasses.replace(episodes, start_values=checked(np.concatenate(values), "start values"))

    def _probed(self, state: State, seen: Mapping[str, list[Any]]) -> Probes | None:
        parts: list[Outcomes] = seen.get("probes", [])
        if not parts:
            return None
        indices = self.curriculum.probes(state, next(iter(seen.get("episodes", [])), None))
        if indices is None:
            raise RuntimeError(f"selection {state.version} was probed, and nobody asked for that")
        outcomes = joined(parts)
        # `Blueprint` has asked one instance's first step only.
        if np.isnan(outcomes.success).any():
            raise ConfigError(_SILENT)
        return Probes(indices, outcomes.returns, outcomes.lengths, outcomes.success)


class Central(CurriculumHost):
    """The host of a run's curriculum. Its arguments are those of `make_curriculum`."""

    def __init__(
        self, config: RunConfig, train: InstanceSet, bounds: ContextBounds,
        given: Mapping[str, bytes] = MappingProxyType({}), *,
        generator: Callable[[], ContextGenerator] | None = None, held_out: InstanceSet | None = None,
    ) -> None:  # fmt: skip
        from space_dist.curricula.making import make_curriculum

        made = make_curriculum(config, train, bounds, given, generator=generator, held_out=held_out)
        super().__init__(made, config.curriculum)


class InProcess:
    """The cluster's twin without Ray: everything at once, here. Same bits."""

    def __init__(self, config: RunConfig, setup: Setup) -> None:
        self._setup, self._worker = setup, Worker(setup)
        self._central = Central(
            config, setup.train, setup.spec.context_bounds, setup.given, generator=setup.spec.generator,
            held_out=setup.test,
        )  # fmt: skip

    def put(self, value: object) -> Handle:
        """The value itself."""
        return value

    def collect(
        self, policy: Handle, selection: Handle, walk: Walk, *, round: int, steps: int, version: int, lag: int = 0
    ) -> list[Handle]:
        """See `Cluster`."""
        asked = {"round": round, "steps": steps, "selection_version": version, "lag": lag}
        return [*self._worker.collect_all(policy, selection, walk, **asked)]

    def start_values(self, policy: Handle) -> list[Handle]:
        """See `Cluster`."""
        return [self._worker.start_values(policy, chunk) for chunk in range(self._setup.chunks)]

    def context_values(self, policy: Handle, contexts: FloatArray, *, version: int) -> list[Handle]:
        """See `Cluster`."""
        return [self._worker.context_values(policy, contexts, version)]

    def probe(self, policy: Handle, indices: IntArray, *, version: int) -> list[Handle]:
        """See `Cluster`."""
        return [self._worker.probe(policy, indices, version, part) for part in range(self._setup.evaluation_parts)]

    def evaluate(self, policy: Handle, split: Split, *, stochastic: bool = False) -> list[Handle]:
        """See `Cluster`."""
        parts = range(self._setup.evaluation_parts)
        return [self._worker.evaluate(policy, split, part, stochastic=stochastic) for part in parts]

    def begin(self, values: Sequence[Handle]) -> Decision:
        """See `Cluster`."""
        return Decision(*self._central.begin(*values))

    def decide(
        self, state: Handle, before: Handle, evidence: Evidence, *, version: int, gradient_steps: int
    ) -> Decision:
        """See `Cluster`."""
        layout, pieces = evidence.flat()
        return Decision(*self._central.decide(state, before, version, gradient_steps, layout, *pieces))

    def get(self, handles: Sequence[Handle]) -> list[Any]:
        """The values themselves."""
        return list(handles)

    def close(self) -> None:
        """Close the environments."""
        self._worker.close()


def checked(values: FloatArray, what: str) -> FloatArray:
    """The values, if they are numbers. Raises SpaceDistError otherwise."""
    if not np.isfinite(values).all():
        raise SpaceDistError(
            f"training diverged: {int((~np.isfinite(values)).sum())} {what} are not finite numbers. A smaller "
            "learner.learning_rate usually helps, unless the environment itself gives such rewards or observations"
        )
    return values
