"""Whatever is wrong with a request: exit status 2, one clear line on standard error, nothing written. All commands."""

import shlex

import numpy as np
import pytest
from acclaim import pair
from captures import on_rig
from helpers import KEYS, run, walk
from strange_rigs import CASES as STRANGE_RIGS
from tiny_denoiser import save_tiny_denoiser
from tiny_infiller import save_tiny_infiller
from tiny_path import save_tiny_path
from tiny_prior import save_tiny_prior
from tiny_stitcher import save_tiny_stitcher
from tiny_tweener import save_tiny_tweener

from mapctl.formats import npz

TURNS = "Zrotation Xrotation Yrotation"
HEAD = (
    f"HIERARCHY\nROOT Hips\n{{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition {TURNS}\n"
    f"JOINT Leg\n{{\nOFFSET 0 -90 0\nCHANNELS 3 {TURNS}\nEnd Site\n{{\nOFFSET 0 -10 0\n}}\n}}\n}}\n"
    "MOTION\nFrames: 2\nFrame Time: 0.0333333\n"
)
ROW = "0 90 0 0 0 0 0 0 0\n"
DEPTH = 3000
DEEP = (
    f"HIERARCHY\nROOT j\n{{\nOFFSET 0 0 0\nCHANNELS 3 {TURNS}\n"
    + "".join(f"JOINT j{k}\n{{\nOFFSET 0 1 0\nCHANNELS 3 {TURNS}\n" for k in range(DEPTH))
    + "}\n" * (DEPTH + 1)
    + "MOTION\nFrames: 1\nFrame Time: 0.04\n"
    + "0 " * 3 * (DEPTH + 1)
)
MOTIONS = {
    "empty": "",
    "cut": HEAD + "0 90 0",
    "nan": HEAD + ROW + ROW.replace("90", "nan"),
    "counts": HEAD + "0 90 0\n" + ROW,
    "words": HEAD + ROW + ROW.replace("90", "high"),
    "deep": DEEP,
    "odd": HEAD + ROW + ROW,
}
CURVES = {"cut": "x,z\n0,0\n1,", "nan": "x,z\n0,0\n1,nan\n", "counts": "x,z\n0,0\n1,1,1,1\n", "point": "x,z\n0,0\n"}
MASKS = {"wrong": "Hand_L,4,x", "name": "Hnad_L,4,6", "late": "Hand_L,4,50"}
PARTS = """
body = "in.bvh"
[[key]]
frame = 0
root_only = "place"
place = [0, 0]
[[key]]
frame = 20
drawing = "pose.csv"
[[key]]
frame = 40
pose_frame = 40
half = "lower"
"""
KEY_FILES = {
    "good": KEYS,
    "misspelt": KEYS.replace("place =", "plaec ="),
    "no-hand": KEYS.replace("Hand_L", "Hnad_L"),
    "no-pose": KEYS.replace("other.bvh", "gone.bvh"),
    "no-body": KEYS.replace("in.bvh", "gone.bvh"),
    "late": KEYS.replace("pose_frame = 20", "pose_frame = 45"),
    "twice": KEYS.replace("frame = 22", "frame = 40"),
    "nan": KEYS.replace("[0.3, 1.5]", "[0.3, nan]"),
    "empty": "",
    "undrawn": PARTS.replace("pose.csv", "no-hand.csv"),
    "point": PARTS.replace("pose.csv", "point.csv"),
    "two-kinds": PARTS + 'drawing = "pose.csv"\n',
    "no-half": PARTS.replace('"lower"', '"left"'),
}
DRAWINGS = {"no-hand": "Hips,3,98\nHead,4,160\nHnad_L,30,130", "point": "Hips,1,1\nHead,1,1"}
REACH = "reach = { leftHand = [0.9, 1, 1] }"
SHOTS = {
    "no-seconds": "look_at = [0, 1, 2]",
    "nothing": "seconds = 1",
    "tail": "seconds = 1\nreach = { tail = [0, 1, 2] }",
    "misspelt": "seconds = 1\nlook = [0, 1, 2]",
    "no-pose": "seconds = 1\nlook_at = [0, 1, 2]\npose_frame = 3",
    "gone": "seconds = 1\npose = 'gone.bvh'",
    "tolerance": f"seconds = 1\n{REACH}\ntolerance = {{ rightHand = 0.1 }}",
    "together": "seconds = 1\nplace = [0, 1]\n[[key]]\nseconds = 1.05\nfacing_deg = 9",
    "late": "seconds = 50\nlook_at = [0, 1, 2]",
    "far": "seconds = 1\nreach = { leftHand = [5, 1, 2] }",
    "near": f"seconds = 1\n{REACH}",
}
SCRIPT = "time_s,speed_mps,heading_deg"
GOTO = f"{SCRIPT},goto_x_m,goto_z_m,within_s,goto_facing_deg,pose\n0,1.2,0,,,,,\n0.2,1,0,"
SCRIPTS = {
    "good": f"{SCRIPT}\n0,1.2,0\n0.2,1.0,40\n",
    "column": "time_s,speed_mps\n0,1",
    "order": f"{SCRIPT}\n0,1,0\n0,1,0",
    "nan": f"{SCRIPT}\n0,nan,0",
    "half": f"{GOTO}1,,0.7,,",
    "facing": f"{GOTO},,,30,",
    "soon": f"{GOTO}1,1,0,,",
    "far": f"{GOTO}1001,1,1,,",
    "no-file": f"{GOTO}1,1,1,,gone.bvh:3",
    "no-frame": f"{GOTO}1,1,1,,in.bvh",
    "late": f"{GOTO}1,1,1,,in.bvh:45",
}
STILL = 'outputs = ["a.bvh"]\n[[actors]]\ncurve = "line:2"\nspeed_by_time = [[0, 0]]\nseconds = 2\n'

IN = "in.bvh -o a.bvh"
INFILL = f"infill {IN} --inbetweener infiller.safetensors"
TWEEN = f"tween {IN} --inbetweener infiller.safetensors --keyframes"
KEYED = "tween {}.keys.toml -o a.bvh --method slerp"
DENOISE = f"denoise {IN} --denoiser denoiser.safetensors"
CLEAN = "denoise takes -o out --denoiser denoiser.safetensors"
WAY = f"infill {IN} --method slerp --path path.safetensors"
STYLE = f"{IN} --method tweener --inbetweener tweener.safetensors --path path.safetensors --no-refine"
STITCH = f"tween {IN} --method stitcher --stitcher stitcher.safetensors --no-refine"
FOLLOW = "follow line:2 -o a.bvh --prior prior.safetensors"
GENERATE = "generate -o gen --seconds 1 --prior prior.safetensors"
STEER = "steer {}.steer.csv -o a.bvh --prior prior.safetensors"
TRAIN = "train refiner --data . -o run"
OVER = "would overwrite its own source"

CASES = {
    "": "mapctl --help",
    "fly": "follow",
    "follow": "mapctl follow --help",
    "follow line:4": "--out",
    f"{FOLLOW} --strct": "Perhaps you meant: --strict",
    f"{FOLLOW} --seconds long": "--seconds: expected a number, got 'long'",
    f"{FOLLOW} --seed 1.5": "--seed: expected a whole number, got '1.5'",
    # curves, speeds, durations
    "follow circle:0 -o a.bvh": "radius",
    "follow circle:nan -o a.bvh": "circle",
    "follow hexagon:4 -o a.bvh": "circle",
    "follow nowhere.csv -o a.bvh": "no such file",
    "follow nowhere/curve -o a.bvh": "no such file",
    **{f"follow {kind}.curve.csv -o a.bvh": f"{kind}.curve.csv" for kind in CURVES},
    f"{FOLLOW} --speed 0": "speed must be positive",
    f"{FOLLOW} --speed nan": "speed must be positive",
    f"{FOLLOW} --speed fast": "'fast'",
    f"{FOLLOW} --speed 0:1,0:2": "rise",
    f"{FOLLOW} --seconds -3": "seconds must be positive, got -3",
    f"{FOLLOW} --seconds 1e9": "fewer seconds",
    f"{FOLLOW} --seed -1": "seed",
    f"{FOLLOW} --liveliness 1.5": "liveliness",
    f"{FOLLOW} --seed {2**63}": "seed",
    f"{FOLLOW} --metres-per-unit 2": "metres per unit",
    f"{FOLLOW} --fps 0": "--fps must be 1 to 1000",
    # shots
    f"{FOLLOW} --avoid 1,2": "an obstacle is X,Z,RADIUS",
    f"{FOLLOW} --avoid 0,0.1,0.5": "the start is within the obstacle",
    f"{FOLLOW} --start sitting": "--start: expected walk, stand or CLIP:FRAME",
    f"{FOLLOW} --end gone.bvh:3": "gone.bvh",
    f"{FOLLOW} --loop": "a loop needs a closed curve",
    "follow line:2 -o a.bvh --style sad": "has no style 'sad', only",
    f"{FOLLOW} --keys gone.toml": "gone.toml",
    f"{FOLLOW} --keys near.shot.toml --avoid 1,1,0.3": "within the obstacle at 1, 1",
    **{
        f"{FOLLOW} --seconds 2 --keys {kind}.shot.toml": said
        for kind, said in {
            "no-seconds": "key[0].seconds: ",
            "nothing": "key[0].reach: ",
            "tail": "key[0].reach.tail: hands and feet are",
            "misspelt": "key[0].look: there is no such key; the nearest is look_at; allowed: seconds",
            "no-pose": "key[0].pose_frame: this is of a pose",
            "gone": "gone.bvh",
            "tolerance": "has no position for it",
            "together": "within two frames",
            "late": "not within",
            "far": "leftHand at 1 s is to be",
        }.items()
    },
    "run gone.toml": "gone.toml",
    "run nothing": "ready scenes",
    "run still.scene.toml -o out": "zero throughout",
    # files that cannot be written, or are read
    "follow line:2 -o a.txt": ".bvh",
    "follow line:4 -o gone/a.bvh": "does not exist",
    "follow line:4 -o .": "cannot write .",
    "follow line:4 -o a.bvh --report gone/a.json": "gone",
    "follow line:4 -o a.bvh --report a.bvh": "requested twice",
    "follow line:4 -o a.bvh --video a.avi": ".mp4",
    "follow line:4 -o /proc/self/a.bvh": "cannot write",
    "generate -o /proc/self/gen --seconds 1": "cannot write",
    "generate -o gen.file --seconds 1": "not a folder",
    "demo -o gen.file/deeper": "not a folder",
    "steer gone.csv -o a.mp4": ".mp4",
    "infill link.bvh -o ./in.bvh --gap 5:9": OVER,
    f"{INFILL} --gap 5:9 --report in.bvh": OVER,
    "infill in.bvh -o folder.bvh --gap 5:9": "it is a folder",
    "infill folder.bvh -o a.bvh --gap 5:9": "is a folder, expected a file",
    "tween in.bvh -o in.bvh --keyframes 0,9": OVER,
    "tween good.keys.toml -o other.bvh": OVER,
    "denoise in.bvh -o in.bvh": OVER,
    # models
    "follow line:2 -o a.bvh --prior nobody": "no prior 'nobody'",
    "follow line:4 -o a.bvh --prior bad.safetensors": "bad",
    "follow line:4 -o a.bvh --weights libre": "must be free or full, got 'libre'",
    "info nobody": "no prior 'nobody'",
    f"denoise {IN} --denoiser prior.safetensors": "a lstm-gmm is no denoiser",
    f"infill {IN} --gap 5:9 --inbetweener prior.safetensors": "a lstm-gmm is no in-betweener",
    f"tween {IN} --keyframes 0,9 --inbetweener nobody": "no prior 'nobody'",
    f"infill {IN} --gap 5:9 --method slerp --inbetweener infiller": "--method slerp uses no network",
    f"{DENOISE} --prior nobody": "no prior 'nobody'",
    # generate and steer
    "generate -o gen --seconds 0": "seconds must be positive",
    "generate -o gen --seconds inf": "seconds must be at most",
    f"{GENERATE} --count 0": "count",
    f"{GENERATE} --temperature -1": "temperature",
    f"{GENERATE} --start cut.bvh": "cut.bvh",
    "generate -o gen --seconds 1 --style swim": "has no gait or style 'swim'",
    f"{GENERATE} --refiner nobody": "no prior 'nobody'",
    f"{GENERATE} --refiner prior.safetensors": "a lstm-gmm is no refiner",
    "steer gone.csv -o a.bvh": "gone.csv",
    f"{STEER.format('good')} --turn-rate -3": "turn_rate must be positive",
    f"{STEER.format('good')} --avoid 0.1,0,0.5": "40 cm within an obstacle",
    f"{STEER.format('good')} --stitcher stitcher": "--stitcher is for goto_x_m, which the script does not have",
    **{
        STEER.format(kind): said
        for kind, said in {
            "column": "line 1: has no column heading_deg",
            "order": "line 3: time_s must rise",
            "nan": "line 2: speed_mps must be a number",
            "half": "line 3: goto_x_m needs goto_z_m too",
            "facing": "line 3: goto_facing_deg needs goto_x_m and goto_z_m and within_s too",
            "soon": "line 3: within_s must be more than 0",
            "far": "line 3: goto_x_m must lie between -1000 and 1000, got 1001",
            "no-file": "line 3: pose: ",
            "no-frame": "line 3: pose is FILE:FRAME, a motion file and a frame of it; got in.bvh",
            "late": "line 3: pose: in.bvh has the frames 0:45, and no 45",
        }.items()
    },
    # motions that cannot be read
    **{f"convert {kind}.bvh a.npz": f"{kind}.bvh" for kind in MOTIONS if kind != "odd"},
    "measure deep.bvh": "deep.bvh",
    "render words.bvh -o a.png": "words.bvh",
    **{f"{words} gone.bvh {more}": "gone.bvh" for words, more in (("measure", ""), ("render", "-o a.png"))},
    **{
        f"convert {words}": said
        for words, said in {
            "gone.amc a.bvh": "gone.amc: no such file",
            "gone.asf+in.amc a.bvh": "gone.asf: no such file",
            "01.asf a.bvh": "01.asf: is a skeleton alone: name its motion, a .amc beside it or subject.asf+take.amc",
            "in.obj a.bvh": "cannot read the ending '.obj'; allowed: .bvh, .npz, .amc",
            "in.bvh a.gltf": "cannot write a.gltf: .gltf is read but not written; allowed: .bvh, .npz",
            "in.bvh a.vrm": "a .vrm needs a character",
            "in.bvh a.xyz": "unknown ending '.xyz'",
            "example:run a.bvh": "no example 'run'; there are: noisy-walk",
            "in.bvh a.npz --fps-in 60": "a .bvh file has a frame rate of its own",
            "in.bvh a.npz --fps 1/0": "frame rate",
            "in.amc a.npz --fps-in 0": "the frame rate must be 0.01 to 1000",
            "broken.amc a.npz": "broken.amc, line 1: expected the number of the first frame, got 'hello'",
            "two/in.amc a.npz": "beside it: 01.asf, 02.asf; name one as 01.asf+in.amc",
            "objects.npz a.bvh": "objects.npz: is not a sound .npz archive: Object arrays cannot be loaded",
            "in.bvh a.npz --frames 2:99": "the range of frames 2:99 must begin before it ends, within the",
            "in.bvh a.npz --frames 3": "a range of frames is A:B, frames or seconds as in 60:120",
            "in.bvh a.npz --unit ell": "a unit is m, dm, cm, mm, in or metres per unit, got 'ell'",
            "in.bvh a.bvh --in-place --root-motion": "choose one",
            "in.bvh a.bvh --loop --frames 0:8": "no cycle is found: 0.27 s are too short",
            "in.bvh a.bvh --to .glb": "--to is for folders; in.bvh is a file",
            "in.bvh a.bvh --again": "--again is for folders; in.bvh is a file",
            "odd.bvh a.bvh --rig canonical": "rig",
            "takes takes": "takes is the folder that is read",
            "takes out --to .mp3": "unknown ending '.mp3'",
            "takes out --jobs 0": "--jobs must be at least 1",
            "takes out --source-rig nobody": "no rig 'nobody'",
            "takes in.bvh": "in.bvh",
            "empty out": "no .bvh or",
            "alike out --to npz": "would both become",
        }.items()
    },
    **{
        f"{words} lossy.bvh {more}": "frame 1, column"
        for words, more in {"convert": "a.npz", "tween": "-o a.bvh --keyframes 0,1", "info": "", "measure": ""}.items()
    },
    "convert lossy.bvh a.npz": "got 'nan'; `mapctl infill` fills in what is lost",
    # rigs
    "info in.bvh --rig cmu-daz": "rig cmu-daz: no joint 'hip' for hips",
    "info in.bvh --rig nobody": "no rig 'nobody'; known rigs: ",
    "info in.bvh --rig none.toml": "no such file",
    "info --rig mixamo": "--rig",
    "info in.bvh -o rig.jpg": "--out writes .png, not .jpg",
    "info in.bvh -o none/rig.png": "none",
    "info -o rig.png": "a picture of a clip's rig: mapctl info CLIP -o FILE.png",
    "convert snake.bvh a.bvh --rig canonical": "no joint is found for hips",
    f"{FOLLOW} --rig part.toml": "rig part names no joint for spine, ",
    f"{DENOISE} --rig nobody": "nobody",
    # denoise
    "denoise in.bvh": "--out",
    "denoise in.bvh -o a.mp3": ".mp3",
    f"{DENOISE} --video p.avi": ".mp4",
    f"{DENOISE} --mask gone.csv": "gone.csv",
    f"{DENOISE} --mask wrong.mask.csv": "line 2",
    f"{DENOISE} --mask name.mask.csv": "no joint 'Hnad_L' to mask; the nearest is Hand_L",
    f"{DENOISE} --mask late.mask.csv": "ends at 50, the recording at 45",
    f"{DENOISE} --causal --delay 0": "the delay must be",
    f"{DENOISE} --causal --prior locomotion": "leave --prior out",
    f"{DENOISE} --delay 0.2": "--delay is how far --causal may look ahead",
    f"{DENOISE} --cluster local": "--cluster is for folders; in.bvh is a file",
    f"{DENOISE} --jobs 2": "--jobs is for folders; in.bvh is a file",
    f"{CLEAN} --strict": "--strict is for single files",
    f"{CLEAN} --mask wrong.mask.csv": "--mask is for single files; takes is a folder",
    f"{CLEAN} --cluster 10.0.0.1:6379 --jobs 2": "--jobs is for this machine",
    f"{CLEAN} --jobs 0": "--jobs must be at least 1, got 0",
    "denoise takes -o out --denoiser prior.safetensors": "a lstm-gmm is no denoiser",
    "denoise empty -o out": "below empty",
    # infill
    INFILL: "give the missing frames (--gap A:B) or joints",
    f"{INFILL} --gap 5:12 --gap 11:20": "the gaps 5:12 and 11:20 overlap; make them one",
    f"{INFILL} --gap 40:46": "within the motion's frames 0:45",
    f"{INFILL} --gap 9:5": "must begin before it ends",
    f"{INFILL} --gap 5": "a gap is A:B, frames or seconds as in 60:120 or 2s:4s; got '5'",
    f"{INFILL} --gap -5:9": "a frame is a whole number from 0",
    f"{INFILL} --gap 5:9:12": "got '9:12'",
    f"{INFILL} --gap 0:20 --gap 20:45": "leave nothing of the motion's 45 frames",
    f"{INFILL} --joints Hand_L,LowArm_L": "no joint 'LowArm_L' to mask; the nearest is LowerArm_L",
    f"{INFILL} --joints 'root position'": "leave nothing of the motion's 45 frames",
    f"{INFILL} --joints Hand_L --curve line:4": "the hips follow a curve where",
    f"{INFILL} --gap 5:9 --method best": "there is no --method best; there are auto",
    f"{INFILL} --gap 5:9 --method infiller --no-refine --prior general": "leave --prior out",
    f"infill {IN} --gap 5:9 --method slerp --curve line:4": "--curve needs",
    f"infill {IN} --gap 5:9 --method slerp --dna in.bvh": "--method slerp takes no style",
    f"infill {IN} --gap 5:9 --dna in.bvh --curve line:4": "--dna gives a style and --curve a trajectory",
    f"{WAY} --way 10:61": "the way 10:61 must begin before it ends, within the motion's frames 0:45",
    f"{WAY} --way 5:20 --way 10:30": "the ways 5:20 and 10:30 overlap",
    f"{WAY} --way 0:45 --gap 10:20": "lost over all frames of a motion whose joints are lost as well",
    f"{WAY} --way 5:20 --curve line:3": "--way and --curve both give the hips' trajectory",
    f"{WAY} --gap 5:20": "--path predicts the hips' position for --way and for --method tweener",
    f"infill {IN} --way 5:20 --method slerp --path denoiser.safetensors": "a denoiser is no path",
    # tween
    f"tween {IN}": "--keyframes",
    f"{TWEEN} 9,9": "at least two keys, got 1",
    f"{TWEEN} 0,1.5s": "the key 45 is not one of the motion's frames 0:45",
    f"{TWEEN} 0,,9": "a frame is a whole number from 0, or seconds as in 1.5s",
    f"{TWEEN} 0,9,20 --joints Hnad_L": "no hand or foot 'Hnad_L'; the",
    f"{TWEEN} 0,9 --joints Hand_L --root-only": "choose one",
    f"{TWEEN} 0,9 --joints Hand_L": "--joints is about keys between",
    f"{TWEEN} 0,9 --method infiller --no-refine --prior x": "leave --prior out",
    f"{TWEEN} 0,9 --method infiller --dna in.bvh": "leave --dna out",
    f"{TWEEN} 0,9 --method tweener": "--method tweener takes no infiller",
    f"{TWEEN} 0,9 --path x": "--path predicts the hips' position",
    f"{TWEEN} 0,9 --method transformer --stitcher stitcher.safetensors": "--method transformer stitches nothing",
    f"tween {IN} --keyframes 0,9 --inbetweener stitcher.safetensors": "is a stitcher; name it by --stitcher",
    f"{STITCH} --keyframes 0,9 --prior prior.safetensors": "no MAP stage for a density",
    f"{STITCH} --keyframes 0,1 --variations 3": "no two keys have whole poses with 1 to 23 frames between them",
    **{
        f"tween {STYLE} --keyframes 0,40 --dna {dna}": said
        for dna, said in {
            "wavelefthand": "the nearest class is wave-left-hand",
            "no.bvh": "no.bvh: no such file",
            "in.bvh,,walk": "with a comma between two",
            "odd.bvh": "odd.bvh gives no style: the rig is not recognised",
        }.items()
    },
    "chain in.bvh other.bvh -o a.bvh --method rollouts --dna in.bvh": "--method rollouts takes no style",
    **{
        KEYED.format(kind): said
        for kind, said in {
            "misspelt": "key[3].plaec: there is no such key; the nearest is place",
            "no-hand": "key[1].reach: no hand or foot 'Hnad_L'; the nearest is Hand_L",
            "no-pose": "gone.bvh",
            "no-body": "body: ",
            "late": "the frame 45 is not one of the pose's 0:45",
            "twice": "key[3]: key[2] is at frame 40 already",
            "nan": "key[3].place[1]: ",
            "empty": "the file is empty",
            "undrawn": "key[1].drawing: no joint 'Hnad_L' that could be drawn; ",
            "point": "the drawing has all joints at one point",
            "two-kinds": "key[2].half: half and drawing are 2 kinds of keys; choose one",
            "no-half": "key[2].half: input should be 'upper' or 'lower'",
        }.items()
    },
    f"{KEYED.format('good')} --keyframes 0,9": "--keyframes is for motion files; ",
    # measure, train, live
    "measure in.bvh --speed 1": "--curve",
    "measure in.bvh --curve line:4 --speed -1": "speed must be positive",
    "measure takes --reference in.bvh": "a folder and a clip",
    "measure takes --curve circle:3": "for one clip",
    "measure short": "short: no clip can be measured; short/one.bvh: measures need",
    "measure takes --reference takes": "clips; a comparison needs at least 8 in each folder",
    "train gan --data . -o run": "lstm-gmm",
    "train refiner": "--data",
    "train refiner --data gone -o run": "gone is not a folder that can be read",
    "train refiner --data empty -o run": "no .bvh below",
    f"{TRAIN} --match (": "regular expression",
    f"{TRAIN} --density nobody": "no prior 'nobody'",
    f"{TRAIN} --resume": "no checkpoint to resume from",
    f"{TRAIN} --steps 0": "steps must be at least 1, got 0",
    f"{TRAIN} --batch 1": "batch must be at least 2, got 1",
    f"{TRAIN} --width 0": "Unrecognized options: --width",
    "live --character hero.glb --rig mixamo": "--character moves on its own bones; leave it or --rig out",
}
"""Command lines, and a part of the message of each."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Everything that the requests name; nothing is ever written here."""
    folder = tmp_path_factory.mktemp("refusals")
    on_rig("bandai", 45).save(folder / "in.bvh")
    on_rig("daz", 45).save(folder / "other.bvh")
    (folder / "link.bvh").symlink_to("in.bvh")
    for name in ("folder.bvh", "takes", "empty", "alike", "two", "short"):
        (folder / name).mkdir()
    walk(40).save(folder / "takes" / "a.bvh")
    for name in ("a.bvh", "a.npz"):
        walk(5).save(folder / "alike" / name)
    walk(40).slice(0, 1).save(folder / "short" / "one.bvh")
    pair(6).write(folder, subject="01", take="in")
    STRANGE_RIGS["a snake"].motion.save(folder / "snake.bvh")
    np.savez(folder / "objects.npz", **{**npz.to_arrays(walk(2)), "names": np.array([{}] * 21)})
    texts = {
        **{f"{kind}.bvh": text for kind, text in MOTIONS.items()},
        **{f"{kind}.curve.csv": text for kind, text in CURVES.items()},
        **{f"{kind}.mask.csv": f"joint,start,stop\n{row}\n" for kind, row in MASKS.items()},
        **{f"{kind}.keys.toml": text for kind, text in KEY_FILES.items()},
        **{f"{kind}.csv": f"joint,x,y\n{rows}\n" for kind, rows in DRAWINGS.items()},
        **{f"{kind}.shot.toml": f"[[key]]\n{text}\n" for kind, text in SHOTS.items()},
        **{f"{kind}.steer.csv": f"{text}\n" for kind, text in SCRIPTS.items()},
        **{f"two/{name}": "x" for name in ("01.asf", "02.asf", "in.amc")},
        "lossy.bvh": MOTIONS["nan"],
        "still.scene.toml": STILL,
        "part.toml": '[joints]\nhips = "Hips"\n',
        "broken.amc": "hello\n",
        "gen.file": "here first",
        "bad.safetensors": "\0" * 99,
        "hero.glb": "",
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    save_tiny_prior(folder / "prior.safetensors")
    save_tiny_denoiser(folder / "denoiser.safetensors")
    save_tiny_infiller(folder / "infiller.safetensors", drawn=0.02)
    save_tiny_stitcher(folder / "stitcher.safetensors")
    predictor = save_tiny_path(folder / "path.safetensors")
    save_tiny_tweener(folder / "tweener.safetensors", str(predictor), ("walk", "wave-left-hand"))
    return folder


@pytest.mark.parametrize(("words", "said"), CASES.items(), ids=CASES)
def test_a_request_is_refused_in_one_line(words, said, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert run(*shlex.split(words)) == 2
    shown = capsys.readouterr()
    assert shown.out == "" or words.startswith("info")  # what is known of a clip is printed all the same
    assert shown.err.startswith("mapctl: ")
    assert shown.err.count("\n") == 1
    assert said in shown.err
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_a_package_that_is_not_installed_is_named(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)

    def miss(self):
        raise ModuleNotFoundError("No module named 'viser.scene'", name="viser.scene")

    with monkeypatch.context() as patch:
        patch.setattr("mapctl.commands.info.Info.run", miss)
        assert run("info") == 2
    assert "pip install 'mapctl[live]'" in capsys.readouterr().err
    monkeypatch.setattr("mapctl.commands.shared.outputs.find_spec", lambda name: None)
    assert run("follow", "line:4", "-o", "a.bvh", "--video", "a.mp4") == 2
    assert "pip install 'mapctl[render]'" in capsys.readouterr().err
    monkeypatch.setattr("mapctl.formats.find_spec", lambda name: None)
    assert run("convert", "gone.bvh", "a.usda") == 2
    assert "USD needs the package usd-core: pip install 'mapctl[usd]'" in capsys.readouterr().err
