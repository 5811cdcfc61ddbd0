"""What holds for every kind of curriculum: stored, chosen among, made of a config, and run."""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from space_dist import config as configs
from space_dist.curricula import (
    Curriculum,
    Probes,
    State,
    decode_state,
    encode_state,
)
from space_dist.curricula.alp_gmm import MixtureState
from space_dist.curricula.making import make_curriculum
from space_dist.curricula.plr import ReplayState
from space_dist.errors import ConfigError
from space_dist.instances import InstanceSet, read_csv
from space_dist.learner import make_learner
from space_dist.rollout import Worker
from space_dist.run.building import Blueprint, spec_of
from tests.test_rivals import ROOT, SPACE, feedback, instances, made, tiny_shards, vds_config
from tests.tiny_env import Line
from tests.two_features import scattered

KINDS = {
    "uniform": "{kind: uniform}",
    "spdrl": "{kind: spdrl, warm_up: 0, offset: 0}",
    "spdrl_cg": "{kind: spdrl, warm_up: 0, offset: 0, optimiser: conjugate_gradient}",
    "vds": "{kind: vds}",
    "alp_gmm": "{kind: alp_gmm, fit_rate: 12}",
    "alp_gmm_bounds": "{kind: alp_gmm, fit_rate: 12, over: bounds}",
    "plr": "{kind: plr}",
    "learnability": "{kind: learnability, top: 2, every: 2, episodes: 2}",
    "procurl": "{kind: procurl}",
    "procurl_improvement": "{kind: procurl, score: improvement, scale: set}",
    "learning_progress": "{kind: learning_progress, outcome: return, lowest_return: -1, largest_return: 1,"
    " smoothing: 0.5}",
    "plr_positive": "{kind: plr, score: positive_value_loss}",
    "edge": "{kind: edge, outcome: return, lowest_return: -1, largest_return: 1}",
    "plr_max_mc": "{kind: plr, score: max_mc}",
    "plr_robust": "{kind: plr, robust: true, temperature: 1, within_update: fixed_chances}",
    "currot": "{kind: currot, delta: 0.5, particles: 12}",
    "currot_bounds": "{kind: currot, delta: 0.5, particles: 12, over: bounds, target: normal, target_mean: [1, 0],"
    " target_std: [0.1, 1]}",
    "accel": "{kind: accel, buffer: 6, batch: 4}",
    "accel_set": "{kind: accel, buffer: 6, batch: 4, new_from: set, edited: batch, score: max_mc, robust: false}",
    "manual": "{kind: manual, column: effort}",
    "watched": "{kind: watched, iterations: 4, shares: 2}",
}


def wide(n: int = 6) -> InstanceSet:
    return scattered(n, effort=np.arange(n, 0.0, -1.0))


def driven(curriculum: Curriculum, train: InstanceSet, steps: int = 4, through: Callable[[State], State] | None = None):
    """(state, selection, numbers) of a made-up history, each state passed `through` something before it is used."""
    state, selection = curriculum.start()
    history: list[Any] = []
    for version in range(steps):
        random = np.random.default_rng(version)
        some = random.choice(len(selection.ids), size=8)
        ids = selection.ids[some]
        indices = np.where(ids < 0, -1, np.searchsorted(train.ids, ids))
        m, n = len(some), len(train)
        won = feedback(version, [0], n=n).episodes
        assert won is not None
        won.success[:] = 1.0
        probes, asked = None, curriculum.probes(state, won)
        if asked is not None:
            success = random.integers(2, size=len(asked)).astype(float)
            probes = Probes(asked, np.zeros(len(asked)), np.ones(len(asked), dtype=np.int64), success)
        told = feedback(
            version, indices, selection.contexts[some], n=n, returns=random.normal(size=m),
            advantages=random.random(m), members=random.normal(size=(n, 3)), probes=probes,
        )  # fmt: skip
        episodes = dataclasses.replace(
            told.episodes, start_values=random.random(m), discounted_returns=random.random(m)
        )  # fmt: skip
        told = dataclasses.replace(told, episodes=episodes)
        state, selection, numbers = curriculum.step(state if through is None else through(state), told)
        history.append((state, selection, numbers))
    return history


def plain(history: list[Any]) -> list[Any]:
    return [
        ({key: np.asarray(value).tolist() for key, value in vars(state).items()}, selection.ids.tolist(),
         selection.contexts.tolist(), numbers)
        for state, selection, numbers in history
    ]  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_a_state_survives_storage_and_the_rows_of_the_file_decide_nothing(kind: str) -> None:
    train = wide()
    curriculum = made(KINDS[kind], train)

    def stored(state: State) -> State:
        arrays, numbers = encode_state(state)
        file = io.BytesIO()
        np.savez(file, **arrays)
        file.seek(0)
        with np.load(file, allow_pickle=False) as loaded:
            return decode_state(curriculum.state_type, dict(loaded), json.loads(json.dumps(numbers, allow_nan=False)))

    history = driven(curriculum, train)
    json.dumps([numbers for _, _, numbers in history], allow_nan=False)
    assert plain(driven(made(KINDS[kind], train), train, through=stored)) == plain(history)
    turned = InstanceSet(train.ids[::-1], train.contexts[::-1], train.names, {"effort": train.columns["effort"][::-1]})
    assert plain(driven(made(KINDS[kind], turned), turned)) == plain(history)
    for state, selection, _ in history:
        again = curriculum.selection(state)
        assert again.ids.tolist() == selection.ids.tolist()
        assert again.contexts.tolist() == selection.contexts.tolist()
    other = driven(made(KINDS[kind], train, seed=1), train)
    if kind != "manual":  # whose order is the file's
        assert plain(other) != plain(history)


def test_every_kind_of_curriculum_is_covered() -> None:
    # test_curricula, test_curriculum_variants, test_user_curriculum, test_causal
    known = {"space", "random_growth", "cspace", "round_robin", "fixed", "custom", "replay"}
    covered = {configs.load(SPACE, [f"curriculum={text}"]).curriculum.kind for text in KINDS.values()}
    import typing

    union = typing.get_args(configs.RunConfig.model_fields["curriculum"].annotation)
    kinds = {typing.get_args(section.model_fields["kind"].annotation)[0] for section in union}
    assert kinds == known | covered


@pytest.mark.parametrize(
    ("curriculum", "words"),
    [
        ("{kind: manual, column: effrot}", ["curriculum.column", "train.csv", "'effrot'", "did you mean 'effort'?"]),
        ("{kind: vds, members_see: [c]}", ["curriculum.members_see", "'c'", "Allowed: a, b"]),
        ("{kind: learnability, top: 7}", ["curriculum.top: 7", "holds 6 instances"]),
        ("{kind: learnability, top: 2, candidates: 9}", ["curriculum.candidates: 9", "holds 6 instances"]),
        ("{kind: spdrl, initial_mean: [1]}", ["curriculum.initial_mean", "1 numbers", "2 features", "(a, b)"]),
        ("{kind: spdrl, initial_mean: [1, 11]}", ["curriculum.initial_mean", "b = 11", "[-10, 10]"]),
    ],
)
def test_what_instances_or_environment_do_not_have_is_refused(curriculum: str, words: list[str]) -> None:
    with pytest.raises(ConfigError) as refusal:
        made(curriculum, wide())
    assert all(word in str(refusal.value) for word in words), str(refusal.value)


def test_moments_of_a_set_on_a_line_are_refused() -> None:
    for train in (instances(4), instances(1)):
        with pytest.raises(ConfigError, match=r"curriculum\.target: set_moments .* singular\. Use target: normal"):
            made("{kind: spdrl}", train)


def test_the_moments_of_the_set_are_the_target() -> None:
    train = wide(40)
    numbers = driven(made("{kind: spdrl}", train), train, 1)[0][2]
    assert numbers["target_mean_b"] == pytest.approx(train.contexts[:, 1].mean())
    assert numbers["target_std_b"] == pytest.approx(train.contexts[:, 1].std())
    assert numbers["mean_a"] == 1.0  # by default, from the middle of the bounds
    assert numbers["std_b"] == 5.0  # and a quarter of their width


@pytest.mark.parametrize(
    ("curriculum", "words"),
    [
        ("{kind: spdrl, target: normal}", "target: normal needs target_mean and target_std"),
        ("{kind: spdrl, target_std: [1]}", "say nothing with target: set_moments"),
        ("{kind: alp_gmm, fit_rate: 5}", "fit_rate must be at least components"),
        ("{kind: spdrl, initial_std: [0]}", "initial_std"),
        ("{kind: plr, temperature: 0}", "temperature"),
        ("{kind: manual}", "curriculum.column: this key is required"),
        ("{kind: space, pic: random, reverse: true}", "reverse: true changes nothing with pic: random"),
    ],
)
def test_settings_that_make_no_sense_are_refused(curriculum: str, words: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        configs.load(SPACE, [f"curriculum={curriculum}"])
    assert words in str(refusal.value)


def set_up(*overrides: str) -> None:
    config = configs.load(SPACE, list(overrides))
    spec = spec_of(config)
    bounds = spec.context_bounds
    middle = (bounds.low + bounds.high) / 2.0
    contexts = middle + np.linspace(-0.1, 0.1, 30)[:, None] * np.random.default_rng(0).random((30, len(middle)))
    train = InstanceSet(np.arange(30), contexts, bounds.names)
    Blueprint(config, spec).setup(train, InstanceSet(np.array([99]), middle[None], bounds.names))


class Silent(Line):
    """The line of `tests.tiny_env`, which does not say whether it succeeded."""

    def step(self, actions: Any) -> Any:
        return dataclasses.replace(super().step(actions), success=None)


def make_silent(n_slots: int) -> Silent:
    return Silent(n_slots, spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32))


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["curriculum={kind: plr}", "env.id=tests.tiny_env:make_discrete", "learner={kind: dqn, n_steps: 2048}"],
         "plr scores episodes by their advantages, which learner.kind: dqn does not compute. Allowed learners: ppo"),
        (["curriculum={kind: learnability}", "env.id=tests.test_every_curriculum:make_silent"],
         "needs to know whether an episode succeeded"),
        (["curriculum={kind: vds}", "env.context_visible=false"], "vds ranks instances by the value of their start"),
        (["curriculum={kind: spdrl}", "env.context_visible=false"], "or curriculum.allow_context_blind: true"),
        (["curriculum={kind: vds, members_see: [gate_x]}", "env.context_visible=false"], "context_visible: true"),
        (["curriculum={kind: vds}", "env.id=tests.tiny_env:make_dict", "learner.policy=MultiInputPolicy"],
         "vds needs flat observations"),
    ],
)  # fmt: skip
def test_what_learner_or_environment_cannot_give_is_refused(overrides: list[str], words: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        set_up(*overrides)
    assert words in str(refusal.value)


def test_shipped_rivals_can_be_made() -> None:
    folder = ROOT / "configs/curricula"
    for path in sorted(folder.glob("*.yaml")):
        config = configs.load(path)
        assert path.stem == config.name
        if config.env.id == "space_dist/PointMass-v0":
            bounds = spec_of(config).context_bounds
            make_curriculum(config, read_csv(config.instances.train, bounds), bounds).start()


def test_contexts_of_instances_are_worth_what_their_start_values_say() -> None:
    config = vds_config()
    worker, learner, _ = tiny_shards(config)
    policy = learner.policy(0)
    found = worker.context_values(policy, worker._setup.train.contexts, version=3)
    assert found.tobytes() == worker.context_values(policy, worker._setup.train.contexts, version=3).tobytes()
    # The line's starts are random within 0.1 of 0, and the value of a fresh network hardly depends on that.
    np.testing.assert_allclose(found, worker.start_values(policy, 0), atol=0.3)
    still = configs.load(SPACE)
    spec = spec_of(still)
    bounds = spec.context_bounds
    train, test = (read_csv(path, bounds) for path in (still.instances.train, still.instances.test))
    point = Worker(Blueprint(still, spec).setup(train, test))
    policy = make_learner(
        still.learner, spec.observation_space, spec.action_space, seed=0, n_slots=16, slot_length=128, total_steps=2048
    ).policy(0)
    values = point.context_values(policy, train.contexts[:7], version=0)
    np.testing.assert_allclose(values, point.start_values(policy, 0)[:7], atol=1e-6)


def test_probes_act_with_noise_on_the_instances_asked_for() -> None:
    config = vds_config()
    worker, learner, _ = tiny_shards(config)
    policy, indices = learner.policy(0), np.repeat([0, 2], 4)
    parts = [worker.probe(policy, indices, 5, part) for part in range(2)]
    assert [part.lengths.tolist() for part in parts] == [[8] * 4, [8] * 4]
    assert len(set(parts[0].returns)) == 4  # the same instance, other noise
    again = Worker(worker._setup).probe(policy, indices, 5, 1)
    assert again.returns.tobytes() == parts[1].returns.tobytes()
    assert worker.probe(policy, indices, 6, 1).returns.tobytes() != parts[1].returns.tobytes()


def test_states_are_plain() -> None:
    for kind, text in KINDS.items():
        state = made(text, wide()).start()[0]
        assert isinstance(state, State)
        for name, value in vars(state).items():
            assert value is None or isinstance(value, int | float | np.ndarray), (kind, name)
    assert isinstance(made(KINDS["plr"], wide()).start()[0], ReplayState)
    assert isinstance(made(KINDS["alp_gmm"], wide()).start()[0], MixtureState)
