"""What others wrote, repeated in a sentence of ours."""

from __future__ import annotations

import reprlib


def clean(text: str) -> str:
    """At most 200 characters of somebody else's text, none of which commands a terminal."""
    line = (text.splitlines() or [""])[0][:200]
    return "".join(character if character.isprintable() else repr(character)[1:-1] for character in line)


def short(value: object) -> str:
    """A value as Python writes it, cut to what a sentence can hold."""
    shortener = reprlib.Repr()
    shortener.maxstring = shortener.maxother = 80
    shortener.maxlevel = 2
    return shortener.repr(value)
