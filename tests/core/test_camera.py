import pytest
import torch

from torchcmax.core.camera import TABLE_ERROR, Camera, Canvas

DAVIS = Camera((180, 240), 199.09, 198.83, 132.19, 110.71, (-0.3684, 0.1509, -0.000296, -0.000759, 0.0))
FISHEYE = Camera((480, 640), 330.0, 331.0, 319.5, 239.5, (-0.02, 0.003, -0.001, 0.0002), "kannala_brandt")


@pytest.mark.parametrize("camera", [DAVIS, FISHEYE, Camera.pinhole((128, 128))], ids=["plumb_bob", "kannala_brandt", "pinhole"])
def test_every_pixel_of_the_table_projects_back_to_itself(camera):
    height, width = camera.size
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    error = camera.project(camera.rays()) - torch.stack([x, y], -1)
    assert camera.rays().shape == (height, width, 3)
    assert error.abs().max() < TABLE_ERROR


def test_plumb_bob_by_hand_from_its_formula():
    x, y = 0.3, -0.2
    k1, k2, p1, p2, k3 = DAVIS.distortion
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    expected = torch.tensor([[DAVIS.fx * u + DAVIS.cx, DAVIS.fy * v + DAVIS.cy]], dtype=torch.float64)
    torch.testing.assert_close(DAVIS.project(torch.tensor([[x, y, 1.0]], dtype=torch.float64)), expected, rtol=0, atol=1e-9)


def test_the_table_agrees_with_the_independent_judge(shared, monkeypatch):
    monkeypatch.syspath_prepend(str(shared / "tools"))
    from score_motion import undistort

    y, x = torch.meshgrid(torch.arange(180), torch.arange(240), indexing="ij")
    pixel = torch.stack([x, y], -1).reshape(-1, 2).double().numpy()
    calibration = torch.tensor([DAVIS.fx, DAVIS.fy, DAVIS.cx, DAVIS.cy, *DAVIS.distortion], dtype=torch.float64).numpy()
    difference = (DAVIS.rays().reshape(-1, 3) - torch.from_numpy(undistort(pixel, calibration))).abs() * DAVIS.fx
    assert difference.max() < TABLE_ERROR


def test_a_lens_that_cannot_be_inverted_is_refused_with_the_pixel():
    with pytest.raises(ValueError, match=r"cannot be inverted at pixel \(\d+, \d+\)"):
        Camera((180, 240), 60.0, 60.0, 120.0, 90.0, (-0.9, 0.0, 0.0, 0.0, 0.0)).rays()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"model": "fisheye"}, "none of plumb_bob, kannala_brandt"),
        ({"distortion": (0.0, 0.0)}, "wants 5 distortion numbers, got 2"),
        ({"fx": float("nan")}, "finite numbers"),
        ({"fy": -1.0}, "positive focal length"),
    ],
)
def test_wrong_numbers_are_named(wrong, message):
    good = {"size": (180, 240), "fx": 200.0, "fy": 200.0, "cx": 120.0, "cy": 90.0}
    with pytest.raises(ValueError, match=message):
        Camera(**{**good, **wrong})


def test_the_canvas_puts_the_optical_axis_on_its_centre_and_has_the_margin(close, dtype):
    canvas = Canvas.around(DAVIS, 0.25)
    assert canvas.size == (180 + 2 * 45, 240 + 2 * 60)
    close(canvas.pixels(torch.tensor([[0.0, 0.0, 2.0]], dtype=dtype)), torch.tensor([[DAVIS.cx + 60, DAVIS.cy + 45]], dtype=dtype))


def test_a_scaled_canvas_shows_the_same_view(close, dtype):
    canvas, ray = Canvas.around(DAVIS), torch.tensor([[0.1, -0.3, 1.0]], dtype=dtype)
    half = canvas.scaled(0.5)
    assert half.size == (135, 180)
    close((half.pixels(ray) + 0.5) * 2 - 0.5, canvas.pixels(ray))
