"""A report as data, written as Markdown and as one HTML page that needs nothing else.

Words of users (labels, messages, log lines) are hostile until they are escaped, and are escaped here, in one place for
each format.
"""

from __future__ import annotations

import base64
import functools
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from space_dist.errors import ConfigError


@contextmanager
def writing_to(folder: Path) -> Iterator[None]:
    """Raises ConfigError where a report's folder, or a file in it, cannot be written."""
    try:
        yield
    except OSError as error:
        raise ConfigError(f"the report cannot be written to {folder}: {error.strerror or error}") from None


@dataclass(frozen=True)
class Picture:
    """A figure: the name of its PNG file beside the report, what it shows, and its bytes."""

    file: str
    caption: str
    png: bytes

    @property
    def source(self) -> str:
        """The whole picture as the address of an <img>."""
        return f"data:image/png;base64,{base64.b64encode(self.png).decode()}"

    @property
    def pixels(self) -> int:
        """Its width, from the PNG's header."""
        return int.from_bytes(self.png[16:20])


@dataclass(frozen=True)
class Section:
    """A part of a report, in the order in which it is written.

    `rows` are dicts that all have the same columns, each a cell of text; the first column is the row's head.
    `words`: the cells are words, not numbers. `details` are (summary, text of many lines) that Markdown leaves out.
    """

    title: str
    text: Sequence[str] = ()
    rows: Sequence[dict[str, str]] = ()
    items: Sequence[str] = ()
    pictures: Sequence[Picture] = ()
    details: Sequence[tuple[str, str]] = ()
    words: bool = False


@dataclass(frozen=True)
class Document:
    """A report: a title and its sections."""

    title: str
    sections: Sequence[Section]


def to_markdown(document: Document) -> str:
    """GitHub's Markdown; pictures are files beside it."""
    parts = [f"# {escaped(document.title)}"]
    for section in document.sections:
        parts += [f"## {escaped(section.title)}"] if section.title else []
        parts += [escaped(paragraph) for paragraph in section.text]
        parts += [markdown_table(section.rows)] if section.rows else []
        parts += ["\n".join(f"- {escaped(item)}" for item in section.items)] if section.items else []
        parts += [f"![{escaped(picture.caption)}]({picture.file})" for picture in section.pictures]
    return "\n\n".join(parts) + "\n"


def markdown_table(rows: Sequence[dict[str, str]]) -> str:
    """A Markdown table of rows that all have the same columns."""
    lines = [[*rows[0]], ["---"] + ["---:"] * (len(rows[0]) - 1), *([*row.values()] for row in rows)]
    return "\n".join(f"| {' | '.join(cell if number == 1 else escaped(cell) for cell in line)} |"
                     for number, line in enumerate(lines))  # fmt: skip


def escaped(text: str) -> str:
    """Text that Markdown shows as it is, in one line: no HTML, links, emphasis, code or columns."""
    text = re.sub(r"([\\`*<>|&])", r"\\\1", " ".join(text.split()))
    text = re.sub(r"\](?=[(\[:])", r"\\]", text)  # intervals in brackets stay readable
    text = re.sub(r"(?<![^\W_])_|_(?![^\W_])", r"\\_", text)
    # GitHub makes a link of any bare address.
    return text.replace("~~", r"\~\~").replace("://", r":\//")


def to_html(document: Document) -> str:
    """One page: styles and pictures within it, no scripts, no requests (its own policy forbids both)."""
    return _page().render(document=document)


@functools.cache
def _page() -> Template:
    environment = Environment(
        loader=PackageLoader("space_dist.report", "."), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters["unbroken"] = _unbroken
    return environment.get_template("page.html")


def _unbroken(text: str) -> str:
    """A cell whose lines do not break within brackets."""
    return re.sub(r"\[[^\]]*\]|\([^)]*\)", lambda found: found[0].replace(" ", "\N{NO-BREAK SPACE}"), text)
