"""What the site needs beside Markdown: equations as MathML, files of the repository by their names, notebooks out of the search."""

import re

from latex2mathml.converter import convert


def formula(source, language, css_class, options, md, **kwargs):
    """A fence ```math, which GitHub shows as an equation too."""
    return "".join(
        convert(line.removesuffix(r"\\"), display="block") for line in source.splitlines() if line
    )


def on_config(config):
    fence = {"name": "math", "class": "math", "format": formula}
    config.mdx_configs.setdefault("pymdownx.superfences", {})["custom_fences"] = [fence]
    return config


def on_page_markdown(markdown, page, **kwargs):
    if page.file.src_uri.startswith("lab/"):
        page.meta["search"] = {"exclude": True}
    # a file outside of docs/ is no page of the site: its name stands there as text
    return re.sub(
        r"\[([^\]]+)\]\((?:\.\./)+(?:mosa|conf|tests|benchmarks)/[^)]*\)", r"`\1`", markdown
    )
