"""Docstrings of the code on the site's API page (mkdocs.yml): what they say of arguments and fields as lists.

In the code, arguments are told in running text: `seed: of the draws.  out: a folder; None: none is written.` A page
shows a paragraph of these as a list with an item each. Names are told from other words before a colon by the signature.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Any, Final

import griffe

_NAMES: Final = re.compile(r"(?:^|(?<=[.)]\s)|(?<=[.)]\s\s))(\w+(?:, \w+)*): ")  # where a sentence may begin
_BEHIND: Final = re.compile(r"(?<=\. )(?=(?:Raises|Returns) )")  # in an argument's paragraph, of all of them


def as_lists(docstring: str, names: Collection[str]) -> str:
    """A docstring as Markdown in which paragraphs that tell of these names are lists."""
    return "\n\n".join(_as_list(paragraph, names) for paragraph in docstring.split("\n\n"))


def _as_list(paragraph: str, names: Collection[str]) -> str:
    if paragraph.startswith((" ", "```")):  # code
        return paragraph
    text = re.sub(r"\s*\n\s*", " ", paragraph)
    found = [match for match in _NAMES.finditer(text) if {*match[1].split(", ")} <= {*names}]
    if not found:
        return paragraph
    ends = [match.start() for match in found[1:]] + [len(text)]
    items = [(match[1], text[match.end() : end].strip()) for match, end in zip(found, ends, strict=True)]
    last, *behind = _BEHIND.split(items[-1][1], maxsplit=1)
    items[-1] = (items[-1][0], last.strip())
    listed = "\n".join(f"- {_bold(told)}: {what}" for told, what in items)
    return "\n\n".join(part for part in (text[: found[0].start()].strip(), listed, *behind) if part)


def _bold(names: str) -> str:
    return ", ".join(f"**`{name}`**" for name in names.split(", "))


class Arguments(griffe.Extension):
    """What mkdocstrings calls."""

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        """Of a function: its parameters."""
        _rewrite(func, {parameter.name for parameter in func.parameters})

    def on_class(self, *, cls: griffe.Class, **_: Any) -> None:
        """Of a class: its fields, and what it is called with."""
        _rewrite(cls, {*cls.members} | {parameter.name for parameter in cls.parameters})


def _rewrite(told: griffe.Object, names: Collection[str]) -> None:
    if told.docstring is not None:
        told.docstring.value = as_lists(told.docstring.value, names)
