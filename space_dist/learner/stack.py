"""Many actor-critics of one shape as one: their weights, what passes through them, and Adam.

Everything has the members along its first axis. A member is two networks of one architecture, its actor and its critic
(whose output is the first of as many as the actor has), so P members are 2P networks, and a layer is one batched matrix
product.

On a CPU a member's bits do not depend on the others. Matrix products and reductions go member by member; what is left
are elementwise functions, of which vectorised loops compute the last few elements of an array in another way: so every
member's rows are a multiple of ROWS, and such ends lie within no array.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch

from space_dist.kernels import Shape

ROWS = 32  # a multiple of twice any CPU's vector of float32
ACTOR, CRITIC = 0, 1
BETAS, EPS = (0.9, 0.999), 1e-5  # Adam's, in SB3's actor-critic policies


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
        part = ParameterSlice(self._length, shape)
        self._length = rounded_up(self._length + math.prod(shape), 16)
        return part

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
        network, part, transposed = self.layout.names[name]
        found = part.of(rows[:, network])
        if name.startswith("value_net."):
            found = found[:, :1]
        return found.transpose(1, 2) if transposed else found

    def networks(self, rows: int) -> Networks:
        """All 2P networks, for so many rows of inputs each; the same object for the same number."""
        if rows not in self._networks:
            self._networks[rows] = Networks(self, self.weights.flatten(0, 1), self.gradient.flatten(0, 1), rows)
        return self._networks[rows]

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
        self._weights = [part.of(weights) for part in layout.weights]
        self._biases = [part.of(weights)[:, None, :] for part in layout.biases[:-1]]
        self._biases.append(layout.biases[-1].of(weights)[:, :, None])
        self._weight_gradients = [part.of(gradient) for part in layout.weights]
        self._bias_gradients = [part.of(gradient) for part in layout.biases]

        def empty(*sizes: int) -> torch.Tensor:
            return torch.zeros(count, *sizes, device=stack.device, dtype=stack.dtype)

        self._hidden = [empty(rows, n) for n in shape.hidden]
        # Where a layer above is done with its units when this one's gradient comes, that lies where it is in the cache.
        above = itertools.zip_longest(shape.hidden, self._hidden[1:])
        self._hidden_gradients = [
            empty(rows, n) if keep or units is None or units.shape[2] != n else units for n, units in above
        ]  # fmt: skip
        self._moved = [empty(rows, n) for n in shape.hidden] if keep else []
        self._scratch = [empty(*part.shape) for part in layout.weights]
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
