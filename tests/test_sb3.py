"""Our curricula in a script with Stable-Baselines3: they decide as our loop does, and go on as a model remembers."""

from __future__ import annotations

import ast
import base64
import difflib
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib import QRDQN, TQC, TRPO, CrossQ, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, CheckpointCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecNormalize

from space_dist import config as configs
from space_dist.arithmetic import SETTINGS
from space_dist.config import PPOConfig, RecurrentPPOConfig, RunConfig
from space_dist.curricula import Selection
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.instances import InstanceSet
from space_dist.learner import SB3Learner
from space_dist.ledger import Checkpoint, decode_checkpoint, encode_checkpoint
from space_dist.rollout import Outcomes, Shard
from space_dist.run.building import Blueprint
from space_dist.run.cluster import Decision, Evidence, Handle, InProcess
from space_dist.run.launch import begun
from space_dist.sb3 import ContextVecEnv, CurriculumCallback
from space_dist.sb3.script import Scored, Wrapped
from space_dist.sb3.session import STATE
from space_dist.system.interrupts import StopRequests
from tests.patience import PATIENCE
from tests.test_learners import LEARNERS, OFF_POLICY
from tests.test_purity import ROOT

EXAMPLES, DOCUMENT = ROOT / "docs" / "examples", ROOT / "docs" / "sb3.md"
LINE, DISCRETE, PARTS = "tests.tiny_env:make", "tests.tiny_env:make_discrete", "tests.tiny_env:make_dict"
TARGETS = np.array([-0.75, 0.75, 0.4, -0.3, 0.1, -0.5])
SLOTS, STEPS, ROUNDS, SEED = 4, 40, 7, 3  # ten steps a slot: episodes, of four or eight, go on from round to round
SPACE = {"kind": "space", "eta": 0.4}


# ---- the same decisions as our loop's ----


class Witness(InProcess):
    """Our own cluster, and everything that a script would have to be shown to decide alike."""

    learner: SB3Learner

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.selections: list[Selection] = []  # of each round
        self.shards: list[Shard] = []
        self.learned: list[Any] = []  # the learner as each round began
        self.advantages: list[NDArray[np.float64] | None] = []
        self.decisions: list[Decision] = []
        self.probed: dict[int, list[Outcomes]] = {}

    def collect(self, *arguments: Any, **named: Any) -> list[Handle]:
        shards = super().collect(*arguments, **named)
        self.selections.append(arguments[1])
        self.shards += shards
        self.learned.append(self.learner.save())
        return shards

    def probe(self, policy: Handle, indices: Any, *, version: int) -> list[Handle]:
        self.probed[version] = super().probe(policy, indices, version=version)
        return self.probed[version]

    def begin(self, values: Any) -> Decision:
        self.decisions.append(super().begin(values))
        return self.decisions[-1]

    def decide(self, state: Handle, before: Handle, evidence: Evidence, **asked: Any) -> Decision:
        self.decisions.append(super().decide(state, before, evidence, **asked))
        return self.decisions[-1]


def run_config(
    folder: Path, kind: str, env: Mapping[str, Any], curriculum: Mapping[str, Any], **learner: Any
) -> RunConfig:
    folder.mkdir(exist_ok=True)
    train, test = folder / "train.csv", folder / "test.csv"
    train.write_text("id,target\n" + "".join(f"{number + 10},{target}\n" for number, target in enumerate(TARGETS)))
    test.write_text("id,target\n0,-0.7\n")
    off_policy = {**OFF_POLICY, "buffer_size": 1000} if kind in ("dqn", "sac", "td3") else {}
    data = {
        "name": "tiny", "seed": SEED, "env": dict(env), "instances": {"train": str(train), "test": str(test)},
        "curriculum": dict(curriculum),
        "learner": {"kind": kind, "n_steps": STEPS, "net_arch": [16], **off_policy, **LEARNERS[kind], **learner},
        "rollout": {"shards": 1, "slots": SLOTS}, "budget": {"steps": ROUNDS * STEPS},
        "evaluation": {"every_steps": 10**6}, "tracking": {"uri": None}, "resources": {"workers": 0},
    }  # fmt: skip
    return configs.parse(data, "test")


def witnessed(config: RunConfig, folder: Path) -> Witness:
    """Our own loop's run of a config."""
    with begun(config, folder, resume=False, stop=StopRequests()) as active:
        witness = Witness(active.blueprint.config, active.setup)
        training = active.training(witness)
        assert isinstance(training.learner, SB3Learner)
        witness.learner, update = training.learner, training.learner.update

        def noting(*arguments: Any, **named: Any) -> Any:
            found = update(*arguments, **named)
            witness.advantages.append(found.advantages)
            return found

        training.learner.update = noting  # type: ignore[method-assign]
        training.run()
        witness.learned.append(training.learner.save())
    return witness


def replay(config: RunConfig, witness: Witness, callback: CurriculumCallback) -> None:
    """Have a script's model do what our loop's did: the same actions, and behind each round the same weights.

    What the environment answers must be the same then, and every selection, and the values behind it.
    """
    twin = Blueprint.of(config).learner()
    assert isinstance(twin, SB3Learner)
    model = twin.model
    instances = InstanceSet(np.arange(len(TARGETS)) + 10, TARGETS[:, None], ("target",))
    env = ContextVecEnv(config.env.id, instances, SLOTS, seed=config.seed, env_kwargs=config.env.kwargs)
    model.env, model.n_envs = env, SLOTS
    if isinstance(model, OffPolicyAlgorithm):
        model.train_freq = TrainFreq(STEPS // SLOTS, TrainFrequencyUnit.STEP)
    _, started = model._setup_learn(config.budget.steps, callback)
    head = twin.policy(0).head
    twin.load(*witness.learned[0])
    started.on_training_start({}, {})
    decided = iter(witness.decisions)
    known = next(decided)
    for number, shard in enumerate(witness.shards):
        started.on_rollout_start()
        if callback.selection.version != known.selection.version:
            known = next(decided)
            assert callback.numbers.keys() == known.numbers.keys()
        same_selection(callback.selection, witness.selections[number])
        np.testing.assert_allclose(callback.values, known.values, rtol=1e-5, atol=1e-6)
        # What our loop has torch compute as well, but for NumPy's tanh of SAC's and TD3's actions.
        if config.learner.policy == "MultiInputPolicy" and config.learner.kind not in ("sac", "td3"):
            assert callback.values.tobytes() == known.values.tobytes()
            assert callback.numbers == known.numbers
        for at, actions in enumerate(shard.actions):
            _, rewards, dones, _ = env.step(head.executed(actions))
            model.num_timesteps += SLOTS
            assert rewards.tolist() == shard.rewards[at].astype(np.float32).tolist()
            assert dones.tolist() == (shard.terminated[at] | shard.truncated[at]).tolist()
            assert started.on_step()
        sizes = witness.advantages[number]
        if sizes is not None:
            model.rollout_buffer.advantages = sizes.astype(np.float32)
        started.on_rollout_end()
        twin.load(*witness.learned[number + 1])
    started.on_training_end()
    last = witness.decisions[-1]
    same_selection(callback.selection, last.selection)
    np.testing.assert_allclose(callback.values, last.values, rtol=1e-5, atol=1e-6)
    assert len(list(decided)) <= 1  # the one behind the last round


def same_selection(one: Selection, other: Selection) -> None:
    assert (one.version, one.order_version, one.drawn) == (other.version, other.order_version, other.drawn)
    assert one.ids.tolist() == other.ids.tolist()
    assert one.contexts.tobytes() == other.contexts.tobytes()


@pytest.mark.parametrize("kind", LEARNERS)
@pytest.mark.parametrize("flat", [True, False])
def test_spaces_decisions_are_our_loops_for_every_learner(kind: str, flat: bool, tmp_path: Path) -> None:
    mlp, _, multi_input = (RecurrentPPOConfig if kind == "recurrent_ppo" else PPOConfig).policies
    policy = mlp if flat else multi_input
    env: dict[str, Any] = {"id": (DISCRETE if kind == "dqn" else LINE) if flat else PARTS}
    env |= {} if flat else {"kwargs": {"discrete": kind == "dqn"}}
    config = run_config(tmp_path, kind, env, SPACE, policy=policy)
    witness = witnessed(config, tmp_path / "run")
    sizes = [len(selection.ids) for selection in witness.selections]
    assert sizes[-1] > 1  # something was decided
    replay(config, witness, CurriculumCallback(**SPACE, round_steps=STEPS))


CURRICULA: dict[str, dict[str, Any]] = {
    "cspace": {"eta": 0.4}, "round_robin": {}, "fixed": {"count": 2}, "random_growth": {"eta": 0.4}, "uniform": {},
    "spdrl": {"warm_up": 1, "offset": 2}, "alp_gmm": {"fit_rate": 10, "components": 3},
    "alp_gmm over bounds": {"fit_rate": 10, "components": 3, "over": "bounds"}, "plr": {},
    "learnability": {"top": 2, "every": 2}, "learning_progress": {}, "edge": {}, "plr max_mc": {"score": "max_mc"},
    "currot": {"delta": 0.0, "particles": 8}, "currot over bounds": {"delta": 0.0, "particles": 8, "over": "bounds"},
    "accel": {"buffer": 8, "batch": 4, "filled_share": 0.3, "robust": False, "score": "max_mc"},
    "space with zero": {"eta": 0.4, "v0": "zero", "kappa": 2},
}  # fmt: skip


@pytest.mark.parametrize("name", CURRICULA)
def test_every_curriculums_decisions_are_our_loops(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {"kind": name.split()[0], **CURRICULA[name]}
    env = {"id": PARTS, "kwargs": {"discrete": True}}
    config = run_config(tmp_path, "ppo", env, settings, policy="MultiInputPolicy")
    witness = witnessed(config, tmp_path / "run")
    callback = CurriculumCallback(**settings)
    if settings["kind"] == "learnability":  # they act with other random numbers: the same evidence is what counts
        assert witness.probed

        def probed(session: Any, seen: Any) -> list[Outcomes]:  # noqa: ARG001
            return witness.probed.get(session.state.version, [])

        monkeypatch.setattr("space_dist.sb3.session.Session._probed", probed)
    replay(config, witness, callback)
    assert callback.selection.version >= 3


def test_the_ensembles_decisions_are_our_loops(tmp_path: Path) -> None:
    settings = {"kind": "vds", "n_batches": 2}
    config = run_config(tmp_path, "ppo", {"id": DISCRETE}, settings, gamma=0.9)
    witness = witnessed(config, tmp_path / "run")
    callback = CurriculumCallback(**settings)
    replay(config, witness, callback)
    assert callback.numbers["largest_disagreement"] == pytest.approx(
        witness.decisions[-1].numbers["largest_disagreement"]
    )


# ---- going on ----


def line_env(env_id: str = LINE, n_envs: int = SLOTS) -> ContextVecEnv:
    return ContextVecEnv(env_id, TARGETS, n_envs)


def ppo(env: Any, **settings: Any) -> PPO:
    return PPO("MlpPolicy", env, n_steps=10, batch_size=20, n_epochs=2, seed=1, device="cpu", **settings)


MODELS: dict[str, tuple[Any, str, dict[str, Any]]] = {
    "ppo": (PPO, LINE, {"n_steps": 10, "batch_size": 20, "n_epochs": 2}),
    "a2c": (A2C, LINE, {"n_steps": 5}),
    "trpo": (TRPO, LINE, {"n_steps": 10, "batch_size": 20}),
    "dqn": (DQN, DISCRETE, {"learning_starts": 20, "target_update_interval": 30, "train_freq": 4}),
    "sac": (SAC, LINE, {"learning_starts": 20, "batch_size": 16}),
    "td3": (TD3, LINE, {"learning_starts": 20, "batch_size": 16}),
}


def made(kind: str, **settings: Any) -> Any:
    algorithm, env_id, given = MODELS[kind]
    return algorithm("MlpPolicy", line_env(env_id), seed=1, device="cpu", **given, **settings)


def same_models(one: Any, other: Any) -> None:
    """Weights, steps, and what both remember, which holds the curriculum, the episodes and the random generators."""
    weights, others = one.policy.state_dict(), other.policy.state_dict()
    assert all(torch.equal(weights[name], others[name]) for name in weights)
    assert one.num_timesteps == other.num_timesteps
    assert getattr(one, STATE) == getattr(other, STATE)


@pytest.mark.parametrize("kind", MODELS)
def test_a_run_that_goes_on_is_the_run_left_alone(kind: str, tmp_path: Path) -> None:
    settings = {**SPACE, "round_steps": 40}
    left_alone, callback = made(kind), CurriculumCallback(**settings)
    left_alone.learn(110, callback=callback)  # rounds end with it, episodes don't
    assert unfinished_lengths(left_alone)
    left_alone.save(tmp_path / "m")
    if isinstance(left_alone, OffPolicyAlgorithm):
        left_alone.save_replay_buffer(tmp_path / "buffer")
    left_alone.learn(150, callback=callback, reset_num_timesteps=False)

    torch.manual_seed(99)
    np.random.seed(99)  # noqa: NPY002
    model = MODELS[kind][0].load(tmp_path / "m", env=line_env(MODELS[kind][1]), device="cpu")
    if isinstance(model, OffPolicyAlgorithm):
        model.load_replay_buffer(tmp_path / "buffer")
    again = CurriculumCallback(**settings)
    model.learn(150, callback=again, reset_num_timesteps=False)
    same_models(model, left_alone)
    same_selection(again.selection, callback.selection)
    assert again.selection.version > 1


def remembered(model: Any) -> Checkpoint:
    return decode_checkpoint(base64.b64decode(getattr(model, STATE)))


def unfinished_lengths(model: Any) -> list[int]:
    return [int(length) for length in remembered(model).arrays["unfinished/lengths"].ravel() if length]


@pytest.mark.parametrize("settings", [SPACE, {"kind": "plr"}, {"kind": "vds"}, {"kind": "spdrl", "warm_up": 1}])
def test_sb3s_own_checkpoints_hold_the_curriculum_wherever_they_were_made(
    settings: dict[str, Any], tmp_path: Path
) -> None:
    """PPO's, in the midst of a rollout, which is collected again."""
    total = 240
    alone, callback = ppo(line_env()), CurriculumCallback(**settings)
    alone.learn(total, callback=CallbackList([callback, CheckpointCallback(7, str(tmp_path), name_prefix="m")]))
    files = sorted(tmp_path.glob("m_*.zip"), key=lambda path: int(path.stem.split("_")[1]))
    assert len(files) == total // (7 * SLOTS)
    for file in files[1::3]:
        model = PPO.load(file, env=line_env(), device="cpu")
        assert model.num_timesteps % (10 * SLOTS)  # not where a rollout ends
        again = CurriculumCallback(**settings)
        model.learn(total - model.num_timesteps, callback=again, reset_num_timesteps=False)
        same_models(model, alone)
        same_selection(again.selection, callback.selection)


@pytest.mark.parametrize(
    ("kind", "settings"),
    [("ppo", SPACE), ("a2c", SPACE), ("trpo", SPACE), ("ppo", {"kind": "plr"}), ("ppo", {"kind": "vds"})],
)
def test_rounds_of_several_rollouts_go_on_from_wherever_they_were_saved(
    kind: str, settings: dict[str, Any], tmp_path: Path
) -> None:
    """What was learnt from in the round is played again; what was collected since, collected again."""
    total, asked = 480, {**settings, "round_steps": 120}
    alone, callback = made(kind), CurriculumCallback(**asked)
    alone.learn(total, callback=[callback, CheckpointCallback(13, str(tmp_path), name_prefix="m")])
    rollout = alone.n_steps * SLOTS
    saved, seen = sorted(tmp_path.glob("m_*.zip")), set()
    for file in saved:
        model = MODELS[kind][0].load(file, env=line_env(), device="cpu")
        seen.add(model.num_timesteps % 120 // rollout)
        again = CurriculumCallback(**asked)
        model.learn(total - model.num_timesteps, callback=again, reset_num_timesteps=False)
        same_models(model, alone)
        same_selection(again.selection, callback.selection)
    assert len(saved) == 9
    assert len(seen) > 2  # in whichever rollout of a round


class Cut(BaseCallback):
    """Ends `learn` in the midst of a rollout."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self._steps = steps

    def _on_step(self) -> bool:
        return self.n_calls < self._steps


@pytest.mark.parametrize("reset", [True, False])
def test_a_round_whose_later_rollout_is_cut_keeps_what_was_learnt_from(reset: bool) -> None:
    told: list[int] = []

    class Tell(CurriculumCallback):
        def _on_rollout_start(self) -> None:
            super()._on_rollout_start()
            told.append(self._begun.env.time)

    model, callback = ppo(line_env()), Tell(**SPACE, round_steps=120)
    model.learn(240, callback=[callback, Cut(25)])
    assert told == [0, 10, 20]  # steps of each slot
    told.clear()
    model.learn(80, callback=callback, reset_num_timesteps=reset)  # two rollouts
    assert told == [20, 0]
    assert callback.selection.version == 2  # behind the round, and where learn ended the next one


@pytest.mark.parametrize("round_steps", [None, 120])
@pytest.mark.parametrize("reset", [True, False])
def test_a_round_whose_last_update_is_interrupted_is_over(
    reset: bool, round_steps: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, callback = ppo(line_env()), CurriculumCallback(**SPACE, round_steps=round_steps)
    updates = iter(range(6))
    train = PPO.train

    def interrupted(self: PPO) -> None:
        if next(updates) == 2:
            raise KeyboardInterrupt
        train(self)

    monkeypatch.setattr(PPO, "train", interrupted)
    with pytest.raises(KeyboardInterrupt):
        model.learn(240, callback=callback)
    before = remembered(model).round
    driven: list[bool] = []

    class Watch(BaseCallback):
        def _on_step(self) -> bool:
            driven.append(self.training_env.driven)
            return True

    model.learn(40, callback=[callback, Watch()], reset_num_timesteps=reset)
    assert all(driven)
    assert len(driven) == 10
    assert remembered(model).round == before + 2  # the one that was interrupted, and the one that learn ended


def test_a_round_goes_on_only_where_it_has_the_same_shape_and_plays_the_same(tmp_path: Path) -> None:
    asked = {**SPACE, "round_steps": 120}
    ppo(line_env()).learn(240, callback=[CurriculumCallback(**asked), CheckpointCallback(25, str(tmp_path))])
    (file,) = tmp_path.glob("rl_model_100_*.zip")

    def loaded(n_envs: int = SLOTS, **settings: Any) -> Any:
        return PPO.load(file, env=line_env(n_envs=n_envs), device="cpu", custom_objects=settings)

    for others in (loaded(n_envs=2), loaded(n_steps=15)):
        others.learn(1, callback=CurriculumCallback(**asked), reset_num_timesteps=False)
        assert remembered(others).round == 2  # the next one; the one it was in is not played a second time
    liar = loaded()
    checkpoint = remembered(liar)
    checkpoint.arrays["learnt/rewards"][3, 1] += 1e-9
    setattr(liar, STATE, base64.b64encode(encode_checkpoint(checkpoint)).decode())
    with pytest.raises(SpaceDistError, match=r"breaks its word: .* earned .* in a step, and had earned"):
        liar.learn(1, callback=CurriculumCallback(**asked), reset_num_timesteps=False)
    for name, bad in (
        ("learnt/rewards", np.zeros((20, 3))), ("learnt/actions", np.zeros((20, SLOTS, 2))),
        ("learnt/actions", np.zeros((20, SLOTS, 1), dtype=np.complex64)),
    ):  # fmt: skip
        damaged, checkpoint = loaded(), remembered(liar)
        checkpoint.arrays[name] = bad
        setattr(damaged, STATE, base64.b64encode(encode_checkpoint(checkpoint)).decode())
        with pytest.raises(SpaceDistError, match="cannot be read"):
            damaged.learn(1, callback=CurriculumCallback(**asked), reset_num_timesteps=False)


def test_a_model_saved_behind_an_update_does_not_learn_from_its_rollout_twice(tmp_path: Path) -> None:
    class Save(BaseCallback):
        def _on_rollout_start(self) -> None:
            self.model.save(tmp_path / f"m{self.num_timesteps}")

        def _on_step(self) -> bool:
            return True

    ppo(line_env()).learn(120, callback=[Save(), CurriculumCallback(**SPACE)])
    model = PPO.load(tmp_path / "m80", env=line_env(), device="cpu")
    assert remembered(model).data["run"]["steps"] == 40  # what was remembered when the rollout before began
    model.learn(1, callback=CurriculumCallback(**SPACE), reset_num_timesteps=False)
    assert model.num_timesteps == 120


def test_an_off_policy_model_saved_in_the_midst_goes_on_with_its_curriculum(tmp_path: Path) -> None:
    callback = CurriculumCallback(**SPACE, round_steps=40)
    model = made("dqn")
    model.learn(200, callback=[callback, CheckpointCallback(39, str(tmp_path), name_prefix="m")])
    loaded = DQN.load(tmp_path / "m_156_steps.zip", env=line_env(DISCRETE), device="cpu")
    again, round_ = CurriculumCallback(**SPACE, round_steps=40), remembered(loaded).round
    loaded.learn(1, callback=again, reset_num_timesteps=False)
    assert remembered(loaded).round == round_ + 2  # the one that it was in is not played a second time
    assert loaded.num_timesteps > 156
    assert again.selection.version >= 3


@pytest.mark.parametrize("settings", [SPACE, {"kind": "plr"}])
def test_what_was_broken_off_is_begun_again(settings: dict[str, Any]) -> None:
    driven = []

    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            driven.append(self.training_env.driven)
            return self.n_calls != 15

    model, callback = ppo(line_env()), CurriculumCallback(**settings)
    model.learn(200, callback=[callback, Stop()])
    assert model.num_timesteps == 15 * SLOTS
    assert remembered(model).data["run"]["steps"] == 10 * SLOTS
    version = callback.selection.version
    model.learn(80, callback=[callback, Stop()], reset_num_timesteps=False)  # stopped once more
    model.learn(80, callback=[callback, Stop()], reset_num_timesteps=False)
    assert callback.selection.version > version
    assert all(driven)  # every step was one of the curriculum's own
    model.learn(40, callback=callback)  # SB3 begins to count anew, and the curriculum goes on
    assert model.num_timesteps == 40
    assert callback.selection.version > version + 1


def test_two_curricula_of_one_model_are_refused() -> None:
    inner = CallbackList([CurriculumCallback("round_robin")])
    with pytest.raises(ConfigError, match="2 CurriculumCallbacks"):
        ppo(line_env()).learn(1, callback=[CurriculumCallback("space"), CheckpointCallback(1000, "."), inner])


def test_without_gradient_steps_nothing_counts_as_settled() -> None:
    model, callback = made("dqn"), CurriculumCallback("space", round_steps=16)
    model.learn(96, callback=callback)
    tests, version = callback.numbers["tests"], callback.selection.version
    assert tests > 0
    model.gradient_steps = 0
    model.learn(96, callback=callback, reset_num_timesteps=False)  # ends the iteration that had some
    assert callback.numbers["tests"] <= tests + 1
    tests, version = callback.numbers["tests"], callback.selection.version
    model.learn(96, callback=callback, reset_num_timesteps=False)
    assert callback.selection.version > version
    assert callback.numbers["tests"] == tests


def test_another_curriculum_than_the_model_remembers_is_refused(tmp_path: Path) -> None:
    model = ppo(line_env())
    model.learn(80, callback=CurriculumCallback("space", eta=0.4))
    model.save(tmp_path / "m")

    def loaded(targets: Any = TARGETS) -> PPO:
        return PPO.load(tmp_path / "m", env=ContextVecEnv(LINE, targets, SLOTS), device="cpu")

    with pytest.raises(ConfigError, match=r"another curriculum: curriculum\.eta was 0\.4 and is 0\.2.*resume=False"):
        loaded().learn(40, callback=CurriculumCallback("space", eta=0.2))
    with pytest.raises(ConfigError, match=r"curriculum\.kind was space and is uniform"):
        loaded().learn(40, callback=CurriculumCallback("uniform"))
    with pytest.raises(ConfigError, match=r"another curriculum: the instances are others\. Ask"):
        loaded(TARGETS[:-1]).learn(40, callback=CurriculumCallback("space", eta=0.4))
    with pytest.raises(ConfigError, match=r"curriculum\.kappa was the default and is 2\. Ask"):
        loaded().learn(40, callback=CurriculumCallback("space", eta=0.4, kappa=2))
    scaled = PPO.load(tmp_path / "m", env=VecNormalize(line_env()), device="cpu")
    with pytest.raises(ConfigError, match=r"VecNormalize was of nothing and is of observations and rewards\. Ask"):
        scaled.learn(40, callback=CurriculumCallback("space", eta=0.4))
    anew = CurriculumCallback("uniform", resume=False)
    loaded().learn(40, callback=anew)
    assert anew.selection.version == 1
    fewer = PPO.load(tmp_path / "m", env=line_env(n_envs=2), device="cpu")
    fewer.learn(40, callback=CurriculumCallback("space", eta=0.4), reset_num_timesteps=False)  # other slots begin anew


def test_what_cannot_be_read_is_refused_in_a_sentence() -> None:
    model = ppo(line_env())
    model.learn(80, callback=CurriculumCallback(**SPACE))
    text = getattr(model, STATE)
    content = base64.b64decode(text)
    damaged = bytearray(content)
    damaged[len(content) // 2] ^= 1
    for wrong in (
        7,
        "",
        "?",
        text[:100],
        base64.b64encode(bytes(damaged)).decode(),
        base64.b64encode(b"pickle").decode(),
    ):
        again = ppo(line_env())
        setattr(again, STATE, wrong)
        with pytest.raises(SpaceDistError, match=r"cannot be read \(.*resume=False"):
            again.learn(40, callback=CurriculumCallback(**SPACE))


# ---- what a model's values are ----


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda env: QRDQN("MlpPolicy", env, device="cpu"), lambda p, o: p.quantile_net(o).mean(1).max(1).values),
        (lambda env: DQN("MlpPolicy", env, device="cpu"), lambda p, o: p.q_net(o).max(1).values),
        (lambda env: MaskablePPO("MlpPolicy", env, device="cpu"), lambda p, o: p.predict_values(o)[:, 0]),
    ],
)
def test_values_of_models_with_discrete_actions(make: Callable[..., Any], expected: Callable[..., Any]) -> None:
    env = line_env(DISCRETE)
    model, observations = make(env), np.random.default_rng(0).uniform(-1, 1, (5, 2)).astype(np.float32)
    found = Scored(model, Wrapped(env)).values(observations)
    with torch.no_grad():
        assert found.tolist() == expected(model.policy, torch.as_tensor(observations)).double().tolist()


def test_values_of_models_with_continuous_actions() -> None:
    env, observations = line_env(), np.random.default_rng(0).uniform(-1, 1, (5, 2)).astype(np.float32)
    inputs = torch.as_tensor(observations)
    for algorithm in (SAC, TD3, TQC, CrossQ):
        model = algorithm("MlpPolicy", env, device="cpu")
        found = Scored(model, Wrapped(env)).values(observations)
        actions, _ = model.predict(observations, deterministic=True)  # the line's actions are scaled already
        with torch.no_grad():
            critics = model.critic(inputs, torch.as_tensor(actions))
            expected = critics.mean((1, 2)) if algorithm is TQC else torch.minimum(*critics)[:, 0]
        np.testing.assert_allclose(found, expected.numpy(), rtol=1e-5, atol=1e-6)


def test_a_recurrent_policy_has_the_value_of_one_that_remembers_nothing() -> None:
    env = line_env()
    model = RecurrentPPO("MlpLstmPolicy", env, n_steps=10, batch_size=20, seed=0, device="cpu")
    callback = CurriculumCallback(**SPACE)
    model.learn(80, callback=callback)
    observations = env.reset()
    states = tuple(torch.zeros(1, SLOTS, 256) for _ in range(2))
    with torch.no_grad():
        expected = model.policy.predict_values(torch.as_tensor(observations), states, torch.ones(SLOTS))[:, 0]
    assert Scored(model, Wrapped(env)).values(observations).tolist() == expected.double().tolist()
    assert callback.selection.version > 0


def test_a_change_of_scale_is_no_progress() -> None:
    """With nothing learnt, values of new scales equal those of old weights under new scales."""
    env = VecNormalize(line_env(), gamma=0.9)
    model, callback = ppo(env, learning_rate=0.0, gamma=0.9), CurriculumCallback("space")
    model.learn(120, callback=callback)
    assert callback.numbers["largest_pic"] == callback.numbers["smallest_pic"] == 0.0
    raw = env.venv.reset()
    with torch.no_grad():
        inputs = torch.as_tensor(np.asarray(env.normalize_obs(raw)))
        scaled = model.policy.predict_values(inputs)[:, 0].double().numpy()
    found = Scored(model, Wrapped(env)).values(raw)
    np.testing.assert_allclose(found, scaled * np.sqrt(env.ret_rms.var + env.epsilon), rtol=1e-6)


# ---- the examples ----


def examples() -> dict[str, str]:
    """By name, what changes in each."""
    return {
        plain: "".join(
            difflib.unified_diff(
                (EXAMPLES / f"{plain}.py").read_text().splitlines(keepends=True),
                (EXAMPLES / f"{plain}_space.py").read_text().splitlines(keepends=True),
                n=1,
            )
        )
        for plain in ("ppo_lander", "dqn_cartpole")
    }


def test_the_examples_are_a_few_lines_apart_and_shown_as_they_are() -> None:
    shown = re.findall(r"```diff\n(.*?)```", DOCUMENT.read_text(), flags=re.DOTALL)
    for diff, block in zip(examples().values(), shown, strict=True):
        body = "".join(diff.splitlines(keepends=True)[2:])
        assert body == block
        assert 0 < len(re.findall(r"^[+-]", body, flags=re.MULTILINE)) <= 10
    (lander,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "your_environment.md").read_text(), flags=re.DOTALL)
    assert (EXAMPLES / "my_lander.py").read_text() == lander


@pytest.mark.parametrize("name", ["ppo_lander", "ppo_lander_space", "dqn_cartpole", "dqn_cartpole_space"])
def test_the_examples_run_and_import_neither_ray_nor_mlflow(name: str, tmp_path: Path) -> None:
    program = (
        "import json, runpy, sys; sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__'); "
        "print(json.dumps([name for name in ('ray', 'mlflow', 'space_dist.learner') if name in sys.modules]))"
    )
    environment = {name: value for name, value in os.environ.items() if name not in SETTINGS}
    environment["PYTHONPATH"] = f"{EXAMPLES}{os.pathsep}{ROOT}"
    done = subprocess.run(
        [sys.executable, "-c", program, str(EXAMPLES / f"{name}.py"), "4096"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=PATIENCE,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == []
    assert ("curriculum/" in done.stdout) == name.endswith("_space")
    assert len(list(tmp_path.glob("*.zip"))) == 1


def test_a_script_computes_as_it_did() -> None:
    """Settings for the same bits everywhere would have its matrix products take several times as long."""
    program = "import os, stable_baselines3, space_dist.sb3; print(sorted(os.environ))"
    environment = {name: value for name, value in os.environ.items() if name not in SETTINGS}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=PATIENCE
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert not set(SETTINGS).intersection(ast.literal_eval(done.stdout))


def test_the_document_is_linked() -> None:
    assert "(docs/sb3.md)" in (ROOT / "README.md").read_text()
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", DOCUMENT.read_text()):
        assert (DOCUMENT.parent / target).exists(), target


def test_spaces_of_parts_are_seen() -> None:
    env = ContextVecEnv(PARTS, TARGETS, 2)
    assert isinstance(env.observation_space, spaces.Dict)
    model = PPO("MultiInputPolicy", env, n_steps=8, batch_size=8, seed=0, device="cpu")
    callback = CurriculumCallback("space", eta=0.9)
    model.learn(64, callback=callback)
    assert callback.selection.version > 0
