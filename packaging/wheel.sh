#!/bin/bash
# packaging/wheel.sh DIR: a wheel of this source tree in DIR, made by .venv's Python.
# PURE=1: without the compiled kernel, for any Python. Otherwise it fits Pythons of that version on this kind of processor.
# Dates in it are SOURCE_DATE_EPOCH's, seconds since 1970; two builds have not been compared byte for byte yet.
set -euo pipefail
repo=$(dirname "$(dirname "$(realpath "$0")")")
mkdir -p "$1"
out=$(realpath "$1")
# A copy, because setuptools would pack what an earlier build left in build/. Its place is fixed: compilers write it down.
work=$repo/build/wheel-source
rm -rf "$work"
mkdir -p "$work"
trap 'rm -rf "$work"' EXIT
cd "$repo"
cp -r pyproject.toml setup.py README.md LICENSE ceilvo daemon drivers calib sim bench "$work/"
find "$work" \( -name '*.so' -o -name __pycache__ \) -prune -exec rm -rf {} +
if [ "${PURE:-}" = 1 ]; then rm "$work/setup.py"; fi
# LDSHARED: without the search path for libraries that a Python of pyenv's would write into them.
CFLAGS="${CFLAGS:-} -g0" LDSHARED="${CC:-cc} -shared" LDFLAGS="${LDFLAGS:-} -Wl,--strip-all" \
  .venv/bin/python -m pip --quiet --disable-pip-version-check wheel --no-deps --wheel-dir "$out" "$work"
