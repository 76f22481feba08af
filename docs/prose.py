"""Measure the prose of README and docs: sentences per page, words per sentence, and sentences that are too long.

python docs/prose.py           # print a table of the pages, and every sentence above the limit
"""

from __future__ import annotations

import re
import statistics
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
MOST_WORDS_ON_AVERAGE = 18.0
"""Largest mean number of words in a sentence, over all pages."""
MOST_WORDS = 35
"""Largest number of words in a sentence."""
README_LINES = 150
"""Largest number of lines of the README."""

_FENCE = re.compile(r"^[ \t]*(```|~~~).*?^[ \t]*\1[ \t]*$", re.MULTILINE | re.DOTALL)
_SHOWN_FORMULA = re.compile(r"\$\$.*?\$\$", re.DOTALL)
_FORMULA = re.compile(r"\$[^$\n]+?\$")
_CODE = re.compile(r"`[^`]+`")
_IMAGE = re.compile(r"!\[[^\]]*\]\([^)]*\)")
_LINK = re.compile(r"\[([^\]]*)\]\([^)]*\)")
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_ITEM = re.compile(r"^\s*(?:[-*+]|\d+\.)\s+")
_RULE = re.compile(r"^\|[\s:|-]+\|$")
_END = re.compile(r"(?<!\be\.g)(?<!\bi\.e)(?<!\bet al)(?<!\bvs)(?<=[.!?])[)\"'*]*\s+(?=[\"'(]*(?:[A-Z\d`]|\*+\w))")
_WORD = re.compile(r"[^\W_]")


def pages() -> list[Path]:
    """Return the pages of prose: README, docs without the API reference, and some pages outside of docs/."""
    beside = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "benchmarks/README.md")
    return [ROOT / name for name in beside] + sorted((ROOT / "docs").glob("*.md"))


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences in paragraphs and list items, not in headings, tables, code blocks or displayed formulas."""
    for block, is_table in _blocks(text):
        if not is_table:
            yield from _split(block)


def cell_sentences(text: str) -> Iterator[str]:
    """Yield the sentences in the table cells of a page."""
    for row, is_table in _blocks(text):
        if is_table and not _RULE.match(row.strip()):
            for cell in row.strip().strip("|").split("|"):
                yield from _split(cell)


def count_words(sentence: str) -> int:
    """Return the number of words. Code, a formula, and a number with the sign of its unit count as one word each."""
    return sum(bool(_WORD.search(word)) for word in sentence.split())


def long_sentences(text: str) -> list[str]:
    """Return all sentences of more than `MOST_WORDS` words, also those in table cells."""
    return [s for s in (*sentences(text), *cell_sentences(text)) if count_words(s) > MOST_WORDS]


def mean_words() -> float:
    """Return the mean number of words in a sentence over all pages."""
    return statistics.fmean(count_words(s) for page in pages() for s in sentences(page.read_text(encoding="utf-8")))


def _blocks(text: str) -> Iterator[tuple[str, bool]]:
    """Yield paragraphs, list items and table rows. The second value is whether it is a table row."""
    for pattern, instead in ((_COMMENT, ""), (_FENCE, "\n\n"), (_SHOWN_FORMULA, " F "), (_IMAGE, "")):
        text = pattern.sub(instead, text)
    paragraph: list[str] = []
    for line in [*text.splitlines(), ""]:
        heading, row, item = line.startswith("#"), line.lstrip().startswith("|"), _ITEM.match(line)
        if paragraph and (not line.strip() or heading or row or item):
            yield " ".join(paragraph), False
            paragraph = []
        if row:
            yield line, True
        elif line.strip() and not heading:
            paragraph.append(_ITEM.sub("", line).strip())


def _split(block: str) -> Iterator[str]:
    """Yield the sentences of a block, with placeholders for formulas and code."""
    for pattern, instead in ((_FORMULA, "F"), (_LINK, r"\1"), (_CODE, "C")):
        block = pattern.sub(instead, block)
    yield from (s for s in _END.split(block) if s.strip() and _WORD.search(s))


def main() -> int:
    """Print the table and the long sentences. Return 1 if a limit is exceeded."""
    faults = 0
    for page in pages():
        text = page.read_text(encoding="utf-8")
        counts = [count_words(s) for s in sentences(text)]
        mean = statistics.fmean(counts) if counts else 0.0
        print(f"{page.relative_to(ROOT)!s:24} {len(counts):4} sentences, {mean:4.1f} words on average")
        for sentence in long_sentences(text):
            faults += 1
            print(f"    {count_words(sentence)} words: {sentence}")
    print(f"All: {mean_words():.1f} words on average, {MOST_WORDS_ON_AVERAGE:.0f} at most; {faults} over {MOST_WORDS}.")
    return int(faults > 0 or mean_words() > MOST_WORDS_ON_AVERAGE)


if __name__ == "__main__":
    sys.exit(main())
