"""An environment that must be learnt in seconds: move along a line to a target, which only the context tells.

`tests.tiny_env:make` (continuous actions) and `tests.tiny_env:make_discrete` are its import paths for a config;
`make_scaled`, `make_image` and `make_dict` show the same line in other units, as pictures and in parts.
"""

from __future__ import annotations

import dataclasses
import os
import uuid
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.envs.interface import FloatArray, IntArray, Observations, Step
from space_dist.instances import ContextBounds

HORIZON = 8
STRIDE = 0.25  # how far a full action moves
START = 0.1  # starts are uniform in [-START, START]
SUCCESS_DISTANCE = 0.1
PIXELS = 36  # the least that SB3's convolutions take


class Line:
    """Position x in [-1, 1], reward 1 - |x - target|. Whoever stands still earns 1 - |target| a step."""

    def __init__(self, n_slots: int, action_space: spaces.Space[Any]) -> None:
        self.n_slots, self.horizon = n_slots, HORIZON
        self.observation_space = spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32)
        self.action_space = action_space
        self.context_bounds = ContextBounds(("target",), np.array([-1.0]), np.array([1.0]))
        self._x, self._target = np.zeros(n_slots), np.zeros(n_slots)
        self._time = np.zeros(n_slots, dtype=np.int64)

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> Observations:
        self._x[slots] = [np.random.default_rng(int(seed)).uniform(-START, START) for seed in seeds]
        self._target[slots], self._time[slots] = contexts[:, 0], 0
        return self._x[slots, None].astype(np.float32)

    def step(self, actions: NDArray[np.generic]) -> Step:
        if isinstance(self.action_space, spaces.Discrete):
            move = actions.astype(np.float64) - 1.0  # left, stay, right
        else:
            move = np.clip(actions[:, 0].astype(np.float64), -1.0, 1.0)
        self._x = np.clip(self._x + STRIDE * move, -1.0, 1.0)
        self._time += 1
        distance = np.abs(self._x - self._target)
        return Step(
            observations=self._x[:, None].astype(np.float32),
            rewards=1.0 - distance,
            terminated=np.zeros(self.n_slots, dtype=np.bool_),
            truncated=self._time >= HORIZON,
            success=distance < SUCCESS_DISTANCE,
        )


def make(n_slots: int) -> Line:
    return Line(n_slots, spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32))


def make_discrete(n_slots: int) -> Line:
    return Line(n_slots, spaces.Discrete(3))


class Glimpsed(Line):
    """The line, whose target is observed in an episode's first step alone; behind the position, and 0 from then on."""

    def __init__(self, n_slots: int) -> None:
        super().__init__(n_slots, spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32))
        self.observation_space = spaces.Box(-1.0, 1.0, shape=(2,), dtype=np.float32)

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> Observations:
        position = np.asarray(super().reset(slots, contexts, seeds))
        return np.concatenate([position, self._target[slots, None].astype(np.float32)], axis=1)

    def step(self, actions: NDArray[np.generic]) -> Step:
        step = super().step(actions)
        position = np.asarray(step.observations)
        return dataclasses.replace(step, observations=np.concatenate([position, np.zeros_like(position)], axis=1))


def make_glimpsed(n_slots: int) -> Glimpsed:
    return Glimpsed(n_slots)


class Noting(Line):
    """The line, of which a file in `folder` tells that it is open, and another one that it is closed."""

    def __init__(self, n_slots: int, folder: str) -> None:
        super().__init__(n_slots, spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32))
        self._folder, self._name = Path(folder), f"{os.getpid()}-{uuid.uuid4().hex}"
        (self._folder / f"{self._name}.open").touch()

    def close(self) -> None:
        (self._folder / f"{self._name}.open").rename(self._folder / f"{self._name}.closed")


def make_noting(n_slots: int, folder: str) -> Noting:
    return Noting(n_slots, folder)


class Scaled(Line):
    """The line in other units: rewards and observations times a number each; contexts stay as they are."""

    def __init__(self, n_slots: int, rewards: float, observations: float) -> None:
        super().__init__(n_slots, spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32))
        self.observation_space = spaces.Box(-observations, observations, shape=(1,), dtype=np.float32)
        self._rewards, self._observations = rewards, np.float32(observations)

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> Observations:
        return super().reset(slots, contexts, seeds) * self._observations

    def step(self, actions: NDArray[np.generic]) -> Step:
        step = super().step(actions)
        return dataclasses.replace(
            step, observations=step.observations * self._observations, rewards=step.rewards * self._rewards
        )


def make_scaled(n_slots: int, rewards: float = 1.0, observations: float = 1.0) -> Scaled:
    return Scaled(n_slots, rewards, observations)


class Shown(Line):
    """The line as `observe(x, target)` shows it; episodes last 4 steps."""

    def __init__(self, n_slots: int, discrete: bool) -> None:
        super().__init__(n_slots, spaces.Discrete(3) if discrete else spaces.Box(-1.0, 1.0, shape=(1,)))
        self.horizon = 4

    def observe(self, x: FloatArray, target: FloatArray) -> Observations:
        raise NotImplementedError

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> Observations:
        super().reset(slots, contexts, seeds)
        return self.observe(self._x[slots], self._target[slots])

    def step(self, actions: NDArray[np.generic]) -> Step:
        step = super().step(actions)
        shown = self.observe(self._x, self._target)
        return dataclasses.replace(step, observations=shown, truncated=self._time >= self.horizon)


class Image(Shown):
    """A picture: the target is a bright column, the position one half as bright."""

    def __init__(self, n_slots: int, discrete: bool) -> None:
        super().__init__(n_slots, discrete)
        self.observation_space = spaces.Box(0, 255, shape=(1, PIXELS, PIXELS), dtype=np.uint8)

    def observe(self, x: FloatArray, target: FloatArray) -> Observations:
        pictures = np.zeros((len(x), 1, PIXELS, PIXELS), dtype=np.uint8)
        for places, brightness in ((x, 127), (target, 255)):
            columns = np.round((places + 1.0) / 2.0 * (PIXELS - 1)).astype(np.int64)
            pictures[np.arange(len(x)), 0, :, columns] = brightness
        return pictures


def make_image(n_slots: int, discrete: bool = True) -> Image:
    return Image(n_slots, discrete)


class Parts(Shown):
    """A dictionary: the position, and the way to the target with its sign."""

    def __init__(self, n_slots: int, discrete: bool) -> None:
        super().__init__(n_slots, discrete)
        self.observation_space = spaces.Dict(
            {
                "position": spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32),
                "way": spaces.Box(-2.0, 2.0, shape=(2,), dtype=np.float32),
            }
        )

    def observe(self, x: FloatArray, target: FloatArray) -> Observations:
        way = target - x
        return {
            "position": x[:, None].astype(np.float32),
            "way": np.stack([way, np.sign(way)], axis=1).astype(np.float32),
        }


def make_dict(n_slots: int, discrete: bool = False) -> Parts:
    return Parts(n_slots, discrete)
