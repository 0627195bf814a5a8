"""README and docs: named files, links and sections exist, figures are those of their source, the site builds, ten stops."""

import importlib.util
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

import mosa

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "SECURITY.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
LAB = ROOT / "docs" / "lab"
"""Dated notebooks: the files that they name may be gone."""


def anchor(heading: str) -> str:
    """Of a heading, as the pages' host makes it."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def anchors(page: Path) -> set[str]:
    return {
        anchor(line.lstrip("#")) for line in page.read_text().splitlines() if line.startswith("#")
    }


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_what_a_page_names_is_there(page):
    text = page.read_text()
    named = re.findall(r"`((?:mosa|benchmarks|tests|conf|docs)/[\w/.-]+\.(?:py|yaml|md))`", text)
    assert page.parent == LAB or not [name for name in named if not (ROOT / name).is_file()]
    for link in re.findall(r"\]\((?!https?:)([^)\s]+)\)", text):
        path, _, section = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), link
        assert not section or section in anchors(target), link


def test_figures_of_the_readme_are_those_of_the_files_that_it_names():
    """A comment above a table names its sources; every figure of the table stands in one of them."""
    tables = re.findall(
        r"<!-- figures: ([^>]+?) -->\n((?:\|.*\n)+)", (ROOT / "README.md").read_text()
    )
    assert len(tables) == 3
    for sources, table in tables:
        text = "".join((ROOT / name).read_text() for name in sources.split())
        figures = re.findall(r"\d+\.\d+(?:e\d+)?(?: ± \d+\.\d+)?", table)
        assert figures and not [
            each for each in figures if not re.search(rf"(?<![\d.]){re.escape(each)}(?!\d)", text)
        ], sources


def test_commands_of_the_guides_name_options_that_exist():
    conf = ROOT / "conf"
    groups = {folder.name for folder in conf.iterdir() if folder.is_dir()}
    pages = [page for page in PAGES if page.parent != LAB]
    lines = [
        line.partition("  #")[0]
        for page in pages
        for line in page.read_text().splitlines()
        if re.match(r"(OMP_NUM_THREADS=1 )?(python train\.py|mosa-train) ", line)
    ]
    named = {
        (group, option)
        for line in lines
        for group, options in re.findall(r" ([a-z_]+)=([\w,]+)(?= |$)", line)
        if group in groups
        for option in options.split(",")
    }
    own = {"soft_duck", "fibres", "softer"}  # files that a page of docs/ writes
    assert len(named) > 20
    assert not [
        f"{group}={option}"
        for group, option in named
        if option not in own and not (conf / group / f"{option}.yaml").is_file()
    ]


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="pip install '.[docs]'")
def test_the_site_builds_strictly(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-d", str(tmp_path)]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0, found.stderr[-3000:]


def test_the_ten_stops_are_in_the_code():
    text = (ROOT / "docs" / "theory_to_code.md").read_text().partition("## Ten stops")[2]
    sources = {path: path.read_text() for path in (ROOT / "mosa").rglob("*.py")}
    whole = "\n".join(sources.values())
    stops = re.split(r"\n(?=\d+\. )", text)[1:]
    assert len(stops) == 10
    for stop in stops:
        for name in re.findall(r"`([\w.]+)`", stop):
            if name.endswith(".py"):
                assert any(path.name == name for path in sources) or (ROOT / name).is_file(), name
            else:
                last = name.rpartition(".")[2]
                assert re.search(rf"(def|class) {last}\b|^\s*{last} = ", whole, re.MULTILINE), name


def test_the_citation_names_this_version_and_the_authors_of_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    (paper,) = citation["references"]
    authors = " and ".join(
        f"{each['family-names']}, {each['given-names']}" for each in paper["authors"]
    )
    readme = (ROOT / "README.md").read_text()
    assert (
        citation["version"] == mosa.__version__
        and f"## {mosa.__version__} " in (ROOT / "CHANGELOG.md").read_text()
    )
    assert f"author = {{{authors}}}" in readme and paper["url"] in readme
    assert paper["title"] in readme.replace("{MoSA}", "MoSA") and str(paper["year"]) in readme


def test_a_change_has_a_fragment_of_a_known_kind():
    with open(ROOT / "pyproject.toml", "rb") as file:
        kinds = {kind["directory"] for kind in tomllib.load(file)["tool"]["towncrier"]["type"]}
    fragments = [path.name for path in (ROOT / "changelog.d").iterdir() if path.name != "README.md"]
    assert not [
        name for name in fragments if not re.fullmatch(rf"\+?[\w-]+\.({'|'.join(kinds)})\.md", name)
    ]
