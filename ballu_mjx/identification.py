"""Identification of the actuators from a suspended sweep (paper, section "System Identification", Algorithm 1).

The legs hang from a base held still, so that each is identified by itself, both at once. Settled angles under a command
are the root of MJX's inverse dynamics at rest, differentiated as an implicit function: no derivative through a
simulation to rest. They are where the search begins. What decides is the whole motion, simulated from the first command
to the last and differentiated forwards, with what a command meets on its way: delay, backlash and dry friction
(`Drivetrain`), under which no leg is ever quite at rest.

All functions compute in double precision and are to be called inside `jax.enable_x64(True)`, but for `identify`, which
sees to it itself. A leg's parameters are a vector in the order of `NAMES`; a pair of angles is (motor, knee).
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int
from mujoco import mjx

from ballu_mjx import batch_last, simulation
from ballu_mjx import robot as ballu
from ballu_mjx.errors import InputError
from ballu_mjx.robot import SIDES, ActuatorParameters
from ballu_mjx.simulation import State
from ballu_mjx.sweep import SAMPLE_TIMESTEP, Sweep

CURVE_SAMPLES = 200
"""Points at which the curves are compared (paper)."""
NAMES = tuple(field.name for field in dataclasses.fields(ActuatorParameters))
"""A leg's parameters, in the order of a vector."""
_STRONG = 0.9
"""Correlations beyond this are named."""
_DEGREE = float(np.pi / 180)


@dataclasses.dataclass(frozen=True)
class IdentificationConfig:
    """How actuators are identified. The defaults were chosen by measurement (docs/actuators.md)."""

    torque_limit: bool = True
    """Identify the servos' torque limits too. The paper's eight parameters alone can tell a weak servo only by a spring
    stiffer than the robot's."""
    cable_slack: bool = True
    """Identify the cables' slack too. Without it, springs and servos come out up to three times too strong."""
    motion: bool = True
    """Learn from the whole motion, not from settled angles alone; delay, backlash and dry friction are then further
    unknowns."""
    objective: Literal["pointwise", "hausdorff"] = "pointwise"
    """`pointwise`: least squares over all angles (Levenberg-Marquardt). `hausdorff`: the paper's distance between
    curves (L-BFGS), started from the pointwise solution; motion has no part in it."""
    degree: int = 7
    """Degree of the polynomials fitted to the curves of angle over command."""
    draws: int = 128
    """Parameters drawn at random for each leg, beside the nominal ones, to find good starts."""
    starts: int = 8
    """Searches for each leg, from the best draws."""
    steps: int = 25
    """Most iterations of a search."""
    seed: int = 0
    """Seeds the draws."""


class _Range(NamedTuple):
    """What is known of a parameter beforehand."""

    factor: float | None
    """Bounds are the nominal value divided and multiplied by this; or else:"""
    reach: tuple[float, float]
    """Bounds are the nominal value less and plus these (rad, or m)."""
    prior: float
    """How much robots differ (standard deviation): relative to the nominal value, or rad, or m."""


RANGES: dict[str, _Range] = {
    "knee_spring_stiffness": _Range(4.0, (0.0, 0.0), 0.3),
    "motor_gain": _Range(4.0, (0.0, 0.0), 0.3),
    "default_motor_angle": _Range(None, (20 * _DEGREE, 20 * _DEGREE), 5 * _DEGREE),
    "default_knee_angle": _Range(None, (15 * _DEGREE, 15 * _DEGREE), 3 * _DEGREE),
    "torque_limit": _Range(4.0, (0.0, 0.0), 0.3),
    "cable_slack": _Range(None, (9e-5, 5e-3), 5e-4),
}


class Drivetrain(NamedTuple):
    """What a command meets on its way to the joints, and what the simulators leave out: identified with the parameters,
    so that it does not pass for them, and reported."""

    delay: Any
    """Seconds from a command to the servo's target."""
    motor_friction: Any
    """Dry friction (N m)."""
    knee_friction: Any
    """Dry friction (N m)."""
    backlash: Any
    """Width (rad) of the play between command and motor arm."""


_FIRST = Drivetrain(0.03, 2e-3, 5e-4, 1 * _DEGREE)
"""Where the search begins."""


def drivetrain_coordinates(values: Drivetrain) -> Float[np.ndarray, " 4"]:
    """Unbounded coordinates: of the delay linear, of the others logarithms; 0 where the search begins."""
    others = np.log(np.array(values[1:]) / np.array(_FIRST[1:]))
    return np.array([(values.delay - _FIRST.delay) / DELAY_UNIT, *others])


def drivetrain(coordinates: Float[Array, " 4"]) -> Drivetrain:
    """The inverse of `drivetrain_coordinates`."""
    delay, *others = coordinates
    return Drivetrain(
        _FIRST.delay + DELAY_UNIT * delay, *(f * jnp.exp(x) for f, x in zip(_FIRST[1:], others, strict=True))
    )


DELAY_UNIT = 0.01
"""Seconds of delay that a coordinate of 1 stands for."""


def _actuators(vector: Float[Array, " parameters"]) -> ActuatorParameters:
    """Of a model with one leg."""
    return ActuatorParameters(*vector[:, None])


class SuspendedLeg:
    """The nominal robot's leg in MJX, hanging from a base held still, for any actuator parameters.

    The left leg, which serves for both: the right one is its mirror image, and moves alike. Legs come in one batch:
    one for each command, parameters and direction of a derivative.
    """

    def __init__(self) -> None:
        self.model = ballu.load_suspended_leg(SIDES[0])
        joints = [self.model.joint(f"{kind}_{SIDES[0]}") for kind in ("motor", "knee")]
        self.angles = np.array([joint.qposadr[0] for joint in joints])
        self._dofs = np.array([joint.dofadr[0] for joint in joints])
        self._mjx = simulation.put_model(self.model)
        self._data = simulation.make_data(self.model)
        rubbing = copy.copy(self.model)
        rubbing.dof_frictionloss[self._dofs] = _FIRST.motor_friction, _FIRST.knee_friction  # MJX leaves out those of 0
        self._rubbing = simulation.put_model(rubbing)
        self._rubbing_data = simulation.make_data(rubbing)
        self._relaxation_damping = np.zeros(self.model.nv)
        for kind, damping in _RELAXATION_DAMPING.items():
            self._relaxation_damping[self.model.joint(f"{kind}_{SIDES[0]}").dofadr[0]] = damping
        self.residual_torque = batch_last.fast(self._residual_torque)

    def settled(
        self, vectors: Float[Array, "legs parameters"], commands: Float[Array, " legs"]
    ) -> tuple[Float[Array, "legs nq"], Float[Array, "legs nq parameters"]]:
        """Generalized positions at rest under each leg's command; `[:, self.angles]` are motor and knee (rad). And
        their derivatives, those of an implicit function."""
        close = jax.vmap(batch_last.fast(self._relaxed_qpos))(vectors, commands)
        qpos, jacobians = self._rest(close, vectors, commands)
        nq = self.model.nq
        return qpos, -jnp.linalg.solve(jacobians[..., :nq], jacobians[..., nq:])

    def motion(
        self,
        vector: Float[Array, " parameters"],
        drivetrain: Drivetrain,
        command: Float[Array, " times"],
        begins: Bool[np.ndarray, " times"],
    ) -> Float[Array, "times 2"]:
        """One leg's motor and knee angle (rad) every `SAMPLE_TIMESTEP`, each as it was the delay before.

        **Arguments**

        - `command`: held from each time to the next.
        - `begins`: where the leg is set to rest at the default angles, and the play to its middle.

        Differentiable forwards.
        """
        inner = round(SAMPLE_TIMESTEP / float(self.model.opt.timestep))

        def path(vector: Array, drivetrain: Drivetrain, command: Array) -> Array:
            friction = jnp.zeros(self.model.nv)
            friction = friction.at[self._dofs].set(jnp.stack([drivetrain.motor_friction, drivetrain.knee_friction]))
            fields = ballu.actuator_fields(self.model, _actuators(vector)) | {"dof_frictionloss": friction}
            model = ballu.with_fields(self._rubbing, fields)
            start = simulation.at(self._default_qpos(vector), jnp.zeros(self.model.nv))
            half = drivetrain.backlash / 2 / ballu.SERVO_RANGE

            def step(carry: tuple[State, Array], now: tuple[Array, Array]) -> tuple[tuple[State, Array], Array]:
                (state, play), (command, begins) = carry, now
                state = jax.tree.map(partial(jnp.where, begins), start, state)
                play = jnp.where(begins, command, jnp.clip(play, command - half, command + half))
                held = self._rubbing_data.replace(ctrl=play[None])  # pyright: ignore
                for _ in range(inner):
                    state = simulation.physics_step(model, held, state)
                return (state, play), state.qpos[self.angles]

            after = jax.lax.scan(step, (start, command[0]), (command, jnp.asarray(begins)))[1]
            return jnp.concatenate([start.qpos[self.angles][None], after[:-1]])

        moved = batch_last.fast(path)(vector, drivetrain, command)
        times = SAMPLE_TIMESTEP * jnp.arange(len(begins))
        return jax.vmap(lambda column: jnp.interp(times - drivetrain.delay, times, column), 1, 1)(moved)

    def _residual_torque(
        self, qpos: Float[Array, " nq"], vector: Float[Array, " parameters"], command: Float[Array, ""]
    ) -> Float[Array, " nv"]:
        """Generalized force (N m) that nothing balances, at rest in `qpos`: zero where the leg hangs still."""
        model = self._with(vector)
        rest = jnp.zeros(self.model.nv)
        data = self._data.replace(qpos=qpos, qvel=rest, qacc=rest, ctrl=command[None])  # pyright: ignore
        data = mjx.fwd_actuation(model, mjx.inverse(model, data))
        return data.qfrc_actuator - data.qfrc_inverse

    def _with(self, vector: Float[Array, " parameters"]) -> mjx.Model:
        return ballu.with_fields(self._mjx, ballu.actuator_fields(self.model, _actuators(vector)))

    def _default_qpos(self, vector: Float[Array, " parameters"]) -> Float[Array, " nq"]:
        rest = [vector[NAMES.index(name)] for name in ("default_motor_angle", "default_knee_angle")]
        return jnp.zeros(self.model.nq).at[self.angles].set(jnp.stack(rest))

    def _relaxed_qpos(self, vector: Float[Array, " parameters"], command: Float[Array, ""]) -> Float[Array, " nq"]:
        """Close to rest, by simulating the way there from command 0, heavily damped and in long steps: whether the
        cable is taut, the stop holds and the servo saturates is then settled."""
        model = self._with(vector)
        # One iteration will do here: what is not exact is Newton's to mend.
        option = model.opt.replace(timestep=jnp.asarray(_RELAXATION_TIMESTEP), iterations=1, ls_iterations=4)
        model = model.replace(dof_damping=jnp.asarray(self._relaxation_damping), opt=option)  # pyright: ignore
        start = simulation.at(self._default_qpos(vector), jnp.zeros(self.model.nv))
        held = self._data.replace(ctrl=command[None])  # pyright: ignore
        step = lambda _, state: simulation.physics_step(model, held, state)  # noqa: E731
        return jax.lax.fori_loop(0, _RELAXATION_STEPS, step, start).qpos

    def _rest(
        self,
        close: Float[Array, "legs nq"],
        vectors: Float[Array, "legs parameters"],
        commands: Float[Array, " legs"],
    ) -> tuple[Float[Array, "legs nq"], Float[Array, "legs nv nq+parameters"]]:
        """Where nothing is left unbalanced, and the derivatives there of what is, by positions and parameters.

        By Newton's method with Levenberg's damping, from close by. Optimistix has such solvers; each holds MJX's
        program several times over, this one once.
        """
        nq = self.model.nq
        every = jnp.eye(nq + vectors.shape[1])
        directions = tuple(jnp.tile(x, (len(close), 1, 1)) for x in (every[:, :nq], every[:, nq:]))

        def evaluate(qpos: Array) -> tuple[Array, Array]:
            return along_directions(self.residual_torque, (qpos, vectors), directions, (commands,))

        def body(state: tuple[Array, ...]) -> tuple[Array, ...]:
            x, value, jacobian, damping, trial, count = state
            new_value, new_jacobian = evaluate(trial)
            better = jnp.sum(new_value**2, axis=1) < jnp.sum(value**2, axis=1)
            x, value = (jnp.where(better[:, None], *pair) for pair in ((trial, x), (new_value, value)))
            jacobian = jnp.where(better[:, None, None], new_jacobian, jacobian)
            damping = jnp.where(better, damping / 100, damping * 10)
            slope = jacobian[..., :nq]
            normal = jnp.swapaxes(slope, 1, 2) @ slope
            damped = normal * (1 + damping[:, None, None] * jnp.eye(nq))
            step = jnp.linalg.solve(damped, jnp.swapaxes(slope, 1, 2) @ value[..., None])[..., 0]
            return x, value, jacobian, damping, x - step, count + 1

        def unfinished(state: tuple[Array, ...]) -> Array:
            x, _, _, _, trial, count = state
            return (count < _ROOT_STEPS) & ((count == 0) | (jnp.max(jnp.abs(trial - x)) > _ROOT_TOLERANCE))

        legs, nv = len(close), self.model.nv
        start = (close, jnp.full((legs, nv), jnp.inf), jnp.zeros((legs, nv, len(every))), jnp.full(legs, 1e-4), close)
        x, _, jacobian, *_ = jax.lax.while_loop(unfinished, body, (*start, jnp.zeros((), int)))
        return x, jacobian


_RELAXATION_TIMESTEP = 0.05
_RELAXATION_STEPS = 150
_RELAXATION_DAMPING = {"hip": 0.1, "knee": 0.03, "motor": 0.05}
"""N m s/rad: more than half the time step times the stiffness of each joint, which keeps such long steps stable."""


def along_directions(
    function: Callable[..., Array],
    points: tuple[Float[Array, "n _"] | Float[Array, " n"], ...],
    directions: tuple[Float[Array, "n k _"] | Float[Array, "n k"], ...],
    held: tuple[Float[Array, "n ..."], ...],
) -> tuple[Float[Array, "n ..."], Float[Array, "n ... k"]]:
    """Values of `function(*point, *held)` at n points, and how they change along k directions at each.

    In one batch of n k: batches within batches are traced once more each, and run in shorter loops.
    """
    n, k = directions[0].shape[:2]
    points, held = (tuple(jnp.repeat(x, k, axis=0) for x in group) for group in (points, held))
    directions = tuple(x.reshape(n * k, *x.shape[2:]) for x in directions)

    def one(point: tuple[Array, ...], direction: tuple[Array, ...], held: tuple[Array, ...]) -> tuple[Array, Array]:
        return jax.jvp(lambda *point: function(*point, *held), point, direction)

    values, changes = jax.vmap(one)(points, directions, held)
    return values[::k], jnp.moveaxis(changes.reshape(n, k, *changes.shape[1:]), 1, -1)


_ROOT_STEPS = 40
_ROOT_TOLERANCE = 1e-9
"""rad: the next step would be lost in rounding."""


def polynomial_curve(
    command: Float[Array | np.ndarray, " holds"], angles: Float[Array | np.ndarray, " holds"], degree: int
) -> Float[Array, "200 2"]:
    """The polynomial fitted to angles (rad) over commands, at `CURVE_SAMPLES` commands in [0, 1].

    Points (command, angle over 90 deg): the plane in which the paper's curves are compared. Linear in the angles."""
    samples = np.linspace(0.0, 1.0, CURVE_SAMPLES)
    # In Chebyshev polynomials: powers of the command would be close to dependent.
    basis = lambda x: jnp.cos(jnp.arange(degree + 1) * jnp.arccos(jnp.clip(2 * x - 1, -1.0, 1.0))[:, None])  # noqa: E731
    coefficients = jnp.linalg.lstsq(basis(jnp.asarray(command)), jnp.asarray(angles))[0]
    return jnp.stack([jnp.asarray(samples), basis(jnp.asarray(samples)) @ coefficients / ballu.SERVO_RANGE], axis=1)


def directed_hausdorff(from_points: Float[Array, "n d"], to_points: Float[Array, "m d"]) -> Float[Array, ""]:
    """The largest distance of a point in `from_points` to the nearest of `to_points`.

    Not smooth: its gradient is that of the one pair of points that decides (a subgradient, where several do), and 0
    where that pair coincides.
    """
    squared = jnp.sum((from_points[:, None] - to_points[None]) ** 2, axis=-1)
    decisive = jnp.max(jnp.min(squared, axis=1))
    return jnp.where(decisive > 0, jnp.sqrt(jnp.where(decisive > 0, decisive, 1.0)), 0.0)


def curve_distances(
    command: Float[np.ndarray | Array, " holds"],
    simulated: Float[Array | np.ndarray, "holds 2"],
    measured: Float[Array | np.ndarray, "holds 2"],
    degree: int,
) -> Float[Array, "2 2"]:
    """Directed Hausdorff distances between a leg's simulated and measured curves: (simulated to measured, measured to
    simulated) by (motor, knee). The paper's objective is the sum of the first row over both legs."""
    pairs = [
        [polynomial_curve(command, angles[:, joint], degree) for angles in (simulated, measured)] for joint in range(2)
    ]
    return jnp.stack([jnp.stack([directed_hausdorff(*pair[::way]) for pair in pairs]) for way in (1, -1)])


class Space:
    """Between a leg's parameters in their units and the unbounded coordinates that are searched.

    A coordinate runs through a logistic function from the lower to the upper bound: of the logarithm for stiffness,
    gain and torque limit, of the value itself for angles and slack. Parameters that are not free keep their nominal
    value.
    """

    def __init__(self, nominal: Float[np.ndarray, " parameters"], config: IdentificationConfig) -> None:
        ranges = [RANGES[name] for name in NAMES]
        factors = np.array([r.factor or 1.0 for r in ranges])
        below, above = np.array([r.reach for r in ranges]).T
        self.nominal = nominal
        self.relative = np.array([r.factor is not None for r in ranges])
        self.lower, self.upper = nominal / factors - below, nominal * factors + above
        self.prior = np.array([r.prior for r in ranges]) * np.where(self.relative, nominal, 1.0)
        """Standard deviation of each parameter among robots, in its units."""
        self.free = np.isin(NAMES, _free_names(config))

    def vector(self, coordinates: Float[Array, " free"]) -> Float[Array, " parameters"]:
        """A leg's parameters, in their units."""
        free, relative = self.free, self.relative[self.free]
        lower, upper = self.lower[free], self.upper[free]
        ratio = np.where(relative, upper / np.where(relative, lower, 1.0), 1.0)
        share = jax.nn.sigmoid(coordinates)
        values = jnp.where(relative, lower * ratio**share, lower + share * (upper - lower))
        return jnp.asarray(self.nominal).at[np.flatnonzero(free)].set(values)

    def coordinates(self, vector: Float[np.ndarray, " parameters"]) -> Float[np.ndarray, " free"]:
        """The inverse of `vector`, for values within the bounds."""
        share = (vector - self.lower) / (self.upper - self.lower)
        logs = [np.log(np.where(self.relative, x, 1.0)) for x in (vector, self.lower, self.upper)]
        span = np.where(self.relative, logs[2] - logs[1], 1.0)
        share = np.where(self.relative, (logs[0] - logs[1]) / span, share)[self.free]
        return np.log(share / (1 - share))

    def draw(self, seed: int, count: int) -> Float[np.ndarray, "draws free"]:
        """Coordinates: of the nominal values, then of uniform draws from the middle half of the bounds' span."""
        shares = np.random.default_rng(seed).uniform(0.25, 0.75, (count, int(self.free.sum())))
        return np.concatenate([self.coordinates(self.nominal)[None], np.log(shares / (1 - shares))])


class LegData(NamedTuple):
    """A `Sweep` with the legs (left, right) first and (motor, knee) last; rad. In its motion each recording is preceded
    by a stretch under its first command, in which the leg comes to rest."""

    command: Float[np.ndarray, "legs holds"]
    settled: Float[np.ndarray, "legs holds 2"]
    weights: Float[np.ndarray, "legs holds 2"]
    """Root of the samples in each mean: a mean of n samples counts as n of them, if the joint was at rest."""
    commanded: Float[np.ndarray, "legs times"]
    motion: Float[np.ndarray, "legs times 2"]
    counts: Bool[np.ndarray, " times"]
    begins: Bool[np.ndarray, " times"]


def nominal_leg() -> Float[np.ndarray, " parameters"]:
    """A leg's nominal parameters."""
    nominal = ActuatorParameters.nominal(ballu.load_suspended_leg(SIDES[0]))
    return np.concatenate([np.asarray(getattr(nominal, name), float) for name in NAMES])


def leg_data(sweep: Sweep) -> LegData:
    """As the fit takes it."""
    firsts = np.flatnonzero(sweep.begins)
    rows = np.insert(np.arange(len(sweep.hold)), np.repeat(firsts, _AT_REST), np.repeat(firsts, _AT_REST))
    before = np.insert(np.zeros(len(sweep.hold), bool), np.repeat(firsts, _AT_REST), True)
    still = np.moveaxis(1 / np.hypot(1, sweep.drift / _DRIFT), -1, 0)
    return LegData(
        command=sweep.command.T,
        settled=np.moveaxis(sweep.settled, -1, 0),
        weights=np.sqrt(sweep.samples)[:, None] * still,
        commanded=sweep.command[sweep.hold[rows]].T,
        motion=np.moveaxis(sweep.motion[rows], -1, 0),
        counts=~before,
        begins=before & ~np.roll(before, 1),
    )


_AT_REST = round(2.0 / SAMPLE_TIMESTEP)
_DRIFT = 0.05 * _DEGREE
"""A joint that creeps on by more has not arrived, and its angle counts for less."""


class Physics:
    """The two programs that hold MJX, compiled side by side: values and Jacobians in a `Space`'s coordinates, for
    batches of fixed sizes. The second, of the motion, only where it is wanted."""

    def __init__(self, space: Space, batch: int, data: LegData, *, motion: bool) -> None:
        self.leg, self.batch = SuspendedLeg(), batch
        size, (legs, holds) = int(space.free.sum()), data.command.shape
        every = size + len(_FIRST)

        def settled(coordinates: Array, command: Array) -> tuple[Array, Array]:
            vectors, by_coordinates = jax.vmap(lambda y: (space.vector(y), jax.jacfwd(space.vector)(y)))(coordinates)
            qpos, slopes = self.leg.settled(jnp.repeat(vectors, holds, axis=0), command.ravel())
            slopes = slopes.reshape(batch, holds, *slopes.shape[1:])
            return qpos.reshape(batch, holds, -1), slopes @ by_coordinates[:, None]

        def moving(coordinates: Array, command: Array) -> tuple[Array, Array]:
            def path(y: Array, command: Array) -> Array:
                return self.leg.motion(space.vector(y[:size]), drivetrain(y[size:]), command, data.begins)

            directions = jnp.tile(jnp.eye(every), (legs, 1, 1))
            return along_directions(path, (coordinates,), (directions,), (command,))

        programs = [jax.jit(settled).lower(jnp.zeros((batch, size)), jnp.zeros((batch, holds)))]
        if motion:
            programs.append(jax.jit(moving).lower(jnp.zeros((legs, every)), jnp.zeros(data.commanded.shape)))
        with ThreadPoolExecutor() as pool:
            self._compiled = list(pool.map(lambda program: program.compile(), programs))

    def settled(
        self, coordinates: Float[np.ndarray, "n size"], command: Float[np.ndarray, "n holds"]
    ) -> tuple[Float[np.ndarray, "n holds nq"], Float[np.ndarray, "n holds nq size"]]:
        """Positions at rest and their derivatives, for any number of coordinates."""
        values, slopes = [], []
        for first in range(0, len(coordinates), self.batch):
            count = min(self.batch, len(coordinates) - first)
            rows = np.minimum(first + np.arange(self.batch), first + count - 1)
            value, slope = self._compiled[0](jnp.asarray(coordinates[rows]), jnp.asarray(command[rows]))
            values.append(np.asarray(value)[:count])
            slopes.append(np.asarray(slope)[:count])
        return np.concatenate(values), np.concatenate(slopes)

    def motion(
        self, coordinates: Float[np.ndarray, "legs _"], commanded: Float[np.ndarray, "legs times"]
    ) -> tuple[Float[np.ndarray, "legs times 2"], Float[np.ndarray, "legs times 2 _"]]:
        """Both legs' motion and its derivatives; coordinates end with those of `drivetrain`."""
        value, jacobian = self._compiled[1](jnp.asarray(coordinates), jnp.asarray(commanded))
        return np.asarray(value), np.asarray(jacobian)


class Direction(NamedTuple):
    """A combination of a leg's parameters, in units of what robots differ by (`RANGES`)."""

    weights: Float[np.ndarray, " free"]
    """Unit vector; entries in the order of the free parameters."""
    standard_error: float
    """Of the combination: below 1, the data know more than is known without them."""


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """One leg, identified."""

    vector: Float[np.ndarray, " parameters"]
    standard_errors: Float[np.ndarray, " parameters"]
    """In the parameters' units, from the Jacobian and the scatter of the residuals taken as white noise; 0 for those
    that were not free, and of the prior's size at most along open directions."""
    correlations: Float[np.ndarray, "free free"]
    directions: tuple[Direction, ...]
    """From the best to the least determined."""
    drivetrain: Drivetrain | None
    residual: float
    """Root mean square (rad) of all residuals."""
    losses: Float[np.ndarray, " starts"]
    """Sums of squares (rad^2, settled angles) that the starts ended at, in ascending order."""

    @property
    def open_directions(self) -> tuple[Direction, ...]:
        """Those that the data leave open: held near the nominal values."""
        return tuple(d for d in self.directions if d.standard_error > 1.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Identification:
    """Both legs (left, right)."""

    fits: tuple[Fit, Fit]
    settled: Float[np.ndarray, "holds 2 2"]
    """Settled angles (rad) of the identified robot; (motor, knee), (left, right) last, as in `Sweep`."""
    with_drivetrain: Float[np.ndarray, "holds 2 2"] | None
    """What its motion comes to with the identified drivetrain."""
    nominal_settled: Float[np.ndarray, "holds 2 2"]
    """The same as `settled`, of the nominal robot."""
    config: IdentificationConfig

    @property
    def parameters(self) -> ActuatorParameters:
        return ActuatorParameters(
            *(jnp.asarray(row, jnp.float32) for row in np.stack([f.vector for f in self.fits], 1))
        )


Report = Callable[[str, int, int, float], None]
"""(stage, iteration, most iterations, the lowest loss among the searches)."""


def identify(
    sweep: Sweep, config: IdentificationConfig = IdentificationConfig(), report: Report | None = None
) -> Identification:
    """Fit both legs' parameters to a sweep.

    1. Settled angles alone, from several starts side by side, the best of many draws: searches that start with a servo
       that never saturates, say, end in a valley of their own.
    2. From the best of these, the whole motion.
    3. Directions that the data leave open, if any, are drawn to the nominal values, and to nothing else.
    4. With `objective="hausdorff"`, the paper's distance between curves, from there.

    **Raises** `InputError` from `IdentificationConfig`'s check.
    """
    check(config)
    report = report or (lambda stage, iteration, steps, value: None)
    with jax.enable_x64(True):
        return Identifier(config, sweep, report).run(sweep, report)


def check(config: IdentificationConfig) -> None:
    """Refuse sizes that make no sense.

    **Raises** `InputError` naming the option.
    """
    for name in ("draws", "starts", "steps", "degree"):
        if getattr(config, name) < 1:
            raise InputError(f"--{name} is {getattr(config, name)}: it must be 1 or more; 1 is the nearest.")
    if config.seed < 0:
        raise InputError(f"--seed is {config.seed}: it must be 0 or more; 0 is the nearest.")


class Identifier:
    """The stages of `identify`, compiled once for sweeps of the same sizes."""

    def __init__(self, config: IdentificationConfig, sweep: Sweep, report: Report) -> None:
        self.config = config
        data = leg_data(sweep)
        starts = min(config.starts, config.draws + 1)
        report("compiling", 0, 1, float("nan"))
        self.space = Space(nominal_leg(), config)
        self.physics = Physics(self.space, starts * len(SIDES), data, motion=config.motion)
        report("compiling", 1, 1, float("nan"))
        self._starts, self._size = starts, int(self.space.free.sum())
        self._squares = _Search(optx.LevenbergMarquardt(rtol=1e-5, atol=1e-5))
        self._shape = _Search(optx.LBFGS(rtol=1e-5, atol=1e-5))

        def objective(angles: Array, command: Array, measured: Array) -> Array:
            return jnp.sum(curve_distances(command, angles, measured, config.degree)[0])

        gradient = jax.value_and_grad(objective)
        self._curve_gradients = jax.jit(jax.vmap(lambda command, angles, measured: gradient(angles, command, measured)))

    def run(self, sweep: Sweep, report: Report) -> Identification:
        config, size, data = self.config, self._size, leg_data(sweep)
        legs = np.arange(len(SIDES))

        draws = self.space.draw(config.seed, config.draws)
        coordinates, leg = np.tile(draws, (len(legs), 1)), np.repeat(legs, len(draws))
        report("draws", 0, 1, float("nan"))
        losses = np.sum(self._settled_residuals(coordinates, leg, data)[0] ** 2, axis=1).reshape(len(legs), -1)
        report("draws", 1, 1, float(losses.min()))
        best = np.argsort(losses, axis=1)[:, : self._starts]
        starts, leg = draws[best].reshape(-1, size), np.repeat(legs, self._starts)
        found, ended = self._squares(
            lambda y: self._settled_residuals(y, leg, data), starts, config.steps, partial(report, "settled angles")
        )
        ended = ended.reshape(len(legs), -1)
        coordinates = found.reshape(len(legs), -1, size)[legs, np.argmin(ended, axis=1)]

        if config.motion:
            coordinates = np.concatenate([coordinates, np.zeros((len(legs), len(_FIRST)))], axis=1)
            coordinates, _ = self._squares(
                lambda y: self._residuals(y, data), coordinates, config.steps, partial(report, "motion")
            )
        analyses = self._analyse(coordinates, data)
        if any(direction.standard_error > 1 for a in analyses for direction in a.directions):
            coordinates, _ = self._squares(
                lambda y: self._drawn(y, data, analyses), coordinates, config.steps, partial(report, "open directions")
            )
            analyses = self._analyse(coordinates, data)
        if config.objective == "hausdorff":
            # From every search's end: a maximum over points and a sum over joints has more valleys still.
            starts = np.concatenate([coordinates[:, None, :size], found.reshape(len(legs), -1, size)[:, 1:]], axis=1)
            shaped, distances = self._shape(
                lambda y: self._distance(y, leg, data),
                starts.reshape(-1, size),
                config.steps,
                partial(report, "curves"),
            )
            best = np.argmin(distances.reshape(len(legs), -1), axis=1)
            shaped = shaped.reshape(len(legs), -1, size)[legs, best]
            coordinates = np.concatenate([shaped, coordinates[:, size:]], axis=1)
            analyses = self._analyse(coordinates, data)

        before = np.tile(self.space.coordinates(self.space.nominal), (len(legs), 1))
        settled = [self._angles(y, data.command)[0] for y in (coordinates[:, :size], before)]
        fits = [
            Fit(
                vector=np.asarray(self.space.vector(jnp.asarray(coordinates[leg, :size]))),
                standard_errors=analysis.standard_errors,
                correlations=analysis.correlations,
                directions=analysis.directions,
                drivetrain=Drivetrain(*map(float, drivetrain(jnp.asarray(coordinates[leg, size:]))))
                if config.motion
                else None,
                residual=analysis.scatter,
                losses=np.sort(ended[leg]),
            )
            for leg, analysis in enumerate(analyses)
        ]
        after, nominal = (np.moveaxis(angles, 0, -1) for angles in settled)
        moving = None
        if config.motion:
            paths, _ = self.physics.motion(coordinates, data.commanded)
            moving = sweep.means(np.moveaxis(paths[:, data.counts], 0, -1))
        return Identification((fits[0], fits[1]), after, moving, nominal, config)

    def _angles(
        self, coordinates: Float[np.ndarray, "n size"], command: Float[np.ndarray, "n holds"]
    ) -> tuple[Float[np.ndarray, "n holds 2"], Float[np.ndarray, "n holds 2 size"]]:
        """Simulated settled angles (rad) and their derivatives."""
        qpos, slope = self.physics.settled(coordinates, command)
        return qpos[:, :, self.physics.leg.angles], slope[:, :, self.physics.leg.angles]

    def _settled_residuals(
        self, coordinates: Float[np.ndarray, "n size"], leg: Int[np.ndarray, " n"], data: LegData
    ) -> tuple[Float[np.ndarray, "n residuals"], Float[np.ndarray, "n residuals size"]]:
        """Simulated less measured settled angles, weighted, and their Jacobians."""
        angles, slope = self._angles(coordinates, data.command[leg])
        weights = data.weights[leg]
        count = len(coordinates)
        return (
            (weights * (angles - data.settled[leg])).reshape(count, -1),
            (weights[..., None] * slope).reshape(count, -1, self._size),
        )

    def _residuals(
        self, coordinates: Float[np.ndarray, "legs size"], data: LegData
    ) -> tuple[Float[np.ndarray, "legs residuals"], Float[np.ndarray, "legs residuals size"]]:
        """The same for both legs, or the whole motion's."""
        legs = len(coordinates)
        if not self.config.motion:
            return self._settled_residuals(coordinates, np.arange(legs), data)
        paths, slopes = self.physics.motion(coordinates, data.commanded)
        values = (paths - data.motion)[:, data.counts]
        return values.reshape(legs, -1), slopes[:, data.counts].reshape(legs, -1, slopes.shape[-1])

    def _drawn(
        self, coordinates: Float[np.ndarray, "legs size"], data: LegData, analyses: list[_Analysis]
    ) -> tuple[Float[np.ndarray, "legs residuals"], Float[np.ndarray, "legs residuals size"]]:
        """All residuals over their scatter, then how far from nominal along open directions, in units of the prior."""
        values, jacobians = self._residuals(coordinates, data)
        space, size = self.space, self._size
        rows, row_slopes = [], []
        for y, analysis in zip(coordinates, analyses, strict=True):
            directions = np.array([d.weights if d.standard_error > 1 else np.zeros(size) for d in analysis.directions])
            vector, slope = self._parameters(y[:size])
            directions = directions / space.prior[space.free]
            rows.append(directions @ (vector - space.nominal)[space.free])
            row_slopes.append(np.pad(directions @ slope, [(0, 0), (0, len(y) - size)]))
        scatter = np.array([analysis.scatter for analysis in analyses])
        return (
            np.concatenate([values / scatter[:, None], np.array(rows)], axis=1),
            np.concatenate([jacobians / scatter[:, None, None], np.array(row_slopes)], axis=1),
        )

    def _distance(
        self, coordinates: Float[np.ndarray, "n size"], leg: Int[np.ndarray, " n"], data: LegData
    ) -> tuple[Float[np.ndarray, "n 1"], Float[np.ndarray, "n 1 size"]]:
        """The legs' parts of the paper's objective."""
        angles, slope = self._angles(coordinates, data.command[leg])
        values, gradients = self._curve_gradients(data.command[leg], angles, data.settled[leg])
        return np.asarray(values)[:, None], np.einsum("nha,nhas->ns", gradients, slope)[:, None]

    def _parameters(self, coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A leg's parameters, and the free ones' derivatives in the coordinates."""
        vector = self.space.vector(jnp.asarray(coordinates))
        return np.asarray(vector), np.asarray(jax.jacfwd(self.space.vector)(jnp.asarray(coordinates)))[self.space.free]

    def _analyse(self, coordinates: Float[np.ndarray, "legs size"], data: LegData) -> list[_Analysis]:
        space, size = self.space, self._size
        results = []
        for y, value, jacobian in zip(coordinates, *self._residuals(coordinates, data), strict=True):
            scatter = float(np.sqrt(np.sum(value**2) / max(np.count_nonzero(value) - len(y), 1)))
            prior = space.prior[space.free]
            # In units of the prior, whatever the coordinates; the drivetrain, of which nobody knows anything, projected
            # out.
            known = jacobian[:, :size] / np.diag(self._parameters(y[:size])[1]) * prior / scatter
            unknown, singular, _ = np.linalg.svd(jacobian[:, size:], full_matrices=False)
            unknown = unknown[:, singular > 1e-9 * singular.max(initial=0.0)]
            known = known - unknown @ (unknown.T @ known)
            _, singular, right = np.linalg.svd(known, full_matrices=False)
            errors = 1 / np.maximum(singular, 1e-12)
            variances = np.where(errors > 1, 1 / (1 + singular**2), errors**2)
            covariance = right.T @ np.diag(variances) @ right
            deviation = np.sqrt(np.diag(covariance))
            standard_errors = np.zeros(len(NAMES))
            standard_errors[space.free] = deviation * prior
            signed = [w * np.sign(w[np.argmax(np.abs(w))]) for w in right]
            directions = tuple(Direction(w, float(e)) for w, e in zip(signed, errors, strict=True))
            correlations = covariance / np.outer(deviation, deviation)
            results.append(_Analysis(scatter, standard_errors, correlations, directions))
        return results


class _Analysis(NamedTuple):
    scatter: float
    standard_errors: Float[np.ndarray, " parameters"]
    correlations: Float[np.ndarray, "free free"]
    directions: tuple[Direction, ...]


_Evaluate = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Coordinates (batch, size) to values (batch, n) and Jacobians (batch, n, size)."""


class _Search:
    """An Optimistix solver, for several starts side by side, one iteration at a time.

    The solver's program holds no physics: values and Jacobians at the points that it tries next are computed outside
    and handed in. MJX, which takes by far the longest to compile, then stands in one program for all solvers and
    stages.
    """

    def __init__(self, solver: Any) -> None:
        least_squares = isinstance(solver, optx.AbstractLeastSquaresSolver)

        @jax.custom_jvp
        def known(y: Array, value: Array, jacobian: Array) -> Array:
            return value

        @known.defjvp
        def _(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
            return primals[1], primals[2] @ tangents[0]

        def function(y: Array, evaluated: tuple[Array, Array]) -> tuple[Array, Array]:
            value = known(y, *evaluated)
            return (value, jnp.sum(value**2)) if least_squares else (value[0], value[0])

        def init(y: Array, evaluated: tuple[Array, Array]) -> Any:
            return solver.init(function, y, evaluated, {}, *jax.eval_shape(function, y, evaluated), frozenset())

        def step(y: Array, evaluated: tuple[Array, Array], state: Any) -> tuple[Array, Any, Array, Array]:
            y, state, loss = solver.step(function, y, evaluated, {}, state, frozenset())
            done, _ = solver.terminate(function, y, evaluated, {}, state, frozenset())
            return y, state, loss, done

        self._init = eqx.filter_jit(eqx.filter_vmap(init))
        self._step = eqx.filter_jit(eqx.filter_vmap(step))

    def __call__(
        self, evaluate: _Evaluate, start: np.ndarray, steps: int, report: Callable[[int, int, float], None]
    ) -> tuple[Float[np.ndarray, "batch size"], Float[np.ndarray, " batch"]]:
        """Coordinates and losses at the end of each search: sums of squares, or the minimized function itself."""
        evaluated = tuple(map(jnp.asarray, evaluate(start)))
        y, state, loss = jnp.asarray(start), self._init(jnp.asarray(start), evaluated), np.zeros(len(start))
        for iteration in range(steps):
            y, state, loss, done = self._step(y, evaluated, state)
            report(iteration + 1, steps, float(jnp.min(loss)))
            if bool(jnp.all(done)):
                break
            evaluated = tuple(map(jnp.asarray, evaluate(np.asarray(state.y_eval))))
        return np.asarray(y), np.asarray(loss)


_UNITS = {
    "knee_spring_stiffness": ("N m/rad", 1.0),
    "motor_gain": ("N m/rad", 1.0),
    "default_motor_angle": ("deg", 1 / _DEGREE),
    "default_knee_angle": ("deg", 1 / _DEGREE),
    "torque_limit": ("N m", 1.0),
    "cable_slack": ("mm", 1e3),
}
_DRIVETRAIN_UNITS = {
    "delay": ("s", 1.0),
    "motor_friction": ("N m", 1.0),
    "knee_friction": ("N m", 1.0),
    "backlash": ("deg", 1 / _DEGREE),
}


def mean_error(simulated: Float[np.ndarray, "holds 2 2"], sweep: Sweep) -> float:
    """Mean absolute error (deg) of the settled angles."""
    return float(np.mean(np.abs(simulated - sweep.settled)) / _DEGREE)


def table(sweep: Sweep, result: Identification) -> str:
    """For the terminal: nominal and identified values with standard errors, errors before and after, and what the data
    leave open."""
    nominal = nominal_leg()
    lines = [f"{'':33}{'nominal':>10}{'identified':>12}{'standard error':>16}"]
    for index, name in enumerate(NAMES):
        unit, scale = _UNITS[name]
        for side, fit in zip(SIDES, result.fits, strict=True):
            label = f"{name.replace('_', ' ')}, {side}"
            error = f"{fit.standard_errors[index] * scale:.2g}" if fit.standard_errors[index] else "(held)"
            value = f"{fit.vector[index] * scale:.4g}"
            lines.append(f"{label:33}{nominal[index] * scale:>10.4g}{value:>12}{error:>16} {unit}")
    for side, fit in zip(SIDES, result.fits, strict=True):
        for name, value in fit.drivetrain._asdict().items() if fit.drivetrain else ():
            unit, scale = _DRIVETRAIN_UNITS[name]
            label = f"{name.replace('_', ' ')}, {side}"
            lines.append(f"{label:33}{'':10}{value * scale:>12.4g}{'':16} {unit} (reported only)")
    before, after = (mean_error(angles, sweep) for angles in (result.nominal_settled, result.settled))
    lines += ["", f"Mean error of the settled angles: {before:.2f} deg before, {after:.2f} deg after."]
    if result.with_drivetrain is not None:
        scatter = ", ".join(
            f"{np.rad2deg(fit.residual):.2f} deg ({side})" for side, fit in zip(SIDES, result.fits, strict=True)
        )
        lines.append(
            f"With delay, friction and backlash {mean_error(result.with_drivetrain, sweep):.2f} deg. Of the whole "
            f"motion is left, root mean square: {scatter}; if that is more than your capture's noise, this model lacks "
            "something."
        )
    with jax.enable_x64(True):
        for label, angles in (("before", result.nominal_settled), ("after", result.settled)):
            distances = np.zeros((2, 2))
            for side in range(len(SIDES)):
                pair = angles[:, :, side], sweep.settled[:, :, side]
                distances += np.asarray(curve_distances(sweep.command[:, side], *pair, result.config.degree))
            there, back = distances.sum(axis=1)
            lines.append(f"Curves {label}: Hausdorff distance {there:.4f} simulated to measured, {back:.4f} back.")
    lines.append("Standard errors take the residuals for white noise; what the model lacks is none.")
    for side, fit in zip(SIDES, result.fits, strict=True):
        singular = ", ".join(f"{1 / d.standard_error:.3g}" for d in fit.directions)
        lines.append(f"Singular values, {side} (Jacobian over noise, in units of what robots differ by): {singular}")
        lines += [
            f"Left open, {side}, and held near nominal: {_in_words(d, result.config)}" for d in fit.open_directions
        ]
        weakest = fit.directions[-1]
        if not fit.open_directions:
            lines.append(
                f"Least determined, {side}: {_in_words(weakest, result.config)}, to {weakest.standard_error:.0%} of "
                "what robots differ by."
            )
        names = _free_names(result.config)
        pairs = [(fit.correlations[i, j], i, j) for i in range(len(names)) for j in range(i)]
        strong = [f"{names[j]} with {names[i]} {r:+.2f}" for r, i, j in pairs if abs(r) > _STRONG]
        if strong:
            lines.append(f"Strongly correlated, {side}: {', '.join(strong).replace('_', ' ')}.")
        same = int(np.sum(fit.losses < 1.01 * fit.losses[0] + 1e-12))
        lines.append(f"Starts, {side}: {same} of {len(fit.losses)} ended within 1 % of the best sum of squares.")
    return "\n".join(lines)


def details(result: Identification, source: Any) -> dict[str, Any]:
    """What stands beside the parameters in `actuators.json`."""
    return {
        "standard_errors": {
            name: [float(f"{fit.standard_errors[index]:.3g}") for fit in result.fits]
            for index, name in enumerate(NAMES)
        },
        "correlations": {
            "parameters": list(_free_names(result.config)),
            **{side: np.round(fit.correlations, 3).tolist() for side, fit in zip(SIDES, result.fits, strict=True)},
        },
        "drivetrain": {
            name: [float(f"{getattr(fit.drivetrain, name):.4g}") if fit.drivetrain else None for fit in result.fits]
            for name in Drivetrain._fields
        },
        "source": source,
    }


def _free_names(config: IdentificationConfig) -> tuple[str, ...]:
    """All but those that have an option of their name which is off."""
    return tuple(name for name in NAMES if getattr(config, name, True))


def _in_words(direction: Direction, config: IdentificationConfig) -> str:
    """The parameters that make up most of a direction, with their signs."""
    parts = [(w, n) for w, n in zip(direction.weights, _free_names(config), strict=True) if abs(w) > 0.3]
    ordered = sorted(parts, key=lambda part: -abs(part[0]))
    return " ".join(f"{w:+.2f} {name.replace('_', ' ')}" for w, name in ordered)
