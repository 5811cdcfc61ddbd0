"""The distributions of actions that a stack's actors give, with their gradients written by hand."""

from __future__ import annotations

import math

import torch

from space_dist.learner.stack import ACTOR, CRITIC, ROWS, Stack, rounded_up, split

LOG_2PI = math.log(2.0 * math.pi)


class Gaussian:
    """Independent normal actions; means are the actor's outputs, log_std a parameter of its own."""

    def __init__(self, stack: Stack, means: torch.Tensor, gradients: torch.Tensor) -> None:
        log_std, self._dimensions = stack.layout.log_std, stack.shape.outputs
        width = rounded_up(self._dimensions, ROWS)
        self._means, self._gradients = means, gradients
        self._wide = stack.weights[:, ACTOR, :width]  # whole vectors
        self._log_std, self._log_std_gradient = (
            log_std.of(stack.weights)[:, ACTOR],
            log_std.of(stack.gradient)[:, ACTOR],
        )
        self._exponential = torch.empty_like(self._wide, memory_format=torch.contiguous_format)
        self._inverse = self._exponential[:, : self._dimensions, None]

    def log_prob(self, actions: torch.Tensor, offset: torch.Tensor, out: torch.Tensor) -> None:
        """`(P, n, rows), (P, rows) -> (P, rows)` log-probabilities plus `offset`, into `out`."""
        torch.neg(self._wide, out=self._exponential).exp_()
        self._z = torch.sub(actions, self._means).mul_(self._inverse)
        self._total = self._log_std.sum(1, keepdim=True).add_(0.5 * LOG_2PI * self._dimensions)
        torch.sub(offset - self._total, self._z.square().sum(1), alpha=0.5, out=out)

    def entropy(self, out: torch.Tensor) -> None:
        """The mean entropy of each member's last `log_prob`, into `out` (P,)."""
        torch.add(self._total[:, 0], 0.5 * self._dimensions, out=out)

    def backward(self, pull: torch.Tensor, entropy: torch.Tensor) -> None:
        """Gradients of sum(pull * log-probabilities) and the entropy loss times (P, 1) `entropy`; `pull`: (P, rows)."""
        weighted = self._z * pull[:, None]
        torch.mul(weighted, self._inverse, out=self._gradients)
        curvature = weighted.mul_(self._z).sum(2)
        torch.sub(curvature, pull.sum(1, keepdim=True).add_(entropy), out=self._log_std_gradient)

    def remember(self) -> None:
        """Take the distribution of the last `log_prob` for the old one."""
        self._old_means, self._old_inverse, self._old_wide = (
            self._means.clone(),
            self._inverse.clone(),
            self._wide.clone(),
        )

    def divergence(self, size: int) -> torch.Tensor:
        """`(P,)` means of KL(of the last `log_prob` || old) over samples and, as in sb3-contrib, action dimensions."""
        distances = (self._means - self._old_means).mul_(self._old_inverse).square_()[:, :, :size].mean((1, 2))
        logarithms = (self._wide - self._old_wide).mul_(2.0)
        spreads = logarithms.exp().sub_(1.0).sub_(logarithms)[:, : self._dimensions].mean(1)
        return distances.add_(spreads).mul_(0.5)

    def curvature(self, tangents: torch.Tensor, directions: torch.Tensor, size: int) -> None:
        """Gradients of the product of the Hessian of `divergence` with a direction.

        tangents: (P, n, rows) derivatives of the means along it.  directions: (P, length).
        """
        torch.mul(tangents, self._inverse.square() / (size * self._dimensions), out=self._gradients)
        self._gradients[:, :, size:] = 0.0
        torch.mul(directions[:, : self._dimensions], 2.0 / self._dimensions, out=self._log_std_gradient)


class Categorical:
    """Discrete actions; the actor's outputs are logits."""

    def __init__(self, logits: torch.Tensor, gradients: torch.Tensor, size: int) -> None:
        self._logits, self._gradients, self._size = logits, gradients, size

    def log_prob(self, actions: torch.Tensor, offset: torch.Tensor, out: torch.Tensor) -> None:
        """As `Gaussian.log_prob`; actions (P, 1, rows)."""
        self._actions = actions
        self._log_probs = torch.log_softmax(self._logits, dim=1)
        self._probs = torch.exp(self._log_probs)
        self._entropies = (self._probs * self._log_probs).sum(1, keepdim=True).neg_()
        torch.add(self._log_probs.gather(1, actions)[:, 0], offset, out=out)

    def entropy(self, out: torch.Tensor) -> None:
        """As `Gaussian.entropy`."""
        torch.mean(self._entropies[:, 0, : self._size], dim=1, out=out)

    def backward(self, pull: torch.Tensor, entropy: torch.Tensor) -> None:
        """As `Gaussian.backward`."""
        bonus = (self._log_probs + self._entropies).mul_(entropy[:, :, None] / self._size)
        bonus.sub_(pull[:, None]).mul_(self._probs)
        bonus.scatter_add_(1, self._actions, pull[:, None])
        self._gradients.copy_(bonus)
        self._gradients[:, :, self._size :] = 0.0

    def remember(self) -> None:
        """As `Gaussian.remember`."""
        self._old_log_probs = self._log_probs

    def divergence(self, size: int) -> torch.Tensor:
        """As `Gaussian.divergence`."""
        return (self._probs * (self._log_probs - self._old_log_probs)).sum(1)[:, :size].mean(1)

    def curvature(self, tangents: torch.Tensor, directions: torch.Tensor, size: int) -> None:  # noqa: ARG002 - no log_std
        """As `Gaussian.curvature`."""
        means = (self._probs * tangents).sum(1, keepdim=True)
        torch.mul(self._probs, tangents - means, out=self._gradients).div_(size)
        self._gradients[:, :, size:] = 0.0


def head_of(stack: Stack, outputs: torch.Tensor, gradients: torch.Tensor, size: int) -> Gaussian | Categorical:
    """The distribution of actions, given the (P, n, rows) outputs of actors, of which `size` rows count."""
    return Categorical(outputs, gradients, size) if stack.shape.discrete else Gaussian(stack, outputs, gradients)


def evaluate(
    stack: Stack, observations: torch.Tensor, actions: torch.Tensor, rows: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """`(P, n, inputs), (P, n, action dimensions) -> (P, n), (P, n)` values and log-probabilities; n: k * `rows`."""
    members, count = observations.shape[:2]
    outputs = torch.empty(members, 2, stack.shape.outputs, count, device=stack.device, dtype=stack.dtype)
    networks = stack.networks(rows)
    for first in range(0, count, rows):
        piece = observations[:, None, first : first + rows].to(stack.dtype)
        some = networks.forward(piece.expand(-1, 2, -1, -1).flatten(0, 1))
        outputs[..., first : first + rows] = split(some, 0, (members, 2))
    log_probs = torch.zeros(members, count, device=stack.device, dtype=stack.dtype)
    head = head_of(stack, outputs[:, ACTOR].contiguous(), outputs[:, ACTOR], count)
    head.log_prob(actions.transpose(1, 2).contiguous(), log_probs, log_probs)
    return outputs[:, CRITIC, 0], log_probs
