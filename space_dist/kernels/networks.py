"""Networks in one array of numbers, PPO's actor and critic among them: where all lies, and passes forward and back.

Hidden layers' weights, and what the units of a layer say about a minibatch, lie in *panels*: a matrix is cut into
strips as wide as `Lanes` (L), and a strip is stored row after row. Then all three products of a layer (its sums, its
weights' gradient, the gradient below) are one loop over one panel each, whose lanes are independent of each other, and
their sums run over units, or samples, in order. What is too much (units and rows up to a multiple of L) is zero, and
stays it: weights that are zero have no gradient.

    inputs and hidden units  (panels of units, rows, L)
    hidden weights           (panels of units, units below, L)
    last weights             (outputs, units below)
    outputs                  (outputs, rows)
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from llvmlite import binding
from numpy.typing import NDArray

from space_dist.kernels.functions import tanh
from space_dist.kernels.lanes import (
    BYTES,
    compiled,
    every,
    fma,
    function,
    load,
    product,
    store,
    total,
    transpose,
    where_greater,
    width,
)

ACTOR, CRITIC = 0, 1
Array = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Shape:
    """What the networks of an actor-critic are.

    inputs: of an observation.  outputs: action dimensions, or discrete actions.  hidden: units of each hidden layer.
    """

    inputs: int
    outputs: int
    discrete: bool
    hidden: tuple[int, ...]
    activation: Literal["tanh", "relu"]

    @property
    def sizes(self) -> tuple[int, ...]:
        """Units of each layer, the inputs first."""
        return (self.inputs, *self.hidden, self.outputs)


class Plan(NamedTuple):
    """Numbers that a compiled function needs; what ends in `_at` is a place in the array.

    rows: of a minibatch, rounded up.  length: of all parameters; gradients lie so far behind them, then Adam's means
    and squares.  fields: numbers of a sample beside its observation, `fields_at` (fields, rows): the action, its
    log-probability when it was taken, the advantage, the return, and the value of that time.
    record: numbers of a sample.  shares_at: (rows,) one by a minibatch's size, 0 in rows too many.
    """

    depth: int
    rows: int
    inputs: int
    outputs: int
    discrete: bool
    tanh: bool
    length: int
    log_std_at: int
    fields: int
    record: int
    zeros_at: int
    inputs_at: int
    fields_at: int
    shares_at: int
    turned_at: int
    sums_at: int
    block_at: int


class Layer(NamedTuple):
    """One layer's numbers of units and places: of parameters, of what comes in, of what goes out and its gradient."""

    n_in: int
    n_out: int
    weights_at: int
    biases_at: int
    below_at: int
    here_at: int
    gradient_at: int


@dataclass(frozen=True, eq=False)
class Layout:
    """Where an actor-critic of one shape, and what learning needs beside it, lie in an array.

    layers: (2, depth + 1, 7) `Layer`s, the actor's first.  size: of the array.
    record_at: where a sample's fields begin.
    places: by SB3's names of parameters, (n,) where the numbers of each lie among `Plan.length`.
    """

    plan: Plan
    layers: NDArray[np.int64]
    size: int
    record_at: int
    places: dict[str, NDArray[np.int64]]

    @functools.lru_cache(maxsize=32)  # noqa: B019 - layouts are few, and kept as long in any case
    def all_places(self, names: tuple[str, ...]) -> NDArray[np.int64]:
        """Where the numbers of all these parameters lie, one after another's."""
        return np.concatenate([self.places[name] for name in names])

    @classmethod
    @functools.lru_cache(maxsize=32)
    def of(cls, shape: Shape, rows: int, itemsize: int) -> Layout:
        """For minibatches of up to `rows` samples, and numbers of `itemsize` bytes."""
        lanes = BYTES // itemsize
        rows = rounded_up(rows, lanes)
        parameters, work = Places(), Places()
        networks: list[Perceptron] = []
        places: dict[str, NDArray[np.int64]] = {}
        for name, head, outputs in (("policy", "action", shape.outputs), ("value", "value", 1)):
            network = Perceptron.of((shape.inputs, *shape.hidden, outputs), lanes, parameters)
            networks.append(network)
            stems = [f"mlp_extractor.{name}_net.{2 * layer}" for layer in range(len(shape.hidden))]
            places |= network.named((*((stem,) for stem in stems), (f"{head}_net",)))
        log_std_at = parameters.take(rounded_up(shape.outputs, lanes))
        if not shape.discrete:
            places["log_std"] = log_std_at + np.arange(shape.outputs)
        length = rounded_up(parameters.taken, 4 * lanes)
        work.take(4 * length)

        fields = (1 if shape.discrete else shape.outputs) + 4
        zeros_at = work.take(lanes)
        inputs_at = work.take(rows * rounded_up(shape.inputs, lanes))
        fields_at, shares_at = work.take(fields * rows), work.take(rows)
        turned_at = work.take(most_weights(shape.hidden, lanes))
        sums_at, block_at = work.take(GROUP * rows * lanes), work.take(2 * lanes * lanes)
        layers = np.stack([network.layers(inputs_at, rows, lanes, work) for network in networks])
        plan = Plan(
            depth=len(shape.hidden), rows=rows, inputs=shape.inputs, outputs=shape.outputs, discrete=shape.discrete,
            tanh=shape.activation == "tanh", length=length, log_std_at=log_std_at, fields=fields,
            record=rounded_up(shape.inputs, lanes) + rounded_up(fields, lanes),
            zeros_at=zeros_at, inputs_at=inputs_at, fields_at=fields_at, shares_at=shares_at,
            turned_at=turned_at, sums_at=sums_at, block_at=block_at,
        )  # fmt: skip
        return cls(plan, layers, work.taken, rounded_up(shape.inputs, lanes), places)


class Places:
    """An array's places, given away one after the other."""

    def __init__(self) -> None:
        self.taken = 0

    def take(self, count: int) -> int:
        """The first of so many places; all are multiples of 64 bytes."""
        first, self.taken = self.taken, self.taken + rounded_up(count, BYTES // 4)
        return first


@dataclass(frozen=True, eq=False)
class Perceptron:
    """Where the parameters of one network lie.

    sizes: units of each layer, the inputs first.  firsts: of each layer, the first places of weights and of biases.
    numbers: of each layer, the (n_out, n_in) places of its weights and the (n_out,) of its biases.
    """

    sizes: tuple[int, ...]
    firsts: tuple[tuple[int, int], ...]
    numbers: tuple[tuple[NDArray[np.int64], NDArray[np.int64]], ...]

    @classmethod
    def of(cls, sizes: tuple[int, ...], lanes: int, parameters: Places) -> Perceptron:
        """Take places for a network of these sizes."""
        firsts, numbers = [], []
        for n_in, n_out in itertools.pairwise(sizes[:-1]):
            below, above = rounded_up(n_in, lanes), rounded_up(n_out, lanes)
            at = parameters.take(below * above)
            units, inputs = np.arange(n_out)[:, None], np.arange(n_in)
            place = at + (units // lanes * below + inputs) * lanes + units % lanes
            bias = parameters.take(above)
            firsts.append((at, bias))
            numbers.append((place, bias + np.arange(n_out)))
        last, outputs = sizes[-2:]
        below = rounded_up(last, lanes)
        at, bias = parameters.take(outputs * below), parameters.take(rounded_up(outputs, lanes))
        firsts.append((at, bias))
        place = at + np.arange(outputs)[:, None] * below + np.arange(last)
        numbers.append((place, bias + np.arange(outputs)))
        return cls(sizes, tuple(firsts), tuple(numbers))

    def named(self, stems: Sequence[Sequence[str]]) -> dict[str, NDArray[np.int64]]:
        """Places by SB3's names of parameters.

        stems: of each layer, the names of the linear layers that lie side by side in it, of one size each.
        """
        named: dict[str, NDArray[np.int64]] = {}
        for (weights, biases), heads in zip(self.numbers, stems, strict=True):
            for stem, weight, bias in zip(
                heads, np.split(weights, len(heads)), np.split(biases, len(heads)), strict=True
            ):
                named |= {f"{stem}.weight": weight.ravel(), f"{stem}.bias": bias}
        return named

    def layers(self, inputs_at: int, rows: int, lanes: int, work: Places) -> NDArray[np.int64]:
        """`(depth + 1, 7)` `Layer`s of a network whose inputs lie there; places for what its units say are taken."""
        layers = np.zeros((len(self.firsts), len(Layer._fields)), dtype=np.int64)
        below_at = inputs_at
        for layer, (n_in, n_out) in enumerate(itertools.pairwise(self.sizes[:-1])):
            here_at = work.take(rows * rounded_up(n_out, lanes))
            layers[layer] = Layer(n_in, n_out, *self.firsts[layer], below_at, here_at, here_at)
            below_at = here_at
        last, outputs = self.sizes[-2:]
        here_at, gradient_at = work.take(outputs * rows), work.take(outputs * rows)
        layers[-1] = Layer(last, outputs, *self.firsts[-1], below_at, here_at, gradient_at)
        return layers


def most_weights(sizes: Sequence[int], lanes: int) -> int:
    """Numbers of the largest matrix between layers of these sizes, 0 if there is one layer only."""
    padded_sizes = [rounded_up(n, lanes) for n in sizes]
    return max((a * b for a, b in itertools.pairwise(padded_sizes)), default=0)


def aligned(count: int, dtype: Any) -> Array:
    """`(count,)` zeros that begin at a cache line: vectors across two cost twice as much."""
    spare = BYTES // np.dtype(dtype).itemsize
    made = np.zeros(count + spare, dtype=dtype)
    first = -made.ctypes.data % BYTES // made.itemsize
    return made[first : first + count]


def rounded_up(number: int, multiple: int) -> int:
    """The least multiple that is not less."""
    return -(-number // multiple) * multiple


# ---- compiled ----

GROUP = 2  # panels computed together; also where the CPU's registers hold one only, for what follows is in its cache
# Rows and panels of results that registers hold, with room for a row of factors: no result depends on it.
_TILE = (8, 2) if binding.get_host_cpu_features().get("avx512f") else (4, 1)
_ROWS, _PANELS = _TILE
_tile, _narrow = product(*_TILE), product(_ROWS, 1)
_STEPS = 128  # samples whose products are added in one go: what they need stays in the first cache


@compiled
def padded(number: int, multiple: int) -> int:
    """`rounded_up`."""
    return (number + multiple - 1) // multiple * multiple


@function
def _products(
    m: Any, c: int, c_panel: int, panels: int, rows: int, start: int, start_row: int, start_panel: int,
    a: int, a_row: int, a_step: int, a_jump: int, span: int, b: int, b_panel: int, count: int,
) -> None:  # fmt: skip
    """`lanes.product` for any number of panels, and of rows that is a multiple of eight."""
    lanes = width(m)
    panel = 0
    while panel < panels:
        wide = panels - panel >= _PANELS
        for row in range(0, rows, _ROWS):
            to, first = c + panel * c_panel + row * lanes, start + panel * start_panel + row * start_row
            left, right = a + row * a_row, b + panel * b_panel
            if wide:
                _tile(
                    m, to, c_panel, first, start_row, start_panel, left, a_row, a_step, a_jump, span, right, b_panel,
                    count,
                )  # fmt: skip
            else:
                _narrow(
                    m, to, c_panel, first, start_row, start_panel, left, a_row, a_step, a_jump, span, right, b_panel,
                    count,
                )  # fmt: skip
        panel += _PANELS if wide else 1


@function
def forward(m: Any, plan: Any, layers: Any, network: int) -> None:
    """From the inputs to a network's outputs."""
    lanes, rows = width(m), plan.rows
    panel, zero = rows * lanes, every(m, 0.0)
    for number in range(plan.depth):
        n_in, n_out, weights_at, biases_at, below_at, here_at, _ = layers[network, number]
        strip = padded(n_in, lanes) * lanes
        panels = padded(n_out, lanes) // lanes
        for first in range(0, panels, GROUP):
            some, to = min(GROUP, panels - first), here_at + first * panel
            _products(
                m, to, panel, some, rows, biases_at + first * lanes, 0, lanes, below_at, lanes, 1, panel - lanes, lanes,
                weights_at + first * strip, strip, n_in,
            )  # fmt: skip
            if plan.tanh:
                for at in range(to, to + some * panel, lanes):
                    store(m, at, tanh(load(m, at)))
            else:
                for at in range(to, to + some * panel, lanes):
                    units = load(m, at)
                    store(m, at, where_greater(zero, units, zero, units))
    _outputs(m, plan, layers, network)


@function
def _outputs(m: Any, plan: Any, layers: Any, network: int) -> None:
    """The last layer: its sums run over every L-th unit in each lane, then over the lanes in order."""
    lanes, rows, block = width(m), plan.rows, plan.block_at
    panel, turned = rows * lanes, block + lanes * lanes
    n_in, n_out, weights_at, biases_at, below_at, here_at, _ = layers[network, plan.depth]
    inputs = padded(n_in, lanes)
    for output in range(n_out):
        for first in range(0, rows, lanes):
            for row in range(lanes):
                found = every(m, 0.0)
                for part in range(inputs // lanes):
                    units = load(m, below_at + part * panel + (first + row) * lanes)
                    found = fma(units, load(m, weights_at + output * inputs + part * lanes), found)
                store(m, block + row * lanes, found)
            transpose(m, block, turned)
            found = every(m, m[biases_at + output])
            for row in range(lanes):
                found = found + load(m, turned + row * lanes)
            store(m, here_at + output * rows + first, found)


@compiled
def _through(plan: Any, derivative: Any, units: Any) -> Any:
    """A derivative by what an activation gave as one by what it was given."""
    one, zero = every(units, 1.0), every(units, 0.0)
    if plan.tanh:
        return derivative * fma(zero - units, units, one)
    return where_greater(units, zero, derivative, zero)


@function
def backward(m: Any, plan: Any, layers: Any, network: int, count: int) -> None:
    """From the gradient of a network's outputs, of `count` samples, to those of all its parameters.

    Hidden units give way to their gradients.
    """
    _outputs_gradients(m, plan, layers, network)
    _outputs_below(m, plan, layers, network)
    lanes, rows = width(m), plan.rows
    panel = rows * lanes
    for number in range(plan.depth - 1, -1, -1):
        n_in, n_out, weights_at, biases_at, below_at, here_at, _ = layers[network, number]
        inputs, units = padded(n_in, lanes), padded(n_out, lanes)
        strip = inputs * lanes
        for first in range(0, units // lanes, GROUP):
            some, given = min(GROUP, units // lanes - first), here_at + first * panel
            to = plan.length + weights_at + first * strip
            for sample in range(0, count, _STEPS):
                steps = min(_STEPS, count - sample)
                for part in range(inputs // lanes):
                    at = to + part * lanes * lanes
                    start, row, jump = (at, lanes, strip) if sample else (plan.zeros_at, 0, 0)
                    # Weights of inputs that there are none of have no gradient: theirs stays the zero that it is.
                    _products(
                        m, at, strip, some, min(lanes, padded(n_in - part * lanes, _ROWS)), start, row, jump,
                        below_at + part * panel + sample * lanes,
                        1, lanes, 0, steps, given + sample * lanes, panel, steps,
                    )  # fmt: skip
        for part in range(units // lanes):
            given = here_at + part * panel
            store(m, plan.length + biases_at + part * lanes, _sum_of_rows(m, given, rows))
        if number:
            _units_below(m, plan, layers, network, number)


@function
def pull(m: Any, plan: Any, layers: Any, network: int, to: int) -> None:
    """Add the gradient of a network's inputs to what lies in panels from `to` on; parameters get no gradients.

    Hidden units give way to their gradients.
    """
    lanes, rows = width(m), plan.rows
    panel = rows * lanes
    if not plan.depth:
        n_in, n_out, weights_at, _, _, _, gradient_at = layers[network, 0]
        inputs = padded(n_in, lanes)
        for part in range(inputs // lanes):
            for row in range(rows):
                at = to + part * panel + row * lanes
                found = _given(m, weights_at + part * lanes, inputs, gradient_at + row, rows, n_out)
                store(m, at, load(m, at) + found)
        return
    _outputs_below(m, plan, layers, network)
    for number in range(plan.depth - 1, 0, -1):
        _units_below(m, plan, layers, network, number)
    n_in, n_out, weights_at, _, _, here_at, _ = layers[network, 0]
    inputs, units = padded(n_in, lanes), padded(n_out, lanes)
    _turn(m, plan.turned_at, weights_at, inputs, units)
    for first in range(0, inputs // lanes, GROUP):
        some, at = min(GROUP, inputs // lanes - first), to + first * panel
        _products(
            m, at, panel, some, rows, at, lanes, panel, here_at, lanes, 1, panel - lanes, lanes,
            plan.turned_at + first * units * lanes, units * lanes, n_out,
        )  # fmt: skip


@function
def _units_below(m: Any, plan: Any, layers: Any, network: int, number: int) -> None:
    """Gradients of the units below a hidden layer, in their place."""
    n_in, n_out, weights_at, _, below_at, here_at, _ = layers[network, number]
    lanes, rows = width(m), plan.rows
    panel, inputs, units = rows * lanes, padded(n_in, lanes), padded(n_out, lanes)
    _turn(m, plan.turned_at, weights_at, inputs, units)
    for first in range(0, inputs // lanes, GROUP):
        some = min(GROUP, inputs // lanes - first)
        _products(
            m, plan.sums_at, panel, some, rows, plan.zeros_at, 0, 0, here_at, lanes, 1, panel - lanes, lanes,
            plan.turned_at + first * units * lanes, units * lanes, n_out,
        )  # fmt: skip
        for at in range(0, some * panel, lanes):
            to = below_at + first * panel + at
            store(m, to, _through(plan, load(m, plan.sums_at + at), load(m, to)))


@function
def _turn(m: Any, to: int, weights_at: int, inputs: int, units: int) -> None:
    """A hidden layer's weights transposed: (panels of units below, units, L)."""
    lanes = width(m)
    for part in range(units // lanes):
        for below in range(inputs // lanes):
            at = weights_at + (part * inputs + below * lanes) * lanes
            transpose(m, at, to + (below * units + part * lanes) * lanes)


@function
def _sum_of_rows(m: Any, at: int, rows: int) -> Any:
    """Of (rows, L): every fourth row together, then those."""
    lanes = width(m)
    one = two = three = four = every(m, 0.0)
    for row in range(at, at + rows * lanes, 4 * lanes):
        one, two = one + load(m, row), two + load(m, row + lanes)
        three, four = three + load(m, row + 2 * lanes), four + load(m, row + 3 * lanes)
    return (one + two) + (three + four)


@function
def _outputs_gradients(m: Any, plan: Any, layers: Any, network: int) -> None:
    """Of the last layer's parameters."""
    lanes, rows = width(m), plan.rows
    panel = rows * lanes
    n_in, n_out, weights_at, biases_at, below_at, _, gradient_at = layers[network, plan.depth]
    inputs = padded(n_in, lanes)
    for output in range(n_out):
        given = gradient_at + output * rows
        found = every(m, 0.0)
        for at in range(given, given + rows, lanes):
            found = found + load(m, at)
        m[plan.length + biases_at + output] = total(found)
        for part in range(inputs // lanes):
            units = below_at + part * panel
            one = two = three = four = every(m, 0.0)
            for row in range(0, rows, 4):
                at = units + row * lanes
                one = fma(every(m, m[given + row]), load(m, at), one)
                two = fma(every(m, m[given + row + 1]), load(m, at + lanes), two)
                three = fma(every(m, m[given + row + 2]), load(m, at + 2 * lanes), three)
                four = fma(every(m, m[given + row + 3]), load(m, at + 3 * lanes), four)
            store(m, plan.length + weights_at + output * inputs + part * lanes, (one + two) + (three + four))


@function
def _outputs_below(m: Any, plan: Any, layers: Any, network: int) -> None:
    """Gradients of the last hidden units, if there are any, in their place."""
    lanes, rows = width(m), plan.rows
    n_in, n_out, weights_at, _, below_at, _, gradient_at = layers[network, plan.depth]
    inputs = padded(n_in, lanes)
    if plan.depth:
        for part in range(inputs // lanes):
            for row in range(0, rows, 4):  # four at a time: a sum waits for its last addition
                at = below_at + (part * rows + row) * lanes
                one = two = three = four = every(m, 0.0)
                for output in range(n_out):
                    weights = load(m, weights_at + output * inputs + part * lanes)
                    given = gradient_at + output * rows + row
                    one, two = fma(every(m, m[given]), weights, one), fma(every(m, m[given + 1]), weights, two)
                    three = fma(every(m, m[given + 2]), weights, three)
                    four = fma(every(m, m[given + 3]), weights, four)
                store(m, at, _through(plan, one, load(m, at)))
                store(m, at + lanes, _through(plan, two, load(m, at + lanes)))
                store(m, at + 2 * lanes, _through(plan, three, load(m, at + 2 * lanes)))
                store(m, at + 3 * lanes, _through(plan, four, load(m, at + 3 * lanes)))


@compiled
def _given(m: Any, weights_at: int, strip: int, gradient_at: int, rows: int, outputs: int) -> Any:
    """The gradient of some units below the outputs, of one sample."""
    found = every(m, 0.0)
    for output in range(outputs):
        found = fma(every(m, m[gradient_at + output * rows]), load(m, weights_at + output * strip), found)
    return found
