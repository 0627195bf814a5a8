"""The page of all settings is the one that the models make."""

from pathlib import Path

from mosa.config.reference import page

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "configuration.md"


def test_the_page_of_all_settings_is_true():
    """python -m mosa.config.reference > docs/reference/configuration.md"""
    assert PAGE.read_text() == page()
