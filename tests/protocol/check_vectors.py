"""Re-encode every golden frame and reject every corrupted one; runs on CPython and on MicroPython.

micropython check_vectors.py FOLDER      prints one line per failure, then "N golden, M corrupted"; exit 1 on failure
"""

import json
import sys

from truearm_wire import cbor, fast, frame, messages


def restore(value):
    if isinstance(value, dict):
        data = bytes([int(value["hex"][i : i + 2], 16) for i in range(0, len(value["hex"]), 2)])
        return cbor.Tag(value["tag"], data) if "tag" in value else data
    if isinstance(value, list):
        return [restore(v) for v in value]
    return value


def payloads(data):
    splitter = frame.Splitter()
    found = []
    at = 0
    while at < len(data):
        at = splitter.push(data, at, len(data))
        if splitter.end:
            found.append(bytes(splitter.buf[1 : splitter.end]))
    return found


def read(path):
    with open(path, "rb") as f:
        return f.read()


def check(folder):
    failures = []
    with open(folder + "/frames.json") as f:
        good = json.load(f)
    for n in range(2 * messages.PAGE_BYTES):  # split into pages during encoding
        whole = ["x" * n, {"a": [1, b"\0" * 40]}]
        if messages.pages_of(whole) != messages.pages(cbor.encode(whole)):
            failures.append("pages of a text of %d letters" % n)
    for entry in good:
        data = read(folder + "/" + entry["file"])
        values = restore(entry["values"])
        if frame.frame(messages.encode_payload(values)) != data:
            failures.append(entry["name"] + ": encoded otherwise")
        if payloads(data) != [messages.encode_payload(values)]:
            failures.append(entry["name"] + ": the splitter finds something else")
        if frame.unframe(data[1:-1]) is None or messages.decode_payload(frame.unframe(data[1:-1])) != values:
            failures.append(entry["name"] + ": decoded otherwise")
    with open(folder + "/corrupted.json") as f:
        bad = json.load(f)
    for entry in bad:
        data = read(folder + "/" + entry["file"])
        if payloads(data) or any(frame.unframe(run) is not None for run in data.split(b"\0") if run):
            failures.append(entry["name"] + ": accepted")
    # counters and stamps, SPEC §2 and §3
    for start, n in ((0, 1), (255, 1), (2**32 - 1, 1), (2**40 - 5, 4000000), (2**33 - 1, 2**30 - 1), (2**64 - 1, 13)):
        buf = bytearray(start.to_bytes(8, "big"))
        fast.add(buf, 0, 8, n)
        if buf != ((start + n) % 2**64).to_bytes(8, "big"):
            failures.append("add %d to %d" % (n, start))
    for now, stamp in (
        (2**32 + 5, 2**32 + 5),
        (2**32 + 5, 2**32 - 1),
        (2**33, 2**33 - 2**31),
        (77, 3),
        (2**56, 2**56 - 1),
    ):
        out = bytearray(9)
        fast.extend(now.to_bytes(8, "big"), (stamp % 2**32).to_bytes(4, "big"), 0, out, 1)
        if out[1:] != stamp.to_bytes(8, "big"):
            failures.append("extend %d at %d" % (stamp, now))
    return failures, len(good), len(bad)


if __name__ == "__main__":
    failures, good, bad = check(sys.argv[1])
    for line in failures:
        print("FAILED " + line)
    print("%d golden, %d corrupted, %d failed on %s" % (good, bad, len(failures), sys.implementation.name))
    sys.exit(1 if failures else 0)
