#!/usr/bin/env bash
# Makes .venv from envs/requirements.lock and envs/torch.lock; needs Python >= 3.11 with pip, network to a package index, 5 GB of disk
# (11 GB for a CUDA build of torch); no root. Everything is checked against the hashes of the locks, and what will be downloaded is said.
# Run it again at any time: it does nothing when nothing changed and repairs what was interrupted. Without make:
#   bash envs/setup.sh && .venv/bin/snakemake --cores 2 scenes/kitchen
#
#   PYTHON=python3.12             the interpreter to build on
#   TORCH='torch==2.13.0+cu130'   the torch to install; default: the pin in envs/requirements.in
#   TORCH_INDEX=<address>         a package index that holds that build of torch (CPU, a CUDA version, ...)
#                                 a build so chosen that envs/torch.lock does not list is installed without a hash, and that is said
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
unset PYTHONHOME PYTHONPATH
export PIP_USER=0
root=$(pwd -P)

venv=.venv
stamp=$venv/.setup # line 1: digests of lock and torch, folder; line 2: "checked" once doctor has passed
log=$venv/setup.log
needed_mb=4000 # without torch; announce() says how much with it
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
torch_wanted=$({ echo "$torch ${TORCH_INDEX:-}"; cat envs/torch.lock envs/torch-cuda.lock; } | sha256)
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

# Every Python of the environment finds its LLVM: also the command mitsuba, and render.py next to an exported scene.
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
        reason="the disk is full: about $needed_mb MB are needed here"
    elif grep -qE 'DO NOT MATCH THE HASHES' $log; then
        reason="$(sed -nE 's/^ *([A-Za-z0-9._-]+==[^ ]+)( from [^ ]+)?.*:$/\1/p' $log | tail -n1) is not a file that the lock names, by its SHA-256; empty pip's cache, or ask whoever runs the package index"
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

# ---- which torch ----------------------------------------------------------------------------------------------------
# pip_torch: what pip would take, such as 2.13.0+cpu where its configuration or TORCH_INDEX offers that build, else 2.13.0; empty where
# no index answers, which the installation of the packages will explain, or where TORCH names something else than a version.
# listed: the line of envs/torch.lock (SHA-256, bytes, bytes unpacked, file) of that build for this Python and machine.
find_torch() {
    local wanted=${torch#torch==} tag
    pip_torch='' listed=''
    case $torch in "torch==$wanted") ;; *) return 0 ;; esac
    pip_torch=$("$venv/bin/python" -m pip index versions torch --disable-pip-version-check ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} 2>>$log |
        sed -n 's/^Available versions: //p' | tr -d ' ' | tr ',' '\n' | awk -v wanted="$wanted" '$0 == wanted || index($0, wanted "+") == 1 {print; exit}') || true
    tag=$("$venv/bin/python" -c 'import sys; print("cp%d%d" % sys.version_info[:2])')
    case $(uname -s) in Linux) tag="$tag-$tag-[^ ]*linux" ;; *) tag="$tag-$tag-macos" ;; esac
    listed=$(sed -n 's/^#   //p' envs/torch.lock | grep -E " torch-${pip_torch//[.+]/[.+]}-$tag[^ ]*_$(uname -m)[.]whl\$" || true)
}

# Says what will be downloaded and whether the disk holds it. pip keeps what it downloads until it has installed it.
announce() {
    local free_mb packages packages_mb disk_mb more more_mb more_disk_mb bytes unpacked build
    read -r packages packages_mb disk_mb < <(sed -n 's/^requirements.lock\t//p' envs/sizes.tsv)
    more='' more_mb=0 more_disk_mb=0 bytes=0 unpacked=0
    [ -z "$listed" ] || read -r _ bytes unpacked _ <<<"$listed"
    build="${pip_torch:+torch }${pip_torch:-$torch} (its size is not known)"
    [ -z "$listed" ] || build="torch $pip_torch ($((bytes / 1000000)) MB)"
    if [ -n "$listed" ] && is_cuda; then
        read -r more more_mb more_disk_mb < <(sed -n 's/^torch-cuda.lock\t//p' envs/sizes.tsv)
        build="$build with $more packages for CUDA ($more_mb MB)"
    fi
    free_mb=$(free_mb)
    # 500 MB: blocks of the disk, and byte code that Python adds.
    needed_mb=$((disk_mb + 500 + (unpacked + bytes) / 1000000 + more_disk_mb + more_mb))
    if [ $needed_mb -lt $((disk_mb + packages_mb)) ]; then needed_mb=$((disk_mb + packages_mb)); fi
    say "to download, less what pip has in its cache: $packages packages ($packages_mb MB) and $build; $needed_mb MB of disk are needed, $free_mb are free"
    if is_cuda && ! has_gpu; then
        say "no NVIDIA GPU is found here, and a CPU build of torch needs no packages for CUDA ($more_mb MB): to take one, stop this and set TORCH_INDEX to its index, from PyTorch's installation page (envs/README.md)"
    fi
    [ "$free_mb" -ge $needed_mb ] || fail "$(too_small "$free_mb")"
}
has_gpu() { command -v nvidia-smi >/dev/null && nvidia-smi -L >/dev/null 2>&1; }
free_mb() { # with what .venv takes now, because it is replaced
    if [ -e $venv ]; then
        echo $(($(df -Pk $venv/ | awk 'NR == 2 {print $4}') / 1024 + $(du -sm $venv/ | cut -f1)))
    else
        echo $(($(df -Pk . | awk 'NR == 2 {print $4}') / 1024))
    fi
}
too_small() { echo "$1 MB of disk are free for $root/$venv, about $needed_mb are needed; free some, or make .venv a link to a folder elsewhere"; }

# The CUDA builds of the public index are those for Linux that have no local suffix, and need more packages.
is_cuda() { [ "$(uname -s)" = Linux ] && [ "$pip_torch" = "${pip_torch%+*}" ]; }

install_torch() {
    local list=$venv/tmp/torch.txt
    # Without a choice of the user nothing is installed that is not listed, even where pip does not say what it would take.
    if [ -n "$listed" ] || [ -z "${TORCH:-}${TORCH_INDEX:-}" ]; then
        # The very version, so that pip cannot take another build than the one that was said.
        sed "s/^torch==[^ ]*/torch==${pip_torch:-${torch#torch==}}/" envs/torch.lock >$list
        pip_install "torch ${pip_torch:-${torch#torch==}}" --require-hashes --no-deps ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} -r $list
        pip_torch=$("$venv/bin/python" -c 'import importlib.metadata as metadata; print(metadata.version("torch"))')
        if is_cuda; then
            pip_install "what torch needs for CUDA" --require-hashes --no-deps -r envs/torch-cuda.lock
        elif [ "$pip_torch" != "${pip_torch%+cu*}" ]; then
            say "what torch $pip_torch needs for CUDA is in no lock: it is installed without hashes"
            pip_install "what torch needs for CUDA" ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} "torch==$pip_torch"
        fi
    else
        say "envs/torch.lock does not list ${pip_torch:+torch }${pip_torch:-$torch} for this Python: it is installed without a hash (to list it: make lock-torch INDEX=<index>)"
        pip_install "$torch" ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} "$torch"
    fi
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
        free=$(free_mb)
        [ "$free" -ge $needed_mb ] || fail "$(too_small "$free")"
        [ ! -e $venv/pyvenv.cfg ] || say "$venv is incomplete, moved or of another Python: making it anew"
        say "making $venv with Python $found (some minutes; progress: $log) ..."
        "$python" -m venv --clear $venv >&2 || fail "$python -m venv $venv failed; choose another Python with PYTHON=..."
    fi
    : >$log
    mkdir -p $venv/tmp # pip unpacks here: the same disk, and what an interruption leaves goes with .venv

    find_torch
    if [ -n "$pip_torch" ] && [ -z "$listed" ] && [ -z "${TORCH:-}${TORCH_INDEX:-}" ]; then
        fail "pip's configuration offers torch $pip_torch, which envs/torch.lock does not list for $("$venv/bin/python" -V): list it (make lock-torch INDEX=<index>), or install it without a hash (TORCH=torch==$pip_torch)"
    fi
    announce
    rm -f $stamp
    # The same version from another index is another build, which pip would not replace.
    [ "$torch_found" = "$torch_wanted" ] || "$venv/bin/python" -m pip uninstall --yes torch >/dev/null 2>&1 || true

    # torch comes last and apart: one lock cannot name both its CPU and its CUDA builds. Its other dependencies are in the lock.
    pip_install "the locked packages" --require-hashes -r envs/requirements.lock
    install_torch
    "$venv/bin/python" -c pass # the first start makes the links of the LLVM wheel
    name_llvm
    rm -rf $venv/tmp
    echo "$lock_wanted $torch_wanted $root" >$stamp
    say "installed in $((SECONDS - started)) s"
fi

# ---- check ----------------------------------------------------------------------------------------------------------
"$venv/bin/python" -m workflow.runtime.doctor >&2 || fail "the environment is installed but does not work: see FAIL above"
echo checked >>$stamp
