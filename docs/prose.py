"""Measure the prose of README and docs: sentences a page, words a sentence, and sentences that are too long.

python docs/prose.py           # a table of the pages, and every sentence over the limit
"""

from __future__ import annotations

import re
import statistics
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
MOST_WORDS_ON_AVERAGE = 18.0
MOST_WORDS = 35
README_LINES = 150

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
    """Return the pages that people read in order: README, docs without the reference, and what stands beside them."""
    beside = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "benchmarks/README.md")
    return [ROOT / name for name in beside] + sorted((ROOT / "docs").glob("*.md"))


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences of a page's paragraphs and list items: no headings, tables, code blocks or shown formulas."""
    for block, is_table in _blocks(text):
        if not is_table:
            yield from _split(block)


def cell_sentences(text: str) -> Iterator[str]:
    """Yield the sentences in a page's table cells."""
    for row, is_table in _blocks(text):
        if is_table and not _RULE.match(row.strip()):
            for cell in row.strip().strip("|").split("|"):
                yield from _split(cell)


def count_words(sentence: str) -> int:
    """Return the number of words; code, a formula and a number with its unit's sign are one each."""
    return sum(bool(_WORD.search(word)) for word in sentence.split())


def long_sentences(text: str) -> list[str]:
    """Return all sentences of over `MOST_WORDS` words, those in table cells too."""
    return [s for s in (*sentences(text), *cell_sentences(text)) if count_words(s) > MOST_WORDS]


def mean_words() -> float:
    """Return the mean number of words in a sentence over all pages."""
    return statistics.fmean(count_words(s) for page in pages() for s in sentences(page.read_text(encoding="utf-8")))


def _blocks(text: str) -> Iterator[tuple[str, bool]]:
    """Yield paragraphs, list items and table rows, and whether each is a row."""
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
    for pattern, instead in ((_FORMULA, "F"), (_LINK, r"\1"), (_CODE, "C")):
        block = pattern.sub(instead, block)
    yield from (s for s in _END.split(block) if s.strip() and _WORD.search(s))


def main() -> int:
    """Print the table and the long sentences; returns 1 where a limit is exceeded."""
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
