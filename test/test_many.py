"""Many bags through a pool and through a cluster: what is done, skipped, and told at the end."""

import json
from pathlib import Path
import signal
import subprocess
import sys
import time

from depth_deblur_ros import cli
from depth_deblur_ros.bag import BagReader
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.job import Job, run_apart
from depth_deblur_ros.many import cores, find_bags, jobs_of, Pool, replay_many
import pytest
from test_replay import FRAMES, write_bag

SAMPLE = Path(__file__).resolve().parents[1] / 'bags/sample'
LONG = SolverParams(reweightings=10, cg_steps=30)  # some seconds for each frame
QUICK = ['--mode', 'motion', '--neighbours', 'ignore']


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    """Give a folder of three bags and of a file that is none."""
    folder = tmp_path_factory.mktemp('bags')
    for name in ('a', 'b', 'c'):
        write_bag(folder / name)
    (folder / 'no_bag.mcap').write_text('this is no recording')
    return folder


def run(capsys, *words):
    code = cli.main(['replay', *map(str, words), *QUICK])
    shown = capsys.readouterr()
    return code, shown.out.splitlines(), shown.err


def gone(pid):
    """Whether a process has ended, waited for or not."""
    try:
        return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] == 'Z'
    except OSError:
        return True


def until(condition, seconds=60):
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.05)
    return found


def assert_all_replayed(out):
    for name in ('a', 'b', 'c'):
        with BagReader(out / name) as found:
            assert len(list(found.messages({'/result'}))) == FRAMES
    assert not list(out.glob('.*'))


def test_a_pattern_of_bags_is_replayed_and_the_failures_come_last(bags, tmp_path, capsys):
    out = tmp_path / 'out'
    command = [bags / '*', out, '--workers', 2]
    code, said, error = run(capsys, *command, '--estimates', tmp_path / 'motion')
    assert code == cli.SOME_FAILED, said
    assert said[-2] == '4 bags: 3 done, 0 done before, 1 with failures'
    assert said[-1].startswith(f'failed: {bags}/no_bag.mcap: ')
    assert 'Traceback' not in error
    assert_all_replayed(out)
    lines = sorted(p.name for p in (tmp_path / 'motion').iterdir())
    assert lines == ['a.jsonl', 'b.jsonl', 'c.jsonl']
    made = {path: path.stat().st_mtime_ns for path in out.rglob('*.mcap')}
    code, said, _ = run(capsys, *command)
    assert code == cli.SOME_FAILED
    assert said[-2] == '4 bags: 0 done, 3 done before, 1 with failures'
    assert {path: path.stat().st_mtime_ns for path in out.rglob('*.mcap')} == made


def test_results_of_other_settings_are_not_mixed(bags, tmp_path, capsys):
    out = tmp_path / 'out'
    assert run(capsys, bags / 'a', bags / 'b', out)[0] == cli.DONE
    assert run(capsys, bags / 'a', bags / 'b', out, '--threads', 1)[0] == cli.DONE
    code, _, error = run(capsys, bags / 'a', bags / 'b', out, '--exposure-s', 0.5)
    assert code == cli.BAD_INPUT
    assert f'the results in {out} are of exposure_s None, not 0.5' in error
    code, said, _ = run(
        capsys, bags / 'a', out, '--workers', 1, '--exposure-s', 0.5, '--overwrite'
    )
    assert code == cli.DONE
    assert said[-1] == '1 bags: 1 done, 0 done before, 0 with failures'


@pytest.mark.parametrize(
    ('names', 'line'),
    [
        (['nowhere/*.mcap'], 'no bag fits nowhere/*.mcap'),
        (['x/run', 'y/run.mcap'], 'x/run and y/run.mcap would both become run'),
        (['x', 'y', '--workers', '0'], 'workers must be at least 1, got 0'),
        (['x', 'y', '--workers', '2', '--scheduler', 'z'], 'not allowed with argument --workers'),
    ],
)
def test_what_cannot_work_is_refused_before_any_work(tmp_path, capsys, names, line):
    where = [n for n in names if not n.startswith('-')][:2] if '--workers' in names else names
    code, said, error = run(capsys, *where, tmp_path / 'out', *names[len(where) :])
    assert (code, said) == (cli.BAD_INPUT, [])
    assert line in error
    assert list(tmp_path.iterdir()) == []


def test_a_pool_shares_the_cores(bags, tmp_path):
    seen = []

    class Told(Pool):
        def submit(self, job):
            future = super().submit(job)
            future.add_done_callback(lambda f: seen.append(f.result().code))
            return future

    params = SolverParams(mode='motion', neighbours='ignore', threads=256)
    jobs = jobs_of(find_bags([str(bags / '[ab]')]), Job(bags, tmp_path, params))
    shown = []
    with Told(2) as pool:
        assert pool.threads == max(1, cores() // 2)
        ended = list(replay_many(jobs, pool, lambda done, total: shown.append((done, total))))
    assert seen == [0, 0]
    assert [done.code for _, done in ended] == [0, 0]
    assert shown == sorted(shown)
    assert shown[-1] == (2 * FRAMES, 2 * FRAMES)
    assert Pool(1, threads=3).threads == 3


def test_a_process_that_dies_costs_its_own_bag_alone(bags, tmp_path):
    done = run_apart(Job(bags / 'a', tmp_path / 'a'), lambda process: process.kill())
    assert done.code == -signal.SIGKILL
    assert done.why == 'its process was ended by signal 9'
    assert not (tmp_path / 'a').exists()


def test_an_exception_ends_what_runs_and_keeps_what_is_done(tmp_path):
    jobs = jobs_of([SAMPLE], Job(SAMPLE, tmp_path, LONG))
    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt), Pool(1) as pool:
        future = pool.submit(jobs[0])
        until(lambda: list(tmp_path.glob('.sample.unfinished/*/state')))
        raise KeyboardInterrupt
    assert future.result().code == cli.INTERRUPTED
    assert time.monotonic() - begun < 60
    assert list(tmp_path.glob('.sample.unfinished/*/state'))
    assert not (tmp_path / 'sample').exists()


def test_nothing_outlives_a_parent_that_is_killed(tmp_path):
    code = (
        'from depth_deblur_ros.core.params import SolverParams; '
        'from depth_deblur_ros.job import Job, run_apart; from pathlib import Path; '
        f'run_apart(Job(Path({str(SAMPLE)!r}), Path({str(tmp_path / "out")!r}), {LONG!r}), '
        'lambda process: print(process.pid, flush=True))'
    )
    parent = subprocess.Popen([sys.executable, '-c', code], stdout=subprocess.PIPE, text=True)
    child = int(parent.stdout.readline())
    until(lambda: list(tmp_path.glob('.out.unfinished/*/lines')))
    assert not gone(child)
    parent.kill()
    parent.wait()
    parent.stdout.close()
    until(lambda: gone(child))
    assert not (tmp_path / 'out').exists()


@pytest.fixture
def cluster(tmp_path):
    """Start a scheduler and two workers of one thread each; give its address."""
    distributed = pytest.importorskip('distributed')
    file, processes = tmp_path / 'scheduler.json', []

    def start(name, *words):
        place = ['--host', '127.0.0.1', '--scheduler-file', file, '--no-dashboard']
        command = [sys.executable, '-m', f'distributed.cli.dask_{name}', *place, *words]
        log = (tmp_path / f'{name}{len(processes)}').open('w')
        processes.append(
            subprocess.Popen([*map(str, command)], stdout=log, stderr=log, cwd=tmp_path)
        )
        log.close()

    start('scheduler', '--port', 0)
    try:
        until(file.exists)
        for _ in range(2):
            start('worker', '--nthreads', 1)
        address = json.loads(file.read_text())['address']
        with distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, 60)
        yield address
    finally:
        for process in reversed(processes):
            process.terminate()
        for process in processes:
            process.wait(60)


@pytest.mark.slow
def test_a_cluster_of_two_workers_does_what_a_pool_does(bags, cluster, tmp_path, capsys):
    from depth_deblur_ros.cluster import Cluster

    out = tmp_path / 'out'
    with Cluster(cluster) as place:
        assert set(place.shares.values()) == {max(1, cores() // 2)}
    code, said, error = run(capsys, bags / '*', out, '--scheduler', cluster)
    assert code == cli.SOME_FAILED, [*said, error]
    assert said[-2] == '4 bags: 3 done, 0 done before, 1 with failures'
    assert said[-1].startswith(f'failed: {bags}/no_bag.mcap: ')
    assert_all_replayed(out)


def test_a_scheduler_that_is_not_there_is_one_line(bags, tmp_path, capsys, monkeypatch):
    cluster = pytest.importorskip('depth_deblur_ros.cluster')
    monkeypatch.setattr(cluster, 'PATIENCE_S', 1.0)
    code, said, error = run(capsys, bags / 'a', tmp_path, '--scheduler', 'tcp://127.0.0.1:9')
    assert (code, said) == (cli.BAD_INPUT, [])
    assert 'no scheduler answers at tcp://127.0.0.1:9' in error
