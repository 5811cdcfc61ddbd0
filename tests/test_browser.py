"""Pages as people see them, in headless Chromium: runs at the first look, every figure there, and no error of ours.

Each page's picture is left in pytest's folder.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from space_dist.experiment.manifest import Grid
from space_dist.tracking import SyncResult, sync
from tests.grids import ROOT
from tests.patience import PATIENCE
from tests.test_grid_tracking import levels, make_grid, run_to

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

sys.path.append(str(ROOT / "jobs"))

from benchmarks.servers import TrackingServer

CHROMIUM = shutil.which("chromium")
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
         "--disable-component-update", "--disable-sync"]  # fmt: skip
pytestmark = [
    pytest.mark.chromium,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: tests/browser/install.sh"),
]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    api = pytest.importorskip("playwright.sync_api")
    with api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pages")


@pytest.fixture(scope="module")
def grid(folder: Path) -> Grid:
    """Two cells of three seeds, all done."""
    made, manifest = make_grid(folder / "demo", None, seeds=(0, 1, 2))
    env = {"env": {"id": "space_dist/PointMass-v0"}}
    cells = tuple(dataclasses.replace(cell, config={**cell.config, **env}) for cell in manifest.cells)
    made.freeze(dataclasses.replace(manifest, cells=cells), {})
    for cell in (0, 1):
        for seed in (0, 1, 2):
            run_to(made, cell, seed, last=1.0 + cell + 0.3 * seed)
    return made


@pytest.fixture(scope="module")
def mirrored(grid: Grid, folder: Path, empty_store: Path) -> Iterator[tuple[str, SyncResult]]:
    """(an MLflow server's address, what was mirrored to it)."""
    shutil.copy(empty_store, folder / "mlflow.db")
    with TrackingServer(folder, os.environ, folder / "server.log") as server:
        yield server.address, sync([], server.address, grids=[grid])


def opened(browser: Browser, url: str, picture: Path, width: int = 1300, *, see: str) -> tuple[Page, list[str]]:
    """A page that shows a text, and the errors that were raised on the way."""
    page = browser.new_page(viewport={"width": width, "height": 1000})
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda said: errors.append(f"{said.text} {said.location}") if said.type == "error" else None)
    page.goto(url, timeout=PATIENCE * 1000)
    page.get_by_text(see).first.wait_for(timeout=PATIENCE * 1000)
    page.screenshot(path=picture)
    return page, errors


@pytest.mark.parametrize("width", [1300, 390])
def test_a_report_shows_all_its_figures_at_any_width(browser: Browser, grid: Grid, folder: Path, width: int) -> None:
    from space_dist.report import build_grid_report

    out = folder / "report"
    if not out.exists():
        build_grid_report(grid, out)
    page, errors = opened(
        browser, (out / "report.html").as_uri(), folder / f"report_{width}.png", width, see="How to read this"
    )
    assert errors == []
    drawn = page.eval_on_selector_all("img", "all => all.map(one => one.complete && one.naturalWidth > 0)")
    assert drawn
    assert all(drawn)
    assert page.evaluate("document.documentElement.scrollWidth") <= width  # wide tables scroll by themselves
    page.close()


def test_mlflow_shows_runs_at_the_first_look_and_three_levels(
    browser: Browser, mirrored: tuple[str, SyncResult], folder: Path
) -> None:
    address, result = mirrored
    (first,) = result.pages
    grid, cells, runs = levels(address)
    page, errors = opened(browser, first.partition("#")[0] + "#/experiments", folder / "experiments.png", see="demo")
    assert not errors_of_ours(errors)
    page.close()
    page, errors = opened(browser, first, folder / "runs.png", see="matching runs")
    page.locator(f'a[href*="{grid.info.run_id}"]').first.wait_for(timeout=PATIENCE * 1000)
    page.screenshot(path=folder / "runs.png")
    assert not errors_of_ours(errors)
    page.close()

    base = first.partition("?")[0]
    for name, run, text in (
        ("grid", grid, "test/return_iqm eta 0.2"),
        ("cell", cells["eta=0.1"], "test/return_iqm"),
        ("run", runs["eta=0.1, seed 0"], "train/learner_loss"),
    ):
        url = f"{base}/{run.info.run_id}?workflowType=machine_learning"
        page, errors = opened(browser, url, folder / f"{name}.png", see=text)
        page.get_by_text("Model metrics").first.click()
        page.locator(".plotly, canvas, svg.main-svg").first.wait_for(timeout=PATIENCE * 1000)
        page.screenshot(path=folder / f"{name}_metrics.png")
        assert not errors_of_ours(errors)
        page.close()
    page, errors = opened(browser, f"{base}/{grid.info.run_id}/artifacts", folder / "artifacts.png", see="report.html")
    page.get_by_text("report.html").first.click()
    page.frame_locator("iframe").get_by_text("How to read this").first.wait_for(timeout=PATIENCE * 1000)
    page.screenshot(path=folder / "artifact.png")
    assert not errors_of_ours(errors)
    page.close()


def errors_of_ours(errors: list[str]) -> list[str]:
    """Errors but those of MLflow's own pages, which ask for what its server lacks, and draw while they resize."""
    theirs = ("ResizeObserver loop", "status of 404")
    return [error for error in errors if "artifact" in error or not any(words in error for words in theirs)]
