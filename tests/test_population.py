from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.config import RunConfig, load, read_yaml, to_yaml
from space_dist.envs.interface import Step
from space_dist.envs.singles import BatchedSingles
from space_dist.envs.spec import EnvironmentSpec
from space_dist.errors import ConfigError, Interrupted, SpaceDistError
from space_dist.learner import CoupledLearner
from space_dist.ledger import CURRICULUM, Ledger
from space_dist.rollout import Shard, Worker, collecting
from space_dist.rollout.policy import policies_of
from space_dist.rollout.walk import Walk
from space_dist.run import population
from space_dist.run.building import Blueprint
from space_dist.run.launch import Outcome, launch, policy_of
from space_dist.run.population import advance, member
from space_dist.system.interrupts import StopRequests
from tests.grids import ROOT
from tests.test_learners import LINE, N_STEPS, ROUNDS, config_for, crashed, learner_section, results
from tests.tiny_env import Line

DISCRETE = "tests.tiny_env:make_discrete"
Ends = dict[Path, Outcome | SpaceDistError]


def configured(folder: Path, number: int, **sections: Any) -> RunConfig:
    """Member `number` of a population of runs that differ in all that members may."""
    folder.mkdir(parents=True, exist_ok=True)
    learner = sections.pop("learner", {})
    kind, own = learner.pop("kind", "ppo"), {"ppo": "clip_range", "trpo": "target_kl"}
    numbers = {"learning_rate": 1e-3 * (number + 1), "gamma": 0.9 - 0.05 * number, own[kind]: 0.1 + 0.05 * number}
    curricula = ({"kind": "space"}, {"kind": "round_robin"}, {"kind": "space", "kappa": 2, "eta": 0.5}, {"kind": "plr"})
    curricula = sections.pop("curricula", curricula)
    config = config_for(
        folder, learner_section(kind, **{**numbers, **learner}),
        curriculum=curricula[number % len(curricula)], engine="population", seed=number, **sections,
    )  # fmt: skip
    write_set(folder / "train.csv", np.linspace(-1.0, 1.0 - number / 11, 6 + number))
    return config


def write_set(path: Path, targets: NDArray[np.float64]) -> None:
    path.write_text("\n".join(["id,target", *(f"{number},{target}" for number, target in enumerate(targets))]) + "\n")


def together(configs: Sequence[RunConfig], folders: Sequence[Path]) -> Ends:
    ends: Ends = {}
    members = {
        folder: member(config, folder, stop=StopRequests()) for config, folder in zip(configs, folders, strict=True)
    }
    advance(members, ends.__setitem__)
    return ends


def alone(config: RunConfig, folder: Path) -> dict[str, bytes]:
    launch(config, folder, resume=True, stop=StopRequests())
    return results(folder)


@pytest.mark.parametrize(
    ("kind", "env_id", "normalised"),
    [("ppo", LINE, False), ("ppo", LINE, True), ("ppo", DISCRETE, False), ("trpo", LINE, True),
     ("trpo", DISCRETE, False)],
)  # fmt: skip
def test_a_member_is_what_its_run_is_alone(kind: str, env_id: str, normalised: bool, tmp_path: Path) -> None:
    learner = {"kind": kind, "normalize_observations": normalised, "normalize_rewards": normalised}
    configs = [
        configured(tmp_path / str(number), number, env={"id": env_id}, learner={**learner},
                   evaluation={"every_steps": 100, "legacy_metric": True})
        for number in range(4)
    ]  # fmt: skip
    expected = [alone(config, tmp_path / f"alone{number}") for number, config in enumerate(configs)]
    for chosen in ([0, 1, 2, 3], [3, 1]):
        folders = [tmp_path / f"{len(chosen)}-{number}" for number in chosen]
        ends = together([configs[number] for number in chosen], folders)
        assert all(isinstance(ends[folder], Outcome) for folder in folders)
        for number, folder in zip(chosen, folders, strict=True):
            assert results(folder) == expected[number]
            assert Ledger(folder).status().state == "done"
    assert len({content["metrics.jsonl"] for content in expected}) == 4


def test_a_part_of_an_evaluation_meets_the_environments_that_it_met_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which have drawn for its episodes already, as those of other parts have not."""
    met: dict[bytes, list[Any]] = defaultdict(list)  # environments, by the seeds of the episodes that they played
    evaluated = population.evaluate

    def watched(env: Any, trials: Any) -> Any:
        met[np.concatenate([trial.seeds for trial in trials]).tobytes()].append(env)
        return evaluated(env, trials)

    monkeypatch.setattr(population, "evaluate", watched)
    monkeypatch.setattr(population, "_SLOTS", 4)
    monkeypatch.delattr(BatchedSingles, "close")  # nor are they as costly as others' environments may be
    configs = [configured(tmp_path / str(number), 0, evaluation={"every_steps": N_STEPS}) for number in range(2)]
    configs = [config.model_copy(update={"seed": number}) for number, config in enumerate(configs)]
    together(configs, [tmp_path / f"run{number}" for number in range(2)])
    assert len(met) == 4  # two parts of each of two batches
    assert {len(envs) for envs in met.values()} != {1}
    assert all(env is envs[0] for envs in met.values() for env in envs)
    assert len({id(envs[0]) for envs in met.values()}) == len(met)


@pytest.mark.parametrize(("slots", "costly"), [(2, False), (4, True)])
def test_where_parts_are_many_or_costly_one_environment_of_a_size_is_kept(
    slots: int, costly: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seven parts over two batches, say, of which four are kept: each would be dropped just before it is wanted."""
    used: list[Any] = []
    evaluated = population.evaluate

    def watched(env: Any, trials: Any) -> Any:
        used.append(env)
        return evaluated(env, trials)

    monkeypatch.setattr(population, "evaluate", watched)
    monkeypatch.setattr(population, "_SLOTS", slots)
    monkeypatch.setattr(population, "_KEPT", 4)
    if not costly:
        monkeypatch.delattr(BatchedSingles, "close")
    configs = [configured(tmp_path / str(number), 0, evaluation={"every_steps": N_STEPS}) for number in range(2)]
    configs = [config.model_copy(update={"seed": number}) for number, config in enumerate(configs)]
    together(configs, [tmp_path / f"run{number}" for number in range(2)])
    made = {id(env) for env in used}
    assert len(made) <= 4  # sizes of parts, of two batches
    first = used[: len(used) // 3]
    assert {id(env) for env in first} == made
    assert len(used) > 3 * len(made)


DRAWING = (
    {"kind": "procurl", "score": "improvement", "scale": "set"},
    {"kind": "learning_progress", "smoothing": 0.5},
    {"kind": "edge", "memory": 0.5},
    {"kind": "plr", "robust": True, "scored_share": 0.3, "temperature": 1.0},
    {"kind": "plr", "robust": True, "scored_share": 0.3, "score": "max_mc", "within_update": "fixed_chances"},
    {"kind": "currot", "delta": -1.0, "particles": 8, "over": "bounds"},
    {"kind": "accel", "buffer": 8, "batch": 6, "filled_share": 0.3},
)


@pytest.mark.parametrize("kind", ["ppo", "trpo"])
def test_members_that_draw_are_what_their_runs_are_alone(kind: str, tmp_path: Path) -> None:
    """Some of them learn from no round, while others wait for their update."""
    configs = [configured(tmp_path / str(number), number, learner={"kind": kind}, curricula=DRAWING,
                          budget={"steps": 9 * N_STEPS}) for number in range(len(DRAWING))]  # fmt: skip
    expected = [alone(config, tmp_path / f"alone{number}") for number, config in enumerate(configs)]
    folders = [tmp_path / f"run{number}" for number in range(len(DRAWING))]
    assert all(isinstance(end, Outcome) for end in together(configs, folders).values())
    assert [results(folder) for folder in folders] == expected
    for folder in (*folders[3:5], folders[6]):
        learned = {row["gradient_steps"] > 0 for row in Ledger(folder).rows() if row["kind"] == "iteration"}
        assert learned == {False, True}


@pytest.mark.parametrize("commits", [(20, 20, 20), (1, 2, 20)])
def test_members_that_stay_together_play_nothing_again(
    commits: tuple[int, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever of them commits, and measures, meanwhile."""
    configs = [configured(tmp_path / str(number), number, checkpoint={"every_rounds": often, "every_seconds": 1e6},
                          evaluation={"every_steps": (number + 1) * N_STEPS})
               for number, often in enumerate(commits)]  # fmt: skip
    played, replayed = [], collecting.replayed
    monkeypatch.setattr(collecting, "replayed", lambda env, table: played.append(1) or replayed(env, table))
    together(configs, [tmp_path / f"run{number}" for number in range(3)])
    assert len(played) == 1  # the first round's, of nothing


def test_members_share_no_world_of_a_simulator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Slots that do wait for each other at every step."""
    monkeypatch.setattr(EnvironmentSpec, "most_slots", 4)
    sizes: set[int] = set()

    def watched(stage: Any, rollouts: Any, **how: Any) -> Any:
        sizes.add(stage.env.n_slots)
        return collecting.collect(stage, rollouts, **how)

    monkeypatch.setattr(population, "collect", watched)
    configs = [configured(tmp_path / str(number), number) for number in range(3)]
    slots = configs[0].rollout.slots
    assert isinstance(slots, int)
    assert 3 * slots * configs[0].rollout.shards > 4 >= slots
    expected = [alone(config, tmp_path / f"alone{number}") for number, config in enumerate(configs)]
    folders = [tmp_path / f"run{number}" for number in range(3)]
    assert all(isinstance(end, Outcome) for end in together(configs, folders).values())
    assert max(sizes) <= 4
    assert [results(folder) for folder in folders] == expected


@pytest.mark.parametrize("slots", [2, 100])
def test_the_memory_of_a_simulators_worlds_is_foreseen(slots: int) -> None:
    of_ant, of_none = (
        Blueprint.of(load(ROOT / f"configs/{name}_space.yaml", [
            "engine=population", "learner.kind=ppo", "learner.n_steps=800", "learner.net_arch=[8]", "rollout.shards=1",
            f"rollout.slots={slots}", "resources.workers=0"])).memory
        for name in ("antgoal", "pointmass")
    )  # fmt: skip
    assert abs(of_ant - of_none - 32 * min(slots, 32)) <= 2


def test_its_learning_is_stable_baselines3s_up_to_rounding(tmp_path: Path) -> None:
    config = configured(tmp_path, 0)
    ours, theirs = tmp_path / "population", tmp_path / "single"
    alone(config, ours)
    alone(config.model_copy(update={"engine": "single"}), theirs)
    rows = [[row for row in Ledger(folder).rows() if row["kind"] == "evaluation"] for folder in (ours, theirs)]
    for one, other in zip(*rows, strict=True):
        assert one["steps"] == other["steps"]
        assert one["test"]["returns"] == pytest.approx(other["test"]["returns"], abs=1e-3)
    assert results(ours)["model.npz"] != results(theirs)["model.npz"]


def test_whoever_is_lost_in_the_middle_goes_on_in_any_company(tmp_path: Path) -> None:
    configs = [configured(tmp_path / str(number), number) for number in range(3)]
    short = configured(tmp_path / "3", 3, budget={"steps": 2 * N_STEPS})
    folders = [tmp_path / f"run{number}" for number in range(4)]

    def die(folder: Path, outcome: Outcome | SpaceDistError) -> None:
        assert (folder, isinstance(outcome, Outcome)) == (folders[3], True)
        raise RuntimeError("the test's crash")

    members = [member(config, folder, stop=StopRequests())
               for config, folder in zip([*configs, short], folders, strict=True)]  # fmt: skip
    with pytest.raises(RuntimeError, match="crash"):
        advance(dict(zip(folders, members, strict=True)), die)
    for folder in folders[:3]:
        status = Ledger(folder).status()
        assert (status.state, status.steps) == ("running", 2 * N_STEPS)
        assert not Ledger(folder).owner_alive()
    assert together([configs[2]], [folders[2]]).keys() == {folders[2]}
    ends = together([short, configs[1], configs[0]], [folders[3], folders[1], folders[0]])
    assert [isinstance(end, Outcome) and end.already_done for end in ends.values()].count(True) == 1
    for number, config in enumerate(configs):
        assert results(folders[number]) == alone(config, tmp_path / f"alone{number}")


@pytest.mark.parametrize("kind", ["ppo", "trpo"])
def test_what_a_member_takes_of_the_memory_is_foreseen(kind: str, tmp_path: Path) -> None:
    """Held against the memory of processes with few and with many members; what it takes at least, too."""
    data = read_yaml(ROOT / "configs/pointmass_space.yaml")
    once = {"ppo": "n_epochs", "trpo": "n_critic_updates"}[kind]
    data |= {"engine": "population", "tracking": {"uri": None},
             "budget": {"steps": 4096}, "evaluation": {"every_steps": 4096},
             "learner": {"kind": kind, "n_steps": 4096, "batch_size": 512, "net_arch": [64, 64], once: 1},
             "instances": {split: str(ROOT / f"configs/instances/pointmass_uniform_{split}.csv")
                           for split in ("train", "test")}}  # fmt: skip
    path = tmp_path / "config.yaml"
    path.write_text(to_yaml(data))
    command = [sys.executable, "-m", "tests.population_memory", path, "4", "12"]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    few, many = map(int, said.split())
    each = (many - few) / 8 / 2**20
    config = load(path)
    assert each <= Blueprint.of(config).memory <= 3 * each


def test_a_member_that_is_asked_to_stop_stops_alone(tmp_path: Path) -> None:
    configs = [configured(tmp_path / str(number), number) for number in range(2)]
    folders = [tmp_path / "run0", tmp_path / "run1"]

    def stopped(work: Any) -> Any:
        """A member that is asked to stop, by its file, after five answers."""
        answer = None
        for count in range(1000):
            if count == 5:
                Ledger(folders[1]).stop_file.touch()
            try:
                request = work.send(answer)
            except StopIteration as end:
                return end.value
            answer = yield request

    members = [member(config, folder, stop=StopRequests()) for config, folder in zip(configs, folders, strict=True)]
    ends: Ends = {}
    advance({folders[0]: members[0], folders[1]: stopped(members[1])}, ends.__setitem__)
    assert isinstance(ends[folders[0]], Outcome)
    assert isinstance(ends[folders[1]], Interrupted)
    assert Ledger(folders[1]).status().state == "interrupted"
    assert alone(configs[1], folders[1]) == alone(configs[1], tmp_path / "alone")


class Fragile(Line):
    """The line, whose end at 1 nobody may want to reach."""

    def step(self, actions: NDArray[np.generic]) -> Step:
        if (self._target > 0.99).any():
            raise ValueError("the line is broken at its end")
        return super().step(actions)


def make_fragile(n_slots: int) -> Fragile:
    return Fragile(n_slots, spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32))


def test_who_breaks_an_environment_fails_alone(tmp_path: Path) -> None:
    """The environments of all members are one batch; only those whose contexts break it must bear that."""
    settings = {"env": {"id": "tests.test_population:make_fragile"},
                "evaluation": {"every_steps": 100, "legacy_metric": True}}  # fmt: skip
    configs = [configured(tmp_path / str(number), number, **settings) for number in range(3)]
    folders = [tmp_path / f"run{number}" for number in range(3)]  # the first one's instances reach 1
    ends = together(configs, folders)
    assert "broken at its end" in str(ends[folders[0]])
    assert isinstance(ends[folders[0]], SpaceDistError)
    for number in (1, 2):
        assert isinstance(ends[folders[number]], Outcome)
        assert results(folders[number]) == alone(configs[number], tmp_path / f"alone{number}")


# ---- policies that share a curriculum ----


def coupled(folder: Path, **sections: Any) -> RunConfig:
    curriculum = {"kind": "space", "eta": 0.5, "aggregate": "population", "policies": 3}
    return config_for(
        folder, learner_section("ppo"),
        **{"curriculum": curriculum, "engine": "population", "budget": {"steps": 3 * ROUNDS * N_STEPS}, **sections},
    )  # fmt: skip


def test_policies_that_share_a_curriculum_are_one_run(tmp_path: Path) -> None:
    """The same bytes alone, among others, interrupted; every policy's steps are counted."""
    config, other = coupled(tmp_path), configured(tmp_path / "1", 1)
    expected = alone(config, tmp_path / "alone")
    status = Ledger(tmp_path / "alone").status()
    assert (status.steps, status.round) == (3 * ROUNDS * N_STEPS, ROUNDS)
    folders = [tmp_path / "run0", tmp_path / "run1"]
    together([config, other], folders)
    assert results(folders[0]) == expected
    assert results(folders[1]) == alone(other, tmp_path / "alone1")
    crashed(config, tmp_path / "crashed", 3)
    assert alone(config, tmp_path / "crashed") == expected
    seeds = {alone(config.model_copy(update={"seed": seed}), tmp_path / f"s{seed}")["model.npz"] for seed in (1, 2)}
    assert len({*seeds, expected["model.npz"]}) == 3


def test_they_learn_each_for_itself_and_are_valued_together(tmp_path: Path) -> None:
    config = coupled(tmp_path)
    blueprint = Blueprint.of(config)
    setup, learner = blueprint.setup(*blueprint.instances()), blueprint.learner()
    assert isinstance(learner, CoupledLearner)
    policy, worker = learner.policy(0), Worker(setup)
    own = [worker.start_values(member, 0) for member in policy.policies]
    assert np.array_equal(worker.start_values(policy, 0), np.mean(own, axis=0))
    assert not np.array_equal(own[0], own[1])
    selection = blueprint.curriculum(setup.train, setup.test).start()[1]
    asked = {"round": 0, "steps": 0, "selection_version": 0}
    shards = [worker.collect(policy, selection, Walk(-1, ()), shard=number, **asked) for number in range(setup.shards)]
    single = Worker(dataclasses.replace(setup, policies=1))
    for number, shard in enumerate(shards):  # each policy's own, with random numbers of its own
        member = policy.policies[number // 4]
        again = single.collect(member, selection, Walk(-1, ()), shard=number, **asked)
        assert np.array_equal(shard.actions, again.actions)
    alone = blueprint.learner()
    assert isinstance(alone, CoupledLearner)
    before = learner.scored()
    update = learner.update(shards, round=0, steps=3 * N_STEPS)
    for member, mine in zip(alone.learners, alone.parts(shards), strict=True):
        made = member.update(mine, round=0, steps=3 * N_STEPS)
        assert made.gradient_steps == update.gradient_steps
    ours, theirs = learner.scored(), alone.scored()
    assert all(np.array_equal(ours[name], theirs[name]) for name in ours)
    assert not np.array_equal(worker.start_values(learner.policy(1), 0), np.mean(own, axis=0))
    assert np.array_equal(worker.start_values(learner.policy_of(before, 1), 0), np.mean(own, axis=0))


def test_each_of_them_meets_the_whole_selection_in_every_iteration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whole passes of each policy, whatever the order, which is another one in every iteration."""
    met: dict[tuple[int, int], set[float]] = {}  # by selection and policy: targets
    learn = CoupledLearner.parts

    def noted(self: CoupledLearner, shards: Sequence[Shard]) -> list[list[Shard]]:
        for number, mine in enumerate(parts := learn(self, shards)):
            for shard in mine:
                seen = shard.observations[..., -1]  # type: ignore[call-overload]
                met.setdefault((shard.selection_version, number), set()).update(seen.ravel().tolist())
        return parts

    monkeypatch.setattr(CoupledLearner, "parts", noted)
    grows = {"kind": "random_growth", "growth": "add", "kappa": 4, "eta": 1e9}
    config = coupled(
        tmp_path, curriculum={**grows, "aggregate": "population", "policies": 4},
        budget={"steps": 4 * 12 * N_STEPS}, rollout={"shards": 2, "slots": 1, "passes": 2.0},
    )  # fmt: skip
    targets = np.linspace(-0.9, 0.9, 12)
    write_set(tmp_path / "train.csv", targets)
    alone(config, tmp_path / "run")
    rows = [row for row in Ledger(tmp_path / "run").rows() if row["kind"] == "iteration" and row["complete"]]
    for version, row in enumerate(rows):
        trained = row["curriculum"]["trained_size"]
        assert row["round"] - (rows[version - 1]["round"] if version else 0) == max(1, -(-2 * trained * 8 // N_STEPS))
        wanted = targets[Ledger(tmp_path / "run").rows(CURRICULUM)[version]["trained"]]
        for policy in range(4):
            assert np.isclose(wanted[:, None], list(met[version, policy]), atol=1e-4).any(axis=1).all()
    assert rows[-1]["curriculum"]["trained_size"] == 12


def test_their_evaluation_is_the_mean_of_theirs(tmp_path: Path) -> None:
    config = coupled(tmp_path, evaluation={"every_steps": 100, "episodes": 2})
    alone(config, tmp_path / "run")
    first = Ledger(tmp_path / "run").rows()[0]
    blueprint = Blueprint.of(config)
    learner, setup = blueprint.learner(), blueprint.setup(*blueprint.instances())
    single = Worker(dataclasses.replace(setup, policies=1, shards=1))
    outcomes = [single.evaluate(member, "test", 0).returns.reshape(-1, 2).mean(axis=1)
                for member in policies_of(learner.policy(0))]  # fmt: skip
    assert first["test"]["returns"] == pytest.approx(np.mean(outcomes, axis=0).tolist(), abs=1e-6)
    assert len(policies_of(policy_of(Ledger(tmp_path / "run"), blueprint.spec))) == 3


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"engine": "single"}, "needs engine: population"),
     ({"learner": learner_section("a2c")}, "learner.kind: ppo"),
     ({"learner": learner_section("ppo", normalize_rewards=True)}, "normalize_rewards")],
)  # fmt: skip
def test_who_cannot_share_a_curriculum_is_told_so(changes: dict[str, Any], words: str, tmp_path: Path) -> None:
    learner = changes.pop("learner", learner_section("ppo"))
    curriculum = {"kind": "space", "aggregate": "population"}
    with pytest.raises(ConfigError, match=words):
        config_for(tmp_path, learner, **{"curriculum": curriculum, "engine": "population", **changes})


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_missed_before_anything_starts(tmp_path: Path) -> None:
    config = config_for(tmp_path, learner_section("ppo"), engine="population", device="cuda")
    with pytest.raises(ConfigError, match="device: cuda: torch finds no GPU"):
        alone(config, tmp_path / "run")
    assert not (tmp_path / "run").exists()
