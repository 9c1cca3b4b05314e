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
    assert pixels(picture.repeats(slider, encoder, said["cycles"]), np.array([0x1F, 0x77, 0xB4])) > 20


def test_what_is_outside_of_the_operating_range_is_red(planned, slider):
    inside = pixels(picture.operating_range(slider, 0, planned.samples), RED)
    faster = replace(planned.samples, v=1.7 * planned.samples.v, torque=1.7 * planned.samples.torque)
    assert pixels(picture.operating_range(slider, 0, faster), RED) > inside + 100
