"""Errors of ceilvo.

    CeilvoError
    ├── ConfigError        a configuration file or key is wrong           exit 78
    ├── CalibrationError   a calibration file is wrong or does not fit    exit 78
    ├── CameraError        the camera is absent, lost or cannot do what was asked
    │   └── BadFrameError  one frame cannot be used, the camera is still there
    ├── BaseLinkError      the base controller does not answer as it should
    ├── BusError           Zenoh cannot be used as configured
    └── FileFormatError    a recording, map or state file cannot be used

A message is one line: what (file, key or device), the value found, what was expected, what to do.
A failed estimate is not an error but a status in the result.
"""

_CHARS = 120
"""Of what a message repeats; chosen: it stays one line."""


def printable(text: str) -> str:
    """With a question mark for what would steer a terminal."""
    return "".join(c if c.isprintable() else "?" for c in text)


def one_line(text: object, most: int = _CHARS) -> str:
    """What somebody else wrote, fit for a message: on one line, printable, not long."""
    line = printable(" ".join(str(text).split()))
    return line if len(line) <= most else line[: most - 3] + "..."


EXIT_CONFIG = 78
"""EX_CONFIG of sysexits.h: systemd must not restart after it."""


class CeilvoError(Exception):
    """Root of all errors that ceilvo raises on purpose."""

    exit_code = 1


class _FileError(CeilvoError):
    """One line a problem; `problems` has them apart."""

    exit_code = EXIT_CONFIG

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


class ConfigError(_FileError):
    pass


class CalibrationError(_FileError):
    pass


class CameraError(CeilvoError):
    pass


class BadFrameError(CameraError):
    pass


class BaseLinkError(CeilvoError):
    pass


class RangingError(CeilvoError):
    pass


class BusError(CeilvoError):
    pass


class FileFormatError(CeilvoError):
    pass
