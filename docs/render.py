"""Render tables of `results/*.json` into the marked places of README and docs.

python docs/render.py           # rewrite the pages
python docs/render.py --check   # name the pages that differ, and fail if there are any

A mark names the file and its tables. `caption` stands for a paragraph about the origin of the numbers:

    <!-- results: main_job short caption -->
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
_MARK = re.compile(r"<!-- results: (?P<file>[\w-]+) (?P<parts>[\w-]+(?: [\w-]+)*) -->\n.*?<!-- /results -->", re.DOTALL)
_OPENED = re.compile(r"<!-- results:")


def render_page(text: str, results: Path = RESULTS) -> str:
    """Return a page with the current tables of the files in `results`.

    **Raises** `InputError` if a file or table is missing, or if a mark has no end.
    """
    if len(_OPENED.findall(text)) != len(_MARK.findall(text)):
        raise InputError("A mark is invalid or has no end; write <!-- results: FILE TABLE -->, then <!-- /results -->.")

    def rendered(found: re.Match[str]) -> str:
        path = results / f"{found['file']}.json"
        content = read_results(path)
        bodies = []
        for name in found["parts"].split():
            if name == CAPTION:
                bodies.append(textwrap.fill(content.caption(), _WIDTH, break_long_words=False, break_on_hyphens=False))
            elif name in content.tables:
                bodies.append(content.tables[name].to_markdown())
            else:
                raise InputError(f"{path} has no table {name!r}; it has {', '.join(content.tables)}.")
        body = "\n\n".join(bodies)
        return f"<!-- results: {found['file']} {found['parts']} -->\n{body}\n<!-- /results -->"

    return _MARK.sub(rendered, text)


def rendered_names(text: str) -> set[str]:
    """Return the names of the result files whose tables a page shows."""
    return {found["file"] for found in _MARK.finditer(text)}


def main(arguments: list[str]) -> int:
    """Rewrite the pages, or with --check name those that differ and return 1 if there are any."""
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
