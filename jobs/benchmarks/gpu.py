"""Many members on one GPU: ours, its update alone, and everything jitted by JAX, interleaved on the same machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer
from rich.console import Console

from benchmarks.contenders import Contender
from benchmarks.results import JsonFile, can_be_a_folder, keep
from benchmarks.throughput import Row, fastest, in_words, measured, not_installed
from space_dist.errors import SpaceDistError

TASK = "pointmass"
SLOTS = (16, 64, 256)  # environments of each of JAX's members, that are tried
ON_A_CORE = 32  # members of ours on a core of the CPU
console = Console()


def gpu(
    rounds: Annotated[int, typer.Option(min=1, help="Rounds, in each of which everybody is measured once.")] = 3,
    seconds: Annotated[float, typer.Option(min=0.1, help="Length of one measurement, start and warm-up apart.")] = 5.0,
    members: Annotated[Optional[list[int]], typer.Option(min=2, help="Members side by side.")] = None,  # noqa: UP045
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Folder for the table.", callback=can_be_a_folder),
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Environment steps per second of PPO on one NVIDIA GPU: a population of ours beside JAX.

    PointMass, 2,048 / 64, networks of 64-64. Ours collects on one core of the CPU. JAX's number of environments is
    searched for, which takes a compilation each.
    """
    name = _gpu()
    rows: dict[str, Row] = {}
    for count in members or (256, 1024):
        ours = Contender("ours", update="population", members=count, device="cuda")
        rows[f"population_{count}"] = _row(f"{ours.title}: collects on a core, learns on the GPU", ours, seconds)
        alone = Contender("ours", update="stacked", members=count, device="cuda")
        rows[f"stacked_{count}"] = _row("ours, the stacked update alone", alone, seconds)
        if "jax" not in not_installed():
            tried = [Contender("jax", members=count, slots=slots, device="cuda") for slots in SLOTS]
            jax = fastest(TASK, tried, seconds)
            rows[f"jax_{count}"] = _row(jax.title, jax, seconds)
    core = Contender("ours", update="population", members=ON_A_CORE)
    rows["core"] = _row(f"{core.title}: a core of the CPU, no GPU", core, seconds)
    for number in range(rounds):
        for row in rows.values():
            row.take()
            console.print(
                f"round {number + 1}: {row.title}, {row.setting}: {in_words(row.rates[-1])}",
                markup=False,
                soft_wrap=True,
            )
    text = _markdown(name, rows, rounds)
    console.print(text, markup=False, soft_wrap=True)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "gpu.md").write_text(text)
    keep({"gpu": name, "rates": {key: row.rates for key, row in rows.items()},
          "settings": {key: f"{row.title}; {row.chosen}" for key, row in rows.items()}}, json_file)  # fmt: skip


def _gpu() -> str:
    """Its name. Raises SpaceDistError where torch finds none."""
    import torch

    if not torch.cuda.is_available():
        raise SpaceDistError("gpu needs an NVIDIA GPU and a torch with CUDA: torch finds no GPU on this machine")
    return str(torch.cuda.get_device_name())


def _row(title: str, contender: Contender, seconds: float) -> Row:
    return Row(title, contender.setting, lambda: measured(TASK, contender, seconds), {})


def _markdown(name: str, rows: dict[str, Row], rounds: int) -> str:
    lines = [
        f"Environment steps per second on one {name}: medians of {rounds} interleaved rounds (least and most).",
        "",
        "| | setting | steps/s |",
        "|---|---|---:|",
    ]
    lines += [f"| {row.title} | {row.chosen} | {row.span} |" for row in rows.values()]
    if "jax" in not_installed():
        lines.append("| JAX | not installed (extra `bench`) | |")
    return "\n".join(lines) + "\n"
