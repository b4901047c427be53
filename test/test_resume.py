"""A replay that is killed and goes on gives the messages of one that was left alone."""

import json
import os
from pathlib import Path
import random
import resource
import signal
import subprocess
import sys
import time

from depth_deblur_ros.bag import BagReader, BagWriter, decoded
from depth_deblur_ros.core.data import InputError
from depth_deblur_ros.journal import pairs_done
from depth_deblur_ros.messages import header_fields, image_fields
from depth_deblur_ros.review import TWIST_TOPIC
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
import numpy as np
import pytest
import stub_replay
import test_replay
from test_replay import run, START, STEP, write_depth, write_info

SAMPLE = Path(__file__).resolve().parents[1] / 'bags/sample'
FRAMES = 12
SHAPE = (48, 64)
MOMENTS = [
    ('solving', 1),
    ('solving', 6),
    ('writing', 3),
    ('writing', 40),
    ('flushing', 5),
    ('noting', 1),
    ('noting', 7),
    ('remembering', 1),
    ('remembering', 9),
    ('noted', 1),
    ('noted', 12),
    ('publishing', 1),
    ('going on', 1),
]


def write_bag(path, frames=FRAMES):
    rng = np.random.default_rng(5)
    with BagWriter(path) as bag:
        for i in range(frames):
            write_info(bag, i)
            image = rng.random((*SHAPE, 3), np.float32)
            fields = image_fields(image, header_fields(START + i * STEP, 'camera_optical'))
            bag.write(test_replay.COLOUR, test_replay.IMAGE, fields, START + i * STEP + 1000)
            write_depth(bag, i)
            bag.write('/note', 'std_msgs/msg/String', {'data': f'note {i}'}, START + i * STEP)
    return path


class Fork:
    """The stub in a process of its own, which need not import all anew."""

    def __init__(self, arguments, log):
        self._log = log
        self.code = None
        self._pid = os.fork()
        if self._pid == 0:
            code = 3
            try:
                with log.open('w') as sys.stdout, log.open('a') as sys.stderr:
                    sys.argv = ['stub', *arguments]
                    code = stub_replay.main()
            finally:
                os._exit(code)

    def kill(self):
        os.kill(self._pid, signal.SIGKILL)
        return self.wait()

    def wait(self, patience=60):
        """Give the exit code, negative for a signal, and what was said."""
        end = time.monotonic() + patience
        while (found := os.waitpid(self._pid, os.WNOHANG))[0] == 0:
            if time.monotonic() > end:
                os.kill(self._pid, signal.SIGKILL)
            time.sleep(0.005)
        return os.waitstatus_to_exitcode(found[1]), self._log.read_text()


def start(bag, out, moment=None, *, wait=True, seconds=0.0, **options):
    """Run the stub; give its exit code and what it says."""
    options = {'all_topics': True, 'estimates': f'{out}.jsonl', **options}
    stub_replay.SECONDS = seconds
    arguments = [str(word) for word in (bag, out, json.dumps(options), *(moment or ()))]
    log = bag.parent / 'log'
    log.write_text('')
    fork = Fork(arguments, log)
    return fork.wait() if wait else fork


def files(out):
    """Give the messages of a bag in their order, and its estimates, all but the time it took."""
    assert sorted(p.name for p in out.iterdir()) == ['metadata.yaml', f'{out.name}.mcap']
    messages = []
    with (out / f'{out.name}.mcap').open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found = reader.iter_decoded_messages(log_time_order=False)
        for _, channel, message, content in found:
            data = message.data
            if channel.topic == '/result':
                values = [(v.key, v.value) for v in content.values if v.key != 'seconds']
                data = (content.level, content.name, content.message, values)
            messages.append((channel.topic, message.log_time, data))
    lines = [json.loads(line) for line in Path(f'{out}.jsonl').read_text().splitlines()]
    return messages, [{**line, 'seconds': None} for line in lines]


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp('resume') / 'in')


@pytest.fixture(scope='module')
def whole(bag):
    """Give what comes out when nobody interrupts."""
    out = bag.parent / 'whole' / 'out'
    code, said = start(bag, out)
    assert code == 0, said
    assert 'failed' in said
    return files(out), said


@pytest.mark.parametrize(('moment', 'number'), MOMENTS)
def test_a_killed_run_goes_on_as_if_nothing_had_been(bag, whole, tmp_path, moment, number):
    out = tmp_path / 'out'
    assert start(bag, out, (moment, number))[0] == -signal.SIGKILL
    assert not out.exists()
    code, said = start(bag, out, resume=True)
    assert code == 0, said
    assert (files(out), said) == whole
    assert sorted(p.name for p in tmp_path.iterdir()) == ['out', 'out.jsonl']


def test_what_is_done_is_not_done_again(bag, whole, tmp_path):
    out = tmp_path / 'out'
    start(bag, out, ('solving', 8))
    assert start(bag, out, ('solving', FRAMES - 6), resume=True)[0] == 0  # five are left
    assert files(out) == whole[0]


def test_kills_at_any_moments_one_after_another_change_nothing(bag, whole, tmp_path):
    out, rng = tmp_path / 'out', random.Random(0)
    kills = 0
    for _ in range(10):
        process = start(bag, out, wait=False, seconds=0.2, resume=True)
        time.sleep(rng.uniform(0.05, 0.6))
        kills += process.kill()[0] == -signal.SIGKILL
        if out.exists():
            break
    else:
        assert start(bag, out, resume=True)[0] == 0
    assert kills > 1
    assert files(out) == whole[0]


def test_a_kill_while_an_older_bag_is_replaced_loses_nothing(bag, whole, tmp_path):
    out = tmp_path / 'out'
    start(bag, out, duration=0.1)
    assert start(bag, out, ('publishing', 1), overwrite=True)[0] == -signal.SIGKILL
    assert (out / 'metadata.yaml').is_file()  # still the old one
    assert start(bag, out, overwrite=True, resume=True)[0] == 0
    assert files(out) == whole[0]


def test_a_run_without_resume_starts_anew(bag, whole, tmp_path):
    out = tmp_path / 'out'
    start(bag, out, ('solving', 8))
    assert start(bag, out)[0] == 0
    assert files(out) == whole[0]
    assert sorted(p.name for p in tmp_path.iterdir()) == ['out', 'out.jsonl']


def test_resume_without_anything_to_go_on_with_starts(bag, whole, tmp_path):
    assert start(bag, tmp_path / 'out', resume=True)[0] == 0
    assert files(tmp_path / 'out') == whole[0]


def test_a_run_of_another_kind_is_not_gone_on_with(bag, tmp_path):
    out = tmp_path / 'out'
    start(bag, out, ('solving', 8))
    code, said = start(bag, out, resume=True, exposure_s=0.5)
    assert code == 2
    assert 'was made with given' in said
    assert 'leave out --resume' in said
    code, said = start(bag, out, resume=True)  # the refusal has thrown nothing away
    assert code == 0, said


def test_two_runs_never_write_one_bag(bag, tmp_path):
    out = tmp_path / 'out'
    first = start(bag, out, wait=False, seconds=0.5)
    end = time.monotonic() + 30
    while not list(tmp_path.glob('.out.unfinished/*/lines')):
        assert time.monotonic() < end
        time.sleep(0.02)
    code, said = start(bag, out, resume=True)
    first.kill()
    assert (code, said) == (2, 'out is being written by another process\n')


def test_a_damaged_journal_is_refused_where_the_solver_remembers(bag, tmp_path):
    out = tmp_path / 'out'
    start(bag, out, ('solving', 8))
    (part,) = tmp_path.glob('.out.unfinished/*/out/out.mcap')
    part.write_bytes(part.read_bytes()[:20_000])
    code, said = start(bag, out, resume=True)
    assert code == 2
    assert 'is damaged' in said


def test_an_interrupt_keeps_what_is_done(tmp_path):
    bag = test_replay.write_bag(tmp_path / 'in')
    seen = []

    def stop_at_the_third(frame, params):
        seen.append(frame.stamp_ns)
        if len(seen) == 3:
            raise KeyboardInterrupt
        return test_replay.solve(frame, params)

    with pytest.raises(KeyboardInterrupt):
        run(bag, tmp_path / 'out', solve=stop_at_the_third)
    assert not (tmp_path / 'out').exists()
    assert run(bag, tmp_path / 'out', solve=stop_at_the_third, resume=True).complete
    assert len(seen) == 3 + test_replay.FRAMES - 2
    assert [p.name for p in sorted(tmp_path.iterdir())] == ['in', 'out']


@pytest.fixture
def room():
    """Let files grow only so far; give what sets it."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize('size', [0, 100, 5_000, 40_000, 120_000])
def test_a_full_disk_is_one_clear_error_and_leaves_nothing_corrupt(bag, tmp_path, room, size):
    out = tmp_path / 'out'
    room(size)
    with pytest.raises(InputError, match=r'cannot write .*: File too large') as raised:
        run(bag, out, all_topics=True, estimates=tmp_path / 'e.jsonl')
    assert '\n' not in str(raised.value)
    assert not out.exists()
    assert not (tmp_path / 'e.jsonl').exists()
    room(resource.RLIM_INFINITY)
    if list(tmp_path.iterdir()):
        assert '--resume goes on from there' in str(raised.value)
    summary = run(bag, out, all_topics=True, estimates=tmp_path / 'e.jsonl', resume=True)
    assert summary.pairs == FRAMES
    assert len((tmp_path / 'e.jsonl').read_text().splitlines()) == FRAMES
    with BagReader(out) as found:
        assert found.damage == []
        assert len(list(found.messages({'/result'}))) == FRAMES
    assert sorted(p.name for p in tmp_path.iterdir()) == ['e.jsonl', 'out']


def with_gyro(source, path):
    """Copy a bag and add a gyro that tells its true turns, 200 times a second."""
    with BagReader(source) as found, BagWriter(path) as bag:
        messages = list(found.messages(found.topics))
        truth = [(m.log_ns, decoded(m)) for m in messages if m.topic.name == TWIST_TOPIC]
        times = np.array([log for log, _ in truth], np.float64)
        turns = np.array([[getattr(t.twist.angular, a) for a in 'xyz'] for _, t in truth])
        for log in range(int(times[0]), int(times[-1]), 5_000_000):
            rate = [float(np.interp(log, times, turn)) for turn in turns.T]
            fields = {
                'header': header_fields(log, 'camera'),
                'angular_velocity': dict(zip('xyz', rate, strict=True)),
            }
            bag.write('/imu', 'sensor_msgs/msg/Imu', fields, log)
        for message in messages:
            bag.copy(message)
    return path


@pytest.mark.slow
def test_the_real_solver_goes_on_with_its_gyro_behind_a_kill(tmp_path):
    bag = with_gyro(SAMPLE, tmp_path / 'in')
    flags = ['--mode', 'motion', '--all-topics', '--estimates']

    def line(source, out, *more):
        begin = [sys.executable, '-m', 'depth_deblur_ros', 'replay', source, out]
        return [*map(str, begin), *flags, f'{out}.jsonl', *more]

    plain, whole, cut = (tmp_path / name / 'out' for name in ('plain', 'whole', 'cut'))
    assert subprocess.run(line(SAMPLE, plain)).returncode == 0
    assert subprocess.run(line(bag, whole)).returncode == 0
    assert files(whole)[1] != files(plain)[1]  # the gyro counts
    resumed = line(bag, cut, '--resume')
    for pairs in (2, 6):
        process = subprocess.Popen(resumed)
        while pairs_done(cut) < pairs:
            assert process.poll() is None
            time.sleep(0.02)
        process.kill()
        assert process.wait() == -signal.SIGKILL
    assert not cut.exists()
    assert subprocess.run(resumed).returncode == 0
    assert files(cut) == files(whole)
