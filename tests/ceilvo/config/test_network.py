"""Which configurations need the network: the installer asks."""

from pathlib import Path

import pytest

from ceilvo.config.network import answer


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("", 1),
        ("zenoh: {listen: [tcp/127.0.0.1:7447], connect: ['tcp/[::1]:7448']}", 1),
        ("zenoh: {listen: [tcp/0.0.0.0:7447]}", 0),
        ("zenoh: {connect: [tls/router.example:7447]}", 0),
        ("zenoh: {config_file: /etc/ceilvo/zenoh.json5}", 0),
        ("zenoh: {enabled: false, listen: [tcp/0.0.0.0:7447]}", 1),
        ("zenoh: {listen: 7}", 1),
    ],
)
def test_what_needs_the_network(tmp_path: Path, text: str, code: int) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(text)
    assert answer(file) == code


def test_a_file_that_is_not_there_needs_none(tmp_path: Path) -> None:
    assert answer(tmp_path / "none.yaml") == 1


@pytest.mark.parametrize(("host", "code"), [("localhost", 1), ("'::1'", 1), ("0.0.0.0", 0), ("'::'", 0)])
def test_pages_for_other_computers_need_it_and_the_daemon_does_not(tmp_path: Path, host: str, code: int) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(f"web: {{host: {host}, token_file: /t, behind_proxy: true}}")
    assert (answer(file, "web"), answer(file)) == (code, 1)
