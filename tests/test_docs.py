"""What README and docs name is there: files, pages and their sections, and the ten stops from the command to the kernel."""

import re
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
    *sorted((ROOT / "docs").glob("*.md")),
]


def anchor(heading: str) -> str:
    """Of a heading, as the pages' host makes it."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def anchors(page: Path) -> set[str]:
    return {
        anchor(line.lstrip("#")) for line in page.read_text().splitlines() if line.startswith("#")
    }


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_what_a_page_names_is_there(page):
    text = page.read_text()
    named = re.findall(r"`((?:mosa|benchmarks|tests|conf|docs)/[\w/.-]+\.(?:py|yaml|md))`", text)
    assert not [name for name in named if not (ROOT / name).is_file()]
    for link in re.findall(r"\]\((?!https?:)([^)\s]+)\)", text):
        path, _, section = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), link
        assert not section or section in anchors(target), link


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
