"""What the node says about itself."""

from types import SimpleNamespace

from depth_deblur_ros.health import Health, Meter, OK, Said, Stream, WARN
from depth_deblur_ros.live import Intake
from depth_deblur_ros.settings import settings_from
import pytest
from test_live import message


def health(now=0.0):
    made = Health(Intake(0.02))
    made.began = now
    for role in ('colour', 'depth', 'camera_info'):
        made.stream(role, f'/{role}', True)
    made.stream('exposure', '/exposure', False)
    return made


def pair(made, now, stamp):
    made.intake.push_depth(message(stamp))
    made.arrived('depth', now)
    made.intake.push_colour(message(stamp), 0)
    made.arrived('colour', now)
    made.arrived('camera_info', now)


def solved(reason='', seconds=0.1):
    outcome = SimpleNamespace(value='failed' if reason else 'solved')
    return SimpleNamespace(reason=reason, result=SimpleNamespace(outcome=outcome, seconds=seconds))


def test_a_rate_is_that_of_the_last_seconds():
    meter = Meter()
    assert meter.rate(0.0) == 0
    for i in range(300):
        meter.tick(i / 30)
    assert meter.rate(10.0) == pytest.approx(30)
    assert meter.rate(100.0) == 0
    assert meter.count == 300


def test_nothing_is_wrong_for_five_seconds():
    made = health()
    assert made.verdict(0.02, 4.9)[0] == OK
    made.streams['depth'].publishers = 2
    level, text = made.verdict(0.02, 6.0)
    assert level == WARN
    assert text == (
        'nothing on /colour for 6 s (no publisher); nothing on /depth for 6 s (2 publishers); '
        'nothing on /camera_info for 6 s (no publisher)'
    )


def test_only_what_is_silent_is_named():
    made = health()
    for i in range(10):
        made.intake.push_colour(message(33 * i), 0)
        made.arrived('colour', float(i))
        made.arrived('camera_info', float(i))
    assert made.verdict(0.02, 9.0)[1] == 'nothing on /depth for 9 s (no publisher)'
    made.stream('depth', '/depth', True).mismatch = 'RELIABILITY'
    assert 'a publisher on /depth offers another QoS: RELIABILITY' in made.verdict(0.02, 9.0)[1]


def test_stamps_apart_are_told_with_their_gap():
    made = health()
    for i in range(10):
        for role, push, stamp in (
            ('depth', made.intake.push_depth, 100 * i + 45),
            ('colour', lambda m: made.intake.push_colour(m, 0), 100 * i),
        ):
            push(message(stamp))
            made.arrived(role, float(i))
        made.arrived('camera_info', float(i))
    level, text = made.verdict(0.02, 9.5)
    assert level == WARN
    assert text == 'the stamps of colour and depth are 0.045 s apart at best, sync_slop_s is 0.02'


def test_failures_are_flagged_while_they_are_new():
    made = health()
    pair(made, 1.0, 0)
    made.count(solved('no camera_info has come yet'), 0.1, 1.0)
    assert made.verdict(0.02, 2.0) == (
        WARN,
        'frames pass unchanged: no camera_info has come yet',
    )
    pair(made, 6.5, 100)
    made.count(solved(), 0.1, 6.5)
    assert made.verdict(0.02, 7.0)[0] == OK


def test_all_figures_are_in_the_status():
    made = health()
    for i in range(4):
        pair(made, i / 30, 33 * i)
    made.intake.mailbox.take()
    made.intake.mailbox.finish()
    made.count(solved(seconds=0.2), 0.25, 0.2)
    status = made.status('deblur: frames', '', settings_from({'mode': 'fast'}), 1.1)
    values = {entry['key']: entry['value'] for entry in status['values']}
    assert (status['level'], status['name']) == (OK, 'deblur: frames')
    assert values['mode'] == 'fast'
    assert (values['arrived'], values['published'], values['dropped']) == ('4', '1', '3')
    assert values['dropped: overtaken by a newer pair while the solver was busy'] == '3'
    assert values['colour rate [Hz]'] == '30.00'
    assert values['latency p50 [s]'] == values['latency p99 [s]'] == '0.2500'
    assert values['solver p99 [s]'] == '0.2000'
    assert values['age of the last pair [s]'] == '1.00'
    assert made.status('n', 'not active', settings_from({}), 100.0)['message'] == 'not active'


def test_another_topic_is_counted_anew():
    made = health()
    made.arrived('depth', 1.0)
    assert made.stream('depth', '/depth', True).meter.count == 1
    assert made.stream('depth', '/other', True).meter.count == 0


def test_what_is_missing_between_two_messages_is_lost():
    stream = Stream('/colour')
    stream.follow(7)  # nobody known to publish yet
    stream.match(1)
    for number in (8, 9, 12, 13):
        stream.follow(number)
    stream.miss(1)
    assert (stream.missing, stream.lost) == (2, 1)
    stream.match(1)  # another publisher
    stream.follow(1000)
    assert stream.missing == 2


def test_without_numbers_the_transport_says_what_is_lost():
    stream = Stream('/colour')
    for publishers, numbers in ((2, (1, 50, 2, 51)), (1, (None, None))):
        stream.match(publishers)
        for number in numbers:
            stream.follow(number)
    stream.miss(3)
    assert (stream.missing, stream.lost) == (3, 3)


def test_a_warning_is_repeated_only_now_and_then():
    said = Said()
    assert said.is_new('nothing for 5 s', 0.0)
    assert not said.is_new('nothing for 6 s', 1.0)
    assert said.is_new('another', 1.0)
    assert said.is_new('nothing for 10 s', 5.5)
