"""
Colour with depth by time stamp: one rule for the live topics and for a bag.

Each colour frame takes its nearest depth within the slop; a depth may serve several. As long as
the stamps of each stream rise, the pairs do not depend on how the two streams interleave.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Generic, TypeVar

A = TypeVar('A')
B = TypeVar('B')

NO_DEPTH = 'no depth within the slop'
DUPLICATE = 'colour stamp seen before'
LATE = 'colour stamp older than that of a frame already paired'

_NEVER = -(2**63)
_JUMP_NS = 200_000_000  # older than its stream by more than this: time was set back, a bag loops


class StampPairer(Generic[A, B]):
    """
    Give each colour item its nearest depth item within slop_ns, in the order of the colour stamps.

    A colour frame waits until a depth stamp has come that is not older: from then on no nearer one
    can come. At most `keep` items of each kind are held. `dropped` counts the colour frames
    without a pair, by reason; `unused_depths` the depths that no colour frame took;
    `nearest_miss_ns` is the smallest gap that was too wide.
    """

    _newest_colour: int
    _newest_depth: int
    _decided: int

    def __init__(self, slop_ns: int, keep: int = 64) -> None:
        self.dropped: Counter[str] = Counter()
        self.unused_depths = 0
        self.nearest_miss_ns: int | None = None
        self.slop_ns = slop_ns
        self.keep = keep
        self._depth: dict[int, B] = {}
        self._used: set[int] = set()
        self._forget_all()

    @property
    def waiting(self) -> int:
        """How many colour frames are undecided."""
        return len(self._colour)

    def push_colour(self, stamp_ns: int, item: A) -> list[tuple[A, B]]:
        """Take a colour item; give the pairs that can be told now."""
        pairs = self._restart(stamp_ns, self._newest_colour)
        if stamp_ns in self._colour or stamp_ns == self._decided:
            self.dropped[DUPLICATE] += 1
        elif stamp_ns < self._decided:
            self.dropped[LATE] += 1
        else:
            self._colour[stamp_ns] = item
            self._newest_colour = max(self._newest_colour, stamp_ns)
        return pairs + self._decide()

    def push_depth(self, stamp_ns: int, item: B) -> list[tuple[A, B]]:
        """Take a depth item; give the pairs that can be told now."""
        pairs = self._restart(stamp_ns, self._newest_depth)
        self.unused_depths += stamp_ns in self._depth
        self._depth.setdefault(stamp_ns, item)
        self._newest_depth = max(self._newest_depth, stamp_ns)
        return pairs + self._decide()

    def flush(self) -> list[tuple[A, B]]:
        """Give the remaining pairs: nothing more will come."""
        return self._decide(waiting=False)

    def settle(
        self, due: Callable[[A], bool], overdue: Callable[[A], bool] = lambda _: False
    ) -> list[tuple[A, B]]:
        """
        Give the pairs of due colour frames: a depth that is near enough is good enough.

        Overdue ones without such a depth are dropped.
        """
        pairs = []
        while self._colour:
            stamp = min(self._colour)
            item, found = self._colour[stamp], self._nearest(stamp) is not None
            if not ((found and due(item)) or overdue(item)):
                break
            pairs += self._decide_one(stamp)
        self._forget()
        return pairs

    def clear(self, reason: str) -> None:
        """Drop all that waits, for this reason."""
        if self._colour:
            self.dropped[reason] += len(self._colour)
        self.nearest_miss_ns = None
        self._forget_all()

    def _forget_all(self) -> None:
        self._colour: dict[int, A] = {}
        self._forget_depths(list(self._depth))
        self._newest_colour = _NEVER
        self._newest_depth = _NEVER
        self._decided = _NEVER

    def _restart(self, stamp_ns: int, newest: int) -> list[tuple[A, B]]:
        """Finish and forget what was before, where time has jumped back."""
        if stamp_ns >= newest - _JUMP_NS:
            return []
        pairs = self.flush()
        self._forget_all()
        return pairs

    def _decide(self, waiting: bool = True) -> list[tuple[A, B]]:
        pairs = []
        while self._colour:
            stamp = min(self._colour)
            known = self._newest_depth >= stamp
            if waiting and not known and len(self._colour) <= self.keep:
                break
            pairs += self._decide_one(stamp)
        self._forget()
        return pairs

    def _decide_one(self, stamp: int) -> list[tuple[A, B]]:
        colour, depth = self._colour.pop(stamp), self._nearest(stamp)
        self._decided = stamp
        if depth is None:
            self.dropped[NO_DEPTH] += 1
            return []
        self._used.add(depth)
        return [(colour, self._depth[depth])]

    def _nearest(self, stamp_ns: int) -> int | None:
        """Give the stamp of the nearest depth within the slop, the older one of two as near."""
        if not self._depth:
            return None
        nearest = min(self._depth, key=lambda stamp: (abs(stamp - stamp_ns), stamp))
        gap = abs(nearest - stamp_ns)
        if gap <= self.slop_ns:
            return nearest
        self.nearest_miss_ns = min(gap, self.nearest_miss_ns or gap)
        return None

    def _forget(self) -> None:
        """Drop depths that no colour frame to come can want, and the oldest of too many."""
        passed = sorted(stamp for stamp in self._depth if stamp <= self._decided)
        self._forget_depths(passed[:-1])
        self._forget_depths(sorted(self._depth)[: -self.keep])

    def _forget_depths(self, stamps: list[int]) -> None:
        self.unused_depths += sum(stamp not in self._used for stamp in stamps)
        for stamp in stamps:
            del self._depth[stamp]
            self._used.discard(stamp)
