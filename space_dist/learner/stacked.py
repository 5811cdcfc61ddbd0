"""Many actor-critics of one shape updated in one tensor program: PPO as in Stable-Baselines3's `PPO.train`.

Everything has the members along its first axis. A member is two networks of one architecture, its actor and its critic
(whose output is the first of as many as the actor has), so P members are 2P networks, and a layer is one batched matrix
product. The gradients are written by hand:

    log pi(a|s)    Gaussian -|z|^2/2 - sum(log sigma) - n/2 log(2 pi), z = (a - mu) / sigma; or the log-softmax at a
    r = exp(log pi - log pi_old)
    policy loss    -mean(min(A r, A clip(r, 1 - eps, 1 + eps)))        d/d log pi = -A r / B where the first is least
    value loss     mean((V - R)^2)
    entropy loss   -mean(H)
    loss           policy loss + ent_coef * entropy loss + vf_coef * value loss

then the member's gradient is scaled to at most `max_grad_norm`, and its Adam makes a step.

On a CPU a member's bits do not depend on the others. Matrix products and reductions go member by member; what is left
are elementwise functions, of which vectorised loops compute the last few elements of an array in another way: so every
member's rows are a multiple of ROWS, and such ends lie within no array.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from space_dist.kernels import Shape

ROWS = 32  # a multiple of twice any CPU's vector of float32
ACTOR, CRITIC = 0, 1
BETAS, EPS = (0.9, 0.999), 1e-5  # Adam's, in SB3's actor-critic policies
Array = NDArray[np.floating[Any]]
LOG_2PI = math.log(2.0 * math.pi)


@dataclass(frozen=True)
class ParameterSlice:
    """Where a parameter lies within the row of a network."""

    first: int
    shape: tuple[int, ...]

    def of(self, rows: torch.Tensor) -> torch.Tensor:
        """`(..., *shape)` views of (..., length) rows."""
        return split(rows[..., self.first : self.first + math.prod(self.shape)], -1, self.shape)


class Layout:
    """The row of a network: log_std, then weights and biases of each layer, each at a multiple of 64 bytes.

    Hidden layers' weights are (in, out), the last layer's (out, in), where the products are fastest.
    names: SB3's, of all parameters: of which network, where, and whether SB3 has it the other way round.
    """

    def __init__(self, shape: Shape) -> None:
        self._length = 0
        self.log_std = self._reserve(shape.outputs)
        sizes = shape.sizes
        self.weights, self.biases = [], []
        for layer, (n_in, n_out) in enumerate(itertools.pairwise(sizes)):
            last = layer == len(sizes) - 2
            self.weights.append(self._reserve(n_out, n_in) if last else self._reserve(n_in, n_out))
            self.biases.append(self._reserve(n_out))
        self.names = dict(self._names(shape))

    def _names(self, shape: Shape) -> Iterator[tuple[str, tuple[int, ParameterSlice, bool]]]:
        if not shape.discrete:
            yield "log_std", (ACTOR, self.log_std, False)
        for network, name, head in ((ACTOR, "policy", "action"), (CRITIC, "value", "value")):
            for layer in range(len(shape.hidden)):
                yield f"mlp_extractor.{name}_net.{2 * layer}.weight", (network, self.weights[layer], True)
                yield f"mlp_extractor.{name}_net.{2 * layer}.bias", (network, self.biases[layer], False)
            yield f"{head}_net.weight", (network, self.weights[-1], False)
            yield f"{head}_net.bias", (network, self.biases[-1], False)

    def _reserve(self, *shape: int) -> ParameterSlice:
        place = ParameterSlice(self._length, shape)
        self._length = rounded_up(self._length + math.prod(shape), 16)
        return place

    @property
    def length(self) -> int:
        """Numbers in a row, padding included."""
        return rounded_up(self._length, ROWS)


class Stack:
    """Weights, gradients and Adam's state of P members: (P, 2, length) each, actors before critics.

    steps: (P,) that each member's Adam has made.
    """

    def __init__(self, shape: Shape, members: int, *, device: torch.device, dtype: torch.dtype) -> None:
        self.shape, self.layout = shape, Layout(shape)
        self.members, self.device, self.dtype = members, device, dtype
        rows = (members, 2, self.layout.length)
        self.weights = torch.zeros(rows, device=device, dtype=dtype)
        self.gradient = torch.zeros(rows, device=device, dtype=dtype)
        self.exp_avg = torch.zeros(rows, device=device, dtype=dtype)
        self.exp_avg_sq = torch.zeros(rows, device=device, dtype=dtype)
        self.steps = torch.zeros(members, device=device)
        self._networks: dict[int, Networks] = {}

    def parameter(self, rows: torch.Tensor, name: str) -> torch.Tensor:
        """`(P, ...)` view of the parameter that SB3 calls `name`, laid out as SB3's, in one of our (P, 2, length)."""
        network, place, transposed = self.layout.names[name]
        found = place.of(rows[:, network])
        if name.startswith("value_net."):
            found = found[:, :1]
        return found.transpose(1, 2) if transposed else found

    def networks(self, rows: int) -> Networks:
        """All 2P networks, for so many rows of inputs each; the same object for the same number."""
        if rows not in self._networks:
            self._networks[rows] = Networks(self, self.weights.flatten(0, 1), self.gradient.flatten(0, 1), rows)
        return self._networks[rows]

    def evaluate(
        self, observations: torch.Tensor, actions: torch.Tensor, rows: int
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """`(P, n, inputs), (P, n, action dimensions) -> (P, n), (P, n)` values and log-probabilities; n: k * `rows`."""
        members, count = observations.shape[:2]
        outputs = torch.empty(members, 2, self.shape.outputs, count, device=self.device, dtype=self.dtype)
        networks = self.networks(rows)
        for first in range(0, count, rows):
            piece = observations[:, None, first : first + rows].to(self.dtype)
            some = networks.forward(piece.expand(-1, 2, -1, -1).flatten(0, 1))
            outputs[..., first : first + rows] = split(some, 0, (members, 2))
        log_probs = torch.zeros(members, count, device=self.device, dtype=self.dtype)
        head = head_of(self, outputs[:, ACTOR].contiguous(), outputs[:, ACTOR], count)
        head.log_prob(actions.transpose(1, 2).contiguous(), log_probs, log_probs)
        return outputs[:, CRITIC, 0], log_probs

    def finite(self) -> list[bool]:
        """Whether each member's weights are numbers."""
        return [bool(finite) for finite in torch.isfinite(self.weights).flatten(1).all(1).tolist()]


class Networks:
    """Forward and backward passes of R networks, one for each row of `weights` (R, length), on `rows` inputs each.

    keep: whether what a forward pass found is still there after a backward pass, for `tangent`.
    """

    def __init__(
        self, stack: Stack, weights: torch.Tensor, gradient: torch.Tensor, rows: int, *, keep: bool = False
    ) -> None:
        self._layout = layout = stack.layout
        shape, count = stack.shape, len(weights)
        self._tanh = shape.activation == "tanh"
        self._weights = [place.of(weights) for place in layout.weights]
        self._biases = [place.of(weights)[:, None, :] for place in layout.biases[:-1]]
        self._biases.append(layout.biases[-1].of(weights)[:, :, None])
        self._weight_gradients = [place.of(gradient) for place in layout.weights]
        self._bias_gradients = [place.of(gradient) for place in layout.biases]

        def empty(*sizes: int) -> torch.Tensor:
            return torch.zeros(count, *sizes, device=stack.device, dtype=stack.dtype)

        self._hidden = [empty(rows, n) for n in shape.hidden]
        # Where a layer above is done with its units when this one's gradient comes, that lies where it is in the cache.
        above = itertools.zip_longest(shape.hidden, self._hidden[1:])
        self._hidden_gradients = [
            empty(rows, n) if keep or units is None or units.shape[2] != n else units for n, units in above
        ]  # fmt: skip
        self._moved = [empty(rows, n) for n in shape.hidden] if keep else []
        self._scratch = [empty(*place.shape) for place in layout.weights]
        self.outputs = empty(shape.outputs, rows)
        self.output_gradients = empty(shape.outputs, rows)
        self._weights_turned, self._hidden_turned, self._output_gradients_turned = (
            [tensor.transpose(1, 2) for tensor in tensors]
            for tensors in (self._weights, self._hidden, [self.output_gradients])
        )

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """`(R, rows, inputs) -> (R, outputs, rows)`, in `outputs`."""
        for layer, hidden in enumerate(self._hidden):
            torch.baddbmm(self._biases[layer], inputs, self._weights[layer], out=hidden)
            if self._tanh:
                torch.tanh(hidden, out=hidden)
            else:
                torch.relu_(hidden)
            inputs = hidden
        turned = self._hidden_turned[-1] if self._hidden else inputs.transpose(1, 2)
        return torch.baddbmm(self._biases[-1], self._weights[-1], turned, out=self.outputs)

    def tangent(self, inputs: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        """`(R, outputs, rows)` derivatives of the last `forward`'s outputs along (R, length) `directions`."""
        found: torch.Tensor | None = None
        for layer, hidden in enumerate(self._hidden):
            weights = self._layout.weights[layer].of(directions)
            bias = self._layout.biases[layer].of(directions)[:, None, :]
            moved = torch.baddbmm(bias, inputs, weights, out=self._moved[layer])
            if found is not None:
                moved.baddbmm_(found, self._weights[layer])
            found = self._through(moved, hidden)
            inputs = hidden
        bias = self._layout.biases[-1].of(directions)[:, :, None]
        moved = torch.baddbmm(bias, self._layout.weights[-1].of(directions), inputs.transpose(1, 2))
        return moved if found is None else moved.baddbmm_(self._weights[-1], found.transpose(1, 2))

    def _through(self, derivatives: torch.Tensor, hidden: torch.Tensor) -> torch.Tensor:
        """Derivatives times those of the activation that gave `hidden`, in place."""
        if self._tanh:
            torch.ops.aten.tanh_backward.grad_input(derivatives, hidden, grad_input=derivatives)
        else:
            torch.ops.aten.threshold_backward.grad_input(derivatives, hidden, 0.0, grad_input=derivatives)
        return derivatives

    def backward(self, inputs: torch.Tensor) -> None:
        """Write the gradient of every weight, given `output_gradients`, of the last `forward`'s `inputs`."""
        given = self.output_gradients
        below = self._hidden[-1] if self._hidden else inputs
        torch.bmm(given, below, out=self._scratch[-1])
        self._weight_gradients[-1].copy_(self._scratch[-1])
        torch.sum(given, dim=2, out=self._bias_gradients[-1])
        for layer in reversed(range(len(self._hidden))):
            gradient, hidden = self._hidden_gradients[layer], self._hidden[layer]
            if layer == len(self._hidden) - 1:
                torch.bmm(self._output_gradients_turned[0], self._weights[-1], out=gradient)
            else:
                torch.bmm(given, self._weights_turned[layer + 1], out=gradient)
            self._through(gradient, hidden)
            turned = self._hidden_turned[layer - 1] if layer else inputs.transpose(1, 2)
            torch.bmm(turned, gradient, out=self._scratch[layer])
            self._weight_gradients[layer].copy_(self._scratch[layer])
            torch.sum(gradient, dim=1, out=self._bias_gradients[layer])
            given = gradient


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


class Gaussian:
    """Independent normal actions; means are the actor's outputs, log_std a parameter of its own."""

    def __init__(self, stack: Stack, means: torch.Tensor, gradients: torch.Tensor) -> None:
        place, self._dimensions = stack.layout.log_std, stack.shape.outputs
        width = rounded_up(self._dimensions, ROWS)
        self._means, self._gradients = means, gradients
        self._wide = stack.weights[:, ACTOR, :width]  # whole vectors
        self._log_std, self._log_std_gradient = place.of(stack.weights)[:, ACTOR], place.of(stack.gradient)[:, ACTOR]
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


class Adam:
    """torch's Adam with a learning rate for each member; members may sit steps out.

    networks: which of a member's learn.
    """

    def __init__(self, stack: Stack, learning_rates: Sequence[float], networks: slice = slice(None)) -> None:
        self._stack, self._rates = stack, learning_rates
        self._weights, self._gradient, self._averages, self._squares = (
            rows[:, networks] for rows in (stack.weights, stack.gradient, stack.exp_avg, stack.exp_avg_sq)
        )
        self._columns = torch.tensor(learning_rates, dtype=torch.float64, device=stack.device)
        self.move([True] * stack.members)

    def move(self, active: Sequence[bool]) -> None:
        """Let these members make the steps from now on; the others keep all they have."""
        stack = self._stack
        self._active = torch.tensor(active, dtype=torch.float32, device=stack.device)
        self._groups: dict[float, tuple[list[torch.Tensor], ...]] = {}  # by learning rate: what the kernel takes
        tensors = (self._weights, self._gradient, self._averages, self._squares, stack.steps)
        for member, rate in enumerate(self._rates):
            if active[member]:
                lists = self._groups.setdefault(rate, tuple([] for _ in tensors))
                for rows, mine in zip(tensors, lists, strict=True):
                    mine.append(rows[member])

    def step(self) -> None:
        """One step of every member that moves."""
        self._stack.steps.add_(self._active)
        if self._stack.device.type == "cpu":
            self._row_by_row()
        else:
            self._together()

    def _row_by_row(self) -> None:
        for rate, (weights, gradients, averages, squares, steps) in self._groups.items():
            torch._fused_adam_(
                weights, gradients, averages, squares, [], steps, lr=rate, beta1=BETAS[0], beta2=BETAS[1],
                weight_decay=0.0, eps=EPS, amsgrad=False, maximize=False,
            )  # fmt: skip

    def _together(self) -> None:
        """Without a kernel for each member: for devices where starting one is what costs."""
        stack, active = self._stack, self._active[:, None, None]
        gradient = torch.where(active > 0.0, self._gradient, 0.0)
        self._averages.lerp_(gradient, (1.0 - BETAS[0]) * active.to(stack.dtype))
        self._squares.lerp_(gradient.square_(), (1.0 - BETAS[1]) * active.to(stack.dtype))
        first, second = (1.0 - beta ** stack.steps.double().clamp(min=1.0) for beta in BETAS)
        rates, roots = (self._columns * self._active / first).to(stack.dtype), second.sqrt().to(stack.dtype)
        denominators = self._squares.sqrt().div_(roots[:, None, None]).add_(EPS)
        self._weights.sub_(self._averages.div(denominators).mul_(rates[:, None, None]))


def column(stack: Stack, numbers: Iterable[float], dtype: torch.dtype | None = None) -> torch.Tensor:
    """`(P, 1)` a number of each member."""
    return torch.tensor(list(numbers), dtype=torch.float64).to(stack.device, dtype or stack.dtype)[:, None]


def split(tensor: torch.Tensor, axis: int, shape: tuple[int, ...]) -> torch.Tensor:
    """A view with one axis as several."""
    view: torch.Tensor = tensor.unflatten(axis, shape)  # type: ignore[no-untyped-call]
    return view


def rounded_up(number: int, multiple: int) -> int:
    """The least multiple that is not less."""
    return -(-number // multiple) * multiple
