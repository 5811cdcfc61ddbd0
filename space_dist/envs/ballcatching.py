"""BallCatching (Klink et al. 2020): an arm that moves in a plane catches balls thrown at it with a net.

Facts: docs/environments.md ("BallCatching"); Klink et al., "Self-Paced Deep Reinforcement Learning", 2020.
Theirs is a Barrett WAM in MuJoCo. Ours is the 7-joint KUKA iiwa of `pybullet_data`, so returns are not comparable:
what comes from them is marked "Klink", what had to be chosen for this arm "ours".
"""

from __future__ import annotations

import math
import tempfile
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from space_dist.envs.bullet import BatchedBullet, Camera, World
from space_dist.envs.interface import Distribution, FloatArray
from space_dist.instances import ContextBounds

HORIZON: Final = 200  # Klink
DT: Final = 0.002  # seconds per physics step; Klink
SUBSTEPS: Final = 5  # physics steps per action; Klink
GRAVITY: Final = 9.81
SHOULDER_HEIGHT: Final = 0.75  # metres; the targets' circle is around it; Klink
BALL_START_Y: Final = (-0.75, -0.65)  # metres, uniform; Klink
BALL_START_Z: Final = (0.8, 1.8)  # metres, uniform; Klink
FLIGHT_TIME: Final = (0.5, 0.05)  # seconds, and seconds per metre of the ball's distance; Klink
STEP_REWARD: Final = 0.275  # Klink
ACTION_COST: Final = 0.005  # times the sum of squares of the action; Klink
CATCH_REWARD: Final = 50.0  # Klink
ALIGNMENT_REWARD: Final = 25.0  # times cos(angle between the net's normal and the ball's way)^5; Klink
OBSERVATION_LIMIT: Final = 10.0  # Klink
N_JOINTS: Final = 5  # Klink: two of seven are fixed

# The iiwa: A1 is fixed where the arm's plane is that of y and z, A3 where it stays one. Positions in radians.
FIXED: Final = {"lbr_iiwa_joint_1": -math.pi / 2, "lbr_iiwa_joint_3": 0.0}
BASE_HEIGHT: Final = SHOULDER_HEIGHT - 0.36  # A2 is 0.36 m above the base
HOME: Final = (0.4363, -1.3963, 0.0, 0.4363, 0.0)  # of A2, A4, A5, A6, A7; ours: the net just below the targets
RATE: Final = 4.0  # rad/s of the desired position at action 1; ours
POSITION_GAIN: Final = 0.1  # of Bullet's joint motors, per physics step: a time constant of 20 ms; Bullet's default
VELOCITY_GAIN: Final = 1.0  # Bullet's default
TORQUES: Final = (320.0, 176.0, 110.0, 40.0, 40.0)  # Nm; the LBR iiwa 14 R820's maximum torques
NET_RADIUS: Final = 0.12  # metres; ours
NET_THICKNESS: Final = 0.02  # metres; ours
NET_CENTRE: Final = 0.17  # metres along the flange's axis; ours
NET_MASS: Final = 0.2  # kg; ours
BALL_RADIUS: Final = 0.033  # metres; a tennis ball's
BALL_MASS: Final = 0.058  # kg; a tennis ball's

BOUNDS: Final = ContextBounds(
    names=("angle", "radius", "distance"),
    low=np.array([0.125 * np.pi, 0.52, 0.75]),
    high=np.array([0.5 * np.pi, 0.95, 4.0]),
)
"""BallCatching (Klink et al. 2020): angle in radians and radius in metres of the point that the ball flies to, seen
from the arm's shoulder, and the distance in metres from which it comes.

Klink et al. have radii from 0.6 to 1.1 for their longer arm: ours are these times 0.95 / 1.1, because the net's centre
reaches 1.07 m.
"""


DISTRIBUTIONS: Final = {
    "ballcatching_uniform": Distribution(
        description="BallCatching, each feature uniform within its bounds",
        source="Klink et al. 2020 (the bounds); the radius is scaled to our arm",
        bounds=BOUNDS,
        draw=lambda rng, n: rng.uniform(BOUNDS.low, BOUNDS.high, size=(n, 3)),
    ),
}


@dataclass
class BallEpisode:
    """What an episode remembers. desired: (5,) joint positions that the motors go for, in radians."""

    desired: FloatArray = field(default_factory=lambda: np.array(HOME))


def target_of(context: FloatArray) -> FloatArray:
    """`(3,)` the point that the ball of a context (angle, radius, distance) flies to, in metres."""
    angle, radius, _ = context.tolist()
    return np.array([0.0, -math.cos(angle) * radius, SHOULDER_HEIGHT + math.sin(angle) * radius])


def flight_time_of(context: FloatArray) -> float:
    """Seconds that the ball of a context flies."""
    return float(FLIGHT_TIME[0] + FLIGHT_TIME[1] * context[2])


class BallWorld(World[BallEpisode]):
    """A floor, an arm with a net, and a ball."""

    def load(self) -> None:
        bullet = self.bullet
        self.call("setGravity", 0.0, 0.0, -GRAVITY)
        self.call("setPhysicsEngineParameter", fixedTimeStep=DT, numSubSteps=0)
        floor = self.call("createCollisionShape", bullet.GEOM_PLANE)
        self.call("createMultiBody", baseMass=0.0, baseCollisionShapeIndex=floor)
        with tempfile.TemporaryDirectory() as folder:
            model = Path(folder) / "arm.urdf"
            model.write_text(_arm_with_net())
            self._arm = self.call("loadURDF", str(model), [0.0, 0.0, BASE_HEIGHT], useFixedBase=True)
        joints = [self.call("getJointInfo", self._arm, joint) for joint in range(self.call("getNumJoints", self._arm))]
        moving = [joint for joint in joints if joint[2] == bullet.JOINT_REVOLUTE]
        self._joints = [joint[0] for joint in moving]
        self._low, self._high = np.array([joint[8:10] for joint in moving]).T
        self._net = next(joint[0] for joint in joints if joint[12] == b"net")
        for joint, position in zip(self._joints, HOME, strict=True):
            self.call("resetJointState", self._arm, joint, position, 0.0)
        sphere = self.call("createCollisionShape", bullet.GEOM_SPHERE, radius=BALL_RADIUS)
        self._ball = self.call(
            "createMultiBody", baseMass=BALL_MASS, baseCollisionShapeIndex=sphere, basePosition=[2.0, -0.7, 1.0]
        )
        self.call("changeDynamics", self._ball, -1, linearDamping=0.0, angularDamping=0.0)
        self._motor = {
            "controlMode": bullet.POSITION_CONTROL, "forces": TORQUES, "targetVelocities": [0.0] * N_JOINTS,
            "positionGains": [POSITION_GAIN] * N_JOINTS, "velocityGains": [VELOCITY_GAIN] * N_JOINTS,
        }  # fmt: skip
        self._control, self._advance = self.bound("setJointMotorControlArray"), self.bound("stepSimulation")
        self._joint_states, self._link_state = self.bound("getJointStates"), self.bound("getLinkState")
        self._contacts, self._velocity = self.bound("getContactPoints"), self.bound("getBaseVelocity")

    def begin(self, context: FloatArray, seed: int) -> tuple[BallEpisode, NDArray[np.float32]]:
        random = np.random.default_rng(seed)
        start = np.array([context[2], random.uniform(*BALL_START_Y), random.uniform(*BALL_START_Z)])
        time = flight_time_of(context)
        velocity = (target_of(context) - start) / time
        velocity[2] += GRAVITY * (time + DT) / 2  # Bullet changes the velocity first, then the position
        self.call("resetBasePositionAndOrientation", self._ball, start.tolist(), [0.0, 0.0, 0.0, 1.0])
        self.call("resetBaseVelocity", self._ball, velocity.tolist(), [0.0, 0.0, 0.0])
        episode = BallEpisode()
        return episode, self._observe(episode)

    def act(self, episode: BallEpisode, action: FloatArray) -> tuple[NDArray[np.float32], float, bool, bool]:
        moved = episode.desired + RATE * DT * SUBSTEPS * action
        episode.desired = np.clip(moved, self._low, self._high)
        self._control(self._arm, self._joints, targetPositions=episode.desired.tolist(), **self._motor)
        reward = STEP_REWARD - ACTION_COST * float(action @ action)
        touched = caught = False
        for _ in range(SUBSTEPS):
            velocity = self._velocity(self._ball)[0]  # before it may be turned by a contact
            self._advance()
            # Bullet lists bodies that come near, too; those that push have met. 9: force; 2, 4: body and link.
            met = [(contact[2], contact[4]) for contact in self._contacts(self._ball) if contact[9] > 0.0]
            if met:
                touched, caught = True, (self._arm, self._net) in met
                break
        if caught:
            reward += CATCH_REWARD + ALIGNMENT_REWARD * self._alignment(velocity) ** 5
        return self._observe(episode), reward, touched, caught

    def camera(self) -> Camera:
        return Camera(target=(0.4, -0.3, 0.9), distance=1.9, yaw=60.0, pitch=-15.0)

    def _alignment(self, velocity: tuple[float, float, float]) -> float:
        """Cosine of the angle between the net's normal and the way that the ball came; 1 is head on."""
        x, y, z, w = self._link_state(self._arm, self._net)[1]
        normal = (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x))  # the link's y axis
        along = sum(n * v for n, v in zip(normal, velocity, strict=True))
        return float(-along / math.hypot(*velocity))

    def _observe(self, episode: BallEpisode) -> NDArray[np.float32]:
        states = self._joint_states(self._arm, self._joints)
        observation = np.array(
            [*episode.desired.tolist(), *(state[0] for state in states), *(state[1] for state in states)],
            dtype=np.float32,
        )
        return np.clip(observation, -OBSERVATION_LIMIT, OBSERVATION_LIMIT)


class BatchedBallCatching(BatchedBullet[BallEpisode]):
    """`n_slots` arms, each with a ball on its way. Context: (angle, radius, distance) in radians and metres.

    The ball starts `distance` away in x, at a height and a y that the seed draws, and flies to the point at `angle`
    and `radius` from the shoulder, in the plane x = 0 in which the arm moves (`target_of`, `flight_time_of`).

    Observation (15): desired positions, positions and velocities of the joints A2, A4, A5, A6 and A7, in rad and
    rad/s, clipped to +-10. The ball is not observed: without the context, a policy cannot know where it goes.
    Action (5): rates of the desired positions, in units of 4 rad/s; motors follow by PD control.

    Reward per step: 0.275 - 0.005 * sum of squares of the action. A contact of the ball with the net is a catch and
    pays 50 + 25 * cos(angle between the net's normal and the ball's way)^5. A catch, and any other contact of the
    ball, end the episode; success is a catch.
    """

    def __init__(self, n_slots: int, *, horizon: int = HORIZON) -> None:
        limit = np.full(3 * N_JOINTS, OBSERVATION_LIMIT, dtype=np.float32)
        self.observation_space = spaces.Box(-limit, limit, dtype=np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, shape=(N_JOINTS,), dtype=np.float32)
        self.context_bounds = BOUNDS
        self.knows_success = True
        super().__init__(n_slots, horizon, BallWorld)


def _arm_with_net() -> str:
    """The iiwa's URDF with two joints fixed and a net, a disk, at its end; its normal is the flange's y axis."""
    import pybullet_data

    source = Path(pybullet_data.getDataPath()) / "kuka_iiwa" / "model.urdf"
    robot = ElementTree.parse(source).getroot()  # noqa: S314 - PyBullet's own file
    for mesh in robot.iter("mesh"):
        mesh.set("filename", str(source.parent / mesh.attrib["filename"]))
    for joint in robot.iter("joint"):
        position = FIXED.get(joint.attrib["name"])
        if position is not None:
            joint.set("type", "fixed")
            origin = joint.find("origin")
            if origin is None or (position and origin.get("rpy", "0 0 0") != "0 0 0"):
                raise ValueError(f"{source} is not the iiwa that this environment was made for")
            if position:
                origin.set("rpy", f"0 0 {position}")
    turn = f'<origin rpy="{math.pi / 2} 0 0"/>'
    disk = f'<geometry><cylinder radius="{NET_RADIUS}" length="{NET_THICKNESS}"/></geometry>'
    across, along = NET_MASS * NET_RADIUS**2 / 4, NET_MASS * NET_RADIUS**2 / 2  # a disk's moments of inertia
    net = f"""<net>
      <link name="net">
        <inertial>
          <mass value="{NET_MASS}"/>
          <inertia ixx="{across}" iyy="{along}" izz="{across}" ixy="0" ixz="0" iyz="0"/>
        </inertial>
        <visual>{turn}{disk}</visual>
        <collision>{turn}{disk}</collision>
      </link>
      <joint name="net_joint" type="fixed">
        <parent link="lbr_iiwa_link_7"/><child link="net"/><origin xyz="0 0 {NET_CENTRE}"/>
      </joint>
    </net>"""
    robot.extend(ElementTree.fromstring(net))  # noqa: S314 - the text above
    return ElementTree.tostring(robot, encoding="unicode")
