"""What a person who looks at a page would find wrong: cut, overlapping, fetched from elsewhere, complaints."""

from __future__ import annotations

from pathlib import Path

from chromium import Page

PICTURES = Path(__file__).resolve().parents[2] / "build" / "web"
"""Screenshots, kept for whoever wants to look."""
SIZES = {"laptop": (1280, 900), "phone": (390, 844)}
OVERFLOWING = """
[...document.querySelectorAll('main *, header *')].filter(e => e.closest('.card, header')).filter(e => {
  const box = e.getBoundingClientRect(), card = e.closest('.card, header').getBoundingClientRect();
  const log = e.closest('.log, .view-list');
  return box.width && !e.closest('svg') && (box.right > card.right + 1 || box.left < card.left - 1
    || (!log && box.bottom > card.bottom + 1)
    || (e.clientWidth && e.scrollWidth > e.clientWidth + 1 && !e.matches('input, select, textarea')));
}).map(e => e.id || e.className || e.tagName)
"""
OVERLAPPING = """
(() => {
  const cards = [...document.querySelectorAll('.card')].map(e => [e.className, e.getBoundingClientRect()]);
  const buttons = [...document.querySelectorAll('button, input')]
    .filter(e => e.offsetParent && !e.closest('.view-list')).map(e => [e.id, e.getBoundingClientRect()]);
  const meet = (a, b) => a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 1 && b.top < a.bottom - 1;
  return [cards, buttons].flatMap(all => all.flatMap(([n, a], i) =>
    all.slice(i + 1).filter(([, b]) => meet(a, b)).map(([m]) => `${n} on ${m}`)));
})()
"""


def whole(page: Page) -> None:
    """Nothing is cut, nothing lies on another."""
    assert page.value("document.documentElement.scrollWidth <= document.documentElement.clientWidth")
    assert page.value(OVERFLOWING) == []
    assert page.value(OVERLAPPING) == []


def kept_to_itself(page: Page, address: str) -> None:
    """No complaint in the console, nothing fetched from elsewhere."""
    own = (address, address.replace("http", "ws", 1), f"blob:{address}", "about:")
    assert len(page.asked) > 5
    assert [url for url in page.asked if not url.startswith(own)] == []
    assert page.complaints == []
