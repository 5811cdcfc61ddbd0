"""How much a curriculum could save: counted by hand, and measured by the command."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from space_dist.api.headroom import measure_headroom
from space_dist.curricula import Draws
from space_dist.curricula.watching import Watched, WatchedState
from space_dist.errors import ConfigError
from space_dist.report.headroom import evenness, in_words, measured, signal, table, verdict
from tests.commanding import Typed, command
from tests.shell import Shell, bash_blocks, one_server
from tests.test_rivals import feedback, instances

ROOT = Path(__file__).resolve().parent.parent
SPARSE = ROOT / "configs/sparse_pointmass_round_robin.yaml"


def state(
    episodes: Any, successes: Any, sizes: Any = None, failed: tuple[float, float] = (0.0, 0.0), *, known: bool = True
) -> WatchedState:
    episodes = np.array(episodes)
    sizes = np.zeros(episodes.shape) if sizes is None else np.array(sizes)
    return WatchedState(
        1,
        np.ones(episodes.shape[1]),
        episodes,
        np.array(successes),
        sizes,
        np.array(failed),
        np.array([0.0, 1.0]),
        known,
    )


def test_signal_by_hand() -> None:
    # 4 s (m - s) / (m (m - 1)): 4 * 1 * 3 / 12 = 1; 0 of 4: 0; one episode says nothing; 1 of 2: 4 * 1 / 2 = 2.
    episodes = np.array([[4, 4, 1], [2, 0, 2], [0, 1, 0]])
    successes = np.array([[1, 0, 1], [1, 0, 2], [0, 0, 0]])
    found = signal(episodes, successes)
    assert found[:2].tolist() == [0.5, 1.0]
    assert np.isnan(found[2])


def test_signal_expects_the_truth() -> None:
    """Unbiased for any number of episodes: over many draws its mean is 4 p (1 - p)."""
    random = np.random.default_rng(0)
    for p in (0.1, 0.5):
        for m in (2, 5):
            found = signal(np.full((1, 20_000), m), random.binomial(m, p, size=(1, 20_000)))
            assert abs(found[0] - 4 * p * (1 - p)) < 0.03


def test_evenness_by_hand() -> None:
    # Means 1 and 1: even. Means 3 and 1: 16 / (2 * 10). One that was not played counts for nothing. No advantages: NaN.
    episodes = np.array([[2, 1, 0], [1, 1, 0], [1, 1, 1], [1, 0, 0]])
    sizes = np.array([[2.0, 1.0, 0.0], [3.0, 1.0, 0.0], [0.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    found = evenness(episodes, sizes)
    assert found[[0, 1, 3]].tolist() == [1.0, 0.8, 1.0]
    assert np.isnan(found[2])


def test_shares_and_first_successes_by_hand() -> None:
    one = state([[4, 2], [2, 2]], [[0, 0], [1, 2]])
    none = state([[4, 2], [2, 2]], [[0, 0], [0, 0]])
    found = measured([one, none], 1000)
    assert found.solved.tolist() == [[0.0, 0.75], [0.0, 0.0]]
    assert found.never.tolist() == [[1.0, 0.0], [1.0, 1.0]]
    assert found.always.tolist() == [[0.0, 0.5], [0.0, 0.0]]
    assert found.first[0] == 1000
    assert np.isnan(found.first[1])
    assert found.failures is None
    assert [row["steps"] for row in table(found)] == ["500", "1,000"]
    assert [row["success"] for row in table(found)] == ["0%", "38%"]


def test_words() -> None:
    even = [state([[4] * 40], [[2] * 40]) for _ in range(3)]
    assert verdict(measured(even, 10)).startswith("Most of what is drawn teaches:")
    rare = [state([[4] * 40], [[0, 4] * 20]) for _ in range(3)]
    assert verdict(measured(rare, 10)).startswith("In no part of the run draws had more than 0% of the signal")
    solved = [state([[4] * 40] * 3, [[0] * 40, [2] * 40, [4] * 40]) for _ in range(3)]
    assert "draws had 100% of the signal: on a world with such a part" in verdict(measured(solved, 10))
    few = [state([[4, 4]], [[2, 2]]) for _ in range(3)]  # at even odds, and far too few to say so
    assert verdict(measured(few, 10)).startswith("There are 2 instances, and fewer than 30 are too few")
    assert verdict(measured([state([[4] * 40], [[0] * 40])], 10)).startswith("Nothing succeeded")
    never = in_words(measured([state([[4, 4]], [[0, 0]])], 10))
    assert len(never) == 1
    assert "Nothing succeeded in 10 steps" in never[0]
    # Failures are paid: they teach, and outcomes bound nothing, whatever they say.
    dense = [state([[4, 4]], [[0, 4]], [[4.0, 4.0]], (0.0, 0.5)) for _ in range(3)]
    assert "have returns from 0 to 0.5" in in_words(measured(dense, 10))[0]
    assert verdict(measured(dense, 10)).startswith("Most of what is drawn teaches:")
    uneven = [state([[4, 4, 4]], [[0, 0, 4]], [[12.0, 0.0, 0.0]], (0.0, 0.5)) for _ in range(3)]
    assert verdict(measured(uneven, 10)).startswith(
        "Advantages differ from instance to instance, which promises nothing"
    )
    unknown = [state([[4, 4]], [[0, 0]], known=False)]
    assert verdict(measured(unknown, 10)).startswith("Neither")


def test_a_bound_is_said_where_enough_instances_were_judged_in_every_part() -> None:
    played, unplayed = [4] * 40, [4] * 20 + [1] * 20
    won = {True: [2] * 40, False: [2] * 20 + [0] * 20}
    for enough, said in [
        ((True, True), "Uniform draws gave 100% (IQM over seeds) of the signal that draws at even odds"),
        (
            (True, False),
            "In the 1 of 2 parts of the run in which 30 instances had two episodes, uniform draws gave 100%",
        ),
        ((False, False), "The first success fell within"),
    ]:
        runs = [state([played if one else unplayed for one in enough], [won[one] for one in enough]) for _ in range(3)]
        words = in_words(measured(runs, 10))
        assert words[0].startswith(said)
        assert ("no curriculum over these instances can need less" in " ".join(words)) == all(enough)
        assert ("these runs are too short to say what a curriculum could save" in words[-1]) == (not any(enough))


def test_what_is_watched_by_hand() -> None:
    curriculum = Watched(instances(4), seed=0, draws=Draws(8, 2), iterations=4, shares=2, advantages=True)
    now, _ = curriculum.start()
    for version, (indices, won) in enumerate([([0, 0, 2], [1, 0, 0]), ([1], [1]), ([2], [0])]):
        told = feedback(version, indices, returns=np.arange(len(indices)) - 1.0, advantages=np.full(len(indices), 0.5))
        assert told.episodes is not None
        told.episodes.success[:] = won
        now, _, numbers = curriculum.step(now, told)
        assert numbers["size"] == len({*indices})
    assert now.episodes[:, :3].tolist() == [[2, 1, 1], [0, 0, 1]]
    assert now.successes[:, :3].tolist() == [[1, 1, 0], [0, 0, 0]]
    assert now.sizes[:, :3].tolist() == [[1.0, 0.5, 0.5], [0.0, 0.0, 0.5]]
    assert (now.failed.tolist(), now.every.tolist(), now.knows_success) == ([-1.0, 1.0], [-1.0, 1.0], True)


def test_the_command_measures(tmp_path: Path, type_in: Typed) -> None:
    asked = (SPARSE, "--seeds", 2, "--steps", 8192, "--out", tmp_path / "out")
    done = type_in("headroom", *asked, "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert len(found["shares"]) == 4  # updates, of 2,048 steps each
    with (tmp_path / "out/instances.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 100
    assert sum(int(row["episodes"]) for row in rows) > 100
    assert (tmp_path / "out/headroom.png").stat().st_size > 10_000
    kept = (tmp_path / "out/instances.csv").read_bytes()
    again = type_in("headroom", *asked)  # from what is there
    assert again.returncode == 0, again.stderr
    assert " ".join(found["words"]) in " ".join(again.stdout.split())
    assert (tmp_path / "out/instances.csv").read_bytes() == kept


def test_the_page_is_typed_from_its_first_block_to_its_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In small: budgets, seeds and where it forks; all else as it stands."""
    clone = tmp_path / "clone"
    shell = Shell(clone, monkeypatch)
    for name in ("sparse_pointmass_round_robin", "sparse_pointmass_procurl"):
        data = yaml.safe_load((ROOT / f"configs/{name}.yaml").read_text())
        data["budget"]["steps"], data["evaluation"]["every_steps"], data["tracking"] = 8192, 8192, {"uri": None}
        (clone / f"configs/{name}.yaml").write_text(yaml.safe_dump(data))
    monkeypatch.chdir(clone)
    script = "\n".join(bash_blocks("causes.md")).replace("100000", "4096").replace("200000", "8192")
    assert script.count("space-dist ") == 6
    with one_server():
        shell.run(script, {"--seeds 5": "--seeds 2"}, answer=lambda words: command(monkeypatch, *words[1:]))
    assert len(shell.typed) == 6
    said = capsys.readouterr().out
    assert any(one in " ".join(said.split()) for one in ("niform draws gave", "too short to say", "Nothing succeeded"))
    assert "6 runs, bit for bit the same" in " ".join(said.split())
    assert (clone / "runs/yoked/recorded.npz").exists()
    assert (clone / "runs/sparse_pointmass_procurl_s0_from_4096/report/report.md").exists()


def test_learners_without_advantages_have_outcomes(tmp_path: Path) -> None:
    found = measure_headroom(
        ROOT / "configs/cartpole_dqn_space.yaml", out=tmp_path, steps=2000, seeds=1, progress=False,
        overrides=["learner.learning_starts=100"],
    )  # fmt: skip
    assert np.isnan(found.headroom.evenness).all()
    assert found.headroom.signal.shape == (1, 1)
    assert not np.isnan(found.headroom.solved).any()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["none.yaml"], "none.yaml"),
        ([SPARSE, "--steps", "100"], "budget.steps"),
        ([SPARSE, "--set", "learner.n_step=5"], "did you mean 'n_steps'"),
    ],
)
def test_what_cannot_be_measured_is_said(words: list[Any], said: str, tmp_path: Path, type_in: Typed) -> None:
    done = type_in("headroom", *words)
    assert done.returncode == 2
    assert said in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "runs").exists()


def test_several_policies_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="aggregate: population"):
        measure_headroom(
            ROOT / "configs/pointmass_space.yaml", out=tmp_path / "out", progress=False,
            overrides=["engine=population", "curriculum.aggregate=population", "learner.update=stock"],
        )  # fmt: skip
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"seeds": [0, 1]}, r"seeds must be a whole number from 1 to 1,000, not \[0, 1\]"),
        ({"seeds": 0}, "seeds must be a whole number from 1 to 1,000, not 0"),
        ({"seeds": True}, "seeds must be a whole number from 1 to 1,000, not True"),
        ({"steps": "4096"}, "steps must be a whole number from 1, not '4096'"),
        ({"steps": 2.5}, "steps must be a whole number from 1, not 2.5"),
        ({"overrides": ["instances.train=none.csv"]}, "none.csv"),
    ],
)
def test_wrong_arguments_are_named_and_leave_nothing(asked: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=said):
        measure_headroom(SPARSE, out=tmp_path / "out", progress=False, **asked)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"status.json": "{}", "config.yaml": "name: mine\n"}, "already holds a run: --out DIR measures in another"),
        ({"manifest.json": "{}"}, "already holds a grid:"),
        ({"config.yaml": "name: mine\n"}, "already holds a config.yaml, of no measurement:"),
    ],
)
def test_what_lies_in_its_folder_is_not_written_over(
    files: dict[str, str], said: str, tmp_path: Path, type_in: Typed
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    for name, content in files.items():
        (out / name).write_text(content)
    done = type_in("headroom", SPARSE, "--seeds", 1, "--steps", 4096, "--out", out)
    assert done.returncode == 2
    assert said in " ".join(done.stderr.split())
    assert {file.name: file.read_text() for file in out.iterdir()} == files


def test_the_measurement_of_another_config_is_kept_and_longer_runs_are_not_another(tmp_path: Path) -> None:
    def measure(steps: int, *changes: str) -> None:
        measure_headroom(SPARSE, out=tmp_path, steps=steps, seeds=1, progress=False, overrides=changes)

    measure(2048)
    kept = (tmp_path / "instances.csv").read_bytes()
    with pytest.raises(ConfigError, match=r"measurement of another config, with another learner.gamma: --out DIR"):
        measure(2048, "learner.gamma=0.9")
    assert (tmp_path / "instances.csv").read_bytes() == kept
    measure(4096)
    assert (tmp_path / "instances.csv").read_bytes() != kept
