"""How fast PPO trains: ours beside JAX, SBX, SB3 and RLlib, interleaved, each rival with its best setting."""

from __future__ import annotations

import functools
import importlib.util
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Optional

import typer
from rich.console import Console

from benchmarks.contenders import TASKS, XLA_FLAGS, Contender, specification
from benchmarks.processes import all_ended
from benchmarks.results import JsonFile, can_be_a_folder, can_be_written, keep
from space_dist import config as configs
from space_dist.arithmetic import SETTINGS
from space_dist.errors import SpaceDistError

ROOT = Path(__file__).resolve().parents[2]
CORES = 2
PATIENCE = 60.0  # seconds for a setting that is tried, its start included: one with too many threads may take hours
PARTS = (*TASKS, "population", "table1")
DUMMY, SUBPROCESSES, BATCHED = (4, 8, 16, 32), (2, 4, 8), (16, 64)  # environments that are tried for rivals
SLOTS = (16, 64)  # that are tried for ours and for JAX
RUNNERS = ((0, 1), (0, 8), (0, 32), (2, 1), (2, 8))  # RLlib's env runners, and environments of each
MEMBERS: dict[str, list[Any]] = {"learner.learning_rate": [1e-4, 2e-4, 3e-4, 5e-4]}  # of a population, times 8 seeds
TABLE1: dict[str, list[Any]] = {  # docs/grids.md
    "curriculum.kappa": [1, 4, 16, 64], "curriculum.eta": [0.025, 0.05, 0.1, 0.2],
}  # fmt: skip
TABLE1_STEPS = 4 * 4 * 10 * 1e6
JITTED = ("pointmass", "pointmass_large")  # whose environment is there for JAX
EXTRA = {"rllib": "RLlib", "jax": "JAX", "sbx": "SBX"}  # of the extra `bench`: rows that may be missing
# What is wanted at least, on two cores.
WANTED = {
    "lean_vs_subproc2": 3.0, "lean_vs_best_sb3": 1.5, "lean_vs_rllib": 3.0, "batched_vs_subproc2": 12.0,
    "batched_vs_sb3_batched": 1.4, "ant_vs_subproc2": 1.7, "population_vs_best_sb3": 20.0, "lean_vs_jax": 0.9,
    "learning_vs_jax": 1.1, "lean_vs_before": 4.0, "population_vs_before": 2.5,
}  # fmt: skip
PAIRS = {  # a ratio: the task, ours, and the rival
    "lean_vs_subproc2": ("pointmass", "lean", "subproc2"),
    "lean_vs_best_sb3": ("pointmass", "lean", "best_sb3"),
    "lean_vs_rllib": ("pointmass", "lean", "rllib"),
    "batched_vs_subproc2": ("pointmass_large", "lean", "subproc2"),
    "batched_vs_sb3_batched": ("pointmass_large", "lean", "sb3_batched"),
    "ant_vs_subproc2": ("ant", "overlap", "subproc2"),
    "population_vs_best_sb3": ("population", "population", "best_sb3"),
    "lean_vs_jax": ("pointmass", "lean", "jax"),
    "learning_vs_jax": ("population", "learning", "jax"),
    "lean_vs_before": ("pointmass", "lean", "before"),
    "population_vs_before": ("population", "population", "before"),
}
console = Console()


@dataclass
class Row:
    """One line of the table.

    measure: gives `rate`, environment steps per second, and of some `compile`, seconds.  waits: seconds per environment
    step that no dispatch can save, by cause.  kernel: seconds per environment step of our compiled update, alone, on
    all the cores that the row has.  rates, compiling: one per round.
    """

    title: str
    setting: str
    measure: Callable[[], Mapping[str, float]]
    waits: dict[str, float]
    kernel: float = 0.0
    rates: list[float] = field(default_factory=list)
    compiling: list[float] = field(default_factory=list)

    def take(self) -> None:
        """Measure once more."""
        found = self.measure()
        self.rates.append(found["rate"])
        if "compile" in found:
            self.compiling.append(found["compile"])

    @property
    def rate(self) -> float:
        """Median over the rounds."""
        return statistics.median(self.rates)

    @property
    def span(self) -> str:
        """Median, least and most over the rounds."""
        if not self.rate:
            return "none finished"
        return f"{self.rate:,.0f} ({min(self.rates):,.0f}-{max(self.rates):,.0f})"

    @property
    def chosen(self) -> str:
        """The setting, and what compiling took, which no rate but those of whole wall times has in it."""
        if not self.compiling:
            return self.setting
        return f"{self.setting}; {statistics.median(self.compiling):.1f} s to compile"

    def limit(self) -> str:
        """Where its time goes, as far as can be told: what is left is dispatch."""
        if not self.waits or not self.rate:
            return ""
        shares = {cause: min(1.0, seconds * self.rate) for cause, seconds in self.waits.items()}
        shares["dispatch"] = max(0.0, 1.0 - sum(shares.values()))
        ordered = sorted(shares.items(), key=lambda item: -item[1])
        return ", ".join(f"{cause} {share:.0%}" for cause, share in ordered)


def throughput(
    rounds: Annotated[int, typer.Option(min=1, help="Rounds, in each of which everybody is measured once.")] = 3,
    seconds: Annotated[float, typer.Option(min=0.1, help="Length of one measurement, start and warm-up apart.")] = 5.0,
    only: Annotated[Optional[list[str]], typer.Option(help=f"Only these parts: {', '.join(PARTS)}.")] = None,  # noqa: UP045
    member_steps: Annotated[int, typer.Option(min=2048, help="Steps of each of the 32 runs of a grid.")] = 102_400,
    before: Annotated[Optional[Path], typer.Option(help="Also measure the checkout there, in this Python.")] = None,  # noqa: UP045
    settings: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            help="Keep here which settings were fastest; what is kept there is not searched again.",
            callback=can_be_written,
        ),
    ] = None,
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Folder for the table and the figure.", callback=can_be_a_folder),
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Environment steps per second of PPO: ours (stock, lean, population) beside JAX, SBX, SB3 and RLlib.

    First it searches for the fastest setting of each, which takes longer than the rounds do; --settings keeps them.
    """
    unknown = sorted({*(only or ())} - {*PARTS})
    if unknown:
        raise typer.BadParameter(f"{unknown[0]} is no part; allowed: {', '.join(PARTS)}", param_hint="--only")
    if before is not None and not (before / "space_dist" / "__init__.py").exists():
        raise typer.BadParameter(f"{before} is no checkout of space_dist", param_hint="--before")
    kept(settings)  # before anything is measured
    checkout = "" if before is None else str(before.resolve())
    parts = only or PARTS
    missing = not_installed()
    table: dict[str, dict[str, Row]] = {}
    for name in [name for name in TASKS if name in parts]:
        found = _searched(name, settings, functools.partial(_search, name, seconds, missing))
        table[name] = _rows(name, found, seconds, checkout)
    if "population" in parts:
        rivals = _searched("population", settings, lambda: _search_population(seconds, missing))
        table["population"] = _population_rows(rivals, seconds, member_steps, checkout)
    for number in range(rounds):
        for name, rows in table.items():
            for row in rows.values():
                row.take()
                console.print(
                    f"round {number + 1}, {name}: {row.title}: {in_words(row.rates[-1])}",
                    markup=False,
                    soft_wrap=True,
                )
    ratios = {
        name: ratio
        for name, (task, ours, rival) in PAIRS.items()
        if task in table and rival in table[task]
        and (ratio := _ratio(table[task][ours], table[task][rival])) is not None
    }  # fmt: skip
    projected = _table1(member_steps) if "table1" in parts else {}
    text = _markdown(table, ratios, projected, rounds, missing)
    console.print(text, markup=False, soft_wrap=True)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "throughput.md").write_text(text)
        if table:
            _figure(table, out / "throughput.png")
    keep(_numbers(table, ratios, projected), json_file)
    short = [name for name, ratio in ratios.items() if ratio < WANTED[name]]
    if short:
        console.print(f"Less than wanted: {', '.join(short)}.", style="red")
        raise typer.Exit(1)


def _ratio(ours: Row, rival: Row) -> float | None:
    """Median of the rounds' ratios: what slows the whole machine for a while slows both.

    Of rounds that the rival has finished; None if there is none.
    """
    found = [one / other for one, other in zip(ours.rates, rival.rates, strict=True) if other]
    return statistics.median(found) if found else None


def in_words(rate: float) -> str:
    """Steps per second; none where nothing was finished, which is no speed."""
    return f"{rate:,.0f} steps/s" if rate else "none finished"


# ---- who is measured ----


def _searched(
    part: str, file: Path | None, search: Callable[[], dict[str, Contender]]
) -> dict[str, Contender]:  # fmt: skip
    """The contenders of a part with their fastest settings: as `file` has them, or as `search` finds them now."""
    known = kept(file)
    if part not in known:
        known[part] = search()
        if file is not None:
            plain = {
                name: {who: asdict(contender) for who, contender in found.items()} for name, found in known.items()
            }
            file.write_text(json.dumps(plain, indent=1) + "\n")
    return known[part]


def kept(file: Path | None) -> dict[str, dict[str, Contender]]:
    """The contenders that a file of settings has, part by part. Raises BadParameter if it is no such file."""
    if file is None or not file.exists() or not file.stat().st_size:
        return {}
    try:
        return {
            str(part): {
                str(name): Contender(**{**contender, "overrides": tuple(contender["overrides"])})
                for name, contender in found.items()
            }
            for part, found in json.loads(file.read_text()).items()
        }
    except (OSError, ValueError, TypeError, AttributeError, KeyError):
        raise typer.BadParameter(
            f"{file} is no file of settings as this benchmark keeps them; remove it, or name another",
            param_hint="--settings",
        ) from None


def _search(task: str, seconds: float, missing: Collection[str]) -> dict[str, Contender]:
    """Everybody's fastest setting on one task."""
    subproc = [Contender("sb3", vec_env="subproc", n_envs=2, threads=threads) for threads in (1, CORES)]
    stock = [
        Contender("sb3", vec_env=kind, n_envs=n)
        for kind, counts in (("subproc", SUBPROCESSES), ("dummy", DUMMY))
        for n in counts
    ]
    found = {"subproc2": fastest(task, subproc, seconds), "best_sb3": fastest(task, stock, seconds)}
    found["sb3_batched"] = fastest(task, [Contender("sb3", vec_env="batched", n_envs=n) for n in BATCHED], seconds)
    for name in ("best_sb3", "sb3_batched"):
        found[name] = fastest(task, [found[name], replace(found[name], threads=CORES)], seconds)
    if "rllib" not in missing:
        found["rllib"] = fastest(task, [Contender("rllib", runners=r, n_envs=n) for r, n in RUNNERS], seconds)
    if "sbx" not in missing:
        found["sbx"] = _best_sbx(task, seconds)
    if task in JITTED and "jax" not in missing:
        found["jax"] = _best_jax(task, seconds, members=1)
    if TASKS[task].shards > 1:
        found |= {update: Contender("ours", update=update, workers=CORES) for update in ("stock", "lean")}
        found["overlap"] = replace(found["lean"], overlap=True)
    else:
        for update in ("stock", "lean"):
            ours = [Contender("ours", update=update, slots=slots) for slots in SLOTS]
            found[update] = fastest(task, ours, seconds)
    return found


def _rows(task: str, found: dict[str, Contender], seconds: float, checkout: str) -> dict[str, Row]:
    """Everybody on one task.

    Another version of ours is measured where it collects in its own process, with the task's slots: 2f6e945 takes none
    that are shorter than an episode.
    """
    costs = process(specification(task, None, 0.0), Contender("ours").first)
    if checkout and TASKS[task].shards == 1:
        found = {**found, "before": replace(found["lean"], slots=0, checkout=checkout)}
    return {
        name: Row(
            contender.title, contender.setting,
            lambda contender=contender: measured(task, contender, seconds),  # type: ignore[misc]
            _waits(contender, costs), costs["kernel"],
        )
        for name, contender in found.items()
    }  # fmt: skip


def _best_sbx(task: str, seconds: float) -> Contender:
    contenders = [Contender("sbx", vec_env="batched", n_envs=n, flags=XLA_FLAGS[0]) for n in BATCHED]
    best = fastest(task, contenders, seconds)
    return fastest(task, [replace(best, flags=flags) for flags in ("", *XLA_FLAGS)], seconds)


def _best_jax(task: str, seconds: float, *, members: int) -> Contender:
    best = fastest(
        task, [Contender("jax", members=members, flags=XLA_FLAGS[0], slots=slots) for slots in SLOTS], seconds
    )
    return fastest(task, [replace(best, flags=flags) for flags in XLA_FLAGS], seconds)


def fastest(
    task: str, contenders: Sequence[Contender], seconds: float, way_out: str = "or the benchmark a shorter --seconds"
) -> Contender:  # fmt: skip
    """The fastest in one short measurement each; one that does not get it done in a minute is none.

    Raises SpaceDistError if that is so of all. way_out: what its sentence advises beside less work for the machine.
    """
    rates = {}
    for contender in contenders:
        tried = f"search, {task}: {contender.title}, {contender.setting}"
        _note(f"{tried}: is tried, for {PATIENCE:.0f} s at most")
        rates[contender] = measured(task, contender, seconds / 2.0, patience=PATIENCE)["rate"]
        _note(f"{tried}: {in_words(rates[contender])}")
    if not any(rates.values()):
        raise SpaceDistError(
            f"{task}: of {len(rates)} settings that were tried none finished within {PATIENCE:.0f} s, its start "
            f"and warm-up included; give the machine less else to do, {way_out}"
        )
    return max(rates, key=lambda contender: rates[contender])


def _note(text: str) -> None:
    console.print(text, style="dim", markup=False, soft_wrap=True)


def _waits(contender: Contender, costs: dict[str, float]) -> dict[str, float]:
    """Seconds per environment step of the simulator and of arithmetic, as far as they cannot run side by side.

    Nothing of JAX, and of ours that are compiled: neither simulator nor arithmetic is then what was measured alone.
    """
    if contender.kind == "jax" or (contender.kind == "ours" and contender.update != "stock"):
        return {}
    batched = contender.kind == "ours" or contender.vec_env == "batched"
    processes = {"ours": contender.workers, "rllib": contender.runners}.get(
        contender.kind, contender.n_envs if contender.vec_env == "subproc" else 1
    )
    simulator = costs["batched" if batched and contender.kind != "rllib" else "single"] / min(CORES, max(1, processes))
    return {"simulator": simulator, "arithmetic": costs["arithmetic"] / contender.threads}


def _search_population(seconds: float, missing: Collection[str]) -> dict[str, Contender]:
    """Everybody's fastest setting for many runs on all cores."""
    rivals = {
        "best_sb3": [Contender("sb3", vec_env="dummy", n_envs=n) for n in DUMMY],
        "sb3_batched": [Contender("sb3", vec_env="batched", n_envs=n) for n in BATCHED],
    }
    found = {name: fastest("pointmass", contenders, seconds) for name, contenders in rivals.items()}
    if "sbx" not in missing:
        found["sbx"] = _best_sbx("pointmass", seconds)
    if "jax" not in missing:
        found["jax"] = _best_jax("pointmass", seconds, members=32 // CORES)
    return found


def _population_rows(
    rivals: dict[str, Contender], seconds: float, member_steps: int, checkout: str
) -> dict[str, Row]:  # fmt: skip
    """Grids of 32 runs on all cores: by whole wall time, or by that of collecting and learning alone."""
    costs = process(specification("pointmass", None, 0.0), Contender("ours").first)
    learning = "collecting and learning alone"
    whole, kernel = "whole wall time: start, evaluation, ledgers and checkpoints included", costs["kernel"] / CORES
    rows, engine = {}, {"engine": "population"}

    def alone(name: str, contender: Contender) -> None:
        """By time of learning, in as many processes as there are cores."""
        rows[name] = Row(
            f"{contender.title}, {CORES} processes at a time", f"{learning}; {contender.setting}",
            lambda: measured("pointmass", contender, seconds, processes=CORES),
            {cause: wait / CORES for cause, wait in _waits(contender, costs).items()}, kernel,
        )  # fmt: skip

    for name, contender in rivals.items():
        alone(name, contender)
    steps, each = 32 * _whole_updates(member_steps), 32 // CORES
    if jax := rivals.get("jax"):
        rows["jax_whole"] = Row(
            f"{jax.title}: 32 runs", "whole wall time: start and compiling included; neither evaluation nor ledger",
            lambda: {"rate": steps / _jax_seconds(jax, member_steps)}, {}, kernel,
        )  # fmt: skip
    ours = [("learning", "population", "")] + ([("before_learning", "before", checkout)] if checkout else [])
    for name, of_grid, where in ours:
        contender = Contender("ours", update="population", members=each, checkout=where)
        alone(name, contender)
        rows[of_grid] = Row(
            f"{contender.title}: a grid of 32 runs", whole,
            lambda where=where: {"rate": steps / _grid_seconds(member_steps, MEMBERS, 8, engine, where)},  # type: ignore[misc]
            {}, kernel,
        )  # fmt: skip
    return rows


# ---- how it is measured ----


def measured(
    task: str, contender: Contender, seconds: float, *, processes: int = 1, patience: float | None = None
) -> dict[str, float]:
    """`rate`: steps per second of so many processes at once, together; 0 if they take longer than `patience` seconds.

    `compile`: seconds, of those who compile apart.
    """
    found = _together([
        (specification(task, contender, seconds, core=core if contender.pinned else None), contender)
        for core in range(processes)
    ], patience)  # fmt: skip
    if not found:
        return {"rate": 0.0}
    compiling = {"compile": max(one["compile"] for one in found)} if "compile" in found[0] else {}
    return {"rate": sum(one["rate"] for one in found), **compiling}


def _jax_seconds(contender: Contender, member_steps: int) -> float:
    """Wall time of as many pinned processes as there are cores, from their start to their end."""
    updates = _whole_updates(member_steps) // 2048
    start = time.perf_counter()
    _together([(specification("pointmass", contender, 0.0, core=core, updates=updates), contender)
               for core in range(CORES)])  # fmt: skip
    return time.perf_counter() - start


def _together(wanted: Sequence[tuple[str, Contender]], patience: float | None = None) -> list[dict[str, float]]:
    """What so many processes at once have found; nothing if they take longer than `patience` seconds."""
    with all_ended():
        processes = [_start(asked, one.first, one.checkout) for asked, one in wanted]
        try:
            return [_finish(process, one, patience) for process, (one, _) in zip(processes, wanted, strict=True)]
        except subprocess.TimeoutExpired:
            return []


def process(wanted: str, first: str, checkout: str = "") -> dict[str, float]:
    """What one process of `contenders` finds, which does something else `first`; of another version, if wanted."""
    with all_ended():
        return _finish(_start(wanted, first, checkout), wanted)


def _start(wanted: str, first: str, checkout: str) -> subprocess.Popen[str]:
    # OpenMP's threads are what torch's contenders set themselves; everything else keeps to one.
    environment = environment_of(checkout)
    environment |= dict.fromkeys(("OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1")
    code = f"{first}; from benchmarks.contenders import main; main()"
    return subprocess.Popen(
        [sys.executable, "-P", "-W", "ignore", "-c", code, wanted],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, start_new_session=True,
    )  # fmt: skip


def environment_of(checkout: str) -> dict[str, str]:
    """That of a process with this `space_dist` or another, without what ours has told libraries."""
    found = {name: value for name, value in os.environ.items() if name not in SETTINGS}
    return found | {"PYTHONPATH": os.pathsep.join([checkout or str(ROOT), str(ROOT / "jobs")])}


def _finish(process: subprocess.Popen[str], wanted: str, patience: float | None = None) -> dict[str, float]:
    output, errors = process.communicate(timeout=patience)
    if process.returncode:
        raise SpaceDistError(f"a contender failed: {wanted}: {errors[-2000:]}")
    found: dict[str, float] = json.loads(output.splitlines()[-1])
    return found


def not_installed() -> list[str]:
    """Who of the extra `bench` cannot be imported. Ray ships RLlib without what it needs."""
    tried = subprocess.run([sys.executable, "-c", "import ray.rllib.algorithms.ppo"], capture_output=True, check=False)
    found = {"rllib": tried.returncode == 0}
    found |= {"jax": all(map(importlib.util.find_spec, ("jax", "optax"))), "sbx": bool(importlib.util.find_spec("sbx"))}
    return [name for name in EXTRA if not found[name]]


def _whole_updates(steps: int) -> int:
    return steps // 2048 * 2048


def _grid_seconds(
    member_steps: int, axes: Mapping[str, list[Any]], seeds: int, more: dict[str, Any], checkout: str = ""
) -> float:
    """Wall time of `space-dist grid run`, all 32 runs of which must have come to their end.

    checkout: of another version, in whose code they then are.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = folder / "grid.yaml"
        path.write_text(configs.to_yaml({
            "name": "throughput", "extends": str(ROOT / "configs/pointmass_space.yaml"),
            "set": {"budget.steps": member_steps, **more},
            "grid": dict(axes), "seeds": {"count": seeds}, "tracking": {"uri": None},
        }))  # fmt: skip
        command = [sys.executable, "-P", "-m", "space_dist.cli"]
        command += ["grid", "run", str(path), "--root", str(folder / "runs")]
        start = time.perf_counter()
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, cwd=folder, env=environment_of(checkout)
        )  # fmt: skip
        seconds = time.perf_counter() - start
        if done.returncode:
            raise SpaceDistError(f"the grid did not complete: {done.stdout[-2000:]}{done.stderr[-2000:]}")
        statuses = [json.loads(file.read_bytes()) for file in (folder / "runs").rglob("status.json")]
        steps = [status["steps"] for status in statuses if status["state"] == "done"]
        if sorted(steps) != [_whole_updates(member_steps)] * 32:
            raise SpaceDistError(f"not all 32 runs came to their end: {sorted(steps)}")
    return seconds


def _table1(member_steps: int) -> dict[str, float]:
    """Hours that the paper's Table 1 would take, by learner, from the beginnings of 32 of its 160 runs."""
    trpo = {"learner": {"kind": "trpo", "n_steps": 2048, "gamma": 0.95, "gae_lambda": 0.99, "target_kl": 0.004}}
    hours = {}
    learners: dict[str, dict[str, Any]] = {"ppo": {}, "trpo": trpo}
    for learner, more in learners.items():
        seconds = _grid_seconds(member_steps, TABLE1, 2, {"engine": "auto", **more})
        hours[learner] = seconds * TABLE1_STEPS / (32 * _whole_updates(member_steps)) / 3600.0
        console.print(f"table 1, {learner}: {seconds:.1f} s for 32 runs, projected {hours[learner]:.2f} h")
    return hours


# ---- what is shown ----


def _title(part: str) -> str:
    return TASKS[part].title if part in TASKS else "PointMass, 2,048 / 64: grids on both cores"


def _markdown(
    table: dict[str, dict[str, Row]], ratios: dict[str, float], projected: dict[str, float], rounds: int,
    missing: Collection[str],
) -> str:  # fmt: skip
    lines = [
        f"Environment steps per second: medians of {rounds} interleaved rounds (least and most), and ratios to the "
        "first line. Where the time goes: the environment's own steps and the networks' multiplications, as measured "
        "alone; all else is dispatch (Python, autograd, interprocess communication). Of the kernel: "
        "to what our compiled update alone would do here, without collecting.",
        "",
    ]
    for part, rows in table.items():
        first = next(iter(rows.values()))
        lines += [f"**{_title(part)}**", "", "| | setting | steps/s | ratio | of the kernel | where the time goes |",
                  "|---|---|---:|---:|---:|---|"]  # fmt: skip
        for row in rows.values():
            ratio = _ratio(row, first)
            lines.append(
                f"| {row.title} | {row.chosen} | {row.span} | {'—' if ratio is None else f'{ratio:.1f}'} "
                f"| {row.rate * row.kernel:.0%} | {row.limit()} |"
            )
        there = {"rllib": part in TASKS, "jax": part in JITTED or part not in TASKS, "sbx": True}
        lines += [f"| {EXTRA[name]} | not installed (extra `bench`) | | | | |" for name in missing if there[name]]
        lines.append("")
    if ratios:
        lines += ["| ratio | measured | wanted at least |", "|---|---:|---:|"]
        lines += [f"| `{name}` | {ratio:.2f} | {WANTED[name]:g} |" for name, ratio in ratios.items()]
        lines.append("")
    for learner, hours in projected.items():
        lines.append(f"The paper's Table 1 (4 x 4 x 10 runs of 1e6 steps) with {learner.upper()}: {hours:.2f} hours.")
    return "\n".join(lines).rstrip() + "\n"


def _figure(table: dict[str, dict[str, Row]], file: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    heights = [len(rows) for rows in table.values()]
    figure, axes = plt.subplots(
        len(table), 1, figsize=(9.0, 1.0 + 0.42 * sum(heights) + 0.5 * len(heights)), height_ratios=heights,
        squeeze=False, layout="constrained",
    )  # fmt: skip
    for axis, (part, rows) in zip(axes[:, 0], table.items(), strict=True):
        shown = list(rows.values())
        colours = ["tab:blue" if row.title.startswith("ours") else "tab:grey" for row in shown]
        errors = [[row.rate - min(row.rates) for row in shown], [max(row.rates) - row.rate for row in shown]]
        axis.barh([row.title for row in shown], [row.rate for row in shown], xerr=errors, color=colours, capsize=2)
        axis.invert_yaxis()
        axis.set_title(_title(part), fontsize=10, loc="left")
        for position, row in enumerate(shown):
            axis.text(max(row.rates), position, f"  {row.rate:,.0f}", va="center", fontsize=8)
        axis.margins(x=0.15)
        axis.spines[["top", "right"]].set_visible(False)
    figure.supxlabel("environment steps per second, collecting and learning: median, least and most", fontsize=9)
    figure.savefig(file, dpi=150)
    plt.close(figure)


def _numbers(table: dict[str, dict[str, Row]], ratios: dict[str, float], projected: dict[str, float]) -> dict[str, Any]:
    return {
        "ratios": ratios,
        "table1_hours": projected,
        "rates": {part: {name: row.rates for name, row in rows.items()} for part, rows in table.items()},
        "settings": {
            part: {name: f"{row.title}; {row.chosen}" for name, row in rows.items()} for part, rows in table.items()
        },
        "kernel": {part: {name: row.kernel for name, row in rows.items()} for part, rows in table.items()},
        "waits": {part: {name: row.waits for name, row in rows.items()} for part, rows in table.items()},
    }
