"""Which of the held-out clips a table measures."""

from helpers import walk

from controllers.benchmarks.shared.held_out import load_clean_clips
from mapctl import retarget


def test_clips_are_spread_over_each_kind_those_first_by_which_nothing_was_chosen(tmp_path):
    names = {
        "test": [f"bandai/wave_{number}.bvh" for number in range(5)] + ["bandai/a_walk_0.bvh"],
        "validation": [f"bandai/nod_{number}.bvh" for number in range(5)]
        + [f"bandai/a_walk_{number}.bvh" for number in range(1, 5)],
    }
    frames = {}
    for number, name in enumerate(name for part in names.values() for name in part):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        motion = walk(30 + number)  # a clip is known again by its length
        retarget.from_canonical(motion, retarget.identify_rig(motion.skeleton)).save(tmp_path / name)
        frames[motion.num_frames] = name.removeprefix("bandai/").removesuffix(".bvh")

    def pick(count: int) -> dict[str, list[str]]:
        found: dict[str, list[str]] = {}
        for clip in load_clean_clips(tmp_path, names, count):
            found.setdefault(clip.kind, []).append(frames[clip.motion.num_frames])
        return found

    assert pick(10) == {"walks": ["a_walk_0", "a_walk_1"], "gestures, dance, fights": ["wave_0", "wave_2"]}
    assert pick(15)["walks"] == ["a_walk_0", "a_walk_1", "a_walk_3"]
    assert pick(35)["gestures, dance, fights"] == [*(f"wave_{number}" for number in range(5)), "nod_0", "nod_2"]
    assert len(pick(500)["gestures, dance, fights"]) == 10
