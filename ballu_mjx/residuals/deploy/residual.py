"""Improved simulator in C MuJoCo: a robot with identified actuators, a drivetrain and a residual.

This file needs only Python 3.10 or newer, NumPy and MuJoCo. `python -m ballu_mjx export simulator` copies it into a
folder, beside the model `identified.xml` and the parameters `simulator.json` and `parameters.npz`. `python residual.py`
in that folder compares a rollout of this simulator with a rollout of the exported simulator.

A control step has the same order as in the exported simulator:

1. The residual computes its loads from the features and commands of the last control steps. It may also delay or change
   the command.
2. In each physics step, the drivetrain turns the command into the actuators' `ctrl`, and MuJoCo advances the state. The
   loads are constant over the control step.
3. The features of the new state are added to the history.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

FORMAT = "ballu-simulator/1"
MODEL_FILE, SETTINGS_FILE, PARAMETERS_FILE, CHECK_FILE = (
    "identified.xml",
    "simulator.json",
    "parameters.npz",
    "check.npz",
)
HISTORY = 3
"""Number of control steps in the history of features and commands that the residual takes as input."""
POSITION, VELOCITY, EULER, FIRST_POINT = slice(0, 3), slice(3, 6), slice(6, 9), 9
"""Layout of `features`: position, velocity and Euler angles of the tracked body, and the index of the first point."""
YAW = 8
"""Index of the tracked body's yaw in `features`."""
_SPEED_AT_REST = 1e-3
"""Smoothed speed of a body at rest (m/s). Training needs a speed that is differentiable at rest."""
_ROUNDING = 1e-3
"""Tolerance for rounding errors of a delay (control steps). Without it, a command whose delay is a whole number of
physics steps could arrive one physics step late."""


# ---- inputs of the residual ----


def features(model: mujoco.MjModel, data: mujoco.MjData, sites: np.ndarray) -> np.ndarray:
    """Return the features of a state: the quantities that motion capture measures, in the world frame.

    The function recomputes the kinematics in `data` from `qpos` and `qvel`.

    **Arguments**

    - `sites`: ids of the tracked site and then of the points.

    **Returns** position (m) and velocity (m/s) of the tracked site, roll, pitch and yaw (rad; intrinsic z-y-x) of its
    body, then position and velocity of each point. The array has 9 + 6 * points numbers.
    """
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_comVel(model, data)
    bodies = model.site_bodyid[sites]
    places = data.site_xpos[sites]
    offset = places - data.subtree_com[model.body_rootid[bodies]]
    # cvel is the spatial velocity (angular, linear) about the centre of mass of the body's kinematic tree.
    velocities = data.cvel[bodies, 3:] + np.cross(data.cvel[bodies, :3], offset)
    kinematics = np.concatenate([places, velocities], axis=1)
    return np.concatenate([kinematics[0], euler_angles(data.xquat[bodies[0]]), kinematics[1:].ravel()])


def euler_angles(quaternion: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw (rad; intrinsic z-y-x) of a unit quaternion (w, x, y, z; body to world)."""
    w, x, y, z = quaternion
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.array([roll, pitch, yaw])


def heading_rotation(yaw: float) -> np.ndarray:
    """Return the rotation matrix, heading frame of the tracked body to world frame, for a yaw angle (rad)."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def network_input(history: np.ndarray, commands: np.ndarray, part: Mapping[str, Any]) -> np.ndarray:
    """Return the input of a network; the list `inputs` of its entry in `simulator.json` names each number.

    **Arguments**

    - `history`: features of the last `HISTORY` control steps, the current one last.
    - `commands`: commands of the last control steps and the coming one, `HISTORY` in all.
    - `part`: the network's entry in `simulator.json`.
    """
    now = history[-1]
    origin = now[POSITION] * (np.array([1.0, 1.0, 0.0]) if part["relative_observation"] else 0.0)
    heading = now[YAW] if part["heading_frame"] else 0.0
    seen = []
    for frame in history:
        vectors = np.concatenate([frame[:6], frame[FIRST_POINT:]]).reshape(-1, 3)
        vectors[::2] -= origin
        turned = frame[YAW] - heading
        angles = frame[6], frame[7], np.arctan2(np.sin(turned), np.cos(turned))
        seen += [(vectors @ heading_rotation(heading)).ravel(), angles]
    if part["observe_command"]:
        low, high = np.array(part["command_ranges"]).T
        seen.append(((commands - low) / (high - low)).ravel())
    return np.concatenate(seen)


def body_motion(history: np.ndarray, control_timestep: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the tracked body's rotation matrix (body to world), velocity (m/s) and angular velocity (rad/s).

    The rotation is the current one. Both velocities are in the body frame. They are extrapolated from the last features
    to the middle of the coming control step, over which forces are held.
    """
    earlier, before, now = (_rotation(seen[EULER]) for seen in history[-3:])
    velocity = now.T @ (1.5 * history[-1, VELOCITY] - 0.5 * history[-2, VELOCITY])
    turned = 2 * _turn(before.T @ now) - _turn(earlier.T @ before)
    return now, velocity, turned / control_timestep


def _rotation(euler: np.ndarray) -> np.ndarray:
    """Return the rotation matrix (body to world) of roll, pitch and yaw (rad; intrinsic z-y-x)."""
    roll, pitch, yaw = euler
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    return heading_rotation(yaw) @ np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])


def _turn(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation vector (rad) of a small rotation, accurate to second order."""
    return np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / 2


# ---- parts of the residual ----


class Action(NamedTuple):
    """Loads of a part of the residual, constant over a control step."""

    wrench: np.ndarray
    """Wrenches, (1 or 1 + points, 6): force (N) and torque (N m) in the world frame. The first row acts at the tracked
    body's centre of mass. Further rows act at the points, in order."""
    joint_force: np.ndarray | float = 0.0
    """Generalized forces along the part's `joints` (N for slides, N m for hinges)."""
    command_change: np.ndarray | float = 0.0
    """Change that is added to the command (the actuators' own units)."""


class Part:
    """Base class of the residual's parts. It has no effect."""

    joints: Sequence[str] = ()
    """Names of the joints along which the part's generalized forces act."""

    def command(self, commands: np.ndarray) -> np.ndarray:
        """Return the command for each of equal parts of the coming control step, (parts, commands).

        A part of the residual with a delay returns older commands. The base class returns the coming command for the
        whole control step.

        **Arguments**

        - `commands`: commands of the last control steps and the coming one, `HISTORY` in all.
        """
        return commands[-1:]

    def act(self, history: np.ndarray, commands: np.ndarray) -> Action:
        """Return the loads over the coming control step.

        **Arguments**

        - `history`: features of the last `HISTORY` control steps, the current one last.
        - `commands`: commands of the last control steps and the coming one, `HISTORY` in all.
        """
        del history, commands
        return Action(np.zeros((1, 6)))


class NetworkPart(Part):
    """Neural network that computes forces, torques or changes of the command."""

    def __init__(self, part: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        """Build the network from its entry `part` in `simulator.json` and its `arrays` in `parameters.npz`."""
        self._part = part
        self._mean, self._std, self._clip = (arrays[name] for name in ("mean", "std", "observation_clip"))
        count = sum(name.startswith("kernel_") for name in arrays)
        self._layers = [(arrays[f"kernel_{i}"], arrays[f"bias_{i}"]) for i in range(count)]
        self._activation = {"swish": _swish, "tanh": np.tanh}[part["activation"]]
        self.joints, self._arrays = part["joints"], arrays

    def act(self, history: np.ndarray, commands: np.ndarray) -> Action:
        """Return the network's loads; forces and torques on bodies are in the world frame."""
        seen = network_input(history, commands, self._part)
        forces, loads = self._part["forces"], self.fade(seen) * self.loads(seen)
        if forces == "joints":
            return Action(np.zeros((1, 6)), joint_force=loads)
        if forces == "commands":
            return Action(np.zeros((1, 6)), command_change=loads)
        vectors = loads.reshape(-1, 3)
        if self._part["heading_frame"]:
            vectors = vectors @ heading_rotation(history[-1, YAW]).T
        return Action(vectors.reshape(1, 6) if forces == "wrench" else np.pad(vectors, [(0, 0), (0, 3)]))

    def fade(self, seen: np.ndarray) -> float:
        """Return the factor on the loads for an input: 1 in the training range, and less outside of it."""
        if self._part["fade"] is None:
            return 1.0
        low, high, widths = (self._arrays[name] for name in ("low", "high", "widths"))
        beyond = np.max(np.maximum(low - seen, seen - high) / widths) - self._part["fade"]["margin"]
        return float(np.exp(-((max(beyond, 0.0) / self._part["fade"]["width"]) ** 4)))

    def loads(self, seen: np.ndarray) -> np.ndarray:
        """Return the loads (N, N m, commands' units) for an input of the network.

        Forces and torques on bodies are in the frame of the input: the heading frame, or the world frame if the entry
        in `simulator.json` has `heading_frame` false.
        """
        x = np.clip((seen - self._mean) / self._std, -self._clip, self._clip)
        for number, (kernel, bias) in enumerate(self._layers):
            x = x @ kernel + bias
            if number < len(self._layers) - 1:
                x = self._activation(x)
        most = np.array(self._part["limit"])
        return np.clip(np.array(self._part["unit"]) * x, -most, most)


def _swish(x: np.ndarray) -> np.ndarray:
    return x * (1 + np.tanh(x / 2)) / 2  # This form does not overflow.


class AerodynamicPart(Part):
    """Drag on the tracked body, and a delay of the commands.

    The body's identified mass, inertia, centre of mass and lift, and the friction, are part of the model
    `identified.xml`.
    """

    def __init__(self, part: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        """Read drag coefficients and delay from the entry `part` in `simulator.json`."""
        del arrays
        self._control_timestep = part["control_timestep"]
        self._linear, self._quadratic, self._turning = (
            np.array(part["parameters"][name]) for name in ("linear_drag", "quadratic_drag", "turning_drag")
        )
        longest = (HISTORY - 1) * self._control_timestep
        late = min(max(part["parameters"]["delay"], 0.0), longest) - part["timestep"] * np.arange(part["substeps"])
        self._age = np.maximum(np.ceil(late / self._control_timestep - _ROUNDING), 0).astype(int)

    def command(self, commands: np.ndarray) -> np.ndarray:
        """Return the command that has arrived at the start of each physics step, (physics steps, commands)."""
        return commands[HISTORY - 1 - self._age]

    def act(self, history: np.ndarray, commands: np.ndarray) -> Action:
        """Return the wrench of the drag (N, N m; world frame) in still air."""
        del commands
        now, velocity, rate = body_motion(history, self._control_timestep)
        speed = np.sqrt(np.sum(velocity**2) + _SPEED_AT_REST**2)
        force = -(self._linear + self._quadratic * speed) * velocity
        return Action(np.concatenate([now @ force, now @ (-self._turning * rate)])[None])


class FluidPart(Part):
    """Force and torque on the tracked body as a linear combination of terms.

    A term is a product of velocities and components of the direction of gravity, in the body frame, times a power of
    the speed. Coefficients have SI units.
    """

    _NAMES = ("vx", "vy", "vz", "wx", "wy", "wz", "gx", "gy", "gz")

    def __init__(self, part: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        """Read terms from the entry `part` in `simulator.json`, and coefficients (terms, 6) from `arrays`."""
        self._control_timestep, self._down = part["control_timestep"], np.array(part["down"])
        self._factors = [[self._NAMES.index(name) for name in term["factors"]] for term in part["terms"]]
        self._power = np.array([term["power_of_speed"] for term in part["terms"]])
        self._coefficients = arrays["coefficients"]

    def act(self, history: np.ndarray, commands: np.ndarray) -> Action:
        """Return the wrench (N, N m; world frame)."""
        del commands
        frame, velocity, rate = body_motion(history, self._control_timestep)
        speed = np.sqrt(np.sum(velocity**2) + _SPEED_AT_REST**2)
        components = np.concatenate([velocity, rate, frame.T @ self._down])
        terms = np.array([np.prod(components[factors]) for factors in self._factors]) * speed**self._power
        wrench = terms @ self._coefficients
        return Action(np.concatenate([frame @ wrench[:3], frame @ wrench[3:]])[None])


_PARTS = {"network": NetworkPart, "aerodynamic": AerodynamicPart, "fluid": FluidPart}


# ---- drivetrain ----


class Drivetrain:
    """Drivetrain between commands and actuators: delay, scale and offset, rate limit, lag, and backlash, in this order.

    Commands and `ctrl` are in the actuators' own units.
    """

    def __init__(self, settings: Mapping[str, Any], timestep: float) -> None:
        """Build the drivetrain from `drivetrain` in `simulator.json`, for physics steps of `timestep` (s)."""
        self._scale, self._offset, self._delay, self._backlash, self._lag = (
            np.array(settings[name], float) for name in ("scale", "offset", "delay", "backlash", "lag")
        )
        # JSON has no infinity. null means no rate limit.
        self._max_change = timestep * np.array([np.inf if each is None else each for each in settings["rate_limit"]])
        self._timestep, self._slots = timestep, int(settings["slots"])
        self.reset(np.zeros(len(self._scale)))

    def reset(self, command: np.ndarray) -> None:
        """Set the state after a long time under the same command, with the backlash centred."""
        self._sent = np.tile(command, (self._slots, 1))
        self._limited = self._lagged = self._ctrl = self._scale * command + self._offset

    def step(self, command: np.ndarray) -> np.ndarray:
        """Advance by one physics step under a command, and return the actuators' `ctrl`."""
        self._sent = np.concatenate([command[None], self._sent[:-1]])
        arrived = self._scale * self._delayed() + self._offset
        self._limited = np.clip(arrived, self._limited - self._max_change, self._limited + self._max_change)
        lag = self._lag / (self._lag + self._timestep)
        self._lagged = self._limited + (self._lagged - self._limited) * lag
        half = self._backlash / 2
        self._ctrl = np.clip(self._ctrl, self._lagged - half, self._lagged + half)
        return self._ctrl

    def _delayed(self) -> np.ndarray:
        """Return the delayed commands, linearly interpolated between physics steps."""
        last = self._slots - 1
        steps = np.clip(self._delay / self._timestep, 0.0, last)
        whole = np.minimum(np.floor(steps), last - 1).astype(int)
        fraction, columns = steps - whole, np.arange(len(steps))
        return (1 - fraction) * self._sent[whole, columns] + fraction * self._sent[whole + 1, columns]


# ---- simulator ----


class ImprovedSimulator:
    """Improved simulator of an exported folder, which advances by control steps.

    `model` and `data` are the `mujoco.MjModel` and `mujoco.MjData` of the simulation. `settings` is the content of
    `simulator.json`. `command` is the command of the last control step. Commands are in the actuators' own units, in
    the order of `commands`.

    ```python
    simulator = ImprovedSimulator(folder)
    simulator.reset(qpos, qvel)
    data = simulator.step(command)
    ```
    """

    def __init__(self, folder: Path | str, model: mujoco.MjModel | None = None) -> None:
        """Load the simulator and reset it to its initial state.

        **Arguments**

        - `folder`: folder with `identified.xml`, `simulator.json` and `parameters.npz`.
        - `model`: a scene of your own that contains the robot, with the same names of sites, joints and actuators.
          Build it from `identified.xml`, so that it has the identified values. If None, the folder's model.

        **Raises** `ValueError` if the folder has another format, if the model lacks a site, joint or actuator of the
        robot, or if it has another time step.
        """
        folder = Path(folder)
        self.settings: dict[str, Any] = json.loads((folder / SETTINGS_FILE).read_text(encoding="utf-8"))
        if self.settings.get("format") != FORMAT:
            raise ValueError(f'{folder / SETTINGS_FILE}: is not of the format "{FORMAT}"; export the simulator again.')
        with np.load(folder / PARAMETERS_FILE, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        self.model = _load_model(folder, arrays) if model is None else model
        self.data = mujoco.MjData(self.model)
        settings = self.settings
        self.commands = tuple(command["name"] for command in settings["commands"])
        """Names of the commands, in order."""
        self.names = (settings["tracked"], *settings["points"])
        """Names of the observed sites: the tracked site, then the points."""
        self.control_timestep: float = settings["control_timestep"]
        """Duration of a control step (s)."""
        self.substeps: int = settings["substeps"]
        """Number of physics steps in a control step."""
        if not np.isclose(self.model.opt.timestep * self.substeps, self.control_timestep):
            raise ValueError(
                f"The model's time step is {self.model.opt.timestep:g} s, but the robot needs "
                f"{self.control_timestep / self.substeps:g} s; set `timestep` in the model's `option`."
            )
        self._sites = self._find(mujoco.mjtObj.mjOBJ_SITE, self.names)
        self._bodies = self.model.site_bodyid[self._sites]
        actuators = [command["actuator"] for command in settings["commands"]]
        self._actuators = self._find(mujoco.mjtObj.mjOBJ_ACTUATOR, actuators)
        self.rest = np.array([command["rest"] for command in settings["commands"]], float)
        """Commands of the robot at rest."""
        part_arrays = [
            {name.partition("/")[2]: value for name, value in arrays.items() if name.startswith(f"part_{number}/")}
            for number in range(len(settings["residual"]))
        ]
        self.residual = [_PARTS[p["kind"]](p, a) for p, a in zip(settings["residual"], part_arrays, strict=True)]
        """Parts of the residual. Their loads add up."""
        drivetrain, timestep = settings["drivetrain"], float(self.model.opt.timestep)
        self.drivetrain = None if drivetrain is None else Drivetrain(drivetrain, timestep)
        """Drivetrain between commands and actuators. None if commands arrive unchanged."""
        self._dofs = [
            self.model.jnt_dofadr[self._find(mujoco.mjtObj.mjOBJ_JOINT, part.joints)] if len(part.joints) else []
            for part in self.residual
        ]
        self._ranges = np.array([[command["low"], command["high"]] for command in settings["commands"]]).T
        self.wrench = np.zeros((1, 6))
        """Residual wrenches of the last control step, (1 or 1 + points, 6): force (N) and torque (N m) in the world
        frame. The first row acts at the tracked body's centre of mass. Further rows act at the points."""
        self.joint_force = np.zeros(self.model.nv)
        """Residual generalized forces of the last control step, (nv,) (N, N m)."""
        self.reset()

    def reset(
        self, qpos: np.ndarray | None = None, qvel: np.ndarray | None = None, command: np.ndarray | None = None
    ) -> None:
        """Reset the simulation to a state.

        The history and the drivetrain are reset as if the robot had been in this state, under this command, for a long
        time.

        **Arguments**

        - `qpos`: generalized positions, (nq,). If None, the initial pose of the exported simulator. A model of your own
          with another `nq` then starts in its `qpos0`.
        - `qvel`: generalized velocities, (nv,). If None, 0.
        - `command`: constant command before the reset (the actuators' own units). If None, that of the robot at rest.
        """
        mujoco.mj_resetData(self.model, self.data)
        start = self.settings["initial_qpos"]
        if qpos is None and len(start) == self.model.nq:
            self.data.qpos[:] = start
        elif qpos is not None:
            self.data.qpos[:] = qpos
        self.data.qvel[:] = 0.0 if qvel is None else qvel
        self.command = self.rest.copy() if command is None else np.array(command, float)
        self._earlier = np.tile(self.command, (HISTORY - 1, 1))
        self._history = np.tile(self.features(), (HISTORY, 1))
        if self.drivetrain is not None:
            self.drivetrain.reset(self.command)

    def features(self) -> np.ndarray:
        """Return the features of the current state; see the function `features` of this module."""
        return features(self.model, self.data, self._sites)

    def step(self, command: np.ndarray) -> mujoco.MjData:
        """Advance by one control step under a command, (commands,), and return `data`."""
        for _ in self.substep(command):
            pass
        return self.data

    def substep(self, command: np.ndarray):  # noqa: ANN201
        """Advance by one control step under a command, and yield `data` after each physics step.

        Exhaust the generator before the next command, because the history is updated after the last physics step.
        """
        self.command = np.array(command, float)
        commands = np.concatenate([self._earlier, self.command[None]])
        sent = self.command[None]
        self.wrench = np.zeros((1, 6))
        if self.residual:
            sent = self.command + sum(part.command(commands) - self.command for part in self.residual)
            actions = [part.act(self._history, commands) for part in self.residual]
            self.wrench = np.zeros((max(len(action.wrench) for action in actions), 6))
            self.joint_force[:] = 0.0
            for dofs, action in zip(self._dofs, actions, strict=True):
                self.wrench[: len(action.wrench)] += action.wrench
                self.joint_force[dofs] += action.joint_force
            change = sum(action.command_change for action in actions)
            if np.any(change):
                sent = np.clip(sent + change, *self._ranges)
        for ctrl in np.repeat(sent, self.substeps // len(sent), axis=0):
            self._physics_step(ctrl if self.drivetrain is None else self.drivetrain.step(ctrl))
            yield self.data
        self._earlier = commands[1:]
        self._history = np.concatenate([self._history[1:], self.features()[None]])

    def _physics_step(self, ctrl: np.ndarray) -> None:
        """Advance by one physics step under the actuators' `ctrl` and the residual's loads."""
        model, data = self.model, self.data
        data.ctrl[self._actuators] = ctrl
        # Forces of the caller act, too, and stay unchanged.
        own = data.xfrc_applied.copy(), data.qfrc_applied.copy()
        for dofs in self._dofs:
            data.qfrc_applied[dofs] = own[1][dofs] + self.joint_force[dofs]
        if len(self.wrench) > 1:  # The torques of forces at points depend on the current positions of the points.
            mujoco.mj_kinematics(model, data)
        for number, (wrench, site, body) in enumerate(zip(self.wrench, self._sites, self._bodies, strict=False)):
            data.xfrc_applied[body] += wrench
            if number:
                data.xfrc_applied[body, 3:] += np.cross(data.site_xpos[site] - data.xipos[body], wrench[:3])
        mujoco.mj_step(model, data)
        data.xfrc_applied[:], data.qfrc_applied[:] = own

    def _find(self, kind: mujoco.mjtObj, names: Any) -> np.ndarray:
        """Return the ids of objects of the model. **Raises** `ValueError` if one is missing."""
        found = np.array([mujoco.mj_name2id(self.model, kind, name) for name in names])
        if (found < 0).any():
            raise ValueError(
                f"The model has no site, joint or actuator {list(names)[int(np.argmin(found))]!r}, which the robot "
                "needs; build your model from identified.xml."
            )
        return found


def _load_model(folder: Path, arrays: Mapping[str, np.ndarray]) -> mujoco.MjModel:
    """Return the folder's model in full precision.

    Numbers in `identified.xml` have six digits. `arrays` hold the exact values of fields that need more.
    """
    model = mujoco.MjModel.from_xml_path(str(folder / MODEL_FILE))
    for name, value in arrays.items():
        owner, _, field = name.partition("/")
        if owner in ("model", "option"):
            place = getattr(model if owner == "model" else model.opt, field)
            if isinstance(place, np.ndarray):
                place[...] = value
            else:
                setattr(model.opt, field, type(place)(value))
    return model


# ---- self-test ----


def deviations(folder: Path | str) -> tuple[np.ndarray, np.ndarray, float]:
    """Compare this simulator with the exported simulator over the rollout in the folder's `check.npz`.

    **Returns** the difference in position of the tracked site (m) and in orientation of its body (deg) after each
    control step, and the mean time that the computation of a control step takes on this computer (s).
    """
    simulator = ImprovedSimulator(folder)
    with np.load(Path(folder) / CHECK_FILE, allow_pickle=False) as archive:
        commands, qpos, qvel, position, quaternion = (
            archive[name] for name in ("commands", "qpos", "qvel", "position", "quaternion")
        )
    simulator.reset(qpos, qvel, commands[0])
    distances, angles, site = [], [], simulator.names[0]
    start = time.perf_counter()
    for command, place, turn in zip(commands, position, quaternion, strict=True):
        data = simulator.step(command)
        distances.append(np.linalg.norm(data.site(site).xpos - place))
        # The sine of half the angle is accurate for small angles. The cosine is not.
        product = np.zeros(4)
        mujoco.mju_mulQuat(product, turn * [1, -1, -1, -1], data.xquat[simulator._bodies[0]])
        angles.append(2 * np.rad2deg(np.arcsin(min(np.linalg.norm(product[1:]), 1.0))))
    return np.array(distances), np.array(angles), (time.perf_counter() - start) / len(commands)


def self_test(folder: Path | str) -> int:
    """Compare a rollout with one of the exported simulator and print the differences.

    **Returns** 0 if all differences are below 1 mm and 0.1 deg, and otherwise 1: the exit status of the program.
    """
    distances, angles, seconds = deviations(folder)
    step = json.loads((Path(folder) / SETTINGS_FILE).read_text(encoding="utf-8"))["control_timestep"]
    print("Largest difference from the exported simulator:")
    for number in sorted({max(round(after / step), 1) for after in (0.5, 1, 2, 5)} | {len(distances)}):
        if number <= len(distances):
            largest = 1000 * distances[:number].max(), angles[:number].max()
            print(f"  up to {number * step:5.2f} s  {largest[0]:9.4f} mm  {largest[1]:9.5f} deg")
    print(f"A control step of {1000 * step:g} ms takes {1000 * seconds:.2f} ms here.")
    good = distances.max() < 1e-3 and angles.max() < 0.1
    print("Passed." if good else "FAILED: a difference is 1 mm or 0.1 deg or more.")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(self_test(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).resolve().parent))
