"""
One page of a run: pictures to compare, the motion over time, times and losses.

The page is one HTML file that asks for nothing else: pictures and charts stand in it, of a bounded
number of frames. Readable in light and dark; the slider is the only thing that needs its script.
"""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Iterator, Sequence
from html import escape

from depth_deblur_ros.charts import chart, Curve, energy_panels, MOST_POINTS, Panel
from depth_deblur_ros.core.data import Outcome, Vector
from depth_deblur_ros.notes import Note, Run, Shot, signed_twists
from depth_deblur_ros.page_style import SCRIPT, STYLE
import numpy as np

DEVIATIONS = 2.0  # standard deviations that the band spans on each side
AXES = ('x, right', 'y, down', 'z, ahead')
ENERGY = (
    'What the image step lowers, (7) of docs/method.md: how far the image, blurred by the motion, '
    'is from what was taken (a mean square, weighed), and how unlike a sharp image it is (the '
    'prior). What is left of the misfit is noise, and what the motion does not explain.'
)
TURN, SHIFT = ('Turning about ', 'rad/s'), ('Moving along ', 'm/s')


def run_page(run: Run) -> str:
    """Give the HTML of a run."""
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; '
        "img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'\">",
        f'<title>{escape(run.title)}</title><style>{STYLE}</style></head><body>',
        f'<header><h1>{escape(run.title)}</h1><p>deblurred by depth_deblur_ros</p></header>',
        '<main>',
        *_tiles(run),
        *_frames(run),
        *_motion(run),
        *_times(run),
        *_energies(run),
        *_losses(run),
        f'</main><footer>{_bounds(run)}</footer><script>{SCRIPT}</script></body></html>\n',
    ]
    return '\n'.join(parts)


def _tiles(run: Run) -> Iterator[str]:
    """Give the few numbers that come first."""
    counts = Counter(note.outcome for note in run.notes)
    solved = [n.blur_px for n in run.notes if n.outcome is Outcome.SOLVED]
    tiles = [('frames', f'{len(run.notes)}', '')]
    tiles += [(outcome.value, f'{counts[outcome]}', outcome.value) for outcome in Outcome]
    if len(run.notes) > 1:
        tiles += [('lost', f'{sum(run.lost.values())}', '')]
    if solved:
        tiles += [('median blur', f'{np.median(solved):.1f} px', '')]
    if run.notes:
        tiles += [('median time', f'{np.median([n.seconds for n in run.notes]):.3g} s', '')]
    yield '<dl class="tiles">'
    for name, value, kind in tiles:
        yield f'<div class="{kind}"><dt>{name}</dt><dd>{value}</dd></div>'
    yield '</dl>'


def _frames(run: Run) -> Iterator[str]:
    """Give one card for each frame with pictures, and the links that lead to them."""
    notes = {note.stamp_ns: (k, note) for k, note in enumerate(run.notes)}
    shown = [(*notes[shot.stamp_ns], shot) for shot in run.shots]
    if not shown:
        return
    yield '<section id="frames"><h2>Frames</h2>'
    if len(shown) > 1:
        yield '<nav>'
        for k, note, _ in shown:
            yield f'<a class="{note.outcome.value}" href="#frame-{k}">{k + 1}</a>'
        yield '</nav>'
    yield '<div class="reel">'
    for k, note, shot in shown:
        yield from _card(k, note, shot, len(run.notes))
    yield '</div></section>'


def _card(number: int, note: Note, shot: Shot, total: int) -> Iterator[str]:
    outcome = note.outcome.value
    same = shot.pictures['sharp'] == shot.pictures['blurred']  # not solved, or mode motion
    after = 'unchanged' if same else 'sharp'
    stamp = f'stamp {note.stamp_ns // 10**9}.{note.stamp_ns % 10**9:09d}'
    yield f'<article class="card" id="frame-{number}"><h3>Frame {number + 1} of {total}'
    yield f'<span class="badge {outcome}">{outcome}</span></h3>'
    yield '<div class="views"><figure><div class="wipe">'
    yield _picture(shot, 'blurred', 'as it was taken')
    yield _picture(shot, 'sharp', after)
    yield '<input type="range" min="0" max="100" value="50" aria-label="blurred or sharp"></div>'
    yield f'<figcaption><span>blurred</span><span>{after}</span></figcaption></figure>'
    yield '<div class="pair">'
    for name, text in (
        ('flow', 'path of each point during the exposure'),
        (
            'depth',
            f'filled depth, {shot.limits[0]:.1f} m (warm) to {shot.limits[1]:.1f} m, '
            'darker where it was a hole',
        ),
    ):
        yield f'<figure>{_picture(shot, name, text)}<figcaption>{text}</figcaption></figure>'
    yield '</div></div>'
    yield f'<p class="facts">blur {note.blur_px:.1f} px · quality {note.quality:.2f} · '
    yield f'sign {"known" if note.sign_resolved else "open"} · {note.seconds:.3g} s · {stamp}</p>'
    if note.outcome is Outcome.SOLVED:
        yield f'<p class="facts">{_amounts(note)}</p>'
    yield '</article>'


def _amounts(note: Note) -> str:
    """Say the motion over the exposure, with its standard deviation."""
    words = []
    for name, unit, part in (('θ', 'mrad', slice(0, 3)), ('v', 'mm', slice(3, 6))):
        pairs = zip(np.round(1e3 * note.p[part], 1), 1e3 * note.deviation[part], strict=True)
        values = (f'{p + 0:.1f}' + (f' ± {d:.1f}' if np.isfinite(d) else '') for p, d in pairs)
        words.append(f'{name} = ({", ".join(values)}) {unit}')
    return ' · '.join(words)


def _picture(shot: Shot, name: str, text: str) -> str:
    data = base64.b64encode(shot.pictures[name]).decode()
    size = f'width="{shot.size[0]}" height="{shot.size[1]}"'
    return f'<img class="{name}" alt="{text}" {size} src="data:image/webp;base64,{data}">'


def _charts(panels: Sequence[Panel]) -> str:
    """Give each panel a picture of its own, so that narrow pages show fewer side by side."""
    return f'<div class="charts">{"".join(chart([p], title=p.title) for p in panels)}</div>'


def _seconds(notes: Sequence[Note]) -> Vector:
    first = notes[0].stamp_ns if notes else 0
    return np.array([(note.stamp_ns - first) / 1e9 for note in notes])


def _motion(run: Run) -> Iterator[str]:
    """Draw the camera's velocity over time, where there is one to draw."""
    found = signed_twists(run)
    if len(run.notes) < 2 or not np.isfinite(found).any():
        return
    x = _seconds(run.notes)
    known = np.array([note.sign_resolved for note in run.notes])
    wide = np.stack([note.deviation / (note.exposure or np.nan) for note in run.notes])
    truth = np.stack([run.truth.get(n.stamp_ns, np.full(6, np.nan)) for n in run.notes])
    panels = []
    for k in range(6):
        name, unit = TURN if k < 3 else SHIFT
        y, edge = found[:, k], DEVIATIONS * wide[:, k]
        curves = [
            Curve('found', x, y, band=(y - edge, y + edge)),
            Curve('', x, np.where(known, y, np.nan), look='points'),
            Curve('', x, np.where(known, np.nan, y), look='rings'),
        ]
        if run.truth:
            curves.insert(0, Curve('truth', x, truth[:, k], 1))
        panels.append(Panel(name + AXES[k % 3], tuple(curves), 'time [s]', unit))
    yield '<section id="motion"><h2>Motion of the camera</h2>'
    yield _charts(panels)
    yield f'<p>{_reading(run, found, truth)}</p></section>'


def _reading(run: Run, found: Vector, truth: Vector) -> str:
    """Say how to read the chart, and how far it is from the truth."""
    text = (
        f'In its optical frame, over {len(run.notes)} frames; the band spans {DEVIATIONS:g} '
        'standard deviations on each side. Points: the sign is known. Rings: one image does not '
        f'tell the sign; drawn with that of {"the truth" if run.truth else "the frame before"}.'
    )
    both = np.isfinite(found).all(1) & np.isfinite(truth).all(1)
    if both.any():
        parts = []
        for name, k in (('turning', slice(0, 3)), ('moving', slice(3, 6))):
            off = np.sqrt(np.square(found[both, k] - truth[both, k]).mean())
            size = np.sqrt(np.square(truth[both, k]).mean())
            parts.append(f'{off:.3g} of {size:.3g} {"rad/s" if name == "turning" else "m/s"}')
        text += f' Root mean square error against the truth: {parts[0]}, {parts[1]}.'
    return text


def _times(run: Run) -> Iterator[str]:
    """Draw blur, quality and time of each frame."""
    if len(run.notes) < 2:
        return
    x, colours = _seconds(run.notes), {Outcome.SOLVED: 2, Outcome.SHARP: 0, Outcome.FAILED: 1}
    panels = []
    for title, unit, ends, values in (
        ('Length of the blur', 'px', (0.0, 5.0), [n.blur_px for n in run.notes]),
        ('Trust in the motion', '0..1', (0.0, 1.0), [n.quality for n in run.notes]),
        ('Time taken', 's', (0.0, 0.1), [n.seconds for n in run.notes]),
    ):
        curves = []
        for outcome, colour in colours.items():
            mine = np.array([n.outcome is outcome for n in run.notes])
            y = np.where(mine, np.array(values, np.float64), np.nan)
            curves.append(Curve(outcome.value, x, y, colour, 'points'))
        panels.append(Panel(title, tuple(curves), 'time [s]', unit, limits=ends))
    yield '<section id="times"><h2>Frame by frame</h2>'
    yield _charts(panels) + '</section>'


def _energies(run: Run) -> Iterator[str]:
    """Tell the energies of the frames that are shown, and draw those of the paper's turns."""
    numbers = {note.stamp_ns: k for k, note in enumerate(run.notes)}
    shown = [(numbers[shot.stamp_ns], shot) for shot in run.shots]
    turns = [(k, run.notes[k].energies) for k, _ in shown if run.notes[k].energies]
    if turns:
        yield '<section id="energy"><h2>Energy</h2>'
        for k, energies in turns:
            yield f'<h3>Frame {k + 1}</h3>{_charts(energy_panels(energies))}'
        yield '</section>'
    elif any(shot.gains for _, shot in shown):
        yield f'<section id="energy"><h2>Energy</h2>{_charts([*_gains(run)])}'
        yield f'<p>{ENERGY}</p></section>'


def _gains(run: Run) -> Iterator[Panel]:
    """Draw the energy before and after the image step, at each of its sizes."""
    shots = [shot for shot in run.shots if shot.gains]
    first = run.notes[0].stamp_ns
    x = np.array([(shot.stamp_ns - first) / 1e9 for shot in shots])
    for level, title in enumerate(('At half the size', 'At full size')):
        told = [{e.step: e.terms for e in shot.gains if e.level == level} for shot in shots]
        if not all(told):
            continue
        before, after = (
            np.array([sum(t[step].values()) for t in told]) for step in ('before', 'after')
        )
        curves = (
            Curve('image as taken', x, before, 1, 'points'),
            Curve('sharp image', x, after, 2, 'points'),
            Curve('of it the prior', x, np.array([t['after']['prior'] for t in told]), 4, 'rings'),
        )
        yield Panel(title, curves, 'time [s]', 'grey levels² per sample', limits=(0.0, 1.0))


def _losses(run: Run) -> Iterator[str]:
    refused = Counter(note.reason for note in run.notes if note.reason)
    rows = [('failed', *entry) for entry in refused.most_common()]
    rows += [('lost', reason, count) for reason, count in run.lost.items()]
    yield '<section id="losses"><h2>Failed and lost</h2>'
    if not rows:
        yield '<p>Every colour frame found its depth and went through the solver.</p>'
    else:
        yield '<table><tr><th>what</th><th>frames</th><th>reason</th></tr>'
        for what, reason, count in rows:
            yield f'<tr><td>{what}</td><td>{count}</td><td>{escape(reason)}</td></tr>'
        yield '</table>'
    yield '</section>'


def _bounds(run: Run) -> str:
    return (
        f'Pictures of {len(run.shots)} of {len(run.notes)} frames, spread evenly, at most 640 px '
        f'wide (WebP); of a curve at most {MOST_POINTS} points. The page loads nothing else.'
    )
