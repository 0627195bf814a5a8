"""Captures and launches of several threads: a capture is alone, launches are not, and nobody waits for ever."""

import threading

import pytest
import warp as wp

from mosa.physics.launching import Turns, launch

LONG = 30.0
"""Seconds after which a wait has failed: nothing here takes time."""


class Inside:
    """A thread that enters a turn, says so, and leaves when it is told."""

    def __init__(self, turn):
        self.entered, self.leave, self.left = (
            threading.Event(),
            threading.Event(),
            threading.Event(),
        )
        self.begun = threading.Event()
        self.thread = threading.Thread(target=self.run, args=(turn,), daemon=True)
        self.thread.start()
        assert self.begun.wait(LONG)

    def run(self, turn):
        self.begun.set()
        with turn():
            self.entered.set()
            self.leave.wait(LONG)
        self.left.set()

    def end(self):
        self.leave.set()
        assert self.left.wait(LONG)
        self.thread.join(LONG)


def turn_of(turns, kind):
    return turns.capturing() if kind == "capturing" else turns


def test_launches_run_beside_each_other():
    turns = Turns()
    first, second = Inside(lambda: turns), Inside(lambda: turns)
    assert first.entered.wait(LONG) and second.entered.wait(LONG)  # both inside at once
    first.end()
    second.end()


@pytest.mark.parametrize("waiting", ["launching", "capturing"])
def test_a_capture_is_alone(waiting):
    """Another's launch or capture gets in only after it has ended: not before it is told to leave, and then surely."""
    turns = Turns()
    capture = Inside(turns.capturing)
    assert capture.entered.wait(LONG)
    other = Inside(lambda: turn_of(turns, waiting))
    with (
        turns._changed
    ):  # nobody is counted as inside, and while the lock is held nobody can be about to be
        assert turns._launching == 0 and turns._capturing == capture.thread.ident
    assert not other.entered.is_set()
    capture.end()
    assert other.entered.wait(LONG)
    other.end()


def test_a_capture_waits_for_launches_that_have_begun():
    turns = Turns()
    launches = [Inside(lambda: turns) for _ in range(2)]
    assert all(each.entered.wait(LONG) for each in launches)
    capture = Inside(turns.capturing)
    launches[0].end()
    with turns._changed:
        assert turns._launching == 1 and turns._capturing is None
    assert not capture.entered.is_set()
    launches[1].end()
    assert capture.entered.wait(LONG)
    capture.end()


def test_a_capture_launches_itself():
    turns = Turns()
    with turns.capturing(), turns, turns:
        assert turns._launching == 0  # it does not wait for itself
    after = Inside(lambda: turns)
    assert after.entered.wait(LONG)
    after.end()


@pytest.mark.parametrize("turn", ["launching", "capturing"])
def test_a_failure_inside_lets_the_others_in(turn):
    turns = Turns()
    with pytest.raises(RuntimeError, match="burst"), turn_of(turns, turn):
        raise RuntimeError("burst")
    for name in ("capturing", "launching"):
        other = Inside(lambda name=name: turn_of(turns, name))
        assert other.entered.wait(LONG)
        other.end()


def test_many_threads_never_launch_into_a_capture():
    """600 turns of six threads, every fifth a capture: inside one nobody else is, by a count that all of them keep."""
    turns, lock, inside, wrong, captured = Turns(), threading.Lock(), [], [], []

    def work(number):
        for i in range(100):
            capturing = (i + number) % 5 == 0
            with turns.capturing() if capturing else turns:
                with lock:
                    inside.append((number, capturing))
                    if capturing:
                        captured.append(number)
                    if len(inside) > 1 and any(alone for _, alone in inside):
                        wrong.append(list(inside))
                with lock:
                    inside.remove((number, capturing))

    threads = [threading.Thread(target=work, args=(number,), daemon=True) for number in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LONG)
    assert not any(thread.is_alive() for thread in threads)
    assert not wrong and len(captured) == 120 and not inside


def test_of_threads_that_come_to_a_kernel_at_once_the_first_compiles_it(tmp_path, monkeypatch):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(wp.config, "optimization_level", 0)
    monkeypatch.setattr(wp.config, "use_precompiled_headers", False)
    made, compiled, together = wp.Module._compile, [], threading.Barrier(2)
    monkeypatch.setattr(wp.Module, "_compile", lambda *a, **k: compiled.append(made(*a, **k)))

    @wp.kernel(module="unique", enable_backward=False)
    def count(a: wp.array(dtype=int)):
        wp.atomic_add(a, 0, 1)

    numbers = wp.zeros(1, dtype=int, device="cpu")

    def run():
        together.wait(LONG)
        launch(count, 5, [numbers], wp.get_device("cpu"))

    threads = [threading.Thread(target=run) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LONG)
    assert compiled == [True] and numbers.numpy() == [10]
