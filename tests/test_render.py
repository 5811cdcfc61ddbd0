"""What `space-dist render` draws is what the policy does."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mlflow import MlflowClient
from numpy.typing import NDArray
from PIL import Image, ImageSequence

from space_dist import config as configs
from space_dist.envs import make_batched
from space_dist.envs.layouts import carve, placed
from space_dist.envs.mixed_maze import draw
from space_dist.errors import ConfigError
from space_dist.instances import InstanceSet
from space_dist.ledger import CURRICULUM, METRICS, TIMING, Ledger, RunWriter, Status
from space_dist.rollout import Worker
from space_dist.rollout.policy import MlpPolicy, to_arrays
from space_dist.run.building import Blueprint, spec_of
from space_dist.run.launch import policy_of
from space_dist.run.render import END_MILLISECONDS, MAX_FRAMES, draw_run
from space_dist.tracking import drawing, sync
from tests.commanding import command
from tests.test_report import finished_run, written

BLUE, GREEN, RED = (0, 114, 178), (0, 158, 115), (213, 94, 0)


def run_of(
    folder: Path, env_id: str, train: NDArray[np.float64], test: NDArray[np.float64],
    bias: list[float] | None = None, **settings: Any,
) -> Ledger:  # fmt: skip
    """A run as its folder shows it, whose policy always does what `bias` says (or what its initial network says)."""
    ids = np.arange(len(train) + len(test))
    names = make_batched(env_id, 1, context_visible=False, kwargs=settings.get("kwargs", {})).context_bounds.names
    sets = InstanceSet(ids[: len(train)], train, names), InstanceSet(ids[len(train) :], test, names)
    data = {
        "name": "drawn", "env": {"id": env_id, **settings}, "instances": {"train": "instances_train.csv",
        "test": "instances_test.csv"}, "curriculum": {"kind": "round_robin"}, "learner": {"kind": "ppo"},
        "rollout": {"shards": 1, "slots": 1}, "budget": {"steps": 2048}, "tracking": {"uri": None},
    }  # fmt: skip
    config = configs.parse(data, "test")
    policy = Blueprint.of(config).learner().policy(0)
    assert isinstance(policy, MlpPolicy)
    if bias is not None:
        matrix, _ = policy.actor[-1]
        policy = dataclasses.replace(policy, actor=(*policy.actor[:-1], (matrix * 0, np.array(bias, dtype=np.float32))))
    ledger = Ledger(folder)
    with RunWriter(ledger) as writer:
        writer.write_config(configs.dump(config), sets[0].to_csv(), sets[1].to_csv())
        status = Status("running", "drawn", 0, 0, 2048, 0, started_at=1.0, updated_at=1.0)
        writer.set_status(status)
        writer.write_model(*to_arrays(policy))
        writer.set_status(dataclasses.replace(status, state="done"))
    return ledger


def frames(path: Path) -> list[NDArray[np.uint8]]:
    with Image.open(path) as image:
        return [np.array(frame.convert("RGB")) for frame in ImageSequence.Iterator(image)]


def centre(frame: NDArray[np.uint8], colour: tuple[int, int, int]) -> tuple[float, float]:
    """The mean column and row of the largest blob's worth of a colour, as shares of the picture's sides."""
    rows, columns = np.nonzero((np.abs(frame.astype(int) - colour) < 25).all(axis=2))
    assert len(rows) > 20
    return float(columns.mean() / frame.shape[1]), float(rows.mean() / frame.shape[0])


@pytest.fixture(scope="module")
def corridor(tmp_path_factory: pytest.TempPathFactory) -> Ledger:
    """Instance 0 is a corridor east and then south; the policy always goes east. Others are carved."""
    layout = np.zeros((1, 25))
    layout[0, :4] = 2.0
    layout[0, [4, 9, 14, 19]] = 4.0
    mazes = carve(np.random.default_rng(0), 8)
    return run_of(
        tmp_path_factory.mktemp("runs") / "corridor", "space_dist/Maze-v0", np.vstack([layout, mazes[:3]]), mazes[3:],
        bias=[0.0, 0.0, 5.0, 0.0], kwargs={"horizon": 24},
    )  # fmt: skip


def test_a_walk_is_drawn_where_it_goes(corridor: Ledger, tmp_path: Path) -> None:
    before = {file: file.read_bytes() for file in corridor.folder.iterdir() if file.is_file()}
    written = draw_run(corridor, tmp_path / "a", [0])
    path, what = written[0]
    assert path.name == "train_0.gif"
    assert what == "train instance 0: return -0.096 of 0.972, no success, 24 steps"
    shown = frames(path)
    columns, rows = zip(*(centre(frame, BLUE) for frame in shown), strict=True)  # of the way, and of who goes it
    assert columns[0] < 0.2
    assert np.ptp(rows) < 0.02  # east along the first row
    assert columns[0] < columns[1] < columns[2] < columns[4] < 0.95
    assert columns[4:] == columns[4:5] * (len(shown) - 4)  # and against the wall
    assert (np.abs(shown[-1].astype(int) - RED) < 25).all(axis=2).any()  # "no success", in red
    assert not (np.abs(shown[0].astype(int) - RED) < 25).all(axis=2).any()
    assert [file.name for file, _ in written[1:]] == ["trajectories_train.png", "trajectories_test.png"]
    again = draw_run(corridor, tmp_path / "b", [0])
    assert [file.read_bytes() for file, _ in again] == [file.read_bytes() for file, _ in written]
    assert {file: file.read_bytes() for file in corridor.folder.iterdir() if file.is_file()} == before


def test_episodes_are_those_of_the_runs_evaluation(tmp_path: Path) -> None:
    contexts = np.array([[0.0, 8.0, 1.0], [1.0, 4.0, 0.0], [-1.0, 6.0, 3.0], [3.0, 1.0, 0.0]])
    ledger = run_of(tmp_path / "run", "space_dist/PointMass-v0", contexts[:2], contexts[2:], bias=[0.3, -5.0],
                    kwargs={"horizon": 30})  # fmt: skip
    config = configs.load(ledger.config)
    names = ("gate_x", "gate_width", "friction")
    sets = [InstanceSet(np.arange(2) + start, contexts[start : start + 2], names) for start in (0, 2)]
    spec = spec_of(config)
    worker = Worker(Blueprint(config, spec).setup(*sets))
    expected = {split: worker.evaluate(policy_of(ledger, spec), split, 0) for split in ("train", "test")}
    written = draw_run(ledger, tmp_path / "pictures", [3, 0, 1, 2])
    for (path, what), (split, place) in zip(
        written, [("test", 1), ("train", 0), ("train", 1), ("test", 0)], strict=False
    ):
        outcome = expected[split]
        assert f"return {outcome.returns[place]:.4g}," in what
        assert f"{outcome.lengths[place]} steps" in what
        assert len(frames(path)) <= outcome.lengths[place] + 1
    crashed = written[0][1]
    assert "no success" in crashed
    assert [path.name for path, _ in written[4:]] == ["trajectories_train.png", "trajectories_test.png"]
    with Image.open(written[-1][0]) as image:
        picture = np.array(image.convert("RGB"))
    for colour in (BLUE, RED):  # ways, and a crash at the wall
        assert (np.abs(picture.astype(int) - colour) < 25).all(axis=2).sum() > 30


def test_a_pole_is_as_long_as_its_context_says(tmp_path: Path) -> None:
    lengths = np.array([[0.2], [0.9], [0.5], [0.6]])
    ledger = run_of(tmp_path / "run", "space_dist/CartPole-v0", lengths[:2], lengths[2:], bias=[5.0, 0.0])
    written = draw_run(ledger, tmp_path / "pictures", [0, 1])
    assert [path.name for path, _ in written] == ["train_0.gif", "train_1.gif"]  # and no trajectories
    short, long = (np.ptp(np.nonzero((np.abs(frames(path)[0].astype(int) - BLUE) < 25).all(axis=2))[0])
                   for path, _ in written)  # fmt: skip
    assert 3.0 < long / short < 5.5
    assert (np.abs(frames(written[0][0])[-1].astype(int) - RED) < 25).all(axis=2).any()  # fell


def test_a_walk_up_the_corridor_is_drawn(tmp_path: Path) -> None:
    """The policy always goes up: to the first goal, and past the others."""
    contexts = np.array([[-6.0, 6.0, 3.0], [6.0, 6.0, 0.5], [0.0, 0.0, 1.0], [-9.0, -9.0, 0.05]])
    ledger = run_of(tmp_path / "run", "space_dist/GoalMaze-v0", contexts[:2], contexts[2:], bias=[0.0, 5.0],
                    kwargs={"horizon": 60})  # fmt: skip
    written = draw_run(ledger, tmp_path / "pictures", [0, 1])
    assert "train instance 0: return 1, success" in written[0][1]
    assert "train instance 1: return 0, no success, 60 steps" in written[1][1]
    shown = frames(written[1][0])
    columns, rows = zip(*(centre(frame, BLUE) for frame in shown), strict=True)
    assert np.ptp(columns) < 0.03
    assert rows[0] > rows[5] > rows[20] > rows[-1]
    dark = (shown[0].max(axis=2) < 60).mean()
    assert 0.3 < dark < 0.7  # the block and what is outside of the walls
    assert [path.name for path, _ in written[2:]] == ["trajectories_train.png", "trajectories_test.png"]


def test_a_small_maze_fills_its_picture(tmp_path: Path) -> None:
    """Of side 3, a corridor east and then south; the policy always goes east."""
    layout = np.zeros((1, 9))
    layout[0, [0, 1, 2, 5]] = [2.0, 2.0, 4.0, 4.0]
    small = np.column_stack(([3.0], placed(layout, 11)))
    others = draw(np.random.default_rng(0), 3)
    ledger = run_of(tmp_path / "run", "space_dist/MixedMaze-v0", np.vstack([small, others[:1]]), others[1:],
                    bias=[0.0, 0.0, 5.0, 0.0], kwargs={"horizon": 8})  # fmt: skip
    written = draw_run(ledger, tmp_path / "pictures", [0])
    assert written[0][1] == "train instance 0: return -0.08889 of 0.9667, no success, 8 steps"
    columns = [centre(frame, BLUE)[0] for frame in frames(written[0][0])]
    assert columns[0] < 0.25
    assert columns[0] < columns[1] < columns[2]
    assert columns[2] > 0.45  # on the way from the left to the right wall
    assert [path.name for path, _ in written[1:]] == ["trajectories_train.png", "trajectories_test.png"]


def test_an_environment_that_draws_itself(tmp_path: Path) -> None:
    gains = np.array([[0.2, 0.0], [0.4, 0.1], [0.3, -0.1]])
    ledger = run_of(tmp_path / "run", "tests.faulty_env:Honest", gains[:2], gains[2:], bias=[0.0, 0.0, 5.0])
    written = draw_run(ledger, tmp_path / "pictures")
    assert [path.name for path, _ in written] == ["test_2.gif"]
    shown = frames(written[0][0])
    assert len(shown) == 13
    assert shown[0].shape == (40 + 18, 60, 3)
    black = [float(np.nonzero((frame[:40] < 60).all(axis=2))[1].mean()) for frame in shown]
    assert black[-1] > black[0]  # it went right


def test_what_cannot_be_drawn_says_why(tmp_path: Path) -> None:
    targets = np.array([[0.2], [-0.4], [0.3]])
    line = run_of(tmp_path / "line", "tests.tiny_env:make", targets[:2], targets[2:])
    with pytest.raises(ConfigError, match=r"tests\.tiny_env:make cannot be drawn: it has no frame\(slot\)"):
        draw_run(line, tmp_path / "pictures")
    whole = np.array([[1.0], [2.0], [3.0]])
    blind = run_of(tmp_path / "blind", "tests.faulty_env:Whole", whole[:2], whole[2:])
    with pytest.raises(ConfigError, match="must take `render_mode`"):
        draw_run(blind, tmp_path / "pictures")


def test_long_episodes_are_thinned_and_show_their_end(corridor: Ledger, tmp_path: Path) -> None:
    config = corridor.config.read_text().replace("horizon: 24", "horizon: 260")
    assert "horizon: 260" in config
    copy = tmp_path / "run"
    shutil.copytree(corridor.folder, copy)
    (copy / "config.yaml").write_text(config)
    (path, what), *_ = draw_run(Ledger(copy), tmp_path, [0])
    assert "260 steps" in what
    with Image.open(path) as image:
        told = [frame.info["duration"] for frame in ImageSequence.Iterator(image)]
    assert len(told) <= MAX_FRAMES + 1
    assert sum(told) == pytest.approx(250 * 260 + END_MILLISECONDS, rel=0.02)


def test_the_command(
    corridor: Ledger, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    assert command(monkeypatch, "render", corridor.folder, "--instances", "0,8", "--out", out) == 0
    assert f"{out / 'test_8.gif'}: test instance 8: return -0.096" in capsys.readouterr().out
    for ids, said in (("0,nine", "must be ids"), ("99", "99 is the id of an instance of neither set"), ("", "must be")):
        assert command(monkeypatch, "render", corridor.folder, "--instances", ids, "--out", out) == 2
        error = capsys.readouterr().err
        assert said in error
        assert ids != "99" or "(ids of train: 0-3; test: 4-8)" in error
    assert command(monkeypatch, "render", tmp_path, "--out", out) != 0
    (tmp_path / "file").touch()
    assert command(monkeypatch, "render", corridor.folder, "--instances", "0", "--out", tmp_path / "file" / "x") == 1
    assert "cannot write to" in capsys.readouterr().err


def test_a_finished_runs_episodes_are_mirrored_and_a_failure_costs_a_warning(
    corridor: Ledger, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rows of a finished run, with the config, the sets and the policy of the corridor's."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(drawing, "_DRAW_SECONDS", 250.0)  # however slow the machine is
    uri = f"sqlite:///{tmp_path / 'store' / 'mlflow.db'}"
    ledgers = [finished_run(tmp_path / f"run{number}", 1.0, seed=number) for number in range(2)]
    for ledger in ledgers:
        for name in ("config.yaml", "instances_train.csv", "instances_test.csv", "model.npz", "model.json"):
            written(ledger, name, (corridor.folder / name).read_bytes())
    written(ledgers[1], "model.npz", b"no model")
    rows = [[(ledger.folder / name).read_bytes() for name in (METRICS, TIMING, CURRICULUM)] for ledger in ledgers]
    result = sync(ledgers, uri, "drawn")
    assert (result.runs, dict(result.failed)) == (2, {})
    assert rows == [[(ledger.folder / name).read_bytes() for name in (METRICS, TIMING, CURRICULUM)]
                    for ledger in ledgers]  # fmt: skip
    client, artifacts = MlflowClient(uri), []
    experiment = client.get_experiment_by_name("drawn").experiment_id
    for number in range(2):
        (run,) = client.search_runs([experiment], f"tags.`space_dist.seed` = '{number}'")
        artifacts.append({Path(item.path).name for item in client.list_artifacts(run.info.run_id, "figures")})
    drawn = {"test_4.gif", "test_6.gif", "test_8.gif", "trajectories_train.png", "trajectories_test.png"}
    assert artifacts[0] - artifacts[1] == drawn
    assert not drawn & artifacts[1]
    assert "episodes were not drawn" in caplog.text
    assert "run1" in caplog.text
