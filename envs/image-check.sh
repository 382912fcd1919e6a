#!/usr/bin/env bash
# Builds the image of envs/Dockerfile and tries it: bash envs/image-check.sh [folder for some 15 GB, by default under TMPDIR]
#                                                  bash envs/image-check.sh --engine     only where Docker or Podman can do it
#
# With Docker or Podman that reach a registry, from the base that the Dockerfile names. Without a registry, root with buildah and
# mmdebstrap (packages of Debian; no daemon, no namespaces) builds the same steps in a chroot, on a base of Debian's own packages
# in the place of that image. Where neither can be had it says so and ends with code 77 ("skipped").
#
# The stand-in base takes over this machine's certificates and its configuration of pip, with the folders that it names.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

say() { echo "image-check: $*" >&2; }
skip() { say "skipped: $*"; exit 77; }
base=$(sed -n 's/^FROM //p' envs/Dockerfile)
name=iif-image-check
# What the image must be able to do: the checks of doctor, and a plan of jobs with the rules of the workflow.
tried='python -m workflow.runtime.doctor && snakemake scenes/kitchen --cores 1 --dry-run --quiet && test -w results && test "$(id -u)" != 0'

for engine in docker podman; do
    if $engine info >/dev/null 2>&1 && timeout 300 $engine pull --quiet "$base" >/dev/null 2>&1; then
        say "building with $engine ..."
        $engine build --file envs/Dockerfile --tag $name .
        $engine run --rm --entrypoint sh $name -c "$tried"
        say "ok: built from $base with $engine, and tried"
        exit 0
    fi
done

[ "${1:-}" != --engine ] || skip "no Docker or Podman that reaches $base"
[ "$(id -u)" = 0 ] || skip "no Docker or Podman that reaches $base, and a build in a chroot needs root"
for tool in buildah mmdebstrap; do
    command -v $tool >/dev/null || skip "no Docker or Podman that reaches $base, and no $tool (Debian: apt-get install --no-install-recommends buildah mmdebstrap)"
done
case $base in *bookworm) suite=bookworm ;; *) skip "no stand-in is known for $base" ;; esac

work=$(mktemp -d "${1:-${TMPDIR:-/tmp}}/iif-image.XXXXXX")
free_mb=$(($(df -Pk "$work" | awk 'NR == 2 {print $4}') / 1024))
buildah() { command buildah --root "$work/images" --runroot "$work/run" --storage-driver vfs "$@"; }
clean() { buildah rm --all >/dev/null 2>&1 || true; rm -rf "$work"; }
trap clean EXIT
[ "$free_mb" -ge 15000 ] || skip "$free_mb MB are free for $work, 15000 are needed; name another folder"

say "the base from packages of Debian $suite, in the place of $base ..."
mmdebstrap --quiet --variant=minbase --include=python3,python3-venv,ca-certificates $suite "$work/base.tar"
container=$(buildah from scratch)
buildah add --quiet "$container" "$work/base.tar" / >/dev/null
rm "$work/base.tar"
mounts=()
if [ -f /etc/ssl/certs/ca-certificates.crt ]; then mounts+=(--volume /etc/ssl/certs:/etc/ssl/certs:ro); fi
# `global.find-links='/a'` and `:env:.cert='/b'` become lines of a file, variables last, because they win.
{ echo '[global]'; python3 -m pip config list 2>/dev/null | sed -nE "s/^(global|:env:)\.(find-links|index-url|extra-index-url|cert|proxy|default-timeout|timeout)='(.*)'\$/\1 \2 = \3/p" |
    awk '{key = $2; sub(/^[^ ]+ /, ""); if (key == "default-timeout") {sub(/^default-/, "")} line[key] = $0} END {for (key in line) print line[key]}'; } >"$work/pip.conf"
buildah copy --quiet "$container" "$work/pip.conf" /etc/pip.conf >/dev/null
for folder in $(grep -oE '(file://|= ?| )/[^ ]+' "$work/pip.conf" | sed -E 's,^(file://|= ?| ),,' | sort -u); do
    # A package index on disk keeps its files next to its folder simple/.
    case $folder in */simple) folder=${folder%/simple} ;; esac
    if [ -d "$folder" ]; then mounts+=(--volume "$folder:$folder:ro"); fi
done
buildah commit --quiet "$container" "$base" >/dev/null
buildah rm "$container" >/dev/null

say "building the steps of envs/Dockerfile in a chroot, and trying the image as its last step ..."
{ cat envs/Dockerfile; echo "RUN $tried"; } >"$work/Dockerfile" # another container would be one more copy of all
buildah bud --isolation chroot --pull-never "${mounts[@]}" --ignorefile envs/Dockerfile.dockerignore --file "$work/Dockerfile" --tag $name .
say "ok: the steps of envs/Dockerfile on packages of Debian $suite in the place of $base, and tried"
