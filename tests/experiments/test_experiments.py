"""The harness of the paper's tables: files that compose, jobs made once, tables of made-up figures, and one experiment for real."""

import errno
import hashlib
import json
import math
import os
import re
import signal
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from forked_workers import fork
from hydra import compose, initialize_config_dir
from made_up import CONF, NAMES, PAPER, experiment, made_up, write_metrics
from omegaconf import OmegaConf

from mosa.cli.experiment import arguments, run, shown
from mosa.config.build import rehearse
from mosa.errors import ConfigError, DataError
from mosa.experiments import running, specimens, workers
from mosa.experiments.analyses import ANALYSES
from mosa.experiments.collecting import Cell, best_of, records_of, table
from mosa.experiments.report.page import read_tables
from mosa.experiments.report.printed import printed_table
from mosa.experiments.report.writing import write_results
from mosa.experiments.specification import (
    MINUTES,
    Analysis,
    Figure,
    Option,
    claim_of,
    estimate,
    folder_name,
    in_turn,
    jobs_of,
    load_experiment,
    minutes_taken,
    narrowed,
    pairs,
)
from mosa.system import whole_files


# ------------------------------------------------------------------------------------------------ files
def options_once(name: str, quick: bool) -> set[tuple[str, ...]]:
    """Overrides of as few jobs as have every option of every axis: the k-th has the k-th of each, from the first again where an
    axis has fewer."""
    found = load_experiment(PAPER, name, quick)
    axes = list(found.axes.values())
    places = [[options[k % len(options)] for options in axes] for k in range(max(map(len, axes)))]
    return {
        (*found.common, *(each for option in place for each in option.overrides))
        for place in places
    }


def test_every_option_of_every_experiment_composes_and_passes_the_checks_before_a_run():
    assert len(NAMES) >= 10
    wanted = set().union(*(options_once(name, quick) for name in NAMES for quick in (False, True)))
    with initialize_config_dir(str(CONF), version_base="1.3"):
        for overrides in sorted(wanted):
            config = OmegaConf.to_container(
                compose("train", overrides=list(overrides)), resolve=False
            )
            rehearse(config)


def test_every_entry_of_the_paper_that_is_named_exists():
    for name in NAMES:
        found = load_experiment(PAPER, name)
        assert found.analysis is None or found.analysis in ANALYSES
        if found.printed is not None:
            assert "The paper prints" in printed_table(found.printed)
    assert set(get_args(Analysis)) == set(ANALYSES)


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
    rows = [line for line in text.splitlines() if line.startswith("| MoSA")]
    psnr, ssim = ([float(cell) for cell in row.split("|")[2:-1]] for row in rows)
    assert (psnr[-1], ssim[-1]) == (31.35, 92.3)  # printed beside them
    assert np.mean(psnr[:-1]) == pytest.approx(
        31.52, abs=0.01
    )  # the paper's own mean is not theirs
    found = printed_table("identification")
    assert "| cream      | yield_stress   | 3      | 3.16     | 2.98  | 2.97  |" in found


@pytest.mark.parametrize(("text", "message"), [
    ("title: a\nrows: x\ncolumns: y\nfigures: []\n", "axes: expected this key"),
    ("title: a\naxes: {x: {o: []}}\nrows: z\ncolumns: x\nfigures: []\n", "rows, columns: expected two of x, found 'z'"),
    ("title: a\naxes: {x: nothing}\nrows: x\ncolumns: x\nfigures: []\n", r"axes\.x: expected one of .*, found 'nothing'"),
    ("title: a\naxes: {x: {of: objects, only: [q]}}\nrows: x\ncolumns: x\nfigures: []\n", r"axes\.x: expected some of .*'q'"),
    ("title: a\naxes: {x: {o: {cots: 1}}}\nrows: x\ncolumns: x\nfigures: []\n", r"axes\.x\.o\.cots: unknown key"),
    ("title: a\naxes: {x: {o: []}}\nrows: x\ncolumns: x\nfigures: []\nfoo: 1\n", "foo: unknown key"),
    ("[", "no readable YAML"),
])  # fmt: skip
def test_a_mistake_in_a_file_names_its_key(tmp_path, text, message):
    (tmp_path / "_shared.yaml").write_text("objects: {a: []}\n")
    (tmp_path / "wrong.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_experiment(tmp_path, "wrong")


def test_ones_own_folder_has_the_paper_s_axes_and_its_own(tmp_path, capsys):
    (tmp_path / "_shared.yaml").write_text("mine: {softer: [adapter=softer]}\n")
    text = "title: Mine\naxes: {method: mine, scene: {of: objects, only: [rabbit]}}\nrows: method\ncolumns: scene\n"
    (tmp_path / "mine.yaml").write_text(text + "figures: [{label: PSNR, figure: test/psnr_crop}]\n")
    words = ["--specifications", str(tmp_path), "--runs", str(tmp_path / "runs")]
    assert run(arguments(words)) == 0 and capsys.readouterr().out.split() == ["mine", "Mine"]
    assert run(arguments(["mine", "--dry-run", *words])) == 0
    said = capsys.readouterr().out
    assert "scene=rabbit" in said and "adapter=softer" in said and "1 jobs, 1 to run" in said
    with pytest.raises(ConfigError, match="--specifications: expected a folder"):
        run(arguments(["mine", "--specifications", str(tmp_path / "none")]))


def test_an_estimate_with_overrides_is_that_of_the_jobs_that_are_complete(tmp_path, capsys):
    words = arguments(["table_time", "--quick", "--dry-run", "--runs", str(tmp_path), "--set", "fit=paper"])  # fmt: skip

    def said() -> list[str]:
        assert run(words) == 0
        return capsys.readouterr().out.splitlines()

    first, *_, last = said()
    assert "not measured yet" in first and "side by side without --set fit=paper; with it" in last
    folder = tmp_path / first.split(":")[0]
    write_metrics(replace(jobs_of(experiment(), tmp_path)[0], folder=folder))
    files = float(re.search(r"about ([0-9.]+) minutes", last)[1])
    (folder / MINUTES).write_text("60")
    *_, last = said()
    assert (
        float(re.search(r"about ([0-9.]+) minutes", last)[1]) > 10 * files and "--set" not in last
    )


def test_mistakes_on_the_command_line_are_named(tmp_path, capsys):
    for words, message in (
        (["nothing"], "experiment: expected one of .* or all, found 'nothing'"),
        (["table_time", "--jobs", "0"], "--jobs"),
        (["table_time", "--seeds", "a"], "--seeds: expected whole numbers"),
        (["table_time", "--only", "shoe=1"], "--only: expected AXIS=NAME"),
        (
            ["table_time", "--only", "scene=boat"],
            "--only scene: expected some of rabbit, found 'boat'",
        ),
    ):
        with pytest.raises(ConfigError, match=message):
            run(arguments([*words, "--dry-run", "--runs", str(tmp_path)]))


# ------------------------------------------------------------------------------------------------ jobs
def test_cells_that_need_the_same_run_share_it(tmp_path):
    jobs = jobs_of(experiment(), tmp_path)
    assert (
        len(jobs) == 2 * 2 * 2 and len({job.folder for job in jobs}) == 8
    )  # operator and direct, scenes, seeds
    shared = [job for job in jobs if len(job.places) == 2]
    assert len(shared) == 4 and {p["method"].name for p in shared[0].places} == {"prior", "ours"}
    again = jobs_of(experiment(common=("x=1",)), tmp_path, ["y=2"])
    assert all(
        "x=1" in job.overrides and "y=2" in job.overrides and job.overrides[-1].startswith("seed=")
        for job in again
    )
    assert not {job.folder for job in again} & {job.folder for job in jobs}


def test_a_key_that_two_axes_set_is_named(tmp_path):
    """Of two priors only the last would count: a row of another law would be the columns' law."""
    laws = (Option("mine", ("prior=my_law",)), Option("ours", ("prior=neo_hookean",)))
    scenes = (Option("rabbit", ("scene=rabbit", "prior=neo_hookean")),)
    with pytest.raises(
        ConfigError, match="one value of prior, found my_law on law and neo_hookean on scene: leave"
    ):
        jobs_of(experiment(axes={"law": laws, "scene": scenes}), tmp_path)
    jobs_of(experiment(axes={"law": laws[1:], "scene": scenes}), tmp_path)  # the same value


def test_what_is_set_for_all_jobs_is_nothing_that_makes_a_row(tmp_path):
    """The rows of two methods would both hold the figures of the one that is set, and a single row those of another one."""
    alone = narrowed(experiment(), {"method": ["ours"]}, None)
    below = experiment(axes={"bound": (Option("small", ("adapter.alpha=0.1",)),)})
    for given, word in (
        (experiment(), "adapter=mine"),
        (alone, "adapter=mine"),
        (below, "+adapter={alpha:0.2}"),
    ):
        with pytest.raises(
            ConfigError, match=r"--set adapter: .* found one of (method|bound), whose"
        ):
            jobs_of(given, tmp_path, [word])
    jobs_of(below, tmp_path, ["adapter=mine", "adapter.hidden=16"])


def test_a_folder_s_name_does_not_depend_on_the_order_of_different_keys():
    assert folder_name(["a=1", "b=2", "seed=0"]) == folder_name(["b=2", "seed=0", "a=1"])
    assert folder_name(["a=1", "a=2"]) != folder_name(["a=2", "a=1"])  # the last one holds
    assert len(folder_name(["scene.path=" + "x" * 500])) < 100


def test_an_experiment_is_narrowed_to_options_and_seeds(tmp_path):
    found = narrowed(experiment(), pairs(["method=ours", "scene=b"], [experiment()]), (3,))
    jobs = jobs_of(found, tmp_path)
    assert [job.overrides for job in jobs] == [("adapter=operator", "scene=b", "seed=3")]


def test_the_estimate_counts_what_is_left_and_what_works_on_it(tmp_path):
    jobs = jobs_of(experiment(), tmp_path)
    said = "8 jobs, 8 to run, about 36.0 minutes with 1 side by side"  # 4 of 3, 4 of 6
    assert estimate(jobs, [None], 1)[-1] == said
    assert "about 6.0 minutes with 2" in estimate(jobs, [0, 1], 1)[-1]
    assert "about 6.0 minutes with 8" in estimate(jobs, [None], 8)[-1]  # none is shorter for others
    write_metrics(jobs[0], **{"time/fit_s": 300.0})
    # of 3 minutes by the file 6 were taken: twice of 33
    assert "8 jobs, 7 to run, about 66.0 minutes" in estimate(jobs, [None], 1)[-1]


def test_what_runs_alone_comes_last(tmp_path):
    timed = experiment(name="timed", alone=True, seeds=(0,))
    both = [*jobs_of(timed, tmp_path), *jobs_of(experiment(), tmp_path)]
    assert len({job.folder for job in both}) == 12  # none is shared with what runs in company
    assert [(job.alone, job.minutes["gpu"]) for job in in_turn(both, [0])] == (
        [(False, 2.0)] * 4 + [(False, 1.0)] * 4 + [(True, 2.0)] * 2 + [(True, 1.0)] * 2)  # fmt: skip


def test_the_jobs_of_what_is_named_first_begin_first_and_those_of_one_word_the_longest_first(
    tmp_path,
):
    jobs = [replace(job, turn=int(job.seed == 0)) for job in jobs_of(experiment(), tmp_path)]
    order = [(job.seed, job.minutes["gpu"]) for job in in_turn(jobs, [0])]
    assert order == [(seed, minutes) for seed in (1, 0) for minutes in (2.0, 2.0, 1.0, 1.0)]


FAKE = """
import json, os, pathlib, sys, time

def until(log, word, count):
    # so many jobs have written the word
    last = time.monotonic() + 60
    while log.read_text().count(word) < count and time.monotonic() < last:
        time.sleep(0.02)

def main():
    folder = pathlib.Path(sys.argv[-1].removeprefix("hydra.run.dir=").strip("'"))
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


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """Makes another program than train.py what a job runs; a name of its own each, as a process imports it by its name."""

    def made(code: str = FAKE) -> None:
        name = f"fake_job_{hashlib.sha256(code.encode()).hexdigest()[:8]}"
        (tmp_path / f"{name}.py").write_text(code)
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.setattr(running, "PROGRAM", f"{name}:main")

    return made


def test_jobs_run_side_by_side_once_and_the_first_of_a_reconstruction_alone(tmp_path, fake, capsys):
    fake()
    jobs = jobs_of(narrowed(experiment(), {}, (0,)), tmp_path)
    failed = running.run_jobs(jobs, [None], 4)
    assert len(failed) == 2 and set(failed.values()) == {"ConfigError: it broke"}
    said = capsys.readouterr().out
    assert said.count("complete after") == 2 and "min left" in said
    firsts = {job.folder.name: job.first for job in jobs}
    done, now = set(), []
    for line in (tmp_path / "log.txt").read_text().splitlines():
        word, name = line.split()
        if word == "begin":
            assert firsts[name] in done or firsts[name] not in [firsts[other] for other in now], (
                "two make the same reconstruction"
            )
            now.append(name)
        else:
            now.remove(name)
            done.add(firsts[name])
    (tmp_path / "log.txt").unlink()
    assert len(running.run_jobs(jobs, [None], 4)) == 2
    assert (tmp_path / "log.txt").read_text().count("begin") == 2  # those that failed, no other


def test_what_shares_a_reconstruction_begins_when_that_is_made(tmp_path, fake):
    said = "print('data took 1 s\\nreconstruction took 1 s', flush=True)"
    fake(FAKE.replace("time.sleep(0.3)", f"time.sleep(0.2); {said}; until(log, 'begin', 2)"))
    jobs = jobs_of(narrowed(experiment(), {"scene": ["a"]}, (0,)), tmp_path)
    assert len(jobs) == 2
    running.run_jobs(jobs, [None], 2)
    words = [line.split()[0] for line in (tmp_path / "log.txt").read_text().splitlines()]
    assert words == ["begin", "begin", "end", "end"]
    taken = [float((job.folder / "minutes.txt").read_text()) for job in jobs if job.finished]
    assert len(taken) == 1 and taken[0] > 0.2 / 60  # one of them fails


def test_a_stop_that_falls_into_the_start_of_a_job_ends_that_job_too(tmp_path, fake, monkeypatch):
    fake(FAKE.replace("time.sleep(0.3)", "time.sleep(60)"))
    started = []

    def stopped(*words):
        started.append(begin(*words))
        signal.raise_signal(signal.SIGINT)
        return started[-1]

    begin = workers.Worker.begin
    monkeypatch.setattr(workers.Worker, "begin", stopped)
    before = signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # a shell that put pytest into the background had it ignored
    try:
        with pytest.raises(KeyboardInterrupt):
            running.run_jobs(jobs_of(experiment(), tmp_path), [None], 1)
    finally:
        signal.signal(signal.SIGINT, before)
    assert len(started) == 1 and started[0].done()
    assert started[0].exception() is not None


def test_a_job_that_is_killed_stops_no_other_and_is_named(tmp_path, fake):
    fake(FAKE.replace("sys.exit(2)", "os.kill(os.getpid(), 9)").replace("ConfigError", "it was"))
    jobs = jobs_of(narrowed(experiment(), {}, (0,)), tmp_path)
    failed = running.run_jobs(jobs, [None], 1)
    assert len(failed) == 2 and all("its process was killed" in each for each in failed.values())
    assert sum(job.finished for job in jobs) == 2


def test_what_is_held_out_or_learned_from_changes_no_film(tmp_path):
    scenes = tuple(
        Option(name, ("scene=a", *more))
        for name, more in (
            ("all", ()),
            ("future", ("scene.holdout_frames=5",)),
            ("two", ("scene.also_train=[b]",)),
            ("other", ("scene.material=c",)),
        )
    )
    made = experiment(
        axes={"method": (Option("ours", ("adapter=operator",)),), "scene": scenes}, seeds=(0,)
    )
    jobs = jobs_of(made, tmp_path)
    assert [job.film for job in jobs] == ["scene=a"] * 3 + ["scene=a scene.material=c"]
    assert len({job.first for job in jobs}) == 4


def test_what_shares_films_begins_when_these_are_made_and_reconstructs_for_itself(tmp_path, fake):
    """Two seeds of a scene have the same films; each would make all of them."""
    fake(
        FAKE.replace(
            "time.sleep(0.3)",
            """time.sleep(0.6)
    open(log, "a").write("filmed it\\n")
    print("data took 1 s", flush=True)
    until(log, "filmed", 2)""",
        )
    )
    jobs = jobs_of(narrowed(experiment(), {"scene": ["a"], "method": ["ours"]}, (0, 1)), tmp_path)
    assert jobs[0].film == jobs[1].film and jobs[0].first != jobs[1].first
    running.run_jobs(jobs, [None], 2)
    words = [line.split()[0] for line in (tmp_path / "log.txt").read_text().splitlines()]
    assert words == ["begin", "filmed", "begin", "filmed", "end", "end"]


def test_every_gpu_has_its_own_jobs(tmp_path, fake, monkeypatch):
    fake()
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,7")
    jobs = [job for job in jobs_of(experiment(), tmp_path) if "operator" in job.folder.name]
    assert running.run_jobs(jobs, [0, 1], 1) == {}
    assert {json.loads((job.folder / "metrics.json").read_text())["gpu"] for job in jobs} == {
        "4",
        "7",
    }


def test_jobs_are_spread_over_the_gpus_where_there_are_places_for_more(tmp_path, fake, monkeypatch):
    fake()
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    scenes = tuple(Option(name, (f"scene={name}",)) for name in "abcd")
    jobs = jobs_of(
        experiment(
            axes={"method": (Option("ours", ("adapter=operator",)),), "scene": scenes}, seeds=(0,)
        ),
        tmp_path,
    )
    assert running.run_jobs(jobs, [0, 1], 4) == {}
    taken = [json.loads((job.folder / "metrics.json").read_text())["gpu"] for job in jobs]
    assert sorted(taken) == ["0", "0", "1", "1"]


def test_a_job_that_runs_alone_has_its_device_to_itself(tmp_path, fake):
    fake(FAKE.replace("time.sleep(0.3)", "until(log, 'begin', 3); time.sleep(0.1)"))
    scenes = {
        "scene": tuple(Option(name, (f"scene={name}",)) for name in "abcd"),
        "method": (Option("ours", ()),),
    }
    company, timed = (
        jobs_of(experiment(axes=scenes, seeds=(0,), alone=alone), tmp_path)
        for alone in (False, True)
    )
    assert running.run_jobs([*timed, *company], [None], 3) == {}
    now, most = [], {"alone": 0, "in company": 0}
    for line in (tmp_path / "log.txt").read_text().splitlines():
        word, name = line.split()
        now.append(name) if word == "begin" else now.remove(name)
        alone = any(each.startswith("alone") for each in now)
        most["alone" if alone else "in company"] = max(
            most["alone" if alone else "in company"], len(now)
        )
    assert most == {"alone": 1, "in company": 3}


# ------------------------------------------------------------------------------------------------ tables of made-up figures


def test_a_table_has_means_and_spreads_over_seeds_and_the_mean_over_columns_that_all_have(tmp_path):
    found, jobs = made_up(tmp_path)
    rows = table(found, records_of(jobs), found.figures[1])
    assert rows["ours"]["a"] == Cell(pytest.approx(11.0), pytest.approx(math.sqrt(2)), 2)
    assert rows["prior"]["a"] == Cell(pytest.approx(20.0), pytest.approx(0.0), 2)
    assert rows["box"]["b"] is None
    assert (
        rows["ours"]["mean"] == Cell(pytest.approx(21.0), pytest.approx(math.sqrt(2)), 2)
        and rows["box"]["mean"] is None
    )
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
    assert (
        rows["box"]["b"].text(1) == "failed"
        and rows["ours"]["a"].text(1) == "diverged"
        and rows["ours"]["a"].sd is None
    )
    assert (
        rows["ours"]["mean"] is None
        and best_of(rows, "a", "least") != "ours"
        and best_of(rows, "b", "least") == "prior"
    )
    page = write_results(found, jobs, tmp_path / "results", "the command").read_text()
    assert (
        f"failed: {missing[0].folder.name} (" in page
        and "): SimulationDiverged: the step is too large" in page
    )
    assert "not run: " in page  # the other seed of it
    again = read_tables(tmp_path / "results" / f"{found.name}.json")[0][found.figures[1].label]
    assert again["box"]["b"].text(1) == "failed" and again["ours"]["a"].text(1) == "diverged"


def test_what_was_identified_before_the_adapter_has_its_own_name_and_infinite_figures_are_read(
    tmp_path,
):
    found = experiment(
        figures=(Figure("E", "id/E", 1e-5), Figure("growth", "id/growth_per_period")), seeds=(0,)
    )
    jobs = jobs_of(found, tmp_path)
    for job in jobs:
        write_metrics(job, **{"id/E": 3e5, "id_prior/E": 2e5, "id/growth_per_period": "Infinity"})
    rows = table(found, records_of(jobs), found.figures[0])
    assert rows["prior"]["a"].mean == pytest.approx(2.0) and rows["ours"][
        "a"
    ].mean == pytest.approx(3.0)
    assert rows["ours"]["a"].sd is None and rows["ours"]["a"].text(2) == "3.00"
    assert table(found, records_of(jobs), found.figures[1])["ours"]["a"].text(2) == "diverged"


def test_the_page_says_where_its_figures_come_from_and_what_is_missing(tmp_path):
    found, jobs = made_up(tmp_path / "runs")
    page = write_results(
        replace(found, printed="generalisation"), jobs, tmp_path / "results", "the command"
    )
    text = page.read_text()
    for part in ("| ours ", "11.0 ± 1.4", "`the command`", "seeds: 0, 1", "a machine", "6 of 8 jobs complete",
                 "12.0 minutes", "The paper prints", "31.35", "made.png"):  # fmt: skip
        assert part in text, part
    assert text.count("- not run: 2 jobs (") == 1
    assert (tmp_path / "results" / "made.png").stat().st_size > 1000 and (
        tmp_path / "results" / "made.pdf"
    ).is_file()
    lines = (tmp_path / "results" / "made.csv").read_text().splitlines()
    assert (
        lines[0] == "method,scene,seed,label,figure,value,run" and len(lines) == 1 + 3 * 2 * 2 * 2
    )


def test_results_that_cannot_be_written_leave_the_ones_before(tmp_path, monkeypatch):
    """A full disk in the middle of each file in turn: the old file stands, and nothing half-written beside it."""
    found, jobs = made_up(tmp_path / "runs")
    results = tmp_path / "results"
    write_results(found, jobs, results, "the first command")
    before = {file.name: file.read_bytes() for file in results.iterdir()}
    assert {"made.csv", "made.md", "made.json", "made.png", "made.pdf"} <= set(before)
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
    assert (
        "0 of 8 jobs complete" in page.read_text()
        and not (tmp_path / "results" / "made.png").exists()
    )


def test_a_damaged_metrics_file_is_named(tmp_path):
    _, jobs = made_up(tmp_path)
    (jobs[0].folder / "metrics.json").write_text("{")
    with pytest.raises(
        DataError, match=r"metrics\.json.*belongs to the job adapter=operator scene=a seed=0"
    ):
        records_of(jobs)


def test_a_time_that_a_kill_left_half_written_is_taken_from_the_figures(tmp_path):
    job = made_up(tmp_path)[1][0]
    write_metrics(job, **{"time/data_s": 120.0})
    (job.folder / MINUTES).write_text("3.5")
    assert minutes_taken(job) == 3.5
    (job.folder / MINUTES).write_text("")
    assert minutes_taken(job) == pytest.approx(3.0)


def test_the_command_is_written_without_folders_of_this_machine():
    words = [
        "table_time",
        "--quick",
        "--runs",
        "/a/b",
        "--results",
        "/c",
        "--only",
        "method=prior only",
        "--set",
        "x=1",
    ]
    options = arguments(words)
    assert (
        shown(options) == "mosa-experiment table_time --quick --only 'method=prior only' --set x=1"
    )


def test_tables_of_which_no_job_is_complete_stay_as_they_are(tmp_path, capsys):
    """`all --collect` in a clone emptied the tables of docs/results that had been run elsewhere."""
    runs, results = tmp_path / "runs", tmp_path / "results"
    options = ["--collect", "--runs", str(runs), "--results", str(results)]
    with pytest.raises(ConfigError, match="--collect: expected a complete job of table_time in"):
        run(arguments(["table_time", *options]))
    assert not results.exists()
    found = load_experiment(PAPER, "table_future")
    write_metrics(jobs_of(found, runs)[0])
    assert run(arguments(["table_future", "table_time", *options])) == 0
    assert {path.stem for path in results.iterdir()} == {"table_future"}


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
def test_a_quick_variant_runs_to_its_table_and_is_not_run_again(
    cache, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(specimens, "ANGLES", 4)
    monkeypatch.setattr(running, "PROGRAM", "starts_once:train")
    monkeypatch.setattr(workers, "ProcessPoolExecutor", fork())
    words = ["table_generalisation", "figure_heterogeneity", "--quick", "--runs", str(tmp_path / "runs"), "--seeds", "0",
             "--only", "method=ours"]  # fmt: skip
    more = [f"scene.cache={cache}", "evaluation.samples=500", "evaluation.assignment=100", "evaluation.floor=false",
            "reconstruction.informed.iterations=0", "identification.grid_error=0"]  # fmt: skip
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
    one = narrowed(
        load_experiment(PAPER, "table_generalisation", quick=True), {"method": ["ours"]}, (0,)
    )
    text, pictures = ANALYSES["directions"](
        one, records_of(jobs_of(one, tmp_path / "runs", more)), tmp_path / "law"
    )
    assert "| tiny  | ours" in text and len(pictures) == 1
    rows = [
        line.split(",") for line in (tmp_path / "law_directions.csv").read_text().splitlines()[1:]
    ]
    (tiny,) = one.axes["scene"]
    two = replace(
        one, axes=one.axes | {"scene": (tiny, replace(tiny, name="again"))}
    )  # the same run in two columns
    text, _ = ANALYSES["compression"](
        two, records_of(jobs_of(two, tmp_path / "runs", more)), tmp_path / "law"
    )
    assert (
        "| tiny  | ours" in text
        and "| again | ours" in text
        and (tmp_path / "law_plates.png").is_file()
    )
    plates = [
        line.split(",") for line in (tmp_path / "law_plates.csv").read_text().splitlines()[1:]
    ]
    assert [row[:2] for row in plates[::5]] == [
        ["tiny", "ours"],
        ["again", "ours"],
    ]  # four directions and the fibres'
    assert len(plates) == 2 * 5 and [row[2:] for row in plates[:5]] == [
        row[2:] for row in plates[5:]
    ]
    pressed = [float(row[4]) for row in plates[:5]]
    assert max(pressed) / min(pressed) == pytest.approx(
        1.6, rel=0.1
    )  # of the truth, between plates
    for job in jobs_of(two, tmp_path / "runs", more):
        (job.folder / "checkpoints" / "last.ckpt").unlink(missing_ok=True)
    kept, _ = ANALYSES["compression"](
        two, records_of(jobs_of(two, tmp_path / "runs", more)), tmp_path / "law"
    )
    assert kept == text  # what was measured is in the run's folder
    true = [float(row[5]) for row in rows]
    assert true[0] / true[18] == pytest.approx(
        1.6, rel=0.01
    )  # along the rabbit's fibres and across
    assert float(rows[0][4]) > 0 and float(rows[0][3]) >= 0


def test_a_claim_of_a_figure_or_row_that_is_not_there_is_a_mistake_of_the_file():
    figures = (Figure("a", "x"),)
    for found, message in (({"text": "t", "figure": "b", "most": 1}, "expected one of a, found 'b'"),
                           ({"text": "t", "figure": "a"}, "row with against, or most"),
                           ({"text": "t", "figure": "a", "rwo": "x"}, "rwo: unknown key")):  # fmt: skip
        with pytest.raises(ConfigError, match=message):
            claim_of("f: claims[0]", found, figures)
    for name in NAMES:  # rows that the claims name are rows
        made = load_experiment(PAPER, name)
        rows = {option.name for option in made.axes[made.rows]}
        assert {
            row for claim in made.claims if claim.row for row in (claim.row, *claim.against)
        } <= rows, name
