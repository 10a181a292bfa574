#!/bin/bash
# make test-robot: the installed service on a virtual robot, from /dev/video0 to Zenoh and Modbus, against the truth.
# run.sh prepare: only the image and the kernel that it boots, behind what others compute.
# make test-deb (ONLY=deb): the same robot, and the Debian package on it instead of the installer's service.
# Results: build/robot/summary.json and, in build/robot/out, everything that was sent, logged and measured.
set -euo pipefail
here=$(dirname "$(realpath "$0")")
repo=$(realpath "$here/../..")
work=$repo/build/robot
share=$work/share
export CACHE=${CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/robot_vm}
export OUT=$work/out
DRIVE_S=${DRIVE_S:-40}

skip() { echo "SKIP: $*"; exit 0; }
step() { printf '[robot %4ds] %s\n' $SECONDS "$*"; }

[ "$(uname -sm)" = "Linux x86_64" ] || skip "the virtual robot needs Linux on x86-64, this is $(uname -sm)"
[ "$(id -u)" = 0 ] || skip "the virtual robot needs root to make its image"
command -v apt-get >/dev/null || skip "the virtual robot needs apt to make its image"
grep -q '^ID=debian' /etc/os-release || skip "the virtual robot is built from Debian's packages, this is another system"
command -v gcc >/dev/null || skip "the virtual robot needs a C compiler for its kernel: apt install gcc"

if [ "${1:-}" = prepare ]; then exec bash "$here/vm.sh" build; fi

cd "$repo"
python=$repo/.venv/bin/python
step "virtual environment"
make -s .venv/.installed

step "image and kernel (cached in $CACHE)"
mkdir -p "$work"
bash "$here/vm.sh" build

installer_kit() {
  step "wheel and its dependencies"
  guest_python=$(basename "$(ls -d "$CACHE"/image/usr/lib/python3.*)")
  # A wheel with the compiled kernel fits one Python only; for another one the kernel is left out.
  host_python=$("$python" -c 'import sys; print("python%d.%d" % sys.version_info[:2])')
  PURE=$([ "$host_python" = "$guest_python" ] || echo 1) bash packaging/wheel.sh "$share/kit"
  pip=("$python" -m pip --quiet --disable-pip-version-check)
  cp -r systemd constraints.txt "$share/kit/"
  mkdir -p "$share/kit/docs"
  if [ -f docs/service.md ]; then cp docs/service.md "$share/kit/docs/"; fi
  key=$({ sed -n '/^dependencies/,/^]/p' pyproject.toml; cat constraints.txt; echo "$guest_python"; } | sha256sum | cut -c1-16)
  wheels=$CACHE/wheels
  if [ "$(cat "$wheels/key" 2>/dev/null)" != "$key" ]; then
    rm -rf "$wheels"
    "${pip[@]}" download --only-binary=:all: --python-version "${guest_python#python}" --dest "$wheels" \
      --constraint constraints.txt "$share"/kit/*.whl 2>"$work/download.log" || { cat "$work/download.log" >&2; exit 1; }
    rm -f "$wheels"/ceilvo-*
    echo "$key" >"$wheels/key"
  fi
  cp -rl "$wheels" "$share/wheels" 2>/dev/null || cp -r "$wheels" "$share/wheels"
}

# A package, DEB or of this source tree, and one of a later version with other defaults.
packages() {
  step "Debian package"
  local deb=${DEB:-} later=$work/later
  mkdir -p "$share/deb"
  if [ -z "$deb" ]; then
    COMPRESSION=none OUT=$work/deb bash packaging/deb/build.sh >"$work/deb.log" 2>&1 || { tail -20 "$work/deb.log" >&2; exit 1; }
    deb=$(ls "$work"/deb/*.deb)
  fi
  # Made here it is not compressed, for speed; `make deb` compresses. Nobody filed a bug that the first upload closes.
  local not=initial-upload-closes-no-bugs,uses-no-compression-for-control-tarball,uses-no-compression-for-data-tarball
  if command -v lintian >/dev/null; then
    lintian --fail-on error --suppress-tags "$not" "$deb"
  else
    echo "lintian is not installed: not asked"
  fi
  rm -rf "$later"
  dpkg-deb --raw-extract "$deb" "$later"
  sed -i 's/^\(Version: .*-\)1$/\12/' "$later/DEBIAN/control"
  echo '# of a later version' >>"$later/etc/ceilvo/config.yaml"
  dpkg-deb --root-owner-group -Znone --build "$later" "$share/deb/new.deb" >/dev/null
  rm -rf "$later"
  cp "$deb" "$share/deb/old.deb"
}

rm -rf "$share" "$OUT"
mkdir -p "$share/kit" "$OUT"
if [ "${ONLY:-}" = deb ]; then packages; else installer_kit; fi

step "recording of $DRIVE_S s at 15 fps"
rm -rf "$work/recording"
"$python" -m ceilvo.sim.record "$work/recording" --seconds "$DRIVE_S" --fps 15 2>/dev/null
"$python" "$here/prepare.py" "$work/recording" "$share"
head -c $((320 * 240 * 4)) "$share/frames.gray" >"$share/small.gray"
cp "$here"/{common.sh,feeder.py,listener.py} "$share/"

step "simulated base"
nice -n -10 "$python" -m ceilvo.sim.base --baud 115200 --parity N --log "$OUT/telegrams.jsonl" --port-link "$OUT/base" >"$OUT/base.txt" 2>&1 &
base=$!
trap 'kill $base 2>/dev/null || true' EXIT
for _ in $(seq 100); do [ -s "$OUT/base.txt" ] && break; sleep 0.05; done
[ -L "$OUT/base" ] || { cat "$OUT/base.txt" >&2; exit 1; }

# boot SCRIPT OUT: run it inside, with the base that listens to OUT/base.stop.
boot() {
  local status=0 watcher tty
  tty=$(readlink "$OUT/base") # before OUT is another one
  cp "$here/$1" "$share/guest.sh"
  mkdir -p "$2"
  while sleep 0.05; do
    if [ -e "$2/base.stop" ]; then kill -STOP $base; else kill -CONT $base; fi 2>/dev/null || break
  done &
  watcher=$!
  OUT=$2 TTY=$tty TIMEOUT=$3 bash "$here/vm.sh" run "$share" || status=$?
  kill $watcher
  kill -CONT $base
  cat "$2/log.txt" 2>/dev/null || tail -20 "$2/console.txt" || true
  return $status
}

status=0
if [ "${ONLY:-drive}" = drive ]; then
  step "boot: the drive"
  boot guest.sh "$OUT" 240 || status=1
  cp "$OUT/telegrams.jsonl" "$OUT/telegrams-drive.jsonl" # the base goes on with the next
fi
if [ "${ONLY:-faults}" = faults ]; then
  step "boot: faults"
  boot faults.sh "$OUT/faults" 420 || status=1
fi
if [ "${ONLY:-}" = deb ]; then
  step "boot: the package"
  boot deb.sh "$OUT/deb" 300 || status=1
fi
kill $base
wait $base || true
trap - EXIT

step "results"
: >"$work/results.txt"
if [ "${ONLY:-drive}" = drive ]; then "$python" "$here/judge.py" "$OUT" "$share" "$work/summary.json" | tee -a "$work/results.txt" || status=1; fi
if [ "${ONLY:-faults}" = faults ]; then "$python" "$here/judge_faults.py" "$OUT/faults" "$work/faults.json" | tee -a "$work/results.txt" || status=1; fi
if [ "${ONLY:-}" = deb ]; then "$python" "$here/judge_deb.py" "$OUT/deb" "$work/deb.json" | tee -a "$work/results.txt" || status=1; fi
grep -s FAILED "$work/results.txt" || true # once more, where the end of a log shows it
step "done"
exit $status
