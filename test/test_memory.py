"""Freed memory that stays with the process, in large pages where it may ask for them."""

from pathlib import Path
import subprocess
import sys

import pytest

LARGE = Path('/sys/kernel/mm/transparent_hugepage/enabled')
TELL = """
from depth_deblur_ros.memory import keep_freed_memory
keep_freed_memory()
print(open('/proc/self/smaps').read())
"""


@pytest.mark.skipif(not LARGE.exists(), reason='this system has no large pages')
def test_images_may_have_large_pages():
    """The flag hg stands at what asked for them."""
    told = subprocess.run([sys.executable, '-c', TELL], check=True, capture_output=True, text=True)
    heap = told.stdout.split('[heap]')[1:]
    asked = [part for part in heap if 'hg' in part.split('VmFlags:')[1].splitlines()[0].split()]
    sizes = [int(part.split('Size:')[1].split()[0]) for part in asked]
    assert sum(sizes) >= 128 * 1024  # kB
