"""One slot of a batched environment as a plain Gymnasium environment, for everyone else's tools."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.envs.interface import Closable, DrawsContexts, MakeBatched
from space_dist.envs.observations import each


class SingleEnv(gym.Env[Any, Any]):
    """Contexts come with `reset(options={"context": array})` and stay until another one is given.

    Without any, one is drawn at each reset: by the environment, or uniformly from `context_space`. The first call of
    `reset` without a seed takes one from the operating system, as Gymnasium prescribes.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own declaration

    def __init__(self, make_batched: MakeBatched) -> None:
        self._env = make_batched(1)
        self.observation_space = self._env.observation_space
        self.action_space = self._env.action_space
        bounds = self._env.context_bounds
        self.context_space = spaces.Box(bounds.low, bounds.high, dtype=np.float64)
        self.context_names = bounds.names
        self._context: NDArray[np.float64] | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; `seed` alone decides its noise. Raises ValueError for a context outside its bounds."""
        super().reset(seed=seed)
        if options is not None and "context" in options:
            context = np.array(options["context"], dtype=np.float64)
            if not self.context_space.contains(context):
                raise ValueError(
                    f"context {np.array2string(context, threshold=10)} is not in {self.context_space}: "
                    f"it holds {', '.join(self.context_names)}"
                )
            self._context = context
        context = self._context if self._context is not None else self._draw_context()
        episode = seed if seed is not None else int(self.np_random.integers(1 << 62))
        observations = self._env.reset(
            np.array([0]), context[None, :], np.array([episode], dtype=np.uint64)
        )  # fmt: skip
        return each(_first, observations), {"context": context.copy()}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One step; `info["success"]` where the environment knows success."""
        step = self._env.step(np.asarray(action)[None])
        info = {} if step.success is None else {"success": bool(step.success[0])}
        return (
            each(_first, step.observations),
            float(step.rewards[0]),
            bool(step.terminated[0]),
            bool(step.truncated[0]),
            info,
        )

    def close(self) -> None:
        """Free what the environment holds outside Python, if anything."""
        if isinstance(self._env, Closable):
            self._env.close()

    def _draw_context(self) -> NDArray[np.float64]:
        if isinstance(self._env, DrawsContexts):
            return _first(self._env.draw_contexts(self.np_random, 1))
        bounds = self._env.context_bounds
        return self.np_random.uniform(bounds.low, bounds.high)


def _first(array: NDArray[Any]) -> NDArray[Any]:
    """The only slot's."""
    slot: NDArray[Any] = array[0]
    return slot


class ContextObservation(
    gym.ObservationWrapper[NDArray[np.float32], Any, NDArray[np.float32]], gym.utils.RecordConstructorArgs
):
    """Appends the context, scaled from `context_space` to [-1, 1], to a flat observation."""

    def __init__(self, env: gym.Env[NDArray[np.float32], Any]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.ObservationWrapper.__init__(self, env)
        inner, context = env.observation_space, env.get_wrapper_attr("context_space")
        if not isinstance(inner, spaces.Box) or len(inner.shape) != 1:
            raise TypeError(f"ContextObservation needs a flat Box observation space, not {inner}")
        self._low, self._width = context.low, context.high - context.low
        one = np.ones(context.shape)
        self.observation_space = spaces.Box(
            np.concatenate([inner.low, -one]).astype(np.float32),
            np.concatenate([inner.high, one]).astype(np.float32),
            dtype=np.float32,
        )
        self._scaled = np.zeros(context.shape, dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """As the wrapped environment's, which must report its context in `info["context"]`."""
        observation, info = self.env.reset(seed=seed, options=options)
        scaled = 2.0 * (info["context"] - self._low) / self._width - 1.0
        self._scaled = np.clip(scaled, -1.0, 1.0).astype(np.float32)
        return self.observation(observation), info

    def observation(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """`(obs_dim + d,)`."""
        return np.concatenate([observation.astype(np.float32, copy=False), self._scaled])
