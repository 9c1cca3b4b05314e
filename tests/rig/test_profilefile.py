"""Files of motions: what they say, and that whatever is wrong is told with its line."""

import contextlib
import math
import re
import warnings
from pathlib import Path

import pytest

from torchcmax.rig.errors import Refused
from torchcmax.rig.plan import plan
from torchcmax.rig.profilefile import load_profile
from torchcmax.rig.profiles import Dwell, Move

CONFIGS = Path(__file__).parents[2] / "configs" / "rig"


@pytest.fixture
def written(tmp_path):
    """Steps, one a line -> the file of them."""

    def write(*steps):
        path = tmp_path / "profile.yaml"
        path.write_text("profile:\n" + "".join(f"  - {step}\n" for step in steps))
        return path

    return write


@pytest.mark.parametrize(("rig", "profile"), [("slider", "slider_pass"), ("pantilt", "pantilt_sweep")])
def test_the_examples_are_accepted(request, rig, profile):
    rig = request.getfixturevalue(rig)
    found = plan(rig, load_profile(CONFIGS / f"{profile}.yaml", rig), cycles=100)
    found.refuse()
    assert found.image_speed > 100


def test_a_step_of_each_kind(slider, written):
    steps = load_profile(
        written(
            "{axis: x, move: {to_m: 0.3, v_mps: 0.5, a_mps2: 2, j_mps3: 50}}",
            "{axis: x, dwell_s: 0.5}",
            "{axis: x, pass: {x0_m: 0.2, x1_m: 0.6, v_mps: 1.0}}",
            "{axis: x, cruise: {v_mps: -0.2, hold_s: 1}}",
            "{axis: x, sync: {from_m: 0.1, to_m: 0.2}}",
            "{axis: x, return: {v_mps: 0.2}}",
        ),
        slider,
    )
    move, dwell, through, cruise, pattern, back = (step[0] for step in steps)
    assert move == Move(0.01, 0.3, 0.5, 2.0, 50.0)  # from home, which is at 0.01
    assert dwell == Dwell(0.3, 0.5)
    assert through == Move(pytest.approx(0.2 - 0.05 - 1 / 24), pytest.approx(0.6 + 0.05 + 1 / 24), 1.0, 12.0)
    assert (cruise.mode, cruise.begin, cruise.end < cruise.begin) == ("velocity", through.end, True)
    assert (pattern.begin, pattern.end, len(pattern.moves)) == (0.1, 0.1, 8)
    assert pattern.moves[0][1].v == slider.axes[0].limits.v / 2
    assert back == Move(0.1, 0.01, 0.2, 12.0)


def test_degrees_and_two_axes_at_once(pantilt, written):
    file = written("together: [{axis: pan, move: {to_deg: 30, v_degps: 90}}, {axis: tilt, move: {to_deg: 10, v_degps: 30}}]")
    (step,) = load_profile(file, pantilt)
    assert step[0] == Move(0.0, math.radians(30), math.radians(90), math.radians(4000))
    assert step[1].end == pytest.approx(math.radians(10))


def test_steps_are_repeated(slider, written):
    file = written(
        "{axis: x, dwell_s: 1}",
        "repeat: {times: 3, steps: [{axis: x, move: {to_m: 0.3, v_mps: 0.5}}, {axis: x, return: {v_mps: 0.2}}]}",
    )
    steps = load_profile(file, slider)
    assert [step[0].end for step in steps] == [0.01, *[0.3, 0.01] * 3]


def test_the_pattern_fits_on_a_short_axis(slider, written):
    from dataclasses import replace

    x = slider.axes[0]
    short = replace(slider, axes=(replace(x, limits=replace(x.limits, min=0.0, max=0.1)),))
    (step,) = load_profile(written("{axis: x, sync: {v_mps: 0.2}}"), short)
    assert plan(short, [step]).ok


@pytest.mark.parametrize(
    ("step", "told"),
    [
        ("{axis: y, dwell_s: 1}", "axis of step is y"),
        ("{axis: x}", "one motion, this has 0"),
        ("{axis: x, dwell_s: 1, sync: {}}", "one motion, this has 2"),
        ("{axis: x, moves: {}}", "did you mean move"),
        ("{axis: x, move: {to_m: 0.3}}", "v_mps is missing in move"),
        ("{axis: x, move: {to_m: 0.3, v_mps: -1}}", "above 0"),
        ("{axis: x, move: {to_deg: 0.3, v_mps: 1}}", "unknown key to_deg"),
        ("{axis: x, cruise: {v_mps: 0, hold_s: 1}}", "v_mps of cruise is 0"),
        ("{axis: x, pass: {x0_m: 0.3, x1_m: 0.3, v_mps: 1}}", "begins where it ends"),
        ("{axis: x, sync: {from_m: 0.3, to_m: 0.3}}", "begins where it ends"),
        ("{axis: x, return: {v_mps: .inf}}", "no finite number"),
        ("{axis: x, dwell_s: -1}", "at least 0"),
        ("{axis: x, dwell_s: 1e9}", "at most 3600"),
        ("{axis: x, cruise: {v_mps: -1e14, hold_s: 1e14}}", "at most 3600"),
        ("{axis: x, together: [{axis: x, dwell_s: 1}]}", "unknown key axis"),
        ("{repeat: {times: 2, steps: [{axis: x, dwell_s: 1}]}, dwell_s: 3}", "unknown key dwell_s"),
        ("together: [{axis: x, dwell_s: 1}, {axis: x, dwell_s: 1}]", "every axis once"),
        ("together: []", "no list of anything"),
        ("repeat: {times: 10000, steps: []}", "no list of anything"),
        ("repeat: {times: 0, steps: []}", "at least 1"),
        ("repeat: {times: 10000, steps: [{axis: x, dwell_s: 1}, {axis: x, dwell_s: 1}]}", "more than 10000 steps"),
    ],
)
def test_what_is_wrong_is_told_with_its_line(slider, written, step, told):
    path = written("{axis: x, dwell_s: 1}", step)
    with pytest.raises(Refused) as caught:
        load_profile(path, slider)
    assert told in str(caught.value)
    assert str(caught.value).startswith(f"{path}, line 3: ")
    assert "what to do: " in str(caught.value)


def test_steps_that_hold_themselves_are_refused(slider, tmp_path):
    file = tmp_path / "profile.yaml"
    for times in (1, 2):
        file.write_text(f"profile: &a [{{repeat: {{times: {times}, steps: *a}}}}]")
        with pytest.raises(Refused, match="steps that hold themselves"):
            load_profile(file, slider)


HOUR = ["repeat: {times: 37, steps: [{axis: x, move: {to_m: 0.3, v_mps: 0.5}}, {axis: x, dwell_s: 100}, {axis: x, return: {v_mps: 0.5}}]}"]


@pytest.mark.parametrize(
    ("steps", "told"),
    [
        (HOUR, "longer than 3600 s"),
        (["{axis: x, move: {to_m: 0.7, v_mps: 2.1e-4}}", "{axis: x, dwell_s: 300}"], "longer than 3600 s"),
        (["{axis: x, cruise: {v_mps: 1e14, hold_s: 3}}", "{axis: x, return: {v_mps: 1}}"], "longer than 3600 s"),
        (["{axis: x, move: {to_m: 1e14, v_mps: 1e14}}"], "beyond what its drive can count"),
    ],
)
def test_what_is_too_long_is_refused_before_it_is_sampled(slider, written, monkeypatch, steps, told):
    monkeypatch.delattr("torchcmax.rig.plan.samples")
    with pytest.raises(Refused, match=told):
        plan(slider, load_profile(written(*steps), slider))


NUMBERS = ["1e-300", "1e-14", "-1", "0", "1e-3", "1e6", "1e14", "1e300", ".nan", "!!float x", "!!null [1]", "&a [*a]", "true", "~"]
TEXT = """profile:
  - {axis: x, move: {to_m: 0.3, v_mps: 0.5, a_mps2: 2, j_mps3: 50}}
  - {axis: x, sync: {from_m: 0.2, to_m: 0.25, v_mps: 0.5, a_mps2: 3}}
  - {axis: x, pass: {x0_m: 0.12, x1_m: 0.3, v_mps: 1.0, a_mps2: 10, settle_s: 0.05}}
  - {axis: x, cruise: {v_mps: 0.2, hold_s: 0.5, a_mps2: 4}}
"""


@pytest.mark.parametrize("number", NUMBERS)
def test_whatever_a_number_is_the_profile_is_planned_or_refused(slider, tmp_path, monkeypatch, number):
    """Each number of a file in turn; no warning either."""
    monkeypatch.setattr("torchcmax.rig.plan.LONGEST", 5.0)
    file = tmp_path / "profile.yaml"
    for place in re.finditer(r"(?<=: )[0-9.]+", TEXT):
        file.write_text(TEXT[: place.start()] + number + TEXT[place.end() :])
        with warnings.catch_warnings(), contextlib.suppress(Refused):
            warnings.simplefilter("error")
            plan(slider, load_profile(file, slider)).summary()
