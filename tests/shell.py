"""What stands in the pages' blocks, typed into bash: whole blocks as they are written, on configs in small.

Bash is real, and so is whatever a block calls besides `space-dist` and `python jobs/...`: these two are handed to the
test's own process, which has everything imported that a new one would spend seconds on.
"""

from __future__ import annotations

import os
import re
import select
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from space_dist import config as configs
from space_dist.api import grids, tuning
from space_dist.config import shipped
from space_dist.grid import fork_server, warm
from tests.commanding import command

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^```(?:bash|console)\n(.*?)^```", re.MULTILINE | re.DOTALL)
STEPS = 512
UPDATE = {"n_steps": STEPS // 2, "n_epochs": 1, "batch_size": 64}
# Behind those of a page's `train`. Mirroring into MLflow, which every run would start processes for, is `sync`'s here.
OPTIONS = ("--set", f"budget.steps={STEPS}", "--set", f"evaluation.every_steps={STEPS}", "--set", "tracking.uri=null")
_ASK = """#!/bin/bash
{condition}
printf '%s\\0' "$(($# + 2))" {program} "$PWD" "$@" >> "$PAGES_ASKED"
read -r code < "$PAGES_ANSWERED"
exit "$code"
"""


def bash_blocks(page: str) -> list[str]:
    """The blocks of a page that one types, by its name: README.md, or a page of docs."""
    return BLOCK.findall((ROOT / page if page == "README.md" else ROOT / "docs" / page).read_text())


Block = tuple[str, int]  # the page, and the number of its block, from 0


def executes(*blocks: Block) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A test that executes these blocks: tests/test_site_commands.py sees to it that no block is left out."""

    def marked(test: Callable[..., None]) -> Callable[..., None]:
        vars(test)["executes"] = blocks
        return test

    return marked


class Shell:
    """Bash in `folder`, which looks like a clone whose configs are in small.

    said: what it and its real programs have said.  typed: all words that were handed to this process.  done: blocks of
    pages that were executed.
    """

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        aside = folder.parent / f"{folder.name}-aside"  # what no clone has: a Ray job's working folder is sent whole
        self.folder, self.said, self._patch = folder, aside / "said.txt", monkeypatch
        self.typed: list[list[str]] = []
        self.done: list[Block] = []
        self._asked, self._answered, tools = aside / "asked", aside / "answered", aside / "tools"
        aside.mkdir()
        for path in (self._asked, self._answered):
            os.mkfifo(path)
        tools.mkdir()
        python = shlex.quote(sys.executable)
        here = f'[ "$PWD" = {shlex.quote(str(folder))} ]'  # and not in a Ray job
        ours = f'{{ {here} && [[ "$1" == jobs/* ]]; }} || exec {python} "$@"'
        native = f'[ -z "$SPACE_DIST_ARITHMETIC" ] || exec {python} -P -m space_dist.cli "$@"'
        for name, condition in (("space-dist", native), ("python", ours)):
            (tools / name).write_text(_ASK.format(condition=condition, program=name))
            (tools / name).chmod(0o755)
        shutil.copytree(ROOT / "jobs", folder / "jobs", ignore=shutil.ignore_patterns("__pycache__"))
        write_small_configs(folder / "configs")
        monkeypatch.setattr(shipped, "FOLDER", (folder / "configs").resolve())
        self.environment = {
            **os.environ, "PATH": f"{tools}:{Path(sys.executable).parent}:{os.environ['PATH']}",
            "PAGES_ASKED": str(self._asked), "PAGES_ANSWERED": str(self._answered), "SPACE_DIST_ARITHMETIC": "",
        }  # fmt: skip

    def block(self, page: str, number: int, replaced: Mapping[str, str] = {}, prelude: str = "", **how: Any) -> None:
        """Type a block of a page; see `run`. prelude: what bash is told before."""
        self.run(bash_blocks(page)[number], replaced, prelude=prelude, **how)
        self.done.append((page, number))

    def run(
        self, script: str, replaced: Mapping[str, str] = {}, prelude: str = "",
        answer: Callable[[list[str]], int] | None = None,
    ) -> None:  # fmt: skip
        """Type a block. replaced: what stands in it for something else, and what that is here; all of it must occur.

        answer: the exit code of words; by default `self.command`. Asserts that bash ends with 0, with `-e`.
        """
        for old, new in replaced.items():
            assert old in script, f"no {old!r} in:\n{script}"
            script = script.replace(old, new)
        asked, answered = (os.open(path, os.O_RDWR) for path in (self._asked, self._answered))
        try:
            with self.said.open("ab") as said:
                process = subprocess.Popen(
                    ["bash", "-e", "-c", prelude + script], cwd=self.folder, env=self.environment,
                    stdin=subprocess.DEVNULL, stdout=said, stderr=said,
                )  # fmt: skip
                try:
                    while process.poll() is None:
                        if select.select([asked], [], [], 0.05)[0]:
                            words = self._words(asked)
                            code = (answer or self.command)(words)
                            os.write(answered, f"{code}\n".encode())
                finally:
                    process.kill()
                    process.wait()
            last = self.typed[-1] if self.typed else []
            assert process.returncode == 0, (last, self.said.read_text()[-3000:])
        finally:
            os.close(asked)
            os.close(answered)

    def _words(self, asked: int) -> list[str]:
        text = b""
        while text.count(b"\0") < 1 or text.count(b"\0") <= int(text.split(b"\0")[0]):
            text += os.read(asked, 1 << 16)
        _, program, folder, *words = (one.decode() for one in text.split(b"\0")[:-1])
        assert Path(folder).samefile(self.folder), folder  # no block goes elsewhere
        self.typed.append([program, *words])
        return self.typed[-1]

    def command(self, words: list[str]) -> int:
        """Do what `space-dist` is asked, with small budgets."""
        program, *rest = words
        assert program == "space-dist", words
        self._patch.chdir(self.folder)
        if rest[0] == "train":
            rest += OPTIONS
        code = command(self._patch, *rest)
        # Of a grid that is not whole, `status` tells so by its exit code.
        return 0 if rest[:2] == ["grid", "status"] and code == 3 else code


def write_small_configs(folder: Path) -> None:
    """`configs/` with the same files, budgets of two updates, grids of two cells and one seed, and short sets."""
    for source in sorted((ROOT / "configs").rglob("*")):
        target = folder / source.relative_to(ROOT / "configs")
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.suffix == ".csv":
            rows = source.read_text().splitlines(keepends=True)
            few = 5 if source.name.startswith(("antgoal", "ballcatching")) else len(rows)
            target.write_text("".join(rows[:few]))
        elif source.suffix == ".yaml":
            target.write_text(configs.to_yaml(in_small(configs.read_yaml(source), source)))


def in_small(data: dict[str, Any], source: Path) -> dict[str, Any]:
    """A run's config or a grid as files say it, of two updates, and of two cells and one seed."""
    if "budget" in data:
        learner = data["learner"]
        of_episodes = learner["kind"] in ("dqn", "sac", "td3")
        data["learner"] = learner | ({"learning_starts": 32} if of_episodes else UPDATE)
        if data["env"]["id"].startswith("space_dist/AntGoal"):
            data["env"]["kwargs"] = {"horizon": 8}
        if "batch_size" not in learner and not of_episodes:  # SB3's own is small, and not every learner has one
            del data["learner"]["batch_size"]
        if learner["kind"] == "trpo":
            del data["learner"]["n_epochs"]
        return data | {
            "budget": {"steps": STEPS, **({"episodes": 3} if of_episodes else {})},
            "evaluation": {"every_steps": STEPS},
        }
    if "extends" not in data:
        return data
    few = {name: values[:2] for name, values in {**data.get("grid", {}), **data.get("zip", {})}.items()}
    # Of what `--scale 0.02` makes in small there is enough to be scaled.
    steps = 50 * STEPS if source.stem == "pointmass_multiply" else STEPS
    settings = {"budget.steps": steps, "evaluation.every_steps": steps}
    if isinstance(data["extends"], str) and "dqn" not in data["extends"]:
        settings |= {"learner.n_steps": STEPS // 2, "learner.n_epochs": 1}
    if "trials" in data:  # a search
        confirm = data["confirm"] | {"seeds": [1000]}
        return data | {"set": data["set"] | settings, "trials": 2, "generation": 1, "seeds": [0], "confirm": confirm,
                       "tracking": {"uri": None}}  # fmt: skip
    kept = {name: value for name, value in data.items() if name not in ("grid", "exclude", "baseline")}
    return kept | {"set": data.get("set", {}) | settings, "zip": few, "seeds": [0], "tracking": {"uri": None}}


@contextmanager
def one_server() -> Iterator[None]:
    """All grids are worked through by forks of one process, which imports once what takes a second, and one at a time.

    What they work on, every task says anew; their environment is what it was at first.
    """
    with fork_server.ForkServer() as server, pytest.MonkeyPatch.context() as patch:
        patch.setattr(server, "close", lambda: None)
        for place in (fork_server, warm, grids, tuning):
            patch.setattr(place, "ForkServer", lambda: server)
        patch.setattr("space_dist.api.grids.cores", lambda: 1)
        yield
