"""
Command line: images, folders of cases and bags in; sharp images, the motion and pictures out.

The only file that prints, and the only one that turns an InputError into an exit code: 0 done,
1 some frames failed, 2 bad input with one line on the error output, 130 interrupted.
What is slow to load is imported by the command that needs it, so that --help is quick.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
import sys
from typing import NoReturn, TYPE_CHECKING

from depth_deblur_ros import flags
from depth_deblur_ros.core.data import InputError, Outcome
from depth_deblur_ros.flags import Parser
from tqdm import tqdm

if TYPE_CHECKING:
    from depth_deblur_ros.cluster import Cluster
    from depth_deblur_ros.job import Job
    from depth_deblur_ros.many import Pool

DONE, SOME_FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
BAG_LIBRARIES = {'lz4', 'mcap', 'rosbags', 'zstandard'}  # a robot may lack them


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and give its exit code."""
    try:
        args = _parser().parse_args(argv)
        if 'params' in args:  # a command that solves
            from depth_deblur_ros.compiling import tell_of_compiling

            tell_of_compiling(lambda text: print(f'depth-deblur: {text}', file=sys.stderr))
        code: int = args.run(args)
        return code
    except (InputError, OSError) as error:
        return _refuse(str(error), BAD_INPUT)
    except ModuleNotFoundError as error:
        missing = str(error.name).split('.')[0]
        if missing == 'distributed':
            return _refuse("--scheduler needs distributed: pip install 'distributed'", BAD_INPUT)
        if missing not in BAG_LIBRARIES:
            raise
        return _refuse(f'bags need {missing}: pip install {missing}', BAD_INPUT)
    except KeyboardInterrupt:
        return _refuse('interrupted', INTERRUPTED)


def _refuse(text: str, code: int) -> int:
    print(f'depth-deblur: {text}', file=sys.stderr)
    return code


def replay_main() -> int:
    """Run `depth-deblur replay`, the executable that `ros2 run depth_deblur_ros replay` starts."""
    return main(['replay', *sys.argv[1:]])


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog='depth-deblur', description='Deblur RGB-D images and tell the motion.')
    parser.add_argument('--version', action='version', version=flags.installed_version())
    commands = parser.add_subparsers(metavar='COMMAND', required=True)

    def command(name: str, run: Callable[[argparse.Namespace], int], text: str) -> Parser:
        added = commands.add_parser(name, help=text, description=text, allow_abbrev=False)
        added.set_defaults(run=run)
        return added

    image = command('image', _image, 'one blurred image and its depth: sharp image, motion')
    _image_flags(image)
    image.add_argument(
        '--energy', type=Path, metavar='FILE.svg', help='energy of each turn, of the method paper'
    )
    image.add_argument('--report', type=Path, metavar='FILE.html', help='page of pictures')
    _bench_flags(command('bench', _bench, 'folders of images, scored where the truth is known'))
    _import_flags(
        command('import-tum', _import_tum, 'a TUM-format folder into a rosbag2 mcap bag')
    )
    _sequence_flags(command('sequence', _sequence, 'the sharp frames hidden in one exposure'))
    _replay_flags(command('replay', _replay, 'a bag: every pair solved, results in another bag'))
    _report_flags(command('report', _report, 'a replayed bag: one HTML page, pictures and plots'))
    apart = commands.add_parser('job', description='what replay of many bags starts for each')
    apart.set_defaults(run=_job)
    return parser


def _image_flags(parser: Parser) -> None:
    parser.add_argument('rgb', type=Path, help='colour image, 8 bit')
    parser.add_argument('depth', type=Path, help='depth image, 16 bit, registered to the colour')
    parser.add_argument('--camera', type=Path, required=True, help='camera.json')
    parser.add_argument('-o', '--out', type=Path, required=True, metavar='DIR', help='results')
    flags.solver_flags(parser)


def _image(args: argparse.Namespace) -> int:
    from depth_deblur_ros.charts import energy_chart
    from depth_deblur_ros.core.solver import deblur
    from depth_deblur_ros.folders import read_frame, write_image, write_json, write_text
    from depth_deblur_ros.notes import note_of, Run, shot_of
    from depth_deblur_ros.page import run_page
    from depth_deblur_ros.results import motion_record

    params = flags.solver_params(args)
    if args.energy and params.method != 'paper':
        raise InputError(f'--energy needs the method paper, got {params.method}')
    frame = read_frame(args.rgb, args.depth, args.camera)
    result = deblur(frame, params)
    write_image(args.out / 'deblurred.png', result.image)
    write_json(args.out / 'motion.json', motion_record(result, frame.stamp_ns, frame.exposure))
    if args.energy:
        write_text(args.energy, energy_chart(result.energies))
    if args.report:
        note = note_of(frame.stamp_ns, frame.exposure, result)
        run = Run(args.rgb.parent.resolve().name, [note], [shot_of(frame, result, params.prior)])
        write_text(args.report, run_page(run))
    print(
        f'{result.outcome.value}: blur {result.blur_px:.1f} px, quality {result.quality:.2f}, '
        f'{result.seconds:.1f} s; {args.out}/deblurred.png, {args.out}/motion.json'
    )
    return SOME_FAILED if result.outcome is Outcome.FAILED else DONE


def _sequence_flags(parser: Parser) -> None:
    _image_flags(parser)
    parser.add_argument(
        '--frames', type=int, default=15, metavar='N', help='frames in the exposure (default: 15)'
    )


def _sequence(args: argparse.Namespace) -> int:
    from depth_deblur_ros.core.sequence import sharp_sequence
    from depth_deblur_ros.core.solver import deblur
    from depth_deblur_ros.folders import read_frame, write_image, write_video

    params = flags.solver_params(args)
    frame = read_frame(args.rgb, args.depth, args.camera)
    result = deblur(frame, params)
    views = sharp_sequence(result.image, result.depth, result.motion, frame.camera, args.frames)
    for i, view in enumerate(views):
        write_image(args.out / f'frame_{i:03d}.png', view)
    write_video(args.out / 'sequence.mp4', views)
    print(
        f'{result.outcome.value}: blur {result.blur_px:.1f} px; {len(views)} frames and '
        f'sequence.mp4 in {args.out} (forwards or backwards: one image cannot tell)'
    )
    return SOME_FAILED if result.outcome is Outcome.FAILED else DONE


def _bench_flags(parser: Parser) -> None:
    parser.add_argument('cases', type=Path, help='folder of case folders')
    parser.add_argument('-o', '--out', type=Path, required=True, metavar='RESULTS')
    parser.add_argument(
        '--oracle', action='store_true', help='take the motion from truth/motion.json as known'
    )
    flags.solver_flags(parser)


def _bench(args: argparse.Namespace) -> int:
    from depth_deblur_ros import bench

    params = flags.solver_params(args)
    cases = bench.find_cases(args.cases)
    solving = bench.solve_cases(cases, args.out, params, oracle=args.oracle)
    rows = list(tqdm(solving, total=len(cases), unit='case', disable=None))
    bench.write_tables(rows, args.out)
    print('\n'.join([bench.table_head(), *map(bench.table_line, bench.with_means(rows))]))
    failed = any(row.outcome in ('failed', 'error') for row in rows)
    return SOME_FAILED if failed else DONE


def _import_flags(parser: Parser) -> None:
    parser.add_argument('folder', type=Path, help='rgb/, depth/ and their lists')
    parser.add_argument('bag', type=Path, help='bag to write')
    camera = parser.add_mutually_exclusive_group()
    camera.add_argument('--camera', type=Path, help='camera.json (default: FOLDER/camera.json)')
    camera.add_argument(
        '--preset', metavar='tum_fr1|tum_fr2|tum_fr3', help='a calibration that TUM published'
    )
    parser.add_argument('--overwrite', action='store_true', help='replace BAG if it is there')


def _import_tum(args: argparse.Namespace) -> int:
    from depth_deblur_ros.tum import import_tum

    summary = import_tum(
        args.folder, args.bag, camera=args.camera, preset=args.preset, overwrite=args.overwrite
    )
    print(f'{args.bag}: {summary}')
    return DONE


def _replay_flags(parser: Parser) -> None:
    parser.add_argument(
        'bag', nargs='+', help='rosbag2 folder or .mcap file to read; several, or a pattern'
    )
    parser.add_argument('out', type=Path, help='bag to write; of many bags, the folder for them')
    parser.add_argument('--estimates', type=Path, metavar='FILE', help='one line of JSON per pair')
    parser.add_argument('--pictures', type=Path, metavar='DIR', help='one picture per frame')
    parser.add_argument('--report', action='store_true', help='one page of the run: OUT.html')
    flags.source_flags(parser)
    parser.add_argument('--exposure-s', type=float, metavar='S', help='exposure of every frame')
    parser.add_argument('--start', type=float, default=0.0, metavar='S', help='skip S seconds')
    parser.add_argument('--duration', type=float, metavar='S', help='stop after S seconds')
    parser.add_argument('--all-topics', action='store_true', help='copy the other topics too')
    parser.add_argument('--overwrite', action='store_true', help='replace OUT if it is there')
    parser.add_argument(
        '--resume', action='store_true', help='go on where a run of the same kind was killed'
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        '--workers', type=int, metavar='N', help='many bags: so many at a time (default: 1)'
    )
    where.add_argument(
        '--scheduler', metavar='ADDRESS', help='many bags: on a cluster of dask.distributed'
    )
    flags.solver_flags(parser)


def _replay(args: argparse.Namespace) -> int:
    from depth_deblur_ros.job import run_job
    from depth_deblur_ros.many import is_pattern

    job = _job_of(args)
    many = len(args.bag) > 1 or is_pattern(args.bag[0])
    if many or args.scheduler or args.workers is not None:
        return _replay_many(args, job)
    said: list[str] = []
    try:
        with tqdm(unit='frame', disable=None) as bar:
            complete = run_job(job, said.append, _progress(bar))
    finally:
        print(*said, sep='\n', end='\n' * bool(said))
    return DONE if complete else SOME_FAILED


def _replay_many(args: argparse.Namespace, whole: Job) -> int:
    """Replay many bags into one folder, tell each as it ends, and at last those that failed."""
    from depth_deblur_ros import many

    jobs = many.jobs_of(many.find_bags(args.bag), whole)
    threads = getattr(args, 'threads', None)  # as the line says, not the file
    with _place(args, threads) as place, tqdm(unit='frame', disable=None) as bar:
        many.note_settings(whole)
        failures, skipped = [], 0
        for job, done in many.replay_many(jobs, place, _progress(bar)):
            if done is None:
                skipped += 1
                continue
            bar.write(done.said)
            if done.code != DONE:
                failures.append(f'{job.bag}: {done.why}')
    fresh = len(jobs) - skipped - len(failures)
    print(f'{len(jobs)} bags: {fresh} done, {skipped} done before, {len(failures)} with failures')
    print(*(f'failed: {failure}' for failure in failures), sep='\n', end='\n' * bool(failures))
    return SOME_FAILED if failures else DONE


def _place(args: argparse.Namespace, threads: int | None) -> Cluster | Pool:
    if args.scheduler:
        from depth_deblur_ros.cluster import Cluster

        return Cluster(args.scheduler, threads)
    from depth_deblur_ros.many import Pool

    return Pool(1 if args.workers is None else args.workers, threads)


def _job(_: argparse.Namespace) -> int:
    from depth_deblur_ros.job import job_from_parent, run_job

    return DONE if run_job(job_from_parent(), print) else SOME_FAILED


def _job_of(args: argparse.Namespace) -> Job:
    from depth_deblur_ros.folders import read_camera
    from depth_deblur_ros.job import Job

    told = {f.name for f in fields(Job)} - {'bag', 'params', 'camera', 'topics'}
    return Job(
        bag=Path(args.bag[0]),
        params=flags.solver_params(args),
        camera=read_camera(args.camera) if args.camera else None,
        topics=dict(args.topics or ()),
        **{name: getattr(args, name) for name in told},
    )


def _report_flags(parser: Parser) -> None:
    parser.add_argument('bag', type=Path, help='bag that was replayed')
    parser.add_argument('out', type=Path, help='bag of the results')
    parser.add_argument('-o', '--page', type=Path, metavar='FILE', help='default: OUT.html')
    parser.add_argument('--estimates', type=Path, metavar='FILE', help='of replay: adds energies')
    flags.source_flags(parser)
    flags.rectified_flag(parser)


def _report(args: argparse.Namespace) -> int:
    from depth_deblur_ros.folders import read_camera
    from depth_deblur_ros.job import Job, page_of, write_page

    camera = read_camera(args.camera) if args.camera else None
    job = Job(
        args.bag,
        args.out,
        params=flags.solver_params(args),
        camera=camera,
        topics=dict(args.topics or ()),
        estimates=args.estimates,
    )
    print(write_page(job, args.page or page_of(args.out)))
    return DONE


def _progress(bar: tqdm[NoReturn]) -> Callable[[int, int | None], None]:
    def show(done: int, total: int | None) -> None:
        bar.total = total
        bar.update(done - bar.n)

    return show
