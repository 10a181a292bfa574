"""Requests of pages as JSON, and what they are told."""

from __future__ import annotations

import json

from aiohttp import web

from ceilvo.drivers.bus.messages import load_object
from ceilvo.errors import BusError, one_line


def expect_json(request: web.Request) -> None:
    """No form of another site's page can send it."""
    if request.content_type != "application/json":
        raise web.HTTPUnsupportedMediaType(text="expected Content-Type: application/json\n")


async def json_of(request: web.Request) -> dict[str, object]:
    """
    Raises:
        web.HTTPException: it brings something else.
    """
    expect_json(request)
    try:
        return load_object(await request.read(), "request")
    except BusError as e:
        raise web.HTTPBadRequest(text=f"{one_line(e)}\n") from e


def refused(status: int, error: str) -> web.Response:
    return web.Response(
        body=json.dumps({"ok": False, "error": error}).encode(), status=status, content_type="application/json"
    )
