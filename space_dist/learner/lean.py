"""SB3's PPO update of small multilayer perceptrons without the dispatch: `learner.update: lean`.

Nine tenths of a stock update are Python, autograd, and an optimiser of thirteen little tensors. Here actor and critic
are stacked, all numbers are one vector, and the derivatives of SB3's loss are written out. Everything else is SB3's:
the minibatches (its buffer's, by its draws), and networks and optimiser, which hold their state before and after each
update. `tests/test_lean.py` holds losses, gradients, norms and weights against `PPO.train`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.utils import explained_variance
from torch import Tensor, nn

_HALF_LOG_2_PI = 0.5 * math.log(2.0 * math.pi)


class LeanPPO(PPO):
    """SB3's PPO for its own MlpPolicy."""

    def train(self) -> None:
        """Update from the rollout buffer as `PPO.train` does, and record the same metrics."""
        policy, optimizer = self.policy, self.policy.optimizer
        self._update_learning_rate(optimizer)
        clip_range = float(self.clip_range(self._current_progress_remaining))  # type: ignore[operator]
        with torch.no_grad():
            network, adam = _Network(policy), _Adam(optimizer, _parameters(policy))
        epochs: list[_Losses] = []
        with torch.inference_mode():
            while len(epochs) < self.n_epochs and (not epochs or epochs[-1].finished):
                epochs.append(self._epoch(network, adam, clip_range))
        self._n_updates += len(epochs)
        with torch.no_grad():
            network.write_back()
            adam.write_back()
        for name, value in self._metrics(epochs, clip_range).items():
            self.logger.record(f"train/{name}", value)

    def _epoch(self, network: _Network, adam: _Adam, clip_range: float) -> _Losses:
        """One pass over the buffer, or what of it keeps `target_kl`."""
        (sample,) = self.rollout_buffer.get(None)  # all of it, permuted: a minibatch of SB3's is the next slice
        dtype, size = network.weights.flat.dtype, self.batch_size
        shares = _shares(len(sample.returns), size, dtype)
        advantages = sample.advantages.to(dtype)
        gains = -shares * (_normalised(advantages, size) if self.normalize_advantage else advantages)
        columns = (
            sample.observations.to(dtype), network.head.actions(sample.actions), sample.old_log_prob.to(dtype),
            gains, sample.returns.to(dtype), shares,
        )  # fmt: skip
        losses = _Losses(shares, clip_range)
        for observations, actions, old_log_probs, gain, returns, share in zip(
            *(torch.split(column, size) for column in columns), strict=True
        ):
            outputs, values = network.forward(observations)
            log_ratios = network.head.log_probs(outputs, actions) - old_log_probs
            ratios, errors = log_ratios.exp(), values - returns
            unclipped, clipped = gain * ratios, gain * ratios.clamp(1.0 - clip_range, 1.0 + clip_range)
            losses.take(log_ratios, torch.maximum(unclipped, clipped), errors, network.head.entropy())
            if self.target_kl is not None and float(_divergence(log_ratios).mean()) > 1.5 * self.target_kl:
                losses.finished = False
                break
            # d exp(x) = exp(x) dx, and nothing where the clipped part is the larger; d e^2 = 2 e de.
            by_log_probs = unclipped * (unclipped >= clipped)
            by_outputs = network.head.backward(by_log_probs, self.ent_coef * share)
            network.backward(by_outputs, errors * share * (2.0 * self.vf_coef))
            clip_norm(network.gradient.flat, self.max_grad_norm)
            adam.step(network.weights.flat, network.gradient.flat)
        return losses

    def _metrics(self, epochs: Sequence[_Losses], clip_range: float) -> dict[str, float]:
        """What `PPO.train` records: means over minibatches, of the divergence those of the last epoch."""
        number = sum(len(epoch) for epoch in epochs)
        entropy, policy, value, clipped = (
            sum(parts) / number for parts in zip(*(epoch.sums() for epoch in epochs), strict=True)
        )
        last_policy, last_value, last_entropy = epochs[-1].last()
        buffer = self.rollout_buffer
        metrics = {
            "entropy_loss": -entropy,
            "policy_gradient_loss": policy,
            "value_loss": value,
            "approx_kl": epochs[-1].divergence(),
            "clip_fraction": clipped,
            "loss": last_policy - self.ent_coef * last_entropy + self.vf_coef * last_value,
            "explained_variance": float(explained_variance(buffer.values.flatten(), buffer.returns.flatten())),
        }
        if hasattr(self.policy, "log_std"):
            metrics["std"] = float(self.policy.log_std.detach().exp().mean())
        return metrics | {"n_updates": self._n_updates, "clip_range": clip_range}


class _Losses:
    """The minibatches of an epoch as far as it came: tensors are kept, and summed once.

    shares: (n,) one by the size of a transition's minibatch: sums with it are sums of the minibatches' means.
    """

    def __init__(self, shares: Tensor, clip_range: float) -> None:
        self._shares, self._clip_range = shares, clip_range
        self._taken: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
        self.finished = True

    def __len__(self) -> int:
        return len(self._taken)

    def take(self, log_ratios: Tensor, surrogates: Tensor, errors: Tensor, entropy: Tensor) -> None:
        """A minibatch: (m,) each, surrogates times their shares; and the mean entropy."""
        self._taken.append((log_ratios, surrogates, errors, entropy))

    def sums(self) -> tuple[float, float, float, float]:
        """Of the minibatches' entropies, policy losses, value losses and clipped fractions."""
        log_ratios, surrogates, errors = self._columns()
        shares = self._shares[: len(errors)]
        clipped = ((log_ratios.exp() - 1.0).abs() > self._clip_range).to(shares.dtype)
        entropies = torch.stack([entropy for *_, entropy in self._taken])
        return (
            float(entropies.sum()), float(surrogates.sum()), float(shares @ errors.square()), float(shares @ clipped),
        )  # fmt: skip

    def divergence(self) -> float:
        """Mean over the minibatches of their mean divergences from the policy that acted."""
        log_ratios, *_ = self._columns()
        return float(self._shares[: len(log_ratios)] @ _divergence(log_ratios)) / len(self)

    def last(self) -> tuple[float, float, float]:
        """Policy loss, value loss and mean entropy of the last minibatch."""
        _, surrogates, errors, entropy = self._taken[-1]
        return float(surrogates.sum()), float(errors.square().mean()), float(entropy)

    def _columns(self) -> list[Tensor]:
        return [torch.cat(parts) for parts in zip(*(taken[:3] for taken in self._taken), strict=True)]


class _Adam:
    """`torch.optim.Adam`, its arithmetic on one vector instead of on many, from and to an optimiser's own state."""

    def __init__(self, optimizer: torch.optim.Optimizer, parameters: Sequence[nn.Parameter]) -> None:
        (group,) = optimizer.param_groups
        self._rate, self._betas, self._eps = float(group["lr"]), group["betas"], group["eps"]
        self._state, self._parameters = optimizer.state, parameters
        known = parameters[0] in optimizer.state
        self._steps = int(optimizer.state[parameters[0]]["step"]) if known else 0
        self._mean, self._square = (
            torch.cat(
                [(optimizer.state[each][name] if known else torch.zeros_like(each)).flatten() for each in parameters]
            )
            for name in ("exp_avg", "exp_avg_sq")
        )
        self._denominator = torch.empty_like(self._mean)

    def step(self, weights: Tensor, gradient: Tensor) -> None:
        """One step, in place."""
        (beta, beta_square), self._steps = self._betas, self._steps + 1
        self._mean.lerp_(gradient, 1.0 - beta)
        self._square.mul_(beta_square).addcmul_(gradient, gradient, value=1.0 - beta_square)
        torch.sqrt(self._square, out=self._denominator)
        self._denominator.div_(math.sqrt(1.0 - beta_square**self._steps)).add_(self._eps)
        weights.addcdiv_(self._mean, self._denominator, value=-self._rate / (1.0 - beta**self._steps))

    def write_back(self) -> None:
        """Give the optimiser its state."""
        means, squares = (_parts(vector, self._parameters) for vector in (self._mean, self._square))
        for parameter, mean, square in zip(self._parameters, means, squares, strict=True):
            self._state[parameter] = {
                "step": torch.tensor(float(self._steps)), "exp_avg": mean.clone(), "exp_avg_sq": square.clone(),
            }  # fmt: skip


def clip_norm(gradient: Tensor, largest: float) -> float:
    """`torch.nn.utils.clip_grad_norm_` of one vector; returns the norm before."""
    norm = float(torch.linalg.vector_norm(gradient))
    if largest / (norm + 1e-6) < 1.0:
        gradient.mul_(largest / (norm + 1e-6))
    return norm


@dataclass(frozen=True)
class _Vector:
    """All numbers of an actor-critic, in the order of `_parameters`, and views of them.

    hidden: of each hidden layer, weights (2, n_out, n_in) and biases (2, 1, n_out): the actor's and the critic's.
    actor: weights (n_outputs, n_in) and biases (n_outputs,) of its last layer; critic: (n_in,) and (1,).
    log_std: (n_outputs,) of Gaussian actions; (0,) of categorical ones.
    """

    flat: Tensor
    hidden: tuple[tuple[Tensor, Tensor], ...]
    actor: tuple[Tensor, Tensor]
    critic: tuple[Tensor, Tensor]
    log_std: Tensor

    @classmethod
    def of(cls, flat: Tensor, policy: Any) -> _Vector:
        """The views of a vector."""
        start = 0

        def cut(*shape: int) -> Tensor:
            nonlocal start
            start += math.prod(shape)
            return flat[start - math.prod(shape) : start].view(shape)

        hidden = tuple(
            (cut(2, layer.out_features, layer.in_features), cut(2, 1, layer.out_features))
            for layer in _linear(policy.mlp_extractor.policy_net)
        )
        actor = (cut(*policy.action_net.weight.shape), cut(*policy.action_net.bias.shape))
        critic = (cut(policy.value_net.in_features), cut(1))
        return cls(flat, hidden, actor, critic, cut(len(flat) - start))


def _parameters(policy: Any) -> list[nn.Parameter]:
    """All of them: what is stacked side by side, the log standard deviation last."""
    extractor = policy.mlp_extractor
    pairs = zip(_linear(extractor.policy_net), _linear(extractor.value_net), strict=True)
    hidden = [part for pair in pairs for name in ("weight", "bias") for part in (getattr(each, name) for each in pair)]
    heads = [part for head in (policy.action_net, policy.value_net) for part in (head.weight, head.bias)]
    return [*hidden, *heads, *([policy.log_std] if hasattr(policy, "log_std") else [])]


def _linear(network: nn.Module) -> list[nn.Linear]:
    return [layer for layer in network.children() if isinstance(layer, nn.Linear)]


def _parts(vector: Tensor, parameters: Sequence[nn.Parameter]) -> list[Tensor]:
    """A vector cut into the parameters' shapes."""
    parts = torch.split(vector, [parameter.numel() for parameter in parameters])
    return [part.view_as(parameter) for part, parameter in zip(parts, parameters, strict=True)]


_ACTIVATIONS: dict[type[nn.Module], tuple[Callable[[Tensor], Tensor], Callable[[Tensor, Tensor], Tensor]]] = {
    nn.Tanh: (torch.tanh_, torch.ops.aten.tanh_backward),
    nn.ReLU: (torch.relu_, lambda gradient, result: torch.ops.aten.threshold_backward(gradient, result, 0)),
}


class _Network:
    """Actor and critic side by side, and the derivatives of a loss by their numbers."""

    def __init__(self, policy: Any) -> None:
        self._parameters = _parameters(policy)
        self.weights = _Vector.of(torch.cat([parameter.flatten() for parameter in self._parameters]), policy)
        self.gradient = _Vector.of(torch.zeros_like(self.weights.flat), policy)
        self.head = (_Gaussian if hasattr(policy, "log_std") else _Categorical)(self.weights, self.gradient)
        self._activate, self._through = _ACTIVATIONS[policy.activation_fn]
        self._results: list[Tensor] = []
        self._transposed = [weights.transpose(1, 2) for weights, _ in self.weights.hidden]
        self._actor_transposed = self.weights.actor[0].t()

    def forward(self, observations: Tensor) -> tuple[Tensor, Tensor]:
        """`(m, n_in) -> (m, n_outputs), (m,)`: the actor's outputs and the critic's values."""
        result = observations.expand(2, *observations.shape)
        self._results = [result]
        for (_, biases), weights in zip(self.weights.hidden, self._transposed, strict=True):
            result = self._activate(torch.baddbmm(biases, result, weights))
            self._results.append(result)
        (_, actor_bias), (critic, critic_bias) = self.weights.actor, self.weights.critic
        return torch.addmm(actor_bias, result[0], self._actor_transposed), torch.mv(result[1], critic) + critic_bias

    def backward(self, by_outputs: Tensor, by_values: Tensor) -> None:
        """Fill the gradient, but for the head's part, from the loss's derivatives by what `forward` returned."""
        (actor, _), (critic, _) = self.weights.actor, self.weights.critic
        (by_actor, by_actor_bias), (by_critic, by_critic_bias) = self.gradient.actor, self.gradient.critic
        result = self._results[-1]
        torch.mm(by_outputs.t(), result[0], out=by_actor)
        torch.sum(by_outputs, 0, out=by_actor_bias)
        torch.mv(result[1].t(), by_values, out=by_critic)
        torch.sum(by_values, 0, keepdim=True, out=by_critic_bias)
        by_results = torch.empty_like(result)
        torch.mm(by_outputs, actor, out=by_results[0])
        torch.outer(by_values, critic, out=by_results[1])
        for layer in reversed(range(len(self.weights.hidden))):
            by_sums = self._through(by_results, self._results[layer + 1])
            by_weights, by_biases = self.gradient.hidden[layer]
            torch.bmm(by_sums.transpose(1, 2), self._results[layer], out=by_weights)
            torch.sum(by_sums, 1, keepdim=True, out=by_biases)
            if layer:
                by_results = torch.bmm(by_sums, self.weights.hidden[layer][0])

    def write_back(self) -> None:
        """Give the policy its numbers."""
        for parameter, part in zip(self._parameters, _parts(self.weights.flat, self._parameters), strict=True):
            parameter.copy_(part)


class _Gaussian:
    """Independent normal actions around the outputs, with a standard deviation each that no observation changes."""

    def __init__(self, weights: _Vector, gradient: _Vector) -> None:
        self._log_std, self._by_log_std = weights.log_std, gradient.log_std

    def actions(self, stored: Tensor) -> Tensor:
        """As the buffer keeps them: (m, n_actions)."""
        return stored.to(self._log_std.dtype)

    def log_probs(self, outputs: Tensor, actions: Tensor) -> Tensor:
        """(m,)"""
        self._scale = torch.exp(-self._log_std)
        self._deviations = (actions - outputs) * self._scale
        self._squares = self._deviations.square()
        self._volume = self._log_std.sum() + len(self._log_std) * _HALF_LOG_2_PI
        return torch.add(-self._volume, self._squares.sum(1), alpha=-0.5)

    def entropy(self) -> Tensor:
        """() of the distributions of the last log-probabilities."""
        return self._volume + 0.5 * len(self._log_std)

    def backward(self, by_log_probs: Tensor, bonus: Tensor) -> Tensor:
        """`(m,), (m,) -> (m, n_actions)`: derivatives by the outputs, of log-probabilities and of -bonus * entropy."""
        torch.mv(self._squares.t(), by_log_probs, out=self._by_log_std)
        self._by_log_std.sub_((by_log_probs + bonus).sum())
        return self._deviations * self._scale * by_log_probs[:, None]


class _Categorical:
    """One of as many actions as there are outputs, which are logits."""

    def __init__(self, weights: _Vector, gradient: _Vector) -> None:
        pass

    def actions(self, stored: Tensor) -> Tensor:
        """(m, 1) indices, which the buffer keeps as numbers."""
        return stored.long()

    def log_probs(self, outputs: Tensor, actions: Tensor) -> Tensor:
        """(m,)"""
        self._actions, self._logs = actions, torch.log_softmax(outputs, 1)
        self._probs = self._logs.exp()
        self._entropies = -(self._probs * self._logs).sum(1)
        return self._logs.gather(1, actions)[:, 0]

    def entropy(self) -> Tensor:
        """() of the distributions of the last log-probabilities: their mean."""
        return self._entropies.mean()

    def backward(self, by_log_probs: Tensor, bonus: Tensor) -> Tensor:
        """`(m,), (m,) -> (m, n_outputs)`: derivatives by the logits, of log-probabilities and of -bonus * entropy."""
        by_logs = (self._logs + self._entropies[:, None]) * bonus[:, None] - by_log_probs[:, None]
        return (self._probs * by_logs).scatter_add_(1, self._actions, by_log_probs[:, None])


def _shares(n: int, size: int, dtype: torch.dtype) -> Tensor:
    """`(n,)` one by the size of the minibatch that each of n transitions is in; the last may be smaller."""
    shares = torch.full((n,), 1.0 / size, dtype=dtype)
    if n % size:
        shares[n - n % size :] = 1.0 / (n % size)
    return shares


def _normalised(advantages: Tensor, size: int) -> Tensor:
    """Advantages with mean 0 and standard deviation 1 within each minibatch, as `PPO.train` scales them."""
    whole = len(advantages) // size * size
    parts = [advantages[:whole].view(-1, size), advantages[whole:].view(1, -1)]
    return torch.cat(
        [
            (part if part.shape[1] == 1 else (part - part.mean(1, True)) / (part.std(1, keepdim=True) + 1e-8)).flatten()
            for part in parts
            if part.numel()
        ]
    )


def _divergence(log_ratios: Tensor) -> Tensor:
    """SB3's estimate of the divergence, per transition (http://joschu.net/blog/kl-approx.html)."""
    return (log_ratios.exp() - 1.0) - log_ratios
