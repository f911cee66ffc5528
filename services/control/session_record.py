"""Control's record of one session, and the messages about the session."""

from dataclasses import dataclass, field

from kouxing_client.messages import Lateness, SessionFacts, SessionState

from kouxing.services.control.placement import UNPACED_AUDIO
from kouxing.shared.fast_record import replace
from kouxing.shared.network.peer import Peer
from kouxing.shared.wire.control import StartSession
from kouxing.shared.wire.face import CurrentFace
from kouxing.shared.wire.session import OpenSession, SessionMoved, SessionOpened, session_id_of


@dataclass(slots=True)
class SessionRecord:
    """Control's record of one session."""

    name: str
    number: int  # ascending in order of opening
    token: str
    opening: OpenSession
    client: Peer  # on control's socket
    opened_s: float
    started_s: float  # time of the newest start message, or loss of a worker
    workers: dict[str, str]  # instance by endpoint, including lost workers
    endpoints: dict[str, str]  # address by endpoint
    facts: SessionFacts  # as reported by its workers
    face: CurrentFace
    waiting_for: set[str]  # instances that have not started the session yet
    deferred: set[str] = field(default_factory=set)  # part of `waiting_for`, notified last
    lost: set[str] = field(default_factory=set)  # lost workers
    rejected_by: set[str] = field(default_factory=set)  # workers that rejected the current move
    started: set[str] = field(default_factory=set)  # instances that have started the session
    epoch: int = 1
    recognizer_epoch: int = 1  # the first epoch of the current recognizer
    is_announced: bool = False  # whether the client has the endpoints
    has_unannounced_move: bool = False  # placed again, and the client has not been notified
    restored_epoch: int = 0  # its epoch when an earlier control process stopped; 0: not restored
    is_speaking: bool = False
    speech_time: int = 0  # media time at which the newest speech started
    next_sequence: int = 1  # first audio message that a replacement recognizer would need
    resume_sequence: int | None = None  # first message to resend; None: same recognizer
    final_until: int = 0  # media time up to which the phones are final
    lateness: Lateness | None = None  # lateness of the session's frames in the last 10 s
    skipped_s: dict[str, float] = field(default_factory=dict)  # by instance

    @property
    def session_id(self) -> str:
        """Public id of the session. It differs for every session with this name."""
        return session_id_of(self.token)

    @property
    def start_request(self) -> str:
        """The request that services confirm. It differs for every session with this name."""
        return f"start-{self.number}-{self.epoch}"

    @property
    def is_up_to_date(self) -> bool:
        """Whether all services and the client are up to date."""
        return self.is_announced and not (
            self.has_unannounced_move or self.waiting_for or self.lost
        )

    @property
    def missing_workers(self) -> set[str]:
        """The session's workers that have not started it yet."""
        return self.waiting_for & {*self.workers.values()}

    @property
    def _audio_endpoint(self) -> str:
        """Endpoint for the client's audio."""
        live = self.endpoints["audio"]
        return live if self.opening.paced else self.endpoints.get(UNPACED_AUDIO, live)

    def start_message(self, now_s: float) -> StartSession:
        """Return the message that starts the session at a service."""
        return StartSession(
            session=self.name,
            epoch=self.epoch,
            request=self.start_request,
            token=self.token,
            opening=replace(self.opening, face=self.face.at(now_s)),
            facts=self.facts,
            endpoints=self.endpoints,
            final_until=self.final_until,
            speech_time=self.speech_time if self.is_speaking else None,
            client=self.client.address,
            client_key=self.client.key or None,
        )

    def opened_message(self, events: str) -> SessionOpened:
        """Return the answer to the client; ``events`` is control's endpoint."""
        return SessionOpened(
            session=self.name,
            epoch=self.epoch,
            request=self.opening.request,
            token=self.token,
            session_id=self.session_id,
            events=events,
            facts=self.facts,
            audio=self._audio_endpoint,
            phones=self.endpoints["phones"],
            faps=self.endpoints["faps"],
        )

    def moved_message(self) -> SessionMoved:
        """Return the ``session-moved`` message for the client and the subscribers."""
        return SessionMoved(
            session=self.name,
            session_id=self.session_id,
            epoch=self.epoch,
            next_sequence=self.resume_sequence,
            audio=self._audio_endpoint,
            phones=self.endpoints["phones"],
            faps=self.endpoints["faps"],
        )

    def state(self, now_s: float) -> SessionState:
        """Return the session's part of a status report."""
        return SessionState(
            session=self.name,
            session_id=self.session_id,
            state="open" if self.is_announced else "starting",
            age_s=now_s - self.opened_s,
            speaking=self.is_speaking,
            endpoints=self.endpoints,
            workers=self.workers,
            facts=self.facts,
            lateness=self.lateness,
            skipped_s=sum(self.skipped_s.values()),
        )
