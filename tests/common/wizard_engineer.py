"""An engineer in front of the wizard's page, who reads, types and clicks, and how long each step took."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from chromium import Page
from page_looks import whole
from patience import until

STEPS = ("intrinsics", "projection", "mount", "sigma", "check")
"""Those that a robot needs; the survey is for who likes."""
ANSWERS: Mapping[str, Mapping[str, str]] = {"projection": {"tile-m": "0.6", "height-m": "2.2"}}
"""The virtual bench's own, as a tape would find them."""


@dataclass
class Engineer:
    """At one page; took_s by step."""

    page: Page
    pictures: Path
    name: str
    took_s: dict[str, float] = field(default_factory=dict)

    def arrive(self, address: str) -> None:
        self.page.go(f"{address}/commission")
        self.page.until("document.querySelector('#steps').children.length === 6")

    def answer(self, step: str) -> None:
        for word, value in ANSWERS.get(step, {}).items():
            self.page.value(f"document.querySelector('#answer-{word}').value = {json.dumps(value)}")

    def choose(self, step: str) -> None:
        self.page.until(f"(document.querySelector('#step-{step}').click(), true)")
        self.page.until(f"document.querySelector('#step-{step}').getAttribute('aria-current') === 'step'")

    def do(self, step: str, away: bool = False) -> None:
        """A step from its form to its verdict; away: the page is closed and opened again while it goes on."""
        begin = time.monotonic()
        self.choose(step)
        self.answer(step)
        whole(self.page)
        self.page.click("#go")
        self.page.until("document.querySelector('main').classList.contains('busy')")
        self.page.until("document.querySelector('#picture').height > 100 && /taken/.test(document.body.innerText)")
        whole(self.page)
        self.look(f"{step}-taking")
        if away:
            address = str(self.page.value("location.origin"))
            self.page.do("Page.navigate", url="about:blank")
            self.page.until("location.protocol === 'about:'")
            self.arrive(address)
            self.choose(step)
        self.finish(step)
        self.took_s[step] = time.monotonic() - begin

    def finish(self, step: str) -> None:
        done = f"document.querySelector('#step-{step}').dataset.done"
        until(lambda: self.page.value(done) in ("PASS", "FAIL") or self.wrong(), f"the end of {step}")
        assert self.page.value(done) == "PASS", self.page.text("main")
        assert self.page.value("document.querySelector('#verdict').dataset.verdict") == "PASS"
        self.page.until("document.querySelector('#rows').children.length > 2")
        whole(self.page)
        self.look(f"{step}-done")

    def wrong(self) -> bool:
        return self.page.value("document.querySelector('#reply').dataset.ok") == "false"

    def views(self) -> int:
        return int(self.page.value("document.querySelector('#views').children.length"))

    def apply(self) -> str:
        """Put into the configuration; what the page said."""
        self.page.click("#apply")
        self.page.until("document.querySelector('#ask').open")
        self.look("ask")
        self.page.click("#yes")
        self.page.until("/written/.test(document.querySelector('#reply').innerText)")
        return self.page.text("#reply")

    def look(self, what: str) -> None:
        self.page.picture(self.pictures / f"{self.name}-{what}.png")
