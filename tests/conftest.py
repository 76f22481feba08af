"""Tests run in the environment that the commands set up, with every annotated array shape checked."""

from jaxtyping import install_import_hook

from ballu_mjx import runtime

runtime.prepare()
install_import_hook("ballu_mjx", "beartype.beartype")
