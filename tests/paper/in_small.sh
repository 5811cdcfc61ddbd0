#!/usr/bin/env bash
# Artefacts of the paper in small, by the command that makes them whole: in_small.sh [NAME...].
# Without names: all of them, of which those on PyBullet take longest: an evaluation is 200 instances of up to 500 steps,
# twice, whatever the budget. Fails unless each has its report, its numbers and a figure, and says that it is in small.
set -euo pipefail
cd "$(dirname "$0")/../.."
scale=0.02
made=$(mktemp -d)
trap 'rm -rf "$made"' EXIT
if [ $# -eq 0 ]; then
  for grid in configs/paper/*.yaml; do
    set -- "$@" "$(basename "$grid" .yaml)"
  done
fi
for name in "$@"; do
  .venv/bin/python jobs/results.py "$name" --scale "$scale" --root "$made/runs" --out "$made/results"
  for file in report.md cells.csv seeds.csv provenance.json; do
    test -s "$made/results/$name-scale-$scale/$file" || { echo "in_small: $name has no $file" >&2; exit 1; }
  done
  for file in "$made/results/$name-scale-$scale"/curves*.png; do # one a task
    test -s "$file" || { echo "in_small: $name has no learning curves" >&2; exit 1; }
  done
  grep -q "A grid in small, scale $scale" "$made/results/$name-scale-$scale/report.md" || {
    echo "in_small: $name does not say that it is in small" >&2
    exit 1
  }
done
echo "in_small: $# artefacts at scale $scale"
