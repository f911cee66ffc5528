"""One session of the synthesizer service: its face and the state of its message streams."""

import math
import time
from collections import deque
from collections.abc import Iterable, Iterator

from kouxing_client.messages import FapFrame

from kouxing.services.synthesizer.face_animator import FaceAnimator, Frame
from kouxing.services.synthesizer.lateness import LatenessMeter
from kouxing.shared.arrays import Floats
from kouxing.shared.clock import to_seconds
from kouxing.shared.face.shapes import SHAPE_SETS
from kouxing.shared.network.reliable import ReliableReceiver
from kouxing.shared.network.replaying_publisher import ReplayingPublisher
from kouxing.shared.network.sockets import Socket
from kouxing.shared.phones import events
from kouxing.shared.phones.events import AudioSkipped, SoundEvent
from kouxing.shared.service.overload import SkipPolicy
from kouxing.shared.wire.control import StartSession
from kouxing.shared.wire.final_time import FinalTimeTracker
from kouxing.shared.wire.speech import Acknowledge, NewestFrame

RECOGNIZER_TIMEOUT_S = 20.0  # longer than the reports for silent clients take


class SynthesizerSession:
    """The state of one session."""

    def __init__(
        self,
        start: StartSession,
        face: FaceAnimator,
        input_socket: Socket,
        publisher: Socket,
        max_lag_s: float,
    ) -> None:
        self.start = start
        self.is_paced = start.opening.paced
        self.replay = ReplayingPublisher(publisher, time.monotonic())
        self.face = face
        self.receiver = ReliableReceiver(input_socket, start.session, self._acknowledgement)
        self.input_epoch = 0  # epoch of the newest message from the recognizer; 0 before the first
        self.relax_at_s = time.monotonic() + RECOGNIZER_TIMEOUT_S  # start of frames without sound
        self.output_sequence = 0
        self.newest_frame: FapFrame | None = None
        self.final_time = FinalTimeTracker()
        self.events: deque[SoundEvent] = deque()  # frames are being made for the first event
        self.pending_frames: Iterator[Frame] | None = None  # remaining frames of the first event
        self.skip_policy = SkipPolicy(max_lag_s)
        self.newest_event_s = 0.0  # media time of the newest received event
        self.is_finished = False
        self.lateness = LatenessMeter()
        self.shapes: list[str] = []  # shape sets to publish
        self.add_shapes(start.opening.face.shapes or ())

    def add_shapes(self, names: Iterable[str]) -> None:
        """Publish more shape sets."""
        known = [name for name in names if name in SHAPE_SETS]
        self.shapes = list(dict.fromkeys([*self.shapes, *known]))

    def skip_if_behind(self, now_s: float) -> None:
        """Skip all frames except the newest frame if the session is too far behind."""
        waiting_s, known_s = 0.0, math.inf
        for event in self.events:
            if isinstance(event, events.Progress):
                waiting_s += max(0.0, event.time_s - known_s)
            if isinstance(event, events.Progress | AudioSkipped):
                known_s = event.time_s
        if self.skip_policy.update(waiting_s, now_s):
            self.face.skip_to(self.newest_event_s)

    def resume(self, media_time: int, num_frames: int, faps: Floats | None) -> None:
        """Continue after the newest frame of another synthesizer."""
        self.output_sequence = num_frames
        self.face.resume(to_seconds(media_time), num_frames, faps)

    @property
    def media_time(self) -> int:
        """Media time of the newest frame, samples at 16 kHz."""
        return self.newest_frame.media_time if self.newest_frame is not None else 0

    def _acknowledgement(self) -> Acknowledge:
        if (frame := self.newest_frame) is None:
            return Acknowledge()
        newest_frame = NewestFrame(
            sequence=frame.sequence, media_time=frame.media_time, values=frame.packed_values
        )
        return Acknowledge(newest_frame=newest_frame)
