"""RecurrentPPO: as sb3-contrib collects and learns, and what is remembered of an episode wherever it goes on."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sb3_contrib import RecurrentPPO
from sb3_contrib.ppo_recurrent.policies import MlpLstmPolicy
from stable_baselines3.common.policies import ActorCriticPolicy

from space_dist import load_policy
from space_dist.config import RecurrentPPOConfig
from space_dist.curricula import Selection
from space_dist.envs import BatchedEnv, make_batched
from space_dist.errors import ConfigError
from space_dist.learner import make_learner
from space_dist.learner.recurrent import RecurrentTorchPolicy, _torchs_own_lstm
from space_dist.ledger import METRICS, Ledger
from space_dist.rollout import Outcomes, Rollout, Shard, Stage, Trial, collect, evaluate
from space_dist.rollout.memory import Memory
from space_dist.rollout.walk import Walk
from space_dist.run.building import Blueprint
from space_dist.run.launch import policy_of
from space_dist.seeding import Purpose, generator, global_generators
from tests.test_learner import Ignore
from tests.test_learners import config_for, crashed, interrupted, learner_section, run, with_checkpoints
from tests.test_walk import LINE, POINTMASS, Noted, Played

GLIMPSED = "tests.tiny_env:make_glimpsed"
LSTMS: dict[str, dict[str, bool]] = {
    "two": {}, "shared": {"shared_lstm": True, "enable_critic_lstm": False}, "actor's": {"enable_critic_lstm": False},
}  # fmt: skip
SHARDS, SLOTS = 2, 3
STATES = ("hidden_states_pi", "cell_states_pi", "hidden_states_vf", "cell_states_vf")


def learner_for(env: BatchedEnv, length: int, **changes: Any) -> Any:
    n_steps = SHARDS * SLOTS * length
    settings: dict[str, Any] = {
        "kind": "recurrent_ppo", "net_arch": (8,), "lstm_hidden_size": 6, "n_lstm_layers": 2, "n_steps": n_steps,
        "gamma": 0.9, "gae_lambda": 0.8, "log_std_init": 0.7, "batch_size": 16, "n_epochs": 2, "learning_rate": 1e-2,
        **changes,
    }  # fmt: skip
    return make_learner(
        RecurrentPPOConfig(**settings), env.observation_space, env.action_space, seed=0, n_slots=SHARDS * SLOTS,
        slot_length=length, total_steps=5 * n_steps,
    )  # fmt: skip


def twin_of(learner: Any, env: Any, length: int) -> Any:
    """sb3-contrib's own algorithm with the learner's settings and weights."""
    config: RecurrentPPOConfig = learner._settings
    lstm = {"lstm_hidden_size": 6, "shared_lstm": config.shared_lstm, "enable_critic_lstm": config.enable_critic_lstm}
    twin: Any = RecurrentPPO(
        "MlpLstmPolicy", env, n_steps=length, gamma=0.9, gae_lambda=0.8, batch_size=16, n_epochs=2, learning_rate=1e-2,
        policy_kwargs={"net_arch": [8], "n_lstm_layers": 2, **lstm}, device="cpu",
    )  # fmt: skip
    twin.policy.load_state_dict(learner.model.policy.state_dict())
    return twin


def collected(learner: Any, stages: list[Stage], selection: Selection, walk: Walk, at: int, length: int) -> list[Shard]:
    shards = []
    for number, stage in enumerate(stages):
        rollout = Rollout(
            learner.policy(at), selection, walk.position(selection, number, SHARDS), 0.9, seed=1, round=at,
            shard=number, unfinished=walk.running(number),
        )  # fmt: skip
        shards += collect(stage, [rollout], length=length)
    return shards


def after(walk: Walk, selection: Selection, shards: list[Shard]) -> Walk:
    begun, unfinished = [one.begun for one in shards], [one.unfinished for one in shards]
    return walk.after(selection, begun, unfinished, n_shards=SHARDS)


def some_contexts(env: Any) -> Selection:
    bounds = env.context_bounds
    contexts = np.random.default_rng(0).uniform(bounds.low, bounds.high, size=(5, len(bounds.names)))
    return Selection(0, np.arange(5), contexts, 0)


@pytest.mark.parametrize("lstms", LSTMS)
@pytest.mark.parametrize(("env_id", "length"), [(POINTMASS, 37), (LINE, 5)])
def test_five_rounds_are_those_that_sb3_contrib_collects(env_id: str, length: int, lstms: str) -> None:
    """Its buffer: values and states of an episode that goes on, bootstraps of what is truncated, advantages."""
    stages = [Stage(Noted(make_batched(env_id, SLOTS, context_visible=False))) for _ in range(SHARDS)]  # type: ignore[arg-type]
    env = stages[0].env
    learner = learner_for(env, length, **LSTMS[lstms], batch_size=SHARDS * SLOTS * length)
    with torch.no_grad():
        learner.model.policy.value_net.bias.fill_(1.5)
        if env_id == POINTMASS:
            learner.model.policy.action_net.bias.copy_(torch.tensor([0.0, -0.35]))  # some crash on the wall, not all
    selection, walk = some_contexts(env), Walk(-1, ())

    def hand_out(slot: int) -> Any:
        ahead = stages[slot // SLOTS].env.begun[slot % SLOTS]  # type: ignore[attr-defined]
        return ahead.popleft() if ahead else (selection.contexts[0], 0)  # an episode that ours begins later

    played = Played(make_batched(env_id, SHARDS * SLOTS, context_visible=False), hand_out)
    twin = twin_of(learner, played, length)
    waiting: set[int] = set()  # slots whose episode ended with the round: sb3-contrib has begun the next one ahead
    went_on = ended = 0
    for at in range(5):
        shards = collected(learner, stages, selection, walk, at, length)
        walk = after(walk, selection, shards)
        if at == 0:
            _, callback = twin._setup_learn(5 * SHARDS * SLOTS * length, Ignore())
        elif waiting:
            late = np.array(sorted(waiting))
            twin._last_obs[late] = played.begin(late)
        waiting = {slot for slot in range(SHARDS * SLOTS) if not shards[slot // SLOTS].unfinished.lengths[slot % SLOTS]}
        twin.policy.load_state_dict(learner.model.policy.state_dict())
        acts = iter(np.concatenate([one.actions for one in shards], axis=1))
        shape = (length, SLOTS, *(env.action_space.shape or ()))
        noise = iter(np.concatenate([
            generator(1, Purpose.ACTIONS, at, number).standard_normal(shape, dtype=np.float32)
            for number in range(SHARDS)
        ], axis=1))  # fmt: skip

        def forward(observations: torch.Tensor, states: Any, starts: torch.Tensor) -> Any:
            """sb3-contrib's own policy; its sample is the mean and our noise: the recorded actions, up to rounding."""
            normal = twin.policy.get_distribution(observations, states.pi, starts)[0].distribution
            sampled = normal.mean + normal.stddev * torch.as_tensor(next(noise))  # noqa: B023
            actions = torch.as_tensor(next(acts))  # noqa: B023
            torch.testing.assert_close(actions, sampled, rtol=1e-5, atol=1e-5)
            values, log_probs, _ = twin.policy.evaluate_actions(observations, actions, states, starts)
            following = MlpLstmPolicy.forward(twin.policy, observations, states, starts, deterministic=True)[3]
            return actions, values, log_probs, following

        twin.policy.forward = forward
        assert twin.collect_rollouts(played, callback, twin.rollout_buffer, length)
        ours, theirs = learner.fill(shards), twin.rollout_buffer
        for name in ("observations", "actions", "episode_starts"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=f"{name} of round {at}")
        for name in ("rewards", "values", "log_probs", "advantages", "returns"):
            np.testing.assert_allclose(
                getattr(ours, name), getattr(theirs, name), rtol=1e-5, atol=1e-5, err_msg=f"{name} of round {at}"
            )
        begins = ours.episode_starts[:, None, :, None]  # where sb3-contrib keeps what it then multiplies by 0
        for name in STATES:
            np.testing.assert_allclose(
                getattr(ours, name) * (1.0 - begins), getattr(theirs, name) * (1.0 - begins), rtol=1e-5, atol=1e-5,
                err_msg=f"{name} of round {at}",
            )  # fmt: skip
        assert np.abs(ours.hidden_states_pi[0]).max() > 0 or at == 0
        went_on += int((~ours.episode_starts[0].astype(bool)).sum())
        ended += sum(len(one.episodes) for one in shards)
        learner.update(shards, round=at, steps=(at + 1) * SHARDS * SLOTS * length)
    assert went_on > 5
    assert ended > 5


@pytest.mark.parametrize("lstms", LSTMS)
@pytest.mark.parametrize("env_id", ["tests.tiny_env:make", "tests.tiny_env:make_discrete"])
def test_updates_are_those_of_sb3_contrib_to_the_bit(env_id: str, lstms: str) -> None:
    length = 7
    stages = [Stage(make_batched(env_id, SLOTS, context_visible=False)) for _ in range(SHARDS)]
    learner = learner_for(stages[0].env, length, **LSTMS[lstms])
    twin = twin_of(learner, Played(make_batched(env_id, SHARDS * SLOTS, context_visible=False), None), length)
    twin.set_logger(copy.deepcopy(learner.model.logger))
    selection, walk = some_contexts(stages[0].env), Walk(-1, ())
    for at in range(3):
        shards = collected(learner, stages, selection, walk, at, length)
        walk = after(walk, selection, shards)
        twin.rollout_buffer = copy.deepcopy(learner.fill(shards))
        before = {name: tensor.clone() for name, tensor in learner.model.policy.state_dict().items()}
        update = learner.update(shards, round=at, steps=(at + 1) * SHARDS * SLOTS * length)
        with global_generators(0, Purpose.UPDATE, at), _torchs_own_lstm():
            twin.train()
        theirs = twin.policy.state_dict()
        for name, ours in learner.model.policy.state_dict().items():
            assert torch.equal(ours, theirs[name]), (at, name)
            assert not torch.equal(ours, before[name]), (at, name)
        assert update.gradient_steps == 2 * 3  # minibatches of 16 of 42 transitions
        assert update.advantages is not None
        assert update.advantages.shape == (length, SHARDS * SLOTS)


def test_rounds_without_a_reward_teach_the_critic_alone() -> None:
    stages = [Stage(make_batched(LINE, SLOTS, context_visible=False)) for _ in range(SHARDS)]
    learner = learner_for(stages[0].env, 7, unrewarded="critic")
    shards = collected(learner, stages, some_contexts(stages[0].env), Walk(-1, ()), 0, 7)
    before = {name: tensor.clone() for name, tensor in learner.model.policy.state_dict().items()}
    none = [dataclasses.replace(shard, rewards=np.zeros_like(shard.rewards)) for shard in shards]
    learner.update(none, round=0, steps=SHARDS * SLOTS * 7)
    for name, now in learner.model.policy.state_dict().items():
        critics = "critic" in name or "value_net" in name
        assert torch.equal(now, before[name]) != critics, name


# ---- memory ----


def policies() -> tuple[BatchedEnv, RecurrentTorchPolicy]:
    env = make_batched(GLIMPSED, 4, context_visible=False)
    return env, learner_for(env, 5).policy(0)


def test_a_policy_acts_as_predict_does_from_episode_to_episode() -> None:
    env, policy = policies()
    network: Any = learner_for(env, 5).model.policy
    memory, states = Memory(policy, 4), None
    random = np.random.default_rng(0)
    for time in range(12):
        observations = random.uniform(-1.0, 1.0, size=(4, 2)).astype(np.float32)
        begun = random.random(4) < 0.3 if time else np.ones(4, dtype=np.bool_)
        memory.forget(np.flatnonzero(begun))
        expected, states = network.predict(observations, states, begun, deterministic=True)
        told = policy.head.executed(policy.head.best(memory.outputs(observations)))
        np.testing.assert_allclose(told, expected, rtol=1e-5, atol=1e-6)
        assert memory.values is not None
        assert memory.values.shape == (4, policy.memory_size) == (4, 4 * 2 * 6)
        np.testing.assert_allclose(memory.values[:, :6], states[0][0], rtol=1e-5, atol=1e-6)
    again = policy.outputs(observations)
    assert np.abs(again - memory.outputs(observations)).max() > 1e-4  # what was seen decides


def test_whoever_goes_on_with_an_episode_remembers_the_same() -> None:
    """On the stage where it runs, or played again from what a checkpoint or a message holds of it."""
    length = 5
    stages = [Stage(make_batched(GLIMPSED, SLOTS, context_visible=False)) for _ in range(SHARDS)]
    learner = learner_for(stages[0].env, length)
    selection, walk = some_contexts(stages[0].env), Walk(-1, ())
    for at in range(4):
        fresh = [Stage(make_batched(GLIMPSED, SLOTS, context_visible=False)) for _ in range(SHARDS)]
        elsewhere = collected(learner, fresh, selection, copy.deepcopy(walk), at, length)
        shards = collected(learner, stages, selection, walk, at, length)
        for one, two in zip(shards, elsewhere, strict=True):
            assert one.unfinished.same(two.unfinished)
            assert one.memory is not None
            assert two.memory is not None
            assert one.memory.tobytes() == two.memory.tobytes()
            assert one.actions.tobytes() == two.actions.tobytes()
            running = walk.running(one.shard)
            if running is not None:
                assert running.memory is not None
                assert one.memory.tobytes() == running.memory.tobytes()  # as it was left, by older weights
                assert one.memory[~one.starts].any(axis=1).all()
            assert not one.memory[one.starts].any()
        walk = after(walk, selection, shards)
        learner.update(shards, round=at, steps=(at + 1) * SHARDS * SLOTS * length)


def test_every_measured_episode_begins_with_nothing_remembered() -> None:
    """Of episodes that end apart, each has the outcome that it has alone."""
    env = make_batched("tests.test_rollout:Countdown", 4, context_visible=False)
    policy = learner_for(env, 5).policy(0)
    contexts, seeds = np.array([[1.0], [3.0], [2.0], [5.0]]), np.arange(4, dtype=np.uint64)
    (together,) = evaluate(env, [Trial(policy, contexts, seeds, 0.9)])
    alone: list[Outcomes] = []
    for index in range(4):
        one = make_batched("tests.test_rollout:Countdown", 1, context_visible=False)
        alone += evaluate(one, [Trial(policy, contexts[index : index + 1], seeds[index : index + 1], 0.9)])
    np.testing.assert_allclose(together.returns, [one.returns[0] for one in alone], rtol=1e-5)
    assert together.lengths.tolist() == [one.lengths[0] for one in alone] == [1, 3, 2, 5]
    for slots in (1, 2, 3):  # those that begin where others have ended, too
        fewer = make_batched("tests.test_rollout:Countdown", slots, context_visible=False)
        (in_turns,) = evaluate(fewer, [Trial(policy, contexts, seeds, 0.9)])
        assert in_turns.returns.tobytes() == together.returns.tobytes()
        assert in_turns.lengths.tolist() == [1, 3, 2, 5]


def test_start_values_are_those_of_episodes_that_begin() -> None:
    env, policy = policies()
    network: Any = learner_for(env, 5).model.policy
    observations = np.random.default_rng(1).uniform(-1.0, 1.0, size=(9, 2)).astype(np.float32)
    nothing = (torch.zeros(2, 9, 6), torch.zeros(2, 9, 6))
    with torch.no_grad():
        expected = network.predict_values(torch.as_tensor(observations), nothing, torch.ones(9))[:, 0]
    np.testing.assert_allclose(policy.values(observations), expected, rtol=1e-5, atol=1e-6)


# ---- learning ----


def learnt(folder: Path, **learner: Any) -> float:
    """Mean return on both instances, whose target is shown in an episode's first step alone.

    Seeds 0 to 3: 6.3 to 7.0 of RecurrentPPO, 2.4 to 4.7 of PPO.
    """
    steps = 12_288
    config = config_for(
        folder, {"n_steps": 512, "batch_size": 256, "n_epochs": 6, "learning_rate": 1e-2, "net_arch": [16],
                 "gamma": 0.8, "gae_lambda": 0.95, **learner},
        env={"id": GLIMPSED, "context_visible": False}, curriculum={"kind": "space"},
        rollout={"shards": 2, "slots": 16}, budget={"steps": steps}, evaluation={"every_steps": steps},
        checkpoint={"every_rounds": 1000},
    )  # fmt: skip
    (folder / "train.csv").write_text("id,target\n0,-0.75\n1,0.75\n")
    run(config, folder / "run")
    rows = Ledger(folder / "run").rows()
    return float(next(row for row in reversed(rows) if row["kind"] == "evaluation")["train"]["return"])


def test_what_was_seen_is_remembered_until_the_end(tmp_path: Path) -> None:
    """Who goes straight to a target that is shown once earns 7.2 of 8; who forgets it, 2 standing still."""
    remembering = learnt(tmp_path / "recurrent", kind="recurrent_ppo", lstm_hidden_size=16)
    forgetting = learnt(tmp_path / "forgetting", kind="ppo")
    assert remembering >= 6.0
    assert forgetting < 5.0


# ---- runs ----


def test_a_run_with_hidden_contexts_whose_curriculum_asks_for_advantages(tmp_path: Path) -> None:
    config = config_for(
        tmp_path, learner_section("recurrent_ppo"), env={"id": LINE, "context_visible": False},
        curriculum={"kind": "plr"},
    )  # fmt: skip
    run(config, tmp_path / "run")
    row = [row for row in Ledger(tmp_path / "run").rows() if row["kind"] == "iteration"][-1]
    assert row["curriculum"]["seen"] > 0
    policy = policy_of(Ledger(tmp_path / "run"), Blueprint.of(config).spec)
    assert isinstance(policy, RecurrentTorchPolicy)
    acting = load_policy(tmp_path / "run")
    observations = np.array([[0.1], [-0.4]], dtype=np.float32)
    first, state = acting.predict(observations)
    second, later = acting.predict(observations, state)
    assert state is not None
    assert later is not None
    assert (first != second).all()
    again, _ = acting.predict(observations, later, episode_start=[True, False])
    assert again[0] == first[0]
    assert again[1] != first[1]
    np.testing.assert_array_equal(acting.predict(observations[0])[0], acting.predict(observations[:1])[0][0])
    with pytest.raises(ConfigError, match=r"the state of 1 observations has the shape \(1, 32\), not \(2, 32\)"):
        acting.predict(observations[:1], state)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"shared_lstm": True}, "shared_lstm: true needs enable_critic_lstm: false"),
        ({"n_steps": 40, "batch_size": 13}, "batch_size = 13 leaves one of n_steps = 40 transitions"),
        ({"policy": "MlpPolicy"}, "learner.policy: not known; did you mean 'MlpLstmPolicy'"),
        ({"update": "lean"}, "learner.update"),
        ({"policy": f"{__name__}:Forgetful"}, "Forgetful' remembers 12 numbers of an episode, and by"),
        ({"policy": f"{__name__}:Plain"}, "Plain' is no policy of recurrent_ppo: no RecurrentActorCriticPolicy"),
    ],
)
def test_what_cannot_be_is_a_sentence(changes: dict[str, Any], words: str, tmp_path: Path) -> None:
    def made() -> None:
        Blueprint.of(config_for(tmp_path, learner_section("recurrent_ppo", **changes))).learner()

    with pytest.raises(ConfigError) as caught:
        made()
    assert words in str(caught.value)


class Plain(ActorCriticPolicy):
    """A policy that remembers nothing."""


class Forgetful(MlpLstmPolicy):
    """A policy that is not made with what it is given."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{**kwargs, "lstm_hidden_size": 3})


def test_a_policy_of_ones_own_remembers(tmp_path: Path) -> None:
    config = config_for(tmp_path, learner_section("recurrent_ppo", policy=f"{__name__}:Mine"))
    run(config, tmp_path / "run")
    assert Ledger(tmp_path / "run").status().state == "done"


class Mine(MlpLstmPolicy):
    """sb3-contrib's, by another name."""


@pytest.mark.parametrize("curriculum", [{"kind": "plr"}, {"kind": "vds", "n_batches": 2, "batch_size": 20}])
def test_a_fork_is_the_run_until_they_part_and_resumes(curriculum: dict[str, Any], tmp_path: Path) -> None:
    at = 100  # in the third round of six
    plain = config_for(tmp_path, learner_section("recurrent_ppo"), curriculum=curriculum)
    expected = run(plain, tmp_path / "plain")
    same = config_for(tmp_path, learner_section("recurrent_ppo"), curriculum=curriculum, fork={"seed": 0, "steps": at})
    assert run(same, tmp_path / "same") == expected
    other = same.model_copy(update={"seed": 1})
    found = run(other, tmp_path / "other")
    assert found["model.npz"] != expected["model.npz"]
    theirs, ours = (
        [row for row in Ledger(tmp_path / name).rows(METRICS) if row["steps"] <= at] for name in ("plain", "other")
    )
    assert ours == theirs
    seldom, folder = with_checkpoints(other, 20), tmp_path / "disturbed"
    interrupted(seldom, folder, 2)  # before they part
    crashed(seldom, folder, 2)  # behind that, back to where they did
    interrupted(seldom, folder, 1)
    assert run(other, folder) == found


@pytest.mark.parametrize("changes", [{"engine": "population"}, {"engine": "auto"}])
def test_it_learns_alone(changes: dict[str, Any], tmp_path: Path) -> None:
    config = config_for(tmp_path, learner_section("recurrent_ppo"), **changes)
    if changes["engine"] == "auto":
        assert Blueprint.of(config).config.engine == "single"
        return
    blueprint = Blueprint.of(config)
    with pytest.raises(ConfigError, match=r"learner\.kind: ppo or trpo, not recurrent_ppo"):
        blueprint.setup(*blueprint.instances())
