#!/bin/bash
# ceilvo on an emulated 64-bit ARM: does it install there, does the kernel compile, are the estimates the same?
#   emulated.sh            Debian for arm64 in a folder, run through qemu-user (root; a quarter of an hour on two processors, an hour on busy ones)
# Prints the versions of the packages, whether the kernel was compiled, and by how much poses differ from those of this
# computer, from pixels on and in the golden drives; exit status 1 where that is above 1e-6. It takes the last commit.
# Environment: CACHE (the root file system, kept), PYTHON (with ceilvo installed, on this computer). Speed under
# emulation says nothing of a real computer's.
set -euo pipefail
PROJECT=$(realpath "$(dirname "$0")/../..")
CACHE=${CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/ceilvo-arm64}
PYTHON=${PYTHON:-$PROJECT/.venv/bin/python}
ROOT=$CACHE/root
DEBS=python3,python3-venv,python3-dev,gcc,libc6-dev

log() { printf '[arm64 %s] %s\n' "$(date +%T)" "$*" >&2; }
fail() { log "$*"; exit 1; }

[ "$(id -u)" = 0 ] || fail "needs root, for a root file system and chroot; found user $(id -un); try sudo"
tools=()
command -v mmdebstrap >/dev/null || tools+=(mmdebstrap)
command -v arch-test >/dev/null || tools+=(arch-test)
command -v qemu-aarch64-static >/dev/null || tools+=(qemu-user-static)
[ ${#tools[@]} = 0 ] || apt-get install -y --no-install-recommends "${tools[@]}" >/dev/null

# The kernel must know what to run arm64 programs with; containers often come without it.
if [ ! -e /proc/sys/fs/binfmt_misc/register ]; then
  mount -t binfmt_misc none /proc/sys/fs/binfmt_misc || fail "no binfmt_misc in this kernel; load its module"
fi
if [ ! -e /proc/sys/fs/binfmt_misc/qemu-aarch64 ]; then
  magic='\x7fELF\x02\x01\x01\x00\x00\x00\x00\x00\x00\x00\x00\x00\x02\x00\xb7\x00'
  mask='\xff\xff\xff\xff\xff\xff\xff\x00\xff\xff\xff\xff\xff\xff\xff\xff\xfe\xff\xff\xff'
  echo ":qemu-aarch64:M::$magic:$mask:$(command -v qemu-aarch64-static):F" >/proc/sys/fs/binfmt_misc/register
fi

if [ ! -e "$ROOT/.complete" ]; then
  log "Debian for arm64 in $ROOT"
  rm -rf "$ROOT"
  mkdir -p "$CACHE"
  list=/etc/apt/sources.list.d/debian.sources
  [ -f "$list" ] || list=/etc/apt/sources.list
  mmdebstrap --quiet --mode=root --arch=arm64 --variant=apt --aptopt='Acquire::Languages "none"' --include="$DEBS" \
    "$(sed -n 's/^VERSION_CODENAME=//p' /etc/os-release)" "$ROOT" "$list" >"$CACHE/log" 2>&1 ||
    { tail -5 "$CACHE/log" >&2; exit 1; }
  touch "$ROOT/.complete"
fi

log "installing ceilvo there"
rm -rf "$ROOT/opt/src" "$ROOT/opt/host"
mkdir -p "$ROOT/opt/src" "$ROOT/opt/host"
git -C "$PROJECT" archive HEAD | tar -x -C "$ROOT/opt/src"
cp /etc/resolv.conf "$ROOT/etc/resolv.conf"
[ ! -f /etc/ssl/certs/ca-certificates.crt ] || install -D /etc/ssl/certs/ca-certificates.crt "$ROOT/opt/host/ca.crt"
pip config list | sed -n "s/^\(global\|install\)\.\([a-z-]*\)='\(.*\)'$/\2=\3/p" |
  grep -E '^(index-url|extra-index-url|trusted-host|proxy|timeout)=' | grep -v '=file:' >"$ROOT/opt/host/settings" || true
{ echo '[global]'; cat "$ROOT/opt/host/settings"; } >"$ROOT/etc/pip.conf"
inside() {
  chroot "$ROOT" /usr/bin/env -i PATH=/usr/bin:/bin HOME=/root LANG=C.UTF-8 OPENBLAS_NUM_THREADS=1 \
    http_proxy="${http_proxy:-}" https_proxy="${https_proxy:-}" PIP_CERT=/opt/host/ca.crt PIP_PROGRESS_BAR=off \
    PIP_DISABLE_PIP_VERSION_CHECK=1 "$@"
}
for fs in proc dev; do
  mountpoint -q "$ROOT/$fs" || mount --bind "/$fs" "$ROOT/$fs"
done
trap 'umount "$ROOT/proc" "$ROOT/dev" 2>/dev/null || true' EXIT
[ -x "$ROOT/opt/venv/bin/pip" ] || inside python3 -m venv /opt/venv
inside /opt/venv/bin/pip install -q /opt/src -c /opt/src/constraints.txt
inside /opt/venv/bin/pip list --format=freeze
log "poses"
OPENBLAS_NUM_THREADS=1 "$PYTHON" -m ceilvo.bench.arm.same_estimates make "$ROOT/opt/drive"
inside /opt/venv/bin/python -u -m ceilvo.bench.arm.same_estimates compare /opt/src/tests/golden/pipeline /opt/drive
