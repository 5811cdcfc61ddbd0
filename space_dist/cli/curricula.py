"""Commands about curricula: check one of your own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from space_dist.cli.terminal import Kwargs, parse_kwargs, say, tell_findings

curriculum_app = typer.Typer(no_args_is_help=True, help="Check curricula of your own.")


@curriculum_app.command("check")
def curriculum_check(
    curriculum: Annotated[
        str, typer.Argument(help="What a config calls curriculum.import: my_package.my_module:MyCurriculum.")
    ],
    instances: Annotated[Path, typer.Option(help="CSV of training instances to choose from.")],
    kwarg: Kwargs = None,
    column: Annotated[
        Optional[list[str]],  # noqa: UP045 - typer reads annotations at run time
        typer.Option(help="A column that is no feature of the context (curriculum.columns). Repeatable."),
    ] = None,
) -> None:
    """Say in plain words what is wrong with a curriculum. Exit code 0: nothing; 2: something."""
    from space_dist.curricula.checker import DECISIONS, check
    from space_dist.instances import read_features

    chosen, bounds = read_features(instances, column or (), named_by="--column")
    findings = check(curriculum, chosen, bounds, parse_kwargs(kwarg))
    tell_findings(findings, curriculum)
    say(f"{curriculum}: no fault found in {DECISIONS} decisions on {len(chosen)} instances")
