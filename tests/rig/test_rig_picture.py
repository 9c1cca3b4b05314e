"""Pictures of plans and runs show what they should."""

import io
from dataclasses import replace

import numpy as np
import pytest
from bus import program
from PIL import Image

pytest.importorskip("matplotlib", reason="the extra rig is not installed")

from torchcmax.rig import picture
from torchcmax.rig.plan import plan
from torchcmax.rig.profilefile import load_profile
from torchcmax.rig.record import read_encoder
from torchcmax.rig.runner import run

RED = np.array([0xC0, 0x39, 0x2B])


@pytest.fixture(scope="module")
def planned(slider):
    return plan(slider, load_profile("configs/rig/slider_pass.yaml", slider))


def pixels(png, colour):
    """How many of a picture are of a colour."""
    image = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)
    assert min(image.shape[:2]) > 300
    return int((abs(image - colour).max(-1) < 12).sum())


def test_planned_and_measured_are_drawn_on_each_other(planned, slider, tmp_path):
    blue = np.array([0x17, 0x64, 0xAB])
    said = run(slider, program(), tmp_path, simulate=True, repeat=2)
    encoder = read_encoder(tmp_path / "encoder.csv", slider)
    assert pixels(picture.motion(slider, planned.samples, None), blue) == 0
    assert pixels(picture.motion(slider, planned.samples, encoder), blue) > 500
    grey = np.array([0x88, 0x88, 0x88])
    once = pixels(picture.motion(slider, planned.samples, encoder, said["cycles"][:1]), grey)
    assert pixels(picture.motion(slider, planned.samples, encoder, said["cycles"]), grey) > once
    assert pixels(picture.repeats(slider, encoder, said["cycles"]), np.array([0x1F, 0x77, 0xB4])) > 20


def test_the_plan_in_its_operating_range_has_one_colour(planned, slider):
    """That of the legend; what comes late hides nothing that came before."""
    assert pixels(picture.operating_range(slider, 0, planned.samples), np.array([0x17, 0x64, 0xAB])) > 3000


def test_what_is_outside_of_the_operating_range_is_red(planned, slider):
    inside = pixels(picture.operating_range(slider, 0, planned.samples), RED)
    faster = replace(planned.samples, **{name: 1.7 * getattr(planned.samples, name) for name in ("v", "torque", "current")})
    assert pixels(picture.operating_range(slider, 0, faster), RED) > inside + 100


def test_red_is_what_the_plan_refuses(slider, tmp_path):
    """Of many supplies and peaks of current: nothing in an accepted plan, braking included, and something where a limit is broken."""
    file, seen = tmp_path / "pass.yaml", set()
    file.write_text("profile: [{axis: x, pass: {x0_m: 0.2, x1_m: 0.45, v_mps: 1.2, a_mps2: 11, settle_s: 0.05}}]\n")
    for supply in np.arange(14, 25, 0.5):
        for peak in (2.0, 2.9, 4.0):
            rig = replace(slider, supply=float(supply), axes=(replace(slider.axes[0], current_peak=peak),))
            found = plan(rig, load_profile(file, rig))
            margin = min(
                c.margin / c.limit for c in found.checks if c.name in ("voltage, its winding hot or cold", "current", "motor's speed")
            )
            red = picture.outside(rig, 0, found.samples).any()
            if abs(margin) > 0.02:  # samples lie beside the corners that are checked
                assert red == (margin < 0), (supply, peak)
                seen.add(bool(red))
    assert seen == {True, False}
