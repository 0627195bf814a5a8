"""What README and docs name is there: files, pages and their sections, and the ten stops from the command to the kernel."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


def anchor(heading: str) -> str:
    """Of a heading, as the pages' host makes it."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def anchors(page: Path) -> set[str]:
    return {anchor(line.lstrip("#")) for line in page.read_text().splitlines() if line.startswith("#")}


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
