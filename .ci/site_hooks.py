"""What the site needs beside Markdown: equations as MathML, files of the repository by their names, notebooks out of the search,
CONTRIBUTING.md as a page."""

import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.structure.files import File


def formula(source, language, css_class, options, md, **kwargs):
    """A fence ```math, which GitHub shows as an equation too."""
    return "".join(
        convert(line.removesuffix(r"\\"), display="block") for line in source.splitlines() if line
    )


def on_config(config):
    fence = {"name": "math", "class": "math", "format": formula}
    config.mdx_configs.setdefault("pymdownx.superfences", {})["custom_fences"] = [fence]
    return config


def on_files(files, config):
    text = (Path(config.docs_dir).parent / "CONTRIBUTING.md").read_text()
    files.append(File.generated(config, "contributing.md", content=text))
    return files


def on_page_markdown(markdown, page, **kwargs):
    if page.file.src_uri.startswith("lab/"):
        page.meta["search"] = {"exclude": True}
    # a file outside of docs/ is no page of the site: its name stands there as text
    return re.sub(
        r"\[([^\]]+)\]\((?:\.\./)+(?:mosa|conf|tests|benchmarks)/[^)]*\)", r"`\1`", markdown
    )
