"""The live node with a solver that knows the answer and takes as long as it is told to."""

import os
import sys
import time

from depth_deblur_ros.core.data import DeblurResult, Motion, Outcome
from depth_deblur_ros.node import DeblurNode, main
import numpy as np

SECONDS = float(os.environ.get('STUB_SECONDS', '0.02'))
THETA, V = (0.01, -0.02, 0.03), (0.004, 0.0, -0.008)


def solve(frame, params, *, start=None):
    time.sleep(SECONDS)
    if frame.image.max() == 0:
        raise ZeroDivisionError('a black frame')
    return DeblurResult(
        image=frame.image if params.mode == 'motion' else 1 - frame.image,
        depth=np.nan_to_num(frame.depth, nan=9.0),
        motion=Motion(np.array(THETA), np.array(V), 1e-8 * np.eye(6)),
        outcome=Outcome.SOLVED,
        sign_resolved=params.prior < 1,  # told by a parameter
        quality=0.5,
        blur_px=3.0,
        seconds=SECONDS,
    )


class StubNode(DeblurNode):
    def __init__(self):
        super().__init__(solve=solve, first=lambda: None)


if __name__ == '__main__':
    sys.exit(main(node_type=StubNode))
