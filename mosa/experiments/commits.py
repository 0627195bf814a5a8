"""Which state of the program made a result, and how much has changed since, as far as git knows."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Sequence
from pathlib import Path

import mosa

PROGRAM = ("mosa", "conf")  # folders of the checkout that figures come from


def git(*words: str) -> str | None:
    """What git says in the checkout that the package lies in; None where there is none, or no such thing in it."""
    try:
        return subprocess.run(["git", "-C", str(Path(mosa.__file__).parents[1]), *words], capture_output=True, text=True,
                              check=True).stdout.strip()  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        return None


def commit() -> str:
    """Of the checkout that the package lies in, with a mark where it has changes; `unknown` where it is installed."""
    found = git("rev-parse", "--short=12", "HEAD")
    changed = git("status", "--porcelain", "--untracked-files=no")
    if found is None or changed is None:
        return "unknown"
    return found + (", with changes" if changed else "")


def commits_since(lines: Sequence[str]) -> tuple[str, int] | None:
    """(commit, number of commits that have changed the program since) of the lines that say where figures come from; None where
    these name no commit that git knows."""
    named = re.search(r"\bcommit ([0-9a-f]{7,40})\b", "; ".join(lines))
    count = git("rev-list", "--count", f"{named[1]}..HEAD", "--", *PROGRAM) if named else None
    return None if count is None else (named[1], int(count))
