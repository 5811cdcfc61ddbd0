"""What our PyBullet environments share: worlds that are loaded once, and slots that borrow them.

A *world* is one PyBullet client with everything loaded. Loading takes some 30 ms and 30 to 40 MB, so a world is made
when a slot is first stepped, is used for all of that slot's episodes, and is shared by several slots where there are
more of them than `MAX_WORLDS`.

An episode must not be able to tell. Bullet keeps more than positions and velocities: contact points with the impulses
that the solver starts from, and the order of overlapping pairs. So the world is saved after loading, and every
episode, the first one included, begins by restoring that. Where slots share a world, its whole state is saved and
restored between their steps. Both give the same bits (`tests/test_bullet.py`).
"""

from __future__ import annotations

import contextlib
import os
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Final, Generic, TypeVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.envs.interface import FloatArray, IntArray, Step
from space_dist.errors import SpaceDistError
from space_dist.instances import ContextBounds
from space_dist.system.extras import needed_from

MAX_WORLDS = 32
"""Worlds of one batched environment, at most. PyBullet itself allows 1,024 clients in a process.

Slots that share one pay 1 to 3 ms a step for changing places.
"""
WORLD_MB: Final = 32
"""About what a world takes of the memory."""

Episode = TypeVar("Episode")


@cache
def pybullet() -> Any:
    """The module; imported by who makes a world, and not by who imports `space_dist.envs`.

    Raises ConfigError where it is not installed.
    """
    with _without_greeting(), needed_from("bullet", "this environment"):
        import pybullet as module
    return module


@contextlib.contextmanager
def _without_greeting() -> Iterator[None]:
    """PyBullet's C code writes its build time to the standard error of every process that imports it."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


@dataclass(frozen=True)
class Camera:
    """target: (x, y, z) in metres.  distance: from it, in metres.  yaw, pitch: in degrees."""

    target: tuple[float, float, float]
    distance: float
    yaw: float
    pitch: float


class World(ABC, Generic[Episode]):
    """One PyBullet client. Subclasses load it, begin episodes in it and act; what an episode needs to remember beside
    Bullet's own state is an `Episode`, which stays with its slot.
    """

    def __init__(self) -> None:
        self.bullet = pybullet()
        self.client: int = self.bullet.connect(self.bullet.DIRECT)
        if self.client < 0:
            raise SpaceDistError("PyBullet gives this process no further physics client; use fewer slots")
        # Also at the interpreter's exit, while PyBullet is still there; never twice.
        self._disconnect = weakref.finalize(self, self.bullet.disconnect, physicsClientId=self.client)
        self.call("setPhysicsEngineParameter", deterministicOverlappingPairs=1)
        self.load()
        self._loaded: int = self.call("saveState")

    def call(self, function: str, *arguments: Any, **named: Any) -> Any:
        """A PyBullet function, on this client."""
        return self.bound(function)(*arguments, **named)

    def bound(self, function: str) -> Callable[..., Any]:
        """A PyBullet function bound to this client, for those that are called at every step."""
        return partial(getattr(self.bullet, function), physicsClientId=self.client)

    @abstractmethod
    def load(self) -> None:
        """Build the scene; called once."""

    @abstractmethod
    def begin(self, context: FloatArray, seed: int) -> tuple[Episode, NDArray[np.float32]]:
        """Start an episode from the restored world: a pure function of the arguments. Returns the first observation."""

    @abstractmethod
    def act(self, episode: Episode, action: FloatArray) -> tuple[NDArray[np.float32], float, bool, bool]:
        """One step, which may change `episode`: (observation, reward, terminated, success)."""

    @abstractmethod
    def camera(self) -> Camera:
        """From where to look at what is happening."""

    def draw(self, width: int, height: int) -> NDArray[np.uint8]:
        """`(height, width, 3)` the scene as it is, by PyBullet's software renderer."""
        camera = self.camera()
        view = self.bullet.computeViewMatrixFromYawPitchRoll(
            camera.target, camera.distance, camera.yaw, camera.pitch, roll=0.0, upAxisIndex=2
        )
        lens = self.bullet.computeProjectionMatrixFOV(fov=60.0, aspect=width / height, nearVal=0.1, farVal=100.0)
        image = self.call("getCameraImage", width, height, view, lens, renderer=self.bullet.ER_TINY_RENDERER)
        return np.reshape(np.asarray(image[2], dtype=np.uint8), (height, width, 4))[:, :, :3].copy()

    def rewind(self) -> None:
        """Back to what was loaded."""
        self.call("restoreState", self._loaded)

    def leave(self) -> int:
        """Save the whole state, for `enter`."""
        state: int = self.call("saveState")
        return state

    def enter(self, state: int) -> None:
        """Go on from a state that was left."""
        self.call("restoreState", state)
        self.forget(state)

    def forget(self, state: int) -> None:
        """Free a state that was left and will not be entered again."""
        self.call("removeState", state)

    def close(self) -> None:
        """Disconnect the client; nothing works afterwards."""
        self._disconnect()


PICTURE: Final = (320, 240)  # pixels


class BatchedBullet(Generic[Episode]):
    """`n_slots` episodes in PyBullet worlds made by `make_world`. Subclasses name spaces, bounds and horizon."""

    observation_space: spaces.Box
    action_space: spaces.Box
    context_bounds: ContextBounds
    knows_success: bool

    def __init__(self, n_slots: int, horizon: int, make_world: Callable[[], World[Episode]]) -> None:
        self.n_slots, self.horizon = n_slots, horizon
        self._make_world = make_world
        self._n_worlds = min(n_slots, MAX_WORLDS)
        self._worlds: dict[int, World[Episode]] = {}
        self._inside: dict[int, int] = {}  # world: the slot whose state it holds
        self._left: dict[int, int] = {}  # slot: its state, saved in its world
        self._episodes: dict[int, Episode] = {}
        self._contexts = np.zeros((n_slots, len(self.context_bounds.names)))
        self._seeds = np.zeros(n_slots, dtype=np.uint64)
        self._time = np.zeros(n_slots, dtype=np.int64)
        pybullet()  # who cannot have a world shall hear it now

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> NDArray[np.float32]:
        """Start new episodes; each from the world as it was loaded."""
        observations = np.empty((len(slots), *self.observation_space.shape), dtype=np.float32)
        self._contexts[slots], self._seeds[slots], self._time[slots] = contexts, seeds, 0
        for row, slot in enumerate(slots.tolist()):
            home = slot % self._n_worlds
            if slot in self._left:
                self._worlds[home].forget(self._left.pop(slot))
            if self._inside.get(home) == slot:
                del self._inside[home]
            # Who only wants start observations needs a single world, whatever the number of slots. An episode begun
            # away from home is begun there again when it is first stepped.
            observations[row] = self._begin(slot, home if home in self._worlds else 0)
        return observations

    def step(self, actions: NDArray[np.generic]) -> Step:
        """Step all slots, one after the other. Raises ValueError unless all actions are finite."""
        chosen = actions.astype(np.float64)  # a copy: nothing an environment does may change the caller's actions
        if not np.isfinite(chosen).all():
            raise ValueError(f"actions must be finite, not {np.array2string(chosen, threshold=10)}")
        np.clip(chosen, self.action_space.low, self.action_space.high, out=chosen)
        observations = np.empty((self.n_slots, *self.observation_space.shape), dtype=np.float32)
        rewards = np.empty(self.n_slots)
        terminated, success = np.zeros((2, self.n_slots), dtype=np.bool_)
        for slot in range(self.n_slots):
            world = self._at_home(slot)
            outcome = world.act(self._episodes[slot], chosen[slot])
            self._time[slot] += 1  # from now on the episode cannot simply be begun again
            observations[slot], rewards[slot], terminated[slot], success[slot] = outcome
        truncated = (self._time >= self.horizon) & ~terminated
        return Step(observations, rewards, terminated, truncated, success if self.knows_success else None)

    def frame(self, slot: int) -> NDArray[np.uint8]:
        """`(240, 320, 3)` what a slot's world looks like now, drawn by PyBullet's software renderer."""
        return self._at_home(slot).draw(*PICTURE)

    def close(self) -> None:
        """Disconnect all worlds. Happens by itself when nobody holds the environment any more."""
        for world in self._worlds.values():
            world.close()
        for kept in (self._worlds, self._inside, self._left, self._episodes):
            kept.clear()

    def _at_home(self, slot: int) -> World[Episode]:
        """The slot's own world, holding the slot's state."""
        home = slot % self._n_worlds
        if self._inside.get(home) != slot:
            if slot in self._left:
                self._vacate(home)
                self._worlds[home].enter(self._left.pop(slot))
                self._inside[home] = slot
            else:
                self._begin(slot, home)
        return self._worlds[home]

    def _begin(self, slot: int, place: int) -> NDArray[np.float32]:
        if place not in self._worlds:
            self._worlds[place] = self._make_world()
        self._vacate(place)
        world = self._worlds[place]
        # Before the first, too: Bullet keeps contact points and the order of overlapping pairs (docs/environments.md).
        world.rewind()
        self._episodes[slot], observation = world.begin(self._contexts[slot], int(self._seeds[slot]))
        if place == slot % self._n_worlds:
            self._inside[place] = slot
        return observation

    def _vacate(self, place: int) -> None:
        """Save the state of the slot inside, unless its episode has not been stepped and can be begun again."""
        slot = self._inside.pop(place, None)
        if slot is not None and self._time[slot] > 0:
            self._left[slot] = self._worlds[place].leave()
