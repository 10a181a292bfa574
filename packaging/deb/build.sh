#!/bin/bash
# make deb: dist/ceilvo_VERSION_ARCHITECTURE.deb for the Debian or Ubuntu that it is built on: what systemd/install.sh installs, in the places
# where packages put things. Needs root (or fakeroot), dpkg-dev, python3-venv, a C compiler, and .venv.
#   WHEELS=DIR      dependencies from this folder of wheels (no network)
#   WHEEL=FILE      this wheel of ceilvo, with the compiled kernel, instead of one of this source tree
#   PYTHON=EXE      interpreter of the package (default /usr/bin/python3)
#   OUT=DIR         where the package goes (default dist); COMPRESSION=none makes it quickly
#   DEBFULLNAME, DEBEMAIL   the maintainer
set -euo pipefail
here=$(dirname "$(realpath "$0")")
repo=$(realpath "$here/../..")
cd "$repo"
python=${PYTHON:-/usr/bin/python3}
app=/usr/lib/ceilvo
work=$repo/build/deb
stage=$work/stage
die() { echo "make deb: $*" >&2; exit 1; }

[ "$(id -u)" = 0 ] || die "must be run as root, or by: fakeroot make deb"
for tool in dpkg-deb dpkg-shlibdeps systemd-sysusers; do
  command -v $tool >/dev/null || die "$tool: not found; apt install dpkg-dev systemd"
done
tag() { "$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])'; }
[ "$(tag .venv/bin/python)" = "$(tag "$python")" ] || die ".venv has Python $(tag .venv/bin/python), expected $(tag "$python") as" \
  "$python: the compiled kernel fits one version only; make .venv anew with PYTHON=$python"
SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct 2>/dev/null || date +%s)}
export SOURCE_DATE_EPOCH
umask 022

rm -rf "$work"
mkdir -p "$stage/DEBIAN" "$work/root"
if [ -z "${WHEEL:-}" ]; then bash packaging/wheel.sh "$work"; fi
wheel=${WHEEL:-$(ls "$work"/ceilvo-*.whl)}
case $wheel in *-none-any.whl) die "the compiled kernel is missing; apt install gcc python3-dev" ;; esac
held=$("$python" -m zipfile -l "$wheel")
for part in daemon/vision/kernel/pixels daemon/odometry/kernel/views daemon/relocalisation/kernel/evidence; do
  grep -q "ceilvo/$part\..*so" <<<"$held" || die "$part was not compiled; apt install gcc python3-dev"
done
version=$(basename "$wheel" | cut -d- -f2)-1
architecture=$(dpkg --print-architecture)

# The installer does what it does on any robot; then things go where packages have them.
bash systemd/install.sh --root "$work/root" --app $app --python "$python" --wheel "$wheel" ${WHEELS:+--wheels "$WHEELS"} --fleet --web
cd "$work/root"
mkdir -p "$stage"/usr/{bin,lib/systemd/system,lib/udev/rules.d,lib/sysusers.d,share/man/man1,share/doc/ceilvo} \
  "$stage"/usr/share/{bash-completion/completions,lintian/overrides} "$stage/etc"
cp -a usr/lib/ceilvo "$stage/usr/lib/"
cp -a etc/ceilvo "$stage/etc/"
cp -a etc/systemd/system/*.{service,slice,socket} "$stage/usr/lib/systemd/system/"
cp -a etc/udev/rules.d/* "$stage/usr/lib/udev/rules.d/"
cp -a etc/sysusers.d/* "$stage/usr/lib/sysusers.d/"
cd "$repo"

program=$stage$app
for command in ceilvod calib; do ln -s "../lib/ceilvo/bin/$command" "$stage/usr/bin/$command"; done
# dpkg replaces and removes the program: nothing in it does that itself. The place of the wheel here is nobody's business.
"$program/bin/python" -I -m pip --quiet --disable-pip-version-check uninstall --yes --root-user-action=ignore setuptools pip 2>/dev/null ||
  "$program/bin/python" -I -m pip --quiet --disable-pip-version-check uninstall --yes --root-user-action=ignore pip
find "$program/bin" -name '[Aa]ctivate*' -delete
find "$program" -name direct_url.json -delete -o -name REQUESTED -delete
find "$program/lib" -type f -perm /111 -exec chmod a-x {} +
find "$program/lib" -depth -name __pycache__ -empty -delete
share=$program/share/ceilvo
rm "$share/install.sh" "$share"/*.{service,slice,socket} "$share"/sysusers* "$share"/*.rules "$share/constraints.txt"

# Pages, completion, papers.
"$program/bin/python" -I packaging/manual.py "$work/manual"
doc=$stage/usr/share/doc/ceilvo
for command in ceilvod calib; do
  install -m644 "$work/manual/$command.1" "$stage/usr/share/man/man1/"
  install -m644 "$work/manual/$command.bash" "$stage/usr/share/bash-completion/completions/$command"
done
install -m644 packaging/deb/copyright "$doc/copyright"
maintainer="${DEBFULLNAME:-$(git config user.name || echo ceilvo)} <${DEBEMAIL:-$(git config user.email || echo root@localhost)}>"
printf 'ceilvo (%s) stable; urgency=medium\n\n  * Built from commit %s.\n\n -- %s  %s\n' "$version" "$(git rev-parse --short HEAD 2>/dev/null || echo unknown)" \
  "$maintainer" "$(date -uRd "@$SOURCE_DATE_EPOCH")" >"$doc/changelog.Debian"
gzip -9n "$doc/changelog.Debian" "$stage"/usr/share/man/man1/*.1
install -m644 packaging/deb/lintian-overrides "$stage/usr/share/lintian/overrides/ceilvo"

# What the libraries in the environment need of the system.
cd "$work"
mkdir -p debian
printf 'Source: ceilvo\n\nPackage: ceilvo\nArchitecture: any\n' >debian/control
private=$(find "$program" -type d -name '*.libs' -printf '-l%p ')
mapfile -t libraries < <(find "$program" -name '*.so*' -type f)
# shellcheck disable=SC2086
dpkg-shlibdeps -O --ignore-missing-info -xceilvo $private "${libraries[@]}" >shlibs.txt 2>shlibs.log ||
  { cat shlibs.log >&2; die "dpkg-shlibdeps: the libraries need something that this system has not"; }
cd "$repo"
next=$(tag "$python" | { IFS=. read -r major minor; echo "$major.$((minor + 1))"; })
depends="python3 (>= $(tag "$python")~), python3 (<< $next), systemd, init-system-helpers (>= 1.52), passwd, $(sed -n 's/^shlibs:Depends=//p' "$work/shlibs.txt")"
sed -e "s|@VERSION@|$version|; s|@ARCHITECTURE@|$architecture|; s|@MAINTAINER@|$maintainer|; s|@DEPENDS@|$depends|" \
  -e "s|@SIZE@|$(du -sk --apparent-size --exclude=DEBIAN "$stage" | cut -f1)|" packaging/deb/control.in >"$stage/DEBIAN/control"
install -m755 packaging/deb/{preinst,postinst,prerm,postrm} "$stage/DEBIAN/"
(cd "$stage" && find etc -type f -printf '/%p\n' | sort >DEBIAN/conffiles)
(cd "$stage" && find usr -type f -printf '%P\0' | sort -z | (cd usr && xargs -0 md5sum) | sed 's|  |  usr/|' >DEBIAN/md5sums)
find "$stage" -newermt "@$SOURCE_DATE_EPOCH" -exec touch -hd "@$SOURCE_DATE_EPOCH" {} +
mkdir -p "${OUT:=dist}"
file=$OUT/ceilvo_${version}_$architecture.deb
dpkg-deb --root-owner-group ${COMPRESSION:+"-Z$COMPRESSION"} --build "$stage" "$file"
echo "make deb: $file, $(($(stat -c %s "$file") / 1000000)) MB"
