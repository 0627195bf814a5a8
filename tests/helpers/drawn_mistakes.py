"""Strategies of what a user or a stranger may write in the place of a value, and where it may stand."""

import copy
import os

from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st

EXAMPLES = int(os.environ.get("MOSA_EXAMPLES", "0"))
"""Thousands by MOSA_EXAMPLES=2000 python -m pytest tests/test_fuzz.py; without it each test has a few that are always the same."""


def examples(few: int):
    """Settings of a test that has `few` examples in the suite."""
    return settings(max_examples=EXAMPLES or few, deadline=None, derandomize=not EXAMPLES, database=None,
                    phases=[Phase.generate],
                    suppress_health_check=list(HealthCheck))  # fmt: skip


numbers = st.one_of(
    st.sampled_from([0, -1, 1, 2, 1.5, -0.0, 1e-9, 1e-300, 1e300, 1e39, -1e9, 10**9, 10**30, float("nan"), float("inf"),
                     -float("inf")]),
    st.floats(-2, 2), st.integers(-5, 50),
)  # fmt: skip
texts = st.sampled_from(
    [
        "",
        "abc",
        "None",
        "1.0",
        "nan",
        "../../x",
        "/dev/null",
        "a\0b",
        "x" * 3000,
        "${oc.env:HOME}",
        "???",
        "separate",
        "sphere",
        "stress",
        "train",
        "os.system",
    ]
)
plain = st.one_of(st.none(), st.booleans(), numbers, texts)
values = st.recursive(plain, lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(texts, inner, max_size=3)),
                      max_leaves=6)  # fmt: skip


def places(tree, above=()):
    """Paths to every value of nested containers, containers included."""
    found = [above] if above else []
    inner = (
        tree.items()
        if isinstance(tree, dict)
        else enumerate(tree)
        if isinstance(tree, list)
        else ()
    )
    for key, value in inner:
        found += places(value, (*above, key))
    return found


def changed(tree, path, value, delete=False):
    """A copy with another value at a path, or without it."""
    result = copy.deepcopy(tree)
    part = result
    for key in path[:-1]:
        part = part[key]
    if delete:
        del part[path[-1]]
    else:
        part[path[-1]] = value
    return result
