"""What holds for every environment on PyBullet: an episode cannot tell where, beside whom or after what it runs."""

from __future__ import annotations

import gc
import hashlib
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import psutil
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from space_dist.envs import BatchedEnv, ContextObservation, bullet, make_batched
from space_dist.envs.distributions import DISTRIBUTIONS, sample
from space_dist.errors import ConfigError
from space_dist.instances import read_csv, refuse_overlap
from space_dist.rollout import Worker, evaluate
from tests.patience import PATIENCE
from tests.test_rollout import bits, setup_for, weights_for

ROOT = Path(__file__).parent.parent
ENVS = {"space_dist/AntGoal-v0": "antgoal_all", "space_dist/BallCatching-v0": "ballcatching_uniform"}
LENGTH = 60  # steps of an episode that are looked at

both = pytest.mark.parametrize("env_id", ENVS)


@dataclass(frozen=True)
class Job:
    """One episode: who runs it must not matter."""

    context: tuple[float, ...]
    seed: int

    def actions(self, env: BatchedEnv) -> NDArray[np.float64]:
        """At random, held for a while, or to the limits: what makes feet slip and joints reach their stops."""
        actions = np.random.default_rng(self.seed).uniform(-1.0, 1.0, size=(LENGTH, *(env.action_space.shape or ())))
        if self.seed % 3 == 1:
            return np.repeat(actions[::20], 20, axis=0)
        return np.sign(actions) if self.seed % 3 == 2 else actions


def jobs(env_id: str, count: int) -> list[Job]:
    contexts = sample(ENVS[env_id], count, 1, 3)[0].contexts
    return [Job(tuple(context), seed) for seed, context in enumerate(contexts.tolist())]


def run(env: BatchedEnv, todo: list[Job]) -> dict[Job, str]:
    """What each episode told, in slots that take the next job as soon as theirs has ended."""
    told: dict[Job, str] = {}
    queue, doing, unfinished = list(todo), [todo[0]] * env.n_slots, len(todo)
    asked = [True] * env.n_slots
    ages, diaries = [0] * env.n_slots, [hashlib.sha256() for _ in range(env.n_slots)]

    def begin(slot: int) -> None:
        asked[slot] = bool(queue)  # else only to keep the slot busy
        doing[slot], ages[slot] = queue.pop(0) if queue else todo[0], 0
        job = doing[slot]
        start = env.reset(np.array([slot]), np.array([job.context]), np.array([job.seed], dtype=np.uint64))
        diaries[slot] = hashlib.sha256(start.tobytes())

    for slot in range(env.n_slots):
        begin(slot)
    while unfinished:
        step = env.step(np.stack([job.actions(env)[age] for job, age in zip(doing, ages, strict=True)]))
        for slot in range(env.n_slots):
            ages[slot] += 1
            ended = step.terminated[slot].tobytes() + step.truncated[slot].tobytes()
            success = b"" if step.success is None else step.success[slot].tobytes()
            diaries[slot].update(step.observations[slot].tobytes() + step.rewards[slot].tobytes() + ended + success)
            if step.terminated[slot] or ages[slot] == LENGTH:
                digest = diaries[slot].hexdigest()
                assert told.setdefault(doing[slot], digest) == digest
                unfinished -= asked[slot]
                begin(slot)
    return told


@pytest.fixture(scope="module")
def alone() -> dict[str, dict[Job, str]]:
    """Each episode as the first of a fresh environment."""
    return {
        env_id: {job: run(make_batched(env_id, 1, context_visible=False), [job])[job] for job in jobs(env_id, 12)}
        for env_id in ENVS
    }


@both
def test_episodes_differ(env_id: str, alone: dict[str, dict[Job, str]]) -> None:
    assert len(set(alone[env_id].values())) == 12


@both
def test_what_ran_before_does_not_matter(env_id: str, alone: dict[str, dict[Job, str]]) -> None:
    todo = list(alone[env_id])
    random = np.random.default_rng(0)
    shuffled = [todo[place] for _ in range(3) for place in random.permutation(len(todo))]
    assert run(make_batched(env_id, 1, context_visible=False), shuffled) == alone[env_id]


@both
def test_slots_and_neighbours_do_not_matter(env_id: str, alone: dict[str, dict[Job, str]]) -> None:
    assert run(make_batched(env_id, 5, context_visible=False), list(alone[env_id])[::-1]) == alone[env_id]


@both
def test_sharing_a_world_does_not_matter(
    env_id: str, alone: dict[str, dict[Job, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bullet, "MAX_WORLDS", 2)
    todo = list(alone[env_id])[:6]
    told = run(make_batched(env_id, 5, context_visible=False), todo)
    assert told == {job: alone[env_id][job] for job in todo}


def test_environments_in_one_process_do_not_disturb_each_other(alone: dict[str, dict[Job, str]]) -> None:
    """Two of each kind, stepped in turn, one of them closed on the way."""
    envs = {env_id: [make_batched(env_id, 1, context_visible=False) for _ in range(2)] for env_id in ENVS}
    for turn in range(4):
        for env_id, pair in envs.items():
            job = list(alone[env_id])[turn]
            for env in pair:
                assert run(env, [job]) == {job: alone[env_id][job]}
                env.step(np.ones((1, *(env.action_space.shape or ()))))  # leave it in the middle of something
        if turn == 1:
            envs["space_dist/AntGoal-v0"].pop()


def test_another_process_gives_the_same_bits(alone: dict[str, dict[Job, str]]) -> None:
    program = (
        "from tests.test_bullet import ENVS, jobs, make_batched, run\n"
        "for env_id in ENVS:\n"
        "    for digest in run(make_batched(env_id, 2, context_visible=False), jobs(env_id, 12)).items():\n"
        "        print(env_id, digest[0].seed, digest[1])\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE)
    assert (done.returncode, done.stderr) == (0, "")  # nothing at the interpreter's exit, and no greeting of PyBullet's
    expected = {(env_id, str(job.seed), digest) for env_id, told in alone.items() for job, digest in told.items()}
    assert {tuple(line.split()) for line in done.stdout.splitlines()} == expected


@both
def test_start_observations_need_one_world(env_id: str) -> None:
    """A run asks for those of all its instances at once; a world each would be 3 GB for a hundred."""
    many, one = make_batched(env_id, 100, context_visible=False), make_batched(env_id, 1, context_visible=False)
    contexts = sample(ENVS[env_id], 100, 1, 0)[0].contexts
    before = clients()
    starts = many.reset(np.arange(100), contexts, np.arange(100, dtype=np.uint64))
    assert clients() == before + 1
    for slot in (0, 57, 99):
        alone = one.reset(np.array([0]), contexts[[slot]], np.array([slot], dtype=np.uint64))
        np.testing.assert_array_equal(alone[0], starts[slot])


@both
def test_measuring_many_episodes_needs_few_worlds(env_id: str) -> None:
    """Slots that share a world change places at every step, which takes longer than the step."""
    instances = sample(ENVS[env_id], 20, 1, 0)[0]
    env = make_batched(env_id, 20, context_visible=True)
    space, actions = env.observation_space, env.action_space
    policy = weights_for((space.shape or ())[0], (actions.shape or ())[0])
    setup = setup_for(env_id, train=instances, test=instances, shards=1)
    worker, before = Worker(setup), clients()
    found = worker.evaluate(policy, "train", 0)
    assert clients() == before + 10  # two turns
    (expected,) = evaluate(env, [setup.trial(policy, "train", 0)])
    assert bits(found) == bits(expected)
    worker.close()


@both
def test_clients_are_freed(env_id: str) -> None:
    gc.collect()
    before = clients()
    for way in ("closed", "forgotten"):
        env = gym.make(env_id)
        env.reset(seed=0)
        assert clients() == before + 1
        if way == "closed":
            env.close()
            assert clients() == before
            env.close()  # twice is once
            env.reset(seed=0)  # and it can be used again
        del env
        gc.collect()
        assert clients() == before


def clients() -> int:
    return sum(bullet.pybullet().isConnected(physicsClientId=client) for client in range(200))


@both
def test_resets_leak_nothing(env_id: str) -> None:
    """`python jobs/benchmark.py envs --resets 10000` is the long one; a leak of a kilobyte shows here."""
    env = make_batched(env_id, 1, context_visible=False)
    contexts = sample(ENVS[env_id], 50, 1, 0)[0].contexts
    process, first = psutil.Process(os.getpid()), 0
    for count in range(1500):
        env.reset(np.array([0]), contexts[[count % 50]], np.array([count], dtype=np.uint64))
        if count % 3 == 0:
            env.step(np.ones((1, *(env.action_space.shape or ()))))
        if count == 300:
            first = process.memory_info().rss
    assert process.memory_info().rss - first < 2**20


@both
@pytest.mark.parametrize("context_visible", [False, True])
def test_gymnasiums_own_checker_accepts_it(env_id: str, context_visible: bool) -> None:
    env = gym.make(env_id, disable_env_checker=True).unwrapped
    check_env(ContextObservation(env) if context_visible else env, skip_render_check=True)


@both
def test_the_callers_arrays_are_the_callers(env_id: str) -> None:
    env, other = (make_batched(env_id, 2, context_visible=False) for _ in range(2))
    contexts = sample(ENVS[env_id], 2, 1, 0)[0].contexts
    given = contexts.copy()
    actions = np.full((2, *(env.action_space.shape or ())), 2.0, dtype=np.float32)  # beyond the limits, to be clipped
    for one in (env, other):
        one.reset(np.arange(2), given, np.arange(2, dtype=np.uint64))[:] = 9.0
    np.testing.assert_array_equal(given, contexts)
    given[:] = 0.0
    env.step(actions).observations[:] = 9.0
    other.step(np.ones_like(actions))
    assert (actions == 2.0).all()
    ours, theirs = env.step(actions), other.step(np.ones_like(actions))
    np.testing.assert_array_equal(ours.observations, theirs.observations)
    np.testing.assert_array_equal(ours.rewards, theirs.rewards)


@both
def test_an_action_that_is_no_number_is_refused(env_id: str) -> None:
    env = make_batched(env_id, 1, context_visible=False)
    env.reset(np.array([0]), sample(ENVS[env_id], 1, 1, 0)[0].contexts, np.zeros(1, dtype=np.uint64))
    actions = np.zeros((1, *(env.action_space.shape or ())))
    actions[0, 3] = np.nan
    with pytest.raises(ValueError, match="must be finite"):
        env.step(actions)


@both
def test_a_missing_pybullet_is_a_sentence(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    bullet.pybullet.cache_clear()  # as in a process that has not imported it yet
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(ConfigError, match=rf"^env.id {env_id!r}: this environment needs PyBullet: pip install"):
        make_batched(env_id, 1, context_visible=False)
    bullet.pybullet.cache_clear()


@both
def test_the_picture_shows_the_scene_and_changes_nothing(env_id: str) -> None:
    env, unseen = (make_batched(env_id, 2, context_visible=False) for _ in range(2))
    contexts = sample(ENVS[env_id], 2, 1, 0)[0].contexts
    actions = np.ones((2, *(env.action_space.shape or ())))
    for one in (env, unseen):
        one.reset(np.arange(2), contexts, np.arange(2, dtype=np.uint64))
        one.step(actions)
    picture = env.frame(1)
    assert (picture.shape, picture.dtype) == ((240, 320, 3), np.uint8)
    assert picture.std() > 10
    for _ in range(10):
        np.testing.assert_array_equal(env.step(actions).observations, unseen.step(actions).observations)
    assert (env.frame(1) != picture).any()


@pytest.mark.parametrize("distribution", ["antgoal_positive", "antgoal_all", "ballcatching_uniform"])
def test_the_sets_are_those_of_seed_0_and_disjoint(distribution: str) -> None:
    folder, bounds = ROOT / "configs" / "instances", DISTRIBUTIONS[distribution].bounds
    train, test = (read_csv(folder / f"{distribution}_{part}.csv", bounds) for part in ("train", "test"))
    assert (len(train), len(test)) == (100, 100)
    refuse_overlap(train, test, "train", "test")
    for read, drawn in zip((train, test), sample(distribution, 100, 100, 0), strict=True):
        np.testing.assert_array_equal(read.ids, drawn.ids)
        np.testing.assert_array_equal(read.contexts, drawn.contexts)
