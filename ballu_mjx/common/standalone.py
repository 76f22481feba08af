"""Source files of this package that also run without it, on another computer."""

from __future__ import annotations

import re
from importlib import resources

_STAND_IN = '''

class {name}:
    """Replacement for jaxtyping's array type. Annotations in this file use it to state shapes."""

    def __class_getitem__(cls, item):
        return item[0]

'''


def standalone_source(package: str, file: str) -> str:
    """Return the source of a module, changed so that it runs without this package and without jaxtyping.

    Imports from modules of `package` become imports of files beside it.
    """
    source = resources.files(package).joinpath(file).read_text(encoding="utf-8")
    beside = rf"^from {re.escape(package)}\.(\w+) import"
    source = re.sub(beside, r"from \1 import", source, flags=re.MULTILINE)

    def stand_ins(imported: re.Match[str]) -> str:
        return "".join(_STAND_IN.format(name=name.strip()) for name in imported[1].split(","))

    source = re.sub(r"^from jaxtyping import ([\w, ]+)\n", stand_ins, source, flags=re.MULTILINE)
    left = re.search(r"^\s*(from|import) +(jaxtyping|ballu_mjx)\b.*", source, flags=re.MULTILINE)
    assert left is None, left
    return source
