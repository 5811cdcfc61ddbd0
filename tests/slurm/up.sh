#!/usr/bin/env bash
# up.sh DIR -- a private, real Slurm on this machine: munged, slurmctld and two slurmd, without systemd, as root.
# Each node is a set of namespaces (pid, net, uts, ipc, mount): its own host name (n1, n2), address, /dev/shm, and
# /var/tmp, which is DIR/tmp.n1 and DIR/tmp.n2 from outside. Killing the pid in DIR/run/n1.host.pid is a node's crash;
# `up.sh DIR node 1` starts it again. Names and addresses on the host come from DIR and from what is free, so that
# several can live at once, and what a killed one has left is in nobody's way.
set -euo pipefail
trap 'echo "up.sh: line $LINENO: $BASH_COMMAND: exit code $?" >&2' ERR
D=$(realpath -m "$1")
PATH=$PATH:/usr/sbin:/sbin
NODES=2 CPUS=2 MEM=8000
export SLURM_CONF=$D/slurm.conf

# number N -- the one of 200 that names and addresses on the host are made of
number() {
  N=$1 NET=10.$((64 + $1 % 64)).$1 BR=spslurm$1 PORT=$((6820 + $1 * 4))
}

start_node() {
  local i=$1 p
  mkdir -p "$D/spool.n$i" "$D/tmp.n$i"
  # one unshare is one node: --kill-child takes everything on it down with it
  # shellcheck disable=SC2016
  setsid unshare --pid --fork --kill-child --mount --mount-proc --uts --net --ipc bash -c '
    hostname "$0"; mount -t tmpfs tmpfs /dev/shm; mount --bind "$1" /var/tmp; mount --bind "$3" /etc/hosts
    until ip link show eth0 >/dev/null 2>&1; do sleep 0.02; done
    ip link set lo up; ip addr add "$2/24" dev eth0; ip link set eth0 up
    slurmd -D -N "$0" -b; exit $?' "n$i" "$D/tmp.n$i" "$NET.$((10 + i))" "$D/hosts" </dev/null >"$D/log/n$i.out" 2>&1 &
  p=$!
  echo "$p" >"$D/run/n$i.host.pid"
  until [ "$(readlink "/proc/$p/ns/net")" != "$(readlink /proc/self/ns/net)" ]; do sleep 0.02; done
  ip link del "sv${N}n$i" 2>/dev/null || true # a crashed node's
  ip link add "sv${N}n$i" type veth peer name eth0 netns "$p"
  ip link set "sv${N}n$i" master "$BR" up
}

if [ "${2:-}" = node ]; then
  number "$(sed s/spslurm// "$D/run/bridge")"
  start_node "$3"
  exit
fi

mkdir -p "$D"/{state,log,run}
chmod 755 "$D" "$D/run"
first=$(printf %s "$D" | cksum | cut -d' ' -f1)
for i in $(seq 0 199); do # the bridge is what makes a number ours: another Slurm of the host's may have the first
  number $(((first + i) % 200 + 20))
  ip link add "$BR" type bridge 2>"$D/log/bridge" && break
  if [ "$i" = 199 ]; then cat "$D/log/bridge" >&2; exit 1; fi
done
echo "$BR" >"$D/run/bridge"
(umask 077 && head -c 1024 /dev/urandom >"$D/munge.key")
{
  echo "127.0.0.1 localhost"
  echo "$NET.1 $(hostname -s)"
  for i in $(seq "$NODES"); do echo "$NET.$((10 + i)) n$i"; done
} >"$D/hosts"
ip addr add "$NET.1/24" dev "$BR"
ip link set "$BR" up
cat >"$SLURM_CONF" <<CONF
ClusterName=tests
SlurmctldHost=$(hostname -s)($NET.1)
SlurmctldPort=$PORT
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket=$D/run/munge.socket,cred_expire=5
CredType=cred/munge
CommunicationParameters=NoCtldInAddrAny
StateSaveLocation=$D/state
SlurmdSpoolDir=$D/spool.%n
SlurmctldPidFile=$D/run/slurmctld.pid
SlurmdPidFile=/dev/shm/slurmd.pid
SlurmctldLogFile=$D/log/slurmctld.log
SlurmdLogFile=$D/log/%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
MailProg=/bin/true
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
SlurmdParameters=config_overrides
DefMemPerCPU=100
ReturnToService=2
SlurmdTimeout=10
SlurmctldTimeout=10
KillWait=20
MinJobAge=3600
SchedulerParameters=sched_interval=1,bf_interval=1
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
JobCompType=jobcomp/none
GresTypes=gpu
NodeName=n[1-$NODES] NodeAddr=$NET.[11-$((10 + NODES))] Port=$((PORT + 1)) CPUs=$CPUS RealMemory=$MEM Gres=gpu:2 Feature=avx,sse State=UNKNOWN
Licenses=matlab:2
PartitionName=debug Nodes=ALL Default=YES MaxTime=INFINITE State=UP
PartitionName=late Nodes=ALL MaxTime=INFINITE State=UP
CONF
echo "NodeName=n[1-$NODES] Name=gpu File=/dev/tty[1-2]" >"$D/gres.conf" # any device files do
# --force: the folder above may be closed to others
munged --force --key-file="$D/munge.key" --socket="$D/run/munge.socket" --pid-file="$D/run/munged.pid" \
  --log-file="$D/log/munged.log" --seed-file="$D/run/munge.seed"
# shellcheck disable=SC2016
unshare --mount bash -c 'mount --bind "$0" /etc/hosts && slurmctld' "$D/hosts" # it binds to what its host name means
for i in $(seq "$NODES"); do start_node "$i"; done
SECONDS=0
while [ $SECONDS -lt 300 ]; do
  [ "$(timeout 5 sinfo -h -p debug -N -r -t idle -o %N 2>/dev/null | wc -l)" = "$NODES" ] && exit 0
  sleep 0.2
done
echo "up.sh: the nodes are not idle after 300 s; see $D/log" >&2
exit 1
