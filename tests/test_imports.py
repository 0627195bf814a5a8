"""No module of mosa imports another that imports it, not even inside of a function, by name or for its types alone: a reader can go
through them in order."""

import ast
import re
from pathlib import Path

import mosa

ROOT = Path(mosa.__file__).parent
NAMED = re.compile(r"(mosa(?:\.\w+)+):\w+")
"""module:function of a registry, which imports it when it is asked for."""


def imported(source: str, modules: set[str]) -> set[str]:
    """Of `modules`, those that a file imports when it is imported, when its functions run, or for its types."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {
                full if (full := f"{node.module}.{alias.name}") in modules else node.module
                for alias in node.names
            }
        elif (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and (named := NAMED.fullmatch(node.value))
        ):
            found.add(named[1])
    return found & modules


def imports(below: str) -> dict[str, set[str]]:
    """Of every module of mosa in `below`, the modules of mosa it imports."""
    files = {
        ".".join(p.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__"): p
        for p in ROOT.rglob("*.py")
    }
    return {
        name: imported(path.read_text(), set(files)) - {name}
        for name, path in files.items()
        if name.startswith(below)
    }


def circles(graph: dict[str, set[str]]) -> list[str]:
    """Modules that can be reached from themselves."""

    def reached(start: str) -> set[str]:
        seen, waiting = set(), list(graph[start])
        while waiting:
            at = waiting.pop()
            if at not in seen:
                seen.add(at)
                waiting += graph.get(at, ())
        return seen

    return sorted(name for name in graph if name in reached(name))


def test_a_circle_is_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == ["a", "b", "c"]
    assert circles({"a": {"b"}, "b": set()}) == []


def test_every_way_of_importing_is_seen():
    modules = {"mosa.a", "mosa.b", "mosa.c", "mosa.d", "mosa.e"}
    source = """
from typing import TYPE_CHECKING
import mosa.a
FORMATS = {"x": "mosa.b:load"}
if TYPE_CHECKING:
    from mosa.c import C
def f():
    from mosa.d import g
    from mosa import e
"""
    assert imported(source, modules) == modules


def test_there_is_no_import_circle():
    graph = imports("mosa")
    assert (
        "mosa.training.lit_mosa" in graph["mosa.training.workflow"]
        and "mosa.data.formats.pacnerf" in graph["mosa.data.scene"]
    )
    assert len(graph) > 150
    assert circles(graph) == []


def test_the_physics_knows_nothing_of_learning():
    everything = imports("mosa.physics.")
    # ply, npz: which files of points are safe to read; settings: models of what a user may set; threads, limits: of the
    # machine; cuda_graphs: of captures; exact_sums: of kernels
    allowed = (
        "mosa.physics",
        "mosa.errors",
        "mosa.types",
        "mosa.system.ply",
        "mosa.system.npz",
        "mosa.settings",
        "mosa.system.threads",
        "mosa.system.limits",
        "mosa.system.cuda_graphs",
        "mosa.physics.exact_sums",
    )
    outside = {
        name: {f for f in found if not f.startswith(allowed)} for name, found in everything.items()
    }
    assert {name: found for name, found in outside.items() if found} == {}
