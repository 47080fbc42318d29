"""The trees of rigs as programs write them: the joints between and beyond the canonical ones (sources: the presets)."""

from rig_maker import Make, names_of


def both(text: str, sides: tuple[str, str]) -> dict[str, tuple[str, ...]]:
    """Joints between, of both sides: `UpperLeg: hip{s} pelvis{s}; LowerLeg: knee{s}`."""
    found = {}
    for side, mark in zip(("left", "right"), sides, strict=True):
        for entry in text.split(";"):
            part, names = entry.split(":")
            found[side + part.strip()] = tuple(names.replace("{s}", mark).split())
    return found


def ends(text: str, sides: tuple[str, str], hand: str = "Hand") -> dict[str, str]:
    """Joints at the ends of both hands."""
    pairs = zip(("left", "right"), sides, strict=True)
    return {name: side + hand for side, mark in pairs for name in text.replace("{s}", mark).split()}


LR, lr, WORDS, HAN = ("L", "R"), ("l", "r"), ("Left", "Right"), ("左", "右")

TREES: dict[tuple[str, str], Make] = {
    ("daz-genesis", "3 and 8"): Make(
        names_of("daz-genesis", 0),
        root="Genesis8Female",
        between=both(
            "UpperLeg: pelvis; LowerLeg: {s}ThighTwist; Toes: {s}Metatarsals; LowerArm: {s}ShldrTwist; "
            "Hand: {s}ForearmTwist",
            lr,
        )
        | {"chest": ("abdomenUpper", "chestLower"), "head": ("neckUpper",)},
        further=ends("{s}Thumb1 {s}Carpal1 {s}Carpal2", lr) | {"lEye": "head", "rEye": "head", "lowerJaw": "head"},
    ),
    ("metahuman", "body and face"): Make(
        names_of("metahuman"),
        root="root",
        between={"chest": ("spine_02", "spine_03", "spine_04"), "head": ("neck_02",)},
        further={"FACIAL_C_FacialRoot": "head", "spine_04_latissimus_l": "chest"}
        | ends("thigh_twist_01_{s} thigh_twist_02_{s} thigh_correctiveRoot_{s}", lr, "UpperLeg")
        | ends("upperarm_twist_01_{s} upperarm_correctiveRoot_{s}", lr, "UpperArm")
        | ends("clavicle_out_{s} clavicle_scap_{s}", lr, "Shoulder")
        | ends("index_metacarpal_{s} thumb_01_{s} wrist_inner_{s}", lr),
    ),
    ("rigify", "deforming"): Make(
        names_of("rigify", 0),
        root="root",
        between=both(
            "LowerLeg: DEF-thigh.{s}.001; Foot: DEF-shin.{s}.001; LowerArm: DEF-upper_arm.{s}.001; "
            "Hand: DEF-forearm.{s}.001",
            LR,
        )
        | {"chest": ("DEF-spine.002",), "head": ("DEF-spine.005",)},
        further=ends("DEF-palm.01.{s} DEF-thumb.01.{s}", LR) | {"DEF-pelvis.L": "hips", "DEF-breast.L": "chest"},
        zup=True,
    ),
    ("rigify", "everything"): Make(
        names_of("rigify", 0),
        root="root",
        further={own: c for version in (2, 3) for c, own in names_of("rigify", version).items()},
    ),
    ("makehuman", "default"): Make(
        names_of("makehuman"),
        between=both(
            "UpperLeg: pelvis.{s}; LowerLeg: upperleg02.{s}; Foot: lowerleg02.{s}; UpperArm: shoulder01.{s}; "
            "LowerArm: upperarm02.{s}; Hand: lowerarm02.{s}",
            LR,
        )
        | {"chest": ("spine04", "spine03", "spine02"), "head": ("neck02", "neck03")},
        further=ends("toe2-1.{s}", LR, "Foot") | ends("finger1-1.{s} metacarpal1.{s}", LR),
    ),
    ("advanced-skeleton", "with parts"): Make(
        names_of("advanced-skeleton"),
        between=both(
            "LowerLeg: HipPart1_{s} HipPart2_{s}; Foot: KneePart1_{s} KneePart2_{s}; "
            "LowerArm: ShoulderPart1_{s} ShoulderPart2_{s}; Hand: ElbowPart1_{s} ElbowPart2_{s}",
            LR,
        )
        | {"chest": ("Spine2_M",), "head": ("NeckPart1_M",)},
        further=ends("IndexFinger1_{s} ThumbFinger1_{s}", LR),
    ),
    ("iclone", "Character Creator"): Make(
        names_of("iclone"),
        root="RL_BoneRoot",
        between=both("UpperLeg: CC_Base_Pelvis", LR)
        | {"chest": ("CC_Base_Spine01",), "head": ("CC_Base_NeckTwist02",)},
        further=ends("CC_Base_{s}_Thumb1 CC_Base_{s}_Index1", LR)
        | ends("CC_Base_{s}_ThighTwist01 CC_Base_{s}_ThighTwist02", LR, "UpperLeg")
        | ends("CC_Base_{s}_KneeShareBone CC_Base_{s}_CalfTwist01", LR, "LowerLeg")
        | ends("CC_Base_{s}_ForearmTwist01 CC_Base_{s}_ElbowShareBone", LR, "LowerArm"),
    ),
    ("humanik", "Character1"): Make(
        names_of("humanik"),
        root="Character1_Reference",
        between={"chest": ("Character1_Spine1",)} | both("LowerArm: Character1_{s}ArmRoll", WORDS),
    ),
    ("mmd", "Japanese"): Make(
        names_of("mmd"),
        root="センター",
        hanging={"spine": "センター"},
        between=both("LowerArm: {s}腕捩; Hand: {s}手捩; UpperArm: {s}肩C", HAN),
        further=ends("{s}親指０ {s}人指１", HAN) | ends("{s}足D", HAN, "UpperLeg"),
    ),
    ("xsens", "BVH"): Make(names_of("xsens"), between={"chest": ("Chest2", "Chest3")}),
    ("rokoko", "Newton"): Make(
        names_of("rokoko"), between={"chest": ("Spine2", "Spine3")}, further=ends("{s}ToeTip", WORDS, "Toes")
    ),
    ("vrm", "VRoid"): Make(names_of("vrm"), root="Root", between={"chest": ("J_Bip_C_Chest",)}),
    ("vrm", "0, facing back"): Make(
        names_of("vrm", 1),
        between={"chest": ("chest",)},
        further=ends("{s}ThumbProximal", ("left", "right")),
        turned_deg=180,
    ),
    ("unity", "avatar"): Make(names_of("unity"), between={"chest": ("Chest",)}, root="Root"),
}
"""A rig as it is written, by preset and version."""
