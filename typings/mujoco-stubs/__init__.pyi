# MuJoCo's bindings are compiled and carry no types: without this, pyright does not know their names.
from typing import Any

def __getattr__(name: str) -> Any: ...
