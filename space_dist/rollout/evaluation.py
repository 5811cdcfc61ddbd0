"""Measuring policies: whole episodes of given contexts and seeds, of many policies at once."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from space_dist.envs import BatchedEnv
from space_dist.envs.observations import put, take
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
    """Measure trials of equally many episodes in one batch, all deterministic or none.

    The outcomes of one have the same bits whatever is measured beside it.
    """
    count, slots, n_slots = len(trials[0]), np.arange(env.n_slots), env.n_slots
    acting = batched([trial.policy for trial in trials], count)
    noise = None
    if trials[0].random is not None:
        shape = (env.horizon, count)
        noise = Noise.joined([Noise.draw(trial.policy.head, env.action_space, trial.random(), shape)
                              for trial in trials if trial.random is not None])  # fmt: skip
    contexts = np.concatenate([trial.contexts for trial in trials])
    seeds = np.concatenate([trial.seeds for trial in trials])
    gamma = np.repeat([trial.gamma for trial in trials], count)
    # Copied: what an environment returns may be its own memory.
    observations = take(env.reset(slots, contexts, seeds), slice(None))
    memory = Memory(acting, n_slots)
    alive = np.ones(n_slots, dtype=np.bool_)
    returns, discounted, success = np.zeros(n_slots), np.zeros(n_slots), np.full(n_slots, np.nan)
    lengths, backward = np.zeros(n_slots, dtype=np.int64), np.zeros(n_slots)
    discount, time = np.ones(n_slots), 0
    trained = np.full(n_slots, np.iinfo(np.int64).max)  # behind every warm-up and schedule of exploration
    while alive.any():
        outputs = memory.outputs(observations)
        chosen = acting.head.best(outputs) if noise is None else acting.head.sampled(outputs, noise, time, trained)
        step = env.step(acting.head.executed(chosen))
        # Horner's rule for the released code's metric, sum r_t gamma^(T-1-t).
        backward = np.where(alive, gamma * backward + step.rewards, backward)
        time += 1
        if time == env.horizon and (alive & ~(step.terminated | step.truncated)).any():
            raise endless(env)
        returns += np.where(alive, step.rewards, 0.0)
        discounted += np.where(alive, discount * step.rewards, 0.0)
        lengths += alive
        if step.success is not None:
            success = np.where(alive, step.success, success)
        discount *= gamma
        ended = np.flatnonzero(step.terminated | step.truncated)
        alive[ended] = False
        put(observations, slice(None), step.observations)
        if len(ended) and alive.any():  # every slot must be steppable; what follows in these is not counted
            put(observations, ended, env.reset(ended, contexts[ended], seeds[ended]))
            memory.forget(ended)
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
