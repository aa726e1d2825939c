"""Files of the recorder's MCAP writer equal those of the mcap library byte for byte, for any content."""

import io

from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from truearm.record.mcap_writer import McapMessage, McapWriter

TEXT = st.text(max_size=8)
UINT64 = st.integers(0, 2**64 - 1)
MESSAGE = st.tuples(st.integers(0, 3), st.integers(0, 2**32 - 1), UINT64, UINT64, st.binary(max_size=60))
CHUNK = st.tuples(st.just("chunk"), st.lists(MESSAGE, max_size=12))
METADATA = st.tuples(st.just("metadata"), TEXT, st.dictionaries(TEXT, TEXT, max_size=3))
ATTACHMENT = st.tuples(st.just("attachment"), UINT64, TEXT, TEXT, st.binary(max_size=30))
STEPS = st.lists(st.one_of(CHUNK, CHUNK, METADATA, ATTACHMENT), max_size=8)


class Library:
    """The mcap library's writer behind the interface of ours."""

    def __init__(self, out, profile, library):
        self._writer = Writer(out, chunk_size=1 << 30, compression=CompressionType.ZSTD, enable_data_crcs=True)
        self._writer.start(profile, library)
        self.schema, self.channel = self._writer.register_schema, self._writer.register_channel
        self.metadata, self.finish = self._writer.add_metadata, self._writer.finish

    def chunk(self, messages):
        for message in messages:
            self._writer.add_message(
                message.channel, message.log_ns, message.data, message.publish_ns, message.sequence
            )
        self._writer.flush()

    def attachment(self, time_ns, name, media_type, data):
        self._writer.add_attachment(time_ns, time_ns, name, media_type, data)


def written(kind, steps):
    out = io.BytesIO()
    writer, channels = kind(out, "truearm", "a writer"), {}
    for name, *arguments in steps:
        if name == "chunk":
            for topic, *_ in arguments[0]:
                if topic not in channels:
                    schema = writer.schema(f"schema {topic}", "jsonschema", b"{}")
                    channels[topic] = writer.channel(f"/{topic}", "json", schema)
            writer.chunk([McapMessage(channels[topic], *message) for topic, *message in arguments[0]])
        else:
            {"metadata": writer.metadata, "attachment": writer.attachment}[name](*arguments)
    writer.finish()
    return out.getvalue()


@given(STEPS)
def test_the_same_bytes_as_the_library(steps):
    assert written(McapWriter, steps) == written(Library, steps)


def test_a_channel_without_a_message_waits_for_the_next_chunk():
    def steps(writer):
        writer.channel("/first", "json", 0)
        writer.chunk([])
        writer.chunk([McapMessage(writer.channel("/second", "json", 0), 7, 2, 1, b"{}")])
        writer.finish()

    ours, theirs = io.BytesIO(), io.BytesIO()
    steps(McapWriter(ours, "", ""))
    steps(Library(theirs, "", ""))
    assert ours.getvalue() == theirs.getvalue()
    ((_, channel, message),) = make_reader(io.BytesIO(ours.getvalue())).iter_messages()
    assert (channel.topic, message.sequence, message.data) == ("/second", 7, b"{}")
