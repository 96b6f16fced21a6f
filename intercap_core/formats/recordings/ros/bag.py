"""ROS bags: files ``.bag`` of ROS 1, files ``.mcap`` and ``.db3`` and bag folders of ROS 2.

The package ``rosbags`` (extra ``ros``) reads them without ROS. Messages are parsed by published
definitions alone: ``rosbags`` would compile the definitions in a file to Python code.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from intercap_core.errors import MissingPackage, UserError
from intercap_core.formats.recordings.source import ClosedOnExit

if TYPE_CHECKING:
    from rosbags.interfaces import TopicInfo

ACTIVE = ".active"  # rosbag record appends it until a bag has its index
SUFFIXES = (".bag", f".bag{ACTIVE}", ".mcap", ".db3")
METADATA = "metadata.yaml"  # of a bag folder of ROS 2
# Command that restores a file without an index or an end.
_REPAIR = {
    ".bag": "rosbag reindex FILE",
    ACTIVE: f"rosbag reindex FILE, then remove {ACTIVE} from its name",
    ".mcap": "mcap recover FILE -o REPAIRED",
    ".db3": "sqlite3 FILE .recover",
    "": "ros2 bag reindex FOLDER",
}
# Messages that the type store of ROS 1 lacks. Of Orbbec's recorder the first fields: custom_msg in
# OrbbecSDK_v2 (MIT).
_ROS1_TYPES = {
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "custom_msg/msg/OBStreamProfileInfo": (
        "std_msgs/Header header\nuint8 streamType\nuint8 format\nfloat32[9] rotationMatrix\n"
        "float32[3] translationMatrix\nuint16 width\nuint16 height\nuint16 fps\n"
        "float32[4] cameraIntrinsic\nfloat32[8] cameraDistortion\nuint8 distortionModel\n"
    ),
    "custom_msg/msg/OBImuStreamProfileInfo": (
        "std_msgs/Header header\nuint8 streamType\nuint8 format\nuint8 accelFullScaleRange\n"
        "uint8 accelSampleRate\nuint8 gyroFullScaleRange\nuint8 gyroSampleRate\n"
        "float32[9] rotationMatrix\nfloat32[3] translationMatrix\n"
    ),
    "custom_msg/msg/OBDeviceInfo": (
        "std_msgs/Header header\nstring name\nstring fullName\nstring asicName\nuint16 vid\n"
        "uint16 pid\nstring uid\nstring sn\n"
    ),
    "custom_msg/msg/OBDisparityParam": (
        "std_msgs/Header header\nfloat64 zpd\nfloat64 zpps\nfloat32 baseline\nfloat64 fx\n"
        "uint8 bitSize\nfloat32 unit\n"
    ),
}


class Bag(ClosedOnExit):
    """An open bag; use as a context manager.

    Raises UserError, naming the file, if the package is missing or the file cannot be read. Methods
    raise it where the file is damaged.
    """

    path: Path
    topics: dict[str, TopicInfo]
    """Type (as ROS 2 writes it) and number of messages by topic, without topics that hold none."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._is_ros1 = path.suffix in (".bag", ACTIVE)
        _require_package(path)
        self._store = _type_store(self._is_ros1)
        with self._explained():
            self._reader = _open_reader(path, self._is_ros1)
            topics = self._reader.topics
        self.topics = {name: topic for name, topic in topics.items() if topic.msgcount}

    def close(self) -> None:
        """Close the files."""
        self._reader.close()

    def messages(self, *topics: str) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, time of recording (ns) and message of ``topics``, in order of recording."""
        connections = [c for c in self._reader.connections if c.topic in topics]
        if not connections:
            return
        remaining = self._reader.messages(connections=connections)
        while True:
            with self._explained():
                item = next(remaining, None)
                message = None if item is None else self._parse(item[0].msgtype, item[2])
            if item is None:
                return
            yield item[0].topic, int(item[1]), message

    def first(self, topic: str) -> Any:
        """Return the first message of a topic; None without messages."""
        return next((message for _, _, message in self.messages(topic)), None)

    def _parse(self, type_name: str, content: bytes) -> Any:
        if not self._is_ros1:
            return self._store.deserialize_cdr(content, type_name)
        # Recorders of vendors append fields of their own, which the usual call refuses.
        definition = self._store.get_msgdef(type_name)
        return definition.deserialize_ros1(content, 0, definition.cls, self._store)[0]

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except MemoryError:
            raise
        except Exception as error:  # a damaged file fails in any line of the library
            reason = " ".join(str(error).split())[:300] or type(error).__name__
            if "ompression" in reason:
                advice = "convert it without compression (rosbag decompress, ros2 bag convert)"
            else:
                repair = _REPAIR.get(self.path.suffix, _REPAIR[""])
                advice = (
                    f"if the recording was not ended properly, repair it ({repair}), else copy or "
                    "record it again"
                )
            raise UserError(
                f"{self.path}: cannot be read as a ROS bag ({reason}); {advice}"
            ) from error


def find_bags(folder: Path) -> list[Path]:
    """Bags in a folder, sorted; the folder itself if it is a bag folder of ROS 2."""
    if is_bag(folder):
        return [folder]
    return sorted(path for path in folder.iterdir() if path.name[0] != "." and is_bag(path))


def is_bag(path: Path) -> bool:
    """Return whether a path has the form of a bag; its content is not read.

    ``ros2 bag record`` names files after their folder, and writes ``METADATA`` when it ends.
    """
    if path.is_dir():
        first = (f"{path.name}_0.mcap", f"{path.name}_0.db3")
        names = (METADATA, *first, *(f"{name}.zstd" for name in first))
        return any((path / name).is_file() for name in names)
    return path.name.endswith(SUFFIXES)


def name_of(path: Path) -> str:
    """Name of a bag without its suffix."""
    return Path(path.name.removesuffix(ACTIVE)).stem


def _open_reader(path: Path, is_ros1: bool) -> Any:
    from rosbags import rosbag1, rosbag2

    if path.is_dir() and not (path / METADATA).is_file():  # of an interrupted recording
        parts = [part for part in path.iterdir() if part.suffix in SUFFIXES]
        path = parts[0] if len(parts) == 1 else path
    reader = rosbag1.Reader(path) if is_ros1 else rosbag2.Reader(path)
    reader.open()
    return reader


def _require_package(path: Path) -> None:
    try:
        import rosbags  # noqa: F401
    except ImportError:
        raise MissingPackage(
            f"{path}: reading ROS bags needs the package rosbags; install it with pip install "
            "'intercap-core[ros]'"
        ) from None


@cache
def _type_store(is_ros1: bool) -> Any:
    """Published definitions of messages of one release of ROS."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if not is_ros1:
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    for name, definition in _ROS1_TYPES.items():
        store.register(get_types_from_msg(definition, name))
    return store
