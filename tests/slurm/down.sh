#!/usr/bin/env bash
# down.sh DIR -- cancel every job of the Slurm that up.sh has started in DIR, then stop its daemons, by pid.
set -uo pipefail
D=$(realpath -m "$1")
export SLURM_CONF=$D/slurm.conf PATH=$PATH:/usr/sbin:/sbin
# ours and alive: the name guards against a reused pid; a zombie counts as gone
alive() {
  case $(sed 's/^[0-9]* (\(.*\)) \(.\).*/\1 \2/' "/proc/$1/stat" 2>/dev/null) in
    *" Z") return 1 ;;
    munged* | slurmctld* | slurmd* | unshare*) return 0 ;;
    *) return 1 ;;
  esac
}
controller=$(cat "$D/run/slurmctld.pid" 2>/dev/null || true)
if [ -n "$controller" ] && alive "$controller"; then # without one a client command retries for a long time
  timeout 10 scancel --user="$(id -un)"
  for _ in $(seq 50); do
    [ -z "$(timeout 5 squeue -h -o %i)" ] && break
    sleep 0.1
  done
fi
pids=()
for file in "$D"/run/n*.host.pid "$D/run/slurmctld.pid" "$D/run/munged.pid"; do
  [ -s "$file" ] && p=$(<"$file") && alive "$p" && pids+=("$p") &&
    case $file in *.host.pid) kill -9 "$p" ;; *) kill "$p" ;; esac
done
for p in "${pids[@]}"; do
  for _ in $(seq 100); do
    alive "$p" || continue 2
    sleep 0.05
  done
  kill -9 "$p"
done
[ -s "$D/run/bridge" ] && ip link del "$(<"$D/run/bridge")"
rm -f "$D"/run/*.pid "$D/run/bridge"
