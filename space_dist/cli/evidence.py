"""Commands that tell causes: what a curriculum could save, and continuations that are the same until they part."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from space_dist.cli.grids import print_json
from space_dist.cli.terminal import Json, Overrides, console, delivered, say, warn
from space_dist.errors import Interrupted


def fork(
    run: Annotated[Path, typer.Argument(help="A run's folder.")],
    at: Annotated[int, typer.Option(help="Environment steps behind which the continuations part.")],
    set: Annotated[
        Optional[list[str]],  # noqa: UP045 - typer reads annotations at run time
        typer.Option(
            metavar="KEY=VALUE",
            help="What is otherwise from there on, in a continuation of its own: curriculum.kind=round_robin, "
            "'curriculum={kind: space, kappa: 4}', learner.learning_rate=0.0001. Repeatable.",
        ),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Continuations of each.")] = 5,
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="The grid's YAML file. Default: fork.yaml in the run's folder."),
    ] = None,
) -> None:
    """Write a grid that goes on from one moment of a run: as it was, and otherwise, from the same bits."""
    from space_dist.grid.forking import forked
    from space_dist.ledger import Ledger, there

    place = Ledger(there(run)).folder / "fork.yaml" if out is None else out
    runs = forked(run, at, set or (), seeds, place)
    say(f"{place}: {runs} runs, bit for bit the same as {run} until {at:,} steps. Next: space-dist grid run {place}")


def headroom(
    config: Annotated[Path, typer.Argument(help="A run's YAML file. Its curriculum plays no part.")],
    overrides: Overrides = None,
    steps: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=1, help="Environment steps of each run. Default: a fifth of the config's budget."),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Runs.")] = 5,
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Folder for runs, table and figure. Default: runs/<name>_headroom."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Say how much a curriculum could save, from a short run of uniform draws: before anything is claimed."""
    from rich.table import Table

    from space_dist.api.headroom import measure_headroom
    from space_dist.api.training import as_config
    from space_dist.report import headroom as reports

    settings = as_config(config, overrides or ())
    runs = "1 run" if seeds == 1 else f"{seeds} runs"
    warn(f"{settings.name}: {runs} of uniform draws, in {out or f'runs/{settings.name}_headroom'}")
    try:
        found = measure_headroom(settings, out=out, steps=steps, seeds=seeds, progress=console.is_terminal)
    except KeyboardInterrupt:
        raise Interrupted("ending with checkpoints; the same command goes on from there") from None
    rows, words = reports.table(found.headroom), reports.in_words(found.headroom)
    if as_json:
        print_json({"folder": str(found.folder), "shares": rows, "words": words})
        return
    shown = Table(title=f"{settings.name}: {len(found.train)} instances, uniform draws, {runs}", title_justify="left")
    for column in rows[0]:
        shown.add_column(column, justify="right")
    for row in rows:
        shown.add_row(*row.values())
    console.print(shown)
    for sentence in words:
        say(sentence)
    say(f"{found.folder / 'headroom.png'}, {found.folder / 'instances.csv'}")
    delivered()
