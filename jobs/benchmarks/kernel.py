"""PPO's compiled update beside the stacked one, by minibatch and member."""

from __future__ import annotations

import itertools
import math
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Annotated, Any

import numba
import numpy as np
import torch
import typer
from numpy.typing import NDArray
from rich.console import Console

from space_dist.kernels import Layout, Settings, Shape, aligned, prepare
from space_dist.kernels.lanes import product
from space_dist.kernels.ppo import N_RECORDED
from space_dist.learner.stack import Stack
from space_dist.learner.stacked import PPO, PPOSettings, Samples

console = Console()
MEMBERS, MINIBATCHES = 16, 8  # members of a stack; minibatches that are timed together
SHAPES = {(64, 64): 64, (128, 128): 128, (256, 256): 512}  # hidden units, and a minibatch
_TILE = product(4, 1)


def kernel(
    rounds: Annotated[int, typer.Option(min=1, help="interleaved measurements of each")] = 40,
) -> None:
    """Microseconds that a minibatch takes a member: the compiled update beside the stacked one."""
    start = time.perf_counter()
    prepare(np.dtype(np.float32))
    console.print(f"compiled or loaded in {time.perf_counter() - start:.1f} s")
    torch.set_num_threads(1)
    limit = _products_per_second()
    console.print(f"this core: {limit / 1e9:.0f} GFLOP/s of products in its first cache")
    for hidden, size in SHAPES.items():
        shape = Shape(7, 2, False, hidden, "tanh")
        works = [_compiled(shape, size), stacked_update(shape, size, size * MINIBATCHES, 1, MEMBERS, "cpu")]
        times: list[list[float]] = [[], []]
        for _ in range(rounds):
            for taken, work in zip(times, works, strict=True):
                start = time.perf_counter()
                work()
                taken.append((time.perf_counter() - start) / MINIBATCHES)
        times[1] = [taken / MEMBERS for taken in times[1]]
        compiled, stacked = (min(taken) for taken in times)
        ratio = statistics.median(other / one for one, other in zip(*times, strict=True))
        # Forward, weights' gradient, and the gradient below all but the first layer.
        sizes = (7, *hidden)
        layers = [2 * a * b for a, b in itertools.pairwise(sizes)]
        operations = 2 * size * (3 * sum(layers) - layers[0] + 3 * 2 * hidden[-1] * 3 / 2)
        console.print(
            f"{'-'.join(map(str, hidden))}, minibatch {size}: compiled {compiled * 1e6:.1f} us "
            f"({operations / compiled / 1e9:.0f} GFLOP/s), stacked {stacked * 1e6:.1f} us ({MEMBERS} members); "
            f"least of {rounds}; ratio {stacked / compiled:.2f} of those, {ratio:.2f} in the median round",
            soft_wrap=True,
        )


def seconds(shape: Shape, size: int, rounds: int = 40) -> float:
    """That a minibatch of `size` takes the compiled update, at the least."""
    work, best = _compiled(shape, size), math.inf
    for _ in range(rounds):
        start = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - start)
    return best / MINIBATCHES


def _products_per_second() -> float:
    """Additions and multiplications of the kernel's own innermost loop, on numbers that stay in the first cache."""

    @numba.njit  # type: ignore[untyped-decorator]
    def repeated(m: Any, times: int) -> None:
        for _ in range(times):
            _TILE(m, 0, 0, 64, 0, 0, 128, 16, 1, 48, 16, 1152, 0, 256)

    m, times, best = aligned(1152 + 256 * 16, np.float32), 1000, math.inf
    repeated(m, 1)
    for _ in range(50):
        start = time.perf_counter()
        repeated(m, times)
        best = min(best, time.perf_counter() - start)
    return 2 * 4 * 16 * 256 * times / best


def _compiled(shape: Shape, size: int) -> Callable[[], object]:
    update = prepare(np.dtype(np.float32)).update
    random, layout, n = np.random.default_rng(0), Layout.of(shape, size, 4), size * MINIBATCHES
    m = aligned(layout.size, np.float32)
    for places in layout.places.values():
        m[places] = 0.1 * random.normal(size=len(places))
    samples = np.zeros((n, layout.plan.record), dtype=np.float32)
    samples[:, : layout.record_at + layout.plan.fields] = random.normal(size=(n, layout.record_at + layout.plan.fields))
    samples[:, shape.inputs : layout.record_at] = 0.0
    settings = Settings(3e-4, 0.9, 0.999, 1e-5, 0, 0.2, math.inf, 0.0, 0.5, 0.5, math.inf, True)
    orders, told, flat = random.permutation(n)[None], np.zeros((MINIBATCHES, N_RECORDED)), samples.ravel()
    return lambda: update(m, layout.plan, layout.layers, settings, flat, orders, size, told)


def stacked_update(
    shape: Shape, size: int, n_steps: int, epochs: int, members: int, device: str
) -> Callable[[], object]:  # fmt: skip
    """The stacked update of so many members, each of `n_steps` samples in minibatches of `size`; permutations too."""
    random = torch.Generator().manual_seed(0)
    stack = Stack(shape, members, device=torch.device(device), dtype=torch.float32)
    for name in stack.layout.names:
        parameter = stack.parameter(stack.weights, name)
        parameter.copy_(0.1 * torch.randn(parameter.shape, generator=random))

    def drawn(*more: int) -> torch.Tensor:
        return torch.randn(members, n_steps, *more, generator=random).to(stack.device)

    samples = Samples(drawn(shape.inputs), drawn(shape.outputs), drawn(), drawn(), drawn())
    own = PPOSettings(3e-4, 0.2, 0.0, 0.5, 0.5, math.inf, True)
    numbers = [np.random.RandomState(member) for member in range(members)]

    def orders() -> Iterator[NDArray[np.int64]]:
        for _ in range(epochs):
            yield np.stack([each.permutation(n_steps) for each in numbers])

    ppo = PPO(stack, samples, [own] * members, size)
    return lambda: ppo.run(orders())
