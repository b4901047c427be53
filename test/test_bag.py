"""Bags in every compression, damaged ones, and what is written read back by another reader."""

from pathlib import Path

from bag_parts import COUNT, EXPECTED, read, TEXTS, write_mcap, write_rosbag
from depth_deblur_ros.bag import BagReader, BagWriter
from depth_deblur_ros.core.data import InputError
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from mcap_ros2.decoder import DecoderFactory
import numpy as np
import pytest
from rosbags.rosbag2 import CompressionMode
import yaml


@pytest.mark.parametrize('mode', list(CompressionMode))
@pytest.mark.parametrize('how', ['folder', 'no metadata', 'file'])
def test_every_compression_of_rosbag2_is_read(tmp_path, mode, how):
    bag = tmp_path / 'bag'
    write_rosbag(bag, mode)
    if how != 'folder':
        (bag / 'metadata.yaml').unlink()
    assert read(next(bag.glob('*.mcap*')) if how == 'file' else bag) == (EXPECTED, [])


@pytest.mark.parametrize('compression', list(CompressionType))
@pytest.mark.parametrize('chunks', [True, False])
def test_every_layout_of_mcap_is_read(tmp_path, compression, chunks):
    write_mcap(tmp_path / 'a.mcap', compression=compression, use_chunking=chunks)
    assert read(tmp_path / 'a.mcap') == (EXPECTED, [])


def test_a_file_without_summary_and_index_is_read(tmp_path):
    none = dict.fromkeys(
        ('use_statistics', 'use_summary_offsets', 'repeat_schemas', 'repeat_channels'), False
    )
    write_mcap(tmp_path / 'a.mcap', index_types=IndexType.NONE, **none)
    assert read(tmp_path / 'a.mcap') == (EXPECTED, [])


def test_messages_come_in_the_order_of_their_log_times(tmp_path):
    times = [100 + 7 * i % COUNT for i in range(COUNT)]
    write_mcap(tmp_path / 'a.mcap', times)
    messages, _ = read(tmp_path / 'a.mcap')
    assert messages == sorted(zip(times, TEXTS, strict=True))


def test_a_span_of_time_is_half_open_and_counted(tmp_path):
    write_mcap(tmp_path / 'a.mcap')
    with BagReader(tmp_path / 'a.mcap') as bag:
        assert (bag.start_ns, bag.end_ns, bag.count('/text')) == (100, 139, COUNT)
        times = [m.log_ns for m in bag.messages({'/text'}, 110, 115)]
        assert times == [110, 111, 112, 113, 114]
        assert 5 <= bag.count('/text', 110, 115) <= 20  # to a chunk
        assert list(bag.messages({'/other'})) == []


def test_a_bag_in_several_files_is_one(tmp_path):
    for name, times in (('b_0', range(140, 180)), ('b_1', range(100, 140))):
        write_mcap(tmp_path / f'{name}.mcap', times)
    messages, damage = read(tmp_path)
    assert [time for time, _ in messages] == list(range(100, 180))
    assert damage == []


def test_a_file_that_is_missing_from_the_bag_is_noted(tmp_path):
    write_rosbag(tmp_path / 'bag', CompressionMode.NONE)
    meta = tmp_path / 'bag/metadata.yaml'
    content = yaml.safe_load(meta.read_text())
    content['rosbag2_bagfile_information']['relative_file_paths'].append('bag_1.mcap')
    meta.write_text(yaml.dump(content))
    missing = ['bag_1.mcap is missing from the bag', f'0 of {COUNT} messages lost']
    assert read(tmp_path / 'bag') == (EXPECTED, missing)


@pytest.mark.parametrize('chunks', [True, False])
@pytest.mark.parametrize('part', np.linspace(0.1, 0.99, 12).round(2))
def test_a_file_without_its_end_gives_what_is_left(tmp_path, part, chunks):
    write_mcap(tmp_path / 'a.mcap', use_chunking=chunks)
    whole = (tmp_path / 'a.mcap').read_bytes()
    (tmp_path / 'a.mcap').write_bytes(whole[: int(len(whole) * part)])
    try:
        messages, damage = read(tmp_path / 'a.mcap')
    except InputError as error:
        assert part < 0.2, error
        return
    assert messages == EXPECTED[: len(messages)]
    assert len(messages) > COUNT * (part - 0.5)  # the index at the end is long here
    assert any('without a footer' in note for note in damage)


def write_nothing(path):
    with path.open('wb') as stream:
        writer = McapWriter(stream)
        writer.start('ros2')
        writer.finish()


@pytest.mark.parametrize(
    ('make', 'reason'),
    [
        (lambda path: None, 'does not exist'),
        (lambda path: path.mkdir(), 'holds no .mcap file'),
        (lambda path: path.write_bytes(b''), r'\(0 bytes\) is not an mcap file'),
        (lambda path: path.write_bytes(b'SQLite format 3'), 'is not an mcap file'),
        (write_nothing, 'holds no messages'),
    ],
)
def test_what_is_no_bag_is_refused(tmp_path, make, reason):
    make(tmp_path / 'a.mcap')
    with pytest.raises(InputError, match=reason):
        BagReader(tmp_path / 'a.mcap')


def test_a_packed_file_that_is_not_zstd_is_refused(tmp_path):
    (tmp_path / 'a.mcap.zstd').write_bytes(b'no zstd at all')
    with pytest.raises(InputError, match=r'cannot read .*a\.mcap\.zstd'):
        BagReader(tmp_path / 'a.mcap.zstd')


# What is written

FIELDS = {
    'header': {'stamp': {'sec': 3, 'nanosec': 4}, 'frame_id': 'camera'},
    'height': 2,
    'width': 3,
    'encoding': 'mono8',
    'step': 3,
    'data': np.arange(6, dtype=np.uint8),
}


def write_bag(path, **options):
    with BagWriter(path, **options) as bag:
        bag.write('/image', 'sensor_msgs/msg/Image', FIELDS, 5)
        bag.write('/info', 'sensor_msgs/msg/CameraInfo', {'k': range(9), 'd': [0.5]}, 6)
        status = {'level': 2, 'values': [{'key': 'a', 'value': 'b'}]}
        bag.write('/status', 'diagnostic_msgs/msg/DiagnosticStatus', status, 7)


def read_independently(path):
    with next(path.glob('*.mcap')).open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return {c.topic: (m, d) for _, c, m, d in reader.iter_decoded_messages()}


def test_another_reader_finds_what_was_written(tmp_path):
    write_bag(tmp_path / 'bag')
    found = read_independently(tmp_path / 'bag')
    message, image = found['/image']
    assert (message.log_time, image.header.stamp.sec, image.header.frame_id) == (5, 3, 'camera')
    assert (image.height, image.width, image.encoding, image.is_bigendian) == (2, 3, 'mono8', 0)
    assert bytes(image.data) == bytes(range(6))
    _, info = found['/info']
    assert (list(info.k), list(info.d), info.roi.do_rectify) == (list(range(9)), [0.5], False)
    _, status = found['/status']
    assert (status.level, status.values[0].key, status.values[0].value) == (2, 'a', 'b')


def test_metadata_says_what_ros2_bag_asks_for(tmp_path):
    write_bag(tmp_path / 'bag')
    meta = yaml.safe_load((tmp_path / 'bag/metadata.yaml').read_text())
    meta = meta['rosbag2_bagfile_information']
    assert meta['storage_identifier'] == 'mcap'
    assert meta['message_count'] == 3
    assert [(tmp_path / 'bag' / name).is_file() for name in meta['relative_file_paths']] == [True]
    assert sorted(p.name for p in tmp_path.iterdir()) == ['bag']


def test_an_interrupted_bag_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), BagWriter(tmp_path / 'bag') as bag:
        bag.write('/image', 'sensor_msgs/msg/Image', FIELDS, 5)
        assert not (tmp_path / 'bag').exists()
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_bag_is_replaced_only_when_asked_for(tmp_path):
    write_bag(tmp_path / 'bag')
    (tmp_path / 'bag/mark').touch()
    with pytest.raises(InputError, match='exists already'):
        BagWriter(tmp_path / 'bag')
    write_bag(tmp_path / 'bag', overwrite=True)
    assert sorted(p.name for p in (tmp_path / 'bag').iterdir()) == ['bag.mcap', 'metadata.yaml']
    assert [p.name for p in tmp_path.iterdir()] == ['bag']


def test_what_is_no_bag_is_never_replaced(tmp_path):
    (tmp_path / 'home').mkdir()
    with pytest.raises(InputError, match='not a rosbag2 folder'):
        BagWriter(tmp_path / 'home', overwrite=True)


def test_a_place_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / 'file').touch()
    with pytest.raises(InputError, match='cannot write'), BagWriter(tmp_path / 'file/bag'):
        pass


def test_a_field_that_the_type_has_not_is_an_error(tmp_path):
    with pytest.raises(TypeError, match='no field hight'), BagWriter(tmp_path / 'bag') as bag:
        bag.write('/image', 'sensor_msgs/msg/Image', {'hight': 3}, 5)


def test_copied_messages_keep_type_and_quality_of_service(tmp_path):
    definition = 'float32 a\nInner b\n' + '=' * 80 + '\nMSG: own_msgs/Inner\nuint8 c\n'
    qos = yaml.dump([{
        'history': 'keep_last', 'depth': 1, 'reliability': 'reliable',
        'durability': 'transient_local', 'deadline': {'sec': 0, 'nsec': 0},
        'lifespan': {'sec': 0, 'nsec': 0}, 'liveliness': 'automatic',
        'liveliness_lease_duration': {'sec': 0, 'nsec': 0},
        'avoid_ros_namespace_conventions': False,
    }])  # fmt: skip
    with Path(tmp_path / 'a.mcap').open('wb') as stream:
        writer = McapWriter(stream)
        writer.start('ros2')
        schema = writer.register_schema('own_msgs/msg/Outer', 'ros2msg', definition.encode())
        channel = writer.register_channel('/own', 'cdr', schema, {'offered_qos_profiles': qos})
        writer.add_message(channel, 5, b'\0\1\0\0' + np.float32(1.5).tobytes() + b'\7', 5)
        writer.finish()
    with BagReader(tmp_path / 'a.mcap') as source, BagWriter(tmp_path / 'bag') as target:
        for message in source.messages({'/own'}):
            target.copy(message)
    _, content = read_independently(tmp_path / 'bag')['/own']
    assert (content.a, content.b.c) == (1.5, 7)
    with BagReader(tmp_path / 'bag') as copy:
        topic = copy.topics['/own']
    assert (topic.type, 'transient_local' in topic.metadata['offered_qos_profiles']) == (
        'own_msgs/msg/Outer',
        True,
    )


def test_a_bag_in_sqlite_is_refused_with_a_way_out(tmp_path):
    (tmp_path / 'old_0.db3').write_bytes(b'SQLite format 3')
    with pytest.raises(InputError, match='a bag in SQLite; rosbags-convert makes it one'):
        BagReader(tmp_path)
