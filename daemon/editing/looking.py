"""Commands that look at maps and change none: show, stats, diff, history, export."""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ceilvo.daemon.editing import sources
from ceilvo.daemon.editing.changes import only
from ceilvo.daemon.editing.exchange import to_geojson, to_json
from ceilvo.daemon.editing.joining import have_same_ids, in_axes_of, matches_by_id, matches_by_place
from ceilvo.daemon.editing.picture import Change, draw
from ceilvo.daemon.editing.statistics import statistics
from ceilvo.daemon.map.database.copies import open_map
from ceilvo.daemon.map.map_file import save_map
from ceilvo.errors import CeilvoError, printable

_COLUMNS, _ROWS = 60, 24
"""Of a map drawn with letters; chosen: a terminal of 80 by 25."""
_SHADES = " .:+*#"
"""From no landmark to many."""


def show(options: argparse.Namespace) -> int:
    """A map in letters, and as a picture."""
    content = sources.read(options.file, options.floor)
    if options.box is not None:
        content = only(content, options.box.holds)
    s = statistics(content)
    (x0, x1), (y0, y1) = s["x_m"], s["y_m"]
    print(f"{options.file}: {s['landmarks']} landmarks, x {x0:.2f} to {x1:.2f} m, y {y0:.2f} to {y1:.2f} m")
    for line in in_letters(content.landmarks.xy_map_m):
        print(line)
    if options.png is not None:
        sources.write_picture(options.png, draw(content, f"{options.file.name} {content.floor}".strip()))
        print(f"{options.png}: picture written")
    return 0


def in_letters(xy_m: np.ndarray) -> list[str]:
    """Lines of text, north up: the denser the landmarks, the darker the letter."""
    if not len(xy_m):
        return []
    low, extent = xy_m.min(axis=0), np.maximum(np.ptp(xy_m, axis=0), 1e-3)
    step = max(extent[0] / _COLUMNS, 0.5 * extent[1] / _ROWS)  # a letter is twice as high as wide
    at = np.floor((xy_m - low) / np.array([step, 2.0 * step])).astype(np.int64)
    count = np.zeros(at.max(axis=0) + 1, np.int64)
    np.add.at(count, (at[:, 0], at[:, 1]), 1)
    shade = np.ceil(count / max(int(count.max()), 1) * (len(_SHADES) - 1)).astype(np.int64)
    return ["".join(_SHADES[s] for s in row).rstrip() for row in shade.T[::-1]]


def stats(options: argparse.Namespace) -> int:
    """Figures of a map."""
    s = statistics(sources.read(options.file, options.floor))
    size = options.file.stat().st_size
    s["file_bytes"] = size
    if sources.is_database(options.file):
        with open_map(options.file, options.floor) as db:
            s |= {"version": db.version, "hash": db.hash, "edits": len(db.history())}
    if options.json:
        print(json.dumps(s))
        return 0
    each = f", {size / s['landmarks']:.0f} bytes each" if s["landmarks"] else ""
    print(f"landmarks    {s['landmarks']}{each}")
    print(f"types        {', '.join(f'{n} {name}' for name, n in s['types'].items()) or 'none'}")
    print(f"extent       x {s['x_m'][0]:.2f} to {s['x_m'][1]:.2f} m, y {s['y_m'][0]:.2f} to {s['y_m'][1]:.2f} m")
    print(f"area         {s['area_m2']:.0f} m2 with landmarks; axis {s['axis_deg']:.2f} deg")
    print(f"sigma        median {1e3 * s['sigma_median_m']:.1f} mm, largest {1e3 * s['sigma_largest_m']:.1f} mm")
    print(f"sightings    {s['sightings']} of {s['expected']} expected")
    print(f"seen         {_when(s['first_seen_s'])} to {_when(s['last_seen_s'])}")
    print(f"key poses    {s['key_poses']} with {s['key_pose_features']} features")
    for session in s["sessions"]:
        print(f"session      {_session(session)}")
    if "hash" in s:
        print(f"version      {s['version']}, hash {s['hash'][:12]}, {s['edits']} edits can be undone")
    return 0


def diff(options: argparse.Namespace) -> int:
    """What is in one map and not in the other, and what moved."""
    a, b = sources.read(options.a, options.floor), sources.read(options.b, options.floor)
    theirs = in_axes_of(b, a.axis_rad)
    by_id = have_same_ids(a.landmarks, theirs) if options.by is None else options.by == "id"
    m = matches_by_id(a.landmarks, theirs) if by_id else matches_by_place(a.landmarks, theirs)
    moved = m.moved(options.sigmas)
    off = np.hypot(*(a.landmarks.xy_map_m[m.a] - theirs.xy_map_m[m.b]).T)
    how = "their ids" if by_id else "their places and types"
    print(f"landmarks    {len(a.landmarks)} and {len(b.landmarks)}, compared by {how}")
    print(f"added        {len(m.only_b)}")
    print(f"removed      {len(m.only_a)}")
    far = f", up to {1e3 * float(np.max(off[moved])):.1f} mm" if np.any(moved) else ""
    print(f"moved        {int(moved.sum())} by more than {options.sigmas:g} sigma{far}")
    print(f"the same     {int((~moved).sum())}")
    if options.png is not None:
        change = Change.of(a.landmarks, theirs, m, options.sigmas)
        sources.write_picture(options.png, draw(b, f"{options.a.name} to {options.b.name}", change))
        print(f"{options.png}: picture written")
    return 0


def history(options: argparse.Namespace) -> int:
    """What made the map: drives, and edits that can be undone, in their order."""
    with open_map(options.file, options.floor) as db:
        log, sessions = db.history(), db.content().sessions
    lines = [(s.begun_s, f"{_when(s.begun_s)}  drive  {_session(asdict(s))}") for s in sessions]
    for e in log:
        did = f"{e.landmarks} landmarks, {e.key_poses} key poses  {printable(e.what)}"
        lines.append((e.at_s, f"{_when(e.at_s)}  {did}"))
    for _, line in sorted(lines):
        print(line)
    if not log:
        print(f"{options.file}: no edits")
    return 0


def _session(s: dict[str, Any]) -> str:
    did = f"{s['added']} landmarks added, {s['faded']} faded, {s['refused']} refused"
    return f"{printable(s['name'])}: {_when(s['begun_s'])} to {_when(s['last_s'])}, {s['saves']} saves, {did}"


def export(options: argparse.Namespace) -> int:
    """A map as files of other kinds."""
    wanted: dict[str, Path | None] = {k: getattr(options, k) for k in ("json", "geojson", "png", "map_json")}
    if not any(wanted.values()):
        raise CeilvoError("nothing to export: give --json, --geojson, --png or --map-json, or several of them")
    content = sources.read(options.file, options.floor)
    if wanted["json"]:
        sources.write_file(wanted["json"], to_json(content))
    if wanted["geojson"]:
        sources.write_file(wanted["geojson"], to_geojson(content))
    if wanted["png"]:
        sources.write_picture(wanted["png"], draw(content, f"{options.file.name} {content.floor}".strip()))
    if wanted["map_json"]:
        save_map(wanted["map_json"], content.landmarks, content.axis_rad)
    for path in wanted.values():
        if path:
            print(f"{path}: written, {path.stat().st_size} bytes, {len(content.landmarks)} landmarks")
    return 0


def _when(at_s: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(at_s)) if at_s > 0.0 else "unknown"
