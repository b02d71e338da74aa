"""Covering arrays: cases of a test in which each pair of values of two factors occurs, in place of all combinations."""

import itertools


def covering(*factors):
    """Return rows with one value of each factor, so that every pair of values of two factors is in some row.

    Greedy, in the order of the factors: of three factors of a ≥ b ≥ c values it needs about a b rows.
    """
    sizes = [range(len(factor)) for factor in factors]
    left = {
        ((i, a), (j, b)): None
        for i, j in itertools.combinations(range(len(factors)), 2)
        for a, b in itertools.product(sizes[i], sizes[j])
    }
    rows = []
    while left:
        row = dict(next(iter(left)))
        for i, size in enumerate(sizes):
            if i not in row:
                others = [*row.items()]
                row[i] = max(size, key=lambda a, i=i, others=others: sum(_pair((i, a), one) in left for one in others))
        for one, other in itertools.combinations(row.items(), 2):
            left.pop(_pair(one, other), None)
        rows.append(tuple(factors[i][row[i]] for i in range(len(factors))))
    return rows


def _pair(one, other):
    return (one, other) if one < other else (other, one)
