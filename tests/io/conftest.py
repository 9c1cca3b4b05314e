"""A recording as text, good or bad."""

import pytest
from samples import CALIB, GOOD


@pytest.fixture
def folder(tmp_path):
    """Writes a recording as text and returns its folder."""

    def write(events=GOOD, calib=CALIB):
        (tmp_path / "events.txt").write_bytes(events.encode() if isinstance(events, str) else events)
        if calib:
            (tmp_path / "calib.txt").write_text(calib)
        return tmp_path

    return write
