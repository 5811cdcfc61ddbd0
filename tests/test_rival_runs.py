"""Runs under the rivals: the same for any number of workers and any interruption, honest steps, a history to draw."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from space_dist import config as configs
from space_dist.envs.distributions import sample
from space_dist.errors import Interrupted
from space_dist.learner import Ensemble
from space_dist.ledger import CURRICULUM, METRICS, Ledger
from space_dist.report import draw_curriculum, load_run
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests

ROOT = Path(__file__).resolve().parent.parent
RESULTS = (METRICS, CURRICULUM, "model.npz", "model.json")
ROUND = 500  # environment steps: five slots of one horizon
BUDGET = 3600  # seven rounds and a bit: probes take the place of some

KINDS = {
    "uniform": "{kind: uniform}",
    "spdrl": "{kind: spdrl, warm_up: 1, offset: 2}",
    "vds": "{kind: vds, n_batches: 3, batch_size: 100, members_see: [gate_x, gate_width]}",
    "alp_gmm": "{kind: alp_gmm, fit_rate: 10, over: bounds}",
    "plr": "{kind: plr}",
    "learnability": "{kind: learnability, top: 3, every: 2, candidates: 4, episodes: 2}",
    "manual": "{kind: manual, column: effort}",
    "procurl": "{kind: procurl, score: improvement, scale: set}",
    "learning_progress": "{kind: learning_progress, outcome: return, lowest_return: -2, largest_return: 2}",
    "plr_robust": "{kind: plr, robust: true, score: max_mc, scored_share: 0.1, temperature: 1}",
    "edge": "{kind: edge, outcome: return, lowest_return: -2, largest_return: 2}",
    "currot": "{kind: currot, delta: 1, particles: 20, over: bounds}",
    "accel": "{kind: accel, buffer: 6, batch: 4}",
}
GENERATING = ("spdrl", "alp_gmm", "currot", "accel")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With instance sets small enough that evaluating costs little."""
    train, test = sample("pointmass_uniform", 12, 3, 0)
    made = tmp_path_factory.mktemp("instances")
    lines = train.to_csv().splitlines()
    efforts = ["effort", *(str(7 * place % 12) for place in range(12))]
    (made / "train.csv").write_text(train.to_csv())
    (made / "ordered.csv").write_text("".join(f"{a},{b}\n" for a, b in zip(lines, efforts, strict=True)))
    (made / "test.csv").write_text(test.to_csv())
    for name, targets in (("train", (-1.0, -0.5, 0.0, 0.5, 1.0)), ("test", (-0.7, 0.7))):
        (made / f"line_{name}.csv").write_text(
            "\n".join(["id,target", *(f"{number},{target}" for number, target in enumerate(targets))]) + "\n"
        )
    return made


def config(kind: str, folder: Path, *more: str, workers: int = 0) -> configs.RunConfig:
    train, test = ("ordered" if kind == "manual" else "train"), "test"
    env = []
    if kind == "learnability":  # probes wait for a first success, which a few updates never have on PointMass
        train, test, env = "line_train", "line_test", ["env={id: tests.tiny_env:make}"]
    settings = [
        *env, f"curriculum={KINDS[kind]}", f"instances.train={folder}/{train}.csv",
        f"instances.test={folder}/{test}.csv",
        f"budget.steps={BUDGET}", f"learner.n_steps={ROUND}", "learner.n_epochs=1", "rollout.shards=5",
        "rollout.slots=1", "evaluation.every_steps=2000", "tracking.uri=null", f"resources.workers={workers}",
    ]  # fmt: skip
    return configs.load(ROOT / "configs/pointmass_space.yaml", [*settings, *more])


def results(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in RESULTS}


@pytest.fixture(scope="module")
def reference(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The folder of an undisturbed run of a kind, made once."""

    @functools.cache
    def run(kind: str) -> Path:
        out: Path = tmp_path_factory.mktemp(kind) / "run"
        launch(config(kind, folder), out, resume=False, stop=StopRequests())
        return out

    return run


class AfterEachRound(StopRequests):
    """Asks to stop whenever it is asked."""

    def reason(self) -> str | None:
        return "the test"


@pytest.mark.parametrize("kind", KINDS)
def test_interrupted_after_every_round_and_resumed_it_is_the_same(
    kind: str, folder: Path, reference: Any, tmp_path: Path
) -> None:
    interruptions = 0
    for _ in range(20):
        try:
            launch(config(kind, folder), tmp_path / "run", resume=True, stop=AfterEachRound())
            break
        except Interrupted:
            interruptions += 1
    assert interruptions >= 4
    assert results(tmp_path / "run") == results(reference(kind))


@pytest.mark.ray
@pytest.mark.usefixtures("one_ray")
@pytest.mark.parametrize(
    ("kind", "workers"),
    [("spdrl", 1), ("spdrl", 4), ("uniform", 1), ("vds", 2), ("alp_gmm", 2), ("plr", 1), ("learnability", 2),
     ("manual", 2), ("procurl", 4), ("learning_progress", 1), ("learning_progress", 4), ("plr_robust", 1),
     ("plr_robust", 4), ("currot", 1), ("currot", 4), ("edge", 1), ("edge", 4), ("accel", 1), ("accel", 4)],
)  # fmt: skip
def test_the_number_of_workers_changes_no_byte(
    kind: str, workers: int, folder: Path, reference: Any, tmp_path: Path
) -> None:
    launch(config(kind, folder, workers=workers), tmp_path / "run", resume=False, stop=StopRequests())
    assert results(tmp_path / "run") == results(reference(kind))


@pytest.mark.parametrize("kind", KINDS)
def test_the_ledger_says_what_was_trained_on_and_it_can_be_drawn(kind: str, reference: Any) -> None:
    run = load_run(Ledger(reference(kind)))
    rows = [row for row in run.ledger.rows(METRICS) if row["kind"] == "iteration"]
    assert len(run.trained) == len(rows)
    for ids, row in zip(run.trained, rows, strict=True):
        if kind == "manual":
            assert len(np.unique(ids)) == len(ids)
        else:  # each episode's instance
            assert len(ids) == row["episodes"]
    assert run.generates_contexts == (kind in GENERATING)
    figure = draw_curriculum(run)
    if kind in GENERATING:
        assert [len(contexts) for contexts in run.contexts] == [len(ids) for ids in run.trained]
        line = figure.axes[0].get_lines()[0]
        np.testing.assert_allclose(line.get_ydata(), [contexts[:, 0].mean() for contexts in run.contexts])
        np.testing.assert_array_equal(line.get_xdata(), run.iteration_ends)
        assert figure.axes[0].get_ylabel() == "gate_x"
    else:
        drawn = np.asarray(figure.axes[0].images[0].get_array())
        sizes = [len(np.unique(ids)) for ids in run.trained]
        np.testing.assert_allclose(drawn.sum(axis=0), sizes)
        assert run.set_size[1].tolist() == sizes
    if kind == "spdrl":
        divergences = figure.axes[3].get_lines()[0].get_ydata()
        assert list(divergences) == [row["curriculum"]["kl_to_target"] for row in rows if row["curriculum"]]


def test_a_manual_order_starts_where_the_column_says(folder: Path, reference: Any) -> None:
    run = load_run(Ledger(reference("manual")))
    efforts = {int(line.split(",")[0]): int(line.split(",")[-1])
               for line in (folder / "ordered.csv").read_text().splitlines()[1:]}  # fmt: skip
    assert [sorted(efforts[one] for one in ids) for ids in run.trained[:3]] == [[0], [0, 1], [0, 1, 2]]


def test_probe_steps_are_charged_to_the_budget_exactly(reference: Any) -> None:
    ledger = Ledger(reference("learnability"))
    rows = [row for row in ledger.rows(METRICS) if row["kind"] == "iteration"]
    charged = 0
    probing = [number for number, row in enumerate(rows) if row["curriculum"]["probe_steps"] > 0]
    assert probing == list(range(probing[0], len(rows) - 1, 2))  # from the first success on, while there is room
    for number, row in enumerate(rows):
        charged += row["curriculum"]["probe_steps"]
        assert row["steps"] == (number + 1) * ROUND + charged
    final = ledger.status().steps
    assert final == rows[-1]["steps"] <= BUDGET < final + ROUND
    assert len(rows) < BUDGET // ROUND


def test_evaluation_is_on_the_instance_sets_of_everyone(reference: Any) -> None:
    lengths = {kind: [len(row["test"]["returns"]) for row in Ledger(reference(kind)).rows(METRICS)
                      if row["kind"] == "evaluation"] for kind in ("spdrl", "uniform")}  # fmt: skip
    assert set(lengths["spdrl"]) == set(lengths["uniform"]) == {3}
    first = [Ledger(reference(kind)).rows(METRICS)[0]["test"] for kind in ("spdrl", "uniform")]
    assert first[0] == first[1]  # before the first update nothing can differ


def test_an_ensemble_is_fitted_under_the_number_of_the_round_that_it_learns_from(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its minibatches are drawn by it, like the learner's: another number would be another run."""
    rounds: list[tuple[int, int]] = []
    fit = Ensemble.update

    def noted(self: Ensemble, shards: Any, statistics: Any, *, round: int) -> dict[str, float]:
        rounds.append((round, shards[0].round))
        return fit(self, shards, statistics, round=round)

    monkeypatch.setattr(Ensemble, "update", noted)
    launch(config("vds", folder), tmp_path / "run", resume=False, stop=StopRequests())
    assert rounds == [(number, number) for number in range(len(rounds))]
    assert len(rounds) > 1
