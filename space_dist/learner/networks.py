"""Networks on their way to the actors: NumPy arrays where they are multilayer perceptrons, through torch otherwise."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import sb3_contrib
import stable_baselines3
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first

from space_dist.config import A2CConfig, DQNConfig, LearnerConfig
from space_dist.envs import Observations
from space_dist.errors import ConfigError
from space_dist.rollout.policy import Array, Head, Layers, Statistics
from space_dist.system.importing import load

ALGORITHMS: dict[str, Any] = {  # by kind: SB3's name in small letters, RecurrentPPO's in two words
    re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower(): found
    for library in (sb3_contrib, stable_baselines3)
    for name in library.__all__
    if isinstance(found := getattr(library, name), type) and issubclass(found, BaseAlgorithm)
}

_LEAST_IMAGE = 36  # pixels: what the convolutions of SB3's NatureCNN leave something of


def is_mlp(config: LearnerConfig, observation_space: spaces.Space[Any]) -> bool:
    """Whether a policy can act in NumPy."""
    return config.policy == "MlpPolicy" and isinstance(observation_space, spaces.Box)


def policy_kwargs(config: LearnerConfig) -> dict[str, Any]:
    """What SB3's policies are made with."""
    kwargs: dict[str, Any] = {
        **config.policy_settings(),
        "net_arch": list(config.net_arch),
        "activation_fn": torch.nn.Tanh if config.activation == "tanh" else torch.nn.ReLU,
    }
    if isinstance(config, A2CConfig) and not config.use_rms_prop:
        kwargs["optimizer_class"] = torch.optim.Adam
    return kwargs


def policy_class(config: LearnerConfig) -> str | type[BasePolicy]:
    """SB3's name of a policy, or a class at an import path. Raises ConfigError if there is none."""
    _, colon, name = config.policy.partition(":")
    if not colon:
        return config.policy
    found = load(config.policy, "learner.policy", of_library=BasePolicy)
    if not (isinstance(found, type) and issubclass(found, BasePolicy)):
        raise ConfigError(f"learner.policy {config.policy!r}: {name!r} is no Stable-Baselines3 policy class")
    return found


def refuse_policy(config: LearnerConfig, observation_space: spaces.Space[Any]) -> None:
    """Raise ConfigError if SB3 cannot build this policy for these observations."""
    mlp, cnn, multi_input = config.policies
    found, base = policy_class(config), ALGORITHMS[config.kind].policy_aliases[mlp]
    if not isinstance(found, str):
        if not issubclass(found, base):
            raise ConfigError(f"learner.policy {config.policy!r} is no policy of {config.kind}: no {base.__name__}")
        return
    parts = observation_space.spaces if isinstance(observation_space, spaces.Dict) else {"": observation_space}
    flat = isinstance(observation_space, spaces.Box) and len(observation_space.shape) == 1
    if found == mlp and not flat:
        raise ConfigError(
            f"learner.policy: {mlp} needs flat observations (a one-dimensional Box), not {observation_space}; "
            f"{cnn} takes images, {multi_input} dictionaries"
        )
    if (found == multi_input) != isinstance(observation_space, spaces.Dict):
        raise ConfigError(f"learner.policy: dictionaries need {multi_input}, and nothing else: {observation_space}")
    for name, part in parts.items():
        image = is_image_space(part)
        if found == cnn and not image:
            raise ConfigError(f"learner.policy: {cnn} needs images (uint8, 0 to 255), not {part}")
        ordered = isinstance(part, spaces.Box) and image and is_image_space_channels_first(part)
        if image and (not ordered or min((part.shape or (0,))[-2:]) < _LEAST_IMAGE):
            what = f"part {name!r} of the observations" if name else "observations"
            raise ConfigError(
                f"learner.policy: images must be (channels, height, width), at least {_LEAST_IMAGE} pixels each way; "
                f"{what}: {part}"
            )


def layers(state: Mapping[str, torch.Tensor], body: str, *heads: str) -> Layers:
    """The linear layers of a `Sequential` named `body` (its numbered parts, in order), then `heads` side by side."""
    names = {name.rsplit(".", 1)[0] for name in state if name.startswith(f"{body}.")}
    numbered = sorted(names, key=lambda name: int(name.rsplit(".", 1)[1]))
    sequence = [_linear(state, name) for name in numbered]
    if heads:
        parts = [_linear(state, head) for head in heads]
        sequence.append(
            (np.concatenate([part[0] for part in parts], axis=1), np.concatenate([part[1] for part in parts]))
        )
    return tuple(sequence)


def _linear(state: Mapping[str, torch.Tensor], name: str) -> tuple[Array, Array]:
    weight, bias = state[f"{name}.weight"].detach().numpy(), state[f"{name}.bias"].detach().numpy()
    return np.array(weight.T, order="C"), bias.copy()


def bounds(space: spaces.Space[Any]) -> dict[str, Any]:
    """`low` and `high` of a continuous action space, for a `Head`."""
    if not isinstance(space, spaces.Box):
        return {}
    return {"low": space.low.astype(np.float32), "high": space.high.astype(np.float32)}


@dataclass(frozen=True)
class TorchPolicy:
    """Any SB3 policy, acting through torch: actors that receive one import torch by unpickling it."""

    version: int
    head: Head
    config: LearnerConfig
    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]
    state: Mapping[str, NDArray[Any]]
    statistics: Statistics

    def outputs(self, observations: Observations) -> Array:
        """See `policy.Policy`."""
        network: Any = network_of(self)
        with torch.no_grad():
            inputs = tensors(self.statistics.scaled(observations))
            if self.head.kind == "greedy":
                outputs = network.q_net(inputs)
            elif self.head.kind == "squashed":
                mean, log_std, _ = network.actor.get_action_dist_params(inputs)
                outputs = torch.cat([mean, log_std], dim=1)
            elif self.head.kind == "deterministic":
                actor = network.actor
                outputs = actor.mu[:-1](actor.extract_features(inputs, actor.features_extractor))
            else:
                distribution = network.get_distribution(inputs).distribution
                outputs = distribution.logits if self.head.kind == "categorical" else distribution.mean
        array: Array = outputs.numpy()
        return array

    def values(self, observations: Observations) -> NDArray[np.float64]:
        """See `policy.Policy`."""
        network: Any = network_of(self)
        with torch.no_grad():
            inputs = tensors(self.statistics.scaled(observations))
            if isinstance(network, ActorCriticPolicy):
                values = network.predict_values(inputs)[:, 0]
            elif self.head.kind == "greedy":
                target = isinstance(self.config, DQNConfig) and self.config.scored_network == "target"
                values = (network.q_net_target if target else network.q_net)(inputs).max(dim=1).values
            else:
                best = torch.as_tensor(self.head.best(self.outputs(observations)))
                values = torch.cat(network.critic(inputs, best), dim=1).min(dim=1).values
        return values.numpy().astype(np.float64) * self.statistics.reward_std


def torch_policy(
    config: LearnerConfig, model: BaseAlgorithm, version: int, statistics: Statistics, head: Head
) -> TorchPolicy:
    """A copy of a model's policy."""
    state = {
        name: tensor.detach().numpy().copy()
        for name, tensor in model.policy.state_dict().items()
        if "_target." not in name or name.startswith("q_net_target.")
    }
    return TorchPolicy(version, head, config, model.observation_space, model.action_space, state, statistics)


_BUILT: dict[str, tuple[Mapping[str, Any], BasePolicy]] = {}  # by what it is made of: the last state, and the network


def network_of(policy: TorchPolicy) -> BasePolicy:
    """SB3's policy object with these weights; built once per process."""
    key = f"{policy.config.model_dump_json()} {policy.observation_space} {policy.action_space}"
    if key not in _BUILT:
        torch.set_num_threads(1)
        found = policy_class(policy.config)
        made = ALGORITHMS[policy.config.kind].policy_aliases[found] if isinstance(found, str) else found
        network = made(policy.observation_space, policy.action_space, lambda _: 0.0, **policy_kwargs(policy.config))
        network.set_training_mode(False)
        _BUILT[key] = ({}, network)
    loaded, network = _BUILT[key]
    if loaded is not policy.state:
        state = {name: torch.as_tensor(array.copy()) for name, array in policy.state.items()}
        missing, unexpected = network.load_state_dict(state, strict=False)
        if unexpected or not all("_target." in name for name in missing):  # targets neither act nor score
            raise RuntimeError(f"the policy sent to this actor is another one: {[*missing, *unexpected][:5]}")
        _BUILT[key] = (policy.state, network)
    return network


def tensors(observations: Observations) -> Any:
    """Observations as SB3's policies take them."""
    if isinstance(observations, dict):
        return {name: torch.tensor(array) for name, array in observations.items()}
    return torch.tensor(observations)  # a copy: what comes from Ray's object store is read-only
