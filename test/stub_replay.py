"""
A replay with a solver that remembers, which may kill its own process at a given moment.

usage: python stub_replay.py BAG OUT [replay's other arguments as JSON] [MOMENT NUMBER]
"""

import json
import os
from pathlib import Path
import signal
import sys
import time

from depth_deblur_ros.bag import BagWriter
from depth_deblur_ros.core.data import DeblurResult, InputError, Motion, Outcome
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.journal import Journal
from depth_deblur_ros.replay import replay
import numpy as np

SECONDS = float(os.environ.get('STUB_SECONDS', '0'))


class Solve:
    """Its results depend on all frames before: one that is lost or solved twice shows."""

    def __init__(self):
        self._sum = 0.0

    def state(self):
        return {'sum': self._sum}

    def restore(self, state):
        self._sum = state['sum']

    def __call__(self, frame, params):
        time.sleep(SECONDS)
        self._sum = 0.5 * self._sum + float(frame.image.mean())
        if 0.3 < self._sum % 1 < 0.4:
            raise InputError('a frame that nobody likes')
        return DeblurResult(
            image=1 - frame.image,
            depth=np.nan_to_num(frame.depth, nan=9.0),
            motion=Motion(np.array([self._sum, 0, 0]), np.zeros(3), 1e-8 * np.eye(6)),
            outcome=Outcome.SOLVED,
            sign_resolved=True,
            quality=0.5,
            blur_px=3.0,
            seconds=0.25,
        )


def die_at(moment, number):
    """Kill this process just before or after the call of this number."""
    owner, name, after = {
        'solving': (Solve, '__call__', False),
        'writing': (BagWriter, 'write', True),
        'flushing': (BagWriter, 'flush', False),
        'noting': (Journal, 'add', False),
        'remembering': (os, 'replace', False),
        'noted': (Journal, 'add', True),
        'going on': (Journal, '__enter__', True),
        'publishing': (BagWriter, '_publish', False),
        'published': (BagWriter, '_publish', True),
    }[moment]
    told = getattr(owner, name)
    calls = []

    def call(*args, **options):
        calls.append(name)
        if len(calls) == number and not after:
            os.kill(os.getpid(), signal.SIGKILL)
        result = told(*args, **options)
        if len(calls) == number:
            os.kill(os.getpid(), signal.SIGKILL)
        return result

    setattr(owner, name, call)


def main():
    options = json.loads(sys.argv[3]) if len(sys.argv) > 3 else {}
    if len(sys.argv) > 4:
        die_at(sys.argv[4], int(sys.argv[5]))
    if 'estimates' in options:
        options['estimates'] = Path(options['estimates'])
    try:
        summary = replay(sys.argv[1], sys.argv[2], params=SolverParams(), solve=Solve(), **options)
    except InputError as error:
        sys.stderr.write(f'{error}\n')
        return 2
    sys.stdout.write(f'{summary}\n')
    return 0


if __name__ == '__main__':
    sys.exit(main())
