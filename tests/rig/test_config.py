"""A rig's file: what it says in SI, and that whatever is wrong is told with its line."""

import hashlib
import math
from pathlib import Path

import pytest

from torchcmax.rig.config import load
from torchcmax.rig.errors import Refused

CONFIGS = Path(__file__).parents[2] / "configs" / "rig"
TEXT = (CONFIGS / "slider.yaml").read_text()


@pytest.fixture
def changed(tmp_path):
    """The slider's file with a text replaced -> its path and the line of the change."""

    def write(old, new):
        assert TEXT.count(old) == 1, old
        path = tmp_path / "rig.yaml"
        path.write_text(TEXT.replace(old, new))
        return path, TEXT[: TEXT.index(old)].count("\n") + 1

    return write


def refused(path):
    with pytest.raises(Refused) as caught:
        load(path)
    message = str(caught.value)
    assert "what to do: " in message
    return message


def test_the_slider_in_si(slider):
    (x,) = slider.axes
    assert (slider.name, slider.moves, slider.supply, slider.bus.sync_period) == ("slider", "camera", 24.0, 1e-3)
    assert (x.motor.part, x.current_peak, x.cpt, x.serial, x.mode) == ("272763", 5.0, 500, None, "auto")
    assert x.transmission.max_input_speed == pytest.approx(8000 * 2 * math.pi / 60)
    assert (x.limits.min, x.limits.max, x.limits.j, x.limits.quick_stop) == (-0.02, 0.75, math.inf, 12)
    assert slider.digest == hashlib.sha256((CONFIGS / "slider.yaml").read_bytes()).hexdigest()


def test_rotary_axes_are_told_in_degrees(pantilt):
    pan, tilt = pantilt.axes
    assert pan.limits.v == pytest.approx(math.radians(500))
    assert tilt.limits.following == pytest.approx(math.radians(1))
    assert pan.transmission.travel == pytest.approx(2 * math.pi)
    assert tilt.point == (0, 0.05, 0)
    assert tilt.invert


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("v_mps: 1.4", "v_mp: 1.4", "did you mean v_mps"),
        ("v_mps: 1.4, ", "", "v_mps is missing in limits"),
        ("v_mps: 1.4", "v_mps: 1.4, v_mps: 1.5", "twice"),
        ("v_mps: 1.4", "v_mps: fast", "no finite number"),
        ("v_mps: 1.4", "v_mps: .nan", "no finite number"),
        ("v_mps: 1.4", "v_mps: .inf", "no finite number"),
        ("v_mps: 1.4", "v_mps: true", "no finite number"),
        ("v_mps: 1.4", "v_mps: [1]", "no finite number"),
        ("v_mps: 1.4", "v_mps: 0", "above 0"),
        ("v_mps: 1.4", "v_mps: null", "no finite number"),
        ("min_m: -0.02", "min_m: 0.75", "above 0.75"),
        ("max_m: 0.75", "max_m: 1.0e+6", "quadcounts"),
        ("mode: auto", "mode: csp", "interpolated and cyclic modes are out"),
        ("mode: auto", "mode: ipm", "interpolated and cyclic modes are out"),
        ("mode: auto", "mode: fast", "auto, ppm, pvm"),
        ("family: epos4", "family: epos3", "epos2, epos4"),
        ("node_id: 1", "node_id: 127", "at most 126"),  # whose heartbeat would be the host's
        ("sync_period_s: 0.001", "sync_period_s: 0.01", "at most 0.005"),
        ("current_peak_a: 5.0", "current_peak_a: 5e+6", "at most 65"),
        ("current_peak_a: 5.0", "current_peak_a: 1e-4", "at least 0.01"),
        ("speed_mps: 0.05", "speed_mps: 1e-6", "homing of axis has a speed of 0.0048 rpm"),
        ("v_mps: 1.4", "v_mps: 1e-5", "limits of axis has a speed of 0.048 rpm"),
        ("v_mps: 1.4", "v_mps: 1e14", "whole numbers from 1 to 2147483647"),
        ("v_mps: 1.4", "v_mps: 1e-300", "above 0"),
        ("a_mps2: 12", "a_mps2: 1e-6", "limits of axis has a change in a second of 0.0048"),
        ("quick_stop_mps2: 12", "quick_stop_mps2: 1e-6", "limits of axis has a quick stop in a second of 0.0048"),
        ("homing: {method: 17", "homing: {method: -3", "want the current, A, at which a stop is reached"),
        ("homing: {method: 17", "homing: {current_a: 1.0, method: 17", "do not go together"),
        ("homing: {method: 17", "homing: {current_a: 4.0, method: -4", "pushes with more than the motor's nominal current"),
        ("following_m: 0.003", "following_m: 1e-9", "following error that the drive cannot count"),
        ("input_speed_max_rpm: 8000", "input_speed_max_rpm: 0.1", "at least 1"),
        ("invert: false", "invert: !!bool [1]", "true or false"),
        ("invert: false", "invert: !!bool maybe", "true or false"),
        ("name: x\n", "name: ../x\n", "it wants letters"),
        ("name: x\n", 'name: "x,y"\n', "it wants letters"),
        ("name: x\n", 'name: "x\\ny"\n', "no text of one line"),
        ("name: slider", 'name: "\\ud800"', "no text of one line"),
        ("rig:\n", "? [a]\n: 1\nrig:\n", "unknown key a mapping or a list"),
        ("node_id: 1", "node_id: 1.5", "whole number"),
        ('part: "272763"', 'part: "272769"', "part of motor is unknown"),
        ("type: belt", "type: rotary", "belt, screw"),
        ("efficiency: 0.85", "efficiency: 85", "at most 1"),
        ("mass_kg: 2.0", "inertia_kgm2: 2.0", "unknown key inertia_kgm2"),
        ("method: 17", "method: 16", "the drives know"),
        ("speed_mps: 0.05", "speed_mps: 2", "faster than the axis may be"),
        ("offset_m: 0.01", "offset_m: 0.9", "outside of the limits"),
        ("invert: false", "invert: maybe", "true or false"),
        ("direction: [1, 0, 0]", "direction: [0, 0, 0]", "no length"),
        ("direction: [1, 0, 0]", "direction: [1, 0]", "wants 3"),
        ("T_ec: [0, 0, 0, 0, 0, 0, 1]", "T_ec: [0, 0, 0, 0, 0, 0, 2]", "length 1 with qw last"),
        ("bus_max_v: 45", "bus_max_v: 20", "above 24"),
        ("bitrate: 1000000", "bitrate: 900000", "one of 10000"),
        ("heartbeat_timeout_s: 0.1", "heartbeat_timeout_s: 0.01", "at least 0.04"),
        ("rate_hz: 1000", "rate_hz: 300", "whole part"),
        ("moves: camera", "moves: both", "camera, scene"),
        ("name: slider", "name: {}", "no text"),
    ],
)
def test_what_is_wrong_is_told_with_its_line(changed, old, new, told):
    path, line = changed(old, new)
    message = refused(path)
    assert told in message
    assert message.startswith(f"{path}, line {line}: ")


def test_a_number_may_be_written_with_a_bare_exponent(changed):
    path, _ = changed("a_mps2: 12", "a_mps2: 1e1")
    assert load(path).axes[0].limits.a == 10


def test_two_axes_want_two_names_and_two_nodes(tmp_path):
    text = (CONFIGS / "pantilt.yaml").read_text()
    for old, new in [("name: tilt", "name: pan"), ("node_id: 2", "node_id: 1")]:
        path = tmp_path / "rig.yaml"
        path.write_text(text.replace(old, new))
        assert f"two axes have the {new.replace(':', '')}" in refused(path)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "is empty"),
        (b"rig: [", "line 1: is no YAML"),
        (b"[" * 100000, "nested too deeply"),
        (b"{a: " * 5000, "nested too deeply"),
        (b"&a {*a : 1}", "unknown key a mapping or a list"),
        (b"- 1\n", "is no mapping"),
        (b"\xff\xfe", "no text in UTF-8"),
        (b"rig: !!python/object/apply:os.system [ls]\n", "line 1: "),
    ],
)
def test_what_is_no_rig_at_all(tmp_path, content, told):
    path = tmp_path / "rig.yaml"
    path.write_bytes(content)
    assert told in refused(path)


def test_a_file_that_is_not_there(tmp_path):
    assert "cannot be read" in refused(tmp_path / "none.yaml")
