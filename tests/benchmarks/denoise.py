"""Denoising beside filters: joint errors of clips with noise (5 degrees, 2 cm, 1 % spikes), of clips that tremble and
drift as estimates from video, and of clean clips.

`--model` is a denoiser. Filters are tuned on the truth: the best cut-off of a Butterworth filter (fourth order, forward
and backward), the best window of a Savitzky-Golay filter (third order). Of clean clips the input is the truth, and the
error is the change.
"""

import torch
from common import compare_methods, load_circles, map_motion, measure_error, parse, print_table
from corruptions import add_noise, add_video_noise
from scipy.signal import butter, savgol_filter, sosfiltfilt
from torch import Tensor

import controllers
import priors
from mapctl.motion import Motion

CUTOFFS, WINDOWS = (1, 1.5, 2, 3, 4, 5, 6, 8, 10, 12), (5, 7, 9, 13, 17, 25, 35)  # Hz; frames


def filter_butterworth(motion: Motion, hertz: float) -> Motion:
    """Filter all values of a motion over time."""
    filtered = butter(4, hertz / (float(motion.fps) / 2), output="sos")

    def smooth(values: Tensor) -> Tensor:
        return torch.from_numpy(sosfiltfilt(filtered, values.numpy(), axis=0).copy())

    return map_motion(motion, smooth)


def filter_savitzky_golay(motion: Motion, window: int) -> Motion:
    """Fit cubic polynomials to all values of a motion over time."""
    return map_motion(motion, lambda values: torch.from_numpy(savgol_filter(values.numpy(), window, 3, axis=0)))


def main(words: list[str] | None = None) -> None:
    """Measure and print."""
    given = parse(__doc__, words, count=20, model="denoiser", seconds=10.0)
    circles = load_circles(given, shortest=2.0, longest=given.seconds, model=given.model)
    denoiser, inbetweener = priors.load_denoiser(given.model), priors.load_inbetweener("transformer")

    def measure(truth: Motion, generator: torch.Generator) -> dict[str, dict[str, float]]:
        noisy = add_noise(truth, generator, degrees=5.0, centimetres=2.0)
        video = add_video_noise(truth, generator)
        half, found = float(truth.fps) / 2, {}
        for case, capture in (("noise", noisy), ("video", video), ("clean", truth)):
            filters = {
                "Butterworth, tuned": [filter_butterworth(capture, hertz) for hertz in CUTOFFS if hertz < half],
                "Savitzky-Golay, tuned": [filter_savitzky_golay(capture, window) for window in WINDOWS],
            }
            if case == "clean":
                filters = {}
            done = controllers.denoise(capture, denoiser, inbetweener=inbetweener).motion
            errors = {"input": measure_error(truth, capture)}
            errors |= {name: min(measure_error(truth, each) for each in tried) for name, tried in filters.items()}
            # A leading T-pose would be cut: compare the frames that are left.
            cut = truth.slice(truth.num_frames - done.num_frames, truth.num_frames)
            found[case] = errors | {"mapctl denoise": measure_error(cut, done)}
            if case == "video":
                studio = controllers.DenoiseSettings(capture="studio")
                done = controllers.denoise(capture, denoiser, inbetweener=inbetweener, settings=studio).motion
                found[case]["mapctl denoise --capture studio"] = measure_error(cut, done)
        return found

    print_table(compare_methods(circles, measure, seed=given.seed, simple="input"), circles)


if __name__ == "__main__":
    main()
