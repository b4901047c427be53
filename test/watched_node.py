"""
The live node, which writes down besides how much memory is in use; all, if PYTHONMALLOC=malloc.

What is resident says less: it grows in steps of large pages until the allocator has found room for
whatever comes, which takes minutes where the machine is busy.
"""

import ctypes
import sys
import threading
import time

from depth_deblur_ros.deblur_node import main

EVERY_S = 0.05
FIELDS = (
    'arena',
    'ordblks',
    'smblks',
    'hblks',
    'hblkhd',
    'usmblks',
    'fsmblks',
    'uordblks',
    'fordblks',
    'keepcost',
)


class Mallinfo2(ctypes.Structure):
    """glibc's, of all arenas [bytes]."""

    _fields_ = [(name, ctypes.c_size_t) for name in FIELDS]


def watch(path):
    """Write the MB in use, a line each time."""
    ask = ctypes.CDLL(None).mallinfo2
    ask.restype = Mallinfo2
    with open(path, 'w', buffering=1) as file:
        while True:
            said = ask()
            file.write(f'{(said.uordblks + said.hblkhd) / 1e6:.4f}\n')
            time.sleep(EVERY_S)


if __name__ == '__main__':
    threading.Thread(target=watch, args=(sys.argv.pop(1),), daemon=True).start()
    sys.exit(main())
