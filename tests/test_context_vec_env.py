"""`ContextVecEnv` alone, and what it and the callback refuse."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from sb3_contrib import ARS, MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecCheckNan, VecFrameStack, VecNormalize

from space_dist.config.shipped import FOLDER
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.instances import InstanceSet, read_csv
from space_dist.sb3 import ContextVecEnv, CurriculumCallback
from tests.faulty_env import Honest, NoInfo, NoLength, NoOptions, OldStep
from tests.test_sb3 import DISCRETE, LINE, SLOTS, TARGETS, line_env, made, ppo, remembered

# ---- the environment ----


class Lesson(Honest):
    """With something of its own to tell."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, terminated, truncated, {**info, "own": 1}

    def action_masks(self) -> NDArray[np.bool_]:
        return np.array([True, False, True])


class Infoless(Lesson):
    def step(self, action: Any) -> Any:
        return (*super().step(action)[:4], 1.0)


class NoArguments(Lesson):
    def reset(self) -> Any:  # type: ignore[override]
        return super().reset()


class Takes(gym.Wrapper[Any, Any, Any, Any]):
    """Of an environment that knows no contexts itself."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.given = options
        return self.env.reset(seed=seed)


CONTEXTS = np.array([[0.2, 0.1], [0.3, -0.2], [0.4, 0.3]])


def test_without_a_callback_it_walks_over_its_instances() -> None:
    env = ContextVecEnv(Lesson, CONTEXTS)
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0, device="cpu")
    instances: list[int] = []

    def note(locals_: dict[str, Any], _: dict[str, Any]) -> None:
        if locals_["done"]:
            info = locals_["info"]
            instances.append(info["instance"])
            assert info["context"].tolist() == CONTEXTS[info["instance"]].tolist()
            assert {"own", "is_success", "terminal_observation", "TimeLimit.truncated"} <= info.keys()

    played = [evaluate_policy(model, env, n_eval_episodes=3, callback=note, return_episode_rewards=True, warn=True)
              for _ in range(2)]  # fmt: skip
    assert instances == [0, 1, 2] * 2
    assert played[0] == played[1]
    single = Lesson()
    for number, (reward, length) in enumerate(zip(*played[0], strict=True)):
        assert length >= 1
        assert np.isfinite(reward)
        assert single.context_space.contains(CONTEXTS[number].astype(single.context_space.dtype))


def test_it_answers_as_sb3s_own_does() -> None:
    """Step by step, beside DummyVecEnv's environments that are reset by hand."""
    env = ContextVecEnv(Lesson, CONTEXTS, 2, context_visible=False, seed=9)
    other = make_vec_env(Lesson, 2)
    assert env.observation_space == other.observation_space
    assert env.action_space == other.action_space
    observations = env.reset()
    assert observations.shape == other.reset().shape
    random = np.random.default_rng(0)
    finished = 0
    for _ in range(60):
        observations, rewards, dones, infos = env.step(random.integers(3, size=2))
        assert (observations.dtype, rewards.dtype, dones.dtype) == (np.float32, np.float32, np.bool_)
        for slot in np.flatnonzero(dones):
            finished += 1
            assert infos[slot]["terminal_observation"].shape == observations[slot].shape
            assert infos[slot]["episode"]["l"] >= 1
    assert finished > 4
    assert env.get_attr("context_names") == [("gain", "drift")] * 2
    assert np.array(env.env_method("action_masks", indices=[1])).tolist() == [[True, False, True]]
    assert env.env_is_wrapped(Monitor) == [True, True]
    assert env.env_is_wrapped(gym.wrappers.TimeLimit) == [False, False]
    env.set_attr("own", 3, indices=0)
    assert env.get_attr("own", indices=0) == [3]
    assert not env.has_attr("nothing")
    env.close()


def test_it_walks_on_for_as_long_as_it_is_stepped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("space_dist.sb3.vec_env._FREE_STEPS", 5)
    env = line_env(n_envs=2)
    met = []
    for _ in range(40):  # before any reset, and beyond what is remembered at once
        _, _, _, infos = env.step(np.zeros((2, 1), dtype=np.float32))
        met += [info["instance"] for info in infos if "instance" in info]
    assert met == [number % len(TARGETS) for number in range(len(met))]
    assert len(met) == 10


def test_masked_policies_learn() -> None:
    env = ContextVecEnv(Lesson, CONTEXTS, 2)
    model = MaskablePPO("MlpPolicy", env, n_steps=16, batch_size=16, seed=0, device="cpu")
    callback = CurriculumCallback("plr")
    model.learn(96, callback=callback)
    assert callback.selection.version == 3
    assert (model.rollout_buffer.actions != 1).all()


def test_probe_episodes_are_counted() -> None:
    env = ContextVecEnv(DISCRETE, TARGETS, SLOTS)
    model = PPO("MlpPolicy", env, n_steps=10, batch_size=20, n_epochs=1, seed=0, device="cpu")
    callback = CurriculumCallback("learnability", top=2, every=2, episodes=2)
    seen: list[Mapping[str, Any]] = []

    class Note(BaseCallback):
        def _on_step(self) -> bool:
            if not seen or seen[-1] is not callback.numbers:
                seen.append(callback.numbers)
            return True

    model.learn(1000, callback=[callback, Note()])
    probes = sum(numbers.get("probe_steps", 0) for numbers in seen)
    assert probes > 0
    assert probes % (2 * len(TARGETS) * 8) == 0  # whole episodes, of eight steps, two of every instance
    rounds = remembered(model).round
    assert model.num_timesteps == rounds * 10 * SLOTS + probes
    assert model.num_timesteps <= 1000 + 10 * SLOTS


def test_numpys_numbers_are_numbers_and_a_copy_is_another() -> None:
    env = ContextVecEnv(Honest, CONTEXTS, np.int64(2), seed=np.int64(3))
    other = copy.deepcopy(env)
    assert (env.num_envs, env.run_seed, type(env.run_seed)) == (2, 3, int)
    for _ in range(3):
        np.testing.assert_array_equal(env.reset(), other.reset())


@pytest.mark.parametrize("name", ["shipped:instances/cartpole_train.csv", Path("shipped:cartpole_train.csv")])
def test_instances_that_ship_are_taken_by_name(name: str | Path) -> None:
    env = ContextVecEnv("space_dist/CartPole-v0", name)
    assert env.instances == read_csv(FOLDER / "instances/cartpole_train.csv", env.bounds)
    env.close()


# ---- what is refused ----


@pytest.mark.parametrize(
    ("attempt", "sentence"),
    [
        (lambda: CurriculumCallback("spacey"), r"CurriculumCallback: curriculum\.kind: 'spacey' is not known; did you "
                                               r"mean 'space'\?"),
        (lambda: CurriculumCallback("space", kapa=2), r"curriculum\.kapa: unknown key; did you mean 'kappa'\?"),
        (lambda: CurriculumCallback("custom", share=0.5),
         r"curriculum\.import: this key is required; as an argument it is written \*\*\{'import': \.\.\.\}\n"
         r"CurriculumCallback: curriculum\.share: unknown key\. What a curriculum of your own takes stands in kwargs: "
         r"\{'share': 0\.5\}\. Allowed here: kind, import, kwargs, columns$"),
        *((lambda path=path: CurriculumCallback("custom", **{"import": path}), sentence) for path, sentence in (
            ("no_such:Own", "^CurriculumCallback: curriculum.import 'no_such:Own': cannot import 'no_such'"),
            ("tests.faulty_curricula:Honset", "^CurriculumCallback: curriculum.import .* has no class 'Honset'; did "
             "you mean 'Honest'"),
        )),
        *((lambda of=of: CurriculumCallback("replay", **of), "^CurriculumCallback: curriculum.kind: replay has a run "
           "follow another, .*: train with space-dist$") for of in ({}, {"of": "runs/other"})),
        (lambda: CurriculumCallback("space", eta=-1.0), r"curriculum\.eta: must be a number above 0, not -1\.0"),
        (lambda: CurriculumCallback("space", passes=0.0), "passes: must be a number above 0, not 0.0"),
        (lambda: CurriculumCallback().selection, r"before learn\(\) has begun"),
        (lambda: ContextVecEnv(Honest(), CONTEXTS), "env is a Honest; give the class"),
        (lambda: ContextVecEnv(Honest, CONTEXTS, 0), "n_envs must be a whole number of at least 1, not 0"),
        *((lambda seed=seed: ContextVecEnv(Honest, CONTEXTS, seed=seed), "seed must be a whole number of at least 0")
          for seed in (-1, None, 1.5, True)),
        (lambda: ContextVecEnv(Honest, CONTEXTS, env_kwargs=3), "env_kwargs must be a dict, not 3"),  # type: ignore[arg-type]
        (lambda: ContextVecEnv(Honest, CONTEXTS[:, 0]), r"shape \(3,\); it needs one row an instance and 2 columns, "
                                                        "one for each of gain, drift"),
        (lambda: ContextVecEnv(Honest, [["a", "b"]]), "instances: row 0 has 'a' for gain, which is no number$"),
        (lambda: ContextVecEnv(Honest, [[0.2, 0.1], [0.2]]),  # type: ignore[list-item]
         r"instances: row 1 is \[0\.2\]; a row is a number for each of gain, drift, in this order$"),
        (lambda: ContextVecEnv(Honest, [{"gain": 0.2, "drift": 0.1}]),  # type: ignore[list-item]
         r"instances: row 0 is \{'gain': 0\.2, 'drift': 0\.1\}; a row is a number for each of gain, drift, in this"),
        (lambda: ContextVecEnv(LINE, ["a"]), "instances: row 0 has 'a' for target, which is no number$"),
        (lambda: ContextVecEnv(Honest, None),  # type: ignore[arg-type]
         "instances is None; give a CSV file, an InstanceSet, or an array of numbers with one row an instance$"),
        (lambda: ContextVecEnv(Honest, 5), "instances is of type int; give a CSV file"),
        *((lambda columns=columns: ContextVecEnv(Honest, CONTEXTS, columns=columns),
           rf"columns must be a list of names, like \['difficulty'\], not {re.escape(repr(columns))}$")
          for columns in ("hard", [1], None)),
        (lambda: ContextVecEnv(Honest, CONTEXTS, columns=["gian"]), "columns: the instances have no column 'gian'; did "
         "you mean 'gain'\\? Further columns come with a CSV file, or with an InstanceSet$"),
        (lambda: ContextVecEnv(Lesson, CONTEXTS, env_kwargs={"horizn": 1}),
         "^ContextVecEnv: the environment Lesson: env_kwargs: it cannot be made with them: got an unexpected keyword "
         "argument 'horizn'; did you mean 'horizon'"),
        (lambda: ContextVecEnv(NoLength, CONTEXTS), r'or set env_kwargs\["horizon"\]: the number of steps after which'),
        (lambda: ContextVecEnv(Honest, CONTEXTS + 1.0), r"instance 0 has gain = 1\.2, outside .* \[0\.1, 0\.5\]"),
        (lambda: ContextVecEnv(Honest, "nowhere.csv"), "nowhere.csv: there is no such file"),
        (lambda: ContextVecEnv(Honest, "shipped:instances/cartpole_trian.csv"), "shipped:instances/cartpole_trian.csv: "
         "nothing of this name comes with space_dist; did you mean 'instances/cartpole_train.csv'"),
        (lambda: ContextVecEnv(LINE, InstanceSet(np.array([0]), np.array([[0.1]]), ("goal",))),
         "features are goal, the environment's are target"),
        (lambda: ContextVecEnv("CartPole-v1", [0.5]), "^ContextVecEnv: env 'CartPole-v1': it has no `context_space`"),
    ],
)  # fmt: skip
def test_mistakes_are_sentences(attempt: Callable[[], Any], sentence: str) -> None:
    with pytest.raises(SpaceDistError, match=sentence):
        attempt()


@pytest.mark.parametrize("make", [NoOptions, lambda: gym.wrappers.TimeLimit(NoOptions(), 5)])
def test_a_reset_that_takes_no_context_is_refused_at_once(make: Callable[[], Any]) -> None:
    with pytest.raises(ConfigError, match=r"NoOptions\.reset\(\) takes no `options`; as in Gymnasium it must be reset"):
        ContextVecEnv(make, CONTEXTS)
    with pytest.raises(ConfigError, match=r"NoArguments\.reset\(\) takes no `seed` and no `options`; "):
        ContextVecEnv(NoArguments, CONTEXTS)
    ContextVecEnv(lambda: Takes(NoOptions()), CONTEXTS).reset()


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (NoInfo, r"NoInfo\.reset\(\) must return \(observation, info\), as in Gymnasium; what it returned is no tuple "
                 "but of type ndarray$"),
        (OldStep, r"OldStep\.step\(\) must return \(observation, reward, terminated, truncated, info\), as in "
                  "Gymnasium; it returned 4 values$"),
        (Infoless, r"Infoless\.step\(\) must return .*; the info that it returned is no dict but of type float$"),
    ],
)  # fmt: skip
def test_what_an_environment_returns_amiss_is_told_of_its_class(make: Callable[[], Any], sentence: str) -> None:
    env = ContextVecEnv(make, CONTEXTS)
    with pytest.raises(SpaceDistError, match=sentence):
        env.step(np.zeros(env.num_envs, dtype=np.int64))


@pytest.mark.parametrize(
    ("model", "callback", "sentence"),
    [
        (lambda: PPO("MlpPolicy", make_vec_env(Honest, 2), n_steps=8, batch_size=8), {}, "a DummyVecEnv, which"),
        (lambda: PPO("MlpPolicy", VecFrameStack(line_env(), 2), n_steps=8, batch_size=8), {}, "VecFrameStack around"),
        (lambda: ARS("MlpPolicy", line_env()), {}, "ARS has no value function"),
        (lambda: made("dqn"), {"kind": "plr"}, "plr scores episodes by their advantages, which DQN does not compute"),
        (lambda: MaskablePPO("MlpPolicy", line_env(DISCRETE)), {"kind": "learnability", "top": 2},
         "MaskablePPO could not"),
        (lambda: ppo(line_env()), {"kind": "learnability"}, r"curriculum\.top: 20 is too many"),
        (lambda: ppo(ContextVecEnv(LINE, TARGETS, SLOTS, context_visible=False)), {}, "context_visible=True"),
        (lambda: ppo(line_env(), policy_kwargs={"activation_fn": torch.nn.ELU}), {"kind": "vds"},
         "knows Tanh and ReLU, not ELU"),
        (lambda: ppo(line_env()), {"aggregate": "population"}, "trains several policies"),
        *((lambda: ppo(line_env()), settings,
           "model.learn learns from every one: train with space-dist, or set robust: false$")
          for settings in ({"kind": "plr", "robust": True}, {"kind": "accel"})),
        (lambda: ppo(ContextVecEnv("tests.test_every_curriculum:make_silent", TARGETS, SLOTS)),
         {"kind": "learning_progress"}, "learning_progress needs to know whether an episode succeeded"),
        (lambda: ppo(line_env()), {"kind": "manual", "column": "difficulty"}, "without a column 'difficulty'"),
    ],
)  # fmt: skip
def test_what_cannot_be_given_is_refused(model: Callable[[], Any], callback: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        model().learn(16, callback=CurriculumCallback(**callback))


@pytest.mark.parametrize("wrap", [lambda env: env, VecCheckNan])
def test_evaluating_on_what_is_trained_on_is_refused(wrap: Callable[[ContextVecEnv], Any]) -> None:
    env = line_env()
    callbacks = [CurriculumCallback("space"), EvalCallback(wrap(env), eval_freq=4, n_eval_episodes=2, verbose=0)]
    sentence = "EvalCallback has the env that is being trained on, .*; give EvalCallback a ContextVecEnv of its own$"
    with pytest.raises(ConfigError, match=sentence):
        ppo(wrap(env)).learn(100, callback=callbacks)


def test_evaluating_on_an_environment_without_the_context_is_refused() -> None:
    blind = ContextVecEnv(LINE, TARGETS, 1, context_visible=False)
    bare = EvalCallback(blind, eval_freq=4, n_eval_episodes=2, verbose=0)
    sentence = (
        "^CurriculumCallback: EvalCallback has an env whose observations are of another shape than those that the "
        "model acts on, which have the context in them; give EvalCallback a ContextVecEnv of its own, wrapped "
    )
    for callbacks in ([CurriculumCallback("space"), bare], [CallbackList([bare]), CurriculumCallback("space")]):
        with pytest.raises(ConfigError, match=sentence):
            ppo(line_env()).learn(100, callback=callbacks)
    hidden = ContextVecEnv(LINE, TARGETS, SLOTS, context_visible=False)
    ppo(hidden).learn(16, callback=[CurriculumCallback("uniform"), bare])


def test_evaluating_at_another_scale_is_refused() -> None:
    plain, scaled = line_env, lambda: VecNormalize(line_env())
    for trained, evaluated, said in (
        (plain, scaled, "EvalCallback has a VecNormalize, and the model's env has none"),
        (scaled, plain, "the model's env has a VecNormalize, and EvalCallback has none"),
    ):
        beside = EvalCallback(evaluated(), eval_freq=4, n_eval_episodes=2, verbose=0)
        with pytest.raises(ConfigError, match=f"^CurriculumCallback: {said}, .*; wrap both "):
            ppo(trained()).learn(100, callback=[CurriculumCallback("space"), beside])


def test_a_normaliser_inside_is_told_where_it_belongs() -> None:
    sentence = "a VecNormalize, a vectorised environment .*; return a single environment, and wrap the ContextVecEnv"
    with pytest.raises(ConfigError, match=sentence):
        ContextVecEnv(lambda: VecNormalize(line_env()), TARGETS, 2)


def test_evaluating_on_an_environment_of_its_own_changes_nothing() -> None:
    told = []
    for beside in ([], [EvalCallback(line_env(n_envs=1), eval_freq=4, n_eval_episodes=2, verbose=0)]):
        model, callback = ppo(line_env()), CurriculumCallback("space")
        model.learn(200, callback=[*beside, callback])
        told.append((callback.values.tolist(), callback.selection.ids.tolist()))
    assert told[0] == told[1]


@pytest.mark.parametrize("kind", ["ppo", "dqn"])
@pytest.mark.parametrize("moment", ["_on_step", "_on_rollout_end", "_on_rollout_start"])
@pytest.mark.parametrize("resets", [True, False])
def test_whoever_uses_what_is_trained_on_is_told(kind: str, moment: str, resets: bool) -> None:
    class Meddler(BaseCallback):
        times = 0

        def _on_step(self) -> bool:
            return True

        def meddle(self) -> bool:
            self.times += 1
            if self.times == 2:
                env = self.training_env
                if resets:
                    env.reset()
                env.step(np.array([env.action_space.sample() for _ in range(env.num_envs)]))
            return True

    model, meddler = made(kind), Meddler()
    setattr(meddler, moment, meddler.meddle)
    sentence = "another callback has reset or stepped the env that is being trained on"
    with pytest.raises(SpaceDistError, match=sentence):
        model.learn(400, callback=[CurriculumCallback("space"), meddler])
    setattr(meddler, moment, lambda: True)
    model.learn(100, callback=CurriculumCallback("space", resume=False))  # as if nothing had been


def test_a_feature_is_a_column_too() -> None:
    columns = {"difficulty": np.arange(3.0)}
    ContextVecEnv(Honest, CONTEXTS, columns=["gain"])
    ContextVecEnv(Honest, InstanceSet(np.arange(3), CONTEXTS, ("gain", "drift"), columns), columns=("difficulty",))


def test_what_is_made_on_the_way_is_closed() -> None:
    made, closed = list[Lesson](), list[Lesson]()

    class Counted(Lesson):
        def __init__(self) -> None:
            super().__init__()
            made.append(self)

        def close(self) -> None:
            closed.append(self)

    env = ContextVecEnv(Counted, CONTEXTS, 2)
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=16, seed=0, device="cpu")
    model.learn(96, callback=CurriculumCallback("space"))
    env.close()
    assert len(made) > 2
    assert sorted(map(id, closed)) == sorted(map(id, made))
