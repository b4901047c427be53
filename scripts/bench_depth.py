"""
Print the table of docs/results.md on depth hole filling: ours and others on the camera cases.

Usage: bench_depth.py FOLDER, the one with eval/ (default: what DEPTH_DEBLUR_DATA names).
"""

from functools import partial
import os
from pathlib import Path
import sys

from depth_deblur_ros.core.depth import fill_depth

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))
from peers_depth import camera_cases, PEERS, score

HEAD = [
    'method',
    'RMSE mm',
    'MAE mm',
    '1/z RMSE 1/km',
    'off by > 5 %',
    'all: RMSE',
    'MAE',
    'ms at VGA',
]
KEYS = ['rmse', 'mae', 'rmse_inverse', 'bad', 'rmse_all', 'mae_all', 'ms']


def main() -> int:
    """Score every method on every case."""
    folder = sys.argv[1] if len(sys.argv) > 1 else os.environ.get('DEPTH_DEBLUR_DATA')
    cases = list(camera_cases(Path(folder))) if folder else []
    if not cases:
        print('name a folder with eval/camera-* cases, or set DEPTH_DEBLUR_DATA', file=sys.stderr)
        return 2
    ours = partial(fill_depth, threads=2)
    ours(cases[0][0].depth, cases[0][0].image)  # compiles
    print('| ' + ' | '.join(HEAD) + ' |')
    print('|---' * len(HEAD) + '|')
    for name, fill in {**PEERS, 'this package': ours}.items():
        found = score(fill, cases)
        print(f'| {name} | ' + ' | '.join(f'{found[key]:.1f}' for key in KEYS) + ' |', flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
