"""What the installed service may reach."""

from __future__ import annotations

from pathlib import Path

from installer import as_root, run_installer, unit_settings


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
