"""The machine as the doctor asks it: rights, who holds a device, programs."""

from __future__ import annotations

from pathlib import Path

from ceilvo.drivers.host.machine import Done, Machine


def test_rights_of_another_user(tmp_path: Path) -> None:
    """`nobody` is on every Linux; files are this process's own."""
    file = tmp_path / "device"
    file.touch()
    machine = Machine(user="nobody")
    for mode, may in ((0o600, False), (0o660, False), (0o666, True), (0o664, False)):
        file.chmod(mode)
        assert machine.may_write(file) is may, oct(mode)
    assert Machine().may_write(file)
    assert Machine(user="root").may_write(file)
    assert not Machine(user="no-such-user").may_write(file)


def test_who_holds_a_device(tmp_path: Path) -> None:
    for pid, opened in ((12, "/dev/video0"), (13, "/dev/video1")):
        (tmp_path / "proc" / str(pid) / "fd").mkdir(parents=True)
        (tmp_path / "proc" / str(pid) / "comm").write_text("cheese\n")
        (tmp_path / "proc" / str(pid) / "fd" / "3").symlink_to(opened)
    assert Machine(root=tmp_path).holders("/dev/video0") == ["cheese (pid 12)"]
    assert Machine(root=tmp_path).holders("/dev/video2") == []
    (tmp_path / "proc" / "13" / "fd" / "4").symlink_to("/dev/pts/3")
    assert Machine(root=tmp_path).holders("/dev/pts/3") == ["cheese (pid 13)"]
    (tmp_path / "proc" / "13" / "fd" / "5").symlink_to("/dev/ptmx")  # the other end: a simulated base
    assert Machine(root=tmp_path).holders("/dev/pts/3") == []


def test_programs(tmp_path: Path) -> None:
    assert Machine().run("echo", "a word") == Done(0, "a word")
    assert Machine().run("no-such-program-here") is None
