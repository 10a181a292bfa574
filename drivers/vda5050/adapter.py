"""Between a robot on Zenoh and a fleet manager on MQTT: says where the robot is, takes initial poses."""

from __future__ import annotations

import json
import logging
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceilvo.config import Config
from ceilvo.drivers.bus.command_guard import CommandGuard
from ceilvo.drivers.bus.messages import Pose, decode_pose
from ceilvo.drivers.live.feed import ALIVE, GONE, Feed
from ceilvo.drivers.ports import Topic
from ceilvo.drivers.rate_limit import QuietLog
from ceilvo.drivers.vda5050 import messages
from ceilvo.drivers.vda5050.maps import FAILED, FINISHED, KINDS, KnownMap, MapActions, Maps, Told
from ceilvo.drivers.vda5050.messages import Action, Robot
from ceilvo.errors import BusError, ConfigError, one_line
from ceilvo.files import read_secret

if TYPE_CHECKING:
    import paho.mqtt.client as mqtt

log = logging.getLogger(__name__)

_SILENT_S = 2.0
"""Without a pose for longer the robot is not localized; chosen: many frames of the slowest camera."""
_ACTIONS = 20
"""Latest ones that the state tells of."""
_KEEPALIVE_S = 10
_MOST_BYTES = 4096
"""Of a password; chosen."""
_ENDED_S = 2.0
"""That the last message may take."""


class Adapter:
    """run() is one thread's; MQTT's callbacks only fill a mailbox."""

    def __init__(self, config: Config, maps: Maps, clock: Callable[[], float] = time.monotonic) -> None:
        """
        Raises:
            ConfigError: paho-mqtt is not installed, or a file cannot be used.
        """
        c = config.vda5050
        self._config, self._vda, self._clock, self._maps = config, c, clock, maps
        self._map_actions, self._map_id = MapActions(maps), maps.known()[0].id
        self._token = CommandGuard.of(config.zenoh).token
        self._robot = Robot(c.version, c.manufacturer, c.serial_number or config.robot.name)
        major = c.version.partition(".")[0]
        self._stem = f"{c.interface_name}/v{major}/{c.manufacturer}/{self._robot.serial_number}"
        self._numbers: dict[str, int] = {}
        self._inbox: queue.Queue[bytes] = queue.Queue(100)
        self._actions: dict[str, dict[str, object]] = {}
        self._pose: Pose | None = None
        self._heard_s: float | None = None
        self._told: tuple[object, ...] = ()
        self._due = {"state": 0.0, "visualization": 0.0}
        self._quiet = QuietLog(log, 0.2, 10)
        self._client = self._mqtt()

    def run(self, stop: threading.Event, on_ready: Callable[[], None] = lambda: None) -> None:
        """Until `stop` is set; a broker that is away is waited for.

        Raises:
            BusError: Zenoh cannot be used as configured.
        """
        self._client.connect_async(self._vda.host, self._vda.port, _KEEPALIVE_S)
        self._client.loop_start()
        try:
            with Feed(replace(self._config.zenoh), self._config.robot.name, (Topic.POSE,)) as feed:
                on_ready()
                feed.each(stop, self._take, lambda: self._idle(feed))
        finally:
            last = self._publish("connection", messages.connection, "OFFLINE", retain=True)
            if self._client.is_connected():
                last.wait_for_publish(_ENDED_S)
            self._client.disconnect()
            self._client.loop_stop()

    # -- the robot

    def _take(self, topic: str, payload: bytes) -> None:
        if topic == GONE:
            self._heard_s = None
        elif topic != ALIVE:
            try:
                self._pose, self._heard_s = decode_pose(payload), self._clock()
            except BusError as e:
                self._quiet.warning(str(e))
                return
            self._visualize(self._pose)

    def _visualize(self, pose: Pose) -> None:
        if self._clock() < self._due["visualization"]:
            return
        self._due["visualization"] = self._clock() + self._vda.visualization_period_s
        number, at = self._next("visualization")
        body = messages.visualization(self._robot, number, at, pose, self._map_id)
        if body is not None:
            self._client.publish(f"{self._stem}/visualization", body, qos=0)

    def _idle(self, feed: Feed) -> None:
        while not self._inbox.empty():
            self._act(feed, self._inbox.get())
        for news in self._map_actions.news():
            self._tell(news)
        silence = self._silence()
        pose = self._pose
        told = (silence, *(() if pose is None else (pose.state, messages.floor_of(pose))))
        if told == self._told and self._clock() < self._due["state"]:
            return
        self._told, self._due["state"] = told, self._clock() + self._vda.state_period_s
        maps = [(m.id, m.version, m.enabled) for m in self._known()]
        self._publish("state", messages.state, self._pose, silence, maps, tuple(self._actions.values()))

    def _known(self) -> list[KnownMap]:
        """The map that the pose is on goes first."""
        known = list(self._maps.known())
        floor = "" if self._pose is None else messages.floor_of(self._pose)
        here = next((m for m in known if m.enabled and m.floor == floor), known[0])
        self._map_id = here.id
        return [here, *(m for m in known if m is not here)]

    def _silence(self) -> str:
        if self._pose is None:
            return ""
        if self._heard_s is None:
            return "the localisation daemon has ended"
        if self._clock() - self._heard_s > _SILENT_S:
            return "the localisation daemon is silent"
        return ""

    # -- the fleet manager

    def _act(self, feed: Feed, payload: bytes) -> None:
        try:
            actions = messages.instant_actions(payload)
        except BusError as e:
            self._quiet.warning(f"{e}; nothing was done")
            return
        for action in actions:
            if action.kind in KINDS:
                self._tell(self._map_actions.add(action))
            elif action.kind in messages.INITIAL_POSE:
                self._tell(self._placed(feed, action))

    def _tell(self, told: Told) -> None:
        """In the next state, which is sent at once."""
        self._actions.pop(told.action.id, None)
        self._actions[told.action.id] = messages.action_state(self._robot, told.action, told.status, told.text)
        while len(self._actions) > _ACTIONS:
            del self._actions[next(iter(self._actions))]
        self._told = ()

    def _placed(self, feed: Feed, action: Action) -> Told:
        try:
            request = messages.initial_pose(action, {m.id: m.floor for m in self._known() if m.enabled})
        except BusError as e:
            return Told(action, FAILED, str(e))
        answer = feed.ask("cmd/initial_pose", request, self._token)
        if answer is None:
            return Told(action, FAILED, "the localisation daemon does not answer")
        said: dict[str, Any] = json.loads(answer[1])
        text = str(said.get("error") or said.get("result", {}).get("did") or "done")
        return Told(action, FINISHED if answer[0] else FAILED, text)

    # -- MQTT

    def _mqtt(self) -> mqtt.Client:
        try:
            import paho.mqtt.client as mqtt
            from paho.mqtt.enums import CallbackAPIVersion
        except ImportError as e:
            raise ConfigError("vda5050: found no paho-mqtt, expected it; pip install 'ceilvo[vda5050]'") from e
        client = mqtt.Client(CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
        if self._vda.user:
            client.username_pw_set(self._vda.user, self._password())
        if self._vda.ca_file:
            try:
                client.tls_set(self._vda.ca_file)
            except (OSError, ValueError) as e:
                raise ConfigError(f"vda5050.ca_file: {self._vda.ca_file}: {one_line(str(e))}, expected PEM") from e
        number, at = self._next("connection")
        broken = messages.connection(self._robot, number, at, "CONNECTIONBROKEN")
        client.will_set(f"{self._stem}/connection", broken, qos=1, retain=True)
        client.reconnect_delay_set(1, 10)
        client.on_connect = self._on_connect
        client.on_message = self._on_message
        return client

    def _password(self) -> str | None:
        file = self._vda.password_file
        if not file:
            return None
        path = Path(file)
        made = "write it there with: (umask 027; cat > FILE)"
        secret = read_secret(path, "vda5050.password_file", "a password", _MOST_BYTES, made, f"chmod 640 {path}")
        try:
            return secret.decode()
        except UnicodeDecodeError as e:
            raise ConfigError(f"vda5050.password_file: {file}: {one_line(str(e))}, expected text in UTF-8") from e

    def _on_connect(self, client: mqtt.Client, _u: Any, _f: Any, reason: Any, _p: Any) -> None:
        if reason.is_failure:
            self._quiet.warning(f"vda5050: {self._vda.host}:{self._vda.port} refuses: {reason}")
            return
        log.info("on MQTT as %s", self._stem)
        client.subscribe(f"{self._stem}/instantActions", qos=0)
        self._publish("connection", messages.connection, "ONLINE", retain=True)
        self._told = ()

    def _on_message(self, _c: mqtt.Client, _u: Any, message: mqtt.MQTTMessage) -> None:
        try:
            self._inbox.put_nowait(bytes(message.payload))
        except queue.Full:
            self._quiet.warning("instantActions: more than can be done; this one was dropped")

    def _publish(self, topic: str, make: Callable[..., bytes], *values: object, retain: bool = False) -> Any:
        number, at = self._next(topic)
        body = make(self._robot, number, at, *values)
        return self._client.publish(f"{self._stem}/{topic}", body, qos=1 if retain else 0, retain=retain)

    def _next(self, topic: str) -> tuple[int, int]:
        """The header's number, counted by topic, and now."""
        number = self._numbers.get(topic, 0)
        self._numbers[topic] = number + 1
        return number, time.time_ns()
