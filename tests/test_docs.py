"""README and docs: named files, links and sections exist, figures are those of their source."""

import importlib.util
import re
import tomllib
from importlib.machinery import SourceFileLoader
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
    """A comment names the sources of all figures from it to the next heading, in tables and sentences."""
    readme = (ROOT / "README.md").read_text()
    assert len(readme.splitlines()) <= 120
    parts = re.findall(
        r"<!-- figures: ([^>]+?) -->\n(.+?)(?=\n## |<!-- figures|\Z)", readme, re.DOTALL
    )
    assert len(parts) == 3
    number = r"\d+\.\d+(?:e\d+)?(?: ± \d+\.\d+)?"
    for sources, said in parts:
        text = "".join((ROOT / name).read_text() for name in sources.split())
        figures = re.findall(number, re.sub(r"[Vv]ersion [\d.]+", "", said))
        assert figures and not [
            each for each in figures if not re.search(rf"(?<![\d.]){re.escape(each)}(?!\d)", text)
        ], sources
    rest = re.sub(r"<!-- figures.+?(?=\n## |<!-- figures|\Z)", "", readme, flags=re.DOTALL)
    untraced = re.findall(rf"{number}(?= ?(?:mm|dB|degrees|%|s\b|GB))", rest)
    assert not untraced


@pytest.fixture(scope="module")
def prose():
    loader = SourceFileLoader("prose", str(ROOT / ".ci" / "prose"))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader("prose", loader))
    loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    "text",
    [
        "What a run leaves",
        "motions of the learned law, of its prior, what was seen, what is true where that is known",
        "What is left is the corotated law's form, which is not the truth's, and the run knows it",
        "none on the last three, but that chick2 made us widen eta's bound",
        "A direction that one drop does not tell is named as such, and is not always wrong then.",
        "A model below it has made up for a part of the grid's error.",
        "What images do not say then speaks neither for nor against the prior.",
        "Not seen: a focal length that is wrong in all cameras by less than a fifth",
        "Nor is more to be had from more looks: after six the letter is where it was after three.",
        "The jobs of what is named first begin first, of one word the longest.",
        "With three cameras the stretch cue knows less than nothing.",
        "Pushing cannot tell simulators apart, as whoever sees the body corrects what its law does.",
        "The figures are of commit c80805f.",
        "| check | asked |\n|---|---|\n| volume | 1.4 %, met |",
        "| law | mm |\n|---|---|\n| prior | 0.87 / 2.84 |",
        " ".join(["word"] * 41) + ".",
    ],
)
def test_the_linter_finds_what_readers_read_twice(prose, tmp_path, monkeypatch, text):
    monkeypatch.setattr(prose, "ROOT", tmp_path)
    page = tmp_path / "page.md"
    page.write_text(text + "\n")
    assert prose.findings(page)[0]
    page.write_text("Run outputs are in one folder. The uncertainty covers 96 % of the errors.\n")
    assert not prose.findings(page)[0]


def test_the_walks_are_short_and_their_stops_are_in_the_code():
    text = (ROOT / "docs" / "theory_to_code.md").read_text().partition("## Ways through")[2]
    sources = {path: path.read_text() for path in (ROOT / "mosa").rglob("*.py")}
    whole = "\n".join(sources.values())
    walks = [re.split(r"\n(?=\d+\. )", walk)[1:] for walk in text.split("\n### ")[1:]]
    assert len(walks) == 4 and all(8 <= len(walk) <= 12 for walk in walks)
    stops = [stop for walk in walks for stop in walk]
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
