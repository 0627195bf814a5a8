"""The page of all settings is the one that the models make."""

from pathlib import Path

import pytest

from mosa.config.reference import main, page

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "configuration.md"


def test_the_page_of_all_settings_is_true():
    """python -m mosa.config.reference > docs/reference/configuration.md"""
    assert PAGE.read_text() == page()


def test_a_key_that_is_not_there_is_named_with_the_nearest(capsys):
    main(["eval", "simulate.height"])
    assert capsys.readouterr().out.startswith("simulate.height = null\n    m, lowest point")
    main(["eval", "simulate.velocity.x"])
    assert capsys.readouterr().out.startswith("simulate.velocity = ")
    main(["train", "trainer.max_epochs"])
    assert capsys.readouterr().out.startswith("trainer.max_epochs = -1\n    the last stage ends")
    main(["train", "trainer.profiler"])
    assert "Lightning's Trainer" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        main(["eval", "simulate.hight"])
    found = capsys.readouterr()
    assert (
        not found.out
        and "simulate.hight" in found.err
        and "nearest is simulate.height" in found.err
    )
