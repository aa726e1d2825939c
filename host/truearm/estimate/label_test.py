"""A single test for wrong labels: names exchanged, renamed in a cycle, or wrong in some groups of rows.

A group is rows measured with the same items mounted: a run of dwells during recording, or the rows of one mounting in a
finished table. Let S_g(l) be the sum of squares of group g's residuals under the labels l, for a robot that the labels
did not influence: the nominal one, or one fitted to other groups. With the given names, S = Σ S_g(named). Two sorts of
alternative labellings are compared with that:

1. **Permutations.** The names of one column, or of two, are permuted everywhere: all permutations of up to MOST_PERMUTED
   names; for more names, the exchanges of two and the cycles.
2. **Groups.** Each group takes the labels that it fits best, if they fit it better by CLEARLY.

**Chance.** If the names are correct, another labelling can seem to fit better only because the robot is inaccurate.
Residuals of a group are correlated, so a group counts as one degree of freedom of unknown variance. The probability
that S' is smaller than S by a factor r is P(F(G, G) < r) for G groups, multiplied by the number of labellings tried
(Bonferroni).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from itertools import chain, combinations, permutations, product
from typing import NamedTuple

from scipy import special

from truearm.estimate.ties import first_within, largest_first

MOST_PERMUTED = 4
CLEARLY = 9.0  # of the sum of squares: a third of the RMS

Labels = tuple[str, ...]  # of a group, one per column
Squares = Sequence[Mapping[Labels, float]]  # of each group, by possible labels


class Labelling(NamedTuple):
    """Labels of all groups, the sum of squares under them, and the log probability that correct names appear this wrong."""

    labels: tuple[Labels, ...]
    square: float
    log_chance: float


def labellings(squares: Squares, named: Sequence[Labels], scope: Sequence[Hashable]) -> list[Labelling]:
    """Return labellings other than the ``named`` one, the best fit first; none that fit no better.

    ``scope`` of each group: only groups of one scope share names (of one rig and one kind of observation).
    """
    as_named = sum(of[labels] for of, labels in zip(squares, named, strict=True))
    other = dict.fromkeys([*permuted(squares, named, scope), _each_best(squares, named)])
    other.pop(tuple(named), None)
    tried = len(other) + sum(len(of) for of in squares)
    found = []
    for labels in other:
        square = sum(of[mine] for of, mine in zip(squares, labels, strict=True))
        if square < as_named:
            chance = min(log_chance(square / as_named, len(squares)) + math.log(tried), 0.0)
            found.append(Labelling(labels, square, chance))
    return [found[i] for i in largest_first([-one.square for one in found])]


def log_chance(ratio: float, freedom: float) -> float:
    """Return the log probability that two mean squares with equal degrees of freedom have a ratio of at most ``ratio``."""
    share, half = ratio / (1.0 + ratio), max(freedom, 1.0) / 2.0
    chance = special.betainc(half, half, share)
    if chance > 1e-280:
        return math.log(chance)
    # First term of the incomplete beta function; the next is smaller by the share.
    return half * math.log(max(share, 1e-300)) - math.log(half) - float(special.betaln(half, half))


def renamings(names: Sequence[str]) -> Iterator[dict[str, str]]:
    """Return the permutations that change any of some names: all for few names, otherwise exchanges of two and cycles."""
    if len(names) <= MOST_PERMUTED:
        for order in permutations(names):
            if list(order) != list(names):
                yield dict(zip(names, order, strict=True))
        return
    for a, b in combinations(names, 2):
        yield {name: {a: b, b: a}.get(name, name) for name in names}
    for shift in range(1, len(names)):
        yield dict(zip(names, [*names[shift:], *names[:shift]], strict=True))


def permuted(
    could: Sequence[Collection[Labels]], named: Sequence[Labels], scope: Sequence[Hashable]
) -> Iterator[tuple[Labels, ...]]:
    """Return the labels of all groups, with the names of one column, or of two, exchanged throughout a scope.

    ``could``: the labels that each group can have.
    """
    for one in dict.fromkeys(scope):
        mine = [g for g, other in enumerate(scope) if other == one]
        columns = range(len(named[mine[0]]))
        names = [list(dict.fromkeys(labels[column] for g in mine for labels in could[g])) for column in columns]
        single = [[{column: new} for new in renamings(names[column])] for column in columns]
        both = ({**a, **b} for i, j in combinations(columns, 2) for a, b in product(single[i], single[j]))
        for new in (*chain.from_iterable(single), *both):
            changed = list(named)
            for g in mine:
                changed[g] = tuple(new.get(k, {}).get(name, name) for k, name in enumerate(named[g]))
            labels = tuple(changed)
            if labels != tuple(named) and all(one in of for one, of in zip(labels, could, strict=True)):
                yield labels


def _each_best(squares: Squares, named: Sequence[Labels]) -> tuple[Labels, ...]:
    best = []
    for of, labels in zip(squares, named, strict=True):
        other = list(of)[first_within([-square for square in of.values()])]
        best.append(other if CLEARLY * of[other] < of[labels] else labels)
    return tuple(best)
