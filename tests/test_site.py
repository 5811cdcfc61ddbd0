"""The pages as a site, and what they tell people to type.

Every block that one types is executed as a whole: see tests/test_site_commands.py, which names the files, and sees to
it that none is left out. Python, YAML and commands of docs/python.md, docs/sb3.md and the three pages about what is
one's own are executed by tests of their own (`ELSEWHERE`).

Here all commands of `space-dist`, `jobs/*.py` and `ray` are held against their own parsers, and not in small:
sub-commands, options and types, files that begin with `configs/` or `jobs/` and names that begin with `shipped:` must
exist, and what `--set` sets must be a key with such a value. Targets of `make` must exist. Words in capitals stand for
something. Those that are cheap are executed on the shipped files themselves (`EXECUTED`). Nothing is said of what
commands print, but for the numbers of the quickstart (tests/test_quickstart.py) and the sentences of docs/faq.md.
"""

from __future__ import annotations

import ast
import functools
import html
import importlib.util
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import typer
from mkdocs.config import load_config

from space_dist import cli, config
from space_dist.config.shipped import located
from space_dist.experiment.grid_file import GridConfig, load_grid
from space_dist.experiment.tuning import TuneConfig, is_search
from space_dist.grid.forking import change_of
from space_dist.slurm.profile import load_profile
from tests.commanding import command
from tests.grids import ROOT

sys.path.append(str(ROOT / "jobs"))

from site_docstrings import as_lists

DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
ELSEWHERE = {  # whose blocks a test runs from the first to the last
    "python.md": "test_python.py", "sb3.md": "test_sb3.py", "your_environment.md": "test_user_env.py",
    "your_curriculum.md": "test_user_curriculum.py", "your_learner.md": "test_user_learner.py",
    "causes.md": "test_headroom.py", "wins.md": "test_wins.py",
}  # fmt: skip
SMALL = (
    "budget.steps=1024", "evaluation.every_steps=1024", "learner.n_steps=512", "learner.batch_size=64",
    "learner.n_epochs=1", "tracking.uri=null",
)  # fmt: skip
EXECUTED = re.compile(
    r"(config|configs|instances|grid plan|slurm export|train|evaluate|export-sb3|report runs/pointmass_space)\b"
)
SEPARATORS = {"&&", "||", ";", "|", "&"}
AROUND = {"do", "then", "else"}


@dataclass(frozen=True)
class Line:
    """A command of a page, in words; variables of the shell as they are written."""

    page: str
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.page}: {shlex.join(self.words)}"


def blocks(page: Path, *languages: str) -> list[str]:
    return [code for language, code in BLOCK.findall(page.read_text()) if language in languages]


def lines(page: Path) -> Iterator[Line]:
    """The commands of a page that are ours to check."""
    for block in blocks(page, "bash", "console"):
        for text in (
            re.sub(r"<<'(\w+)'\n.*?^\1$", "", block, flags=re.DOTALL | re.MULTILINE).replace("\\\n", " ").splitlines()
        ):
            lexer = shlex.shlex(text.removeprefix("$ "), posix=True, punctuation_chars=";&|")
            lexer.whitespace_split = True
            words: list[str] = []
            for word in [*lexer, ";"]:
                if word in SEPARATORS:
                    if told(words):
                        yield Line(page.name, tuple(words))
                    words = []
                elif words or not (word in AROUND or re.match(r"[A-Z_]+=", word)):  # what stands before a command
                    words.append(word)


def told(words: list[str]) -> bool:
    return bool(words) and (
        words[0] in {"space-dist", "make", "ray", "sbatch"}
        or (words[0] == "python" and len(words) > 1 and words[1].startswith("jobs/"))
    )


COMMANDS = [line for page in PAGES for line in lines(page)]


# ---- the site -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)], cwd=ROOT, capture_output=True,
        text=True, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip
    assert built.returncode == 0, built.stderr[-3000:]
    return folder


def entries(nav: Any) -> Iterator[str]:
    for one in nav if isinstance(nav, list) else nav.values() if isinstance(nav, dict) else ():
        yield from [one] if isinstance(one, str) else entries(one)


def test_the_site_builds_without_a_warning_and_every_page_is_in_its_navigation(site: Path) -> None:
    named = set(entries(load_config(str(ROOT / "mkdocs.yml"))["nav"]))
    assert {page.name for page in DOCS.glob("*.md")} == {name for name in named if not name.startswith("source/")}
    assert [name for name in named if not (site / name).with_suffix(".html").is_file()] == []


def test_files_outside_of_docs_are_pages(site: Path) -> None:
    shown = (site / "source/space_dist/curricula/space.py.html").read_text()
    assert "highlight" in shown
    assert "space.py.html" in (site / "source/space_dist/curricula/index.html").read_text()
    assert 'href="source/space_dist/curricula/space.py.html"' in (site / "architecture.html").read_text()


def test_arguments_and_fields_are_lists_on_the_page_of_the_api(site: Path) -> None:
    text = html.unescape(re.sub(r"<(?!/?(?:li|p)\b)[^>]+>", "", (site / "api.html").read_text()))
    for item in ("seed, workers: the run's seed,", "out: the run's folder;", "resume: go on with", "n_envs: how many"):
        assert f"<li>{item}" in text
    assert "<p>Raises LedgerError where there is no policy yet," in text


def test_a_narrow_screen_cuts_no_signature_off_and_breaks_no_word_of_a_heading(site: Path) -> None:
    page = (site / "api.html").read_text()
    assert "space_<wbr>dist.<wbr>api.<wbr>headroom.<wbr>measure_<wbr>headroom</span>" in page
    assert 'href="signatures.css"' in page
    assert "white-space: pre-wrap" in (site / "signatures.css").read_text()
    assert "<wbr>" not in (site / "search/search_index.json").read_text()


def test_the_page_of_the_api_explains_what_its_signatures_name(site: Path) -> None:
    page = (site / "api.html").read_text()
    rows = {
        row for line in re.findall(r"<tr>\s*<td>(.*?)</td>", page) for row in re.findall(r"<code>(\w+)</code>", line)
    }
    assert rows >= {"Config", "Overrides", "Observations", "Row", "Run", "Ledger", "Cause", "EnvironmentSpec"}
    for path in ("report.headroom.Headroom", "curricula.watching.WatchedState"):
        assert f'id="space_dist.{path}"' in page


def test_a_list_has_what_is_told_of_names_and_nothing_else() -> None:
    told = (
        "First: a line.\n\nBefore them. seed: of draws; None: none.  out,\nroot: where seed: is.  size: two\n"
        "    lines. Raises OSError.\n\n    seed: code"
    )
    assert as_lists(told, ["seed", "size"]) == (
        "First: a line.\n\nBefore them.\n\n- **`seed`**: of draws; None: none.  out, root: where seed: is.\n"
        "- **`size`**: two lines.\n\nRaises OSError.\n\n    seed: code"
    )
    assert as_lists("seed, out: these.", ["seed", "out"]) == "- **`seed`**, **`out`**: these."
    assert as_lists("Nothing: no name.\nAnother line.", ["seed"]) == "Nothing: no name.\nAnother line."


def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    """Links of the text may lead elsewhere; scripts, styles, fonts and pictures may not come from there."""
    loads = re.compile(
        r"<(?:script|img|iframe|source)[^>]*\ssrc=\"?(?:https?:)?//|<link[^>]*rel=\"?(?:stylesheet|preconnect|icon)[^>]*href=\"?(?:https?:)?//"
    )
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > len(PAGES)
    assert [page.name for page in pages if loads.search(page.read_text())] == []


# ---- commands -------------------------------------------------------------------------------------------------------


@functools.cache
def parser(of: str) -> Any:
    """The click command behind `space-dist`, `ray` or a script of jobs/."""
    if of == "space-dist":
        return typer.main.get_command(cli.app)
    if of == "ray":
        from ray.scripts.scripts import cli as ray

        return ray
    spec = importlib.util.spec_from_file_location(Path(of).stem, ROOT / of)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    sys.path.insert(0, str(ROOT / "jobs"))  # where a script finds what lies beside it
    try:
        spec.loader.exec_module(module)
    finally:
        del sys.path[0]
    return typer.main.get_command(module.app)


def parsed(of: str, words: list[str]) -> dict[str, Any]:
    """What a command's own parser makes of its words. Raises what that raises; invokes nothing."""
    found, context = parser(of), None
    arguments = [number(word.strip("[]")) for word in words]
    while hasattr(found, "commands"):
        name = arguments.pop(0)
        assert name in found.commands, f"there is no `{name}`; there are {sorted(found.commands)}"
        context, found = found.context_class(found, info_name=of, parent=context), found.commands[name]
    return dict(found.make_context(words[0], arguments, parent=context).params)


def number(word: str) -> str:
    """A number for what may stand for one: a capital, or a variable of the shell."""
    return re.sub(r"^[A-Z]$|\$\{?\w+\}?", "4096", word)


def missing(words: list[str]) -> list[str]:
    """The files named by their place in the repository, or by `shipped:`, that are not there."""
    absent = []
    for word in words:
        if word.startswith(("configs/", "jobs/")) and "my_" not in word:
            absent += [] if list(ROOT.glob(re.sub(r"\$\{?\w+\}?", "*", word))) else [word]
        if word.startswith("shipped:"):
            absent += [] if located(word).exists() else [word]
    return absent


def settings(name: str, values: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the schema take what `--set` sets."""
    monkeypatch.chdir(ROOT)
    overrides = [number(one) for one in values.get("overrides") or values.get("set") or ()]
    if name == "slurm":
        load_profile(values.get("profile"), overrides)
    elif name == "fork":
        for override in overrides:
            change = {"steps": values["at"], "set": change_of(override)}
            config.load(ROOT / "configs/sparse_pointmass_procurl.yaml", [f"schedule={json.dumps([change])}"])
    elif overrides:
        given = Path(str(values["config"]))
        config.load(located(given) if list(ROOT.glob(str(given))) or "shipped:" in str(given) else
                    ROOT / "configs/pointmass_space.yaml", overrides)  # fmt: skip


@pytest.mark.parametrize("line", COMMANDS, ids=str)
def test_a_command_of_a_page_is_one_that_exists(line: Line, monkeypatch: pytest.MonkeyPatch) -> None:
    first, *rest = line.words
    assert missing(list(line.words)) == []
    monkeypatch.setattr("space_dist.ledger.there", lambda path: path)  # the runs of a page are nobody's here
    monkeypatch.setattr("space_dist.ledger.Ledger.status", lambda ledger: None)
    if first == "make":
        targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert set(rest) <= set(targets)
    elif first == "ray" and "--" in rest:
        parsed("ray", rest[: rest.index("--") + 2])
        inner = rest[rest.index("--") + 1 :]
        assert told(inner)
        test_a_command_of_a_page_is_one_that_exists(Line(line.page, tuple(inner)), monkeypatch)
    elif first in {"space-dist", "ray"}:
        values = parsed(first, rest)
        if first == "space-dist":
            settings(rest[0], values, monkeypatch)
    else:
        script, arguments = rest[0], rest[1:]
        meant = {"jobs/train.py": ["train"], "jobs/grid.py": ["grid", "run"]}.get(script)
        parsed("space-dist", [*meant, *arguments]) if meant else parsed(script, arguments)


def test_wrong_commands_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Or the test above would hold nothing."""
    assert len(COMMANDS) > 60
    assert {line.page for line in COMMANDS} > {
        "README.md",
        "index.md",
        "training.md",
        "ray.md",
        "slurm.md",
        "recovery.md",
    }
    for words in (
        "space-dist trian x", "space-dist train x --sed 1", "space-dist grid plan configs/grids/none.yaml",
        "make nothing",
        "space-dist train configs/pointmass_space.yaml --set learner.gama=1", "ray start --haed",
        "python jobs/benchmark.py nothing", "ray job submit -- python jobs/train.py x --sed 1",
        "space-dist slurm export configs/grids/quickstart.yaml --out x --set tiem=1", "space-dist train x --seed many",
    ):  # fmt: skip
        with pytest.raises(Exception):  # noqa: B017, PT011 - click's, ours, or an assertion
            test_a_command_of_a_page_is_one_that_exists(Line("", tuple(words.split())), monkeypatch)


@pytest.mark.usefixtures("capfd")
def test_cheap_commands_work_as_they_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    small = [word for one in SMALL for word in ("--set", one)]
    done = []
    for place, line in enumerate(dict.fromkeys(line.words for line in COMMANDS if executed(line))):
        words = [f"{tmp_path}/{place}{word}" if word.startswith("/shared") else word for word in line[1:]]
        words = [word for word in words if word != "--check"]  # which asks this machine's Slurm, if it has one
        code = command(monkeypatch, *words, *(small if words[0] == "train" else ()))
        assert code == 0, shlex.join(words)
        done.append(words[0])
    assert {"train", "evaluate", "export-sb3", "report", "instances", "configs", "grid", "slurm"} <= set(done)
    assert (tmp_path / "policy.zip").is_file()


def executed(line: Line) -> bool:
    words = shlex.join(line.words[1:])
    return (
        line.words[0] == "space-dist"
        and line.page not in ELSEWHERE
        and EXECUTED.match(words) is not None
        and (line.page == "training.md" or not words.startswith(("train", "evaluate")))
        and not re.search(r"--workers|my_package|carl|\$|[^-]\bGRID\b", words)
    )


# ---- snippets -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_of_a_page_compiles_and_is_executed_by_a_test(page: Path) -> None:
    for code in blocks(page, "python"):
        compile(code, page.name, "exec")
        assert page.name in ELSEWHERE


def test_tests_that_execute_pages_name_them() -> None:
    for page, test in ELSEWHERE.items():
        assert page in (ROOT / "tests" / test).read_text()


@pytest.mark.parametrize(
    ("page", "text"), [(page.name, text) for page in PAGES for text in blocks(page, "yaml")], ids=lambda one: one[:20]
)
def test_yaml_of_a_page_is_taken_by_the_schema(page: str, text: str, tmp_path: Path) -> None:
    (tmp_path / "snippet.yaml").write_text(text)
    data = config.read_yaml(tmp_path / "snippet.yaml")
    if "seeds" in data:
        config.check(TuneConfig if is_search(data) else GridConfig, data, page)
        return
    if page == "tuning.md":  # a part of the search that the page begins with
        (tmp_path / "search.yaml").write_text(blocks(DOCS / page, "yaml")[0])
        config.check(TuneConfig, config.read_yaml(tmp_path / "search.yaml") | data, page)
        return
    base = config.read(ROOT / "configs/pointmass_space.yaml")
    config.parse(data if "budget" in data else base | data, page)


def test_the_grid_of_the_page_has_the_cells_it_says(tmp_path: Path) -> None:
    (text,) = blocks(DOCS / "grids.md", "yaml")
    (tmp_path / "grid.yaml").write_text(
        text.replace("../pointmass_space.yaml", str(ROOT / "configs/pointmass_space.yaml"))
    )
    grid, cells = load_grid(tmp_path / "grid.yaml")
    assert (len(cells), len(grid.seed_list())) == (15, 10)


# ---- errors ---------------------------------------------------------------------------------------------------------


@functools.cache
def sentences() -> tuple[str, ...]:
    """Every text of the code, with {} for what is put in."""
    found = []
    for path in sorted((ROOT / "space_dist").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                found.append("".join(str(one.value) if isinstance(one, ast.Constant) else "{}" for one in node.values))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return tuple(found)


@pytest.mark.parametrize("message", blocks(DOCS / "faq.md", "text"), ids=lambda message: message[:40])
def test_an_error_of_the_page_is_one_of_the_code(message: str) -> None:
    pieces = [piece.strip() for piece in re.split(r"\b[A-Z]+\b", " ".join(message.split()))]
    told = [piece for piece in pieces if len(piece) > 5]
    assert max(map(len, told)) > 8
    assert any(all(piece in sentence for piece in told) for sentence in sentences())


def test_the_commonest_errors_are_on_the_page() -> None:
    assert 15 <= len(blocks(DOCS / "faq.md", "text")) <= 25
