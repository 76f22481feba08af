"""The posture of each sample, where measurements fit several: which joints inverse kinematics begins with.

Some samples along the recording are fitted from several starts. Of what is found, the sequence that fits best and moves
least is taken (dynamic programming). Other samples begin between their neighbours.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from ballu_mjx.recordings.pose_solver import PoseSolver

_ANCHOR_INTERVAL = 0.2
"""s between samples that are fitted from several starts."""
_STARTS, _FITS = 6, 60
"""Random starts of each, and fits in all, at least, where the starting pose does not lead to what was measured."""
_LOST = 25.0
"""Squared misfit a measurement, in units of its noise, beyond which a sample's posture may not have been found."""
_SAME = 0.1
"""rad, m: what joints differ by at most in one posture."""
_MOVED = 0.3
"""rad, m: what a joint moves between such samples, where two sequences of postures are told apart by it."""
_MOST_JUMPS = 8
_OUTSTANDING = 3.0
"""Of what the quietest fifth of such samples moves at most: what a change of posture moves at least."""
_AWAY = (1.0, 0.3)
"""rad, m: the same from the starting pose, where two first postures are. From the reference pose; from a keyframe."""


class PostureSearch:
    """The search for postures that a `PoseSolver` fits all samples from."""

    def __init__(self, solver: PoseSolver) -> None:
        self._solver = solver
        self._has_keyframe = solver.problem.robot.keyframe is not None or solver.problem.model.nkey > 0

    def solve(self) -> Float[np.ndarray, "T nq"]:
        """Return poses of all samples.

        The solver is not `bounded` afterwards where some sample fits no pose within the joints' ranges.
        """
        grid = self._solver.problem.grid
        count = len(next(iter(grid.positions.values())))
        start = self._starting_pose()
        rows = np.arange(count)
        joints = np.tile(start[self._solver.addresses], (count, 1))
        if len(self._solver.hidden):
            anchors = np.unique(np.append(rows[:: max(1, round(_ANCHOR_INTERVAL / grid.step))], count - 1))
            found = self._anchor_joints(start, anchors)
            joints = np.stack([np.interp(rows, anchors, column) for column in found.T], axis=1)
        return self._solver.fit(self._solver.guess(start, joints, rows), rows)[0]

    def _anchor_joints(
        self, start: Float[np.ndarray, " nq"], anchors: Int[np.ndarray, " A"]
    ) -> Float[np.ndarray, "A joints"]:
        """Joints of some samples, of which no posture is known, continuous in time."""
        own, count = start[self._solver.addresses], len(anchors)
        everywhere = np.arange(count)
        candidates: list[tuple[np.ndarray, np.ndarray]] = []

        def fitted(joints: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            rows = anchors[which]
            qpos, cost = self._solver.fit(self._solver.guess(start, joints, rows), rows)
            found = qpos[:, self._solver.addresses]
            free = self._solver.turns & ~np.isin(np.arange(len(own)), self._solver.recorded)
            found[:, free] = own[free] + _wrapped(found[:, free] - own[free])
            return found, cost

        def add(joints: Float[np.ndarray, "starts n joints"], which: Int[np.ndarray, " n"]) -> None:
            """Fit the samples in `which` from several starts each."""
            found, cost = fitted(joints.reshape(-1, len(own)), np.tile(which, len(joints)))
            rows = np.zeros((len(joints), count, len(own))), np.full((len(joints), count), np.inf)
            rows[0][:, which], rows[1][:, which] = found.reshape(joints.shape), cost.reshape(joints.shape[:2])
            candidates.append(rows)

        def carry(path: np.ndarray, places: np.ndarray, ways: np.ndarray) -> None:
            """Fit sample after sample from the one before, from each place on in its way (1 or -1), to
            where this leads to what is known."""
            rows = np.zeros((len(places), count, len(own))), np.full((len(places), count), np.inf)
            joints, going = path[places], np.arange(len(places))
            for step in range(1, count):
                which = places + step * ways
                going = going[(which[going] >= 0) & (which[going] < count)]
                if not len(going):
                    break
                joints[going], cost = fitted(joints[going], which[going])
                rows[0][going, which[going]], rows[1][going, which[going]] = joints[going], cost
                going = going[self._apart(joints[going], path[which[going]]) > _SAME**2]
            candidates.append(rows)

        def best() -> tuple[np.ndarray, np.ndarray]:
            return self._best_path(own, *(np.concatenate(each) for each in zip(*candidates, strict=True)))

        def lost(cost: np.ndarray) -> np.ndarray:
            return np.flatnonzero(cost > _LOST * self._solver.measurements)

        add(np.tile(own, (1, count, 1)), everywhere)
        if len(which := lost(candidates[0][1][0])):
            add(self._starts(start, len(which)), which)
        path, cost = best()
        apart = 1
        while apart < count and len(lost(cost)):  # Others may have found what one has not.
            before, after = np.maximum(everywhere - apart, 0), np.minimum(everywhere + apart, count - 1)
            add(np.stack([path[before], path[after]]), everywhere)
            path, cost = best()
            apart *= 2
        if len(which := lost(cost)):  # What is measured clearly is believed, against the model's ranges.
            self._solver.bounded = False
            add(np.concatenate([self._starts(start, len(which)), path[None, which]]), which)
            path, cost = best()
        if len(jumps := self._jumps(path)):
            carry(path, np.concatenate([jumps, jumps + 1]), np.repeat([1, -1], len(jumps)))
            path, _ = best()
        path[:, self._solver.turns] = np.unwrap(path[:, self._solver.turns], axis=0)
        return path

    def _jumps(self, path: Float[np.ndarray, "A joints"]) -> Int[np.ndarray, " jumps"]:
        """Samples after which joints move by much more than elsewhere: from one posture to another. The largest few."""
        moved = np.sqrt(self._apart(path[1:], path[:-1]))
        largest = np.argsort(-moved)[:_MOST_JUMPS]
        return largest[moved[largest] > _SAME + _OUTSTANDING * np.percentile(moved, 20)]

    def _apart(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Squared distances (rad, m) of joints, turns aside."""
        difference = a - b
        difference[..., self._solver.turns] = _wrapped(difference[..., self._solver.turns])
        return np.sum(difference**2, axis=-1)

    def _best_path(
        self,
        own: Float[np.ndarray, " joints"],
        joints: Float[np.ndarray, "candidates A joints"],
        cost: Float[np.ndarray, "candidates A"],
    ) -> tuple[Float[np.ndarray, "A joints"], Float[np.ndarray, " A"]]:
        """One candidate of each sample, so that misfits and movements are least in all, and their misfits."""
        total = cost[:, 0] + self._apart(joints[:, 0], own) / _AWAY[self._has_keyframe] ** 2
        came = []
        for sample in range(1, joints.shape[1]):
            moved = self._apart(joints[:, sample, None], joints[None, :, sample - 1]) / _MOVED**2
            came.append(np.argmin(total + moved, axis=1))
            total = cost[:, sample] + np.min(total + moved, axis=1)
        chosen = [int(np.argmin(total))]
        for back in reversed(came):
            chosen.append(int(back[chosen[-1]]))
        places = chosen[::-1], np.arange(joints.shape[1])
        return joints[places], cost[places]

    def _starting_pose(self) -> Float[np.ndarray, " nq"]:
        """Where the description or else the model's first keyframe says that the robot starts. Without any: the
        reference pose, with joints whose ranges do not hold it in the middle of these."""
        problem, model = self._solver.problem, self._solver.problem.model
        start = problem.robot.adapter.initial_qpos(problem.robot, model)
        if self._has_keyframe:
            return model.key_qpos[0].copy() if problem.robot.keyframe is None else start
        joints = start[self._solver.addresses]
        outside = (joints < self._solver.low) | (joints > self._solver.high)
        start[self._solver.addresses] = np.where(outside, self._middle(joints), joints)
        return start

    def _middle(self, otherwise: Float[np.ndarray, " joints"]) -> Float[np.ndarray, " joints"]:
        limited = np.isfinite(self._solver.low) & np.isfinite(self._solver.high)
        with np.errstate(invalid="ignore"):
            return np.where(limited, (self._solver.low + self._solver.high) / 2, otherwise)

    def _starts(self, start: Float[np.ndarray, " nq"], count: int) -> Float[np.ndarray, "starts n joints"]:
        """Joints to begin with beside the starting pose: the model's keyframes, the middles of the ranges, and others
        at random, more of them where few samples need them."""
        own, model = start[self._solver.addresses], self._solver.problem.model
        spread = np.where(self._solver.tree.rotates[self._solver.dofs], np.pi, 0.1)
        low = np.where(np.isfinite(self._solver.low), self._solver.low, own - spread)
        high = np.where(np.isfinite(self._solver.high), self._solver.high, own + spread)
        drawn = np.random.default_rng(0).uniform(low, high, (max(_STARTS, _FITS // count), count, len(own)))
        fixed = [*model.key_qpos[:, self._solver.addresses], self._middle(own)]
        return np.concatenate([np.tile(np.stack(fixed)[:, None], (1, count, 1)), drawn])


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi
