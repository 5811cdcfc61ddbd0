"""What a run is: which settings are part of its identity, whatever words a config says them in."""

from __future__ import annotations

import contextlib
import json
import random
import string
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel

from space_dist import config as configs
from space_dist.config import NOT_IDENTITY, RunConfig, differences, identity, load
from space_dist.errors import ConfigError
from tests.config_texts import leaves
from tests.test_config import SHIPPED, SPACE, ident, kinds, plain, written

# What a kind cannot do without.
NEEDED: dict[str, Any] = {"fixed": {"count": 4}, "manual": {"column": "difficulty"}, "currot": {"delta": 4.0},
                          "custom": {"import": "my_package.my_module:Mine"}, "replay": {"of": "runs/a/s0"},
                          "watched": {"iterations": 5}}  # fmt: skip
CONFIGS = {path.stem: load(path) for path in SHIPPED}
CONFIGS |= {f"{section}_{kind}": load(SPACE, [f"{section}={json.dumps({'kind': kind, **NEEDED.get(kind, {})})}"])
            for section in ("learner", "curriculum") for kind in kinds(section)}  # fmt: skip
OTHER_WORDS = {
    "name": "another",
    "env.id": "my_package:make",
    "learner.policy": "CnnPolicy",
    "instances.train": "/elsewhere/train.csv",
    "instances.test": "/elsewhere/test.csv",
    "tracking.uri": "http://localhost:5000",
    "tracking.experiment": "another",
    "resources.address": "auto",
    "curriculum.column": "effort",
    "curriculum.import": "my_package.my_module:Other",
    "learner.import": "my_package.my_module:Other",
    "init_from": "runs/other/s0",
    "curriculum.of": "runs/other/s0",
    "fork": {"seed": 3, "steps": 1},
}
# What decides no result, and so is no part of a run's identity: when it is saved, where it is mirrored, what it runs
# on, and where its instance files, and what other runs give it, lie (their content enters by digest).
UNIDENTIFYING = (*NOT_IDENTITY, "instances", "init_from", "curriculum.of")
# What must be set for another value to be valid, where none is: multiplying by a kappa of 1 is refused, and so are
# rounds of whole episodes in more than one slot.
COMPANIONS: dict[str, dict[str, Any]] = {
    "curriculum.growth": {"curriculum.kappa": 2},
    "curriculum.adaptive_eta": {"curriculum.growth": "add"},
    "rollout.shards": {"learner.n_episodes": None},
    "rollout.slots": {"learner.n_episodes": None},
    "learner.n_episodes": {"rollout.shards": 1, "rollout.slots": 1},
    "learner.shared_lstm": {"learner.enable_critic_lstm": False},
}
# Valid only together with others; see the tests of the fixed subset, the target, and what only some learners can.
INSEPARABLE = (
    "device",
    "curriculum.aggregate",
    "rollout.overlap",
    "curriculum.ids",
    "curriculum.target",
    "curriculum.target_mean",
    "curriculum.target_std",
)
CASES = [(name, key) for name, config in CONFIGS.items() for key, _ in leaves(config.model_dump(mode="json"))
         if not key.endswith(".kind") and key not in INSEPARABLE]  # fmt: skip


def annotation(config: RunConfig, key: str) -> Any:
    section: Any = config
    *parents, last = key.split(".")
    for part in parents:
        section = getattr(section, part)
    if not isinstance(section, BaseModel):  # env.kwargs
        return Any
    return next(field.annotation for name, field in type(section).model_fields.items() if last in (name, field.alias))


def words_in(annotation: Any) -> list[str]:
    """The words that a Literal, or a union with one, allows."""
    return [word for part in get_args(annotation) for word in ([part] if isinstance(part, str) else words_in(part))]


def candidates(config: RunConfig, key: str, value: Any) -> list[Any]:
    """Values that differ; at least one should be valid."""
    words = [word for word in words_in(annotation(config, key)) if word != value]
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int | float):
        return [value * 2 or 1, value / 2 or 0.5, *words]
    if isinstance(value, list):
        return [[32, 32], ["effort"], ["wandb"], [{"steps": 1, "set": {"learner.gamma": 0.5}}]]
    if key == "learner.policy":  # each kind has its own
        return [OTHER_WORDS[key], "CnnLstmPolicy"]
    return [OTHER_WORDS[key]] if key in OTHER_WORDS else [*words, 0.01, 1, [0.5, 0.5], ["a"]]


def pair(config: RunConfig, key: str) -> tuple[RunConfig, RunConfig]:
    """Two valid configs that differ in `key` alone: the one given, where that is possible, and another."""
    value = dict(leaves(config.model_dump(mode="json")))[key]
    for companions in ({}, COMPANIONS.get(key, {})):
        for companion, needed in companions.items():
            config = with_value(config, companion, needed)
        for candidate in candidates(config, key, value):
            with contextlib.suppress(ConfigError):
                return config, with_value(config, key, candidate)
    raise NotImplementedError(f"no other value of {key} = {value!r} is known to this test")


def with_value(config: RunConfig, key: str, value: Any) -> RunConfig:
    tree = config.model_dump(mode="json")
    section = tree
    *parents, last = key.split(".")
    for part in parents:
        section = section[part]
    section[last] = value
    return configs.parse(tree, "test")


@pytest.mark.parametrize(("name", "key"), CASES)
def test_identity_depends_on_everything_that_decides_results_and_on_nothing_else(name: str, key: str) -> None:
    config, changed = pair(CONFIGS[name], key)
    assert changed != config
    if key in UNIDENTIFYING or key.partition(".")[0] in UNIDENTIFYING:
        assert ident(changed) == ident(config)
        assert differences(config, changed) == []
    else:
        assert ident(changed) != ident(config)
        whole = OTHER_WORDS.get(key) if isinstance(OTHER_WORDS.get(key), dict) else None  # a section that was not there
        named = [key] if whole is None else [f"{key}.{name}" for name in whole]
        assert [line.partition(":")[0] for line in differences(config, changed)] == named
        assert ident(with_value(changed, key, dict(leaves(config.model_dump(mode="json")))[key])) == ident(config)


@pytest.mark.skipif("fixed" not in kinds("curriculum"), reason="no fixed subsets")
def test_identity_depends_on_the_fixed_subset() -> None:
    chosen = ["ids: [1]", "ids: [2]", "ids: [1, 2]", "count: 1", "count: 2"]
    assert len({ident(load(SPACE, [f"curriculum={{kind: fixed, {text}}}"])) for text in chosen}) == len(chosen)


def test_identity_depends_on_the_target_of_self_paced_contexts() -> None:
    chosen = ["set_moments", *(f"normal, target_mean: [{mean}], target_std: [{std}]"
                               for mean, std in ((1, 1), (2, 1), (1, 2)))]  # fmt: skip
    assert len({ident(load(SPACE, [f"curriculum={{kind: spdrl, target: {text}}}"])) for text in chosen}) == len(chosen)


def test_identity_depends_on_what_only_some_learners_can() -> None:
    shared = "curriculum={kind: space, aggregate: population}"
    assert ident(load(SPACE, ["engine=population", shared])) != ident(load(SPACE, ["engine=population"]))
    assert ident(load(SPACE, ["rollout.overlap=true"])) != ident(load(SPACE))
    assert len({ident(load(SPACE, ["engine=population", f"device={device}"])) for device in ("cpu", "cuda")}) == 2


def test_identity_depends_on_the_kinds() -> None:
    names = [name for name in CONFIGS if name.startswith(("learner_", "curriculum_"))]
    assert ident(CONFIGS["learner_ppo"]) == ident(load(SPACE))
    assert ident(CONFIGS["curriculum_space"]) == ident(load(SPACE, ["curriculum.eta=0.1", "curriculum.kappa=1"]))
    assert len({ident(CONFIGS[name]) for name in names}) == len(names)


def test_identity_depends_on_the_content_of_instance_files() -> None:
    config = load(SPACE)
    assert len({identity(config, *digests) for digests in (("a", "b"), ("b", "a"), ("a", "c"), ("c", "b"))}) == 4
    assert len(ident(config)) == 64
    assert set(ident(config)) <= set(string.hexdigits.lower())


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_identity_survives_reordering_and_writing_out_defaults(path: Path, tmp_path: Path) -> None:
    config = load(path)
    full = config.model_dump(mode="json")
    for tree in (plain(path), full):
        shuffled = reordered(tree, random.Random(1))
        assert list(leaves(shuffled)) != list(leaves(tree))
        shuffled["instances"] = full["instances"]
        again = load(written(tmp_path, configs.to_yaml(shuffled)))
        assert ident(again) == ident(config)
        assert differences(config, again) == []


def reordered(tree: dict[str, Any], rng: random.Random) -> dict[str, Any]:
    keys_of_tree = sorted(tree, key=lambda _: rng.random())
    return {key: reordered(tree[key], rng) if isinstance(tree[key], dict) else tree[key] for key in keys_of_tree}


def test_identity_does_not_see_how_a_number_is_written() -> None:
    for one, other in (("budget.steps=1000000", "budget.steps=1.0e+6"), ("learner.ent_coef=0", "learner.ent_coef=-0.0"),
                       ("curriculum.eta=1", "curriculum.eta=1.0"), ("learner.gamma=0.5", "learner.gamma=5e-1"),
                       ("learner.net_arch=[64, 64]", "learner.net_arch=[6.4e1, 64]")):  # fmt: skip
        assert ident(load(SPACE, [one])) == ident(load(SPACE, [other]))


def test_differences_name_the_keys_and_both_values() -> None:
    changed = load(SPACE, ["learner.gamma=0.9", "seed=3", "resources.workers=0", "curriculum={kind: round_robin}"])
    found = differences(load(SPACE), changed)
    assert found == sorted(found)
    assert set(found) >= {"curriculum.eta: 0.4 -> None", "curriculum.kind: space -> round_robin",
                          "learner.gamma: 0.95 -> 0.9", "seed: 0 -> 3"}  # fmt: skip
    assert all(line.startswith(("curriculum.", "learner.gamma", "seed")) for line in found)


@pytest.mark.parametrize(
    "uri", ["http:///", "http://[", "sqlite:///:memory:", "sqlite:///", "http://user:secret@host:5000",
            "http://secret@host", "https://user:secret@[", "postgresql://user:secret@host/db", "mlruns"]
)  # fmt: skip
def test_tracking_uris_that_could_not_be_mirrored_to_are_refused_and_no_password_is_repeated(uri: str) -> None:
    with pytest.raises(ConfigError) as caught:
        configs.parse({"tracking": {"uri": uri}}, "run.yaml")
    text = next(line for line in str(caught.value).splitlines() if "tracking.uri" in line)
    assert "sqlite:////absolute/path/mlflow.db" in text
    assert "secret" not in str(caught.value)
    assert ("MLFLOW_TRACKING_PASSWORD" in text) == ("http" in uri and "secret" in uri and "[" not in uri)
    for override in (f"tracking.uri={uri!r}", f"tracking.url={uri}", f"tracking.uri=[{uri}"):
        with pytest.raises(ConfigError) as caught:
            load(SPACE, [override])
        assert "secret" not in str(caught.value), override


def test_learners_say_what_they_can_do() -> None:
    found = {ability: configs.learners_that(ability) for ability in
             ("has_advantages", "keeps_next_observations", "can_be_stacked")}  # fmt: skip
    assert found == {
        "has_advantages": ["ppo", "trpo", "a2c", "recurrent_ppo"],
        "keeps_next_observations": ["dqn", "sac", "td3"],
        "can_be_stacked": ["ppo", "trpo"],
    }
    actions = {kind: CONFIGS[f"learner_{kind}"].learner.actions for kind in kinds("learner")}
    assert {kind: what for kind, what in actions.items() if what != "any"} == {
        "dqn": "discrete", "sac": "bounded", "td3": "bounded",
    }  # fmt: skip
    compiled = [(update, engine) for update in ("stock", "lean") for engine in ("single", "population")
                if load(SPACE, [f"learner.update={update}"]).learner.is_compiled(engine)]  # fmt: skip
    assert compiled == [("stock", "population"), ("lean", "single"), ("lean", "population")]
    assert not CONFIGS["learner_trpo"].learner.is_compiled("population")


@pytest.mark.parametrize(
    ("settings", "found"),
    [
        ([], (4, 4)),
        (["rollout=auto"], (4, 4)),
        (["learner.n_steps=1000"], (4, 2)),
        (["learner.n_steps=50", "learner.batch_size=10"], (2, 1)),
        (["learner.n_steps=1001"], (1, 1)),
        (["learner.n_steps=1000", "rollout={shards: auto, slots: 5}"], (4, 5)),
        (["learner.n_steps=96", "rollout={shards: 8}"], (8, 4)),
        (["learner.n_steps=72", "rollout={shards: 8}"], (8, 3)),
    ],
)
def test_shards_and_slots_that_fit_are_found(settings: list[str], found: tuple[int, int], tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    text = "\n".join(line for line in SPACE.read_text().splitlines() if "shards:" not in line and "slots:" not in line)
    file.write_text(text.replace("rollout:\n", "").replace("instances/", f"{SPACE.parent}/instances/"))
    rollout = load(file, settings).rollout
    assert (rollout.shards, rollout.slots) == found


def test_numbers_that_do_not_fit_are_answered_with_some_that_do() -> None:
    with pytest.raises(ConfigError) as refusal:
        load(SPACE, ["learner.n_steps=1001"])
    text = str(refusal.value)
    assert "rollout: auto (1 and 1 here), or learner.n_steps: 992 or 1008" in text
    for n_steps in (992, 1008):
        assert load(SPACE, [f"learner.n_steps={n_steps}"]).rollout.shards == 4
    with pytest.raises(ConfigError, match=r"Use budget\.steps: 2048 or more"):
        load(SPACE, ["budget.steps=1"])


@pytest.mark.parametrize(
    ("key", "ours"),
    [
        ("learner.lr", "learner.learning_rate"),
        ("n_envs", "rollout.shards"),
        ("learner.total_timesteps", "budget.steps"),
    ],
)
def test_words_of_stable_baselines3_are_translated(key: str, ours: str) -> None:
    with pytest.raises(ConfigError, match=f"What Stable-Baselines3 calls {key.rpartition('.')[2]} is {ours}"):
        load(SPACE, [f"{key}=4"])


@pytest.mark.parametrize("workers", ["-1", "4097", "some"])
def test_workers_are_a_number_or_auto(workers: str) -> None:
    with pytest.raises(ConfigError, match=r"resources\.workers"):
        load(SPACE, [f"resources.workers={workers}"])
    assert load(SPACE, ["resources.workers=auto"]).resources.workers == "auto"
