"""Many actor-critics of one shape updated in one tensor program: PPO as in Stable-Baselines3's `PPO.train`.

Members, and why their bits do not depend on each other: `stack`. The gradients are written by hand:

    log pi(a|s)    Gaussian -|z|^2/2 - sum(log sigma) - n/2 log(2 pi), z = (a - mu) / sigma; or the log-softmax at a
    r = exp(log pi - log pi_old)
    policy loss    -mean(min(A r, A clip(r, 1 - eps, 1 + eps)))        d/d log pi = -A r / B where the first is least
    value loss     mean((V - R)^2)
    entropy loss   -mean(H)
    loss           policy loss + ent_coef * entropy loss + vf_coef * value loss

then the member's gradient is scaled to at most `max_grad_norm`, and its Adam makes a step.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from space_dist.learner.heads import head_of
from space_dist.learner.stack import ACTOR, CRITIC, ROWS, Adam, Stack, column, rounded_up, split

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Samples:
    """What P members learn from: N samples each, in float32 as SB3's buffer keeps them, on the stack's device.

    observations: (P, N, inputs).  actions: (P, N, action dimensions), or (P, N, 1) numbers of discrete ones.
    log_probs, advantages, returns: (P, N).
    """

    observations: torch.Tensor
    actions: torch.Tensor
    log_probs: torch.Tensor
    advantages: torch.Tensor
    returns: torch.Tensor

    def packed(self, dtype: torch.dtype) -> torch.Tensor:
        """`(P, N, n)` all that belongs to a sample side by side, so that to gather it costs one visit to the memory."""
        numbers = torch.stack([self.log_probs, self.returns, self.advantages], dim=2)
        return torch.cat([self.observations, self.actions.float(), numbers], dim=2).to(dtype)


@dataclass(frozen=True)
class PPOSettings:
    """One member's own. max_grad_norm, target_kl: infinite for none."""

    learning_rate: float
    clip_range: float
    ent_coef: float
    vf_coef: float
    max_grad_norm: float
    target_kl: float
    normalize_advantage: bool


@dataclass(frozen=True)
class Report:
    """What one member's update says of itself. metrics: under SB3's names.  updates: by how many its count grows."""

    metrics: dict[str, float]
    updates: int


class Minibatches:
    """`count` minibatches of `size` samples a member, drawn anew each epoch into the same memory.

    Everything has `rows`, a multiple of ROWS, instead of `size`; those too many are samples that count nothing.
    inputs: (count, 2P, rows, inputs).  actions: (count, P, action dimensions, rows).  offsets: (count, P, rows) minus
    the log-probabilities.  returns: likewise.  pulls: minus the advantages, scaled if they are to be, by the size.
    log_ratios, losses, errors: what the minibatches gave, of each sample.  entropies: (count, P) means.
    """

    def __init__(self, stack: Stack, packed: torch.Tensor, size: int, count: int, normalized: torch.Tensor) -> None:
        self.count, self.size, self.rows = count, size, rounded_up(size, ROWS)
        self._stack, self._packed, self._normalized = stack, packed, normalized
        shape, device = stack.shape, stack.device
        each = (count, stack.members, self.rows)

        def empty(*sizes: int, dtype: torch.dtype = stack.dtype) -> torch.Tensor:
            return torch.empty(sizes, dtype=dtype, device=device)

        self.inputs = empty(count, 2 * stack.members, self.rows, shape.inputs)
        wide, kind = (1, torch.int64) if shape.discrete else (shape.outputs, stack.dtype)
        self.actions = empty(count, stack.members, wide, self.rows, dtype=kind)
        self.offsets, self.returns, self.pulls = empty(*each), empty(*each), empty(*each)
        self._drawn = empty(*each, packed.shape[2])
        self._observations, self._actions = self._drawn[..., : shape.inputs], self._drawn[..., shape.inputs : -3]
        self._log_probs, self._returns, self._unscaled = self._drawn[..., -3:].unbind(3)
        self._advantages = empty(*each, dtype=torch.float32)
        self.log_ratios, self.losses, self.errors = empty(*each), empty(*each), empty(*each)
        self.entropies = empty(count, stack.members)

    def draw(self, places: NDArray[np.int64]) -> None:
        """Gather samples: (P, count * size) places in each member's."""
        members, size = self._stack.members, self.size
        index = np.zeros((self.count, members, self.rows), dtype=np.int64)
        index[:, :, :size] = places.reshape(members, self.count, size).swapaxes(0, 1)
        index += np.arange(members)[:, None] * self._packed.shape[1]
        which = torch.from_numpy(index.reshape(-1)).to(self._stack.device)
        torch.index_select(self._packed.flatten(0, 1), 0, which, out=self._drawn.flatten(0, 2))
        split(self.inputs, 1, (members, 2)).copy_(self._observations[:, :, None])
        self.actions.copy_(self._actions.transpose(2, 3))
        torch.neg(self._log_probs, out=self.offsets)
        self.returns.copy_(self._returns)
        self._advantages.copy_(self._unscaled)
        if size > 1:  # as SB3, and as there in float32
            mine = self._advantages[:, :, :size]
            exact = mine.double()  # to float32's last digit what torch.std says, in a sixth of its time
            exact -= exact.mean(2, keepdim=True)
            deviation = exact.square_().sum(2, keepdim=True).div_(size - 1).sqrt_().float()
            self._advantages.sub_(mine.mean(2, keepdim=True) * self._normalized)
            self._advantages.div_(torch.where(self._normalized > 0.0, deviation + 1e-8, 1.0))
        self.pulls.copy_(self._advantages).div_(-size)
        self.pulls[:, :, size:] = 0.0


def parts_of(stack: Stack, packed: torch.Tensor, size: int, normalized: torch.Tensor) -> list[Minibatches]:
    """An epoch's minibatches: those of `size`, and the smaller one that is left, if any."""
    whole, rest = divmod(packed.shape[1], size)
    kinds = ((size, whole), (rest, 1))
    return [Minibatches(stack, packed, each, count, normalized) for each, count in kinds if each * count]


class PPO:
    """The epochs of one update of all members."""

    def __init__(
        self, stack: Stack, samples: Samples, settings: Sequence[PPOSettings], batch_size: int
    ) -> None:  # fmt: skip
        self._stack, self._settings = stack, settings
        self._entropy = column(stack, (one.ent_coef for one in settings))
        self._vf = column(stack, (one.vf_coef for one in settings))
        self._max_norm = column(stack, (one.max_grad_norm for one in settings))
        self._clip = column(stack, (one.clip_range for one in settings))
        self._low = column(stack, (1.0 - one.clip_range for one in settings))
        self._high = column(stack, (1.0 + one.clip_range for one in settings))
        # SB3 stops an update at 1.5 `target_kl`.
        self._limits = column(stack, (1.5 * one.target_kl for one in settings))[:, 0]
        self._watched = any(math.isfinite(one.target_kl) for one in settings)
        normalized = column(stack, (float(one.normalize_advantage) for one in settings), torch.float32)
        self._parts = parts_of(stack, samples.packed(stack.dtype), batch_size, normalized)
        self._adam = Adam(stack, [one.learning_rate for one in settings])

    def run(self, orders: Iterable[NDArray[np.int64]]) -> list[Report]:
        """One epoch for each (P, N) of `orders`: each member's permutation of its samples."""
        members = self._stack.members
        self._active = [True] * members
        made, epochs, last = [0] * members, [0] * members, [0] * members
        records: list[tuple[torch.Tensor, ...]] = []
        for order in orders:
            for member in range(members):
                if self._active[member]:
                    last[member], epochs[member] = made[member], epochs[member] + 1
            first = 0
            for part in self._parts:
                part.draw(order[:, first : first + part.size * part.count])
                first += part.size * part.count
                records.append(self._learn(part, made))
            if not any(self._active):
                break
        columns = [torch.cat(parts).cpu().numpy() for parts in zip(*records, strict=True)]
        return [
            self._report(member, [column[: made[member], member] for column in columns], epochs[member], last[member])
            for member in range(members)
        ]

    def _report(self, member: int, columns: Sequence[Array], epochs: int, last: int) -> Report:
        """Of a member's minibatches, the last of which may have been refused by `target_kl`; `last`: epoch's first."""
        policy, value, entropy, divergence, clipped = columns
        own = self._settings[member]
        metrics = {
            "entropy_loss": entropy.mean(),
            "policy_gradient_loss": policy.mean(),
            "value_loss": value.mean(),
            "approx_kl": divergence[last:].mean(),
            "clip_fraction": clipped.mean(),
            "loss": policy[-1] + own.ent_coef * entropy[-1] + own.vf_coef * value[-1],
            "clip_range": own.clip_range,
        }
        return Report({name: float(metric) for name, metric in metrics.items()}, epochs)

    def _learn(self, batches: Minibatches, made: list[int]) -> tuple[torch.Tensor, ...]:
        """All minibatches. Returns (count, P) policy, value and entropy losses, divergences, clip fractions."""
        stack, members, size, rows = self._stack, self._stack.members, batches.size, batches.rows
        networks = stack.networks(rows)
        outputs = split(networks.outputs, 0, (members, 2))
        gradients = split(networks.output_gradients, 0, (members, 2))
        values, value_gradients = outputs[:, CRITIC, 0], gradients[:, CRITIC, 0]
        head = head_of(stack, outputs[:, ACTOR], gradients[:, ACTOR], size)
        low, high = (bound.expand(members, rows).contiguous() for bound in (self._low, self._high))
        value_scale = (self._vf * 2.0 / size).repeat(1, rows)
        value_scale[:, size:] = 0.0
        views = (
            tensor.unbind(0)
            for tensor in (
                batches.inputs, batches.actions, batches.offsets, batches.pulls, batches.returns,
                batches.log_ratios, batches.losses, batches.errors, batches.entropies,
            )
        )  # fmt: skip
        for inputs, actions, offsets, pulls, returns, log_ratio, loss, error, entropy in zip(*views, strict=True):
            networks.forward(inputs)
            head.log_prob(actions, offsets, log_ratio)
            head.entropy(entropy)
            ratio = torch.exp(log_ratio)
            clipped = torch.clamp(ratio, low, high).mul_(pulls)
            pull = ratio.mul_(pulls)
            torch.maximum(pull, clipped, out=loss)
            pull.mul_(pull >= clipped)
            torch.sub(values, returns, out=error)
            for member, active in enumerate(self._active):
                made[member] += active
            if self._watched and not self._keep_going(log_ratio[:, :size]):
                break
            torch.mul(error, value_scale, out=value_gradients)
            head.backward(pull, self._entropy)
            networks.backward(inputs)
            self.gradient_step()
        log_ratios = batches.log_ratios[:, :, :size]
        return (
            batches.losses[:, :, :size].sum(2),
            batches.errors[:, :, :size].square().mean(2),
            -batches.entropies,
            _divergence(log_ratios),
            ((log_ratios.exp() - 1.0).abs() > self._clip).to(stack.dtype).mean(2),
        )

    def gradient_step(self) -> None:
        """Clip each member's gradient, and let its Adam make a step."""
        # 1e-6: as torch's `clip_grad_norm_`.
        norms = torch.linalg.vector_norm(self._stack.gradient, dim=(1, 2)).add_(1e-6)
        self._stack.gradient.mul_(torch.div(self._max_norm[:, 0], norms).clamp_(max=1.0)[:, None, None])
        self._adam.step()

    def _keep_going(self, log_ratios: torch.Tensor) -> bool:
        """Stop members whose policy is farther from the one that acted than 1.5 `target_kl`."""
        stops = (_divergence(log_ratios) > self._limits).tolist()
        if any(stops):
            self._active = [active and not stop for active, stop in zip(self._active, stops, strict=True)]
            self._adam.move(self._active)
        return any(self._active)


def _divergence(log_ratios: torch.Tensor) -> torch.Tensor:
    """Schulman's estimate of the reverse KL divergence: the mean of (r - 1) - log r."""
    return torch.expm1(log_ratios).sub_(log_ratios).mean(-1)
