"""The parts of `jobs/benchmark.py throughput` whose faults would show in no number."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from space_dist.envs import make_batched
from space_dist.envs.pointmass import BOUNDS as POINTMASS_BOUNDS
from space_dist.envs.pointmass import START, BatchedPointMass
from space_dist.errors import SpaceDistError
from tests.grids import ROOT
from tests.patience import PATIENCE

sys.path.append(str(ROOT / "jobs"))

import benchmark
from benchmarks.batched_vec_env import BatchedVecEnv
from benchmarks.contenders import TASKS, Contender, specification
from benchmarks.pic import _shown
from benchmarks.throughput import PAIRS, WANTED, Row, _markdown, _ratio, _searched, fastest, process
from benchmarks.tune import _fastest_stock

LINE = "tests.tiny_env:make"


def row(*rates: float, **waits: float) -> Row:
    return Row("somebody", "somehow", lambda: {"rate": 0.0}, waits, 0.002, list(rates))


def test_our_batched_environments_step_in_stable_baselines3s_interface_as_by_themselves() -> None:
    contexts = np.array([[-0.5], [0.25]])
    ours = BatchedVecEnv(make_batched(LINE, 3, context_visible=True), contexts, seed=4)
    plain, random = make_batched(LINE, 3, context_visible=True), np.random.default_rng(4)

    def start(slots: Any) -> Any:
        drawn = contexts[random.integers(2, size=len(slots))]
        return plain.reset(slots, drawn, random.integers(1 << 62, size=len(slots), dtype=np.uint64))

    np.testing.assert_array_equal(ours.reset(), start(np.arange(3)))
    ends, actions = 0, np.random.default_rng(0)
    for _ in range(3 * plain.horizon):
        action = actions.uniform(-1.0, 1.0, size=(3, *plain.action_space.shape)).astype(np.float32)
        observations, rewards, dones, infos = ours.step(action)
        step = plain.step(action)
        np.testing.assert_array_equal(dones, step.terminated | step.truncated)
        np.testing.assert_allclose(rewards, step.rewards, rtol=1e-6)
        expected = step.observations.copy()
        slots = np.flatnonzero(dones)
        for slot in slots:
            np.testing.assert_array_equal(infos[slot]["terminal_observation"], step.observations[slot])
            assert infos[slot]["TimeLimit.truncated"] == (step.truncated[slot] and not step.terminated[slot])
        assert all("terminal_observation" not in info for info, done in zip(infos, dones, strict=True) if not done)
        if len(slots):
            expected[slots] = start(slots)
        np.testing.assert_array_equal(observations, expected)
        ends += len(slots)
    assert ends >= 9


def test_batched_environments_take_instances_in_turn_from_the_first_at_every_reset() -> None:
    contexts = np.array([[-0.5], [0.25], [0.75]])
    env = BatchedVecEnv(make_batched(LINE, 2, context_visible=True), contexts, seed=0, in_turn=True)
    still = np.zeros((2, *env.action_space.shape), dtype=np.float32)
    for _ in range(2):
        found = [env.reset()[:, -1]]
        for _ in range(3):
            dones = np.zeros(2, dtype=np.bool_)
            while not dones.any():
                observations, _, dones, _ = env.step(still)
            assert dones.all()
            found.append(observations[:, -1])
        np.testing.assert_allclose(np.concatenate(found), [-0.5, 0.25, 0.75, -0.5, 0.25, 0.75, -0.5, 0.25])


def test_ratios_are_medians_of_the_rounds_own() -> None:
    # A machine that slows down to a tenth after the first round slows both.
    assert _ratio(row(400.0, 40.0, 30.0), row(100.0, 10.0, 10.0)) == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("throughput", "--settings", "damaged.json"), "damaged.json is no file of settings"),
        (("throughput", "--settings", "list.json"), "list.json is no file of settings"),
        (("throughput", "--settings", "folder"), "folder is a folder; name a file"),
        (("throughput", "--out", "list.json"), "list.json is no folder"),
        (("throughput", "--json", "nowhere/a.json"), "there is no folder"),
        (("coverage", "--json", "folder"), "folder is a folder; name a file"),
        (("equivalence", "--root", "list.json"), "list.json is no folder"),
        (("equivalence", "--curriculum", "roundrobin"), "did you mean 'round_robin'?"),
    ],
)
def test_what_cannot_be_kept_is_said_before_anything_is_measured(
    words: Sequence[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("benchmarks.throughput.not_installed", lambda: pytest.fail("it went on"))
    monkeypatch.setattr("benchmarks.equivalence._Arms", lambda *_: pytest.fail("it went on"))
    (tmp_path / "damaged.json").write_text("{bad")
    (tmp_path / "list.json").write_text("[1, 2]")
    (tmp_path / "folder").mkdir()
    with pytest.raises(SystemExit) as ended:
        typer.main.get_command(benchmark.app)(list(words), prog_name="benchmark.py")
    assert ended.value.code == 2
    assert said in " ".join(capsys.readouterr().err.replace("│", " ").split())


def test_one_seed_has_no_standard_error() -> None:
    assert (_shown([2.0]), _shown([1.0, 3.0])) == ("2.00 (—)", "2.00 (1.00)")


def test_what_was_found_once_is_not_searched_again(tmp_path: Path) -> None:
    file, searches = tmp_path / "settings.json", []

    def search() -> dict[str, Contender]:
        searches.append(1)
        return {"lean": Contender("ours", update="lean", slots=64, overrides=("a=1",))}

    found = _searched("pointmass", file, search)
    assert found == search()
    assert found["lean"].setting == "one process, 64 slots"
    assert _searched("pointmass", file, search) == found
    assert len(searches) == 2
    _searched("cartpole", file, search)
    assert len(searches) == 3
    assert _searched("pointmass", None, search) == found
    assert len(searches) == 4


def test_the_table_says_who_is_missing_and_where_time_goes() -> None:
    rows = {"subproc2": row(100.0), "lean": row(400.0, simulator=1e-3, arithmetic=5e-4)}
    text = _markdown({"cartpole": rows, "population": rows}, {"lean_vs_rllib": 4.0}, {}, 1, ["rllib", "jax", "sbx"])
    assert "| somebody | somehow | 400 (400-400) | 4.0 | 80% | simulator 40%, dispatch 40%, arithmetic 20% |" in text
    cartpole, population = text.split("**PointMass")
    missing = "| not installed (extra `bench`) | | | | |"
    assert [f"| {name} {missing}" in cartpole for name in ("RLlib", "JAX", "SBX")] == [True, False, True]
    assert [f"| {name} {missing}" in population for name in ("RLlib", "JAX", "SBX")] == [False, True, True]
    assert "| `lean_vs_rllib` | 4.00 | 3 |" in text


@pytest.mark.parametrize("name", TASKS)
def test_the_tasks_differ_in_nothing_but_what_they_say(name: str) -> None:
    task = TASKS[name]
    learner = task.run_config("learner.update=lean").learner
    assert (learner.kind, learner.n_steps, learner.net_arch) == ("ppo", task.n_steps, (64, 64))
    assert (learner.batch_size, learner.n_epochs) == (task.batch_size, 10)
    assert name in specification(name, Contender("ours"), 1.0)


def test_what_does_not_finish_is_no_speed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    rates = {16: 0.0, 64: 250.0}
    monkeypatch.setattr(
        "benchmarks.throughput.measured", lambda task, contender, *_, **__: {"rate": rates[contender.n_envs]}
    )
    tried = [Contender("sb3", vec_env="batched", n_envs=n) for n in rates]
    assert fastest("cartpole", tried, 0.5) is tried[1]
    said = capsys.readouterr().out
    assert "(16), 1 torch thread: none finished\n" in said
    assert "(64), 1 torch thread: 250 steps/s\n" in said
    told = ["is tried, for 60 s at most", "none finished"], ["is tried, for 60 s at most", "250 steps/s"]
    assert [line.rpartition(": ")[2] for line in said.splitlines()] == [*told[0], *told[1]]
    rates[64] = 0.0
    with pytest.raises(
        SpaceDistError, match=r"cartpole: of 2 settings that were tried none finished .* a shorter --seconds"
    ):
        fastest("cartpole", tried, 0.5)
    with pytest.raises(SpaceDistError, match=r"do, or say which of 16 and 64 it is with --n-envs$"):
        _fastest_stock()  # of `tune`, which has no --seconds


def test_a_ratio_leaves_out_rounds_that_the_rival_did_not_finish() -> None:
    never, once, lean = row(0.0, 0.0, simulator=1.0), row(0.0, 100.0), row(400.0, 300.0)
    assert (_ratio(lean, never), _ratio(lean, once), _ratio(never, lean)) == (None, 3.0, 0.0)
    text = _markdown({"cartpole": {"subproc2": never, "lean": lean}}, {}, {}, 2, [])
    assert "| somebody | somehow | none finished | — | 0% |  |" in text
    assert "| somebody | somehow | 350 (300-400) | — | 70% |" in text


def test_every_ratio_has_a_goal() -> None:
    assert PAIRS.keys() == WANTED.keys()


def test_what_compiling_takes_is_told_apart() -> None:
    measured = Row("somebody", "somehow", lambda: {"rate": 10.0, "compile": 7.5}, {})
    measured.take()
    assert (measured.rates, measured.chosen) == ([10.0], "somehow; 7.5 s to compile")


def test_another_checkout_runs_its_own_code(tmp_path: Path) -> None:
    package = tmp_path / "old" / "space_dist"
    shutil.copytree(ROOT / "space_dist", package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / "envs" / "pointmass.py").write_text("raise RuntimeError('this is the other one')")
    asked = specification("pointmass", Contender("ours"), 0.1)
    with pytest.raises(SpaceDistError, match="this is the other one"):
        process(asked, Contender("ours").first, str(tmp_path / "old"))
    nothing = Contender("ours", checkout=str(tmp_path / "nothing"))
    with pytest.raises(SpaceDistError, match="holds no space_dist"):
        process(specification("pointmass", nothing, 0.1), nothing.first, nothing.checkout)


def test_jaxs_point_masses_go_where_ours_do() -> None:
    jax = pytest.importorskip("jax")
    pytest.importorskip("optax")
    from benchmarks import jitted

    slots, random = 64, np.random.default_rng(3)
    ours = BatchedPointMass(slots)
    contexts = random.uniform(POINTMASS_BOUNDS.low, POINTMASS_BOUNDS.high, (slots, 3)).astype(np.float32)
    ours.reset(np.arange(slots), contexts.astype(np.float64), np.arange(slots, dtype=np.uint64))
    noise = np.stack([np.random.default_rng(seed).standard_normal((100, 10, 2)) for seed in range(slots)])
    body = np.tile(START, (slots, 1)).astype(np.float32)
    state, going = jitted.State(body, contexts, np.zeros(slots, np.int32)), np.ones(slots, dtype=bool)
    crashed, truncated, jitted_step = 0, 0, jax.jit(jitted.step)
    for moment in range(ours.horizon):
        actions = random.uniform(-12.0, 6.0, (slots, 2)).astype(np.float32)
        step = ours.step(actions)
        state, rewards, crashes, ends = jitted_step(state, actions, noise[:, moment].astype(np.float32))
        np.testing.assert_array_equal(np.asarray(crashes)[going], step.terminated[going])
        np.testing.assert_array_equal(np.asarray(ends)[going], step.truncated[going])
        np.testing.assert_allclose(np.asarray(rewards)[going], step.rewards[going], atol=1e-3)
        np.testing.assert_allclose(np.asarray(state.body)[going], step.observations[going], atol=2e-3)
        crashed, truncated = crashed + int(step.terminated[going].sum()), truncated + int(step.truncated[going].sum())
        going &= ~(step.terminated | step.truncated)
    assert crashed
    assert truncated


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_an_ended_benchmark_leaves_no_process_behind(number: signal.Signals, tmp_path: Path) -> None:
    name, value = "SPACE_DIST_TEST", str(tmp_path)

    def marked() -> set[int]:
        found = set()
        for folder in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                if f"{name}={value}".encode() in (folder / "environ").read_bytes():
                    found.add(int(folder.name))
        return found

    code = (
        # A shell has what it starts in the background ignore SIGINT, and so what that starts.
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler);"
        "import runpy, sys; import benchmarks.throughput as t; t.not_installed = lambda: ['rllib', 'jax', 'sbx'];"
        "sys.argv = ['benchmark.py', 'throughput', '--only', 'pointmass', '--seconds', '600'];"
        f"runpy.run_path({str(ROOT / 'jobs/benchmark.py')!r}, run_name='__main__')"
    )
    environment = {**os.environ, name: value, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'jobs'}"}
    process = subprocess.Popen(
        [sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    try:
        deadline = time.monotonic() + PATIENCE
        while len(marked()) < 2 and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.1)
        process.send_signal(number)
        said, _ = process.communicate(timeout=PATIENCE)
        assert process.returncode == 128 + number, said
        assert marked() == set()
    finally:
        for pid in marked():
            os.kill(pid, signal.SIGKILL)
