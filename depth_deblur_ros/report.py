"""
Pictures and words about what became of the frames.

A picture shows the blurred image, the sharp one, and the filled depth with the path that each
point of a grid took during the exposure; a path has no arrow head: its sign is unknown.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import cv2
from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    DeblurResult,
    FloatImage,
    Outcome,
    RgbdFrame,
)
from depth_deblur_ros.core.geometry import flow
import numpy as np
import numpy.typing as npt

Picture = npt.NDArray[np.uint8]  # (H, W, 3) RGB
Colour = tuple[int, int, int]

PANEL_WIDTH = (360, 640)  # px; smaller images are enlarged, larger ones reduced
GAP, HEAD, FOOT, SCALE = 8, 30, 36, 74  # px
PAPER, INK, FAINT = (250, 250, 248), (30, 30, 34), (110, 110, 116)
BADGE = {
    Outcome.SHARP: (90, 110, 130),
    Outcome.SOLVED: (36, 130, 70),
    Outcome.FAILED: (190, 50, 40),
}
GRID = 26  # px between two paths, more where they are long
HOLE_SHADE = 0.72  # brightness of depth that was filled in


def draw_frame(frame: RgbdFrame, result: DeblurResult) -> Picture:
    """Draw blurred | sharp | filled depth with the flow of the motion, and a caption."""
    limits = depth_limits(result)
    changed = result.outcome is Outcome.SOLVED
    panels = {
        'blurred': draw_image(frame.image),
        'sharp' if changed else 'unchanged': draw_image(result.image),
        'depth, darker where it was a hole': _with_paths(
            draw_depth(frame, result, limits), result, frame.camera
        ),
    }
    height, width = panels['blurred'].shape[:2]
    size = (HEAD + height + FOOT, 3 * width + 4 * GAP + SCALE, 3)
    canvas = np.full(size, PAPER, np.uint8)
    for k, (title, panel) in enumerate(panels.items()):
        left = GAP + k * (width + GAP)
        canvas[HEAD : HEAD + height, left : left + width] = panel
        _write(canvas, title, (left + 2, HEAD - 10), INK)
    bar = canvas[HEAD : HEAD + height, 3 * (width + GAP) + GAP :]
    _draw_scale(bar, limits)
    _write_caption(canvas, frame, result)
    return canvas


def draw_flow(frame: RgbdFrame, result: DeblurResult) -> Picture:
    """Draw the sharp image with the path of each point of a grid."""
    return _with_paths(draw_image(result.image), result, frame.camera)


def draw_depth(frame: RgbdFrame, result: DeblurResult, limits: tuple[float, float]) -> Picture:
    """Colour the filled depth between two limits [m], darker where it was a hole."""
    coloured = _colours(result.depth, limits)
    measured = np.isfinite(frame.depth) & (frame.depth > 0)
    shade = np.where(measured, 1.0, HOLE_SHADE)[..., None]
    return _fit((coloured * shade).astype(np.uint8))


def draw_image(image: FloatImage) -> Picture:
    """Give an image as it is, in a size that fits a page."""
    return _fit(_as_rgb(image))


def depth_limits(result: DeblurResult) -> tuple[float, float]:
    """Give the depths [m] between which nearly all of a frame lies."""
    low, high = np.percentile(result.depth, [1, 99])
    return float(low), float(high)


def summary(results: Sequence[DeblurResult]) -> str:
    """Say in a few lines what became of a run's frames."""
    if not results:
        return 'no frames'
    counts = Counter(result.outcome for result in results)
    outcomes = ', '.join(f'{counts[outcome]} {outcome.value}' for outcome in Outcome)
    lines = [f'frames    {len(results)}: {outcomes}']
    for name, unit, values in (
        ('blur', 'px', [r.blur_px for r in results if r.outcome is Outcome.SOLVED]),
        ('quality', '', [r.quality for r in results]),
        ('time', 's', [r.seconds for r in results]),
    ):
        if values:
            middle, most = np.median(values), max(values)
            lines.append(
                f'{name:<9} median {middle:.2f} {unit}, largest {most:.2f} {unit}'.rstrip()
            )
    return '\n'.join(lines)


def _as_rgb(image: FloatImage) -> Picture:
    pixels = np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)
    return pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2)


def _zoom(width: int) -> float:
    return float(np.clip(width, *PANEL_WIDTH)) / width


def _fit(picture: Picture) -> Picture:
    zoom = _zoom(picture.shape[1])
    if zoom == 1:
        return picture
    size = (round(zoom * picture.shape[1]), max(1, round(zoom * picture.shape[0])))
    way = cv2.INTER_AREA if zoom < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(picture, size, interpolation=way), np.uint8)


def _colours(depth: npt.NDArray[np.floating], limits: tuple[float, float]) -> Picture:
    """Colour depths (H, W): near is warm, far is cold."""
    low, high = limits
    far = np.clip((depth - low) / max(high - low, 1e-6), 0, 1)
    index = np.rint(235 - 215 * far).astype(np.uint8)  # the ends of the map are nearly black
    return np.asarray(cv2.applyColorMap(index, cv2.COLORMAP_TURBO)[..., ::-1], np.uint8)


def _with_paths(picture: Picture, result: DeblurResult, camera: CameraIntrinsics) -> Picture:
    """Draw the path of every grid point over the exposure, centred on the point."""
    paths, zoom = flow(result.motion.by_rows, result.depth, camera), _zoom(camera.width)
    lengths = zoom * np.hypot(paths[..., 0], paths[..., 1])
    drawn = picture.copy()
    if lengths.max() < 0.5:
        return drawn
    step = max(GRID, round(1.4 * float(np.median(lengths))))
    rows, columns = (np.arange(step // 2, side, step) for side in picture.shape[:2])
    for thickness, colour in ((3, (20, 20, 24)), (1, (255, 255, 255))):
        for y, x in ((y, x) for y in rows for x in columns):
            at = min(int(y / zoom), camera.height - 1), min(int(x / zoom), camera.width - 1)
            half = zoom * paths[at] / 2
            start, end = (np.rint(16 * (np.array([x, y]) + s * half)).astype(int) for s in (-1, 1))
            cv2.line(drawn, start.tolist(), end.tolist(), colour, thickness, cv2.LINE_AA, 4)
    return drawn


def _draw_scale(strip: Picture, limits: tuple[float, float]) -> None:
    """Draw the colours of the depth as a bar with metres beside it, near at the bottom."""
    top, bottom, wide = 8, strip.shape[0] - 8, 14
    values = np.linspace(limits[1], limits[0], bottom - top)[:, None]
    strip[top:bottom, :wide] = _colours(values, limits)
    for k in range(5):
        depth = limits[1] + (limits[0] - limits[1]) * k / 4
        y = top + round((bottom - top - 1) * k / 4)
        cv2.line(strip, (wide, y), (wide + 4, y), FAINT, 1)
        _write(strip, f'{depth:.1f} m', (wide + 8, y + 4), INK, 0.42)


def _write_caption(canvas: Picture, frame: RgbdFrame, result: DeblurResult) -> None:
    base = canvas.shape[0] - 12
    word = result.outcome.value
    (width, _), _ = cv2.getTextSize(word, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)
    low, high = (GAP, base - 17), (GAP + width + 16, base + 7)
    cv2.rectangle(canvas, low, high, BADGE[result.outcome], -1)
    _write(canvas, word, (GAP + 8, base), (255, 255, 255))
    parts = [
        f'blur {result.blur_px:.1f} px',
        f'quality {result.quality:.2f}',
        f'sign {"known" if result.sign_resolved else "open"}',
        f'{result.seconds:.1f} s',
        f'stamp {frame.stamp_ns // 10**9}.{frame.stamp_ns % 10**9:09d}',
    ]
    _write(canvas, '    '.join(parts), (GAP + width + 34, base), INK)


def _write(
    canvas: Picture, text: str, at: tuple[int, int], colour: Colour, size: float = 0.55
) -> None:
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)
