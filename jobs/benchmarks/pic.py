"""What PIC measures: does the change of a start value say where training on an instance helps?

SPaCE on PointMass's uniform set, ranked in each of its ways, with sets that grow alike (eta so large that each decision
grows them by two). At each decision the start values of all instances are set beside the returns that the deterministic
policy truly has there.
"""

from __future__ import annotations

import itertools
import multiprocessing
import tempfile
import warnings
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table
from scipy.stats import spearmanr

from benchmarks.results import JsonFile, keep
from space_dist import config as configs
from space_dist.ledger import METRICS, Ledger, RunWriter, Status
from space_dist.rollout import FloatArray, IntArray, Split, joined
from space_dist.run.building import Blueprint
from space_dist.run.cluster import Decision, Evidence, Handle, InProcess
from space_dist.run.training import Training

ROOT = Path(__file__).resolve().parents[2]
RANKS = ("improvement", "abs", "relative", "lowest_value", "random")
console = Console()


@dataclass
class _Moment:
    """What stood at one decision. trained: (n,) of the iteration. values, returns: (n,) V_t and discounted returns."""

    trained: IntArray
    values: FloatArray
    returns: FloatArray
    held_out: float


@dataclass
class _Watched(InProcess):
    """A run's cluster that looks at each decision: on environments and seeds of its own, so it changes nothing."""

    config: configs.RunConfig
    setup: Any
    moments: list[_Moment] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__(self.config, self.setup)

    def start_values(self, policy: Handle) -> list[Handle]:
        """As `InProcess`."""
        self._policy = policy
        return super().start_values(policy)

    def begin(self, values: Sequence[Handle]) -> Decision:
        """As `InProcess`, looked at."""
        decision = super().begin(values)
        self._look(np.zeros(0, dtype=np.int64), decision)
        return decision

    def decide(
        self, state: Handle, before: Handle, evidence: Evidence, *, version: int, gradient_steps: int
    ) -> Decision:
        """As `InProcess`, looked at."""
        decision = super().decide(state, before, evidence, version=version, gradient_steps=gradient_steps)
        self._look(np.sort(state.selected), decision)
        return decision

    def _look(self, trained: IntArray, decision: Decision) -> None:
        splits: tuple[Split, Split] = ("train", "test")
        train, test = (joined(self.evaluate(self._policy, split)) for split in splits)
        self.moments.append(
            _Moment(trained, decision.values, train.discounted_returns, float(test.discounted_returns.mean()))
        )


def pic(
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each way to rank.")] = 3,
    steps: Annotated[int, typer.Option(min=10_240, help="Environment steps of a run.")] = 102_400,
    processes: Annotated[int, typer.Option(min=1, help="Runs at a time. Decides no result.")] = 2,
    json_file: JsonFile = None,
) -> None:
    """What SPaCE's ranking measures on PointMass: values against true returns, and what each ranking comes to."""
    asked = [(rank, seed, steps) for seed in range(seeds) for rank in RANKS]
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        running = [pool.submit(_run, *one) for one in asked]
        try:
            found = [one.result() for one in running]
        except (SystemExit, KeyboardInterrupt):  # or the pool would have its runs end first, which takes minutes
            for worker in multiprocessing.active_children():
                worker.kill()
            raise
    rows: list[dict[str, Any]] = []
    for rank in RANKS:
        mine = [one for (which, _, _), one in zip(asked, found, strict=True) if which == rank]
        rows.append({"pic": rank, **{name: [one[name] for one in mine] for name in mine[0]}})
    table = Table(title=f"{seeds} seeds, {steps:,} steps, sets that grow alike; mean (standard error over seeds)")
    for column in ("", *RANKS):
        table.add_column(column, justify="right" if column else "left")
    for name, words in _MEASURES.items():
        table.add_row(words, *(_shown(row[name]) for row in rows))
    console.print(table)
    console.print(_WORDS, highlight=False, soft_wrap=True)
    keep(rows, json_file)


_MEASURES = {
    "held_out": "held-out return",
    "size": "set at the end",
    "distinct": "trained on at all",
    "kept": "kept / chance",
    "bias_in": "V - G inside",
    "bias_out": "V - G outside",
    "error_in": "|V - G| inside",
    "error_out": "|V - G| outside",
    "agree_in": "d with gain, inside",
    "agree_out": "d with gain, outside",
    "correction": "d with last error, outside",
}
_WORDS = """\
G: discounted return of the deterministic policy on an instance; inside, outside: of the set just trained on. kept: the
share of that set that is in the next one, over what a random set would keep. d with gain: rank correlation, over
instances, of d_t = V_t - V_t-1 with G_t - G_t-1. d with last error: of d_t with G_t-1 - V_t-1, by which V was too low.
All but the first three are means over a run's decisions."""


def _shown(numbers: list[float]) -> str:
    """Their mean and its standard error, of which one seed has none."""
    error = f"{np.std(numbers, ddof=1) / np.sqrt(len(numbers)):.2f}" if len(numbers) > 1 else "—"
    return f"{np.nanmean(numbers):.2f} ({error})"


def _run(rank: str, seed: int, steps: int) -> dict[str, float]:
    """One run, in numbers."""
    config = configs.load(
        ROOT / "configs/pointmass_space.yaml",
        [f"curriculum={{kind: space, pic: {rank}, eta: 1.0e+9, kappa: 2}}", "learner.update=lean",
         f"budget.steps={steps}", "evaluation.every_steps=100000000", "tracking.uri=null",
         "checkpoint.every_rounds=100000", "checkpoint.every_seconds=100000", f"seed={seed}"],
    )  # fmt: skip
    blueprint = Blueprint.of(config)
    cluster = _Watched(config, blueprint.setup(*blueprint.instances()))
    status = Status("running", config.name, seed, 0, config.budget.steps, 0, 0.0, 0.0)
    with tempfile.TemporaryDirectory() as folder, RunWriter(Ledger(folder)) as writer:
        writer.restore()
        Training(blueprint, cluster.setup, cluster, writer, status=status).run()
        last = [row for row in Ledger(folder).rows(METRICS) if row["kind"] == "evaluation"][-1]
    return {"held_out": last["test"]["return"], **_numbers(cluster.moments)}


def _numbers(moments: Sequence[_Moment]) -> dict[str, float]:
    n = len(moments[0].values)
    seen = np.zeros(n, dtype=np.bool_)
    found: dict[str, list[float]] = {name: [] for name in list(_MEASURES)[3:]}
    for place, (old, now) in enumerate(itertools.pairwise(moments)):
        inside = np.zeros(n, dtype=np.bool_)
        inside[now.trained] = True
        seen |= inside
        change, gain = now.values - old.values, now.returns - old.returns
        error = now.values - now.returns
        for name, some in (("in", inside), ("out", ~inside)):
            if some.sum() < 5:  # too few for a correlation
                continue
            found[f"bias_{name}"].append(float(error[some].mean()))
            found[f"error_{name}"].append(float(np.abs(error[some]).mean()))
            found[f"agree_{name}"].append(_correlation(change[some], gain[some]))
        if (~inside).sum() >= 5:
            found["correction"].append(_correlation(change[~inside], (old.returns - old.values)[~inside]))
        if place + 2 < len(moments):
            following = moments[place + 2].trained
            share = float(inside[following].sum()) / len(now.trained)
            found["kept"].append(share / (len(following) / n))
    return {
        "size": float(len(moments[-1].trained)), "distinct": float(seen.sum()),
        **{name: float(np.nanmean(numbers)) if numbers else float("nan") for name, numbers in found.items()},
    }  # fmt: skip


def _correlation(one: FloatArray, other: FloatArray) -> float:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # where all are alike there is none, and it is left out
        return float(spearmanr(one, other).statistic)
