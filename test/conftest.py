"""Settings that every test shares."""

import importlib.util
import os
from pathlib import Path

# Small kernels would else spend their time spinning for a core that other programs keep busy.
os.environ.setdefault('OMP_WAIT_POLICY', 'passive')

from hypothesis import settings
import pytest

settings.register_profile('ci', derandomize=True, deadline=None)
settings.register_profile('here', deadline=None)  # the first call compiles
settings.load_profile('ci' if os.environ.get('CI') else 'here')

WITHOUT_ROS = importlib.util.find_spec('rclpy') is None
collect_ignore_glob = ['test_node*.py'] if WITHOUT_ROS else []


def pytest_report_header():
    return 'rclpy is not installed: the live node is not tested' if WITHOUT_ROS else None


@pytest.fixture(autouse=True, scope='session')
def ros_logs_stay_here(tmp_path_factory):
    """ROS piles up logs in the home directory, and needs one, unless told otherwise."""
    os.environ['ROS_LOG_DIR'] = str(tmp_path_factory.mktemp('ros_log'))


@pytest.fixture(scope='session')
def data():
    """Give the folder of evaluation data."""
    folder = os.environ.get('DEPTH_DEBLUR_DATA')
    if not folder:
        pytest.skip('DEPTH_DEBLUR_DATA is not set')
    return Path(folder)


@pytest.fixture
def peer(monkeypatch):
    """Give what speaks to a live node from another process, in a domain of its own."""
    import ros_parts  # ROS is not everywhere

    ros_parts.private_domain(monkeypatch)
    made = ros_parts.Peer()
    yield made
    made.close()
