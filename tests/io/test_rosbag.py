"""ROS 1 bags, written here with the library's writer."""

import numpy as np
import pytest
import torch
from mutated import assert_safe
from samples import a_trajectory

from torchcmax.core import so3
from torchcmax.core.pose import Pose, Trajectory
from torchcmax.io import DataError, DataNote, DataWarning, Events, OpenOptions, open

rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="rosbags is an extra: pip install 'torchcmax[io]'")
EVENT = "uint16 x\nuint16 y\ntime ts\nbool polarity\n"
ARRAY = "std_msgs/Header header\nuint32 height\nuint32 width\n{kind}/Event[] events\n"


def events(count=5000, start=1_600_000_000_000_000):
    rng = np.random.default_rng(0)
    t = start + np.sort(rng.integers(0, 10**6, count))
    return Events(
        t, rng.integers(0, 240, count).astype("u2"), rng.integers(0, 180, count).astype("u2"), rng.integers(0, 2, count).astype("u1")
    )


def write(path, found, topics=("/dvs/events",), kind="dvs_msgs", info=True, poses=None, compression=None, frames=()):
    """A bag of event arrays of 700 events each, with a calibration, poses, and frames: (parent, child, poses, topic) of tf."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(EVENT, f"{kind}/msg/Event"))
    store.register(get_types_from_msg(ARRAY.format(kind=kind), f"{kind}/msg/EventArray"))
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf2_msgs/msg/TFMessage"))
    types = store.types
    time, header = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]

    def head(t):
        return header(0, time(t // 10**6, t % 10**6 * 1000), "camera")

    bag = rosbag1.Writer(path)
    if compression:
        bag.set_compression(compression)
    with bag:

        def send(connection, message, t, name):
            bag.write(connection, t * 1000, store.serialize_ros1(message, name))

        for topic in topics:
            name = f"{kind}/msg/EventArray"
            connection = bag.add_connection(topic, name, typestore=store)
            for first in range(0, len(found), 700):
                part = found[first : first + 700]
                rows = zip(part.x.tolist(), part.y.tolist(), part.t.tolist(), part.p.tolist(), strict=True)
                each = [types[f"{kind}/msg/Event"](x, y, time(t // 10**6, t % 10**6 * 1000), bool(p)) for x, y, t, p in rows]
                t = int(part.t[0])
                send(connection, types[name](head(t), 180, 240, each), t, name)
        if info:
            name = "sensor_msgs/msg/CameraInfo"
            connection = bag.add_connection("/dvs/camera_info", name, typestore=store)
            K, D = np.array([200.0, 0, 120, 0, 201, 90, 0, 0, 1]), np.array([-0.3, 0.1, 0.001, 0.002, 0.0])
            region = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
            message = types[name](head(int(found.t[0])), 180, 240, "plumb_bob", D, K, np.eye(3).ravel(), np.zeros(12), 0, 0, region)
            send(connection, message, int(found.t[0]), name)
        if poses is not None:
            name = "geometry_msgs/msg/PoseStamped"
            connection = bag.add_connection("/optitrack/davis", name, typestore=store)
            point, quaternion, pose = (types[f"geometry_msgs/msg/{one}"] for one in ("Point", "Quaternion", "Pose"))
            q = so3.to_quaternion(poses.pose.R)
            for t, p, r in zip(poses.time.tolist(), poses.pose.t.tolist(), q.tolist(), strict=True):
                send(connection, types[name](head(t), pose(point(*p), quaternion(*r))), t, name)
        connections = {}
        for parent, child, poses, topic in frames:
            name = "tf2_msgs/msg/TFMessage"
            connections[topic] = connections.get(topic) or bag.add_connection(topic, name, typestore=store)
            vector, quaternion, transform, one = (
                types[f"geometry_msgs/msg/{one}"] for one in ("Vector3", "Quaternion", "Transform", "TransformStamped")
            )
            for t, p, r in zip(poses.time.tolist(), poses.pose.t.tolist(), so3.to_quaternion(poses.pose.R).tolist(), strict=True):
                stamp = header(0, time(t // 10**6, t % 10**6 * 1000), parent)
                message = types[name]([one(stamp, child, transform(vector(*p), quaternion(*r)))])
                for _ in range(2):  # tf repeats itself
                    send(connections[topic], message, t, name)
    return path


def read(path, **options):
    recording = open(path, OpenOptions(**options))
    return recording, Events.join(list(recording.chunks()))


def same(found, expected):
    for name in "txyp":
        assert np.array_equal(getattr(found, name), getattr(expected, name)), name


@pytest.mark.parametrize("kind", ["dvs_msgs", "prophesee_event_msgs"])
@pytest.mark.parametrize("chunk", [100, 1 << 20])
def test_events_and_calibration_come_back_as_they_were_written(tmp_path, kind, chunk):
    recording, found = read(write(tmp_path / "a.bag", events(), kind=kind), chunk=chunk)
    same(found, events())
    camera = recording.camera
    assert camera.size == (180, 240)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (200, 201, 120, 90)
    assert camera.distortion[:4] == (-0.3, 0.1, 0.001, 0.002)
    assert recording.truth is None


@pytest.mark.parametrize("compression", ["BZ2", "LZ4"])
def test_compressed_bags_are_read(tmp_path, compression):
    path = write(tmp_path / "a.bag", events(), compression=getattr(rosbag1.Writer.CompressionFormat, compression))
    same(read(path)[1], events())


def test_poses_are_the_truth(tmp_path):
    whole = a_trajectory()
    keep = whole.time > 0
    poses = type(whole)(whole.time[keep], whole.pose[keep])
    with pytest.warns(DataNote, match="/optitrack/davis are taken"):
        recording = open(write(tmp_path / "a.bag", events(), poses=poses))
    assert torch.equal(recording.truth.time, poses.time)
    torch.testing.assert_close(recording.truth.pose.R, poses.pose.R)
    torch.testing.assert_close(recording.truth.pose.t, poses.pose.t)


def test_of_two_cameras_the_left_one_is_read_and_the_other_named(tmp_path):
    path = write(tmp_path / "a.bag", events(), topics=("/davis/right/events", "/davis/left/events"))
    with pytest.warns(DataNote, match="/davis/left/events are read; there are /davis/right/events too"):
        same(read(path, camera="pinhole")[1], events())


def test_a_bag_without_calibration_says_so_and_knows_its_size(tmp_path):
    path = write(tmp_path / "a.bag", events(), info=False)
    with pytest.raises(DataError, match="there is no calibration"):
        open(path)
    assert open(path, OpenOptions(camera="pinhole")).camera.size == (180, 240)


def test_a_bag_without_events_names_what_it_holds(tmp_path):
    with pytest.raises(DataError, match="holds no events, but sensor_msgs/msg/CameraInfo"):
        open(write(tmp_path / "a.bag", events(), topics=()))


def test_broken_bags_end_in_a_data_error_or_are_read_as_far_as_they_go(tmp_path):
    raw = write(tmp_path / "a.bag", events()).read_bytes()
    found = assert_safe(tmp_path, raw, 4096, ".bag")
    assert "DataError" in found


def test_a_message_that_claims_more_than_it_has_ends_the_reading_with_a_warning(tmp_path):
    raw = bytearray(write(tmp_path / "a.bag", events(1400)).read_bytes())
    mark = (240).to_bytes(4, "little") + (700).to_bytes(4, "little")
    second = raw.index(mark, raw.index(mark) + 1)
    raw[second + 4 : second + 8] = (7000).to_bytes(4, "little")
    (tmp_path / "b.bag").write_bytes(raw)
    with pytest.warns(DataWarning, match="is read up to event 700, and broken from there on"):
        same(read(tmp_path / "b.bag")[1], events(1400)[:700])


def placed(poses, still=False):
    """The same poses at times of the bag; still: all of them the first one."""
    first = poses.pose[:1]
    pose = Pose(first.R.expand_as(poses.pose.R), first.t.expand_as(poses.pose.t)) if still else poses.pose
    return Trajectory(torch.arange(len(poses)) * 1000 + 1_600_000_000_000_000, pose)


def test_the_only_frames_of_tf_that_move_are_the_truth(tmp_path):
    poses = placed(a_trajectory())
    fixed = placed(a_trajectory(), still=True)
    frames = [("base", "camera", fixed, "/tf"), ("world", "base", poses, "/tf"), ("base", "lens", fixed, "/tf_static")]
    with pytest.warns(DataNote, match="poses of tf, base in world, are taken"):
        truth = open(write(tmp_path / "a.bag", events(), frames=frames), OpenOptions()).truth
    assert torch.equal(truth.time, poses.time)
    torch.testing.assert_close(truth.pose.t, poses.pose.t)
    torch.testing.assert_close(truth.pose.R, poses.pose.R)


def test_frames_of_tf_in_any_order_of_time_are_sorted(tmp_path):
    poses = placed(a_trajectory())
    frames = [("world", "base", poses, "/tf"), ("world", "base", poses, "/relayed")]
    truth = open(write(tmp_path / "a.bag", events(), frames=frames), OpenOptions()).truth
    assert torch.equal(truth.time, poses.time)
    torch.testing.assert_close(truth.pose.t, poses.pose.t)


def test_of_several_frames_of_tf_that_move_none_is_taken(tmp_path):
    poses = placed(a_trajectory())
    frames = [("world", "camera", poses, "/tf"), ("world", "hand", poses, "/tf")]
    with pytest.warns(DataNote, match="camera in world, hand in world; none is taken"):
        assert open(write(tmp_path / "a.bag", events(), frames=frames), OpenOptions()).truth is None
