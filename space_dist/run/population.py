"""Many runs of one shape in one process, in one batch: collected, measured and updated together.

Each member is a run like any other, with its own curriculum, ledger, checkpoint and log: a generator (`member`) that
says what it waits for. `advance` answers all of them at once: what members want collected or measured becomes one batch
of environments, and once every member waits for its update, all are made in one tensor program. A member's bits do not
depend on its companions, so members may be put together in any way, end when they end, and be resumed among others.
"""

from __future__ import annotations

import contextlib
import json
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from space_dist.config import RunConfig
from space_dist.envs import BatchedEnv, close, unwrapped
from space_dist.envs.interface import Closable
from space_dist.errors import SpaceDistError, exits_refused
from space_dist.learner import PopulationLearner, learn_together
from space_dist.rollout import Outcomes, Rollout, Setup, Shard, Split, Stage, Trial, collect, evaluate
from space_dist.rollout.walk import Walk
from space_dist.run.cluster import Handle, InProcess
from space_dist.run.launch import Outcome, begun, speaking
from space_dist.run.requests import Learn, Wait, Work
from space_dist.system.interrupts import StopRequests

_SLOTS = 1024  # environments stepped together, at most: what the cache holds of them. Decides no result
_KEPT = 8  # batches of environments that are kept, beside those in which episodes go on: what 32 members measure in
_KEPT_COSTLY = 4  # of those that hold more than arrays, as a simulator's worlds


def member(config: RunConfig, folder: Path, *, stop: StopRequests, pause_at: int = 0) -> Work[Outcome]:
    """One run of a population, to its end, or as far as asked, from where it stopped; raises as `launch` does."""
    with begun(config, folder, resume=True, stop=StopRequests(stop), pause_at=pause_at) as active:
        for part in active.parts():
            with contextlib.closing(_Promising(part.blueprint.config, part.setup, folder)) as cluster:
                yield from part.training(cluster).work()
    return active.finished()


def advance(
    members: Mapping[Path, Work[Outcome]], ended: Callable[[Path, Outcome | SpaceDistError], None]
) -> None:  # fmt: skip
    """Bring all members to their ends; `ended` hears of each when it has come to it, and how.

    members: by the folder of their run. A member that fails, or is asked to stop, ends alone.
    """
    shop, asked = _Workshop(), dict[Path, Wait | Learn]()

    def go_on(folder: Path, answer: Any) -> None:
        token = speaking.set(folder)
        work = members[folder]
        try:
            # Thrown into the member, whose own handlers note the failure in its status.
            asked[folder] = work.throw(answer) if isinstance(answer, Exception) else work.send(answer)
        except StopIteration as stop:
            ended(folder, stop.value)
        except SpaceDistError as error:
            ended(folder, error)
        finally:
            speaking.reset(token)

    try:
        for folder in members:
            go_on(folder, None)
        while asked:
            waiting = {folder: request for folder, request in asked.items() if isinstance(request, Wait)}
            answers = shop.answers(waiting) if waiting else _learned(asked)
            for folder, answer in answers.items():
                del asked[folder]
                go_on(folder, answer)
    finally:
        shop.close()
        # Closed generators release their ledgers' locks.
        for work in members.values():
            work.close()


def _learned(asked: Mapping[Path, Wait | Learn]) -> dict[Path, Any]:
    """The updates of all members, or what became of them."""
    stacks: dict[Hashable, list[_Part]] = defaultdict(list)
    made: dict[Path, list[Any]] = {}
    for folder, request in asked.items():
        if isinstance(request, Learn):
            for part in _parts_of(folder, request):
                stacks[part.learner.key].append(part)
    for parts in stacks.values():
        updates = learn_together(
            [part.learner for part in parts], [part.shards for part in parts],
            round=[part.request.round for part in parts], steps=[part.request.steps for part in parts],
        )  # fmt: skip
        for part, update in zip(parts, updates, strict=True):
            made.setdefault(part.folder, []).append(update)
    answers: dict[Path, Any] = {}
    for folder, request in asked.items():
        if isinstance(request, Learn):
            try:
                answers[folder] = request.learner.combined(made[folder])
            except SpaceDistError as error:
                answers[folder] = error
    return answers


@dataclass(frozen=True)
class _Part:
    """One policy's share of an update."""

    folder: Path
    request: Learn
    learner: PopulationLearner
    shards: Sequence[Shard]


def _parts_of(folder: Path, request: Learn) -> Iterator[_Part]:
    learner = request.learner
    if not learner.learners:
        raise TypeError(f"{folder}: a member of a population needs engine: population")
    for one, shards in zip(learner.learners, learner.parts(request.shards), strict=True):
        yield _Part(folder, request, one, shards)


ShardKey = tuple[str, int]  # a member's folder and a shard


@dataclass(eq=False)
class _Promise:
    """A handle: shards or outcomes that a member waits for. value: once it is known; an exception where it failed."""

    setup: Setup
    work: Rollout | Trial
    shard_key: ShardKey | None = None  # whose episodes a rollout goes on with
    value: Any = None

    @property
    def batch(self) -> Hashable:
        """Equal for what can be computed at once."""
        setup = self.setup
        # Sorted: the same arguments in another order make the same environment.
        env = (setup.spec.env_id, json.dumps(dict(setup.spec.kwargs), sort_keys=True), setup.spec.context_visible)
        if isinstance(self.work, Rollout):
            return ("collect", *env, setup.slots, setup.slot_length)
        # Noisy and deterministic trials act by different calls of a policy's head.
        return ("measure", *env, len(self.work), self.work.random is None)

    @property
    def slots(self) -> int:
        """Environments that it takes."""
        return self.setup.slots if isinstance(self.work, Rollout) else self.setup.spec.slots_for(len(self.work))


class _Promising(InProcess):
    """A member's cluster: what is large is promised, and computed with its like; the rest is done at once."""

    def __init__(self, config: RunConfig, setup: Setup, folder: Path) -> None:
        super().__init__(config, setup)
        self._folder = str(folder)
        self._worker.close()  # collecting and measuring are the workshop's; that one can be made is known by now

    def collect(
        self, policy: Handle, selection: Handle, walk: Walk, *, round: int, steps: int, version: int, lag: int = 0
    ) -> list[Handle]:
        """See `Cluster`."""
        asked = {"round": round, "steps": steps, "selection_version": version, "lag": lag}
        return [_Promise(self._setup, self._setup.rollout(policy, selection, walk, shard=shard, **asked),
                         shard_key=(self._folder, shard))
                for shard in range(self._setup.shards)]  # fmt: skip

    def evaluate(self, policy: Handle, split: Split, *, stochastic: bool = False) -> list[Handle]:
        """See `Cluster`."""
        trials = [self._setup.trial(policy, split, part, stochastic=stochastic)
                  for part in range(self._setup.evaluation_parts)]  # fmt: skip
        return [_Promise(self._setup, trial) if len(trial) else Outcomes.none(policy.version) for trial in trials]


class _Workshop:
    """Computes what members were promised, in batches over all of them."""

    def __init__(self) -> None:
        self._spare: list[tuple[Hashable, BatchedEnv]] = []  # with batch and slots; the latest used is last
        self._stages: dict[tuple[ShardKey, ...], tuple[Hashable, Stage]] = {}  # in which these shards' episodes go on
        self._n_parts: dict[Hashable, int] = {}  # of each batch that is evaluated
        self._costly: set[Hashable] = set()  # batches whose environments hold more than memory

    def answers(self, waiting: Mapping[Path, Wait]) -> dict[Path, Any]:
        """The values that members wait for, of some at least; an exception for one whose work failed.

        Nobody's rollout is computed before everyone who waits does for one: a member that commits by itself, or
        measures more, is waited for, or episodes would be played again in the company that remains.
        """
        sooner = {
            folder: request for folder, request in waiting.items() if not any(map(_is_to_collect, request.handles))
        }
        handles = [handle for request in waiting.values() for handle in request.handles]
        self._keep([handle for handle in handles if isinstance(handle, _Promise) and handle.value is None
                    and not (sooner and _is_to_collect(handle))])  # fmt: skip
        answers: dict[Path, Any] = {}
        for folder, request in (sooner or waiting).items():
            values = [handle.value if isinstance(handle, _Promise) else handle for handle in request.handles]
            answers[folder] = next((value for value in values if isinstance(value, Exception)), values)
        return answers

    def close(self) -> None:
        """Free the environments."""
        for shard_keys in list(self._stages):
            self._disband(shard_keys)
        while self._spare:
            close(self._spare.pop()[1])

    def _keep(self, promises: Sequence[_Promise]) -> None:
        batches: dict[Hashable, list[_Promise]] = defaultdict(list)
        for promise in promises:
            batches[promise.batch].append(promise)
        # In the same order every round, whoever was answered first: else episodes would be played again.
        parts = {batch: _parts(sorted(promised, key=lambda promise: promise.shard_key or ("", 0)))
                 for batch, promised in batches.items()}  # fmt: skip
        self._n_parts |= {batch: len(parts[batch]) for batch, promised in batches.items()
                          if promised[0].shard_key is None}  # fmt: skip
        for batch, several in parts.items():
            for number, some in enumerate(several):
                try:
                    with exits_refused():
                        self._compute(batch, some, number if self._has_own(batch) else 0)
                except Exception:  # somebody's environment may raise anything: whose was it?
                    self._compute_apart(batch, some)

    def _compute(self, batch: Hashable, promised: Sequence[_Promise], number: int = 0) -> None:
        """number: of the environments, of several of one size, in which these are computed."""
        setup, works = promised[0].setup, [promise.work for promise in promised]
        key = (batch, sum(promise.slots for promise in promised), number)
        values: Sequence[Any]
        if rollouts := [work for work in works if isinstance(work, Rollout)]:
            values = collect(self._stage(key, promised), rollouts, length=setup.slot_length)
        else:
            env = self._env(key, promised)
            if _is_costly(env):
                self._costly.add(batch)
            self._keep_spare(key, env)  # before it may fail, and is closed with the others
            values = evaluate(env, [work for work in works if isinstance(work, Trial)])
        for promise, value in zip(promised, values, strict=True):
            promise.value = value

    def _has_own(self, batch: Hashable) -> bool:
        """Whether each part of an evaluation has environments of its own, which are kept.

        An evaluation plays the same episodes as the one before it, and what an environment has drawn for an episode it
        need not draw again. But no more are kept than some, and of those that are costly one of each size.
        """
        return batch in self._n_parts.keys() - self._costly and sum(self._n_parts.values()) <= _KEPT

    def _compute_apart(self, batch: Hashable, promised: Sequence[_Promise]) -> None:
        for promise in promised:
            self.close()  # nobody knows what state an environment is in that has failed
            try:
                with exits_refused():
                    self._compute(batch, [promise])
            except Exception as error:
                promise.value = error
        self.close()

    def _stage(self, key: Hashable, promised: Sequence[_Promise]) -> Stage:
        """Where these shards' episodes go on; their environments from other company are free."""
        shard_keys = tuple(promise.shard_key for promise in promised if promise.shard_key is not None)
        if shard_keys not in self._stages:
            for others in [others for others in self._stages if not set(others).isdisjoint(shard_keys)]:
                self._disband(others)
            self._stages[shard_keys] = (key, Stage(self._env(key, promised)))
        return self._stages[shard_keys][1]

    def _disband(self, shard_keys: tuple[ShardKey, ...]) -> None:
        key, stage = self._stages.pop(shard_keys)
        self._keep_spare(key, stage.env)

    def _env(self, key: Hashable, promised: Sequence[_Promise]) -> BatchedEnv:
        """A spare one, or a new one."""
        for place in reversed(range(len(self._spare))):
            if self._spare[place][0] == key:
                return self._spare.pop(place)[1]
        return promised[0].setup.spec.make(sum(promise.slots for promise in promised))

    def _keep_spare(self, key: Hashable, env: BatchedEnv) -> None:
        self._spare.append((key, env))
        # Members end and sizes of batches change: unbounded, every size ever met would stay in memory.
        costly = [place for place, (_, spare) in enumerate(self._spare) if _is_costly(spare)]
        if len(costly) > _KEPT_COSTLY:
            close(self._spare.pop(costly[0])[1])
        elif len(self._spare) > _KEPT:
            close(self._spare.pop(0)[1])


def _is_costly(env: BatchedEnv) -> bool:
    """Whether it holds more than arrays."""
    return isinstance(unwrapped(env), Closable)


def _is_to_collect(handle: Handle) -> bool:
    """Whether it is a rollout that is still to be computed."""
    return isinstance(handle, _Promise) and handle.value is None and isinstance(handle.work, Rollout)


def _parts(promised: Sequence[_Promise]) -> list[list[_Promise]]:
    """Equal parts that fit the cache, and a simulator's worlds; each trial alone where slots are stepped one by one."""
    spec = promised[0].setup.spec
    most = max(1, min(_SLOTS, spec.most_slots) // max(promise.slots for promise in promised))
    if spec.one_by_one and isinstance(promised[0].work, Trial):
        most = 1
    count = -(-len(promised) // most)
    split = np.array_split(np.arange(len(promised)), count)
    return [[promised[place] for place in places] for places in split]
