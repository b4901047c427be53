"""
One bag through all that `replay` does: the bag of results, estimates, pictures, the page.

A job can be done here, or in a process of its own: then nothing of it outlives whoever waits.
"""

from __future__ import annotations

import _thread
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
import os
from pathlib import Path
import pickle
import signal
import subprocess
import sys
import threading
from typing import NamedTuple

from depth_deblur_ros.core.data import DeblurResult, InputError, RgbdFrame
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.folders import CameraFile, write_image, write_text
from depth_deblur_ros.memory import keep_freed_memory

APART = ('-m', 'depth_deblur_ros', 'job')  # the command that calls job_from_parent
Progress = Callable[[int, int | None], None]


@dataclass(frozen=True)
class Job:
    """
    A bag to replay, and how; each field is the flag of `depth-deblur replay` of its name.

    pictures is a folder; report asks for a page beside out.
    """

    bag: Path
    out: Path
    params: SolverParams = field(default_factory=SolverParams)
    camera: CameraFile | None = None
    exposure_s: float | None = None
    topics: Mapping[str, str] = field(default_factory=dict)
    start: float = 0.0
    duration: float | None = None
    all_topics: bool = False
    estimates: Path | None = None
    pictures: Path | None = None
    report: bool = False
    overwrite: bool = False
    resume: bool = False


class Done(NamedTuple):
    """How a job ended: the exit code of `replay`, negative for a signal, and what it said."""

    code: int
    said: str

    @property
    def why(self) -> str:
        """Say in one line why it was not done as it should."""
        if self.code == 1:
            return 'some frames failed or were lost'
        last = self.said.splitlines()[-1:]
        if self.code < 0:
            last = [f'its process was ended by signal {-self.code}', *last]
        return '; '.join(last).removeprefix('depth-deblur: ')


def run_job(job: Job, say: Callable[[str], None], progress: Progress | None = None) -> bool:
    """Do a job and say what came of it; give whether no frame failed or was lost."""
    from depth_deblur_ros.replay import replay

    keep_freed_memory()
    exposure = job.exposure_s
    if job.camera and exposure is None:
        exposure = job.camera.exposure
    summary = replay(
        job.bag,
        job.out,
        params=job.params,
        camera=job.camera.intrinsics if job.camera else None,
        exposure_s=exposure,
        topics=job.topics,
        start=job.start,
        duration=job.duration,
        all_topics=job.all_topics,
        estimates=job.estimates,
        progress=progress,
        on_frame=_painter(job.pictures) if job.pictures else None,
        overwrite=job.overwrite,
        resume=job.resume,
    )
    say(f'{job.out}: {summary}')
    if job.report:
        say(write_page(job, page_of(job.out), summary.dropped))
    return summary.complete


def page_of(bag: Path) -> Path:
    """Give the place of the page that belongs to a bag of results."""
    whole = bag.resolve()
    return whole.with_name(f'{whole.name}.html')


def write_page(job: Job, page: Path, lost: Mapping[str, int] | None = None) -> str:
    """Write the page of a job that is done, lost as review takes it; give what to say of it."""
    from depth_deblur_ros.page import run_page
    from depth_deblur_ros.review import review

    run = review(
        job.bag,
        job.out,
        camera=job.camera.intrinsics if job.camera else None,
        topics=job.topics,
        estimates=job.estimates,
        lost=lost,
        params=job.params,
    )
    write_text(page, run_page(run))
    return f'{page}: {len(run.notes)} frames, pictures of {len(run.shots)}'


def _painter(folder: Path) -> Callable[[int, RgbdFrame, DeblurResult], None]:
    """Give what writes one picture per frame, by its number."""
    from depth_deblur_ros.report import draw_frame

    def paint(number: int, frame: RgbdFrame, result: DeblurResult) -> None:
        write_image(folder / f'{number:05d}.png', draw_frame(frame, result))

    return paint


def run_apart(job: Job, begun: Callable[[subprocess.Popen[bytes]], None] | None = None) -> Done:
    """Do a job in a process of its own, which begun is told of; it ends when this one does."""
    with subprocess.Popen(
        [sys.executable, *APART],
        bufsize=0,  # so that closing the pipe to a dead process writes nothing
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,  # an interrupt comes once, from whoever waits
    ) as process:
        assert process.stdin and process.stdout
        if begun:
            begun(process)
        with suppress(BrokenPipeError):  # it has ended already; what it said tells why
            process.stdin.write(pickle.dumps(job))
        said = process.stdout.read().decode(errors='replace')
    return Done(process.returncode, said.strip())


def job_from_parent() -> Job:
    """Take the job that run_apart sent; from then on the parent's end interrupts this process."""
    # A shell starts what it puts in the background deaf to interrupts, and that is handed down.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    source = sys.stdin.buffer
    try:
        job = pickle.load(source)
    except (EOFError, pickle.UnpicklingError) as error:
        raise InputError('a job comes from `replay` of many bags, not by hand') from error

    def watch() -> None:
        os.read(source.fileno(), 1)  # nothing comes: it returns when the parent has ended
        _thread.interrupt_main()

    threading.Thread(target=watch, daemon=True).start()
    assert isinstance(job, Job)
    return job
