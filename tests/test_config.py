"""The schema: what is accepted, what is refused and in which words, and what makes two runs the same run."""

from __future__ import annotations

import contextlib
import copy
import json
import os
import random
import resource
import select
import signal
import string
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import psutil
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError
from ruamel.yaml import YAML

from space_dist import config as configs
from space_dist.config import NOT_IDENTITY, RunConfig, differences, dump, identity, load, schema
from space_dist.errors import ConfigError

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


# ---- what is accepted -----------------------------------------------------------------------------------------------


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


def test_overrides_are_applied_in_order_and_the_seed_last() -> None:
    config = load(SPACE, ["seed=1", "curriculum={kind: round_robin}", "rollout.slots=8", "rollout.slots=2"], seed=9)
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


def test_several_faults_are_told_together() -> None:
    text = refusal(SPACE, "seed=-1", "name=a/b", "learner.gamma=2")
    assert [line.partition(": ")[0] for line in text.splitlines()] == [
        "--set name=a/b", "--set seed=-1", "--set learner.gamma=2",
    ]  # fmt: skip


def test_settings_that_do_not_go_together() -> None:
    text = refusal(SPACE, "rollout.shards=3")
    assert str(SPACE) in text
    for part in ("learner.n_steps = 2048", "rollout.shards * rollout.slots = 3 * 4 = 12"):
        assert part in text
    text = refusal(SPACE, "budget.steps=2047")
    assert "budget.steps = 2047 is less than one update of learner.n_steps = 2048" in text


@pytest.mark.parametrize(
    "override", ["", "=", "=1", "seed", ".seed=1", "budget..steps=1", "budget.=1", " =1", "seed=[", "seed=*a",
                 "seed: 1", "seed=!!int ''", "seed=!!python/name:os.system", "\0=1", "seed=\x1b[31m"],
)  # fmt: skip
def test_malformed_overrides(override: str) -> None:
    assert "--set" in refusal(SPACE, override)


def test_overrides_into_something_that_is_no_section() -> None:
    assert "--set name.x=1: 'name' is not a section" in refusal(SPACE, "name.x=1")
    assert "is not a section" in refusal(SPACE, "learner.net_arch.0=1")


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


# ---- generated faults -----------------------------------------------------------------------------------------------


class Raw(str):
    """YAML text that `emitted` copies as it stands."""

    __slots__ = ()


def emitted(tree: dict[str, Any], indent: int = 0) -> str:
    lines = []
    for key, value in tree.items():
        if isinstance(value, dict) and value:
            lines.append(f"{' ' * indent}{key}:\n{emitted(value, indent + 2)}")
        else:
            text = value if isinstance(value, Raw) else json.dumps(value)
            lines.append(f"{' ' * indent}{key}: {text}\n")
    return "".join(lines)


def replaced(tree: dict[str, Any], key: str, value: Any, *, rename: str | None = None) -> str:
    tree = copy.deepcopy(tree)
    section = tree
    *sections, last = key.split(".")
    for part in sections:
        section = section.setdefault(part, {})
    if rename is not None:
        section[rename] = section.pop(last)
    else:
        section[last] = value
    return emitted(tree)


def leaves(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


BASE = plain(SPACE)
LEAVES = [key for key, _ in leaves(BASE)]
SECTIONS = [key for key, value in BASE.items() if isinstance(value, dict)]
JUNK = [
    "null", "~", "''", "' '", "true", "[]", "[[[]]]", "{}", "{a: 1}", "{kind: {kind: 1}}", "-1", "0", "1e309", "1e-400",
    ".nan", ".inf", "-.inf", "9" * 400, "9" * 5_000, "0x" + "f" * 1_000, "0x" + "f" * 5_000, "[0x" + "f" * 5_000 + "]",
    "x" * 10_000, "'" + "y\\ " * 1_000 + "'", '"\\e[31m"', '"\\0"', '"\\ud800"', '"\\x85\\u2028"', '"a\\nb"',
    "!!python/object/apply:os.system ['touch /tmp/pwned']", "!!python/name:os.system", "!!python/module:os",
    "!!binary aGk=", "!!binary '*'", "!!timestamp 2020-01-01", "2020-01-01", "2020-13-41", "!!set {a, b}", "!!int ''",
    "!!int x", "!!float '-'", "!!bool x", "!!omap [a: 1]", "!!pairs [a: 1]", "!<tag:x> y", "! x", "&a [*a]",
    "&a {b: *a}", "*nowhere", "<<", "=", "{<<: {a: 1}}", "{<<: 1}", "{? [a] : 1}", "{? {a: 1} : 1}", "{1: 2}",
    "{null: 1}", "1_000",
    "0o17", "0b2", "1:30:00", "|", "> x", "? x", "@x",
    "`x`", "%x", "[", "]", "{", "}", "'", '"', "&", "*", "!", ": :",
    "- x", "[" * 60 + "]" * 60, "[" * 3_000 + "]" * 3_000, '"\\U00110000"', "[" + "1, " * 2_000 + "]",
    "{" + "k" * 900 + ": 1}", "{" + ", ".join(f"{'k' * 60}{i}: 1" for i in range(200)) + "}",
]  # fmt: skip


@broken
@given(content=st.one_of(st.binary(max_size=300), st.text(max_size=300).map(lambda text: text.encode(errors="replace")),
                         st.text("{}[]&*!|>%@`'\",:?-#\n ab01.<=~\t", max_size=120).map(str.encode)))  # fmt: skip
def test_random_bytes(content: bytes, tmp_path_factory: pytest.TempPathFactory) -> None:
    attempt(written(tmp_path_factory.getbasetemp(), content, "bytes.yaml"))


words = st.one_of(st.sampled_from(sorted(RunConfig.model_fields)), st.text(max_size=8))
data = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(string.printable, max_size=20)),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(words, inner, max_size=4)),
    max_leaves=20,
)


@broken
@given(tree=st.dictionaries(st.sampled_from([*RunConfig.model_fields, "nmae", "x" * 50]), data, max_size=8))
def test_random_yaml_data(tree: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> None:
    assert attempt(written(tmp_path_factory.getbasetemp(), configs.to_yaml(tree), "data.yaml")) is not None


@broken
@given(key=st.sampled_from([*LEAVES, *SECTIONS]), value=data)
def test_random_values(key: str, value: Any, tmp_path_factory: pytest.TempPathFactory) -> None:
    tree = copy.deepcopy(BASE)
    *sections, last = key.split(".")
    (tree[sections[0]] if sections else tree)[last] = value
    text = attempt(written(tmp_path_factory.getbasetemp(), configs.to_yaml(tree), "values.yaml"))
    assert text is None or whole_file(text) or key in text


@pytest.mark.parametrize("junk", JUNK, ids=lambda junk: repr(junk[:20]))
def test_junk_for_every_value(junk: str, tmp_path: Path) -> None:
    slow = len(junk) > 2_000  # what takes the YAML parser long is put in a few places only
    for key in ("name", "seed", "learner", "learner.kind", "learner.gamma") if slow else (*LEAVES, *SECTIONS, "seed"):
        text = attempt(written(tmp_path, replaced(BASE, key, Raw(junk))))
        assert text is None or whole_file(text) or key in text
    assert not Path("/tmp/pwned").exists()  # noqa: S108 - what one of the junk values tries to make


@pytest.mark.parametrize("junk", [junk for junk in JUNK if len(junk) < 2_000], ids=lambda junk: repr(junk[:20]))
def test_junk_as_a_key_and_in_an_override(junk: str, tmp_path: Path) -> None:
    for content in (f"? {junk}\n: 1\n{TEXT}", f"{TEXT}? {junk}\n: 1\n"):
        assert attempt(written(tmp_path, content)) is not None
    for override in (f"name={junk}", f"learner={junk}", f"{junk}=1", f"learner.{junk}=1", junk):
        text = ""
        try:
            load(SPACE, [override])
        except ConfigError as error:
            text = str(error)
        assert len(text) < MAX_MESSAGE


@pytest.mark.parametrize("key", [*LEAVES, *SECTIONS])
def test_missing_renamed_and_doubled_keys(key: str, tmp_path: Path) -> None:
    last = key.rpartition(".")[2]
    for new in ("", "x", last.upper(), "k" * 2_000, '"\\e[31m"', '"a\\nb"', '"\\ud800"', "<<", "!!int 3", "null"):
        text = attempt(written(tmp_path, replaced(BASE, key, None, rename=f"? {new}\n" if len(new) > 900 else new)))
        assert text is None or whole_file(text) or key in text or "unknown key" in text
    tree = copy.deepcopy(BASE)
    section = tree
    for part in key.split(".")[:-1]:
        section = section[part]
    del section[last]
    text = attempt(written(tmp_path, emitted(tree)))
    assert text is None or f"{key}" in text
    doubled = emitted(BASE).replace(f"{last}:", f"{last}: 1\n{'  ' if '.' in key else ''}{last}:", 1)
    text = attempt(written(tmp_path, doubled))
    assert text is not None
    assert last in text


def test_a_missing_kind_is_asked_for(tmp_path: Path) -> None:
    for section in ("learner", "curriculum"):
        tree = copy.deepcopy(BASE)
        del tree[section]["kind"]
        text = attempt(written(tmp_path, emitted(tree)))
        assert text is not None
        assert f"{section}.kind" in text
        assert ", ".join(kinds(section)) in text


@pytest.mark.parametrize("seed", range(120))
def test_garbled_configs(seed: int, tmp_path: Path) -> None:
    rng = random.Random(seed)
    content = bytearray(TEXT.encode())
    for _ in range(rng.randint(1, 8)):
        at = rng.randrange(len(content))
        match rng.randrange(5):
            case 0:
                content[at] = rng.randrange(256)
            case 1:
                del content[at : at + rng.randint(1, 40)]
            case 2:
                content[at:at] = rng.choice(JUNK[:24] + JUNK[28:])[:200].encode()
            case 3:
                content[at:at] = content[at : at + rng.randint(1, 100)]
            case _:
                content[at:at] = rng.choice(
                    [b"\n", b"  ", b"\t", b"\0", b"\xff", b": ", b"- ", b"&a ", b"*a ", b"<<: x"]
                )
    attempt(written(tmp_path, bytes(content)))


def laughs(levels: int, width: int, *, merge: bool = False) -> str:
    lines = ["a0: &a0 {x: 1}" if merge else "a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    for level in range(1, levels):
        again = "[" + ", ".join([f"*a{level - 1}"] * width) + "]"
        lines.append(f"a{level}: &a{level} " + (f"{{<<: {again}, k{level}: 1}}" if merge else again))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    "content",
    [
        laughs(12, 10), laughs(40, 2), laughs(12, 10, merge=True), laughs(40, 2, merge=True),
        "a: " + "[" * 10_000 + "]" * 10_000, "a: " + "[" * 10_000, "a: " + "{a: " * 10_000 + "}" * 10_000,
        "- " * 10_000, "? " * 10_000, "".join(" " * depth + "a:\n" for depth in range(1_000)), "!" * 10_000,
        "%YAML 1.0\n---\n" + TEXT, "%YAML 1.3\n---\n" + TEXT, "%YAML 3.9\n---\n" + TEXT, "%TAG ! x\n---\n" + TEXT,
        "%YAML 1." + "9" * 5_000 + "\n---\n" + TEXT, TEXT + "? " + "k" * 40_000 + "\n: 1\n",
        TEXT + ("? " + "k" * 20_000 + "\n: 1\n") * 2, TEXT + "".join(f"{'k' * 900}{i}: 1\n" for i in range(500)),
        TEXT + "".join(f"k{i}: {i}\n" for i in range(2_000)), TEXT + "seed: 0x" + "f" * 5_000 + "\n",
        TEXT + '"\\e]0;owned\\a": 1\n', TEXT + "learner: &l {<<: *l}\n", "a: " + "x" * 1_000_000,
        "a: [" + "1, " * 20_000 + "]",
    ],
    ids=[
        "billion laughs", "2**40 laughs", "billion merges", "2**40 merges", "10,000 [", "10,000 open [", "10,000 {",
        "10,000 -", "10,000 ?", "1,000 indents", "10,000 !", "YAML 1.0", "YAML 1.3", "YAML 3.9", "TAG", "YAML 1.99...",
        "long key", "long key twice", "500 long keys", "2,000 unknown keys", "5,000 hex digits", "terminal escape",
        "merge into itself", "1 MB word", "20,000 numbers",
    ],
)  # fmt: skip
def test_hostile_files_are_refused_quickly_and_briefly(content: str, tmp_path: Path) -> None:
    text = attempted_elsewhere(written(tmp_path, content))
    assert text is not None or content.startswith(("%YAML 1.", "%TAG"))


@pytest.mark.parametrize("code", ["\\e[2J", "\\e]0;owned\\a", "\\0", "\\b", "\\r", "\\x9b2J"])
def test_nothing_in_a_file_commands_the_terminal(code: str, tmp_path: Path) -> None:
    for content in (
        f'{TEXT}"{code}": 1\n', f'{TEXT}"{code}": 1\n"{code}": 1\n', f'{TEXT}"k{code}": {{a: 1}}\n',
        replaced(BASE, "learner", Raw(f'{{kind: ppo, "{code}": 1}}')), replaced(BASE, "learner.kind", Raw(f'"{code}"')),
        replaced(BASE, "name", Raw(f'"{code}"')), replaced(BASE, "seed", Raw(f'["{code}"]')), f'"{code}"\n',
        replaced(BASE, "seed", Raw(f'!!float "{code}"')), replaced(BASE, "seed", Raw(f'!!timestamp "{code}"')),
    ):  # fmt: skip
        text = attempt(written(tmp_path, content))
        assert text is not None
        assert all(character.isprintable() or character == "\n" for character in text), repr(text)


def test_a_line_break_in_a_key_makes_no_line_of_its_own(tmp_path: Path) -> None:
    text = attempt(written(tmp_path, f'{TEXT}"a\\nspace-dist: all is well": 1\n'))
    assert text is not None
    assert len(text.splitlines()) == 1


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


# ---- identity -------------------------------------------------------------------------------------------------------


def kinds(section: str) -> list[str]:
    options = get_args(RunConfig.model_fields[section].annotation)
    return [get_args(option.model_fields["kind"].annotation)[0] for option in options]


# What a kind cannot do without.
NEEDED: dict[str, Any] = {"fixed": {"count": 4}, "manual": {"column": "difficulty"},
                          "custom": {"import": "my_package.my_module:Mine"}}  # fmt: skip
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
}
# What decides no result, and so is no part of a run's identity: when it is saved, where it is mirrored, what it runs
# on, and where its instance files, and the networks it starts from, lie (their content enters by digest).
UNIDENTIFYING = (*NOT_IDENTITY, "instances", "init_from")
# What must be set for another value to be valid, where none is: multiplying by a kappa of 1 is refused, and so are
# rounds of whole episodes in more than one slot.
COMPANIONS: dict[str, dict[str, Any]] = {
    "curriculum.growth": {"curriculum.kappa": 2},
    "curriculum.adaptive_eta": {"curriculum.growth": "add"},
    "rollout.shards": {"learner.n_episodes": None},
    "rollout.slots": {"learner.n_episodes": None},
    "learner.n_episodes": {"rollout.shards": 1, "rollout.slots": 1},
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
        return [[32, 32], ["effort"], ["wandb"]]
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
    if key.partition(".")[0] in UNIDENTIFYING:
        assert ident(changed) == ident(config)
        assert differences(config, changed) == []
    else:
        assert ident(changed) != ident(config)
        assert [line.partition(":")[0] for line in differences(config, changed)] == [key]
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
    assert ident(CONFIGS["learner_ppo"]) == ident(CONFIGS["curriculum_space"]) == ident(load(SPACE))
    assert len({ident(CONFIGS[name]) for name in names}) == len(names) - 1


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
    assert set(found) >= {"curriculum.eta: 0.1 -> None", "curriculum.kind: space -> round_robin",
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
        "has_advantages": ["ppo", "trpo", "a2c"],
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
