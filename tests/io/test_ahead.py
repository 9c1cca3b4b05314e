"""A thread that reads ahead changes nothing but the time it takes."""

import subprocess
import sys
import textwrap
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

from torchcmax.core.camera import Camera
from torchcmax.io import DataError, DataNote, DataWarning, Events, Recording
from torchcmax.io.ahead import ahead
from torchcmax.io.errors import tell

CAMERA = Camera((5, 7), 6.0, 6.5, 3.0, 2.0)


def readers():
    return [thread for thread in threading.enumerate() if thread.name.startswith("ahead")]


@pytest.fixture(autouse=True)
def no_thread_is_left():
    yield
    assert not readers()


def counting(count, log=None, error=None):
    """0, 1, ...; what happens is written to the log."""
    log = [] if log is None else log
    try:
        for i in range(count):
            log.append(f"made {i}")
            yield i
        if error:
            raise error
    finally:
        log.append("closed")


def test_everything_comes_once_and_in_order():
    assert list(ahead(counting(100))) == list(range(100))
    assert list(ahead(counting(0))) == []


def test_nothing_is_read_before_it_is_asked_for():
    log = []
    things = ahead(counting(5, log))
    assert not log
    things.close()
    assert not log


def test_the_next_is_made_meanwhile_and_no_more_than_one():
    log = []
    things = ahead(counting(5, log))
    assert next(things) == 0
    for _ in range(1000):  # without the thread this would never become true
        if log == ["made 0", "made 1"]:
            break
        time.sleep(0.01)
    time.sleep(0.05)
    assert log == ["made 0", "made 1"]
    things.close()


def test_an_error_comes_after_what_was_read_before_it():
    error = DataError("events.txt", "letters in a column", "mend it", "line 7")
    things = ahead(counting(2, error=error))
    assert [next(things), next(things)] == [0, 1]
    with pytest.raises(DataError) as caught:
        next(things)
    assert caught.value is error
    assert list(things) == []


def test_closing_early_closes_the_source_and_ends_the_thread():
    log = []
    things = ahead(counting(1000, log))
    assert next(things) == 0
    things.close()
    assert log[-1] == "closed"
    assert len(log) <= 3


def test_leaving_the_loop_is_enough():
    log = []
    for _ in ahead(counting(1000, log)):
        break
    assert log[-1] == "closed"
    assert not readers()


def test_an_interrupt_in_the_callers_work_closes_the_source():
    log = []

    def work():
        for i in ahead(counting(1000, log)):
            if i == 3:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    assert log[-1] == "closed"


def test_warnings_come_in_the_callers_thread_and_not_before_their_place():
    def source():
        yield 0
        tell(DataNote("between"))
        yield 1
        tell(DataWarning("at the end"))

    seen = []
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = lambda message, *_: seen.append((str(message), threading.current_thread()))
        for i in ahead(source()):
            seen.append(i)
            time.sleep(0.05)  # time enough for the thread to come to the next warning
    here = threading.main_thread()
    assert seen == [0, ("between", here), 1, ("at the end", here)]


@pytest.mark.parametrize("taken", [0, 1, 2])
def test_warnings_of_a_source_that_is_closed_early_are_told(taken):
    def source():
        try:
            yield from range(10)
        finally:
            tell(DataWarning("closed"))

    things = ahead(source())
    for _ in range(taken):
        next(things)
    if taken:
        with pytest.warns(DataWarning, match="closed"):
            things.close()
    else:
        things.close()  # it never began


def test_a_warning_that_filters_make_an_error_stops_the_caller():
    def source():
        yield 0
        tell(DataWarning("mended"))
        yield 1

    things = ahead(source())
    assert next(things) == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(DataWarning, match="mended"):
            next(things)
    assert not readers()


def test_a_filter_that_stands_only_while_the_thread_warns_does_not_swallow_the_warning():
    """Warnings are filtered as the caller wants them when they reach it, not as they are when the thread comes upon them."""
    come, go = threading.Event(), threading.Event()

    def source():
        yield 0
        come.wait(10)
        tell(DataWarning("mended"))
        go.set()
        yield 1

    things = ahead(source())
    next(things)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        come.set()
        assert go.wait(10)
    with pytest.warns(DataWarning, match="mended"):
        assert list(things) == [1]


def test_windows_read_ahead_are_those_read_in_turn():
    t = np.arange(1000) // 2
    events = Events(t, (t % 7).astype("u2"), (t % 5).astype("u2"), (t % 2).astype("u1"))
    recording = Recording(Path("r"), "r", CAMERA, lambda: (events[i : i + 64] for i in range(0, 1000, 64)))
    for one, other in zip(recording.windows(30, 20, 3), ahead(recording.windows(30, 20, 3)), strict=True):
        assert all((getattr(one, name) == getattr(other, name)).all() for name in ("ray", "dt", "polarity", "start", "duration"))


def run(code):
    """A fresh Python process, which must end by itself; -> exit status and what it said."""
    code = "from torchcmax.io.ahead import ahead\nimport itertools, signal, sys, time\n" + textwrap.dedent(code)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    return done.returncode, done.stdout, done.stderr


def test_a_process_ends_though_nobody_closed_or_finished():
    code = """
        def slow():
            for i in itertools.count():
                time.sleep(0.2)
                yield i
        things = ahead(slow())
        print(next(things), next(things))
    """
    assert run(code) == (0, "0 1\n", "")


def test_ctrl_c_while_waiting_for_the_reader_ends_the_process_and_closes_the_source():
    code = """
        def slow():
            try:
                yield 0
                time.sleep(0.3)  # until the main thread waits
                signal.raise_signal(signal.SIGINT)
                time.sleep(0.5)
                yield 1
            finally:
                print("closed")
        try:
            for thing in ahead(slow()):
                print(thing)
        except KeyboardInterrupt:
            print("interrupted")
    """
    assert run(code) == (0, "0\nclosed\ninterrupted\n", "")


def test_the_source_is_closed_and_its_error_told_also_where_warnings_are_errors():
    closed, told = [], threading.Event()

    def source(fails):
        try:
            yield 1
            tell(DataWarning("something"))
            told.set()
            if fails:
                raise DataError("file", "is broken", "mend it")
            yield 2
        finally:
            closed.append(True)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(DataError, match="is broken"):
            list(ahead(source(True)))
        told.clear()
        reading = ahead(source(False))
        assert next(reading) == 1
        assert told.wait(10)
        with pytest.raises(DataWarning):
            reading.close()
    assert closed == [True, True]
