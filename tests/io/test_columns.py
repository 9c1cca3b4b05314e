"""Text in any order of columns, unit and separator, as labs write it."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mutated import assert_safe
from samples import read, refused

from torchcmax.io import DataError, DataNote, OpenOptions, open
from torchcmax.io.columns import Form, form_of

ORDERS = ("txyp", "xypt", "xytp", "tpxy")
UNITS = {"s": 10**6, "ms": 10**3, "us": 1, "ns": Fraction(1, 1000)}


def rows(count=300, seed=0):
    """Microseconds, pixels and polarities of events that tell which column is which."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(10**6, 9 * 10**6, count))
    return np.stack([t, rng.integers(0, 240, count), rng.integers(0, 180, count), rng.integers(0, 2, count)], 1).tolist()


def written(events, order, *, separator=" ", time=str, dark="0", end="\n", head=""):
    """Events as text; time: µs -> how it is written."""
    lines = []
    for t, x, y, p in events:
        words = {"t": time(t), "x": str(x), "y": str(y), "p": "1" if p else dark, "-": "7"}
        lines.append(separator.join(words[name] for name in order) + end)
    return head + "".join(lines)


def same(events, expected):
    assert np.stack([events.t, events.x, events.y, events.p], 1).astype(np.int64).tolist() == expected


def in_seconds(t):
    return f"{t // 10**6}.{t % 10**6:06d}"


@pytest.mark.parametrize("separator", [" ", "\t", ",", ";", ", ", "   "])
@pytest.mark.parametrize("order", ORDERS)
def test_the_values_tell_the_order(tmp_path, order, separator):
    (tmp_path / "a.txt").write_text(written(rows(), order, separator=separator, time=in_seconds))
    same(read(tmp_path / "a.txt", camera="pinhole"), rows())


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("dark", ["0", "-1"])
@pytest.mark.parametrize("order", ORDERS)
def test_whole_numbers_are_microseconds_and_that_is_told(tmp_path, order, dark, end):
    (tmp_path / "a.csv").write_text(written(rows(), order, separator=",", dark=dark, end=end))
    with pytest.warns(DataNote, match="taken for us"):
        same(read(tmp_path / "a.csv", camera="pinhole"), rows())


@pytest.mark.parametrize(
    ("head", "order", "unit"),
    [
        ("t,x,y,p\n", "txyp", "us"),
        ("t_us,x,y,p\n", "txyp", "us"),
        ("timestamp [us], x, y, polarity\n", "txyp", "us"),
        ("# timestamp(ns) x y pol\n", "txyp", "ns"),
        ("x,y,pol,time_ns\n", "xypt", "ns"),
        ('"x","y","p","t_ms"\n', "xypt", "ms"),
        ("polarity;y;x;timestamp_us\n", "pyxt", "us"),
        ("t_us,x,y,label,on\n", "txy-p", "us"),
        ("# recorded on a Monday\n# y_px x_px t_ns p\n", "yxtp", "ns"),
    ],
)
def test_names_tell_the_order_and_the_unit(tmp_path, head, order, unit):
    separator = "," if "," in head else ";" if ";" in head else " "
    events = [[t - t % 1000, x, y, p] for t, x, y, p in rows()]  # whole ms
    text = written(events, order, separator=separator, time=lambda t: str(int(t / UNITS[unit])), head=head)
    (tmp_path / "a.csv").write_text(text)
    same(read(tmp_path / "a.csv", camera="pinhole"), events)


@pytest.mark.filterwarnings("error::torchcmax.io.errors.DataNote")
def test_a_unit_that_is_told_needs_no_note(tmp_path):
    events = [[t, x, y, p] for t, (_, x, y, p) in enumerate(rows(), 10**6)]
    (tmp_path / "a.csv").write_text(written(events, "txyp", separator=",", head="t_us,x,y,p\n"))
    same(read(tmp_path / "a.csv", camera="pinhole"), events)


def test_a_first_line_of_two_numbers_is_the_sensor(tmp_path):
    (tmp_path / "a.txt").write_text(written(rows(), "txyp", time=in_seconds, head="346 260\n"))
    recording = open(tmp_path / "a.txt", OpenOptions(camera="pinhole"))
    assert recording.camera.size == (260, 346)
    same(next(recording.chunks()), rows())


def test_nanoseconds_since_1970_can_only_be_that(tmp_path):
    events = [[t + 1_700_000_000_000_000, x, y, p] for t, x, y, p in rows()]
    (tmp_path / "a.txt").write_text(written(events, "xypt", time=lambda t: str(t * 1000 + 499)))
    same(read(tmp_path / "a.txt", camera="pinhole"), events)


def test_whole_numbers_too_far_apart_are_not_guessed(tmp_path):
    (tmp_path / "a.txt").write_text(written(rows(), "txyp", time=lambda t: str(t * 1000)))
    refused(tmp_path / "a.txt", "in no unit that anybody tells", "t_us,x,y,p", camera="pinhole")


@pytest.mark.parametrize(("lines", "told"), [("5 1 7 1\n", "t x y p or x y t p"), ("1 2 1 0\n9 4 9 1\n", "t x y p or x y t p")])
def test_what_may_be_read_in_two_ways_is_refused(tmp_path, lines, told):
    (tmp_path / "a.txt").write_text(lines)
    refused(tmp_path / "a.txt", told, "name the columns", camera="pinhole")


@pytest.mark.parametrize("order", ["txyp", "xypt", "xytp", "tpxy"])
@pytest.mark.parametrize("time", [lambda t: f"{t}.0", lambda t: f"{t:.18e}"])
def test_decimal_times_that_are_whole_and_far_apart_are_microseconds(tmp_path, order, time):
    """As np.savetxt writes integers that have become floating point."""
    (tmp_path / "a.txt").write_text(written(rows(), order, time=time))
    with pytest.warns(DataNote, match="whole numbers, and taken for us"):
        same(read(tmp_path / "a.txt", camera="pinhole"), rows())


@pytest.mark.parametrize("label", ["", "car"])
def test_columns_that_are_no_numbers_change_no_unit(tmp_path, label):
    (tmp_path / "a.csv").write_text(written(rows(), "txyp", separator=",", head="t,x,y,p,label\n", end=f",{label}\n"))
    with pytest.warns(DataNote, match="taken for us"):
        same(read(tmp_path / "a.csv", camera="pinhole"), rows())


@pytest.mark.parametrize("head", ["# x y t p\n# from a sensor on a car\n", "240 180\n# x y t p\n"])
def test_a_comment_that_names_the_columns_need_not_be_the_last_line_before_them(tmp_path, head):
    (tmp_path / "a.txt").write_text(head + "5 10 20 1\n8 2 21 0\n")
    same(read(tmp_path / "a.txt", camera="pinhole"), [[20, 5, 10, 1], [21, 8, 2, 0]])


def test_columns_in_another_order_than_usual_are_told(tmp_path):
    (tmp_path / "a.txt").write_text(written(rows(), "xypt", time=in_seconds))
    with pytest.warns(DataNote, match="columns are taken to be x y p t; if they are not: name the columns"):
        read(tmp_path / "a.txt", camera="pinhole")


@pytest.mark.parametrize("lines", ["5 7 10 1\n3 9 11 0\n9 8 12 1\n", "9 7 0 1\n" + "".join(f"{t} 7 {t // 9} 1\n" for t in range(200))])
def test_rows_that_rise_are_no_times_where_the_times_may_be_out_of_order(tmp_path, lines):
    (tmp_path / "a.txt").write_text(lines)
    refused(tmp_path / "a.txt", "t x y p or x y t p", "name the columns", camera="pinhole")


def test_a_fraction_behind_whole_numbers_that_nobody_tells_the_unit_of(tmp_path):
    (tmp_path / "a.txt").write_text(written(rows(3000), "txyp") + "9000000.5 1 2 0\n")
    refused(tmp_path / "a.txt", "line 3001", "9000000.5 is no whole number", camera="pinhole")


def test_an_exponent_beyond_all_measure_takes_no_time(tmp_path):
    (tmp_path / "a.txt").write_text("# t_us x y p\n1e-99999999 1 2 0\n")
    same(read(tmp_path / "a.txt", camera="pinhole"), [[0, 1, 2, 0]])


def test_words_that_are_no_numbers_are_told_as_that(tmp_path):
    (tmp_path / "a.csv").write_text('"1000","2","3","1"\n')
    refused(tmp_path / "a.csv", "is not a number", "line 1", camera="pinhole")


@pytest.mark.parametrize(
    "line",
    ["1.5,,2,3,1", "1.5,2,,1", "1.5 2 3 1", "1.5,2,3", "1.5,-1,3,1", "1.5,2,-1,0", "x,2,3,1", "1.5,2,3,1,", "--1.5,2,3,1", "1.5,2,3,1 # c"],
)
def test_a_wrong_line_is_named_behind_a_header(tmp_path, line):
    head = "# a camera\nt,x,y,p\n"
    text = written(rows(10), "txyp", separator=",", time=in_seconds, head=head) + line + "\n"
    (tmp_path / "a.csv").write_text(text + written(rows(10), "txyp", separator=",", time=in_seconds))
    refused(tmp_path / "a.csv", "line 13", line, "t,x,y,p, as the first lines are", camera="pinhole")


def test_an_event_off_the_sensor_is_named_by_its_line(tmp_path):
    (tmp_path / "a.csv").write_text("240,180\nt_us,x,y,p\n1,2,3,0\n2,240,3,1\n")
    refused(tmp_path / "a.csv", "line 4", "(240, 3)", sensor=None, camera="pinhole")


def test_a_last_line_that_is_cut_off_is_told_for_any_separator(tmp_path):
    (tmp_path / "a.csv").write_text(written(rows(), "xypt", separator=";", time=in_seconds) + "12;3")
    refused(tmp_path / "a.csv", "the last line is cut off", "line 301", camera="pinhole")


def test_names_in_blocks_of_any_size_are_passed_over(tmp_path):
    from torchcmax.io.events import Events
    from torchcmax.io.text import check_text, line_of, read_text

    (tmp_path / "a.csv").write_text(written(rows(), "pyxt", separator=",", head="# one\n# two\np,y,x,t_us\n", dark="-1"))
    form = check_text(tmp_path / "a.csv")
    for block in (1, 7, 40, 1 << 20):
        same(Events.join(list(read_text(tmp_path / "a.csv", 37, block, form))), rows())
    assert line_of(tmp_path / "a.csv", 5, form) == "line 9"


@pytest.mark.parametrize("other", ["groundtruth.txt", "imu.txt", "images.txt", "plane.txt"])
def test_the_only_text_of_events_in_a_folder_is_found(tmp_path, other):
    (tmp_path / "events.csv").write_text(written(rows(), "txyp", separator=",", head="t_us,x,y,p\n"))
    (tmp_path / "calib.txt").write_text("200 200 120 90 0 0 0 0 0\n")
    (tmp_path / other).write_text(
        {"groundtruth.txt": "0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "plane.txt": "0 0 -1 2\n"}.get(other, "0.1 1 1 1\n")
    )
    assert open(tmp_path, OpenOptions(sensor=(240, 180))).path == tmp_path / "events.csv"
    (tmp_path / "more.CSV").write_text(written(rows(), "txyp", separator=",", head="t_us,x,y,p\n"))
    with pytest.raises(DataError, match=r"several recordings: events\.csv, more\.CSV"):
        open(tmp_path)


@pytest.mark.parametrize("line", ["0.1 1 2 3 4 5 6", "0.1 1 2 3 4 5 6 7", "0.1 images/frame_00000000.png", "240 180"])
def test_other_texts_are_no_events(tmp_path, line):
    (tmp_path / "a.txt").write_text((line + "\n") * 3)
    refused(tmp_path / "a.txt", "its first line is no event", camera="pinhole")


NUMBERS = st.integers(0, 9_999_999_999)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(NUMBERS, st.integers(0, 65535), st.integers(0, 65535), st.booleans()), min_size=2, max_size=20),
    st.permutations("txyp-"),
    st.sampled_from([" ", "\t", ",", ";", ", "]),
    st.sampled_from(["s", "ms", "us", "ns", "fraction", "us_fraction"]),
    st.sampled_from(["0", "-1"]),
    st.sampled_from(["\n", "\r\n"]),
)
def test_any_form_is_read_as_line_by_line(tmp_path_factory, numbers, order, separator, unit, dark, end):
    """The quick way, whatever the form, against one line after the other with exact fractions."""
    from torchcmax.io.events import Events
    from torchcmax.io.text import check_text, read_text

    names = {"t": {"fraction": "t_s", "us_fraction": "t_us"}.get(unit, f"t_{unit}"), "x": "x", "y": "y", "p": "p", "-": "other"}
    text = written(numbers, order, separator=separator, time=in_seconds if "fraction" in unit else str, dark=dark, end=end)
    file = tmp_path_factory.mktemp("any") / "a.csv"
    file.write_text(separator.join(names[name] for name in order) + end + text, newline="")
    factor = {"fraction": 1, "us_fraction": Fraction(1, 10**6)}.get(unit) or UNITS[unit]
    expected = [[math.floor(Fraction(t) * factor + Fraction(1, 2)), x, y, int(p)] for t, x, y, p in numbers]
    same(Events.join(list(read_text(file, 100, form=check_text(file)))), expected)


@pytest.mark.parametrize(
    ("separator", "end"), [("\t", "\n"), (" \t", "\r\n"), (" , ", " \n"), (";", "\t\r\n"), ("   ", "\n"), (",", "\n"), (", ", "\r\n")]
)
@pytest.mark.parametrize(
    ("time", "pixel"), [(str, str), *((time, pixel) for time in (in_seconds, "{:.1f}".format) for pixel in (str, "{:.18e}".format))]
)
def test_no_form_that_is_the_same_in_every_line_is_read_line_by_line(tmp_path, monkeypatch, separator, end, time, pixel):
    from torchcmax.io import text as module

    monkeypatch.setattr(module, "_by_line", lambda *_: pytest.fail("line by line"))
    head = separator.join(["x", "t_s" if time is in_seconds else "t_us", "p", "y"]) + end
    lines = [separator.join([pixel(x), time(t), str(p), pixel(y)]) + end for t, x, y, p in rows()]
    (tmp_path / "a.csv").write_text(head + "".join(lines), newline="")
    same(read(tmp_path / "a.csv", camera="pinhole"), rows())


@pytest.mark.parametrize(("unit", "times"), [("s", [1_250_000, 1_500_001]), ("ms", [1250, 1500]), ("us", [1, 2]), ("ns", [0, 0])])
def test_decimal_numbers_have_the_unit_that_is_told(tmp_path, unit, times):
    (tmp_path / "a.csv").write_text(f"t_{unit},x,y,p\n1.25,5.0,2.0,1.0\n1.5000006,5e0,7,-1\n")
    same(read(tmp_path / "a.csv", camera="pinhole"), [[times[0], 5, 2, 1], [times[1], 5, 7, 0]])


def test_columns_that_are_aligned_are_not_read_line_by_line(tmp_path, monkeypatch):
    from torchcmax.io import text as module

    monkeypatch.setattr(module, "_by_line", lambda *_: pytest.fail("line by line"))
    (tmp_path / "a.txt").write_text("# t_us x y p\n" + "".join(f"{t:8d} {x:3d} {y:3d} {p:2d}\n" for t, x, y, p in rows()))
    same(read(tmp_path / "a.txt", camera="pinhole"), rows())


def test_what_stands_between_columns_is_the_same_in_every_line_or_refused(tmp_path):
    (tmp_path / "a.csv").write_text("# t_us x y p\n1, 5, 2, 1\n2,5 5, 2, 1\n")
    refused(tmp_path / "a.csv", "line 3", "'5 5' is not a number", camera="pinhole")


ODD = ["1.0", "7.", ".5", "+3", "-2", "-1", "2e1", "1e999", "nan", "1_0", "0x1", "", "1 2", "1\r2", "1,2", "é", "65536", '"1"', "# 1"]


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 10**8), st.integers(0, 999), st.integers(0, 999), st.sampled_from([-1, 0, 1])), min_size=1, max_size=4
    ),
    st.sampled_from([str, in_seconds, "{:.1f}".format, "{:.18e}".format]),
    st.sampled_from([" ", "\t", "  ", ",", ", ", " ;\t"]),
    st.sampled_from(["\n", "\r\n", " \n"]),
    st.lists(st.tuples(st.integers(0, 15), st.sampled_from(ODD)), max_size=2),
)
def test_every_way_of_reading_finds_the_same_events_or_the_same_fault(events, time, separator, end, odd):
    from torchcmax.io.text import _by_line, _parse

    lines = [[time(t), str(x), str(y), str(p)] for t, x, y, p in events]
    for place, word in odd:
        lines[place // 4 % len(lines)][place % 4] = word
    text = "".join(separator.join(words) + end for words in lines).encode()
    unit = Fraction(10**6 if time is in_seconds else 1)
    form = Form(separator=separator.strip() or " ", decimal=time is not str, unit=unit)

    def outcome(reading):
        try:
            found = reading()
        except DataError as error:
            return str(error)
        return np.stack([found.t, found.x, found.y, found.p], 1).astype(np.int64).tolist()

    assert outcome(lambda: _parse(text, 1, "a.csv", form)[0]) == outcome(lambda: _by_line(text, 1, "a.csv", form))


@pytest.mark.parametrize(
    ("order", "separator", "head"), [("xypt", ",", ""), ("tpxy", "\t", "# t_us p x y\n"), ("txyp", ";", "240;180\nt_ns;x;y;p\n")]
)
def test_broken_texts_of_other_forms(tmp_path, order, separator, head):
    text = written(rows(3000), order, separator=separator, head=head)
    assert_safe(tmp_path, text.encode(), 80, ".csv")


def test_a_form_of_nothing_but_names_has_no_events():
    assert form_of([(1, "t,x,y,p")]) == Form(skip=1, line=2)
