"""What the installed service may reach."""

from __future__ import annotations

from pathlib import Path

from installer import MAPD_UNIT, WEB_UNIT, as_root, run_installer, unit_settings


@as_root
def test_the_unit_has_the_network_only_where_the_configuration_needs_it(
    kit: Path, tmp_path: Path, python: Path
) -> None:
    root = tmp_path / "root"
    config, drop_in = root / "etc/ceilvo/config.yaml", root / "etc/systemd/system/ceilvod.service.d/10-network.conf"
    config.parent.mkdir(parents=True)
    options = ("--wheel", str(kit / "ceilvo-9.9.9-py3-none-any.whl"), "--no-deps")
    for text, network in (("a: 1", False), ("listen: tcp/0.0.0.0:7447", True), ("a: 1", False)):
        config.write_text(text)
        done = run_installer(kit, root, *options, python=python)
        assert done.returncode == 0, done.stderr
        assert ("needs the network" in done.stdout) == network == drop_in.exists()
        assert drop_in.parent.exists() == network
        assert not network or "RestrictAddressFamilies=AF_NETLINK\n" in drop_in.read_text()
    assert unit_settings()["IPAddressDeny"] == ["any"]
    assert unit_settings()["IPAddressAllow"] == ["localhost"]


@as_root
def test_a_fleets_map_service_comes_when_asked_for_stays_with_an_upgrade_and_goes(
    kit: Path, tmp_path: Path, python: Path
) -> None:
    root = tmp_path / "root"
    root.mkdir()
    options = ("--wheel", str(kit / "ceilvo-9.9.9-py3-none-any.whl"), "--no-deps")
    unit, state = root / "etc/systemd/system/ceilvo-mapd.service", root / "var/lib/ceilvo-mapd"
    first = run_installer(kit, root, *options, "--fleet", python=python)
    assert first.returncode == 0, first.stderr
    assert unit.read_bytes() == MAPD_UNIT.read_bytes() and "ceilvo-mapd:" in (root / "etc/passwd").read_text()
    config, drop_in = root / "etc/ceilvo/mapd.yaml", unit.with_name("ceilvo-mapd.service.d") / "10-network.conf"
    assert config.exists() and not drop_in.exists()
    config.write_text("listen: tcp/0.0.0.0:7447")
    again = run_installer(kit, root, *options, python=python)
    assert again.returncode == 0, again.stderr
    assert unit.exists() and drop_in.exists() and config.read_text().startswith("listen")
    assert not (root / "etc/systemd/system/ceilvod.service.d").exists()
    (state / "building.db").write_text("mine")
    assert run_installer(root / "opt/ceilvo/share/ceilvo", root, "uninstall").returncode == 0
    assert not unit.exists() and not drop_in.parent.exists() and (state / "building.db").exists()
    assert "ceilvo-mapd:" not in (root / "etc/passwd").read_text()
    assert run_installer(kit, root, "uninstall", "--purge").returncode == 0
    assert not state.exists()


@as_root
def test_pages_come_when_asked_for_stay_with_an_upgrade_and_go(kit: Path, tmp_path: Path, python: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    options = ("--wheel", str(kit / "ceilvo-9.9.9-py3-none-any.whl"), "--no-deps")
    unit, users = root / "etc/systemd/system/ceilvo-web.service", root / "etc/passwd"
    drop_in = unit.with_name("ceilvo-web.service.d") / "10-network.conf"
    first = run_installer(kit, root, *options, "--web", python=python)
    assert first.returncode == 0, first.stderr
    assert unit.read_bytes() == WEB_UNIT.read_bytes() and "ceilvo-web:" in users.read_text() and not drop_in.exists()
    (root / "etc/ceilvo/config.yaml").write_text("host: 0.0.0.0")
    again = run_installer(kit, root, *options, python=python)
    assert again.returncode == 0, again.stderr
    assert unit.exists() and drop_in.exists()
    assert run_installer(root / "opt/ceilvo/share/ceilvo", root, "uninstall").returncode == 0
    assert not unit.exists() and not drop_in.parent.exists() and "ceilvo-web:" not in users.read_text()
    assert run_installer(kit, root, *options, python=python).returncode == 0
    assert not unit.exists()


def test_the_pages_are_closed_in_as_the_map_service_is() -> None:
    mapd, pages = unit_settings(MAPD_UNIT), unit_settings(WEB_UNIT)
    assert mapd.keys() - pages.keys() == {"PrivateDevices"}, "the camera, for commissioning"
    assert pages.keys() - mapd.keys() == {"SupplementaryGroups", "Nice", "CPUWeight", "DeviceAllow"}
    assert pages["DevicePolicy"] == mapd["DevicePolicy"] == ["closed"]
    assert pages["DeviceAllow"] == ["char-video4linux rw"]
    own = {"Description", "Documentation", "After", "ExecStart", "User", "Group", "WorkingDirectory"}
    own |= {"WatchdogSec", "TimeoutStartSec", "TimeoutStopSec", "StateDirectory"}
    assert {name for name in mapd.keys() & pages.keys() if mapd[name] != pages[name]} == own


def test_the_map_service_is_closed_in_as_the_daemon_is() -> None:
    daemon, mapd = unit_settings(), unit_settings(MAPD_UNIT)
    of_devices = {"DeviceAllow", "SupplementaryGroups", "Nice", "OOMScoreAdjust", "ConfigurationDirectory"}
    of_devices |= {"RuntimeDirectory", "RuntimeDirectoryMode", "Wants", "Slice", "MemoryMin"}
    assert daemon.keys() - mapd.keys() == of_devices
    start = daemon["Description"], daemon["User"]
    assert start != (mapd["Description"], mapd["User"])
    closed = [
        name for name in daemon if name.startswith(("Protect", "Private", "Restrict", "System", "No", "IP", "Cap"))
    ]
    assert len(closed) > 20 and all(daemon[name] == mapd[name] for name in closed)
