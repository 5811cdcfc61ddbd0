"""The benchmarks that pages have one type: executed by bash as they are written, with their smallest sizes.

`kernel`, `off-policy`, `equivalence` and `tune` measure, a few minibatches and runs. `throughput` searches, counts
rounds, draws its table and keeps its files, while what its processes answer is made up: they take minutes, and
tests/test_throughput.py has them. `chaos` is asked what it is asked, and tests/chaos/test_chaos.py rehearses.
"""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch
import typer

from space_dist.arithmetic import SETTINGS
from space_dist.errors import SpaceDistError
from tests.commanding import command
from tests.grids import ROOT
from tests.shell import Shell, executes, one_server

sys.path.append(str(ROOT / "jobs"))

import benchmark
from benchmarks import chaos, contenders, equivalence, gpu, kernel, off_policy, optuna_study, throughput, tune
from benchmarks.faults import KINDS, Fault, Hit, Result


class Bench(Shell):
    """A shell whose `python jobs/benchmark.py` is done in this process."""

    more: tuple[str, ...] = ()

    def command(self, words: list[str]) -> int:
        if words[:2] != ["python", "jobs/benchmark.py"]:
            return super().command(words)
        self._patch.chdir(self.folder)
        try:
            typer.main.get_command(benchmark.app)([*words[2:], *self.more], prog_name="benchmark.py")
        except SystemExit as error:
            return int(error.code or 0)
        return 0


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[Bench]:
    clone = tmp_path / "clone"
    clone.mkdir()
    found = Bench(clone, monkeypatch)
    yield found
    assert set(found.done) == set(request.function.executes)


@executes(("performance.md", 1), ("performance.md", 2))
def test_kernels(bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(kernel, "SHAPES", {(64, 64): 64})
    bench.more = ("--rounds", "1")
    bench.block("performance.md", 1)
    assert "64-64, minibatch 64: compiled " in capsys.readouterr().out
    works = off_policy._works
    monkeypatch.setattr(off_policy, "_works", lambda steps: {
        kind: dataclasses.replace(work, settings=(
            *work.settings, "learner.learning_starts=100", "learner.gradient_steps_per_step=0.1", "budget.steps=512",
            "evaluation.every_steps=512",
        )) for kind, work in works(steps).items()
    })  # fmt: skip
    bench.more = ("--rounds", "1", "--steps", "512")
    bench.block("performance.md", 2)
    assert "ratio of gradient" in capsys.readouterr().out


@executes(("performance.md", 3))
def test_equivalence(bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Three runs an arm, by one process."""
    for name, value in {"PILOT": range(9000, 9003), "FEWEST": 3, "MOST": 3}.items():
        monkeypatch.setattr(equivalence, name, value)

    ran = subprocess.run

    def run(words: list[str], **how: Any) -> Any:
        if words[:3] != [sys.executable, "-m", "space_dist.cli"]:
            return ran(words, **how)
        assert how == {"stdout": subprocess.DEVNULL, "check": False}
        return subprocess.CompletedProcess(words, command(monkeypatch, *words[3:]))

    monkeypatch.setattr(equivalence.subprocess, "run", run)
    bench.more = ("--steps", "4096", "--max-parallel", "1")
    codes: list[int] = []

    def answer(words: list[str]) -> int:
        codes.append(bench.command(words))
        return 0  # that so few are not shown to be equal is no fault

    with one_server():
        bench.block("performance.md", 3, {"/tmp/equivalence": str(bench.folder / "kept")}, answer=answer)  # noqa: S108
    told = capsys.readouterr().out
    assert "PointMass, round_robin, 4,096 steps, the same 3 seeds" in told
    assert codes == [0 if "yes" in told else 1]
    assert len(list((bench.folder / "kept").glob("*/*/s*/model.npz"))) == 9


@executes(("performance.md", 4))
def test_gpu(bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Asked of processes of `contenders` as on a GPU; JAX's are as fast as they have environments."""
    monkeypatch.setattr(gpu, "_gpu", lambda: "GPU of a test")
    monkeypatch.setattr(gpu, "not_installed", list)
    asked: list[contenders.Contender] = []

    def found(wanted: list[tuple[str, contenders.Contender]], patience: float | None = None) -> list[dict[str, float]]:
        assert patience is None or patience > 0
        ((specification, contender),) = wanted
        given = json.loads(specification)
        assert given["core"] == (0 if contender.device == "cpu" else None)
        assert contenders.Contender(**given["contender"] | {"overrides": ()}) == contender
        asked.append(contender)
        return [{"rate": 1e6 + contender.slots} | ({"compile": 2.0} if contender.kind == "jax" else {})]

    monkeypatch.setattr(throughput, "_together", found)
    bench.block("performance.md", 4)
    told = capsys.readouterr().out
    assert "| JAX, everything jitted | 1,024 members on the GPU, 256 slots, XLA_FLAGS=''; 2.0 s to compile" in told
    assert "| 1,000,256 (1,000,256-1,000,256) |" in told
    measured = asked[2 * len(gpu.SLOTS) :]
    assert [(one.update, one.members, one.device) for one in measured[: len(measured) // 2]] == [
        ("population", 256, "cuda"), ("stacked", 256, "cuda"), ("stock", 256, "cuda"),
        ("population", 1024, "cuda"), ("stacked", 1024, "cuda"), ("stock", 1024, "cuda"), ("population", 32, "cpu"),
    ]  # fmt: skip
    # A process of `contenders` that is asked for the update alone.
    alone = contenders.Contender("ours", update="stacked", members=2)
    assert contenders.measure(contenders.TASKS["pointmass"], alone, 0.01, time.perf_counter)["rate"] > 0.0


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_there_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu, "measured", lambda *_: pytest.fail("it went on"))
    with pytest.raises(SpaceDistError, match="torch finds no GPU on this machine"):
        gpu.gpu()


@executes(("performance.md", 5))
def test_tune(bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Two trials of two seeds and an update each; Optuna's study with all seeds in processes of its own."""
    ran, studies = tune.completed, []

    def run(words: list[str], **how: Any) -> Any:
        if words[1:4] == ["-P", "-m", "space_dist.cli"]:
            with contextlib.chdir(how["cwd"]):
                return subprocess.CompletedProcess(words, command(monkeypatch, *words[4:]))
        if "from benchmarks.optuna_study import main; main()" not in words:
            return ran(words, **how)
        assert (how["env"]["SPACE_DIST_ARITHMETIC"], how["env"].keys() & SETTINGS.keys()) == ("native", set())
        given = json.loads(words[-1])
        studies.append(given)
        if given["seeds"] > 1:
            return ran(words, **how)
        with ThreadPoolExecutor(1) as pool:
            found = optuna_study.studied(optuna_study.Asked(**given), pool)
        return subprocess.CompletedProcess(words, 0, json.dumps(found))

    monkeypatch.setattr(tune, "completed", run)
    monkeypatch.setattr(tune, "cores", lambda: 1)
    monkeypatch.setattr(throughput, "process", lambda *_: {"kernel": 1e-6})
    sizes = {"trials": 2, "seeds": 2, "generation": 1, "steps": 2048, "rounds": 1, "n-envs": 64}
    bench.more = tuple(word for name, size in sizes.items() for word in (f"--{name}", str(size)))
    with one_server():
        bench.block("performance.md", 5)
    assert [(one["seeds"], one["evaluations"], one["processes"]) for one in studies] == [(2, [0, 2048], 1),
                                                                                         (1, [0, 2048], 1)]  # fmt: skip
    taken = {name: rounds for name, (*rounds,) in json.loads((bench.folder / "tune.json").read_text()).items()}
    assert {name: [one["steps"] for one in rounds] for name, rounds in taken.items()} == {
        "ours": [4 * 2048], "optuna": [4 * 2048], "one_seed": [2 * 2048]
    }  # fmt: skip
    for (one,) in taken.values():
        runs = one["steps"] // 2048
        # Two evaluations of a run, on 100 instances of each set, of at most 100 steps.
        assert runs * 2 * 200 <= one["evaluation_steps"] <= runs * 2 * 200 * 100
        assert (len(one["values"]), sum(one["shares"].values())) == (2, pytest.approx(1.0))
    # PPO learns nothing in one update: whoever is measured otherwise would be seen here.
    assert taken["optuna"][0]["values"] == pytest.approx(taken["ours"][0]["values"], rel=0.5)
    told = capsys.readouterr().out
    assert "2 trials of 2 seeds on 1 cores" in told
    assert "2 seeds a trial cost " in told


@executes(("performance.md", 0))
def test_throughput(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everybody is as fast as they are many, and what they are asked is what a process of `contenders` takes."""
    asked: list[dict[str, Any]] = []
    fields = {field.name for field in dataclasses.fields(contenders.Contender)}

    def found(wanted: list[tuple[str, contenders.Contender]], patience: float | None = None) -> list[dict[str, float]]:
        assert patience is None or patience > 0
        given = [json.loads(specification) for specification, _ in wanted]
        assert all(one["task"] in contenders.TASKS and {*one["contender"]} == fields for one in given)
        asked.extend(given)
        return [{"rate": 1000.0 * len(asked)} for _ in wanted]

    monkeypatch.setattr(throughput, "_together", found)
    monkeypatch.setattr(
        throughput, "process", lambda *_: dict.fromkeys(("kernel", "batched", "single", "arithmetic"), 1e-5)
    )
    monkeypatch.setattr(throughput, "_grid_seconds", lambda *_: 1.0)
    monkeypatch.setattr(throughput, "not_installed", lambda: [*throughput.EXTRA])
    codes: list[int] = []

    def answer(words: list[str]) -> int:
        codes.append(bench.command(words))
        return 0  # that somebody is slower than wanted is no fault of the command

    # The clone's own history, where the commit of the page is.
    for words in (["clone", "-q", "--no-checkout", str(ROOT), "history"],):
        subprocess.run(["git", *words], cwd=bench.folder, check=True)
    shutil.move(bench.folder / "history/.git", bench.folder / ".git")
    bench.block("performance.md", 0, prelude='pip() { echo "not done: pip $*"; }\n', answer=answer)
    assert len(codes) == 4
    assert set(codes) <= {0, 1}
    assert {one["task"] for one in asked} == {*contenders.TASKS}
    for name in ("throughput/throughput.md", "throughput/throughput.png", "throughput.json", "settings.json"):
        assert (bench.folder / name).is_file()
    before = [one["contender"] for one in asked if one["contender"]["checkout"]]
    assert {one["checkout"] for one in before} == {str((bench.folder.parent / "before").resolve())}
    assert (bench.folder.parent / "before/space_dist/__init__.py").is_file()


@executes(("recovery.md", 0))
def test_chaos(bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """What `rehearse` is asked for: tests/chaos/test_chaos.py asks it for less."""
    wanted, rehearse = [], inspect.signature(chaos.rehearse)

    def rehearsed(**how: Any) -> Result:
        wanted.append(rehearse.bind(**how).arguments)
        hit = Hit(Fault(KINDS[0], 1.0, 0.0, 0.0, 0.5), "run", 1.0, 2.5)
        return Result(hits=[hit], runs=how["runs"], identical=how["runs"], submissions=1)

    monkeypatch.setattr(chaos, "rehearse", rehearsed)
    bench.block("recovery.md", 0)
    assert [(one["count"], one["runs"], len(one["kinds"])) for one in wanted] == [(50, 8, 14), (50, 8, 10)]
    assert [one["settings"].get("engine") for one in wanted] == [None, "population"]
    assert capsys.readouterr().out.count(KINDS[0]) == 2
