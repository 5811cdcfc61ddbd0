"""The paper's grids: each can be run whole and in small, and one command makes what it shows, always the same."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from space_dist.config import read_yaml
from space_dist.envs.distributions import sample
from space_dist.errors import ConfigError
from space_dist.experiment.grid_file import load_grid
from space_dist.grid.planning import plan
from tests.grids import TINY, write_grid, write_line_instances
from tests.patience import PATIENCE

ROOT = Path(__file__).resolve().parent.parent
GRIDS = sorted(path.stem for path in (ROOT / "configs/paper").glob("*.yaml"))
INSTANCES = ROOT / "configs/instances"


def grid_file(name: str) -> Path:
    return ROOT / f"configs/paper/{name}.yaml"


def test_every_row_of_the_page_has_its_grid() -> None:
    page = (ROOT / "docs/results.md").read_text()
    claims = page.partition("## What came out")[0]
    rows = [line.split("|") for line in claims.splitlines() if line.startswith("| C")]
    assert len(rows) == 18
    named = {name.strip(" `") for row in rows for name in row[3].replace(", 100 mazes", "").split(",")}
    assert named <= {*GRIDS}
    assert {"cartpole", "ant", "ball_catching", "pointmass_uniform", "maze", "pointmass_table1", "pointmass_multiply",
            "ant_vds", "pointmass_target", "pointmass_sizes", "rivals"} <= {*GRIDS}  # fmt: skip


@pytest.mark.parametrize("name", GRIDS)
def test_a_grid_of_the_paper_is_whole_and_can_be_run_in_small(name: str, tmp_path: Path) -> None:
    """Ten seeds, and evaluations of which one half chooses instances and the other measures them."""
    grid, cells = load_grid(grid_file(name))
    assert len(grid.seed_list()) == 10
    assert all(data["evaluation"]["episodes"] % 2 == 0 for _, data in cells)
    assert grid.name == f"paper-{name.replace('_', '-')}"
    small = plan(grid_file(name), tmp_path, 0.02)
    assert (len(small.manifest.cells), len(small.manifest.seeds)) == (len(cells), 1)
    assert small.manifest.name == f"{grid.name}-scale-0.02"
    assert small.steps <= 0.0025 * sum(data["budget"]["steps"] for _, data in cells) * 10 + 10_000 * len(cells)


def test_the_table_has_the_papers_settings() -> None:
    for name in ("pointmass_table1", "pointmass_table1_trpo"):
        axes = read_yaml(grid_file(name))["grid"]
        assert axes == {"curriculum.kappa": [1, 4, 16, 32], "curriculum.eta": [0.05, 0.1, 0.2, 0.4]}


def test_the_sets_of_all_sizes_are_the_first_rows_of_one() -> None:
    """And what `space-dist instances sample` draws."""
    train, test = sample("pointmass_uniform", 1600, 100, 0)
    lines = train.to_csv().splitlines(keepends=True)
    for count in (25, 50, 100, 200, 400, 800, 1600):
        assert (INSTANCES / f"pointmass_sizes_train_{count}.csv").read_text() == "".join(lines[: count + 1])
    assert (INSTANCES / "pointmass_sizes_test.csv").read_text() == test.to_csv()


@pytest.mark.parametrize(("name", "distribution", "count"), [
    ("maze_dfs_1000", "maze_dfs", 1000), ("pointmass_goal", "pointmass_goal", 100)
])  # fmt: skip
def test_the_other_sets_are_what_is_drawn(name: str, distribution: str, count: int) -> None:
    for split, drawn in zip(("train", "test"), sample(distribution, count, 100, 0), strict=True):
        assert (INSTANCES / f"{name}_{split}.csv").read_text() == drawn.to_csv()


def test_only_the_goal_varies() -> None:
    train, test = sample("pointmass_goal", 50, 50, 3)
    assert {*train.contexts[:, 2], *test.contexts[:, 2]} == {2.0}
    assert len({*train.contexts[:, 0]}) == 50


def test_the_page_says_what_the_kept_results_say() -> None:
    """Number for number: the table is made of them again."""
    made = subprocess.run(
        [sys.executable, ROOT / "jobs/claims.py"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=True,
    ).stdout.strip()
    page = (ROOT / "docs/results.md").read_text()
    assert (
        page.partition("<!-- claims: made by jobs/claims.py -->")[2].partition("<!-- end of claims -->")[0].strip()
        == made
    )
    names = [path.parent.name for path in (ROOT / "docs/results").glob("*/provenance.json")]
    assert names, "nothing is kept"
    small = {name.partition("-scale-")[0] for name in names if "-scale-" in name}
    assert small <= {"ant", "ant_vds", "ball_catching"}  # what PyBullet steps; all else is kept whole
    assert {name for name in names if "-scale-" not in name} <= {*GRIDS} - small
    assert made.count("\n| [C") >= len(names)


@pytest.fixture
def claims(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """jobs/claims.py, which looks for kept results in `tmp_path`."""
    module = load_job("claims", monkeypatch)
    monkeypatch.setattr(module, "ROOT", tmp_path)
    return module


class Kept:
    """Results as `make results` keeps them, of values that are given."""

    def __init__(self, root: Path, name: str) -> None:
        cells = plan(grid_file(name), root / "runs").manifest.cells
        self.labels = [cell.label for cell in cells]
        self.folder = root / "docs/results" / name
        self.folder.mkdir(parents=True)
        (self.folder / "provenance.json").write_text(json.dumps({"scale": 1.0}))

    def curves(self, finals: Mapping[str, float], seeds: int = 10) -> Kept:
        """From 0 to the final return of the last key that is in a label, from which seeds and cells differ a little."""
        spread = np.random.default_rng(0).normal(0.0, 0.02, (len(self.labels), 10))
        rows = [
            f"x,{quoted(label)},{seed},{steps},{share * (final_of(label, finals) + spread[i, seed])}"
            for i, label in enumerate(self.labels)
            for seed in range(seeds)
            for steps, share in (
                (0, 0.0),
                (200_000, 0.5),
                (400_000 + 9_000 * seed, 0.9),
                (600_000, 0.9),
                (800_000, 1.0),
                (1_000_000, 1.0),
            )
        ]
        (self.folder / "seeds.csv").write_text("\n".join(["cell,label,seed,steps,test_return", *rows]) + "\n")
        return self

    def csv(self, name: str, columns: Mapping[str, Mapping[str, object]]) -> None:
        """`columns`: by label, its row."""
        heads = [*next(iter(columns.values()))]
        rows = [",".join([quoted(label), *(str(row[head]) for head in heads)]) for label, row in columns.items()]
        (self.folder / name).write_text("\n".join([",".join(["label", *heads]), *rows]) + "\n")


def quoted(label: str) -> str:
    return '"' + label.replace('"', '""') + '"'


def final_of(label: str, finals: Mapping[str, float]) -> float:
    return [value for key, value in finals.items() if key in label][-1]


@pytest.mark.parametrize(("name", "claim", "finals", "verdict"), [
    ("pointmass_table1", "C9 (PPO)", {"": 10.0}, "holds"),
    ("pointmass_table1_trpo", "C9 (TRPO)", {"": 10.0, "kappa=32": 10.2}, "holds"),
    ("pointmass_table1", "C9 (PPO)", {"": 10.0, "kappa=32": 12.0, "eta=0.4": 12.0}, "does not hold here"),
    ("pointmass_sizes", "C13", {"": 10.0, "_25.csv": 6.0, "_50.csv": 8.0}, "holds"),
    ("pointmass_sizes", "C13", {"": 10.0, "_25.csv": 6.0}, "holds in part"),
    ("pointmass_sizes", "C13", {"": 10.0, "_25.csv": 6.0, "_50.csv": 8.0, "_1600.csv": 12.0}, "does not hold here"),
    ("ant_vds", "C11", {"": 10.0, "vds members_see": -1.0}, "holds"),
    ("ant_vds", "C11", {"": 10.0, "vds members_see": 3.0}, "does not hold here"),
    ("ant", "C3", {"": 10.0}, "holds in part"),
    ("ball_catching", "C4", {"": 10.0, "space": 12.0}, "does not hold here"),
    ("maze", "C8", {"": 10.0, "space": 12.0}, "holds"),
    ("maze", "C8", {"": 10.0, "round_robin": 12.0}, "does not hold here"),
    ("pointmass_uniform_trpo", "C5 (TRPO)", {"": 10.0, "space": 12.0}, "holds"),
    ("pointmass_uniform_trpo", "C6 (TRPO)", {"": 10.0, "spdrl": 8.0}, "holds"),
    ("pointmass_uniform_trpo", "C7 (TRPO)", {"": 10.0, "space": 12.0}, "holds"),
    ("pointmass_multiply", "C10", {"": 10.0, "multiply": 9.0}, "holds"),
    ("pointmass_target", "C12 (learning rate 3e-4)", {"": 10.0, "spdrl": 12.0}, "does not hold here"),
])  # fmt: skip
def test_a_claim_is_judged_by_the_rules_of_the_page(
    claims: Any, tmp_path: Path, name: str, claim: str, finals: Mapping[str, float], verdict: str
) -> None:
    """On the cells that its grid has."""
    Kept(tmp_path, name).curves(finals)
    grid, parts = claims.CLAIMS[claim]
    assert grid == name
    assert claims.verdict(parts(claims.Artefact(tmp_path / "docs/results" / name)), whole=True) == verdict
    assert (
        claims.verdict(parts(claims.Artefact(tmp_path / "docs/results" / name)), whole=False)
        == "not tested at full scale"
    )


def test_two_seeds_show_nothing(claims: Any, tmp_path: Path) -> None:
    """Not even that something is not above its start: there is no interval."""
    Kept(tmp_path, "ant_vds").curves({"": 10.0, "vds members_see": 3.0}, seeds=2)
    parts = claims.CLAIMS["C11"][1](claims.Artefact(tmp_path / "docs/results/ant_vds"))
    assert [(part.seen, part.contradicted) for part in parts] == [(False, False)] * 2
    assert "p = — (2 seeds)" in parts[0].text


def test_what_was_run_in_small_is_told_as_such_until_all_of_it_was_run(claims: Any, tmp_path: Path) -> None:
    def rows() -> list[str]:
        return [row for row in str(claims.table()).splitlines() if "[C4" in row]

    assert rows() == []
    for scale in (0.02, 0.3):
        small = Kept(tmp_path, "ball_catching").curves({"": 10.0})
        (small.folder / "provenance.json").write_text(json.dumps({"scale": scale}))
        small.folder.rename(small.folder.with_name(f"ball_catching-scale-{scale}"))
    (row,) = rows()
    assert row.startswith("| [C4, scale 0.3](results/ball_catching-scale-0.3/report.md) |")
    assert row.endswith("| *not tested at full scale* |")
    Kept(tmp_path, "ball_catching").curves({"": 10.0, "space": 12.0})
    (row,) = rows()
    assert row.startswith("| [C4](results/ball_catching/report.md) |")
    assert row.endswith("| *does not hold here* |")


@pytest.mark.parametrize(("least", "most", "other", "verdict"), [
    (0.14, 0.52, 0.95, "holds"), (0.14, 0.7, 0.95, "holds in part"), (0.0, 0.52, 0.5, "does not hold here")
])  # fmt: skip
def test_curricula_of_ant_are_judged_by_their_agreement(
    claims: Any, tmp_path: Path, least: float, most: float, other: float, verdict: str
) -> None:
    kept = Kept(tmp_path, "ant").curves({"": 1.0})
    taus = {claims.SPACE: (least, most), claims.CSPACE: (other, 1.0)}
    kept.csv("curricula.csv", {
        label: {"tau_with_others_least": low, "tau_with_others_most": high} for label, (low, high) in taus.items()
    })  # fmt: skip
    assert (
        claims.verdict(claims.CLAIMS["C15"][1](claims.Artefact(tmp_path / "docs/results/ant")), whole=True) == verdict
    )


def load_job(name: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    spec = importlib.util.spec_from_file_location(f"{name}_job", ROOT / f"jobs/{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)  # where dataclasses look
    monkeypatch.syspath_prepend(str(ROOT / "jobs"))
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def job(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """jobs/results.py, whose grids are one tiny one."""
    module = load_job("results", monkeypatch)
    settings = {**TINY, **write_line_instances(tmp_path), "evaluation.episodes": 2}
    write_grid(tmp_path, name="tiny", set=settings, seeds=[0, 1]).rename(tmp_path / "tiny.yaml")
    monkeypatch.setattr(module, "GRIDS", tmp_path)
    monkeypatch.setattr(module, "WINS", tmp_path / "none")
    return module


def kept(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_one_command_makes_an_artefact_always_the_same(job: Any, tmp_path: Path) -> None:
    for place in ("one", "other"):
        job.results("tiny", 0.5, tmp_path / place / "runs", tmp_path / place / "out")
    first, second = (kept(tmp_path / place / "out/tiny-scale-0.5") for place in ("one", "other"))
    # Forgetting cannot be told from two evaluations.
    assert {*first} == {*job.KEPT, "provenance.json", *(name for name in first if name.endswith(".png"))} - {
        "forgetting.csv"
    }
    assert {"curves.png", "profiles.png", "instances.png", "frequencies.png"} <= {*first}
    assert first == second
    provenance = json.loads(first["provenance.json"])
    assert provenance["command"] == "make results NAME=tiny SCALE=0.5"
    assert (provenance["scale"], provenance["seeds"], provenance["cells"]) == (0.5, [0], 2)
    assert provenance["environment_steps"] == 2 * 256  # half of 768 steps are one update
    assert len(provenance["arithmetic"]) == 1
    assert "A grid in small, scale 0.5" in first["report.md"].decode()


def test_what_is_kept_is_made_anew(job: Any, tmp_path: Path) -> None:
    """Nothing of an earlier report stays behind; a whole grid has the plain name."""
    out = tmp_path / "out/tiny"
    out.mkdir(parents=True)
    (out / "left.png").touch()
    job.results("all", 1.0, tmp_path / "runs", tmp_path / "out")
    assert "left.png" not in kept(out)
    assert json.loads(kept(out)["provenance.json"])["command"] == "make results NAME=tiny"


def test_an_unknown_artefact_is_one_sentence(job: Any, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"'tini' is no artefact; did you mean 'tiny'[?]"):
        job.results("tini", 1.0, tmp_path / "runs", tmp_path / "out")
    done = subprocess.run(
        [sys.executable, ROOT / "jobs/results.py", "cartpol"], cwd=ROOT, capture_output=True, text=True,
        timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert (done.returncode, "Traceback" in done.stderr) == (2, False)
    assert "did you mean 'cartpole'?" in done.stderr
