"""The schema: what is accepted, and what is refused in which words."""

from __future__ import annotations

import json
import os
import re
import resource
import select
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_origin

import psutil
import pytest
from hypothesis import HealthCheck, settings
from pydantic import BaseModel, ValidationError
from ruamel.yaml import YAML

from space_dist import config as configs
from space_dist.config import RunConfig, dump, identity, load, schema
from space_dist.config.plain_yaml import to_yaml
from space_dist.config.reading import from_option
from space_dist.errors import ConfigError, with_changes
from space_dist.experiment.grid_file import GridConfig
from space_dist.experiment.tuning import TuneConfig
from space_dist.slurm.profile import Profile
from tests.config_texts import Raw, leaves, replaced

FOLDER = Path(__file__).parent.parent / "configs"
SHIPPED = sorted(FOLDER.glob("*.yaml"))
SPACE = FOLDER / "pointmass_space.yaml"
TEXT = SPACE.read_text()
MAX_MESSAGE = 5_000  # characters
broken = settings(max_examples=120, deadline=None, suppress_health_check=list(HealthCheck))


def plain(path: Path) -> dict[str, Any]:
    return YAML(typ="safe", pure=True).load(path.read_text())


def written(folder: Path, content: str | bytes, name: str = "run.yaml") -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def refusal(path: Path, *overrides: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load(path, overrides)
    text = str(caught.value)
    assert 0 < len(text) < MAX_MESSAGE
    return text


def ident(config: RunConfig, train: str = "t", test: str = "e") -> str:
    return identity(config, train, test)


def attempted_elsewhere(path: Path, seconds: float = 60.0, memory: int = 2 << 30) -> str | None:
    """`attempt` in a process of its own, which is killed when it takes longer, or more memory on top of ours."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            used = psutil.Process().memory_info().vms
            resource.setrlimit(resource.RLIMIT_AS, (used + memory, used + memory))
            text = attempt(path)
            os.write(write, json.dumps(text).encode())
            status = 0
        except BaseException as error:  # the child must not return into pytest
            os.write(write, f"{type(error).__name__}: {str(error)[:500]}".encode())
        finally:
            os._exit(status)
    os.close(write)
    finished, _, _ = select.select([read], [], [], seconds)
    if not finished:
        os.kill(child, signal.SIGKILL)
    with os.fdopen(read, "rb") as file:
        answer = file.read().decode()
    _, status = os.waitpid(child, 0)
    assert finished, f"not done within {seconds} s"
    assert status == 0, answer
    return json.loads(answer)


def attempt(path: Path) -> str | None:
    """None where the file is a valid config, else the text of its refusal. Anything else fails the test."""
    try:
        config = load(path)
    except ConfigError as error:
        text = str(error)
    else:
        assert isinstance(config, RunConfig)
        return None
    assert str(path) in text
    assert len(text) < MAX_MESSAGE, f"a message of {len(text)} characters"
    return text


def whole_file(text: str) -> bool:
    """Whether a refusal is about the text of the file, not the value of a key."""
    return any(
        phrase in text for phrase in ("not valid YAML", "nested too deeply", "is not a word", " aliases", "UTF-8")
    )


def kinds(section: str) -> list[str]:
    options = get_args(RunConfig.model_fields[section].annotation)
    return [get_args(option.model_fields["kind"].annotation)[0] for option in options]


# ---- what is accepted -----------------------------------------------------------------------------------------------


def test_what_is_written_of_a_config_is_all_of_it_whatever_was_written_before() -> None:
    for overrides in ([], ["fork={seed: 0, steps: 5}"], ["budget.steps=30000"]):
        for seed in (3, 0, 41):
            config = load(SPACE, [*overrides, f"seed={seed}"])
            assert dump(config) == to_yaml(config.model_dump(mode="json"))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_configs_load_and_survive_being_dumped(path: Path, tmp_path: Path) -> None:
    config = load(path)
    assert config.name == path.stem
    assert config.instances.train.is_absolute()
    assert config.instances.test.is_absolute()
    assert config.instances.train.is_file()
    again = load(written(tmp_path, dump(config)))
    assert again == config
    assert ident(again) == ident(config)
    assert dump(again) == dump(config)


def test_there_are_shipped_configs() -> None:
    assert SPACE in SHIPPED
    assert len(SHIPPED) >= 2


def test_relative_instance_paths_are_relative_to_the_config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    deep = tmp_path / "configs"
    deep.mkdir()
    path = written(deep, TEXT.replace("instances/pointmass_uniform_train.csv", "here.csv"))
    monkeypatch.chdir(deep)
    assert load(Path("run.yaml")).instances.train == deep / "here.csv"
    monkeypatch.chdir(tmp_path)
    assert load(Path("configs/run.yaml")).instances.train == deep / "here.csv"
    assert load(path, ["instances.train=here.csv"]).instances.train == tmp_path / "here.csv"
    assert load(path, ["instances.train=/there.csv"]).instances.train == Path("/there.csv")


def test_instance_paths_of_a_whole_section_override_are_absolute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    config = load(SPACE, ["instances={train: a.csv, test: b.csv}"])
    assert (config.instances.train, config.instances.test) == (tmp_path / "a.csv", tmp_path / "b.csv")


@pytest.mark.parametrize(
    ("override", "key", "expected"),
    [
        ("budget.steps=1e5", "budget.steps", 100_000),
        ("budget.steps=1.0e+6", "budget.steps", 1_000_000),
        ("budget.steps=20480", "budget.steps", 20_480),
        (" budget.steps = 20480", "budget.steps", 20_480),
        ("learner.net_arch=[32, 16]", "learner.net_arch", (32, 16)),
        ("learner.net_arch=[]", "learner.net_arch", ()),
        ("learner.max_grad_norm=null", "learner.max_grad_norm", None),
        ("learner.max_grad_norm=", "learner.max_grad_norm", None),
        ("learner.target_kl=1e-2", "learner.target_kl", 0.01),
        ("learner.log_std_init=-1", "learner.log_std_init", -1.0),
        ("env.context_visible=false", "env.context_visible", False),
        ("evaluation.every_steps=log", "evaluation.every_steps", "log"),
        ("evaluation.every_steps=1e3", "evaluation.every_steps", 1_000),
        ("tracking.uri=null", "tracking.uri", None),
        ("tracking={uri: null, live: false}", "tracking.live", False),
        ("rollout.shards=8", "rollout.shards", 8),
        ("seed=7", "seed", 7),
        ("name=a=b", "name", None),
    ],
)
def test_overrides(override: str, key: str, expected: Any) -> None:
    if expected is None and "=a=b" in override:
        assert "name" in refusal(SPACE, override)  # only the first = divides; the value is then no name
        return
    value: Any = load(SPACE, [override])
    for part in key.split("."):
        value = getattr(value, part)
    assert value == expected
    assert type(value) is type(expected)


def test_overrides_are_applied_in_order_and_what_options_say_last() -> None:
    overrides = ["seed=1", "curriculum={kind: round_robin}", "rollout.slots=8", "rollout.slots=2"]
    config = load(SPACE, [*overrides, from_option("--seed", "seed", 9)])
    assert (config.seed, config.curriculum.kind, config.rollout.slots) == (9, "round_robin", 2)


def test_configs_are_frozen_everywhere() -> None:
    config = load(SPACE)
    with pytest.raises(ValidationError):
        config.seed = 1
    for name in RunConfig.model_fields:
        section = getattr(config, name)
        if isinstance(section, BaseModel):
            field = next(iter(type(section).model_fields))
            with pytest.raises(ValidationError):
                setattr(section, field, getattr(section, field))
    assert isinstance(config.learner.net_arch, tuple)


# ---- what is refused ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "meant"),
    [
        ("budjet", "budget"),
        ("learner.n_step", "n_steps"),
        ("learner.clip_rnage", "clip_range"),
        ("curriculum.etta", "eta"),
        ("rollout.shard", "shards"),
        ("env.context_visable", "context_visible"),
        ("evaluation.every_step", "every_steps"),
        ("instances.trian", "train"),
        ("tracking.url", "uri"),
    ],
)
def test_unknown_keys_are_named_with_the_nearest(key: str, meant: str, tmp_path: Path) -> None:
    data = plain(SPACE)
    section = data
    *sections, last = key.split(".")
    for part in sections:
        section = section.setdefault(part, {})
    section[last] = 1
    path = written(tmp_path, configs.to_yaml(data))
    text = refusal(path)
    assert text.startswith(f"{path}: {key}: unknown key; did you mean {meant!r}?")
    assert "Allowed here: " in text
    assert f"--set {key}=1: {key}: unknown key; did you mean {meant!r}?" in refusal(SPACE, f"{key}=1")


@pytest.mark.parametrize(
    ("learner", "said"),
    [
        ("{kind: ppo, target_klx: 0.1}", "learner.target_klx: unknown key; did you mean 'target_kl'? Allowed here: "),
        ("{kind: ppo, use_sde: true}", "use_sde: unknown key. Stable-Baselines3 has it, and runs here do without. Al"),
        ("{kind: ppo, use_sd: true}", "use_sd: unknown key; did you mean 'use_sde'? Stable-Baselines3 has it, and r"),
        ("{kind: ppo, clip_range_vf: 1}", "unknown key. Stable-Baselines3's ppo has it, a config no key for it: "
                                          "a class of your own can set it (learner.import). Allowed here: "),
        ("{kind: dqn, train_freq: 4}", "What Stable-Baselines3 calls train_freq is learner.n_steps or learner.n_epi"),
        ("{kind: ppo, seed: 4}", "learner.seed: unknown key: seed stands outside of learner"),
        ("{kind: ppo, import: 'a:B', target: 1}", "learner.target: unknown key. What a learner of your own takes "
                                                  "stands in kwargs: {'target': 1}. Allowed here: "),
        ("{kind: ppo, import: 'a:B', rate: 0.1}", "learner.rate: unknown key. What a learner of your own takes stands"),
        ("{kind: ppo, import: 'a:B', n_stesp: 9}", "n_stesp: unknown key; did you mean 'n_steps'? Allowed here: "),
        ("{kind: ppo, kwargs: {target_kl: 1}}", "learner: import, which names the class of your own that kwargs are "
                                                "for, is missing; 'target_kl' stands beside kwargs: learner.target_kl"),
        ("{kind: ppo, kwargs: {target_klx: 1}}", "is missing; did you mean 'target_kl'? That stands beside kwargs: "
                                                 "learner.target_kl"),
        ("{import: 'a:B'}", "learner.kind: this key is required: beside import it says which of Stable-Baselines3's "
                            "classes yours is derived from. Allowed: ppo, trpo, a2c"),
    ],
)  # fmt: skip
def test_a_learners_arguments_are_told_where_they_belong(learner: str, said: str) -> None:
    assert said in refusal(SPACE, f"learner={learner}")


def test_what_a_file_says_for_another_kind_is_told_once_with_what_replaces_it() -> None:
    said = refusal(SPACE, "learner.kind=dqn")
    instead = (
        "--set 'learner={kind: dqn}' puts another section in place of the file's, of which dqn has no n_epochs, no "
    )
    assert said.startswith(f"{SPACE} with --set learner.kind=dqn: {instead}")
    assert "\n" not in said
    beside = refusal(SPACE, "learner.kind=dqn", "learner.n_epochs=3")  # that one the file did not say
    assert "--set learner.n_epochs=3: learner.n_epochs: unknown key" in beside


def test_an_unknown_key_inside_an_unknown_section_is_put_down_to_its_override() -> None:
    assert refusal(SPACE, "budjet.steps=1").startswith("--set budjet.steps=1: budjet: unknown key")
    assert refusal(SPACE, "seed.x=1").startswith("--set seed.x=1: ")


def test_learner_keys_of_the_other_algorithm_are_unknown() -> None:
    assert "learner.cg_damping: unknown key" in refusal(SPACE, "learner.cg_damping=0.1")
    assert load(SPACE, ["learner={kind: trpo, cg_damping: 0.1}"]).learner.kind == "trpo"


def test_doubled_keys_are_named_with_their_line(tmp_path: Path) -> None:
    path = written(tmp_path, TEXT + "name: other\n")
    text = refusal(path)
    assert str(path) in text
    assert f"line {TEXT.count(chr(10)) + 1}" in text
    assert "'name'" in text or '"name"' in text
    nested = written(tmp_path, TEXT.replace("  slots: 4", "  slots: 4\n  shards: 4"))
    assert "shards" in refusal(nested)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("seed", "true"), ("seed", "'1'"), ("seed", "1.5"), ("seed", "null"), ("seed", "-1"), ("seed", "2147483648"),
        ("seed", ".nan"), ("seed", ".inf"), ("seed", "[1]"), ("seed", "{a: 1}"), ("seed", "2020-01-01"),
        ("budget.steps", "1.5"), ("budget.steps", "0"), ("budget.steps", "false"), ("budget.steps", "1e13"),
        ("learner.gamma", "true"), ("learner.gamma", "'0.9'"), ("learner.gamma", "1.01"), ("learner.gamma", "-0.1"),
        ("learner.gamma", ".nan"), ("learner.learning_rate", "0"), ("learner.learning_rate", ".inf"),
        ("learner.net_arch", "64"), ("learner.net_arch", "[64, 0]"), ("learner.net_arch", "[64, 1.5]"),
        ("learner.net_arch", "'64'"), ("learner.net_arch", "null"), ("learner.net_arch", "[true]"),
        ("learner.batch_size", "1"), ("learner.activation", "gelu"), ("learner.activation", "null"),
        ("learner.normalize_advantage", "1"), ("learner.max_grad_norm", "0"), ("learner.log_std_init", ".inf"),
        ("learner.kind", "rainbow"), ("learner.kind", "null"), ("learner.kind", "[ppo]"),
        ("curriculum.kind", "spcae"), ("curriculum.eta", "0"), ("curriculum.kappa", "0"), ("curriculum.kappa", "0.5"),
        ("rollout.shards", "0"), ("rollout.shards", "5000"), ("rollout.slots", "-4"), ("rollout.passes", "0"),
        ("evaluation.every_steps", "0"), ("evaluation.every_steps", "-5"), ("evaluation.every_steps", "linear"),
        ("evaluation.every_steps", "1.5"), ("evaluation.every_steps", "true"), ("evaluation.episodes", "0"),
        ("env.context_visible", "yes"), ("env.context_visible", "1"), ("env.id", "''"), ("env.id", "3"),
        ("instances.train", "3"), ("instances.test", "null"), ("instances.test", "[a.csv]"),
        ("name", "a/b"), ("name", "../a"), ("name", "''"), ("name", "1"), ("name", ".hidden"), ("name", "'a b'"),
        ("name", '"a\\n"'), ("name", '"a\\u0000"'), ("name", "null"),
        ("resources.workers", "-1"), ("resources.workers", "1.5"), ("resources.grace_seconds", "0"),
        ("tracking.live", "'no'"), ("checkpoint.every_rounds", "0"), ("checkpoint.every_seconds", "-1"),
        ("env", "null"), ("env", "[]"), ("learner", "ppo"), ("curriculum", "space"), ("rollout", "4"), ("budget", "1"),
    ],
)  # fmt: skip
def test_wrong_values_are_named_with_file_and_key(key: str, value: str, tmp_path: Path) -> None:
    path = written(tmp_path, replaced(plain(SPACE), key, Raw(value)))
    text = refusal(path)
    assert str(path) in text
    assert whole_file(text) or f"{path}: {key}" in text
    override = refusal(SPACE, f"{key}={value}")
    assert f"--set {key}=" in override


def test_unknown_kinds_list_what_is_known() -> None:
    text = refusal(SPACE, "curriculum.kind=spacee")
    assert "did you mean 'space'?" in text
    for kind in ("space", "round_robin", "random_growth", "cspace", "fixed"):
        assert kind in text
    assert "did you mean 'trpo'?" in refusal(SPACE, "learner.kind=tpro")
    assert "curriculum.kind" in refusal(SPACE, "curriculum={eta: 0.1}")


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("curriculum", "", "curriculum: the section is empty: it needs a kind, like `kind: space`. Allowed: space, "),
        ("curriculum", "space", "curriculum: 'space' is no section; write {kind: space}"),
        ("curriculum", "[]", "curriculum: [] is no section: it takes keys and values, and needs a kind, like"),
        ("learner", "", "learner: the section is empty: it needs a kind, like `kind: ppo`. Allowed: ppo, trpo, a2c"),
        ("instances", "", "instances: the section is empty: it needs train and test. Allowed here: train, test"),
        ("budget", "1000", "budget: 1000 is no section: it takes keys and values, and needs steps"),
        ("evaluation", "", "evaluation: the section is empty: give it keys and values, or leave the key out. Allowed "
                           "here: every_steps, episodes, legacy_metric"),
        ("env.kwargs", "", "env.kwargs: is empty; give it keys and values, or leave the key out"),
        ("schedule", "", "schedule: is empty; give it a list, [] for none, or leave the key out"),
        ("schedule", "[null]", "schedule.0: the section is empty: it needs steps and set"),
    ],
)  # fmt: skip
def test_empty_sections_are_told_what_they_need(key: str, value: str, said: str, tmp_path: Path) -> None:
    path = written(tmp_path, replaced(plain(SPACE), key, Raw(value)))
    assert f"{path}: {said}" in refusal(path)


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("name", "give it a text"),
        ("seed", "give it a whole number from 0 to 2,147,483,647, or leave the key out"),
        ("engine", "give it auto, single or population, or leave the key out"),
        ("env.context_visible", "give it true or false, or leave the key out"),
        ("instances.test", "give it a path"),
        ("curriculum.eta", "give it a number above 0, or leave the key out"),
        ("learner.gamma", "give it a number from 0 to 1, or leave the key out"),
        ("learner.net_arch", "give it a list, [] for none, or leave the key out"),
        ("rollout.slots", "give it a whole number from 1 to 65,536, or leave the key out"),
        ("budget.steps", "give it a whole number from 1 to 1,000,000,000,000: budget.episodes is a limit beside it, "
                         "and the one that is reached first ends a run"),
        ("evaluation.every_steps", "give it a whole number or log, or leave the key out"),
        ("env.kwargs.horizon", "give it true or false, a number, or a text, or leave it out"),
    ],
)  # fmt: skip
def test_empty_values_are_told_what_they_need(key: str, said: str) -> None:
    assert refusal(SPACE, f"{key}=") == f"--set {key}=: {key}: is empty; {said}"


def test_no_empty_value_is_told_in_pydantics_words() -> None:
    """Of no key of any section, whichever kind it is of, nor in lists and by names of a user's own."""
    data = configs.read(SPACE)
    sections = [
        (name, model, key)
        for name, field in configs.RunConfig.model_fields.items()
        for model in (field.annotation, *get_args(field.annotation)) if isinstance(model, type)
        and issubclass(model, configs.Section)
        for key in model.model_fields
    ]  # fmt: skip
    assert len(sections) > 200
    empty: list[dict[str, Any]] = [{name: None} for name in configs.RunConfig.model_fields]
    for name, model, key in sections:
        kind = {"kind": get_args(model.model_fields["kind"].annotation)[0]} if "kind" in model.model_fields else {}
        section = {**(kind or data.get(name, {})), model.model_fields[key].alias or key: None}
        empty.append({name: [section] if name == "schedule" else section})
    empty += [{"schedule": [{"steps": 5000, "set": {key: None}}]} for key in ("learner.gamma", "curriculum")]
    empty += [{"learner": {"kind": "ppo", "net_arch": [None]}}, {"tracking": {"sinks": [None]}}]
    said = []
    for change in empty:
        try:
            configs.parse({**data, **change}, "run.yaml")
        except ConfigError as error:
            said += str(error).splitlines()
    assert len(said) > 200
    assert [line for line in said if re.search(r"Input|None|a value", line)] == []


def test_values_of_no_type_that_a_key_may_have_are_told_all_of_them() -> None:
    assert refusal(SPACE, "evaluation.every_steps=1.5").endswith("must be a whole number or log, not 1.5")
    text = refusal(SPACE, "checkpoint.every_rounds=atuo")
    assert text.endswith("checkpoint.every_rounds: must be a whole number or auto, not 'atuo'; did you mean 'auto'?")
    assert refusal(SPACE, "env.kwargs={a: [1]}").endswith("env.kwargs.a: must be true or false, a number, or a text, "
                                                          "not [1]")  # fmt: skip


# None of which is what most keys take, nor within the range of any.
WRONG = (
    True, -1e30, 1e30, -(10**30), 10**30, 0.5, float("nan"), float("inf"), "", "x" * 5000, "no such word", [], [[]],
    [-1e30] * 20, ["x" * 5000] * 101, {}, {"x": [1]}, {1: 2},
)  # fmt: skip
OF_PYDANTIC = re.compile(r"[A-Z]\w+ (should|must) |Field required|Extra inputs|a value|valid ")


def with_wrong_values(model: Any, whole: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """A file of this schema again and again, with each of its keys, however deep, of each wrong value."""
    for key, field in model.model_fields.items():
        name = field.alias or key
        yield from ({**whole, name: value} for value in WRONG)
        for section in sections_in(field.annotation):
            kind = section.model_fields.get("kind")
            kinds = {"kind": get_args(kind.annotation)[0]} if kind and field.annotation is not section else {}
            given = whole.get(name)
            inner = kinds or (given if isinstance(given, dict) and field.annotation is section else {})
            for one in with_wrong_values(section, inner):
                listed = get_origin(field.annotation) is tuple
                named = get_origin(field.annotation) is dict
                yield {**whole, name: [one] if listed else {"a": one} if named else one}


def sections_in(annotation: Any) -> list[Any]:
    if isinstance(annotation, type) and issubclass(annotation, configs.Section):
        return [annotation]
    return [section for part in get_args(annotation) for section in sections_in(part)]


@pytest.mark.parametrize("model", [configs.RunConfig, GridConfig, TuneConfig, Profile])
def test_no_wrong_value_is_told_in_pydantics_words(model: Any) -> None:
    """Of no key of any section, whichever kind it is of, of no kind of file."""
    whole = configs.read(SPACE) if model is configs.RunConfig else {}
    said = set()
    for change in with_wrong_values(model, whole):
        try:
            configs.check(model, change, "a.yaml")
        except ConfigError as error:
            said.update(str(error).splitlines())
    assert len(said) > 100
    assert [line for line in sorted(said) if OF_PYDANTIC.search(line)] == []


def test_a_value_out_of_its_range_is_told_the_range() -> None:
    assert refusal(SPACE, "seed=-1").endswith("seed: must be a whole number from 0 to 2,147,483,647, not -1")
    assert refusal(SPACE, "learner.net_arch=[0]").endswith("net_arch.0: must be a whole number from 1 to 16,384, not 0")
    assert refusal(SPACE, "curriculum.eta=.inf").endswith("eta: must be a finite number above 0, not inf")
    assert refusal(SPACE, f"env.id={'x' * 301}").endswith("env.id: must be a text of 1 to 300 characters, not of 301")
    assert refusal(SPACE, "name=5").endswith("name: must be a text, not 5; write it in quotes")
    assert refusal(SPACE, "name=a b").endswith(
        "name: must be a name of letters, digits, dots, underscores and hyphens, the first a letter or a digit, of at "
        "most 100 characters, not 'a b'"
    )
    with pytest.raises(ConfigError, match=r"search\.a\.float: must be a list of 2 numbers, not \[1\.0\]"):
        configs.check(TuneConfig, {"search": {"a": {"float": [1.0]}}}, "a.yaml")


def test_missing_sections_are_told_what_they_need(tmp_path: Path) -> None:
    tree = plain(SPACE)
    del tree["curriculum"], tree["instances"]
    text = refusal(written(tmp_path, json.dumps(tree)))
    assert "curriculum: this key is required: a section with a kind, like `kind: space`; `space-dist config" in text
    assert "explains it. Allowed: space, round_robin" in text
    assert "instances: this key is required: a section with train and test; `space-dist config" in text
    tree = plain(SPACE) | {"budget": {"episodes": 40}}
    assert refusal(written(tmp_path, json.dumps(tree))).endswith(
        "budget.steps: this key is required: budget.episodes is a limit beside it, and the one that is reached first "
        "ends a run; `space-dist config schema budget.steps` explains it"
    )


def test_what_somebody_elses_code_takes_is_said_to_stand_in_kwargs() -> None:
    told = refusal(SPACE, "env.length=3")
    assert "env.length: unknown key. What the environment takes stands in kwargs: {'length': 3}. Allowed here: " in told
    told = refusal(SPACE, "env.context_visibel=false")
    assert told.endswith("unknown key; did you mean 'context_visible'? Allowed here: id, kwargs, context_visible")
    told = refusal(SPACE, "curriculum={kind: custom, import: 'mine:Mine', share: 0.5}")
    assert "unknown key. What a curriculum of your own takes stands in kwargs: {'share': 0.5}. Allowed here: k" in told
    told = refusal(SPACE, "curriculum={kind: custom, import: 'mine:Mine', imports: 'mine:Mine'}")
    assert told.endswith("unknown key; did you mean 'import'? Allowed here: kind, import, kwargs, columns")
    assert refusal(SPACE, "env.kwarg={length: 3}").endswith("Allowed here: id, kwargs, context_visible")


@pytest.mark.parametrize(
    ("address", "hint"),
    [
        ("http://head:8265", " (a job server has http://HOST:PORT, which `grid submit --address` takes)"),
        ("HTTPS://head", " (a job server has https://HOST:PORT, which `grid submit --address` takes)"),
        ("loacl", " (did you mean 'local'?)"), ("head", ""), ("head:abc", ""), (":6379", ""), ("head:99999", ""),
        ("foo:bar:baz", ""), ("anyscale://x", ""),
        ("ray://head:10001",
         " (ray:// is a Ray client's; a run is started on a machine of the cluster, or by `grid submit`)"),
    ],
)  # fmt: skip
def test_an_address_that_no_ray_has_is_refused(address: str, hint: str) -> None:
    override = f"resources.address={address}"
    said = f"resources.address: must be local, auto or HOST:PORT{hint}, not {address!r}"
    assert refusal(SPACE, override) == f"--set {override}: {said}"


@pytest.mark.parametrize("address", ["local", "auto", "head:6379", "10.0.0.1:6379", "'[::1]:6379'"])
def test_addresses_of_rays_are_taken(address: str) -> None:
    assert load(SPACE, [f"resources.address={address}"]).resources.address == address.strip("'")


def test_several_faults_are_told_together() -> None:
    text = refusal(SPACE, "seed=-1", "name=a/b", "learner.gamma=2")
    assert [line.partition(": ")[0] for line in text.splitlines()] == [
        "--set name=a/b", "--set seed=-1", "--set learner.gamma=2",
    ]  # fmt: skip


def test_settings_that_do_not_go_together() -> None:
    text = refusal(SPACE, "rollout.shards=3", "seed=3")
    assert text.startswith(f"{SPACE} with --set rollout.shards=3: learner.n_steps = 2048 ")
    for part in ("learner.n_steps = 2048", "rollout.shards * rollout.slots = 3 * 4 = 12"):
        assert part in text
    text = refusal(SPACE, "budget.steps=2047")
    assert "budget.steps = 2047 is less than one update of learner.n_steps = 2048" in text


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        (["seed=3", "learner.n_steps=1000", "learner.gamma=0.9"], "--set learner.n_steps=1000"),
        (["learner={kind: ppo, n_steps: 1000}"], "--set learner={kind: ppo, n_steps: 1000}"),
        (["budget.steps=2000", "learner.n_steps=4000"], "--set budget.steps=2000 --set learner.n_steps=4000"),
        (["device=cuda"], "--set device=cuda"),
        (["learner.kind=trpo"], "--set learner.kind=trpo"),  # the file has keys of ppo's
        (["curriculum.eta=0.2", "curriculum.kappa=1", "curriculum.growth=multiply"],
         "--set curriculum.kappa=1 --set curriculum.growth=multiply"),
    ],
)  # fmt: skip
def test_a_file_that_an_override_makes_wrong_is_named_with_it(overrides: list[str], named: str, tmp_path: Path) -> None:
    for line in refusal(SPACE, *overrides).splitlines():
        assert line.startswith(f"{SPACE} with {named}: ")
    faulty = written(tmp_path, replaced(plain(SPACE), "learner.gamma", 2))
    said = refusal(faulty, "learner.kind=ppo")
    assert said == f"{faulty}: learner.gamma: must be a number from 0 to 1, not 2"  # which is the file's own
    faulty = written(tmp_path, replaced(plain(SPACE), "learner.n_steps", 1000))
    assert refusal(faulty, "learner.gamma=0.9").startswith(f"{faulty}: learner.n_steps = 1000 ")


@pytest.mark.parametrize(
    "override", ["", "=", "=1", "seed", ".seed=1", "budget..steps=1", "budget.=1", " =1", "seed=[", "seed=*a",
                 "seed: 1", "seed=!!int ''", "seed=!!python/name:os.system", "\0=1", "seed=\x1b[31m"],
)  # fmt: skip
def test_malformed_overrides(override: str) -> None:
    assert "--set" in refusal(SPACE, override)


def test_overrides_into_something_that_is_no_section() -> None:
    assert "--set name.x=1: 'name' is not a section" in refusal(SPACE, "name.x=1")
    assert "is not a section" in refusal(SPACE, "learner.net_arch.0=1")


def test_a_value_that_a_sentence_names_is_known_for_an_overrides() -> None:
    told = {"curriculum.column": "--set curriculum.column=dificulty", "seed": "--set seed=1",
            "instances.test": "--set instances.test=sets/a_test.csv"}  # fmt: skip
    sentence = "instances.train: /x/train.csv: row 1: there is no column 'dificulty'"
    assert with_changes("a.yaml", sentence, told) == "a.yaml with --set curriculum.column=dificulty"
    sentence = "overlap: of /x/a_train.csv and /x/sets/a_test.csv, by their ids: 1 is 1"
    assert with_changes("a.yaml", sentence, told) == "a.yaml with --set instances.test=sets/a_test.csv"
    assert with_changes("a.yaml", "there is no space for 1 more", told) == "a.yaml"


def test_overrides_fill_a_section_that_is_empty() -> None:
    assert load(SPACE, ["curriculum=null", "curriculum.kind=round_robin"]).curriculum.kind == "round_robin"


@pytest.mark.parametrize(
    "content", [b"", b"\n", b"# only a comment\n", b"3", b"[1, 2]", b"text", b"null", b"---\n...\n", b"\xff\xfe\x00",
                b"a: b: c", b"\tname: x", b"a\0b", b"{", b"'", b"x: *y", b"- a", b"a: 1\n---\nb: 1\n"],
)  # fmt: skip
def test_files_that_are_no_configs(content: bytes, tmp_path: Path) -> None:
    assert attempt(written(tmp_path, content)) is not None


def test_paths_that_are_no_files(tmp_path: Path) -> None:
    written(tmp_path, TEXT, "pointmass.yaml")
    text = refusal(tmp_path / "pointmas.yaml")
    assert "does not exist" in text
    assert "pointmass.yaml" in text
    assert "folder" in refusal(tmp_path)
    for name in ("x" * 300, "a\0b", "missing/deeper.yaml", "pointmass.yaml/below.yaml"):
        assert refusal(tmp_path / name)
    assert "not a regular file" in refusal(Path("/dev/null"))
    big = written(tmp_path, b"#" * (2 << 20), "big.yaml")
    assert "larger than" in refusal(big)


# ---- the schema explains itself -------------------------------------------------------------------------------------


def sections(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    yield model
    for field in model.model_fields.values():
        options = get_args(field.annotation) or (field.annotation,)
        for option in options:
            if isinstance(option, type) and issubclass(option, BaseModel):
                yield from sections(option)


def keys(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    for name, field in model.model_fields.items():
        options = [option for option in (get_args(field.annotation) or (field.annotation,))
                   if isinstance(option, type) and issubclass(option, BaseModel)]  # fmt: skip
        if not options:
            yield f"{prefix}{field.alias or name}"
        for option in options:
            yield from keys(option, f"{prefix}{name}.")


def test_every_field_of_every_section_is_explained() -> None:
    for section in sections(RunConfig):
        assert section.__doc__, section.__name__
        for name, field in section.model_fields.items():
            options = [option for option in (get_args(field.annotation) or (field.annotation,))
                       if isinstance(option, type) and issubclass(option, BaseModel)]  # fmt: skip
            assert options or (field.description or "").strip(), f"{section.__name__}.{name}"


def test_schema_lists_every_field_once_per_kind_with_type_default_and_meaning() -> None:
    lines = list(schema())
    assert sorted(key for key, kind, _, _ in lines if kind != "section") == sorted(keys(RunConfig))
    named = {key.partition(" ")[0] for key, _, _, _ in lines}
    assert named >= {key for path in SHIPPED for key, _ in leaves(load(path).model_dump(mode="json"))
                     if not key.startswith("env.kwargs.")}  # fmt: skip
    assert all(kind and text for _, kind, _, text in lines)
    assert all(default for _, kind, default, _ in lines if kind != "section")
    by_key = {(key, default) for key, _, default, _ in lines}
    assert {("seed", "0"), ("budget.steps", "required"), ("learner.net_arch", "[64, 64]"), ("env.id", "required"),
            ("learner.max_grad_norm", "0.5"), ("learner.max_grad_norm", "0.5")} <= by_key  # fmt: skip
