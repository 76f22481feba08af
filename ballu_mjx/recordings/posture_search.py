"""Search for the posture of each sample, if its measurements fit several. Inverse kinematics starts from the result.

Some samples along the recording, the anchors, are fitted from several starting poses. Dynamic programming selects the
sequence of results that fits best and moves least. Other samples start between their neighbouring anchors. A hinge
without a range may turn by more than half a turn between two anchors, so its turns are counted from sample to sample.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from ballu_mjx.recordings.pose_solver import PoseSolver

_ANCHOR_INTERVAL = 0.2
"""Time (s) between anchors, the samples that are fitted from several starting poses."""
_STARTS, _FITS = 6, 60
"""Minimum numbers of random starts per anchor, and of random starts in all. They are for anchors whose measurements the
fit from the starting pose does not reach."""
_LARGEST_MISFIT = 25.0
"""Squared misfit per measurement, in units of its noise, above which a sample's posture counts as not found."""
_SAME = 0.1
"""Largest distance of joints (rad, m) within one posture."""
_MOVED = 0.3
"""Movement of joints (rad, m) between anchors that costs a sequence as much as a squared misfit of one."""
_MOST_JUMPS = 8
"""Maximum number of changes of posture from which further fits start."""
_OUTSTANDING = 3.0
"""Smallest movement at a change of posture, relative to the 20th percentile of movements between anchors."""
_AWAY = (1.0, 0.3)
"""Distance of joints (rad, m) between starting pose and first anchor that costs as much as a squared misfit of one. The
first number is for the reference pose, the second for a keyframe."""


class PostureSearch:
    """Search for the postures from which a `PoseSolver` fits all samples."""

    def __init__(self, solver: PoseSolver) -> None:
        self._solver = solver
        self._has_keyframe = solver.problem.robot.keyframe is not None or solver.problem.model.nkey > 0

    def solve(self) -> Float[np.ndarray, "T nq"]:
        """Return the poses of all samples. Hidden hinges without a range do not jump by full turns.

        The solver's `bounded` is False afterwards if some sample fits no pose within the joints' ranges.
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
        qpos, cost = self._solver.fit(self._solver.guess(start, joints, rows), rows)
        turning = self._solver.hidden[self._solver.turns[self._solver.hidden]]
        if len(turning):
            self._start_from_neighbours(start, qpos, cost)
            columns = self._solver.addresses[turning]
            qpos[:, columns] = np.unwrap(qpos[:, columns], axis=0)
        return qpos

    def _start_from_neighbours(
        self, start: Float[np.ndarray, " nq"], qpos: Float[np.ndarray, "T nq"], cost: Float[np.ndarray, " T"]
    ) -> None:
        """Fit the samples that were not found again, from the samples beside them, in place.

        A hinge that starts half a turn away from its angle is at a maximum of the misfit, and may stay there.
        """
        limit = _LARGEST_MISFIT * self._solver.measurements
        for step in (-1, 1):
            lost = np.flatnonzero(cost > limit)
            if not len(lost):
                break
            beside = qpos[np.clip(lost + step, 0, len(qpos) - 1)][:, self._solver.addresses]
            again, misfit = self._solver.fit(self._solver.guess(start, beside, lost), lost)
            found = misfit <= limit
            qpos[lost[found]], cost[lost[found]] = again[found], misfit[found]

    def _anchor_joints(
        self, start: Float[np.ndarray, " nq"], anchors: Int[np.ndarray, " A"]
    ) -> Float[np.ndarray, "A joints"]:
        """Return the joints of the anchors, continuous in time. No posture is known beforehand."""
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
            """Fit the anchors in `which`, each from several starts."""
            found, cost = fitted(joints.reshape(-1, len(own)), np.tile(which, len(joints)))
            rows = np.zeros((len(joints), count, len(own))), np.full((len(joints), count), np.inf)
            rows[0][:, which], rows[1][:, which] = found.reshape(joints.shape), cost.reshape(joints.shape[:2])
            candidates.append(rows)

        def carry(path: np.ndarray, places: np.ndarray, ways: np.ndarray) -> None:
            """Fit one anchor after another, each from the one before. Start at each of `places`, and go forwards or
            backwards (`ways`, 1 or -1). Stop where the result equals `path`."""
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

        def not_found(cost: np.ndarray) -> np.ndarray:
            return np.flatnonzero(cost > _LARGEST_MISFIT * self._solver.measurements)

        add(np.tile(own, (1, count, 1)), everywhere)
        if len(which := not_found(candidates[0][1][0])):
            add(self._starts(start, len(which)), which)
        path, cost = best()
        apart = 1
        while apart < count and len(not_found(cost)):  # Neighbours may have found the posture.
            before, after = np.maximum(everywhere - apart, 0), np.minimum(everywhere + apart, count - 1)
            add(np.stack([path[before], path[after]]), everywhere)
            path, cost = best()
            apart *= 2
        if len(which := not_found(cost)):  # Clear measurements override joint ranges.
            self._solver.bounded = False
            add(np.concatenate([self._starts(start, len(which)), path[None, which]]), which)
            path, cost = best()
        if len(jumps := self._jumps(path)):
            carry(path, np.concatenate([jumps, jumps + 1]), np.repeat([1, -1], len(jumps)))
            path, _ = best()
        path[:, self._solver.turns] = np.unwrap(path[:, self._solver.turns], axis=0)
        return path

    def _jumps(self, path: Float[np.ndarray, "A joints"]) -> Int[np.ndarray, " jumps"]:
        """Return the anchors before the largest changes of posture. Joints move much more there than elsewhere."""
        moved = np.sqrt(self._apart(path[1:], path[:-1]))
        largest = np.argsort(-moved)[:_MOST_JUMPS]
        return largest[moved[largest] > _SAME + _OUTSTANDING * np.percentile(moved, 20)]

    def _apart(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return squared distances (rad, m) of joints. Full turns of hinges without a range do not count."""
        difference = a - b
        difference[..., self._solver.turns] = _wrapped(difference[..., self._solver.turns])
        return np.sum(difference**2, axis=-1)

    def _best_path(
        self,
        own: Float[np.ndarray, " joints"],
        joints: Float[np.ndarray, "candidates A joints"],
        cost: Float[np.ndarray, "candidates A"],
    ) -> tuple[Float[np.ndarray, "A joints"], Float[np.ndarray, " A"]]:
        """Return one candidate per anchor that minimizes the sum of misfits and movements, and the misfits."""
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
        """Return the starting pose of the description, or else the model's first keyframe.

        Without either, it is the reference pose. Joints outside their range are then set to the range's middle.
        """
        problem, model = self._solver.problem, self._solver.problem.model
        start = problem.robot.adapter.initial_qpos(problem.robot, model)
        if self._has_keyframe:
            return model.key_qpos[0].copy() if problem.robot.keyframe is None else start
        joints = start[self._solver.addresses]
        outside = (joints < self._solver.low) | (joints > self._solver.high)
        start[self._solver.addresses] = np.where(outside, self._middle(joints), joints)
        return start

    def _middle(self, otherwise: Float[np.ndarray, " joints"]) -> Float[np.ndarray, " joints"]:
        """Return the middles of the joints' ranges, and `otherwise` for joints without a finite range."""
        limited = np.isfinite(self._solver.low) & np.isfinite(self._solver.high)
        with np.errstate(invalid="ignore"):
            return np.where(limited, (self._solver.low + self._solver.high) / 2, otherwise)

    def _starts(self, start: Float[np.ndarray, " nq"], count: int) -> Float[np.ndarray, "starts n joints"]:
        """Return further starting joints for `count` anchors: keyframes, middles of the ranges, and random joints.

        The fewer the anchors, the more random joints each of them gets.
        """
        own, model = start[self._solver.addresses], self._solver.problem.model
        spread = np.where(self._solver.tree.rotates[self._solver.dofs], np.pi, 0.1)
        low = np.where(np.isfinite(self._solver.low), self._solver.low, own - spread)
        high = np.where(np.isfinite(self._solver.high), self._solver.high, own + spread)
        drawn = np.random.default_rng(0).uniform(low, high, (max(_STARTS, _FITS // count), count, len(own)))
        fixed = [*model.key_qpos[:, self._solver.addresses], self._middle(own)]
        return np.concatenate([np.tile(np.stack(fixed)[:, None], (1, count, 1)), drawn])


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi
