"""SB3's gradient steps of DQN, TD3 and SAC as compiled functions: `learner.update: lean`.

As in `lean`, only arithmetic is ours. Minibatches are SB3's: its replay buffer draws and scales them, those of many
steps in one call, which gives the same as one call a step. Noise is torch's, drawn in the same order. Networks and
optimisers hold their state before and after each update. `tests/test_lean_replay.py` holds losses, weights, targets and
optimisers against SB3's `train`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import DQN, SAC, TD3
from torch import nn

from space_dist.kernels import aligned, dqn, sac, td3
from space_dist.kernels.replay import Algorithm, ReplayLayout, ReplayShape
from space_dist.learner.lean import Array

_NUMBERS = 1 << 20  # of samples that are drawn together, about; no result depends on it


class Networks:
    """A model's networks, targets and optimisers, laid out for a kernel; SB3's own stay the truth.

    optimizers: all of them; where steps are counted, they are in this order.
    """

    def __init__(self, algorithm: Algorithm, model: Any, optimizers: Sequence[torch.optim.Optimizer]) -> None:
        named = dict(model.policy.named_parameters())
        if getattr(model, "log_ent_coef", None) is not None:
            named["log_ent_coef"] = model.log_ent_coef
        self._named, self._optimizers = named, tuple(optimizers)
        names = {id(parameter): name for name, parameter in named.items()}
        self._optimised = [[names[id(one)] for one in _parameters(optimizer)] for optimizer in optimizers]
        self.dtype: np.dtype[Any] = next(model.policy.parameters()).detach().numpy().dtype
        self.shape = shape_of(algorithm, model)

    def layout(self, size: int) -> ReplayLayout:
        """For minibatches of `size`."""
        return ReplayLayout.of(self.shape, size, self.dtype.itemsize)

    def laid_out(self, size: int) -> Array:
        """The array of a layout, with everything in it."""
        layout = self.layout(size)
        m, length = aligned(layout.size, self.dtype), layout.plan.length
        m[_places(layout, list(self._named))] = joined(list(self._named.values()))
        for optimizer, names in zip(self._optimizers, self._optimised, strict=True):
            if optimizer.state:
                states = [optimizer.state[self._named[name]] for name in names]
                for behind, moment in ((2, "exp_avg"), (3, "exp_avg_sq")):
                    m[behind * length + _places(layout, names)] = joined([state[moment] for state in states])
        return m

    def steps(self) -> list[int]:
        """That each optimiser has made."""
        return [
            max((int(state["step"]) for state in optimizer.state.values()), default=0) for optimizer in self._optimizers
        ]

    def keep(self, m: Array, size: int, steps: Sequence[int]) -> None:
        """Give networks and optimisers their numbers from the array of `laid_out`.

        steps: that each optimiser has made by now.
        """
        layout = self.layout(size)
        with torch.no_grad():
            for name, weight in self._split(m, 0, layout, list(self._named)).items():
                self._named[name].copy_(weight)
        for optimizer, names, count in zip(self._optimizers, self._optimised, steps, strict=True):
            # An optimiser that has made no step has no state (TD3's actor before `policy_delay`).
            if count:
                means, squares = (self._split(m, behind * layout.plan.length, layout, names) for behind in (2, 3))
                for name in names:
                    parameter = self._named[name]
                    # As torch's Adam keeps it: checkpoints of stock and lean are interchangeable.
                    optimizer.state[parameter] = {
                        "step": torch.tensor(float(count)), "exp_avg": means[name].to(parameter.dtype),
                        "exp_avg_sq": squares[name].to(parameter.dtype),
                    }  # fmt: skip

    def _split(self, m: Array, behind: int, layout: ReplayLayout, names: Sequence[str]) -> dict[str, torch.Tensor]:
        """By name, what lies so far behind parameters: copies of their shapes."""
        parameters = [self._named[name] for name in names]
        numbers = torch.from_numpy(m[behind + _places(layout, names)])
        parts = torch.split(numbers, [parameter.numel() for parameter in parameters])
        return {name: part.view_as(parameter) for name, part, parameter in zip(names, parts, parameters, strict=True)}


def _parameters(optimizer: torch.optim.Optimizer) -> list[torch.Tensor]:
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def _places(layout: ReplayLayout, names: Sequence[str]) -> NDArray[np.int64]:
    return np.concatenate([layout.places[name] for name in names])


def shape_of(algorithm: Algorithm, model: Any) -> ReplayShape:
    """Of the networks of SB3's MlpPolicy."""
    policy = model.policy
    body = {"dqn": lambda: policy.q_net.q_net, "td3": lambda: policy.actor.mu, "sac": lambda: policy.actor.latent_pi}
    linear = [layer for layer in body[algorithm]().children() if isinstance(layer, nn.Linear)]
    hidden = linear if algorithm == "sac" else linear[:-1]
    return ReplayShape(
        algorithm, inputs=int(np.prod(model.observation_space.shape)),
        outputs=int(model.action_space.n if algorithm == "dqn" else np.prod(model.action_space.shape)),
        hidden=tuple(layer.out_features for layer in hidden),
        activation="tanh" if policy.activation_fn is nn.Tanh else "relu",
    )  # fmt: skip


def _batches(
    model: Any, dtype: np.dtype[Any], gradient_steps: int, size: int
) -> Iterator[tuple[int, list[Array], torch.Tensor]]:
    """SB3's minibatches, those of several gradient steps drawn together.

    Yields a number of steps, their samples as kernels take them, and (steps, size, ...) the actions again.
    """
    width = 2 * int(np.prod(model.observation_space.shape)) + 2 * int(np.prod(model.action_space.shape)) + 3
    while gradient_steps:
        steps = min(max(1, _NUMBERS // (width * size)), gradient_steps)
        gradient_steps -= steps
        data = model.replay_buffer.sample(steps * size, env=model._vec_normalize_env)
        observed = data.observations.float(), data.next_observations.float()  # as SB3's `preprocess_obs`
        tensors = (*observed, data.actions, data.rewards, (1 - data.dones) * model.gamma)
        arrays = [np.ascontiguousarray(tensor.numpy(), dtype=dtype) for tensor in tensors]
        yield steps, arrays, data.actions.view(steps, size, -1)


def _adam(optimizer: torch.optim.Optimizer) -> dict[str, float]:
    """Settings of an optimiser, as kernels call them."""
    (group,) = optimizer.param_groups
    beta, beta_square = group["betas"]
    return {"learning_rate": float(group["lr"]), "beta": beta, "beta_square": beta_square, "eps": float(group["eps"])}


class LeanDQN(DQN):
    """SB3's DQN for its own MlpPolicy."""

    @functools.cached_property
    def networks(self) -> Networks:
        """What learns, as the kernel takes it."""
        return Networks("dqn", self, [self.policy.optimizer])

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Learn from the replay buffer as `DQN.train` does, and record the same metrics."""
        self._update_learning_rate(self.policy.optimizer)
        networks, recorded = self.networks, []
        m, layout, (steps,) = networks.laid_out(batch_size), networks.layout(batch_size), networks.steps()
        settings = dqn.Settings(
            **_adam(self.policy.optimizer), steps=steps, max_grad_norm=float(self.max_grad_norm)
        )  # fmt: skip
        for count, samples, _ in _batches(self, networks.dtype, gradient_steps, batch_size):
            recorded.append(np.zeros((count, dqn.N_RECORDED)))
            dqn.prepare(networks.dtype)(m, layout.plan, layout.layers, settings, *samples, batch_size, recorded[-1])
            settings = settings._replace(steps=settings.steps + count)
        networks.keep(m, batch_size, [settings.steps])
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/loss", np.concatenate(recorded)[:, dqn.LOSS].mean())


class LeanTD3(TD3):
    """SB3's TD3 for its own MlpPolicy."""

    @functools.cached_property
    def networks(self) -> Networks:
        """What learns, as the kernel takes it."""
        return Networks("td3", self, [self.actor.optimizer, self.critic.optimizer])

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Learn from the replay buffer as `TD3.train` does, and record the same metrics."""
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        networks, recorded = self.networks, []
        m, layout, (of_actor, of_critics) = networks.laid_out(batch_size), networks.layout(batch_size), networks.steps()
        settings = td3.Settings(
            **_adam(self.critic.optimizer), critic_steps=of_critics, actor_steps=of_actor, updates=self._n_updates,
            policy_delay=self.policy_delay, tau=float(self.tau),
        )  # fmt: skip
        for count, samples, actions in _batches(self, networks.dtype, gradient_steps, batch_size):
            noise = torch.empty_like(actions)
            for one in noise:  # a draw for all steps would be another one
                one.normal_(0, self.target_policy_noise)
            noise.clamp_(-self.target_noise_clip, self.target_noise_clip)
            recorded.append(np.zeros((count, td3.N_RECORDED)))
            made = td3.prepare(networks.dtype)(
                m, layout.plan, layout.layers, settings, *samples,
                noise.view(-1, networks.shape.outputs).numpy().astype(networks.dtype), batch_size, recorded[-1],
            )  # fmt: skip
            settings = settings._replace(
                critic_steps=settings.critic_steps + count, actor_steps=settings.actor_steps + made,
                updates=settings.updates + count,
            )  # fmt: skip
        networks.keep(m, batch_size, [settings.actor_steps, settings.critic_steps])
        numbers = np.arange(self._n_updates + 1, self._n_updates + gradient_steps + 1)
        self._n_updates += gradient_steps
        losses, acted = np.concatenate(recorded), numbers % self.policy_delay == 0
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if acted.any():
            self.logger.record("train/actor_loss", losses[acted, td3.ACTOR_LOSS].mean())
        self.logger.record("train/critic_loss", losses[:, td3.CRITIC_LOSS].mean())


class LeanSAC(SAC):
    """SB3's SAC for its own MlpPolicy."""

    @functools.cached_property
    def networks(self) -> Networks:
        """What learns, as the kernel takes it."""
        return Networks("sac", self, self._all_optimizers())

    def _all_optimizers(self) -> list[torch.optim.Optimizer]:
        learned = [self.ent_coef_optimizer] if self.ent_coef_optimizer is not None else []
        return [self.actor.optimizer, self.critic.optimizer, *learned]

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Learn from the replay buffer as `SAC.train` does, and record the same metrics."""
        self._update_learning_rate(self._all_optimizers())
        networks, recorded, learned = self.networks, [], self.ent_coef_optimizer is not None
        m, layout, steps = networks.laid_out(batch_size), networks.layout(batch_size), networks.steps()
        settings = sac.Settings(
            **_adam(self.critic.optimizer), steps=steps[0], made=0,
            target_update_interval=self.target_update_interval, tau=float(self.tau), learned=learned,
            ent_coef=math.nan if learned else float(self.ent_coef_tensor), target_entropy=float(self.target_entropy),
        )  # fmt: skip
        dtype = next(self.policy.parameters()).dtype
        for count, samples, _ in _batches(self, networks.dtype, gradient_steps, batch_size):
            noise = torch.empty((2, count, batch_size, networks.shape.outputs), dtype=dtype)
            for now, then in zip(*noise, strict=True):  # a draw for all steps would be another one
                now.normal_()
                then.normal_()
            recorded.append(np.zeros((count, sac.N_RECORDED)))
            sac.prepare(networks.dtype)(
                m, layout.plan, layout.layers, settings, *samples,
                *(one.view(-1, networks.shape.outputs).numpy() for one in noise), batch_size, recorded[-1],
            )  # fmt: skip
            settings = settings._replace(steps=settings.steps + count, made=settings.made + count)
        networks.keep(m, batch_size, [settings.steps] * len(steps))
        self._n_updates += gradient_steps
        means = np.concatenate(recorded).mean(axis=0)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/ent_coef", means[sac.ENT_COEF])
        self.logger.record("train/actor_loss", means[sac.ACTOR_LOSS])
        self.logger.record("train/critic_loss", means[sac.CRITIC_LOSS])
        if learned:
            self.logger.record("train/ent_coef_loss", means[sac.ENT_COEF_LOSS])


LEAN: dict[str, Any] = {"dqn": LeanDQN, "td3": LeanTD3, "sac": LeanSAC}


def joined(tensors: Sequence[torch.Tensor]) -> Array:
    """All their numbers, one after another."""
    return np.concatenate([tensor.detach().numpy().ravel() for tensor in tensors])
