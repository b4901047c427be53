"""
What the live node says about itself: counts, rates, times, and why nothing comes out.

Times are those of a steady clock, in seconds; the caller brings them.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
import re
from typing import Any

from depth_deblur_ros.frames import SolvedPair
from depth_deblur_ros.live import Intake
from depth_deblur_ros.messages import Fields
from depth_deblur_ros.settings import Settings
import numpy as np

SILENCE_S = 5.0  # after this a warning
WINDOW_S = 5.0  # of the rates
SAMPLES = 500  # of the latencies
OK, WARN = 0, 1


class Said:
    """Which warnings have been given lately."""

    def __init__(self) -> None:
        self._when: dict[str, float] = {}

    def is_new(self, text: str, now: float) -> bool:
        """Whether this text, whatever its numbers, has not been given for long; it is now."""
        kind = re.sub(r'\d+', '', text)
        self._when = {k: t for k, t in self._when.items() if now - t < SILENCE_S}
        return self._when.setdefault(kind, now) == now


class Meter:
    """How often something happens."""

    def __init__(self) -> None:
        self.count = 0
        self.last: float | None = None
        self._times: deque[float] = deque(maxlen=1000)

    def tick(self, now: float) -> None:
        """Count one event."""
        self.count += 1
        self.last = now
        self._times.append(now)

    def rate(self, now: float) -> float:
        """Give the events per second of the last seconds."""
        times = [time for time in self._times if time > now - WINDOW_S]
        return (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 0.0


@dataclass
class Stream:
    """
    What came on one topic; mismatch is a QoS policy.

    missing counts the messages that were sent and did not get here, by the numbers that a
    publisher gives them; where there are none, or several publishers, it is lost, which is what
    the transport says it lost. The others came while the queue was full.
    """

    topic: str
    needed: bool = True
    meter: Meter = field(default_factory=Meter)
    missing: int = 0
    lost: int = 0
    publishers: int = 0
    mismatch: str = ''
    _matched: int = 0
    _number: int | None = None

    def match(self, publishers: int) -> None:
        """Count by the numbers of whoever publishes from now on."""
        self._matched, self._number = publishers, None

    def follow(self, number: int | None) -> None:
        """Count what is missing before the message of this number."""
        before, self._number = self._number, number if self._matched == 1 else None
        if before is not None and self._number is not None:
            self.missing += max(0, self._number - before - 1)

    def miss(self, count: int) -> None:
        """Count what the transport says is lost."""
        self.lost += count
        if self._number is None:
            self.missing += count

    def trouble(self, now: float, began: float) -> str:
        """Say why nothing comes, if nothing has come for long."""
        quiet = now - max(began, self.meter.last or began)
        if self.mismatch:
            return f'a publisher on {self.topic} offers another QoS: {self.mismatch}'
        if quiet < SILENCE_S:
            return ''
        publishers = {0: 'no publisher', 1: '1 publisher'}
        there = publishers.get(self.publishers, f'{self.publishers} publishers')
        return f'nothing on {self.topic} for {quiet:.0f} s ({there})'


class Health:
    """
    Counts and times of one run of the node.

    streams by role: colour, depth, camera_info, exposure. Callbacks count in one thread and the
    solver in another: the caller locks.
    """

    def __init__(self, intake: Intake) -> None:
        self.intake = intake
        self.streams: dict[str, Stream] = {}
        self.began = 0.0
        self._pairs = 0
        self._last_pair: float | None = None
        self.published = Meter()
        self.outcomes: Counter[str] = Counter()
        self.failed: Counter[str] = Counter()
        self._failure: tuple[float, str] | None = None
        self._latency: deque[float] = deque(maxlen=SAMPLES)
        self._solver: deque[float] = deque(maxlen=SAMPLES)

    def count(self, solved: SolvedPair, latency: float, now: float) -> None:
        """Count a pair whose results have been published, latency seconds after its stamp."""
        self.published.tick(now)
        self.outcomes[solved.result.outcome.value] += 1
        self._latency.append(latency)
        self._solver.append(solved.result.seconds)
        if solved.reason:
            self.failed[solved.reason] += 1
            self._failure = now, solved.reason

    def stream(self, role: str, topic: str, needed: bool) -> Stream:
        """Give what is counted of a topic, the counts so far if it is the same topic."""
        if role not in self.streams or self.streams[role].topic != topic:
            self.streams[role] = Stream(topic)
        self.streams[role].needed = needed
        self.streams[role].mismatch = ''
        self.streams[role].match(0)
        return self.streams[role]

    def arrived(self, role: str, now: float) -> None:
        """Count a message that has been handed over to the intake."""
        self.streams[role].meter.tick(now)
        if self.intake.pairs > self._pairs:
            self._pairs, self._last_pair = self.intake.pairs, now

    def silence(self, slop_s: float, now: float) -> str:
        """Say why no pair has come for long; empty where pairs come."""
        quiet = now - max(self.began, self._last_pair or self.began)
        if quiet < SILENCE_S:
            return ''
        needed = [stream for stream in self.streams.values() if stream.needed]
        troubles = [text for s in needed if (text := s.trouble(now, self.began))]
        if not troubles and self.intake.gap_s is not None:
            troubles = [
                f'the stamps of colour and depth are {self.intake.gap_s:.3f} s apart at best, '
                f'sync_slop_s is {slop_s:g}'
            ]
        return '; '.join(troubles) or f'no pair for {quiet:.0f} s'

    def verdict(self, slop_s: float, now: float) -> tuple[int, str]:
        """Give the level and the line of a node that is at work."""
        if silence := self.silence(slop_s, now):
            return WARN, silence
        if self._failure and now - self._failure[0] < SILENCE_S:
            return WARN, f'frames pass unchanged: {self._failure[1]}'
        rates = self.streams['colour'].meter.rate(now), self.published.rate(now)
        return OK, f'{rates[0]:.1f} Hz in, {rates[1]:.1f} Hz out'

    def status(self, name: str, state: str, settings: Settings, now: float) -> Fields:
        """Give a diagnostic_msgs/DiagnosticStatus; state says why the node is not at work."""
        level, message = (OK, state) if state else self.verdict(settings.node.sync_slop_s, now)
        values = {'mode': settings.solver.mode, **self.values(now)}
        return {
            'level': level,
            'name': name,
            'message': message,
            'values': [{'key': key, 'value': str(value)} for key, value in values.items()],
        }

    def values(self, now: float) -> dict[str, Any]:
        """Give all counts and times, by name."""
        intake, dropped = self.intake, self.intake.dropped
        values: dict[str, Any] = {
            'arrived': intake.arrived,
            'published': self.published.count,
            'dropped': dropped.total(),
            'waiting': intake.waiting,
            **{f'dropped: {reason}': n for reason, n in dropped.most_common()},
            'unused depths': intake.unused_depths,
            'pairs': intake.pairs,
            **{f'outcome: {name}': n for name, n in self.outcomes.most_common()},
            **{f'failed: {reason}': n for reason, n in self.failed.most_common()},
        }
        for role, stream in self.streams.items():
            values[f'{role} topic'] = stream.topic
            values[f'{role} arrived'] = stream.meter.count
            values[f'{role} lost in transport'] = stream.missing
            values[f'{role} lost in a full queue'] = max(0, stream.missing - stream.lost)
            values[f'{role} rate [Hz]'] = f'{stream.meter.rate(now):.2f}'
        values['output rate [Hz]'] = f'{self.published.rate(now):.2f}'
        values |= _percentiles('latency', self._latency) | _percentiles('solver', self._solver)
        age = '' if self._last_pair is None else f'{now - self._last_pair:.2f}'
        return {**values, 'age of the last pair [s]': age}


def _percentiles(name: str, samples: Iterable[float]) -> dict[str, str]:
    times = list(samples)
    if not times:
        return {f'{name} p50 [s]': '', f'{name} p99 [s]': ''}
    p50, p99 = np.percentile(times, [50, 99])
    return {f'{name} p50 [s]': f'{p50:.4f}', f'{name} p99 [s]': f'{p99:.4f}'}
