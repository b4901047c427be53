"""
A cluttered room of rectangles and spheres, laid out and painted from a seed.

World axes: x right, y down, z forward, metres; the eye stands near the origin.
"""

from __future__ import annotations

from dataclasses import dataclass, field
import math

from depth_deblur_ros.core.data import CameraIntrinsics
import numpy as np
import numpy.typing as npt
from raycast import Array, colour_rays, depth_rays, empty_depth, empty_light, image_bounds, Light
from textures import mip_levels, paint, PAINTERS

FLOOR, CEILING, DOOR = 1.3, -1.4, 0.55
EPSILON = 0.012  # m; how far a poster stands off its wall
PROJECTOR = np.array([-0.075, 0.0, 0.0])  # m; of the depth camera, in the camera's frame
RICH = ('leaves', 'leaves', 'page', 'page', 'cloth', 'checker', 'stucco', 'books')

Rng = np.random.Generator
Pair = tuple[float, float]
Triple = tuple[float, float, float]
X, Y, Z = np.eye(3)


@dataclass(frozen=True, eq=False)
class Pose:
    """Where a camera stands: point_world = rotation @ point_camera + centre."""

    rotation: Array  # (3, 3)
    centre: Array  # (3,), metres


@dataclass(frozen=True, eq=False)
class DepthView:
    """What a depth camera could see, without its noise; (H, W) each."""

    depth: Array  # metres along z, inf = nothing there
    incidence: Array  # cosine between ray and normal
    shine: Array  # 0 matt .. 1 mirror
    lit: npt.NDArray[np.bool_]  # its projector sees the point too


@dataclass(frozen=True, eq=False)
class Scene:
    """The arrays that raycast.py documents."""

    rects: Array
    spheres: Array
    materials: Array
    lamps: Array
    pool: Light

    def light(self, camera: CameraIntrinsics, pose: Pose) -> Light:
        """Render linear light (H, W, 3)."""
        out = empty_light(camera.height, camera.width)
        world = (self.rects, self.spheres, self.materials, self.lamps, self.pool)
        at, lens = (pose.rotation, pose.centre), _lens(camera)
        colour_rays(world, image_bounds(self.rects, self.spheres, at, lens), at, lens, out)
        return out

    def depth(self, camera: CameraIntrinsics, pose: Pose) -> DepthView:
        """Render the exact depth at the pixel centres."""
        out = empty_depth(camera.height, camera.width)
        projector = pose.rotation @ PROJECTOR + pose.centre
        surfaces = (self.rects, self.spheres, self.materials)
        depth_rays(surfaces, (pose.rotation, pose.centre), _lens(camera), projector, out)
        return DepthView(*out)


def render_view(scene: Scene, camera: CameraIntrinsics, pose: Pose) -> tuple[Light, Array]:
    """Render one sharp view: linear light (H, W, 3) and depth (H, W) [m]."""
    return scene.light(camera, pose), scene.depth(camera, pose).depth


def _lens(camera: CameraIntrinsics) -> tuple[float, float, float, float]:
    return float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy)


@dataclass
class _Builder:
    rng: Rng
    rects: list[Array] = field(default_factory=list)
    rect_materials: list[Array] = field(default_factory=list)
    spheres: list[Array] = field(default_factory=list)
    sphere_materials: list[Array] = field(default_factory=list)

    def material(self, name: str, tile: float) -> Array:
        """Tint a texture a little, so that two things of one kind differ."""
        tint = self.rng.uniform(0.8, 1.1) * (1 + self.rng.uniform(-0.1, 0.1, 3))
        shine = 1.0 if name == 'glass' else 0.0
        return np.array([list(PAINTERS).index(name), tile, *tint, shine])

    def rect(self, corner: Array, u: Array, v: Array, size: Pair, look: Array) -> None:
        """Add a rectangle seen with u to the right and v downwards."""
        row = np.concatenate([corner, u, v, np.cross(v, u), np.array(size)])
        self.rects.append(row)
        self.rect_materials.append(look)

    def box(self, foot: Triple, size: Triple, yaw: float, name: str) -> None:
        """Add a box (width, height, length) standing on the point foot, turned by yaw about y."""
        w, h, d = size
        a = np.array([math.cos(yaw), 0, math.sin(yaw)])
        b = np.array([-math.sin(yaw), 0, math.cos(yaw)])
        left, right, top = -w / 2 * a, w / 2 * a, np.array(foot) - h * Y
        near, far = top - d / 2 * b, top + d / 2 * b
        look = self.material(name, max(size))
        self.rect(near + left, a, Y, (w, h), look)
        self.rect(near + right, b, Y, (d, h), look)
        self.rect(far + left, -b, Y, (d, h), look)
        self.rect(far + right, -a, Y, (w, h), look)
        self.rect(far + left, a, -b, (w, d), look)

    def ball(self, centre: Triple, radius: float, name: str) -> None:
        """Add a sphere with the texture once around it."""
        self.spheres.append(np.array([*centre, radius]))
        self.sphere_materials.append(self.material(name, 2 * math.pi * radius))

    def build(self, lamps: Array) -> Scene:
        """Paint the textures and pack the scene."""
        pool = np.stack([mip_levels(paint(name, self.rng)) for name in PAINTERS])
        materials = np.stack(self.rect_materials + self.sphere_materials)
        return Scene(np.stack(self.rects), np.stack(self.spheres), materials, lamps, pool)


def _walls(b: _Builder, half: float, back: float) -> float:
    """Put up the room; give x where a doorway begins, to a room out of the sensor's range."""
    height, depth, front = FLOOR - CEILING, back + 5, -1.0
    wall, ceiling = b.material('plaster', 3), b.material('plaster', 3)
    beyond = b.material('books', 2.4)
    floor = b.material(str(b.rng.choice(['wood', 'checker'])), 2.4)
    door = b.rng.uniform(-0.2, 0.35) * half
    rest = half - door - DOOR
    b.rect(np.array([-half, CEILING, front]), Z, Y, (depth, height), wall)
    b.rect(np.array([half, CEILING, front + depth]), -Z, Y, (depth, height), wall)
    b.rect(np.array([-half, FLOOR, front + depth]), X, -Z, (2 * half, depth), floor)
    b.rect(np.array([-half, CEILING, front]), X, Z, (2 * half, depth), ceiling)
    b.rect(np.array([-half, CEILING, back + 2.6]), X, Y, (2 * half, height), beyond)
    b.rect(np.array([-half, CEILING, back]), X, Y, (door + half, height), wall)
    b.rect(np.array([door + DOOR, CEILING, back]), X, Y, (rest, height), wall)
    b.rect(np.array([door, CEILING, back]), X, Y, (DOOR, 0.6), wall)
    return door


def _posters(b: _Builder, half: float, back: float, door: float) -> None:
    """Hang pictures on the back wall, clear of the door, and on both side walls."""
    for x in np.arange(-half + 0.1, half - 0.5, 0.62):
        w, h, y = b.rng.uniform(0.35, 0.55), b.rng.uniform(0.35, 0.7), b.rng.uniform(-1.0, -0.3)
        look = b.material(str(b.rng.choice(RICH)), max(w, h))
        if x + w < door or x > door + DOOR:
            b.rect(np.array([x, y, back - EPSILON]), X, Y, (w, h), look)
            b.rect(np.array([x + 0.03, y + h + 0.08, back - EPSILON]), X, Y, (w - 0.1, 0.4), look)
    for z in (1.2, 2.3):
        w, h, name = b.rng.uniform(0.5, 0.9), b.rng.uniform(0.5, 0.9), str(b.rng.choice(RICH))
        y, look = b.rng.uniform(-0.8, 0.1), b.material(name, max(w, h))
        b.rect(np.array([-half + EPSILON, y, z]), Z, Y, (w, h), look)
        b.rect(np.array([half - EPSILON, y, z + w]), -Z, Y, (w, h), look)


def _furniture(b: _Builder, half: float, back: float) -> None:
    """Place a shelf, a rug, a desk with things on it, and something close to the lens."""
    rng, side = b.rng, float(b.rng.choice([-1, 1]))
    shelf = (side * (half - 0.75), FLOOR, back - 0.2)
    b.box(shelf, (1.1, 2.0, 0.35), 0.0, 'books')
    rug = np.array([-1.0, FLOOR - EPSILON, back - 0.3])
    b.rect(rug, X, -Z, (2.0, 1.4), b.material('cloth', 2.0))
    at, top = -side * rng.uniform(0.1, 0.3), 0.52
    b.box((at, FLOOR, 2.0), (1.9, FLOOR - top, 0.8), rng.uniform(-0.12, 0.12), 'wood')
    for x in np.linspace(at - 0.78, at + 0.78, 5) + rng.uniform(-0.06, 0.06, 5):
        foot = (float(x), top, 2.0 + rng.uniform(-0.22, 0.2))
        if rng.random() < 0.25:
            r = rng.uniform(0.11, 0.16)
            b.ball((foot[0], top - r, foot[2]), r, str(rng.choice(RICH)))
            continue
        size = (rng.uniform(0.18, 0.3), rng.uniform(0.15, 0.5), rng.uniform(0.08, 0.25))
        b.box(foot, size, rng.uniform(-0.6, 0.6), str(rng.choice(RICH)))
    screen = (at + rng.uniform(-0.3, 0.3), top, 2.28)
    b.box(screen, (0.5, 0.34, 0.04), rng.uniform(-0.3, 0.3), 'glass')
    b.ball((side * 0.62, 0.5, 1.35), rng.uniform(0.13, 0.17), 'leaves')
    b.box((side * 0.62, FLOOR, 1.35), (0.34, FLOOR - 0.64, 0.34), 0.4, 'cloth')
    b.box((-side * 0.55, FLOOR, 0.98), (0.36, FLOOR - 0.16, 0.05), side * 0.35, 'page')


def make_scene(seed: int) -> Scene:
    """Lay out and paint the room of that number."""
    b = _Builder(np.random.default_rng(seed))
    half, back = b.rng.uniform(2.0, 2.4), b.rng.uniform(3.3, 3.8)
    door = _walls(b, half, back)
    _posters(b, half, back, door)
    _furniture(b, half, back)
    lamps = np.array(
        [
            [b.rng.uniform(-1.2, 1.2), CEILING + 0.1, 1.2, 1.5],
            [b.rng.uniform(-2, 2), -0.8, -0.6, 1.6],
        ]
    )
    return b.build(lamps)
