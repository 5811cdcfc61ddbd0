"""Benchmarks that print ratios measured in one run: `python jobs/benchmark.py --help` lists them."""

from __future__ import annotations

import space_dist.cli  # noqa: F401  # isort: skip - one thread for all arithmetic, before NumPy is imported

import signal
from types import FrameType

import typer
from benchmarks import (
    arithmetic,
    chaos,
    checkpoint,
    coverage,
    curricula,
    curriculum,
    envs,
    equivalence,
    gpu,
    grid,
    kernel,
    off_policy,
    pic,
    throughput,
    tune,
)
from rich.console import Console

from space_dist.errors import SpaceDistError

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
for _benchmark in (
    arithmetic.arithmetic,
    chaos.chaos,
    checkpoint.checkpoint,
    coverage.coverage,
    curricula.curricula,
    curriculum.curriculum,
    envs.envs,
    equivalence.equivalence,
    gpu.gpu,
    grid.grid,
    kernel.kernel,
    off_policy.off_policy,
    pic.pic,
    throughput.throughput,
    tune.tune,
):
    app.command()(_benchmark)


@app.callback()
def _benchmarks() -> None:
    """Speed lives here, not in tests."""


def _end(number: int, _: FrameType | None) -> None:
    """End as on Ctrl-C: whoever has started processes ends them on the way out, which a second signal must not stop."""
    signal.signal(number, signal.SIG_IGN)
    raise SystemExit(128 + number)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, _end)
    try:
        app()
    except SpaceDistError as error:
        Console().print(f"benchmark: {error}", style="red", markup=False)
        raise SystemExit(error.exit_code) from None
