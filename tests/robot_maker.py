# ruff: noqa: E501
"""A small humanoid with 21 hinges, as MJCF and as URDF."""

import math

LEG = {
    "hip_yaw": "0 0 1",
    "hip_roll": "1 0 0",
    "hip_pitch": "0 1 0",
    "knee": "0 1 0",
    "ankle_pitch": "0 1 0",
    "ankle_roll": "1 0 0",
}
ARM = {"shoulder_pitch": "0 1 0", "shoulder_roll": "1 0 0", "shoulder_yaw": "0 0 1", "elbow": "0 1 0"}
RANGES = {
    **{
        "hip_yaw": (-1, 1),
        "hip_roll": (-0.6, 0.6),
        "hip_pitch": (-2, 1),
        "knee": (-0.05, 2.4),
        "ankle_pitch": (-0.9, 0.6),
    },
    **{
        "ankle_roll": (-0.4, 0.4),
        "shoulder_pitch": (-3, 1.5),
        "shoulder_roll": (-1.8, 1.8),
        "shoulder_yaw": (-1.5, 1.5),
    },
    **{"elbow": (-2.2, 0.05), "waist_yaw": (-1.5, 1.5)},
}
OFFSETS = {
    **{"hip_yaw": (0, 0.09, -0.05), "hip_roll": (0, 0, -0.03), "hip_pitch": (0, 0, -0.02), "knee": (0.01, 0, -0.32)},
    **{"ankle_pitch": (-0.01, 0, -0.3), "ankle_roll": (0, 0, -0.02), "shoulder_pitch": (0, 0.14, 0.3)},
    **{"shoulder_roll": (0, 0.03, 0), "shoulder_yaw": (0, 0.01, -0.08), "elbow": (0.01, 0, -0.12)},
}
SOLE = (0.03, 0.09, 0.035, 0.045)  # metres: centre ahead, half length, half width, and depth under the ankle


def list_joints():
    """Joints in the model's order: name, axis."""
    sides = [(side, {**LEG}) for side in ("left", "right")]
    legs = [(f"{side}_{part}", axis) for side, parts in sides for part, axis in parts.items()]
    arms = [(f"{side}_{part}", axis) for side in ("left", "right") for part, axis in ARM.items()]
    return [*legs, ("waist_yaw", "0 0 1"), *arms]


def make_mjcf(path, *, rename=lambda name: name, shapes=True, joint="hinge"):
    """Write the humanoid as MJCF."""

    def chain(side, parts, last=""):
        text, end = "", ""
        for part, axis in parts.items():
            x, y, z = OFFSETS[part]
            low, high = RANGES[part]
            name = rename(f"{side}_{part}")
            y = -y if side == "right" else y
            text += f'<body name="{name}_link" pos="{x} {y} {z}"><inertial pos="0 0 -0.02" mass="1" diaginertia=".01 .01 .01"/>'
            text += f'<joint name="{name}" type="{joint}" axis="{axis}" range="{math.degrees(low)} {math.degrees(high)}" limited="true"/>'
            end += "</body>"
        hand = f'<body name="{rename(side + "_palm")}" pos="0.01 0 -0.14"/>' if "elbow" in parts else ""
        return text + last + hand + end

    ahead, length, width, depth = SOLE
    box = f'<geom type="box" pos="{ahead} 0 {-depth / 2}" size="{length} {width} {depth / 2}"/>' if shapes else ""
    legs = "".join(chain(side, LEG, box) for side in ("left", "right"))
    arms = "".join(chain(side, ARM) for side in ("left", "right"))
    path.write_text(
        f"""<mujoco model="small"><worldbody><geom name="floor" type="plane" size="5 5 1"/>
        <body name="pelvis" pos="0 0 0.8"><freejoint/><inertial pos="0 0 0" mass="4" diaginertia=".1 .1 .1"/>{legs}
        <body name="{rename("waist_yaw")}_link" pos="0 0 0.08"><inertial pos="0 0 0.1" mass="6" diaginertia=".1 .1 .1"/>
        <joint name="{rename("waist_yaw")}" axis="0 0 1" range="-90 90" limited="true"/>{arms}
        <body name="{rename("head")}" pos="0 0 0.45"/></body></body></worldbody></mujoco>"""
    )
    return path


def make_urdf(path, speed: float | str = 12.0):
    """Write the humanoid as URDF, whose joints have a largest speed."""
    links, joints = ["pelvis"], []

    def add(name, parent, axis, at, limits):
        links.append(f"{name}_link")
        low, high = limits
        joints.append(
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{name}_link"/><axis xyz="{axis}"/>'
            f'<origin xyz="{at[0]} {at[1]} {at[2]}"/><limit lower="{low}" upper="{high}" velocity="{speed}" effort="9"/></joint>'
        )
        return f"{name}_link"

    for side in ("left", "right"):
        above = "pelvis"
        for part, axis in LEG.items():
            x, y, z = OFFSETS[part]
            above = add(f"{side}_{part}", above, axis, (x, -y if side == "right" else y, z), RANGES[part])
    waist = add("waist_yaw", "pelvis", "0 0 1", (0, 0, 0.08), RANGES["waist_yaw"])
    for side in ("left", "right"):
        above = waist
        for part, axis in ARM.items():
            x, y, z = OFFSETS[part]
            above = add(f"{side}_{part}", above, axis, (x, -y if side == "right" else y, z), RANGES[part])
    ahead, length, width, depth = SOLE
    inertia = '<inertial><mass value="1"/><inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>'
    box = f'<collision><origin xyz="{ahead} 0 {-depth / 2}"/><geometry><box size="{2 * length} {2 * width} {depth}"/></geometry></collision>'
    bodies = [f'<link name="{name}">{inertia}{box if "ankle_roll" in name else ""}</link>' for name in links]
    path.write_text(f'<robot name="small">{"".join(bodies)}{"".join(joints)}</robot>')
    return path
