"""Creates the faces of sessions from their settings, and changes them."""

from collections.abc import Callable

from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face_animator import FaceAnimator
from kouxing.services.synthesizer.lips.lip_model import LipModel
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.services.synthesizer.session import SynthesizerSession
from kouxing.shared.errors import StartFailure, UserError
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE
from kouxing.shared.wire.control import StartSession
from kouxing.shared.wire.face import FaceSettings
from kouxing.shared.wire.session import ErrorCode


class FaceMaker:
    """Creates and changes faces.

    Control has checked the names in the settings. ``report`` is called with a session and a text if
    a lip model cannot be loaded.
    """

    def __init__(
        self, config: SynthesizerConfig, report: Callable[[StartSession, str], None]
    ) -> None:
        self._config = config
        self._report = report
        load_lip_model(name=config.lips)  # so that the first session does not wait

    def make(self, start: StartSession) -> FaceAnimator:
        """Return a face at rest. Raises ``StartFailure`` if its lip model cannot be loaded."""
        config, settings = self._config, start.opening.face
        face = FaceAnimator(
            self._load_lip_model(start, settings.lip_model or config.lips),
            frame_rate_hz=config.frame_rate_hz,
            delay_s=config.delay_ms / 1e3,
            idle_motion=config.idle_motion,
            expressiveness=settings.expressiveness or config.expressiveness,
            feeling=config.feeling if settings.feeling is None else settings.feeling,
        )
        if settings.expressions:
            face.set_expressions(settings.expressions, settings.hold_s)
        _set_idle_motion(face, settings)
        return face

    def change(self, session: SynthesizerSession, settings: FaceSettings) -> None:
        """Change the settings of a face, with continuous transitions."""
        if settings.lip_model is not None:
            language = session.start.facts.language or DEFAULT_LANGUAGE
            try:
                session.face.set_lip_model(load_lip_model(language, settings.lip_model))
            except UserError as error:
                self._report(session.start, str(error))
        if settings.expressiveness is not None:
            session.face.set_expressiveness(settings.expressiveness)
        if settings.feeling is not None:
            session.face.set_feeling(settings.feeling)
        _set_idle_motion(session.face, settings)
        if settings.expressions is not None:
            session.face.set_expressions(settings.expressions, settings.hold_s)
        session.add_shapes(settings.shapes or ())

    def _load_lip_model(self, start: StartSession, name: str) -> LipModel:
        """Load the lip model of a session.

        A moved session gets the default lip model if its own cannot be loaded. Raises
        ``StartFailure`` if a new session's lip model cannot be loaded.
        """
        language = start.facts.language or DEFAULT_LANGUAGE
        try:
            return load_lip_model(language, name)
        except UserError as error:
            is_default = name == self._config.lips  # loaded at startup
            if start.epoch == 1 or is_default:
                code = ErrorCode.BAD_LANGUAGE if is_default else ErrorCode.BAD_FACE
                raise StartFailure(code, str(error)) from error
            self._report(start, str(error))
            return self._load_lip_model(start, self._config.lips)


def _set_idle_motion(face: FaceAnimator, settings: FaceSettings) -> None:
    face.set_idle_motion(
        still=settings.still, eye_contact=settings.eye_contact, listening=settings.listening
    )
