"""ROS 1 bags with event arrays of dvs_msgs or prophesee_event_msgs, through the library rosbags; camera_info and poses where they are.

Events are taken from the messages' bytes at once: one is x and y (uint16), seconds and nanoseconds (uint32), polarity (uint8), packed.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from torchcmax.core.pose import Trajectory
from torchcmax.io.calibration import Lens
from torchcmax.io.contents import Contents
from torchcmax.io.errors import DataError, DataNote, DataWarning, tell
from torchcmax.io.events import Events
from torchcmax.io.lensfiles import in_our_words
from torchcmax.io.trajectory import checked_trajectory

HEAD = b"#ROSBAG V2.0"
EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])
ARRAYS = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
INFO = "sensor_msgs/msg/CameraInfo"
POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped", "nav_msgs/msg/Odometry")
FRAMES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")  # of one form
AGAIN = "copy or download it again; a bag that was not closed is mended by `rosbag reindex`"
Row = tuple[int, float, float, float, float, float, float, float]  # µs, tx ty tz qx qy qz qw
MOST = 1 << 31  # bytes of a message: more is a damaged length


def knows(path: Path, head: bytes) -> bool:
    """Whether it is a ROS 1 bag."""
    return head.startswith(HEAD)


def contents(path: Path) -> Contents:
    """What the bag's topics say; its events are read when they are asked for."""
    with _bag(path) as bag:
        topic = _events_topic(path, bag)
        lens, truth = _lens(path, bag, topic), _truth(path, bag)
        sensor = lens.sensor if lens is not None and lens.sensor is not None else _size(path, bag, topic)
    return Contents(partial(_events, path, topic), lambda event: f"event {event + 1} of {topic}", sensor=sensor, lens=lens, truth=truth)


@contextmanager
def _bag(path: Path) -> Iterator[Any]:
    """The bag, open; whatever the library finds wrong with it is a DataError."""
    try:
        from rosbags.rosbag1 import Reader
    except ImportError as error:
        raise DataError(path, f"needs the library rosbags to be read ({error})", "pip install 'torchcmax[io]'") from error
    try:
        with Reader(path) as bag:
            yield bag
    except DataError:
        raise
    except Exception as error:  # of the library's own kinds, and of what damaged bytes make of it
        raise DataError(path, f"cannot be read as a ROS bag: {_line(error)}", AGAIN) from error


def _line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)


def _topics(bag: Any, kinds: tuple[str, ...]) -> dict[str, int]:
    """Topics of these kinds with the number of their messages, those with most first."""
    found: dict[str, int] = {}
    for connection in bag.connections:
        if connection.msgtype in kinds:
            found[connection.topic] = found.get(connection.topic, 0) + connection.msgcount
    return dict(sorted(found.items(), key=lambda item: (-item[1], item[0])))


def _events_topic(path: Path, bag: Any) -> str:
    """The topic of events: the left one of two cameras, else the one that comes first by name."""
    found = sorted(_topics(bag, ARRAYS))
    if not found:
        kinds = ", ".join(sorted({connection.msgtype for connection in bag.connections})) or "nothing"
        raise DataError(path, f"holds no events, but {kinds}", f"record a topic of {' or '.join(ARRAYS)}")
    topic = next((name for name in found if "left" in name), found[0])
    if len(found) > 1:
        tell(DataNote(f"{path}: the events of {topic} are read; there are {', '.join(name for name in found if name != topic)} too"))
    return topic


def _messages(bag: Any, topic: str) -> Iterator[bytes]:
    """The bytes of a topic's messages."""
    connections = [connection for connection in bag.connections if connection.topic == topic]
    for _, _, data in bag.messages(connections=connections):
        yield bytes(data)


def _size(path: Path, bag: Any, topic: str) -> tuple[int, int] | None:
    """Width and height as the first message of events says; None where it says nothing."""
    for data in _messages(bag, topic):
        _, height, width, _ = _array(path, data, 0)
        return (width, height) if width and height else None
    raise DataError(path, f"holds no message of {topic}", AGAIN)


def _array(path: Path, data: bytes, number: int) -> tuple[int, int, int, int]:
    """Of the bytes of an event array: where its events begin, height, width, and how many events there are."""
    at = 12
    if len(data) >= at + 4:
        at += 4 + struct.unpack_from("<I", data, at)[0]  # the frame's name
    if len(data) < at + 12:
        raise DataError(path, f"a message of {len(data)} bytes is no event array", AGAIN, f"message {number + 1}")
    height, width, count = struct.unpack_from("<III", data, at)
    if len(data) < at + 12 + count * EVENT.itemsize:
        raise DataError(path, f"a message of {len(data)} bytes claims to hold {count} events", AGAIN, f"message {number + 1}")
    return at + 12, height, width, count


def _events(path: Path, topic: str, chunk: int) -> Iterator[Events]:
    """Message by message, gathered to chunks; where the bag is broken, those before, with a warning."""
    parts: list[Events] = []
    waiting = seen = 0
    try:
        with _bag(path) as bag:
            for number, data in enumerate(_messages(bag, topic)):
                at, _, _, count = _array(path, data, number)
                raw = np.frombuffer(data, EVENT, count, at)
                t = raw["s"].astype(np.int64) * 1_000_000 + (raw["ns"] + np.uint32(500)) // 1000
                parts.append(Events(t, raw["x"].copy(), raw["y"].copy(), (raw["p"] > 0).astype(np.uint8)))
                waiting, seen = waiting + count, seen + count
                if waiting >= chunk:
                    yield Events.join(parts)
                    parts, waiting = [], 0
    except DataError as error:
        if not seen:
            raise
        tell(DataWarning(f"{path}: is read up to event {seen}, and broken from there on: {error.problem}"))
    if waiting:
        yield Events.join(parts)


def _typestore() -> Any:
    """How messages are laid out: those of ROS itself, and of tf."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", FRAMES[0]))
    return store


def _lens(path: Path, bag: Any, topic: str) -> Lens | None:
    """The camera_info in the namespace of the events, or the only one."""
    found = sorted(_topics(bag, (INFO,)))
    space = topic.rpartition("/")[0]
    name = next((one for one in found if one.rpartition("/")[0] == space), found[0] if len(found) == 1 else None)
    if name is None:
        return None
    store = _typestore()
    for data in _messages(bag, name):
        told = store.deserialize_ros1(data, INFO)
        if not told.K[0] > 0:  # a driver without a calibration
            return None
        words = {
            "image_width": int(told.width),
            "image_height": int(told.height),
            "camera_matrix": {"data": [float(value) for value in told.K]},
            "distortion_model": str(told.distortion_model) or "plumb_bob",
            "distortion_coefficients": {"data": [float(value) for value in told.D]},
        }
        return _told(path, name, words)
    return None


def _told(path: Path, topic: str, words: dict[str, Any]) -> Lens:
    from dataclasses import replace

    from torchcmax.io.calibration import checked_size, told_lens

    file = f"{path}, {topic}"
    found = in_our_words(file, words)
    lens = told_lens(file, found, "it wants K, D and a distortion_model, as camera_calibration writes them")
    return replace(lens, sensor=checked_size(file, found["width"], found["height"])) if found.get("width") else lens


def _truth(path: Path, bag: Any) -> Trajectory | None:
    """The poses of the topic that has most, as camera to world; None where there is none."""
    found = {name: count for name, count in _topics(bag, POSES).items() if count > 1}
    if not found:
        return _frames(path, bag)
    topic = next(iter(found))
    kind = next(connection.msgtype for connection in bag.connections if connection.topic == topic)
    tell(DataNote(f"{path}: poses of {topic} are taken for the camera's"))
    store, rows = _typestore(), list[Row]()
    for data in _messages(bag, topic):
        told = store.deserialize_ros1(data, kind)
        stamp = told.header.stamp
        if kind.endswith("TransformStamped"):
            p, q = told.transform.translation, told.transform.rotation
        else:
            pose = told.pose.pose if kind.endswith("Odometry") else told.pose
            p, q = pose.position, pose.orientation
        rows.append((stamp.sec * 1_000_000 + round(stamp.nanosec / 1000), p.x, p.y, p.z, q.x, q.y, q.z, q.w))
    return _trajectory(path, topic, rows)


def _trajectory(path: Path, name: str, rows: list[Row]) -> Trajectory:
    """Poses from rows of a time and its seven numbers."""
    time = np.array([row[0] for row in rows], np.int64)
    table = np.array([row[1:] for row in rows], np.float64)
    return checked_trajectory(str(path), time, table[:, :3], table[:, 3:], lambda i: f"{name}, pose {i + 1}")


def _frames(path: Path, bag: Any) -> Trajectory | None:
    """The one pair of frames in tf that moves against each other, child to parent; None where none does, or nobody knows which it is."""
    pairs: dict[tuple[str, str], dict[int, Row]] = {}
    topics = [topic for topic in _topics(bag, FRAMES) if not topic.endswith("static")]
    for topic in topics:
        store = _typestore()
        for data in _messages(bag, topic):
            for told in store.deserialize_ros1(data, FRAMES[0]).transforms:
                stamp, p, q = told.header.stamp, told.transform.translation, told.transform.rotation
                time = stamp.sec * 1_000_000 + round(stamp.nanosec / 1000)
                rows = pairs.setdefault((told.header.frame_id, told.child_frame_id), {})
                rows.setdefault(time, (time, p.x, p.y, p.z, q.x, q.y, q.z, q.w))  # tf repeats what it has, in any order
    moving = {pair: sorted(rows.values()) for pair, rows in pairs.items() if len({row[1:] for row in rows.values()}) > 1}
    names = [f"{child} in {parent}" for parent, child in moving]
    if len(moving) != 1:
        if moving:
            tell(DataNote(f"{path}: tf tells of {', '.join(names)}; none is taken for the camera's poses: give them as groundtruth.txt"))
        return None
    tell(DataNote(f"{path}: poses of tf, {names[0]}, are taken for the camera's"))
    return _trajectory(path, f"tf, {names[0]}", next(iter(moving.values())))
