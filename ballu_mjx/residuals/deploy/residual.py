"""An improved simulator in C MuJoCo: a robot with its identified actuators, its drivetrain and its residual.

Python 3.10, NumPy and MuJoCo are all it needs. `python -m ballu_mjx export simulator` copies this file into a folder,
beside the model `identified.xml` and the parameters `simulator.json` and `parameters.npz`. `python residual.py` there
compares a rollout with that of the simulator that was exported.

One control step, as there: features of the current state; the residual's commands and wrenches by the features and
commands of the last control steps; the drivetrain, once a physics step; physics steps with the wrenches held.
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
"""Control steps whose features and commands the residual sees."""
POSITION, VELOCITY, EULER, FIRST_POINT = slice(0, 3), slice(3, 6), slice(6, 9), 9
"""Where `features` has what of the tracked body, and where the points begin."""
YAW = 8
_SLOW = 1e-3
"""m/s; keeps the speed differentiable at rest."""
_JUST = 1e-3
"""Of a control step: a delay of just so many physics steps is over when they are."""


# ---- what the residual sees ----


def features(model: mujoco.MjModel, data: mujoco.MjData, sites: np.ndarray) -> np.ndarray:
    """Return what motion capture sees of a state, in the world frame: m, m/s, rad.

    Position, velocity, roll, pitch and yaw (intrinsic z-y-x) of the first of `sites`, then position and velocity of
    each other one. Kinematics in `data` are computed anew.
    """
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_comVel(model, data)
    bodies = model.site_bodyid[sites]
    places = data.site_xpos[sites]
    offset = places - data.subtree_com[model.body_rootid[bodies]]
    # cvel is the spatial velocity (angular, linear) about the whole robot's centre of mass.
    velocities = data.cvel[bodies, 3:] + np.cross(data.cvel[bodies, :3], offset)
    kinematics = np.concatenate([places, velocities], axis=1)
    return np.concatenate([kinematics[0], euler_angles(data.xquat[bodies[0]]), kinematics[1:].ravel()])


def euler_angles(quaternion: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw (rad; intrinsic z-y-x) of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.array([roll, pitch, yaw])


def heading_rotation(yaw: float) -> np.ndarray:
    """Return the rotation about z that takes vectors in the tracked body's heading frame to the world."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def network_input(history: np.ndarray, commands: np.ndarray, part: Mapping[str, Any]) -> np.ndarray:
    """Return what a network sees, in the order of its `inputs` in `simulator.json`."""
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
    """Return the tracked body's rotation (body to world), and velocity (m/s) and angular velocity (rad/s) along its
    axes in the middle of the coming control step, extrapolated from the last ones."""
    earlier, before, now = (_rotation(seen[EULER]) for seen in history[-3:])
    velocity = now.T @ (1.5 * history[-1, VELOCITY] - 0.5 * history[-2, VELOCITY])
    turned = 2 * _turn(before.T @ now) - _turn(earlier.T @ before)
    return now, velocity, turned / control_timestep


def _rotation(euler: np.ndarray) -> np.ndarray:
    roll, pitch, yaw = euler
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    return heading_rotation(yaw) @ np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])


def _turn(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation vector (rad) of a small rotation, to second order."""
    return np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / 2


# ---- the residual's parts ----


class Action(NamedTuple):
    """What a part does over a control step."""

    wrench: np.ndarray
    """Forces and torques (N, N m; world), a row each: on the tracked body, then at the points where there are more."""
    joint_force: np.ndarray | float = 0.0
    """Forces and torques (N, N m) along the part's `joints`."""
    command_change: np.ndarray | float = 0.0
    """What is added to the command, in the actuators' own units."""


class Part:
    """A part of the residual. This one does nothing."""

    joints: Sequence[str] = ()
    """Joints that it acts along."""

    def command(self, commands: np.ndarray) -> np.ndarray:
        """Return the command, as it is or late, for equal parts of the control step."""
        return commands[-1:]

    def act(self, history: np.ndarray, commands: np.ndarray) -> Action:
        """Return what it does over the coming control step."""
        del history, commands
        return Action(np.zeros((1, 6)))


class NetworkPart(Part):
    """Forces, torques or changes of the command by a neural network; `part` is its entry in `simulator.json`."""

    def __init__(self, part: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        self._part = part
        self._mean, self._std, self._clip = (arrays[name] for name in ("mean", "std", "observation_clip"))
        count = sum(name.startswith("kernel_") for name in arrays)
        self._layers = [(arrays[f"kernel_{i}"], arrays[f"bias_{i}"]) for i in range(count)]
        self._activation = {"swish": _swish, "tanh": np.tanh}[part["activation"]]
        self.joints = part["joints"]

    def act(self, history: np.ndarray, commands: np.ndarray) -> Action:
        """Return the network's loads, where they act."""
        forces, loads = self._part["forces"], self.loads(network_input(history, commands, self._part))
        if forces == "joints":
            return Action(np.zeros((1, 6)), joint_force=loads)
        if forces == "commands":
            return Action(np.zeros((1, 6)), command_change=loads)
        vectors = loads.reshape(-1, 3)
        if self._part["heading_frame"]:
            vectors = vectors @ heading_rotation(history[-1, YAW]).T
        return Action(vectors.reshape(1, 6) if forces == "wrench" else np.pad(vectors, [(0, 0), (0, 3)]))

    def loads(self, seen: np.ndarray) -> np.ndarray:
        """Return the loads (N, N m, commands' units), in the frame of what the network sees."""
        x = np.clip((seen - self._mean) / self._std, -self._clip, self._clip)
        for number, (kernel, bias) in enumerate(self._layers):
            x = x @ kernel + bias
            if number < len(self._layers) - 1:
                x = self._activation(x)
        most = np.array(self._part["limit"])
        return np.clip(np.array(self._part["unit"]) * x, -most, most)


def _swish(x: np.ndarray) -> np.ndarray:
    return x * (1 + np.tanh(x / 2)) / 2  # without overflow


class AerodynamicPart(Part):
    """Drag of the tracked body, and late commands; its mass, inertia, centre and lift stand in the model."""

    def __init__(self, part: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        del arrays
        self._control_timestep = part["control_timestep"]
        self._linear, self._quadratic, self._turning = (
            np.array(part["parameters"][name]) for name in ("linear_drag", "quadratic_drag", "turning_drag")
        )
        longest = (HISTORY - 1) * self._control_timestep
        late = min(max(part["parameters"]["delay"], 0.0), longest) - part["timestep"] * np.arange(part["substeps"])
        self._age = np.maximum(np.ceil(late / self._control_timestep - _JUST), 0).astype(int)

    def command(self, commands: np.ndarray) -> np.ndarray:
        """Return what has arrived by the start of each physics step."""
        return commands[HISTORY - 1 - self._age]

    def act(self, history: np.ndarray, commands: np.ndarray) -> Action:
        """Return the drag (N, N m; world) in still air."""
        del commands
        now, velocity, rate = body_motion(history, self._control_timestep)
        speed = np.sqrt(np.sum(velocity**2) + _SLOW**2)
        force = -(self._linear + self._quadratic * speed) * velocity
        return Action(np.concatenate([now @ force, now @ (-self._turning * rate)])[None])


class FluidPart(Part):
    """Force and torque on the tracked body as polynomials of its motion, in its own axes."""

    _NAMES = ("vx", "vy", "vz", "wx", "wy", "wz", "gx", "gy", "gz")

    def __init__(self, part: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        self._control_timestep, self._down = part["control_timestep"], np.array(part["down"])
        self._factors = [[self._NAMES.index(name) for name in term["factors"]] for term in part["terms"]]
        self._power = np.array([term["power_of_speed"] for term in part["terms"]])
        self._coefficients = arrays["coefficients"]

    def act(self, history: np.ndarray, commands: np.ndarray) -> Action:
        """Return the wrench (N, N m; world)."""
        del commands
        frame, velocity, rate = body_motion(history, self._control_timestep)
        speed = np.sqrt(np.sum(velocity**2) + _SLOW**2)
        components = np.concatenate([velocity, rate, frame.T @ self._down])
        terms = np.array([np.prod(components[factors]) for factors in self._factors]) * speed**self._power
        own = terms @ self._coefficients
        return Action(np.concatenate([frame @ own[:3], frame @ own[3:]])[None])


_PARTS = {"network": NetworkPart, "aerodynamic": AerodynamicPart, "fluid": FluidPart}


# ---- the drivetrain ----


class Drivetrain:
    """What a command meets on its way to its actuator: delay, scale and offset, rate limit, lag, and backlash."""

    def __init__(self, settings: Mapping[str, Any], timestep: float) -> None:
        self._scale, self._offset, self._delay, self._backlash, self._lag = (
            np.array(settings[name], float) for name in ("scale", "offset", "delay", "backlash", "lag")
        )
        # JSON has no infinity: null is no limit.
        self._most = timestep * np.array([np.inf if each is None else each for each in settings["rate_limit"]])
        self._timestep, self._slots = timestep, int(settings["slots"])
        self.reset(np.zeros(len(self._scale)))

    def reset(self, command: np.ndarray) -> None:
        """Start at rest under a command, the backlash in its middle."""
        self._sent = np.tile(command, (self._slots, 1))
        self._limited = self._lagged = self._played = self._scale * command + self._offset

    def step(self, command: np.ndarray) -> np.ndarray:
        """Advance by one physics step; return the actuators' `ctrl`."""
        self._sent = np.concatenate([command[None], self._sent[:-1]])
        arrived = self._scale * self._delayed() + self._offset
        self._limited = np.clip(arrived, self._limited - self._most, self._limited + self._most)
        lag = self._lag / (self._lag + self._timestep)
        self._lagged = self._limited + (self._lagged - self._limited) * lag
        half = self._backlash / 2
        self._played = np.clip(self._played, self._lagged - half, self._lagged + half)
        return self._played

    def _delayed(self) -> np.ndarray:
        last = self._slots - 1
        late = np.clip(self._delay / self._timestep, 0.0, last)
        whole = np.minimum(np.floor(late), last - 1).astype(int)
        share, columns = late - whole, np.arange(len(late))
        return (1 - share) * self._sent[whole, columns] + share * self._sent[whole + 1, columns]


# ---- the simulator ----


class ImprovedSimulator:
    """The improved simulator of a folder, control step by control step.

    `model` and `data` are MuJoCo's; `command` is the command of the last control step. Commands are in the actuators'
    own units, in the order of `commands`; the residual and the drivetrain act on them and on the robot's bodies.

    **Arguments**

    - `folder`: with `identified.xml`, `simulator.json` and `parameters.npz`.
    - `model`: a model of your own that holds the robot, with sites and actuators of the same names; None: the folder's.
      A model of your own must have the identified values: build it from `identified.xml`.

    **Raises** `ValueError` where the folder is of another format, or the model does not have the robot.
    """

    def __init__(self, folder: Path | str, model: mujoco.MjModel | None = None) -> None:
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
        """Names of the commands."""
        self.names = (settings["tracked"], *settings["points"])
        """Sites that are observed, the tracked one first."""
        self.control_timestep: float = settings["control_timestep"]
        """Seconds between two commands."""
        self.substeps: int = settings["substeps"]
        """Physics steps in a control step."""
        if not np.isclose(self.model.opt.timestep * self.substeps, self.control_timestep):
            raise ValueError(f"The model's time step must be {self.control_timestep / self.substeps:g} s.")
        self._sites = self._find(mujoco.mjtObj.mjOBJ_SITE, self.names)
        self._bodies = self.model.site_bodyid[self._sites]
        actuators = [command["actuator"] for command in settings["commands"]]
        self._actuators = self._find(mujoco.mjtObj.mjOBJ_ACTUATOR, actuators)
        self.rest = np.array([command["rest"] for command in settings["commands"]], float)
        """Commands of a robot at rest."""
        own = [
            {name.partition("/")[2]: value for name, value in arrays.items() if name.startswith(f"part_{number}/")}
            for number in range(len(settings["residual"]))
        ]
        self.residual = [_PARTS[p["kind"]](p, a) for p, a in zip(settings["residual"], own, strict=True)]
        """The residual's parts, which act together."""
        drivetrain, timestep = settings["drivetrain"], float(self.model.opt.timestep)
        self.drivetrain = None if drivetrain is None else Drivetrain(drivetrain, timestep)
        """None where commands arrive unchanged."""
        self._places = [
            self.model.jnt_dofadr[self._find(mujoco.mjtObj.mjOBJ_JOINT, part.joints)] if len(part.joints) else []
            for part in self.residual
        ]
        self._ranges = np.array([[command["low"], command["high"]] for command in settings["commands"]]).T
        self.wrench = np.zeros((1, 6))
        """Force (N) and torque (N m, world) of the last control step: on the tracked body, then at the points."""
        self.joint_force = np.zeros(self.model.nv)
        """Generalized forces (N, N m) of the last control step."""
        self.reset()

    def reset(
        self, qpos: np.ndarray | None = None, qvel: np.ndarray | None = None, command: np.ndarray | None = None
    ) -> None:
        """Start at a state that the robot has been in for a while.

        **Arguments**

        - `qpos`, `qvel`: generalized positions and velocities; None: where the exported simulator starts, at rest.
        - `command`: what has been commanded; None: the commands of a robot at rest.
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
        """Return what motion capture sees of the current state; see the function of the same name."""
        return features(self.model, self.data, self._sites)

    def step(self, command: np.ndarray) -> mujoco.MjData:
        """Advance by a control step under a command; returns `data`."""
        for _ in self.substep(command):
            pass
        return self.data

    def substep(self, command: np.ndarray):  # noqa: ANN201
        """Advance by a control step under a command; yields `data` after each of its physics steps."""
        self.command = np.array(command, float)
        commands = np.concatenate([self._earlier, self.command[None]])
        sent = self.command[None]
        self.wrench = np.zeros((1, 6))
        if self.residual:
            sent = self.command + sum(part.command(commands) - self.command for part in self.residual)
            actions = [part.act(self._history, commands) for part in self.residual]
            self.wrench = np.zeros((max(len(action.wrench) for action in actions), 6))
            self.joint_force[:] = 0.0
            for places, action in zip(self._places, actions, strict=True):
                self.wrench[: len(action.wrench)] += action.wrench
                self.joint_force[places] += action.joint_force
            change = sum(action.command_change for action in actions)
            if np.any(change):
                sent = np.clip(sent + change, *self._ranges)
        for ctrl in np.repeat(sent, self.substeps // len(sent), axis=0):
            self._physics_step(ctrl if self.drivetrain is None else self.drivetrain.step(ctrl))
            yield self.data
        self._earlier = commands[1:]
        self._history = np.concatenate([self._history[1:], self.features()[None]])

    def _physics_step(self, ctrl: np.ndarray) -> None:
        model, data = self.model, self.data
        data.ctrl[self._actuators] = ctrl
        data.xfrc_applied[self._bodies] = 0.0
        for places in self._places:
            data.qfrc_applied[places] = self.joint_force[places]
        if len(self.wrench) > 1:  # where the points are now decides on the torques
            mujoco.mj_kinematics(model, data)
        for number, (wrench, site, body) in enumerate(zip(self.wrench, self._sites, self._bodies, strict=False)):
            data.xfrc_applied[body] += wrench
            if number:
                data.xfrc_applied[body, 3:] += np.cross(data.site_xpos[site] - data.xipos[body], wrench[:3])
        mujoco.mj_step(model, data)

    def _find(self, kind: mujoco.mjtObj, names: Any) -> np.ndarray:
        found = np.array([mujoco.mj_name2id(self.model, kind, name) for name in names])
        if (found < 0).any():
            raise ValueError(f"The model has no {list(names)[int(np.argmin(found))]!r}, which the robot needs.")
        return found


def _load_model(folder: Path, arrays: Mapping[str, np.ndarray]) -> mujoco.MjModel:
    """Return the model; fields of which MJCF's text holds fewer digits come from the arrays."""
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


# ---- the check ----


def deviations(folder: Path | str) -> tuple[np.ndarray, np.ndarray, float]:
    """Return how far this simulator is from the exported one after each control step of a rollout that came with the
    folder: of the tracked site (m) and of its body (deg); and the seconds that a control step takes here."""
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
        # By the sine of half the angle: the cosine has no digits left for small ones.
        product = np.zeros(4)
        mujoco.mju_mulQuat(product, turn * [1, -1, -1, -1], data.xquat[simulator._bodies[0]])
        angles.append(2 * np.rad2deg(np.arcsin(min(np.linalg.norm(product[1:]), 1.0))))
    return np.array(distances), np.array(angles), (time.perf_counter() - start) / len(commands)


def self_test(folder: Path | str) -> int:
    """Compare a rollout with the exported simulator's, and print the differences; returns 0 where they are small."""
    distances, angles, seconds = deviations(folder)
    step = json.loads((Path(folder) / SETTINGS_FILE).read_text(encoding="utf-8"))["control_timestep"]
    print("Difference from the simulator that was exported, largest so far:")
    for number in sorted({max(round(after / step), 1) for after in (0.5, 1, 2, 5)} | {len(distances)}):
        if number <= len(distances):
            largest = 1000 * distances[:number].max(), angles[:number].max()
            print(f"  after {number * step:5.2f} s  {largest[0]:9.4f} mm  {largest[1]:9.5f} deg")
    print(f"A control step of {1000 * step:g} ms takes {1000 * seconds:.2f} ms here.")
    good = distances.max() < 1e-3 and angles.max() < 0.1
    print("Passed." if good else "FAILED: the differences are above 1 mm or 0.1 deg.")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(self_test(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).resolve().parent))
