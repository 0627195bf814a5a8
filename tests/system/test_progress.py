"""Progress is a bar where it can be redrawn, and lines where it cannot."""

import io

import pytest

from mosa.system import progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


def shown(stream, steps=200, **options):
    bar = progress.tqdm(total=steps, desc="fit prior", file=stream, **options)
    for k in range(steps):
        bar.set_postfix({"loss": f"{1 / (k + 1):.5f}"}, refresh=False)
        bar.update()
    bar.close()
    bar.close()
    return stream.getvalue()


@pytest.mark.parametrize("leave", [True, False])
def test_a_file_gets_a_line_at_the_start_and_one_at_the_end(leave):
    lines = shown(io.StringIO(), leave=leave, dynamic_ncols=True, mininterval=0.0).split("\n")
    assert len(lines) == 3 and lines[2] == ""
    assert lines[0].startswith("fit prior:   0% 0/200 [")
    assert (
        lines[1].startswith("fit prior: 100% 200/200 [")
        and "loss=0.005" in lines[1]
        and "\r" not in lines[1]
    )


def test_a_file_gets_a_line_now_and_then(monkeypatch):
    monkeypatch.setattr(progress, "LINE_SECONDS", 0.0)
    lines = shown(io.StringIO(), steps=5).splitlines()
    counts = [line.split()[3] for line in lines]
    assert list(dict.fromkeys(counts)) == ["0/5", "1/5", "2/5", "3/5", "4/5", "5/5"]


def test_a_terminal_gets_a_bar():
    text = shown(Terminal())
    assert text.count("\r") > 1 and "|" in text and text.count("\n") == 1


def test_an_iterable_and_a_bar_that_is_switched_off(capsys):
    assert list(progress.tqdm(range(3), "poses")) == [0, 1, 2]
    assert capsys.readouterr().err.splitlines()[-1].startswith("poses: 100% 3/3 [")
    for _ in progress.tqdm(range(3), disable=True):
        pass
    assert capsys.readouterr().err == ""
