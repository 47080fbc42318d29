"""The sub-commands, a module each, imported when its command is used. Part of the command line: like `mapctl.cli` they
may import every package, and nothing else imports them.
"""

from importlib import import_module

COMMANDS = {
    "demo": ("Demo", "A character walks a figure of eight: motion, film, contact sheet and report."),
    "follow": ("FollowCurve", "A character walks a curve: motion and, if requested, a film and a report."),
    "run": ("RunScene", "A scripted scene of several actors, from a TOML file or a ready one by name."),
    "generate": ("Generate", "Motion sampled from a prior, of any length."),
    "steer": ("Steer", "A character follows a script of speeds and directions, as in live steering."),
    "live": ("Live", "Steer characters in a browser on this machine: sliders, keys, drawn paths, recording."),
    "smooth": ("Smooth", "Smooth a tracker's poses live, between tracker and viewer, over the VMC protocol."),
    "drive": ("Drive", "A robot does at once what a character does whose poses come over the VMC protocol."),
    "denoise": ("Denoise", "Denoise a capture with noise, sliding and gaps, or a folder of them."),
    "infill": ("Infill", "Fill in missing frames or joints of a motion; all else stays as it was."),
    "tween": ("Tween", "The motion between keyframes: frames of a clip, or poses of a file."),
    "blend": ("Blend", "Hands or feet of a clip move as in another one for some frames."),
    "chain": ("Chain", "One long motion through short pieces of many clips, the gaps filled in."),
    "render": ("Render", "Film a motion: MP4, GIF, or a PNG contact sheet."),
    "convert": ("Convert", "Write a motion, or a folder of them, in another format, on another skeleton or edited."),
    "measure": ("Measure", "Path, feet, jitter and more of a motion, beside a reference clip and mocap."),
    "train": ("Train", "Train a model on a folder of BVH."),
    "info": ("Info", "Bundled models, licences, scenes and versions; or a clip and its rig."),
    "mcp": ("ServeTools", "Serve info, shot, denoise, measure and contact sheet to an assistant, over MCP."),
    "compile": ("CompileKernels", "Compile the kernels and keep them on disk, so that the first motion does not wait."),
    "blender-addon": ("BlenderAddon", "Write the add-on for Blender 4.2 and later."),
    "bench": ("Bench", "Cost on this machine: following a curve, and steering."),
}
"""Class of options and summary of each command, by the name the user types, in the order of the help."""
MANY_THREADS = {"blender-addon", "convert", "info", "render", "train"}
"""Commands that compute with as many threads as there are, or decide it themselves."""


def load_command(name: str) -> type:
    """Import the module of a command and return its class of options."""
    return getattr(import_module(f"{__name__}.{name.replace('-', '_')}"), COMMANDS[name][0])
