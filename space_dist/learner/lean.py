"""SB3's PPO update of small multilayer perceptrons as one compiled function: `learner.update: lean`.

Nine tenths of a stock update are Python, autograd, and an optimiser of thirteen little tensors. `kernels.ppo` has the
derivatives of SB3's loss written out, and all epochs in one call. Everything else is SB3's: the buffer, the minibatches
(by its draws), and networks and optimiser, which hold their state before and after each update. `tests/test_lean.py`
holds losses, gradients, norms and weights against `PPO.train`.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.utils import explained_variance
from torch import nn

from space_dist.kernels import Layout, Settings, Shape, aligned, prepare
from space_dist.kernels.ppo import CLIPPED, DIVERGENCE, ENTROPY, N_RECORDED, POLICY_LOSS, VALUE_LOSS

Array = NDArray[np.floating[Any]]
_ROWS = 64  # samples that are evaluated together; no result depends on it
_PARTS = (0, 2, 3)  # of a layout's parameters, gradients, means and squares: those that outlive an update


class LeanBuffer(RolloutBuffer):
    """SB3's, with its advantages computed by a compiled function, to the bit."""

    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: NDArray[np.bool_]) -> None:
        """See SB3's; last_values: (n_envs,) or (n_envs, 1)."""
        last = last_values.numpy().flatten()
        prepare(last.dtype).advantages(
            self.rewards, self.values, self.episode_starts, last, dones.astype(np.float32), self.gamma,
            self.gamma * self.gae_lambda, self.advantages,
        )  # fmt: skip
        self.returns = self.advantages + self.values


class LeanPPO(PPO):
    """SB3's PPO for its own MlpPolicy."""

    def _setup_model(self) -> None:
        self.rollout_buffer_class = LeanBuffer
        super()._setup_model()

    _network: Network | None = None

    @property
    def network(self) -> Network:
        """The policy, as the kernel takes it."""
        if self._network is None or not self._network.is_of(self.policy):
            self._network = Network(self.policy)
        return self._network

    def __getstate__(self) -> dict[str, Any]:
        """Without what is laid out for the kernel: a copy has a policy of its own."""
        return {name: value for name, value in self.__dict__.items() if name != "_network"}

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_network"]

    def train(self) -> None:
        """Update from the rollout buffer as `PPO.train` does, and record the same metrics."""
        self._update_learning_rate(self.policy.optimizer)
        buffer = self.rollout_buffer
        samples = self.network.packed(
            *(buffer.swap_and_flatten(array) if not buffer.generator_ready else array
              for array in (buffer.observations, buffer.actions, buffer.log_probs, buffer.advantages, buffer.returns,
                            buffer.values))
        )  # fmt: skip
        orders = np.stack([np.random.permutation(len(samples)) for _ in range(self.n_epochs)])  # noqa: NPY002 - as SB3
        report = self.network.update(samples, orders, self.batch_size, self._settings())
        self._n_updates += report.epochs
        for name, value in self._metrics(report).items():
            self.logger.record(f"train/{name}", value)

    def evaluate(self, observations: Array, actions: NDArray[Any] | None = None) -> tuple[Array, Array]:
        """`(n, inputs), (n, ...) -> (n,), (n,)` values and actions' log-probabilities, to the bit as an update's."""
        packed = self.network.packed(observations, np.zeros(()) if actions is None else actions)
        return self.network.evaluate(packed)

    def _settings(self) -> Settings:
        (group,) = self.policy.optimizer.param_groups
        remaining = self._current_progress_remaining
        clip: Any = self.clip_range
        clip_vf: Any = self.clip_range_vf
        return Settings(
            learning_rate=float(group["lr"]), beta=group["betas"][0], beta_square=group["betas"][1],
            eps=float(group["eps"]), steps=0, clip_range=float(clip(remaining)),
            clip_range_vf=math.inf if clip_vf is None else float(clip_vf(remaining)),
            ent_coef=float(self.ent_coef), vf_coef=float(self.vf_coef), max_grad_norm=float(self.max_grad_norm),
            target_kl=math.inf if self.target_kl is None else float(self.target_kl),
            normalize_advantage=bool(self.normalize_advantage),
        )  # fmt: skip

    def _metrics(self, report: Report) -> dict[str, float]:
        """What `PPO.train` records: means over minibatches, of the divergence those of the last epoch."""
        recorded, buffer, settings = report.recorded, self.rollout_buffer, self._settings()
        last = recorded[-1]
        metrics = {
            "entropy_loss": -recorded[:, ENTROPY].mean(),
            "policy_gradient_loss": recorded[:, POLICY_LOSS].mean(),
            "value_loss": recorded[:, VALUE_LOSS].mean(),
            "approx_kl": recorded[report.last_epoch :, DIVERGENCE].mean(),
            "clip_fraction": recorded[:, CLIPPED].mean(),
            "loss": last[POLICY_LOSS] - self.ent_coef * last[ENTROPY] + self.vf_coef * last[VALUE_LOSS],
            "explained_variance": explained_variance(buffer.values.flatten(), buffer.returns.flatten()),
        }
        if hasattr(self.policy, "log_std"):
            metrics["std"] = self.policy.log_std.detach().exp().mean()
        metrics |= {"n_updates": self._n_updates, "clip_range": settings.clip_range}
        if self.clip_range_vf is not None:
            metrics["clip_range_vf"] = settings.clip_range_vf
        return {name: float(value) for name, value in metrics.items()}


@dataclass(frozen=True)
class Report:
    """What an update says of itself.

    recorded: (minibatches, kernels.ppo.N_RECORDED), the last of which `target_kl` may have refused.
    last_epoch: the first minibatch of the last one.
    """

    recorded: NDArray[np.float64]
    epochs: int
    last_epoch: int


class Network:
    """An SB3 policy, and its optimiser's memory, laid out for the kernel; SB3's own stay the truth.

    SB3's tensors are views of one array here, `(3, n)` weights and Adam's means and squares, so that all numbers go to
    the kernel and back at once.
    """

    def __init__(self, policy: Any) -> None:
        self._policy, (self._names, self._parameters) = policy, zip(*policy.named_parameters(), strict=True)
        weight = policy.action_net.weight
        self._dtype, self._shape = weight.detach().numpy().dtype, shape_of(policy)
        sizes = [parameter.numel() for parameter in self._parameters]
        self._numbers = np.zeros((3, sum(sizes)), dtype=self._dtype)
        ends = np.cumsum([0, *sizes])
        self._places = [slice(*ends_of_one) for ends_of_one in itertools.pairwise(ends)]
        self._addresses = [self._numbers[0, place].ctypes.data for place in self._places]
        self._means, self._squares = (
            [part.view_as(parameter) for part, parameter in zip(torch.split(row, sizes), self._parameters, strict=True)]
            for row in torch.from_numpy(self._numbers[1:])
        )

    def is_of(self, policy: Any) -> bool:
        """Whether it is laid out for this policy as it is now: its tensors may be others, but not of another type."""
        theirs = tuple(policy.parameters())
        return (
            self._policy is policy
            and len(theirs) == len(self._parameters)
            and all(
                one is mine and one.detach().numpy().dtype == self._dtype
                for one, mine in zip(theirs, self._parameters, strict=True)
            )
        )

    def packed(
        self, observations: Array, actions: NDArray[Any], log_probs: Any = 0.0, advantages: Any = 0.0,
        returns: Any = 0.0, values: Any = 0.0,
    ) -> Array:  # fmt: skip
        """`(n, record)`: all that belongs to a sample side by side, so that to gather it costs one visit to memory."""
        layout = self._layout(1)
        n, first = len(observations), layout.record_at
        samples = np.zeros((n, layout.plan.record), dtype=self._dtype)
        samples[:, : layout.plan.inputs] = observations.reshape(n, -1)
        count = layout.plan.fields - 4
        samples[:, first : first + count] = actions.reshape(n, -1) if actions.ndim else actions
        for offset, numbers in enumerate((log_probs, advantages, returns, values)):
            samples[:, first + count + offset] = numbers.reshape(-1) if isinstance(numbers, np.ndarray) else numbers
        return samples

    def update(self, samples: Array, orders: NDArray[np.int64], size: int, settings: Settings) -> Report:
        """Learn from the epochs' (epochs, n) permutations of samples in minibatches of `size`."""
        n = len(samples)
        layout, steps = self._layout(min(size, n)), self._gather()
        places = layout.all_places(self._names)
        m = aligned(layout.size, self._dtype)
        parts = m[: 4 * layout.plan.length].reshape(4, -1)
        for part, numbers in zip(_PARTS, self._numbers, strict=True):
            parts[part, places] = numbers
        recorded = np.zeros((len(orders) * -(-n // size), N_RECORDED))
        done, made, epochs = prepare(self._dtype).update(
            m, layout.plan, layout.layers, settings._replace(steps=steps), samples.ravel(), orders, size, recorded
        )
        self._keep(layout, parts, steps + made)
        return Report(recorded[:done], epochs, (epochs - 1) * -(-n // size))

    def _gather(self) -> int:
        """Have the array hold SB3's numbers, whoever has put other tensors in the place of its views.

        Returns the steps that Adam has made.
        """
        self._gather_weights()
        state = self._policy.optimizer.state
        if not state:
            self._numbers[1:] = 0.0
        for parameter, mean, square in zip(self._parameters, self._means, self._squares, strict=True):
            if state and state[parameter]["exp_avg"] is not mean:  # as after a checkpoint was loaded
                mean.copy_(state[parameter]["exp_avg"])
                square.copy_(state[parameter]["exp_avg_sq"])
        return max((int(one["step"]) for one in state.values()), default=0)

    def _gather_weights(self) -> None:
        for parameter, place, address in zip(self._parameters, self._places, self._addresses, strict=True):
            if parameter.data_ptr() != address:
                self._numbers[0, place] = parameter.detach().numpy().ravel()
                parameter.data = torch.from_numpy(self._numbers[0, place]).view_as(parameter)

    def _keep(self, layout: Layout, parts: Array, steps: int) -> None:
        """Give policy and optimiser their numbers, and the views of Adam's."""
        places = layout.all_places(self._names)
        for part, numbers in zip(_PARTS, self._numbers, strict=True):
            np.take(parts[part], places, out=numbers)
        for parameter, mean, square in zip(self._parameters, self._means, self._squares, strict=True):
            # As torch's Adam keeps it, so that a stock run can go on from a lean one's checkpoint.
            self._policy.optimizer.state[parameter] = {
                "step": torch.tensor(float(steps)), "exp_avg": mean, "exp_avg_sq": square,
            }  # fmt: skip

    def evaluate(self, samples: Array) -> tuple[Array, Array]:
        """`(n, record) -> (n,), (n,)`: values, and the actions' log-probabilities."""
        n = len(samples)
        layout = self._layout(_ROWS)
        m = aligned(layout.size, self._dtype)
        self._gather_weights()
        m[layout.all_places(self._names)] = self._numbers[0]
        found = np.zeros((n, layout.plan.outputs), self._dtype), np.zeros(n, self._dtype), np.zeros(n, self._dtype)
        prepare(self._dtype).evaluate(m, layout.plan, layout.layers, samples.ravel(), np.arange(n), *found)
        return found[1:]

    def _layout(self, rows: int) -> Layout:
        return Layout.of(self._shape, rows, self._dtype.itemsize)


def shape_of(policy: Any) -> Shape:
    """Of SB3's MlpPolicy."""
    extractor = policy.mlp_extractor
    hidden = [layer for layer in extractor.policy_net.children() if isinstance(layer, nn.Linear)]
    return Shape(
        inputs=hidden[0].in_features if hidden else policy.action_net.in_features,
        outputs=policy.action_net.out_features, discrete=not hasattr(policy, "log_std"),
        hidden=tuple(layer.out_features for layer in hidden),
        activation="tanh" if policy.activation_fn is nn.Tanh else "relu",
    )  # fmt: skip
