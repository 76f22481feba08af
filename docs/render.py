"""Render tables of `results/*.json` into README and docs, where their marks stand.

python docs/render.py           # rewrite the pages
python docs/render.py --check   # name the pages that differ, and fail where there are any

A mark names the file and the table; `caption` says where the numbers come from:

    <!-- results: main_job short -->
    <!-- /results -->
    <!-- results: main_job caption -->
    <!-- /results -->
"""

from __future__ import annotations

import re
import sys
import textwrap
from pathlib import Path

import prose

from ballu_mjx.common.errors import InputError
from ballu_mjx.common.results import read_results

RESULTS = prose.ROOT / "results"
CAPTION = "caption"
_WIDTH = 120
_MARK = re.compile(r"<!-- results: (?P<file>[\w-]+) (?P<table>[\w-]+) -->\n(?P<old>.*?)<!-- /results -->", re.DOTALL)
_OPENED = re.compile(r"<!-- results:")


def render_page(text: str, results: Path = RESULTS) -> str:
    """Return a page with its tables as the files in `results` have them.

    **Raises** `InputError` for a file or table that is not there, and for a mark without end.
    """
    if len(_OPENED.findall(text)) != len(_MARK.findall(text)):
        raise InputError("A mark has no end, or is none: <!-- results: FILE TABLE -->, then <!-- /results -->.")

    def rendered(found: re.Match[str]) -> str:
        file, name = found["file"], found["table"]
        content = read_results(results / f"{file}.json")
        if name == CAPTION:
            body = textwrap.fill(content.caption(), _WIDTH, break_long_words=False, break_on_hyphens=False)
        elif name in content.tables:
            body = content.tables[name].to_markdown()
        else:
            raise InputError(f"{results / file}.json has no table {name!r}; it has {', '.join(content.tables)}.")
        # Blank lines: Markdown would take the comments for the table's first and last rows.
        return f"<!-- results: {file} {name} -->\n\n{body}\n\n<!-- /results -->"

    return _MARK.sub(rendered, text)


def rendered_names(text: str) -> set[str]:
    """Return the files whose tables a page shows."""
    return {found["file"] for found in _MARK.finditer(text)}


def main(arguments: list[str]) -> int:
    """Rewrite the pages, or with --check name those that differ; returns 1 where there are any."""
    differing = []
    for page in prose.pages():
        text = page.read_text(encoding="utf-8")
        new = render_page(text)
        if new != text:
            differing.append(page)
            if "--check" not in arguments:
                page.write_text(new, encoding="utf-8")
    for page in differing:
        print(f"{page.relative_to(prose.ROOT)}: {'differs' if '--check' in arguments else 'rendered'}")
    return 1 if differing and "--check" in arguments else 0


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except InputError as error:
        sys.exit(str(error))
