"""Yoked runs, which follow another run's curriculum, and forks, which are the same as another run until they part."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from space_dist import config as configs
from space_dist.curricula import GENERATED, Draws, State
from space_dist.curricula.replay import Recording, Replay
from space_dist.envs.distributions import sample
from space_dist.errors import ConfigError
from space_dist.instances import InstanceSet
from space_dist.ledger import CURRICULUM, METRICS, Ledger
from space_dist.run import given
from space_dist.run.launch import Outcome, launch
from space_dist.run.population import advance, member
from space_dist.run.recording import recording_in
from space_dist.run.starting import weights_in
from space_dist.system.interrupts import StopRequests
from tests.commanding import Typed
from tests.shell import one_server
from tests.test_learners import crashed, interrupted, with_checkpoints

ROOT = Path(__file__).resolve().parent.parent
ROUND, BUDGET, AT = 128, 1280, 500  # the fork is behind the round that ends at 512
RESULTS = (METRICS, CURRICULUM, "model.npz")
KINDS = {
    "space": "{kind: space, eta: 4, kappa: 3}",
    "round_robin": "{kind: round_robin}",
    "uniform": "{kind: uniform}",
    "plr": "{kind: plr}",
    "spdrl": "{kind: spdrl, warm_up: 1, offset: 0}",
    "vds": "{kind: vds, n_batches: 1, batch_size: 50}",
    "procurl": "{kind: procurl, score: improvement, scale: set}",
    "learning_progress": "{kind: learning_progress, outcome: return, lowest_return: 0.25, largest_return: 0.5}",
    "edge": "{kind: edge, outcome: return, lowest_return: 0.25, largest_return: 0.5}",
    "plr_robust": "{kind: plr, robust: true, score: max_mc, scored_share: 0.3, temperature: 1}",
    "currot": "{kind: currot, delta: 0.3, particles: 16, over: bounds}",
    "accel": "{kind: accel, buffer: 8, batch: 6, filled_share: 0.3}",
}


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sets")
    for name, instances in zip(("train", "test"), sample("pointmass_uniform", 12, 3, 0), strict=True):
        (folder / f"{name}.csv").write_text(instances.to_csv())
    return folder


def configured(sets: Path, curriculum: str, *more: str, seed: int = 0, engine: str = "lean") -> configs.RunConfig:
    return configs.load(ROOT / "configs/pointmass_space.yaml", [
        f"curriculum={curriculum}", f"instances.train={sets}/train.csv", f"instances.test={sets}/test.csv",
        f"budget.steps={BUDGET}", f"learner.n_steps={ROUND}", "learner.n_epochs=1", "learner.net_arch=[16, 16]",
        "rollout.shards=2", "rollout.slots=4", "env.kwargs.horizon=16", "evaluation.every_steps=640",
        "evaluation.episodes=1", "tracking.uri=null", f"seed={seed}",
        *{"lean": ["learner.update=lean"], "stock": [], "population": ["engine=population"]}[engine], *more,
    ])  # fmt: skip


def run(config: configs.RunConfig, folder: Path, *, resume: bool = True) -> dict[str, bytes]:
    launch(config, folder, resume=resume, stop=StopRequests())
    return {name: (folder / name).read_bytes() for name in RESULTS}


@pytest.fixture(scope="module")
def of(sets: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The folder of a finished run of a kind, made once."""

    @functools.cache
    def made(kind: str) -> Path:
        folder: Path = tmp_path_factory.mktemp(kind) / "run"
        run(configured(sets, KINDS[kind]), folder)
        return folder

    return made


def following(folder: Path) -> str:
    return f"{{kind: replay, of: {folder}}}"


def trained(folder: Path) -> list[list[int]]:
    return [row["trained"] for row in Ledger(folder).rows(CURRICULUM)]


# ---- yoked ----


@pytest.mark.parametrize("kind", ["space", "round_robin"])
def test_who_follows_itself_is_itself(kind: str, sets: Path, of: Any, tmp_path: Path) -> None:
    found = run(configured(sets, following(of(kind))), tmp_path / "yoked")
    assert found[CURRICULUM] == (of(kind) / CURRICULUM).read_bytes()
    assert found["model.npz"] == (of(kind) / "model.npz").read_bytes()


def test_another_seed_gets_the_same_sets_and_learns_something_else(sets: Path, of: Any, tmp_path: Path) -> None:
    own = run(configured(sets, KINDS["space"], seed=1), tmp_path / "own")
    found = run(configured(sets, following(of("space")), seed=1), tmp_path / "yoked")
    assert trained(tmp_path / "yoked") == trained(of("space")) != trained(tmp_path / "own")
    assert found["model.npz"] not in (own["model.npz"], (of("space") / "model.npz").read_bytes())


@pytest.mark.parametrize("kind", ["uniform", "plr", "vds"])
def test_draws_are_those_of_the_same_iteration(kind: str, sets: Path, of: Any, tmp_path: Path) -> None:
    run(configured(sets, following(of(kind)), seed=1), tmp_path / "yoked")
    recorded, seen = trained(of(kind)), trained(tmp_path / "yoked")
    assert len(seen) == len(recorded) == BUDGET // ROUND
    for before, now, own in zip([[], *recorded], seen, recorded, strict=False):
        # Of the episodes that end in an iteration some began in the one before it.
        assert {*now} <= {*before, *own}
    assert len({tuple(sorted(one)) for one in seen}) > 1


def test_contexts_of_no_instance_are_followed_as_well(sets: Path, of: Any, tmp_path: Path) -> None:
    run(configured(sets, following(of("spdrl")), seed=1), tmp_path / "yoked")
    theirs, found = (
        {tuple(context) for row in Ledger(folder).rows(CURRICULUM) for context in row.get("contexts", ())}
        for folder in (of("spdrl"), tmp_path / "yoked")
    )
    assert len(found) > 20
    assert found <= theirs
    assert {instance for one in trained(tmp_path / "yoked") for instance in one} == {GENERATED}


@pytest.mark.parametrize("kind", ["space", "plr"])
def test_neither_interruptions_nor_company_nor_actors_change_a_byte(
    kind: str, sets: Path, of: Any, tmp_path: Path
) -> None:
    config = configured(sets, following(of(kind)), seed=1)
    expected = run(config, tmp_path / "whole")
    seldom = with_checkpoints(config, 20)
    interrupted(seldom, tmp_path / "disturbed", 3)
    crashed(seldom, tmp_path / "disturbed", 2)
    assert run(config, tmp_path / "disturbed") == expected
    members = [configured(sets, following(of(kind)), seed=seed, engine="population") for seed in (1, 2)]
    alone = [run(config, tmp_path / f"alone{number}") for number, config in enumerate(members)]
    assert together(members, tmp_path) == alone


def together(members: list[configs.RunConfig], folder: Path) -> list[dict[str, bytes]]:
    """What runs that share a process write."""
    folders = [folder / f"together{number}" for number in range(len(members))]
    ends: dict[Path, Any] = {}
    advance({place: member(config, place, stop=StopRequests()) for place, config in zip(folders, members, strict=True)},
            ends.__setitem__)  # fmt: skip
    assert all(isinstance(ends[place], Outcome) for place in folders), ends
    return [{name: (place / name).read_bytes() for name in RESULTS} for place in folders]


@pytest.mark.ray
@pytest.mark.parametrize("what", ["yoked", "fork"])
def test_rollout_actors_change_no_byte(what: str, sets: Path, of: Any, tmp_path: Path) -> None:
    changed = [f"schedule=[{{steps: {AT}, set: {{curriculum: {KINDS['plr']}}}}}]", f"fork={{seed: 3, steps: {AT}}}"]
    curriculum, more = (following(of("plr")), []) if what == "yoked" else (KINDS["space"], changed)
    expected = run(configured(sets, curriculum, *more, seed=1), tmp_path / "here")
    assert run(configured(sets, curriculum, *more, "resources.workers=1", seed=1), tmp_path / "actor") == expected


def test_a_run_keeps_what_it_follows(sets: Path, of: Any, tmp_path: Path) -> None:
    import shutil

    gone = tmp_path / "gone"
    shutil.copytree(of("space"), gone)
    config, folder = configured(sets, following(gone), seed=1), tmp_path / "yoked"
    expected = run(config, tmp_path / "whole")
    interrupted(config, folder, 3)
    shutil.rmtree(gone)
    with pytest.raises(ConfigError, match=r"curriculum.of: .*gone does not exist"):
        launch(config, folder, resume=True, stop=StopRequests())
    kept = configured(sets, following(folder / "recorded.npz"), seed=1)
    assert run(kept, folder) == expected
    assert (folder / "recorded.npz").read_bytes() == recording_in(of("space"))
    assert yaml_of(folder)["curriculum"] == {"kind": "replay", "of": "recorded.npz"}
    other = configured(sets, following(of("round_robin")), seed=1)
    with pytest.raises(ConfigError, match=r"another configuration \(curriculum.of: another recorded curriculum\)"):
        launch(other, folder, resume=True, stop=StopRequests())


def test_what_is_given_is_read_once_however_often_settings_change(
    sets: Path, of: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[Path] = []

    def counted(path: Path) -> bytes:
        read.append(path)
        return weights_in(path)

    monkeypatch.setattr(given, "_READ", {"init_from": counted})
    changes = [{"steps": steps, "set": {"learner.learning_rate": 0.01}} for steps in (200, 400)]
    run(
        configured(sets, KINDS["space"], f"init_from={of('space')}", f"schedule={json.dumps(changes)}"),
        tmp_path / "run",
    )
    assert read == [of("space")]


def yaml_of(folder: Path) -> dict[str, Any]:
    import yaml

    found: dict[str, Any] = yaml.safe_load((folder / "config.yaml").read_text())
    return found


def test_what_cannot_be_followed_is_said(sets: Path, of: Any, tmp_path: Path) -> None:
    interrupted(configured(sets, KINDS["space"]), tmp_path / "part", 3)
    for part in ("train", "test"):
        (tmp_path / f"{part}.csv").write_text((sets / f"{part}.csv").read_text())
    lines = (sets / "train.csv").read_text().splitlines()
    head, first = lines[0], lines[1].split(",")
    (tmp_path / "train.csv").write_text("\n".join([head, ",".join([first[0], "1.5", *first[2:]]), *lines[2:]]) + "\n")
    (tmp_path / "junk.npz").write_bytes(b"junk")
    cases = [
        (sets, tmp_path / "none", [], r"curriculum.of: .*none does not exist; it is the folder of a run"),
        (sets, tmp_path, [], "holds no run"),
        (sets, tmp_path / "junk.npz", [], "holds no recorded curriculum"),
        (sets, tmp_path / "part", [], r"is not done \(interrupted, 384 of 1,280 steps\)"),
        (tmp_path, of("space"), [], rf"was trained on instance {first[0]}, which .*train.csv does not have, or with"),
        (sets, of("space"), [f"budget.steps={2 * BUDGET}"], "is more than the 1280 steps of the run"),
        (sets, of("space"), [f"learner.n_steps={ROUND // 2}"], "a round of that run has 128 steps, and one of this"),
    ]
    for where, run_of, more, words in cases:
        with pytest.raises(ConfigError, match=words):
            launch(configured(where, following(run_of), *more), tmp_path / "out", resume=False, stop=StopRequests())
        assert not (tmp_path / "out").exists()


def instances(n: int) -> InstanceSet:
    return InstanceSet(np.arange(10, 10 + n), np.arange(2.0 * n).reshape(n, 2), ("a", "b"))


def recording(lists: list[list[int]], *, drawn: bool, generated: list[list[float]] | None = None) -> Recording:
    train = instances(4)
    return Recording(
        drawn, 100, 10, np.array([len(one) for one in lists]), np.array([each for one in lists for each in one]),
        np.array(generated or [], dtype=np.float64).reshape(-1, 2), train.ids, train.contexts,
    )  # fmt: skip


def test_sets_by_hand() -> None:
    lists = [[12, 10], [12, 10], [12, 10, 11], [12, 10]]
    curriculum = Replay(instances(4), recording(lists, drawn=False), draws=Draws(8, 2))
    found = [curriculum.selection(State(version)) for version in range(6)]
    assert [one.ids.tolist() for one in found] == [*lists, [12, 10], [12, 10]]
    # The walk goes on while the order stays, and behind the recording's end.
    assert [one.order_version for one in found] == [0, 0, 2, 3, 3, 3]
    assert found[2].contexts.tolist() == [[4, 5], [0, 1], [2, 3]]
    assert not any(one.drawn for one in found)


def test_draws_by_hand() -> None:
    lists = [[], [11, GENERATED, 10], [], [13]]
    curriculum = Replay(instances(4), recording(lists, drawn=True, generated=[[7.0, 8.0]]), draws=Draws(8, 2))
    found = [curriculum.selection(State(version)) for version in range(5)]
    # The e-th episode of walk w gets draw 2 e + w: of 11, -1, 10, 11, -1, 10, 11, -1 the first walk has every second.
    dealt = [11, 10, GENERATED, 11, GENERATED, 11, 10, GENERATED]
    assert [one.ids.tolist() for one in found] == [dealt, dealt, dealt, [13] * 8, [13] * 8]
    assert found[0].contexts[2].tolist() == [7.0, 8.0]
    assert [one.order_version for one in found] == [0, 1, 2, 3, 4]
    assert all(one.drawn for one in found)


def test_a_recording_survives_and_others_are_refused() -> None:
    whole = recording([[11, GENERATED], [], [12]], drawn=True, generated=[[1.0, 2.0]])
    again = Recording.decode(whole.encode())
    assert again.encode() == whole.encode()
    assert (again.drawn, again.budget_steps, again.round_steps, again.ids.tolist()) == (True, 100, 10, [11, -1, 12])
    for change in (
        {"lengths": np.array([2, 0])}, {"lengths": np.array([4, 0, -1])}, {"ids": np.array([11, -1, 99])},
        {"generated": np.zeros((2, 2))}, {"generated": np.array([[np.nan, 1.0]])}, {"set_contexts": np.zeros((4, 3))},
        {"ids": np.array([11.0, -1.0, 12.0])}, {"lengths": np.zeros(0, dtype=int), "ids": np.zeros(0, dtype=int)},
    ):  # fmt: skip
        with pytest.raises(ValueError, match="arrays"):
            Recording.decode(Recording(**{**vars(whole), **change}).encode())


def test_strangers_are_instances_that_are_not_there_or_are_others() -> None:
    whole = recording([[11, 12], [13, GENERATED]], drawn=True, generated=[[0.0, 0.0]])
    assert whole.strangers(instances(4)).tolist() == []
    assert whole.strangers(instances(3)).tolist() == [13]
    moved = instances(4).contexts.copy()
    moved[[0, 1]] += 1.0  # the first was never trained on
    assert whole.strangers(InstanceSet(np.arange(10, 14), moved, ("a", "b"))).tolist() == [11]


# ---- forks ----


def rows_until(folder: Path, steps: int, name: str = METRICS) -> list[Any]:
    return [row for row in Ledger(folder).rows(name) if row["steps"] <= steps]


def forked(sets: Path, curriculum: str, change: str | None, *more: str, **how: Any) -> configs.RunConfig:
    schedule = [] if change is None else [f"schedule=[{{steps: {AT}, set: {{curriculum: {change}}}}}]"]
    return configured(sets, curriculum, f"fork={{seed: 0, steps: {AT}}}", *schedule, *more, **how)


def test_continuations_are_the_run_until_they_part(sets: Path, of: Any, tmp_path: Path) -> None:
    trunk = of("space")
    same = run(forked(sets, KINDS["space"], None, seed=0), tmp_path / "same")
    assert same == {name: (trunk / name).read_bytes() for name in RESULTS}
    models = {same["model.npz"]}
    for name, change, seed in (("other", None, 1), ("changed", KINDS["plr"], 0), ("both", KINDS["plr"], 1)):
        found = run(forked(sets, KINDS["space"], change, seed=seed), tmp_path / name)
        assert rows_until(tmp_path / name, AT) == rows_until(trunk, AT)
        assert len(rows_until(tmp_path / name, AT)) >= 2
        assert Ledger(tmp_path / name).rows(METRICS)[-1]["steps"] == BUDGET
        models.add(found["model.npz"])
    assert len(models) == 4


@pytest.mark.parametrize("kind", ["procurl", "learning_progress", "plr_robust", "currot", "edge", "accel"])
def test_draws_are_gone_on_with_behind_a_fork(kind: str, sets: Path, of: Any, tmp_path: Path) -> None:
    trunk = of(kind)
    same = run(forked(sets, KINDS[kind], None, seed=0), tmp_path / "same")
    assert same == {name: (trunk / name).read_bytes() for name in RESULTS}
    other = run(forked(sets, KINDS[kind], None, seed=1), tmp_path / "other")
    assert rows_until(tmp_path / "other", AT) == rows_until(trunk, AT)
    assert other["model.npz"] != same["model.npz"]


@pytest.mark.parametrize("change", KINDS)
@pytest.mark.parametrize("before", ["space", "plr"])
def test_another_curriculum_begins_anew(before: str, change: str, sets: Path, of: Any, tmp_path: Path) -> None:
    config = forked(sets, KINDS[before], KINDS[change], seed=0)
    expected = run(config, tmp_path / "whole")
    rows = [row for row in Ledger(tmp_path / "whole").rows(METRICS) if row["kind"] == "iteration"]
    history = Ledger(tmp_path / "whole").rows(CURRICULUM)
    assert [row["iteration"] for row in history] == [row["iteration"] for row in rows] == [*range(1, len(rows) + 1)]
    assert rows_until(tmp_path / "whole", AT, CURRICULUM) == rows_until(of(before), AT, CURRICULUM)
    [(place, parted)] = [(place, row) for place, row in enumerate(rows) if row["steps"] == 512]
    assert parted["complete"] == (of_drawn(before) or complete_in(of(before), 512))
    # Its first selection is what it has with nothing known.
    fresh = run_first(sets, change, tmp_path / "fresh")
    if not of_drawn(change):
        assert history[place + 1]["trained"] == fresh
    seldom = with_checkpoints(config, 20)
    interrupted(seldom, tmp_path / "disturbed", 3)  # before they part
    crashed(seldom, tmp_path / "disturbed", 3)  # behind it
    interrupted(seldom, tmp_path / "disturbed", 1)
    assert run(config, tmp_path / "disturbed") == expected


def of_drawn(kind: str) -> bool:
    return kind not in ("space", "round_robin")


def complete_in(folder: Path, steps: int) -> bool:
    return any(row["steps"] == steps and row["complete"] for row in Ledger(folder).rows(METRICS)
               if row["kind"] == "iteration")  # fmt: skip


def run_first(sets: Path, kind: str, folder: Path) -> list[int]:
    """What a fresh run of a kind is trained on in its first iteration."""
    run(configured(sets, KINDS[kind]), folder)
    return trained(folder)[0]


def test_continuations_share_a_process_and_change_nothing(sets: Path, tmp_path: Path) -> None:
    members = [
        forked(sets, KINDS["space"], change, seed=seed, engine="population")
        for change in (None, KINDS["plr"], KINDS["round_robin"]) for seed in (1, 2)
    ]  # fmt: skip
    alone = [run(config, tmp_path / f"alone{number}") for number, config in enumerate(members)]
    assert together(members, tmp_path) == alone
    assert len({one["model.npz"] for one in alone}) == len(members)


def test_a_curriculum_that_needs_more_brings_it(sets: Path, tmp_path: Path) -> None:
    """A column of the instances, and scikit-learn, for a curriculum that is not there at first."""
    lines = (sets / "train.csv").read_text().splitlines()
    made = [f"{line},{'effort' if number == 0 else number}" for number, line in enumerate(lines)]
    (tmp_path / "train.csv").write_text("\n".join(made) + "\n")
    (tmp_path / "test.csv").write_text((sets / "test.csv").read_text())
    config = forked(tmp_path, KINDS["space"], "{kind: manual, column: effort}", seed=0)
    run(config, tmp_path / "run")
    first = next(row for row in Ledger(tmp_path / "run").rows(CURRICULUM) if row["steps"] > 512)
    assert first["trained"] == [int(lines[1].split(",")[0])]  # the least effort
    assert forked(sets, KINDS["space"], "{kind: alp_gmm}").libraries == ("scipy", "scikit-learn")


def test_the_command_writes_a_grid_of_continuations(of: Any, tmp_path: Path, type_in: Typed) -> None:
    done = type_in(
        "fork", of("space"), "--at", AT, "--seeds", 2, "--set", "curriculum.kind=round_robin", "--set",
        "curriculum={kind: uniform}", "--set", "learner.learning_rate=0.01", "--out", tmp_path / "fork.yaml",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert f"8 runs, bit for bit the same as {of('space')} until 500 steps" in " ".join(done.stdout.split())
    with one_server():
        done = type_in("grid", "run", "fork.yaml")
    assert done.returncode == 0, done.stderr
    [manifest] = tmp_path.glob("runs/*/manifest.json")
    cells = json.loads(manifest.read_text())["cells"]
    assert [cell["label"] for cell in cells] == [
        "unchanged", "from 500 round_robin", "from 500 uniform", "from 500 learning_rate=0.01",
    ]  # fmt: skip
    folders = [*manifest.parent.glob("*/s*/status.json")]
    assert len(folders) == 8
    for status in folders:
        assert rows_until(status.parent, AT) == rows_until(of("space"), AT)
    done = type_in("report", manifest.parent)
    assert done.returncode == 0, done.stderr
    again = type_in("fork", of("space"), "--at", AT, "--out", tmp_path / "fork.yaml")
    assert (again.returncode, "exists already" in again.stderr) == (2, True)
    twice = type_in("fork", folders[0].parent, "--at", AT)
    assert (twice.returncode, "is itself the continuation of a run with seed 0" in " ".join(twice.stderr.split())) == (
        2, True,
    )  # fmt: skip
    explained = type_in("explain", folders[0].parent, "--iteration", 1)
    assert (explained.returncode, "changes on the way" in " ".join(explained.stderr.split())) == (2, True)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--at", "0"], "forks before its end"),
        (["--at", BUDGET], "has a budget of 1,280 steps"),
        (["--at", AT, "--set", "learner.n_steps=64"], "learner.n_steps cannot change on the way"),
        (["--at", AT, "--set", "curriculum.kind=spcae"], "did you mean 'space'?"),
        (["--at", AT, "--set", "nothing"], "write KEY=VALUE"),
        (["--at", AT, "--set", "curriculum={kind: replay, of: x}"], "replay follows a run from its start"),
    ],
)
def test_forks_that_cannot_be_are_said(words: list[Any], said: str, of: Any, tmp_path: Path, type_in: Typed) -> None:
    done = type_in("fork", of("space"), *words, "--out", tmp_path / "fork.yaml")
    assert done.returncode == 2
    assert said in " ".join(done.stderr.split()), done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "fork.yaml").exists()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ([f"fork={{seed: 0, steps: {BUDGET}}}"], f"fork.steps = {BUDGET} is not below budget.steps"),
        (["fork={seed: -1, steps: 9}"], "fork.seed"),
        (["schedule=[{steps: 9, set: {curriculum: {kind: space, aggregate: population}}}]", "engine=population",
          "learner.update=stock"], "the number of policies cannot change"),
    ],
)  # fmt: skip
def test_settings_of_forks_that_cannot_be_are_said(settings: list[str], words: str, sets: Path) -> None:
    with pytest.raises(ConfigError, match=words):
        configured(sets, KINDS["space"], *settings)
