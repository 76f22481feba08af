"""Imports of a campaign's trainings, made once before their processes are forked."""

from ballu_mjx.common import runtime

runtime.prepare()

import follower  # noqa: E402, F401

import ballu_mjx.rl.training_loop  # noqa: E402, F401
