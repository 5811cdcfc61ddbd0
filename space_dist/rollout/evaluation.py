"""Measuring policies: whole episodes of given contexts and seeds, of many policies at once."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from space_dist.envs import BatchedEnv
from space_dist.envs.observations import allocate, each, put
from space_dist.rollout.collecting import endless
from space_dist.rollout.memory import Memory
from space_dist.rollout.policy import Noise, Policy, batched
from space_dist.rollout.walk import FloatArray, IntArray


@dataclass(frozen=True)
class Outcomes:
    """Evaluation episodes, one entry per instance and episode, instances in id order.

    returns, discounted_returns (n,) in reward units; lengths (n,) in steps; success (n,) as in `Episodes`.
    backward_discounted_returns: (n,) sum of r_t gamma^(T-1-t), the released SPaCE code's metric.
    """

    policy_version: int
    returns: FloatArray
    discounted_returns: FloatArray
    lengths: IntArray
    success: FloatArray
    backward_discounted_returns: FloatArray

    @classmethod
    def none(cls, policy_version: int) -> Outcomes:
        """Of no episodes."""
        nothing = np.zeros(0)
        return cls(policy_version, nothing, nothing, nothing.astype(np.int64), nothing, nothing)


@dataclass(frozen=True)
class Trial:
    """Episodes to be measured, one per row of `contexts` (k, d), with `seeds` (k,).

    Deterministic ones, unless there is a `random` generator, made anew each time, to act with.
    """

    policy: Policy
    contexts: FloatArray
    seeds: NDArray[np.uint64]
    gamma: float
    random: Callable[[], np.random.Generator] | None = None

    def __len__(self) -> int:
        return len(self.seeds)


def evaluate(env: BatchedEnv, trials: Sequence[Trial]) -> list[Outcomes]:
    """Measure trials of equally many episodes, all deterministic or none, in slots for all of them or for fewer.

    Where there are fewer slots, the next episode begins where one has ended. The outcomes of a trial have the same bits
    in any number of slots, whatever is measured beside it.
    """
    count, n_slots = len(trials[0]), env.n_slots
    acting = batched([trial.policy for trial in trials], count)
    contexts = np.concatenate([trial.contexts for trial in trials])
    seeds = np.concatenate([trial.seeds for trial in trials])
    gamma = np.repeat([trial.gamma for trial in trials], count)
    noise = None
    if trials[0].random is not None:
        shape = (env.horizon, count)
        noise = Noise.joined([Noise.draw(trial.policy.head, env.action_space, trial.random(), shape)
                              for trial in trials if trial.random is not None])  # fmt: skip
    # By episode from here on, the actions of all of them included: a row is rounded by its place among the others.
    n = len(seeds)
    playing, waiting = np.arange(n_slots), n_slots  # the episode in each slot, and the next to begin
    rows: Any = slice(None) if n_slots == n else playing  # the same; a view is sooner had than a copy

    def by_episode(told: NDArray[Any]) -> NDArray[Any]:
        """What every slot told, where its episode is; zeros where none has told anything."""
        if n_slots == n:
            return told
        spread = np.zeros(n, dtype=told.dtype)
        spread[rows] = told
        return spread

    observations = each(np.zeros_like, allocate(env.observation_space, n))
    put(observations, rows, env.reset(np.arange(n_slots), contexts[rows], seeds[rows]))
    memory = Memory(acting, n)
    alive = np.arange(n) < n_slots
    returns, discounted, success = np.zeros(n), np.zeros(n), np.full(n, np.nan)
    lengths, backward = np.zeros(n, dtype=np.int64), np.zeros(n)
    discount, time = np.ones(n), 0
    trained = np.full(n, np.iinfo(np.int64).max)  # behind every warm-up and schedule of exploration
    while alive.any():
        outputs = memory.outputs(observations)
        chosen = (acting.head.best(outputs) if noise is None
                  else acting.head.sampled(outputs, noise.at(lengths), 0, trained))  # fmt: skip
        step = env.step(acting.head.executed(chosen)[rows])
        rewards, over = by_episode(step.rewards), step.terminated | step.truncated
        # Horner's rule for the released code's metric, sum r_t gamma^(T-1-t).
        backward = np.where(alive, gamma * backward + rewards, backward)
        returns += np.where(alive, rewards, 0.0)
        discounted += np.where(alive, discount * rewards, 0.0)
        discount *= gamma
        lengths += alive
        if step.success is not None:
            success = np.where(alive, by_episode(step.success), success)
        time += 1
        if time >= env.horizon and (alive & ~by_episode(over) & (lengths >= env.horizon)).any():
            raise endless(env)
        put(observations, rows, step.observations)
        if over.any():
            free = np.flatnonzero(over & alive[rows])
            alive[playing[free]] = False
            begun = free[: n - waiting]
            playing[begun] = np.arange(waiting, waiting + len(begun))
            waiting += len(begun)
            alive[playing[begun]], discount[playing[begun]] = True, 1.0
            if alive.any():  # every slot must be steppable; what follows where none begins is not counted
                slots = np.flatnonzero(over)
                put(observations, playing[slots], env.reset(slots, contexts[playing[slots]], seeds[playing[slots]]))
                memory.forget(playing[slots])
    return [
        Outcomes(trial.policy.version, returns[mine], discounted[mine], lengths[mine], success[mine], backward[mine])
        for index, trial in enumerate(trials)
        for mine in [slice(index * count, (index + 1) * count)]
    ]


def joined(parts: list[Outcomes]) -> Outcomes:
    """The parts of one split's evaluation as one, in order."""
    fields = [field.name for field in dataclasses.fields(Outcomes) if field.name != "policy_version"]
    return Outcomes(parts[0].policy_version, **{name: np.concatenate([getattr(part, name) for part in parts])
                                                 for name in fields})  # fmt: skip
