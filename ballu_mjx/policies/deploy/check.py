"""Check of an exported policy in C MuJoCo against the policy and the simulator of its training."""

from __future__ import annotations

import dataclasses
import functools
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from ballu_mjx.common import files
from ballu_mjx.common.errors import InputError
from ballu_mjx.policies.deploy.controller import Controller
from ballu_mjx.policies.deploy.export import POLICY_FILE, POLICY_FORMAT
from ballu_mjx.policies.policy import Policy
from ballu_mjx.policies.tasks import Step
from ballu_mjx.residuals.deploy.export import export_simulator, rollout_in_double, rollout_positions
from ballu_mjx.residuals.deploy.residual import YAW, ImprovedSimulator
from ballu_mjx.robots.kinematic_trees import mass_shares
from ballu_mjx.sim.c_model import improved_model, site_poses
from ballu_mjx.sim.simulator import AugmentedSimulator, Simulator

TOLERANCE = 0.1
"""Largest relative difference of distance or reward between two trials that count as equal."""
COMMAND_TOLERANCE = 1e-3
"""Largest difference between exported network and policy, as a fraction of a command's range."""
PREDICTABLE = 1e-3
"""Position error (m) of the tracked site, due to single precision alone, at which the comparison of states ends."""
_ROUNDINGS, _LEAST_APART = 10.0, 1e-5
"""Tolerance for the distance between C MuJoCo and our simulator: this multiple of the distance due to single precision,
but at least this distance (m)."""
_LEAST_DISTANCE, _LEAST_SPEED = 0.1, 0.01
"""Distance (m) and speed (m/s) below which differences are ignored."""
_FRAME_INTERVAL = 0.005
"""Shortest time between two frames for the controller (s)."""


@dataclasses.dataclass(frozen=True)
class Trial:
    """Result of a policy's trial in one simulator."""

    simulator: str
    """Name of the simulator in the table."""
    reward: float
    """Mean reward over the trial. It is a velocity (m/s) for the tasks of this package."""
    displacement: tuple[float, float]
    """Displacement of the centre of mass along x and y (m)."""
    yaw: float
    """Yaw of the tracked body at the end (deg)."""

    def differs_from(self, other: Trial) -> str | None:
        """Return a description of the difference from `other`. None if the trials count as equal."""
        far = float(np.hypot(*other.displacement))
        apart = float(np.hypot(*np.subtract(self.displacement, other.displacement)))
        if not apart <= max(TOLERANCE * far, _LEAST_DISTANCE):
            return f"its final position is {apart:.2f} m from that in {other.simulator}"
        if not abs(self.reward - other.reward) <= max(TOLERANCE * abs(other.reward), _LEAST_SPEED):
            return f"its mean reward is {self.reward:.3f}, not {other.reward:.3f}"
        return None


@dataclasses.dataclass(frozen=True)
class Agreement:
    """Differences of exported network and simulator from the originals, along the trial in C MuJoCo."""

    commands: float
    """Largest difference between commands of network and policy for equal observations, as a fraction of their
    ranges."""
    compared: float
    """Duration (s) of the comparison of states. It ends when single precision alone moves the tracked site by at least
    `PREDICTABLE`."""
    apart: float
    """Largest distance (m), in this time, of the tracked site from its position in our simulator in double precision,
    under the same commands."""
    rounding: float
    """The same distance for our simulator in single precision."""

    def problem(self) -> str | None:
        """Return a description of what differs. None if nothing differs."""
        if not self.commands <= COMMAND_TOLERANCE:
            return (
                f"on the same observations its commands are up to {self.commands:.2%} of their range from the policy's"
            )
        if not self.apart <= max(_ROUNDINGS * self.rounding, _LEAST_APART):
            return (
                f"under the same commands the tracked site is up to {1000 * self.apart:.3g} mm from its position in "
                f"its own simulator within {self.compared:.2f} s; rounding explains {1000 * self.rounding:.3g} mm"
            )
        return None

    def __str__(self) -> str:
        return (
            f"Commands on the same observations differ by at most {self.commands:.2g} of their range.\n"
            f"Positions of the tracked site under the same commands, over {self.compared:.2f} s, differ by at most "
            f"{1000 * self.apart:.2g} mm in double precision; single precision alone: {1000 * self.rounding:.2g} mm."
        )


@dataclasses.dataclass(frozen=True)
class PolicyCheck:
    """Result of a check: trials of an exported policy. `own` is the trial in the simulator of its training."""

    agreement: Agreement
    own: Trial
    network: Trial
    """Trial in C MuJoCo of its network alone, on exact features."""
    controller: Trial
    """Trial in C MuJoCo of the whole controller, with estimator and rate limit, on frames of the true poses."""
    seconds: float
    """Duration of a trial (s)."""
    notes: tuple[str, ...] = ()
    """Properties of the policy's own simulator that C MuJoCo leaves out, one sentence each."""

    @property
    def agrees(self) -> bool:
        """Whether network and simulator agree with those of the run."""
        return self.agreement.problem() is None

    def table(self) -> str:
        """Return a table of the trials, and the verdict."""
        trials = (self.own, self.network, self.controller)
        rows = [
            ("", *(trial.simulator for trial in trials)),
            ("mean reward", *(f"{trial.reward:.3f}" for trial in trials)),
            ("return", *(f"{trial.reward * self.seconds:.2f}" for trial in trials)),
            ("x (m)", *(f"{trial.displacement[0]:.2f}" for trial in trials)),
            ("y (m)", *(f"{trial.displacement[1]:.2f}" for trial in trials)),
            ("yaw (deg)", *(f"{trial.yaw:.1f}" for trial in trials)),
        ]
        widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
        lines = ["  ".join(f"{cell:>{w}}" for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
        lines[0] = f"A trial of {self.seconds:g} s:\n{lines[0]}"
        return "\n".join([*lines, *self.notes, str(self.agreement), self.verdict()])

    def verdict(self) -> str:
        """Return the verdict: agreement with the run, difference of the trials, and effect of the controller."""
        problem, apart = self.agreement.problem(), self.network.differs_from(self.own)
        said = "AGREES: in C MuJoCo, policy and simulator are those of the run."
        if problem is not None:
            said = f"DIFFERS: {problem}."
        elif apart is not None:
            said += (
                f" The trials differ nevertheless: {apart}. The motion magnifies rounding, so only the first "
                f"{self.agreement.compared:.2f} s can be predicted."
            )
        changed = self.controller.differs_from(self.network)
        if changed is None:
            return f"{said} From frames, with estimator and rate limit, it does the same."
        return f"{said} From frames, with estimator and rate limit, {changed}."


def check_policy(
    folder: Path | str,
    *,
    simulator: Path | str | None = None,
    run: Path | str | None = None,
    seconds: float | None = None,
) -> PolicyCheck:
    """Run an exported policy in C MuJoCo and in the simulator of its training.

    Two comparisons decide whether they agree: commands on the same observations, and states under the same commands
    (`Agreement`). The distances of the trials are reported but do not decide, because contacts make them depend on
    rounding.

    **Arguments**

    - `folder`: folder that `export.export_policy` wrote.
    - `simulator`: folder of an exported simulator to run in. None for the policy's own simulator, which is then
      exported temporarily.
    - `run`: folder of the policy's run. None for the folder that was stored at export.
    - `seconds`: duration of a trial (s), above 0 and at most 3600. None for that of the task.

    **Raises** `InputError` if a folder is damaged, the run is missing, or the simulator is of another robot.
    """
    folder = Path(folder)
    path, fix = folder / POLICY_FILE, "export the policy again"
    if not path.is_file():
        raise InputError(f"{folder}: is not an exported policy ({POLICY_FILE} is missing); {fix}.")
    described = files.read_json(path, fix)
    if described.get("format") != POLICY_FORMAT or not isinstance(described.get("run"), str):
        raise InputError(f'{path}: is not of the format "{POLICY_FORMAT}"; {fix}.')
    try:
        controller = Controller(folder)
    except (OSError, ValueError) as error:
        raise InputError(f"{folder}: its weights cannot be read ({error}); {fix}.") from error
    if seconds is not None and not 0 < seconds <= 3600:
        raise InputError(f"--seconds is {seconds:g}: it must be above 0, and 3600 or less.")
    policy = Policy.load(described["run"] if run is None else run)
    _check_same(controller, policy, folder)
    seconds = policy.task.trial_seconds if seconds is None else seconds
    steps = max(round(seconds / policy.robot.control_timestep), 1)
    own = Simulator(policy.robot, policy.actuators).with_residual(policy.trained_residual)
    with tempfile.TemporaryDirectory() as temporary:
        if simulator is None:
            simulator = export_simulator(own, Path(temporary) / "simulator", check_seconds=0.0).folder
        there = _read_simulator(Path(simulator), policy)
    # Trials in C MuJoCo have the reward of the task alone.
    config = dataclasses.replace(policy.config, outside_cost=0.0)
    plain = policy if config == policy.config else dataclasses.replace(policy, config=config, loop=None)
    loop = plain.closed_loop()
    qpos, qvel = loop.standing()
    rollout = loop(policy.params, qpos, qvel, steps)
    moved = rollout.com[0, -1] - rollout.com[0, 0]
    trial = Trial(
        "its own simulator",
        float(rollout.reward[0].mean()),
        (float(moved[0]), float(moved[1])),
        float(np.rad2deg(rollout.yaw[0, -1])),
    )
    shares = mass_shares(policy.robot.load_model(policy.actuators), policy.robot.tracked)
    rest = policy, (qpos[0], qvel[0]), steps, shares
    seen = []

    def act(frames: Frames) -> Any:
        seen.append((there.data.qpos.copy(), there.data.qvel.copy(), controller.act(there.features())))
        return seen[-1][-1]

    network = _run_trial("C MuJoCo", there, act, *rest)
    agreement = _compare(there, own, policy, *map(np.array, zip(*seen, strict=True)))
    from_frames = _run_trial("C MuJoCo, from frames", there, _from_frames(folder), *rest)
    notes = [] if rollout.divergence is None else [rollout.divergence]
    if policy.config.sampled_residual:
        notes.append("Training sampled the residual's forces; C MuJoCo uses the mode of their distribution.")
    return PolicyCheck(agreement, trial, network, from_frames, steps * policy.robot.control_timestep, tuple(notes))


def _compare(
    there: ImprovedSimulator,
    own: AugmentedSimulator,
    policy: Policy,
    qpos: Float[np.ndarray, "steps nq"],
    qvel: Float[np.ndarray, "steps nv"],
    commands: Float[np.ndarray, "steps commands"],
) -> Agreement:
    """Compare network and simulator along a trial in C MuJoCo. `qpos` and `qvel` are the states before `commands`."""
    low, high = np.array(policy.robot.command_ranges).T
    features, _ = own.simulator.observe_all(jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32))
    act = policy.act()
    expected = np.array([act(row) for row in np.asarray(features)])
    model = improved_model(own)
    exact = rollout_in_double(own, model, qpos[0], qvel[0], commands)
    run = jax.jit(functools.partial(rollout_positions, own))
    rounded = np.asarray(run(*(x.astype(np.float32) for x in (qpos[0], qvel[0], commands))))
    there.reset(qpos[0], qvel[0], commands[0])
    found = np.array([there.step(command).qpos.copy() for command in commands])
    places, _ = site_poses(model, policy.robot.tracked, np.stack([exact, found, rounded]))
    apart, rounding = np.linalg.norm(places[1:] - places[0], axis=-1)
    unpredictable = ~(rounding < PREDICTABLE)
    count = max(int(unpredictable.argmax()), 1) if unpredictable.any() else len(rounding)
    return Agreement(
        float(np.max(np.abs(expected - commands) / (high - low))),
        count * policy.robot.control_timestep,
        float(np.max(apart[:count])),
        float(np.max(rounding[:count])),
    )


Frames = list[tuple[float, dict[str, np.ndarray]]]
Act = Callable[[Frames], Any]
"""Function that maps the frames of the last control step to commands."""


def _from_frames(folder: Path) -> Act:
    controller = Controller(folder)

    def act(frames: Frames) -> Any:
        command: Any = controller.command
        for time, frame in frames:
            command = controller.step(time, frame)
        return command

    return act


def _run_trial(
    name: str,
    there: ImprovedSimulator,
    act: Act,
    policy: Policy,
    start: tuple[np.ndarray, np.ndarray],
    steps: int,
    shares: Float[np.ndarray, " bodies"],
) -> Trial:
    """Return a trial. `shares` are those of `mass_shares`."""
    there.reset(*start)
    rewards: list[float] = []
    frames = [(0.0, _frame(there))]
    com = first = shares @ there.data.xipos
    stride = max(round(_FRAME_INTERVAL / there.model.opt.timestep), 1)
    for _ in range(steps):
        command, before = np.asarray(act(frames), float), com
        frames = []
        for number, data in enumerate(there.substep(command), start=1):
            if number % stride == 0 or number == there.substeps:
                mujoco.mj_kinematics(there.model, data)
                frames.append((float(data.time), _frame(there)))
        features, com = there.features(), shares @ there.data.xipos
        velocity = (com - before) / there.control_timestep
        rewards.append(float(policy.task.reward(Step(*map(jnp.asarray, (velocity, features, command))))))
    moved, yaw = com - first, float(np.rad2deg(features[YAW]))
    return Trial(name, float(np.mean(rewards)), (float(moved[0]), float(moved[1])), yaw)


def _frame(there: ImprovedSimulator) -> dict[str, np.ndarray]:
    frame = {f"{name}_position": there.data.site(name).xpos.copy() for name in there.names}
    body = there.model.site_bodyid[there.model.site(there.names[0]).id]
    return {**frame, f"{there.names[0]}_quaternion": there.data.xquat[body].copy()}


def _check_same(controller: Controller, policy: Policy, folder: Path) -> None:
    stored = controller.weights
    act, given = policy.act(), stored["check_commands"]
    if given.shape[1:] == (len(policy.robot.commands),) and stored["check_features"].shape[1] == policy.robot.features:
        now = np.array([act(row) for row in stored["check_features"]])
        ranges = stored["command_high"] - stored["command_low"]
        if np.max(np.abs(now - given) / ranges) < 1e-3:
            return
    raise InputError(f"{folder}: differs from the policy of its run; export it again, or give its run with --run.")


def _read_simulator(folder: Path, policy: Policy) -> ImprovedSimulator:
    try:
        there = ImprovedSimulator(folder)
    except (OSError, ValueError, KeyError) as error:
        problem = " ".join(str(error).split())
        raise InputError(
            f"{folder}: is not an exported simulator ({problem}); `export simulator` writes one."
        ) from error
    robot = policy.robot
    if (there.names, there.commands) != ((robot.tracked, *robot.points), robot.commands) or (
        there.model.nq != robot.load_model().nq
    ):
        raise InputError(f"{folder}: is a simulator of {there.settings['robot']}, not of {robot.name}.")
    return there
