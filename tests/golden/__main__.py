"""`python -m tests.golden [CASE ...]`: run cases here and print their digests; `--write` makes them the golden ones.

A golden digest changes on purpose only, with a line in CHANGELOG.md that says why and by how much results move.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

from space_dist.launch import arithmetic_digest
from tests.golden.cases import CASES, DIGESTS, run


def main() -> None:
    names = [name for name in sys.argv[1:] if name != "--write"] or list(CASES)
    found = {"arithmetic": arithmetic_digest(), "cases": {}}
    with tempfile.TemporaryDirectory() as folder:
        for number, name in enumerate(names):
            found["cases"][name] = run(name, Path(folder) / str(number))
    if "--write" in sys.argv:
        known = json.loads(DIGESTS.read_text())["cases"] if DIGESTS.exists() else {}
        cases = {name: digests for name, digests in (known | found["cases"]).items() if name in CASES}
        found = {"arithmetic": found["arithmetic"], "cases": {name: cases[name] for name in CASES}}
        DIGESTS.write_text(json.dumps(found, indent=2) + "\n")
    sys.stdout.write(json.dumps(found) + "\n")


main()
