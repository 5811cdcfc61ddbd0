"""The Python API: the page that describes it, what it does as the command does, and how it refuses."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import space_dist
from space_dist import config as configs
from space_dist.api import progress
from space_dist.api.arguments import as_changes
from space_dist.api.training import as_config
from space_dist.config import BudgetConfig, Mirrors, RunConfig
from space_dist.errors import ConfigError, LedgerError, SpaceDistError
from space_dist.grid.planning import plan
from space_dist.grid.tuning import plan_search
from space_dist.ledger import CURRICULUM, METRICS, RunWriter
from space_dist.run.continuing import is_longer
from space_dist.run.pace import TimeLeft
from space_dist.run.training import Progress
from space_dist.tracking.pusher import Pusher
from tests.commanding import command
from tests.grids import write_grid
from tests.patience import PATIENCE
from tests.test_learners import N_STEPS, config_for, learner_section
from tests.tunes import write_tune

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs/python.md"
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
RESULTS = (METRICS, CURRICULUM, "values.jsonl", "model.npz", "model.json")


def files(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in RESULTS}


def test_every_block_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    said, names = io.StringIO(), {"__name__": "page"}
    with contextlib.redirect_stdout(said):
        for block in BLOCK.findall(PAGE.read_text()):
            exec(compile(block, str(PAGE), "exec"), names)  # noqa: S102 - our own page
    told = said.getvalue()
    assert "did you mean 'kappa'?" in told
    assert "4,096/4,096 steps" in told
    grid: Any = names["grid"]
    assert grid.complete
    assert len(grid.runs()) == 4
    html = names["report"]._repr_html_()  # type: ignore[attr-defined]
    assert html.count("<img") == len(names["report"].figures) >= 1  # type: ignore[attr-defined]
    assert names["run"]._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]


# ---- a larger budget, and starting from another run ------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "changes"), [
    ("ppo", {}), ("sac", {}), ("ppo", {"normalize_observations": True, "normalize_rewards": True}),
])  # fmt: skip
def test_a_longer_run_is_the_one_that_had_its_budget_from_the_start(
    kind: str, changes: dict[str, Any], tmp_path: Path
) -> None:
    section = learner_section(kind, **changes)
    short = config_for(tmp_path, section, checkpoint={"every_rounds": 2})
    long = config_for(tmp_path, section, checkpoint={"every_rounds": 2}, budget={"steps": 11 * N_STEPS})
    space_dist.train(short, out=tmp_path / "run", progress=False)
    assert space_dist.Run(tmp_path / "run").status.steps == short.budget.steps
    with pytest.raises(ConfigError, match=r"--resume continues it, .*from Python: resume=True"):
        space_dist.train(long, out=tmp_path / "run", progress=False)
    space_dist.train(long, out=tmp_path / "run", resume=True, progress=False)
    space_dist.train(long, out=tmp_path / "whole", progress=False)
    assert files(tmp_path / "run") == files(tmp_path / "whole")
    refused = (
        r"budget.steps: 440 -> 240: the budget of a run that is there may only grow, .*: --set budget.steps=440 goes"
    )
    with pytest.raises(ConfigError, match=refused):
        space_dist.train(short, out=tmp_path / "run", resume=True, progress=False)
    fewer = long.model_copy(update={"budget": long.budget.model_copy(update={"episodes": 5})})
    with pytest.raises(ConfigError, match=r"budget.episodes: no limit -> 5: .* --set budget.episodes=null goes"):
        space_dist.train(fewer, out=tmp_path / "run", resume=True, progress=False)


def test_a_run_shorter_than_its_first_checkpoint_begins_anew(tmp_path: Path) -> None:
    section, seldom = learner_section("ppo"), {"every_rounds": 1000, "every_seconds": 1e6}
    space_dist.train(config_for(tmp_path, section, checkpoint=seldom), out=tmp_path / "run", progress=False)
    long = config_for(tmp_path, section, checkpoint=seldom, budget={"steps": 8 * N_STEPS})
    space_dist.train(long, out=tmp_path / "run", resume=True, progress=False)
    space_dist.train(long, out=tmp_path / "whole", progress=False)
    assert files(tmp_path / "run") == files(tmp_path / "whole")


def test_without_its_checkpoints_a_run_gets_no_larger_budget(tmp_path: Path) -> None:
    section = learner_section("ppo")
    run = space_dist.train(config_for(tmp_path, section), out=tmp_path / "run", progress=False)
    for path in (run.folder / "checkpoints").iterdir():
        path.unlink()
    before = files(run.folder)
    long = config_for(tmp_path, section, budget={"steps": 12 * N_STEPS})
    with pytest.raises(ConfigError, match="its checkpoints were removed, and a larger budget goes on from one of them"):
        space_dist.train(long, out=run.folder, resume=True, progress=False)
    assert files(run.folder) == before
    assert run.status.state == "done"


def everything(folder: Path) -> dict[str, bytes]:
    """All of a run's files but its lock, which whoever looks at a run takes."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.name != "lock.json"
    }


@pytest.mark.parametrize("state", ["done", "interrupted"])
@pytest.mark.parametrize("grows", [True, False])
@pytest.mark.parametrize("damaged", ["all", "the one that is needed", "rows under both", "all, and the status gone"])
def test_what_cannot_go_on_is_left_as_it_is(damaged: str, grows: bool, state: str, tmp_path: Path) -> None:
    config = config_for(tmp_path, learner_section("ppo"), checkpoint={"every_rounds": 1})

    def give_up(now: Progress) -> None:
        if state == "interrupted" and now.steps >= 4 * N_STEPS:
            raise KeyboardInterrupt

    with contextlib.suppress(KeyboardInterrupt):
        space_dist.train(config, out=tmp_path / "run", progress=give_up)
    run = tmp_path / "run"
    assert space_dist.Run(run).status.state == state
    newest, older = sorted((run / "checkpoints").iterdir(), reverse=True)
    if damaged == "rows under both":
        (run / METRICS).write_bytes(b"!" + (run / METRICS).read_bytes()[1:])
    for path in {"the one that is needed": [older], "rows under both": []}.get(damaged, [newest, older]):
        path.write_bytes(path.read_bytes()[:-100])
    if damaged.endswith("gone"):
        (run / "status.json").unlink()
    longer = config_for(tmp_path, learner_section("ppo"), checkpoint={"every_rounds": 1}, budget={"steps": 480})
    before = everything(run)
    # Of a done run, the last checkpoint is from its end: a longer one needs that before it.
    goes_on = damaged == "the one that is needed" and not (grows and state == "done")
    stays_done = state == "done" and not grows and damaged == "all"
    with contextlib.nullcontext() if goes_on or stays_done else pytest.raises(SpaceDistError) as refused:
        space_dist.train(longer if grows else config, out=run, resume=True, progress=False)
    if goes_on:
        assert space_dist.Run(run).status.state == "done"
        return
    assert everything(run) == before
    if refused is not None and "gone" not in damaged:
        assert re.search(r"no checkpoint( that it could go on from)? is intact \(", str(refused.value))


def test_killed_as_it_forgets_the_only_checkpoint_it_begins_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    section, seldom = learner_section("ppo"), {"every_rounds": 1000, "every_seconds": 1e6}
    space_dist.train(config_for(tmp_path, section, checkpoint=seldom), out=tmp_path / "run", progress=False)
    long = config_for(tmp_path, section, checkpoint=seldom, budget={"steps": 8 * N_STEPS})

    def die(path: Path, **options: bool) -> None:  # noqa: ARG001 - the signature is pathlib's
        raise KeyboardInterrupt if path.suffix == ".npz" else FileNotFoundError

    monkeypatch.setattr(Path, "unlink", die)
    with pytest.raises(KeyboardInterrupt):
        space_dist.train(long, out=tmp_path / "run", resume=True, progress=False)
    monkeypatch.undo()
    space_dist.train(long, out=tmp_path / "run", resume=True, progress=False)
    space_dist.train(long, out=tmp_path / "whole", progress=False)
    assert files(tmp_path / "run") == files(tmp_path / "whole")


def test_a_longer_run_that_is_interrupted_goes_on(tmp_path: Path) -> None:
    section = learner_section("ppo")
    space_dist.train(config_for(tmp_path, section), out=tmp_path / "run", progress=False)
    long = config_for(tmp_path, section, budget={"steps": 12 * N_STEPS})

    def give_up(now: Progress) -> None:
        if now.steps >= 8 * N_STEPS:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        space_dist.train(long, out=tmp_path / "run", resume=True, progress=give_up)
    assert space_dist.Run(tmp_path / "run").status.state == "interrupted"
    space_dist.train(long, out=tmp_path / "run", resume=True, progress=False)
    space_dist.train(long, out=tmp_path / "whole", progress=False)
    assert files(tmp_path / "run") == files(tmp_path / "whole")


def test_killed_as_it_is_handed_to_a_larger_budget_it_goes_on_under_that_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    section = learner_section("ppo")
    short, long = config_for(tmp_path, section), config_for(tmp_path, section, budget={"steps": 12 * N_STEPS})
    space_dist.train(short, out=tmp_path / "run", progress=False)
    hand_over = RunWriter.hand_over

    def die_behind(writer: RunWriter, *arguments: Any) -> Any:
        hand_over(writer, *arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(RunWriter, "hand_over", die_behind)
    with pytest.raises(KeyboardInterrupt):
        space_dist.train(long, out=tmp_path / "run", resume=True, progress=False)
    monkeypatch.undo()
    with pytest.raises(ConfigError, match="a larger budget, of 480 steps, when it was killed: ask for"):
        space_dist.train(short, out=tmp_path / "run", resume=True, progress=False)
    space_dist.train(long, out=tmp_path / "run", resume=True, progress=False)
    space_dist.train(long, out=tmp_path / "whole", progress=False)
    assert files(tmp_path / "run") == files(tmp_path / "whole")


@pytest.mark.parametrize(("kind", "changes", "reason"), [
    ("ppo", {"learning_rate_schedule": "linear"}, "learner.learning_rate_schedule: linear falls to 0"),
    ("dqn", {}, "learner.exploration_fraction: 0.5 is a share of the budget"),
])  # fmt: skip
def test_what_goes_by_the_budget_is_not_made_longer(
    kind: str, changes: dict[str, Any], reason: str, tmp_path: Path
) -> None:
    section = learner_section(kind, **changes)
    space_dist.train(config_for(tmp_path, section), out=tmp_path / "run", progress=False)
    before = files(tmp_path / "run")
    with pytest.raises(ConfigError, match=reason):
        space_dist.train(
            config_for(tmp_path, section, budget={"steps": 8 * N_STEPS}), out=tmp_path / "run", resume=True
        )
    assert files(tmp_path / "run") == before


def test_a_refused_budget_names_the_limit_that_grew(tmp_path: Path) -> None:
    short = config_for(tmp_path, learner_section("ppo", learning_rate_schedule="linear"))
    budgets = [short.model_copy(update={"budget": BudgetConfig(steps=9, episodes=limit)}) for limit in (1, 60)]
    with pytest.raises(
        ConfigError, match=r"budget: 1 -> 60 episodes: .* Under the budget that it has, this one goes on"
    ):
        is_longer(*budgets)


@pytest.mark.parametrize("kind", ["ppo", "recurrent_ppo", "td3"])
def test_a_run_starts_from_what_another_has_learned(kind: str, tmp_path: Path) -> None:
    section = learner_section(kind, normalize_observations=True)
    first = space_dist.train(config_for(tmp_path, section), out=tmp_path / "first", progress=False)
    from_it = config_for(tmp_path, section, init_from=str(tmp_path / "first"))
    second = space_dist.train(from_it, out=tmp_path / "second", progress=False)
    assert second.evaluations[0]["test"]["returns"] == first.evaluations[-1]["test"]["returns"]
    assert second.evaluations[0]["steps"] == 0
    # The copy is the run's own, and stands for what it was made of.
    kept = config_for(tmp_path, section, init_from=str(tmp_path / "second/init.npz"))
    space_dist.train(kept, out=tmp_path / "second", resume=True, progress=False)
    fresh = config_for(tmp_path, section)
    with pytest.raises(ConfigError, match="init_from: other networks"):
        space_dist.train(fresh, out=tmp_path / "second", resume=True, progress=False)


@pytest.mark.parametrize("engine", ["single", "population"])
def test_a_grid_keeps_what_its_runs_start_from(engine: str, tmp_path: Path) -> None:
    config = config_for(tmp_path, learner_section("ppo"))
    first = space_dist.train(config, out=tmp_path / "first", progress=False)
    (tmp_path / "run.yaml").write_text(configs.dump(config))
    (tmp_path / "grid.yaml").write_text(
        f"name: from_first\nextends: run.yaml\nset: {{ init_from: first, engine: {engine} }}\nseeds: [0]\n"
        "tracking: { uri: null }\n"
    )
    plan(tmp_path / "grid.yaml", tmp_path / "runs")
    learned = first.evaluations[-1]["test"]["returns"]
    shutil.rmtree(first.folder)
    grid = space_dist.run_grid(tmp_path / "runs/from_first", max_parallel=1, progress=False)
    assert grid.complete, grid.statuses
    for run in grid.runs().values():
        np.testing.assert_allclose(run.evaluations[0]["test"]["returns"], learned, rtol=1e-6)
    assert grid.report().numbers[0]["runs"] == 1


def test_networks_that_do_not_fit_are_refused_with_what_differs(tmp_path: Path) -> None:
    space_dist.train(config_for(tmp_path, learner_section("ppo")), out=tmp_path / "first", progress=False)
    for section, reason in (
        (learner_section("ppo", net_arch=[8]), r"has the shape \(16, 2\) in that run, and \(8, 2\) here"),
        (learner_section("sac"), "that run has no 'policy/actor"),
        (learner_section("ppo", normalize_rewards=True), "that run has no 'normaliser/"),
    ):
        with pytest.raises(ConfigError, match=f"init_from: .*{reason}"):
            space_dist.train(
                config_for(tmp_path, section, init_from=str(tmp_path / "first")), out=tmp_path / "no", progress=False
            )
    for path, reason in ((tmp_path / "nowhere", "does not exist"), (tmp_path / "train.csv", "holds no weights"),
                         (tmp_path, "holds no run")):  # fmt: skip
        with pytest.raises(ConfigError, match=f"init_from: .*{reason}"):
            space_dist.train(config_for(tmp_path, learner_section("ppo"), init_from=str(path)), out=tmp_path / "no")
    assert not (tmp_path / "no").exists()


# ---- configs, policies, folders --------------------------------------------------------------------------------------


def test_a_config_is_a_path_a_mapping_or_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = ROOT / "configs/pointmass_space.yaml"
    read = as_config(path, {"budget.steps": np.int64(4096), "learner.net_arch": (8, 8)}, seed=3, workers=0)
    assert (read.seed, read.budget.steps, read.resources.workers, read.learner.net_arch) == (3, 4096, 0, (8, 8))
    assert as_config(str(path), ["budget.steps=4096", "learner.net_arch=[8, 8]"], seed=3, workers=0) == read
    assert as_config(read) == read
    data = read.model_dump(mode="json")
    data["instances"] = {"train": "here.csv", "test": Path("there.csv")}
    assert as_config(data).instances.train == tmp_path / "here.csv"
    assert data["instances"]["train"] == "here.csv"
    for bad, words in (
        (7, "a path, shipped:NAME, a mapping or a RunConfig, not a int"),
        ("", "a config is a path, shipped:NAME, a mapping or a RunConfig, not ''"),
        ({**data, "nmae": "x"}, "config: nmae: unknown key; did you mean 'name'?"),
        ({**data, "learner": {"kind": "ppo", "n_steps": object()}}, "learner.n_steps"),
    ):
        with pytest.raises(ConfigError, match=re.escape(words)):
            as_config(bad)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="overrides must be a mapping or a list"):
        as_config(read, "budget.steps=3")


def test_train_does_what_the_command_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = config_for(tmp_path, learner_section("ppo"))
    (tmp_path / "run.yaml").write_text(configs.dump(config))
    assert command(monkeypatch, "train", tmp_path / "run.yaml", "--out", tmp_path / "told") == 0
    run = space_dist.train(tmp_path / "run.yaml", out=tmp_path / "called")
    assert files(tmp_path / "told") == files(run.folder)
    assert run.final["test"] == run.evaluations[-1]["test"]["return"]
    assert isinstance(run.config, RunConfig)
    with pytest.raises(LedgerError, match="does not exist"):
        space_dist.Run(tmp_path / "nowhere")
    with pytest.raises(
        LedgerError, match=r"2 folders below it do, .*/called, .*/told; space_dist\.report_on\('/.*'\) reports on"
    ):
        space_dist.Run(tmp_path)


def test_a_grids_folder_is_no_run_and_says_what_reads_it(tmp_path: Path) -> None:
    folder = plan(write_grid(tmp_path), tmp_path / "runs").grid.folder
    with pytest.raises(LedgerError, match=r"a grid's: space_dist\.report_on\("):
        space_dist.Run(folder)
    folder = plan_search(write_tune(tmp_path, name="sought"), tmp_path / "runs").grid.folder
    with pytest.raises(LedgerError, match=r"a search's: `space-dist tune report "):
        space_dist.Run(folder)
    for read in (space_dist.Run, space_dist.load_policy):
        with pytest.raises(LedgerError, match=r"/soght does not exist; did you mean 'sought'\?"):
            read(folder.with_name("soght"))
    (tmp_path / "manifest.json").write_text("{}")  # somebody else's
    with pytest.raises(LedgerError, match="holds no run"):
        space_dist.Run(tmp_path)


def test_a_run_with_a_dashboard_ends_with_where_to_look(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The mirror's own process is stood in for by what it writes: the quickstart's test has a whole one."""

    def start(pusher: Pusher, tracking: Mirrors, folder: Path, log_file: Path) -> None:
        said = 2 * "1 run is up to date in MLflow\\nLook at http://x/#/experiments/1 once\\n"  # a lost one's, too
        pusher.where, pusher._folder, pusher._log_file = str(tracking.uri), folder, log_file
        pusher._said_before = log_file.write_text("Look at an older page\n")
        pusher._process = subprocess.Popen(["/bin/sh", "-c", f"printf '{said}' >> {shlex.quote(str(log_file))}"])

    monkeypatch.setattr(Pusher, "__init__", start)
    config = config_for(tmp_path, learner_section("ppo"), tracking={"uri": "http://x"})
    (tmp_path / "run.yaml").write_text(configs.dump(config))
    assert command(monkeypatch, "train", tmp_path / "run.yaml", "--out", tmp_path / "run") == 0
    *_, done, look = capsys.readouterr().out.splitlines()
    assert done.endswith(f"environment steps. {tmp_path / 'run'}")
    assert look == "Look at http://x/#/experiments/1 once"


def test_a_policy_acts_as_the_run_does(tmp_path: Path) -> None:
    run = space_dist.train(config_for(tmp_path, learner_section("ppo")), out=tmp_path / "run", progress=False)
    policy = run.policy(seed=3)
    plain = np.linspace(-1.0, 1.0, 5)[:, None]
    seen = policy.with_context(plain, np.array([0.5]))
    assert isinstance(seen, np.ndarray)
    assert seen.tolist() == [[x, 0.5] for x in plain[:, 0].astype(np.float32).tolist()]
    batch, state = policy.predict(seen)
    assert (batch.shape, state) == ((5, 1), None)
    one, _ = policy.predict(seen[2])
    assert one.tolist() == batch[2].tolist()
    drawn, _ = policy.predict(seen, deterministic=False)
    assert drawn.tolist() != batch.tolist()
    assert drawn.tolist() == run.policy(seed=3).predict(seen, deterministic=False)[0].tolist()
    with pytest.raises(ConfigError, match=r"has the shape \(2,\), or \(n, 2\), not \(3,\)"):
        policy.predict(np.zeros(3))
    assert policy.values(seen).tolist() == pytest.approx([policy.values(each) for each in seen], abs=1e-6)
    with pytest.raises(ConfigError, match="without its context has 1 numbers, not the shape \\(5, 2\\)"):
        policy.with_context(seen, np.array([0.5]))
    with pytest.raises(ConfigError, match=r"contexts of shape \(3, 1\) for observations of shape \(5, 1\)"):
        policy.with_context(plain, np.zeros((3, 1)))
    with pytest.raises(ConfigError, match="contexts of shape"):
        policy.with_context(plain, np.zeros(4))
    given: Any
    for given in ({"target": 0.5}, ["a"], object()):
        with pytest.raises(ConfigError, match="an array of a number for each of target, in this order, not "):
            policy.with_context(plain, given)
    assert repr(policy) == f"ActingPolicy('tests.tiny_env:make', updates: {policy.policy.version}, context: target)"
    with pytest.raises(ConfigError, match="it has no number 1"):
        space_dist.load_policy(run, number=1)


def test_the_model_tells_how_contexts_are_scaled(tmp_path: Path) -> None:
    run = space_dist.train(config_for(tmp_path, learner_section("ppo")), out=tmp_path / "run", progress=False)
    told = json.loads((run.folder / "model.json").read_text())["context"]
    assert (told["names"], told["low"], told["high"]) == (["target"], [-1.0], [1.0])


# ---- arguments, and where a run may be put ---------------------------------------------------------------------------


@pytest.mark.parametrize(("call", "said"), [
    (lambda: space_dist.load_policy(None), "run must be a path, not None"),  # type: ignore[arg-type]
    (lambda: space_dist.load_policy("x", seed=-1), "seed must be a whole number from 0, not -1"),
    (lambda: space_dist.load_policy("x", seed="x"), "seed must be a whole number from 0, not 'x'"),  # type: ignore[arg-type]
    (lambda: space_dist.Run(None), "folder must be a path, not None"),  # type: ignore[arg-type]
    (lambda: space_dist.GridRun(None), "folder must be a path, not None"),  # type: ignore[arg-type]
    (lambda: space_dist.report_on(None), "paths must be a folder or a list of them, not None"),  # type: ignore[arg-type]
    (lambda: space_dist.report_on([]), "paths must be a folder or a list of them, not []"),
    (lambda: space_dist.run_grid(None), "grid must be a path, not None"),  # type: ignore[arg-type]
    (lambda: space_dist.run_grid("g", scale="0.5"), "scale must be a number above 0 and at most 1, not '0.5'"),  # type: ignore[arg-type]
    (lambda: space_dist.run_grid("g", max_parallel=0), "max_parallel must be a whole number from 1, not 0"),
    (lambda: space_dist.run_grid("g", max_parallel="2"), "max_parallel must be a whole number from 1, not '2'"),  # type: ignore[arg-type]
    (lambda: space_dist.run_grid("g", overrides="budget.steps=1"), "overrides must be a mapping or a list, like {"),
    (lambda: space_dist.run_search("s", max_parallel=-1), "max_parallel must be a whole number from 1, not -1"),
    (lambda: space_dist.train("c", progress="yes"), "progress must be True, False or a function, not 'yes'"),  # type: ignore[arg-type]
    (lambda: space_dist.train("shipped:pointmass_space", out=""), "out must be a path, not ''"),
    (lambda: space_dist.train("shipped:pointmass_space", seed="1"), "seed: must be a whole number from 0 to 2,147"),  # type: ignore[arg-type]
    (lambda: space_dist.train("shipped:pointmass_space", workers="2"), "workers: must be a whole number or auto"),  # type: ignore[arg-type]
    (lambda: space_dist.train("shipped:pointmass_space", overrides={"": 1}), "overrides: '' is no key, like"),
    (lambda: space_dist.train("shipped:pointmass_space", overrides={"curriculum.kapa": 1}),
     "overrides: curriculum.kapa: unknown key; did you mean 'kappa'?"),
    (lambda: space_dist.train("shipped:quickstart"), "space-dist grid run shipped:quickstart (from Python: space_d"),
])  # fmt: skip
def test_an_argument_that_cannot_be_used_is_named(call: Callable[[], object], said: str) -> None:
    with pytest.raises(ConfigError) as refused:
        call()
    assert str(refused.value).removeprefix("shipped:quickstart is a grid, of many runs: ").startswith(said)


def test_a_name_without_its_shipped_is_told_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for call, name in ((space_dist.train, "pointmass_space"), (space_dist.train, "configs/pointmass_space.yaml"),
                       (space_dist.run_grid, "quickstart"), (space_dist.run_search, "goalmaze_space")):  # fmt: skip
        meant = f"did you mean 'shipped:{name.removeprefix('configs/')}'?"
        with pytest.raises(ConfigError, match=re.escape(meant)):
            call(name)  # type: ignore[operator]


@pytest.mark.parametrize(
    "value", [1024, 1e-5, 1e20, "space", "1", "a: b", "", " x", "yes", None, True, [8, 8], {"kind": "space"}]
)
def test_what_a_program_overrides_with_is_what_the_command_reads(value: object) -> None:
    data: dict[str, Any] = {}
    configs.apply_override(data, configs.from_program("overrides", "learner.key", value))
    assert data == {"learner": {"key": value}}


def test_a_grid_is_changed_by_a_mapping_as_by_the_command(tmp_path: Path) -> None:
    path = write_grid(tmp_path)
    told = plan(path, tmp_path / "runs", 1.0, ["learner.gamma=0.5"])
    given = plan(path, tmp_path / "runs", 1.0, as_changes({"learner.gamma": 0.5}))
    assert (given.grid.folder, given.manifest) == (told.grid.folder, told.manifest)
    with pytest.raises(ConfigError, match=r"^overrides: learner.gama: .*did you mean 'gamma'"):
        space_dist.run_grid(path, root=tmp_path / "runs", overrides={"learner.gama": 0.5}, progress=False)


def test_a_run_is_put_into_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = config_for(tmp_path, learner_section("ppo"))
    (tmp_path / "run.yaml").write_text(configs.dump(config))
    run = space_dist.train(config, out=tmp_path / "runs/tiny/s0", progress=False).folder
    grid = plan(write_grid(tmp_path), tmp_path / "grids").grid.folder
    for folder, said in (
        (run.parent, "holds other runs, as .*/s0; give the run a folder of its own"),
        (run.parents[1], "holds other runs"),
        (grid, "holds a grid"),
        (grid.parent, "holds the folders of grids"),
        (run / "more", "lies inside of the run in .*/s0"),
        (tmp_path / "run.yaml", "is a file"),
        (tmp_path / ("x" * 300), "cannot be a run's folder: File name too long"),
    ):
        before = sorted(tmp_path.rglob("*"))
        for resume in (False, True):
            with pytest.raises(ConfigError, match=said):
                space_dist.train(config, out=folder, resume=resume, progress=False)
        assert command(monkeypatch, "train", tmp_path / "run.yaml", "--out", folder) == 2
        assert sorted(tmp_path.rglob("*")) == before
    other = tmp_path / "other"
    (other / "theirs").mkdir(parents=True)
    for name in ("manifest.json", "theirs/status.json"):
        (other / name).write_text("{}")
    assert space_dist.train(config, out=other, progress=False).status.state == "done"
    assert space_dist.train(config, out=other, resume=True, progress=False).status.state == "done"


def test_who_resumes_where_nothing_is_hears_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = config_for(tmp_path, learner_section("ppo"))
    (tmp_path / "run.yaml").write_text(configs.dump(config))
    assert command(monkeypatch, "train", tmp_path / "run.yaml", "--out", tmp_path / "told", "--resume") == 0
    assert f"tiny s0: beginning anew: there was no run in {tmp_path / 'told'}\n" in capsys.readouterr().out
    assert command(monkeypatch, "train", tmp_path / "run.yaml", "--out", tmp_path / "told", "--resume") == 0
    assert "beginning anew" not in capsys.readouterr().out
    monkeypatch.setattr(progress, "in_notebook", lambda: False)
    for number, wanted in enumerate((True, lambda now: None)):  # in a batch job's file
        space_dist.train(config, out=tmp_path / f"piped{number}", resume=True, progress=wanted)
        said = f"tiny s0: beginning anew: there was no run in {tmp_path / f'piped{number}'}\n"
        assert capsys.readouterr() == ("", said)
    space_dist.train(config, out=tmp_path / "silent", resume=True, progress=False)
    assert capsys.readouterr() == ("", "")
    monkeypatch.setattr(progress, "_on_terminal", lambda: True)
    space_dist.train(config, out=tmp_path / "called", resume=True)
    assert f"tiny s0: beginning anew: there was no run in {tmp_path / 'called'}" in "".join(
        capsys.readouterr().out.split("\n")
    )


def test_only_files_of_rows_are_read_as_such(tmp_path: Path) -> None:
    run = space_dist.train(config_for(tmp_path, learner_section("ppo")), out=tmp_path / "run", progress=False)
    assert run.rows(CURRICULUM)
    for name, hint in (("config.yaml", ""), ("metric.jsonl", "; did you mean 'metrics.jsonl'?")):
        said = (
            f"'{name}' is no file of rows; there are metrics.jsonl, timing.jsonl, curriculum.jsonl, values.jsonl{hint}"
        )
        with pytest.raises(ConfigError, match=f"^{re.escape(said)}$"):
            run.rows(name)
    with pytest.raises(LedgerError, match=r"config\.yaml is no run's folder: it is a file$"):
        space_dist.Run(run.folder / "config.yaml")
    more = config_for(tmp_path, learner_section("ppo", n_epochs=3), budget={"steps": 8 * N_STEPS})
    said = r"\(learner\.n_epochs: \d+ -> 3\)\. A run's .*\(from Python: overrides, out=DIR\)"
    with pytest.raises(ConfigError, match=said):
        space_dist.train(more, out=run.folder, resume=True, progress=False)


# ---- what is shown, and what importing costs -------------------------------------------------------------------------


def test_a_notebook_shows_one_line_in_its_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []

    class Handle:
        def update(self, page: dict[str, str], raw: bool) -> None:
            assert raw
            shown.append(page["text/plain"])

    def display(page: dict[str, str], raw: bool, display_id: bool) -> Handle:
        assert page["text/plain"] == ""
        assert raw
        assert display_id
        return Handle()

    fake, inside = types.ModuleType("IPython"), types.ModuleType("IPython.display")
    fake.get_ipython = lambda: types.SimpleNamespace(kernel=object())  # type: ignore[attr-defined]
    inside.display = display  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "IPython", fake)
    monkeypatch.setitem(sys.modules, "IPython.display", inside)
    monkeypatch.setattr(progress, "_SECONDS", 0.0)
    space_dist.train(config_for(tmp_path, learner_section("ppo")), out=tmp_path / "run")
    assert len(shown) >= 6
    assert shown[-1].startswith("tiny s0  240/240 steps (100%)")
    shown.clear()
    space_dist.train(config_for(tmp_path, learner_section("ppo")), out=tmp_path / "other", progress=False)
    assert shown == []


def test_names_are_there_and_nothing_is_imported_before_one_is_asked_for() -> None:
    assert set(space_dist.__all__) <= set(dir(space_dist))
    for name in space_dist.__all__:
        assert getattr(space_dist, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        space_dist.trian  # noqa: B018
    code = (
        "import sys; before = set(sys.modules); import space_dist; "
        "new = {name.partition('.')[0] for name in set(sys.modules) - before} - set(sys.stdlib_module_names); "
        "print(sorted(name for name in new if not name.startswith('_')))"
    )
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=PATIENCE, env=environment
    )  # fmt: skip
    assert done.stdout.strip() == "['space_dist']", done.stderr


def test_a_rate_that_cannot_be_told_yet_is_a_dash() -> None:
    known = Progress(2048, 4096, 5012.3, 4, 100)
    assert "  5,012/s  set 4/100" in progress.line_of_run("pointmass_space", 0, known)
    assert "  —/s  set 4/100" in progress.line_of_run(
        "pointmass_space", 0, dataclasses.replace(known, steps_per_second=0.0)
    )


def test_how_far_a_run_is_goes_by_the_limit_that_is_nearer() -> None:
    known = Progress(1000, 60_000, 500.0, 1, 3, episodes=25, budget_episodes=100)
    assert "  1,000/60,000 steps, 25/100 episodes (25%)" in progress.line_of_run("cartpole", 0, known)
    assert known.share == 0.25
    assert dataclasses.replace(known, episodes=102).share == 1.0
    assert dataclasses.replace(known, steps=30_000).share == 0.5


def test_time_left_is_told_once_rounds_of_some_seconds_tell_it() -> None:
    left = TimeLeft()
    assert left.after(0.5, 100.0) is None  # however far it went on from, and however long that took
    assert left.after(0.6, 130.0) is None  # one round says little
    assert left.after(0.7, 160.0) == pytest.approx(90.0)
    assert left.after(1.0, 250.0) is None
    quick = TimeLeft()
    told = [quick.after(0.001 * number, 0.1 * number) for number in range(1, 101)]
    assert told[:50] == [None] * 50
    assert told[60:] == pytest.approx([0.1 * (1000 - number) for number in range(61, 101)])


def test_time_left_goes_by_the_last_minute() -> None:
    left = TimeLeft()
    for second in range(101):  # as of a learner that only collects at first
        left.after(0.005 * second, float(second))
    told = [left.after(0.5 + 0.001 * second, 100.0 + second) for second in range(1, 101)]
    assert told[-1] == pytest.approx(400.0)
    slow = TimeLeft()
    assert [slow.after(0.1 * number, 1000.0 * number) for number in range(1, 6)][-1] == pytest.approx(5000.0)
