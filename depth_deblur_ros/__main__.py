"""The command line as `python -m depth_deblur_ros`."""

import sys

from depth_deblur_ros.cli import main

sys.exit(main())
