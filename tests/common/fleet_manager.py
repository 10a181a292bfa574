"""A fleet manager on MQTT, and a real broker between it and the robot."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import paho.mqtt.client as mqtt
import pytest
from patience import until
from zenoh_world import free_port

BROKER = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin")


class Fleet:
    """A fleet manager, and what it was told by topic."""

    def __init__(self, port: int) -> None:
        self.orders = 0
        self.told: dict[str, list[dict[str, Any]]] = {}
        self.client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        self.client.on_message = self._take
        self.client.connect("127.0.0.1", port)
        self.client.subscribe("uagv/v3/ceilvo/robot1/#")
        self.client.loop_start()

    def _take(self, client: Any, userdata: Any, message: Any) -> None:
        topic = message.topic.rpartition("/")[2]
        self.told.setdefault(topic, []).append(json.loads(message.payload) if topic != "instantActions" else {})

    def last(self, topic: str) -> dict[str, Any]:
        return self.told.get(topic, [{}])[-1]

    def order(self, kind: str, **parameters: object) -> str:
        """Its id."""
        self.orders += 1
        given = [{"key": k, "value": v} for k, v in parameters.items()]
        action = {"actionType": kind, "actionId": f"{kind} {self.orders}", "actionParameters": given}
        self.client.publish("uagv/v3/ceilvo/robot1/instantActions", json.dumps({"actions": [action]}))
        return f"{kind} {self.orders}"

    def told_of(self, action_id: str) -> dict[str, Any]:
        """The newest state of an action, {} before the first."""
        states = self.last("state").get("instantActionStates", [])
        return next((a for a in states if a["actionId"] == action_id), {})

    def result(self, kind: str, **parameters: object) -> tuple[str, str]:
        """Order it; status and text when it is over."""
        name = self.order(kind, **parameters)
        until(lambda: self.told_of(name).get("actionStatus") in ("FINISHED", "FAILED"), f"the end of {name}")
        return self.told_of(name)["actionStatus"], self.told_of(name)["actionResult"]

    def maps(self) -> dict[tuple[str, str], str]:
        """Status by id and version."""
        return {(m["mapId"], m["mapVersion"]): m["mapStatus"] for m in self.last("state").get("maps", [])}

    def close(self) -> None:
        self.client.disconnect()
        self.client.loop_stop()


@contextmanager
def mosquitto(folder: Path) -> Iterator[int]:
    """A real broker; its port."""
    if BROKER is None:
        pytest.skip("no mosquitto here: apt install mosquitto")
    port = free_port()
    (folder / "mosquitto.conf").write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n")
    process = subprocess.Popen([BROKER, "-c", str(folder / "mosquitto.conf")], stderr=subprocess.DEVNULL)

    def answers() -> bool:
        try:
            socket.create_connection(("127.0.0.1", port)).close()
        except OSError:
            return False
        return True

    until(answers, "the broker listens")
    yield port
    process.kill()
    process.wait()
