"""What the doctor says of the program as it was installed."""

from __future__ import annotations

import pytest

from ceilvo.daemon.doctor.findings import fine
from ceilvo.daemon.doctor.system import compiled_kernel
from ceilvo.daemon.vision import kernel


def test_a_kernel_that_was_not_compiled_is_told_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel, "COMPILED", True)
    assert list(compiled_kernel()) == [fine("kernel", "compiled")]
    monkeypatch.setattr(kernel, "COMPILED", False)
    (finding,) = compiled_kernel()
    assert finding.level == "note"  # slower, but right
    assert "not compiled" in finding.text and "apt install gcc python3-dev" in finding.text
