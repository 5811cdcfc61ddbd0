"""What is wrong with an environment, in plain words: `space-dist env check`.

An episode must be a pure function of (context, seed, actions). So the same few episodes are played again and again:
in another copy, after other episodes, among neighbours, with other contexts; what should be equal is compared bit by
bit. Faults are looked for in an order in which each can be told from the ones before.
"""

from __future__ import annotations

import contextlib
import functools
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from space_dist.envs import BatchedEnv, BatchedSingles, DrawsContexts, close, distribution_of, make_batched
from space_dist.envs.generating import EnvironmentGenerator, own_method
from space_dist.envs.interface import FloatArray, Step, refuse_actions
from space_dist.envs.observations import Observations
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.instances import InstanceSet
from space_dist.seeding import Purpose, episode_seeds, generator
from space_dist.system.findings import FaultError, Findings

COMPARED_STEPS: Final = 200  # of an episode; horizons are played to their end once
N_CONTEXTS: Final = 8
N_EPISODES: Final = 3  # replayed in every setting
_EDITS: Final = 3  # of each context
_ROUNDED: Final = "precision lowered by casting to float32"  # in a warning of Gymnasium's Box


@dataclass
class EnvironmentFindings(Findings):
    """Also what the environment is. horizon: in steps.  names: of the context's features."""

    horizon: int = 0
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Moment:
    """One slot at a reset or behind a step, as bytes: equal if and only if bit by bit equal."""

    observation: bytes
    reward: bytes = b""
    ended: tuple[bool, bool] = (False, False)


_Episode = tuple[_Moment, ...]


def check(
    env_id: str, kwargs: Mapping[str, Any] = MappingProxyType({}), instances: InstanceSet | None = None
) -> EnvironmentFindings:
    """Look for every fault that a run would suffer from.

    Contexts are drawn uniformly within their bounds (by the environment, if it draws its own), the corners of the
    bounds included; or are the first of `instances`. All is seeded. Raises ConfigError for a single instance.
    """
    if instances is not None and len(instances) < 2:
        raise ConfigError("it takes at least two instances to see whether contexts matter")
    findings = EnvironmentFindings()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            _Check(env_id, kwargs, instances, findings).run()
        except FaultError as fault:
            findings.faults.append(str(fault))
    # Every copy of the environment warns again, and the check makes dozens.
    distinct = {(warning.category, str(warning.message)): warning for warning in told}
    if any(_ROUNDED in text for _, text in distinct):
        findings.notes.append(
            "bounds of a space are given in float64 and rounded to its float32; give them as float32, and Gymnasium "
            "does not warn of it"
        )
    for warning in distinct.values():
        if _ROUNDED not in str(warning.message):
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    return findings


class _Check:
    def __init__(
        self, env_id: str, kwargs: Mapping[str, Any], instances: InstanceSet | None, findings: EnvironmentFindings
    ) -> None:
        self._env_id, self._kwargs, self._findings = env_id, kwargs, findings
        with self._opened(1) as env:
            self._horizon = findings.horizon = env.horizon
            self._bounds = env.context_bounds
            findings.names = self._bounds.names
            # Uniformly: features vary one by one.
            self._drawn = instances is None and not isinstance(env, DrawsContexts)
            self._contexts = self._draw() if instances is None else _cycled(instances.contexts, N_CONTEXTS)
            self._seeds = episode_seeds(0, Purpose.EPISODES, count=N_CONTEXTS)
            try:
                refuse_actions(env.action_space)
            except ConfigError as error:
                raise FaultError(str(error).removeprefix("env.id: ")) from None
            self._actions = _sampled_actions(env.action_space, N_CONTEXTS + 1, COMPARED_STEPS)

    def run(self) -> None:
        with self._single() as single:
            if single is not None:
                self._check_single_spaces(single)
        self._check_spaces_and_ends()
        reference = self._check_repeated()
        self._check_earlier_episodes(reference)
        self._check_neighbours(reference)
        self._check_contexts()
        self._check_edits()
        with self._single() as single:
            if single is not None:
                self._check_context_survives(single)
                self._ask_gymnasium()

    # ---- the checks ----

    def _check_single_spaces(self, env: gym.Env[Any, Any]) -> None:
        """What a single environment returns itself: made a batch of, it would be converted."""
        given = self._contexts[0].astype(env.get_wrapper_attr("context_space").dtype)
        told = _called("reset()", lambda: env.reset(seed=int(self._seeds[0]), options={"context": given}))
        if not isinstance(told, tuple) or len(told) != 2:
            raise FaultError("reset() must return (observation, info)")
        self._refuse_misfits(env.observation_space, _as_batch(told[0]), 1, "reset")
        for time in range(min(COMPARED_STEPS, self._horizon)):
            action = _scalar(self._actions[0, time])
            before = np.array(action)
            told = _called("step()", functools.partial(env.step, action))
            if not np.array_equal(before, action):
                raise FaultError("step() changes the action it is given, which is the learner's; copy it first")
            if not isinstance(told, tuple) or len(told) != 5:
                raise FaultError("step() must return (observation, reward, terminated, truncated, info)")
            self._refuse_misfits(env.observation_space, _as_batch(told[0]), 1, f"step {time + 1}")
            if np.ndim(told[2]) or np.ndim(told[3]):
                raise FaultError("step() must return terminated and truncated as a truth value each, not as arrays")
            if told[2] or told[3]:
                break

    def _check_spaces_and_ends(self) -> None:
        """Whole episodes in all contexts at once: what comes back fits its space, and ends in time."""
        n = N_CONTEXTS
        with self._opened(n) as env:
            current = self._reset(env, np.arange(n), self._contexts, self._seeds)
            self._refuse_misfits(env.observation_space, current, n, "reset")
            alive = np.ones(n, dtype=np.bool_)
            for time in range(self._horizon):
                # Again and again the same, beyond those that are drawn: a horizon may be any number.
                step = self._step(env, self._actions[:n, time % COMPARED_STEPS])
                self._refuse_misfits(env.observation_space, step.observations, n, f"step {time + 1}")
                self._refuse_step(step, n, time + 1)
                alive &= ~(step.terminated | step.truncated)
                if not alive.any():
                    return
                if len(ended := np.flatnonzero(step.terminated | step.truncated)):
                    self._reset(env, ended, self._contexts[ended], self._seeds[ended])
        raise FaultError(
            f"episodes do not end: after its horizon of {self._horizon} steps neither terminated nor truncated was set"
        )

    def _check_repeated(self) -> list[_Episode]:
        """The same episodes in two new copies."""
        first, second = ([self._alone(k) for k in range(N_EPISODES)] for _ in range(2))
        for one, other in zip(first, second, strict=True):
            if one[0] != other[0]:
                raise FaultError(
                    "the start state is not seeded: with the same seed and context, two episodes start differently. "
                    "Draw it from the seed given to reset() (self.np_random after super().reset(seed=seed)) alone"
                )
            if one != other:
                raise FaultError(
                    f"there is unseeded randomness in step(): with the same seed, context and actions, two episodes "
                    f"differ from step {_first_difference(one, other)} on. Draw it from the seed given to reset() alone"
                )
        return first

    def _check_earlier_episodes(self, reference: Sequence[_Episode]) -> None:
        """The same episodes one after another in one copy, and one broken off."""
        with self._opened(1) as env:
            self._play(env, [N_EPISODES], steps=2)
            for k in [*range(N_EPISODES), 0]:
                found = self._play(env, [k])[0]
                if found == reference[k]:
                    continue
                if found == self._alone(k, context=N_EPISODES):
                    raise FaultError(
                        "a context does not arrive: only that of the very first reset counts, later ones are ignored"
                    )
                where = _first_difference(found, reference[k])
                what = "it starts differently" if where == 0 else f"it differs from step {where} on"
                raise FaultError(
                    "the trajectory depends on earlier episodes: played again after others, with the same seed, "
                    f"context and actions, {what}. reset() must put back everything that an episode changes"
                )

    def _check_neighbours(self, reference: Sequence[_Episode]) -> None:
        """The same episodes among others that run beside them, in other slots."""
        for order in ([0, 3, 1, 4, 2], [5, 2, 1, 6, 0, 7]):
            with self._opened(len(order)) as env:
                for k, found in zip(order, self._play(env, order), strict=True):
                    if k < N_EPISODES and found != reference[k]:
                        raise FaultError(
                            "the trajectory depends on the neighbours in the batch: beside other episodes, with the "
                            "same seed, context and actions, it is another one. Copies must share nothing that changes "
                            "(class attributes, module globals, global random generators)"
                        )

    def _check_contexts(self) -> None:
        """The same seed and actions in other contexts."""
        base = self._alone(0)
        told = [self._alone(0, context=k) for k in range(1, N_CONTEXTS)]
        if all(one == base for one in told):
            raise FaultError(
                "contexts are ignored: another context changes nothing, neither the start nor a later observation, "
                "reward or end"
            )
        if len(self._bounds.names) == 1 or not self._drawn:
            return
        for column, name in enumerate(self._bounds.names):
            lowest, highest = (self._contexts[0].copy() for _ in range(2))
            lowest[column], highest[column] = self._bounds.low[column], self._bounds.high[column]
            if self._alone(0, values=lowest) == self._alone(0, values=highest):
                self._findings.notes.append(
                    f"changing {name!r} alone, from {lowest[column]:g} to {highest[column]:g}, changed nothing in an "
                    "episode of random actions; see whether it is used at all"
                )

    def _check_edits(self) -> None:
        """Contexts that the environment makes of others: the same whenever it is asked, and such as it can play."""
        with self._opened(1) as env:
            if own_method(env, "edit_contexts") is None:
                return
        source = EnvironmentGenerator(self._opened, "the environment")

        def edited() -> FloatArray:
            return source.edit(generator(0, Purpose.GENERATION), self._contexts, _EDITS)

        found = _called("edit_contexts()", edited)
        if found.tobytes() != _called("edit_contexts()", edited).tobytes():
            raise FaultError(
                "edit_contexts() is not a function of its arguments: with the same generator and contexts it gave "
                "others. Draw random numbers from the generator that it is given alone"
            )
        with self._opened(len(found)) as env:
            self._reset(env, np.arange(len(found)), found, self._seeds[: len(found)])
        if np.array_equal(found, self._contexts):
            self._findings.notes.append(
                f"edit_contexts() changed nothing in {len(found)} contexts, {_EDITS} times each"
            )

    def _ask_gymnasium(self) -> None:
        """Gymnasium's own checker, on a copy that nothing was done to."""
        with self._single() as env, warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            try:
                check_env(env, skip_render_check=True, skip_close_check=True)  # type: ignore[arg-type]
            except (Exception, SystemExit) as error:  # it asserts, and runs somebody else's code
                text = " ".join(str(error).split()) or type(error).__name__
                raise FaultError(f"Gymnasium's own checker refuses it: {text[:300]}") from None
        for warning in told:
            text = " ".join(str(warning.message).replace("\x1b[33m", "").replace("\x1b[0m", "").split())
            if "WARN" in text and "different from the unwrapped version" not in text:
                self._findings.notes.append(f"Gymnasium's own checker: {text.partition('WARN:')[2].strip()[:300]}")

    def _check_context_survives(self, env: gym.Env[Any, Any]) -> None:
        """A reset without a context must keep the last one: wrappers that reset by themselves give none."""
        context = self._contexts[1].astype(env.get_wrapper_attr("context_space").dtype)
        seed, actions = int(self._seeds[1]), self._actions[1][:COMPARED_STEPS]

        def told(options: dict[str, Any] | None) -> list[bytes]:
            observation, _ = env.reset(seed=seed, options=options)
            moments = [_bytes(observation)]
            for action in actions:
                observation, reward, terminated, truncated, _ = env.step(_scalar(action))
                moments.append(_bytes(observation) + np.float64(reward).tobytes())
                if terminated or truncated:
                    break
            return moments

        _called("reset() before any context was given (there must be a default one)", lambda: env.reset(seed=seed))
        given = told({"context": context})
        kept = _called("reset() without a context (it must keep the last one)", lambda: told(None))
        if kept != given:
            raise FaultError(
                "the context does not survive: after a reset without options it is another one. Keep the last context "
                "given until a new one comes"
            )

    # ---- playing ----

    def _alone(self, k: int, *, context: int | None = None, values: FloatArray | None = None) -> _Episode:
        """Episode k in a copy of its own, if need be in another context."""
        with self._opened(1) as env:
            return self._play(env, [k], context=context, values=values)[0]

    def _play(
        self, env: BatchedEnv, episodes: Sequence[int], *,
        context: int | None = None, values: FloatArray | None = None, steps: int = COMPARED_STEPS,
    ) -> list[_Episode]:  # fmt: skip
        """Episode k of each slot, to its end or `steps`; slots that have ended begin again, unseen."""
        chosen = np.array(episodes)
        contexts = self._contexts[chosen if context is None else np.full(len(chosen), context)]
        if values is not None:
            contexts = values[None]
        slots = np.arange(len(chosen))
        started = self._reset(env, slots, contexts, self._seeds[chosen])
        told = [[_Moment(_bytes(_row(started, slot)))] for slot in slots]
        alive = np.ones(len(chosen), dtype=np.bool_)
        for time in range(min(steps, self._horizon)):
            step = self._step(env, self._actions[chosen, time])
            for slot in np.flatnonzero(alive):
                told[slot].append(
                    _Moment(
                        _bytes(_row(step.observations, slot)),
                        np.float64(step.rewards[slot]).tobytes(),
                        (bool(step.terminated[slot]), bool(step.truncated[slot])),
                    )
                )
            ended = np.flatnonzero(step.terminated | step.truncated)
            alive[ended] = False
            if not alive.any():
                break
            if len(ended):
                self._reset(env, ended, contexts[ended], self._seeds[chosen][ended])
        return [tuple(one) for one in told]

    @contextlib.contextmanager
    def _opened(self, n_slots: int) -> Iterator[BatchedEnv]:
        """Another copy, closed behind the context."""
        try:
            env = make_batched(self._env_id, n_slots, context_visible=False, kwargs=self._kwargs)
        except ConfigError as error:
            raise FaultError(str(error)) from None
        try:
            yield env
        finally:
            close(env)

    @contextlib.contextmanager
    def _single(self) -> Iterator[gym.Env[Any, Any] | None]:
        """Another copy of a single environment."""
        with self._opened(1) as env:
            yield env.first if isinstance(env, BatchedSingles) else None

    def _reset(
        self, env: BatchedEnv, slots: NDArray[np.int64], contexts: FloatArray, seeds: NDArray[np.uint64]
    ) -> Observations:
        given = contexts.copy()
        what = f"reset() with {self._named(contexts)}"
        observations: Observations = _called(what, lambda: env.reset(slots, given, seeds.copy()))
        if not np.array_equal(given, contexts):
            raise FaultError("reset() changes the contexts it is given; copy them first")
        return observations

    def _step(self, env: BatchedEnv, actions: NDArray[Any]) -> Step:
        given = actions.copy()
        step: Step = _called("step()", lambda: env.step(given))
        if not np.array_equal(given, actions):
            raise FaultError("step() changes the actions it is given, which are the learner's; copy them first")
        return step

    def _named(self, contexts: FloatArray) -> str:
        shown = ", ".join(f"{name} {value:g}" for name, value in zip(self._bounds.names, contexts[0], strict=True))
        more = f" (or one of the {len(contexts) - 1} others)" if len(contexts) > 1 else ""
        return f"the context {shown[:200]}{more}"

    def _draw(self) -> FloatArray:
        drawn = distribution_of(self._env_id, self._kwargs).draw(generator(0, Purpose.INSTANCES), N_CONTEXTS)
        if self._drawn:
            # Both ends of the bounds as well, which draws hardly ever come near.
            drawn[-2:] = self._bounds.low, self._bounds.high
        return drawn

    # ---- what came back ----

    def _refuse_misfits(self, space: spaces.Space[Any], observations: Observations, n: int, where: str) -> None:
        parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
        found = observations if isinstance(observations, dict) else {"": observations}
        if set(parts) != set(found):
            raise FaultError(
                f"the observation at {where} has the parts {', '.join(sorted(found)) or 'none'}, its space has "
                f"{', '.join(sorted(parts)) or 'none'}"
            )
        for name, part in parts.items():
            _refuse_array(found[name], part, n, f"the observation{f' {name!r}' if name else ''} at {where}")

    def _refuse_step(self, step: Step, n: int, time: int) -> None:
        for name in ("rewards", "terminated", "truncated", "success"):
            array = getattr(step, name)
            if name == "success" and array is None:
                continue
            if np.shape(array) != (n,):
                raise FaultError(f"{name} at step {time} have shape {np.shape(array)}, not one number for each slot")
            if name != "rewards" and np.asarray(array).dtype != np.bool_:
                raise FaultError(f"{name} at step {time} is of dtype {np.asarray(array).dtype}, not bool")
        if not np.isfinite(step.rewards).all():
            bad = step.rewards[~np.isfinite(step.rewards)][0]
            raise FaultError(f"a reward at step {time} is {bad}: rewards must be finite numbers")


def _refuse_array(array: Any, space: Any, n: int, what: str) -> None:
    if not isinstance(array, np.ndarray):
        raise FaultError(f"{what} is a {type(array).__name__}, not an array")
    if array.shape != (n, *space.shape):
        raise FaultError(f"spaces are wrong: {what} has shape {array.shape[1:]}, its space says {space.shape}")
    if array.dtype != space.dtype:
        raise FaultError(f"spaces are wrong: {what} is of dtype {array.dtype}, its space says {space.dtype}")
    if np.isnan(array).any():
        raise FaultError(f"{what} holds NaN")
    outside = (array < space.low) | (array > space.high)
    if outside.any():
        index = tuple(int(one) for one in np.argwhere(outside)[0])
        place = index[1:]
        raise FaultError(
            f"spaces are wrong: {what} holds {array[index]:g} at {list(place)}, outside its space's bounds "
            f"[{space.low[place]:g}, {space.high[place]:g}]"
        )


def _sampled_actions(space: spaces.Space[Any], episodes: int, steps: int) -> NDArray[Any]:
    """`(episodes, steps, ...)`, seeded."""
    space.seed(int(episode_seeds(0, Purpose.ACTIONS, count=1)[0] % (1 << 32)))
    drawn = np.array([space.sample() for _ in range(episodes * steps)])
    return drawn.reshape(episodes, steps, *drawn.shape[1:])


def _cycled(contexts: FloatArray, n: int) -> FloatArray:
    return contexts[np.arange(n) % len(contexts)]


def _first_difference(one: _Episode, other: _Episode) -> int:
    """The step, counted from 1, behind which two episodes first differ; 0: their start."""
    return next((index for index, pair in enumerate(zip(one, other, strict=False)) if pair[0] != pair[1]),
                min(len(one), len(other)))  # fmt: skip


def _row(observations: Observations, slot: Any) -> Any:
    if isinstance(observations, dict):
        return {name: array[slot] for name, array in observations.items()}
    return observations[slot]


def _bytes(observation: Any) -> bytes:
    if isinstance(observation, dict):
        return b"".join(_bytes(observation[name]) for name in sorted(observation))
    return np.ascontiguousarray(observation).tobytes()


def _scalar(action: NDArray[Any]) -> Any:
    return int(action) if action.ndim == 0 else action.copy()


def _as_batch(observation: Any) -> Any:
    """A single observation as a batch of one; what is no array stays what it is."""
    if isinstance(observation, dict):
        return {name: _as_batch(part) for name, part in observation.items()}
    return observation[None] if isinstance(observation, np.ndarray) else observation


def _called(what: str, call: Callable[[], Any]) -> Any:
    try:
        return call()
    except (Exception, SystemExit) as error:  # somebody else's code may raise anything
        text = str(error) if isinstance(error, SpaceDistError) else f"{type(error).__name__}: {error}"
        raise FaultError(f"{what} fails: {text[:300]}") from None
