"""What is written comes back, from every form and across every border of chunks; the recordings at hand open."""

import dataclasses
import subprocess
import sys
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import ECD, POSE, a_trajectory

from torchcmax.core.camera import Camera
from torchcmax.core.plane import Plane
from torchcmax.io import DataWarning, Events, OpenOptions, Recording, open, save
from torchcmax.io.checked import Source, checked
from torchcmax.io.columns import Form
from torchcmax.io.text import _plain, _tidy, read_text

DAVIS = Camera((180, 240), 199.09, 198.83, 132.19, 110.71, (-0.3684, 0.1509, -0.000296, -0.000759, 0.0))
FISHEYE = Camera((60, 80), 40.0, 41.0, 39.5, 29.5, (0.01, -0.002, 0.0003, 0.0), "kannala_brandt")


@st.composite
def streams(draw):
    """Valid events: times in order, often equal, from below zero to the epoch's."""
    steps = draw(st.lists(st.sampled_from([0, 0, 1, 7, 999_999, 10**7]), min_size=1, max_size=40))
    t = np.cumsum([draw(st.sampled_from([-5, 0, 13_595_875, 1_468_940_293_844_896])), *steps[1:]])
    x, y, p = (draw(st.lists(st.integers(0, most), min_size=len(t), max_size=len(t))) for most in (239, 179, 1))
    return Events(t.astype("i8"), np.array(x, "u2"), np.array(y, "u2"), np.array(p, "u1"))


def same(left, right):
    for field in dataclasses.fields(Events):
        a, b = getattr(left, field.name), getattr(right, field.name)
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def as_text(events, end="\n", off=0):
    rows = zip(*(getattr(events, name).tolist() for name in "txyp"), strict=True)
    sign = [("-" if t < 0 else "", *divmod(abs(t), 10**6), x, y, p or off) for t, x, y, p in rows]
    return "".join(f"{s}{whole}.{part:06d} {x} {y} {p}{end}" for s, whole, part, x, y, p in sign)


def back(path, chunk, **options):
    recording = open(path, OpenOptions(chunk=chunk, sensor=(240, 180), **options))
    chunks = list(recording.chunks())
    assert all(len(part) == chunk for part in chunks[:-1])
    return Events.join(chunks)


@settings(max_examples=60, deadline=None)
@given(streams(), st.integers(1, 9), st.sampled_from(["\n", "\r\n"]), st.sampled_from([0, -1]), st.sampled_from(["", "# t x y p\n"]))
def test_text_and_zip_come_back_exactly(tmp_path_factory, events, chunk, end, off, head):
    folder = tmp_path_factory.mktemp("ecd")
    (folder / "events.txt").write_bytes((head + as_text(events, end, off)).encode())
    (folder / "calib.txt").write_text(ECD)
    same(back(folder, chunk), events)
    same(back(folder / "events.txt", chunk), events)
    for inside in ("", "shapes/"):
        with zipfile.ZipFile(folder / "r.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            for name in ("events.txt", "calib.txt"):
                archive.write(folder / name, inside + name)
        same(back(folder / "r.zip", chunk), events)
        assert open(folder / "r.zip", OpenOptions(sensor=(240, 180))).camera == DAVIS
    assert sorted(entry.name for entry in folder.iterdir()) == ["calib.txt", "events.txt", "r.zip"]


@settings(max_examples=60, deadline=None)
@given(streams(), st.integers(1, 9), st.integers(1, 60))
def test_blocks_of_any_size_give_the_same_events(tmp_path_factory, events, chunk, block):
    file = tmp_path_factory.mktemp("text") / "events.txt"
    file.write_text(as_text(events))
    same(Events.join(list(read_text(file, chunk, block))), events)


@settings(max_examples=40, deadline=None)
@given(streams(), st.integers(1, 9), st.sampled_from(["i8", "u2", "i4"]), st.sampled_from([0, -1]))
def test_both_hdf5_layouts_come_back_exactly(tmp_path_factory, events, chunk, kind, off):
    folder = tmp_path_factory.mktemp("sim")
    (folder / "calib.txt").write_text(ECD)
    with h5py.File(folder / "events.h5", "w") as file:
        for name in "txyp":
            file[f"events/{name}"] = getattr(events, name).astype({"t": "i8", "p": "i1"}.get(name, kind))
        file["events/p"][()] = np.where(events.p, 1, off)
    same(back(folder, chunk), events)
    same(back(folder / "events.h5", chunk), events)
    recording = open(folder, OpenOptions(chunk=chunk, sensor=(240, 180)))
    save(recording, folder / "own.data")
    own = open(folder / "own.data", OpenOptions(chunk=chunk, strict=False))
    same(Events.join(list(own.chunks())), events)
    assert (own.camera, own.name, own.count) == (DAVIS, recording.name, len(events))


@settings(max_examples=100, deadline=None)
@given(st.data(), st.integers(2, 12))
def test_events_moved_by_less_than_a_chunk_are_put_back_stably(data, chunk):
    count = data.draw(st.integers(1, 60))
    t = np.array(data.draw(st.lists(st.integers(0, 30), min_size=count, max_size=count)))
    t.sort()
    reach = data.draw(st.lists(st.integers(0, chunk - 1), min_size=count, max_size=count))
    order = np.argsort(np.arange(count) + reach, kind="stable")  # none passes more than chunk - 1 others
    t = t[order]
    events = Events(t, np.arange(count).astype("u2"), np.zeros(count, "u2"), np.zeros(count, "u1"))
    source = Source("r", (100, 1), lambda event: f"event {event}")
    raw = (events[i : i + chunk] for i in range(0, count, chunk))
    late = int((t < np.maximum.accumulate(t)).sum())
    if late:
        with pytest.warns(DataWarning, match=f"{late} of {count} events"):
            parts = list(checked(raw, source))
    else:
        parts = list(checked(raw, source))
    same(Events.join(parts), events[np.argsort(t, kind="stable")])


@pytest.mark.parametrize(
    ("text", "microseconds"),
    [
        ("13.595874999000001", 13_595_875),
        ("1468940293.844896", 1_468_940_293_844_896),
        ("1468940293.8448964999", 1_468_940_293_844_896),
        ("0.9999996", 1_000_000),
        ("2.09714", 2_097_140),
        ("3", 3_000_000),
        (".5", 500_000),
        ("1.", 1_000_000),
        ("-0.25", -250_000),
        ("1.5e-3", 1_500),
    ],
)
def test_times_are_exact_to_the_microsecond(tmp_path, text, microseconds):
    (tmp_path / "events.txt").write_text(f"{text} 1 2 1\n")
    assert next(read_text(tmp_path / "events.txt", 10)).t.tolist() == [microseconds]


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("digits", [(6, 6), (6, 9), (7, 9), (9, 9), (1, 5), (1, 9)])
def test_many_plain_lines_are_exact_to_the_microsecond(end, digits):
    """However many digits stand behind the dots; what is beyond the sixth is rounded, half up."""
    rng = np.random.default_rng(digits)
    micro, beyond = rng.integers(0, 10**9, 500), rng.choice([50, 450, 550, 950], 500)  # nanoseconds
    width = rng.integers(digits[0], digits[1] + 1, 500)
    exact = micro - micro % 10 ** np.maximum(6 - width, 0)
    seconds = [f"{m // 10**6}.{f'{m % 10**6:06d}{b:03d}'[:w]}" for m, b, w in zip(exact, beyond, width, strict=True)]
    up = (width > 6) & (beyond > 500)
    x, y, p = (rng.integers(0, most, 500) for most in (240, 180, 2))
    lines = "".join(f"{s} {a} {b} {c}{end}" for s, a, b, c in zip(seconds, x, y, p, strict=True)).encode()
    same(_plain(_tidy(lines, Form()), Form()), Events(exact + up, x.astype("u2"), y.astype("u2"), p.astype("u1")))


@pytest.mark.parametrize("line", [b"1.0 2 3 1\r5\n", b"1.0 2 3\r1 \n", b"1.0 2 3 1\n\r", b"1 0.2 3 1\r\n"])
def test_marks_in_another_place_are_not_read_as_plain_lines(line):
    good = b"1.0 2 3 1\r\n"
    assert _plain(_tidy(good + good, Form()), Form()) is not None
    assert _plain(_tidy(good + line, Form()), Form()) is None


def test_tabs_spaces_and_floats_that_are_whole_are_read(tmp_path):
    (tmp_path / "events.txt").write_text("0.1\t1\t2\t1\n0.2   3 4  0 \n\n1e-1 1.0e+01 4.0 1.0\n")
    events = next(read_text(tmp_path / "events.txt", 10))
    assert (events.x.tolist(), events.y.tolist(), events.p.tolist()) == ([1, 3, 10], [2, 4, 4], [1, 0, 1])


def test_a_byte_order_mark_is_passed_over(tmp_path):
    mark = b"\xef\xbb\xbf"
    (tmp_path / "events.txt").write_bytes(mark + b"0.1 1 2 1\n0.2 3 4 0")
    (tmp_path / "calib.txt").write_bytes(mark + ECD.encode())
    (tmp_path / "groundtruth.txt").write_bytes(mark + ("0" + POSE + "1" + POSE).encode())
    recording = open(tmp_path, OpenOptions(sensor=(240, 180)))
    assert (next(recording.chunks()).t.tolist(), recording.camera, recording.truth.time.tolist()) == ([100_000, 200_000], DAVIS, [0, 10**6])
    (tmp_path / "other.name").write_bytes(mark + b"0.1 1 2 1\n")
    assert len(next(open(tmp_path / "other.name", OpenOptions(sensor=(240, 180))).chunks())) == 1
    with zipfile.ZipFile(tmp_path / "r.zip", "w") as archive:
        for name in ("events.txt", "calib.txt"):
            archive.write(tmp_path / name, name)
    assert next(open(tmp_path / "r.zip", OpenOptions(sensor=(240, 180))).chunks()).x.tolist() == [1, 3]


@pytest.mark.parametrize("first", ["-0.1 1 2 1", "+0.1 1 2 1", "1e-3 1 2 1", "# head\n.5 1 2 1"])
def test_events_are_known_whatever_the_name(tmp_path, first):
    (tmp_path / "events.dat").write_text(first + "\n")
    assert len(next(open(tmp_path / "events.dat", OpenOptions(camera="pinhole", sensor=(9, 9))).chunks())) == 1


def test_two_recordings_in_a_folder_are_told(tmp_path):
    events = Events(np.array([1]), np.array([2], "u2"), np.array([3], "u2"), np.array([1], "u1"))
    save(Recording(tmp_path, "a", FISHEYE, lambda: iter([events])), tmp_path / "events.h5")
    (tmp_path / "events.txt").write_text("0.1 1 2 1\n")
    with pytest.warns(DataWarning, match=r"holds events.h5 and events.txt; events.txt is ignored"):
        assert open(tmp_path).camera == FISHEYE


def test_times_up_to_the_bound_are_read_from_text_and_hdf5(tmp_path):
    t = np.array([-(2**60), 2**60])
    (tmp_path / "a.txt").write_text(f"{t[0] / 1e6:.1f} 1 2 1\n{t[1] / 1e6:.1f} 1 2 1\n")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, data in (("t", t), ("x", [1, 1]), ("y", [2, 2]), ("p", [1, 1])):
            file[f"events/{name}"] = data
    for name in ("a.txt", "a.h5"):
        found = next(open(tmp_path / name, OpenOptions(camera="pinhole", sensor=(9, 9))).chunks()).t
        np.testing.assert_allclose(found, t, atol=1e6)
        assert found[1] - found[0] > 0


def test_hdf5_attributes_may_be_arrays_of_one_number(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs.update(width=np.array([80.0]), height=np.array([60]))
        file.create_group("calib").attrs.update(fx=np.array([50]), fy=50, cx=40, cy=30, k1=0.1)
        for name in "txyp":
            file[f"events/{name}"] = [1]
    assert open(tmp_path / "a.h5").camera == Camera((60, 80), 50, 50, 40, 30, (0.1, 0, 0, 0, 0))


def test_a_camera_file_goes_before_calib_txt(tmp_path):
    (tmp_path / "events.txt").write_text("0.1 1 2 1\n")
    (tmp_path / "calib.txt").write_text(ECD)
    file = tmp_path / "my.yaml"
    text = "# mine\nmodel: kannala_brandt\nwidth: 80\nheight: 60\nfx: 40\nfy: 41\ncx: 39.5\ncy: 29.5\n"
    file.write_text(text + "distortion: [0.01, -0.002, 3.0e-4, 0]\n")
    assert open(tmp_path, OpenOptions(camera=str(file))).camera == FISHEYE
    file.write_text("{width: 80, height: 60, fx: 40, fy: 40, cx: 39.5, cy: 29.5}")
    assert open(tmp_path, OpenOptions(camera=str(file))).camera == Camera((60, 80), 40, 40, 39.5, 29.5)
    file.write_text("# fx fy cx cy\n50 50 64 64")
    assert open(tmp_path, OpenOptions(camera=str(file))).camera == Camera((128, 128), 50, 50, 64, 64)
    assert open(tmp_path, OpenOptions(camera="pinhole")).camera == Camera.pinhole((128, 128))


def test_own_files_keep_truth_plane_and_camera(tmp_path):
    plane = Plane(torch.tensor([[0.6, 0.0, -0.8]], dtype=torch.float64), torch.tensor([0.7], dtype=torch.float64))
    events = Events(np.array([1]), np.array([2], "u2"), np.array([3], "u2"), np.array([1], "u1"))
    save(Recording(tmp_path, "öl", FISHEYE, lambda: iter([events]), None, a_trajectory(), plane), tmp_path / "a.h5")
    (tmp_path / "calib.txt").write_text("what stands beside a complete file is not its own")
    found = open(tmp_path / "a.h5")
    assert (found.camera, found.name, found.count) == (FISHEYE, "öl", 1)
    assert torch.equal(found.truth.time, a_trajectory().time)
    assert torch.equal(found.truth.pose.t, a_trajectory().pose.t)
    torch.testing.assert_close(found.truth.pose.R, a_trajectory().pose.R, rtol=0, atol=1e-15)
    assert torch.equal(found.plane.normal, plane.normal)
    assert torch.equal(found.plane.distance, plane.distance)
    assert [entry.name for entry in sorted(tmp_path.iterdir())] == ["a.h5", "calib.txt"]


def test_a_recording_can_be_saved_over_itself(tmp_path):
    events = Events(np.arange(9), np.arange(9).astype("u2"), np.zeros(9, "u2"), np.ones(9, "u1"))
    save(Recording(tmp_path, "a", FISHEYE, lambda: iter([events])), tmp_path / "a.h5")
    save(open(tmp_path / "a.h5", OpenOptions(chunk=2)), tmp_path / "a.h5")
    same(Events.join(list(open(tmp_path / "a.h5").chunks())), events)


@pytest.mark.parametrize(
    ("name", "count", "first", "last", "size"),
    [
        ("real/ecd/boxes_rotation", 30_000, 49_006_624, 49_012_158, (180, 240)),
        ("real/ecd/boxes_rotation_13s", 30_000, 13_582_596, 13_595_875, (180, 240)),
        ("real/ecd/shapes_rotation_2s", 20_000, 2_097_134, 2_195_729, (180, 240)),
        ("real/slider_depth", 50_000, 3_811, 174_156, (180, 240)),
        ("real/dvs128/garfield", 202_235, 0, 738_000, (128, 128)),
        ("sim/poster_translation_clean", 2_296_042, 807, 2_499_999, (180, 240)),
        ("sim/rotation_panorama_sim", 5_099_145, 0, 5_999_999, (180, 240)),
    ],
)
def test_the_recordings_at_hand_open(shared, name, count, first, last, size):
    recording = open(shared / "data" / name, OpenOptions(camera="pinhole" if "dvs128" in name else ""))
    events = Events.join(list(recording.chunks()))
    assert (len(events), events.t[0], events.t[-1], recording.camera.size) == (count, first, last, size)
    assert recording.name == Path(name).name
    assert recording.count in (None, count)
    assert (recording.truth is not None) == ("sim" in name or "slider" in name)
    assert (recording.plane is not None) == ("poster" in name)
    if "sim" in name:
        assert recording.camera == DAVIS


def test_the_simulators_file_alone_tells_camera_truth_and_plane(shared, tmp_path):
    folder = shared / "data/sim/poster_translation_clean"
    (tmp_path / "alone.h5").symlink_to(folder / "events.h5")
    alone, whole = open(tmp_path / "alone.h5"), open(folder)
    assert alone.camera == whole.camera
    assert torch.equal(alone.truth.time, whole.truth.time)
    torch.testing.assert_close(alone.truth.pose.t, whole.truth.pose.t, rtol=0, atol=1e-8)
    torch.testing.assert_close(alone.plane.normal, whole.plane.normal, rtol=0, atol=1e-8)


MEMORY = """
import sys
import torchcmax.io as io
def peak():  # KiB; getrusage would also count what the parent held before it started this process
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM"))
def read(name):
    options = io.OpenOptions(camera="pinhole", sensor=(240, 180), chunk=1 << 16)
    return sum(map(len, io.open(sys.argv[1] + name, options).chunks()))
read("/small.txt")
before = peak()
print(read("/events.txt"), peak() - before)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory of one process is read from /proc")
def test_memory_does_not_grow_with_the_file(tmp_path):
    block = "".join(f"{{}}.{i:06d} {i % 240} {i % 180} {i % 2}\n" for i in range(0, 1_000_000, 10))
    with (tmp_path / "events.txt").open("w") as file:
        file.writelines(block.replace("{}", str(second)) for second in range(30))
    (tmp_path / "small.txt").write_text("0.1 1 2 1\n")
    command = [sys.executable, "-c", MEMORY, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2])
    count, grown = map(int, done.stdout.split())
    assert count == 3_000_000
    assert grown < 32 * 1024  # KiB; measured: 16 MiB, and 111 MiB where all events are held at once
