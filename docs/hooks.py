"""MkDocs hooks that add the pages outside of docs/ and the experiments, and render formulas without a script."""

from __future__ import annotations

import re
from html import unescape
from pathlib import Path

import jupytext
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
_EXPERIMENTS = "experiments"
"""Folder of the experiments, and of their pages."""
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
_SHORT_CODE = re.compile(r"<code>([^<]{1,24})</code>")
"""Short code. A browser would break its lines after the hyphens of an option."""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """List the experiments under the heading `Experiments`."""
    pages = [f"{_page(source, config)}.md" for source in _experiments(config)]
    for section in config.nav or []:
        if "Experiments" in section:
            section["Experiments"] = pages
    return config


def _experiments(config: MkDocsConfig) -> list[Path]:
    """Return the experiments: scripts with cells (`# %%`)."""
    scripts = sorted((Path(config.config_file_path).parent / _EXPERIMENTS).rglob("*.py"))
    return [script for script in scripts if script.read_text(encoding="utf-8").startswith("# %%")]


def _page(source: Path, config: MkDocsConfig) -> str:
    """Return the address of an experiment's page and notebook, without the suffix."""
    return source.relative_to(Path(config.config_file_path).parent).with_suffix("").as_posix()


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages outside of docs/, the experiments as pages and notebooks, and files to which the README links."""
    root = Path(config.config_file_path).parent
    for source in _experiments(config):
        notebook, page = jupytext.read(source), _page(source, config)
        title, _, text = jupytext.writes(notebook, "md").partition("\n")
        note = (
            f"*[Notebook]({source.stem}.ipynb) of `{page}.py`, without outputs. In Colab, clone the repository and "
            "change to its folder first.*"
        )
        files.append(File.generated(config, f"{page}.md", content=f"{title}\n\n{note}\n{text}"))
        files.append(File.generated(config, f"{page}.ipynb", content=jupytext.writes(notebook, "ipynb")))
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
