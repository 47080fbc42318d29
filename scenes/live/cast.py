"""All characters of the live viewer: what arrives is taken and shown when it is due, and who falls behind is said."""

import time
from collections.abc import Callable, Sequence

import viser

from mapctl.curves.obstacles import Obstacle
from mapctl.errors import MapctlError
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.runtime.live_protocol import FrameChunk, LiveCharacter
from mapctl.streaming.protocols import FrameStream
from scenes.drawn_character import DrawnCharacter
from scenes.live.actor import LiveActor
from scenes.live.inputs import SteeringInputs
from scenes.live.notifications import Notifications
from scenes.live.readouts import Readouts


class Cast:
    """Characters, of which one is chosen: orders are for it, and the numbers are its own."""

    def __init__(
        self, members: Sequence[LiveActor], notices: Notifications, gauges: Readouts, stream: FrameStream | None = None
    ):
        """Frames also go to `stream`."""
        self.members, self._notices, self._gauges, self._stream = members, notices, gauges, stream
        self.number, self.is_paused, self.rests, self._began = 0, False, False, 0.0
        self._still_since: float | None = None

    @property
    def chosen(self) -> LiveActor:
        """The chosen character."""
        return self.members[self.number]

    def begin(self, now: float) -> None:
        """Note when the show began: what was due before is not streamed, for it would only come late."""
        self._began = now

    def choose(self, number: int) -> None:
        """Choose a character, from 0."""
        if not 0 <= number < len(self.members):
            raise MapctlError(f"there is no character {number + 1}")
        self.number = number
        self._gauges.forget()

    def show(self, now: float, show_time: float) -> None:
        """Take what came and show what is due: now is a value of time.perf_counter, `show_time` the show's own."""
        for member in self.members:
            if not member.gone:
                self._run_safely(lambda one=member: self._receive(one, now))
            if not self.is_still:
                self._run_safely(lambda one=member: one.show_due(now, show_time))

    @property
    def is_still(self) -> bool:
        """Whether nobody moves."""
        return self.is_paused or self.rests

    @property
    def is_recorded(self) -> bool:
        """Whether somebody is recorded."""
        return any(member.recording is not None for member in self.members)

    def set_paused(self, paused: bool) -> None:
        """Stop everybody, or go on."""
        self.is_paused = paused
        if self._stream is not None:
            self._stream.pause()
        self._stop_or_go_on()

    def rest(self, rests: bool) -> None:
        """Stop everybody while nobody looks, or go on unless they are paused."""
        if rests == self.rests:
            return
        self.rests = rests
        if not self.is_paused:
            self._stop_or_go_on()

    def _stop_or_go_on(self) -> None:
        still_since, now = self._still_since, time.perf_counter()
        self._still_since = (still_since or now) if self.is_still else None
        for member in self.members:
            if still_since is not None and not self.is_still:
                member.postpone(now - still_since)
            member.pace.forget()
            self._run_safely(lambda one=member: one.character.pause(self.is_still))

    def set_rate(self, rate: float) -> None:
        """Let time pass at another rate for everybody, seconds of theirs per second."""
        if self._stream is not None:
            self._stream.pause()
        for member in self.members:
            self._run_safely(lambda one=member: one.set_rate(rate, time.perf_counter()))

    def restart(self, obstacles: Sequence[Obstacle]) -> None:
        """Restart everybody with the first orders, to walk round obstacles."""
        for number, member in enumerate(self.members):
            self._notices.state(f"gone {member.name}", None)
            self._run_safely(lambda one=member: one.reset(obstacles))
            if self._stream is not None:
                self._stream.forget(number)
        self._gauges.forget()

    def report_pace(self, now: float) -> None:
        """Say who does not keep up, and who does again."""
        if self.is_still:
            return
        for member in self.members:
            if not member.gone:
                self._report_pace(member, now)

    def close(self) -> None:
        """End all characters."""
        for member in self.members:
            member.character.close()

    def _receive(self, member: LiveActor, now: float) -> None:
        try:
            arrived = member.character.poll()
        except MapctlError as error:
            member.gone = str(error)
            said = f"{member.name} is no more: {error}. Reset brings it back; its recording can be saved"
            self._notices.state(f"gone {member.name}", said)
            self._notices.console(said)
            return
        for delivered in arrived:
            member.take(delivered, now)
            self._report_recording(member)
            if self._stream is not None and delivered.due >= self._began:
                self._send(self._stream, self.members.index(member), delivered)
            for note in delivered.notes:
                self._notices.event(member.name.capitalize(), note)
            if member is self.chosen:
                self._gauges.add(delivered, PRIOR_FPS)

    def _report_recording(self, member: LiveActor) -> None:
        fault = "" if member.recording is None else member.recording.fault
        said = f"The recording of {member.name} has stopped: {fault}. What there is can be saved"
        self._notices.state(f"recording {member.name}", said if fault else None)

    def _send(self, stream: FrameStream, number: int, delivered: FrameChunk) -> None:
        """Send frames, one by one in slow motion, since they are farther apart than the stream takes them to be."""
        if delivered.rate == 1:
            stream.put(number, delivered.due, delivered.seconds, delivered.root, delivered.quats)
            return
        for k in range(len(delivered.root)):
            one, seconds = slice(k, k + 1), delivered.seconds + k / PRIOR_FPS
            stream.put(number, delivered.due_of(k), seconds, delivered.root[one], delivered.quats[one])

    def _report_pace(self, member: LiveActor, now: float) -> None:
        changed, slow = member.pace.judge(now), member.pace.slow
        said = f"{member.name} is too slow for this machine: {member.pace.text(now)}" if slow else None
        if changed or slow:
            self._notices.state(f"slow {member.name}", said)
        if changed:
            self._notices.console(said or f"{member.name} keeps up again")

    def _run_safely(self, action: Callable[[], None]) -> None:
        self._notices.run_safely(action)


def make_members(
    scene: viser.SceneApi,
    world: str,
    characters: Sequence[LiveCharacter],
    orders: Sequence[SteeringInputs],
    *,
    drawn: Sequence[DrawnCharacter | None] = (),
    rigs: Sequence[Callable[[Motion], Motion] | None] = (),
    licence: str = "",
) -> list[LiveActor]:
    """Make the characters below the scene's node `world`: mannequins without `drawn`, recorded as they move without
    `rigs`, under a licence where formats keep one."""
    nobody = [None] * len(characters)
    parts = zip(characters, orders, drawn or nobody, rigs or nobody, strict=True)
    return [LiveActor(scene, world, k, *one, licence=licence) for k, one in enumerate(parts)]
