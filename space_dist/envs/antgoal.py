"""AntGoal (Eimer et al. 2021): PyBullet's Ant walks towards a goal, and one of its legs may be disabled.

Facts: docs/environments.md ("AntGoal"). Robot: `mjcf/ant.xml` of `pybullet_data`. Physics, observation
and reward are those of PyBullet Gym's AntBulletEnv (https://github.com/bulletphysics/bullet3, `pybullet_envs`; kept
alive in https://github.com/araffin/pybullet_envs_gymnasium), against which `tests/test_antgoal.py` compares every step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.envs.bullet import BatchedBullet, Camera, World
from space_dist.envs.interface import Distribution, FloatArray
from space_dist.instances import ContextBounds

HORIZON: Final = 500
"""The paper's figure; the released code has 500 for SPaCE and round robin, and 150 elsewhere."""

DT: Final = 0.0165  # seconds per action
SUBSTEPS: Final = 4  # of the physics, per action
SOLVER_ITERATIONS: Final = 5
GRAVITY: Final = 9.8
CONTACT_ERP: Final = 0.9
FLOOR_FRICTION: Final = 0.8
FLOOR_RESTITUTION: Final = 0.5
TORQUE: Final = 250.0  # of a joint at action 1: power 2.5 times a joint's coefficient 100
START_ANGLE: Final = 0.1  # radians; a joint starts uniformly within +-
HEALTHY_HEIGHT: Final = 0.26  # of the torso's centre, whose radius is 0.25: below, the ant has fallen
SPEED_SCALE: Final = 0.3  # of the torso's velocity (m/s) in the observation
JOINT_SPEED_SCALE: Final = 0.1  # of the joints' velocities (rad/s) in the observation
OBSERVATION_LIMIT: Final = 5.0
ELECTRICITY_COST: Final = -2.0  # times the mean of |action * scaled joint velocity|
STALL_COST: Final = -0.1  # times the mean square of the action
AT_LIMIT: Final = 0.99  # share of a joint's range
AT_LIMIT_COST: Final = -0.1  # per joint
LEGS: Final = 4
ACTIONS_PER_LEG: Final = 2  # hip, ankle
FEET: Final = ("front_left_foot", "front_right_foot", "left_back_foot", "right_back_foot")

BOUNDS: Final = ContextBounds(
    names=("goal_x", "goal_y", "disabled_leg"),
    low=np.array([-750.0, -750.0, -1.0]),
    high=np.array([750.0, 750.0, 3.0]),
)
"""AntGoal (Eimer et al. 2021): the goal in metres from the start, and the disabled leg, a whole number: -1 for none."""


def _draw(rng: np.random.Generator, n: int, nearest_goal: float) -> NDArray[np.float64]:
    """Goals uniform between `nearest_goal` and 750 on each axis; none or one of four legs, each as likely."""
    goals = rng.uniform(nearest_goal, BOUNDS.high[:2], size=(n, 2))
    return np.column_stack((goals, rng.integers(-1, 4, size=n)))


DISTRIBUTIONS: Final = {
    "antgoal_positive": Distribution(
        description="AntGoal, goals uniform in the positive quadrant up to 750 on each axis; no leg or one of four "
        "disabled, each with probability 1/5",
        source="Eimer et al. 2021; the quadrant is the released code's",
        bounds=BOUNDS,
        draw=lambda rng, n: _draw(rng, n, 0.0),
    ),
    "antgoal_all": Distribution(
        description="AntGoal, goals uniform in all four quadrants up to 750 on each axis; no leg or one of four "
        "disabled, each with probability 1/5",
        source="Eimer et al. 2021 (goals at most 750 away)",
        bounds=BOUNDS,
        draw=lambda rng, n: _draw(rng, n, -750.0),
    ),
}


@dataclass
class AntEpisode:
    """What an episode remembers. goal: (x, y) in metres; leg: the disabled one's index, -1 for none."""

    goal_x: float
    goal_y: float
    leg: int
    start_height: float = 0.0
    distance: float = 0.0  # to the goal, in metres
    feet: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # whether each touched the floor


class AntWorld(World[AntEpisode]):
    """A floor and an ant."""

    def load(self) -> None:
        import pybullet_data

        bullet, data = self.bullet, Path(pybullet_data.getDataPath())
        self.call("setGravity", 0.0, 0.0, -GRAVITY)
        self.call("setDefaultContactERP", CONTACT_ERP)
        self.call(
            "setPhysicsEngineParameter",
            fixedTimeStep=DT, numSubSteps=SUBSTEPS, numSolverIterations=SOLVER_ITERATIONS,
        )  # fmt: skip
        (self._floor,) = self.call("loadSDF", str(data / "plane_stadium.sdf"))
        self.call("changeDynamics", self._floor, -1, lateralFriction=FLOOR_FRICTION, restitution=FLOOR_RESTITUTION)
        flags = bullet.URDF_USE_SELF_COLLISION | bullet.URDF_USE_SELF_COLLISION_EXCLUDE_ALL_PARENTS
        (self._ant,) = self.call("loadMJCF", str(data / "mjcf" / "ant.xml"), flags=flags)
        joints = [self.call("getJointInfo", self._ant, joint) for joint in range(self.call("getNumJoints", self._ant))]
        self._links = [joint[0] for joint in joints]
        moving = [joint for joint in joints if joint[2] == bullet.JOINT_REVOLUTE]  # hip and ankle of each leg in turn
        self._joints = [joint[0] for joint in moving]
        low, high = np.array([joint[8:10] for joint in moving]).T
        self._middle, self._half_range = (low + high) / 2, (high - low) / 2
        names = [joint[12].decode() for joint in joints]
        self._feet = [names.index(foot) for foot in FEET]
        for link in self._links:  # joints have a position motor at first, which would hold them
            self.call("setJointMotorControl2", self._ant, link, bullet.POSITION_CONTROL, force=0.0)
        self._torque = bullet.TORQUE_CONTROL
        self._apply, self._advance = self.bound("setJointMotorControlArray"), self.bound("stepSimulation")
        self._joint_states, self._link_states = self.bound("getJointStates"), self.bound("getLinkStates")
        self._pose, self._velocity = self.bound("getBasePositionAndOrientation"), self.bound("getBaseVelocity")
        self._contacts, self._euler = self.bound("getContactPoints"), bullet.getEulerFromQuaternion

    def begin(self, context: FloatArray, seed: int) -> tuple[AntEpisode, NDArray[np.float32]]:
        angles = np.random.default_rng(seed).uniform(-START_ANGLE, START_ANGLE, size=len(self._joints))
        for joint, angle in zip(self._joints, angles.tolist(), strict=True):
            self.call("resetJointState", self._ant, joint, angle, 0.0)
        episode = AntEpisode(float(context[0]), float(context[1]), round(float(context[2])))
        episode.start_height = self._pose(self._ant)[0][2]
        observation, _, _ = self._observe(episode)
        return episode, observation

    def act(self, episode: AntEpisode, action: FloatArray) -> tuple[NDArray[np.float32], float, bool, bool]:
        if episode.leg >= 0:
            first = ACTIONS_PER_LEG * episode.leg
            action = action.copy()
            action[first : first + ACTIONS_PER_LEG] = 0.0
        self._apply(self._ant, self._joints, self._torque, forces=(TORQUE * action).tolist())
        self._advance()
        distance_before = episode.distance
        observation, joints, height = self._observe(episode)
        touching = {contact[3] for contact in self._contacts(self._ant, self._floor)}
        first_foot, second, third, fourth = (float(foot in touching) for foot in self._feet)
        episode.feet = (first_foot, second, third, fourth)
        positions, speeds = joints
        fallen = height <= HEALTHY_HEIGHT
        reward = (
            (-1.0 if fallen else 1.0)
            + (distance_before - episode.distance) / DT
            + ELECTRICITY_COST * float(np.abs(action * speeds).mean())
            + STALL_COST * float(action @ action) / len(action)
            + AT_LIMIT_COST * int(np.count_nonzero(np.abs(positions) > AT_LIMIT))
        )
        return observation, reward, fallen, False

    def camera(self) -> Camera:
        x, y, _ = self._pose(self._ant)[0]
        return Camera(target=(x, y, 0.5), distance=3.0, yaw=30.0, pitch=-30.0)

    def _observe(self, episode: AntEpisode) -> tuple[NDArray[np.float32], tuple[FloatArray, FloatArray], float]:
        """(observation, (joint positions within their ranges, joint speeds, scaled), height of the torso)."""
        (torso_x, torso_y, height), orientation = self._pose(self._ant)
        (vx, vy, vz), _ = self._velocity(self._ant)
        roll, pitch, yaw = self._euler(orientation)
        # Where the ant is: the mean of its parts.
        parts = [link[0] for link in self._link_states(self._ant, self._links)]
        n_parts = 1 + len(parts)
        to_x = episode.goal_x - (torso_x + sum(part[0] for part in parts)) / n_parts
        to_y = episode.goal_y - (torso_y + sum(part[1] for part in parts)) / n_parts
        episode.distance = math.hypot(to_x, to_y)
        angle = math.atan2(to_y, to_x) - yaw
        cos, sin = math.cos(yaw), math.sin(yaw)
        states = np.array([state[:2] for state in self._joint_states(self._ant, self._joints)])
        states[:, 0] = (states[:, 0] - self._middle) / self._half_range
        states[:, 1] *= JOINT_SPEED_SCALE
        observation = np.array(
            [
                height - episode.start_height, math.sin(angle), math.cos(angle),
                SPEED_SCALE * (cos * vx + sin * vy), SPEED_SCALE * (cos * vy - sin * vx), SPEED_SCALE * vz,
                roll, pitch, *states.ravel().tolist(), *episode.feet,
            ],
            dtype=np.float32,
        )  # fmt: skip
        np.clip(observation, -OBSERVATION_LIMIT, OBSERVATION_LIMIT, out=observation)
        return observation, (states[:, 0], states[:, 1]), height


class BatchedAntGoal(BatchedBullet[AntEpisode]):
    """`n_slots` ants. Context: (goal_x, goal_y, disabled_leg); goal in metres from the start, leg -1 (none) or 0 to 3.

    Observation (28): height above the start's, sine and cosine of the goal's direction in the ant's view, 0.3 of the
    torso's velocity in the ant's view (3), roll, pitch, position in its range and 0.1 of its velocity for each of 8
    joints, and for each foot whether it touched the floor *before* the last step (as in AntBulletEnv); clipped to +-5.
    The disabled leg is not observed. Action (8): torques of hip and ankle of legs 0 to 3 (front left, front right,
    back left, back right), in units of 250 Nm. A disabled leg's pair is executed, and paid for, as zero.

    Reward per step: 1 for standing, or -1 for falling, which ends the episode; metres gained towards the goal per
    second; costs of power, torque and joints at their limits. A leg between two whole numbers is the nearest one.
    The goals are out of reach within an episode, so there is no success to speak of: `Step.success` is None.
    """

    def __init__(self, n_slots: int, *, horizon: int = HORIZON) -> None:
        limit = np.full(16 + 8 + LEGS, OBSERVATION_LIMIT, dtype=np.float32)
        self.observation_space = spaces.Box(-limit, limit, dtype=np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, shape=(LEGS * ACTIONS_PER_LEG,), dtype=np.float32)
        self.context_bounds = BOUNDS
        self.knows_success = False
        super().__init__(n_slots, horizon, AntWorld)

    def draw_contexts(self, rng: np.random.Generator, n: int) -> FloatArray:
        """`(n, 3)` goals in all four quadrants, and legs, which are whole numbers."""
        return DISTRIBUTIONS["antgoal_all"].draw(rng, n)
