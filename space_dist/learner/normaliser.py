"""Running scales of observations and rewards. They change between rounds only, and travel with the weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.envs import Observations
from space_dist.rollout import Shard
from space_dist.rollout.policy import Statistics

REWARD_CLIP = 10.0  # of normalised rewards; SB3's VecNormalize
FloatArray = NDArray[np.float64]
_ROUNDING = 1e-9  # share of a mean below which a deviation is an error of summation


@dataclass
class _Moments:
    """Count, mean and sum of squared deviations, merged as in Chan et al. (1979)."""

    count: float
    mean: FloatArray
    squares: FloatArray

    @classmethod
    def empty(cls, *shape: int) -> _Moments:
        return cls(0.0, np.zeros(shape), np.zeros(shape))

    def merge(self, values: FloatArray) -> None:
        """Take in `(n, ...)` values."""
        count, mean = float(len(values)), values.mean(axis=0)
        squares = ((values - mean) ** 2).sum(axis=0)
        total, delta = self.count + count, mean - self.mean
        self.mean = self.mean + delta * (count / total)
        self.squares = self.squares + squares + delta**2 * (self.count * count / total)
        self.count = total

    @property
    def std(self) -> FloatArray:
        """Standard deviations; 1 where nothing varies but the last bits. Nothing is added: scaling leaves no trace."""
        variance = self.squares / max(self.count, 1.0)
        varies = variance > (_ROUNDING * self.mean) ** 2
        return np.where(varies, np.sqrt(np.where(varies, variance, 1.0)), 1.0)


class Normaliser:
    """As SB3's VecNormalize, except that its statistics stand still within a round.

    Observations: minus their mean, by their standard deviation. Rewards: by the standard deviation of the discounted
    return, which starts anew with each episode and goes on with it from round to round.
    """

    def __init__(self, observation_space: spaces.Space[Any], gamma: float, observations: bool, rewards: bool) -> None:
        self._gamma, self._observations, self._rewards = gamma, observations, rewards
        self._seen = _Moments.empty(*(observation_space.shape or ()))
        self._returns = _Moments.empty()
        self._running: FloatArray = np.zeros(0)  # (slots of all shards,) discounted returns behind the last round

    @property
    def statistics(self) -> Statistics:
        """The scales as of now."""
        std = float(self._returns.std) if self._rewards else 1.0
        if not self._observations:
            return Statistics(reward_std=std)
        return Statistics(self._seen.mean.copy(), self._seen.std, std)

    def update(self, shards: Sequence[Shard]) -> None:
        """Take in a round, in shard order."""
        running: list[FloatArray] = []
        known = self._running
        for shard in shards:
            if self._observations and not isinstance(shard.observations, dict):
                self._seen.merge(shard.observations.reshape(-1, shard.observations.shape[-1]).astype(np.float64))
            if self._rewards:
                slots = len(shard.starts)
                before = known[:slots] if len(known) else np.zeros(slots)
                sums, after = _discounted(shard, self._gamma, before)
                self._returns.merge(sums)
                known, running = known[slots:], [*running, after]
        if running:
            self._running = np.concatenate(running)

    def save(self) -> dict[str, NDArray[Any]]:
        """Arrays from which `load` restores everything."""
        moments = {"observations": self._seen, "returns": self._returns}
        arrays = {
            f"{name}_{part}": np.asarray(getattr(one, part))
            for name, one in moments.items()
            for part in ("count", "mean", "squares")
        }
        return {**arrays, "running": self._running}

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Restore what `save` gave."""
        for name, one in {"observations": self._seen, "returns": self._returns}.items():
            one.count = float(arrays[f"{name}_count"])
            one.mean, one.squares = arrays[f"{name}_mean"].copy(), arrays[f"{name}_squares"].copy()
        self._running = arrays["running"].copy()

    def normalize_obs(self, observations: Observations) -> Observations:
        """What SB3's replay buffer calls when it samples; dictionaries come back as they are."""
        return self.statistics.scaled(observations)

    def normalize_reward(self, rewards: NDArray[Any]) -> NDArray[np.float32]:
        """What SB3's replay buffer calls when it samples, and `fill` for rollouts."""
        scaled = rewards.astype(np.float64) / self.statistics.reward_std
        return (np.clip(scaled, -REWARD_CLIP, REWARD_CLIP) if self._rewards else scaled).astype(np.float32)


def _discounted(shard: Shard, gamma: float, before: FloatArray) -> tuple[FloatArray, FloatArray]:
    """`(length * slots,)` sum of gamma^(t-k) r_k up to each step t of its episode; (slots,) the last where one goes on.

    before: (slots,) what the last round ended with.
    """
    running = np.where(shard.starts, 0.0, before)
    sums = np.empty_like(shard.rewards)
    for time, rewards in enumerate(shard.rewards):
        running = running * gamma + rewards
        sums[time] = running
        running = np.where(shard.terminated[time] | shard.truncated[time], 0.0, running)
    return sums.reshape(-1), running
