"""Bags of small messages for the tests, and what readers that are not ours find in them."""

import random

from depth_deblur_ros.bag import BagReader, decoded
from mcap.reader import NonSeekingReader
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, Reader, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

TYPES = get_typestore(Stores.ROS2_JAZZY)
COUNT = 40
TEXTS = [f'message {i}' for i in range(COUNT)]
EXPECTED = [(100 + i, text) for i, text in enumerate(TEXTS)]


def string(text):
    make = TYPES.types['std_msgs/msg/String']
    return bytes(TYPES.serialize_cdr(make(text), 'std_msgs/msg/String'))


WHOLE = [(time, '/text', string(text)) for time, text in EXPECTED]
NOISE = random.Random(0)
LONG = [f'{i:02d}' + ''.join(NOISE.choices('abcdefghij', k=20_000)) for i in range(COUNT)]
BIG = [(100 + i, '/text', string(text)) for i, text in enumerate(LONG)]
LAYOUTS = {
    'plain': {'compression': CompressionType.NONE},
    'lz4': {'compression': CompressionType.LZ4},
    'zstd': {'compression': CompressionType.ZSTD},
    'no chunks': {'use_chunking': False, 'enable_data_crcs': True},
    'no index': {
        'compression': CompressionType.NONE,
        'index_types': IndexType.NONE,
        'use_statistics': False,
        'use_summary_offsets': False,
        'repeat_schemas': False,
        'repeat_channels': False,
    },
}


def write_rosbag(folder, mode):
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        topic = writer.add_connection('/text', 'std_msgs/msg/String', typestore=TYPES)
        for i, text in enumerate(TEXTS):
            writer.write(topic, 100 + i, string(text))


def write_mcap(path, times=range(100, 100 + COUNT), texts=TEXTS, chunk_size=200, **options):
    """Write an mcap file with chunks of a few messages each."""
    with path.open('wb') as stream:
        writer = McapWriter(stream, chunk_size=chunk_size, **options)
        writer.start('ros2')
        text = TYPES.generate_msgdef('std_msgs/msg/String', ros_version=2)[0].encode()
        schema = writer.register_schema('std_msgs/msg/String', 'ros2msg', text)
        channel = writer.register_channel('/text', 'cdr', schema)
        for time, content in zip(times, texts, strict=True):
            writer.add_message(channel, time, string(content), time)
        writer.finish()


def read(path):
    with BagReader(path) as bag:
        return [(m.log_ns, decoded(m).data) for m in bag.messages({'/text'})], bag.damage


def raw(path):
    """Give the messages as they stand in the bag, by our reader, and what it says is damaged."""
    with BagReader(path) as bag:
        found = [(m.log_ns, m.topic.name, bytes(m.data)) for m in bag.messages(bag.topics)]
        return found, bag.damage


def others(path):
    """Give what other readers find up to where they give up."""
    return {
        'stream': _until_it_breaks(_by_stream(path, validate_crcs=False)),
        'stream with checksums': _until_it_breaks(_by_stream(path, validate_crcs=True)),
        'without seeking': _until_it_breaks(_without_seeking(path)),
        'rosbags': _until_it_breaks(_by_rosbags(path)),
    }


def _until_it_breaks(messages):
    found = []
    try:
        found.extend(iter(lambda: next(messages), None))
    except Exception:  # whatever a reader does about damage
        return found
    return found


def _by_stream(path, validate_crcs):
    channels = {}
    with path.open('rb') as stream:
        for record in StreamReader(stream, validate_crcs=validate_crcs).records:
            if isinstance(record, Channel):
                channels[record.id] = record.topic
            elif isinstance(record, Message) and record.channel_id in channels:
                yield record.log_time, channels[record.channel_id], bytes(record.data)


def _without_seeking(path):
    with path.open('rb') as stream:
        for _, channel, message in NonSeekingReader(stream).iter_messages(log_time_order=False):
            yield message.log_time, channel.topic, bytes(message.data)


def _by_rosbags(path):
    with Reader(path.parent) as reader:
        for connection, time, data in reader.messages():
            yield time, connection.topic, bytes(data)
