"""What is left of damaged bags: never less than other readers find, and the loss is told."""

from contextlib import suppress
import random
import re
import struct
import zlib

from bag_parts import (
    BIG,
    COUNT,
    EXPECTED,
    LAYOUTS,
    LONG,
    others,
    raw,
    read,
    TEXTS,
    WHOLE,
    write_mcap,
    write_rosbag,
)
import damage
from depth_deblur_ros.bag import BagReader
from depth_deblur_ros.core.data import InputError
from hypothesis import example, given, settings
from hypothesis import strategies as st
import pytest
from rosbags.rosbag2 import CompressionMode
import zstandard

ZSTD = b'\x28\xb5\x2f\xfd'


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp('damage')
    for name, options in LAYOUTS.items():
        write_mcap(folder / name, **options)
        write_mcap(folder / f'{name} big', texts=LONG, chunk_size=200_000, **options)
    return folder


def damaged(folder, content):
    path = folder / 'bag' / 'a.mcap'
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    return path


def sound(messages, whole):
    """Give those messages that are as they were written."""
    return sorted(set(messages) & set(whole))


def assert_no_reader_finds_more(path, whole):
    try:
        ours, damage = raw(path)
    except InputError as error:
        ours, damage = [], [str(error)]
    assert len(sound(ours, whole)) == len([m for m in ours if m in whole])  # none twice
    assert sorted(ours) == sorted(whole) or damage
    for name, found in others(path).items():
        missed = set(sound(found, whole)) - set(ours)
        assert not missed, (name, sorted(missed)[:3], damage)
    return sound(ours, whole), damage


layouts = st.sampled_from(list(LAYOUTS))
parts = st.floats(0, 1)


@settings(max_examples=150)
@given(layout=layouts, part=parts)
def test_a_cut_bag_gives_what_any_reader_finds(folder, layout, part):
    content = (folder / layout).read_bytes()
    path = damaged(folder, content[: int(part * len(content))])
    found, _ = assert_no_reader_finds_more(path, WHOLE)
    assert found == WHOLE[: len(found)]


@settings(max_examples=150)
@given(layout=layouts, flips=st.lists(st.tuples(parts, st.integers(0, 7)), min_size=1, max_size=4))
def test_flipped_bits_cost_no_more_than_with_any_reader(folder, layout, flips):
    content = bytearray((folder / layout).read_bytes())
    begin = 400 if layout == 'no index' else 0  # there topic and type are told only once
    for part, bit in flips:
        content[begin + int(part * (len(content) - begin - 1))] ^= 1 << bit
    with suppress(UnicodeDecodeError):
        assert_no_reader_finds_more(damaged(folder, content), WHOLE)


@settings(max_examples=100)
@given(layout=layouts, begin=parts, length=st.integers(1, 400), fill=st.sampled_from([0, 255, 5]))
@example(layout='no chunks', begin=0.890625, length=1, fill=0)  # a channel in the summary
@example(layout='no index', begin=0.0625, length=1, fill=255)  # the length of a channel
def test_an_overwritten_stretch_costs_what_it_covers(folder, layout, begin, length, fill):
    content = bytearray((folder / layout).read_bytes())
    at = int(begin * len(content))
    content[at : at + length] = bytes([fill]) * len(content[at : at + length])
    found, damage = assert_no_reader_finds_more(damaged(folder, content), WHOLE)
    described = at > 400  # type and topic stand in the first records
    if described and layout != 'no index':
        # at most the chunks that it touches: of up to 8 messages, three at most
        assert len(found) >= COUNT - 24, damage


@settings(max_examples=60)
@given(layout=layouts, begin=parts, length=st.integers(1, 3000))
def test_a_missing_stretch_costs_what_it_held(folder, layout, begin, length):
    content = (folder / layout).read_bytes()
    at = int(begin * len(content))
    path = damaged(folder, content[:at] + content[at + length :])
    assert_no_reader_finds_more(path, WHOLE)


@settings(max_examples=60)
@given(layout=layouts, part=st.floats(0.1, 1))
def test_a_cut_chunk_gives_its_leading_messages(folder, layout, part):
    """Ten messages of 20 kB are in a chunk; of a cut one the others give none."""
    content = (folder / f'{layout} big').read_bytes()
    path = damaged(folder, content[: int(part * len(content))])
    found, damage = assert_no_reader_finds_more(path, BIG)
    assert found == BIG[: len(found)]
    assert len(found) >= COUNT * part * 0.97 - 8, damage  # zstd unpacks 128 kB at once


def cut_after(content, text):
    return content[: content.index(text) + len(text)]


def test_a_chunk_is_given_up_to_the_cut_message(folder):
    content = (folder / 'plain big').read_bytes()
    path = damaged(folder, cut_after(content, LONG[17].encode()) + b'\0')
    found, damage = raw(path)
    assert found == BIG[:18]
    assert 'without a footer' in damage[0]
    assert re.search(r'chunk at byte \d+: only \d+ of its \d+ bytes .*; \d messages', damage[1])
    assert damage[-1] == '18 messages read; nothing tells how many are lost'


def test_one_flipped_bit_of_a_plain_chunk_is_turned_back(folder):
    content = (folder / 'plain').read_bytes()
    assert content.count(b'message 20') == 1
    path = damaged(folder, content.replace(b'message 20', b'massage 20'))
    found, damage = raw(path)
    assert found == WHOLE
    assert 'one flipped bit has been turned back; 0 of' in damage[0]
    assert damage[-1] == f'0 of {COUNT} messages lost'


def test_a_message_under_a_wrong_checksum_is_given_and_told(folder):
    content = (folder / 'plain').read_bytes()
    path = damaged(folder, content.replace(b'message 20', b'missive 20'))
    messages, damage = read(path)
    assert [text for _, text in messages] == [*TEXTS[:20], 'missive 20', *TEXTS[21:]]
    assert 'its checksum is wrong, so that messages may be altered; 0 of' in damage[0]


@pytest.mark.parametrize('layout', ['plain', 'no chunks', 'no index'])
def test_a_broken_length_in_the_middle_costs_one_message(folder, layout):
    content = bytearray((folder / layout).read_bytes())
    place = content.index(b'message 20') - 8 - 22 - 8  # the length of that record
    (length,) = struct.unpack_from('<Q', content, place)
    for wrong in (length + 1, 0, length + 60, 2**33, 2**63):
        content[place : place + 8] = struct.pack('<Q', wrong)
        found, damage = raw(damaged(folder, content))
        assert set(WHOLE) - set(found) <= {WHOLE[20]}, wrong
        assert damage


def test_a_lost_beginning_costs_only_what_it_held(folder):
    content = (folder / 'plain').read_bytes()
    path = damaged(folder, bytes(300) + content[300:])
    found, damage = raw(path)
    assert len(found) > 30
    assert 'no record can be read from byte 0' in damage[0]
    assert damage[-1] == f'{COUNT - len(found)} of {COUNT} messages lost'


def test_a_lost_header_of_a_plain_chunk_costs_no_message(folder):
    content = bytearray((folder / 'plain').read_bytes())
    place = content.index(b'message 20')
    chunk = content.rindex(b'\x06', 0, content.rindex(b'message 1', 0, place) - 60)
    while content[chunk] != 6 or content[chunk + 6 : chunk + 9] != b'\0\0\0':
        chunk = content.rindex(b'\x06', 0, chunk)
    content[chunk : chunk + 48] = bytes(48)
    found, damage = raw(damaged(folder, content))
    assert found == WHOLE, damage
    assert damage[-1] == f'0 of {COUNT} messages lost'


def test_a_lost_packed_chunk_is_told_with_its_place_and_its_messages(folder):
    content = bytearray((folder / 'zstd').read_bytes())
    place = content.index(b'zstd', len(content) // 3)
    content[place - 60 : place + 4] = bytes(64)
    found, damage = raw(damaged(folder, content))
    lost = COUNT - len(found)
    assert 0 < lost < 10
    assert re.search(
        rf'no record can be read from byte \d+ to \d+, which held {lost} messages', damage[0]
    )
    assert damage[-1] == f'{lost} of {COUNT} messages lost'


def test_zeros_behind_the_end_are_no_damage(folder):
    path = damaged(folder, (folder / 'zstd').read_bytes() + bytes(5000))
    assert raw(path) == (WHOLE, [])


def test_two_files_in_one_are_both_read(folder, tmp_path):
    write_mcap(tmp_path / 'b.mcap', range(200, 200 + COUNT))
    both = (folder / 'zstd').read_bytes() + (tmp_path / 'b.mcap').read_bytes()
    found, _ = raw(damaged(folder, both))
    assert len(found) == 2 * COUNT


@pytest.mark.parametrize('part', [0.2, 0.5, 0.9])
def test_a_packed_file_that_is_cut_gives_its_beginning(tmp_path, part):
    write_rosbag(tmp_path / 'bag', CompressionMode.FILE)
    (path,) = (tmp_path / 'bag').glob('*.mcap.zstd')
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    with suppress(InputError):  # a file this small is one block of zstd
        messages, damage = read(tmp_path / 'bag')
        assert messages == EXPECTED[: len(messages)]
        assert damage


def test_a_packed_message_that_is_broken_costs_itself_alone(tmp_path):
    write_rosbag(tmp_path / 'bag', CompressionMode.MESSAGE)
    (path,) = (tmp_path / 'bag').glob('*.mcap')
    content = bytearray(path.read_bytes())
    frames = [match.start() for match in re.finditer(re.escape(ZSTD), content)]
    content[frames[7] + 6 : frames[7] + 12] = b'\xff' * 6
    path.write_bytes(content)
    messages, damage = read(tmp_path / 'bag')
    assert len(messages) == COUNT - 1
    assert any('a message on /text cannot be unpacked' in note for note in damage)
    assert damage[-1] == f'1 of {COUNT} messages lost'


def test_a_file_that_a_crash_left_unlisted_is_read_and_told(tmp_path):
    write_rosbag(tmp_path / 'bag', CompressionMode.NONE)
    write_mcap(tmp_path / 'bag' / 'bag_1.mcap', range(200, 200 + COUNT))
    messages, damage = read(tmp_path / 'bag')
    assert len(messages) == 2 * COUNT
    assert damage[0] == 'bag_1.mcap is not listed in metadata.yaml'


def test_a_half_packed_copy_beside_its_original_is_passed_over(tmp_path):
    write_rosbag(tmp_path / 'bag', CompressionMode.NONE)
    (tmp_path / 'bag' / 'metadata.yaml').unlink()
    (path,) = (tmp_path / 'bag').glob('*.mcap')
    packed = zstandard.compress(path.read_bytes())
    path.with_suffix('.mcap.zstd').write_bytes(packed[: len(packed) // 2])
    assert read(tmp_path / 'bag') == (EXPECTED, [])


def test_a_block_whose_times_lie_is_read_all_the_same(folder):
    content = bytearray((folder / 'plain').read_bytes())
    chunk = next(m.start() for m in re.finditer(rb'\x06.{5}\0\0\0', content, re.DOTALL))
    content[chunk + 9 : chunk + 25] = struct.pack('<QQ', 2**62, 1)
    found, _ = raw(damaged(folder, content))
    assert found == WHOLE


def test_a_chunk_that_claims_to_be_huge_takes_no_memory(folder):
    bomb = zstandard.compress(bytes(50_000_000))
    content = bytearray((folder / 'zstd').read_bytes())
    chunk = next(m.start() for m in re.finditer(rb'\x06.{5}\0\0\0', content, re.DOTALL))
    (length,) = struct.unpack_from('<Q', content, chunk + 1)
    body = (
        struct.pack('<QQQI', 100, 139, 2**60, 1) + b'\4\0\0\0zstd' + struct.pack('<Q', len(bomb))
    )
    chunk_record = b'\6' + struct.pack('<Q', len(body) + len(bomb)) + body + bomb
    content[chunk : chunk + 9 + length] = chunk_record
    found, damage = raw(damaged(folder, content))
    assert len(found) < COUNT
    assert any(f'of its {2**60} bytes can be unpacked' in note for note in damage)


def test_the_oracle_of_checksums_agrees(folder):
    """The test of a flipped bit stands on CRC-32 being that of zlib, as the format says."""
    assert zlib.crc32(b'123456789') == 0xCBF43926


@pytest.mark.parametrize('seed', range(200))
def test_garbage_never_crashes_the_reader(folder, seed):
    rng = random.Random(seed)
    content = bytearray((folder / rng.choice(list(LAYOUTS))).read_bytes())
    for _ in range(rng.randint(1, 40)):
        at, length = rng.randrange(len(content)), rng.randint(1, 12)
        content[at : at + length] = rng.randbytes(rng.choice([length, 0, 2 * length]))
    with suppress(InputError), BagReader(damaged(folder, content)) as bag:
        assert len(list(bag.messages(bag.topics))) <= COUNT


def first_index(content, chunk):
    """Give where the first message index behind a chunk's begin stands."""
    index = content.index(b'\x07', chunk + 60)
    while struct.unpack_from('<Q', content, index + 1)[0] != 6 + 16 * content[index + 11] // 16:
        index = content.index(b'\x07', index + 1)
    return index


def test_an_index_that_ends_within_an_entry_costs_no_message(folder):
    content = bytearray((folder / 'plain').read_bytes())
    index = first_index(content, 0)
    (entries,) = struct.unpack_from('<I', content, index + 11)
    content[index + 11 : index + 15] = struct.pack('<I', entries + 13)
    content[index + 15 + entries : index + 15 + entries] = bytes(13)
    assert raw(damaged(folder, content))[0] == WHOLE


def test_a_chunk_that_claims_to_be_shorter_than_its_head_is_no_chunk(folder):
    content = bytearray((folder / 'plain').read_bytes())
    chunk = next(m.start() for m in re.finditer(rb'\x06.{5}\0\0\0', content, re.DOTALL))
    index = first_index(content, chunk)
    record = bytes(content[index : index + 9 + 6 + content[index + 11]])
    content[chunk + 1 : chunk + 9] = struct.pack('<Q', 22)
    content[chunk + 9 + 22 : chunk + 9 + 22 + len(record)] = record
    found, damage = raw(damaged(folder, content))
    assert found
    assert damage


@pytest.mark.parametrize('kind', damage.KINDS)
def test_no_reader_finds_more_in_a_bag_damaged_at_random(folder, kind):
    rng = random.Random(3)
    for layout in folder.iterdir():
        if layout.is_file():
            whole = BIG if layout.name.endswith('big') else WHOLE
            path = damaged(folder, damage.damaged(layout.read_bytes(), kind, rng))
            assert not damage.compare(path, set(whole))[2], layout
