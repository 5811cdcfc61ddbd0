"""YAML that is small and plain: only what JSON knows, every key once, nothing that grows when it is read."""

from __future__ import annotations

import difflib
import functools
import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.constructor import DuplicateKeyError, SafeConstructor
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import AliasEvent

from space_dist.config.quoting import clean, short
from space_dist.config.sections import MAX_LIST
from space_dist.errors import ConfigError, missing_folder

_MAX_CONFIG_BYTES = 64 << 10  # over twenty times the longest that ships
_MAX_ALIASES = 20  # each may double what a file means
_MAX_WORD = 100  # characters of a key
_MAX_BRACKETS = 200  # open at once
_ALIKE = 0.65  # of 1: names of files may be anything, so that half of one is no hint at another
_MAX_NESTING = 50  # the parser is recursive, and so is the check against the schema


def to_yaml(data: Mapping[str, Any]) -> str:
    """Plain data as YAML text."""
    # pure: ruamel's C parser reads YAML 1.1, where `yes` is true, and need not be installed.
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    buffer = io.StringIO()
    yaml.dump(dict(data), buffer)
    return buffer.getvalue()


def read_yaml(path: Path) -> dict[str, Any]:
    """The keys and values of a YAML file that is small, plain and UTF-8. Raises ConfigError otherwise."""
    try:
        if path.is_dir():
            raise ConfigError(f"{path} is a folder; a config is a YAML file")
        if path.suffix == ".py" and path.exists():
            raise ConfigError(f"{path} is Python; a config is a YAML file, which names what a module has: MODULE:NAME")
        if path.exists() and not path.is_file():
            raise ConfigError(f"{path} is not a regular file")
        with path.open("rb") as file:
            # One byte more than is allowed tells a file that is too large, without reading it all.
            content = file.read(_MAX_CONFIG_BYTES + 1)
    except FileNotFoundError:
        folder = path.parent
        above = folder / ".." / path.name
        hint = f"; did you mean {str(above)!r}?" if above.is_file() else _beside(path)
        raise ConfigError(f"{path} does not exist{hint}") from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if len(content) > _MAX_CONFIG_BYTES:
        raise ConfigError(f"{path} is larger than {_MAX_CONFIG_BYTES >> 10} KiB: that is no config")
    data = parse_yaml(content, str(path))
    if not isinstance(data, dict):
        it_is = "is empty" if data is None else f"holds {short(data)}"
        raise ConfigError(f"{path} must hold keys and values, like `name: my_run`; it {it_is}")
    return data


class _Constructor(SafeConstructor):
    """Numbers that cannot be read, and dates, stay words: the schema then says what is wrong, and with which key."""

    def _number_or_word(self, node: Any) -> Any:
        read = self.construct_yaml_int if node.tag.endswith(":int") else self.construct_yaml_float
        try:
            return read(node)
        except ValueError:
            return node.value


_Constructor.add_constructor("tag:yaml.org,2002:int", _Constructor._number_or_word)
_Constructor.add_constructor("tag:yaml.org,2002:float", _Constructor._number_or_word)
_Constructor.add_constructor("tag:yaml.org,2002:timestamp", SafeConstructor.construct_yaml_str)


class _ValueFaultError(ValueError):
    """A value that no config can hold; its text begins with the key."""


def _beside(path: Path) -> str:
    """A hint at a missing folder, or at the file beside it whose name, its ending aside, is nearly this one."""
    if hint := missing_folder(path):
        return hint
    files = {file.stem: file for file in sorted(path.parent.glob("*.yaml"))} if path.parent.is_dir() else {}
    close = difflib.get_close_matches(path.stem, files, n=1, cutoff=_ALIKE)
    return f"; did you mean {str(files[close[0]])!r}?" if close else "."


def parse_yaml(content: bytes | str, source: str) -> Any:
    """What a text says, as plain data. Raises ConfigError that begins with `source` for what is not small and plain."""
    try:
        text = content.decode() if isinstance(content, bytes) else content
        return _plain(_loaded(text, source))
    except UnicodeDecodeError as error:
        raise ConfigError(f"{source} is not UTF-8 text (byte {error.start})") from None
    except DuplicateKeyError as error:
        where = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        problem = str(error.problem).split(" with value")[0]
        raise ConfigError(f"{source}{where}: {clean(problem)}: every key may stand once") from None
    except YAMLError as error:
        mark = error.problem_mark if isinstance(error, MarkedYAMLError) else None
        where = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = error.problem if isinstance(error, MarkedYAMLError) and error.problem else str(error)
        raise ConfigError(f"{source}{where} is not valid YAML: {clean(str(problem))}") from None
    except _ValueFaultError as error:
        raise ConfigError(f"{source}: {error}") from None
    except RecursionError:
        raise ConfigError(f"{source} is nested too deeply") from None
    except (ValueError, TypeError, AttributeError, KeyError, IndexError, OverflowError, NotImplementedError,
            AssertionError) as error:  # fmt: skip  # ruamel asserts that %YAML names a version it knows
        raise ConfigError(f"{source} is not valid YAML: {clean(str(error))}") from None


def plain(data: Mapping[str, Any], source: str) -> dict[str, Any]:
    """What a program wrote, as if it had been read from YAML: a copy, of what JSON knows alone.

    Raises ConfigError that begins with `source`, and names the key, for anything else.
    """
    try:
        found: dict[str, Any] = _plain(dict(data))
    except RecursionError:
        raise ConfigError(f"{source} is nested too deeply") from None
    except ValueError as error:
        raise ConfigError(f"{source}: {error}") from None
    return found


@functools.lru_cache(maxsize=64)
def _loaded(text: str, source: str) -> Any:
    """What a YAML text says, for `_plain` to copy: ten milliseconds for a run's, which is read several times."""
    yaml = YAML(typ="safe", pure=True)
    yaml.Constructor = _Constructor
    yaml.allow_duplicate_keys = False
    _refuse_tricks(text, source)
    return yaml.load(text)


def _refuse_tricks(text: str, source: str) -> None:
    """Refuse what makes a small file mean a large one, or name types. Raises ConfigError, RecursionError."""
    depth = 0
    for bracket in re.findall(r"[\[{}\]]", text):
        depth += 1 if bracket in "[{" else -1
        if depth > _MAX_BRACKETS:  # ruamel would take minutes to say so
            raise RecursionError
    aliases = 0
    for event in YAML(typ="safe", pure=True).parse(text):
        aliases += isinstance(event, AliasEvent)
        tag = getattr(event, "tag", None)
        if tag is not None and str(tag) != "!":
            line = event.start_mark.line + 1
            raise ConfigError(
                f"{source}, line {line} is not valid YAML for a config: tags like {clean(str(tag))!r} are not read"
            )
    if aliases > _MAX_ALIASES:
        raise ConfigError(f"{source} has {aliases} aliases; at most {_MAX_ALIASES} are read")


def _plain(value: Any, path: tuple[str, ...] = ()) -> Any:
    """Only what JSON knows, so that dates, sets and self-containing aliases cannot surprise anyone later."""
    # An alias may hold itself: there is no end to what is copied then.
    if len(path) > _MAX_NESTING:
        raise RecursionError

    def fault(what: str) -> ValueError:
        return _ValueFaultError(f"{'.'.join(path) or 'the whole file'}: {what}")

    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str) or not key.isprintable() or len(key) > _MAX_WORD:
                raise ValueError(f"{'.'.join(path)}: the key {short(key)} is not a word".removeprefix(": "))
        return {str(key): _plain(item, (*path, str(key))) for key, item in value.items()}
    if isinstance(value, list):
        if len(value) > MAX_LIST:
            raise fault(f"a list of {len(value)} values")
        return [_plain(item, (*path, str(index))) for index, item in enumerate(value)]
    if isinstance(value, str) and not value.isprintable():
        raise fault(f"{short(value)} holds characters that cannot be printed")
    if isinstance(value, int) and abs(value) >= 1 << 63:
        raise fault("a number of more than 63 bits")
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return int(value) if abs(value) < 1 << 63 and value.is_integer() else value  # 1e6 is how people write counts
    raise fault(f"{short(value)} is a {type(value).__name__}; write numbers, words, lists and keys only")
