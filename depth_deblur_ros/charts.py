"""
Charts as SVG: lines with bands, points and rings, in panels side by side.

The text of an SVG stands by itself as a file and inside a page; its colours follow the reader's
light or dark setting.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
import math

from depth_deblur_ros.core.data import EnergyStep
import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Marks = tuple[tuple[float, str], ...]  # where on the axis, and what stands there

WIDTH, HEIGHT = 430, 250  # of a panel; CSS pixels, as all lengths below
LEFT, RIGHT, TOP, BOTTOM = 62, 14, 46, 38
TICKS = 5  # about so many along an axis
LEAST = 1e-30  # of a logarithmic axis: less counts as nothing
MOST_POINTS = 1000  # of a curve: more are thinned evenly
RAISED = str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹')
AT_LEVEL = 'level of the pyramid, 0 = coarsest'
STYLE = """
.chart{--ink:#1f2328;--faint:#6e7781;--grid:#d8dee4;--c0:#0b62c4;--c1:#c2410c;--c2:#15803d;
--c3:#7c3aed;--c4:#6e7781;font:11px system-ui,sans-serif}
.chart text{fill:var(--faint)}.chart .title{fill:var(--ink);font-weight:600;font-size:12px}
.chart .grid{stroke:var(--grid);stroke-width:1}.chart .line{fill:none;stroke-width:1.6;
stroke-linejoin:round;stroke-linecap:round}.chart .band{stroke:none;opacity:.16}
@media (prefers-color-scheme:dark){.chart{--ink:#e6edf3;--faint:#9198a1;--grid:#30363d;
--c0:#58a6ff;--c1:#f0883e;--c2:#3fb950;--c3:#bc8cff;--c4:#9198a1}}
"""


@dataclass(frozen=True, eq=False)
class Curve:
    """
    Values y over x (n,), NaN = a gap.

    look is line, points or rings; band is the low and the high edge (n,).
    """

    name: str
    x: Floats
    y: Floats
    colour: int = 0  # 0 to 4
    look: str = 'line'
    band: tuple[Floats, Floats] | None = None


@dataclass(frozen=True, eq=False)
class Panel:
    """
    Curves in one frame.

    logarithmic draws what is above LEAST alone; limits, where given, have their place on y.
    """

    title: str
    curves: tuple[Curve, ...]
    x_label: str
    y_label: str
    logarithmic: bool = False
    marks: Marks = ()  # instead of the ticks of the x axis
    limits: tuple[float, float] | None = None


def chart(panels: Sequence[Panel], columns: int = 3, title: str = '') -> str:
    """Give the SVG of panels in rows of so many columns."""
    columns = min(columns, len(panels))
    rows = math.ceil(len(panels) / columns)
    size = f'0 0 {columns * WIDTH} {rows * HEIGHT}'
    parts = [
        f'<svg class="chart" xmlns="http://www.w3.org/2000/svg" viewBox="{size}" role="img">',
        f'<title>{escape(title)}</title><style>{STYLE}</style>',
    ]
    for k, panel in enumerate(panels):
        x, y = k % columns * WIDTH, k // columns * HEIGHT
        parts.append(f'<g transform="translate({x} {y})">{"".join(_drawn(panel))}</g>')
    return '\n'.join([*parts, '</svg>\n'])


def energy_chart(energies: Sequence[EnergyStep]) -> str:
    """Draw the energy before and after each turn, level by level, and its terms beside it."""
    title = 'The energy, before and after each turn of motion and image, coarse to fine'
    return chart(energy_panels(energies), 2, title)


def energy_panels(energies: Sequence[EnergyStep]) -> tuple[Panel, Panel]:
    """Give the panels of energy_chart."""
    turns = np.arange(len(energies) // 2, dtype=np.float64)
    x = np.stack([turns, turns + 0.7, np.full(len(turns), np.nan)], 1).ravel()
    at_level = [step.level for step in energies[::2]]
    firsts = [k for k, level in enumerate(at_level) if k == 0 or level != at_level[k - 1]]
    marks = tuple((float(turns[k]), str(at_level[k])) for k in firsts)

    total = _over_turns([sum(step.terms.values()) for step in energies])
    names = list(energies[0].terms) if energies else []
    terms = [_over_turns([abs(step.terms[name]) for step in energies]) for name in names]
    label = 'grey levels² per sample'
    total_curve = Curve('E', x, total)
    term_curves = [Curve(n, x, y, k) for k, (n, y) in enumerate(zip(names, terms, strict=True))]
    return (
        Panel(
            'Energy over each turn, mu1 renewed before it',
            (total_curve,),
            AT_LEVEL,
            label,
            marks=marks,
        ),
        Panel(
            'Its terms; of motion the size of its reward',
            tuple(term_curves),
            AT_LEVEL,
            label,
            logarithmic=True,
            marks=marks,
        ),
    )


def _over_turns(values: Sequence[float]) -> Floats:
    """Put a gap after both ends of each turn."""
    ends = np.reshape(np.asarray(values, np.float64), (-1, 2))
    return np.column_stack([ends, np.full(len(ends), np.nan)]).ravel()


@dataclass(frozen=True)
class _Axis:
    """From values between low and high to places between start and end."""

    low: float
    high: float
    start: float
    end: float
    logarithmic: bool = False

    def place(self, values: Floats | float) -> Floats:
        v = np.asarray(values, np.float64)
        if self.logarithmic:
            v = np.log10(np.where(v > LEAST, v, np.nan))
        return self.start + (v - self.low) / (self.high - self.low) * (self.end - self.start)

    def ticks(self) -> list[float]:
        if self.logarithmic:
            powers = range(math.ceil(self.low), math.floor(self.high) + 1)
            return [10.0**k for k in powers[:: math.ceil(max(len(powers), 1) / 7)]]
        raw = (self.high - self.low) / TICKS
        size = 10.0 ** math.floor(math.log10(raw))
        step = next(size * k for k in (1, 2, 5, 10) if size * k >= raw * 0.99)
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return [k * step for k in range(first, last + 1)]


def _axis(values: Sequence[Floats], start: float, end: float, logarithmic: bool = False) -> _Axis:
    """Make the axis on which all finite values have their place, with a little room."""
    v = np.concatenate([*values, np.zeros(0)])
    v = v[np.isfinite(v) & ((v > LEAST) | (not logarithmic))]
    v = np.log10(v) if logarithmic else v
    low, high = (float(v.min()), float(v.max())) if v.size else (0.0, 1.0)
    room = 0.05 * (high - low) or 0.5 * abs(high) or 0.5
    return _Axis(low - room, high + room, start, end, logarithmic)


def _drawn(panel: Panel) -> Iterator[str]:
    """Give the elements of one panel, from the title to the curves."""
    tall = [c.y for c in panel.curves] + [e for c in panel.curves for e in c.band or ()]
    tall += [np.array(panel.limits)] if panel.limits else []
    xs = _axis([c.x for c in panel.curves], LEFT, WIDTH - RIGHT)
    ys = _axis(tall, HEIGHT - BOTTOM, TOP, panel.logarithmic)
    yield _text(LEFT, 16, panel.title, 'start', 'title')
    yield from _legend(panel.curves)
    for value in ys.ticks():
        y = float(ys.place(value))
        yield f'<path class="grid" d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}"/>'
        yield _text(LEFT - 6, y + 4, _number(value, panel.logarithmic), 'end')
    for value, word in panel.marks or [(tick, f'{tick:.6g}') for tick in xs.ticks()]:
        x = float(xs.place(value))
        if panel.marks:
            yield f'<path class="grid" d="M{x:.1f} {TOP}V{HEIGHT - BOTTOM}"/>'
        yield _text(x, HEIGHT - BOTTOM + 15, word, 'start' if panel.marks else 'middle')
    yield _text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 6, panel.x_label, 'middle')
    middle = (TOP + HEIGHT - BOTTOM) / 2
    unit = _text(0, 0, panel.y_label, 'middle')
    yield f'<g transform="translate(11 {middle:.0f}) rotate(-90)">{unit}</g>'
    for curve in panel.curves:
        yield from _curve(curve, xs, ys)


def _legend(curves: Sequence[Curve]) -> Iterator[str]:
    x = float(LEFT)
    for curve in curves:
        if not curve.name:
            continue
        yield f'<circle cx="{x + 4:.0f}" cy="30" r="3.5" fill="var(--c{curve.colour})"/>'
        yield _text(x + 12, 34, curve.name, 'start')
        x += 20 + 5.9 * len(curve.name)


def _curve(curve: Curve, xs: _Axis, ys: _Axis) -> Iterator[str]:
    thin = slice(None, None, max(1, math.ceil(len(curve.x) / MOST_POINTS)))
    x, y = xs.place(curve.x)[thin], ys.place(curve.y)[thin]
    paint = f'var(--c{curve.colour})'
    if curve.band is not None:
        low, high = (ys.place(edge)[thin] for edge in curve.band)
        for part in _runs(x, low + high):
            there = [*zip(x[part], high[part], strict=True)]
            back = [*zip(x[part], low[part], strict=True)][::-1]
            yield f'<path class="band" fill="{paint}" d="{_path(there + back)}Z"/>'
    if curve.look == 'line':
        for part in _runs(x, y):
            path = _path([*zip(x[part], y[part], strict=True)])
            yield f'<path class="line" stroke="{paint}" d="{path}"/>'
        return
    inside = paint if curve.look == 'points' else 'none'
    for part in _runs(x, y):
        for px, py in zip(x[part], y[part], strict=True):
            at = f'cx="{px:.1f}" cy="{py:.1f}" r="2.4"'
            yield f'<circle {at} fill="{inside}" stroke="{paint}"/>'


def _runs(x: Floats, y: Floats) -> list[slice]:
    """Give the stretches without a gap."""
    good = np.r_[False, np.isfinite(x) & np.isfinite(y), False]
    edges = np.flatnonzero(good[1:] != good[:-1])
    return [slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _number(value: float, logarithmic: bool) -> str:
    if not logarithmic:
        return f'{value:.6g}'
    return '10' + str(round(math.log10(value))).translate(RAISED)


def _path(points: Sequence[tuple[float, float]]) -> str:
    return 'M' + 'L'.join(f'{x:.1f} {y:.1f}' for x, y in points) + 'h0'  # one point is a dot


def _text(x: float, y: float, text: str, anchor: str, kind: str = '') -> str:
    at = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"'
    return f'<text class="{kind}" {at}>{escape(text)}</text>'
