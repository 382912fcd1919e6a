#!/usr/bin/env bash
# `make test-slurm`: a Slurm of one node, and the tests in tests/slurm/ on it. Everything runs in namespaces of its own (mounts,
# processes, network), which end with it: no daemon, file or port is left behind, and no Slurm of this machine is touched.
#   bash tests/slurm/run.sh [--accounting] [arguments of pytest]
# With --accounting (or IIF_SLURM_ACCOUNTING=1), a database (slurmdbd, MariaDB) keeps what jobs took, as on most clusters.
set -euo pipefail
script=$(realpath "${BASH_SOURCE[0]}")
cd "$(dirname "$script")/../.."
if [ "${1:-}" = --accounting ]; then
  shift
  export IIF_SLURM_ACCOUNTING=1
fi

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
  if [ -n "${IIF_SLURM_ACCOUNTING:-}" ]; then
    for program in slurmdbd mariadbd mariadb-install-db mariadb sacctmgr; do
      command -v $program >/dev/null || PATH=$PATH:/usr/sbin command -v $program >/dev/null ||
        skip "no $program (Debian and Ubuntu: apt-get install slurmdbd mariadb-server)"
    done
  fi
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
  exec unshare --mount --pid --net --fork --kill-child --mount-proc bash "$script" "$@"
fi

export PATH=$PATH:/usr/sbin
mount --make-rprivate /
mkdir -p /etc/slurm
mount -t tmpfs -o mode=755 tmpfs /run
mount -t tmpfs tmpfs /etc/slurm
ip link set lo up
ip address add 10.99.0.1/24 dev lo # names are looked up only where an address beside 127.0.0.1 is configured
state=/run/iif-slurm # in memory that ends with the namespace, so that nothing is left however this script ends
mkdir "$state"
host=$(hostname -s)
grep -qw "$host" /etc/hosts || { cp /etc/hosts "$state/hosts" && echo "127.0.0.1 $host" >>"$state/hosts" && mount --bind "$state/hosts" /etc/hosts; }
mkdir -p /run/munge "$state"/{state,spool,log}
chown munge: /run/munge
dd if=/dev/urandom of="$state/munge.key" bs=1024 count=1 2>/dev/null
chown munge: "$state/munge.key"
chmod 400 "$state/munge.key"
memory=$(awk '/MemTotal/ {print int($2 / 1024 * 0.9)}' /proc/meminfo)
accounting='AccountingStorageType=accounting_storage/none' # `sacct` is there and knows nothing, as on clusters without a database
if [ -n "${IIF_SLURM_ACCOUNTING:-}" ]; then
  accounting=$(printf '%s\n' AccountingStorageType=accounting_storage/slurmdbd AccountingStorageHost=127.0.0.1 \
    AccountingStoreFlags=job_comment)
  mkdir -p /run/mysqld
  mariadb-install-db --no-defaults --user=root --datadir="$state/database" --skip-test-db >"$state/log/mariadb-install.log" 2>&1
  mariadbd --no-defaults --user=root --datadir="$state/database" --socket=/run/mysqld/mysqld.sock --skip-networking \
    --innodb-buffer-pool-size=128M --innodb-lock-wait-timeout=900 --pid-file="$state/mariadbd.pid" 2>"$state/log/mariadbd.log" &
  for _ in $(seq 60); do mariadb --no-defaults -e 'SELECT 1' >/dev/null 2>&1 && break; sleep 0.5; done
  mariadb --no-defaults -e "CREATE DATABASE slurm; GRANT ALL ON slurm.* TO 'slurm'@'localhost' IDENTIFIED BY 'slurm';"
  cat >/etc/slurm/slurmdbd.conf <<CONF
AuthType=auth/munge
DbdHost=$host
DbdAddr=127.0.0.1
SlurmUser=root
LogFile=$state/log/slurmdbd.log
PidFile=$state/slurmdbd.pid
StorageType=accounting_storage/mysql
StorageHost=localhost
StorageUser=slurm
StoragePass=slurm
StorageLoc=slurm
CONF
  chmod 600 /etc/slurm/slurmdbd.conf
fi
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
$accounting
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=1
JobAcctGatherParams=OverMemoryKill
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
if [ -n "${IIF_SLURM_ACCOUNTING:-}" ]; then
  slurmdbd
  for _ in $(seq 60); do sacctmgr -n show cluster >/dev/null 2>&1 && break; sleep 0.5; done
  sacctmgr -i -Q add cluster loopback >/dev/null
  sacctmgr -i -Q add account iif >/dev/null
  sacctmgr -i -Q add user "$(id -un)" account=iif >/dev/null
fi
slurmctld
slurmd
for _ in $(seq 40); do sinfo -h -o %t 2>/dev/null | grep -qE 'idle|mix' && break; sleep 0.5; done
sinfo || { tail -n 20 "$state"/log/*.log >&2; exit 1; }
export IIF_SLURM_STATE=$state
.venv/bin/python -m pytest -p no:cacheprovider -o faulthandler_timeout=0 -q tests/slurm "$@"
