"""What became of the Debian package on the virtual robot: a table, and deb.json.

judge_deb.py OUT SUMMARY; exit status 1 when a promise is broken. Knows the facts that deb.sh wrote, not ceilvo's code.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

from judge import Check, phases, told

Facts = Mapping[str, str]


def checks(f: Facts, journal: str) -> Iterator[Check]:
    """What dpkg did, what runs, and what is left; every fact that is not there breaks its promise."""

    def same(name: str, fact: str, promise: str) -> Check:
        found = f.get(fact, "-").strip()
        return Check(name, found or "nothing", promise or "nothing", found == promise)

    def kept(name: str, fact: str) -> Check:
        """Digests of two files, as before the upgrade."""
        digests = f.get("kept_before", "").split()
        same_ones = len(digests) == 2 and f.get(fact, "").split() == digests
        return Check(name, f.get(fact, "-"), " ".join(digests), same_ones)

    yield phases(f)
    yield Check("installed in", _seconds(f, "install_ms"), "", None)
    yield same("installed", "installed", "installed 0.1.0-1")
    yield same("starts with the computer: daemon, pages, maps", "enabled", "enabled disabled disabled")
    yield same("runs before it is configured", "active_at_first", "inactive")
    yield same("users of the system", "users", "3")
    yield same("systemd-analyze verify", "verify", "")
    yield same("kernel compiled", "kernel", "True")
    yield same("check-config", "check_config_status", "0")
    yield same("page answers", "page", "yes")
    yield same("TRACKING", "before_tracking", "yes")
    yield same("the doctor finds", "doctor", "kernel:OK map:OK unit:OK")
    yield Check("upgraded in", _seconds(f, "upgrade_ms"), "", None)
    yield same("upgraded", "upgraded", "installed 0.1.0-2")
    yield kept("configuration and calibration kept", "kept_after")
    yield same("new defaults beside it", "new_defaults", "config.yaml.dpkg-dist")
    before, after = (int(f.get(f"landmarks_{when}") or 0) for when in ("before", "after"))
    yield Check("landmarks of the map", f"{before}, {after} after", "kept", 0 < before <= after)
    yield same("daemon is another process", "restarted", "yes")
    yield same("pages are another process", "web_restarted", "active")
    yield same("TRACKING after the upgrade", "after_tracking", "yes")
    yield same("removed", "removed", "config-files 0.1.0-2")
    yield same("runs when removed", "active_removed", "inactive")
    yield same("commands and program when removed", "commands_removed", "")
    yield kept("configuration and calibration when removed", "kept_removed")
    yield same("map when removed", "map_removed", "yes")
    yield same("purged", "purged", "none")
    yield same("left by purge", "left", "")
    yield same("users left by purge", "users_left", "0")
    tracebacks = journal.count("Traceback (most recent call last)")
    yield Check("Python tracebacks", str(tracebacks), "0", tracebacks == 0 and bool(journal))


def _seconds(f: Facts, name: str) -> str:
    return f"{int(f[name]) / 1e3:.1f} s" if name in f else "-"


def main() -> int:
    out, summary = (Path(a) for a in sys.argv[1:])
    facts, journal = ((out / name) for name in ("facts.txt", "service.txt"))
    found = dict(line.split("=", 1) for line in facts.read_text().splitlines()) if facts.exists() else {}
    return told(list(checks(found, journal.read_text(errors="replace") if journal.exists() else "")), summary)


if __name__ == "__main__":
    sys.exit(main())
