"""Files of the recorder's MCAP writer against those of the mcap library: the same bytes, whatever is written."""

import io

from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from truearm.record.mcap_writer import McapWriter

TEXT = st.text(max_size=8)
UINT64 = st.integers(0, 2**64 - 1)
MESSAGE = st.tuples(
    st.just("message"), st.integers(0, 3), st.integers(0, 2**32 - 1), UINT64, UINT64, st.binary(max_size=60)
)
METADATA = st.tuples(st.just("metadata"), TEXT, st.dictionaries(TEXT, TEXT, max_size=3))
ATTACHMENT = st.tuples(st.just("attachment"), UINT64, TEXT, TEXT, st.binary(max_size=30))
STEP = st.one_of(MESSAGE, MESSAGE, MESSAGE, METADATA, ATTACHMENT, st.just(("flush",)))


class Library:
    """The mcap library's writer behind the interface of ours."""

    def __init__(self, out, profile, library):
        self._writer = Writer(out, chunk_size=1 << 30, compression=CompressionType.ZSTD, enable_data_crcs=True)
        self._writer.start(profile, library)
        self.register_schema, self.register_channel = self._writer.register_schema, self._writer.register_channel
        self.add_metadata, self.flush, self.finish = self._writer.add_metadata, self._writer.flush, self._writer.finish

    def add_message(self, channel, sequence, log_ns, publish_ns, data):
        self._writer.add_message(channel, log_ns, data, publish_ns, sequence)

    def add_attachment(self, time_ns, name, media_type, data):
        self._writer.add_attachment(time_ns, time_ns, name, media_type, data)


def written(kind, steps):
    out = io.BytesIO()
    writer, channels = kind(out, "truearm", "a writer"), {}
    for name, *arguments in steps:
        if name == "message":
            topic, *message = arguments
            if topic not in channels:
                schema = writer.register_schema(f"schema {topic}", "jsonschema", b"{}")
                channels[topic] = writer.register_channel(f"/{topic}", "json", schema)
            writer.add_message(channels[topic], *message)
        else:
            {"metadata": writer.add_metadata, "attachment": writer.add_attachment, "flush": writer.flush}[name](
                *arguments
            )
    writer.finish()
    return out.getvalue()


@given(st.lists(STEP, max_size=30))
def test_the_same_bytes_as_the_library(steps):
    assert written(McapWriter, steps) == written(Library, steps)


def test_a_channel_without_a_message_waits_for_the_next_chunk():
    def steps(writer):
        writer.register_channel("/first", "json", 0)
        writer.flush()
        writer.add_message(writer.register_channel("/second", "json", 0), 7, 2, 1, b"{}")
        writer.finish()

    ours, theirs = io.BytesIO(), io.BytesIO()
    steps(McapWriter(ours, "", ""))
    steps(Library(theirs, "", ""))
    assert ours.getvalue() == theirs.getvalue()
    ((_, channel, message),) = make_reader(io.BytesIO(ours.getvalue())).iter_messages()
    assert (channel.topic, message.sequence, message.data) == ("/second", 7, b"{}")
