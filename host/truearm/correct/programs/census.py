"""The census of uses: which literals may change, and which moves need numbers of their own.

A literal may change only if every use of every name on the way to it is the target of a move that is itself corrected.
Any other use, whatever it is, keeps the numbers: an unknown construct costs a move, never correctness. A move that
loses its literal gets numbers of its own in place of its argument, or is refused if its argument cannot be replaced.
Refusing a move makes its uses other uses, so the census goes on until nothing changes; each datum is visited once.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from truearm.correct.programs.program import Datum, Goal, Move, Place, Program
from truearm.findings import Reason
from truearm.model.transforms import apart, inverted
from truearm.types import Floats

SAME = 1e-6  # m, rad between corrections of one literal: below a controller's resolution


@dataclass(eq=False)
class Census:
    """The moves that change their literals, and those that get numbers of their own.

    ``joints_change``: literals of joint readings are corrected too. ``replaced``: moves whose argument is replaced.
    ``poses``: the new pose (4, 4) of each literal, and the goal for which it was computed.
    """

    program: Program
    joints_change: bool
    replaced: set[Move] = field(default_factory=set)
    poses: dict[Place, tuple[Goal, Floats]] = field(default_factory=dict)
    _released: list[Move] = field(default_factory=list)
    _movers: dict[Datum, list[Move]] = field(default_factory=lambda: defaultdict(list))

    def __post_init__(self) -> None:
        """Count the uses of all data, and refuse the moves whose literals something else reads."""
        targets = {place for move in self.program.moves for _, place in self.uses(move)} | self.program.harmless
        for move in self.program.moves:
            for datum, _ in self.uses(move):
                self._movers[datum].append(move)
        for datum in list(self._movers):
            other_uses = datum.uses - targets
            if other_uses:
                self._keep(datum, min(other_uses))

    def refuse(self, move: Move, reason: Reason) -> None:
        """Refuse a move. It goes on reading the old numbers, so other moves by the same names lose their literals."""
        if move.reason is None:
            move.reason = reason
            self.replaced.discard(move)
            self._released.append(move)
            for datum, place in self.uses(move):
                self._keep(datum, place)

    def _keep(self, datum: Datum, use: Place) -> None:
        """Keep the numbers on the way through a datum, because of a use of it: give its moves numbers of their own.

        What holds the numbers of a datum is needed as it is, so the names to which it leads are kept too.
        """
        waiting = [(datum, use)]
        while waiting:
            datum, use = waiting.pop()
            for move in self._movers.pop(datum, ()):
                for goal in move.goals:
                    names = [name for name, _ in goal.target.uses]
                    if datum in names:
                        waiting += goal.target.uses[names.index(datum) + 1 :]
                if not self._shares(move):
                    continue
                self._released.append(move)
                if replaceable(move):
                    self.replaced.add(move)
                else:
                    move.reason = Reason("shared-use", {"name": datum.name, "where": self.program.where(use)})
                    waiting += self.uses(move)

    def settle(self, goal_poses: dict[Goal, Floats]) -> None:
        """Choose the new pose of each literal.

        ``goal_poses``: the pose (4, 4) in its frame of each goal that is a pose.

        Where moves want different numbers of one literal, those that differ from the first get numbers of their own.
        """
        users: dict[Place, list[tuple[Move, Goal]]] = defaultdict(list)
        for move in self.program.moves:
            for goal in move.goals if move.reason is None else ():
                if goal in goal_poses:
                    users[goal.target.literal.place].append((move, goal))
        unsettled = dict.fromkeys(users)
        while unsettled:
            place, _ = unsettled.popitem()
            for move in self._settle_literal(place, users[place], goal_poses):
                self.refuse(move, Reason("other-numbers", {"where": self.program.where(place)}))
            for move in self._released:
                unsettled.update((goal.target.literal.place, None) for goal in move.goals if goal in goal_poses)
            self._released.clear()

    def _settle_literal(
        self, place: Place, users: Iterable[tuple[Move, Goal]], goal_poses: dict[Goal, Floats]
    ) -> list[Move]:
        """Choose the pose of a literal for its first user without an offset; return the moves to refuse."""
        sharing = [(move, goal) for move, goal in users if self._shares(move)]
        self.poses.pop(place, None)
        if not sharing:
            return []
        if len(sharing) == 1 and sharing[0][1].target.left is sharing[0][1].target.right:
            self.poses[place] = sharing[0][1], goal_poses[sharing[0][1]]
            return []
        solved = np.array([inverted(g.target.left) @ goal_poses[g] @ inverted(g.target.right) for _, g in sharing])
        plain = (row for row, (_, g) in enumerate(sharing) if g.target.left is g.target.right)
        chosen = next(plain, 0)
        self.poses[place] = sharing[chosen][1], solved[chosen]
        differs = np.abs(apart(np.broadcast_to(solved[chosen], solved.shape), solved)).max(axis=1) > SAME
        refused = []
        for (move, _), is_other in zip(sharing, differs, strict=True):
            if is_other and self._shares(move):
                if replaceable(move):
                    self.replaced.add(move)
                    self._released.append(move)
                else:
                    refused.append(move)
        return refused

    def uses(self, move: Move) -> list[tuple[Datum, Place]]:
        """Return the uses of names by which a move reaches numbers that change."""
        goals = (goal for goal in move.goals if self.joints_change or not goal.is_joints)
        return [use for goal in goals for use in goal.target.uses]

    def _shares(self, move: Move) -> bool:
        return move.reason is None and move not in self.replaced


def replaceable(move: Move) -> bool:
    """Return whether numbers can be written in place of all targets of a move."""
    return bool(move.goals) and all(goal.argument is not None for goal in move.goals)
