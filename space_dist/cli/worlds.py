"""Commands about environments: check one, and see what a policy does in it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Optional

import typer

from space_dist.cli.terminal import say
from space_dist.errors import ConfigError

env_app = typer.Typer(no_args_is_help=True, help="Check environments.")

Kwargs = Annotated[
    Optional[list[str]],  # noqa: UP045 - typer reads annotations at run time
    typer.Option("--kwarg", metavar="NAME=VALUE", help="An argument of the environment (env.kwargs). Repeatable."),
]


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
    from space_dist.envs import make_batched
    from space_dist.envs.checker import check
    from space_dist.instances import read_csv

    kwargs = parse_kwargs(kwarg)
    chosen = None
    if instances is not None:
        chosen = read_csv(instances, make_batched(env, 1, context_visible=False, kwargs=kwargs).context_bounds)
    findings = check(env, kwargs, chosen)
    for note in findings.notes:
        say(f"note: {note}")
    if findings.faults:
        raise ConfigError("\n".join(fault if env in fault else f"{env}: {fault}" for fault in findings.faults))
    say(f"{env}: no fault found. Context: {', '.join(findings.names)}. Horizon: {findings.horizon} steps")


def parse_kwargs(given: list[str] | None) -> dict[str, Any]:
    """`NAME=VALUE` as YAML reads the value. Raises ConfigError for anything else."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    kwargs: dict[str, Any] = {}
    for one in given or []:
        name, equals, value = one.partition("=")
        if not equals or not name.isidentifier():
            raise ConfigError(f"--kwarg {one!r} is not NAME=VALUE")
        try:
            kwargs[name] = YAML(typ="safe", pure=True).load(value)
        except YAMLError:
            kwargs[name] = None
        if not isinstance(kwargs[name], bool | int | float | str):
            raise ConfigError(f"--kwarg {one!r}: the value must be a number, a word, true or false")
    return kwargs
