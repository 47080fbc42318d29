"""`mapctl steer`: a script of commands is replayed, as live steering would answer it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from mapctl.commands.shared import character, options, outputs
from mapctl.commands.shared.path_walk import EXIT_INTERRUPTED
from mapctl.commands.shared.threads import use_single_thread
from mapctl.intent.steering import SteeringLimits
from mapctl.runtime.progress import show_progress

if TYPE_CHECKING:
    from controllers.steering.loop import Recorder, StepRecord
    from mapctl.intent.steering import CommandTrack
    from mapctl.motion import Motion
    from priors.lstm_gmm.density import LstmGmmDensity

_EXIT_NOT_SATISFIED = 3
_TURN_RATE_DEG = round(math.degrees(SteeringLimits.turn_rate), 1)
_LAST_COMMAND_SECONDS = 3.0  # seconds for which a script of a single command is played


@dataclass(frozen=True)
class Steer:
    """A character obeys a script of speeds and directions, answered as live steering would."""

    commands: Positional[Annotated[Path, arg(metavar="COMMANDS.csv")]]
    """CSV with the columns time_s, speed_mps, heading_deg (0 is +Z, 90 is +X); and, where wanted, facing_deg for
    strafing, turn_deg_s to turn on and on, step_m for a step length, gait and style as the prior knows them. The last
    line's time is the end."""
    out: options.OutFile
    """Where the motion goes: .bvh, .npz, .glb or .usda."""
    realtime: bool = False
    """Play against the wall clock: every step has a deadline and brings the best found by then. On a machine that
    cannot keep up the script's time goes slower than the clock's, and the summary says so."""
    prior: options.Name = "locomotion-live"
    """A bundled prior, or the file or run folder of a trained one."""
    rig: character.OutRig = "canonical"
    """Whose body moves: the canonical one, or that of a clip, on whose rig the motion is then written; or a rig by name
    or TOML file, whose joints get the canonical bones."""
    seed: options.Count = 0
    """Of the pose that it begins with."""
    acceleration: options.Number = SteeringLimits.acceleration
    """Most that the wanted speed rises by, m/s^2."""
    braking: options.Number = SteeringLimits.braking
    """Most that it falls by, m/s^2."""
    turn_rate: options.Number = _TURN_RATE_DEG
    """Most that the wanted direction turns by, degrees/s."""
    report: options.MaybeFile = None
    """JSON with each command's response, timing, ledger and measures."""
    plot: options.MaybeFile = None
    """PNG of wanted and got speed and direction over time."""
    strict: bool = False
    """Exit with status 3 where a speed was lowered to what the prior can do, or a frame was late."""
    quiet: bool = False
    """No summary and no progress bar."""

    def run(self) -> int:
        """Check everything, steer, write, tell. Ctrl-C ends the script early; what was steered is written."""
        use_single_thread()
        self._check()
        import priors
        from mapctl.intent.steering_csv import read_commands

        track = read_commands(self.commands)
        person, prior = character.read_character(self.rig), priors.load(self.prior)
        track, lowered = track.limit_speed(prior.limits.max_steering_speed)
        for labels in {command.told for command in track.commands if command.told}:
            prior.conditioned_on(labels)  # what it does not know is said now
        recorder, records, frames = self._run_steering(prior, track, person)
        motion = recorder.motion(frames)
        person.on_rig(motion).save(self.out)
        report = self._report(motion, recorder, records, track, lowered, prior)
        if self.report is not None:
            from mapctl import report as reports

            reports.write_report(report, self.report)
        if self.plot is not None:
            from scenes.plots.steering import plot

            plot(motion, track, self.plot)
        if not self.quiet:
            print("\n".join(_format_summary(report, options.collect_paths(self.out, self.report, self.plot))))
        if motion.num_frames < frames:
            return EXIT_INTERRUPTED
        return _EXIT_NOT_SATISFIED if self.strict and (lowered or report["timing"]["late_frames"]) else 0

    def _check(self) -> None:
        from mapctl import formats

        options.check_seed(self.seed)
        self._limits()
        formats.check_ending(self.out)
        outputs.check_files(options.collect_paths(self.out, self.report, self.plot))
        outputs.check_plot(self.plot)

    def _limits(self) -> SteeringLimits:
        return SteeringLimits(self.acceleration, self.braking, math.radians(self.turn_rate))

    def _run_steering(
        self, prior: "LstmGmmDensity", track: "CommandTrack", person: character.Character
    ) -> tuple["Recorder", list["StepRecord"], int]:
        import torch

        from controllers.steering import steer
        from controllers.steering.loop import Recorder, StreamClock, WallClock, drive
        from mapctl.terms import FootContact

        first, recorder = track.commands[0], Recorder()
        frames = options.count_frames(track.times[-1] + (_LAST_COMMAND_SECONDS if len(track.times) == 1 else 0.0))
        footing = FootContact(rest_height=person.toe_rest_height)
        settings = steer.SteerSettings(limits=self._limits(), footing=footing)
        generator = torch.Generator().manual_seed(self.seed)
        state, pose = steer.begin(prior, first, generator=generator, settings=settings, skeleton=person.skeleton)
        recorder.show(pose, 0.0)
        for command in (first, *{command.told: command for command in track.commands}.values()):
            steer.step(state, command)  # what is compiled, loaded or told on first use must not cost frames
        clock = WallClock() if self.realtime else StreamClock()
        with show_progress("steering", quiet=self.quiet) as progress:
            displays = [recorder] if progress is None else [recorder, _ProgressDisplay(progress, frames)]
            _, records = drive(state, track, displays, frames=frames, clock=clock)
        return recorder, records, frames

    def _report(
        self,
        motion: "Motion",
        recorder: "Recorder",
        records: Sequence["StepRecord"],
        track: "CommandTrack",
        lowered: Sequence[str],
        prior: "LstmGmmDensity",
    ) -> dict[str, Any]:
        from controllers.steering.loop import summarise_step_timing
        from mapctl import metrics, report
        from mapctl.metrics.travel import measure_commands

        cost = summarise_step_timing(records, [time for time in track.times[1:] if time < motion.seconds])
        return {
            "request": options.describe_request("steer", self),
            "seed": self.seed,
            "versions": report.package_versions(),
            "prior": {"name": prior.name, "licence": prior.card.licence},
            "motion": report.summarise_motion(motion),
            "status": {"text": "; ".join(lowered) or "done", "ok": not lowered, "notes": list(lowered)},
            "commands": measure_commands(motion, track),
            "ledger": recorder.ledger.summary(),
            "measures": metrics.measure(motion),
            "mocap": report.reference_measures(prior.card.quality),
            "timing": cost | {"peak_memory_mb": report.peak_memory_mb()},
        }


@dataclass(frozen=True)
class _ProgressDisplay:
    """A Display that moves a progress bar."""

    progress: Any
    frames: int

    def show(self, frames: Any, due: float) -> None:
        from mapctl.features import PRIOR_FPS

        self.progress(min(self.frames, round(due * PRIOR_FPS) + frames.motion.num_frames), self.frames)


def _format_summary(report: Mapping[str, Any], files: Sequence[Path]) -> list[str]:
    lines = []
    for row in report["commands"][:-1]:
        reached = "not reached" if row["reached_s"] is None else f"reached after {row['reached_s']:.1f} s"
        steady = "" if row["steady_speed_mps"] is None else f", then {row['steady_speed_mps']:.2f} m/s"
        off, rate = row["steady_heading_error_deg"], row["steady_turn_deg_s"]
        turned = "" if off is None else f", {off:+.1f} degrees off"
        turned += "" if rate is None else f", turning {rate:.0f} degrees/s"
        turned += "" if row["steady_step_m"] is None else f", steps of {row['steady_step_m']:.2f} m"
        way = (
            f"to {row['heading_deg']:.0f} degrees"
            if row["turn_deg_s"] is None
            else (f"turning {row['turn_deg_s']:.0f} degrees/s")
        )
        asked = f"{row['speed_mps']:.2f} m/s {way}"
        lines.append(f"{row['time_s']:6.1f} s  {asked}: {reached}{steady}{turned}")
    cost, latency = report["timing"], report["timing"]["command_latency_s"]
    waited = "" if latency is None else f"; a command waits {latency:.2f} s at most"
    slow = f"; too slow here: time stood still for {cost['held_s']:.1f} s" if cost["held_s"] else ""
    return [
        *lines,
        f"cost      {cost['frame_ms_p50']:.1f} ms a frame (p99 {cost['frame_ms_p99']:.1f}), "
        f"{cost['late_frames']} late, {cost['evaluations_per_frame']:.1f} evaluations a frame{waited}{slow}",
        f"status    {report['status']['text']}",
        f"wrote     {', '.join(map(str, files))}",
    ]
