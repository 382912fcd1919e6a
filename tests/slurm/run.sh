#!/usr/bin/env bash
# `make test-slurm`: a Slurm of one node, and the tests in tests/slurm/ on it. Everything runs in namespaces of its own (mounts,
# processes, network), which end with it: no daemon, file or port is left behind, and no Slurm of this machine is touched.
#   bash tests/slurm/run.sh [arguments of pytest]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."

skip() { echo "test-slurm: skipped: $*" >&2; exit 0; }
if [ -z "${IIF_SLURM:-}" ]; then
  if [ -e /etc/slurm/slurm.conf ] || [ -e /etc/slurm-llnl/slurm.conf ] || [ -n "${SLURM_CONF:-}" ]; then
    echo 'test-slurm: this machine has a Slurm configuration already; run the test where there is none' >&2
    exit 1
  fi
  [ "$(id -u)" = 0 ] || skip 'starting Slurm needs root'
  for program in slurmctld slurmd sbatch munged unshare; do
    command -v $program >/dev/null || PATH=$PATH:/usr/sbin command -v $program >/dev/null ||
      skip "no $program (Debian and Ubuntu: apt-get install slurm-wlm munge)"
  done
  unshare --mount --pid --net --fork --mount-proc true 2>/dev/null || skip 'this machine allows no namespaces (unshare)'
  # The plugin stands apart, because Snakemake imports every plugin that it finds at every start.
  wanted=$(sha256sum envs/requirements-cluster.txt | cut -d' ' -f1)
  if [ "$(cat .cluster/.from 2>/dev/null)" != "$wanted" ]; then
    rm -rf .cluster
    mkdir -p .cluster
    # What Snakemake's environment has already stays there: only the plugins, and what they alone need.
    awk '/^[a-z]/ {own = /^(snakemake-executor|throttler)/} own' envs/requirements-cluster.txt >.cluster/requirements.txt
    .venv/bin/python -m pip install --quiet --no-deps --no-compile --disable-pip-version-check --require-hashes --target .cluster \
      -r .cluster/requirements.txt
    echo "$wanted" >.cluster/.from
  fi
  export IIF_SLURM=$PWD/.cluster
  exec unshare --mount --pid --net --fork --kill-child --mount-proc bash "${BASH_SOURCE[0]}" "$@"
fi

export PATH=$PATH:/usr/sbin
mount --make-rprivate /
mkdir -p /etc/slurm
mount -t tmpfs tmpfs /run
mount -t tmpfs tmpfs /etc/slurm
ip link set lo up
ip address add 10.99.0.1/24 dev lo # names are looked up only where an address beside 127.0.0.1 is configured
state=$(mktemp -d)
trap 'rm -rf "$state"' EXIT
chmod 755 "$state"
host=$(hostname -s)
grep -qw "$host" /etc/hosts || { cp /etc/hosts "$state/hosts" && echo "127.0.0.1 $host" >>"$state/hosts" && mount --bind "$state/hosts" /etc/hosts; }
mkdir -p /run/munge "$state"/{state,spool,log}
chown munge: /run/munge
dd if=/dev/urandom of="$state/munge.key" bs=1024 count=1 2>/dev/null
chown munge: "$state/munge.key"
chmod 400 "$state/munge.key"
memory=$(awk '/MemTotal/ {print int($2 / 1024 * 0.9)}' /proc/meminfo)
# Accounting: JOBCOMP writes a file; `sacct` is there and knows nothing, as on clusters without a database.
cat >/etc/slurm/slurm.conf <<CONF
ClusterName=loopback
SlurmctldHost=$host(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
SlurmctldPidFile=$state/slurmctld.pid
SlurmdPidFile=$state/slurmd.pid
StateSaveLocation=$state/state
SlurmdSpoolDir=$state/spool
SlurmctldLogFile=$state/log/slurmctld.log
SlurmdLogFile=$state/log/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=1
JobCompType=jobcomp/filetxt
JobCompLoc=$state/log/jobcomp.log
SchedulerType=sched/backfill
SchedulerParameters=bf_interval=2,sched_interval=2
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
ReturnToService=2
# A scene's job asks for six cores, because three of its stages can run at once; smaller machines pretend to have them.
SlurmdParameters=config_overrides
NodeName=$host NodeAddr=127.0.0.1 CPUs=$(($(nproc) < 12 ? 12 : $(nproc))) RealMemory=$memory State=UNKNOWN
PartitionName=main Nodes=$host Default=YES MaxTime=INFINITE State=UP
CONF
setpriv --reuid munge --regid munge --clear-groups munged --key-file="$state/munge.key" --pid-file=/run/munge/munged.pid \
  --log-file=/run/munge/munged.log --seed-file=/run/munge/seed
slurmctld
slurmd
for _ in $(seq 40); do sinfo -h -o %t 2>/dev/null | grep -qE 'idle|mix' && break; sleep 0.5; done
sinfo || { tail -n 20 "$state"/log/*.log >&2; exit 1; }
export IIF_SLURM_STATE=$state
.venv/bin/python -m pytest -p no:cacheprovider -q tests/slurm "$@"
