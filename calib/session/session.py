"""The commissioning session: a folder with every sample taken and every step's result, so that work can be resumed.

    SESSION/
      intrinsics.samples.jsonl   one accepted sample a line, the first line says what they are samples of
      intrinsics/                pictures of the step
      intrinsics.json            the step's result
      calibration.yaml           put together from the results, as soon as there are enough of them

Results are written whole or not at all; one that is there is replaced only by force, and kept as .bak.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ceilvo.errors import CalibrationError, one_line
from ceilvo.files import write_atomic
from ceilvo.json_values import json_value

STEPS = ("intrinsics", "projection", "mount", "sigma", "survey", "check")
CALIBRATION = "calibration.yaml"


class Session:
    """One commissioning in one folder, which is made on the first write.

    Every write raises CalibrationError when the disk refuses; what was there before stays.
    """

    def __init__(self, folder: Path, *, force: bool = False) -> None:
        self.folder = folder
        self.force = force

    @property
    def calibration_file(self) -> Path:
        return self.folder / CALIBRATION

    def result(self, step: str) -> dict[str, Any] | None:
        """The step's result, None when it has not been done.

        Raises:
            CalibrationError: the file is damaged.
        """
        path = self.folder / f"{step}.json"
        try:
            value = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, RecursionError) as e:
            raise CalibrationError(
                f"{path}: cannot be read ({one_line(e)}); run 'calib {step}' again with --force"
            ) from None
        if not isinstance(value, dict):
            raise CalibrationError(f"{path}: found no result in it; run 'calib {step}' again with --force")
        return value

    def need(self, step: str, reason: str) -> dict[str, Any]:
        """The step's result, which must be there."""
        result = self.result(step)
        if result is None:
            raise CalibrationError(
                f"{self.folder}: found no result of '{step}', {reason} needs it; run 'calib {step}' first"
            )
        return result

    def begin(self, step: str) -> None:
        """Refuse a step that has its result already, unless forced; then the samples of that result are put aside."""
        if self.result_there(step):
            if not self.force:
                raise CalibrationError(
                    f"{self.folder / step}.json: found the result of an earlier run, expected none; "
                    "pass --force to do the step again (the old result is kept as .bak)"
                )
            self.set_aside(step)

    def result_there(self, step: str) -> bool:
        return (self.folder / f"{step}.json").exists()

    def save(self, step: str, result: Mapping[str, Any]) -> Path:
        """Write a step's result; one that was there is kept as .bak."""
        path = self.folder / f"{step}.json"
        with self._writing(path):
            self.folder.mkdir(parents=True, exist_ok=True)
            if path.exists():
                write_atomic(path.with_name(path.name + ".bak"), path.read_bytes())
            write_atomic(path, json.dumps(json_value(result), indent=1, allow_nan=False) + "\n")
        return path

    def write(self, name: str, data: bytes | str) -> Path:
        """A picture or a table that goes with a result."""
        path = self.folder / name
        with self._writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(path, data)
        return path

    # -- samples

    def samples(self, step: str, subject: Mapping[str, Any]) -> list[dict[str, Any]]:
        """Samples of an interrupted run, in order; [] at the start.

        Args:
            subject: what the samples are of (board, camera, source); it must be that of the earlier run.

        Raises:
            CalibrationError: the earlier run was of something else, and no force.
        """
        path = self._samples_file(step)
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except FileNotFoundError:
            lines = []
        except (OSError, ValueError) as e:
            raise CalibrationError(f"{path}: cannot be read ({one_line(e)}); pass --force to start again") from None
        records = list(_whole_lines(lines))
        wanted = json_value(subject)
        if records and records[0] == wanted:
            return records[1:]
        if len(records) > 1 and not self.force:
            differs = [k for k in wanted if records[0].get(k) != wanted[k]]
            raise CalibrationError(
                f"{path}: found samples of another {' and '.join(differs) or 'kind'} "
                f"({', '.join(one_line(records[0].get(k)) for k in differs)}), expected "
                f"{', '.join(str(wanted[k]) for k in differs)}; go on as before, or pass --force to start again"
            )
        self.set_aside(step)
        self._append(path, wanted)
        return []

    @contextmanager
    def reading_samples(self, step: str) -> Iterator[None]:
        """Around the use of a step's samples."""
        with reading(self._samples_file(step)):
            yield

    def add_sample(self, step: str, sample: Mapping[str, Any]) -> None:
        """Kept on disk before anything else happens to it."""
        self._append(self._samples_file(step), json_value(sample))

    def drop_sample(self, step: str, index: int) -> None:
        """Take one of the accepted samples out again.

        Raises:
            CalibrationError: there is none at that place in their order.
        """
        path = self._samples_file(step)
        records = self.sample_lines(step)
        if not 0 <= index < len(records) - 1:
            raise CalibrationError(f"{path}: found {max(0, len(records) - 1)} samples, expected one at {index}")
        del records[index + 1]
        with self._writing(path):
            write_atomic(path, "".join(json.dumps(record, allow_nan=False) + "\n" for record in records))

    def sample_lines(self, step: str) -> list[dict[str, Any]]:
        """What the samples are of, then the samples; [] where there are none or they cannot be read."""
        try:
            return list(_whole_lines(self._samples_file(step).read_text(encoding="utf-8").splitlines()))
        except (OSError, ValueError):
            return []

    def samples_age_s(self, step: str) -> float:
        """Since the last sample; infinite when there is none."""
        try:
            return time.time() - self._samples_file(step).stat().st_mtime
        except OSError:
            return float("inf")

    def log(self, name: str, record: Mapping[str, Any]) -> None:
        """A line more in a file of which nothing is ever taken away."""
        self._append(self.folder / f"{name}.jsonl", json_value(record))

    def set_aside(self, step: str) -> None:
        """Keep the samples so far as .bak and start without."""
        path = self._samples_file(step)
        if path.exists():
            with self._writing(path):
                path.replace(path.with_name(path.name + ".bak"))

    def _samples_file(self, step: str) -> Path:
        return self.folder / f"{step}.samples.jsonl"

    def _append(self, path: Path, record: Any) -> None:
        with self._writing(path):
            self.folder.mkdir(parents=True, exist_ok=True)
            whole = path.exists() and path.stat().st_size > 0 and not path.read_bytes().endswith(b"\n")
            with path.open("a", encoding="utf-8") as f:
                f.write(("\n" if whole else "") + json.dumps(record, allow_nan=False) + "\n")
                f.flush()
                os.fsync(f.fileno())

    @contextmanager
    def _writing(self, path: Path) -> Iterator[None]:
        try:
            yield
        except OSError as e:
            raise CalibrationError(
                f"{path}: cannot be written ({e.strerror}); what was taken so far is kept in {self.folder}: make room "
                "or check its rights, then run the same command to go on"
            ) from None


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Around the use of what a session's file or folder says: what is not as calib wrote it is a CalibrationError."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as e:
        raise CalibrationError(
            f"{path}: damaged ({type(e).__name__} {one_line(e)}); run the step again with --force"
        ) from None


def _whole_lines(lines: list[str]) -> Iterator[dict[str, Any]]:
    """Records; a line that was cut short by a crash is left out."""
    for line in lines:
        try:
            value = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(value, dict):
            yield value
