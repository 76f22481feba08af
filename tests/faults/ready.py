"""What the trainings of a campaign need, imported once for all of them before they are forked off."""

from ballu_mjx.common import runtime

runtime.prepare()

import follower  # noqa: E402, F401

import ballu_mjx.rl.training_loop  # noqa: E402, F401
