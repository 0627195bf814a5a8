"""The harness of the paper's tables: files that compose, jobs made once, tables of made-up figures, and one experiment for real."""

import errno
import json
import math
import os
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml
from hydra import compose, initialize_config_dir
from matplotlib.colors import to_rgba
from omegaconf import OmegaConf

from mosa import whole_files
from mosa.commands.experiment import arguments, run, shown
from mosa.config import rehearse
from mosa.errors import ConfigError, DataError
from mosa.experiments import analyses, commits, running, specimens
from mosa.experiments.analyses import ANALYSES
from mosa.experiments.collecting import Cell, best_of, records_of, table
from mosa.experiments.drawing import FURTHER, MARKED, STYLES, draw, style_of
from mosa.experiments.page import older, read_tables, verdict
from mosa.experiments.printed import printed_table
from mosa.experiments.specification import (
    CROWD,
    MINUTES,
    Claim,
    Experiment,
    Figure,
    Option,
    claim_of,
    estimate,
    experiment_names,
    folder_name,
    jobs_of,
    load_experiment,
    minutes_taken,
    narrowed,
    pairs,
)
from mosa.experiments.writing import made_by, write_results
from mosa.keys import EVALUATION, TRAINING
from mosa.schema import check

CONF = Path(__file__).parents[2] / "conf"
PAPER = CONF / "experiment" / "paper"
NAMES = experiment_names(PAPER)


def experiment(**changes) -> Experiment:
    """Three rows, of which two read the same runs, by two scenes and two seeds."""
    axes = {
        "method": (Option("prior", ("adapter=operator",), "prior/"), Option("box", ("adapter=direct",), cost=2.0),
                   Option("ours", ("adapter=operator",))),
        "scene": (Option("a", ("scene=a",)), Option("b", ("scene=b",))),
    }  # fmt: skip
    figures = (Figure("PSNR", "test/psnr_crop", best="most"), Figure("rms [mm]", "test/rms_m", 1e3, 1, "least"))
    made = Experiment("made", "Made up", axes, "method", "scene", figures, seeds=(0, 1), minutes={"cpu": 3.0, "gpu": 1.0})
    return replace(made, **changes)


def write_metrics(job, rms=0.010, prior=0.020, **more) -> None:
    job.folder.mkdir(parents=True, exist_ok=True)
    figures = {"test/rms_m": rms, "prior/test/rms_m": prior, "test/psnr_crop": 30.0 - 100 * rms, "prior/test/psnr_crop": 25.0,
               "time/fit_s": 60.0, "time/data_s": 60.0, "time/device": "a machine", **more}  # fmt: skip
    (job.folder / "metrics.json").write_text(json.dumps(figures))


# ------------------------------------------------------------------------------------------------ files
def options_once(name: str, quick: bool) -> set[tuple[str, ...]]:
    """Overrides of the first job, and of one for every other option of every axis."""
    found = load_experiment(PAPER, name, quick)
    first = {axis: options[0] for axis, options in found.axes.items()}
    places = [first | {axis: option} for axis, options in found.axes.items() for option in options]
    return {(*found.common, *(each for option in place.values() for each in option.overrides)) for place in places}


def test_every_option_of_every_experiment_composes_and_passes_the_checks_before_a_run():
    assert len(NAMES) >= 10
    wanted = set().union(*(options_once(name, quick) for name in NAMES for quick in (False, True)))
    with initialize_config_dir(str(CONF), version_base="1.3"):
        for overrides in sorted(wanted):
            config = OmegaConf.to_container(compose("train", overrides=list(overrides)), resolve=False)
            check(config, TRAINING, EVALUATION)
            rehearse(config)


def test_every_entry_of_the_paper_that_is_named_exists():
    for name in NAMES:
        found = load_experiment(PAPER, name)
        assert found.analysis is None or found.analysis in ANALYSES
        if found.printed is not None:
            assert "The paper prints" in printed_table(found.printed)


@pytest.mark.parametrize("quick", [False, True], ids=["whole", "quick"])
def test_the_rows_that_a_note_names_are_in_its_table(quick):
    named = 0
    for name in NAMES:
        made = load_experiment(PAPER, name, quick)
        rows = {option.name for option in made.axes[made.rows]}
        for row in re.findall(r"\(row ([^)]*)\)", made.note):
            named += 1
            assert row in rows, name
    assert named  # of table_grounding


def test_the_paper_s_figures_are_those_of_its_tables():
    text = printed_table("generalisation")
    row = next(line for line in text.splitlines() if line.startswith("| MoSA"))
    values = [[float(v) for v in cell.split("/")] for cell in row.split("|")[2:-1]]
    assert values[-1] == [31.35, 92.3]  # printed beside them
    assert np.mean([psnr for psnr, _ in values[:-1]]) == pytest.approx(31.52, abs=0.01)  # the paper's own mean is not theirs


@pytest.mark.parametrize(("text", "message"), [
    ("title: a\nrows: x\ncolumns: y\nfigures: []\n", "axes: expected this key"),
    ("title: a\naxes: {x: {o: []}}\nrows: z\ncolumns: x\nfigures: []\n", "rows: expected one of x, found 'z'"),
    ("title: a\naxes: {x: nothing}\nrows: x\ncolumns: x\nfigures: []\n", r"axes\.x: expected one of .*, found 'nothing'"),
    ("title: a\naxes: {x: {of: objects, only: [q]}}\nrows: x\ncolumns: x\nfigures: []\n", r"axes\.x: expected some of .*'q'"),
    ("title: a\naxes: {x: {o: {cots: 1}}}\nrows: x\ncolumns: x\nfigures: []\n", r"axes\.x\.o: expected fields of name"),
    ("title: a\nfoo: 1\n", "foo: unknown key"),
    ("[", "no readable YAML"),
])  # fmt: skip
def test_a_mistake_in_a_file_names_its_key(tmp_path, text, message):
    (tmp_path / "_shared.yaml").write_text("objects: {a: []}\n")
    (tmp_path / "wrong.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_experiment(tmp_path, "wrong")


def test_mistakes_on_the_command_line_are_named(tmp_path, capsys):
    for words, message in (
        (["nothing"], "experiment: expected one of .* or all, found 'nothing'"),
        (["table_time", "--jobs", "0"], "--jobs"),
        (["table_time", "--seeds", "a"], "--seeds: expected whole numbers"),
        (["table_time", "--only", "shoe=1"], "--only: expected AXIS=NAME"),
        (["table_time", "--only", "scene=boat"], "--only scene: expected some of rabbit, found 'boat'"),
    ):
        with pytest.raises(ConfigError, match=message):
            run(arguments([*words, "--dry-run", "--runs", str(tmp_path)]))


# ------------------------------------------------------------------------------------------------ jobs
def test_cells_that_need_the_same_run_share_it(tmp_path):
    jobs = jobs_of(experiment(), tmp_path)
    assert len(jobs) == 2 * 2 * 2 and len({job.folder for job in jobs}) == 8  # operator and direct, scenes, seeds
    shared = [job for job in jobs if len(job.places) == 2]
    assert len(shared) == 4 and {p["method"].name for p in shared[0].places} == {"prior", "ours"}
    again = jobs_of(experiment(common=("x=1",)), tmp_path, ["y=2"])
    assert all("x=1" in job.overrides and "y=2" in job.overrides and job.overrides[-1].startswith("seed=") for job in again)
    assert not {job.folder for job in again} & {job.folder for job in jobs}


def test_a_folder_s_name_does_not_depend_on_the_order_of_different_keys():
    assert folder_name(["a=1", "b=2", "seed=0"]) == folder_name(["b=2", "seed=0", "a=1"])
    assert folder_name(["a=1", "a=2"]) != folder_name(["a=2", "a=1"])  # the last one holds
    assert len(folder_name(["scene.path=" + "x" * 500])) < 100


def test_an_experiment_is_narrowed_to_options_and_seeds(tmp_path):
    found = narrowed(experiment(), pairs(["method=ours", "scene=b"], [experiment()]), (3,))
    jobs = jobs_of(found, tmp_path)
    assert [job.overrides for job in jobs] == [("adapter=operator", "scene=b", "seed=3")]


def test_what_is_said_of_one_experiment_holds_for_that_one(tmp_path):
    both = [experiment(), experiment(name="other")]
    only = pairs(["method=box", "other:method=ours", "scene=a"], both)
    assert [[job.overrides[0] for job in jobs_of(narrowed(each, only, (0,)), tmp_path)] for each in both] == [
        ["adapter=direct"], ["adapter=operator"]]  # fmt: skip
    with pytest.raises(ConfigError, match=r"--only: expected AXIS=NAME,NAME with an axis of method, scene, or EXPERIMENT:AXIS"):
        pairs(["nothing:method=ours"], both)


def test_the_estimate_learns_from_the_jobs_that_are_complete(tmp_path):
    jobs = jobs_of(experiment(), tmp_path)
    assert estimate(jobs, [None], 1)[-1] == "8 jobs, 8 to run, about 36.0 minutes with 1 side by side"  # 4 of 3, 4 of 6
    assert "about 6.0 minutes with 2" in estimate(jobs, [0, 1], 1)[-1]
    write_metrics(jobs[0], **{"time/fit_s": 300.0})  # six minutes in place of three
    assert estimate(jobs, [None], 1)[-1] == "8 jobs, 7 to run, about 66.0 minutes with 1 side by side"


def test_the_estimate_knows_the_longest_job_and_what_shares_a_gpu(tmp_path):
    jobs = jobs_of(experiment(), tmp_path)
    assert "about 6.0 minutes with 8" in estimate(jobs, [None], 8)[-1]  # none is shorter for the others
    assert f"about {2 * (1 + 3 * CROWD):.1f} minutes with 8" in estimate(jobs, [0, 1], 4)[-1]
    assert f"about {2 * (1 + 3 * CROWD):.1f} minutes with 40" in estimate(jobs, [0, 1], 20)[-1]  # there are four on each
    own = experiment(axes={**experiment().axes, "method": (Option("box", ("adapter=direct",), cost={"gpu": 5.0}),)})
    one = jobs_of(narrowed(own, {"scene": ["a"]}, (0,)), tmp_path / "own")
    assert "about 3.0 minutes" in estimate(one, [None], 1)[-1] and "about 5.0 minutes" in estimate(one, [0], 1)[-1]


FAKE = """
import json, os, pathlib, sys, time
folder = pathlib.Path(sys.argv[1])
log = folder.parent / "log.txt"
with open(log, "a") as file:
    file.write(f"begin {folder.name}\\n")
time.sleep(0.3)
with open(log, "a") as file:
    file.write(f"end {folder.name}\\n")
if "direct" in folder.name:
    print("ConfigError: it broke")
    sys.exit(2)
(folder / "metrics.json").write_text(json.dumps({"gpu": os.environ.get("CUDA_VISIBLE_DEVICES", "")}))
"""


def test_jobs_run_side_by_side_once_and_the_first_of_a_reconstruction_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(running, "command_of", lambda job: [sys.executable, "-c", FAKE, str(job.folder)])
    jobs = jobs_of(experiment(), tmp_path)
    failed = running.run_jobs(jobs, [None], 4)
    assert len(failed) == 4 and set(failed.values()) == {"ConfigError: it broke"}
    assert capsys.readouterr().out.count("complete after") == 4
    firsts = {job.folder.name: job.first for job in jobs}
    done, now = set(), []
    for line in (tmp_path / "log.txt").read_text().splitlines():
        word, name = line.split()
        if word == "begin":
            assert firsts[name] in done or firsts[name] not in [firsts[other] for other in now], "two make the same reconstruction"
            now.append(name)
        else:
            now.remove(name)
            done.add(firsts[name])
    (tmp_path / "log.txt").unlink()
    assert len(running.run_jobs(jobs, [None], 4)) == 4
    assert (tmp_path / "log.txt").read_text().count("begin") == 4  # those that failed, no other


def test_what_shares_a_reconstruction_begins_when_that_is_made(tmp_path, monkeypatch):
    said = FAKE.replace("time.sleep(0.3)", "time.sleep(0.2); print('reconstruction took 1 s', flush=True); time.sleep(1.5)")
    monkeypatch.setattr(running, "command_of", lambda job: [sys.executable, "-c", said, str(job.folder)])
    jobs = jobs_of(narrowed(experiment(), {"scene": ["a"]}, (0,)), tmp_path)
    assert len(jobs) == 2
    running.run_jobs(jobs, [None], 2)
    words = [line.split()[0] for line in (tmp_path / "log.txt").read_text().splitlines()]
    assert words == ["begin", "begin", "end", "end"]
    taken = [float((job.folder / "minutes.txt").read_text()) for job in jobs if job.finished]
    assert len(taken) == 1 and taken[0] > 1.5 / 60  # one of them fails


def test_every_gpu_has_its_own_jobs(tmp_path, monkeypatch):
    monkeypatch.setattr(running, "command_of", lambda job: [sys.executable, "-c", FAKE, str(job.folder)])
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,7")
    jobs = [job for job in jobs_of(experiment(), tmp_path) if "operator" in job.folder.name]
    assert running.run_jobs(jobs, [0, 1], 1) == {}
    assert {json.loads((job.folder / "metrics.json").read_text())["gpu"] for job in jobs} == {"4", "7"}


def test_jobs_are_spread_over_the_gpus_where_there_are_places_for_more(tmp_path, monkeypatch):
    monkeypatch.setattr(running, "command_of", lambda job: [sys.executable, "-c", FAKE, str(job.folder)])
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    scenes = tuple(Option(name, (f"scene={name}",)) for name in "abcd")
    jobs = jobs_of(experiment(axes={"method": (Option("ours", ("adapter=operator",)),), "scene": scenes}, seeds=(0,)), tmp_path)
    assert running.run_jobs(jobs, [0, 1], 4) == {}
    taken = [json.loads((job.folder / "metrics.json").read_text())["gpu"] for job in jobs]
    assert sorted(taken) == ["0", "0", "1", "1"]


# ------------------------------------------------------------------------------------------------ tables of made-up figures
def made_up(tmp_path) -> tuple[Experiment, list]:
    found = experiment()
    jobs = jobs_of(found, tmp_path)
    for job in jobs:
        scene = job.places[0]["scene"].name
        if job.places[0]["method"].name == "box" and scene == "b":
            continue  # it failed
        write_metrics(job, rms=(0.010 if scene == "a" else 0.030) + 0.002 * job.seed, prior=0.020)
    return found, jobs


def test_a_table_has_means_and_spreads_over_seeds_and_the_mean_over_columns_that_all_have(tmp_path):
    found, jobs = made_up(tmp_path)
    rows = table(found, records_of(jobs), found.figures[1])
    assert rows["ours"]["a"] == Cell(pytest.approx(11.0), pytest.approx(math.sqrt(2)), 2)
    assert rows["prior"]["a"] == Cell(pytest.approx(20.0), pytest.approx(0.0), 2)
    assert rows["box"]["b"] is None
    assert rows["ours"]["mean"] == Cell(pytest.approx(21.0), pytest.approx(math.sqrt(2)), 2) and rows["box"]["mean"] is None
    assert best_of(rows, "a", "least") in ("ours", "box") and best_of(rows, "b", "least") == "prior"
    assert best_of(rows, "a", None) is None


def test_what_failed_or_diverged_is_not_what_was_not_run(tmp_path):
    """A run that failed says why in the table's file; an infinite error is one that diverged, and neither is best or in a mean."""
    found, jobs = made_up(tmp_path)
    missing = [job for job in jobs if not job.finished]
    assert table(found, records_of(jobs), found.figures[1])["box"]["b"] is None
    (missing[0].folder).mkdir(parents=True, exist_ok=True)
    (missing[0].folder / "failed.txt").write_text("SimulationDiverged: the step is too large\n")
    ended = next(job for job in jobs if job.finished for place in job.places
                 if place["scene"].name == "a" and place["method"].name == "ours")  # fmt: skip
    write_metrics(ended, rms=math.inf, prior=0.020)
    rows = table(found, records_of(jobs), found.figures[1])
    assert rows["box"]["b"].text(1) == "failed" and rows["ours"]["a"].text(1) == "diverged" and rows["ours"]["a"].sd is None
    assert rows["ours"]["mean"] is None and best_of(rows, "a", "least") != "ours" and best_of(rows, "b", "least") == "prior"
    page = write_results(found, jobs, tmp_path / "results", "the command").read_text()
    assert f"failed: {missing[0].folder.name} (" in page and "): SimulationDiverged: the step is too large" in page
    assert "not run: " in page  # the other seed of it
    again = read_tables(tmp_path / "results" / f"{found.name}.json")[0][found.figures[1].label]
    assert again["box"]["b"].text(1) == "failed" and again["ours"]["a"].text(1) == "diverged"


def test_what_was_identified_before_the_adapter_has_its_own_name_and_infinite_figures_are_read(tmp_path):
    found = experiment(figures=(Figure("E", "id/E", 1e-5), Figure("growth", "id/growth_per_period")), seeds=(0,))
    jobs = jobs_of(found, tmp_path)
    for job in jobs:
        write_metrics(job, **{"id/E": 3e5, "id_prior/E": 2e5, "id/growth_per_period": "Infinity"})
    rows = table(found, records_of(jobs), found.figures[0])
    assert rows["prior"]["a"].mean == pytest.approx(2.0) and rows["ours"]["a"].mean == pytest.approx(3.0)
    assert rows["ours"]["a"].sd is None and rows["ours"]["a"].text(2) == "3.00"
    assert table(found, records_of(jobs), found.figures[1])["ours"]["a"].text(2) == "diverged"


def test_the_page_says_where_its_figures_come_from_and_what_is_missing(tmp_path):
    found, jobs = made_up(tmp_path / "runs")
    page = write_results(replace(found, printed="generalisation"), jobs, tmp_path / "results", "the command")
    text = page.read_text()
    for part in ("| ours ", "11.0 ± 1.4", "`the command`", "seeds: 0, 1", "a machine", "6 of 8 jobs complete",
                 "12.0 minutes", "The paper prints", "31.35 / 92.3", "made.png"):  # fmt: skip
        assert part in text, part
    assert text.count("- not run: ") == 2
    assert (tmp_path / "results" / "made.png").stat().st_size > 1000 and (tmp_path / "results" / "made.pdf").is_file()
    lines = (tmp_path / "results" / "made.csv").read_text().splitlines()
    assert lines[0] == "method,scene,seed,label,figure,value,run" and len(lines) == 1 + 3 * 2 * 2 * 2
    tex = (tmp_path / "results" / "made.tex").read_text()
    assert tex.count(r"\begin{tabular}{lccc}") == 2 and r"$\pm$" in tex and r"\textbf{" in tex


@pytest.mark.parametrize("plot", ["lines", "map", None])
def test_every_kind_of_picture_is_drawn_also_where_cells_are_missing(tmp_path, plot):
    found, jobs = made_up(tmp_path / "runs")
    write_results(replace(found, plot=plot), jobs, tmp_path / "results", "")
    assert (tmp_path / "results" / "made.png").is_file() == (plot is not None)


def test_a_map_has_the_figure_s_decimals_and_bars_say_where_they_begin(tmp_path):
    found, jobs = made_up(tmp_path / "runs")
    tables = {figure.label: table(found, records_of(jobs), figure) for figure in found.figures}
    for place, figure in zip(draw(replace(found, plot="map"), tables).axes, found.figures):  # colour bars come after the maps
        written = [text.get_text() for text in place.texts]
        assert written and {len(text.partition(".")[2]) for text in written} == {figure.decimals}
    close = {"method": {"a": Cell(98.0, None, 1)}, "other": {"a": Cell(99.0, None, 1)}}
    ssim = Figure("SSIM x100", "test/ssim_crop", 100, 1, "most")
    place = draw(replace(found, figures=(ssim,), plot="bars"), {"SSIM x100": close}).axes[0]
    low, high = place.get_ylim()
    assert 99 < high <= 100 and 90 < low < 98 and place.get_ylabel() == f"axis cut at {low:.4g}"
    alone = {"method": {"a": Cell(1.0, None, 1)}, "other": {"a": Cell(30.0, None, 1)}}
    place = draw(replace(found, figures=(replace(ssim, figure="test/psnr_crop"),), plot="bars"), {"SSIM x100": alone}).axes[0]
    assert place.get_ylim()[0] == 0 and place.get_ylabel() == ""


def test_a_method_of_which_nothing_was_run_takes_no_bar_and_no_colour(tmp_path):
    """It had the first one's colour in the legend."""
    found, _ = made_up(tmp_path / "runs")
    figures = (Figure("a", "test/rms_m", 1, 1, "least"), Figure("b", "test/psnr_crop", 1, 1, "least"))
    rows = {"first": {"x": Cell(1.0, None, 1)}, "not run": {"x": None}, "last": {"x": Cell(2.0, None, 1)}}
    partly = rows | {"last": {"x": None}}
    canvas = draw(replace(found, figures=figures, plot="bars"), {"a": partly, "b": rows})
    assert [text.get_text() for text in canvas.legends[0].get_texts()] == ["first", "last"]
    colours = [patch.get_facecolor() for place in canvas.axes for patch in place.patches]
    assert len(colours) == 3 and colours[0] == colours[1] != colours[2]


def test_every_method_of_the_paper_has_a_colour_of_its_own_in_every_picture():
    """Whatever else is in the picture, and whether it is bars or lines."""
    names = [option.name for option in load_experiment(PAPER, "table_generalisation").axes["method"]]
    assert set(names) <= set(STYLES) and len({STYLES[name]["color"] for name in names}) == len(names)
    assert not {style["color"] for style in STYLES.values()} & set(FURTHER)
    value = Cell(2.0, None, 1)
    few = {"box": {"a": value}, "ours": {"a": value}}
    many = {"NeuMA": {"a": value}, "box": {"a": None}, "ours": {"a": value}, "other": {"a": value}}
    figures = (Figure("rms", "test/rms_m", 1, 1, "least"),)
    first, second = (draw(experiment(figures=figures), {"rms": rows}).axes[0] for rows in (few, many))
    colours = [{bar.get_label(): bar[0].get_facecolor() for bar in place.containers} for place in (first, second)]
    assert colours[0]["ours"] == colours[1]["ours"] and len(set(colours[1].values())) == 3
    lines = draw(experiment(figures=figures, plot="lines", rows="scene", columns="method"),
                 {"rms": {scene: {name: value for name in ("prior", "box", "ours")} for scene in "ab"}}).axes[0]  # fmt: skip
    (ours,) = [line for line in lines.lines if line.get_label() == "ours"]
    assert to_rgba(ours.get_color()) == colours[0]["ours"]


def test_what_diverged_what_failed_and_what_was_not_run_differ():
    cells = {"x": Cell(1.0, None, 1), "y": Cell(math.inf, None, 1), "z": Cell(math.nan, None, 0)}
    rows = {"ours": cells, "box": {"x": None, "y": Cell(2.0, None, 1), "z": None}, "prior": dict.fromkeys("xyz")}
    canvas = draw(experiment(figures=(Figure("rms", "test/rms_m", 1, 1, "least"),)), {"rms": rows})
    (place,) = canvas.axes
    assert [(round(float(line.get_xdata()[0])), line.get_marker()) for line in place.lines] == [(1, "x"), (2, "+")]
    assert {line.get_color() for line in place.lines} == {style_of("ours")["color"]}
    assert [text.get_text() for text in canvas.legends[0].get_texts()] == ["ours", "box", "diverged", "failed"]
    assert canvas.get_supxlabel() == "gap: not run; not run: prior"
    assert draw(experiment(figures=(Figure("rms", "test/rms_m"),)), {"rms": {"ours": {"x": None}}}) is None


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
        tables = {label: {column: {row: rows[row][column] for row in rows} for column in "ab"} for label, rows in tables.items()}
    psnr, wide, rms = draw(made, tables).axes
    assert 20 < psnr.get_ylim()[0] < 25 and psnr.get_ylabel() == f"axis cut at {psnr.get_ylim()[0]:.4g}"
    assert wide.get_yscale() == "log" and wide.get_ylabel() == "logarithmic axis from 1"
    assert rms.get_yscale() == "linear" and rms.get_ylim()[0] == 0 and rms.get_ylabel() == ""
    if plot == "lines":  # a bar of an error for the one point with two seeds
        assert [len(bar[2][0].get_segments()) for bar in psnr.containers] == [1]
    most = (Figure("SSIM", "test/ssim_crop", 100, 1, "most"),)
    high = {row: dict.fromkeys(cells, Cell(99.9, None, 1)) for row, cells in tables["rms"].items()}
    (ssim,) = draw(replace(made, figures=most), {"SSIM": high}).axes
    assert ssim.get_ylim()[1] <= 100 and ssim.get_ylabel().startswith("axis cut at 9")


def test_a_map_is_lighter_where_it_is_better_and_frames_the_default_of_the_configuration():
    made = load_experiment(PAPER, "figure_alpha")
    defaults = yaml.safe_load((CONF / "adapter" / "mosa.yaml").read_text())["adapter"]
    assert defaults["alpha_normal"] is None and MARKED["alpha", "alpha_normal"]["default"] == (defaults["alpha"], defaults["alpha"])
    names = [option.name for option in made.axes["alpha"]]
    cells = {row: {column: Cell(i + j, None, 1) for j, column in enumerate(names)} for i, row in enumerate(names)}
    cells["0.30"] |= {"0.30": None, "0.20": Cell(-math.inf, None, 1)}
    canvas = draw(made, {figure.label: cells for figure in made.figures})
    psnr, rms = canvas.axes[:2]
    for place in (psnr, rms):
        assert [tuple(patch.get_xy()) for patch in place.patches] == [(0.52, 0.53), (1.52, 1.53)]
        words = [text.get_text() for text in place.texts]
        assert {"default", "the paper's", "diverged"} <= set(words) and len(words) == 2 + 24
    shades = [place.images[0].cmap(place.images[0].norm(np.array([0.0, 7.0]))).sum(1) for place in (psnr, rms)]
    assert shades[0][0] < shades[0][1] and shades[1][0] > shades[1][1]
    assert canvas.get_supxlabel() == "white: not run"


def test_many_bars_have_a_row_for_each_figure_and_no_picture_is_wider_than_a_page():
    for bars_of_a_part, down in ((2, 2), (9, 4)):
        rows = {name: {column: Cell(1.0, None, 1) for column in "abcdefghi"[:bars_of_a_part]} for name in ("ours", "NeuMA")}
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
                             config={"cfg": {"scene": {"name": "other"}}})
             for f in (factors[record.place["scene"].name] for record in records)]  # fmt: skip
    monkeypatch.setattr(analyses, "loaded", lambda _: zip(records, twins))
    drawn = []
    monkeypatch.setattr(analyses, "save", lambda canvas, path: drawn.append(canvas) or path)
    ANALYSES["heterogeneity"](found, records, tmp_path / "law")
    parts = [place.collections[0] for place in drawn[0].axes[:2]]
    (limits,) = {part.get_clim() for part in parts}
    assert sum(limits) == pytest.approx(2.0) and limits[1] >= float(factors["b"].max())
    assert drawn[0].axes[-1].get_xlabel().startswith("factor on the stiffness, 1: as the calibrated law")
    assert [drawn[0].axes[i].get_ylabel() for i in (0, 2)] == ["learned", "truth"]


@pytest.mark.parametrize("columns", [["a"], ["a", "b"]])
def test_the_rounding_of_an_isotropic_law_is_no_curve_and_a_response_of_zero_is_seen(tmp_path, monkeypatch, columns):
    """Beside one with a ratio of 1.6 and alone; the ripples of each part have a range of their own, E in kPa begins at 0."""
    found = narrowed(experiment(), {"method": ["ours"], "scene": columns}, (0,))
    records = records_of(jobs_of(found, tmp_path))
    laws = {"a": lambda n: 1e5 * (1 + 1e-4 * n[:, 0]), "b": lambda n: 1e5 * (1 + 0.6 * n[:, 0] ** 2)}
    twins = [SimpleNamespace(body=record.place["scene"].name, config={"cfg": {"scene": {"name": "rabbit"}}}) for record in records]
    monkeypatch.setattr(analyses, "loaded", lambda _: zip(records, twins))
    monkeypatch.setattr(analyses, "redistribution", lambda body, n: (0.1 if body == "b" else 0.0) * n[:, 0].abs())
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
        assert place.get_ylim()[0] == 0 and place.lines[0].get_ydata().mean() > 90 and place.get_ylabel() == "E [kPa]"
    assert all(place.lines[0].get_color() == style_of("ours")["color"] for place in places.ravel())


def test_results_that_cannot_be_written_leave_the_ones_before(tmp_path, monkeypatch):
    """A full disk in the middle of each file in turn: the old file stands, and nothing half-written beside it."""
    found, jobs = made_up(tmp_path / "runs")
    results = tmp_path / "results"
    write_results(found, jobs, results, "the first command")
    before = {file.name: file.read_bytes() for file in results.iterdir()}
    assert {"made.csv", "made.tex", "made.md", "made.json", "made.png", "made.pdf"} <= set(before)
    replace_file = os.replace
    for name in before:
        now = (results / name).read_bytes()

        def full(source, target, name=name):
            if Path(target).name == name:
                raise OSError(errno.ENOSPC, "full")
            replace_file(source, target)

        monkeypatch.setattr(whole_files.os, "replace", full)
        with pytest.raises(OSError, match="full"):
            write_results(found, jobs, results, "the second command")
        assert (results / name).read_bytes() == now
        assert {file.name for file in results.iterdir()} == set(before)


def test_nothing_complete_is_a_page_without_figures(tmp_path):
    found = experiment()
    page = write_results(found, jobs_of(found, tmp_path), tmp_path / "results", "")
    assert "0 of 8 jobs complete" in page.read_text() and not (tmp_path / "results" / "made.png").exists()


def test_a_damaged_metrics_file_is_named(tmp_path):
    _, jobs = made_up(tmp_path)
    (jobs[0].folder / "metrics.json").write_text("{")
    with pytest.raises(DataError, match=r"metrics\.json.*belongs to the job adapter=operator scene=a seed=0"):
        records_of(jobs)


def test_a_time_that_a_kill_left_half_written_is_taken_from_the_figures(tmp_path):
    job = made_up(tmp_path)[1][0]
    write_metrics(job, **{"time/data_s": 120.0})
    (job.folder / MINUTES).write_text("3.5")
    assert minutes_taken(job) == 3.5
    (job.folder / MINUTES).write_text("")
    assert minutes_taken(job) == pytest.approx(3.0)


def test_the_command_is_written_without_folders_of_this_machine():
    words = ["table_time", "--quick", "--runs", "/a/b", "--results", "/c", "--only", "method=prior only", "--set", "x=1"]
    options = arguments(words)
    assert shown(options) == "mosa-experiment table_time --quick --only 'method=prior only' --set x=1"


def test_errors_frame_by_frame_are_those_of_the_motions(tmp_path):
    found = replace(experiment(), seeds=(0,), analysis="long_term", plot=None)
    jobs = jobs_of(found, tmp_path / "runs")
    x = np.zeros((4, 5, 3), np.float32)
    for job in jobs:
        write_metrics(job)
        np.savez(job.folder / "truth.npz", **{"train/x": x, "test/one/x": x, "test/two/x": x})
        for name, size in (("rollout", 0.001), ("prior", 0.002)):
            moved = {"test/one/x": x + size * np.eye(3)[0], "test/two/x": x + 3 * size * np.eye(3)[1],
                     "test/one/times": np.arange(4) / 10, "test/two/times": np.arange(4) / 10}  # fmt: skip
            np.savez(job.folder / f"{name}.npz", **moved)
    write_results(found, jobs, tmp_path / "results", "")
    lines = (tmp_path / "results" / "made_frames.csv").read_text().splitlines()
    assert len(lines) == 1 + 2 * 3 * 4 and lines[0] == "scene,method,time_s,rms_mm,sd_mm"
    assert "a,prior,0.1000,4.0000,0.0000" in lines and "a,ours,0.3000,2.0000,0.0000" in lines
    assert (tmp_path / "results" / "made_frames.png").is_file()


# ------------------------------------------------------------------------------------------------ one for real
@pytest.mark.slow
def test_a_quick_variant_runs_to_its_table_and_is_not_run_again(cache, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(specimens, "ANGLES", 4)
    words = ["table_generalisation", "figure_heterogeneity", "--quick", "--runs", str(tmp_path / "runs"), "--seeds", "0",
             "--only", "method=ours"]  # fmt: skip
    more = [f"scene.cache={cache}", "evaluation.samples=500", "evaluation.assignment=100"]
    words += [word for each in more for word in ("--set", each)]
    assert run(arguments(words)) == 0
    assert "1 jobs, 1 to run" in capsys.readouterr().out  # both read the same run
    results = tmp_path / "runs" / "results"
    for name in ("table_generalisation_quick", "figure_heterogeneity_quick"):
        assert "1 of 1 jobs complete" in (results / f"{name}.md").read_text()
    assert "correlation" in (results / "figure_heterogeneity_quick.md").read_text()
    assert (results / "figure_heterogeneity_quick_factor.png").is_file()
    assert run(arguments(words)) == 0
    assert "0 to run" in capsys.readouterr().out
    one = narrowed(load_experiment(PAPER, "table_generalisation", quick=True), {"method": ["ours"]}, (0,))
    text, pictures = ANALYSES["directions"](one, records_of(jobs_of(one, tmp_path / "runs", more)), tmp_path / "law")
    assert "| tiny  | ours" in text and len(pictures) == 1
    rows = [line.split(",") for line in (tmp_path / "law_directions.csv").read_text().splitlines()[1:]]
    (tiny,) = one.axes["scene"]
    two = replace(one, axes=one.axes | {"scene": (tiny, replace(tiny, name="again"))})  # the same run in two columns
    text, _ = ANALYSES["compression"](two, records_of(jobs_of(two, tmp_path / "runs", more)), tmp_path / "law")
    assert "| tiny  | ours" in text and "| again | ours" in text and (tmp_path / "law_plates.png").is_file()
    plates = [line.split(",") for line in (tmp_path / "law_plates.csv").read_text().splitlines()[1:]]
    assert [row[:2] for row in plates[::5]] == [["tiny", "ours"], ["again", "ours"]]  # four directions and the fibres'
    assert len(plates) == 2 * 5 and [row[2:] for row in plates[:5]] == [row[2:] for row in plates[5:]]
    pressed = [float(row[4]) for row in plates[:5]]
    assert max(pressed) / min(pressed) == pytest.approx(1.6, rel=0.1)  # of the truth, between plates
    for job in jobs_of(two, tmp_path / "runs", more):
        (job.folder / "checkpoints" / "last.ckpt").unlink(missing_ok=True)
    kept, _ = ANALYSES["compression"](two, records_of(jobs_of(two, tmp_path / "runs", more)), tmp_path / "law")
    assert kept == text  # what was measured is in the run's folder
    true = [float(row[5]) for row in rows]
    assert true[0] / true[18] == pytest.approx(1.6, rel=0.01)  # along the rabbit's fibres and across
    assert float(rows[0][4]) > 0 and float(rows[0][3]) >= 0


# ------------------------------------------------------------------------------------------------ the page of results
def cells(**rows) -> dict:
    return {row: {"mean": None if value is None else Cell(*value)} for row, value in rows.items()}


def test_a_claim_holds_only_by_more_than_the_spread_of_the_seeds():
    found = experiment()
    claim = Claim("ours is ahead", "rms [mm]", row="ours", against=("prior", "box"))
    for rows, begins in (
        (cells(ours=(10.0, 0.5, 3), prior=(20.0, 0.5, 3), box=(12.0, 0.5, 3)), "holds, 10.0 ± 0.5 against 20.0 ± 0.5 (prior)"),
        (cells(ours=(10.0, 2.0, 3), prior=(20.0, 0.5, 3), box=(11.0, 2.0, 3)), "within the spread, "),
        (cells(ours=(10.0, 0.1, 3), prior=(20.0, 0.5, 3), box=(9.0, 0.1, 3)), "does not hold, "),
        (cells(ours=None, prior=(20.0, 0.5, 3), box=(9.0, 0.1, 3)), "not run"),
    ):
        assert verdict(found, claim, {"rms [mm]": rows}).startswith(begins)
    one = verdict(found, claim, {"rms [mm]": cells(ours=(10.0, None, 1), prior=(20.0, None, 1), box=None)})
    assert one == "holds against those that were run, 10.0 against 20.0 (prior); not run: box; one seed"
    best = Claim("more is better", "PSNR", row="ours", against=("prior",))
    assert verdict(found, best, {"PSNR": cells(ours=(30.0, None, 1), prior=(31.0, None, 1))}).startswith("does not hold")


def of_columns(**rows) -> dict:
    """Rows of figures in the columns a, b, c, of one seed."""
    return {row: {column: None if value is None else Cell(value, None, 1) for column, value in zip("abc", values)}
            for row, values in rows.items()}  # fmt: skip


def test_rows_are_compared_where_both_were_run_and_that_is_said():
    """A column in which the other one diverged is no part of the means, and counts as one in which it is worse."""
    claim = Claim("ours is ahead", "rms [mm]", row="ours", against=("prior", "box"))
    rows = of_columns(ours=(10.0, 12.0, 30.0), prior=(20.0, 22.0, 24.0), box=(15.0, None, math.inf))
    assert verdict(experiment(), claim, {"rms [mm]": rows}) == (
        "holds, 17.3 against 22.0 (prior; better in 2 of 3), 10.0 against 15.0 (box; better in 2 of 2; without b, c); one seed")
    behind = rows | of_columns(box=(9.0, None, math.inf))
    assert verdict(experiment(), claim, {"rms [mm]": behind}).startswith("does not hold, 17.3 against")
    sds = {"ours": {"a": Cell(10.0, 3.0, 3), "b": Cell(10.0, 4.0, 3)}, "prior": {"a": Cell(12.0, 0.0, 3), "b": Cell(12.0, 0.0, 3)}}
    assert verdict(experiment(), replace(claim, against=("prior",)), {"rms [mm]": sds}) == (
        "within the spread, 10.0 ± 2.5 against 12.0 ± 0.0 (prior; better in 2 of 2)")  # of the mean sqrt(3^2 + 4^2) / 2


def test_a_claim_of_every_column_names_those_in_which_it_fails():
    claim = Claim("gains under each", "PSNR", row="ours", against=("prior",), each=True)
    rows = of_columns(ours=(30.0, 28.0, -math.inf), prior=(29.0, 29.0, 25.0))
    assert verdict(experiment(), claim, {"PSNR": rows}) == (
        "does not hold, ahead in 1 of 3 (a); b: 28.00 against 29.00 (prior); c: diverged; one seed")
    better = of_columns(ours=(30.0, 30.0, 26.0), prior=(29.0, 29.0, -math.inf))
    assert verdict(experiment(), claim, {"PSNR": better}) == "holds, ahead in 3 of 3; one seed"
    rows = of_columns(ours=(29.2, 31.0, 30.0), prior=(29.0, 30.0, 29.0))
    near = verdict(experiment(), replace(claim, spread=0.5), {"PSNR": rows})
    assert near == "does not hold, ahead in 2 of 3 (b, c); a: 29.20 against 29.00 (prior); one seed"
    assert verdict(experiment(), claim, {"PSNR": of_columns(ours=(None, None, None), prior=(1.0, 1.0, 1.0))}) == "not run"


def test_of_one_seed_a_difference_has_to_be_more_than_the_spread_that_is_given():
    claim = Claim("helps", "PSNR", row="ours", against=("prior",), spread=0.3)
    rows = {gain: cells(ours=(30.0 + gain, None, 1), prior=(30.0, None, 1)) for gain in (0.2, 0.4, -0.2, -0.4)}
    said = {gain: verdict(experiment(), claim, {"PSNR": found}).partition(",")[0] for gain, found in rows.items()}
    assert said == {0.2: "within the spread", 0.4: "holds", -0.2: "within the spread", -0.4: "does not hold"}


def test_a_bound_excuses_what_the_posterior_says_is_not_determined():
    claim = Claim("within 5 %", "PSNR", most=5.0, unless="rms [mm]")
    rows = cells(a=(3.0, None, 1), b=(40.0, None, 1), c=(9.0, None, 1))
    said = verdict(experiment(), claim, {"PSNR": rows, "rms [mm]": cells(a=(1.0, None, 1), b=(25.0, None, 1), c=(1.0, None, 1))})
    assert said == ("does not hold, 1 of 3 within 5; not determined, and the posterior says so: b (40.0); beyond it: c (9.0)")
    alone = {"PSNR": cells(b=(40.0, None, 1)), "rms [mm]": cells(b=(25.0, None, 1))}
    assert verdict(experiment(), claim, alone).startswith("none is determined, 0 of 1")
    both = {name: rows | cells(a=(3.0, None, 1)) for name, rows in alone.items()}
    assert verdict(experiment(), claim, both).startswith("holds where it is determined, 1 of 2")
    assert verdict(experiment(), claim, {}) == "not run"


@pytest.mark.parametrize(("off", "sd", "determined"), [
    (3648.5, 262.0, False),  # 37 times as much is 3.6 in the logarithm
    (184.1, 34.9, True), (54.1, 28.0, True), (30.0, 16.0, True), (30.0, 19.0, False),
])  # fmt: skip
def test_a_deviation_of_a_modulus_is_one_of_its_logarithm(off, sd, determined):
    found = replace(experiment(), figures=(Figure("mu [%]", "id/mu_relative_error", 100, 1),
                                           Figure("sd of mu [%]", "posterior/mu_relative_sd", 100, 1)))  # fmt: skip
    claim = Claim("within 5 %", "mu [%]", most=5.0, unless="sd of mu [%]")
    said = verdict(found, claim, {"mu [%]": cells(a=(off, None, 1)), "sd of mu [%]": cells(a=(sd, None, 1))})
    assert said.startswith("does not hold" if determined else "none is determined")


def test_the_page_has_what_was_run_and_says_what_was_not(tmp_path):
    found = narrowed(load_experiment(PAPER, "table_generalisation"), {"scene": ["rabbit", "peanut"]}, (0,))
    jobs = [job for job in jobs_of(found, tmp_path / "runs")
            if any(place["method"].name in ("ours", "NeuMA") for place in job.places)]  # fmt: skip
    for job in jobs:
        write_metrics(job, rms=0.010 if "adapter=operator" in job.overrides else 0.030)
    write_results(found, jobs, tmp_path / "docs" / "results", "the command")
    (tmp_path / "docs" / "results" / "law_from_motion.md").write_text("# A law\n\ntext\n")
    assert run(arguments(["--page", "--results", str(tmp_path / "docs" / "results")])) == 0
    text = (tmp_path / "docs" / "results.md").read_text()
    assert "[A law](results/law_from_motion.md)." in text
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()]
    glance = {row[0]: row[1:] for row in rows if len(row) == 5}
    assert glance["Ablations of the paper's adapter and of its motion cues"] == ["not run", "", "4 not run", ""]
    jobs_complete, _, papers, about_ours = glance["Generalisation to drops that were not seen"]
    assert jobs_complete == "4 of 4" and papers == "2 not run" and about_ours == "2 hold against what was run"
    for name in NAMES:
        assert f"## {load_experiment(PAPER, name).title}" in text
    assert "31.35 / 92.3" in text and "`the command`" in text and "](results/table_generalisation.png)" in text
    row = next(line for line in text.splitlines() if line.startswith("| NCLaw"))
    assert row.count("not run") >= 2
    least = "our default has the smallest error of all"
    assert f"{least}: **holds against those that were run, 10.0 against 20.0 (prior only; better in 2 of 2), " in text
    assert "30.0 (NeuMA; better in 2 of 2); not run: " in text
    assert "Here: not run. `mosa-experiment table_ablation`" in text
    with pytest.raises(ConfigError, match="--results: expected a folder"):
        run(arguments(["--page", "--results", str(tmp_path / "nothing")]))
    (tmp_path / "docs" / "results" / "table_generalisation.json").write_text("{}")
    with pytest.raises(DataError, match=r"table_generalisation\.json"):
        run(arguments(["--page", "--results", str(tmp_path / "docs" / "results")]))


@pytest.mark.parametrize(("count", "said"), [("3", True), ("0", False), (None, False)])
def test_the_page_says_of_figures_that_the_program_has_changed_since(monkeypatch, count, said):
    """Of no change, or of a commit that this checkout does not know, it says nothing."""
    asked = []
    monkeypatch.setattr(commits, "git", lambda *words: asked.append(words) or count)
    found = older(["command: `mosa-experiment all`", "version 0.1.0, commit 0123456789ab, with changes", "seeds: 0"])
    assert asked == [("rev-list", "--count", "0123456789ab..HEAD", "--", "mosa", "conf")]
    assert found == ["**These figures are of an older commit, 0123456789ab:** 3 commits have changed the program (`mosa/`, "
                     "`conf/`) since, up to when this page was made. What it gives now was not run."] * said
    assert older(["version 0.1.0, commit unknown"]) == [] and len(asked) == 1


def test_results_name_the_commits_that_their_runs_were_made_with(tmp_path):
    """Not the one that collects them: the commonest first, and the others with how many they are."""
    found, jobs = made_up(tmp_path)
    complete = [job for job in jobs if job.finished]
    assert made_by(complete) == f"commit {commits.commit()}"
    for job, made in zip(complete, ("0123456789ab", "ba9876543210, with changes") + ("0123456789ab",) * 9):
        (job.folder / "commit.txt").write_text(made + "\n")
    assert made_by(complete) == "commit 0123456789ab (1 job of ba9876543210, with changes)"
    page = write_results(found, jobs, tmp_path / "results", "the command").read_text()
    assert "commit 0123456789ab (1 job of ba9876543210, with changes)" in page


def test_the_commit_of_a_result_is_that_of_the_checkout():
    assert re.fullmatch(r"unknown|[0-9a-f]{12}(, with changes)?", commits.commit())
    assert commits.git("no-such-command") is None


def test_a_claim_of_a_figure_or_row_that_is_not_there_is_a_mistake_of_the_file():
    figures = (Figure("a", "x"),)
    for found, message in (({"text": "t", "figure": "b", "most": 1}, "expected one of a, found 'b'"),
                           ({"text": "t", "figure": "a"}, "row with against, or most"),
                           ({"text": "t", "figure": "a", "rwo": "x"}, "expected fields of")):  # fmt: skip
        with pytest.raises(ConfigError, match=message):
            claim_of("f: claims[0]", found, figures)
    for name in NAMES:  # rows that the claims name are rows
        made = load_experiment(PAPER, name)
        rows = {option.name for option in made.axes[made.rows]}
        assert {row for claim in made.claims if claim.row for row in (claim.row, *claim.against)} <= rows, name
