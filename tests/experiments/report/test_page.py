"""The page of results: claims against figures, and where these come from."""

import math
import re
from dataclasses import replace

import pytest
from made_up import NAMES, PAPER, experiment, made_up, write_metrics

from mosa.cli.experiment import arguments, run
from mosa.errors import ConfigError, DataError
from mosa.experiments import commits
from mosa.experiments.collecting import Cell
from mosa.experiments.report.page import listed, ranges, state_of, verdict
from mosa.experiments.report.writing import made_by, write_results
from mosa.experiments.specification import (
    Claim,
    Figure,
    jobs_of,
    load_experiment,
    narrowed,
)


def cells(**rows) -> dict:
    return {row: {"mean": None if value is None else Cell(*value)} for row, value in rows.items()}


def of_columns(**rows) -> dict:
    """Rows of figures in the columns a, b, c, of one seed."""
    return {row: {column: None if value is None else Cell(value, None, 1) for column, value in zip("abc", values)}
            for row, values in rows.items()}  # fmt: skip


def test_a_claim_holds_only_by_more_than_the_spread_of_the_seeds():
    found = experiment()
    claim = Claim("ours is ahead", "rms [mm]", row="ours", against=("prior", "box"))
    for rows, begins in (
        (
            cells(ours=(10.0, 0.5, 3), prior=(20.0, 0.5, 3), box=(12.0, 0.5, 3)),
            "holds, 10.0 ± 0.5 against 20.0 ± 0.5 (prior)",
        ),
        (
            cells(ours=(10.0, 2.0, 3), prior=(20.0, 0.5, 3), box=(11.0, 2.0, 3)),
            "within the spread, ",
        ),
        (cells(ours=(10.0, 0.1, 3), prior=(20.0, 0.5, 3), box=(9.0, 0.1, 3)), "does not hold, "),
        (cells(ours=None, prior=(20.0, 0.5, 3), box=(9.0, 0.1, 3)), "not run"),
    ):
        assert verdict(found, claim, {"rms [mm]": rows}).startswith(begins)
    one = verdict(
        found, claim, {"rms [mm]": cells(ours=(10.0, None, 1), prior=(20.0, None, 1), box=None)}
    )
    assert (
        one
        == "holds against those that were run, 10.0 against 20.0 (prior); not run: box; one seed"
    )
    near = verdict(
        found,
        claim,
        {"rms [mm]": cells(ours=(4.546, None, 1), prior=(4.499, None, 1), box=(9.0, None, 1))},
    )
    assert near == "does not hold, 4.55 against 4.50 (prior), 4.5 against 9.0 (box); one seed"
    best = Claim("more is better", "PSNR", row="ours", against=("prior",))
    assert verdict(
        found, best, {"PSNR": cells(ours=(30.0, None, 1), prior=(31.0, None, 1))}
    ).startswith("does not hold")


def test_rows_are_compared_where_both_were_run_and_that_is_said():
    """A column in which the other one diverged is no part of the means, and counts as one in which it is worse."""
    claim = Claim("ours is ahead", "rms [mm]", row="ours", against=("prior", "box"))
    rows = of_columns(ours=(10.0, 12.0, 30.0), prior=(20.0, 22.0, 24.0), box=(15.0, None, math.inf))
    assert verdict(experiment(), claim, {"rms [mm]": rows}) == (
        "holds, 17.3 against 22.0 (prior; better in 2 of 3), 10.0 against 15.0 (box; better in 2 of 2; without b, c); one seed"
    )
    behind = rows | of_columns(box=(9.0, None, math.inf))
    assert verdict(experiment(), claim, {"rms [mm]": behind}).startswith(
        "does not hold, 17.3 against"
    )
    sds = {
        "ours": {"a": Cell(10.0, 3.0, 3), "b": Cell(10.0, 4.0, 3)},
        "prior": {"a": Cell(12.0, 0.0, 3), "b": Cell(12.0, 0.0, 3)},
    }
    assert verdict(experiment(), replace(claim, against=("prior",)), {"rms [mm]": sds}) == (
        "within the spread, 10.0 ± 2.5 against 12.0 ± 0.0 (prior; better in 2 of 2)"
    )  # of the mean sqrt(3^2 + 4^2) / 2


def test_a_claim_of_every_column_names_those_in_which_it_fails():
    claim = Claim("gains under each", "PSNR", row="ours", against=("prior",), each=True)
    rows = of_columns(ours=(30.0, 28.0, -math.inf), prior=(29.0, 29.0, 25.0))
    assert verdict(experiment(), claim, {"PSNR": rows}) == (
        "does not hold, ahead in 1 of 3 (a); b: 28.00 against 29.00 (prior); c: diverged; one seed"
    )
    better = of_columns(ours=(30.0, 30.0, 26.0), prior=(29.0, 29.0, -math.inf))
    assert verdict(experiment(), claim, {"PSNR": better}) == "holds, ahead in 3 of 3; one seed"
    rows = of_columns(ours=(29.2, 31.0, 30.0), prior=(29.0, 30.0, 29.0))
    near = verdict(experiment(), replace(claim, spread=0.5), {"PSNR": rows})
    assert near == "does not hold, ahead in 2 of 3 (b, c); a: 29.20 against 29.00 (prior); one seed"
    assert (
        verdict(
            experiment(),
            claim,
            {"PSNR": of_columns(ours=(None, None, None), prior=(1.0, 1.0, 1.0))},
        )
        == "not run"
    )


def test_of_one_seed_a_difference_has_to_be_more_than_the_spread_that_is_given():
    claim = Claim("helps", "PSNR", row="ours", against=("prior",), spread=0.3)
    rows = {
        gain: cells(ours=(30.0 + gain, None, 1), prior=(30.0, None, 1))
        for gain in (0.2, 0.4, -0.2, -0.4)
    }
    said = {
        gain: verdict(experiment(), claim, {"PSNR": found}).partition(",")[0]
        for gain, found in rows.items()
    }
    assert said == {
        0.2: "within the spread",
        0.4: "holds",
        -0.2: "within the spread",
        -0.4: "does not hold",
    }


def test_a_bound_excuses_what_the_posterior_says_is_not_determined():
    claim = Claim("within 5 %", "PSNR", most=5.0, unless="rms [mm]")
    rows = cells(a=(3.0, None, 1), b=(40.0, None, 1), c=(9.0, None, 1))
    said = verdict(
        experiment(),
        claim,
        {"PSNR": rows, "rms [mm]": cells(a=(1.0, None, 1), b=(25.0, None, 1), c=(1.0, None, 1))},
    )
    assert said == "does not hold, 1 of 3 within 5; not determined: b (40.0); beyond it: c (9.0)"
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
    said = verdict(
        found, claim, {"mu [%]": cells(a=(off, None, 1)), "sd of mu [%]": cells(a=(sd, None, 1))}
    )
    assert said.startswith("does not hold" if determined else "none is determined")


def test_the_page_has_what_was_run_and_says_what_was_not(tmp_path):
    found = narrowed(
        load_experiment(PAPER, "table_generalisation"), {"scene": ["rabbit", "peanut"]}, (0,)
    )
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
    assert glance["Ablations of the paper's adapter and of its motion cues"] == [
        "not run",
        "",
        "4 not run",
        "",
    ]
    jobs_complete, _, papers, about_ours = glance["Generalisation to drops that were not seen"]
    assert (
        jobs_complete == "4 of 4"
        and papers == "2 not run"
        and about_ours == "2 hold against what was run"
    )
    for name in NAMES:
        assert f"## {load_experiment(PAPER, name).title}" in text
    assert "](results/table_generalisation.md)" in text and "`the command`" not in text
    whole = (tmp_path / "docs" / "results" / "table_generalisation.md").read_text()
    assert "`the command`" in whole and "31.35" in whole and "](table_generalisation.png)" in whole
    least = "our default has the smallest error of all"
    assert (
        f"{least}: **holds against those that were run**\n    - 10.0 against 20.0 (prior only; better in 2 of 2)\n"
        in text
    )
    assert "30.0 (NeuMA; better in 2 of 2); not run: " in text
    assert "Not run. Command: `mosa-experiment table_ablation`" in text
    with pytest.raises(ConfigError, match="--results: expected a folder"):
        run(arguments(["--page", "--results", str(tmp_path / "nothing")]))
    (tmp_path / "docs" / "results" / "table_generalisation.json").write_text("{}")
    with pytest.raises(DataError, match=r"table_generalisation\.json"):
        run(arguments(["--page", "--results", str(tmp_path / "docs" / "results")]))


@pytest.mark.parametrize(
    ("count", "said"),
    [
        ("3", "0.1.0, 0123456789ab, with changes (3)"),
        ("0", "0.1.0, 0123456789ab, with changes (0)"),
        (None, "0.1.0"),
    ],
)
def test_the_page_counts_the_changes_of_the_program_since_its_figures(monkeypatch, count, said):
    """Of a commit that this checkout does not know, it says the version alone."""
    asked = []
    monkeypatch.setattr(commits, "git", lambda *words: asked.append(words) or count)
    found = state_of(
        [
            "command: `mosa-experiment all`",
            "version 0.1.0, commit 0123456789ab, with changes",
            "2 of 2 jobs complete",
        ]
    )
    assert asked == [("rev-list", "--count", "0123456789ab..HEAD", "--", "mosa", "conf")]
    assert found == ("2 of 2", said)
    assert state_of(["2 of 2 jobs complete", "version 0.1.0, commit unknown"])[1] == "0.1.0"
    assert len(asked) == 1


def test_a_map_says_its_smallest_and_largest_cell():
    made = replace(experiment(), figures=(Figure("mm", "rms", decimals=1), Figure("dB", "psnr")))
    rows = of_columns(slow=(3.0, 1.25, None), fast=(math.inf, 2.0, 9.0))
    assert ranges(made, {"mm": rows}) == (
        f"- mm ({made.rows}, {made.columns}): 1.2 (slow, b) to 9.0 (fast, c)"
    )


def test_each_comparison_of_a_claim_is_an_item_of_its_own():
    said = "holds, 9.1 ± 0.2 against 19.8 ± 0.0 (prior; better in 6 of 7), 9.1 ± 0.2 against 3.0 (box); not run: x"
    assert listed("ours", said).splitlines() == [
        "- ours: **holds**",
        "    - 9.1 ± 0.2 against 19.8 ± 0.0 (prior; better in 6 of 7)",
        "    - 9.1 ± 0.2 against 3.0 (box); not run: x",
    ]
    assert listed("moduli", "does not hold, 1 of 2 within 5 %; beyond it: a (9.0), b (7.0)") == (
        "- moduli: **does not hold**\n    - 1 of 2 within 5 %; beyond it: a (9.0), b (7.0)"
    )
    assert listed("speed", "not run") == "- speed: **not run**"


def test_results_name_the_commits_that_their_runs_were_made_with(tmp_path):
    """Not the one that collects them: the commonest first, and the others with how many they are."""
    found, jobs = made_up(tmp_path)
    complete = [job for job in jobs if job.finished]
    assert made_by(complete) == f"commit {commits.commit()}"
    for job, made in zip(
        complete, ("0123456789ab", "ba9876543210, with changes") + ("0123456789ab",) * 9
    ):
        (job.folder / "commit.txt").write_text(made + "\n")
    assert made_by(complete) == "commit 0123456789ab (1 job of ba9876543210, with changes)"
    page = write_results(found, jobs, tmp_path / "results", "the command").read_text()
    assert "commit 0123456789ab (1 job of ba9876543210, with changes)" in page


def test_the_commit_of_a_result_is_that_of_the_checkout():
    assert re.fullmatch(r"unknown|[0-9a-f]{12}(, with changes)?", commits.commit())
    assert commits.git("no-such-command") is None
