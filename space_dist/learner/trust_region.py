"""TRPO of many members in one tensor program, as sb3-contrib's `TRPO.train` does it for one.

    objective      mean(A r), r = exp(log pi - log pi_old); its gradient is g
    H v            the Hessian of the mean KL divergence times v, plus damping: the derivatives of the actor's outputs
                   along v, times the divergence's own curvature, back through the actor (exact where old is new)
    s              about H^-1 g, by conjugate gradients
    step           sqrt(2 target_kl / s H s) s, shortened until the objective is higher and the divergence small enough

then the critic is fitted to the returns in minibatches. Members converge, stop and fail each for itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from space_dist.learner.heads import head_of
from space_dist.learner.stack import ACTOR, CRITIC, Adam, Networks, Stack, column, split
from space_dist.learner.stacked import Minibatches, Report, Samples, parts_of

_RESIDUAL = 1e-10  # of conjugate gradients, squared, below which they stop; sb3-contrib


@dataclass(frozen=True)
class TRPOSettings:
    """One member's own."""

    learning_rate: float
    target_kl: float
    normalize_advantage: bool
    cg_max_steps: int
    cg_damping: float
    line_search_shrinking_factor: float
    line_search_max_iter: int


class TRPO:
    """One update of all members.

    noise: (P, n) what conjugate gradients start from, before it is made small; in the order of SB3's parameters.
    """

    def __init__(
        self,
        stack: Stack,
        samples: Samples,
        settings: Sequence[TRPOSettings],
        batch_size: int,
        noise: torch.Tensor,
    ) -> None:
        self._stack, self._settings = stack, settings
        normalized = column(stack, (float(one.normalize_advantage) for one in settings), torch.float32)
        packed = samples.packed(stack.dtype)
        self._all = Minibatches(stack, packed, packed.shape[1], 1, normalized)
        self._actors = Networks(stack, stack.weights[:, ACTOR], stack.gradient[:, ACTOR], self._all.rows, keep=True)
        self._inputs = split(self._all.inputs[0], 0, (stack.members, 2))[:, ACTOR]
        self._head = head_of(stack, self._actors.outputs, self._actors.output_gradients, self._all.size)
        self._damping = column(stack, (one.cg_damping for one in settings))
        self._targets = column(stack, (one.target_kl for one in settings))[:, 0]
        self._start = torch.zeros_like(stack.weights)
        first = 0
        for name, (network, _, _) in stack.layout.names.items():
            if network == ACTOR:
                parameter = stack.parameter(self._start, name)
                last = first + parameter[0].numel()
                parameter.copy_(noise[:, first:last].view(parameter.shape))
                first = last
        self._parts = parts_of(stack, packed, batch_size, normalized)
        self._critics = {
            part.rows: Networks(stack, stack.weights[:, CRITIC], stack.gradient[:, CRITIC], part.rows)
            for part in self._parts
        }
        self._adam = Adam(stack, [one.learning_rate for one in settings], slice(CRITIC, None))

    def run(self, orders: Iterable[NDArray[np.int64]]) -> list[Report]:
        """The actors' step on the first (P, N) of `orders`, one pass of the critics over each of the others.

        orders: each member's permutations of its samples.
        """
        rest = iter(orders)
        self._all.draw(next(rest))
        objectives, divergences, found = self._improve()
        losses = torch.cat([part for order in rest for part in self._fit(order)]).cpu().numpy()
        metrics = {
            "policy_objective": objectives.tolist(),
            "kl_divergence_loss": divergences.tolist(),
            "is_line_search_success": found.tolist(),
            "value_loss": [losses[:, member].mean() for member in range(self._stack.members)],
        }
        members = range(self._stack.members)
        return [Report({name: float(of[member]) for name, of in metrics.items()}, 1) for member in members]

    def _improve(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Move the actors. Returns (P,) objectives and divergences reached, and whether a step was found."""
        stack, settings = self._stack, self._settings
        before = self._objective()
        self._head.remember()
        nothing = torch.zeros_like(self._damping)
        self._head.backward(-self._pull, nothing)
        self._actors.backward(self._inputs)
        direction = self._solve(stack.gradient[:, ACTOR].clone())
        curvature = _dot(direction, self._product(direction)).double()
        lengths = torch.sqrt(2.0 * column(stack, (one.target_kl for one in settings), torch.float64)[:, 0] / curvature)
        weights = stack.weights[:, ACTOR]
        original = weights.clone()
        searching = torch.ones(stack.members, dtype=torch.bool, device=stack.device)
        found = ~searching
        objectives, divergences = before.clone(), torch.zeros_like(before)
        shares, factors = [1.0] * stack.members, [one.line_search_shrinking_factor for one in settings]
        for tried in range(max(one.line_search_max_iter for one in settings)):
            searching &= torch.tensor([tried < one.line_search_max_iter for one in settings], device=stack.device)
            steps = (column(stack, shares, torch.float64) * lengths[:, None]).to(stack.dtype)
            shares = [share * factor for share, factor in zip(shares, factors, strict=True)]
            weights.copy_(torch.where(searching[:, None], original + steps * direction, weights))
            objective, divergence = self._objective(), self._head.divergence(self._all.size)
            better = searching & (divergence < self._targets) & (objective > before)
            objectives, divergences = (
                torch.where(better, new, old) for new, old in ((objective, objectives), (divergence, divergences))
            )
            found, searching = found | better, searching & ~better
            if not bool(searching.any()):
                break
        failed = ~found & torch.isfinite(lengths)  # else there was no step at all: leave weights that are no numbers
        weights.copy_(torch.where(failed[:, None], original, weights))
        return objectives, divergences, found

    def _objective(self) -> torch.Tensor:
        """`(P,)` of the actors as they are."""
        batches, size = self._all, self._all.size
        self._actors.forward(self._inputs)
        self._head.log_prob(batches.actions[0], batches.offsets[0], batches.log_ratios[0])
        self._pull = torch.exp(batches.log_ratios[0]).mul_(batches.pulls[0])
        return -self._pull[:, :size].sum(1)

    def _product(self, vectors: torch.Tensor) -> torch.Tensor:
        """`(P, length)` each member's damped Hessian times its vector."""
        self._head.curvature(self._actors.tangent(self._inputs, vectors), vectors, self._all.size)
        self._actors.backward(self._inputs)
        return self._stack.gradient[:, ACTOR] + self._damping * vectors

    def _solve(self, gradients: torch.Tensor) -> torch.Tensor:
        """`(P, length)` of each member about its damped Hessian's inverse times its gradient."""
        steps = [one.cg_max_steps for one in self._settings]
        found = 1e-4 * self._start[:, ACTOR]
        residual = gradients - self._product(found)
        size = _dot(residual, residual)
        going = ~(size < _RESIDUAL)
        search = residual.clone()
        for made in range(max(steps)):
            if not bool(going.any()):
                break
            product = self._product(search)
            rates = (size / _dot(search, product))[:, None]
            found = torch.where(going[:, None], found + rates * search, found)
            residual = torch.where(going[:, None], residual - rates * product, residual)
            following = _dot(residual, residual)
            going &= ~(following < _RESIDUAL)
            going &= torch.tensor([made + 1 < most for most in steps], device=going.device)
            search = torch.where(going[:, None], residual + (following / size)[:, None] * search, search)
            size = following
        return found

    def _fit(self, order: NDArray[np.int64]) -> list[torch.Tensor]:
        """One pass of the critics; (minibatches, P) value losses."""
        first, losses = 0, []
        for part in self._parts:
            part.draw(order[:, first : first + part.size * part.count])
            first += part.size * part.count
            critics = self._critics[part.rows]
            values, gradients = critics.outputs[:, 0], critics.output_gradients[:, 0]
            gradients[:, part.size :] = 0.0
            for inputs, returns, error in zip(part.inputs, part.returns, part.errors, strict=True):
                mine = split(inputs, 0, (self._stack.members, 2))[:, CRITIC]
                critics.forward(mine)
                torch.sub(values, returns, out=error)
                torch.mul(error[:, : part.size], 2.0 / part.size, out=gradients[:, : part.size])
                critics.backward(mine)
                self.critic_step()
            losses.append(part.errors[:, :, : part.size].square().mean(2))
        return losses

    def critic_step(self) -> None:
        """Let the critics' Adam make a step."""
        self._adam.step()


def _dot(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """`(P,)` inner products of (P, n)."""
    return (first * second).sum(1)
