"""PPO, TRPO, A2C and, with `recurrent`, RecurrentPPO: one round is one rollout buffer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from space_dist.config import LearnerConfig
from space_dist.envs import Observations
from space_dist.envs.observations import concatenate, each, put, rows
from space_dist.learner.custom import algorithm_class, made, set_up
from space_dist.learner.interface import SB3Learner, schedule
from space_dist.learner.lean import LeanPPO
from space_dist.learner.networks import bounds, layers, policy_class, policy_kwargs, tensors
from space_dist.rollout import Shard
from space_dist.rollout.policy import Head, MlpPolicy, Statistics

_OURS = {
    "kind", "policy", "n_steps", "learning_rate", "learning_rate_schedule", "net_arch", "activation",
    "normalize_observations", "normalize_rewards", "unrewarded", "update", "import_path", "kwargs",
}  # fmt: skip


Values = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Joined:
    """The slots of all shards, one shard's after another's: (length, slots, ...) each.

    ended: whether an episode did, at this step.  starts: (slots,) whether the first step began an episode.
    """

    observations: Observations
    actions: NDArray[np.generic]
    rewards: NDArray[np.float32]
    ended: NDArray[np.bool_]
    starts: NDArray[np.bool_]

    @property
    def episode_starts(self) -> NDArray[np.bool_]:
        """(length, slots) whether an episode begins with this step."""
        return np.concatenate([self.starts[None], self.ended[:-1]])

    def flat(self, action_space: spaces.Space[Any]) -> tuple[Observations, torch.Tensor]:
        """`(length * slots, ...)` observations, and actions as SB3's policies judge them."""
        count = self.rewards.size
        actions = torch.as_tensor(self.actions.reshape(count, -1).astype(np.float32))
        if isinstance(action_space, spaces.Discrete):
            # As SB3's `train()` does: its buffer keeps numbers of actions as floats.
            actions = actions.long().flatten()
        return each(lambda array: array.reshape(count, *array.shape[2:]), self.observations), actions


def leaves_policy(config: LearnerConfig, shards: Sequence[Shard]) -> bool:
    """Whether a round shall teach the value function only: nothing in it was rewarded (`learner.unrewarded`).

    Without advantages the policy's own loss has no gradient; what the value function is fitted to stays.
    """
    return getattr(config, "unrewarded", "learn") == "critic" and not any(shard.rewards.any() for shard in shards)


class OnPolicyLearner(SB3Learner):
    """A learner whose advantages, returns and losses are SB3's own, on our shards; or `lean`'s."""

    model: OnPolicyAlgorithm

    def __init__(
        self,
        config: LearnerConfig,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        *,
        seed: int,
        n_slots: int,
        slot_length: int,
        total_steps: int,
    ) -> None:
        self._n_slots, self._slot_length = n_slots, slot_length
        self._settings = config
        super().__init__(config, observation_space, action_space, seed=seed, total_steps=total_steps)

    def _build(self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> OnPolicyAlgorithm:
        config = self._settings
        ours = _OURS | {*config.policy_settings()}
        settings = {name: value for name, value in dict(config).items() if name not in ours}
        if "max_grad_norm" in settings and settings["max_grad_norm"] is None:
            # SB3 clips in any case: an infinite norm clips nothing.
            settings["max_grad_norm"] = float("inf")
        algorithm: Any = LeanPPO if self._compiled else algorithm_class(config)
        model = made(
            algorithm,
            config,
            policy_class(config),
            env=None,
            n_steps=self._slot_length,
            learning_rate=schedule(config.learning_rate, config.learning_rate_schedule),
            policy_kwargs=policy_kwargs(config),
            device="cpu",
            _init_setup_model=False,
            **settings,
        )
        # SB3 takes these from an environment, and there is none: `env=None`.
        model.observation_space, model.action_space, model.n_envs = observation_space, action_space, self._n_slots
        set_up(model, config)
        on_policy: OnPolicyAlgorithm = model
        return on_policy

    @property
    def _compiled(self) -> bool:
        """Whether updates, and what they need, are computed by our kernel."""
        return self._settings.is_compiled("single")

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        return {"policy": self.model.policy.optimizer}

    def _head(self) -> Head:
        state = self.model.policy.state_dict()
        if "log_std" in state:
            return Head("gaussian", state["log_std"].numpy().copy(), **bounds(self.model.action_space))
        return Head("categorical")

    def _mlp(self, version: int, statistics: Statistics) -> MlpPolicy:
        state = self.model.policy.state_dict()
        return MlpPolicy(
            version=version,
            activation=self._settings.activation,
            head=self._head(),
            actor=layers(state, "mlp_extractor.policy_net", "action_net"),
            critics=(layers(state, "mlp_extractor.value_net", "value_net"),),
            statistics=statistics,
        )

    def _learn(self, shards: Sequence[Shard], *, steps: int) -> None:
        self._advantages = self._gae(shards)  # before `train` lays them out in its own way
        if leaves_policy(self._settings, shards):
            self.model.rollout_buffer.advantages[:] = 0.0
        self.model.num_timesteps = steps
        # SB3 does this in its own collecting, which never runs here.
        self.model._update_current_progress_remaining(steps, self._total_steps)
        self.model.train()

    def _gae(self, shards: Sequence[Shard]) -> NDArray[np.float64]:
        with self._weights(self._acted):
            advantages = self.fill(shards).advantages
        scaled: NDArray[np.float64] = advantages.astype(np.float64) * self.statistics.reward_std
        return scaled

    def fill(self, shards: Sequence[Shard]) -> RolloutBuffer:
        """Fill SB3's rollout buffer: values and log-probabilities by its policy, returns and advantages by its buffer.

        As in SB3's own collecting, the value behind a truncated step is added to its reward, and an episode that goes
        on is bootstrapped from the value of its last observation.
        """
        buffer, joined = self.model.rollout_buffer, self.joined(shards)
        rewards, ended = joined.rewards, joined.ended
        length, n_slots = rewards.shape
        beyond = [shard.truncated_observations for shard in shards]
        beyond.append(concatenate([shard.last_observations for shard in shards]))
        buffer.reset()
        with torch.no_grad():
            values, log_probs, (*behind, last_values) = self._evaluated(
                shards, joined, [self.statistics.scaled(others) for others in beyond]
            )
        first = 0
        for shard, after in zip(shards, behind, strict=True):
            if len(after):
                mine = np.argwhere(shard.truncated)
                rewards[mine[:, 0], mine[:, 1] + first] += self.model.gamma * after
            first += shard.rewards.shape[1]
        put(buffer.observations, slice(None), joined.observations)
        buffer.actions[:] = joined.actions.reshape(buffer.actions.shape)
        buffer.rewards[:] = rewards
        buffer.episode_starts[:] = joined.episode_starts
        buffer.values[:] = values.reshape(length, n_slots)
        buffer.log_probs[:] = log_probs.reshape(length, n_slots)
        # SB3's `get` refuses a buffer that is not full.
        buffer.pos, buffer.full = length, True
        buffer.compute_returns_and_advantage(last_values=torch.as_tensor(last_values), dones=ended[-1])
        return buffer

    def joined(self, shards: Sequence[Shard]) -> Joined:
        """A round's shards as one, at the scales that acted."""
        rewards = np.concatenate([shard.rewards for shard in shards], axis=1)
        truncated = np.concatenate([shard.truncated for shard in shards], axis=1)
        return Joined(
            self.statistics.scaled(concatenate([shard.observations for shard in shards], axis=1)),
            np.concatenate([shard.actions for shard in shards], axis=1),
            self._normaliser.normalize_reward(rewards) if self._normaliser else rewards.astype(np.float32),
            np.concatenate([shard.terminated for shard in shards], axis=1) | truncated,
            np.concatenate([shard.starts for shard in shards]),
        )

    def _evaluated(
        self,
        shards: Sequence[Shard],  # noqa: ARG002 - of a recurrent policy they hold more
        joined: Joined,
        beyond: Sequence[Observations],
    ) -> tuple[Values, Values, list[Values]]:
        """`(n,), (n,)` values and log-probabilities of all steps' actions, as the update that follows computes them.

        beyond: observations behind each shard's truncated steps, then behind the last of all slots, at the scales that
            acted, whose (k,) values are wanted as well.
        """
        observations, actions = joined.flat(self.model.action_space)
        if isinstance(self.model, LeanPPO) and not isinstance(observations, dict):
            return self._evaluated_at_once(self.model, [observations, *beyond], actions.numpy())
        found, likelihoods, _ = self.model.policy.evaluate_actions(tensors(observations), actions)
        values = [
            self.model.policy.predict_values(tensors(others)).numpy()[:, 0] if rows(others) else np.zeros(0, np.float32)
            for others in beyond
        ]
        return found.numpy(), likelihoods.numpy(), values

    @staticmethod
    def _evaluated_at_once(
        model: LeanPPO, parts: Sequence[Observations], actions: NDArray[Any]
    ) -> tuple[Values, Values, list[Values]]:
        observations, n = concatenate(parts), len(actions)
        if isinstance(observations, dict):
            raise TypeError("a multilayer perceptron takes flat observations")
        all_actions = np.zeros((len(observations), *actions.shape[1:]), dtype=actions.dtype)
        all_actions[:n] = actions
        values, log_probs = model.evaluate(observations, all_actions)
        ends = np.cumsum([rows(part) for part in parts])
        return values[:n], log_probs[:n], np.split(values, ends[:-1])[1:]
