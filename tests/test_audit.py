"""The independent audit of a run's decisions, and their explanation: every variant, resumed runs, changed ledgers."""

from __future__ import annotations

import contextlib
import functools
import io
import json
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from space_dist import config as configs
from space_dist.cli import app
from space_dist.errors import Interrupted, LedgerError
from space_dist.instances import read_csv
from space_dist.ledger import CURRICULUM, METRICS, VALUES, Ledger, decode_values, encode_row, encode_values
from space_dist.report.decisions import explain
from space_dist.run import training
from space_dist.run.building import spec_of
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests

ROOT = Path(__file__).resolve().parent.parent
AUDIT = ROOT / "jobs/audit.py"
CURRICULA = {
    "default": "{kind: space}",
    "abs": "{kind: space, pic: abs, kappa: 2}",
    "relative": "{kind: space, pic: relative, kappa: 2}",
    "lowest_value": "{kind: space, pic: lowest_value, kappa: 2}",
    "random": "{kind: space, pic: random, kappa: 2}",
    "reverse": "{kind: space, reverse: true, kappa: 2}",
    "as_printed": "{kind: space, mean: as_printed, kappa: 2}",
    "mean_abs_change": "{kind: space, mean: mean_abs_change, kappa: 2}",
    "zero": "{kind: space, v0: zero, kappa: 2}",
    "multiply": "{kind: space, growth: multiply, kappa: 2, eta: 1.0}",
    "once": "{kind: space, adaptive_eta: once, patience: 1, eta: 1.0e-6}",
    "persistent": "{kind: space, adaptive_eta: persistent, patience: 1, eta: 1.0e-6}",
    "population": "{kind: space, aggregate: population, policies: 2, kappa: 2}",
    "random_growth": "{kind: random_growth, kappa: 2}",
    "centroid": "{kind: cspace, growth: schedule}",
    "nearest_member": "{kind: cspace, distance: nearest_member, growth: schedule, reverse: true}",
    "manual": "{kind: manual, column: effort, kappa: 2}",
    "round_robin": "{kind: round_robin}",
    "fixed": "{kind: fixed, count: 3}",
    "fixed_ids": "{kind: fixed, ids: [2, 5, 7]}",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("instances")
    targets = np.linspace(-0.9, 0.9, 9)
    lines = [f"{number},{target},{7 * number % 9}" for number, target in enumerate(targets)]
    (made / "ordered.csv").write_text("\n".join(["id,target,effort", *lines]) + "\n")
    plain = [line.rpartition(",")[0] for line in ["id,target,effort", *lines]]
    (made / "train.csv").write_text("\n".join(plain) + "\n")
    (made / "test.csv").write_text("id,target\n0,0.3\n")
    return made


def config(name: str, folder: Path, *more: str) -> configs.RunConfig:
    train = "ordered" if name == "manual" else "train"
    return configs.load(
        ROOT / "configs/pointmass_space.yaml",
        [f"curriculum={CURRICULA[name]}", "env.id=tests.tiny_env:make", f"instances.train={folder}/{train}.csv",
         f"instances.test={folder}/test.csv", "learner.n_steps=64", "learner.n_epochs=1", "rollout.shards=2",
         "rollout.slots=2", f"budget.steps={64 * 14 * (2 if name == 'population' else 1)}", "tracking.uri=null",
         "resources.workers=0", "evaluation.every_steps=1000",
         *(["engine=population"] if name == "population" else []), *more],
    )  # fmt: skip


@pytest.fixture(scope="module")
def run_of(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The folder of a run of a variant, made once."""

    @functools.cache
    def run(name: str, *more: str) -> Path:
        out: Path = tmp_path_factory.mktemp(name) / "run"
        launch(config(name, folder, *more), out, resume=False, stop=StopRequests())
        return out

    return run


AUDITING = runpy.run_path(str(AUDIT))["main"]


def audited(folder: Path) -> tuple[int, str]:
    """The exit code of the audit, and what it says."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = AUDITING([str(folder)])
    return code, said.getvalue()


@pytest.mark.parametrize("name", CURRICULA)
def test_every_decision_of_every_variant_is_made_again(name: str, run_of: Any) -> None:
    out = run_of(name)
    code, said = audited(out)
    rows = [row for row in Ledger(out).rows(METRICS) if row["kind"] == "iteration" and row["complete"]]
    assert code == 0, said
    assert f"all {len(rows)} decisions" in said
    assert len(rows) >= 4
    if "fixed" not in name and name != "round_robin":
        assert len(Ledger(out).rows(CURRICULUM)[-1]["trained"]) > 1  # it did grow


def test_the_audit_is_a_program_that_knows_nothing_of_our_code(run_of: Any) -> None:
    code = (
        f"import runpy, sys; main = runpy.run_path({str(AUDIT)!r})['main']; code = main(sys.argv[1:]); "
        "print([name for name in sys.modules if name.partition('.')[0] == 'space_dist']); raise SystemExit(code)"
    )
    command = [sys.executable, "-c", code, str(run_of("abs"))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stdout.splitlines()[-1]) == (0, "[]"), done.stderr
    shown = subprocess.run([sys.executable, str(AUDIT), "--help"], capture_output=True, text=True, timeout=300)
    assert (shown.returncode, "Exit code 0" in shown.stdout) == (0, True)


def test_values_scored_again_under_new_scales_are_what_the_decision_saw(run_of: Any) -> None:
    out = run_of("default", "learner.normalize_observations=true")
    assert all("before" in row for row in Ledger(out).rows(VALUES)[1:])
    assert audited(out)[0] == 0
    zero = run_of("zero", "learner.normalize_rewards=true")
    rows = Ledger(zero).rows(VALUES)
    assert not decode_values(rows[0]["after"]).any()
    assert ["before" in row for row in rows[1:3]] == [False, True]  # the first compares with 0
    assert audited(zero)[0] == 0


class AfterEachRound(StopRequests):
    def reason(self) -> str | None:
        return "the test"


def test_a_resumed_run_has_the_same_values_and_passes(folder: Path, run_of: Any, tmp_path: Path) -> None:
    interruptions = 0
    for _ in range(30):
        try:
            launch(config("default", folder), tmp_path / "run", resume=True, stop=AfterEachRound())
            break
        except Interrupted:
            interruptions += 1
            with (tmp_path / "run" / VALUES).open("ab") as file:
                file.write(b'{"iteration":99,"after":')  # a row that no checkpoint covers
    assert interruptions > 5
    assert (tmp_path / "run" / VALUES).read_bytes() == (run_of("default") / VALUES).read_bytes()
    assert audited(tmp_path / "run")[0] == 0


def rewritten(run: Path, to: Path, name: str, change: Any) -> Path:
    """A copy of a run whose rows of a file were changed by somebody who knows how checksums are made."""
    shutil.copytree(run, to)
    rows = Ledger(run).rows(name)
    (to / name).write_bytes(b"".join(encode_row(row) for row in change(rows)))
    return to


def test_whoever_changes_the_ledger_is_found(run_of: Any, tmp_path: Path) -> None:
    run = run_of("round_robin")
    space = run_of("abs")

    def other_values(rows: list[Any]) -> list[Any]:
        rows[2]["after"] = encode_values(2.0 * decode_values(rows[2]["after"]))
        return rows

    def other_set(rows: list[Any]) -> list[Any]:
        rows[-1]["trained"] = rows[-1]["trained"][::-1]
        return rows

    def other_story(rows: list[Any]) -> list[Any]:
        row = [row for row in rows if row["kind"] == "iteration"][2]
        row["curriculum"]["size"] += 1
        return rows

    cases = [
        (space, VALUES, other_values, "iteration 2: the run says mean_value_after"),
        (run, CURRICULUM, other_set, "trained on another set than the one that follows"),
        (space, METRICS, other_story, "iteration 3: the run says size = "),
        (space, VALUES, lambda rows: rows[:-1], "its start values are not there"),
        (space, VALUES, lambda rows: [{**row, "after": encode_values(np.zeros(3))} for row in rows], "3 start values"),
    ]
    for number, (source, name, change, words) in enumerate(cases):
        code, said = audited(rewritten(source, tmp_path / str(number), name, change))
        assert (code, words in said) == (1, True), said
    shutil.copytree(space, tmp_path / "flipped")
    content = bytearray((space / VALUES).read_bytes())
    content[content.index(b"f4") + 12] ^= 1
    (tmp_path / "flipped" / VALUES).write_bytes(content)
    code, said = audited(tmp_path / "flipped")
    assert (code, "row 1: its checksum does not match" in said) == (1, True), said
    assert any(VALUES in one for one in Ledger(tmp_path / "flipped").damage())
    with pytest.raises(LedgerError, match=r"values\.jsonl, row 1"):
        Ledger(tmp_path / "flipped").rows(VALUES)


def test_rows_that_no_checkpoint_covers_accuse_nobody(run_of: Any, tmp_path: Path) -> None:
    """As a run's files are while it writes: the iteration's row is there, its values and the next set are not."""
    run = run_of("abs")
    being_written = shutil.copytree(run, tmp_path / "being_written")
    row = next(row for row in reversed(Ledger(run).rows(METRICS)) if row["kind"] == "iteration" and row["complete"])
    with (being_written / METRICS).open("ab") as file:
        file.write(encode_row({**row, "iteration": row["iteration"] + 1}))
    with (being_written / CURRICULUM).open("ab") as file:
        file.write(encode_row({"iteration": row["iteration"] + 1, "steps": 0, "trained": [0]}))
    assert audited(being_written) == (0, audited(run)[1].replace(str(run), str(being_written)))
    (being_written / "status.json").unlink()  # then nothing says that these do not count
    assert audited(being_written)[0] == 1
    begun = shutil.copytree(run, tmp_path / "begun")
    status = json.loads((begun / "status.json").read_text())
    (begun / "status.json").write_text(json.dumps({**status, "committed": {}}))
    assert "has committed nothing yet" in audited(begun)[1]
    assert audited(begun)[0] == 2
    (begun / "status.json").write_text("{")
    assert audited(begun) == (2, f"audit: {begun / 'status.json'} is damaged\n")


def test_what_cannot_be_audited_is_said(folder: Path, run_of: Any, tmp_path: Path) -> None:
    code, said = audited(tmp_path)
    assert (code, "the folder of one run is wanted" in said) == (2, True)
    headless = rewritten(run_of("abs"), tmp_path / "headless", VALUES, lambda rows: rows[1:])
    assert audited(headless)[0] == 2
    drawn = config("default", folder, "curriculum={kind: uniform}")
    launch(drawn, tmp_path / "drawn", resume=False, stop=StopRequests())
    code, said = audited(tmp_path / "drawn")
    assert (code, "kind: uniform draws its instances" in said) == (2, True)
    shown = CliRunner().invoke(app, ["explain", str(tmp_path / "drawn"), "--iteration", "1"])
    assert "uniform draws its instances" in str(shown.exception)


def test_values_are_kept_bit_for_bit_and_nothing_else_is_taken_for_them() -> None:
    for values in (np.array([0.1, -0.0, 1e300]), np.float32([0.1, 3.5, -7.25]).astype(np.float64), np.zeros(0)):
        encoded = json.loads(json.dumps(encode_values(values)))
        assert decode_values(encoded).tobytes() == values.tobytes()
    assert list(encode_values(np.float32([0.1]).astype(np.float64))) == ["f4"]
    for wrong in (None, {}, {"f4": "!"}, {"f2": ""}, {"f8": "AAAA"}, {"f4": "", "f8": ""}, [1.0], {"f4": 3}):
        with pytest.raises(LedgerError, match="start values are"):
            decode_values(wrong)


def test_large_sets_keep_no_values_and_the_log_says_so(
    folder: Path, run_of: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = run_of("default")
    monkeypatch.setattr(training, "MOST_VALUED", 8)
    launch(config("default", folder), tmp_path / "run", resume=False, stop=StopRequests())
    assert (tmp_path / "run" / VALUES).read_bytes() == b""
    assert (tmp_path / "run/log.txt").read_text().count("9 instances: above 8, values.jsonl is not written") == 1
    assert (tmp_path / "run" / METRICS).read_bytes() == (kept / METRICS).read_bytes()
    assert audited(tmp_path / "run")[0] == 2


# ---- explain --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CURRICULA)
def test_every_decision_can_be_explained(name: str, run_of: Any) -> None:
    out = run_of(name)
    rows = [row for row in Ledger(out).rows(METRICS) if row["kind"] == "iteration" and row["complete"]]
    trained = [row["trained"] for row in Ledger(out).rows(CURRICULUM)]
    for iteration in (1, len(rows)):
        result = CliRunner().invoke(app, ["explain", str(out), "--iteration", str(iteration)])
        assert result.exit_code == 0, result.exception
        lines = result.stdout.splitlines()
        assert f"S = {len(trained[iteration - 1])} of 9" in lines[1]
        if iteration < len(trained):
            named = ", ".join(str(one) for one in trained[iteration])
            assert f"Line 12: I_curr := {named}" in lines
            assert lines[-1].endswith("the run has trained on these")
    last = CliRunner().invoke(app, ["explain", str(out)]).stdout.splitlines()
    assert [last[0], last[1:]] == [f"{lines[0]}, the last; --iteration N shows another", lines[1:]]


def test_an_explanation_has_the_numbers_of_the_log(run_of: Any) -> None:
    out = run_of("default")
    row = next(row for row in Ledger(out).rows(METRICS) if row.get("iteration") == 3 and row["kind"] == "iteration")
    said, scored = row["curriculum"], Ledger(out).rows(VALUES)
    text = CliRunner().invoke(app, ["explain", str(out), "--iteration", "3"]).stdout
    assert f"Line 6: V_t = {said['mean_value_after']:.6g}, V_t-1 = {said['mean_value_before']:.6g}" in text
    assert f"a relative change of {said['relative_change']:.6g}" in text
    assert ("S := " in text) == said["grew"]
    before, after = (decode_values(scored[at]["after"]) for at in (2, 3))
    best = int((after - before).argmax())
    first = next(line.split() for line in text.splitlines() if line.startswith("next"))
    assert first[1] == str(best)
    assert [float(number) for number in first[2:]] == pytest.approx(
        [before[best], after[best], after[best] - before[best]], rel=1e-5
    )


@pytest.mark.parametrize("iteration", ["0", "99"])
def test_iterations_that_are_not_there_are_refused(iteration: str, run_of: Any) -> None:
    result = CliRunner().invoke(app, ["explain", str(run_of("default")), "--iteration", iteration])
    assert "has decisions behind iterations 1 to " in str(result.exception)


def test_an_explanation_that_the_run_contradicts_is_none(run_of: Any, tmp_path: Path) -> None:
    def other_set(rows: list[Any]) -> list[Any]:
        rows[1]["trained"] = [8]
        return rows

    changed = rewritten(run_of("default"), tmp_path / "changed", CURRICULUM, other_set)
    for file in changed.glob("status.json"):
        file.unlink()  # else the ledger itself says that it was changed
    stored = configs.load(changed / "config.yaml")
    bounds = spec_of(stored).context_bounds
    train = read_csv(changed / "instances_train.csv", bounds)
    with pytest.raises(LedgerError, match=r"trained on another set .*audit\.py says where"):
        explain(Ledger(changed), stored, bounds, train, 1)
