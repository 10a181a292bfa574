#!/bin/bash
# Installs ceilvo as a service, or takes it away again. Run as root; safe to repeat (that is the upgrade, too).
set -euo pipefail

usage() {
  cat <<'U'
install.sh [options]               install or upgrade, enable the service (it is not started)
install.sh uninstall [options]     remove everything but configuration, calibration and state
  --purge          with uninstall: remove those too
  --fleet          also what robots of a fleet need, and the unit of its map service (neither enabled nor started)
  --web            also the pages for a browser, with their unit (neither enabled nor started)

  --wheel FILE     install this wheel instead of the source tree that this script is in
  --wheels DIR     take dependencies from this folder of wheels only (no network)
  --no-deps        install no dependencies: the interpreter's own packages are used
  --python EXE     interpreter, at least 3.10 (default /usr/bin/python3)
  --root DIR       stage below DIR; nothing of the running system is touched
  --app DIR        with --root: where the program will lie, for those who make packages (default /opt/ceilvo)
U
}

# What goes where. The program is replaced as a whole; configuration, calibration and state are never overwritten.
APP=/opt/ceilvo
WRITTEN=$APP # the place that the units here name
CONF=/etc/ceilvo
STATE=/var/lib/ceilvo
UNIT=/etc/systemd/system/ceilvod.service
MODULES_UNIT=/etc/systemd/system/ceilvo-modules.service
SLICE_UNIT=/etc/systemd/system/ceilvo.slice
WANTED=/etc/systemd/system/multi-user.target.wants/ceilvod.service
RULES=/etc/udev/rules.d/60-ceilvo.rules
SYSUSERS=/etc/sysusers.d/ceilvo.conf
MAPD_UNIT=/etc/systemd/system/ceilvo-mapd.service
MAPD_STATE=/var/lib/ceilvo-mapd
WEB_STATE=/var/lib/ceilvo-web
MAPD_SYSUSERS=/etc/sysusers.d/ceilvo-mapd.conf
WEB_UNIT=/etc/systemd/system/ceilvo-web.service
WEB_SYSUSERS=/etc/sysusers.d/ceilvo-web.conf
COMMANDS="ceilvod calib"

say() { printf 'ceilvo: %s\n' "$*"; }
die() { printf 'install.sh: %s\n' "$*" >&2; exit 1; }

value() { [ $# -ge 2 ] || die "$1: expected a value"; }

parse() {
  action=install root='' wheel='' wheels='' python=/usr/bin/python3 deps=yes purge=no fleet=no web=no
  while [ $# -gt 0 ]; do
    case $1 in
      install | uninstall) action=$1 ;;
      --purge) purge=yes ;;
      --fleet) fleet=yes ;;
      --web) web=yes ;;
      --no-deps) deps=no ;;
      --wheel) value "$@"; wheel=$2; shift ;;
      --wheels) value "$@"; wheels=$2; shift ;;
      --python) value "$@"; python=$2; shift ;;
      --root) value "$@"; root=$2; shift ;;
      --app) value "$@"; APP=$2; shift ;;
      -h | --help) usage; exit 0 ;;
      *) die "unknown argument '$1'; see --help" ;;
    esac
    shift
  done
  if [ "$purge" = yes ] && [ "$action" = install ]; then die "--purge goes with uninstall"; fi
  if [ "$fleet" = yes ] && [ "$action" = uninstall ]; then die "--fleet goes with install"; fi
  if [ "$web" = yes ] && [ "$action" = uninstall ]; then die "--web goes with install"; fi
  if [ "$APP" != "$WRITTEN" ] && [ -z "$root" ]; then die "--app goes with --root"; fi
  if [ -n "$root" ]; then
    [ -d "$root" ] || die "--root $root: no such directory"
    root=$(realpath "$root")
    [ "$root" != / ] || root=''
  fi
}

check() {
  [ "$(id -u)" = 0 ] || die "must be run as root: sudo $0"
  [ -n "$root" ] || command -v systemctl >/dev/null || die "systemctl not found: this machine does not run systemd"
  command -v "$python" >/dev/null || die "--python $python: not found; install Python 3.10 or newer"
  "$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' ||
    die "--python $python is $("$python" -V 2>&1), expected Python 3.10 or newer"
  case $(realpath "$(command -v "$python")") in
    /root/* | /home/*) [ -n "$root" ] || die "--python $python lies in a home directory, which the service cannot read" ;;
  esac
  "$python" -c 'import venv, ensurepip' 2>/dev/null ||
    die "$python cannot make virtual environments; on Debian and Ubuntu: apt install python3-venv"
  if [ -n "$wheel" ]; then
    [ -f "$wheel" ] || die "--wheel $wheel: no such file"
    package=$(realpath "$wheel")
  else
    [ -f "$here/../pyproject.toml" ] || die "not in a source tree; give --wheel FILE"
    package=$(realpath "$here/..")
  fi
  if [ -n "$wheels" ] && [ ! -d "$wheels" ]; then die "--wheels $wheels: no such directory"; fi
  if [ -e "$root$MAPD_UNIT" ]; then fleet=yes; fi # an upgrade keeps what is there
  if [ -e "$root$WEB_UNIT" ]; then web=yes; fi
}

pip_options() {
  opts=(--quiet --disable-pip-version-check --no-compile --no-cache-dir --root-user-action=ignore)
  [ "$deps" = yes ] || opts+=(--no-deps)
  [ -z "$wheels" ] || opts+=(--no-index --find-links "$(realpath "$wheels")")
  local f
  for f in "$here/constraints.txt" "$here/../constraints.txt"; do
    if [ -f "$f" ]; then opts+=(--constraint "$(realpath "$f")"); break; fi
  done
}

# The new program is made beside the old one and takes its place in one step, so that a failed upgrade changes nothing.
install_app() {
  local new=$root$APP.new old=$root$APP.old venv_opts=() cmd
  rm -rf "$new" "$old"
  trap 'rm -rf "$root$APP.new"' EXIT
  mkdir -p "$root${APP%/*}"
  [ "$deps" = yes ] || venv_opts=(--system-site-packages)
  say "virtual environment with $("$python" -V 2>&1)"
  "$python" -I -m venv "${venv_opts[@]}" "$new"
  pip_options
  say "packages from $package"
  case $fleet$web in
    yesyes) package="${package}[fleet,web]" ;;
    yesno) package="${package}[fleet]" ;;
    noyes) package="${package}[web]" ;;
  esac
  "$new/bin/python" -I -m pip install "${opts[@]}" "$package"
  for cmd in $COMMANDS; do
    [ -x "$new/bin/$cmd" ] || die "$package does not bring the command '$cmd'"
  done
  # Scripts name their interpreter by its path: make it the final one.
  grep -rlIZ --fixed-strings "$new" "$new/bin" "$new/pyvenv.cfg" | xargs -0r sed -i "s|$new|$APP|g"
  # Byte code holds the date of its source, and before Python 3.11, its sets in the order of their hashes: with a fixed
  # date and seed an installation is the same bytes each time. -s and not -I, which would not let the seed be given.
  find "$new/lib" -name __pycache__ -prune -exec rm -rf {} +
  find "$new/lib" -name '*.py' -exec touch -d @315532800 {} +
  (cd "$new/lib" && env -i PYTHONHASHSEED=0 ../bin/python -s -m compileall -qqf -s "$new" -p "$APP" "$new/lib") || true
  install_share "$new/share/ceilvo"
  if [ -e "$root$APP" ]; then mv -T "$root$APP" "$old"; fi
  mv -T "$new" "$root$APP"
  rm -rf "$old"
}

# put_unit FILE: a unit in its place, with the program's.
put_unit() {
  install -d "${1%/*}"
  sed "s|$WRITTEN/|$APP/|g" "$here/${1##*/}" >"$1"
  chmod 644 "$1"
}

# What uninstalling needs, and what the unit's Documentation= points to.
install_share() {
  local f
  install -d "$1"
  install -m755 "$here/install.sh" "$here/network.sh" "$1/"
  for f in ceilvod.service ceilvo-modules.service ceilvo.slice ceilvo-mapd.service ceilvo-web.service 60-ceilvo.rules sysusers.conf sysusers-mapd.conf sysusers-web.conf; do
    install -m644 "$here/$f" "$1/$f"
  done
  for f in "$here/service.md" "$here/../docs/service.md" "$here/fleet.md" "$here/../docs/fleet.md" "$here/web.md" "$here/../docs/web.md"; do
    if [ -f "$f" ]; then install -m644 "$f" "$1/${f##*/}"; fi
  done
  for f in "$here/constraints.txt" "$here/../constraints.txt"; do
    if [ -f "$f" ]; then install -m644 "$f" "$1/constraints.txt"; break; fi
  done
  "$new/bin/python" -I -m ceilvo.config.rendering >"$1/config.yaml"
}

install_user() {
  command -v systemd-sysusers >/dev/null || die "systemd-sysusers not found: systemd is too old"
  install -D -m644 "$here/sysusers.conf" "$root$SYSUSERS"
  systemd-sysusers ${root:+--root="$root"} "$root$SYSUSERS" >/dev/null
  if [ "$web" = yes ]; then
    install -D -m644 "$here/sysusers-web.conf" "$root$WEB_SYSUSERS"
    systemd-sysusers ${root:+--root="$root"} "$root$WEB_SYSUSERS" >/dev/null
  fi
  [ "$fleet" = yes ] || return 0
  install -D -m644 "$here/sysusers-mapd.conf" "$root$MAPD_SYSUSERS"
  systemd-sysusers ${root:+--root="$root"} "$root$MAPD_SYSUSERS" >/dev/null
}

install_config() {
  local default=$root$APP/share/ceilvo/config.yaml
  install -d -m755 "$root$CONF"
  if [ ! -e "$root$CONF/config.yaml" ]; then
    install -m644 "$default" "$root$CONF/config.yaml"
    say "$CONF/config.yaml written: set the camera and the base"
  elif cmp -s "$default" "$root$CONF/config.yaml"; then
    rm -f "$root$CONF/config.yaml.new"
  else
    install -m644 "$default" "$root$CONF/config.yaml.new"
    say "$CONF/config.yaml kept; the defaults of this version are in config.yaml.new"
  fi
  if [ "$fleet" = yes ] && [ ! -e "$root$CONF/mapd.yaml" ]; then
    install -m644 "$default" "$root$CONF/mapd.yaml"
    say "$CONF/mapd.yaml written, for the map service: set mapd and zenoh"
  fi
  [ -e "$root$CONF/calibration.yaml" ] || say "$CONF/calibration.yaml is missing: commission the camera with 'calib'"
}

install_service() {
  local cmd
  install -d "$root/usr/local/bin"
  for cmd in $COMMANDS; do ln -sfn "$APP/bin/$cmd" "$root/usr/local/bin/$cmd"; done
  install -D -m644 "$here/60-ceilvo.rules" "$root$RULES"
  put_unit "$root$UNIT"
  put_unit "$root$MODULES_UNIT"
  put_unit "$root$SLICE_UNIT"
  install -d "$root${WANTED%/*}"
  ln -sfn "$UNIT" "$root$WANTED"
  install -d -m750 "$root$STATE"
  if [ "$web" = yes ]; then put_unit "$root$WEB_UNIT"; fi
  [ "$fleet" = yes ] || return 0
  put_unit "$root$MAPD_UNIT"
  install -d -m750 "$root$MAPD_STATE"
}

tell_system() {
  [ -z "$root" ] || return 0
  systemctl daemon-reload
  if command -v udevadm >/dev/null; then
    udevadm control --reload || true
    udevadm trigger --subsystem-match=video4linux --subsystem-match=tty --action=change || true
  fi
}

do_install() {
  check
  install_app
  install_user
  install_config
  install_service
  bash "$root$APP/share/ceilvo/network.sh" ${root:+--root "$root"}
  tell_system
  if [ -z "$root" ]; then
    chown ceilvo:ceilvo "$STATE"
    systemctl try-restart ceilvod.service
    if [ "$fleet" = yes ]; then
      chown ceilvo-mapd:ceilvo-mapd "$MAPD_STATE"
      systemctl try-restart ceilvo-mapd.service
    fi
    if [ "$web" = yes ]; then systemctl try-restart ceilvo-web.service; fi
    say "installed; start with: systemctl start ceilvod"
  fi
}

do_uninstall() {
  [ "$(id -u)" = 0 ] || die "must be run as root: sudo $0 uninstall"
  local cmd
  if [ -z "$root" ] && [ -e "$UNIT" ]; then systemctl disable --now --quiet ceilvod.service ceilvo-modules.service || true; fi
  if [ -z "$root" ] && [ -e "$MAPD_UNIT" ]; then systemctl disable --now --quiet ceilvo-mapd.service || true; fi
  if [ -z "$root" ] && [ -e "$WEB_UNIT" ]; then systemctl disable --now --quiet ceilvo-web.service || true; fi
  rm -f "$root$WEB_UNIT" "$root$WEB_SYSUSERS"
  rm -rf "$root$WEB_UNIT.d"
  rm -f "$root$WANTED" "$root$UNIT" "$root$MODULES_UNIT" "$root$SLICE_UNIT" "$root$RULES" "$root$SYSUSERS" "$root$MAPD_UNIT" "$root$MAPD_SYSUSERS"
  rm -rf "$root$UNIT.d" "$root$MAPD_UNIT.d"
  for cmd in $COMMANDS; do
    if [ "$(readlink "$root/usr/local/bin/$cmd" || true)" = "$APP/bin/$cmd" ]; then rm -f "$root/usr/local/bin/$cmd"; fi
  done
  rm -rf "$root$APP" "$root$APP.new" "$root$APP.old"
  if [ "$purge" = yes ]; then
    rm -rf "$root$CONF" "$root$STATE" "$root$MAPD_STATE" "$root$WEB_STATE"
  else
    say "kept: $CONF $STATE"
  fi
  remove_user
  tell_system
  say "uninstalled"
}

# Kept state goes to root, so that the next user with this number does not own it; systemd hands it back at a start.
remove_user() {
  local state user
  for state in "$STATE" "$MAPD_STATE" "$WEB_STATE"; do
    user=${state##*/}
    [ ! -d "$root$state" ] || chown -R root:root "$root$state"
    if grep -qs "^$user:" "$root/etc/passwd"; then userdel ${root:+--prefix "$root"} "$user"; fi
  done
}

main() {
  here=$(dirname "$(realpath "$0")")
  parse "$@"
  case $action in
    install) do_install ;;
    uninstall) do_uninstall ;;
  esac
}

main "$@"
exit
