"""Sixteen float32 at once: the same as numpy's, one by one."""

from depth_deblur_ros.core import lanes
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numba import njit
import numpy as np

numbers = st.floats(-1e6, 1e6, width=32)
arrays = hnp.arrays(np.float32, (2, 40), elements=numbers)
places = st.integers(0, 40 - lanes.WIDTH)


@njit
def calculate(a, b, at, out):
    x, y = lanes.load(a, at), lanes.load(b, at)
    lanes.store(out, 0, x + y)
    lanes.store(out, 16, x - y)
    lanes.store(out, 32, x * y)
    lanes.store(out, 48, lanes.larger(x, y))
    lanes.store(out, 64, lanes.smaller(x, y))
    lanes.store(out, 80, lanes.next_lane(x, y))
    lanes.store(out, 96, lanes.splat(b[at]))
    lanes.store(out, 112, lanes.tent(x))
    lanes.store(out, 128, lanes.whole(x))
    lanes.store(out, 144, lanes.where_positive(x, x, y))
    ends = lanes.last_lane(x), lanes.least(x), lanes.greatest(x)
    return ends, lanes.total(x, np.empty(16, np.float32))


@given(pair=arrays, at=places)
def test_each_lane_calculates_by_itself(pair, at):
    a, b = pair
    x, y = (array[at : at + 16] for array in pair)
    out = np.full(10 * 16 + 1, 7, np.float32)
    ends, total = calculate(a, b, at, out)
    expected = [x + y, x - y, x * y, np.maximum(x, y), np.minimum(x, y), np.r_[y[-1], x[:-1]]]
    expected += [np.full(16, y[0]), np.maximum(0, 1 - np.abs(x))]
    expected += [np.trunc(x), np.where(x > 0, x, y)]
    np.testing.assert_allclose(out[:-1].reshape(10, 16), expected, rtol=1e-6)
    assert out[-1] == 7
    assert ends == (x[-1], x.min(), x.max())
    np.testing.assert_allclose(total, x.sum(dtype=np.float64), rtol=1e-5, atol=1e-5 * 16e6)


@njit
def pass_on(shorts, at, numbers, out):
    lanes.store(out, 0, lanes.load_whole(shorts, at))
    lanes.store_whole(shorts, at, lanes.load(numbers, 0))


@given(seed=st.integers(0, 2**32 - 1), at=places)
def test_sixteen_bits_are_whole_numbers(seed, at):
    rng = np.random.default_rng(seed)
    shorts, out = rng.integers(0, 65536, 40).astype(np.uint16), np.empty(16, np.float32)
    numbers = np.r_[0, 65535, rng.uniform(0, 65535, 14)].astype(np.float32)
    expected, before = shorts.copy(), shorts[at : at + 16].copy()
    expected[at : at + 16] = np.trunc(numbers)
    pass_on(shorts, at, numbers, out)
    np.testing.assert_array_equal(out, before)
    np.testing.assert_array_equal(shorts, expected)


@njit
def look_up(a, places, out):
    here, beside = lanes.pairs(a, lanes.load(places, 0))
    lanes.store(out, 0, here)
    lanes.store(out, 16, beside)


@given(a=hnp.arrays(np.float32, 40, elements=numbers), seed=st.integers(0, 2**32 - 1))
def test_pairs_lie_side_by_side(a, seed):
    places, out = np.random.default_rng(seed).integers(0, 39, 16), np.empty(32, np.float32)
    look_up(a, places.astype(np.float32), out)
    np.testing.assert_array_equal(out, np.r_[a[places], a[places + 1]])
