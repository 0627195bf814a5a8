"""Pictures of experiments: one style for a method, axes that say what they hide, marks of what is missing."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from made_up import PAPER, experiment, made_up
from matplotlib.colors import to_rgba

from mosa.experiments import analyses
from mosa.experiments.analyses import ANALYSES
from mosa.experiments.collecting import Cell, records_of, table
from mosa.experiments.report.drawing import FURTHER, STYLES, draw, style_of
from mosa.experiments.report.writing import write_results
from mosa.experiments.specification import (
    Figure,
    jobs_of,
    load_experiment,
    narrowed,
)


@pytest.mark.parametrize("plot", ["lines", "map", None])
def test_every_kind_of_picture_is_drawn_also_where_cells_are_missing(tmp_path, plot):
    found, jobs = made_up(tmp_path / "runs")
    write_results(replace(found, plot=plot), jobs, tmp_path / "results", "")
    assert (tmp_path / "results" / "made.png").is_file() == (plot is not None)


def test_a_map_has_the_figure_s_decimals_and_bars_say_where_they_begin(tmp_path):
    found, jobs = made_up(tmp_path / "runs")
    tables = {figure.label: table(found, records_of(jobs), figure) for figure in found.figures}
    for place, figure in zip(
        draw(replace(found, plot="map"), tables).axes, found.figures
    ):  # colour bars come after the maps
        written = [text.get_text() for text in place.texts]
        assert written and {len(text.partition(".")[2]) for text in written} == {figure.decimals}
    close = {"method": {"a": Cell(98.0, None, 1)}, "other": {"a": Cell(99.0, None, 1)}}
    ssim = Figure("SSIM x100", "test/ssim_crop", 100, 1, "most")
    place = draw(replace(found, figures=(ssim,), plot="bars"), {"SSIM x100": close}).axes[0]
    low, high = place.get_ylim()
    assert 99 < high <= 100 and 90 < low < 98 and place.get_ylabel() == f"axis cut at {low:.4g}"
    alone = {"method": {"a": Cell(1.0, None, 1)}, "other": {"a": Cell(30.0, None, 1)}}
    place = draw(
        replace(found, figures=(replace(ssim, figure="test/psnr_crop"),), plot="bars"),
        {"SSIM x100": alone},
    ).axes[0]
    assert place.get_ylim()[0] == 0 and place.get_ylabel() == ""


def test_a_method_of_which_nothing_was_run_takes_no_bar_and_no_colour(tmp_path):
    """It had the first one's colour in the legend."""
    found, _ = made_up(tmp_path / "runs")
    figures = (
        Figure("a", "test/rms_m", 1, 1, "least"),
        Figure("b", "test/psnr_crop", 1, 1, "least"),
    )
    rows = {
        "first": {"x": Cell(1.0, None, 1)},
        "not run": {"x": None},
        "last": {"x": Cell(2.0, None, 1)},
    }
    partly = rows | {"last": {"x": None}}
    canvas = draw(replace(found, figures=figures, plot="bars"), {"a": partly, "b": rows})
    assert [text.get_text() for text in canvas.legends[0].get_texts()] == ["first", "last"]
    colours = [patch.get_facecolor() for place in canvas.axes for patch in place.patches]
    assert len(colours) == 3 and colours[0] == colours[1] != colours[2]


def test_every_method_of_the_paper_has_a_colour_of_its_own_in_every_picture():
    """Whatever else is in the picture, and whether it is bars or lines."""
    names = [
        option.name for option in load_experiment(PAPER, "table_generalisation").axes["method"]
    ]
    assert set(names) <= set(STYLES) and len({STYLES[name]["color"] for name in names}) == len(
        names
    )
    assert not {style["color"] for style in STYLES.values()} & set(FURTHER)
    value = Cell(2.0, None, 1)
    few = {"box": {"a": value}, "ours": {"a": value}}
    many = {"NeuMA": {"a": value}, "box": {"a": None}, "ours": {"a": value}, "other": {"a": value}}
    figures = (Figure("rms", "test/rms_m", 1, 1, "least"),)
    first, second = (
        draw(experiment(figures=figures), {"rms": rows}).axes[0] for rows in (few, many)
    )
    colours = [
        {bar.get_label(): bar[0].get_facecolor() for bar in place.containers}
        for place in (first, second)
    ]
    assert colours[0]["ours"] == colours[1]["ours"] and len(set(colours[1].values())) == 3
    lines = draw(experiment(figures=figures, plot="lines", rows="scene", columns="method"),
                 {"rms": {scene: {name: value for name in ("prior", "box", "ours")} for scene in "ab"}}).axes[0]  # fmt: skip
    (ours,) = [line for line in lines.lines if line.get_label() == "ours"]
    assert to_rgba(ours.get_color()) == colours[0]["ours"]


def test_what_diverged_what_failed_and_what_was_not_run_differ():
    cells = {"x": Cell(1.0, None, 1), "y": Cell(math.inf, None, 1), "z": Cell(math.nan, None, 0)}
    rows = {
        "ours": cells,
        "box": {"x": None, "y": Cell(2.0, None, 1), "z": None},
        "prior": dict.fromkeys("xyz"),
    }
    canvas = draw(experiment(figures=(Figure("rms", "test/rms_m", 1, 1, "least"),)), {"rms": rows})
    (place,) = canvas.axes
    assert [(round(float(line.get_xdata()[0])), line.get_marker()) for line in place.lines] == [
        (1, "x"),
        (2, "+"),
    ]
    assert {line.get_color() for line in place.lines} == {style_of("ours")["color"]}
    assert [text.get_text() for text in canvas.legends[0].get_texts()] == [
        "ours",
        "box",
        "diverged",
        "failed",
    ]
    assert canvas.get_supxlabel() == "gap: not run; not run: prior"
    assert (
        draw(experiment(figures=(Figure("rms", "test/rms_m"),)), {"rms": {"ours": {"x": None}}})
        is None
    )


@pytest.mark.parametrize("plot", ["bars", "lines"])
def test_every_axis_without_its_zero_says_so_and_errors_over_a_decade_are_logarithmic(plot):
    figures = (Figure("PSNR", "test/psnr_crop", best="most"), Figure("wide", "test/rms_m", 1, 1, "least"),
               Figure("rms", "test/rms_m", 1, 1, "least"))  # fmt: skip
    sizes = {"PSNR": (25.0, 30.0, 31.0), "wide": (1.5, 20.0, 40.0), "rms": (5.0, 6.0, 7.0)}
    tables = {label: {"prior": {"a": Cell(x, None, 1), "b": Cell(y, 0.5, 2)}, "ours": {"a": Cell(z, None, 1), "b": None}}
              for label, (x, y, z) in sizes.items()}  # fmt: skip
    made = experiment(figures=figures, plot=plot)
    if plot == "lines":
        made = replace(made, rows="scene", columns="method")
        tables = {
            label: {column: {row: rows[row][column] for row in rows} for column in "ab"}
            for label, rows in tables.items()
        }
    psnr, wide, rms = draw(made, tables).axes
    assert (
        20 < psnr.get_ylim()[0] < 25
        and psnr.get_ylabel() == f"axis cut at {psnr.get_ylim()[0]:.4g}"
    )
    assert wide.get_yscale() == "log" and wide.get_ylabel() == "logarithmic axis from 1"
    assert rms.get_yscale() == "linear" and rms.get_ylim()[0] == 0 and rms.get_ylabel() == ""
    if plot == "lines":  # a bar of an error for the one point with two seeds
        assert [len(bar[2][0].get_segments()) for bar in psnr.containers] == [1]
    most = (Figure("SSIM", "test/ssim_crop", 100, 1, "most"),)
    high = {row: dict.fromkeys(cells, Cell(99.9, None, 1)) for row, cells in tables["rms"].items()}
    (ssim,) = draw(replace(made, figures=most), {"SSIM": high}).axes
    assert ssim.get_ylim()[1] <= 100 and ssim.get_ylabel().startswith("axis cut at 9")


def test_a_map_is_lighter_where_it_is_better():
    made = load_experiment(PAPER, "figure_alpha")
    names = [option.name for option in made.axes["alpha"]]
    cells = {
        row: {column: Cell(i + j, None, 1) for j, column in enumerate(names)}
        for i, row in enumerate(names)
    }
    cells["0.30"] |= {"0.30": None, "0.20": Cell(-math.inf, None, 1)}
    canvas = draw(made, {figure.label: cells for figure in made.figures})
    psnr, rms = canvas.axes[:2]
    for place in (psnr, rms):
        words = [text.get_text() for text in place.texts]
        assert "diverged" in words and len(words) == 24
    shades = [
        place.images[0].cmap(place.images[0].norm(np.array([0.0, 7.0]))).sum(1)
        for place in (psnr, rms)
    ]
    assert shades[0][0] < shades[0][1] and shades[1][0] > shades[1][1]
    assert canvas.get_supxlabel() == "white: not run"


def test_many_bars_have_a_row_for_each_figure_and_no_picture_is_wider_than_a_page():
    for bars_of_a_part, down in ((2, 2), (9, 4)):
        rows = {
            name: {column: Cell(1.0, None, 1) for column in "abcdefghi"[:bars_of_a_part]}
            for name in ("ours", "NeuMA")
        }
        figures = tuple(Figure(label, "test/rms_m", best="least") for label in "pqrs")
        canvas = draw(experiment(figures=figures), dict.fromkeys("pqrs", rows))
        canvas.draw_without_rendering()
        assert len({round(place.get_position().y0, 3) for place in canvas.axes}) == down
        assert canvas.get_figwidth() == 9


def test_the_factors_of_all_bodies_have_one_range_about_one(tmp_path, monkeypatch):
    found = narrowed(experiment(), {"method": ["ours"]}, (0,))
    records = records_of(jobs_of(found, tmp_path))
    rest = torch.rand(20, 3) - 0.5
    factors = {"a": 1 + 0.1 * rest[:, 0], "b": 1 + 0.6 * rest[:, 1]}
    model = SimpleNamespace(heterogeneity=None)
    twins = [SimpleNamespace(body=SimpleNamespace(rest=rest, heterogeneity=True, model=lambda: model, factor=lambda _, f=f: f),
                             record=SimpleNamespace(settings={"scene": {"name": "other"}}))
             for f in (factors[record.place["scene"].name] for record in records)]  # fmt: skip
    monkeypatch.setattr(analyses, "loaded", lambda _: zip(records, twins))
    drawn = []
    monkeypatch.setattr(analyses, "save", lambda canvas, path: drawn.append(canvas) or path)
    ANALYSES["heterogeneity"](found, records, tmp_path / "law")
    parts = [place.collections[0] for place in drawn[0].axes[:2]]
    (limits,) = {part.get_clim() for part in parts}
    assert sum(limits) == pytest.approx(2.0) and limits[1] >= float(factors["b"].max())
    assert (
        drawn[0]
        .axes[-1]
        .get_xlabel()
        .startswith("factor on the stiffness, 1: as the calibrated law")
    )
    assert [drawn[0].axes[i].get_ylabel() for i in (0, 2)] == ["learned", "truth"]


@pytest.mark.parametrize("columns", [["a"], ["a", "b"]])
def test_the_rounding_of_an_isotropic_law_is_no_curve_and_a_response_of_zero_is_seen(
    tmp_path, monkeypatch, columns
):
    """Beside one with a ratio of 1.6 and alone; the ripples of each part have a range of their own, E in kPa begins at 0."""
    found = narrowed(experiment(), {"method": ["ours"], "scene": columns}, (0,))
    records = records_of(jobs_of(found, tmp_path))
    laws = {
        "a": lambda n: 1e5 * (1 + 1e-4 * n[:, 0]),
        "b": lambda n: 1e5 * (1 + 0.6 * n[:, 0] ** 2),
    }
    twins = [
        SimpleNamespace(
            body=record.place["scene"].name,
            record=SimpleNamespace(settings={"scene": {"name": "rabbit"}}),
        )
        for record in records
    ]
    monkeypatch.setattr(analyses, "loaded", lambda _: zip(records, twins))
    monkeypatch.setattr(
        analyses, "redistribution", lambda body, n: (0.1 if body == "b" else 0.0) * n[:, 0].abs()
    )
    monkeypatch.setattr(analyses, "learned_modulus", lambda body, n: laws[body](n))
    monkeypatch.setattr(analyses, "true_modulus", lambda *_: None)
    drawn = []
    monkeypatch.setattr(analyses, "save", lambda canvas, path: drawn.append(canvas) or path)
    ANALYSES["directions"](found, records, tmp_path / "law")
    places = np.array(drawn[0].axes).reshape(3, len(columns))
    low, high = places[1, 0].get_ylim()
    curve = places[1, 0].lines[0].get_ydata()
    assert low <= 0.95 and 1.05 <= high < 1.2 and curve.max() - curve.min() < 0.01 * (high - low)
    assert places[1, 0].get_ylabel() == f"E over its mean (axis cut at {low:.4g})"
    low, high = places[0, 0].get_ylim()
    assert low < -0.02 * high  # w of 0 lies beside the axis, not on it
    for place in places[2]:
        assert (
            place.get_ylim()[0] == 0
            and place.lines[0].get_ydata().mean() > 90
            and place.get_ylabel() == "E [kPa]"
        )
    assert all(place.lines[0].get_color() == style_of("ours")["color"] for place in places.ravel())
