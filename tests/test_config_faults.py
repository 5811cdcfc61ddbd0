"""Configs and instance sets with faults that a machine made up: refused in a sentence, or as good as they look."""

from __future__ import annotations

import copy
import random
import string
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from space_dist import config as configs
from space_dist.config import RunConfig, load
from space_dist.errors import ConfigError
from tests.config_texts import Raw, emitted, leaves, replaced
from tests.test_config import (
    MAX_MESSAGE,
    SPACE,
    TEXT,
    attempt,
    attempted_elsewhere,
    broken,
    kinds,
    plain,
    whole_file,
    written,
)

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
