"""Networks that learn from a replay buffer: where they and their minibatches lie, and what DQN, TD3 and SAC share."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from space_dist.kernels.build import ready
from space_dist.kernels.lanes import BYTES, every, fma, function, load, store, total, where_greater, width
from space_dist.kernels.networks import GROUP, Perceptron, Places, backward, forward, most_weights, rounded_up

VALUES = 0  # DQN's only network
ACTOR, FIRST, SECOND = range(3)  # TD3's and SAC's
Algorithm = Literal["dqn", "td3", "sac"]


@dataclass(frozen=True)
class ReplayShape:
    """What networks an algorithm learns.

    inputs: of an observation.  outputs: discrete actions, or action dimensions.  hidden: units of each hidden layer.
    """

    algorithm: Algorithm
    inputs: int
    outputs: int
    hidden: tuple[int, ...]
    activation: Literal["tanh", "relu"]

    def networks(self) -> list[tuple[tuple[int, ...], list[tuple[str, ...]]]]:
        """Of each network that learns, sizes of layers, and SB3's names of those; a layer may be several of SB3's."""
        depth, joint = len(self.hidden), self.inputs + self.outputs

        def numbered(stem: str, count: int) -> list[tuple[str, ...]]:
            return [(f"{stem}.{2 * layer}",) for layer in range(count)]

        if self.algorithm == "dqn":
            return [((self.inputs, *self.hidden, self.outputs), numbered("q_net.q_net", depth + 1))]
        critics = [((joint, *self.hidden, 1), numbered(f"critic.qf{number}", depth + 1)) for number in range(2)]
        if self.algorithm == "td3":
            return [((self.inputs, *self.hidden, self.outputs), numbered("actor.mu", depth + 1)), *critics]
        heads = ("actor.mu", "actor.log_std")
        actor = (self.inputs, *self.hidden, 2 * self.outputs), [*numbered("actor.latent_pi", depth), heads]
        return [actor, *critics]


class ReplayPlan(NamedTuple):
    """Numbers that a compiled function needs; what ends in `_at` is a place in the array.

    rows: of a minibatch, rounded up.  length: of all parameters that learn; gradients lie so far behind them, then
    Adam's means and squares, then, `targets` behind, those of targets.  networks: that learn; in `layers` a target is
    so many behind its own.
    Parameters of critics begin at `critics_at`, and the log of SAC's entropy coefficient lies at `log_alpha_at`.
    inputs_at, joint_at: panels of what is observed, and of that with an action.  pulls_at: panels of gradients of the
    latter.  actions_at, slopes_at, noise_at, pulled_at: (outputs, rows) numbers of actions; DQN's are one.
    rewards_at, factors_at (of what follows), goals_at, log_probs_at: (rows,).  shares_at: (rows,) one by a
    minibatch's size, 0 in rows too many.
    """

    depth: int
    rows: int
    inputs: int
    outputs: int
    tanh: bool
    length: int
    targets: int
    networks: int
    critics_at: int
    log_alpha_at: int
    zeros_at: int
    inputs_at: int
    joint_at: int
    pulls_at: int
    pulls_end: int
    actions_at: int
    slopes_at: int
    noise_at: int
    pulled_at: int
    rewards_at: int
    factors_at: int
    goals_at: int
    log_probs_at: int
    shares_at: int
    turned_at: int
    sums_at: int
    block_at: int


@dataclass(frozen=True, eq=False)
class ReplayLayout:
    """Where the networks of one shape, and what learning needs beside them, lie in an array.

    layers: (2 networks, depth + 1, 7) `Layer`s, targets behind those that learn.  size: of the array.
    places: by SB3's names of parameters, (n,) where the numbers of each lie; "log_ent_coef" among them.
    """

    plan: ReplayPlan
    layers: NDArray[np.int64]
    size: int
    places: dict[str, NDArray[np.int64]]

    @classmethod
    @functools.lru_cache(maxsize=32)
    def of(cls, shape: ReplayShape, rows: int, itemsize: int) -> ReplayLayout:
        """For minibatches of `rows` samples, and numbers of `itemsize` bytes."""
        lanes = BYTES // itemsize
        rows = rounded_up(rows, lanes)
        parameters, work = Places(), Places()
        networks, starts = [], []
        places: dict[str, NDArray[np.int64]] = {}
        for sizes, stems in shape.networks():
            starts.append(parameters.taken)
            networks.append(Perceptron.of(sizes, lanes, parameters))
            places |= networks[-1].named(stems)
        log_alpha_at = parameters.take(1)
        length = rounded_up(parameters.taken, 4 * lanes)
        work.take(5 * length)
        places |= {_of_target(name): 4 * length + place for name, place in places.items()}
        places["log_ent_coef"] = np.array([log_alpha_at])

        panels = rounded_up(shape.inputs, lanes), rounded_up(shape.inputs + shape.outputs, lanes)
        inputs_at, joint_at, pulls_at = (work.take(rows * units) for units in (panels[0], panels[1], panels[1]))
        each = {name: work.take(shape.outputs * rows) for name in ("actions_at", "slopes_at", "noise_at", "pulled_at")}
        each |= {name: work.take(rows) for name in _COLUMNS}
        learnt = [
            network.layers(inputs_at if network.sizes[0] == shape.inputs else joint_at, rows, lanes, work)
            for network in networks
        ]
        # A target's units lie where its own's do: they are never wanted at once.
        targets = [layers + np.array([0, 0, 4 * length, 4 * length, 0, 0, 0]) for layers in learnt]
        plan = ReplayPlan(
            depth=len(shape.hidden), rows=rows, inputs=shape.inputs, outputs=shape.outputs,
            tanh=shape.activation == "tanh", length=length, targets=4 * length, networks=len(networks),
            critics_at=starts[FIRST] if len(starts) > FIRST else length,
            log_alpha_at=log_alpha_at, zeros_at=work.take(lanes), inputs_at=inputs_at, joint_at=joint_at,
            pulls_at=pulls_at, pulls_end=pulls_at + rows * panels[1], **each,
            turned_at=work.take(max(most_weights(sizes[:-1], lanes) for sizes, _ in shape.networks())),
            sums_at=work.take(GROUP * rows * lanes), block_at=work.take(2 * lanes * lanes),
        )  # fmt: skip
        return cls(plan, np.stack([*learnt, *targets]), work.taken, places)


_COLUMNS = ("rewards_at", "factors_at", "goals_at", "log_probs_at", "shares_at")


def _of_target(name: str) -> str:
    """SB3's name of a parameter's target."""
    network, _, rest = name.partition(".")
    return f"{network}_target.{rest}"


def prepared(entry: Any, dtype: Any, algorithm: Algorithm, settings: Any, noises: int, columns: int) -> Any:
    """An algorithm's update, compiled for arrays of `dtype`, which are the only ones it then takes.

    noises: arrays of them.  columns: that it tells of a minibatch.
    """
    layout = ReplayLayout.of(ReplayShape(algorithm, 1, 1, (1,), "relu"), 1, np.dtype(dtype).itemsize)
    samples: Sequence[Any] = [np.zeros((1, 1), dtype)] * (5 + noises)
    recorded = np.zeros((1, columns))
    entry.disable_compile(False)
    ready([(entry, (np.zeros(1, dtype), layout.plan, layout.layers, settings, *samples, 1, recorded))])
    entry.disable_compile()
    return entry


# ---- compiled ----


@function
def panels(m: Any, rows: int, to: int, values: Any, first: int, count: int) -> None:
    """Write `count` samples' inputs, (n, inputs) from sample `first` on, into panels."""
    lanes = width(m)
    for row in range(count):
        for unit in range(values.shape[1]):
            m[to + (unit // lanes * rows + row) * lanes + unit % lanes] = values[first + row, unit]


@function
def columns(m: Any, rows: int, to: int, values: Any, first: int, count: int) -> None:
    """Write `count` samples' (n, columns), from sample `first` on, as (columns, rows)."""
    for column in range(values.shape[1]):
        for row in range(count):
            m[to + column * rows + row] = values[first + row, column]


@function
def share_out(m: Any, plan: Any, count: int) -> None:
    """How much each row counts in a mean over minibatches of `count` samples."""
    for row in range(plan.rows):
        m[plan.shares_at + row] = 1.0 / count if row < count else 0.0


@function
def join(m: Any, plan: Any, count: int) -> None:
    """Write the actions at `actions_at` into the critics' inputs."""
    lanes, rows = width(m), plan.rows
    for output in range(plan.outputs):
        unit = plan.inputs + output
        to = plan.joint_at + unit // lanes * rows * lanes + unit % lanes
        for row in range(count):
            m[to + row * lanes] = m[plan.actions_at + output * rows + row]


@function
def part(m: Any, plan: Any) -> None:
    """Write the actions' part of the gradient of the critics' inputs to `pulled_at`."""
    lanes, rows = width(m), plan.rows
    for output in range(plan.outputs):
        unit = plan.inputs + output
        at = plan.pulls_at + unit // lanes * rows * lanes + unit % lanes
        for row in range(rows):
            m[plan.pulled_at + output * rows + row] = m[at + row * lanes]


@function
def clear(m: Any, first: int, last: int) -> None:
    """Set to 0."""
    for at in range(first, last, width(m)):
        store(m, at, every(m, 0.0))


@function
def lower_targets(m: Any, plan: Any, layers: Any, row: int) -> Any:
    """What the lower one of both target critics says of a few rows."""
    first = load(m, layers[plan.networks + FIRST, plan.depth][5] + row)
    second = load(m, layers[plan.networks + SECOND, plan.depth][5] + row)
    return where_greater(first, second, second, first)


@function
def set_goals(m: Any, plan: Any, row: int, following: Any) -> None:
    """What critics learn of a few rows: the reward, and its discounted share of what follows."""
    goal = fma(following, load(m, plan.factors_at + row), load(m, plan.rewards_at + row))
    store(m, plan.goals_at + row, goal)


@function
def fit_critics(m: Any, plan: Any, layers: Any, weight: float, count: int) -> Any:
    """The sum of both critics' mean squared errors, each times `weight`, whose gradients are then there."""
    lanes, rows = width(m), plan.rows
    squares, slope = every(m, 0.0), every(m, 2.0 * weight)
    for critic in (FIRST, SECOND):
        forward(m, plan, layers, critic)
        values_at, gradient_at = layers[critic, plan.depth][5], layers[critic, plan.depth][6]
        for row in range(0, rows, lanes):
            error = load(m, values_at + row) - load(m, plan.goals_at + row)
            scaled = error * load(m, plan.shares_at + row)
            squares = fma(error, scaled, squares)
            store(m, gradient_at + row, scaled * slope)
        backward(m, plan, layers, critic, count)
    return weight * total(squares)
