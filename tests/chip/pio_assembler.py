"""An assembler for PIO programs, from chapter 3 of the RP2040 datasheet alone, for programs written for MicroPython's.

`Assembler` replaces MicroPython's `rp2`: its `asm_pio` returns a `Program`, which pio_reference.py executes.
"""

import types
from dataclasses import dataclass

SOURCES = {"pins": 0, "x": 1, "y": 2, "null": 3, "pindirs": 4, "pc": 5, "status": 5, "isr": 6, "osr": 7, "exec": 8}
CONDITIONS = {"not_x": 1, "x_dec": 2, "not_y": 3, "y_dec": 4, "x_not_y": 5, "pin": 6, "not_osre": 7}
NOBLOCK, IF = "noblock", "if"


@dataclass
class Program:
    words: list[int]
    wrap_target: int
    wrap: int
    side_count: int  # side set bits, including the enable bit
    side_optional: bool
    in_right: bool = True
    out_right: bool = True
    autopush: bool = False
    autopull: bool = False
    push_at: int = 32
    pull_at: int = 32
    join: int = 0


class _Instruction:
    """An instruction, completed by `.side()` and `[delay]`."""

    def __init__(self, word):
        self.word = word
        self.value = None
        self.delay = 0

    def side(self, value):
        self.value = value
        return self

    def __getitem__(self, delay):
        self.delay = delay
        return self


class _Emitter:
    """The names that a program uses; it runs once, and labels are resolved at the end."""

    def __init__(self):
        self.instructions = []
        self.labels = {}
        self.targets = {}
        self.wraps = [0, None]

    def add(self, word):
        self.instructions.append(_Instruction(word))
        return self.instructions[-1]

    def jmp(self, condition, label=None):
        number = 0 if label is None else condition
        self.targets[len(self.instructions)] = condition if label is None else label
        return self.add(number << 5)

    def wait(self, polarity, kind, index):
        source = 0 if kind == 0 else 1 if kind == CONDITIONS["pin"] else 2  # `irq` is the instruction's name, too
        return self.add(1 << 13 | polarity << 7 | source << 5 | index)

    def push(self, *flags):
        return self.add(4 << 13 | (IF in flags) << 6 | (NOBLOCK not in flags) << 5)

    def pull(self, *flags):
        return self.add(4 << 13 | 1 << 7 | (IF in flags) << 6 | (NOBLOCK not in flags) << 5)

    def irq(self, *args):
        flags, index = args[:-1], args[-1]
        return self.add(6 << 13 | ("clear" in flags) << 6 | ("block" in flags) << 5 | index)

    def mov(self, destination, source):
        return self.add(5 << 13 | (4 if destination == 8 else destination) << 5 | source)

    def out(self, destination, bits):
        return self.add(3 << 13 | (7 if destination == 8 else destination) << 5 | bits & 31)

    def names(self):
        return {
            **SOURCES,
            **CONDITIONS,
            "gpio": 0,
            "irq": self.irq,
            "invert": lambda source: source | 1 << 3,
            "reverse": lambda source: source | 2 << 3,
            "rel": lambda index: index | 16,
            "noblock": NOBLOCK,
            "block": "block",
            "iffull": IF,
            "ifempty": IF,
            "clear": "clear",
            "label": lambda name: self.labels.__setitem__(name, len(self.instructions)),
            "wrap_target": lambda: self.wraps.__setitem__(0, len(self.instructions)),
            "wrap": lambda: self.wraps.__setitem__(1, len(self.instructions) - 1),
            "nop": lambda: self.mov(2, 2),
            "jmp": self.jmp,
            "wait": self.wait,
            "in_": lambda source, bits: self.add(2 << 13 | source << 5 | bits & 31),
            "out": self.out,
            "push": self.push,
            "pull": self.pull,
            "mov": self.mov,
            "set": lambda destination, value: self.add(7 << 13 | destination << 5 | value),
        }


class Assembler:
    """A replacement for MicroPython's module rp2."""

    class PIO:
        IN_LOW, IN_HIGH, OUT_LOW, OUT_HIGH = range(4)
        SHIFT_LEFT, SHIFT_RIGHT = range(2)
        JOIN_NONE, JOIN_TX, JOIN_RX = range(3)

    @staticmethod
    def asm_pio(
        *, sideset_init=None, in_shiftdir=0, out_shiftdir=0, autopush=False, autopull=False, push_thresh=32,
        pull_thresh=32, fifo_join=0, **_
    ):  # fmt: skip
        pins = 0 if sideset_init is None else 1 if isinstance(sideset_init, int) else len(sideset_init)

        def assemble(function):
            emitter = _Emitter()
            types.FunctionType(function.__code__, emitter.names(), function.__name__, None, function.__closure__)()
            found = emitter.instructions
            optional = pins > 0 and any(i.value is None for i in found)
            count = pins + optional
            words = []
            for at, instruction in enumerate(found):
                word = instruction.word | (emitter.labels[emitter.targets[at]] if at in emitter.targets else 0)
                side = 0 if instruction.value is None else instruction.value | (optional << pins)
                assert instruction.delay < 1 << (5 - count)
                words.append(word | (side << (5 - count) | instruction.delay) << 8)
            wrap = len(words) - 1 if emitter.wraps[1] is None else emitter.wraps[1]
            return Program(
                words, emitter.wraps[0], wrap, count, optional, bool(in_shiftdir), bool(out_shiftdir), autopush,
                autopull, push_thresh, pull_thresh, fifo_join,
            )  # fmt: skip

        return assemble
