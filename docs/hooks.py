"""MkDocs hooks that add the pages outside of docs/, and render formulas without script and network."""

from __future__ import annotations

import re
from html import unescape
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

_OUTSIDE = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "benchmarks/README.md": "benchmarks.md",
}
_LINKED = ("CITATION.cff", "LICENSE")
"""Files that are not pages, but to which the README links."""
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
_SHORT_CODE = re.compile(r"<code>([^<]{1,24})</code>")
"""Short code. A browser would break its lines after the hyphens of an option."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages outside of docs/, and the files to which the README links."""
    root = Path(config.config_file_path).parent
    for source, page in _OUTSIDE.items():
        files.append(File.generated(config, page, content=(root / source).read_text(encoding="utf-8")))
    for name in _LINKED:
        files.append(File.generated(config, name, abs_src_path=str(root / name)))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Convert links for GitHub to links that are relative to docs/."""
    markdown = re.sub(r"\]\((?:\.\./)?docs/", "](", markdown)
    for source, page in _OUTSIDE.items():
        markdown = re.sub(rf"\]\((?:\.\./)?{re.escape(source)}(#[^)]*)?\)", rf"]({page}\1)", markdown)
    return markdown


def on_page_content(html: str, **_: object) -> str:
    """Convert LaTeX to MathML, make wide formulas scroll separately, and keep short code in one line."""

    def formula(found: re.Match[str]) -> str:
        if found[1] == "div":
            return f'<div class="formula">{convert(unescape(found[2]), display="block")}</div>'
        return convert(unescape(found[2]), display="inline")

    return _SHORT_CODE.sub(r'<code class="short">\1</code>', _FORMULA.sub(formula, html))
