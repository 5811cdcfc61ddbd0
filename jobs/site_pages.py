"""Hooks of MkDocs (mkdocs.yml): pages written for GitHub, as a site.

A link from a page to a file of the repository outside `docs`, or to a folder, works on GitHub. Here such a file
becomes a page of the site, under `source/`: Markdown as itself, everything else highlighted; a folder becomes a page
that lists what is in it. Links are rewritten to lead there. And Markdown is read as GitHub reads it: lists and tables
need no blank line before them, and lists within lists are indented by two spaces.
"""

from __future__ import annotations

import ast
import os
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from markdown import Markdown
from markdown.extensions import Extension
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT: Final = Path(__file__).parents[1]
DOCS: Final = "docs/"
SOURCE: Final = "source/"  # where pages of files outside docs are on the site
LANGUAGES: Final = {
    ".py": "python", ".yaml": "yaml", ".toml": "toml", ".sh": "bash", ".sbatch": "bash", ".j2": "jinja",
    ".html": "html", ".json": "json", ".csv": "text", ".txt": "text", ".in": "text",
}  # fmt: skip
LARGEST: Final = 200_000  # bytes of a file that is shown

_LINK: Final = re.compile(r"(\]\()([^)\s#]*)((?:#[^)\s]*)?\))")
_FENCE: Final = re.compile(r"^\s*(```|~~~)")
_ITEM: Final = re.compile(r"^(\s*)(?:[-*+]|\d+\.)\s+\S")
_CODE: Final = re.compile(r"`[^`\n]*`")
_NAME: Final = re.compile(r'(<span class="doc doc-object-name[^>]*>)([\w.]+)(?=</span>)')


def uri_of(path: str) -> str:
    """Where a file or folder of the repository, by its path there, is among the site's files."""
    if (ROOT / path).is_dir():
        return f"{SOURCE}{path}/index.md"
    if path.startswith(DOCS) and Path(path).suffix in {".md", ".png"}:
        return path.removeprefix(DOCS)
    return f"{SOURCE}{path}.md"


def origin_of(uri: str) -> str:
    """The path in the repository of a page that was written as Markdown."""
    return uri.removeprefix(SOURCE).removesuffix(".md") if uri.startswith(SOURCE) else DOCS + uri


def linked(text: str, origin: str) -> Iterator[str]:
    """The files and folders of the repository, by their paths there, that the page `origin` links to."""
    for line in _prose(text):
        for _, target, _ in _LINK.findall(_CODE.sub("``", line)):
            if target and "://" not in target:
                yield posixpath.normpath(posixpath.join(posixpath.dirname(origin), target))


def _prose(text: str) -> Iterator[str]:
    fenced = False
    for line in text.splitlines():
        if _FENCE.match(line):
            fenced = not fenced
        elif not fenced:
            yield line


def as_site(text: str, origin: str, uri: str) -> str:
    """The Markdown of the page `origin` (a path in the repository) as it is on the site, at `uri`."""
    lines: list[str] = []
    fenced = False
    for line in text.splitlines():
        if _FENCE.match(line):
            fenced = not fenced
        if fenced:
            lines.append(line)
            continue
        if lines and _begins_block(lines[-1], line):
            lines.append("")
        lines.append(_LINK.sub(lambda found: _rewritten(found, origin, uri), line))
    return "\n".join(lines) + "\n"


def _begins_block(before: str, line: str) -> bool:
    """Whether a list or table begins here that follows a paragraph without a blank line."""
    item = _ITEM.match(line)
    if item:
        indent = len(before) - len(before.lstrip())
        return bool(before.strip()) and not _ITEM.match(before) and indent <= len(item[1])
    return line.startswith("|") and bool(before.strip()) and not before.startswith("|")


def _rewritten(found: re.Match[str], origin: str, uri: str) -> str:
    opening, target, closing = found.groups()
    if not target or "://" in target:
        return found[0]
    path = posixpath.normpath(posixpath.join(posixpath.dirname(origin), target))
    return opening + posixpath.relpath(uri_of(path), posixpath.dirname(uri) or ".") + closing


# ---- pages of files and folders -------------------------------------------------------------------------------------


def page_of(path: str) -> str:
    """The Markdown of the page that shows a file, or lists a folder, of the repository."""
    file = ROOT / path
    if file.is_dir():
        return _listing(path)
    if file.suffix == ".md":
        return file.read_text()
    language = LANGUAGES.get(file.suffix, "text")
    head = f"---\nsearch:\n  exclude: true\n---\n\n# {file.name}\n\n`{path}`\n\n"
    return f"{head}~~~~~~{language}\n{file.read_text()}~~~~~~\n"


def _listing(path: str) -> str:
    rows = [
        f"| [`{one.name}{'/' if one.is_dir() else ''}`]({one.name}) | {_about(one)} |" for one in _shown(ROOT / path)
    ]
    head = f"---\nsearch:\n  exclude: true\n---\n\n# {path}\n\n"
    return "\n".join([head, "| | |", "|---|---|", *rows, ""])


def _shown(folder: Path) -> list[Path]:
    """What of a folder is listed: folders first, then files of text."""
    found = [
        one for one in sorted(folder.iterdir())
        if not one.name.startswith((".", "__pycache__")) and (
            one.is_dir() or (one.suffix in {".md", *LANGUAGES} and one.stat().st_size <= LARGEST)
        )
    ]  # fmt: skip
    return sorted(found, key=lambda one: not one.is_dir())


def _about(path: Path) -> str:
    """The first line of a module's or package's docstring, or of a YAML file's comment."""
    file = path / "__init__.py" if path.is_dir() else path
    if file.suffix == ".py" and file.is_file():
        first = (ast.get_docstring(ast.parse(file.read_text())) or "").partition("\n\n")[0]
    elif file.suffix == ".yaml":
        first = file.read_text().partition("\n")[0]
        first = first.removeprefix("#").strip() if first.startswith("#") else ""
    else:
        first = ""
    return " ".join(first.split()).replace("|", "\\|").replace("<", "&lt;").replace("[", "\\[")


# ---- what MkDocs calls ----------------------------------------------------------------------------------------------


class _TwoSpaces(Extension):
    """Lists within lists are indented by two spaces or more."""

    def extendMarkdown(self, md: Markdown) -> None:  # noqa: N802 - Markdown's name
        md.tab_length = 2


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Have Markdown read as GitHub reads it."""
    extensions: list[object] = config.markdown_extensions  # type: ignore[assignment]  # which are handed to Markdown
    extensions.append(_TwoSpaces())
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the files and folders that pages link to, and those that these link to."""
    waiting = [
        path for file in files.documentation_pages() for path in linked(file.content_string, origin_of(file.src_uri))
    ]
    waiting += ["CHANGELOG.md", "CONTRIBUTING.md"]
    seen: set[str] = set()
    while waiting:
        path = waiting.pop()
        uri = uri_of(path)
        if path in seen or not uri.startswith(SOURCE) or not (ROOT / path).exists():  # MkDocs warns of the latter
            continue
        seen.add(path)
        content = page_of(path)
        files.append(File.generated(config, uri, content=content, inclusion=InclusionLevel.NOT_IN_NAV))
        if (ROOT / path).is_dir():
            waiting += [os.path.relpath(one, ROOT) for one in _shown(ROOT / path)]
        elif path.endswith(".md"):
            waiting += linked(content, path)
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001
    """Rewrite links, and let lists and tables begin where GitHub has them begin."""
    uri = page.file.src_uri
    if not uri.startswith(SOURCE):
        return as_site(markdown, DOCS + uri, uri)
    origin = origin_of(uri)
    if uri.endswith("/index.md"):
        return _LINK.sub(lambda found: _rewritten(found, uri.removeprefix(SOURCE), uri), markdown)
    return as_site(markdown, origin, uri) if origin.endswith(".md") else markdown


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:  # noqa: ARG001
    """Let a narrow screen break the names that are headings of the API behind a dot or an underscore."""
    return _NAME.sub(lambda found: found[1] + re.sub(r"(?<=[._])(?=\w)", "<wbr>", found[2]), output)
