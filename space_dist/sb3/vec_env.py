"""A vectorised environment of Stable-Baselines3's, each of whose episodes is played on an instance.

SB3's own reset an environment as soon as its episode has ended, with nothing that could tell it a context. This one
chooses the context first: by the round that a `CurriculumCallback` has begun, or, where there is none, by walking over
all instances. It keeps the books that `rollout.collect` keeps, so that what a curriculum is told is the same.
"""

from __future__ import annotations

import operator
import re
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from space_dist.curricula import Selection
from space_dist.envs import BatchedEnv, BatchedSingles, Drawable, close, make_batched, unwrapped
from space_dist.envs.interface import opened
from space_dist.envs.observations import Observations, allocate, concatenate, put, take
from space_dist.errors import ConfigError, nearest
from space_dist.instances import ContextBounds, InstanceSet, read_csv
from space_dist.rollout import EpisodeTable, Shard, Stage, Walking, another_way, endless, replayed
from space_dist.rollout.walk import Unfinished

_FREE = 1 << 32  # the first round of an environment that nobody drives; no run has so many
_FREE_STEPS = 1024  # of such a round
_ARGUMENTS = (  # what a config's keys are called here
    (re.compile(r"\benv\.kwargs\.(\w+)"), r'env_kwargs["\1"]'),
    (re.compile(r"\benv\.kwargs\b"), "env_kwargs"),
    (re.compile(r"\benv\.id\b"), "env"),
)


@dataclass(frozen=True)
class RoundPlan:
    """A round of one shard: see `rollout.Route`."""

    selection: Selection
    start: int
    gamma: float
    seed: int
    round: int
    unfinished: Unfinished | None = None
    shard: int = 0


@dataclass(frozen=True)
class Played:
    """Steps of a round from its first on: (time, n_envs, ...) actions as given, (time, n_envs) rewards in return."""

    actions: NDArray[np.generic]
    rewards: NDArray[np.float64]


class ContextVecEnv(VecEnv):
    """`n_envs` copies of an environment, stepped one after another, as in SB3's DummyVecEnv; episodes are on instances.

    env: a class or function that makes a `gymnasium.Env` with a `context_space`, whose `reset` takes
        `options={"context": array}` (docs/your_environment.md), or a batched one; or its id, as `env.id` of a config.
    instances: a CSV file (or `shipped:NAME`), an `InstanceSet`, or an (n, d) array of contexts in environment units,
        one row an instance (ids are 0, 1, ... then; (n,) where a context is one number).
    n_envs: how many episodes run at once.
    seed: with the instance and the round it decides each episode's own. SB3's `seed=` of a model takes its place.
    context_visible: whether observations end with the context, scaled from its bounds to [-1, 1].
    columns: names of further columns of a CSV file, for curricula that read one.
    env_kwargs: arguments of the environment.

    While a `CurriculumCallback` trains on it, the callback chooses the instances. Otherwise episodes walk over all
    instances by id, from the first at every `reset`: so an environment of test instances, given to SB3's
    `evaluate_policy` with as many episodes as there are instances, has each played once, and the same each time. (With
    `n_envs=1`: of several, `evaluate_policy` counts equally many episodes each, wherever short ones have led the walk.)

    An info holds what the environment told, and at the end of an episode `instance` (its id, -1 for a generated
    context), `context` (d,), `episode` as SB3's Monitor tells it, and `is_success` where the environment knows success.

    Raises ConfigError if environment or instances cannot be used.
    """

    def __init__(
        self,
        env: str | Callable[..., Any],
        instances: InstanceSet | Path | str | ArrayLike,
        n_envs: int = 1,
        *,
        seed: int = 0,
        context_visible: bool = True,
        columns: Sequence[str] = (),
        env_kwargs: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        if not isinstance(env, str) and not callable(env):
            raise ConfigError(
                f"ContextVecEnv: env is a {type(env).__name__}; give the class, a function that makes one environment "
                "at each call, or an id"
            )
        n_envs = _whole(n_envs, "n_envs", 1)
        try:
            kwargs = dict(env_kwargs)  # which can be copied
        except (TypeError, ValueError):
            raise ConfigError(f"ContextVecEnv: env_kwargs must be a dict, not {env_kwargs!r}") from None
        self._env, self._kwargs, self.context_visible = env, kwargs, context_visible
        batched = self.make_batched(n_envs)
        self.bounds = batched.context_bounds
        self.instances = _instances(instances, self.bounds, columns)
        self.run_seed = _whole(seed, "seed", 0)
        self.horizon = batched.horizon
        self._batched, self._stage = batched, Stage(batched)
        super().__init__(n_envs, batched.observation_space, batched.action_space)
        self._began = time.time()
        self._actions: NDArray[Any] = np.zeros(0)
        self._free_rounds, self._free_start = 0, 0
        self._current: Observations = allocate(batched.observation_space, n_envs)
        self.driven = False
        """Whether a callback chooses the instances of the round that is played."""
        self.time = self._length = 0  # as if a round were over: whoever steps before a reset begins another
        self._ended = True
        self._left: Unfinished | None = None

    def make_batched(self, n_slots: int) -> BatchedEnv:
        """Another such environment, with `n_slots` slots."""
        with _told_of_arguments("ContextVecEnv: "):
            return make_batched(self._env, n_slots, context_visible=self.context_visible, kwargs=self._kwargs)

    def opened(self, n_slots: int) -> AbstractContextManager[BatchedEnv]:
        """Such an environment, for as long as the context lasts."""
        return opened(self.make_batched, n_slots)

    # ---- rounds ----

    def begin_round(self, plan: RoundPlan, *, length: int, record: bool = False, driven: bool = True) -> Observations:
        """Go on with what of `plan` is unfinished, and play its selection, for `length` steps of all slots at most.

        record: keep the observations. Returns (n_envs, ...) where all slots stand. Raises SpaceDistError if an episode
        that has to be played again goes another way.
        """
        env, slots = self._batched, self.num_envs
        self.plan, self._length, self._record, self.driven = plan, length, record, driven
        self._ended, self._left = False, plan.unfinished
        self._walking = Walking([plan], slots)
        self._table = EpisodeTable([plan], slots)
        self.time = 0
        self._observed: list[Observations] = []
        self._truncated_observed: list[Observations] = []
        self._executed: list[NDArray[Any]] = []
        self._steps: list[tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]] = []
        live = self._stage.resume([plan.unfinished])
        self._current = live if live is not None else replayed(env, self._table)
        self.starts = ~self._table.runs
        """(n_envs,) whether a slot's first step in this round begins an episode."""
        self._start(np.flatnonzero(self.starts))
        return take(self._current, slice(None))

    def played(self) -> Played:
        """All steps since `begin_round`."""
        return Played(np.stack(self._executed), np.stack([rewards for rewards, _, _ in self._steps]))

    def play_again(self, before: Played) -> Observations:
        """Take the steps of `before`, in a round that has just begun as theirs had.

        Returns (n_envs, ...) where all slots stand. Raises SpaceDistError if they earn other rewards.
        """
        for actions in before.actions:
            self.step_async(actions)
            self.step_wait()
        earned = self.played().rewards
        # Equal to the bit or not at all; NaN is equal to itself here.
        differ = np.argwhere((earned != before.rewards) & ~(np.isnan(earned) & np.isnan(before.rewards)))
        if len(differ):
            at = tuple(differ[0].tolist())
            raise another_way(f"earned {float(earned[at])!r} in a step, and had earned {float(before.rewards[at])!r}")
        return take(self._current, slice(None))

    @property
    def begins(self) -> NDArray[np.bool_]:
        """(n_envs,) where an episode stands before its first step."""
        fresh: NDArray[np.bool_] = self._table.lengths(self.time) == 0
        return fresh

    def end_round(self) -> Shard:
        """What was played since `begin_round`, as the one shard of a round.

        Episodes that had begun and made no step are not part of it: the next round begins others in their slots.
        Observations have length 0 where they were not recorded.
        """
        table, length, plan = self._table, len(self._executed), self.plan
        fresh = table.runs & (table.lengths(length) == 0)
        table.runs[fresh] = False
        (episodes,) = table.episodes(1)
        (unfinished,) = table.unfinished(1, np.stack(self._executed))
        rewards, terminated, truncated = (np.stack(column) for column in zip(*self._steps, strict=True))
        space, slots = self._batched.observation_space, self.num_envs
        observations = allocate(space, len(self._observed), slots)
        for at, observed in enumerate(self._observed):
            put(observations, at, observed)
        lasts = self._truncated_observed
        self._stage.leave([unfinished], self._current)
        self.driven, self._ended, self._length, self._left = False, True, length, unfinished
        return Shard(
            shard=plan.shard, round=plan.round, policy_version=plan.round,
            selection_version=plan.selection.version, order_version=plan.selection.order_version,
            observations=observations, actions=np.stack(self._executed), rewards=rewards, terminated=terminated,
            truncated=truncated, starts=self.starts, last_observations=take(self._current, slice(None)),
            truncated_observations=concatenate(lasts) if lasts else allocate(space, 0), next_observations=None,
            episodes=episodes, begun=int(self._walking.begun[0] - fresh.sum()), unfinished=unfinished,
        )  # fmt: skip

    def _walk_on(self, unfinished: Unfinished | None) -> None:
        """Begin a round that nobody drives."""
        ids, contexts = self.instances.ids, self.instances.contexts
        plan = RoundPlan(
            Selection(0, ids, contexts, 0), self._free_start, 1.0, self.run_seed, _FREE + self._free_rounds, unfinished
        )
        self._free_rounds += 1
        self.begin_round(plan, length=_FREE_STEPS, driven=False)

    def _start(self, slots: NDArray[np.int64]) -> None:
        """Begin the next episodes of the plan in `slots` (k,), which ascend."""
        if not len(slots):
            return
        ids, contexts, seeds = self._walking.next(slots)
        put(self._current, slots, self._batched.reset(slots, contexts, seeds))
        self._table.begin(slots, ids, contexts, seeds, self.time)

    # ---- what SB3 asks of a VecEnv ----

    def reset(self) -> VecEnvObs:
        """Begin new episodes in all slots, on the first instances. A round that was being played is over."""
        self._stage.leave([], self._current)
        self._free_rounds, self._free_start = 0, 0
        self._walk_on(None)
        self._reset_seeds()
        self._reset_options()
        return take(self._current, slice(None))

    def step_async(self, actions: NDArray[Any]) -> None:
        """See `VecEnv`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """One step of every slot; where an episode ends, the next one begins at once, on its own instance."""
        if self.time == self._length:  # of a round that is over, and nobody has begun another
            if not self._ended:
                free, shard = not self.driven, self.end_round()
                self._free_start = (self._free_start + free * shard.begun) % len(self.instances)
            self._walk_on(self._left)
        env, table, at = self._batched, self._table, self.time
        actions = np.array(self._actions)
        step = env.step(actions)
        terminated, truncated = step.terminated, step.truncated & ~step.terminated
        if self._record:
            self._observed.append(take(self._current, slice(None)))
            self._truncated_observed.append(take(step.observations, truncated))
        self._executed.append(actions)
        self._steps.append((step.rewards, terminated, truncated))
        table.add(step.rewards)
        dones = terminated | truncated
        ended = np.flatnonzero(dones)
        table.end(ended, at, step.success)
        if table.overdue(at + 1, env.horizon):
            raise endless(env)
        infos = self._infos(truncated)
        for slot in ended.tolist():
            infos[slot] |= {
                "terminal_observation": take(step.observations, slot),
                "instance": int(table.ids[slot]),
                "context": table.contexts[slot].copy(),
                "episode": {
                    "r": float(table.returns[slot]),
                    "l": int(table.lengths(at)[slot]) + 1,
                    "t": round(time.time() - self._began, 6),
                },
            }
            if step.success is not None:
                infos[slot]["is_success"] = bool(step.success[slot])
        self.time = at + 1
        put(self._current, slice(None), step.observations)
        self._start(ended)
        # As SB3's DummyVecEnv keeps them.
        return take(self._current, slice(None)), step.rewards.astype(np.float32), dones, infos

    def _infos(self, truncated: NDArray[np.bool_]) -> list[dict[str, Any]]:
        env = unwrapped(self._batched)
        given: Sequence[Mapping[str, Any]] = env.infos if isinstance(env, BatchedSingles) else [{}] * self.num_envs
        # SB3 bootstraps by this key, on-policy as off-policy.
        return [{**info, "TimeLimit.truncated": bool(cut)} for info, cut in zip(given, truncated, strict=True)]

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Have `seed` decide the seeds of all episodes to come."""
        if seed is not None:
            self.run_seed = _whole(seed, "seed", 0)
        return [seed] * self.num_envs

    def close(self) -> None:
        """Free what the environments hold."""
        close(unwrapped(self._batched))

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """See `VecEnv`."""
        if attr_name == "render_mode" and not isinstance(unwrapped(self._batched), BatchedSingles):
            return [None for _ in self._get_indices(indices)]
        return [
            one.get_wrapper_attr(attr_name) if isinstance(one, gym.Env) else getattr(one, attr_name)
            for one in self._targets(indices)
        ]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """See `VecEnv`."""
        for one in self._targets(indices):
            setattr(one, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """See `VecEnv`."""
        return [method(*args, **kwargs) for method in self.get_attr(method_name, indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """See `VecEnv`. Episodes are told as SB3's Monitor tells them, so it counts as there."""
        return [
            wrapper_class is Monitor or (isinstance(one, gym.Env) and is_wrapped(one, wrapper_class))
            for one in self._targets(indices)
        ]

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """What every slot's environment draws of itself."""
        env = unwrapped(self._batched)
        return [env.frame(slot) if isinstance(env, Drawable) else None for slot in range(self.num_envs)]

    def _targets(self, indices: VecEnvIndices) -> list[Any]:
        """The single environments, or the batched one as often as it is asked for."""
        env = unwrapped(self._batched)
        return [env.single(slot) if isinstance(env, BatchedSingles) else env for slot in self._get_indices(indices)]


def _whole(given: Any, name: str, least: int) -> int:
    try:
        number = -1 if isinstance(given, bool) else operator.index(given)
    except TypeError:
        number = -1
    if number < least:
        raise ConfigError(f"ContextVecEnv: {name} must be a whole number of at least {least}, not {given!r}")
    return number


@contextmanager
def _told_of_arguments(beginning: str = "") -> Iterator[None]:
    """Have what is wrong with the environment be told of the arguments here, and not of the keys of a config."""
    try:
        yield
    except ConfigError as error:
        text = str(error)
        for key, argument in _ARGUMENTS:
            text = key.sub(argument, text)
        raise ConfigError(f"{beginning}{text}") from error.__cause__


def _instances(
    given: InstanceSet | Path | str | ArrayLike, bounds: ContextBounds, columns: Sequence[str]
) -> InstanceSet:
    """What was given as an instance set. Raises ConfigError if it does not belong to these bounds."""
    listed = isinstance(columns, Collection) and not isinstance(columns, str)
    if not listed or not all(isinstance(name, str) for name in columns):
        raise ConfigError(f"ContextVecEnv: columns must be a list of names, like ['difficulty'], not {columns!r}")
    if isinstance(given, str | Path):
        with _told_of_arguments():
            return read_csv(given, bounds, columns)
    if isinstance(given, InstanceSet):
        instances = given
    else:
        contexts = _contexts(given, bounds.names)
        instances = InstanceSet(np.arange(len(contexts)), contexts, bounds.names)
    if instances.names != bounds.names:
        raise ConfigError(
            f"ContextVecEnv: the instances' features are {', '.join(instances.names)}, the environment's are "
            f"{', '.join(bounds.names)}"
        )
    known = (*instances.names, *instances.columns)
    if missing := [name for name in columns if name not in known]:
        raise ConfigError(
            f"ContextVecEnv: columns: the instances have no column {missing[0]!r}{nearest(missing[0], known)} Further "
            "columns come with a CSV file, or with an InstanceSet"
        )
    outside = np.argwhere((instances.contexts < bounds.low) | (instances.contexts > bounds.high))
    if len(outside):
        row, feature = outside[0]
        raise ConfigError(
            f"ContextVecEnv: instance {instances.ids[row]} has {bounds.names[feature]} = "
            f"{instances.contexts[row, feature]:g}, outside its bounds [{bounds.low[feature]:g}, "
            f"{bounds.high[feature]:g}]"
        )
    return instances


def _contexts(given: ArrayLike, names: Sequence[str]) -> NDArray[np.float64]:
    """(n, d) what was given as rows of numbers."""
    try:
        contexts = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        contexts = None
    if contexts is None or not contexts.ndim:
        what = "None" if given is None else f"of type {type(given).__name__}"
        wanted = "give a CSV file, an InstanceSet, or an array of numbers with one row an instance"
        raise ConfigError(f"ContextVecEnv: instances{_fault_of_row(given, names) or f' is {what}; {wanted}'}")
    contexts = contexts[:, None] if contexts.ndim == 1 and len(names) == 1 else contexts
    if contexts.ndim != 2 or contexts.shape[1] != len(names):
        raise ConfigError(
            f"ContextVecEnv: instances has the shape {contexts.shape}; it needs one row an instance and {len(names)} "
            f"columns, one for each of {', '.join(names)}"
        )
    return contexts


def _fault_of_row(given: object, names: Sequence[str]) -> str | None:
    """What is wrong with the first row that is not its numbers, if there are rows."""
    for number, row in enumerate(given if isinstance(given, list | tuple | np.ndarray) else ()):
        cells = row if isinstance(row, list | tuple | np.ndarray) else [row]
        if isinstance(row, Mapping) or len(cells) != len(names):
            shown = repr(row)[:80]
            return f": row {number} is {shown}; a row is a number for each of {', '.join(names)}, in this order"
        for name, cell in zip(names, cells, strict=True):
            try:
                float(cell)
            except (TypeError, ValueError):
                return f": row {number} has {str(cell)[:80]!r} for {name}, which is no number"
    return None
