import re
import xml.etree.ElementTree as xml

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcmax.chart import Axes, Line, Span, chart, said, thinned, ticks

AXES = Axes("Title", "time, s", "m")


def drawn(svg, shape="line"):
    """The points of each line, px."""
    paths = [path for path in xml.fromstring(svg).iter("path") if path.get("data-name") is not None and shape in path.get("class").split()]
    return [[(float(u), float(v)) for u, v in re.findall(r"[ML]([-\d.]+) ([-\d.]+)", path.get("d"))] for path in paths]


def test_a_line_goes_where_the_axes_say():
    svg = chart(AXES, [Line("a", np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 0.0]))])
    root, [points] = xml.fromstring(svg), drawn(svg)
    at = {name: float(root.get(f"data-{name}")) for name in "abcdlhmn"}
    assert [u for u, _ in points] == pytest.approx([at["a"], (at["a"] + at["b"]) / 2, at["b"]], abs=0.06)
    back = [at["m"] + (v - at["c"]) / (at["d"] - at["c"]) * (at["n"] - at["m"]) for _, v in points]
    assert back == pytest.approx([0, 1, 0], abs=1e-3)


def test_a_line_breaks_where_numbers_are_missing_and_a_single_number_is_seen():
    y = np.array([1.0, 2.0, np.nan, 3.0, np.nan, 1.0, 2.0])
    [path] = [p for p in xml.fromstring(chart(AXES, [Line("a", np.arange(7.0), y)])).iter("path") if p.get("data-name") == "a"]
    assert path.get("d").count("M") == 3
    assert path.get("d").count("h0") == 3


@pytest.mark.parametrize(
    "y",
    [np.zeros(0), np.array([np.nan, np.nan]), np.array([5.0]), np.array([5.0, 5.0]), np.array([np.inf, 1.0]), np.array([1e300, -1e300])],
)
def test_no_numbers_one_number_and_equal_or_endless_ones_are_a_chart_too(y):
    for equal in (False, True):
        svg = chart(Axes("t", "x", "y", equal=equal), [Line("a", np.arange(float(len(y))), y)])
        xml.fromstring(svg)
        assert not re.search(r"\b(nan|inf)\b", svg)


def test_equal_axes_have_one_scale():
    svg = chart(Axes("t", "x", "y", (490, 400), True, False), [Line("a", np.array([0.0, 10.0]), np.array([0.0, 1.0]))])
    [[(u0, v0), (u1, v1)]] = drawn(svg)
    assert (u1 - u0) / 10 == pytest.approx((v0 - v1) / 1, abs=0.15)


def test_truth_is_drawn_below_the_estimate_whatever_the_order():
    x = np.arange(3.0)
    svg = chart(AXES, [Line("estimate", x, x), Line("truth", x, x, truth=True)])
    assert svg.index('data-name="truth"') < svg.index('data-name="estimate"')


def test_text_is_escaped():
    evil = '<script>"&'
    svg = chart(Axes(evil, evil, evil), [Line(evil, np.arange(2.0), np.arange(2.0)), Line("b", np.arange(2.0), np.arange(2.0))])
    assert "<script>" not in svg
    assert xml.fromstring(svg).get("aria-label") == evil


def test_a_shaded_stretch_stays_within_the_axes_and_is_never_too_thin_to_see():
    svg = chart(AXES, [Line("a", np.array([0.0, 10.0]), np.zeros(2))], [Span(-5, 2, "lost"), Span(5, 5.0001, "weak")])
    lost, weak = [r for r in xml.fromstring(svg).iter("rect") if r.find("title") is not None]
    assert float(lost.get("x")) == 64
    assert float(lost.get("width")) == pytest.approx(0.2 * (1000 - 64 - 12), abs=0.1)
    assert float(weak.get("width")) == 1
    assert svg.count(">lost</text>") == svg.count(">weak</text>") == 1


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6), st.integers(1, 12))
def test_ticks_are_round_few_and_inside(low, extent, most):
    high = low + extent
    found = ticks(low, high, most)
    assert len(found) <= most + 1
    step = extent / most
    assert all(low - 1e-6 * step - 1e-9 * abs(low) <= tick <= high + 1e-6 * step + 1e-9 * abs(high) for tick in found)


def test_ticks_are_told_with_as_many_decimals_as_they_need():
    assert [said(v, [0.0, 0.5]) for v in (0.0, 0.5, -1.0)] == ["0.0", "0.5", "−1.0"]
    assert [said(v, [0.0, 20.0]) for v in (0.0, 20.0)] == ["0", "20"]


def test_thinning_keeps_extremes_gaps_and_the_ends():
    rng = np.random.default_rng(0)
    y = rng.normal(size=100_000)
    y[31_415], y[77_777], y[50_000:50_400] = 99, -99, np.nan
    kept = thinned(y, 1500)
    assert len(kept) <= 1500
    assert {0, 31_415, 77_777, 99_999} <= set(kept.tolist())
    assert np.isnan(y[kept]).any()
    assert (np.diff(kept) > 0).all()


def test_few_numbers_are_all_drawn():
    assert thinned(np.arange(1500.0), 1500).tolist() == list(range(1500))
