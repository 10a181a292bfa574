"""`ceilvod replay` of a folder with several runs: each by itself, by as many workers as there are."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ceilvo.daemon.replay.replay import Outputs
from ceilvo.daemon.replay.rerun import Rerun, replayed, runs_in
from ceilvo.daemon.replay.trajectory import Alignment
from ceilvo.errors import CeilvoError
from ceilvo.files import write_atomic
from ceilvo.tasks.workers import Workers, each, progress


@dataclass(frozen=True)
class _Task:
    """One run, and which results are wanted of it."""

    run: Rerun
    wanted: Outputs
    reference: Path | None
    align: Alignment


@dataclass(frozen=True)
class _Done:
    """What was printed, the exit code, and the files that were written, by their path below a folder."""

    text: str
    code: int
    files: dict[str, bytes]


def replay_runs(run: Rerun, outputs: Outputs, reference: Path | None, align: Alignment, workers: Workers) -> int:
    """Every run of a folder; the exit code: the largest of theirs.

    Results of a run go beside those that one would have: poses.tum becomes poses-NAME.tum, NAME that of its first file.
    """
    runs = [replace(run, source=files[0].resolve(), files=_absolute(files)) for files in runs_in(run.source)]
    tasks = [_Task(r, outputs, None if reference is None else reference.resolve(), align) for r in runs]
    codes, tick = [0] * len(tasks), progress("runs", len(tasks))
    texts: dict[int, str] = {}
    for k, done in each(_replayed, tasks, workers):
        codes[k], texts[k] = done.code, done.text
        _write(done.files, outputs, runs[k].source.stem)
        tick()
    for k in sorted(texts):
        sys.stdout.write(f"{runs[k].source.name}\n{texts[k]}")
    return max(codes)


def _absolute(files: Sequence[Path]) -> tuple[Path, ...]:
    return tuple(f.resolve() for f in files)


def _replayed(task: _Task) -> _Done:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        wanted = Outputs(
            tum=task.wanted.tum and folder / "tum",
            jsonl=task.wanted.jsonl and folder / "jsonl",
            pictures=task.wanted.pictures and folder / "pictures",
            picture_every=task.wanted.picture_every,
        )
        text, code = replayed(task.run, wanted, task.reference, task.align)
        files = {f.relative_to(folder).as_posix(): f.read_bytes() for f in folder.rglob("*") if f.is_file()}
    return _Done(text, code, files)


def _write(files: dict[str, bytes], outputs: Outputs, name: str) -> None:
    for path, data in files.items():
        what, _, rest = path.partition("/")
        base: Path = getattr(outputs, what)
        target = base / name / rest if rest else base.with_stem(f"{base.stem}-{name}")
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(target, data)
        except OSError as e:
            raise CeilvoError(f"{target}: cannot be written: {e.strerror}; check its folder and the disk") from e
