"""Send frames over the link, one at a time: sequence numbers, and writes of which the link takes only part.

No call allocates. A frame is begun in the link's own buffer (`begin`, `put_*`, `send`) or was built elsewhere
(`send_built`, for the ring's data frames). Until the link has taken all of it, no other can be begun.
"""

from truearm_wire.cbor import put_head, put_int
from truearm_wire.fast import add, copy
from truearm_wire.frame import FRAME_MAX, HEAD, TAIL, close
from truearm_wire.messages import COUNTER


class Link:
    def __init__(self, board):
        self._board = board
        self._own = bytearray(FRAME_MAX + 8)
        self._end = 0  # of the payload under construction
        self._buf = self._own  # current output: _buf[_at:_stop]
        self._at = 0
        self._stop = 0
        self._time_at = 0  # position of the time of sending, until it is written
        self._held_back = False
        self._seq = bytearray(4)
        self.sent = 0
        self.short_writes = 0

    def free(self):
        """Return whether a frame can be begun."""
        return self._at == self._stop

    def pump(self):
        """Give the link as much of the current frame as it takes. Returns whether it took anything."""
        left = self._stop - self._at
        if left == 0:
            return False
        if self._time_at:
            taken = self._board.send_stamped(self._buf, self._at, self._stop - TAIL, self._time_at)
            if taken:
                self._time_at = 0
        else:
            taken = self._board.send(self._buf, self._at, left)
        self._at += taken
        if taken == left:
            self.sent = (self.sent + 1) & COUNTER
            self._held_back = False
        elif not self._held_back:  # counted once per frame, however many pieces it needs
            self._held_back = True
            self.short_writes = (self.short_writes + 1) & COUNTER
        return taken > 0

    def put_seq(self, buf, at):
        """Write the next sequence number as a u32 into a payload; return the offset after it."""
        buf[at] = 0x1A
        copy(buf, at + 1, self._seq, 0, 4)
        add(self._seq, 0, 4, 1)
        return at + 5

    def begin(self, frame_type, elements):
        """Begin a frame with `elements` elements after its type and sequence number."""
        end = put_head(self._own, HEAD, 4, elements + 2)
        end = put_head(self._own, end, 0, frame_type)
        self._end = self.put_seq(self._own, end)

    def put_int(self, n):
        self._end = put_int(self._own, self._end, n)

    def put_u32(self, counter):
        """Write four bytes, big endian."""
        self._own[self._end] = 0x1A
        copy(self._own, self._end + 1, counter, 0, 4)
        self._end += 5

    def put_u64(self, counter):
        """Write eight bytes, big endian."""
        self._own[self._end] = 0x1B
        copy(self._own, self._end + 1, counter, 0, 8)
        self._end += 9

    def put_time(self):
        """Reserve eight bytes for the time at which the frame is sent; it must be closed with send_stamped()."""
        self._own[self._end] = 0x1B
        self._end += 9

    def put_bytes(self, data, major=2):
        """Write a byte string, or text with major 3."""
        self._end = put_head(self._own, self._end, major, len(data))
        copy(self._own, self._end, data, 0, len(data))
        self._end += len(data)

    def send_stamped(self):
        """Send the frame that was begun, whose last element is the time of sending."""
        self._buf = self._own
        self._at = 0
        self._stop = self._end + TAIL
        self._time_at = self._end - 8
        self.pump()

    def send(self):
        """Send the frame that was begun."""
        self.send_built(self._own, 0, self._end)

    def send_built(self, buf, at, end):
        """Send the payload buf[at + HEAD:end], framed in place."""
        self._buf = buf
        self._at = at
        self._stop = close(buf, at, end)
        self.pump()
