#!/usr/bin/env bash
# Every artefact of the paper in small, by the command that makes it whole: in_small.sh [SCALE], 0.02 by default.
# Fails unless each has its report, its numbers and a figure, and says that it is in small.
set -euo pipefail
cd "$(dirname "$0")/../.."
scale=${1:-0.02}
made=$(mktemp -d)
trap 'rm -rf "$made"' EXIT
.venv/bin/python jobs/results.py all --scale "$scale" --root "$made/runs" --out "$made/results"
for grid in configs/paper/*.yaml; do
  name=$(basename "$grid" .yaml)-scale-$scale
  for file in report.md cells.csv seeds.csv curves.png provenance.json; do
    test -s "$made/results/$name/$file" || { echo "in_small: $name has no $file" >&2; exit 1; }
  done
  grep -q "A grid in small, scale $scale" "$made/results/$name/report.md" || {
    echo "in_small: $name does not say that it is in small" >&2
    exit 1
  }
done
echo "in_small: $(ls "$made/results" | wc -l) artefacts at scale $scale"
