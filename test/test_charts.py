"""Charts: what is drawn where, what is left out, and that the text is XML."""

import re
import xml.etree.ElementTree as ET

from depth_deblur_ros.charts import chart, Curve, energy_chart, MOST_POINTS, Panel
from depth_deblur_ros.core.data import EnergyStep
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
import numpy as np
import pytest

SVG = '{http://www.w3.org/2000/svg}'


def drawn(*curves, **more):
    """Give the elements of a chart of one panel."""
    text = chart([Panel('a <title>', curves, 'x', 'y', **more)])
    return list(ET.fromstring(text).iter())


def points(elements, kind='line'):
    """Give the points (n, 2) of each path of a kind."""
    paths = [e.get('d') for e in elements if e.get('class') == kind]
    numbers = [re.findall(r'-?[\d.]+', d.removesuffix('h0').removesuffix('h0Z')) for d in paths]
    return [np.array(n, float).reshape(-1, 2) for n in numbers]


def test_a_line_keeps_its_shape():
    x, y = np.arange(5.0), np.array([0, 1, 4, 9, 16.0])
    (line,) = points(drawn(Curve('', x, y)))
    assert np.diff(line[:, 0]) == pytest.approx(np.diff(line[:, 0])[0], abs=0.2)
    rise = line[0, 1] - line[:, 1]  # y grows downwards
    np.testing.assert_allclose(rise / rise[-1], y / 16, atol=2e-3)


def test_a_gap_parts_a_line():
    x, y = np.arange(6.0), np.array([1, 2, np.nan, 3, np.nan, 4])
    assert [len(line) for line in points(drawn(Curve('', x, y)))] == [2, 1, 1]


def test_the_band_lies_about_the_line():
    x, y = np.arange(4.0), np.zeros(4)
    elements = drawn(Curve('', x, y, band=(y - 1, y + 2)))
    (line,), (band,) = points(elements), points(elements, 'band')
    below, above = band[:, 1].max() - line[0, 1], line[0, 1] - band[:, 1].min()
    assert above == pytest.approx(2 * below, abs=0.3)


def test_decades_are_equally_far_apart_and_what_is_not_positive_is_left_out():
    y = np.array([1e-3, 1e-1, 1e1, 0.0, -5.0])
    (line,) = points(drawn(Curve('', np.arange(5.0), y), logarithmic=True))
    assert len(line) == 3
    assert np.diff(line[:, 1])[0] == pytest.approx(np.diff(line[:, 1])[1], abs=0.2)


def test_points_and_rings_are_told_apart():
    x = np.arange(3.0)
    for look, fill in (('points', 'var(--c1)'), ('rings', 'none')):
        circles = [e for e in drawn(Curve('', x, x, 1, look)) if e.tag == f'{SVG}circle']
        assert [c.get('fill') for c in circles] == [fill] * 3


@given(
    hnp.arrays(np.float64, st.integers(0, 30), elements=st.floats(-1e6, 1e6) | st.just(np.nan)),
    st.booleans(),
)
def test_everything_drawn_lies_in_the_frame(y, logarithmic):
    elements = drawn(Curve('y', np.arange(float(y.size)), y), logarithmic=logarithmic)
    for line in points(elements):
        assert (line >= 0).all() and (line[:, 0] <= 430).all() and (line[:, 1] <= 250).all()


def test_long_curves_are_thinned_evenly():
    n = 10 * MOST_POINTS
    (line,) = points(drawn(Curve('', np.arange(float(n)), np.arange(float(n)))))
    assert MOST_POINTS / 2 <= len(line) <= MOST_POINTS


def test_titles_are_escaped_and_nothing_comes_from_elsewhere():
    text = chart([Panel('a <title> & more', (), 'x', 'y')])
    assert 'a &lt;title&gt; &amp; more' in text
    assert set(re.findall(r'https?://[^"]+', text)) == {'http://www.w3.org/2000/svg'}


def test_each_turn_is_one_stroke_from_before_to_after():
    steps = [
        EnergyStep(level, f'{end} turn 1', {'variation': value, 'motion': -1.0})
        for level, ends in ((2, (5.0, 4.0)), (5, (4.0, 2.0)))
        for end, value in zip(('before', 'after'), ends, strict=True)
    ]
    text = energy_chart(steps)
    total = points(list(ET.fromstring(text).iter()))[:2]
    falls = [float(line[1, 1] - line[0, 1]) for line in total]
    assert falls[1] == pytest.approx(2 * falls[0], abs=0.3) and falls[0] > 0
    words = [e.text for e in ET.fromstring(text).iter(f'{SVG}text')]
    assert {'2', '5', 'variation', 'motion'} <= set(words)


def test_a_run_without_turns_has_an_empty_chart():
    assert not points(list(ET.fromstring(energy_chart(())).iter()))
