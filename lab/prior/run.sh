#!/bin/bash
# On a machine with a CUDA device and without a network: unpacks what `python -m lab.prior pack` has written into the folder of this
# script, once per machine, and trains.    bash run.sh OUT [arguments of train]
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd) out=$1
shift
home=${IIF_LAB_HOME:-$HOME/iif-lab}
if [ ! -f "$home/ready" ]; then
  mkdir -p "$home/site" "$home/oidn" "$home/code"
  # The archives are unpacked at the same time, by Python, because xz need not be installed.
  for part in site oidn code; do
    python3 -c 'import sys, tarfile; tarfile.open(sys.argv[1]).extractall(sys.argv[2], filter="fully_trusted")' "$here/$part.tar.xz" "$home/$part" &
    unpacking+=($!)
  done
  for job in "${unpacking[@]}"; do wait "$job"; done
  touch "$home/ready"
fi
export PYTHONPATH="$home/code:$home/site" IIF_OIDN="$home/oidn" NUMBA_CACHE_DIR="$home/numba"
export LD_LIBRARY_PATH="$home/oidn:${LD_LIBRARY_PATH:-}" OMP_NUM_THREADS=1 MALLOC_ARENA_MAX=2 PYTHONUNBUFFERED=1
more=()
[ -f "$here/assets.npz" ] && more+=(--assets "$here/assets.npz")
[ -f "$here/init.safetensors" ] && more+=(--init "$here/init.safetensors")
cd "$home/code"
# The crops go to memory, and the state stays on the machine: it is larger than what may come back.
exec python3 -m lab.prior train /dev/shm/iif-lab "$out" --state "$home/state.pt" --consume --device cuda --compile "${more[@]}" "$@"
