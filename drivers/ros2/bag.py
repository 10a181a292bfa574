"""A ROS 2 bag in one MCAP file, with the definitions in it: `ros2 bag`, Foxglove, rosbags and mcap read it."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal

from ceilvo.drivers.ros2.cdr import Cdr
from ceilvo.drivers.ros2.endpoints import Endpoint
from ceilvo.errors import FileFormatError

if TYPE_CHECKING:
    from rosbags.interfaces import Connection, Qos

_BAG_VERSION: Literal[9] = 9
"""Of rosbag2's metadata: Jazzy's; Humble's tools read the MCAP file by itself."""


class Bag:
    """A context manager; the file appears when it ends well."""

    def __init__(self, path: Path, cdr: Cdr) -> None:
        """
        Raises:
            FileFormatError: it cannot be made, or is there already.
        """
        from rosbags.rosbag2 import StoragePlugin, Writer

        if path.suffix != ".mcap":
            raise FileFormatError(f"{path}: ends in {path.suffix!r}, expected a name that ends in .mcap")
        if path.exists():
            raise FileFormatError(f"{path}: is there already, expected a new name")
        self._path, self._cdr = path, cdr
        self._connections: dict[Endpoint, Connection] = {}
        with self._writing():
            self._folder = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
            try:
                self._bag = Writer(self._folder / "bag", version=_BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
                self._bag.open()
            except BaseException:
                shutil.rmtree(self._folder, ignore_errors=True)
                raise
        self.messages = 0

    def write(self, endpoint: Endpoint, message: Any, unix_ns: int) -> None:
        """
        Raises:
            FileFormatError: the disk does not take it.
        """
        connection = self._connections.get(endpoint)
        with self._writing():
            if connection is None:
                connection = self._connections[endpoint] = self._bag.add_connection(
                    endpoint.topic, endpoint.message, typestore=self._cdr.store, offered_qos_profiles=[_qos(endpoint)]
                )
            self._bag.write(connection, unix_ns, self._cdr.encode(message))
        self.messages += 1

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        try:
            if kind is None:
                with self._writing():
                    self._bag.close()
                    (self._folder / "bag" / "bag.mcap").replace(self._path)
            else:
                with contextlib.suppress(OSError):
                    self._bag.abort()
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)

    @contextlib.contextmanager
    def _writing(self) -> Any:
        try:
            yield
        except OSError as e:
            raise FileFormatError(
                f"{self._path}: cannot be written: {e.strerror or e}; check its folder, its owner and the room"
            ) from e


def _qos(endpoint: Endpoint) -> Qos:
    """As the node offers it."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    none = QosTime(0, 0)
    durability = QosDurability.TRANSIENT_LOCAL if endpoint.latched else QosDurability.VOLATILE
    return Qos(
        QosHistory.KEEP_LAST,
        endpoint.depth,
        QosReliability.RELIABLE,
        durability,
        deadline=none,
        lifespan=none,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=none,
        avoid_ros_namespace_conventions=False,
    )
