"""The kinematic model of a robot: links, hinges and their limits, read from MJCF or URDF by MuJoCo (Todorov et al.
2012), and which of its links is which part of a person.

All link frames are aligned with the robot's world, Z up and X ahead, where its joint angles are zero: a hinge turns its
link by a rotation vector along its axis, and the robot is a skeleton like any other.
"""

import importlib
import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import Gt, MinLen
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import kinematics, rotations
from mapctl.errors import FileFormatError, RequestError
from mapctl.formats import toml
from mapctl.formats.text import one_line
from mapctl.joint_names import Side, split_side
from mapctl.mesh.primitives import unit
from mapctl.retarget import RigMap, identify_rig
from mapctl.retarget.character import RiggedCharacter, Stance
from mapctl.retarget.joint_matching import REQUIRED
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import Skeleton

_ASIDE, _ACROSS = 0.01, 0.7  # metres that the end of a limb is aside, cosine of an axis across the body
_HEAD_SHARE = 0.26  # of the shoulders' height over the hips, by which a head is over them, as the canonical body's


@dataclass(frozen=True)
class _Stated:
    """A robot's TOML."""

    __pydantic_config__ = toml.STRICT

    links: Mapping[str, str] = field(default_factory=dict)
    """Link by canonical joint, where another one would be recognised."""
    speed: Annotated[float, Gt(0)] | None = None
    """Largest speed of all joints, rad/s."""
    soles: Mapping[str, Annotated[Sequence[tuple[float, float, float]], MinLen(3)]] = field(default_factory=dict)
    """Corners of the soles by foot link, each x, y and z in the link's frame in the model, metres."""


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot with a floating base and hinges."""

    skeleton: Skeleton
    """Links, the first of which is the base. The End Site of a foot is the tip of its sole."""
    joints: tuple[str, ...]
    """Names of the joints, in the model's order."""
    hinges: tuple[int, ...]
    """The link that each joint turns."""
    axes: Float[Tensor, "joints 3"]
    """Unit vector along each joint's axis."""
    low: Float[Tensor, " joints"]
    """Smallest angles, radians."""
    high: Float[Tensor, " joints"]
    """Largest angles, radians."""
    speed: Float[Tensor, " joints"]
    """Largest speeds, rad/s; infinite where none are stated."""
    zero: Float[Tensor, "links 3 3"]
    """Orientation of each link's frame in the model where all angles are zero."""
    soles: tuple[Float[Tensor, "corners 3"], Float[Tensor, "corners 3"]]
    """Corners of the left and the right sole about the origins of their links, metres."""
    rigmap: RigMap
    """The links as a rig of a person."""
    model: Any
    """MuJoCo's model."""

    @cached_property
    def character(self) -> RiggedCharacter:
        """The robot as a character whose tips of the soles are its toes."""
        flat = torch.zeros(2, dtype=torch.float64)
        return RiggedCharacter(self.rigmap, Stance(flat, flat, torch.zeros(2, 2, dtype=torch.float64)))

    @cached_property
    def above(self) -> Bool[Tensor, "links joints"]:
        """Whether each joint moves each link."""
        return kinematics.find_joints_above(self.skeleton.parents)[:, list(self.hinges)]

    @property
    def feet(self) -> tuple[int, int]:
        """The left and the right foot's link."""
        return self.rigmap.joints["leftFoot"], self.rigmap.joints["rightFoot"]

    @property
    def tips(self) -> Float[Tensor, "2 3"]:
        """Tips of the left and the right sole about the origins of their links, metres."""
        names, ends = self.skeleton.names, self.skeleton.end_offsets
        return torch.tensor([ends[names[foot]] for foot in self.feet], dtype=torch.float64)

    @property
    def corner_links(self) -> list[int]:
        """The link of each corner of the soles."""
        return [foot for foot, sole in zip(self.feet, self.soles, strict=True) for _ in sole]

    @property
    def bodies(self) -> list[int]:
        """The links that are bodies of the model."""
        return [link for link, name in enumerate(self.skeleton.names) if not name.startswith("(")]

    def rotate_links(
        self, base: Float[Tensor, "frames 3 3"], angles: Float[Tensor, "frames joints"]
    ) -> Float[Tensor, "frames links 3 3"]:
        """Compute each link's rotation in its parent, at orientations of the base and angles, radians."""
        vectors = angles.new_zeros(len(angles), self.skeleton.num_joints, 3)
        vectors[:, list(self.hinges)] = angles[..., None] * self.axes
        return torch.cat([base[:, None], rotations.rotation_vector_to_matrix(vectors[:, 1:])], dim=1)

    def chain_links(
        self, base: Float[Tensor, "frames 3 3"], angles: Float[Tensor, "frames joints"]
    ) -> tuple[Float[Tensor, "frames links 3"], Float[Tensor, "frames links 3 3"]]:
        """Compute positions of all links about the base, metres, and their orientations."""
        local = self.rotate_links(base, angles)
        return kinematics.chain_matrices(self.skeleton.offsets, self.skeleton.parents, local)


def load(path: str | PathLike[str]) -> Robot:
    """Load a robot. A .toml of the same name beside it states what it does not show: `links`, `speed` and `soles`.
    FileFormatError for a file that is no robot with two legs and arms, RequestError without MuJoCo."""
    path = Path(path)
    model = _compile(path)
    beside = path.with_suffix(".toml")
    stated = toml.read(beside, _Stated, what="robot's table") if beside.exists() else _Stated()
    return _Tree(path, model).build(stated)


def import_mujoco() -> Any:
    """Import MuJoCo, which has no types; RequestError where it is not installed."""
    try:
        return importlib.import_module("mujoco")
    except ImportError:
        raise RequestError("robots need MuJoCo: pip install 'mapctl[robot]'") from None


def _compile(path: Path) -> Any:
    """Compile a model, without its meshes where their files are not there."""
    mujoco = import_mujoco()
    if not path.is_file():
        raise RequestError(f"{path}: no such file")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        spec.compiler.fusestatic = False
        try:
            return spec.compile()
        except ValueError:
            for geom in [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_MESH]:
                spec.delete(geom)
            for mesh in list(spec.meshes):
                spec.delete(mesh)
            return spec.compile()
    except Exception as error:  # MuJoCo raises whatever its parsers do
        raise FileFormatError(path, f"is no model that MuJoCo can read: {one_line(error)}") from error


class _Tree:
    """Links of a model where all angles are zero. Of a body with several hinges each but the last has a link of its
    own; a link's origin is on its hinge."""

    def __init__(self, path: Path, model: Any):
        mujoco = import_mujoco()
        self.path, self.model, self.data = path, model, mujoco.MjData(model)
        self.data.qpos[model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE]] = 0
        mujoco.mj_kinematics(model, self.data)
        self.names: list[str] = []
        self.parents: list[int] = []
        self.origins: list[np.ndarray] = []
        self.zero: list[np.ndarray] = []
        self.hinges: list[int] = []
        self.turning: list[int] = []  # number of the joint in the model, by hinge
        self.link_of: dict[int, int] = {}  # by body
        for body in range(1, model.nbody):
            above = self.link_of.get(int(model.body_parentid[body]), -1)
            if above < 0 and self.link_of:
                continue  # another tree: an object to be carried
            first = int(model.body_jntadr[body])
            own = [first + k for k in range(int(model.body_jntnum[body])) if first + k < model.njnt]
            own = [j for j in own if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE]
            if any(model.jnt_type[j] != mujoco.mjtJoint.mjJNT_HINGE for j in own) or (own and above < 0):
                raise FileFormatError(path, f"{model.body(body).name}: only hinges are known below a free base")
            for joint in own[:-1]:
                above = self._add(_name_joint(model, joint), above, body, joint)
            self.link_of[body] = self._add(model.body(body).name or f"body{body}", above, body, *own[-1:])
        if not self.names:
            raise FileFormatError(path, "has no bodies")
        self.turn = self._find_turn()
        self.origins, self.zero = [self.turn @ at for at in self.origins], [self.turn @ zero for zero in self.zero]

    def _add(self, name: str, above: int, body: int, joint: int | None = None) -> int:
        self.names.append(name)
        self.parents.append(above)
        self.origins.append(np.array(self.data.xpos[body] if joint is None else self.data.xanchor[joint]))
        self.zero.append(np.array(self.data.xmat[body]).reshape(3, 3))
        if joint is not None:
            self.hinges.append(len(self.names) - 1)
            self.turning.append(joint)
        return len(self.names) - 1

    def build(self, stated: _Stated) -> Robot:
        """Build the robot; FileFormatError where a part of a person is not among its links."""
        links = self._match_links() | dict(stated.links)
        for joint in (*REQUIRED, *links):
            if links.get(joint) not in self.names:
                beside = self.path.with_suffix(".toml").name
                raise FileFormatError(self.path, f"no link is known to be {joint}; name it under [links] in {beside}")
        at, model = np.stack(self.origins), self.model
        offsets = np.concatenate([np.zeros((1, 3)), at[1:] - at[self.parents[1:]]])
        feet = [links[f"{side}Foot"] for side in ("left", "right")]
        soles = [self._find_sole(foot, stated) for foot in feet]
        tips = [np.array([sole[:, 0].max(), sole[:, 1].mean(), sole[:, 2].min()]) for sole in soles]
        ends = {foot: (float(tip[0]), float(tip[1]), float(tip[2])) for foot, tip in zip(feet, tips, strict=True)}
        skeleton = Skeleton(tuple(self.names), tuple(self.parents), torch.from_numpy(offsets), ends)
        joints = [_name_joint(model, joint) for joint in self.turning]
        limited = model.jnt_limited[self.turning].astype(bool)[:, None]
        ranges = torch.from_numpy(np.where(limited, model.jnt_range[self.turning], [-np.pi, np.pi]))
        speeds = {} if stated.speed is not None else _read_speeds(self.path)
        speed = [speeds.get(joint, stated.speed or np.inf) for joint in joints]
        rig = Rig(self.path.stem, links, rest="straighten", up="z", facing="x")
        return Robot(
            skeleton=skeleton,
            joints=tuple(joints),
            hinges=tuple(self.hinges),
            axes=torch.from_numpy(self.data.xaxis[self.turning] @ self.turn.T),
            low=ranges[:, 0],
            high=ranges[:, 1],
            speed=torch.tensor(speed, dtype=torch.float64),
            zero=torch.from_numpy(np.stack(self.zero)),
            soles=(torch.from_numpy(soles[0]), torch.from_numpy(soles[1])),
            rigmap=identify_rig(skeleton, rig),
            model=model,
        )

    def _find_sole(self, foot: str, stated: _Stated) -> Float[np.ndarray, "corners 3"]:
        """Find the corners of a sole: of the box around all shapes of the foot and of what is fixed to it."""
        link = self.names.index(foot)
        if foot in stated.soles:
            return np.array(stated.soles[foot], dtype=np.float64).reshape(-1, 3) @ self.zero[link].T
        model, data, points = self.model, self.data, list[np.ndarray]()
        bodies = {body for body, own in self.link_of.items() if self._find_moving(own) == link}
        for geom in (geom for geom in range(model.ngeom) if int(model.geom_bodyid[geom]) in bodies):
            signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
            box = model.geom_aabb[geom, :3] + signs * model.geom_aabb[geom, 3:]
            points.append((data.geom_xpos[geom] + box @ data.geom_xmat[geom].reshape(3, 3).T) @ self.turn.T)
        if not points:
            beside = self.path.with_suffix(".toml").name
            raise FileFormatError(
                self.path, f"{foot} has no shape; give the corners of its sole under [soles] in {beside}"
            )
        low, high = (edge(np.concatenate(points), axis=0) - self.origins[link] for edge in (np.min, np.max))
        return np.array([(x, y, low[2]) for x in (low[0], high[0]) for y in (low[1], high[1])])

    def _find_turn(self) -> Float[np.ndarray, "3 3"]:
        """Find the rotation about the vertical after which links that are named left are on the left, X ahead: a model
        may stand in any heading. Without such names it faces X."""
        sides = [
            [at for at, name in zip(self.origins, self.names, strict=True) if split_side(name)[0] is side]
            for side in (Side.LEFT, Side.RIGHT)
        ]
        if not all(sides):
            return np.eye(3)
        left, right = (np.mean(side, axis=0) for side in sides)
        x, y, _ = left - right
        cos, sin = np.array([y, x]) / (np.hypot(x, y) or 1.0)
        return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])

    def _find_moving(self, link: int) -> int:
        """Find the link that carries a link: itself if it turns."""
        while link not in self.hinges and self.parents[link] >= 0:
            link = self.parents[link]
        return link

    def _match_links(self) -> dict[str, str]:
        """Match links with canonical joints by how the robot is built, upright, facing X, where all angles are zero. A
        limb is a chain of hinges after a branching; the lowest one of a side is its leg, the longest other its arm. A
        knee is the second hinge across a leg, an elbow the hinge across an arm that is farthest from both its ends."""
        below: dict[int, list[int]] = defaultdict(list)
        for link in self.hinges:
            below[self._find_moving(self.parents[link])].append(link)
        chains: list[list[int]] = []
        for first in (link for parent, links in below.items() if len(links) > 1 or parent == 0 for link in links):
            chains.append([first])
            while len(following := below.get(chains[-1][-1], [])) == 1:
                chains[-1] += following
        at, found = self.origins, {"hips": 0}
        arms = list[list[int]]()
        for side, sign in (("left", 1.0), ("right", -1.0)):
            own = [chain for chain in chains if len(chain) > 2 and sign * at[chain[-1]][1] > _ASIDE]
            own.sort(key=lambda chain: at[chain[-1]][2])
            across = [link for link in own[0] if abs(self._axis(link)[1]) > _ACROSS] if len(own) > 1 else []
            if len(across) < 2:
                continue
            leg, arm, knee = own[0], max(own[1:], key=len), across[1]
            shoulder, hand = at[arm[1]], self._find_end(arm[-1])
            bends = [link for link in arm[2:] if abs(unit(at[link] - shoulder) @ self._axis(link)) < _ACROSS]
            near = {link: min(np.linalg.norm(at[link] - end) for end in (shoulder, at[hand])) for link in bends}
            elbow = max(near or arm[-1:], key=lambda link: float(near.get(link, 0.0)))
            found |= {
                f"{side}UpperLeg": self._find_centre(leg[: leg.index(knee)]),
                f"{side}LowerLeg": knee,
                f"{side}Foot": leg[-1],
                f"{side}UpperArm": self._find_centre(arm[: arm.index(elbow)]),
                f"{side}LowerArm": elbow,
            }
            hand = hand if arm[-1] == elbow else arm[-1]
            found |= {f"{side}Hand": hand} if hand != elbow else {}
            arms.append(arm)
        if len(arms) == 2:
            found |= self._find_trunk(arms, chains)
        return {joint: self.names[link] for joint, link in found.items()}

    def _find_trunk(self, arms: list[list[int]], chains: list[list[int]]) -> dict[str, int]:
        """Find spine, chest and head; where nothing turns them they are fixed, between hips and shoulders and above."""
        trunk, link = [], self._find_moving(self.parents[arms[0][0]])
        while link in self.hinges:
            trunk, link = [link, *trunk], self._find_moving(self.parents[link])
        top = trunk[-1] if trunk else 0
        shoulders = (self.origins[arms[0][0]] + self.origins[arms[1][0]]) / 2
        found = {"spine": trunk[0] if trunk else self._add_fixed("(spine)", 0, self.origins[0])}
        if len(trunk) > 1:
            found["chest"] = top
        necks = [chain for chain in chains if self.origins[chain[0]][2] > shoulders[2] and chain not in arms]
        above = _HEAD_SHARE * (shoulders - self.origins[0]) * np.array([0.0, 0.0, 1.0])
        head = max(necks, key=len)[-1] if necks else self._add_fixed("(head)", top, shoulders + above)
        return found | {"head": head}

    def _add_fixed(self, name: str, above: int, at: Float[np.ndarray, "3"]) -> int:
        """Add a link that is no body of the model; parentheses mark its name."""
        self.names.append(name)
        self.parents.append(above)
        self.origins.append(np.array(at))
        self.zero.append(np.eye(3))
        return len(self.names) - 1

    def _find_end(self, link: int) -> int:
        """Find the farthest of the links that are fixed to a link: itself if there is none."""
        fixed = [own for own in range(len(self.names)) if self._find_moving(own) == link]
        return max(fixed, key=lambda own: float(np.linalg.norm(self.origins[own] - self.origins[link])))

    def _axis(self, link: int) -> Float[np.ndarray, "3"]:
        return self.turn @ self.data.xaxis[self.turning[self.hinges.index(link)]]

    def _find_centre(self, links: list[int]) -> int:
        """Find the link that is nearest to the point where the axes of several about meet, by least squares."""
        axes = np.stack([self._axis(link) for link in links])
        across = np.eye(3) - axes[:, :, None] * axes[:, None]
        at = np.stack([self.origins[link] for link in links])
        centre = np.linalg.lstsq(across.sum(axis=0), (across @ at[..., None]).sum(axis=0)[:, 0], rcond=None)[0]
        return links[int(np.linalg.norm(at - centre, axis=1).argmin())]


def _name_joint(model: Any, joint: int) -> str:
    return model.joint(joint).name or f"joint{joint}"


def _read_speeds(path: Path) -> dict[str, float]:
    """Read the largest speeds of a URDF's joints, rad/s, which MuJoCo leaves out."""
    try:
        joints = [(joint.get("name", ""), joint.find("limit")) for joint in ElementTree.parse(path).iter("joint")]
        found = {name: float(limit.get("velocity", 0)) for name, limit in joints if limit is not None}
    except (ElementTree.ParseError, ValueError) as error:
        raise FileFormatError(path, f"velocity of joints: {one_line(error)}") from error
    return {name: speed for name, speed in found.items() if speed > 0}
