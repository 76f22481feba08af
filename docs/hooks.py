"""What MkDocs leaves to do: the pages that stand outside of docs/, and formulas that need no script and no network."""

from __future__ import annotations

import re
from html import unescape
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

_OUTSIDE = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "benchmarks/README.md": "benchmarks.md"}
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add README, CONTRIBUTING and the benchmarks' README, their links as seen from docs/."""
    root = Path(config.config_file_path).parent
    for source, page in _OUTSIDE.items():
        text = (root / source).read_text(encoding="utf-8").replace("](docs/", "](")
        for other, its_page in _OUTSIDE.items():
            text = text.replace(f"]({other})", f"]({its_page})")
        files.append(File.generated(config, page, content=text))
    # No page, but linked to from the README.
    files.append(File.generated(config, "CITATION.cff", abs_src_path=str(root / "CITATION.cff")))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Links to what stands outside of docs/, as written for GitHub."""
    for other, its_page in _OUTSIDE.items():
        markdown = markdown.replace(f"](../{other})", f"]({its_page})")
    return markdown


def on_page_content(html: str, **_: object) -> str:
    """LaTeX to MathML."""

    def formula(found: re.Match[str]) -> str:
        return convert(unescape(found[2]), display="block" if found[1] == "div" else "inline")

    return _FORMULA.sub(formula, html)
