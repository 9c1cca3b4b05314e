"""The camera makers' own formats against slow decoders that are written here, word by word, from the formats' documentation."""

import struct
import warnings
from xml.etree import ElementTree

import numpy as np
import pytest
from mutated import assert_safe

from torchcmax.io import DataError, DataNote, DataWarning, Events, OpenOptions, open

PINHOLE = OpenOptions(camera="pinhole")
RAW3 = b"% evt 3.0\n% format EVT3;height=720;width=1280\n% end\n"


@pytest.fixture(scope="module")
def formats(shared):
    return shared / "data/real/formats"


def read(path, **options):
    recording = open(path, OpenOptions(camera="pinhole", **options))
    return recording.camera.size[::-1], Events.join(list(recording.chunks()))


def same(events, expected):
    for name, column in zip("txyp", zip(*expected, strict=True), strict=True):
        assert np.array_equal(getattr(events, name), np.array(column)), name


def words(raw, kind):
    at = 0
    while raw[at : at + 2] == b"% ":
        at = raw.index(b"\n", at) + 1
    return np.frombuffer(raw[at : len(raw) - (len(raw) - at) % np.dtype(kind).itemsize], kind).tolist()


def slow_evt2(raw):
    high, found = None, []
    for word in words(raw, "<u4"):
        kind = word >> 28
        if kind == 8:
            high = word & 0xFFFFFFF
        elif kind < 2 and high is not None:
            found.append((high << 6 | word >> 22 & 63, word >> 11 & 0x7FF, word & 0x7FF, kind))
    return found


def slow_evt21(raw):
    high, found = None, []
    for word in words(raw, "<u8"):
        kind = word >> 60
        if kind == 8:
            high = word >> 32 & 0xFFFFFFF
        elif kind < 2 and high is not None:
            x, y, t = word >> 43 & 0x7FF, word >> 32 & 0x7FF, high << 6 | word >> 54 & 63
            found += [(t, x + i, y, kind) for i in range(32) if word >> i & 1]
    return found


def slow_evt3(raw):
    high, turns, low, row, base, polarity, found = None, 0, 0, 0, 0, 0, []
    for word in words(raw, "<u2"):
        kind, value = word >> 12, word & 0xFFF
        if kind == 8:
            turns += high is not None and value < high - 2048
            high = value
        elif kind == 6:
            low = value
        elif kind == 0:
            row = value & 0x7FF
        elif kind == 3:
            base, polarity = value & 0x7FF, value >> 11
        elif kind in (2, 4, 5):
            t = None if high is None else (turns << 24) + (high << 12) + low
            if kind == 2:
                found.append((t, value & 0x7FF, row, value >> 11))
            else:
                found += [(t, base + i, row, polarity) for i in range(12 if kind == 4 else 8) if value >> i & 1]
                base += 12 if kind == 4 else 8
    return [event for event in found if event[0] is not None]


def test_evt2_is_read_as_it_is_documented(formats):
    size, events = read(formats / "evt2.raw")
    assert size == (640, 480)
    assert len(events) == 521_252
    same(events, slow_evt2((formats / "evt2.raw").read_bytes()))


def test_evt3_is_read_as_it_is_documented(formats):
    size, events = read(formats / "evt3.raw")
    assert size == (1280, 720)
    same(events, slow_evt3((formats / "evt3.raw").read_bytes()))


def test_evt3_has_the_events_of_another_decoder(formats):
    """Whose clock goes on by 4,096 us wherever the low time goes back a little, though the high time, which the file repeats, does not."""
    _, events = read(formats / "evt3.raw")
    expected = np.load(formats / "evt3_expected.npy")
    for name in "xyp":
        assert np.array_equal(getattr(events, name), expected[name])
    ahead = expected["t"] - events.t
    assert not ahead[:20_121].any()
    assert set(np.unique(ahead[np.concatenate([[True], np.diff(expected["t"]) < 4096])] % 4096)) == {0}


@pytest.mark.parametrize("chunk", [7, 1000, 1 << 20])
def test_blocks_of_any_size_give_the_same_events(formats, tmp_path, chunk):
    raw = (formats / "evt3.raw").read_bytes()[: 30_000 if chunk == 7 else None]
    (tmp_path / "a.raw").write_bytes(raw)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # of what a small chunk cannot sort
        same(Events.join(list(open(tmp_path / "a.raw", PINHOLE).chunks())), slow_evt3(raw))
        from torchcmax.io.prophesee import contents

        same(Events.join(list(contents(tmp_path / "a.raw").events(chunk))), slow_evt3(raw))


def test_the_clock_of_evt3_goes_on_when_its_24_bits_begin_anew(tmp_path):
    body = struct.pack("<6H", 0x8FFF, 0x6FFF, 0x0005, 0x2807, 0x8000, 0x6001) + struct.pack("<H", 0x2008)
    (tmp_path / "a.raw").write_bytes(RAW3 + body)
    same(read(tmp_path / "a.raw")[1], [((1 << 24) - 1, 7, 5, 1), ((1 << 24) + 1, 8, 5, 0)])


def test_vectors_of_evt3_go_on_in_the_next_block(tmp_path):
    from torchcmax.io.prophesee import contents

    body = struct.pack("<8H", 0x8001, 0x6002, 0x0003, 0x3800 | 10, 0x4801, 0x4002, 0x5081, 0x4001)
    (tmp_path / "a.raw").write_bytes(RAW3 + body)
    expected = [(4098, x, 3, 1) for x in (10, 21, 23, 34, 41, 42)]
    assert slow_evt3(RAW3 + body) == expected
    for chunk in range(1, 9):
        same(Events.join(list(contents(tmp_path / "a.raw").events(chunk))), expected)


@pytest.mark.parametrize("legacy", [False, True])
def test_evt21_is_read_as_it_is_documented(tmp_path, legacy):
    rng = np.random.default_rng(0)
    body = [8 << 60 | 77 << 32]
    for i in range(2000):
        if i % 50 == 0:
            body.append(8 << 60 | (78 + i // 50) << 32)
        x, y, low = (int(rng.integers(0, most)) for most in (1280 - 32, 720, 1))
        body.append(int(rng.integers(0, 2)) << 60 | (low + i % 50) << 54 | x << 43 | y << 32 | int(rng.integers(1, 1 << 32)))
    data = np.array(body, "<u8")
    header = b"% evt 2.1\n% format EVT21;height=720;width=1280" + (b";endianness=legacy" if legacy else b"") + b"\n% end\n"
    plain = header + data.tobytes()
    (tmp_path / "a.raw").write_bytes(header + (data >> np.uint64(32) | data << np.uint64(32)).tobytes() if legacy else plain)
    size, events = read(tmp_path / "a.raw")
    assert size == (1280, 720)
    assert len(events) > 20_000
    same(events, slow_evt21(plain))


def test_dat_is_read_and_its_clock_goes_on_after_32_bits(tmp_path):
    rows = [((1 << 32) - 2, 3, 4, 1), ((1 << 32) - 1, 303, 239, 0), (1, 5, 6, 1)]
    body = b"".join(struct.pack("<II", t, x | y << 14 | p << 28) for t, x, y, p in rows)
    header = b"% Data file containing CD events.\n% Version 2\n% Height 240\n% Width 304\n"
    (tmp_path / "a.dat").write_bytes(header + b"\x0c\x08" + body)
    size, events = read(tmp_path / "a.dat")
    assert size == (304, 240)
    same(events, [*rows[:2], ((1 << 32) + 1, 5, 6, 1)])
    assert open(tmp_path / "a.dat", PINHOLE).count == 3


def slow_es(raw):
    """Event Stream 2, DVS: the size, then bytes of (dt, on) 7 + 1 bits and x, y; a byte of all ones is 127 us more."""
    assert raw[:12] == b"Event Stream"
    assert raw[15] == 1
    width, height = struct.unpack_from("<HH", raw, 16)
    t, at, found = 0, 20, []
    while at < len(raw):
        head = raw[at]
        at += 1
        if head == 0xFF:
            t += 127
            continue
        t += head >> 1
        found.append((t, *struct.unpack_from("<HH", raw, at), head & 1))
        at += 4
    return (width, height), found


def test_es_is_read_as_it_is_documented(formats):
    pytest.importorskip("faery")
    size, expected = slow_es((formats / "dvs.es").read_bytes())
    found, events = read(formats / "dvs.es")
    assert found == size == (320, 240)
    assert len(events) == len(expected)
    same(events, [(t, x, size[1] - 1 - y, p) for t, x, y, p in expected])


def test_aedat4_has_the_size_and_times_that_its_parts_tell(formats):
    """Of the events, only packets' places are told without its compression: here the header, against what the library makes of it."""
    pytest.importorskip("faery")
    raw = (formats / "davis346.aedat4").read_bytes()
    tree = ElementTree.fromstring(raw[raw.index(b"<dv") : raw.index(b"</dv>") + 5])
    told = {one.get("key"): one.text for one in tree.iter("attr") if one.get("key") in ("sizeX", "sizeY", "tsOffset")}
    size, events = read(formats / "davis346.aedat4")
    assert size == (int(told["sizeX"]), int(told["sizeY"]))
    assert len(events) == 111_954
    assert int(told["tsOffset"]) < events.t[0] <= events.t[-1] < int(told["tsOffset"]) + 24 * 3600 * 10**6
    assert (np.diff(events.t) >= 0).all()
    assert (events.x.max(), events.y.max()) == (size[0] - 1, size[1] - 1)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b"% evt 4.0\n\0\0\0\0", "EVT4"),
        (b"% Date 2020\n\0\0\0\0", "none is named"),
        (b"% evt 2.0\n", "holds no events"),
        (b"% Version 2\n% Height 2\n% Width 2\n\x0c\x04abcd", "8 bytes"),
        (b"#!AER-DAT4.0\r\n", "header is broken"),
        (b"#!AER-DAT4.0\r\n<dv><attr key='typeIdentifier'>IMUS</attr></dv>", "only IMUS"),
        (b"Event Stream", "cannot be read"),
    ],
)
def test_a_header_that_tells_nothing_is_refused(tmp_path, body, words):
    if words in ("cannot be read",):
        pytest.importorskip("faery")
    (tmp_path / "a.raw").write_bytes(body)
    with pytest.raises(DataError, match=words):
        read(tmp_path / "a.raw")


def test_a_file_that_ends_within_a_word_is_read_up_to_there(formats, tmp_path):
    raw = (formats / "evt2.raw").read_bytes()[:100_003]
    (tmp_path / "a.raw").write_bytes(raw)
    with pytest.warns(DataWarning, match="ends within a word"):
        _, events = read(tmp_path / "a.raw")
    same(events, slow_evt2(raw))


def test_events_before_the_first_time_are_told(tmp_path):
    (tmp_path / "a.raw").write_bytes(RAW3 + struct.pack("<5H", 0x2001, 0x8000, 0x6001, 0x2003, 0x2004))
    with pytest.warns(DataNote, match="1 events before the first time"):
        _, events = read(tmp_path / "a.raw")
    same(events, [(1, 3, 0, 0), (1, 4, 0, 0)])


@pytest.mark.parametrize(
    ("name", "header", "most"),
    [("evt2.raw", 150, 300_000), ("evt3.raw", 200, 200_000), ("dvs.es", 16, 200_000), ("davis346.aedat4", 2334, None)],
)
def test_a_broken_file_ends_in_a_data_error_or_is_read_as_far_as_it_goes(formats, tmp_path, name, header, most):
    if not name.endswith("raw"):
        pytest.importorskip("faery")
    assert_safe(tmp_path, (formats / name).read_bytes()[:most], header, "." + name.split(".")[1])


@pytest.mark.parametrize("form", ["EVT21", "dat"])
def test_a_broken_file_of_the_other_formats_too(tmp_path, form):
    rng = np.random.default_rng(0)
    if form == "dat":
        header = b"% Data file containing CD events.\n% Version 2\n% Height 240\n% Width 304\n\x0c\x08"
        t = np.sort(rng.integers(0, 10**6, 5000))
        place = rng.integers(0, 304, 5000) | rng.integers(0, 240, 5000) << 14 | rng.integers(0, 2, 5000) << 28
        body = np.stack([t, place], 1).astype("<u4").tobytes()
    else:
        header = b"% format EVT21;height=720;width=1280\n% end\n"
        body = np.array([8 << 60 | 5 << 32, *(1 << 60 | i << 54 | 9 << 43 | 8 << 32 | 255 for i in range(64))] * 50, "<u8").tobytes()
    assert_safe(tmp_path, header + body, len(header), ".dat" if form == "dat" else ".raw")
