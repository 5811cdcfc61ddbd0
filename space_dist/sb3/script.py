"""What somebody else's SB3 model shows a curriculum: values, gradient steps, and what its wrappers do to observations.

An instance's start value is what our own learners call so: V(s0) of an actor-critic, max_a Q of a DQN, and min_k Q_k at
the deterministic action of SAC and TD3; of sb3-contrib's distributions of returns, their means.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import (
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
)

from space_dist.envs import Observations
from space_dist.envs.observations import take
from space_dist.errors import ConfigError
from space_dist.rollout.policy import Statistics
from space_dist.sb3.vec_env import ContextVecEnv

_WRAPPERS = (VecNormalize, VecMonitor, VecTransposeImage, VecCheckNan)


class Wrapped:
    """A `ContextVecEnv` and what is wrapped around it.

    Raises ConfigError where there is no such environment, or a wrapper that observations cannot be sent through without
    a step.
    """

    def __init__(self, env: VecEnv | None) -> None:
        self._wrappers: list[VecEnvWrapper] = []  # the innermost first
        while isinstance(env, VecEnvWrapper):
            self._wrappers.insert(0, env)
            env = env.venv
        if not isinstance(env, ContextVecEnv):
            raise ConfigError(
                f"CurriculumCallback: the model's environment is {_a(env)}, which knows no instances; make it with "
                "ContextVecEnv(env, instances, n_envs)"
            )
        for wrapper in self._wrappers:
            if not isinstance(wrapper, _WRAPPERS):
                raise ConfigError(
                    f"CurriculumCallback: {type(wrapper).__name__} around ContextVecEnv hides what an episode's first "
                    f"observation is; allowed are {', '.join(kind.__name__ for kind in _WRAPPERS)}. Wrap the single "
                    "environment instead"
                )
        self.env = env

    @property
    def normaliser(self) -> VecNormalize | None:
        """SB3's, if there is one that scales observations or rewards."""
        found = [one for one in self._wrappers if isinstance(one, VecNormalize) and (one.norm_obs or one.norm_reward)]
        return found[-1] if found else None

    @property
    def scaled(self) -> str:
        """What SB3's normaliser scales."""
        found = self.normaliser
        scaled = {"observations": found.norm_obs, "rewards": found.norm_reward} if found is not None else {}
        return "of " + (" and ".join(what for what, so in scaled.items() if so) or "nothing")

    @property
    def statistics(self) -> Statistics:
        """The scales of flat observations, and of rewards, as of now."""
        normaliser = self.normaliser
        if normaliser is None:
            return Statistics()
        reward_std = 1.0
        if normaliser.norm_reward:
            reward_std = float(np.sqrt(normaliser.ret_rms.var + normaliser.epsilon))
        scales = getattr(normaliser, "obs_rms", None)
        if not normaliser.norm_obs or not isinstance(scales, RunningMeanStd):
            return Statistics(reward_std=reward_std)
        return Statistics(scales.mean.copy(), np.sqrt(scales.var + normaliser.epsilon), reward_std)

    def seen(self, observations: Observations) -> Observations:
        """`(n, ...)` raw observations as the policy sees them, at the scales of now."""
        found: Any = observations
        for wrapper in self._wrappers:
            if isinstance(wrapper, VecNormalize):
                found = wrapper.normalize_obs(found)
            elif isinstance(wrapper, VecTransposeImage):
                found = wrapper.transpose_observations(found)
        seen: Observations = found
        return seen

    def put(self, model: BaseAlgorithm, observations: Observations) -> None:
        """Have `model` go on from (n_envs, ...) raw observations, where `env` stands."""
        found: Any = observations
        for wrapper in self._wrappers:
            if isinstance(wrapper, VecNormalize):
                wrapper.old_obs = take(found, slice(None))
                if model.get_vec_normalize_env() is wrapper:
                    model._last_original_obs = take(found, slice(None))
                found = wrapper.normalize_obs(found)
            elif isinstance(wrapper, VecTransposeImage):
                found = wrapper.transpose_observations(found)
        model._last_obs = found
        model._last_episode_starts = self.env.begins


class Scored:
    """What a model's policy, as it is whenever it is asked, says that states are worth: a `policy.Valuing`."""

    def __init__(self, model: BaseAlgorithm, wrapped: Wrapped) -> None:
        self._model, self._wrapped = model, wrapped

    def values(self, observations: Observations) -> NDArray[np.float64]:
        """`(n, ...) -> (n,)` what the states of raw observations are worth, in unscaled reward units."""
        policy: Any = self._model.policy
        policy.set_training_mode(False)
        with torch.no_grad():
            inputs, _ = policy.obs_to_tensor(self._wrapped.seen(observations))
            values = _values(policy, inputs)
        unscaled: NDArray[np.float64] = values.cpu().numpy().astype(np.float64) * self._wrapped.statistics.reward_std
        return unscaled


def refuse_model(model: BaseAlgorithm) -> None:
    """Raise ConfigError if a model is of no kind whose instances could have start values."""
    policy = model.policy
    kinds = isinstance(model, OnPolicyAlgorithm | OffPolicyAlgorithm)
    known = ("predict_values", "q_net", "quantile_net")
    if not kinds or not (any(hasattr(policy, name) for name in known) or _has_critic(policy)):
        raise ConfigError(
            f"CurriculumCallback: {type(model).__name__} has no value function that could say what an instance's start "
            "is worth; those of PPO, A2C, DQN, SAC, TD3 and DDPG have, and of sb3-contrib TRPO, MaskablePPO, "
            "RecurrentPPO, QRDQN, TQC and CrossQ"
        )


def gradient_steps(model: BaseAlgorithm) -> int:
    """Steps that the optimiser of the scored network has made so far; SB3's count of updates where it keeps none."""
    policy: Any = model.policy
    optimizer = policy.critic.optimizer if _has_critic(policy) else policy.optimizer
    counts = [int(state["step"]) for state in optimizer.state.values() if "step" in state]
    return max(counts, default=int(getattr(model, "_n_updates", 0)))


def weights(model: BaseAlgorithm) -> dict[str, NDArray[Any]]:
    """A copy of the policy's, by name."""
    return {name: tensor.detach().cpu().numpy().copy() for name, tensor in model.policy.state_dict().items()}


@contextmanager
def with_weights(model: BaseAlgorithm, others: Mapping[str, NDArray[Any]]) -> Iterator[None]:
    """Have the policy's weights be others meanwhile: what `weights` gave earlier."""
    now = copy.deepcopy(model.policy.state_dict())
    model.policy.load_state_dict({name: torch.as_tensor(array.copy()) for name, array in others.items()})
    try:
        yield
    finally:
        model.policy.load_state_dict(now)


def network(model: BaseAlgorithm) -> tuple[tuple[int, ...], str]:
    """Units of each hidden layer of a policy's value function, and its activation: tanh or relu.

    Raises ConfigError for another activation.
    """
    policy: Any = model.policy
    given: Any = getattr(policy, "net_arch", ())
    if isinstance(given, dict):
        given = given.get("vf", given.get("qf", ()))
    kind = getattr(policy, "activation_fn", None)
    names = {torch.nn.Tanh: "tanh", torch.nn.ReLU: "relu"}
    if kind not in names:
        raise ConfigError(
            "CurriculumCallback: vds has an ensemble of value functions with the policy's activation, and knows Tanh "
            f"and ReLU, not {getattr(kind, '__name__', kind)}"
        )
    return tuple(int(units) for units in given), names[kind]


def _values(policy: Any, inputs: Any) -> torch.Tensor:
    """`(n,)` what a policy says that the states behind `inputs` are worth, at its own scale."""
    found: torch.Tensor
    if hasattr(policy, "lstm_hidden_state_shape"):  # at an episode's start nothing is remembered
        n = len(next(iter(inputs.values())) if isinstance(inputs, dict) else inputs)
        layers, _, size = policy.lstm_hidden_state_shape
        nothing = torch.zeros(layers, n, size, device=policy.device)
        found = policy.predict_values(inputs, (nothing, nothing), torch.ones(n, device=policy.device))[:, 0]
    elif hasattr(policy, "predict_values"):
        found = policy.predict_values(inputs)[:, 0]
    elif hasattr(policy, "quantile_net"):
        found = policy.quantile_net(inputs).mean(dim=1).max(dim=1).values
    elif hasattr(policy, "q_net"):
        found = policy.q_net(inputs).max(dim=1).values
    else:
        critics = policy.critic(inputs, policy._predict(inputs, deterministic=True))
        least = isinstance(critics, tuple)  # else they are (n, critics, quantiles)
        found = torch.cat(critics, dim=1).min(dim=1).values if least else critics.mean(dim=(1, 2))
    return found


def _has_critic(policy: Any) -> bool:
    return isinstance(getattr(policy, "critic", None), torch.nn.Module) and hasattr(policy.critic, "optimizer")


def _a(env: object) -> str:
    return "none" if env is None else f"a {type(env).__name__}"
