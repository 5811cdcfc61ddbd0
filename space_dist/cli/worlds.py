"""Commands about environments: check one, and see what a policy does in it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from space_dist.cli.terminal import Kwargs, one_run, parse_kwargs, say, tell_findings
from space_dist.errors import ConfigError

env_app = typer.Typer(no_args_is_help=True, help="Check environments.")


@env_app.command("check")
def env_check(
    env: Annotated[str, typer.Argument(help="What a config calls env.id: my_package.my_module:make.")],
    kwarg: Kwargs = None,
    instances: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="CSV of contexts to try; default: drawn within the bounds."),
    ] = None,
) -> None:
    """Say in plain words what is wrong with an environment. Exit code 0: nothing; 2: something."""
    from space_dist.envs.checker import check
    from space_dist.envs.spec import read_spec
    from space_dist.instances import read_csv

    kwargs = parse_kwargs(kwarg)
    chosen = None
    if instances is not None:
        chosen = read_csv(instances, read_spec(env, context_visible=False, kwargs=kwargs).context_bounds)
    findings = check(env, kwargs, chosen)
    tell_findings(findings, env)
    say(f"{env}: no fault found. Context: {', '.join(findings.names)}. Horizon: {findings.horizon} steps")


def render(
    run: Annotated[Path, typer.Argument(help="A run's folder.", callback=one_run)],
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")],
    instances: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Ids of training or test instances: 0,5,9. Default: three of the test set."),
    ] = None,
) -> None:
    """Draw what a run's policy does: a GIF for each instance, and trajectories side by side."""
    from space_dist.ledger import Ledger, there
    from space_dist.run.render import draw_run

    ids = None
    if instances is not None:
        try:
            ids = [int(one) for one in instances.split(",")]
        except ValueError:
            raise ConfigError(f"--instances {instances!r} must be ids, separated by commas: 0,5,9") from None
    for path, what in draw_run(Ledger(there(run)), out, ids):
        say(f"{path}: {what}")
