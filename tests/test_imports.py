"""No module of the physics imports another that imports it, not even inside of a function: a reader can go through them in
order."""

import ast
from pathlib import Path

import mosa

ROOT = Path(mosa.__file__).parent


def imports(below: str) -> dict[str, set[str]]:
    """Of every module of mosa, the modules of mosa it imports anywhere in its file (not for types alone), those in `below`
    alone."""
    files = {".".join(p.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__"): p for p in ROOT.rglob("*.py")}
    graph = {}
    for name, path in files.items():
        found: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                found |= {full if (full := f"{node.module}.{alias.name}") in files else node.module for alias in node.names}
        if name.startswith(below):
            graph[name] = {f for f in found & set(files) if f.startswith(below)} - {name}
    return graph


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


def test_the_physics_has_no_import_circle():
    graph = imports("mosa.physics.")
    assert "mosa.physics.constitutive.laws" in graph["mosa.physics.constitutive.elasticity"] and len(graph) > 30
    assert circles(graph) == []


def test_the_physics_knows_nothing_of_learning():
    everything = imports("mosa.")
    # ply: which files of points are safe to read; schema: kinds of single values; threads, limits: of the machine
    allowed = ("mosa.physics", "mosa.errors", "mosa.types", "mosa.rotations", "mosa.ply", "mosa.schema", "mosa.threads",
               "mosa.limits")
    outside = {name: {f for f in found if not f.startswith(allowed)}
               for name, found in everything.items() if name.startswith("mosa.physics.")}
    assert {name: found for name, found in outside.items() if found} == {}
