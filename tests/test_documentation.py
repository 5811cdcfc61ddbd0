"""What the pages say of the code: files and names that are there, and the figure of the packages as they are today."""

from __future__ import annotations

import ast
import functools
import importlib.util
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from PIL import Image

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    path for folder in (ROOT, *(ROOT / name for name in ("docs", "configs", "slurm")))
    for path in (folder.glob("*.md") if folder == ROOT else folder.rglob("*.md"))
)  # fmt: skip
CODE = sorted(path for folder in ("space_dist", "jobs", "tests") for path in (ROOT / folder).rglob("*.py"))
LOOKED_IN = tuple(ROOT / name for name in ("", "space_dist", "tests", "docs"))
FILE = re.compile(r"(?<![\w./~<-])(?:[\w-]+/)*[\w-]+\.(?:py|md)\b(?![\w/])")
QUOTED = re.compile(r"`([^`\n]+)`")
FENCED = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[([^\]]*)\]\(([^)#\s]*)(?:#[^)]*)?\)")
NAME = re.compile(r"([A-Z]\w+)\.([a-z_]\w*)(?:\(\))?")
WRITTEN = {"report.md", "results.md"}  # by space_dist: names of files in a run's or report's folder
OF_OTHERS = {"gymnasium/envs/classic_control/cartpole.py", "json.py", "PPO.load"}  # other packages'


def named(path: Path) -> str:
    return str(path.relative_to(ROOT))


def known(file: str, beside: Path) -> bool:
    """Whether a page or docstring may name it: it is here, or is somebody else's, or is what a reader writes."""
    return (
        any((folder / file).is_file() for folder in (*LOOKED_IN, beside))
        or file in WRITTEN | OF_OTHERS
        or Path(file).name.startswith("my_")
    )


def prose(page: Path) -> str:
    """A page without its blocks of code."""
    return FENCED.sub("", page.read_text())


def docstrings(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield ast.get_docstring(node) or ""


@functools.cache
def definitions(path: Path) -> frozenset[str]:
    """What a module defines, as `name`, and what its classes do, as `Class.name`."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        found |= bound(node)
        if isinstance(node, ast.ClassDef):
            own = [name for part in node.body for name in bound(part)]
            stored = [
                part.attr for part in ast.walk(node)
                if isinstance(part, ast.Attribute) and isinstance(part.ctx, ast.Store)
            ]  # fmt: skip
            found |= {f"{node.name}.{name}" for name in (*own, *stored)}
    return frozenset(found)


def bound(node: ast.stmt) -> set[str]:
    if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
        return {node.name}
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return {target.id for target in targets if isinstance(target, ast.Name)}


@functools.cache
def bases() -> dict[str, set[str]]:
    """By class of space_dist, the names of what it derives from; of several with one name, of all of them."""
    found: dict[str, set[str]] = {}
    for path in CODE:
        for node in ast.walk(ast.parse(path.read_text())) if "space_dist" in path.parts[len(ROOT.parts) :] else ():
            if isinstance(node, ast.ClassDef):
                parents = {base.id if isinstance(base, ast.Name) else getattr(base, "attr", "") for base in node.bases}
                found.setdefault(node.name, set()).update(parents)
    return found


@functools.cache
def everywhere() -> frozenset[str]:
    return frozenset(one for path in CODE for one in definitions(path))


def has(owner: str, name: str) -> bool:
    """Whether a class of that name, or one that it derives from, defines this; one of somebody else's may."""
    if owner not in bases():
        return True
    return f"{owner}.{name}" in everywhere() or any(
        parent in bases() and has(parent, name) for parent in bases()[owner] - {owner}
    )


@functools.cache
def architecture() -> ModuleType:
    """jobs/architecture.py, which is in no package."""
    spec = importlib.util.spec_from_file_location("architecture", ROOT / "jobs/architecture.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look for it
    spec.loader.exec_module(module)
    return module


# ---- files and names ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_a_page_links_to_files_that_are_there(page: Path) -> None:
    targets = [target for _, target in LINK.findall(prose(page)) if target and "://" not in target]
    assert [target for target in targets if not (page.parent / target).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_a_page_names_files_that_are_there(page: Path) -> None:
    quoted = [file for words in QUOTED.findall(prose(page)) for file in FILE.findall(words)]
    assert [file for file in quoted if not known(file, page.parent)] == []


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_what_a_page_links_to_by_name_is_defined_there(page: Path) -> None:
    """[`Training.work`](../space_dist/run/training.py)"""
    wanted = [
        (words.strip("`"), target) for words, target in LINK.findall(prose(page))
        if words.startswith("`") and re.fullmatch(r"`[A-Za-z_][\w.]*`", words) and target.endswith(".py")
        and not words.endswith(".py`")
    ]  # fmt: skip
    assert [
        one for one in wanted if one[0] not in {Path(one[1]).stem, *definitions((page.parent / one[1]).resolve())}
    ] == []


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_a_page_names_members_that_our_classes_have(page: Path) -> None:
    quoted = [found for words in QUOTED.findall(prose(page)) if (found := NAME.fullmatch(words))]
    assert [found[0] for found in quoted if not has(found[1], found[2]) and found[0] not in OF_OTHERS] == []


def test_docstrings_name_files_that_are_there() -> None:
    missing = {
        f"{named(path)}: {file}" for path in CODE for words in docstrings(path) for file in FILE.findall(words)
        if not known(file, path.parent)
    }  # fmt: skip
    assert missing == set()


def test_the_pages_and_docstrings_are_found() -> None:
    """Or the tests above would hold nothing."""
    assert {"README.md", "CONTRIBUTING.md", "docs/architecture.md"} <= {named(page) for page in PAGES}
    quoted = [file for page in PAGES for words in QUOTED.findall(prose(page)) for file in FILE.findall(words)]
    members = [words for page in PAGES for words in QUOTED.findall(prose(page)) if NAME.fullmatch(words)]
    cited = [file for path in CODE for words in docstrings(path) for file in FILE.findall(words)]
    assert min(len(quoted), len(members), len(cited)) > 20
    assert not has("Training", "no_such_method")
    assert has("RolloutActor", "start_values")  # of the Worker that it is
    assert not known("no_such_file.py", ROOT)


# ---- the house on one page ------------------------------------------------------------------------------------------


def test_the_figure_shows_the_packages_and_imports_of_today() -> None:
    """If not: `python jobs/architecture.py` draws it anew."""
    drawing = architecture()
    with Image.open(drawing.FIGURE) as image:
        assert image.info[drawing.KEY] == drawing.read().shown()


def test_arrows_that_are_left_out_are_ways_over_others() -> None:
    drawing = architecture()
    house = drawing.House(
        (("a",), ("b",), ("c",), ("d",)), frozenset({("a", "b"), ("b", "c"), ("a", "c"), ("a", "d")}), {}
    )
    assert house.arrows == (("a", "b"), ("a", "d"), ("b", "c"))


def test_the_page_says_of_every_package_what_it_is() -> None:
    page = (ROOT / "docs/architecture.md").read_text()
    assert set(architecture().PLACES) == {name for layer in architecture().read().layers for name in layer}
    said = re.findall(r"^\| \[`(\w+)`\]", page, re.MULTILINE)
    layers = [name for layer in architecture().read().layers for name in layer]
    assert said == layers
    assert {path.stem for path in (ROOT / "space_dist").iterdir() if path.suffix == ".py" or path.is_dir()} - {
        "__init__", "__pycache__", "shipped"
    } == set(layers)  # fmt: skip


def test_contributing_names_whoever_may_import_what_few_may() -> None:
    """As pyproject.toml has it, by package."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    page = " ".join((ROOT / "CONTRIBUTING.md").read_text().split())
    assert contracts[0]["exhaustive"]
    for library, words in (("ray", "Ray"), ("torch", "Stable-Baselines3, sb3-contrib and torch"), ("mlflow", "MLflow")):
        allowed = {
            line.split(".")[1].split(" ")[0]
            for contract in contracts
            for line in contract.get("ignore_imports", [])
            if line.endswith(f" -> {library}")
        }
        (sentence,) = re.findall(rf"- {words}: ([^.(]*)", page)
        assert set(QUOTED.findall(sentence)) == allowed
