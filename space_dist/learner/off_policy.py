"""DQN, SAC and TD3: transitions enter SB3's replay buffer in shard order; `train()`, SB3's or `lean`, samples it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from space_dist.config import DQNConfig, SACConfig, TD3Config
from space_dist.envs import Observations
from space_dist.envs.observations import each, put, take
from space_dist.learner.custom import algorithm_class, made, set_up
from space_dist.learner.interface import Arrays, SB3Learner, schedule
from space_dist.learner.lean_replay import LEAN
from space_dist.learner.networks import bounds, layers, policy_class, policy_kwargs
from space_dist.rollout import Shard
from space_dist.rollout.policy import Exploration, Head, MlpPolicy, Statistics

_OURS = {
    "kind", "policy", "n_steps", "n_episodes", "learning_rate", "learning_rate_schedule", "net_arch", "activation",
    "log_std_init", "gradient_steps_per_step", "action_noise_std", "scored_network",
    "normalize_observations", "normalize_rewards", "update", "import_path", "kwargs",
}  # fmt: skip


class OffPolicyLearner(SB3Learner):
    """What DQN, SAC and TD3 share: the replay buffer, and the ratio of gradient steps to environment steps."""

    model: OffPolicyAlgorithm

    def __init__(
        self,
        config: DQNConfig | SACConfig | TD3Config,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        *,
        seed: int,
        total_steps: int,
    ) -> None:
        self._settings = config
        self._seen = 0
        super().__init__(config, observation_space, action_space, seed=seed, total_steps=total_steps)
        if self._normaliser is not None:  # SB3's buffer keeps raw transitions and asks this when it samples
            self.model._vec_normalize_env = self._normaliser  # type: ignore[assignment]

    def _build(self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> OffPolicyAlgorithm:
        config = self._settings
        settings = {name: value for name, value in dict(config).items() if name not in _OURS}
        if "max_grad_norm" in settings and settings["max_grad_norm"] is None:
            # SB3's DQN clips in any case: an infinite norm clips nothing.
            settings["max_grad_norm"] = float("inf")
        if isinstance(config, SACConfig):  # SB3's "auto" asks an environment for this number
            settings["target_entropy"] = float(-np.prod(action_space.shape or ()))
        algorithm = LEAN[config.kind] if config.update == "lean" else algorithm_class(config)
        model: Any = made(
            algorithm,
            config,
            policy_class(config),
            env=None,
            learning_rate=schedule(config.learning_rate, config.learning_rate_schedule),
            policy_kwargs=policy_kwargs(config),
            device="cpu",
            _init_setup_model=False,
            **settings,
        )
        # SB3 takes these from an environment, and there is none: `env=None`.
        model.observation_space, model.action_space, model.n_envs = observation_space, action_space, 1
        set_up(model, config)
        off_policy: OffPolicyAlgorithm = model
        return off_policy

    @property
    def _buffer(self) -> ReplayBuffer:
        if self.model.replay_buffer is None:
            raise RuntimeError("SB3 made no replay buffer")
        return self.model.replay_buffer

    def _learn(self, shards: Sequence[Shard], *, steps: int) -> None:
        for shard in shards:
            self.remember(_transitions(shard), self._seen)
        before = steps - sum(shard.steps for shard in shards)
        for step in range(before + 1, steps + 1):
            self.model.num_timesteps = step
            self.model._update_current_progress_remaining(step, self._total_steps)
            # DQN copies its target network, and lets epsilon fall, in `_on_step`, once a step, and not in `train()`.
            self.model._on_step()
        ratio = self._settings.gradient_steps_per_step
        # What a ratio leaves over counts in a later round, and needs no state.
        gradient_steps = math.floor(steps * ratio) - math.floor(before * ratio)
        if steps > self._settings.learning_starts and gradient_steps:
            self.model.train(batch_size=self._settings.batch_size, gradient_steps=gradient_steps)

    @property
    def seen(self) -> int:
        """How many transitions have entered the replay buffer so far."""
        return self._seen

    @property
    def capacity(self) -> int:
        """How many the replay buffer remembers."""
        return int(self._buffer.buffer_size)

    def remember(self, arrays: Mapping[str, NDArray[Any]], first: int) -> None:
        """Enter transitions, of which the first is the run's transition number `first`, as SB3's `add` would."""
        buffer, count = self._buffer, len(arrays["rewards"])
        skip = max(0, count - self.capacity)  # a round larger than the buffer leaves only its end there
        places = (first + np.arange(skip, count)) % self.capacity
        for name in ("observations", "next_observations"):
            put(getattr(buffer, name), (places, 0), take(_unpacked(arrays, name), slice(skip, None)))
        buffer.actions[places, 0] = arrays["actions"][skip:].reshape(len(places), -1)
        for name in ("rewards", "dones", "timeouts"):
            getattr(buffer, name)[places, 0] = arrays[name][skip:]
        self._seen = first + count
        buffer.pos, buffer.full = self._seen % self.capacity, self._seen >= self.capacity

    def transitions(self, first: int) -> Arrays:
        """The transitions from number `first` on, as far as the buffer still remembers them."""
        first = max(first, self._seen - self.capacity)
        places = np.arange(first, self._seen) % self.capacity
        buffer = self._buffer
        arrays = {name: getattr(buffer, name)[places, 0] for name in ("actions", "rewards", "dones", "timeouts")}
        for name in ("observations", "next_observations"):
            arrays |= _packed(take(getattr(buffer, name), (places, 0)), name)
        return arrays

    def save(self) -> tuple[Arrays, dict[str, Any]]:
        """See `Learner`."""
        arrays, data = super().save()
        return arrays, {**data, "seen": self._seen}


class DQNLearner(OffPolicyLearner):
    """DQN. Its target network is updated, and its epsilon falls, with every transition."""

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        return {"policy": self.model.policy.optimizer}

    def _head(self) -> Head:
        config = self._settings
        if not isinstance(config, DQNConfig):
            raise TypeError(config)
        return Head(
            "greedy",
            exploration=Exploration(
                learning_starts=config.learning_starts,
                epsilon_initial=config.exploration_initial_eps,
                epsilon_final=config.exploration_final_eps,
                decay_steps=config.exploration_fraction * self._total_steps,
            ),
        )

    def _learn(self, shards: Sequence[Shard], *, steps: int) -> None:
        super()._learn(shards, steps=steps)
        if steps <= self._settings.learning_starts:  # SB3 logs a rate that has not chosen an action yet
            self.model.logger.name_to_value.pop("rollout/exploration_rate", None)

    def _mlp(self, version: int, statistics: Statistics) -> MlpPolicy:
        state = self.model.policy.state_dict()
        target = isinstance(self._settings, DQNConfig) and self._settings.scored_network == "target"
        return MlpPolicy(
            version, self._settings.activation, self._head(), layers(state, "q_net.q_net"),
            critics=(layers(state, "q_net_target.q_net"),) if target else (), statistics=statistics,
        )  # fmt: skip

    def save(self) -> tuple[Arrays, dict[str, Any]]:
        """See `Learner`."""
        arrays, data = super().save()
        # SB3 copies the target network by this count.
        return arrays, {**data, "n_calls": self.model._n_calls}  # type: ignore[attr-defined]

    def load(self, arrays: Mapping[str, NDArray[Any]], data: Mapping[str, Any]) -> None:
        """See `Learner`."""
        super().load(arrays, data)
        self.model._n_calls = int(data["n_calls"])  # type: ignore[attr-defined]


class _ContinuousLearner(OffPolicyLearner):
    def _critics(self) -> tuple[Any, ...]:
        state = self.model.policy.state_dict()
        count = len({name.split(".")[1] for name in state if name.startswith("critic.qf")})
        return tuple(layers(state, f"critic.qf{index}") for index in range(count))


class SACLearner(_ContinuousLearner):
    """SAC. Its values contain the entropy bonus; the log of its coefficient, alpha, is logged."""

    model: Any

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        optimizers = {"critic": self.model.critic.optimizer, "actor": self.model.actor.optimizer}
        if self.model.ent_coef_optimizer is not None:
            optimizers["ent_coef"] = self.model.ent_coef_optimizer
        return optimizers

    def _head(self) -> Head:
        exploration = Exploration(learning_starts=self._settings.learning_starts)
        return Head("squashed", exploration=exploration, **bounds(self.model.action_space))

    def _mlp(self, version: int, statistics: Statistics) -> MlpPolicy:
        actor = layers(self.model.policy.state_dict(), "actor.latent_pi", "actor.mu", "actor.log_std")
        return MlpPolicy(
            version, self._settings.activation, self._head(), actor, self._critics(), True, statistics
        )  # fmt: skip

    def _more_metrics(self, metrics: Mapping[str, float]) -> dict[str, float]:
        log_alpha = {"log_alpha": math.log(metrics["ent_coef"])} if metrics.get("ent_coef", 0.0) > 0.0 else {}
        return {**super()._more_metrics(metrics), **log_alpha}

    def save(self) -> tuple[Arrays, dict[str, Any]]:
        """See `Learner`."""
        arrays, data = super().save()
        if self.model.log_ent_coef is not None:
            arrays["log_ent_coef"] = self.model.log_ent_coef.detach().numpy().copy()
        return arrays, data

    def load(self, arrays: Mapping[str, NDArray[Any]], data: Mapping[str, Any]) -> None:
        """See `Learner`."""
        super().load(arrays, data)
        if self.model.log_ent_coef is not None:
            with torch.no_grad():
                self.model.log_ent_coef.copy_(torch.as_tensor(arrays["log_ent_coef"].copy()))


class TD3Learner(_ContinuousLearner):
    """TD3: deterministic, with Gaussian noise on what it executes."""

    model: Any

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        return {"critic": self.model.critic.optimizer, "actor": self.model.actor.optimizer}

    def _head(self) -> Head:
        config = self._settings
        if not isinstance(config, TD3Config):
            raise TypeError(config)
        exploration = Exploration(learning_starts=config.learning_starts, noise_std=config.action_noise_std)
        return Head("deterministic", exploration=exploration, **bounds(self.model.action_space))

    def _mlp(self, version: int, statistics: Statistics) -> MlpPolicy:
        actor = layers(self.model.policy.state_dict(), "actor.mu")
        return MlpPolicy(
            version, self._settings.activation, self._head(), actor, self._critics(), True, statistics
        )  # fmt: skip


OFF_POLICY: dict[type, Callable[..., OffPolicyLearner]] = {  # by section of the config
    DQNConfig: DQNLearner, SACConfig: SACLearner, TD3Config: TD3Learner,
}  # fmt: skip


def _transitions(shard: Shard) -> dict[str, NDArray[Any]]:
    """A shard's transitions in the order of time, then slots, as a replay buffer stores them."""
    if shard.next_observations is None:
        raise RuntimeError("the shard kept no next observations")
    count = shard.steps

    def flat(array: NDArray[Any]) -> NDArray[Any]:
        return array.reshape(count, *array.shape[2:])

    return {
        **_packed(each(flat, shard.observations), "observations"),
        **_packed(each(flat, shard.next_observations), "next_observations"),
        "actions": flat(shard.actions),
        "rewards": flat(shard.rewards).astype(np.float32),
        "dones": flat(shard.terminated | shard.truncated).astype(np.float32),
        # SB3's buffer takes these off `dones` as it samples: what was truncated is bootstrapped.
        "timeouts": flat(shard.truncated).astype(np.float32),
    }


def _packed(observations: Observations, name: str) -> dict[str, NDArray[Any]]:
    if isinstance(observations, dict):
        return {f"{name}.{part}": array for part, array in observations.items()}
    return {name: observations}


def _unpacked(arrays: Mapping[str, NDArray[Any]], name: str) -> Observations:
    if name in arrays:
        return arrays[name]
    prefix = f"{name}."
    return {part.removeprefix(prefix): array for part, array in arrays.items() if part.startswith(prefix)}
