"""README and docs say what is true: links resolve, commands, options, keys and files exist."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest
import yaml

from ceilvo.calib import cli as calib_cli
from ceilvo.config import Config
from ceilvo.config.reader import load_config
from ceilvo.config.schema import SECTIONS
from ceilvo.daemon import cli as daemon_cli

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$|((?:^ {4}\S.*\n)+)", re.M | re.S)
INLINE = re.compile(r"`([^`\n]+)`")
FOLDERS = "ceilvo|daemon|drivers|calib|sim|bench|systemd|tests|docs"
MAINS = {"ceilvod": daemon_cli.main, "calib": calib_cli.main}

pages = pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)


def prose(page: Path) -> str:
    return re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)


def snippets(page: Path) -> list[str]:
    """Lines of code blocks and pieces of inline code; comments dropped."""
    text = page.read_text(encoding="utf-8")
    lines = [line for m in BLOCK.finditer(text) for line in (m[2] or m[3]).splitlines()]
    return [line.split("  #")[0].strip() for line in lines] + INLINE.findall(prose(page))


def anchors(page: Path) -> set[str]:
    titles = re.findall(r"^#+ (.*)$", prose(page), re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def planned() -> set[str]:
    """Commands of calib that the README names as not there yet."""
    line = re.search(r"^Not there yet: (.*?)\. ", (ROOT / "README.md").read_text(encoding="utf-8"), re.M | re.S)
    return set(re.findall(r"`calib (\w+)`", line[1])) if line else set()


def help_of(program: str, command: str, capsys: pytest.CaptureFixture[str]) -> str | None:
    """The help text, or None when there is no such command."""
    with pytest.raises(SystemExit) as end:
        MAINS[program]([*command.split(), "--help"])
    text = capsys.readouterr().out
    return text if end.value.code == 0 else None


@pages
def test_links_resolve(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name}: {target}"
        assert not anchor or anchor in anchors(file), f"{page.name}: no heading for {target}"


@pages
def test_commands_and_their_options_exist(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for snippet in snippets(page):
        found = re.match(r"(ceilvod|calib) ([a-z][\w-]*)(.*)", snippet)
        if not found or (found[1] == "calib" and found[2] in planned()):
            continue
        text = help_of(found[1], found[2], capsys)
        assert text is not None, f"{page.name}: {snippet}"
        words, rest = found[2], found[3]
        while (below := re.match(r" ([a-z]\w*)\b(.*)", rest)) and f"{{{below[1]}" in re.sub("[,}]", "{", text):
            words, rest = f"{words} {below[1]}", below[2]
            text = help_of(found[1], words, capsys) or text
        for option in re.findall(r"--[\w-]+", found[3]):
            assert option in text, f"{page.name}: {snippet}: {option}"


def test_what_is_said_to_be_missing_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    assert not planned() or "Not there yet" in (ROOT / "README.md").read_text(encoding="utf-8")
    for command in sorted(planned()):
        assert help_of("calib", command, capsys) is None, f"README.md: calib {command} is there by now"


@pages
def test_make_targets_exist(page: Path) -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
    for snippet in snippets(page):
        found = re.match(r"make ([a-z][\w-]*)", snippet)
        assert not found or found[1] in targets, f"{page.name}: {snippet}"


@pages
def test_modules_that_are_run_exist(page: Path) -> None:
    for name, rest in re.findall(r"python -m (ceilvo[\w.]*)(.*)", page.read_text(encoding="utf-8")):
        package = importlib.util.find_spec(name)
        is_package = package is not None and package.submodule_search_locations is not None
        spec = importlib.util.find_spec(f"{name}.__main__") if is_package else package
        assert spec is not None and spec.origin is not None, f"{page.name}: python -m {name}"
        origin = Path(spec.origin)
        parts = [origin, origin.with_name("command.py")] if is_package else [origin]
        source = "".join(p.read_text(encoding="utf-8") for p in parts if p.exists())
        for option in re.findall(r"--[\w-]+", re.split(r"[`#]", rest)[0]):
            assert option in source or option == "--help", f"{page.name}: {name} {option}"


@pages
def test_files_named_exist(page: Path) -> None:
    for snippet in INLINE.findall(prose(page)):
        if re.fullmatch(rf"({FOLDERS})/[\w/-]+\.\w+", snippet):
            assert (ROOT / snippet).exists(), f"{page.name}: {snippet}"


@pages
def test_keys_named_exist(page: Path) -> None:
    """`section.key` is a key of config.yaml, or of the calibration, which has a camera section, too."""
    suffixes = "yaml|json|jsonl|py|md|service|db"
    calibration_camera = {"id", "kind", "fx_px", "fy_px", "cx_px", "cy_px", "distortion", "readout_s"}
    for snippet in INLINE.findall(prose(page)) + re.findall(r"--set (\S+)", page.read_text(encoding="utf-8")):
        found = re.match(rf"({'|'.join(SECTIONS)})\.(?!(?:{suffixes})$)([a-z]\w*)(?=$|[:=\s])", snippet)
        if found and not (found[1] == "camera" and found[2] in calibration_camera):
            assert hasattr(getattr(Config(), found[1]), found[2]), f"{page.name}: {snippet}"


@pages
def test_configurations_shown_are_valid(page: Path, tmp_path: Path) -> None:
    for found in BLOCK.finditer(page.read_text(encoding="utf-8")):
        content = yaml.safe_load(found[2]) if found[1] == "yaml" else None
        if isinstance(content, dict) and set(content) <= set(SECTIONS):
            file = tmp_path / "config.yaml"
            file.write_text(found[2], encoding="utf-8")
            load_config(file)


@pages
def test_no_paths_of_one_machine(page: Path) -> None:
    assert not re.findall(r"(?<![\w.])/(?:work|home/\w+|root)/\S*", page.read_text(encoding="utf-8")), page.name


def test_index_lists_every_page() -> None:
    listed = set(re.findall(r"\]\(([\w-]+\.md)\)", (ROOT / "docs" / "README.md").read_text(encoding="utf-8")))
    assert listed == {p.name for p in PAGES if p.parent.name == "docs"} - {"README.md"}


def test_pictures_are_small() -> None:
    pictures = [p for p in (ROOT / "docs" / "images").iterdir() if p.suffix in {".png", ".jpg"}]
    assert pictures
    for picture in pictures:
        assert picture.stat().st_size < 400_000, picture.name
