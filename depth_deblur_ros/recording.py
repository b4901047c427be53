"""RGB-D pairs out of a bag: which topics to read, which camera counts, what was left out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from depth_deblur_ros.bag import BagReader, decoded
from depth_deblur_ros.core.data import check_exposure, InputError
from depth_deblur_ros.frames import Pair
from depth_deblur_ros.mcap_file import BagMessage
from depth_deblur_ros.messages import camera_from_msg, stamp_ns
from depth_deblur_ros.pairing import StampPairer

_IMAGES = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage')
_ROLES = {  # role: (message types, usual topics)
    'colour': (_IMAGES, ('/rgb/image_rect_color', '/camera/rgb/image_color')),
    'depth': (_IMAGES, ('/depth_registered/image_rect', '/camera/depth/image')),
    'info': (('sensor_msgs/msg/CameraInfo',), ('/rgb/camera_info', '/camera/rgb/camera_info')),
    'exposure': (('std_msgs/msg/Float32',), ('/exposure', '/camera/rgb/exposure')),
    'imu': (('sensor_msgs/msg/Imu',), ('/imu', '/imu/data', '/camera/imu')),
}
_TRANSPORTS = ('', '/compressed', '/compressedDepth')
_DEPTH_ENCODINGS = ('16UC1', '32FC1')


@dataclass(frozen=True)
class Topics:
    """The topics that are read; info is None where a camera is given, the last are optional."""

    colour: str
    depth: str
    info: str | None
    exposure: str | None
    imu: str | None = None

    def names(self) -> set[str]:
        """Give all that are read."""
        names = (self.colour, self.depth, self.info, self.exposure, self.imu)
        return {name for name in names if name}


def choose_topics(bag: BagReader, given: Mapping[str, str], *, with_info: bool) -> Topics:
    """Take the topics that are given, else the usual ones, else the only ones that fit."""
    for role, name in given.items():
        if role not in _ROLES:
            raise InputError(f'unknown topic role {role!r}; known are {", ".join(_ROLES)}')
        if name not in bag.topics or bag.topics[name].type not in _ROLES[role][0]:
            raise _missing(bag, role, f'{name} is not there as {" or ".join(_ROLES[role][0])}')
    colour = given.get('colour') or _usual(bag, 'colour') or _only(bag, 'colour')
    depth = given.get('depth') or _usual(bag, 'depth') or _only(bag, 'depth')
    info = None
    if with_info:
        beside = colour.removesuffix('/compressed').rpartition('/')[0] + '/camera_info'
        info = given.get('info') or _usual(bag, 'info', beside) or _only(bag, 'info')
    optional = [given.get(role) or _usual(bag, role) for role in ('exposure', 'imu')]
    return Topics(colour, depth, info, *optional)


def first_message(bag: BagReader, topic: str) -> Any:
    """Give the first message of a topic that can be read."""
    for message in bag.messages({topic}):
        try:
            return decoded(message)
        except InputError:
            continue
    raise InputError(f'{topic} in {bag.path} holds no message that can be read')


def first_camera(bag: BagReader, topic: str) -> Any:
    """Give the first camera_info that can be used; refuse a bag without one before any work."""
    refusal = InputError(f'{topic} in {bag.path} holds no message that can be read')
    for message in bag.messages({topic}):
        try:
            info = decoded(message)
            camera_from_msg(info)
            return info
        except InputError as error:
            refusal = error
    raise refusal


def _usual(bag: BagReader, role: str, *first: str) -> str | None:
    types, names = _ROLES[role]
    wanted = (name + transport for name in (*first, *names) for transport in _TRANSPORTS)
    return next((n for n in wanted if n in bag.topics and bag.topics[n].type in types), None)


def _only(bag: BagReader, role: str) -> str:
    """Give the only topic of the right type; colour and depth are told apart by their encoding."""
    fitting = {name for name, topic in bag.topics.items() if topic.type in _ROLES[role][0]}
    if role in ('colour', 'depth'):
        fitting = {name for name in fitting if _is_depth(bag, name) == (role == 'depth')}
    # A compressed topic beside its raw one is the same stream.
    fitting -= {name + transport for name in fitting for transport in _TRANSPORTS[1:]}
    if len(fitting) == 1:
        return fitting.pop()
    found = (
        f'more than one would fit: {", ".join(sorted(fitting))}' if fitting else 'none is there'
    )
    raise _missing(bag, role, found)


def _is_depth(bag: BagReader, topic: str) -> bool | None:
    try:
        message = first_message(bag, topic)
    except InputError:
        return None
    form: str = getattr(message, 'encoding', '') or getattr(message, 'format', '')
    return form.startswith(_DEPTH_ENCODINGS) or 'compressedDepth' in form


def _missing(bag: BagReader, role: str, found: str) -> InputError:
    there = ', '.join(f'{t.name} ({t.type})' for _, t in sorted(bag.topics.items()))
    return InputError(f'no topic for {role} in {bag.path}: {found}; topics: {there or "none"}')


class PairReader:
    """
    Read the colour-depth pairs of a bag; `dropped` counts the colour without one, by reason.

    `unread` counts the messages beside them that cannot be read, by topic.

    on_message, where given, sees every message of the bag in passing, on_imu those of the gyro.
    The camera_info is the latest before the colour frame; before the first, the first.
    """

    def __init__(
        self,
        bag: BagReader,
        topics: Topics,
        slop_ns: int,
        on_message: Callable[[BagMessage], None] | None = None,
        *,
        on_imu: Callable[[Any], None] | None = None,
    ) -> None:
        self.slop_s = slop_ns / 1e9
        self._bag = bag
        self._topics = topics
        self._on_message, self._on_imu = on_message, on_imu
        self._pairer: StampPairer[Pair, Any] = StampPairer(slop_ns)
        self._info = first_camera(bag, topics.info) if topics.info else None
        self._exposure: float | None = None
        self.dropped: Counter[str] = self._pairer.dropped
        self.unread: Counter[str] = Counter()

    @property
    def nearest_miss_s(self) -> float | None:
        """The smallest gap in seconds that was too wide for a pair."""
        miss = self._pairer.nearest_miss_ns
        return None if miss is None else miss / 1e9

    def pairs(self, start_ns: int, end_ns: int | None) -> Iterator[Pair]:
        """Give the pairs of a span of log time, in the order of the colour stamps."""
        wanted = self._bag.topics.keys() if self._on_message else self._topics.names()
        for message in self._bag.messages(wanted, start_ns, end_ns):
            if self._on_message:
                self._on_message(message)
            if message.topic.name in self._topics.names():
                yield from self._take(message)
        yield from map(_joined, self._pairer.flush())

    def _take(self, message: BagMessage) -> Iterator[Pair]:
        name = message.topic.name
        try:
            content = self._checked(name, decoded(message))
        except InputError:
            if name == self._topics.colour:
                self.dropped[f'a message on {name} cannot be read'] += 1
            else:
                self.unread[name] += 1
            return
        if name == self._topics.info:
            self._info = content
        elif name == self._topics.exposure:
            self._exposure = float(content.data)
        elif name == self._topics.imu:
            if self._on_imu:
                self._on_imu(content)
        elif name == self._topics.depth:
            yield from map(_joined, self._pairer.push_depth(stamp_ns(content.header), content))
        else:
            pair = Pair(content, None, self._info, self._exposure, message.log_ns)
            yield from map(_joined, self._pairer.push_colour(stamp_ns(content.header), pair))

    def _checked(self, name: str, content: Any) -> Any:
        """Refuse what only a damaged message says."""
        if name == self._topics.exposure:
            check_exposure(float(content.data))
        elif content.header.stamp.nanosec >= 1_000_000_000:
            raise InputError(f'{content.header.stamp.nanosec} ns are no part of a second')
        elif name == self._topics.info:
            camera_from_msg(content)
        return content


def _joined(found: tuple[Pair, Any]) -> Pair:
    return replace(found[0], depth=found[1])
