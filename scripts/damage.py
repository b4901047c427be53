"""
Damage small bags at random, and compare what is recovered with what other readers recover.

usage: python scripts/damage.py [--bags N] [--seed N] [--keep FOLDER]; exit code 1 where another
reader gives a sound message that ours does not. Prints a table in the form of docs/results.md.
"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
import random
import sys
import tempfile

from depth_deblur_ros.core.data import InputError

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))
from bag_parts import BIG, COUNT, LAYOUTS, LONG, others, raw, WHOLE, write_mcap

DATA_END = 0x0F
CHUNK, MESSAGE = 6, 5
MAGIC_SIZE, HEAD_SIZE = 8, 9


def records(bag: bytes, *kinds: int) -> list[tuple[int, int]]:
    """Give begin and end of the outermost records of these kinds, or of all."""
    at, found = MAGIC_SIZE, []
    while at + HEAD_SIZE <= len(bag) - MAGIC_SIZE:
        end = at + HEAD_SIZE + int.from_bytes(bag[at + 1 : at + HEAD_SIZE], 'little')
        if not kinds or bag[at] in kinds:
            found.append((at, end))
        at = end
    return found


def cut(bag: bytes, rng: random.Random) -> bytes:
    """End it anywhere."""
    return bag[: rng.randrange(len(bag))]


def noise(bag: bytes, rng: random.Random) -> bytes:
    """Put random bytes over a stretch."""
    at, length = rng.randrange(len(bag)), rng.choice([1, 10, 100, 1000, 4096, 20_000])
    end = min(len(bag), at + length)
    return bag[:at] + rng.randbytes(end - at) + bag[end:]


def zeros(bag: bytes, rng: random.Random) -> bytes:
    """Empty up to three pages."""
    for _ in range(rng.randint(1, 3)):
        page = rng.choice([512, 4096])
        at = rng.randrange(len(bag)) // page * page
        end = min(len(bag), at + page)
        bag = bag[:at] + bytes(end - at) + bag[end:]
    return bag


def insertion(bag: bytes, rng: random.Random) -> bytes:
    """Put random bytes in between."""
    at = rng.randrange(len(bag))
    return bag[:at] + rng.randbytes(rng.choice([1, 7, 100, 5000])) + bag[at:]


def length(bag: bytes, rng: random.Random) -> bytes:
    """Change a byte of the length of a record."""
    at = rng.choice(records(bag))[0] + 1 + rng.randrange(8)
    return bag[:at] + bytes([rng.choice([0, 1, 255, rng.randrange(256)])]) + bag[at + 1 :]


def swap(bag: bytes, rng: random.Random) -> bytes:
    """Let two chunks or messages change places."""
    found = records(bag, CHUNK, MESSAGE)
    if len(found) < 2:
        return bag
    (a, b), (c, d) = sorted(rng.sample(found, 2))
    return bag[:a] + bag[c:d] + bag[b:c] + bag[a:b] + bag[d:]


def double(bag: bytes, rng: random.Random) -> bytes:
    """Put a chunk or message in a second time, anywhere."""
    found = records(bag, CHUNK, MESSAGE)
    begin, end = rng.choice(found)
    at = rng.choice([end, rng.choice(found)[0], len(bag)])
    return bag[:at] + bag[begin:end] + bag[at:]


def omission(bag: bytes, rng: random.Random) -> bytes:
    """Leave out a chunk or message."""
    begin, end = rng.choice(records(bag, CHUNK, MESSAGE))
    return bag[:begin] + bag[end:]


def splice(bag: bytes, rng: random.Random) -> bytes:
    """Join a beginning to an end, wherever these are."""
    return bag[: rng.randrange(len(bag))] + bag[rng.randrange(len(bag)) :]


def no_end(bag: bytes, rng: random.Random) -> bytes:
    """Take away the end of data, the summary and the footer."""
    ends = records(bag, DATA_END)
    return bag[: ends[-1][0]] if ends else bag


KINDS: dict[str, Callable[[bytes, random.Random], bytes]] = {
    'cut anywhere': cut,
    'random bytes over a stretch of 1 to 20 000': noise,
    'up to three pages of zeros': zeros,
    'random bytes put in between': insertion,
    "a byte of a record's length changed": length,
    'two chunks or messages swapped': swap,
    'a chunk or message twice': double,
    'a chunk or message left out': omission,
    'a beginning joined to an end': splice,
    'without the end of data, summary and footer': no_end,
}


def damaged(bag: bytes, kind: str, rng: random.Random) -> bytes:
    """Damage a bag one to three times in the same way, so long as there is something to damage."""
    for _ in range(rng.choice([1, 1, 2, 3])):
        try:
            bag = KINDS[kind](bag, rng)
        except (IndexError, ValueError):
            return bag  # nothing is left
    return bag


def compare(path: Path, whole: set[object]) -> tuple[int, int, bool, bool]:
    """Give the sound messages of ours and of the best other; worse and silent, which are bad."""
    try:
        messages, damage = raw(path)
    except InputError as error:
        messages, damage = [], [str(error)]
    ours = set(messages) & whole
    theirs = [set(found) & whole for found in others(path).values()]
    worse = any(found - ours for found in theirs)
    return len(ours), max(map(len, theirs)), worse, not damage and ours != whole


def main() -> int:
    """Damage, compare, print."""
    parser = argparse.ArgumentParser(description='Damage bags and compare what is recovered.')
    parser.add_argument('--bags', type=int, default=1500)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--keep', type=Path, help='folder for bags of which others give more')
    args = parser.parse_args()
    rng, sums = random.Random(args.seed), defaultdict[str, Counter[str]](Counter)
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / 'bag' / 'a.mcap'
        path.parent.mkdir()
        for number in range(args.bags):
            kind, layout, big = rng.choice([*KINDS]), rng.choice([*LAYOUTS]), rng.random() < 0.5
            options = {'texts': LONG, 'chunk_size': 200_000} if big else {}
            write_mcap(path, **options, **LAYOUTS[layout])
            path.write_bytes(damaged(path.read_bytes(), kind, rng))
            ours, best, worse, silent = compare(path, set(BIG if big else WHOLE))
            sums[kind].update(bags=1, ours=ours, best=best, worse=worse, silent=silent)
            if worse and args.keep:
                args.keep.mkdir(parents=True, exist_ok=True)
                (args.keep / f'{number}.mcap').write_bytes(path.read_bytes())
    print('| damage | ours | best other | others gave more | not told |\n|---|---|---|---|---|')
    for kind, n in sorted(sums.items()):
        shares = f'{n["ours"] / n["bags"] / COUNT:.3f} | {n["best"] / n["bags"] / COUNT:.3f}'
        print(f'| {kind} | {shares} | {n["worse"]:d} of {n["bags"]} | {n["silent"]:d} |')
    return int(any(n['worse'] for n in sums.values()))


if __name__ == '__main__':
    sys.exit(main())
