"""A run's policy, to act with: NumPy in, NumPy out, with the method that Stable-Baselines3's policies have."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from space_dist.api.arguments import as_count, as_path
from space_dist.envs import Observations
from space_dist.envs.observations import rows
from space_dist.envs.spec import EnvironmentSpec
from space_dist.errors import ConfigError
from space_dist.ledger import Ledger
from space_dist.rollout.memory import Memory
from space_dist.rollout.policy import Noise, Policy, policies_of
from space_dist.run.building import spec_of
from space_dist.run.claiming import stored_config
from space_dist.run.launch import policy_of

if TYPE_CHECKING:
    from space_dist.api.training import Run


class ActingPolicy:
    """One policy of a run.

    policy: its networks.  spec: what its environment is like: `observation_space`, `action_space`, `horizon`,
    `context_bounds`, ...
    """

    def __init__(self, policy: Policy, spec: EnvironmentSpec, *, seed: int = 0) -> None:
        self.policy, self.spec = policy, spec
        self._random = np.random.default_rng(seed)

    def __repr__(self) -> str:
        spec = self.spec
        shown = ", ".join(spec.context_bounds.names) if spec.context_visible else "hidden"
        return f"ActingPolicy({spec.env_id!r}, updates: {self.policy.version:,}, context: {shown})"

    def predict(
        self,
        observation: Observations,
        state: NDArray[np.float32] | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], NDArray[np.float32] | None]:
        """`(..., obs) -> (..., action)` what to do, and the next `state`, as Stable-Baselines3's `predict` has it.

        observation: one, or a batch of them; with the scaled context where the run shows it: see `with_context`.
        state: (n, memory_size) what a recurrent policy remembers of each one's episode, as the call before gave it;
        None: nothing, and of other policies always. episode_start: (n,) where an episode begins, whatever `state` says.
        deterministic: the likeliest or best action; else one drawn as in training. Raises ConfigError for another
        shape.
        """
        batch, single = self._batched(observation)
        head, memory = self.policy.head, self._memory(rows(batch), state, episode_start)
        outputs = memory.outputs(batch)
        if deterministic:
            actions = head.best(outputs)
        else:
            # The last step there is: behind every warm-up and exploration schedule.
            noise = Noise.draw(head, self.spec.action_space, self._random, (1, rows(batch)))
            actions = head.sampled(outputs, noise, 0, np.full(rows(batch), np.iinfo(np.int64).max))
        executed = head.executed(actions)
        return (executed[0] if single else executed), memory.values

    def values(self, observation: Observations) -> NDArray[np.float64]:
        """`(..., obs) -> (...)` what the states are worth, V(s), in unscaled reward units.

        observation: as for `predict`. Of a recurrent policy: where an episode begins. Raises ConfigError for another
        shape.
        """
        batch, single = self._batched(observation)
        values = self.policy.values(batch)
        return values[0] if single else values

    def _memory(self, count: int, state: NDArray[np.float32] | None, episode_start: ArrayLike | None) -> Memory:
        memory = Memory(self.policy, count)
        if memory.values is not None and state is not None:
            if np.shape(state) != memory.values.shape:
                raise ConfigError(
                    f"the state of {count} observations has the shape {memory.values.shape}, not {np.shape(state)}; "
                    "hand on what predict gave, or None where all episodes begin"
                )
            memory.values[:] = state
            if episode_start is not None:
                memory.forget(np.flatnonzero(np.broadcast_to(np.asarray(episode_start, dtype=np.bool_), count)))
        return memory

    def with_context(self, observation: Observations, context: NDArray[Any]) -> Observations:
        """`(..., obs), (..., d)` observations as the run's policy saw them: with the context, if it is shown one.

        context: in environment units; it is scaled from its bounds to [-1, 1] (what lies beyond them: to the nearest of
        them), and put behind flat observations, or beside the parts of others. Raises ConfigError for a context that is
        not its numbers, or of another length, or flat observations of one.
        """
        if not self.spec.context_visible:
            return observation
        bounds = self.spec.context_bounds
        scaled = np.clip(bounds.scale(_numbers(context, bounds.names)), -1.0, 1.0).astype(np.float32)
        if isinstance(self.spec.observation_space, spaces.Dict):
            parts = observation if isinstance(observation, dict) else {"observation": np.asarray(observation)}
            return {**parts, "context": scaled}
        plain = np.asarray(observation, dtype=np.float32)
        own = int(np.prod(self.spec.observation_space.shape or ())) - scaled.shape[-1]
        if plain.shape[-1:] != (own,):
            raise ConfigError(
                f"an observation without its context has {own} numbers, not the shape {plain.shape}; the context's "
                f"{scaled.shape[-1]} are put behind them"
            )
        if scaled.ndim > 1 and scaled.shape[:-1] != plain.shape[:-1]:
            raise ConfigError(f"contexts of shape {scaled.shape} for observations of shape {plain.shape}")
        return np.concatenate([plain, np.broadcast_to(scaled, (*plain.shape[:-1], scaled.shape[-1]))], axis=-1)

    def _batched(self, observation: Observations) -> tuple[Observations, bool]:
        """The observations as a batch, and whether there is one alone."""
        space = self.spec.observation_space
        if isinstance(observation, dict):
            parts: dict[str, Any] = dict(getattr(space, "spaces", {}))
            if set(parts) != set(observation):
                raise ConfigError(f"an observation has the parts {', '.join(parts) or 'none'}, not {[*observation]}")
            found = {name: _batch(np.asarray(observation[name]), parts[name].shape, name) for name in parts}
            return {name: batch for name, (batch, _) in found.items()}, all(one for _, one in found.values())
        return _batch(np.asarray(observation), space.shape or (), "")


def _numbers(context: ArrayLike, names: tuple[str, ...]) -> NDArray[np.float64]:
    try:
        return np.asarray(context, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigError(
            f"a context is an array of a number for each of {', '.join(names)}, in this order, not {repr(context)[:80]}"
        ) from None


def _batch(array: NDArray[Any], shape: tuple[int, ...], name: str) -> tuple[NDArray[Any], bool]:
    if array.shape == shape:
        return array[None], True
    if array.shape[1:] != shape:
        part = f" {name!r}" if name else ""
        raise ConfigError(
            f"an observation{part} has the shape {shape}, or (n, {', '.join(map(str, shape))}), not {array.shape}; "
            "where the run shows the context, `with_context` puts it there"
        )
    return array, False


def load_policy(run: Run | Path | str, *, number: int = 0, seed: int = 0) -> ActingPolicy:
    """What a run has learned: its final model, or, of an unfinished one, the policy of its last checkpoint.

    run: its folder.  number: which, where a run trains several.  seed: of the actions that are drawn.
    Raises LedgerError where there is no policy yet, and ConfigError if the environment cannot be made.
    """
    number, seed = as_count(number, "number", least=0), as_count(seed, "seed", least=0)
    ledger = Ledger(as_path(getattr(run, "folder", run), "run"))
    ledger.status()
    spec = spec_of(stored_config(ledger))
    policies = policies_of(policy_of(ledger, spec))
    if number >= len(policies):
        raise ConfigError(f"{ledger.folder} has {len(policies)} policies, counted from 0; it has no number {number}")
    return ActingPolicy(policies[number], spec, seed=seed)
