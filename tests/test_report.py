"""Reports from real ledgers: known answers, and nothing dropped in silence."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from space_dist.cli.runs import print_report
from space_dist.config import to_yaml
from space_dist.errors import ConfigError, LedgerError
from space_dist.ledger import CURRICULUM, METRICS, TIMING, Checkpoint, Ledger, RunWriter, Status, find_ledgers
from space_dist.report import (
    Estimate,
    Interval,
    Report,
    build_report,
    confidence_interval,
    draw_comparison,
    draw_curriculum,
    draw_learning_curve,
    estimate,
    group,
    interquartile_mean,
    load_run,
    read_config,
    summarise,
)
from space_dist.report.figures import curriculum_shares
from space_dist.report.tables import few_seeds
from space_dist.seeding import Purpose, generator

STARTED = 1_700_000_000.0
STEPS = 1000  # of one iteration


def start_run(
    folder: Path, *, name: str = "space", seed: int = 0, n: int = 4, eta: float = 0.1, uri: str | None = None,
    sets: Sequence[str] | None = None,
) -> Ledger:  # fmt: skip
    """A run that was started and wrote nothing yet, as the launcher leaves it; on these training and test `sets`."""
    config = {
        "name": name,
        "seed": seed,
        "env": {"id": "space_dist/PointMass-v0", "context_visible": True},
        "instances": {"train": "instances_train.csv", "test": "instances_test.csv"},
        "curriculum": {"kind": "space", "eta": eta, "kappa": 1},
        "learner": {"kind": "ppo", "net_arch": [64, 64], "target_kl": None},
        "budget": {"steps": 4 * STEPS},
        "checkpoint": {"every_rounds": 20},
        "tracking": {"uri": uri, "experiment": "tests"},
        "resources": {"workers": seed},
    }
    train, test = sets or ["id,gate\n" + "".join(f"{i},{i + offset}.5\n" for i in range(n)) for offset in (0, 100)]
    with RunWriter(Ledger(folder)) as writer:
        writer.write_config(to_yaml(config), train, test)
        writer.set_status(
            Status(
                "running",
                name,
                seed,
                0,
                4 * STEPS,
                0,
                STARTED + seed,
                STARTED + seed,
                fingerprint={"cpu": "test", "torch": "2.0"},
            )
        )
    return Ledger(folder)


def continue_run(
    ledger: Ledger,
    test: Sequence[float | None],
    trained: Sequence[Sequence[int]],
    *,
    train: Sequence[float | None] | None = None,
    until: int | None = None,
    state: str = "done",
    success: float | None = None,
    message: str | None = None,
) -> None:
    """Append the iterations up to number `until`, each with the evaluation after it, and commit them.

    `test` has one return more than there are iterations: the evaluation at step 0.
    """
    until = len(trained) if until is None else until
    before = ledger.status()
    with RunWriter(ledger) as writer:
        checkpoint = writer.restore()
        writer.status = before
        done = checkpoint.round if checkpoint else 0
        numbers = list(range(done + 1, until + 1)) if checkpoint else list(range(until + 1))
        n_rows = len(ledger.rows(METRICS))

        def add(row: dict[str, Any]) -> None:
            nonlocal n_rows
            writer.append(METRICS, row)
            time = before.started_at + 1.25 * n_rows
            rate = None if row["steps"] == 0 else 800.0
            writer.append(TIMING, {"row": n_rows, "unix_time": time, "seconds": 1.25, "steps_per_second": rate})
            n_rows += 1

        for number in numbers:
            position = {"iteration": number, "round": number, "steps": number * STEPS}
            if number:
                writer.append(CURRICULUM, {"iteration": number, "steps": number * STEPS,
                                           "trained": list(trained[number - 1])})  # fmt: skip
                size = len(trained[number - 1])
                numbers_ = {"size": len(trained[min(number, len(trained) - 1)]), "trained_size": size, "grew": True,
                            "mean_value_before": -0.5, "mean_value_after": None}  # fmt: skip
                add({"kind": "iteration", **position, "complete": True, "episodes": 20,
                     "rollout": {"return": -9.0 + number, "discounted_return": None, "length": 50.0, "success": None},
                     "learner": {"loss": 1.0 / number, "clip_fraction": 0.25}, "curriculum": numbers_})  # fmt: skip
            evaluated = {}
            for split, returns in (("train", test if train is None else train), ("test", test)):
                value = returns[number]
                evaluated[split] = {"return": value, "discounted_return": value, "length": 40.0, "success": success,
                                    "returns": [value] * 4}  # fmt: skip
            add({"kind": "evaluation", **position, **evaluated})
        status = dataclasses.replace(
            before, state=state, steps=until * STEPS, round=until, message=message,
            updated_at=before.started_at + 1.25 * n_rows,
        )  # fmt: skip
        writer.commit(Checkpoint(until, {"weights": np.zeros(3)}, {}), dataclasses.replace(status, state="running"))
        if state == "done":
            writer.write_model({"weights": np.arange(3.0)}, {"kind": "mlp"})
            ledger.log.write_text("done\n")
        writer.set_status(status)


GROWTH = ([2], [0, 2], [0, 1, 2, 3], [0, 1, 2, 3])


def finished_run(folder: Path, final: float | None, **settings: Any) -> Ledger:
    ledger = start_run(folder, **settings)
    continue_run(ledger, [-10.0, -8.0, -6.0, -4.0, final], GROWTH, success=0.5)
    return ledger


# ---- statistics -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "answer"),
    [
        ([5.0], 5.0),
        ([1.0, 2.0, 6.0], 3.0),  # a quarter of three is no whole value: the plain mean
        ([100.0, 1.0, 3.0, -50.0], 2.0),  # of -50, 1, 3, 100 the middle two
        ([9.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 70.0], 4.5),  # 3, 4, 5, 6
        ([1.0, np.nan, 2.0, 3.0, 4.0], np.nan),
    ],
)
def test_the_interquartile_mean_is_that_of_the_middle_half(values: list[float], answer: float) -> None:
    np.testing.assert_equal(interquartile_mean(np.array(values)), answer)


def test_the_interval_by_hand() -> None:
    """1, 2, 6: the mean 3, standard error sqrt(7 / 3), Student's t of two degrees 4.30265.

    0 1 5 7 20: IQM 13/3. Of all values, standard deviation sqrt(64.3): 1.1 sqrt(64.3 / 5) = 3.945. Winsorised to
    1 1 5 7 7, sqrt(9.2): sqrt(5) / 3 sqrt(9.2) = 2.261. The larger, times 2.77645.
    0 0 4 8 8 and so on where few values are in the middle: the winsorised ones have the larger error.
    """
    found = confidence_interval(np.array([1.0, 2.0, 6.0]))
    np.testing.assert_allclose(found, 3.0 + np.array([-1, 1]) * 6.572411, rtol=1e-6)
    found = confidence_interval(np.array([0.0, 1.0, 5.0, 7.0, 20.0]))
    np.testing.assert_allclose(found, 13.0 / 3.0 + np.array([-1, 1]) * 2.776445 * 1.1 * np.sqrt(64.3 / 5.0), rtol=1e-6)
    apart = np.array([0.0, 0.0, 4.0, 8.0, 8.0])  # as they are if winsorised: 16 of variance, sqrt(5) / 3 of its root
    half = 2.776445 * np.sqrt(5.0) / 3.0 * 4.0
    np.testing.assert_allclose(confidence_interval(apart), [4.0 - half, 4.0 + half], rtol=1e-6)


def test_the_interval_of_the_median_is_of_order_statistics() -> None:
    """Of ten values the second and the ninth: less than 2.5 % of all samples have fewer than two below the median."""
    values = np.arange(10.0) ** 2
    assert [float(bound) for bound in confidence_interval(values, "median")] == [1.0, 64.0]
    assert [float(bound) for bound in confidence_interval(values[:6], "median")] == [0.0, 25.0]
    half = 4.302653 * 1.25 * np.sqrt(7.0 / 3.0)
    found = confidence_interval(np.array([1.0, 2.0, 6.0]), "median")
    np.testing.assert_allclose(found, [2.0 - half, 2.0 + half], rtol=1e-6)


@pytest.mark.parametrize(
    ("population", "least"),
    [
        ("normal", (93.0, 93.0, 93.0)),
        ("skewed", (85.0, 92.0, 93.0)),  # exponential: nothing covers at three
        ("failing", (80.0, 90.0, 93.0)),  # three of ten seeds far below
    ],
)
def test_intervals_cover_what_they_promise(population: str, least: tuple[float, ...]) -> None:
    """Of 4,000 cells of 3, 5 and 10 seeds; the percentile bootstrap covers 67 to 77 % at three and 85 to 92 % at five.

    Standard error of a share of 95 %: 0.35 %. What covers always would be no interval either.
    """
    random = generator(0, Purpose.BOOTSTRAP, 1)
    draw = {
        "normal": lambda *shape: random.standard_normal(shape),
        "skewed": lambda *shape: random.exponential(size=shape),
        "failing": lambda *shape: random.standard_normal(shape) - 6.0 * (random.random(shape) < 0.3),
    }[population]
    all_of_it = draw(1_000_000)
    for n, share in zip((3, 5, 10), least, strict=True):
        truth = all_of_it.mean() if n == 3 else interquartile_mean(all_of_it)
        low, high = confidence_interval(draw(n, 4000))
        covered = 100.0 * np.mean((low <= truth) & (truth <= high))
        assert share <= covered <= 98.5, n
        assert np.median(high - low) / all_of_it.std() < {3: 5.5, 5: 3.0, 10: 2.0}[n]


def test_the_interval_is_the_same_in_every_call_and_place() -> None:
    curves = np.array([[1.0, 2.0, 1.0], [4.0, 5.0, 4.0], [3.0, 9.0, 3.0]])
    low, high = confidence_interval(curves)
    assert low.shape == high.shape == (3,)
    assert (low[0], high[0]) == (low[2], high[2])
    assert float(confidence_interval(curves[:, 1])[0]) == low[1]


def test_one_seed_has_no_interval_and_none_has_no_number() -> None:
    """Nor have two, whose Student's t is 12.7, or seeds that do not differ."""
    one, none = estimate(np.array([2.0])), estimate(np.array([]))
    assert one == Estimate(1, *[Interval(2.0, None, None)] * 3)
    assert estimate(np.array([1.0, 3.0])) == Estimate(2, *[Interval(2.0, None, None)] * 3)
    assert estimate(np.full(8, 2.0)) == Estimate(8, *[Interval(2.0, None, None)] * 3)
    assert none.n == 0
    assert np.isnan(none.iqm.value)


def test_ten_seeds_need_no_warning(tmp_path: Path) -> None:
    for seed in range(10):
        finished_run(tmp_path / f"s{seed}", float(seed), seed=seed)
    assert build_report(find_ledgers([tmp_path]), tmp_path / "out").remarks == []


# ---- the report -----------------------------------------------------------------------------------------------------


def test_two_configurations_of_three_seeds(tmp_path: Path) -> None:
    for seed, final in enumerate((1.0, 2.0, 6.0)):
        finished_run(tmp_path / f"space/s{seed}", final, seed=seed)
        finished_run(tmp_path / f"robin/s{seed}", final - 10.0, seed=seed, name="round_robin")
    report = build_report(find_ledgers([tmp_path]), tmp_path / "out/deep")

    assert [row["configuration"] for row in report.table] == ["round_robin", "space"]
    space = report.table[1]
    assert space == {
        "configuration": "space",
        "seeds finished": "3/3",
        "environment steps": "4,000",
        "test return, IQM [95 %]": "3.000 [-3.572, 9.572]",
        "test return, mean": "3.000",
        "test return, median": "2.000",
        "train return, IQM [95 %]": "3.000 [-3.572, 9.572]",
        "test success": "0.500",
        "set size at the end": "4 of 4",
        "all instances reached": "3/3 at 2,000 steps",
    }
    (warning,) = report.remarks
    assert warning.startswith("Intervals here rest on fewer than 10 seeds (round_robin: 3; space: 3): ")
    assert report.markdown.index(warning) < report.markdown.index("| space |")  # before what it is about
    assert report.figure.read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "out/deep/report.md").read_text() == report.markdown
    assert "| space | 3/3 | 4,000 | 3.000 [-3.572, 9.572] |" in report.markdown
    with (tmp_path / "out/deep/report.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["test_return_iqm"]) for row in rows] == [-7.0, 3.0]
    assert [row["all_instances_reached_at"] for row in rows] == ["2000.0", "2000.0"]


def test_a_report_says_of_few_seeds_what_the_docs_have_measured() -> None:
    """Populations of which some seeds fail or end at a limit; docs/reports.md has the table of `coverage`."""
    text = (Path(__file__).parent.parent / "docs/reports.md").read_text()
    rows = re.findall(r"^\| ([^|]*(?:fail|at a limit)) \| (\d+) \| (\d+) \(", text, re.MULTILINE)
    covered = {seeds: [int(share) for _, n, share in rows if n == seeds] for seeds in ("3", "5")}
    assert [len(shares) for shares in covered.values()] == [4, 4]
    three, five = (f"{min(shares)} to {max(shares)} %" for shares in covered.values())
    (sentence,) = few_seeds({"a": 4})
    assert f"an interval over three seeds covers {three}, one over five {five}." in sentence
    half = [int(share) for name, _, share in rows if name == "half fail"]
    assert f"{min(half)}\nto {max(half)} % are covered at any number of seeds up to 20" in text


def test_what_is_drawn_is_what_was_measured(tmp_path: Path) -> None:
    ledgers = [finished_run(tmp_path / f"s{seed}", final, seed=seed) for seed, final in enumerate((1.0, 2.0, 6.0))]
    late = start_run(tmp_path / "s3", seed=3)
    continue_run(late, [50.0, 50.0], [[0]], state="interrupted")
    figure = draw_comparison(group([load_run(ledger) for ledger in [*ledgers, late]]))
    test, train, sizes = figure.axes

    (line,) = test.get_lines()
    assert line.get_label() == "space (3 of 4 seeds)"
    np.testing.assert_array_equal(line.get_xdata(), [0, 1000, 2000, 3000, 4000])
    np.testing.assert_array_equal(line.get_ydata(), [-10, -8, -6, -4, 3])
    band = test.collections[0].get_paths()[0].vertices
    assert band[band[:, 0] == 4000][:, 1].min() == pytest.approx(-3.5724, abs=1e-3)
    assert band[band[:, 0] == 4000][:, 1].max() == pytest.approx(9.5724, abs=1e-3)
    np.testing.assert_array_equal(train.get_lines()[0].get_ydata(), [-10, -8, -6, -4, 3])

    *seeds, median = sizes.get_lines()
    assert len(seeds) == 3
    np.testing.assert_array_equal(median.get_xdata(), [0, 1000, 2000, 3000, 4000])
    np.testing.assert_array_equal(median.get_ydata(), [1, 2, 4, 4, 4])


def test_set_sizes_are_held_between_their_changes(tmp_path: Path) -> None:
    """Two seeds that grow at different steps: 1, 2, 3 and 3, 3, 4 instances, so a median of 2, 2.5, 3.5."""
    for seed, trained in enumerate(([[0], [0, 1], [0, 1, 2]], [[1, 2, 3], [1, 2, 3], [0, 1, 2, 3]])):
        continue_run(start_run(tmp_path / f"s{seed}", seed=seed), [0.0] * 4, trained)
    (configuration,) = group([load_run(ledger) for ledger in find_ledgers([tmp_path])])
    median = draw_comparison([configuration]).axes[2].get_lines()[-1]
    np.testing.assert_array_equal(median.get_ydata(), [2.0, 2.5, 3.5, 3.5])

    (summary,) = summarise([configuration])
    assert (summary.set_size, summary.n_instances, summary.reached, summary.reached_at) == (3.5, 4, 1, 2000)


def test_unfinished_runs_are_shown_and_not_counted(tmp_path: Path) -> None:
    finished_run(tmp_path / "s0", 1.0, seed=0)
    continue_run(start_run(tmp_path / "s1", seed=1), [99.0] * 3, GROWTH[:2], state="failed", message="worker died\n...")
    start_run(tmp_path / "s2", seed=2)
    report = build_report(find_ledgers([tmp_path]), tmp_path / "out")

    (row,) = report.table
    assert row["seeds finished"] == "1/3"
    assert row["test return, IQM [95 %]"] == "1.000 [—]"
    few, remark = report.remarks
    assert (
        few == "Over fewer than 3 seeds there is no interval (space: 1): one seed cannot tell how far seeds differ, "
        "and two hardly can."
    )
    assert "seed 1 failed at 2,000 of 4,000 steps (worker died);" in remark
    assert "seed 2 left behind by a process that is gone at 0 of 4,000 steps" in remark
    assert remark in report.markdown


def test_runs_without_any_row_make_a_report(tmp_path: Path) -> None:
    report = build_report([start_run(tmp_path / "s0")], tmp_path / "out")
    assert report.table[0]["seeds finished"] == "0/1"
    assert report.table[0]["test return, IQM [95 %]"] == "—"
    assert report.figure.exists()


def test_a_running_run_is_drawn_while_nothing_has_finished(tmp_path: Path) -> None:
    ledger = start_run(tmp_path / "s0")
    continue_run(ledger, [0.0, 1.0, 2.0], GROWTH[:2], state="interrupted")
    figure = draw_comparison(group([load_run(ledger)]))
    assert figure.axes[0].get_lines()[0].get_label() == "space (1 seed, unfinished)"


def test_seeds_evaluated_at_different_steps_count_with_their_last_evaluation(tmp_path: Path) -> None:
    finished_run(tmp_path / "s0", 1.0, seed=0)
    short = start_run(tmp_path / "s1", seed=1)
    continue_run(short, [-10.0, -8.0, -6.0], GROWTH[:2])
    report = build_report(find_ledgers([tmp_path]), tmp_path / "out")
    assert report.table[0]["environment steps"] == "3,000 (2,000–4,000)"
    assert any("evaluated at different steps" in remark for remark in report.remarks)
    (configuration,) = group([load_run(ledger) for ledger in find_ledgers([tmp_path])])
    steps, returns = configuration.returns("test")
    longest = max(configuration.runs, key=lambda run: len(run.evaluation_steps))
    assert steps.tolist() == longest.evaluation_steps.tolist()
    assert returns[1].tolist() == [-10.0, -8.0, -6.0, -6.0, -6.0]


def test_a_final_return_that_is_no_number_is_not_averaged_away(tmp_path: Path) -> None:
    for seed, final in enumerate((1.0, 2.0, None, 3.0, 4.0)):
        finished_run(tmp_path / f"s{seed}", final, seed=seed)
    report = build_report(find_ledgers([tmp_path]), tmp_path / "out")
    assert report.table[0]["test return, IQM [95 %]"] == "—"
    assert any("test return is not a finite number for seed 2" in remark for remark in report.remarks)


def test_the_same_seed_twice_is_refused(tmp_path: Path) -> None:
    one, two = finished_run(tmp_path / "a", 1.0, seed=7), finished_run(tmp_path / "b", 1.0, seed=7)
    with pytest.raises(ConfigError, match="seed 7 of space is there twice") as refusal:
        build_report([one, two], tmp_path / "out")
    assert str(one.folder) in str(refusal.value)
    assert str(two.folder) in str(refusal.value)
    assert not (tmp_path / "out").exists()


def relabelled(folder: Path, *changes: dict[str, Any]) -> list[str]:
    """The labels of finished runs of one name, which have these sections in their configs."""
    for number, sections in enumerate(changes):
        ledger = finished_run(folder / f"r{number}", 1.0)
        written(ledger, "config.yaml", to_yaml({**read_config(ledger), **sections}))
    return [found.label for found in group([load_run(ledger) for ledger in find_ledgers([folder])])]


def test_configurations_of_one_name_are_told_apart_by_their_settings(tmp_path: Path) -> None:
    """A setting that one kind alone has is named where two of that kind differ in it; defaults of a kind are not."""
    space, round_robin = {"curriculum": {"kind": "space"}}, {"curriculum": {"kind": "round_robin"}}
    faster = {"curriculum": {"kind": "space", "eta": 0.2}}
    assert relabelled(tmp_path / "kinds", faster, space, round_robin) == [
        "space kind=space eta=0.2", "space kind=space eta=0.1", "space kind=round_robin",
    ]  # fmt: skip
    given = {"env": {"id": "space_dist/PointMass-v0", "kwargs": {"horizon": 50}}}
    assert relabelled(tmp_path / "one", space, given) == ["space", "space horizon=50"]
    a2c = {"learner": {"kind": "a2c", "gamma": 0.9, "n_steps": 512, "learning_rate": 0.123456789, "ent_coef": 0.01}}
    assert relabelled(tmp_path / "long", space, round_robin | a2c) == [
        "space curriculum.kind=space learner.kind=ppo", "space curriculum.kind=round_robin learner.kind=a2c",
    ]  # fmt: skip


def test_a_hash_tells_apart_what_no_short_setting_does(tmp_path: Path) -> None:
    finished_run(tmp_path / "a", 1.0, eta=0.1)
    finished_run(tmp_path / "b", 1.0, eta=0.2)
    finished_run(tmp_path / "c", 1.0, eta=0.2, n=5, seed=1)  # other instances: another configuration too
    labels = [row["configuration"] for row in build_report(find_ledgers([tmp_path]), tmp_path / "out").table]
    assert labels[0] == "space eta=0.1"
    assert all(re.fullmatch(r"space eta=0\.2 [0-9a-f]{6}", label) for label in labels[1:])
    assert len(set(labels)) == 3
    long = relabelled(tmp_path / "long", *({"learner": {"kind": "ppo", "net_arch": [n] * 30}} for n in (32, 64)))
    assert all(re.fullmatch(r"space [0-9a-f]{6}", label) for label in long)
    assert len(set(long)) == 2


def test_runs_of_equal_settings_are_one_configuration_whatever_they_are_called(tmp_path: Path) -> None:
    finished_run(tmp_path / "a", 1.0, seed=0, name="monday")
    finished_run(tmp_path / "b", 3.0, seed=1, name="tuesday")
    runs = [load_run(ledger) for ledger in find_ledgers([tmp_path])]
    assert [(found.label, len(found.runs)) for found in group(runs)] == [("monday + tuesday", 2)]
    finished_run(tmp_path / "c", 5.0, seed=1, name="monday")  # the same seed twice: now the names tell them apart
    runs = [load_run(ledger) for ledger in find_ledgers([tmp_path])]
    assert [(found.label, len(found.runs)) for found in group(runs)] == [("monday", 2), ("tuesday", 1)]


def written(ledger: Ledger, file: str, content: str | bytes) -> None:
    """Give a run another file, as if it had been started with it."""
    content = content.encode() if isinstance(content, str) else content
    (ledger.folder / file).write_bytes(content)
    with RunWriter(ledger) as writer:
        writer.status = ledger.status()
        sha256 = hashlib.sha256(content).hexdigest()
        writer.set_status(dataclasses.replace(writer.status, files={**writer.status.files, file: [sha256]}))


def test_a_default_written_out_makes_no_other_configuration(tmp_path: Path) -> None:
    for seed in range(2):
        ledger = finished_run(tmp_path / f"s{seed}", 1.0, seed=seed)
        text = ledger.config.read_text()
        assert "kappa: 1" in text
        written(ledger, "config.yaml", text if seed else text.replace("kappa: 1", "kappa: 1, pic: improvement"))
    assert len(group([load_run(ledger) for ledger in find_ledgers([tmp_path])])) == 1


def test_resources_and_tracking_do_not_make_another_configuration(tmp_path: Path) -> None:
    for seed in range(2):
        finished_run(tmp_path / f"s{seed}", 1.0, seed=seed, uri=f"http://host{seed}:1")
    (configuration,) = group([load_run(ledger) for ledger in find_ledgers([tmp_path])])
    assert configuration.label == "space"


def test_runs_of_other_code_are_named(tmp_path: Path) -> None:
    finished_run(tmp_path / "s0", 1.0, seed=0)
    other = finished_run(tmp_path / "s1", 1.0, seed=1)
    with RunWriter(other) as writer:
        writer.status = other.status()
        fingerprint = {"cpu": "test", "torch": "2.1"}
        writer.set_status(dataclasses.replace(writer.status, fingerprint=fingerprint, fingerprint_changed=True))
    remarks = build_report(find_ledgers([tmp_path]), tmp_path / "out").remarks
    assert "space: its runs differ in torch: 2.0, 2.1." in remarks
    assert any("resumed with another arithmetic or other library versions: seed 1" in remark for remark in remarks)


def test_no_runs_and_nowhere_to_write_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no runs"):
        build_report([], tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be written"):
        build_report([start_run(tmp_path / "s0")], tmp_path / "file")


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("config.yaml", "a: [", "not valid YAML"),
        ("config.yaml", "just words", "no keys and values"),
        ("instances_train.csv", "id,x\nfirst,1.0\n", "not every row has an id"),
        ("metrics.jsonl", "{}\n", "row 1: damaged"),
    ],
)
def test_damage_is_named(tmp_path: Path, file: str, content: str, message: str) -> None:
    ledger = start_run(tmp_path / "s0")
    (ledger.folder / file).write_text(content)
    if file in ledger.status().files:
        with pytest.raises(LedgerError, match="its checksum is not the one"):
            load_run(ledger)
        written(ledger, file, content)
    with pytest.raises(LedgerError, match=message):
        load_run(ledger)


# ---- the figures of one run -----------------------------------------------------------------------------------------


def test_the_learning_curve_of_a_run(tmp_path: Path) -> None:
    ledger = start_run(tmp_path / "s0")
    with pytest.raises(LedgerError, match="no evaluation yet"):
        draw_learning_curve(load_run(ledger))
    continue_run(ledger, [-3.0, -2.0, -1.0], GROWTH[:2], train=[1.0, 2.0, None])
    returns, sizes = draw_learning_curve(load_run(ledger)).axes
    test, train = returns.get_lines()
    assert (test.get_label(), train.get_label()) == ("test", "train")
    np.testing.assert_array_equal(test.get_xdata(), [0, 1000, 2000])
    np.testing.assert_array_equal(test.get_ydata(), [-3, -2, -1])
    np.testing.assert_array_equal(train.get_ydata(), [1, 2, np.nan])
    np.testing.assert_array_equal(sizes.get_lines()[0].get_ydata(), [1, 2, 2])


def arrays(*trained: Sequence[int]) -> list[np.ndarray[tuple[int], np.dtype[np.int64]]]:
    return [np.array(ids, dtype=np.int64) for ids in trained]


def test_the_map_of_a_curriculum_by_hand() -> None:
    """Ids 3, 5, 7, 9, 11. First included: 7 in iteration 1, 3 and 9 in 2 (a tie: by id), 5 in 3, 11 never."""
    ids = np.array([3, 5, 7, 9, 11])
    order, shares = curriculum_shares(arrays([7], [9, 7, 3], [5, 9, 9]), ids)
    assert order.tolist() == [7, 3, 9, 5, 11]
    np.testing.assert_array_equal(shares, [[1, 1, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1], [0, 0, 0]])


def test_a_large_map_shows_the_mean_of_each_block() -> None:
    """The same five instances in blocks of two (rows 7+3, 9+5, 11) and three iterations in blocks of two."""
    ids = np.array([3, 5, 7, 9, 11])
    order, shares = curriculum_shares(arrays([7], [9, 7, 3], [5, 9, 9]), ids, max_rows=3, max_columns=2)
    assert order.tolist() == [7, 3, 9, 5, 11]
    np.testing.assert_array_equal(shares, [[0.75, 0.0], [0.25, 1.0], [0.0, 0.0]])


def test_an_id_that_is_no_instance_is_refused() -> None:
    for foreign in (-1, 4, 12):
        with pytest.raises(LedgerError, match="iteration 1"):
            curriculum_shares(arrays([foreign]), np.array([3, 5]))


def test_the_heat_map_of_a_run(tmp_path: Path) -> None:
    run = load_run(finished_run(tmp_path / "s0", 1.0))
    axes = draw_curriculum(run).axes[0]
    np.testing.assert_array_equal(
        np.asarray(axes.images[0].get_array()), [[1, 1, 1, 1], [0, 1, 1, 1], [0, 0, 1, 1], [0, 0, 1, 1]]
    )
    assert [label.get_text() for label in axes.get_yticklabels()] == ["2", "0", "1", "3"]


def test_generated_contexts_have_no_map(tmp_path: Path) -> None:
    ledger = start_run(tmp_path / "s0")
    continue_run(ledger, [0.0, 0.0], [[-1, -1, -1, -1]])
    run = load_run(ledger)
    assert run.all_instances_reached_at is None
    with pytest.raises(LedgerError, match="not trained on generated contexts in every iteration"):
        draw_curriculum(run)  # its ledger does not say which
    assert build_report([ledger], tmp_path / "out").table[0]["set size at the end"] == "—"


def test_configurations_never_look_alike_on_a_narrow_terminal(tmp_path: Path) -> None:
    rows = [{"configuration": f"pointmass_small_space_kappa_{kappa}", "test return": "[1, 2]"} for kappa in range(40)]
    told = []
    for count, width in ((40, 80), (2, 80), (2, 200)):
        to = Console(file=io.StringIO(), width=width)
        print_report(Report(rows[:count], [], [], "", tmp_path / "report.png"), to)
        told.append(to.file.getvalue())  # type: ignore[attr-defined]
        assert all(row["configuration"] in told[-1] for row in rows[:count])
        assert told[-1].count("[1, 2]") == count
    assert "│" not in told[0]
    assert "│" in told[1]
    assert "│" in told[2]
