"""Our batched environments as a Stable-Baselines3 vector environment."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from space_dist.envs import BatchedEnv


class BatchedVecEnv(VecEnv):
    """Resets slots by itself, as SB3 wants it, each to one of `contexts` (n, d).

    in_turn: to one after another, from the first at every `reset` (round robin); they are drawn otherwise.
    """

    def __init__(self, env: BatchedEnv, contexts: NDArray[np.float64], *, seed: int, in_turn: bool = False) -> None:
        self._env, self._contexts = env, contexts
        self._in_turn, self._begun = in_turn, 0
        self._random = np.random.default_rng(seed)
        self._actions: NDArray[Any] = np.zeros(0)
        super().__init__(env.n_slots, env.observation_space, env.action_space)

    def reset(self) -> Any:
        """Start all slots anew."""
        self._begun = 0
        self._observations = self._start(np.arange(self.num_envs))
        return self._observations

    def _start(self, slots: NDArray[np.int64]) -> Any:
        if self._in_turn:
            rows = np.arange(self._begun, self._begun + len(slots)) % len(self._contexts)
            self._begun += len(slots)
        else:
            rows = self._random.integers(len(self._contexts), size=len(slots))
        return self._env.reset(
            slots, self._contexts[rows], self._random.integers(1 << 62, size=len(slots), dtype=np.uint64)
        )

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Step all slots; those that end show their next start, and their last observation in `info`."""
        step = self._env.step(self._actions)
        observations: Any = step.observations
        ended = step.terminated | step.truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        slots = np.flatnonzero(ended)
        if len(slots):
            observations = observations.copy()
            for slot in slots:
                infos[slot] = {
                    "terminal_observation": observations[slot].copy(),
                    "TimeLimit.truncated": bool(step.truncated[slot] and not step.terminated[slot]),
                }
            observations[slots] = self._start(slots)
        return observations, step.rewards.astype(np.float32), ended, infos

    def close(self) -> None:
        """Nothing is held."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """SB3 asks for `render_mode`."""
        return [getattr(self._env, attr_name, None) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Slots have no attributes of their own."""
        raise NotImplementedError

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Slots have no methods of their own."""
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:  # noqa: ARG002 - SB3's signature
        """Never."""
        return [False for _ in self._get_indices(indices)]
