import pytest
import torch

from torchcmax.core.contrast import CONTRASTS, _smooth, blur, normalized, variance

ALL = pytest.mark.parametrize("contrast", CONTRASTS.values(), ids=CONTRASTS)


@pytest.fixture
def scattered(rand):
    """64 events alone on their pixels of a 16 x 16 image, and the same 64 in eight piles."""
    alone, piled = (torch.zeros(1, 16, 16).to(rand(1)) for _ in range(2))
    alone[:, ::2, ::2] = 1
    piled[:, 2::8, 1::4] = 8
    return alone, piled


@ALL
def test_piled_events_are_sharper_than_scattered_ones(contrast, scattered):
    alone, piled = scattered
    assert contrast(piled) > contrast(alone)


@ALL
def test_normalized_contrast_knows_neither_the_weight_of_an_event_nor_the_size_of_the_image(contrast, rand, close):
    image = (rand(1, 20, 20) > 0.9).to(rand(1)) * (1 + (3 * rand(1, 20, 20)).floor())
    image[:, [0, -1]] = 0  # so that the same events lie in the middle of the larger image, none at its border
    image[:, :, [0, -1]] = 0
    weight = torch.ones(1, int(image.sum())).to(image)
    sharpness = contrast(normalized(image, weight))
    close(contrast(normalized(3 * image, 3 * weight)), sharpness)
    if contrast.__name__ not in ("variance", "michelson"):  # these know the mean, which a larger empty image lowers
        large = torch.zeros(1, 40, 30).to(image)
        large[:, 10:30, 5:25] = image
        close(contrast(normalized(large, weight)), sharpness)


@pytest.mark.parametrize("name", ["mean_square", "high_pass", "gradient_magnitude"])
def test_scattered_events_have_contrast_one(name, dtype, device, close):
    image = torch.zeros(1, 30, 30, dtype=dtype, device=device)
    image[:, 2:-2:4, 2:-2:4] = 1
    weight = torch.ones(1, int(image.sum()), dtype=dtype, device=device)
    close(CONTRASTS[name](normalized(image, weight)), torch.ones(1, dtype=dtype, device=device))


@ALL
def test_the_contrast_has_the_gradient_of_float64(contrast):
    g = torch.Generator().manual_seed(0)
    image = torch.rand(2, 5, 6, generator=g, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(contrast, image)
    assert torch.autograd.gradcheck(lambda i: contrast(blur(i, 0.8)), image)


@ALL
def test_rows_do_not_mix(contrast, rand):
    image = rand(4, 12, 15)
    torch.testing.assert_close(contrast(image), torch.cat([contrast(image[i : i + 1]) for i in range(4)]), rtol=1e-6, atol=0)


@ALL
def test_an_empty_image_has_no_contrast_and_no_nan(contrast, dtype):
    image = torch.zeros(2, 6, 6, dtype=dtype, requires_grad=True)
    value = contrast(normalized(image, torch.zeros(2, 3, dtype=dtype)))
    value.sum().backward()
    assert (value == 0).all()
    assert (image.grad == 0).all()


def test_variance_by_hand(dtype, device, close):
    image = torch.tensor([[[0.0, 2.0], [0.0, 2.0]], [[3.0, 3.0], [3.0, 3.0]]], dtype=dtype, device=device)
    close(variance(image), torch.tensor([1.0, 0.0], dtype=dtype, device=device))


def test_michelson_lies_between_nothing_and_one(rand):
    flat, spike = torch.ones(1, 8, 8).to(rand(1)), torch.zeros(1, 100, 100).to(rand(1))
    spike[0, 5, 5] = 1
    assert CONTRASTS["michelson"](flat).abs() < 1e-6
    assert 0.99 < CONTRASTS["michelson"](spike) < 1


@pytest.mark.parametrize("sigma", [0.5, 1.0, 2.5])
def test_blur_is_a_gaussian(sigma, dtype, device):
    image = torch.zeros(1, 31, 41, dtype=dtype, device=device)
    image[0, 15, 20] = 1
    y, x = torch.meshgrid(torch.arange(31) - 15, torch.arange(41) - 20, indexing="ij")
    gauss = torch.exp(-(x**2 + y**2) / (2 * sigma**2)).to(image)
    torch.testing.assert_close(blur(image, sigma)[0], gauss / gauss.sum(), rtol=0, atol=3e-3 * gauss.sum().reciprocal().item())


@pytest.mark.parametrize("sigma", [0.5, 1.0, 2.5])
def test_blur_is_its_readable_twin_on_every_device_and_in_a_cropped_image(sigma, rand, close):
    image = rand(3, 27, 34)[:, 1:-1, 1:-1]
    close(blur(image, sigma), _smooth(_smooth(image, sigma, -2), sigma, -1))


def test_blur_is_its_own_adjoint(rand, close):
    a, b = rand(2, 13, 17), rand(2, 13, 17)
    close((blur(a, 1.3) * b).sum(), (a * blur(b, 1.3)).sum())


def test_no_blur_leaves_the_image_alone(rand):
    image = rand(1, 5, 5)
    assert blur(image, 0) is image
