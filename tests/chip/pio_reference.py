"""An assembler and an interpreter for PIO programs, from chapter 3 of the RP2040 datasheet alone, one cycle at a time.

They are there to check others: the programs of the firmware's drivers, MicroPython's assembler and the emulator of hil_sim/chip. So they
share nothing with those, and are as plain as can be.

`Assembler` takes the place of MicroPython's `rp2`: what its `asm_pio` returns is a `Program`. `Block` is one PIO block. A cycle is:
every state machine that has a tick executes (sections 3.2, 3.4); pins and flags that they wrote show from the next cycle on. Inputs
pass two flip-flops (3.5.6.3): at the edge that begins a cycle the first takes the pad as it was just before, the second takes the first.
"""

import types
from collections import deque
from dataclasses import dataclass, field

WORD = 0xFFFFFFFF
SOURCES = {"pins": 0, "x": 1, "y": 2, "null": 3, "pindirs": 4, "pc": 5, "status": 5, "isr": 6, "osr": 7, "exec": 8}
CONDITIONS = {"not_x": 1, "x_dec": 2, "not_y": 3, "y_dec": 4, "x_not_y": 5, "pin": 6, "not_osre": 7}
NOBLOCK, IF = "noblock", "if"


@dataclass
class Program:
    words: list[int]
    wrap_target: int
    wrap: int
    side_count: int  # bits of side set, with the enable bit
    side_optional: bool
    in_right: bool = True
    out_right: bool = True
    autopush: bool = False
    autopull: bool = False
    push_at: int = 32
    pull_at: int = 32
    join: int = 0


class _Instruction:
    """An instruction that `.side()` and `[delay]` complete."""

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
    """The names that a program uses; run once, labels are resolved at the end."""

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
    """In place of MicroPython's module rp2."""

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


def rotate_right(value, n):
    return (value >> n | value << (32 - n)) & WORD


def ones(n):
    return (1 << n) - 1


@dataclass
class Machine:
    """A state machine: registers, and the fields of its configuration registers (3.7)."""

    block: "Block"
    index: int
    program: Program | None = None
    offset: int = 0
    in_base: int = 0
    out_base: int = 0
    out_count: int = 0
    set_base: int = 0
    set_count: int = 0
    side_base: int = 0
    side_pindirs: bool = False
    jmp_pin: int = 0
    status_rx: bool = False
    status_n: int = 0
    divider: int = 256  # 1/256 cycles
    x: int = 0
    y: int = 0
    pc: int = 0
    isr: int = 0
    osr: int = 0
    isr_count: int = 0
    osr_count: int = 32
    tx: deque = field(default_factory=deque)
    rx: deque = field(default_factory=deque)
    enabled: bool = False
    delay: int = 0
    fraction: int = 0
    until_tick: int = 0
    forced: int | None = None
    waits_for_flag: int | None = None

    # -- ticks (3.5.5) and the way of the program (3.4, 3.5.2)

    def cycle(self):
        if not self.enabled:
            return
        if self.until_tick:
            self.until_tick -= 1
            return
        self.fraction += self.divider & 255
        self.until_tick = (self.divider >> 8) - 1 + (self.fraction >> 8)
        self.fraction &= 255
        if self.delay:
            self.delay -= 1
            return
        word, was_forced, self.forced = self.forced, self.forced is not None, None
        word = word if was_forced else self.block.memory[self.pc]
        delay = self._side(word)
        target = self.execute(word)
        if target == "stall":
            self.forced = word if was_forced else None
            return
        if target is not None:
            self.pc = target
        elif not was_forced:
            wrapped = self.pc == self.offset + self.program.wrap
            self.pc = self.offset + self.program.wrap_target if wrapped else (self.pc + 1) & 31
        self.delay = 0 if self.forced is not None else delay

    def _side(self, word):
        """Side set (3.5.1). Returns the delay."""
        bits, count = word >> 8 & 31, self.program.side_count
        delay, value = bits & ones(5 - count), bits >> (5 - count)
        if self.program.side_optional:
            count -= 1
            if not value >> count:
                return delay
            value &= ones(count)
        self.block.write(self.side_pindirs, value, self.side_base, count)
        return delay

    def execute(self, word):
        kind, field_, low = word >> 13, word >> 5 & 7, word & 31
        if kind not in (3, 4, 5):
            self._refill()
        if kind == 0:
            return low if self._condition(field_) else None
        if kind == 1:
            return self._wait(word >> 7 & 1, field_ & 3, low)
        if kind == 2:
            return self._in(self._source(field_), low or 32)
        if kind == 3:
            return self._out(field_, low or 32)
        if kind == 4:
            return (self._pull if word & 128 else self._push)(word & 64, word & 32)
        if kind == 5:
            value = self._source(word & 7)
            value = (value, ~value & WORD, int(f"{value:032b}"[::-1], 2), value)[word >> 3 & 3]
            return self._mov(field_, value)
        if kind == 6:
            return self._irq(word & 64, word & 32, low)
        if field_ in (0, 4):
            self.block.write(field_ == 4, low, self.set_base, self.set_count)
        elif field_ == 1:
            self.x = low
        elif field_ == 2:
            self.y = low
        return None

    # -- instructions, in the order of 3.4

    def _condition(self, number):
        if number == 2:
            self.x, met = (self.x - 1) & WORD, self.x != 0
            return met
        if number == 4:
            self.y, met = (self.y - 1) & WORD, self.y != 0
            return met
        pin = self.block.inputs >> self.jmp_pin & 1
        others = {0: True, 1: self.x == 0, 3: self.y == 0, 5: self.x != self.y, 6: pin == 1}
        return others.get(number, self.osr_count < self.program.pull_at)

    def _wait(self, polarity, kind, index):
        if kind == 2:
            flag = self._flag(index)
            if (self.block.flags >> flag & 1) != polarity:
                return "stall"
            if polarity:
                self.block.clearing |= 1 << flag
            return None
        pin = (index + self.in_base) % 32 if kind == 1 else index
        return None if (self.block.inputs >> pin & 1) == polarity else "stall"

    def _flag(self, index):
        return index & 4 | (index + self.index) & 3 if index & 16 else index & 7

    def _source(self, number):
        status = len(self.rx if self.status_rx else self.tx) < self.status_n
        return {
            0: rotate_right(self.block.inputs, self.in_base), 1: self.x, 2: self.y, 5: WORD if status else 0,
            6: self.isr, 7: self.osr,
        }.get(number, 0)  # fmt: skip

    def _in(self, value, bits):
        pushes = self.program.autopush and self.isr_count + bits >= self.program.push_at
        if pushes and len(self.rx) >= self.rx_depth:
            return "stall"
        value &= ones(bits)
        if self.program.in_right:
            self.isr = (self.isr >> bits | value << (32 - bits)) & WORD
        else:
            self.isr = (self.isr << bits | value) & WORD
        self.isr_count = min(32, self.isr_count + bits)
        if pushes:
            self._to_rx()
        return None

    def _out(self, destination, bits):
        if self.program.autopull and self.osr_count >= self.program.pull_at:
            if self.tx:
                self._from_tx()
            return "stall"
        if self.program.out_right:
            value, self.osr = self.osr & ones(bits), self.osr >> bits
        else:
            value, self.osr = self.osr >> (32 - bits), self.osr << bits & WORD
        self.osr_count = min(32, self.osr_count + bits)
        target = None
        if destination in (0, 4):
            self.block.write(destination == 4, value, self.out_base, self.out_count)
        elif destination == 1:
            self.x = value
        elif destination == 2:
            self.y = value
        elif destination == 5:
            target = value & 31
        elif destination == 6:
            self.isr, self.isr_count = value, bits
        elif destination == 7:
            self.forced = value & 0xFFFF
        if self.osr_count >= self.program.pull_at:
            self._refill()
        return target

    def _push(self, if_full, block):
        if if_full and self.isr_count < self.program.push_at:
            return None
        if len(self.rx) < self.rx_depth:
            self._to_rx()
            return None
        if block:
            return "stall"
        self.isr = self.isr_count = 0
        return None

    def _pull(self, if_empty, block):
        if if_empty and self.osr_count < self.program.pull_at:
            return None
        if self.program.autopull and self.osr_count == 0:
            return None
        if self.tx:
            self._from_tx()
            return None
        if block:
            return "stall"
        self.osr, self.osr_count = self.x, 0
        return None

    def _mov(self, destination, value):
        if destination == 0:
            self.block.write(False, value, self.out_base, self.out_count)
        elif destination == 1:
            self.x = value
        elif destination == 2:
            self.y = value
        elif destination == 4:
            self.forced = value & 0xFFFF
        elif destination == 5:
            return value & 31
        elif destination == 6:
            self.isr, self.isr_count = value, 0
        elif destination == 7:
            self.osr, self.osr_count = value, 0
        return None

    def _irq(self, clear, wait, index):
        flag = self._flag(index)
        if clear:
            self.block.clearing |= 1 << flag
            return None
        if wait and self.waits_for_flag is not None:
            if self.block.flags >> self.waits_for_flag & 1:
                return "stall"
            self.waits_for_flag = None
            return None
        self.block.setting |= 1 << flag
        if not wait:
            return None
        self.waits_for_flag = flag
        return "stall"

    # -- FIFOs (3.5.4)

    @property
    def rx_depth(self):
        return (4, 0, 8)[self.program.join]

    @property
    def tx_depth(self):
        return (4, 8, 0)[self.program.join]

    def _refill(self):
        if self.program.autopull and self.osr_count >= self.program.pull_at and self.tx:
            self._from_tx()

    def _to_rx(self):
        self.rx.append(self.isr)
        self.block.pushed.append((self.block.now, self.index, self.isr))
        self.isr = self.isr_count = 0

    def _from_tx(self):
        self.osr, self.osr_count = self.tx.popleft(), 0


class Block:
    """One PIO block. `pads` are the levels on the pins (the caller's); `out`, `directions` what the block drives."""

    def __init__(self):
        self.memory = [0] * 32
        self.machines = [Machine(self, i) for i in range(4)]
        self.pads = self.first = self.inputs = 0
        self.out = self.directions = 0
        self.flags = self.setting = self.clearing = 0
        self.now = 0
        self.pushed = []  # (cycle, machine, word)
        self._next = [0, 0]

    def load(self, machine, program, offset, **config):
        self.memory[offset : offset + len(program.words)] = [
            word + offset if word >> 13 == 0 else word for word in program.words
        ]
        found = self.machines[machine]
        found.program, found.offset, found.pc = program, offset, offset
        for name, value in config.items():
            setattr(found, name, value)
        return found

    def write(self, directions, value, base, count):
        for i in range(count):
            bit = 1 << (base + i) % 32
            self._next[directions] = self._next[directions] & ~bit | (bit if value >> i & 1 else 0)

    def cycle(self):
        self.inputs, self.first = self.first, self.pads
        self.out, self.directions = self._next
        for machine in self.machines:
            machine.cycle()
        self.flags = self.flags & ~self.clearing | self.setting
        self.setting = self.clearing = 0
        self.now += 1
