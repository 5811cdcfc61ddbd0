#!/usr/bin/env bash
# install.sh -- what the tests on a real Slurm need, on Debian or Ubuntu, as root. Does nothing where it is there.
set -euo pipefail
PATH=$PATH:/usr/sbin:/sbin
have() { command -v "$@" >/dev/null; }
if have slurmctld && have slurmd && have munged && have sbatch && have ip && have shellcheck; then exit 0; fi
if [ "$(id -u)" != 0 ] || ! have apt-get; then
  echo "install.sh: needs root and apt-get to install Slurm" >&2
  exit 1
fi
export DEBIAN_FRONTEND=noninteractive
apt-get update -qq
apt-get install -y -qq --no-install-recommends munge slurmctld slurmd slurm-client iproute2 shellcheck >/dev/null
