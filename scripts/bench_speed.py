"""
Time each mode of the solver against Richardson-Lucy deconvolution by scikit-image.

Both get the same frame of the sample bag in the same run, so that the ratios hold on any machine.
Richardson-Lucy is told the blur: one point-spread function for the whole image, 30 steps.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
import time

from depth_deblur_ros.bag import BagReader
from depth_deblur_ros.core.data import FloatImage, RgbdFrame
from depth_deblur_ros.core.params import MODES, SolverParams
from depth_deblur_ros.core.solver import deblur
from depth_deblur_ros.frames import frame_from_pair
from depth_deblur_ros.recording import choose_topics, PairReader
import numpy as np
from skimage.restoration import richardson_lucy

BAG = Path(__file__).resolve().parents[1] / 'bags/sample'
STEPS, RUNS = 30, 3


def sample_frame() -> RgbdFrame:
    """Give the first frame of the sample bag."""
    with BagReader(BAG) as reader:
        topics = choose_topics(reader, {}, with_info=True)
        pairs = PairReader(reader, topics, slop_ns=20_000_000)
        return frame_from_pair(next(pairs.pairs(reader.start_ns, None)))


def line_psf(length: float) -> FloatImage:
    """Give a horizontal line of the length [px] as a point-spread function."""
    side = 2 * round(length / 2) + 1
    psf = np.zeros((side, side), np.float32)
    psf[side // 2] = 1 / side
    return psf


def seconds(work: Callable[[], object]) -> float:
    """Give the median time of some runs; the first, which may compile, does not count."""
    work()
    times = []
    for _ in range(RUNS):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return median(times)


def main() -> None:
    """Print the times and their ratios."""
    frame = sample_frame()
    psf = line_psf(deblur(frame).blur_px)[..., None]
    peer = seconds(lambda: richardson_lucy(frame.image, psf, num_iter=STEPS))
    print(f'{frame.camera.width}x{frame.camera.height}, medians of {RUNS} runs')
    print(f'Richardson-Lucy, {STEPS} steps  {peer:7.2f} s')
    for mode in MODES:
        own = seconds(partial(deblur, frame, SolverParams(mode=mode)))
        print(f'deblur, {mode:<16}  {own:7.2f} s   {own / peer:5.2f} of Richardson-Lucy')


if __name__ == '__main__':
    main()
