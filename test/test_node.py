"""The live node in a process of its own, over real DDS; mostly with a solver that is a stub."""

import json
from pathlib import Path
import signal
import subprocess
import sys
import time

from depth_deblur_ros.results import UNKNOWN_VARIANCE
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistStamped, TwistWithCovarianceStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
import numpy as np
import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
import ros_parts
from ros_parts import (
    assert_all_accounted,
    COLOUR,
    colour_message,
    DEPTH,
    depth_message,
    INFO,
    Process,
    qos,
    STUB,
)
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Float32
import stub_node

pytestmark = pytest.mark.ros

SECOND = 10**9
START = 1_700_000_000 * SECOND


@pytest.fixture
def start(peer, tmp_path):
    """Start the node with ROS arguments, stop it in the end, and see that it leaves with 0."""
    started = []

    def begin(*arguments, command=STUB, **environment):
        words = ['--ros-args', *arguments] if arguments else []
        log = tmp_path / f'node{len(started)}.log'
        started.append(Process([*command, *words], log, **environment))
        return started[-1]

    yield begin
    codes = [node.stop() for node in started]
    assert set(codes) <= {0, 2, -signal.SIGKILL}, started[0].text()
    assert all('Traceback' not in node.text() for node in started)


def stamps(messages):
    return [m.header.stamp.sec * SECOND + m.header.stamp.nanosec for m in messages]


def test_one_frame_gives_every_topic_at_its_stamp(peer, start):
    start('-p', 'exposure_s:=0.02', '-p', 'prior:=0.5')
    images = peer.listen(Image, 'deblurred/image')
    infos = peer.listen(CameraInfo, 'deblurred/camera_info')
    depths = peer.listen(Image, 'deblurred/depth')
    twists = peer.listen(TwistStamped, 'motion')
    spreads = peer.listen(TwistWithCovarianceStamped, 'motion_with_covariance')
    moves = peer.listen(TwistStamped, 'displacement')
    results = peer.listen(DiagnosticStatus, 'result')
    depth = np.full((48, 64), 2, np.float32)
    depth[0, 0] = np.nan
    peer.send_frame(START + 5, depth=depth)
    every = (images, infos, depths, twists, spreads, moves, results)
    peer.until(lambda: all(every))
    for messages in every[:-1]:
        assert stamps(messages) == [START + 5]
        assert messages[0].header.frame_id == 'camera_optical_frame'
    assert images[0].encoding == 'rgb8' and set(images[0].data) == {255 - 64}
    assert np.frombuffer(depths[0].data, np.float32).reshape(48, 64)[0, 0] == 9
    assert infos[0].k[0] == ros_parts.CAMERA.fx and infos[0].width == 64
    linear, angular = twists[0].twist.linear, twists[0].twist.angular
    np.testing.assert_allclose([linear.x, linear.y, linear.z], -np.array(stub_node.V) / 0.02)
    np.testing.assert_allclose(
        [angular.x, angular.y, angular.z], -np.array(stub_node.THETA) / 0.02
    )
    assert moves[0].twist.angular.z == -0.03 and moves[0].twist.linear.z == 0.008
    values = {entry.key: entry.value for entry in results[0].values}
    assert values['outcome'] == 'solved' and values['sign_resolved'] == 'true'


def test_what_is_not_known_is_not_said(peer, start):
    start()
    images = peer.listen(Image, 'deblurred/image')
    twists = peer.listen(TwistStamped, 'motion')
    spreads = peer.listen(TwistWithCovarianceStamped, 'motion_with_covariance')
    moves = peer.listen(TwistStamped, 'displacement')
    peer.send_frame(START)
    peer.until(lambda: moves and images)
    peer.send('exposure', Float32, Float32(data=float('nan')))  # not an exposure: ignored
    peer.spin(0.3)
    peer.send_frame(START + SECOND)
    peer.until(lambda: len(moves) == 2)
    peer.spin(0.3)
    assert (twists, spreads) == ([], [])  # sign and exposure open
    peer.send('exposure', Float32, Float32(data=0.01))
    peer.spin(0.3)
    peer.send_frame(START + 2 * SECOND)
    peer.until(lambda: spreads)
    assert twists == []  # the sign still is
    assert spreads[0].twist.twist.angular.z == 0
    variance = spreads[0].twist.covariance[35]
    assert variance == pytest.approx((0.03**2 + 1e-8) / 0.01**2, rel=1e-5)


def test_each_frame_takes_the_exposure_that_was_sent_just_before_it(peer, start):
    start('-p', 'prior:=0.5', STUB_SECONDS='0')
    twists = peer.listen(TwistStamped, 'motion')
    peer.send('exposure', Float32, Float32(data=1.0))
    peer.send_frame(START)
    for number in range(1, 31):
        peer.send('exposure', Float32, Float32(data=number / 64))
        peer.spin(0.02)  # topics keep no order among themselves
        peer.send_frame(START + number * 33_000_000, info=False)
        peer.spin(0.02)
        if number % 3 == 0:  # some wait together
            peer.spin(0.1)
    values = peer.settled(arrived=31)
    assert int(values['published']) == len(twists) > 2
    for stamp, twist in zip(stamps(twists), twists, strict=True):
        number = (stamp - START) // 33_000_000
        assert twist.twist.angular.z == -0.03 / (number / 64 if number else 1.0)


def test_a_solver_too_slow_drops_whole_pairs_and_counts_them(peer, start):
    start(STUB_SECONDS='0.3')
    moves = peer.listen(TwistStamped, 'displacement')
    sent = [START + i * 33_000_000 for i in range(40)]
    for stamp in sent:
        peer.send_frame(stamp)
        peer.spin(0.03)
    values = peer.settled(arrived=40)
    assert_all_accounted(values)
    assert int(values['depth lost in transport']) == 0
    assert 3 <= int(values['published']) < 20
    assert int(values['published']) == len(moves)
    assert values['dropped: overtaken by a newer pair while the solver was busy']
    assert stamps(moves) == sorted(stamps(moves)) and stamps(moves)[-1] == sent[-1]


def send_until(peer, stamp, condition):
    """Send frames: the first may be lost, before both sides have met."""
    for i in range(100):
        peer.send_frame(stamp + i * SECOND)
        peer.spin(0.2)
        if condition():
            return
    pytest.fail(f'{i} frames were of no use; last: {peer.status()}')


def test_nobody_listens_nobody_works_unless_told_to(peer, start):
    start()
    peer.until(lambda: peer.status()[0] == 'idle: nobody subscribes')
    publisher = peer.node.create_publisher(Image, COLOUR, 10)
    peer.spin(1.0)
    assert publisher.get_subscription_count() == 0
    parameters(peer, lazy=False)
    peer.until(lambda: publisher.get_subscription_count() == 1)
    send_until(peer, START, lambda: int(peer.status()[1]['published']) > 1)
    parameters(peer, lazy=True)
    peer.until(lambda: publisher.get_subscription_count() == 0)
    moves = peer.listen(TwistStamped, 'displacement')
    peer.until(lambda: publisher.get_subscription_count() == 1)
    send_until(peer, START + 1000 * SECOND, lambda: moves)
    assert_all_accounted(peer.settled())


def parameters(peer, node='depth_deblur', **values):
    """Set parameters; give the reasons of those that are refused."""
    kinds = {bool: 'bool', int: 'integer', float: 'double', str: 'string'}
    request = SetParameters.Request()
    for name, value in values.items():
        kind = kinds[type(value)]
        number = getattr(ParameterType, f'PARAMETER_{kind.upper()}')
        content = ParameterValue(type=number, **{f'{kind}_value': value})
        request.parameters.append(Parameter(name=name, value=content))
    results = peer.call(SetParameters, f'{node}/set_parameters', request).results
    return [result.reason for result in results if not result.successful]


def test_parameters_have_text_and_limits_and_change_for_the_next_frame(peer, start):
    start()
    images = peer.listen(Image, 'deblurred/image')
    request = DescribeParameters.Request(names=['threads', 'sync_slop_s', 'mode', 'autostart'])
    answer = peer.call(DescribeParameters, 'depth_deblur/describe_parameters', request)
    threads, slop, mode, autostart = answer.descriptors
    assert all(d.description for d in answer.descriptors)
    assert (threads.integer_range[0].from_value, threads.integer_range[0].to_value) == (1, 256)
    assert slop.floating_point_range[0].to_value == 1.0
    assert mode.additional_constraints == 'one of full, fast, motion'
    assert autostart.read_only
    peer.send_frame(START)
    peer.until(lambda: len(images) == 1)
    assert parameters(peer, mode='motion') == []
    peer.send_frame(START + SECOND)
    peer.until(lambda: len(images) == 2)
    assert [set(m.data) for m in images] == [{191}, {64}]
    assert 'quick' in parameters(peer, mode='quick')[0]
    assert '256' in parameters(peer, threads=1000)[0]
    assert parameters(peer, colour_topic='not a topic')[0].startswith('colour_topic must be')
    assert parameters(peer, camera='nowhere.json')[0].startswith('camera must be a file')
    request = GetParameters.Request(names=['mode', 'threads'])
    values = peer.call(GetParameters, 'depth_deblur/get_parameters', request).values
    assert (values[0].string_value, values[1].integer_value) == ('motion', 2)
    assert parameters(peer, colour_topic='/other/colour', mode='full') == []
    peer.send_frame(START + 2 * SECOND, names=('/other/colour', DEPTH, INFO))
    peer.until(lambda: len(images) == 3)
    assert set(images[2].data) == {191}


def change_state(peer, transition, node='depth_deblur'):
    request = ChangeState.Request(transition=Transition(id=transition))
    assert peer.call(ChangeState, f'{node}/change_state', request).success


def test_a_deadline_that_is_missed_steps_the_mode_down_and_up(peer, start):
    start('-p', 'deadline_ms:=10.0')  # the stub says that it takes 20
    images = peer.listen(Image, 'deblurred/image')

    def send(count):
        for _ in range(count):
            number = len(images)
            peer.send_frame(START + number * SECOND)
            peer.until(lambda number=number: len(images) == number + 1)

    send(8)
    assert [set(m.data) for m in images] == [{191}] * 6 + [{64}] * 2  # 64: no image step
    peer.until(lambda: peer.status()[1].get('mode in use') == 'motion')
    values = peer.status()[1]
    assert (values['mode'], values['mode stepped down']) == ('full', '2')
    assert parameters(peer, deadline_ms=100.0) == []  # room for what was asked for
    send(1)
    assert set(images[-1].data) == {191}
    assert 'deadline_ms' in parameters(peer, deadline_ms=-1.0)[0]


def test_the_lifecycle_stops_and_frees_the_work(peer, start):
    start('-p', 'autostart:=false')
    state = peer.call(GetState, 'depth_deblur/get_state', GetState.Request()).current_state
    assert state.label == 'unconfigured'
    moves = peer.listen(TwistStamped, 'displacement')
    assert peer.node.count_publishers('displacement') == 0
    change_state(peer, Transition.TRANSITION_CONFIGURE)
    peer.until(lambda: peer.status()[0] == 'not active')
    change_state(peer, Transition.TRANSITION_ACTIVATE)
    peer.send_frame(START)
    peer.until(lambda: len(moves) == 1)
    change_state(peer, Transition.TRANSITION_DEACTIVATE)
    peer.until(lambda: peer.node.count_subscribers(COLOUR) == 0)
    peer.send_frame(START + SECOND)
    peer.spin(0.5)
    assert len(moves) == 1
    change_state(peer, Transition.TRANSITION_ACTIVATE)
    peer.until(lambda: peer.node.count_subscribers(COLOUR) == 1)
    peer.spin(1.0)
    peer.send_frame(START + 2 * SECOND)
    peer.until(lambda: len(moves) == 2)
    assert_all_accounted(peer.settled(published=2))
    change_state(peer, Transition.TRANSITION_DEACTIVATE)
    change_state(peer, Transition.TRANSITION_CLEANUP)
    peer.until(lambda: peer.node.count_publishers('displacement') == 0)
    change_state(peer, Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)


def test_bad_frames_pass_unchanged_and_are_flagged(peer, start):
    node = start()
    images = peer.listen(Image, 'deblurred/image')
    results = peer.listen(DiagnosticStatus, 'result')
    peer.send_frame(START, info=False)  # no camera_info yet
    peer.until(lambda: len(results) == 1)
    peer.send_frame(START + SECOND, depth=np.ones((24, 32), np.float32))
    peer.until(lambda: len(results) == 2)
    peer.send_frame(START + 2 * SECOND, image=np.zeros((48, 64, 3), np.float32))  # breaks down
    peer.until(lambda: len(results) == 3)
    garbage = colour_message(START + 3 * SECOND)
    garbage.encoding = 'garbage'
    peer.send(COLOUR, Image, garbage)
    peer.send(DEPTH, Image, depth_message(START + 3 * SECOND))
    peer.until(lambda: len(results) == 4)
    short = colour_message(START + 4 * SECOND)
    short.data = short.data[:7]
    peer.send(COLOUR, Image, short)
    peer.send(DEPTH, Image, depth_message(START + 4 * SECOND))
    peer.until(lambda: len(results) == 5)
    peer.send_frame(START + 5 * SECOND)
    peer.until(lambda: len(results) == 6 and len(images) == 4)
    said = [result.message for result in results]
    assert said[0] == 'no camera_info has come yet'
    assert said[1].startswith('depth is 32x24 but the image is 64x48')
    assert said[2] == 'the solver broke down: ZeroDivisionError: a black frame'
    assert said[3].startswith("image encoding 'garbage'")
    assert 'does not fit in 7 bytes' in said[4]
    assert said[5] == 'solved'
    # Unchanged where there is an image at all.
    assert [set(m.data) for m in images] == [{64}, {64}, {0}, {191}]
    assert [r.level for r in results] == [b'\x02'] * 5 + [b'\x00']
    values = peer.settled(published=6)
    assert values['failed: no camera_info has come yet'] == '1'
    assert_all_accounted(values)
    assert 'ZeroDivisionError' in node.text()
    node.log.write_text('')  # the traceback of the breakdown is wanted here


def test_silence_is_explained(peer, start):
    start('-p', 'lazy:=false')
    peer.until(lambda: 'no publisher' in peer.status()[0], 15)
    assert f'nothing on /{COLOUR}' in peer.status()[0]
    assert f'nothing on /{DEPTH}' in peer.status()[0]
    fast = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    for i in range(70):  # colour alone
        peer.send(COLOUR, Image, colour_message(START + i * 33_000_000), fast)
        peer.spin(0.02)
    peer.until(lambda: peer.status()[0].startswith(f'nothing on /{DEPTH}'), 15)
    values = peer.settled(arrived=70)
    assert_all_accounted(values)
    assert values['dropped: no depth within the slop'] == '70'


def test_stamps_apart_and_another_qos_are_told(peer, start):
    start(
        '-p', 'lazy:=false',
        '-p', f'qos_overrides./{INFO}.subscription.reliability:=reliable',
    )  # fmt: skip
    best_effort = qos(ReliabilityPolicy.BEST_EFFORT)
    publisher = peer.node.create_publisher(CameraInfo, INFO, best_effort)
    for i in range(60):
        peer.send(COLOUR, Image, colour_message(START + i * 100_000_000))
        peer.send(DEPTH, Image, depth_message(START + i * 100_000_000 + 45_000_000))
        peer.spin(0.1)
    peer.until(lambda: 'another QoS: RELIABILITY' in peer.status()[0], 15)
    peer.node.destroy_publisher(publisher)
    assert parameters(peer, camera='tum_fr3') == []  # camera_info is not needed any more
    for i in range(60, 120):
        peer.send(COLOUR, Image, colour_message(START + i * 100_000_000))
        peer.send(DEPTH, Image, depth_message(START + i * 100_000_000 + 45_000_000))
        peer.spin(0.1)
    peer.until(lambda: 'apart' in peer.status()[0], 15)
    assert '0.045 s apart at best, sync_slop_s is 0.02' in peer.status()[0]
    values = peer.status()[1]
    assert_all_accounted(values)
    assert int(values['unused depths']) > 100


def assert_only_overtaken(values, pairs):
    """All are paired; a busy machine may overtake a few, nothing else is lost."""
    overtaken = values.get('dropped: overtaken by a newer pair while the solver was busy', '0')
    assert (values['pairs'], values['dropped']) == (str(pairs), overtaken)
    assert int(overtaken) < pairs / 4


def test_late_depth_still_finds_its_colour(peer, start):
    start(STUB_SECONDS='0')
    moves = peer.listen(TwistStamped, 'displacement')
    peer.send_frame(START)
    sent = [START + (i + 1) * 33_000_000 for i in range(20)]
    for i, stamp in enumerate(sent):
        peer.send(COLOUR, Image, colour_message(stamp))
        if i >= 6:  # 200 ms late
            peer.send(DEPTH, Image, depth_message(sent[i - 6]))
        peer.spin(0.04)
    for stamp in sent[-6:]:
        peer.send(DEPTH, Image, depth_message(stamp))
        peer.spin(0.04)
    values = peer.settled(arrived=21)
    assert set(stamps(moves)) <= {START, *sent} and stamps(moves) == sorted(stamps(moves))
    assert_only_overtaken(values, 21)
    assert values['unused depths'] == '0'


def test_an_older_depth_is_taken_after_the_slop(peer, start):
    start()
    moves = peer.listen(TwistStamped, 'displacement')
    peer.send_frame(START)
    peer.send(DEPTH, Image, depth_message(START + SECOND - 5_000_000))
    peer.send(COLOUR, Image, colour_message(START + SECOND))
    peer.until(lambda: len(moves) == 2, 1.0)


def test_a_looped_bag_goes_on(peer, start):
    start(STUB_SECONDS='0')
    moves = peer.listen(TwistStamped, 'displacement')
    sent = [START + i * 100_000_000 for i in range(10)]
    for _ in range(3):
        for stamp in sent:
            peer.send_frame(stamp)
            peer.spin(0.05)
    assert_only_overtaken(peer.settled(arrived=30), 30)
    seen = stamps(moves)
    assert set(seen) <= set(sent) and sum(np.diff(seen) < 0) == 2


def test_ros_time_that_jumps_back_drops_what_waits(peer, start):
    start('-p', 'use_sim_time:=true')
    moves = peer.listen(TwistStamped, 'displacement')
    clock = peer.node.create_publisher(Clock, '/clock', 10)
    peer.until(lambda: clock.get_subscription_count() > 0)
    peer.spin(0.5)

    def tick(time_ns):
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(time_ns, SECOND)
        clock.publish(message)
        peer.spin(0.3)

    tick(START + SECOND)
    peer.send_frame(START + SECOND)
    peer.until(lambda: len(moves) == 1)
    peer.settled(published=1)
    # The latency is that of ROS time, which stands still here.
    assert float(peer.status()[1]['latency p50 [s]']) == 0
    peer.send(COLOUR, Image, colour_message(START + SECOND + 50_000_000))  # waits for its depth
    peer.spin(0.3)
    tick(START)
    values = peer.settled(arrived=2)
    assert values['dropped: ROS time jumped back'] == '1'
    peer.send_frame(START + 10_000_000)
    peer.until(lambda: len(moves) == 2)
    assert_all_accounted(peer.settled(published=2))


def test_compressed_in_and_out(peer, start):
    start(
        '-p', 'colour_transport:=compressed', '-p', 'depth_transport:=compressedDepth',
        '-r', f'{COLOUR}:=/cam/color', '-r', f'{DEPTH}:=/cam/depth',
    )  # fmt: skip
    cv2 = pytest.importorskip('cv2')
    packed = peer.listen(CompressedImage, 'deblurred/image/compressed')
    info = ros_parts.camera_info_fields(ros_parts.CAMERA, ros_parts.header_fields(START, 'c'))
    colour, depth = CompressedImage(), CompressedImage()
    for message in (colour, depth):
        message.header = colour_message(START).header
    picture = np.full((48, 64, 3), (10, 60, 200), np.uint8)  # blue first
    colour.format = 'rgb8; png compressed bgr8'
    colour.data = cv2.imencode('.png', picture)[1].tobytes()
    depth.format = '16UC1; compressedDepth'
    metres = np.full((48, 64), 2000, np.uint16)
    depth.data = bytes(12) + cv2.imencode('.png', metres)[1].tobytes()
    peer.send(INFO, CameraInfo, ros_parts.filled(CameraInfo(), info))
    peer.send('/cam/color/compressed', CompressedImage, colour)
    peer.send('/cam/depth/compressedDepth', CompressedImage, depth)
    peer.until(lambda: packed)
    assert packed[0].format == 'rgb8; jpeg compressed bgr8'
    seen = cv2.imdecode(np.frombuffer(packed[0].data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert np.abs(seen.astype(int) - (245, 195, 55)).max() <= 3


def test_two_nodes_in_two_namespaces(peer, start):
    for name in ('left', 'right'):
        start('-r', f'__ns:=/{name}')
    heard = {n: peer.listen(TwistStamped, f'/{n}/displacement') for n in ('left', 'right')}
    for i, name in enumerate(('left', 'right')):
        names = [f'/{name}/{topic}' for topic in (COLOUR, DEPTH, INFO)]
        peer.send_frame(START + i * SECOND, names=names)
    peer.until(lambda: all(heard.values()))
    peer.spin(0.3)
    assert [stamps(m) for m in heard.values()] == [[START], [START + SECOND]]


def test_outputs_take_another_qos_by_parameter(peer, start):
    start('-p', 'qos_overrides./displacement.publisher.durability:=transient_local')
    moves = peer.listen(TwistStamped, 'displacement')
    peer.send_frame(START)
    peer.until(lambda: moves)
    late = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    heard = []
    peer.node.create_subscription(TwistStamped, 'displacement', heard.append, late)
    peer.until(lambda: heard)


@pytest.mark.parametrize('signals', [['INT'], ['TERM'], ['INT', 'INT'], ['TERM', 'INT', 'TERM']])
def test_signals_end_it_well_in_the_midst_of_work(peer, start, signals):
    node = start(STUB_SECONDS='0.5')
    peer.listen(TwistStamped, 'displacement')
    for i in range(5):
        peer.send_frame(START + i * 33_000_000)
    peer.spin(0.2)
    for name in signals[:-1]:
        node.process.send_signal(getattr(signal, f'SIG{name}'))
        time.sleep(0.1)
    assert node.stop(getattr(signal, f'SIG{signals[-1]}'), timeout=10) == 0
    assert 'rror' not in node.text()


@pytest.mark.parametrize('signals', [['INT'], ['TERM'], ['INT', 'INT']])
def test_signals_do_not_wait_for_a_slow_solver(peer, start, signals):
    node = start(STUB_SECONDS='100')
    moves = peer.listen(TwistStamped, 'displacement')
    peer.send_frame(START)
    peer.until(lambda: peer.status()[1].get('waiting') == '1')
    begin = time.monotonic()
    for name in signals:
        node.process.send_signal(getattr(signal, f'SIG{name}'))
        time.sleep(0.05)
    assert node.wait(30) == 0
    assert time.monotonic() - begin < 10  # by itself it takes one
    assert 'rror' not in node.text() and not moves


@pytest.mark.parametrize('name', ['INT', 'TERM'])
@pytest.mark.parametrize('module', ['numba', 'rclpy', 'sensor_msgs.msg'])
def test_a_signal_while_it_is_being_loaded_ends_it_in_peace(name, module):
    code = f"""
import os, signal, sys

class Loading:
    def find_spec(self, name, *_):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIG{name})

sys.meta_path.insert(0, Loading())
from depth_deblur_ros.deblur_node import main
sys.exit(main())
"""
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')


def test_a_large_frame_in_full_does_not_delay_the_end(peer, start, tmp_path):
    width, height = 1920, 1080
    camera = {'fx': 1500.0, 'fy': 1500.0, 'cx': 959.5, 'cy': 539.5, 'depth_scale': 1000.0}
    camera |= {'width': width, 'height': height, 'exposure': None, 'transfer': 'srgb'}
    path = tmp_path / 'camera.json'
    path.write_text(json.dumps(camera))
    node = start('-p', f'camera:={path}', '-p', 'mode:=full', command=ros_parts.NODE)
    images = peer.listen(Image, 'deblurred/image')
    peer.until(lambda: peer.status()[0].startswith('nothing on'), 90)  # the solver is ready
    noise = np.random.default_rng(0).random((height, width, 3), np.float32)
    noise = np.cumsum(noise - 0.5, axis=1)  # a blur to the right
    image = (0.5 + 0.1 * (noise[:, 16:] - noise[:, :-16])).clip(0, 1)
    image = np.pad(image, ((0, 0), (8, 8), (0, 0)), 'edge')
    peer.send_frame(START, image=image, depth=np.ones((height, width), np.float32), info=False)
    peer.until(lambda: peer.status()[1].get('waiting') == '1')
    peer.spin(0.5)
    begin = time.monotonic()
    assert node.stop(signal.SIGTERM, timeout=30) == 0
    assert time.monotonic() - begin < 10
    assert not images and 'rror' not in node.text()


def test_a_killed_node_starts_anew(peer, start):
    node = start()
    moves = peer.listen(TwistStamped, 'displacement')
    peer.send_frame(START)
    peer.until(lambda: len(moves) == 1)
    node.kill()
    start()
    # DDS notices the death late; the new node hears the same publishers.
    peer.until(lambda: peer.status()[1].get('arrived') == '0')
    send_until(peer, START + SECOND, lambda: len(moves) > 1)


@pytest.mark.parametrize(
    ('arguments', 'text'),
    [
        (('-p', 'threads:=0'), 'threads'),
        (('-p', 'mode:=quick'), "mode must be one of ('full', 'fast', 'motion'), got 'quick'"),
        (('-p', 'exposure_s:=1'), 'exposure_s'),
        (('-p', 'camera:=nowhere.json'), 'camera must be a file'),
        (('--params-file', 'nowhere.yaml'), 'nowhere.yaml'),
    ],
)
def test_what_cannot_work_is_refused_at_the_start(peer, start, arguments, text):
    node = start(*arguments)
    assert node.wait(20) == 2
    assert text in node.text()


def test_presets_and_defaults_are_accepted(peer, start, tmp_path):
    config = Path(ros_parts.ROOT) / 'config'
    for path in (config / 'deblur.yaml', *sorted((config / 'presets').glob('*.yaml'))):
        node = start('--params-file', str(path), '-p', 'lazy:=false', '-r', f'__node:={path.stem}')
        request = GetParameters.Request(names=['colour_topic'])
        answer = peer.call(GetParameters, f'{path.stem}/get_parameters', request)
        topic = answer.values[0].string_value
        peer.until(lambda topic=topic: peer.node.count_subscribers(topic) == 1)
        assert node.stop() == 0
        peer.until(lambda topic=topic: peer.node.count_subscribers(topic) == 0)


def test_the_real_solver_at_thirty_frames_a_second(peer, start, tmp_path):
    """All that is sent arrives, and what is published is the bag's motion, but for its sign."""
    import play_bag

    remaps = [w for old, new in play_bag.REMAP.items() for w in ('-r', f'{old}:={new}')]
    start(*remaps, '-p', 'mode:=motion', command=ros_parts.NODE)
    moves = peer.listen(TwistStamped, 'displacement')
    twists = peer.listen(TwistStamped, 'motion')
    spreads = peer.listen(TwistWithCovarianceStamped, 'motion_with_covariance')
    infos = peer.listen(CameraInfo, 'deblurred/camera_info')
    results = peer.listen(DiagnosticStatus, 'result')
    peer.until(lambda: peer.status()[0].startswith('nothing on'), 90)  # the solver is ready
    player = Process(
        (sys.executable, ros_parts.ROOT / 'scripts/play_bag.py', '--frames', 120),
        tmp_path / 'sent',
    )
    peer.until(lambda: player.process.poll() is not None, 60)
    sent = player.json()['stamps']
    values = peer.settled(timeout=60)
    assert_all_accounted(values)
    for role in ('colour', 'depth', 'camera_info'):
        # The profile loses nothing; a busy machine may stop the node for longer than its queue.
        lost = values[f'{role} lost in transport']
        assert lost == values[f'{role} lost in a full queue']
        assert int(values[f'{role} arrived']) + int(lost) == len(sent)
    peer.spin(0.5)
    assert int(values['published']) == len(moves) == len(results) == len(infos) > 0
    assert set(stamps(moves)) <= set(sent)
    assert stamps(moves) == stamps(infos) == stamps(spreads)
    assert {m.header.frame_id for m in (*moves, *twists, *spreads, *infos)} == {
        'camera_rgb_optical_frame'
    }
    assert (infos[0].k[0], infos[0].width, infos[0].height) == (525.0, 640, 480)
    known = dict(zip(stamps(twists), twists, strict=True))
    for move, spread, result in zip(moves, spreads, results, strict=True):
        assert_velocities(move, known.pop(stamps([move])[0], None), spread, result)
    assert not known
    errors = [
        displacement_error(move, true_twist(sent.index(stamp) % 10))
        for move, stamp, result in zip(moves, stamps(moves), results, strict=True)
        if result.message == 'solved'
    ]
    assert errors and np.median(errors) < 0.35


EXPOSURE = 0.02  # s, of the sample bag


def assert_velocities(move, twist, spread, result):
    """The velocities are the displacement over the exposure; none is told where it is open."""
    values = {entry.key: entry.value for entry in result.values}
    failed = values['outcome'] == 'failed'
    expected = six(move.twist) / EXPOSURE
    told = values['sign_resolved'] == 'true' and not failed
    assert (twist is not None) == told
    if told:
        np.testing.assert_allclose(six(twist.twist), expected, rtol=1e-6)
    mean, covariance = six(spread.twist.twist), np.reshape(spread.twist.covariance, (6, 6))
    np.testing.assert_allclose(mean, expected if told else 0, rtol=1e-6)
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert (np.diag(covariance) >= 0.999 * np.square(expected - mean)).all()
    assert not failed or covariance[0, 0] == UNKNOWN_VARIANCE


def six(twist):
    """Give linear and angular in one vector."""
    return np.array([getattr(part, x) for part in (twist.linear, twist.angular) for x in 'xyz'])


def true_twist(number):
    """Give the camera's rotation over the exposure of a frame of the sample bag."""
    from depth_deblur_ros.bag import BagReader, decoded
    import play_bag

    with BagReader(play_bag.BAG) as bag:
        messages = list(bag.messages({'/ground_truth/motion'}))
    angular = decoded(messages[number]).twist.angular
    return EXPOSURE * np.array([angular.x, angular.y, angular.z])


def displacement_error(move, truth):
    """Give the relative error of the rotation across the image, with the better sign."""
    seen = np.array([move.twist.angular.x, move.twist.angular.y])
    distance = min(np.linalg.norm(seen - truth[:2]), np.linalg.norm(seen + truth[:2]))
    return distance / np.linalg.norm(truth[:2])


CYCLONE = """<CycloneDDS><Domain><General>
<Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><Peers><Peer address="127.0.0.1"/></Peers>
<ParticipantIndex>auto</ParticipantIndex></Discovery></Domain></CycloneDDS>"""


@pytest.mark.parametrize(('reliability', 'side'), [('best_effort', 120), ('reliable', 480)])
def test_a_client_on_another_dds(peer, start, tmp_path, reliability, side):
    pytest.importorskip('cyclonedds')
    policies = [
        word
        for topic in (COLOUR, DEPTH)
        for word in ('-p', f'qos_overrides./{topic}.subscription.reliability:={reliability}')
    ]
    start('-p', 'exposure_s:=0.02', '-p', 'prior:=0.5', *policies)
    width = side * 4 // 3
    client = Process(
        (sys.executable, ros_parts.ROOT / 'test/dds_client.py', 20, width, side),
        tmp_path / 'client',
        CYCLONEDDS_URI=CYCLONE,
    )
    peer.until(lambda: client.process.poll() is not None, 90)
    got = client.json()
    stamps = [1_700_000_000 + number for number in range(20)]
    size = 3 * width * side
    assert got['images'] == [[s, 245 - n, size] for n, s in enumerate(stamps)]
    assert got['twists'] == [[s, -0.03 / 0.02] for s in stamps]
    values = peer.settled()
    assert_all_accounted(values)
    assert 21 <= int(values['published']) <= 25
