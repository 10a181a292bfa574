"""The ceilvod command."""

from __future__ import annotations

import argparse
import logging
import math
import os
import sys
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from ceilvo import __version__
from ceilvo.calibration import Calibration
from ceilvo.calibration_file import read_calibration
from ceilvo.config import Config
from ceilvo.config.arguments import check_word, command, from_up
from ceilvo.config.checks import cross_check
from ceilvo.config.reader import beside, calibration_path, load_config
from ceilvo.config.reader import replace as replace_keys
from ceilvo.daemon.app import process as app
from ceilvo.daemon.doctor import kernels
from ceilvo.errors import CeilvoError, ConfigError, FileFormatError

log = logging.getLogger("ceilvo")

if TYPE_CHECKING:
    from ceilvo.config.arguments import Commands

DEFAULT_CONFIG = Path("/etc/ceilvo/config.yaml")
DEFAULT_SUMMARY = Path("build/run-summary.json")
_MOST_TILT_DEG = 45.0
"""Of a simulated robot that rocks; chosen: one that leans further falls over."""
WRONG_USE = 2
"""Exit code of argparse, and ours, for words that are no command."""
BENCHES = {"paper": "paper", "mrclam": "mrclam", "speed": "speed.filter_step"}
"""What `ceilvod experiment` ran by the first word, now a module of ceilvo.bench."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns the exit code: 0 fine, 78 wrong configuration or calibration, 1 anything else, 2 wrong arguments."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    options = parser_of(words[:1]).parse_args(words)
    _log_to_stderr("info")
    try:
        return int(options.do(options))
    except CeilvoError as e:
        for line in getattr(e, "problems", None) or [str(e)]:
            print(f"ceilvod: {line}", file=sys.stderr)
        return e.exit_code
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def entry() -> NoReturn:
    """The command, to its end."""
    leave(main())


def leave(code: int) -> NoReturn:
    """End the process: a thread that is stuck in a driver or in C++ would abort a dying interpreter."""
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    if threading.active_count() > 1:
        os._exit(code)
    sys.exit(code)


def parser_of(first: Sequence[str]) -> argparse.ArgumentParser:
    """Of all commands; where the first word is a robot's own, of those alone: a restart need not wait for the rest."""
    parser = argparse.ArgumentParser(
        prog="ceilvod",
        description="Localisation of indoor robots that look at the ceiling.",
        epilog="example: ceilvod run --simulate --seconds 20",
    )
    parser.add_argument("--version", action="version", version=f"ceilvod {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_run(commands)
    _add_record(commands)
    if {*first} & {"run", "record"}:
        return parser
    from ceilvo.daemon.app.readers import command as readers
    from ceilvo.daemon.building import commands as building
    from ceilvo.daemon.editing import command as map_command
    from ceilvo.daemon.fleet import words as fleet_words

    _add_replay(commands)
    readers.add(commands, _config_options, _config)
    _add_check(commands)
    _add_doctor(commands)
    words = map_command.add(commands)
    fleet_words.add_to_map(words, _config_options)
    building.add(words, DEFAULT_CONFIG)
    fleet_words.add(commands, _config_options)
    _add_experiment(commands)
    check_word(parser, commands, first)
    return parser


def _config_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, metavar="FILE", help=f"configuration (default: {DEFAULT_CONFIG})")
    parser.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override one key; may be repeated"
    )


def _add_run(commands: Commands) -> None:
    p = command(commands, "run", "run the daemon", "ceilvod run --config config.yaml")
    _run_options(p)
    p.set_defaults(do=_run, record=None)


def _add_record(commands: Commands) -> None:
    p = command(
        commands,
        "record",
        "run the daemon and record all it sees and says, without loss",
        "ceilvod record drive.mcap --config config.yaml --seconds 60",
    )
    p.add_argument("record", type=Path, metavar="FILE", help="new MCAP file; 'ceilvod replay FILE' does it again")
    _run_options(p)
    p.set_defaults(do=_run)


def _run_options(p: argparse.ArgumentParser) -> None:
    _config_options(p)
    p.add_argument("--simulate", action="store_true", help="a rendered ceiling and a simulated robot; no hardware")
    p.add_argument("--seconds", type=_positive, metavar="S", help="end after S seconds of frames, with a summary")
    p.add_argument("--summary", type=Path, metavar="FILE", help=f"figures as JSON (simulating: {DEFAULT_SUMMARY})")
    p.add_argument("--seed", type=from_up(0), default=1, metavar="N", help="which simulated world (default: 1)")
    p.add_argument("--tilt-deg", type=_tilt, default=0.0, metavar="D", help="simulated rocking, at most (default: 0)")
    p.add_argument(
        "--calibration", type=Path, metavar="FILE", help="instead of the config's, or of the simulated truth"
    )


def _add_replay(commands: Commands) -> None:
    from ceilvo.tasks.workers import add_options

    p = command(
        commands,
        "replay",
        "run a recording through the pipeline, as fast as it goes",
        "ceilvod replay recording/ --calibration calibration.yaml --tum poses.tum --reference truth.tum",
    )
    p.add_argument(
        "source",
        type=Path,
        metavar="SOURCE",
        help="recording (MCAP file, or a folder of runs), image folder (frames.csv) or video file",
    )
    _config_options(p)
    p.add_argument("--calibration", type=Path, metavar="FILE", help="default: SOURCE/calibration.yaml or the config's")
    p.add_argument("--tum", type=Path, metavar="FILE", help="write the trajectory as 't x y z qx qy qz qw'")
    p.add_argument("--jsonl", type=Path, metavar="FILE", help="write every estimate as a JSON line")
    p.add_argument("--pictures", type=Path, metavar="DIR", help="draw what was seen, and the particles")
    p.add_argument(
        "--picture-every", type=from_up(1), default=10, metavar="N", help="a picture of every Nth frame (10)"
    )
    p.add_argument("--reference", type=Path, metavar="FILE", help="TUM trajectory to compare with")
    p.add_argument("--align", choices=("none", "first", "se2"), default="none", help="before comparing (none)")
    add_options(p)
    p.set_defaults(do=_replay)


def _add_check(commands: Commands) -> None:
    p = command(
        commands,
        "check-config",
        "check a configuration without starting",
        "ceilvod check-config /etc/ceilvo/config.yaml",
    )
    p.add_argument("file", type=Path, metavar="FILE")
    p.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override one key; may be repeated"
    )
    p.set_defaults(do=_check)


def _add_doctor(commands: Commands) -> None:
    p = command(
        commands,
        "doctor",
        "look at camera, base, bus, clock, disk and service, and say what to do",
        "ceilvod doctor --config /etc/ceilvo/config.yaml",
    )
    _config_options(p)
    p.add_argument("--json", action="store_true", help="the findings as JSON")
    p.set_defaults(do=_doctor)


def _add_experiment(commands: Commands) -> None:
    """Not listed: it only says where the benches have gone."""
    p = commands.add_parser("experiment", description=f"Moved: {_bench_command(*BENCHES)}.")
    p.add_argument("words", nargs=argparse.REMAINDER, metavar="...")
    p.set_defaults(do=_experiment)


def _bench_command(*names: str) -> str:
    return ", ".join(f"python -m ceilvo.bench.{BENCHES[name]}" for name in names)


# -- what they do


def _run(options: argparse.Namespace) -> int:
    if options.simulate:
        return _run_simulated(options)
    path = options.config or DEFAULT_CONFIG
    if options.config is None and not path.exists():
        raise ConfigError(
            f"{path}: no such file; name a configuration with --config FILE, or try it without any hardware: "
            "ceilvod run --simulate"
        )
    config = beside(load_config(path, options.set), path)
    file = options.calibration or calibration_path(config, path)
    calibration = _checked(config, read_calibration(file), path)
    _log_to_stderr(config.service.log_level)
    kernels.log_which(log)
    return app.run(app.plan_real(config, calibration, options.seconds, options.summary, options.record))


def _run_simulated(options: argparse.Namespace) -> int:
    from ceilvo.daemon.app.simulation import simulation  # a robot has no need of it

    config = _config(options)
    cross_check(config, None, "config")
    terminal = sys.stdout.isatty()
    _log_to_stderr("error" if terminal else config.service.log_level)
    kernels.log_which(log)
    believed = None if options.calibration is None else read_calibration(options.calibration)
    summary = options.summary or DEFAULT_SUMMARY
    tilt_rad = math.radians(options.tilt_deg)
    with simulation(config, options.seed, options.seconds, summary, believed, tilt_rad) as plan:
        return app.run(replace(plan, record=options.record))


def _replay(options: argparse.Namespace) -> int:
    from ceilvo.daemon.replay.command import check_source, replay_recording
    from ceilvo.daemon.replay.replay import Outputs
    from ceilvo.daemon.replay.rerun import Rerun, is_recording, replay_run, runs_in
    from ceilvo.daemon.replay.runs import replay_runs
    from ceilvo.tasks.workers import Workers

    if not options.source.exists():
        raise FileFormatError(f"{options.source}: no such recording, folder or video file")
    outputs = Outputs(options.tum, options.jsonl, options.pictures, options.picture_every)
    if is_recording(options.source):
        config = None if options.config is None else load_config(options.config, options.set)
        calibration = None if options.calibration is None else read_calibration(options.calibration)
        run, workers = Rerun(options.source, config, tuple(options.set), calibration), Workers.of(options)
        if len(runs_in(options.source)) > 1 or workers.scheduler:
            return replay_runs(run, outputs, options.reference, options.align, workers)
        return replay_run(run, outputs, options.reference, options.align)
    config = _config(options)
    check_source(options.source)
    calibration = read_calibration(_calibration_file(options, config))
    return replay_recording(options.source, config, calibration, outputs, options.reference, options.align)


def _check(options: argparse.Namespace) -> int:
    config = load_config(options.file, options.set)
    file = calibration_path(config, options.file)
    if file.exists():
        _checked(config, read_calibration(file), options.file)
        print(f"{options.file}: good, and {file} fits it")
    else:
        for note in cross_check(config, None, str(options.file)):
            print(f"{options.file}: note: {note}")
        print(f"{options.file}: good; {file} is not there yet, 'calib' writes it")
    return 0


def _doctor(options: argparse.Namespace) -> int:
    from ceilvo.daemon.doctor.examination import examine

    return examine(options.config or DEFAULT_CONFIG, tuple(options.set), options.json)


def _experiment(options: argparse.Namespace) -> int:
    name = next(iter(options.words), "")
    print(f"ceilvod: experiment is now {_bench_command(*([name] if name in BENCHES else BENCHES))}", file=sys.stderr)
    return WRONG_USE


def _config(options: argparse.Namespace) -> Config:
    """The file that was named, else the defaults: simulations, replays and watching need none."""
    if options.config is not None:
        return load_config(options.config, options.set)
    return replace_keys(Config(), options.set)


def _checked(config: Config, calibration: Calibration, path: Path) -> Calibration:
    for note in cross_check(config, calibration, str(path)):
        log.info("%s: note: %s", path, note)
    return calibration


def _calibration_file(options: argparse.Namespace, config: Config) -> Path:
    if options.calibration is not None:
        return Path(options.calibration)
    beside = (
        options.source / "calibration.yaml" if options.source.is_dir() else options.source.parent / "calibration.yaml"
    )
    if beside.exists() or options.config is None:
        return Path(beside)
    return calibration_path(config, options.config)


def _log_to_stderr(level: str) -> None:
    """Plain lines; under systemd with the priority that journald understands."""
    handler = logging.StreamHandler(sys.stderr)
    under_systemd = "JOURNAL_STREAM" in os.environ
    handler.setFormatter(_Priority() if under_systemd else logging.Formatter("%(asctime)s %(levelname)-7s %(message)s"))
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    logging.getLogger("pymodbus").setLevel(logging.CRITICAL)


class _Priority(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        priority = 3 if record.levelno >= logging.ERROR else 4 if record.levelno >= logging.WARNING else 6
        return "\n".join(f"<{priority}>{line}" for line in super().format(record).splitlines())


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"{text}: expected seconds above 0")
    return value


def _tilt(text: str) -> float:
    value = float(text)
    if not 0.0 <= value <= _MOST_TILT_DEG:
        raise argparse.ArgumentTypeError(f"{text}: expected 0 to {_MOST_TILT_DEG:g} deg")
    return value


if __name__ == "__main__":
    entry()
