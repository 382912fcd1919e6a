#!/usr/bin/env bash
# Makes .venv from envs/requirements.lock; needs Python >= 3.11 with pip, network to a package index, 4 GB of disk; no root.
# Run it again at any time: it does nothing when nothing changed and repairs what was interrupted. Without make:
#   bash envs/setup.sh && .venv/bin/snakemake --cores 2 scenes/kitchen
#
#   PYTHON=python3.12             the interpreter to build on
#   TORCH='torch==2.13.0+cu130'   the torch to install; default: the pin in envs/requirements.in
#   TORCH_INDEX=<address>         a package index that holds that build of torch (CPU, a CUDA version, ...)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
unset PYTHONHOME PYTHONPATH
export PIP_USER=0
root=$(pwd -P)

venv=.venv
stamp=$venv/.setup # line 1: digests of lock and torch, folder; line 2: "checked" once doctor has passed
log=$venv/setup.log
needed_mb=4000
torch=${TORCH:-$(sed -n 's/^\(torch==[^ ]*\).*/\1/p' envs/requirements.in)}

say() { echo "setup: $*" >&2; }
fail() { say "$*"; exit 1; }

# One setup at a time in a checkout; where the file system has no locks, none is taken.
exec 9<envs/setup.sh
if command -v flock >/dev/null; then
    flock -n 9 2>/dev/null || if [ $? = 1 ]; then
        say "waiting for another setup of this checkout to end"
        flock 9
    fi
fi

# ---- up to date? ----------------------------------------------------------------------------------------------------
sha256() { if command -v sha256sum >/dev/null; then sha256sum; else shasum -a 256; fi | cut -d' ' -f1; }
lock_wanted=$(sha256 <envs/requirements.lock)
torch_wanted=$(echo "$torch ${TORCH_INDEX:-}" | sha256)
lock_found='' torch_found='' folder='' checked=''
if [ -f $stamp ]; then
    { read -r lock_found torch_found folder && read -r checked; } <$stamp || true
fi
# Making the environment of another checkout anew would break that one.
if [ -L $venv ] && [ -n "$folder" ] && [ "$folder" != "$root" ] && [ "$venv" -ef "$folder/$venv" ]; then
    fail "$venv is a link to the environment of $folder; remove the link, or let it point to a folder that no checkout uses"
fi
version='import sys; print("%d.%d" % sys.version_info[:2])'
recent='import sys; sys.exit(sys.version_info < (3, 11))'
if ! "$venv/bin/python" -c "$recent" 2>/dev/null; then folder=''; fi
if [ -n "${PYTHON:-}" ] && [ "$("$PYTHON" -c "$version" 2>&1)" != "$("$venv/bin/python" -c "$version" 2>&1)" ]; then folder=''; fi
installed=no
if [ "$lock_found $torch_found $folder" = "$lock_wanted $torch_wanted $root" ]; then installed=yes; fi

# Every Python of the environment finds its LLVM: also the command mitsuba, and render.py beside an exported scene.
name_llvm() {
    local packages
    for packages in "$venv"/lib/python3*/site-packages; do
        cmp -s envs/iif_llvm.pth "$packages/iif_llvm.pth" || cp envs/iif_llvm.pth "$packages/"
    done
}

if [ $installed = yes ] && [ "$checked" = checked ]; then
    name_llvm
    exit 0
fi

# ---- install --------------------------------------------------------------------------------------------------------
explain() { # the reason of a failed pip in one line
    local what=$1 reason
    if grep -qiE 'No space left|Disk quota exceeded' $log; then
        reason="the disk is full: about $needed_mb MB are needed here, twice that for a CUDA build of torch"
    elif grep -qE 'DO NOT MATCH THE HASHES' $log; then
        reason="a downloaded file is not the one that the lock names; empty pip's cache, or ask whoever runs the package index"
    elif grep -qiE 'connection broken|NewConnectionError|ConnectTimeout|ReadTimeout|name resolution|Network is unreachable|ProxyError|SSLError|timed out' $log; then
        reason="the package index cannot be reached: check network, proxy and pip's configuration (pip config list)"
    elif grep -qF '(from versions: none)' $log; then
        reason="the package index cannot be reached or is not a full one: check network, proxy and pip's configuration (pip config list)"
    elif grep -qE 'No matching distribution|Could not find a version' $log; then
        reason="the package index has no build for $("$venv/bin/python" -V 2>&1) on $(uname -sm): $(grep -m1 -oE 'No matching distribution found for .*' $log || true)"
    else
        reason=$(grep -m1 -E '^ERROR|Error' $log || tail -n1 $log)
    fi
    fail "installing $what failed: $reason (all of pip's output: $log)"
}
pip_install() { # what, arguments of pip install
    local what=$1
    shift
    say "installing $what ..."
    # Without --no-compile pip compiles every module of every package, on one core: 40 s for a tenth that is ever imported.
    TMPDIR=$root/$venv/tmp "$venv/bin/python" -m pip install --no-input --no-compile --disable-pip-version-check --progress-bar off "$@" >>$log 2>&1 || explain "$what"
}

if [ $installed = no ]; then
    started=$SECONDS
    [ -n "$torch" ] || fail "envs/requirements.in has no line torch==<version>; restore it or set TORCH"

    # Scripts in .venv/bin name their interpreter by absolute path, and pip takes half-written packages for installed
    # ones. So a .venv without a stamp of this folder (interrupted, moved, made by hand) is made anew; one with the
    # stamp of another lock is brought up to date in place.
    if [ "$folder" != "$root" ]; then
        candidates=(python3 python3.11 python3.12 python3.13 python3.14)
        [ -z "${PYTHON:-}" ] || candidates=("$PYTHON")
        python='' tried=''
        for candidate in "${candidates[@]}"; do
            found=$("$candidate" -c "$version" 2>/dev/null) || continue
            if "$candidate" -c "$recent"; then python=$candidate && break; fi
            tried="$tried${tried:+, }Python $found ($candidate)"
        done
        [ -n "$python" ] || fail "Python 3.11 or newer is needed, found ${tried:-none (tried: ${candidates[*]})}; install one and choose it with PYTHON=/path/to/python3"
        "$python" -c 'import venv, ensurepip' 2>/dev/null ||
            fail "$python ($found) has no venv module; install it (Debian and Ubuntu: python$found-venv) or choose another Python with PYTHON=..."
        if [ -L $venv ] && [ ! -e $venv ]; then mkdir -p "$(readlink $venv)"; fi
        rm -f $stamp
        free_mb=$(($(df -Pk . | awk 'NR == 2 {print $4}') / 1024))
        if [ -e $venv ]; then free_mb=$(($(df -Pk $venv/ | awk 'NR == 2 {print $4}') / 1024 + $(du -sm $venv/ | cut -f1))); fi
        [ "$free_mb" -ge $needed_mb ] ||
            fail "$free_mb MB of disk are free for $root/$venv, about $needed_mb are needed; free some, or make .venv a link to a folder elsewhere"
        [ ! -e $venv/pyvenv.cfg ] || say "$venv is incomplete, moved or of another Python: making it anew"
        say "making $venv with Python $found (3 GB, some minutes; progress: $log) ..."
        "$python" -m venv --clear $venv >&2 || fail "$python -m venv $venv failed; choose another Python with PYTHON=..."
    else
        rm -f $stamp
        # The same version from another index is another build, which pip would not replace.
        [ "$torch_found" = "$torch_wanted" ] || "$venv/bin/python" -m pip uninstall --yes torch >/dev/null 2>&1 || true
    fi
    : >$log
    mkdir -p $venv/tmp # pip unpacks here: the same disk, and what an interruption leaves goes with .venv

    # torch comes last and apart: one lock cannot name both its CPU and its CUDA builds. Its dependencies are in the lock.
    pip_install "the locked packages" --require-hashes -r envs/requirements.lock
    pip_install "$torch" ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} "$torch"
    "$venv/bin/python" -c pass # the first start makes the links of the LLVM wheel
    name_llvm
    rm -rf $venv/tmp
    echo "$lock_wanted $torch_wanted $root" >$stamp
    say "installed in $((SECONDS - started)) s"
fi

# ---- check ----------------------------------------------------------------------------------------------------------
"$venv/bin/python" -m workflow.runtime.doctor >&2 || fail "the environment is installed but does not work: see FAIL above"
echo checked >>$stamp
