"""Episodes that go on across rounds: whoever goes on with them, what Stable-Baselines3 makes of them, and fairness."""

from __future__ import annotations

import dataclasses
from collections import defaultdict, deque
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from sb3_contrib import TRPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.vec_env import VecEnv

from space_dist.config import A2CConfig, PPOConfig, TRPOConfig
from space_dist.curricula import Selection
from space_dist.envs import BatchedEnv, BatchedSingles, make_batched
from space_dist.envs.interface import FloatArray, IntArray, Observations, Step
from space_dist.errors import SpaceDistError
from space_dist.instances import InstanceSet
from space_dist.learner import make_learner
from space_dist.learner.normaliser import _discounted
from space_dist.ledger import METRICS, Ledger
from space_dist.rollout import Rollout, Setup, Shard, Stage, Worker, collect, collecting
from space_dist.rollout.episodes import rounds_over
from space_dist.rollout.walk import Unfinished, Walk, Walking, stacked, unstacked
from space_dist.run.launch import launch
from space_dist.seeding import Purpose, episode_seeds, generator
from space_dist.system.interrupts import StopRequests
from tests.test_learner import Ignore
from tests.test_learners import config_for, learner_section
from tests.test_rollout import Countdown, bits, falling, setup_for, uniform, weights_for
from tests.tiny_env import HORIZON, Line

POINTMASS, LINE = "space_dist/PointMass-v0", "tests.tiny_env:make"
LENGTH, ROUNDS = 7, 24  # of PointMass's 100 steps


def setup(**changes: Any) -> Setup:
    return setup_for(slot_length=LENGTH, **changes)


def selection_in(at: int) -> Selection:
    """One that changes every ten rounds."""
    version = at // 10
    return Selection(version, 100 * version + np.arange(6), uniform(6, seed=version), version)


def going_on(one: Setup, worker: Any, rounds: int = ROUNDS) -> list[list[Shard]]:
    """What `worker(round, shard)` collects of every round and shard, one round after another."""
    walk, told = Walk(-1, ()), []
    for at in range(rounds):
        selection = selection_in(at)
        asked = {"round": at, "steps": 0, "selection_version": selection.version}
        shards = [
            worker(at, shard).collect(falling(version=at, seed=at), selection, walk, shard=shard, **asked)
            for shard in range(one.shards)
        ]
        walk = walk.after(
            selection, [shard.begun for shard in shards], [shard.unfinished for shard in shards], n_shards=one.walks
        )
        told.append(shards)
    return told


def test_an_episodes_seed_hangs_on_its_number_alone() -> None:
    """However many are drawn with it, and however many more its slot turns out to begin."""
    rollouts = [
        Rollout(falling(), selection_in(0), start=0, gamma=1.0, seed=3, round=5, shard=shard) for shard in (0, 2)
    ]
    walking, slots = Walking(rollouts, 4), np.array([0, 2, 3, 4, 7])  # three of the first's, two of the second's
    seeds = [walking.next(slots)[2] for _ in range(40)]
    for mine, shard in ((slice(3), 0), (slice(3, 5), 2)):
        told = np.concatenate([one[mine] for one in seeds])
        np.testing.assert_array_equal(told, episode_seeds(3, Purpose.EPISODES, 5, shard, count=len(told)))


# ---- whoever goes on ----


def test_whoever_goes_on_with_an_episode_gives_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    """At once, by playing it again, an actor with other shards in between, and one with more shards than it keeps."""
    one = setup()
    steady = Worker(one)
    expected = [[bits(shard) for shard in shards] for shards in going_on(one, lambda *_: steady)]
    assert {len(steady._stages), one.shards} == {3}

    def same(worker: Any) -> bool:
        return [[bits(shard) for shard in shards] for shards in going_on(one, worker)] == expected

    assert same(lambda *_: Worker(one))
    pair = Worker(one), Worker(one)
    assert same(lambda at, shard: pair[(at + shard) % 2])
    monkeypatch.setattr("space_dist.rollout.worker.LIVE", 1)
    crowded = Worker(one)
    assert same(lambda *_: crowded)
    assert len(crowded._stages) == 2


def test_going_on_at_once_plays_nothing_again(monkeypatch: pytest.MonkeyPatch) -> None:
    one = setup()
    worker, played = Worker(one), []
    replayed = collecting.replayed
    monkeypatch.setattr(collecting, "replayed", lambda env, table: played.append(1) or replayed(env, table))
    going_on(one, lambda *_: worker, rounds=5)
    assert len(played) == one.shards  # the first round's, of nothing


def test_whole_episodes_are_told_when_they_end_whatever_the_selection_is_by_then() -> None:
    """Every episode, flown alone from its context and seed with the actions of all its rounds."""
    slots, rounds = 4, 40
    noted = Noted(make_batched(POINTMASS, slots, context_visible=True))
    stage, parts, left = Stage(noted), [], None  # type: ignore[arg-type]
    for at in range(rounds):
        policy, selection = falling(version=at, seed=at), selection_in(at)
        parts += collect(stage, [Rollout(policy, selection, 0, 0.9, 3, at, 0, unfinished=left)], length=LENGTH)
        left = parts[-1].unfinished
    single = make_batched(POINTMASS, 1, context_visible=True)
    actions = np.clip(np.concatenate([part.actions for part in parts]), -10.0, 10.0)
    spanning = outlived = 0
    for slot in range(slots):
        began = 0
        for at, part in enumerate(parts):
            for row in np.flatnonzero(part.episodes.slots == slot):
                ended, (context, seed) = at * LENGTH + int(part.episodes.times[row]), noted.begun[slot].popleft()
                version, place = divmod(int(part.episodes.ids[row]), 100)
                np.testing.assert_array_equal(context, uniform(6, seed=version)[place])
                np.testing.assert_array_equal(part.episodes.contexts[row], context)
                single.reset(np.array([0]), context[None], np.array([seed], dtype=np.uint64))
                steps = [single.step(actions[time, slot][None]) for time in range(began, ended + 1)]
                assert [bool(step.terminated[0] | step.truncated[0]) for step in steps] == [False] * (
                    len(steps) - 1
                ) + [True]
                returns, discounted, discount = 0.0, 0.0, 1.0
                for step in steps:
                    returns, discounted = returns + step.rewards[0], discounted + discount * step.rewards[0]
                    discount *= 0.9
                assert (part.episodes.lengths[row], part.episodes.returns[row]) == (len(steps), returns)
                assert part.episodes.discounted_returns[row] == discounted
                assert part.episodes.success[row] == steps[-1].success[0]  # type: ignore[index]
                spanning, outlived = (
                    spanning + (len(steps) > 2 * LENGTH),
                    outlived + (version < selection_in(at).version),
                )
                began = ended + 1
        assert parts[-1].unfinished.lengths[slot] == rounds * LENGTH - began
    assert spanning > 10
    assert outlived > 0


def test_shards_in_any_company_go_on_with_the_same_bits() -> None:
    """As a population's members do that leave, join and change places: some of them have nothing to go on with."""

    def rollouts(at: int, before: dict[int, Unfinished], who: list[int]) -> list[Rollout]:
        return [
            Rollout(falling(version=at, seed=at + 10 * one), selection_in(at), one, 0.9, seed=one, round=at,
                    shard=0, unfinished=before.get(one))
            for one in who
        ]  # fmt: skip

    expected: dict[tuple[int, int], Any] = {}
    for one in range(3):
        stage, before = Stage(make_batched(POINTMASS, 2, context_visible=True)), {}
        for at in range(20):
            (shard,) = collect(stage, rollouts(at, before, [one]), length=LENGTH)
            before[one], expected[one, at] = shard.unfinished, bits(shard)
    before = {}
    stages = {n: Stage(make_batched(POINTMASS, 2 * n, context_visible=True)) for n in (1, 2, 3)}
    for at in range(20):
        companies = [[0, 1, 2]] if at < 5 else [[2, 0], [1]] if at < 12 else [[1, 0, 2]]
        for who in companies:
            for one, shard in zip(
                who, collect(stages[len(who)], rollouts(at, before, who), length=LENGTH), strict=True
            ):
                before[one] = shard.unfinished
                assert bits(shard) == expected[one, at]


@pytest.mark.parametrize("length", [3, 12])  # of a slot in a round; an episode has 8 steps
@pytest.mark.parametrize("engine", ["single", "population"])
def test_a_run_logs_whole_episodes_and_no_stub(length: int, engine: str, tmp_path: Path) -> None:
    slots, rounds = 8, 10
    steps = length * slots
    config = config_for(
        tmp_path, learner_section("ppo", n_steps=steps), engine=engine, budget={"steps": rounds * steps},
        evaluation={"every_steps": 10_000}, curriculum={"kind": "round_robin"},
    )  # fmt: skip
    launch(config, tmp_path / "run", resume=False, stop=StopRequests())
    rows = [row for row in Ledger(tmp_path / "run").rows(METRICS) if row["kind"] == "iteration"]
    assert {row["rollout"]["length"] for row in rows if row["episodes"]} == {HORIZON}
    assert sum(row["episodes"] for row in rows) == slots * (rounds * length // HORIZON)
    assert rows[-1]["steps"] == rounds * steps


# ---- environments that break the contract ----


class Forgetful(Countdown):
    """Lives longer, and earns more, the more episodes it has had."""

    def __init__(self, n_slots: int, *, earns: bool) -> None:
        super().__init__(n_slots)
        self.episodes, self.earns = 0, earns

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> Observations:
        self.episodes += len(slots)
        return super().reset(slots, contexts - (0.0 if self.earns else self.episodes), seeds)

    def step(self, actions: NDArray[np.generic]) -> Step:
        step = super().step(actions)
        return dataclasses.replace(step, rewards=step.rewards + self.episodes) if self.earns else step


@pytest.mark.parametrize(("earns", "words"), [(False, "ended after 2 steps, and had gone on for 3"),
                                              (True, r"earned 12\.0 in 3 steps, and had earned 9\.0")])  # fmt: skip
def test_an_episode_that_goes_another_way_when_played_again_is_told(earns: bool, words: str) -> None:
    env = Forgetful(1, earns=earns)
    policy, selection = weights_for(2, 1), Selection(0, np.array([7]), np.array([[5.0]]), 0)
    first = Rollout(policy, selection, 0, 0.9, seed=0, round=0, shard=0)
    (shard,) = collect(Stage(env), [first], length=3)
    if not earns:
        env.episodes = 2
    with pytest.raises(SpaceDistError, match=f"breaks its word.*{words}.*env check"):
        collect(Stage(env), [dataclasses.replace(first, round=1, unfinished=shard.unfinished)], length=3)


class Endless(Countdown):
    def step(self, actions: NDArray[np.generic]) -> Step:
        step = super().step(actions)
        self.ready[:] = True
        return dataclasses.replace(step, truncated=np.zeros(self.n_slots, dtype=np.bool_))


@pytest.mark.parametrize("episodes", [None, 1])
def test_an_episode_beyond_the_horizon_is_told(episodes: int | None) -> None:
    rollout = Rollout(weights_for(2, 1), Selection(0, np.array([7]), np.array([[50.0]]), 0), 0, 0.9, 0, 0, 0)
    with pytest.raises(SpaceDistError, match="after its horizon of 5 steps"):
        collect(Stage(Endless(1)), [rollout], length=5, episodes=episodes)


class Wandering(gym.Env[Any, Any]):
    """A user's own environment: everything random comes from Gymnasium's generator, which its reset seeds."""

    observation_space = spaces.Box(-np.inf, np.inf, shape=(1,), dtype=np.float32)
    action_space = spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32)
    context_space = spaces.Box(0.0, 1.0, shape=(1,), dtype=np.float32)
    horizon = 30

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.x = float(options["context"][0])
        return np.array([self.x], dtype=np.float32), {}

    def step(self, action: Any) -> Any:
        self.x += 0.1 * float(action[0]) + self.np_random.normal(0.0, 0.1)
        return np.array([self.x], dtype=np.float32), self.x, abs(self.x) > 1.5, False, {}


def test_single_environments_go_on_too() -> None:
    selection = Selection(0, np.arange(3), np.array([[0.2], [0.5], [0.9]]), 0)

    def chain(fresh: bool) -> list[Any]:
        stage, unfinished, found = None, None, []
        for at in range(12):
            stage = Stage(BatchedSingles(2, Wandering)) if fresh or stage is None else stage
            rollout = Rollout(weights_for(1, 1), selection, 0, 0.9, seed=0, round=at, shard=0, unfinished=unfinished)
            (shard,) = collect(stage, [rollout], length=4)
            unfinished = shard.unfinished
            found.append(shard)
        assert max(int(n) for shard in found for n in shard.episodes.lengths) > 16
        return [bits(shard) for shard in found]

    assert chain(fresh=False) == chain(fresh=True)


# ---- checkpoints ----


def test_what_is_unfinished_survives_being_arrays_and_what_does_not_fit_is_refused() -> None:
    one = setup()
    worker = Worker(one)
    left = tuple(shard.unfinished for shard in going_on(one, lambda *_: worker, rounds=9)[-1])
    arrays = stacked(Walk(0, (0, 0, 0), left))
    fit: dict[str, Any] = {"shards": 3, "slots": 4, "features": 3, "horizon": 100, "action_shape": (2,)}
    again = unstacked(arrays, **fit)
    assert all(mine.same(other) for mine, other in zip(left, again, strict=True))
    assert stacked(Walk(-1, ())) == {}
    lengths = arrays["lengths"]
    for changes in (
        {"lengths": -lengths}, {"lengths": lengths + 100}, {"lengths": lengths.astype(float)}, {"seeds": lengths},
        {"actions": arrays["actions"][:, 1:]}, {"actions": arrays["actions"].astype("U3")},
        {"contexts": arrays["contexts"][..., :2]}, {"more": lengths}, {"ids": arrays["ids"][:, :3]},
    ):  # fmt: skip
        with pytest.raises(SpaceDistError, match="episodes in progress are not those"):
            unstacked({**arrays, **changes}, **fit)
    with pytest.raises(SpaceDistError, match="another version"):
        unstacked({}, **fit)


# ---- as Stable-Baselines3 ----


class Noted:
    """A batched environment that notes with which context and seed each slot's episodes begin."""

    def __init__(self, env: BatchedEnv) -> None:
        self.env, self.begun = env, defaultdict(deque)  # type: ignore[var-annotated]

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def reset(self, slots: IntArray, contexts: FloatArray, seeds: NDArray[np.uint64]) -> Observations:
        for slot, context, seed in zip(slots.tolist(), contexts, seeds, strict=True):
            self.begun[slot].append((context, seed))
        return self.env.reset(slots, contexts, seeds)


class Played(VecEnv):
    """A batched environment as Stable-Baselines3 wants it: it resets by itself, with contexts and seeds handed out."""

    def __init__(self, env: BatchedEnv, hand_out: Any) -> None:
        super().__init__(env.n_slots, env.observation_space, env.action_space)
        self.env, self.hand_out = env, hand_out

    def begin(self, slots: NDArray[Any]) -> Any:
        contexts, seeds = zip(*(self.hand_out(int(slot)) for slot in slots), strict=True)
        return self.env.reset(slots, np.array(contexts), np.array(seeds, dtype=np.uint64))

    def reset(self) -> Any:
        self.now = self.begin(np.arange(self.num_envs)).copy()
        return self.now.copy()

    def step_async(self, actions: NDArray[Any]) -> None:
        self.given = actions

    def step_wait(self) -> Any:
        step = self.env.step(self.given)
        done, following = step.terminated | step.truncated, np.array(step.observations)
        infos: list[dict[str, Any]] = [{} for _ in done]
        for slot in np.flatnonzero(done):
            timeout = bool(step.truncated[slot] and not step.terminated[slot])
            infos[slot] = {"terminal_observation": following[slot].copy(), "TimeLimit.truncated": timeout}
        if done.any():
            following[done] = self.begin(np.flatnonzero(done))
        return following, step.rewards.astype(np.float32), done, infos

    def close(self) -> None: ...

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:  # noqa: ARG002
        return [None] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:  # noqa: ARG002
        return [False] * self.num_envs

    def set_attr(self, *_: Any) -> None:
        raise NotImplementedError

    env_method = set_attr


@pytest.mark.parametrize("kind", ["ppo", "trpo", "a2c"])
@pytest.mark.parametrize(("env_id", "length"), [(POINTMASS, 37), (LINE, 5)])
def test_five_rounds_are_those_that_stable_baselines3_collects(env_id: str, length: int, kind: str) -> None:
    n_shards, slots = 2, 3
    n_steps = n_shards * slots * length
    common = {"kind": kind, "net_arch": (8,), "n_steps": n_steps, "gamma": 0.9, "gae_lambda": 0.8, "log_std_init": 0.7}
    config: Any = {"ppo": PPOConfig, "trpo": TRPOConfig, "a2c": A2CConfig}[kind](
        **common, **({} if kind == "a2c" else {"batch_size": n_steps})
    )
    stages = [Stage(Noted(make_batched(env_id, slots, context_visible=True))) for _ in range(n_shards)]  # type: ignore[arg-type]
    env = stages[0].env
    learner: Any = make_learner(
        config, env.observation_space, env.action_space, seed=0, n_slots=n_shards * slots, slot_length=length,
        total_steps=5 * n_steps,
    )  # fmt: skip
    with torch.no_grad():
        learner.model.policy.value_net.bias.fill_(1.5)
        if env_id == POINTMASS:
            learner.model.policy.action_net.bias.copy_(torch.tensor([0.0, -0.35]))  # some crash on the wall, not all
    bounds = env.context_bounds
    contexts = np.random.default_rng(0).uniform(bounds.low, bounds.high, size=(5, len(bounds.names)))
    selection, walk = Selection(0, np.arange(5), contexts, 0), Walk(-1, ())

    def hand_out(slot: int) -> Any:
        ahead = stages[slot // slots].env.begun[slot % slots]  # type: ignore[attr-defined]
        return ahead.popleft() if ahead else (contexts[0], 0)  # an episode that ours begins with the next round

    played = Played(make_batched(env_id, n_shards * slots, context_visible=True), hand_out)
    twin: Any = {"ppo": PPO, "trpo": TRPO, "a2c": A2C}[kind](
        "MlpPolicy", played, n_steps=length, gamma=0.9, gae_lambda=0.8, policy_kwargs={"net_arch": [8]}, device="cpu",
        **({} if kind == "a2c" else {"batch_size": n_steps}),
    )  # fmt: skip
    names = ("observations", "actions", "rewards", "episode_starts", "values", "log_probs", "advantages", "returns")
    went_on = ended = 0
    waiting: set[int] = set()  # slots whose episode ended with the round: SB3 has begun the next one ahead of us
    for at in range(5):
        policy = learner.policy(at)
        shards = []
        for number, stage in enumerate(stages):
            rollout = Rollout(
                policy, selection, walk.position(selection, number, n_shards), 0.9, seed=1, round=at, shard=number,
                unfinished=walk.running(number),
            )  # fmt: skip
            shards += collect(stage, [rollout], length=length)
        walk = walk.after(
            selection, [one.begun for one in shards], [one.unfinished for one in shards], n_shards=n_shards
        )
        if at == 0:
            _, callback = twin._setup_learn(5 * n_steps, Ignore())
        elif waiting:
            late = np.array(sorted(waiting))
            twin._last_obs[late] = played.begin(late)
        waiting = {
            slot for slot in range(n_shards * slots) if not shards[slot // slots].unfinished.lengths[slot % slots]
        }
        twin.policy.load_state_dict(learner.model.policy.state_dict())
        acts = iter(np.concatenate([one.actions for one in shards], axis=1))
        noise = iter(np.concatenate([
            generator(1, Purpose.ACTIONS, at, number).standard_normal(
                (length, slots, *env.action_space.shape), dtype=np.float32
            )
            for number in range(n_shards)
        ], axis=1))  # fmt: skip

        def forward(observations: torch.Tensor) -> Any:
            """SB3's own policy; its sample is the mean and our noise: the recorded actions, up to rounding."""
            normal = twin.policy.get_distribution(observations).distribution
            with torch.no_grad():
                sampled = normal.mean + normal.stddev * torch.as_tensor(next(noise))  # noqa: B023
            actions = torch.as_tensor(next(acts))  # noqa: B023
            torch.testing.assert_close(actions, sampled, rtol=1e-5, atol=1e-5)
            values, log_probs, _ = twin.policy.evaluate_actions(observations, actions)
            return actions, values, log_probs

        twin.policy.forward = forward
        assert twin.collect_rollouts(played, callback, twin.rollout_buffer, length)
        ours = learner.fill(shards)
        for name in names:
            exact = name in ("observations", "actions", "episode_starts")
            np.testing.assert_allclose(
                getattr(ours, name), getattr(twin.rollout_buffer, name), err_msg=f"{name} of round {at}",
                rtol=0.0 if exact else 1e-5, atol=0.0 if exact else 1e-5,
            )  # fmt: skip
        went_on += int((~ours.episode_starts[0].astype(bool)).sum())
        ended += sum(len(one.episodes) for one in shards)
        learner.update(shards, round=at, steps=(at + 1) * n_steps)
    assert went_on > 5
    assert ended > 5


def test_discounted_returns_go_on_from_round_to_round_as_vec_normalizes() -> None:
    one = setup()
    worker = Worker(one)
    parts = [shards[0] for shards in going_on(one, lambda *_: worker)]
    running, found = np.zeros(one.slots), []
    for part in parts:
        sums, running = _discounted(part, 0.9, running)
        found.append(sums.reshape(LENGTH, one.slots))
    returns, expected = np.zeros(one.slots), []
    for part in parts:
        for rewards, done in zip(part.rewards, part.terminated | part.truncated, strict=True):
            returns = returns * 0.9 + rewards
            expected.append(returns.copy())
            returns[done] = 0.0
    np.testing.assert_array_equal(np.concatenate(found), expected)


# ---- fairness ----


class Steps(Line):
    """Ends after as many steps as its horizon says."""

    def __init__(self, n_slots: int, horizon: int) -> None:
        super().__init__(n_slots, spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32))
        self.horizon = horizon

    def step(self, actions: NDArray[np.generic]) -> Step:
        step = super().step(actions)
        return dataclasses.replace(step, truncated=self._time >= self.horizon)


def played_to_the_end(n: int, horizon: int, shards: int, slots: int, length: int, rounds: int) -> NDArray[np.int64]:
    """`(rounds, n)` how often each instance was played to its end in each round."""
    selection, walk = Selection(0, np.arange(n), np.linspace(-1.0, 1.0, n)[:, None], 0), Walk(-1, ())
    stages = [Stage(Steps(slots, horizon)) for _ in range(shards)]
    policy, counts = weights_for(1, 1), np.zeros((rounds, n), dtype=np.int64)
    for at in range(rounds):
        told = []
        for number, stage in enumerate(stages):
            place = walk.position(selection, number, shards)
            rollout = Rollout(policy, selection, place, 0.9, 0, at, number, unfinished=walk.running(number))
            told += collect(stage, [rollout], length=length)
        walk = walk.after(selection, [one.begun for one in told], [one.unfinished for one in told], n_shards=shards)
        for one in told:
            np.add.at(counts[at], one.episodes.ids, 1)
    return counts


@settings(max_examples=40)
@given(
    n=st.integers(1, 200), horizon=st.integers(1, 30), shards=st.integers(1, 6), slots=st.integers(1, 6),
    length=st.integers(1, 40), data=st.data(),
)  # fmt: skip
def test_where_nothing_ends_early_every_instance_is_played_to_its_end_equally_often(
    n: int, horizon: int, shards: int, slots: int, length: int, data: Any
) -> None:
    """To within one, over any stretch of rounds."""
    rounds = min(40, 2 + 2 * n * horizon // (shards * slots * length))
    counts = played_to_the_end(n, horizon, shards, slots, length, rounds)
    first = data.draw(st.integers(0, rounds - 1))
    for since in (0, first):
        assert np.ptp(counts[since:].cumsum(axis=0), axis=1).max() <= 1


@pytest.mark.parametrize("n", [32, 64, 96, 100, 128])
def test_the_slots_rhythm_leaves_nobody_out(n: int) -> None:
    """The issue's case: 128 steps a slot and a horizon of 100."""
    counts = played_to_the_end(n, 100, 4, 4, 128, 20).sum(axis=0)
    assert np.ptp(counts) <= 1
    assert counts.sum() == 16 * (20 * 128 // 100)


@given(n=st.integers(1, 40), shards=st.integers(1, 5), slots=st.integers(1, 4), seed=st.integers(0, 99))
@settings(max_examples=40)
def test_where_episodes_end_early_counts_differ_by_no_more_than_shards_and_slots(
    n: int, shards: int, slots: int, seed: int
) -> None:
    """Begun: by the shards. Ended: by the slots as well, in each of which one may run."""
    random = np.random.default_rng(seed)
    lives = random.integers(1, 6, size=n).astype(np.float64)
    selection, walk = Selection(0, np.arange(n), lives[:, None], 0), Walk(-1, ())
    stages, ended = [Stage(Countdown(slots)) for _ in range(shards)], np.zeros(n, dtype=np.int64)
    for at in range(15):
        told = []
        for number, stage in enumerate(stages):
            place = walk.position(selection, number, shards)
            rollout = Rollout(weights_for(2, 1), selection, place, 0.9, seed, at, number,
                              unfinished=walk.running(number))  # fmt: skip
            told += collect(stage, [rollout], length=int(random.integers(1, 9)) if shards == 1 else 4)
        walk = walk.after(selection, [one.begun for one in told], [one.unfinished for one in told], n_shards=shards)
        running = np.zeros(n, dtype=np.int64)
        for one in told:
            np.add.at(ended, one.episodes.ids, 1)
            np.add.at(running, one.unfinished.ids[one.unfinished.lengths > 0], 1)
        assert np.ptp(ended + running) <= shards
        assert np.ptp(ended) <= shards + shards * slots


def test_every_member_of_a_population_meets_the_whole_selection() -> None:
    four = setup(
        shards=8, policies=4, train=InstanceSet(np.arange(24), uniform(24), ("gate_x", "gate_width", "friction"))
    )
    selection = Selection(0, four.train.ids, four.train.contexts, 0)
    fresh = Walk(-1, ())
    assert [fresh.position(selection, shard, four.walks) for shard in range(8)] == [0, 12] * 4
    later = fresh.after(selection, list(range(8)), [], n_shards=four.walks)
    assert later.positions == (0, 13, 2, 15, 4, 17, 6, 19)
    new = dataclasses.replace(selection, version=1, order_version=1)
    assert [later.position(new, shard, four.walks) for shard in range(8)] == [0, 12] * 4


@settings(deadline=None)
@given(horizon=st.integers(1, 400), n_steps=st.integers(1, 10_000), episodes=st.integers(1, 2_000))
@example(horizon=7, n_steps=300, episodes=300)  # 300 / (300 / 7) is more than 7
def test_an_iteration_is_no_round_longer_than_its_passes_take(horizon: int, n_steps: int, episodes: int) -> None:
    rounds = rounds_over(float(episodes), horizon, n_steps)
    assert rounds * n_steps >= episodes * horizon
    assert rounds == 1 or (rounds - 1) * n_steps < episodes * horizon
