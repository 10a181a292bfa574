"""Calibrations by which sessions saw: of one robot, of several, or of one before and after a change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ceilvo.calibration import Calibration
from ceilvo.calibration_file import read_calibration
from ceilvo.config.reader import calibration_path, load_config
from ceilvo.daemon.building.typed import Prefixed
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.refinement.survey import Floor
from ceilvo.errors import CeilvoError


@dataclass(frozen=True)
class Eyes:
    """Files with their calibrations; a session is of the one with the longest prefix that its name begins with.

    Attributes:
        named: calibrations of sessions by their whole name, before any prefix.
        prefixes: how many of the files are for prefixes; None: all.
    """

    files: tuple[Prefixed, ...]
    calibrations: tuple[Calibration, ...]
    named: Mapping[str, int] = field(default_factory=dict)
    prefixes: int | None = None

    @staticmethod
    def read(given: Sequence[Prefixed], config: Path) -> Eyes:
        """Those that were named, else the one that the configuration names.

        Raises:
            CeilvoError: a file cannot be used, or a prefix is given twice.
        """
        files = tuple(given) or (Prefixed("", calibration_path(load_config(config, ()), config)),)
        prefixes = [f.prefix for f in files]
        for p in prefixes:
            if prefixes.count(p) > 1:
                raise CeilvoError(f"--calibration: given twice for sessions {p!r}; say SESSIONS=FILE for each")
        return Eyes(files, tuple(read_calibration(f.file) for f in files))

    def of(self, session: str) -> int:
        """Which one saw a session.

        Raises:
            CeilvoError: none.
        """
        if session in self.named:
            return self.named[session]
        fit = [i for i, f in enumerate(self.files[: self.prefixes]) if session.startswith(f.prefix)]
        if not fit:
            raise CeilvoError(f"session {session!r}: no --calibration is for it; give FILE, or SESSIONS=FILE")
        return max(fit, key=lambda i: len(self.files[i].prefix))

    def floors(self, contents: Sequence[MapContent]) -> tuple[list[Floor], list[Calibration]]:
        """Maps with all their sessions, and the calibrations.

        Raises:
            CeilvoError: no map has key poses, or a session has no calibration.
        """
        if not any(c.key_poses for c in contents):
            raise CeilvoError("no key poses are kept with the map, expected some: 'ceilvod map build' makes them")
        floors = [
            Floor(c.landmarks, c.axis_rad, c.key_poses, tuple(self.of(k.session) for k in c.key_poses))
            for c in contents
        ]
        return floors, list(self.calibrations)

    def targets(self, given: Sequence[Prefixed]) -> dict[int, Path]:
        """Where corrected calibrations go, by their number; nothing is there yet.

        Raises:
            CeilvoError: a file is there, or its prefix is no calibration's.
        """
        prefixes, out = [f.prefix for f in self.files], {}
        for f in given:
            if f.prefix not in prefixes:
                raise CeilvoError(f"--write-calibration: no calibration is for sessions {f.prefix!r}")
            if f.file.exists():
                raise CeilvoError(f"{f.file}: is there already, expected a new name: the old calibration is kept")
            out[prefixes.index(f.prefix)] = f.file
        return out
