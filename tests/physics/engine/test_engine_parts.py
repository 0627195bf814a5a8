"""The parts that segments and chains share: graphs, room, clock, what is known of tensors."""

import ast
import warnings
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import mosa.physics
from mosa.physics.engine.capture import ATTEMPTS, MAX_GRAPHS, Graphs
from mosa.physics.engine.solver import SegmentSolver
from mosa.physics.launching import same_memory
from mosa.physics.time.adaptive_steps import StepControl
from mosa.physics.time.clock import Adaptive, Clock, Moment


class Counted:
    """Runs and captures are told apart by what they leave in `said`; the first `broken` captures fail."""

    def __init__(self, broken: int = 0) -> None:
        self.said, self.broken = [], broken

    def run(self, body) -> None:
        body()
        self.said.append("run")

    def capture(self, body):
        if self.broken:
            self.broken -= 1
            raise RuntimeError("no")
        body()
        self.said.append("captured")
        return lambda: self.said.append("replayed")


def play(graphs: Graphs, name="pass") -> str:
    if graphs.waits(name):
        graphs.capture(name, lambda: None)
    graphs.play(name, lambda: None)
    return graphs.strategy.said[-1]


def test_a_pass_is_run_then_captured_then_replayed():
    graphs = Graphs(Counted(), "")
    assert not graphs.waits("pass")
    assert [play(graphs) for _ in range(3)] == ["run", "replayed", "replayed"]
    assert graphs.strategy.said == ["run", "captured", "replayed", "replayed"]
    graphs.drop()
    assert len(graphs) == 0 and play(graphs) == "replayed"  # captured at once
    graphs.forget()
    assert play(graphs) == "run" and play(graphs, "another") == "run"


def test_captures_that_fail_are_tried_a_few_times_in_a_row():
    graphs = Graphs(Counted(broken=ATTEMPTS - 1), "passes are slow")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert [play(graphs) for _ in range(ATTEMPTS + 1)] == ["run"] * ATTEMPTS + ["replayed"]
    graphs = Graphs(Counted(broken=ATTEMPTS), "passes are slow")
    with pytest.warns(UserWarning, match="passes are slow: no"):
        assert [play(graphs) for _ in range(ATTEMPTS + 3)] == ["run"] * (ATTEMPTS + 3)
    assert Graphs(Counted(), "", attempts=0).attempts == 0 and not graphs.waits("pass")


@pytest.mark.parametrize("most", [MAX_GRAPHS, 5])
def test_there_are_never_many_more_graphs_than_allowed(most):
    graphs = Graphs(Counted(), "", most=most)
    for dt in range(3 * most):
        play(graphs, dt), play(graphs, dt)
        assert len(graphs) <= most + 1 and set(graphs.waiting()) <= {dt}
    assert len(graphs) > 1


@pytest.mark.parametrize("stays", [False, True])
def test_room_for_states_is_spent(stays):
    solver = SegmentSolver.__new__(SegmentSolver)
    solver.room, tape = 0.0, [torch.zeros(10), torch.zeros(30)]
    work = SimpleNamespace(kept_bytes=160, stays=stays, key=(1,), tape=lambda: tape)
    pool = {(1,): [work]}
    assert solver.keep(work, pool) == [] and pool == {(1,): [work]}
    solver.room = 200.0
    assert solver.keep(work, pool) is (work if stays else tape) and solver.room == 40
    assert pool == {(1,): [] if stays else [work]} and solver.keep(work, pool) == []
    if stays:
        solver.take_back(work, pool)
        assert solver.room == 200 and pool == {(1,): [work]}


def test_velocities_lie_between_the_positions_of_steps_that_vary():
    fixed = Clock(0.1, 5)
    assert fixed.frame(Moment(None, 5, 1), None) == (5, 5, 0.1 / 5, None) and not fixed.varies
    counts = [4, 10, 5]
    clock, moment, found = Clock(0.1, 5, lambda frame, *_: counts[frame - 1]), Moment(None), []
    for _ in counts:
        frame = clock.frame(moment, None)
        found.append((frame.first, *frame.steps))
        moment = Moment(None, moment.substeps + frame.count, moment.frames + 1, frame.dt)
    expected = [(0, 0.0125, 0.025), (4, 0.0175, 0.01), (14, 0.015, 0.02)]
    assert found == [pytest.approx(e) for e in expected]
    late = Clock(0.1, 5, lambda *_: 4).frame(Moment(None, lag=None), None)
    assert late.steps.kick == late.steps.dt == late.dt == 0.1 / 4
    assert Adaptive(StepControl()).lag is None


def test_memory_is_the_same_whoever_views_it():
    a = torch.arange(6.0)
    leaf = torch.nn.Parameter(a)
    assert same_memory([a, leaf], [leaf.detach(), a])
    assert (
        not same_memory([a], [a.clone()])
        and not same_memory([a], [a[:3]])
        and not same_memory([a], [a, a])
    )


def test_a_part_of_the_physics_knows_only_those_below_it():
    """launching, sums, rotations < constitutive, grid < contact < world < engine with its adapters and its time."""
    order = {"launching": 0, "memory_sums": 0, "exact_sums": 0, "rotations": 0, "constitutive": 1, "grid": 1, "contact": 2,
             "world": 3, "engine": 4}  # fmt: skip
    whole = {"adapters": "engine", "time": "engine"}
    root, upwards, seen = Path(mosa.physics.__file__).parent, [], set()
    for path in root.rglob("*.py"):
        own = path.relative_to(root).with_suffix("").parts[0]
        own = whole.get(own, own)
        for node in ast.walk(ast.parse(path.read_text())):
            if (
                own in order
                and isinstance(node, ast.ImportFrom)
                and node.module
                and node.module.startswith("mosa.physics.")
            ):
                other = node.module.split(".")[2]
                other = whole.get(other, other)
                seen.add((own, other))
                upwards += (
                    [(path.name, other)] if own != other and order[other] >= order[own] else []
                )
    assert (
        upwards == []
        and {("engine", "grid"), ("contact", "grid"), ("constitutive", "launching")} <= seen
    )


def test_no_result_is_kept_under_an_id_or_an_address():
    """Those of something that is gone are given to something else."""
    found = []
    for path in sorted(Path(mosa.physics.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call):
                name = (
                    node.func.id
                    if isinstance(node.func, ast.Name)
                    else getattr(node.func, "attr", None)
                )
                found += [(path.name, name)] if name in ("id", "data_ptr") else []
    assert found == [("launching.py", "data_ptr")]  # of alignment
