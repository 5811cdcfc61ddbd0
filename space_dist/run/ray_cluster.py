"""The same work on the actors of `ray_actors`: who is asked, what is owed, and what becomes of either when one dies.

Nothing here decides a result. A shard may be computed by any actor; values flow from rollout actors to the curriculum
actor, and its selection back to them, by object reference, without passing through the driver.

Every call is a pure function that is kept until its answer is here, so whatever is lost is asked for again: an actor
that died or is late, an object whose only copy was on a lost node, what waited in the queue behind either. Calls go to
actors that are up; one that is being replaced joins when it is.
"""

from __future__ import annotations

import contextlib
import logging
import os
import statistics
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

from space_dist.system.workplace import RAY_DEFAULTS

os.environ.update(RAY_DEFAULTS | dict(os.environ))  # before Ray reads it

import ray
from ray.exceptions import RayError, RayTaskError
from ray.util.placement_group import PlacementGroup, placement_group, placement_group_table, remove_placement_group
from ray.util.scheduling_strategies import PlacementGroupSchedulingStrategy

from space_dist.arithmetic import settings as arithmetic_settings
from space_dist.config import RunConfig
from space_dist.errors import CONTINUES, ConfigError, Interrupted, SpaceDistError
from space_dist.rollout import FloatArray, IntArray, Setup, Split
from space_dist.rollout.walk import Walk
from space_dist.run.cluster import Decision, Evidence, Handle, n_workers
from space_dist.run.ray_actors import (
    CENTRAL,
    CurriculumActor,
    RolloutActor,
    computes_with,
    name_of,
    refuse_other_arithmetic,
)
from space_dist.run.ray_session import attended, cpus, first_line, join_ray, remove_session, shut_down
from space_dist.run.ray_watch import Note, nowhere
from space_dist.system.importing import folders_of_user

_ATTEMPTS = 6  # at one call, or at one actor's start, before something must be wrong with the work itself
_LOOK_SECONDS = 0.2  # between two looks for what died or is late
_RESCHEDULING_SECONDS = 5.0  # that Ray gets to find other room for a lost node's actors
_REMEMBERED = 101  # durations per kind of call, whose median says what is late: a mean would follow the late ones
_CLOSING_SECONDS = 5.0  # that actors get to close their environments
_CENTRAL_ANSWERS = 4  # state, selection, numbers, values

log = logging.getLogger("space_dist")


# eq=False: told apart by identity, as members of sets and keys; values are arrays.
@dataclass(eq=False)
class _RemoteValue:
    """A handle: where a value is, or will be. Recomputing the value moves it.

    kept: the driver holds the value too, because nobody could compute it again: what was put, what was decided.
    """

    ref: Any
    value: Any = None
    kept: bool = False


@dataclass(eq=False)
class _Call:
    """A call of an actor's method, kept until its answer has arrived so that it can be made again."""

    work: int  # number of the shard, chunk or part, which decides the actor; CENTRAL for the curriculum actor
    method: str
    arguments: tuple[Any, ...]
    options: dict[str, Any]
    answers: list[_RemoteValue]
    actor_index: int = 0
    actor: Any = None
    seconds: Any = None  # reference of how long it took: small, so it comes to the driver by itself
    number: int = 0  # in the order of submission, in which actors work
    answered: bool = False
    attempts: int = 0
    late: int = 0  # times
    since: float | None = None  # when its turn came, on the cluster's clock

    @property
    def remote_arguments(self) -> list[_RemoteValue]:
        """The arguments that are handles."""
        return [argument for argument in self.arguments if isinstance(argument, _RemoteValue)]


class RayCluster:
    """Rollout actors and one curriculum actor; a context manager that leaves nothing behind.

    The rollout actors' CPUs are held in one placement group, so that a run has all its room or none. An actor that
    dies, or is late, is replaced, and what it owed is computed elsewhere; if a node is lost and the others have no room
    for its actors, the run goes on with fewer. Raises SpaceDistError if Ray cannot be reached or has no room.
    """

    def __init__(
        self, config: RunConfig, setup: Setup, raise_if_stopped: Callable[[], None] = lambda: None,
        note: Note = nowhere, tell: Callable[[str], None] = log.warning,
        joined: Callable[[str], None] = lambda which: None,
    ) -> None:  # fmt: skip
        """As `join_ray` for `raise_if_stopped`, `note` and `joined`. tell: hears of what is lost, and logs it."""
        self._config, self._resources, self._setup = config, config.resources, setup
        self._workers = max(1, n_workers(config, setup.spec))
        self._raise_if_stopped, self._note, self._tell, self._joined = raise_if_stopped, note, tell, joined
        self._computing = [computes_with(config, setup, central=central) for central in (False, True)]
        self._room: PlacementGroup | None = None
        self._actors: dict[int, Any] = {}  # by index
        self._starting: dict[int, tuple[Any, float]] = {}  # index -> its sign of life to be, and since when
        self._hosts: dict[int, str] = {}  # index -> the machine it is on, as long as it is up
        self._asked_hosts: dict[int, Any] = {}  # index -> that answer to be, which comes before the sign of life
        self._failed_starts: dict[int, int] = defaultdict(int)
        self._unanswered: list[_Call] = []
        self._submitted = 0
        self._seconds: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=_REMEMBERED))
        self._session: str | None = None  # the folder of a Ray of our own
        self._watch = contextlib.ExitStack()  # over Ray itself, as long as it is ours to use
        self._clock = 0.0  # seconds spent waiting: a driver that was itself stopped, or busy, blames nobody

    def __enter__(self) -> RayCluster:
        resources = self._resources
        found = join_ray(resources.address, self._workers + 1, self._raise_if_stopped, self._note, self._joined)
        self._session = found["session_dir"] if resources.address == "local" else None
        self._watch.enter_context(attended(found, resources.address, gone=True, leave=shut_down, note=self._note))
        try:
            self._remote_setup = self.put(self._setup)
            if resources.workers == "auto":
                self._workers = max(1, min(self._workers, int(cpus()[0])))
            if not self._take_room(self._workers, resources.room_seconds):
                raise self._no_room(self._workers)
            self._start((*range(self._workers), CENTRAL))
            while self._starting:
                self._look_after_starting()
        # Python calls no `__exit__` for what fails in `__enter__`.
        except BaseException:
            self._watch.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None or issubclass(kind, Interrupted):
            self._close_environments()
        with contextlib.suppress(RayError):
            for actor in self._actors.values():
                ray.kill(actor)
            self._leave_room()
        self._watch.close()
        if kind is None or issubclass(kind, Interrupted):
            remove_session(self._session)

    def put(self, value: object) -> Handle:
        """See `cluster.Cluster`."""
        return _RemoteValue(ray.put(value), value, kept=True)

    def collect(
        self, policy: Handle, selection: Handle, walk: Walk, *, round: int, steps: int, version: int, lag: int = 0
    ) -> list[Handle]:
        """See `cluster.Cluster`."""
        asked = {"round": round, "steps": steps, "selection_version": version, "lag": lag}
        shards = range(self._setup.shards)
        return [self._ask(shard, "collect", policy, selection, walk.of(shard), shard=shard, **asked)[0]
                for shard in shards]  # fmt: skip

    def start_values(self, policy: Handle) -> list[Handle]:
        """See `cluster.Cluster`."""
        return [self._ask(chunk, "start_values", policy, chunk)[0] for chunk in range(self._setup.chunks)]

    def context_values(self, policy: Handle, contexts: FloatArray, *, version: int) -> list[Handle]:
        """See `cluster.Cluster`."""
        return [self._ask(0, "context_values", policy, contexts, version)[0]]

    def probe(self, policy: Handle, indices: IntArray, *, version: int) -> list[Handle]:
        """See `cluster.Cluster`."""
        parts = range(self._setup.evaluation_parts)
        return [self._ask(part, "probe", policy, indices, version, part)[0] for part in parts]

    def evaluate(self, policy: Handle, split: Split, *, stochastic: bool = False) -> list[Handle]:
        """See `cluster.Cluster`."""
        parts = range(self._setup.evaluation_parts)
        return [self._ask(part, "evaluate", policy, split, part, stochastic=stochastic)[0] for part in parts]

    def begin(self, values: Sequence[Handle]) -> Decision:
        """See `cluster.Cluster`."""
        return Decision(*self._ask(CENTRAL, "begin", *values))

    def decide(
        self, state: Handle, before: Handle, evidence: Evidence, *, version: int, gradient_steps: int
    ) -> Decision:
        """See `cluster.Cluster`."""
        layout, handles = evidence.flat()
        return Decision(*self._ask(CENTRAL, "decide", state, before, version, gradient_steps, layout, *handles))

    def get(self, handles: Sequence[Handle]) -> list[Any]:
        """Wait for values; every call made so far is answered then. Raises SpaceDistError if work fails repeatedly."""
        decided = [remote for call in self._unanswered if call.work == CENTRAL for remote in call.answers]
        wanted = [remote for remote in dict.fromkeys([*handles, *decided]) if not remote.kept]
        while True:
            self._wait_for_answers()
            try:
                # A timeout is a RayError as well: what does not arrive in time is computed again.
                values = ray.get([remote.ref for remote in wanted], timeout=self._resources.first_answer_seconds)
                break
            except RayTaskError as error:
                raise _cause(error) from error
            except RayError as error:  # it had been computed, and was lost with a node before it came here
                self._ask_again(set(), set(self._unanswered), error)
        arrived = dict(zip(wanted, values, strict=True))
        for remote in decided:  # the next decision needs it, and nobody could make it again
            remote.value, remote.kept = arrived[remote], True
        # What was asked for ahead of its time may still be lost before it is fetched.
        self._unanswered = [call for call in self._unanswered
                            if call.method == "collect" and not arrived.keys() >= set(call.answers)]  # fmt: skip
        return [handle.value if handle.kept else arrived[handle] for handle in handles]

    # ---- calls ----

    def _ask(self, work: int, method: str, *arguments: Any, **options: Any) -> list[_RemoteValue]:
        answers = [_RemoteValue(None) for _ in range(_CENTRAL_ANSWERS if work == CENTRAL else 1)]
        call = _Call(work, method, arguments, options, answers)
        self._unanswered.append(call)
        self._submit(call)
        return answers

    def _submit(self, call: _Call) -> None:
        call.actor_index = CENTRAL if call.work == CENTRAL else self._actor_for(call.work)
        call.actor, call.since, call.answered = self._actors[call.actor_index], None, False
        call.number = self._submitted = self._submitted + 1
        several = len(call.answers) > 1
        arguments = [argument.ref if isinstance(argument, _RemoteValue) else argument for argument in call.arguments]
        method = call.actor.timed.options(num_returns=1 + len(call.answers))
        call.seconds, *refs = method.remote(call.method, several, *arguments, **call.options)
        for remote, ref in zip(call.answers, refs, strict=True):
            remote.ref = ref

    def _wait_for_answers(self) -> None:
        while waiting := [call for call in self._unanswered if not call.answered]:
            start = time.monotonic()
            refs = [call.seconds for call in waiting]
            ready, _ = ray.wait(refs, num_returns=len(refs), timeout=_LOOK_SECONDS, fetch_local=False)
            self._clock += min(time.monotonic() - start, 2 * _LOOK_SECONDS)
            self._look_after_starting(wait=False)
            arrived = set(ready)
            dead, lost, reason = set(), set(), None
            for call in waiting:
                if call.seconds in arrived:
                    try:
                        self._seconds[call.method].append(ray.get(call.seconds))
                        call.answered = True
                    except RayError as error:
                        if not _is_loss(error):
                            raise _cause(error) from error
                        reason = error
                        lost.add(call)
                        if isinstance(error, RayTaskError):  # its actor lives; an argument was lost
                            lost |= self._makers(call)
                        elif self._actors.get(call.actor_index) is call.actor:
                            dead.add(call.actor_index)
            late = self._late()
            if dead or lost or late:
                self._tell_lost(dead)
                self._replace(dead | late)
                self._ask_again(dead | late, lost, reason)

    def _tell_lost(self, dead: Iterable[int]) -> None:
        """A line for each machine on which actors have died."""
        on: dict[str, list[str]] = defaultdict(list)
        for index in sorted(dead):
            on[self._hosts.get(index, "a node")].append(name_of(index))
        for host, names in on.items():
            new = "a new one takes its place" if len(names) == 1 else "new ones take their places"
            self._tell(f"lost {', '.join(names)} (on {host}); what was owed is computed again, and {new}")

    def _makers(self, call: _Call) -> set[_Call]:
        """The answered calls whose answers were this one's arguments."""
        return {
            one for one in self._unanswered if one.answered and not set(one.answers).isdisjoint(call.remote_arguments)
        }

    def _late(self) -> set[int]:
        """Indices of actors that have been at one call for much longer than such calls take."""
        turns: dict[int, _Call] = {}
        for call in sorted((one for one in self._unanswered if not one.answered), key=lambda one: one.number):
            turns.setdefault(call.actor_index, call)
        coming = {remote for call in self._unanswered if not call.answered for remote in call.answers}
        late = set()
        for index, call in turns.items():
            if index in self._starting or any(remote in coming for remote in call.remote_arguments):
                call.since = None  # it waits for somebody else
            elif call.since is None:
                call.since = self._clock
            elif self._clock - call.since > self._patience(call):
                log.warning(
                    "%s has not answered for %.0f s where %s takes %.2g s; replacing it",
                    name_of(index), self._clock - call.since, call.method, self._usual_seconds(call),
                )  # fmt: skip
                call.late += 1
                late.add(index)
        return late

    def _usual_seconds(self, call: _Call) -> float:
        return statistics.median(self._seconds[call.method] or [0.0])

    def _patience(self, call: _Call) -> float:
        """Seconds; more for a call that was found late before: a false alarm must cost nothing but time."""
        resources = self._resources
        if not self._seconds[call.method]:
            return resources.first_answer_seconds * 2.0**call.late
        return max(resources.late_seconds, resources.late_factor * self._usual_seconds(call)) * 2.0**call.late

    def _ask_again(self, indices: set[int], lost: set[_Call], reason: Exception | None) -> None:
        """Submit anew what the actors `indices` owed, what was `lost`, and what was to use either."""
        if reason is not None:
            log.warning("lost a part of the run (%s); computing it again", type(reason).__name__)
        moved = {remote for call in lost for remote in call.remote_arguments if remote.kept}
        for remote in moved:
            remote.ref = ray.put(remote.value)
        for call in self._unanswered:  # in the order of submission, so that arguments are asked for before their users
            owed = call.actor_index in indices and not call.answered
            if call in lost or owed or (not call.answered and not moved.isdisjoint(call.remote_arguments)):
                call.attempts += 1
                if call.attempts == _ATTEMPTS:
                    what = "took too long" if reason is None else f"{type(reason).__name__}: {first_line(reason)}"
                    raise SpaceDistError(
                        f"the same work was lost {_ATTEMPTS} times ({what}). What was committed is intact; {CONTINUES}"
                    ) from reason
                self._submit(call)
                moved.update(call.answers)

    # ---- actors ----

    def _actor_for(self, work: int) -> int:
        """The rollout actor for a part of the work: the same one as long as none is lost."""
        while not (indices := sorted(index for index in self._actors if index not in (CENTRAL, *self._starting))):
            self._find_other_room()
        return indices[work % len(indices)]

    def _start(self, indices: Iterable[int]) -> None:
        """Start actors; they are up once `_look_after_starting` has seen it."""
        if self._room is None:
            raise RuntimeError("actors are started in a room")
        for index in indices:
            # Never restarted by Ray: an actor that came back blank would go on silently.
            inside = PlacementGroupSchedulingStrategy(self._room, placement_group_bundle_index=-1)
            options: dict[str, Any] = {"max_restarts": 0, "scheduling_strategy": inside}
            if self._resources.address != "local" and (chosen := arithmetic_settings()):  # our own Ray's inherit them
                options["runtime_env"] = {"env_vars": chosen}
            setup = self._remote_setup.ref
            self._actors[index] = (
                # Not counted: a run takes 1 + resources.workers CPUs (docs/grids.md).
                ray.remote(num_cpus=0, **options)(CurriculumActor).remote(self._config, setup, folders_of_user())
                if index == CENTRAL
                else ray.remote(num_cpus=1, **options)(RolloutActor).remote(setup, folders_of_user())
            )
            parts = self._computing[index == CENTRAL]
            self._asked_hosts[index] = self._actors[index].host.remote()
            self._starting[index] = (self._actors[index].ready.remote(parts), time.monotonic())

    def _close_environments(self) -> None:
        """Have actors close their environments: what these hold outside of their process would outlive it."""
        with contextlib.suppress(RayError):
            asked = [actor.close.remote() for index, actor in self._actors.items()
                     if index != CENTRAL and index not in self._starting]  # fmt: skip
            if asked:
                ray.wait(asked, num_returns=len(asked), timeout=_CLOSING_SECONDS, fetch_local=False)

    def _replace(self, indices: Iterable[int]) -> None:
        for index in indices:
            with contextlib.suppress(RayError):
                ray.kill(self._actors[index])  # which also answers whoever waits for what it owed
        self._start(indices)

    def _look_after_starting(self, *, wait: bool = True) -> None:
        """Notice which actors are up by now, and start those again that died before. Raises what stopped them."""
        refs = [ref for ref, _ in self._starting.values()]
        if not refs:
            return
        arrived = set(ray.wait(refs, timeout=_LOOK_SECONDS if wait else 0, fetch_local=False)[0])
        for index, (ref, since) in list(self._starting.items()):
            if ref in arrived:
                try:
                    found, self._hosts[index] = ray.get([ref, self._asked_hosts[index]])
                except RayError as error:
                    self._retry_start(index, error)
                else:
                    refuse_other_arithmetic(index, found)
                    del self._starting[index]
                    self._failed_starts[index] = 0
            elif time.monotonic() - since > self._resources.first_answer_seconds:
                log.warning("%s did not start; trying again", name_of(index))
                self._retry_start(index, None)

    def _retry_start(self, index: int, error: RayError | None) -> None:
        cause = None if error is None else error.__cause__
        self._failed_starts[index] += 1
        if isinstance(cause, SpaceDistError):
            # Our own sentence (another arithmetic, a config's fault) would be the same at every attempt.
            raise cause
        if isinstance(cause, RayTaskError) and not _is_loss(cause):  # its environment's or policy's own fault
            raise _cause(cause) from error
        if self._failed_starts[index] == _ATTEMPTS:
            what = "no sign of life" if error is None else first_line(error)
            raise SpaceDistError(f"{name_of(index)} died as it started: {what}") from error
        if error is not None:
            self._remote_setup.ref = ray.put(self._setup)  # it may be what was lost
        self._replace([index])

    # ---- room ----

    def _take_room(self, workers: int, seconds: float) -> bool:
        """Hold one CPU for each rollout actor, near to each other; False if there is no room within the time."""
        # One group, all or nothing: two runs that each hold half of the CPUs would wait for each other for ever.
        self._room = placement_group([{"CPU": 1.0}] * workers, strategy="PACK")
        if self._room.wait(max(1.0, seconds)):
            return True
        self._leave_room()
        return False

    def _leave_room(self) -> None:
        if self._room is not None:
            remove_placement_group(self._room)
            self._room = None

    def _find_other_room(self) -> None:
        """Wait for a rollout actor to come up; if Ray finds no room for all of them any more, hold what there is."""
        start, seconds = time.monotonic(), self._resources.room_seconds
        while self._actors.keys() - {CENTRAL} <= self._starting.keys():
            self._look_after_starting()
            waited = time.monotonic() - start
            if waited > min(_RESCHEDULING_SECONDS, seconds) and not self._has_room():
                for actor in self._actors.values():
                    with contextlib.suppress(RayError):
                        ray.kill(actor)
                self._actors, self._starting = {}, {}
                self._leave_room()
                workers = max(1, min(self._workers, int(cpus()[1])))
                if not self._take_room(workers, _RESCHEDULING_SECONDS):
                    if waited > seconds:
                        raise self._no_room(workers)
                    continue
                self._tell(f"room is left for {workers} of {self._workers} rollout actors")
                self._start((*range(workers), CENTRAL))

    def _has_room(self) -> bool:
        return self._room is not None and placement_group_table(self._room)["state"] == "CREATED"

    def _no_room(self, workers: int) -> SpaceDistError:
        total, free = cpus()
        return SpaceDistError(
            f"Ray has no room for {workers} rollout actors of one CPU each: in {self._resources.room_seconds:.0f} s "
            f"(resources.room_seconds) none was found; the cluster has {total:.0f} CPUs, {free:.0f} of them free. "
            "Fewer fit with --workers"
        )


def _is_loss(error: BaseException | None) -> bool:
    """Whether a part of Ray failed, and not the work itself: directly, or as an argument of a call."""
    while isinstance(error, RayTaskError):
        error = error.cause
    return isinstance(error, RayError)


def _cause(error: RayError) -> Exception:
    """What the code in the actor raised: our own errors as they are, others as a sentence."""
    cause = error.cause if isinstance(error, RayTaskError) and isinstance(error.cause, Exception) else error
    if isinstance(cause, SpaceDistError):
        kind = ConfigError if isinstance(cause, ConfigError) else SpaceDistError
        return kind(str(cause.args[0]) if cause.args else str(cause))
    lines = str(error).strip().splitlines()
    return SpaceDistError(f"an actor failed: {lines[-1][:300] if lines else type(error).__name__}")
