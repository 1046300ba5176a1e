"""Cases of a test in which every two values of every two parameters meet, far fewer than the full product."""

from collections.abc import Iterable
from itertools import combinations, product

import pytest


def pairwise(**axes: Iterable) -> pytest.MarkDecorator:
    """Parametrise a test by cases, chosen greedily until every pair of values of two axes is in one."""
    values = [[*axis] for axis in axes.values()]
    pairs = {case: {*combinations(enumerate(case), 2)} for case in product(*(range(len(axis)) for axis in values))}
    missing, cases = set().union(*pairs.values()), []
    while missing:
        cases.append(max(pairs, key=lambda case: len(pairs[case] & missing)))
        missing -= pairs[cases[-1]]
    chosen = [tuple(axis[k] for axis, k in zip(values, case, strict=True)) for case in cases]
    return pytest.mark.parametrize(", ".join(axes), chosen)
