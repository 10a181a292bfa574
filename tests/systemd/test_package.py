"""The Debian package without building it: its scripts, its manual pages and completion, and what removes what."""

from __future__ import annotations

import argparse
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from installer import INSTALL, REPO, as_root, run_installer

DEB = REPO / "packaging" / "deb"
SCRIPTS = [DEB / name for name in ("preinst", "postinst", "prerm", "postrm")]


def manual() -> ModuleType:
    path = REPO / "packaging" / "manual.py"
    spec = importlib.util.spec_from_file_location("manual", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("manual")
    env = os.environ | {"SOURCE_DATE_EPOCH": "1700000000"}
    subprocess.run([sys.executable, str(REPO / "packaging" / "manual.py"), str(folder)], check=True, env=env)
    return folder


# --- maintainer scripts


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.name)
def test_maintainer_scripts_are_plain_shell_and_stop_at_the_first_error(script: Path) -> None:
    lines = script.read_text().splitlines()
    assert lines[:2] == ["#!/bin/sh", "set -e"]
    subprocess.run(["sh", "-n", str(script)], check=True)
    if shutil.which("shellcheck"):
        done = subprocess.run(["shellcheck", str(script)], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout


def run_script(name: str, *words: str, tmp_path: Path) -> tuple[str, list[str]]:
    """Run in a world of stand-ins that write down how they are called; below a root that no path leaves."""
    bin_, log, root = tmp_path / "bin", tmp_path / "log", tmp_path / "root"
    bin_.mkdir(exist_ok=True)
    log.write_text("")
    for command in (
        "systemctl",
        "systemd-sysusers",
        "deb-systemd-helper",
        "deb-systemd-invoke",
        "udevadm",
        "userdel",
        "bash",
        "chown",
    ):
        (bin_ / command).write_text(f'#!/bin/sh\necho {command} "$@" >>{log}\n')
        (bin_ / command).chmod(0o755)
    (bin_ / "getent").write_text("#!/bin/sh\n")
    (bin_ / "getent").chmod(0o755)
    (bin_ / "install").write_text(f'#!/bin/sh\necho install "$@" >>{log}\n')
    (bin_ / "install").chmod(0o755)
    (root / "run/systemd/system").mkdir(parents=True, exist_ok=True)
    script = re.sub(r"(?<![\w.])/(etc|var|opt|run|usr/lib/ceilvo)/", rf"{root}/\1/", (DEB / name).read_text())
    (tmp_path / name).write_text(script)
    done = subprocess.run(
        ["sh", str(tmp_path / name), *words], capture_output=True, text=True, env={"PATH": f"{bin_}:/usr/bin:/bin"}
    )
    return f"{done.returncode} {done.stderr}", log.read_text().splitlines()


def test_purge_leaves_nothing_and_removal_all_that_is_the_robots(tmp_path: Path) -> None:
    root = tmp_path / "root"
    mine = [
        root / p
        for p in (
            "etc/ceilvo/config.yaml",
            "etc/ceilvo/calibration.yaml",
            "var/lib/ceilvo/map.db",
            "var/lib/ceilvo-web/x",
        )
    ]
    drop_in = root / "etc/systemd/system/ceilvod.service.d/10-network.conf"
    own = root / "etc/systemd/system/ceilvo-web.service.d/own.conf"
    for path in (*mine, drop_in, own):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("mine")
    said, log = run_script("postrm", "remove", tmp_path=tmp_path)
    assert said == "0 " and all(p.exists() for p in (*mine, drop_in)) and not any("userdel" in line for line in log)
    said, log = run_script("postrm", "purge", tmp_path=tmp_path)
    assert said == "0 "
    assert not any(p.parent.exists() for p in (*mine, drop_in)) and own.exists()
    assert [line for line in log if line.startswith("userdel")] == [
        f"userdel {u}" for u in ("ceilvo-web", "ceilvo-mapd", "ceilvo")
    ]


def test_an_upgrade_restarts_what_runs_and_starts_nothing(tmp_path: Path) -> None:
    for words in (("configure", ""), ("configure", "0.1.0-1")):
        said, log = run_script("postinst", *words, tmp_path=tmp_path)
        assert said == "0 "
        assert not any(re.search(r"\b(start|restart)\b", line.replace("try-restart", "")) for line in log), log
        assert sum("try-restart" in line for line in log) == 3 and any("network.sh" in line for line in log)
    said, log = run_script("prerm", "upgrade", "0.1.0-2", tmp_path=tmp_path)
    assert said == "0 " and log == []
    _, log = run_script("prerm", "remove", tmp_path=tmp_path)
    units = ("ceilvod", "ceilvo-web", "ceilvo-mapd", "ceilvo-modules")
    stopped = [*(f"{name}.service" for name in units), "ceilvo-pictures.socket"]
    assert log == ["deb-systemd-invoke stop " + " ".join(stopped)]


def test_it_is_not_installed_over_the_installers_copy(tmp_path: Path) -> None:
    assert run_script("preinst", "install", tmp_path=tmp_path)[0] == "0 "
    other = tmp_path / "root/opt/ceilvo/share/ceilvo/install.sh"
    other.parent.mkdir(parents=True)
    other.write_text("")
    said, _ = run_script("preinst", "install", tmp_path=tmp_path)
    assert said.startswith("1 ") and "uninstall" in said and "configuration, calibration and map are kept" in said


def test_every_override_of_lintian_has_its_reason() -> None:
    lines = (DEB / "lintian-overrides").read_text().splitlines()
    assert lines
    for before, line in zip(["", *lines], lines, strict=False):
        assert line.startswith("# ") or (line.startswith("ceilvo: ") and before.startswith("# "))


# --- the installer, staged for the package


@as_root
def test_units_staged_for_a_package_name_the_programs_place(kit: Path, tmp_path: Path, python: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    options = ("--wheel", str(kit / "ceilvo-9.9.9-py3-none-any.whl"), "--no-deps", "--app", "/usr/lib/ceilvo", "--web")
    done = run_installer(kit, root, *options, python=python)
    assert done.returncode == 0, done.stderr
    for name in ("ceilvod", "ceilvo-web"):
        unit = (root / f"etc/systemd/system/{name}.service").read_text()
        assert unit == (REPO / f"systemd/{name}.service").read_text().replace("/opt/ceilvo/", "/usr/lib/ceilvo/")
        assert "ExecStart=/usr/lib/ceilvo/bin/ceilvod " in unit
    assert (root / "usr/lib/ceilvo/bin/ceilvod").read_text().startswith("#!/usr/lib/ceilvo/bin/python")
    assert not (root / "opt").exists()
    alone = subprocess.run(["bash", str(INSTALL), "--app", "/usr/lib/x"], capture_output=True, text=True)
    assert alone.returncode == 1 and "--app goes with --root" in alone.stderr


# --- manual pages and completion


@pytest.mark.parametrize("program", ["ceilvod", "calib"])
def test_a_manual_page_has_every_command_and_option(told: Path, program: str) -> None:
    page = (told / f"{program}.1").read_text()
    plain = page.replace("\\-", "-")
    m = manual()
    for words, parser in m.tree(m.PROGRAMS[program](())):
        if words and not m.commands(parser):
            assert f".SS {program} {' '.join(words)}\n" in page
        for action in m.options(parser):
            assert all(option in plain for option in action.option_strings if option != "--help")
    assert f'.TH {program.upper()} 1 "2023-11-14"' in page
    assert all(s in page for s in (".SH NAME", ".SH SYNOPSIS", ".SH FILES", ".SH EXIT STATUS"))
    if shutil.which("groff"):
        done = subprocess.run(
            ["groff", "-man", "-Tascii", "-ww", "-z", str(told / f"{program}.1")], capture_output=True, text=True
        )
        assert (done.returncode, done.stderr) == (0, "")


def test_a_help_text_that_roff_would_take_for_its_own_is_shown(tmp_path: Path) -> None:
    m = manual()
    parser = argparse.ArgumentParser("calib", description=".TH is not a word of mine; 'a\\b'")
    commands = parser.add_subparsers()
    commands.add_parser("x", help="y", description="'quoted").add_argument("--of", help="100 %% of it")
    page = m.page("calib", parser, "2026-01-01")
    lines = page.splitlines()
    assert "\\&.TH is not a word of mine; 'a\\eb'" in lines and "\\&'quoted" in lines and "100 % of it" in lines


def completed(told: Path, *words: str) -> list[str]:
    """What bash offers for the last word."""
    program = words[0]
    script = f'. "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _{program}; printf "%s\\n" "${{COMPREPLY[@]}}"'
    done = subprocess.run(
        ["bash", "-uc", script, "-", str(told / f"{program}.bash"), *words], capture_output=True, text=True, cwd=told
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.split()


def test_bash_completes_commands_options_choices_and_files(told: Path) -> None:
    assert completed(told, "ceilvod", "re") == ["record", "replay"]
    assert completed(told, "ceilvod", "map", "tran") == ["transition"]
    assert "--simulate" in completed(told, "ceilvod", "run", "--")
    assert completed(told, "ceilvod", "replay", "--align", "") == ["none", "first", "se2"]
    assert completed(told, "calib", "board", "--paper", "") == ["A4", "A3", "Letter"]
    assert completed(told, "ceilvod", "run", "--config", "cal") == ["calib.1", "calib.bash"]
    assert completed(told, "ceilvod", "run", "--seconds", "") == []
    assert completed(told, "ceilvod", "replay", "ceil") == ["ceilvod.1", "ceilvod.bash"]


# --- the container


def container() -> list[tuple[str, str]]:
    """Instruction and the rest of each line of the container's recipe."""
    text = re.sub(r"\\\n", " ", (REPO / "packaging" / "Containerfile").read_text())
    return [(m[1], m[2]) for m in re.finditer(r"^([A-Z]+) (.*)$", text, re.M)]


def test_the_containers_recipe_is_understood_and_runs_what_the_unit_runs() -> None:
    lines = container()
    text = (REPO / "packaging" / "Containerfile").read_text()
    assert len(lines) == len([n for n in re.sub(r"\\\n", " ", text).splitlines() if n and not n.startswith("#")])
    known = {"ARG", "FROM", "RUN", "COPY", "ENV", "VOLUME", "USER", "WORKDIR", "STOPSIGNAL", "ENTRYPOINT", "CMD"}
    assert {word for word, _ in lines} <= known
    last = dict(lines)
    run = [*re.findall(r'"([^"]+)"', last["ENTRYPOINT"]), *re.findall(r'"([^"]+)"', last["CMD"])]
    unit = re.search(r"^ExecStart=/opt/ceilvo/bin/(.*)$", (REPO / "systemd/ceilvod.service").read_text(), re.M)
    assert unit is not None and " ".join(run) == unit[1]
    assert last["USER"] == "ceilvo" and "/opt/ceilvo /opt/ceilvo" in last["COPY"]
    for command in re.findall(r"^RUN (.*)$", re.sub(r"\\\n", " ", text), re.M):
        subprocess.run(["bash", "-n", "-c", command], check=True)


def test_the_documents_build_and_run_the_container_so() -> None:
    page = (REPO / "docs" / "service.md").read_text()
    assert "podman build -f packaging/Containerfile -t ceilvo ." in page
    for needed in ("--device /dev/video0", "--device /dev/ttyUSB0", "/etc/ceilvo", "/var/lib/ceilvo"):
        assert needed in page[page.index("podman run") :]
    assert "podman build -f packaging/Containerfile" in (REPO / "README.md").read_text()
