"""What each curriculum costs beside round robin, per iteration, as a share of one PPO update."""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from benchmarks.curriculum import ppo_update_seconds
from benchmarks.measure import duration
from benchmarks.results import JsonFile, keep, refuse_if
from space_dist import config as configs
from space_dist.envs.distributions import sample
from space_dist.instances import InstanceSet
from space_dist.ledger import Ledger, RunWriter, Status
from space_dist.rollout import FloatArray
from space_dist.run.building import Blueprint
from space_dist.run.cluster import Decision, Evidence, Handle, InProcess
from space_dist.run.training import Training

ROOT = Path(__file__).resolve().parents[2]
console = Console()
_PROBES = 41_000  # environment steps that learnability's first probe may take, and then some

LIMIT = 0.05  # of one PPO update: what a curriculum may cost more than round robin
KINDS = {
    "round_robin": "{kind: round_robin}",
    "space": "{kind: space}",
    "cspace": "{kind: cspace}",
    "random_growth": "{kind: random_growth}",
    "manual": "{kind: manual, column: effort}",
    "uniform": "{kind: uniform}",
    "plr": "{kind: plr}",
    "plr, max_mc": "{kind: plr, score: max_mc, within_update: fixed_chances, temperature: 1}",
    "learnability": "{kind: learnability}",
    "procurl": "{kind: procurl}",
    "learning_progress": "{kind: learning_progress}",
    "edge": "{kind: edge}",
    "currot over the set": "{kind: currot, delta: 4}",
    "currot over the bounds": "{kind: currot, delta: 4, over: bounds}",
    "accel": "{kind: accel}",
    "alp_gmm": "{kind: alp_gmm}",
    "alp_gmm over the bounds": "{kind: alp_gmm, over: bounds}",
    "vds": "{kind: vds}",
    "spdrl": "{kind: spdrl, target: normal, target_mean: [2.5, 0.5, 0.0], target_std: [4.0e-3, 3.75e-3, 2.0e-3], "
    "least_std: [0.2, 0.1875, 0.1], warm_up: 0, offset: 10}",
}  # fmt: skip


def curricula(
    iterations: Annotated[int, typer.Option(min=5, help="Iterations of each; the mean counts.")] = 30,
    json_file: JsonFile = None,
) -> None:
    """What each curriculum costs beside round robin with 100 instances, as a share of one PPO update."""
    import sklearn.mixture  # noqa: F401 - a second, which ALP-GMM pays once a run and not once an iteration

    threadpool_limits(limits=1)
    base = configs.load(ROOT / "configs/pointmass_space.yaml", ["tracking.uri=null"])
    update = ppo_update_seconds(base, 7)
    console.print(f"one stock PPO update (2,048 steps, minibatch 64, 10 epochs): {update:.3f} s of CPU time")
    rows = [{"curriculum": name, "update": update, **_measured(text, iterations)} for name, text in KINDS.items()]
    table = Table(title="Mean CPU time per iteration, 100 instances of PointMass, one thread")
    for column in ("curriculum", "feedback", "decide", "more than round robin", "at most", "own optimisation"):
        table.add_column(column, justify="left" if column == "curriculum" else "right")
    for row in rows:
        more = row["feedback"] + row["decide"] - rows[0]["feedback"] - rows[0]["decide"]
        row |= {"share": more / update, "limit": LIMIT, "optimisation_share": row["optimise"] / update}
        table.add_row(
            row["curriculum"],
            duration(row["feedback"]),
            duration(row["decide"]),
            f"{row['share']:.2%}",
            f"{LIMIT:.0%}",
            f"{duration(row['optimise'])} ({row['optimisation_share']:.1%})" if row["optimise"] else "",
        )
    console.print(table)
    console.print(
        "Feedback: start values of all instances (round robin's too), of generated contexts, and the ensemble's. "
        "Decide: the curriculum's step and its draws, with ALP-GMM's fit whenever one is due. Own optimisation: VDS's "
        "ensemble and SPDRL's search. Learnability's probes are environment steps, which the budget is charged."
    )
    keep(rows, json_file)
    refuse_if(any(row["share"] > row["limit"] for row in rows), console)


class _Timed(InProcess):
    """The cluster of a run without Ray that notes the CPU time of what is done for the curriculum."""

    def __init__(self, config: configs.RunConfig, train: InstanceSet, test: InstanceSet) -> None:
        setup = Blueprint.of(config).setup(train, test)
        super().__init__(config, setup)
        self.setup, self.spent = setup, defaultdict[str, list[float]](list)
        self._searches = config.curriculum.kind == "spdrl"

    def timed(self, what: str, work: Callable[[], Any]) -> Any:
        """The answer of `work`."""
        start = time.process_time()
        answer = work()
        self.spent[what].append(time.process_time() - start)
        return answer

    def start_values(self, policy: Handle) -> list[Handle]:
        """As `InProcess`, timed."""
        values: list[Handle] = self.timed("feedback", lambda: super(_Timed, self).start_values(policy))
        return values

    def context_values(self, policy: Handle, contexts: FloatArray, *, version: int) -> list[Handle]:
        """As `InProcess`, timed."""
        ask = super().context_values
        values: list[Handle] = self.timed("feedback", lambda: ask(policy, contexts, version=version))
        return values

    def decide(
        self, state: Handle, before: Handle, evidence: Evidence, *, version: int, gradient_steps: int
    ) -> Decision:
        """As `InProcess`, timed; SPDRL's search apart from its draws."""
        ask = super().decide
        what = "search" if self._searches else "decide"
        decision: Decision = self.timed(
            what, lambda: ask(state, before, evidence, version=version, gradient_steps=gradient_steps)
        )
        if self._searches:
            self.timed("decide", lambda: self._central.curriculum.selection(decision.state))
            self.spent["search"][-1] -= self.spent["decide"][-1]
        return decision


def _measured(curriculum: str, iterations: int) -> dict[str, Any]:
    """Mean CPU seconds per iteration of a short run, whose policy learns little: one epoch an update."""
    config = configs.load(
        ROOT / "configs/pointmass_space.yaml",
        [f"curriculum={curriculum}", "tracking.uri=null", "learner.n_epochs=1", "rollout.passes=0.01",
         f"budget.steps={iterations * 2048 + _PROBES}", "evaluation.every_steps=100000000",
         "checkpoint.every_rounds=1000", "checkpoint.every_seconds=10000"],
    )  # fmt: skip
    train, test = sample("pointmass_uniform", 100, 100, 0)
    train = InstanceSet(train.ids, train.contexts, train.names, {"effort": train.ids.astype(np.float64)})
    cluster = _Timed(config, train, test)
    status = Status("running", config.name, 0, 0, config.budget.steps, 0, 0.0, 0.0)
    with tempfile.TemporaryDirectory() as folder, RunWriter(Ledger(folder)) as writer:
        run = Training(Blueprint.of(config), cluster.setup, cluster, writer, status=status)
        ensemble = run.ensemble
        if ensemble is not None:
            fit = ensemble.update
            ensemble.update = lambda *a, **k: cluster.timed("fit", lambda: fit(*a, **k))  # type: ignore[method-assign]
        run.run()
    spent, count = cluster.spent, len(cluster.spent["decide"])
    means = {name: float(np.sum(spent[name])) / count for name in ("feedback", "decide")}
    return {**means, "optimise": float(np.sum(spent["fit"]) + np.sum(spent["search"])) / count}
