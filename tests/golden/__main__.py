"""`python -m tests.golden [CASE ...]`: run cases here and print their digests; `--write` makes them the golden ones.

`--resume FOLDER` has the run that was stopped in that folder go on to its end first.

A golden digest changes on purpose only, with a line in CHANGELOG.md that says why and by how much results move.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

from space_dist import config as configs
from space_dist.run.claiming import arithmetic_digest
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests
from tests.golden.cases import CASES, DIGESTS, run


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.golden")
    parser.add_argument("cases", nargs="*", choices=[[], *CASES], metavar="CASE")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--resume", type=Path, metavar="FOLDER")
    asked = parser.parse_args()
    if asked.resume is not None:
        launch(configs.load(asked.resume / "config.yaml"), asked.resume, resume=True, stop=StopRequests())
    names = asked.cases or list(CASES)
    found = {"arithmetic": arithmetic_digest(), "cases": {}}
    with tempfile.TemporaryDirectory() as folder:
        for number, name in enumerate(names):
            found["cases"][name] = run(name, Path(folder) / str(number))
    if asked.write:
        known = json.loads(DIGESTS.read_text())["cases"] if DIGESTS.exists() else {}
        cases = {name: digests for name, digests in (known | found["cases"]).items() if name in CASES}
        found = {"arithmetic": found["arithmetic"], "cases": {name: cases[name] for name in CASES}}
        DIGESTS.write_text(json.dumps(found, indent=2) + "\n")
    known = json.loads(DIGESTS.read_text())["cases"]
    others = [name for name, digests in found["cases"].items() if known.get(name) != digests]
    told = f": {', '.join(others)}" if others else ""
    sys.stderr.write(f"of {len(names)} cases {len(others)} are not the golden ones{told}\n")
    sys.stdout.write(json.dumps(found) + "\n")


main()
