"""Commands about what a user writes: instance sets and configs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table

from space_dist.cli.terminal import Kwargs, Overrides, console, delivered, parse_kwargs, say, write
from space_dist.errors import ConfigError, about, nearest

if TYPE_CHECKING:
    from space_dist.instances import InstanceSet

SchemaRow = tuple[str, str, str, str]  # key, type, default, explanation

instances_app = typer.Typer(no_args_is_help=True, help="Make and check instance sets.")
config_app = typer.Typer(no_args_is_help=True, help="Explain and check configs.")


@instances_app.command("sample")
def instances_sample(
    distribution: Annotated[
        str, typer.Argument(help="pointmass_uniform, maze_dfs, ...; uniform: of --env, within its bounds.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for <distribution>_train.csv and <distribution>_test.csv.")],
    n_train: Annotated[int, typer.Option("--train", min=1, max=10_000_000, help="Training instances.")] = 100,
    n_test: Annotated[int, typer.Option("--test", min=1, max=10_000_000, help="Test instances.")] = 100,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1)] = 0,
    env: Annotated[Optional[str], typer.Option(help="With uniform: the environment.")] = None,  # noqa: UP045
    kwarg: Kwargs = None,
) -> None:
    """Draw disjoint training and test instances."""
    from space_dist.envs import distribution_of
    from space_dist.envs.distributions import DISTRIBUTIONS, sample
    from space_dist.instances import shown

    if distribution not in (allowed := ("uniform", *DISTRIBUTIONS)):
        raise ConfigError(
            f"unknown distribution {shown(distribution)}{nearest(distribution[:100], allowed)} "
            f"(known are {', '.join(allowed)})"
        )
    if (distribution == "uniform") != (env is not None):
        raise ConfigError("`instances sample uniform` needs --env, and no other distribution takes it")
    known = DISTRIBUTIONS if env is None else {"uniform": distribution_of(env, parse_kwargs(kwarg))}
    train_set, test_set = sample(distribution, n_train, n_test, seed, known)
    for name, chosen in (("train", train_set), ("test", test_set)):
        path = out / f"{distribution}_{name}.csv"
        if path.exists():
            raise ConfigError(f"{path} exists; choose another --out, or remove it")
        write(path, chosen.to_csv())
        say(f"{path}: {len(chosen)} instances")


@instances_app.command("pad")
def instances_pad(
    file: Annotated[Path, typer.Argument(metavar="SET.csv", help="A training set.")],
    share: Annotated[float, typer.Option(help="How much of the padded set cannot be solved, between 0 and 1.")],
    out: Annotated[Path, typer.Option(help="The CSV file to write.")],
    env: Annotated[str, typer.Option(help="The environment whose contexts these are.")],
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1)] = 0,
    kwarg: Kwargs = None,
) -> None:
    """Add instances that no policy can solve, as the environment draws them, until they are a share of the set."""
    from space_dist.envs.padding import pad
    from space_dist.envs.spec import read_spec
    from space_dist.instances import PADDING_IDS, read_csv

    if out.exists():
        raise ConfigError(f"{out} exists; choose another --out, or remove it")
    kwargs = parse_kwargs(kwarg)
    bounds = read_spec(env, context_visible=False, kwargs=kwargs).context_bounds
    padded = pad(read_csv(file, bounds), share, seed, env, kwargs)
    write(out, padded.to_csv())
    say(f"{out}: {len(padded)} instances, {_padding(padded)} (ids from {PADDING_IDS})")


def _padding(instances: InstanceSet) -> str:
    count = int(instances.padding.sum())
    return f"{count} of them padding that no policy can solve: a share of {count / len(instances):.4g}"


@instances_app.command("check")
def instances_check(
    files: Annotated[list[Path], typer.Argument(help="CSV files; given two, they must not share a context.")],
    env: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="The environment whose contexts these are. Default: space_dist/PointMass-v0."),
    ] = None,
    kwarg: Kwargs = None,
    columns: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option("--column", help="A further column that may be there, such as a manual order. Repeatable."),
    ] = None,
) -> None:
    """Check instance files and show what is in them."""
    from space_dist.config import located
    from space_dist.envs.spec import read_spec
    from space_dist.instances import read_csv, refuse_overlap, summary

    known = env or "space_dist/PointMass-v0"
    bounds = read_spec(known, context_visible=False, kwargs=parse_kwargs(kwarg)).context_bounds
    files = [located(file) for file in files]
    try:
        sets = [read_csv(file, bounds, columns or (), if_there=True) for file in files]
    except ConfigError as error:
        if env is not None or not all(file.is_file() for file in files):
            raise
        raise ConfigError(
            f"{error}. They were taken for contexts of {known}: --env names another environment"
        ) from None
    for index, one in enumerate(sets):
        for other in range(index):
            refuse_overlap(sets[other], one, str(files[other]), str(files[index]))
    for file, one in zip(files, sets, strict=True):
        padding = f", {_padding(one)}" if one.padding.any() else ""
        say(f"{file}: {len(one)} instances{padding}")
        table = Table()
        for name in ("feature", "least", "mean", "greatest", "bounds"):
            table.add_column(name, justify="left" if name == "feature" else "right")
        for row, low, high in zip(summary(one, bounds), bounds.low, bounds.high, strict=True):
            table.add_row(row[0], *(f"{value:.4g}" for value in row[1:]), f"[{low:g}, {high:g}]")
        console.print(table)


@config_app.command("schema")
def config_schema(
    only: Annotated[
        Optional[str],  # noqa: UP045
        typer.Argument(
            metavar="KEY",
            help="Only keys with these letters (gamma, learner.), or of a section of this kind (space, ppo).",
        ),
    ] = None,
    of: Annotated[str, typer.Option(help="Whose keys: of a run, a grid, or a search.")] = "run",
) -> None:
    """Explain every key: type, default, meaning, unit and source."""
    schemas = _schemas()
    if of not in schemas:
        raise ConfigError(f"--of {of!r} is not known{nearest(of, schemas)} Allowed: {', '.join(schemas)}")
    for key, kind, default, text in schemas[of] if only is None else _about(only, of, schemas):
        if kind == "section":
            console.print(f"\n[bold]{key}[/bold]  {text}", highlight=False)
        else:
            about_it = kind if default == "required" else f"{kind}, default {default}"
            required = " (required)" if default == "required" else ""
            console.print(f"  [bold]{key}[/bold]: {escape(about_it)}{required}", highlight=False)
            console.print(Padding(escape(text), (0, 0, 0, 6)), highlight=False)
    delivered()


def _schemas() -> dict[str, list[SchemaRow]]:
    """The keys of each kind of file that a user writes."""
    from space_dist.config import RunConfig, schema
    from space_dist.experiment.grid_file import GridConfig
    from space_dist.experiment.tuning import TuneConfig

    return {name: list(schema(of)) for name, of in (("run", RunConfig), ("grid", GridConfig), ("search", TuneConfig))}


def _about(asked: str, of: str, schemas: Mapping[str, list[SchemaRow]]) -> list[SchemaRow]:
    """Rows of a schema: of keys with these letters, and of sections of this kind. Raises ConfigError for none."""
    from space_dist.config import what_sb3_calls

    if found := _rows_about(asked, schemas[of]):
        return found
    if others := [other for other, rows in schemas.items() if other != of and _rows_about(asked, rows)]:
        ways = " or ".join(f"--of {other}" for other in others)
        raise ConfigError(f"config schema: no key of a {of} has {asked!r} in it; {ways} shows one that has")
    if (meant := what_sb3_calls(asked)) is not None:
        raise ConfigError(f"config schema: no key has {asked!r} in it. {meant}")
    keys = {row[0].rpartition(".")[2] for row in schemas[of]}
    raise ConfigError(f"config schema: no key has {asked!r} in it{nearest(asked, keys)}")


def _rows_about(asked: str, rows: Iterable[SchemaRow]) -> list[SchemaRow]:
    found: list[SchemaRow] = []
    header: SchemaRow | None = None
    whole = False
    for row in rows:
        if row[1] == "section":
            header, whole = row, row[0].endswith(f" ({asked})")
            continue
        inside = header is not None and row[0].startswith(f"{header[0].partition(' ')[0]}.")
        if asked in row[0] or (inside and whole):
            found += [header] if inside and header is not None and header not in found else []
            found.append(row)
    return found


@config_app.command("check")
def config_check(
    config: Annotated[Path, typer.Argument(help="A run's YAML file.")],
    overrides: Overrides = None,
) -> None:
    """Check a config and its instance files, and print it with every default written out."""
    from space_dist import config as configs
    from space_dist.run.building import Blueprint

    run = configs.load(config, overrides or (), to_check=True)
    with about(str(config), configs.origins(overrides or ())):
        blueprint = Blueprint.of(run)
        blueprint.setup(*blueprint.instances())
    print(configs.dump(run), end="")
    delivered()
