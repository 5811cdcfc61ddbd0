#!/bin/bash
# Submits the grid pointmass_small to SLURM, or goes on with it: what is done stays done.
# What failed for good stays so, too, until `space-dist grid retry` gives it another try.
# Options, if any, go to sbatch for training and win over train.sbatch: ./submit.sh --partition=other
# shellcheck disable=SC1003,SC2016,SC2088 # values are quoted whole, whatever they hold
set -euo pipefail
quit() {
  printf '%s\n' "submit.sh: $2" >&2
  exit "$1"
}
cd -- "$(dirname -- "${BASH_SOURCE[0]}")"
[ -f manifest.json ] || quit 2 "$PWD holds no manifest.json: it needs the whole exported folder"
command -v sbatch >/dev/null || quit 2 "there is no sbatch here: run this where SLURM is"
grid=$PWD
jobs=$grid/slurm_jobs.txt
mkdir -p -- "$grid" logs

if [ -s "$jobs" ]; then
  listed=$(squeue --noheader --format=%F) || quit 1 "squeue does not answer, so nobody knows whether this is in the queue already; try again"
  queued=$(cut -d' ' -f1 "$jobs" | grep -Fxf - <(sort -u <<<"$listed") | paste -sd' ') || queued=''
  if [ -n "$queued" ]; then
    echo "already in the queue, nothing to do: $queued (scancel ends them, then submit again)"
    exit 0
  fi
fi

submitted=()
undo() {
  if [ -n "${submitted[*]-}" ]; then
    echo "submit.sh: sbatch refused; cancelling what was submitted: ${submitted[*]}" >&2
    scancel "${submitted[@]}"
  else
    echo "submit.sh: nothing was submitted; ./submit.sh tries again, once what is said above is mended" >&2
  fi
}
trap undo EXIT

# Submits with the arguments after the first, which says what it is; sets `job`.
submit() {
  job=$(sbatch --parsable "${@:2}") || exit
  job=${job%%;*} # of several clusters the name follows
  submitted+=("$job")
  echo "$job $1" >>"$jobs.new"
  echo "$1: job $job"
}

rm -f -- "$grid/stop" "$jobs.new"
submit train "$@" train.sbatch
submit aggregate --dependency=afterany:"$(IFS=: && echo "${submitted[*]}")" aggregate.sbatch
mv -f -- "$jobs.new" "$jobs"
trap - EXIT
echo "submitted pointmass_small, 6 runs in all${*:+, with $*}; results: $grid"
