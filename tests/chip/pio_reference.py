"""An interpreter for PIO programs, from chapter 3 of the RP2040 datasheet alone, one cycle at a time.

It checks other implementations: the programs of the firmware's drivers and the emulator of hil_sim/chip. It therefore
shares no code with those, and is as simple as possible. MicroPython assembles the programs.

`Block` is one PIO block. In a cycle, every state machine that has a tick executes (sections 3.2, 3.4); the pins and
flags that it writes change in the next cycle. Inputs pass two flip-flops (3.5.6.3): at the edge that begins a cycle the
first takes the pad's previous level, the second takes the first.
"""

from collections import deque
from dataclasses import dataclass, field

WORD = 0xFFFFFFFF


def rotate_right(value, n):
    return (value >> n | value << (32 - n)) & WORD


def ones(n):
    return (1 << n) - 1


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

    @classmethod
    def assembled(cls, words, control, shifts, side_pins):
        """Return a program as MicroPython's ``asm_pio`` has it, by the fields of SM_EXECCTRL and SM_SHIFTCTRL (3.7)."""
        optional, flags = bool(control >> 30 & 1), [bool(shifts >> bit & 1) for bit in (18, 19, 16, 17)]
        thresholds = [shifts >> bit & 31 or 32 for bit in (20, 25)]
        return cls(
            words,
            control >> 7 & 31,
            control >> 12 & 31,
            side_pins + optional,
            optional,
            *flags,
            *thresholds,
            shifts >> 30,
        )


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

    # -- ticks (3.5.5) and program flow (3.4, 3.5.2)

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
    """One PIO block. `pads` are the levels on the pins (from the caller); `out`, `directions` what the block drives."""

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
